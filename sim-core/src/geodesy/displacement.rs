//! Positions displaced by small angles on the ground, as a GNSS receiver's error displaces them many times a second.
//!
//! The exact method is inverse projection, addition in latitude and longitude, forward projection: some 0.4 µs. This module uses
//! its Taylor series about the nodes of a grid over the map, computed from the exact method once at the start: some 0.02 µs, and
//! within 0.1 mm of the exact method over a map of 50 km × 50 km for displacements up to 300 m (a test compares them).

use super::{GeodesyError, Geodetic, NetPosition, Projection};

/// Most cells along one side of the grid.
const MOST_CELLS: usize = 32;
/// Smallest cell, metres: below this the series is exact to rounding anyway.
const LEAST_CELL_M: f64 = 500.0;
/// Angle of the finite difference for first derivatives, degrees (11 m).
const FIRST_DEG: f64 = 1e-4;
/// Angle of the finite difference for second derivatives, degrees (111 m).
const SECOND_DEG: f64 = 1e-3;

/// An angle of arc on the ground, degrees: the same angle is the same distance in both directions (to 0.5 %, the flattening
/// of the ellipsoid); one degree of latitude is 111.3 km.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GroundArc {
    /// To the east: the longitude changes by this divided by the cosine of the latitude.
    pub east_deg: f64,
    /// To the north: the latitude changes by this.
    pub north_deg: f64,
}

/// A displaced position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisplacedPosition {
    /// Latitude and longitude.
    pub geodetic: Geodetic,
    /// Net coordinates.
    pub net: NetPosition,
}

/// The displaced position, exactly: inverse projection, addition, forward projection.
///
/// # Errors
/// Outside the domain of the projection.
pub fn displaced_exactly(
    projection: &Projection,
    from: NetPosition,
    arc: GroundArc,
) -> Result<DisplacedPosition, GeodesyError> {
    let start = projection.geodetic_from_net(from)?;
    let geodetic = Geodetic {
        latitude_deg: start.latitude_deg + arc.north_deg,
        longitude_deg: start.longitude_deg + arc.east_deg / libm::cos(start.latitude_deg.to_radians()),
    };
    Ok(DisplacedPosition {
        geodetic,
        net: projection.net_from_geodetic(geodetic)?,
    })
}

type Pair = [f64; 2];

/// Derivatives of the exact method at one point of the map. Columns of matrices: east, north (angles), or x, y (metres).
#[derive(Debug, Clone, Copy)]
struct SeriesNode {
    at: Pair,
    /// Latitude and longitude, degrees, their derivatives by x and y, and by xx, xy, yy.
    geodetic: [Pair; 6],
    /// Longitude per eastern arc, 1 / cos(latitude), and its derivatives by x and y.
    stretch: [f64; 3],
    /// Metres per degree, by east and north.
    metres: [Pair; 2],
    /// Derivatives of `metres` by x and by y.
    metres_by: [[Pair; 2]; 2],
    /// Metres per square degree: half the second derivative by east-east and north-north, whole by east-north.
    curvature: [Pair; 3],
}

/// The map's displacement series.
#[derive(Debug, Clone)]
pub struct DisplacementMap {
    corner_m: Pair,
    cell_m: f64,
    columns: usize,
    rows: usize,
    nodes: Vec<SeriesNode>,
}

impl DisplacementMap {
    /// The series over a map with these bounds (x_min, y_min, x_max, y_max, metres).
    ///
    /// # Errors
    /// The map is not inside the domain of its projection.
    pub fn new(projection: &Projection, bounds_m: [f64; 4]) -> Result<Self, GeodesyError> {
        let [x_min, y_min, x_max, y_max] = bounds_m;
        let cell_m = ((x_max - x_min).max(y_max - y_min) / MOST_CELLS as f64).max(LEAST_CELL_M);
        let cells = |length_m: f64| (libm::ceil(length_m / cell_m) as usize).clamp(1, MOST_CELLS);
        let (columns, rows) = (cells(x_max - x_min), cells(y_max - y_min));
        let centre = |corner: f64, index: usize| corner + (index as f64 + 0.5) * cell_m;
        let nodes = (0..rows * columns)
            .map(|i| {
                SeriesNode::new(
                    projection,
                    [centre(x_min, i % columns), centre(y_min, i / columns)],
                    0.5 * cell_m,
                )
            })
            .collect::<Result<_, _>>()?;
        Ok(Self {
            corner_m: [x_min, y_min],
            cell_m,
            columns,
            rows,
            nodes,
        })
    }

    /// The displaced position.
    #[must_use]
    pub fn displaced(&self, from: NetPosition, arc: GroundArc) -> DisplacedPosition {
        let cell = |value: f64, corner: f64, count: usize| (((value - corner) / self.cell_m) as usize).min(count - 1);
        let column = cell(from.x_m, self.corner_m[0], self.columns);
        let row = cell(from.y_m, self.corner_m[1], self.rows);
        self.nodes[row * self.columns + column].displaced(from, arc)
    }
}

impl SeriesNode {
    fn new(projection: &Projection, at: Pair, reach_m: f64) -> Result<Self, GeodesyError> {
        let moved = |x: f64, y: f64| [at[0] + x * reach_m, at[1] + y * reach_m];
        let geodetic = |x: f64, y: f64| {
            let [x_m, y_m] = moved(x, y);
            let geodetic = projection.geodetic_from_net(NetPosition { x_m, y_m })?;
            Ok([geodetic.latitude_deg, geodetic.longitude_deg])
        };
        let stretch = |g: Pair| 1.0 / libm::cos(g[0].to_radians());
        let (centre, left, right) = (geodetic(0.0, 0.0)?, geodetic(-1.0, 0.0)?, geodetic(1.0, 0.0)?);
        let (below, above) = (geodetic(0.0, -1.0)?, geodetic(0.0, 1.0)?);
        let diagonal = [
            geodetic(1.0, 1.0)?,
            geodetic(1.0, -1.0)?,
            geodetic(-1.0, 1.0)?,
            geodetic(-1.0, -1.0)?,
        ];
        let (once, twice) = (0.5 / reach_m, 1.0 / (reach_m * reach_m));
        let by = |f: &dyn Fn(usize) -> f64| [f(0), f(1)];
        let metres = |x: f64, y: f64| metres_per_degree(projection, moved(x, y));
        let slope = |plus: [Pair; 2], minus: [Pair; 2]| {
            [0, 1].map(|column: usize| [0, 1].map(|axis: usize| (plus[column][axis] - minus[column][axis]) * once))
        };
        Ok(Self {
            at,
            geodetic: [
                centre,
                by(&|i| (right[i] - left[i]) * once),
                by(&|i| (above[i] - below[i]) * once),
                by(&|i| 0.5 * (right[i] + left[i] - 2.0 * centre[i]) * twice),
                by(&|i| 0.25 * (diagonal[0][i] - diagonal[1][i] - diagonal[2][i] + diagonal[3][i]) * twice),
                by(&|i| 0.5 * (above[i] + below[i] - 2.0 * centre[i]) * twice),
            ],
            stretch: [
                stretch(centre),
                (stretch(right) - stretch(left)) * once,
                (stretch(above) - stretch(below)) * once,
            ],
            metres: metres(0.0, 0.0)?,
            metres_by: [
                slope(metres(1.0, 0.0)?, metres(-1.0, 0.0)?),
                slope(metres(0.0, 1.0)?, metres(0.0, -1.0)?),
            ],
            curvature: curvature(projection, at)?,
        })
    }

    fn displaced(&self, from: NetPosition, arc: GroundArc) -> DisplacedPosition {
        let (x, y) = (from.x_m - self.at[0], from.y_m - self.at[1]);
        let (e, n) = (arc.east_deg, arc.north_deg);
        let [g, gx, gy, gxx, gxy, gyy] = &self.geodetic;
        let start = |i: usize| g[i] + x * (gx[i] + x * gxx[i] + y * gxy[i]) + y * (gy[i] + y * gyy[i]);
        let stretch = self.stretch[0] + x * self.stretch[1] + y * self.stretch[2];
        let metres = |column: usize, axis: usize| {
            self.metres[column][axis] + x * self.metres_by[0][column][axis] + y * self.metres_by[1][column][axis]
        };
        let [ee, en, nn] = &self.curvature;
        let net =
            |axis: usize| e * (metres(0, axis) + e * ee[axis] + n * en[axis]) + n * (metres(1, axis) + n * nn[axis]);
        DisplacedPosition {
            geodetic: Geodetic {
                latitude_deg: start(0) + n,
                longitude_deg: start(1) + e * stretch,
            },
            net: NetPosition {
                x_m: from.x_m + net(0),
                y_m: from.y_m + net(1),
            },
        }
    }
}

/// Displacement of a position by an arc, metres.
fn moved_m(projection: &Projection, at: Pair, east_deg: f64, north_deg: f64) -> Result<Pair, GeodesyError> {
    let from = NetPosition { x_m: at[0], y_m: at[1] };
    let to = displaced_exactly(projection, from, GroundArc { east_deg, north_deg })?.net;
    Ok([to.x_m - from.x_m, to.y_m - from.y_m])
}

fn metres_per_degree(projection: &Projection, at: Pair) -> Result<[Pair; 2], GeodesyError> {
    let slope = |plus: Pair, minus: Pair| [0, 1].map(|axis: usize| (plus[axis] - minus[axis]) / (2.0 * FIRST_DEG));
    let moved = |e: f64, n: f64| moved_m(projection, at, e * FIRST_DEG, n * FIRST_DEG);
    Ok([
        slope(moved(1.0, 0.0)?, moved(-1.0, 0.0)?),
        slope(moved(0.0, 1.0)?, moved(0.0, -1.0)?),
    ])
}

fn curvature(projection: &Projection, at: Pair) -> Result<[Pair; 3], GeodesyError> {
    let moved = |e: f64, n: f64| moved_m(projection, at, e * SECOND_DEG, n * SECOND_DEG);
    let [east, west, north, south] = [moved(1.0, 0.0)?, moved(-1.0, 0.0)?, moved(0.0, 1.0)?, moved(0.0, -1.0)?];
    let [ne, nw, se, sw] = [
        moved(1.0, 1.0)?,
        moved(-1.0, 1.0)?,
        moved(1.0, -1.0)?,
        moved(-1.0, -1.0)?,
    ];
    let square = SECOND_DEG * SECOND_DEG;
    Ok([
        [0, 1].map(|i: usize| 0.5 * (east[i] + west[i]) / square),
        [0, 1].map(|i: usize| 0.25 * (ne[i] - nw[i] - se[i] + sw[i]) / square),
        [0, 1].map(|i: usize| 0.5 * (north[i] + south[i]) / square),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_schema::run::MapInfo;
    use proptest::prelude::*;

    const UTM: &str = "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs";
    const ORIGIN: &str = "+proj=tmerc +lat_0=-52.3 +lon_0=10.5 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs";
    const MERCATOR: &str = "+proj=merc +lon_0=0 +datum=WGS84 +units=m +no_defs";

    fn maps() -> Vec<(Projection, DisplacementMap)> {
        let map = |definition: &str, net_offset_m: Pair| {
            let bounds_m = [-25_000.0, -25_000.0, 25_000.0, 25_000.0];
            let info = MapInfo {
                projection: definition.into(),
                net_offset_m,
                bounds_m,
                traffic_lights: 0,
                world_origin_m: [0.0; 2],
            };
            let projection = Projection::new(&info).unwrap();
            let series = DisplacementMap::new(&projection, bounds_m).unwrap();
            (projection, series)
        };
        vec![
            map(UTM, [-402_990.0, -5_794_389.0]),
            map(ORIGIN, [0.0; 2]),
            map(MERCATOR, [-1_000_000.0, -6_000_000.0]),
        ]
    }

    #[test]
    fn the_series_agrees_with_the_exact_way_to_a_tenth_of_a_millimetre() {
        let maps = maps();
        let arcs = [0.0, 5e-5, -3e-4, 3e-3];
        proptest!(|(x_m in -25_100.0_f64..25_100.0, y_m in -25_100.0_f64..25_100.0, e in 0..4_usize, n in 0..4_usize)| {
            let (from, arc) = (NetPosition { x_m, y_m }, GroundArc { east_deg: arcs[e], north_deg: arcs[n] });
            for (projection, series) in &maps {
                let (fast, exact) = (series.displaced(from, arc), displaced_exactly(projection, from, arc).unwrap());
                let off = (fast.net.x_m - exact.net.x_m).hypot(fast.net.y_m - exact.net.y_m);
                prop_assert!(off < 1e-4, "{off} m off at {from:?} by {arc:?}");
                prop_assert!((fast.geodetic.latitude_deg - exact.geodetic.latitude_deg).abs() < 1e-9);
                prop_assert!((fast.geodetic.longitude_deg - exact.geodetic.longitude_deg).abs() < 2e-9);
            }
        });
    }

    #[test]
    fn a_small_map_has_one_node_and_no_displacement_changes_nothing() {
        let info = MapInfo {
            projection: UTM.into(),
            net_offset_m: [-402_990.0, -5_794_389.0],
            bounds_m: [0.0; 4],
            traffic_lights: 0,
            world_origin_m: [0.0; 2],
        };
        let series = DisplacementMap::new(&Projection::new(&info).unwrap(), [0.0, 0.0, 220.0, 220.0]).unwrap();
        assert_eq!(series.nodes.len(), 1);
        let from = NetPosition { x_m: 12.5, y_m: -300.0 };
        assert_eq!(series.displaced(from, GroundArc::default()).net, from);
    }
}
