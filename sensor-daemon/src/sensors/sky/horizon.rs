//! The part of the sky that buildings hide at a place, and the walls that mirror satellites to it.
//!
//! Only prisms count: trees, lamp posts, vehicles and bridges are transparent. A prism hides the sky below its roof, down to the ground.

use std::f64::consts::TAU;

use sim_core::scene::{
    Grid, Prism, Scene,
    shape::{Bounds, Point, cross, dot, edges, from_to},
};

use super::constellation::{MASK_DEG, Satellite};

/// Sectors of the horizon, 5.6° each.
pub const SECTORS: usize = 64;
/// Most walls remembered for reflections: those that fill most sectors.
const WALLS: usize = 8;
/// A wall that fills fewer sectors is too small to reflect a signal of 0.19 m wave length from afar (Fresnel zone).
const LEAST_SECTORS: usize = 2;
/// Largest distance at which walls are considered, metres.
const FARTHEST_M: f64 = 1_000.0;
/// Size of a cell of the index over buildings, metres.
const INDEX_CELL_M: f64 = 50.0;

/// A wall as seen from the place: everything relative to it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct HorizonWall {
    /// Ends, metres; seen from the place, the left one comes first.
    left_m: [f32; 2],
    right_m: [f32; 2],
    /// Unit vector out of the wall, towards the place.
    outward: [f32; 2],
    /// Of the roof above the antenna, metres.
    top_m: f32,
}

/// The wall behind which the sky begins in a sector, in whole parts of a metre: all sectors fit four cache lines.
#[derive(Debug, Clone, Copy, PartialEq)]
struct HorizonEdge {
    /// Its roof above the antenna, 1/64 m; 0 if there is none.
    top: u16,
    /// Its distance, 1/32 m.
    distance: u16,
}

impl HorizonEdge {
    const TOP: f64 = 64.0;
    const DISTANCE: f64 = 32.0;

    fn new(top_m: f64, distance_m: f64) -> Self {
        Self {
            top: (top_m * Self::TOP).round() as u16,
            distance: ((distance_m * Self::DISTANCE).round() as u16).max(1),
        }
    }

    fn top_m(self) -> f64 {
        f64::from(self.top) * (1.0 / Self::TOP)
    }

    fn distance_m(self) -> f64 {
        f64::from(self.distance) * (1.0 / Self::DISTANCE)
    }
}

/// The sky of a place.
#[derive(Debug, Clone, PartialEq)]
pub struct Horizon {
    /// The place: antenna, world, metres.
    pub place_m: [f64; 3],
    /// Along the middle of each sector.
    edges: [HorizonEdge; SECTORS],
    /// The rest is empty.
    walls: [HorizonWall; WALLS],
}

/// A place with a free sky above the mask, a place under some walls, or one inside a building.
#[derive(Debug, Clone, PartialEq)]
pub enum CellSky {
    /// Nothing is higher than the mask.
    Open,
    /// Walls are.
    Walled(Box<Horizon>),
    /// No satellite reaches it.
    Inside,
}

/// Sector of a heading (east, north).
#[must_use]
fn sector([east, north]: Point) -> usize {
    let turns = libm::atan2(north, east) / TAU;
    ((turns.rem_euclid(1.0) * SECTORS as f64) as usize).min(SECTORS - 1)
}

/// A satellite with its sector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacedSatellite {
    /// Where it is.
    pub satellite: Satellite,
    sector: usize,
}

impl From<Satellite> for PlacedSatellite {
    fn from(satellite: Satellite) -> Self {
        Self {
            satellite,
            sector: sector(satellite.heading),
        }
    }
}

impl Horizon {
    /// Tangent of the elevation below which the sky is hidden, along the middle of each sector; sector 0 begins in the east, the next
    /// are counter-clockwise from it.
    pub fn tangents(&self) -> impl Iterator<Item = f64> + '_ {
        self.edges.iter().map(|edge| edge.top_m() / edge.distance_m())
    }

    /// True if the satellite is in sight of an antenna at `antenna_m`, near the place.
    #[must_use]
    pub fn is_in_sight(&self, placed: &PlacedSatellite, antenna_m: [f64; 3]) -> bool {
        let edge = self.edges[placed.sector];
        let higher_m = antenna_m[2] - self.place_m[2];
        edge.top == 0 || edge.top_m() - higher_m < placed.satellite.tan_elevation * edge.distance_m()
    }

    /// Walls as they stand about an antenna at `antenna_m`, near the place.
    #[must_use]
    pub fn mirrors(&self, antenna_m: [f64; 3]) -> Mirrors<'_> {
        let moved = [antenna_m[0] - self.place_m[0], antenna_m[1] - self.place_m[1]];
        let higher_m = antenna_m[2] - self.place_m[2];
        let mut mirrors = Mirrors {
            edges: &self.edges,
            higher_m,
            walls: [MirrorWall::default(); WALLS],
        };
        for (mirror, wall) in mirrors.walls.iter_mut().zip(&self.walls) {
            *mirror = MirrorWall {
                left: from_to(moved, wall.left_m.map(f64::from)),
                right: from_to(moved, wall.right_m.map(f64::from)),
                outward: wall.outward.map(f64::from),
                distance_m: 0.0,
                top_m: f64::from(wall.top_m) - higher_m,
            };
            mirror.distance_m = -dot(mirror.outward, mirror.left);
        }
        mirrors
    }
}

/// A wall relative to an antenna; a wall with distance 0 mirrors nothing.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct MirrorWall {
    left: Point,
    right: Point,
    outward: Point,
    distance_m: f64,
    top_m: f64,
}

/// Walls about an antenna.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mirrors<'a> {
    edges: &'a [HorizonEdge; SECTORS],
    higher_m: f64,
    walls: [MirrorWall; WALLS],
}

impl Mirrors<'_> {
    /// Extra path of a hidden satellite's signal by the nearest wall that mirrors it to the antenna, metres.
    ///
    /// A vertical wall at distance `d` with the outward normal `n` makes the path longer by `2 d n·s = 2 d cos e cos Δ`, `e` being
    /// the elevation and Δ the azimuth of the satellite against the normal (image of the antenna behind the wall; Groves, section
    /// 9.3.4). It does if the mirrored ray meets the wall between its ends and below its roof, and if the wall is lit there: it
    /// is higher up and farther away from what hides the satellite than the antenna is.
    #[must_use]
    pub fn extra_path_m(&self, placed: &PlacedSatellite) -> Option<f64> {
        let satellite = &placed.satellite;
        let (s, tan_e) = (satellite.heading, satellite.tan_elevation);
        let edge = self.edges[placed.sector];
        let (hider_m, hider_top_m) = (edge.distance_m(), edge.top_m() - self.higher_m);
        let nearest_m = self
            .walls
            .iter()
            .filter_map(|wall| {
                let facing = dot(wall.outward, s);
                // The ray meets the wall at distance `d / facing`; everything below is multiplied by `facing`.
                let rises_m = wall.distance_m * tan_e;
                let is_reached = facing > 0.0 && wall.distance_m > 0.0 && rises_m <= wall.top_m * facing;
                let is_lit = hider_m * facing * tan_e + 2.0 * rises_m >= hider_top_m * facing;
                (is_reached && is_lit && wall.is_met(s, facing)).then_some(wall.distance_m * facing)
            })
            .min_by(f64::total_cmp)?;
        let cos_e = dot(s, [satellite.line_of_sight[0], satellite.line_of_sight[1]]);
        Some(2.0 * nearest_m * cos_e)
    }
}

impl MirrorWall {
    /// True if the ray towards `s`, mirrored, meets the wall between its ends.
    fn is_met(&self, s: Point, facing: f64) -> bool {
        let mirrored = [
            s[0] - 2.0 * facing * self.outward[0],
            s[1] - 2.0 * facing * self.outward[1],
        ];
        cross(mirrored, self.left) >= 0.0 && cross(self.right, mirrored) >= 0.0
    }
}

/// Buildings by the ground that they hide sky from.
#[derive(Debug, Clone, Default)]
pub struct Skyline {
    index: Grid,
    /// Unit vectors along the middles of the sectors.
    middles: Vec<Point>,
}

/// State of the search for the highest wall in each sector.
struct HorizonSearch {
    tangent: [f64; SECTORS],
    distance_m: [f64; SECTORS],
    /// Number of the wall in `seen`.
    wall: [usize; SECTORS],
    seen: Vec<(Point, Point, f64)>,
}

impl Skyline {
    /// The skyline of a scene's buildings.
    #[must_use]
    pub fn new(buildings: &[Prism]) -> Self {
        let lowest_m = buildings
            .iter()
            .map(|building| building.base_z_m)
            .fold(f64::INFINITY, f64::min);
        let tan_mask = libm::tan(MASK_DEG.to_radians());
        let hidden: Vec<Bounds> = buildings
            .iter()
            .map(|building| {
                building
                    .bounds
                    .grown(((building.z_m()[1] - lowest_m) / tan_mask).min(FARTHEST_M))
            })
            .collect();
        let middle = |sector: usize| {
            let (sin, cos) = libm::sincos(TAU * (sector as f64 + 0.5) / SECTORS as f64);
            [cos, sin]
        };
        Self {
            index: Grid::new(&hidden, INDEX_CELL_M),
            middles: (0..SECTORS).map(middle).collect(),
        }
    }

    /// The sky of an antenna at `place_m` (world, metres).
    #[must_use]
    pub fn sky(&self, scene: &Scene, place_m: [f64; 3]) -> CellSky {
        let place = [place_m[0], place_m[1]];
        let mut search = HorizonSearch {
            tangent: [0.0; SECTORS],
            distance_m: [1.0; SECTORS],
            wall: [usize::MAX; SECTORS],
            seen: Vec::new(),
        };
        for &number in self.index.at(place) {
            let building = &scene.buildings()[number as usize];
            let above_m = building.z_m()[1] - place_m[2];
            if above_m <= 0.0 {
                continue;
            }
            if building.contains(place) {
                return CellSky::Inside;
            }
            for (a, b) in edges(&building.outline_m) {
                search.add_wall(&self.middles, from_to(place, a), from_to(place, b), above_m);
            }
        }
        search.sky(place_m)
    }
}

impl HorizonSearch {
    /// Records a wall from `a` to `b` (relative to the place), the building on its left, in the sectors where it is the highest so far.
    fn add_wall(&mut self, middles: &[Point], a: Point, b: Point, above_m: f64) {
        // Outlines are counter-clockwise: the place sees the walls that have it on their right, and they run clockwise around it.
        let along = from_to(a, b);
        let doubled_area = cross(a, along);
        if doubled_area >= 0.0 {
            return;
        }
        let number = self.seen.len();
        let mut is_seen = false;
        let first = libm::atan2(b[1], b[0]) / TAU * SECTORS as f64 - 0.5;
        let span = libm::atan2(-cross(a, b), dot(a, b)) / TAU * SECTORS as f64;
        // One sector more on either side: the test below is exact.
        let (from, to) = (first.floor() as i64, (first + span).ceil() as i64);
        for place in from..=to {
            let sector = place.rem_euclid(SECTORS as i64) as usize;
            let middle = middles[sector];
            if cross(middle, a) < 0.0 || cross(b, middle) < 0.0 {
                continue;
            }
            let distance_m = doubled_area / cross(middle, along);
            let tangent = above_m / distance_m;
            if distance_m > 0.0 && tangent > self.tangent[sector] {
                (self.tangent[sector], self.distance_m[sector], self.wall[sector]) = (tangent, distance_m, number);
                is_seen = true;
            }
        }
        if is_seen {
            self.seen.push((a, b, above_m));
        }
    }

    fn sky(self, place_m: [f64; 3]) -> CellSky {
        let tan_mask = libm::tan(MASK_DEG.to_radians());
        if self.tangent.iter().all(|tangent| *tangent <= tan_mask) {
            return CellSky::Open;
        }
        CellSky::Walled(Box::new(Horizon {
            place_m,
            edges: std::array::from_fn(|sector| {
                let distance_m = self.distance_m[sector];
                HorizonEdge::new(self.tangent[sector] * distance_m, distance_m)
            }),
            walls: self.largest_walls(),
        }))
    }

    /// Walls that fill most sectors; of equals those that were found first.
    fn largest_walls(&self) -> [HorizonWall; WALLS] {
        let fills = |number: usize| self.wall.iter().filter(|wall| **wall == number).count();
        let mut large: Vec<(usize, usize)> = (0..self.seen.len())
            .map(|number| (fills(number), number))
            .filter(|(sectors, _)| *sectors >= LEAST_SECTORS)
            .collect();
        large.sort_by_key(|(sectors, number)| (std::cmp::Reverse(*sectors), *number));
        let mut walls = [HorizonWall::default(); WALLS];
        for (wall, (_, number)) in walls.iter_mut().zip(large) {
            *wall = self.wall(number);
        }
        walls
    }

    fn wall(&self, number: usize) -> HorizonWall {
        let (a, b, above_m) = self.seen[number];
        let along = from_to(a, b);
        let length_m = libm::hypot(along[0], along[1]);
        HorizonWall {
            left_m: a.map(|value| value as f32),
            right_m: b.map(|value| value as f32),
            outward: [(along[1] / length_m) as f32, (-along[0] / length_m) as f32],
            top_m: above_m as f32,
        }
    }
}
