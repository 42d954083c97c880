//! Props: boxes from the catalogue, placed by the configuration or at random beside the road.

use ipc_schema::props::{PROPS, PropKind};
use rand_chacha::{
    ChaCha8Rng,
    rand_core::{RngCore, SeedableRng},
};

use super::{
    Scene, SurfaceKind,
    grid::Grid,
    road::{RoadPiece, left_of},
    shape::{Bounds, OrientedBox, Point, between, distance},
};

/// Random positions tried for one prop before it is left out.
const TRIES: u32 = 64;
/// Free ground between a random prop and everything else, metres.
const CLEARANCE_M: f64 = 0.3;
/// Most distance of a random prop from the edge of the lane it belongs to, beyond the clearance, metres.
const REACH_M: f64 = 6.0;

/// A prop and its position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prop {
    /// What it is.
    pub kind: &'static PropKind,
    /// Where it stands.
    pub body: OrientedBox,
}

impl Prop {
    /// A prop with its centre at `centre_m`, at height `ground_m`; `yaw_rad` is counter-clockwise from east.
    #[must_use]
    pub fn new(kind: &'static PropKind, centre_m: Point, yaw_rad: f64, ground_m: f64) -> Self {
        let (sin, cos) = libm::sincos(yaw_rad);
        Self {
            kind,
            body: OrientedBox {
                centre_m,
                along: [cos, sin],
                half_m: [0.5 * kind.length_m, 0.5 * kind.width_m],
                z_m: [ground_m, ground_m + kind.height_m],
            },
        }
    }

    /// Radius of the circle about its footprint, metres.
    fn reach_m(kind: &PropKind) -> f64 {
        0.5 * libm::hypot(kind.length_m, kind.width_m)
    }
}

/// `count` props beside the road: off every surface, clear of buildings and of each other. Prop *i* draws from stream *i* of the
/// seed, so the first props are the same whatever the number. Where there is no room a prop is left out.
pub(super) fn beside_the_road(scene: &Scene, count: u32, seed: u64) -> Vec<Prop> {
    let lanes = OuterLanes::new(scene);
    let mut placed: Vec<Prop> = Vec::new();
    if lanes.is_empty() {
        return placed;
    }
    let mut neighbours = PropNeighbours::new(scene);
    for number in 0..u64::from(count) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(number);
        let prop = (0..TRIES).find_map(|_| {
            let (kind, centre_m, yaw_rad) = lanes.draw(&mut random);
            let prop = scene.prop_at(kind, centre_m, yaw_rad);
            let reach_m = Prop::reach_m(prop.kind) + CLEARANCE_M;
            let off_road = scene.road().nearest(prop.body.centre_m, reach_m, |_| true).is_none();
            (off_road && neighbours.are_clear(scene, &placed, &prop)).then_some(prop)
        });
        if let Some(prop) = prop {
            neighbours.add(&prop, placed.len());
            placed.push(prop);
        }
    }
    placed
}

/// Uniform in 0 … 1.
fn share(random: &mut ChaCha8Rng) -> f64 {
    (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}

/// Outer lanes to draw places from, in proportion to their length.
struct OuterLanes<'a> {
    /// Segment of a lane, and the length of all segments up to its end.
    segments: Vec<(&'a RoadPiece, usize, f64)>,
}

impl<'a> OuterLanes<'a> {
    fn new(scene: &'a Scene) -> Self {
        let mut total_m = 0.0;
        let mut segments = Vec::new();
        // Lanes within junctions have ids that begin with a colon: no prop stands there.
        let lanes = scene.road().pieces().iter();
        for piece in lanes.filter(|piece| piece.surface == SurfaceKind::Lane && !piece.id.starts_with(':')) {
            for place in 0..piece.shape_m.len() - 1 {
                let [a, b] = ends(piece, place);
                total_m += distance(a, b);
                segments.push((piece, place, total_m));
            }
        }
        Self { segments }
    }

    fn is_empty(&self) -> bool {
        self.segments.is_empty()
    }

    /// A random prop with its centre and heading in radians, beside a random place of a random lane.
    fn draw(&self, random: &mut ChaCha8Rng) -> (&'static PropKind, Point, f64) {
        let kind = &PROPS[(random.next_u64() % PROPS.len() as u64) as usize];
        let total_m = self.segments.last().map_or(0.0, |segment| segment.2);
        let wanted_m = share(random) * total_m;
        let place = self.segments.partition_point(|segment| segment.2 <= wanted_m);
        let (piece, place, end_m) = self.segments[place.min(self.segments.len() - 1)];
        let [a, b] = ends(piece, place);
        let length_m = distance(a, b).max(f64::MIN_POSITIVE);
        let at = between(a, b, 1.0 - ((end_m - wanted_m) / length_m).clamp(0.0, 1.0));
        let side = if random.next_u32() & 1 == 0 { 1.0 } else { -1.0 };
        let off_m = piece.half_width_m.unwrap_or(0.0) + Prop::reach_m(kind) + CLEARANCE_M + REACH_M * share(random);
        let left = left_of(a, b);
        let yaw_rad = libm::atan2(b[1] - a[1], b[0] - a[0]);
        let centre_m = [0, 1].map(|axis: usize| at[axis] + side * off_m * left[axis]);
        (kind, centre_m, yaw_rad)
    }
}

fn ends(piece: &RoadPiece, place: usize) -> [Point; 2] {
    [piece.shape_m[place], piece.shape_m[place + 1]].map(|[x, y, _]| [x, y])
}

/// Random props by cell, and the props of the configuration.
struct PropNeighbours {
    cells: std::collections::BTreeMap<[i64; 2], Vec<usize>>,
    found: Vec<u32>,
    obstacles: Grid,
}

impl PropNeighbours {
    /// No prop is longer than this, metres.
    const CELL_M: f64 = 8.0;

    fn new(scene: &Scene) -> Self {
        let bounds: Vec<Bounds> = scene.props().iter().map(|prop| prop.body.bounds()).collect();
        Self {
            cells: std::collections::BTreeMap::new(),
            found: Vec::new(),
            obstacles: Grid::new(&bounds, Self::CELL_M),
        }
    }

    fn cell(point: Point) -> [i64; 2] {
        point.map(|value| libm::floor(value / Self::CELL_M) as i64)
    }

    fn add(&mut self, prop: &Prop, number: usize) {
        self.cells
            .entry(Self::cell(prop.body.centre_m))
            .or_default()
            .push(number);
    }

    /// True if the circle about `prop` is clear of buildings, obstacles and the props placed so far.
    fn are_clear(&mut self, scene: &Scene, placed: &[Prop], prop: &Prop) -> bool {
        let centre = prop.body.centre_m;
        let reach_m = Prop::reach_m(prop.kind) + CLEARANCE_M;
        let bounds = Bounds::about(centre, reach_m);
        scene.solids_near(&bounds, &mut self.found);
        let near_building = self.found.iter().any(|&number| match scene.solid(number) {
            super::Solid::Building(building) => {
                building.contains(centre)
                    || super::shape::edges(&building.outline_m)
                        .any(|(a, b)| distance(super::shape::nearest_on_segment(a, b, centre), centre) < reach_m)
            }
            super::Solid::Prop(_) => false,
        });
        let apart = |other: &Prop| distance(other.body.centre_m, centre) > reach_m + Prop::reach_m(other.kind);
        self.obstacles.near(&bounds.grown(Self::CELL_M), &mut self.found);
        let clear_of_obstacles = self.found.iter().all(|&number| apart(&scene.props()[number as usize]));
        let [column, row] = Self::cell(centre);
        let clear_of_placed = (-1..=1).all(|right| {
            (-1..=1).all(|up| {
                let cell = self.cells.get(&[column + right, row + up]);
                cell.is_none_or(|numbers| numbers.iter().all(|&number| apart(&placed[number])))
            })
        });
        !near_building && clear_of_obstacles && clear_of_placed
    }
}
