//! Rectangles on the ground that no wall reaches into, mostly streets. The line between two antennas in one of them meets no building, and
//! only the road users between them can be in its way: both are found without a walk over the map.
//!
//! A strip is grown about a pair of radios that turned out to see each other, so strips are where traffic is. They change no result.

use std::{cmp::Ordering, collections::BTreeMap};

use sim_core::scene::shape::{Bounds, Point, cross, distance, dot, from_to};

use super::{
    links::Radio,
    obstruction::{Antenna, Obstacles},
};

/// Farthest that a strip reaches beyond the pair that it is grown about, along and across, metres.
const REACH_M: [f64; 2] = [500.0, 8.0];
/// Distance of a strip from walls, metres. It is far more than what rounding moves.
const CLEARANCE_M: f64 = 0.3;
/// A shorter or narrower strip is not worth its place, metres.
const LEAST_M: [f64; 2] = [60.0, 6.0];
/// A wall within this angle of the line between two radios gives the strip about them its direction, as a sine.
const SAME_DIRECTION: f64 = 0.25;
/// How far from the middle of a pair such a wall may be, metres.
const WALL_AWAY_M: f64 = 30.0;
/// Most strips that a radio counts as in. Where there are so many, no more are grown.
const STRIPS_OF_RADIO: usize = 4;
/// Size of the cells of the index over strips, metres.
const CELL_M: f64 = 25.0;
/// Attempts to grow a strip that may fail before the first one succeeds, and those that each tick adds.
const FIRST_ATTEMPTS: u32 = 50;
const ATTEMPTS_OF_TICK: u32 = 2;
/// Most strips that a tick adds: their search takes some 30 µs each.
const STRIPS_OF_TICK: u32 = 64;
/// More than what a distance in f32 may be wrong by, metres.
const ROUNDING_M: f32 = 0.02;

/// A rectangle without a wall in it, by its own axes: along, and to the left.
#[derive(Debug, Clone, Copy)]
struct OpenStrip {
    origin_m: Point,
    along: Point,
    /// From and to, along and across, metres.
    from_m: [f64; 2],
    to_m: [f64; 2],
}

impl OpenStrip {
    /// Coordinates of a point along and across, metres.
    fn coordinates(&self, point: Point) -> [f64; 2] {
        let offset = from_to(self.origin_m, point);
        [dot(self.along, offset), cross(self.along, offset)]
    }

    fn holds(&self, at: [f64; 2]) -> bool {
        (0..2).all(|axis| (self.from_m[axis]..=self.to_m[axis]).contains(&at[axis]))
    }

    fn point(&self, [along, across]: [f64; 2]) -> Point {
        [
            self.origin_m[0] + along * self.along[0] - across * self.along[1],
            self.origin_m[1] + along * self.along[1] + across * self.along[0],
        ]
    }

    fn bounds(&self) -> Bounds {
        let ([along, across], [far, left]) = (self.from_m, self.to_m);
        Bounds::of([[along, across], [along, left], [far, across], [far, left]].map(|corner| self.point(corner)))
    }

    /// The strip about two points that no wall is between, if there is one worth its place.
    fn about(obstacles: &Obstacles, a: Point, b: Point) -> Option<Self> {
        let middle_m = [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])];
        let length_m = distance(a, b);
        if length_m < 1.0 {
            return None;
        }
        let way = from_to(a, b).map(|value| value / length_m);
        let mut walls = Vec::new();
        obstacles.walls_near(&Bounds::about(middle_m, WALL_AWAY_M), &mut walls);
        let direction = |&[from, to]: &[Point; 2]| {
            let length_m = distance(from, to).max(1e-3);
            let along = from_to(from, to).map(|value| value / length_m);
            let away_m = cross(along, from_to(from, middle_m)).abs();
            (length_m > 5.0 && cross(along, way).abs() < SAME_DIRECTION).then_some((away_m, along))
        };
        let nearest = walls.iter().filter_map(direction).min_by(|a, b| a.0.total_cmp(&b.0));
        let mut strip = Self {
            origin_m: middle_m,
            along: nearest.map_or(way, |(_, along)| along),
            from_m: [0.0; 2],
            to_m: [0.0; 2],
        };
        let (a, b) = (strip.coordinates(a), strip.coordinates(b));
        let (least, most) = (
            [0, 1].map(|axis: usize| a[axis].min(b[axis])),
            [0, 1].map(|axis: usize| a[axis].max(b[axis])),
        );
        strip.from_m = [0, 1].map(|axis: usize| least[axis] - REACH_M[axis]);
        strip.to_m = [0, 1].map(|axis: usize| most[axis] + REACH_M[axis]);
        obstacles.walls_near(&strip.bounds(), &mut walls);
        let walls: Vec<[[f64; 2]; 2]> = walls
            .iter()
            .map(|wall| wall.map(|point| strip.coordinates(point)))
            .collect();
        // First as wide as the walls beside the pair leave it, then as long as those before and behind it do.
        for axis in [1, 0] {
            let beside = match axis {
                1 => [least[0] - CLEARANCE_M, most[0] + CLEARANCE_M],
                // Nearer than the walls beside the pair.
                _ => [strip.from_m[1] - 0.5 * CLEARANCE_M, strip.to_m[1] + 0.5 * CLEARANCE_M],
            };
            for [low, high] in walls.iter().filter_map(|wall| extent_beside(wall, axis, beside)) {
                if high + CLEARANCE_M < least[axis] {
                    strip.from_m[axis] = strip.from_m[axis].max(high + CLEARANCE_M);
                } else if low - CLEARANCE_M > most[axis] {
                    strip.to_m[axis] = strip.to_m[axis].min(low - CLEARANCE_M);
                } else {
                    return None;
                }
            }
        }
        (0..2)
            .all(|axis| strip.to_m[axis] - strip.from_m[axis] >= LEAST_M[axis])
            .then_some(strip)
    }
}

/// Least and greatest coordinate on an axis of the part of a wall whose other coordinate is within `beside`.
fn extent_beside(wall: &[[f64; 2]; 2], axis: usize, beside: [f64; 2]) -> Option<[f64; 2]> {
    let [from, to] = wall.map(|point| [point[axis], point[1 - axis]]);
    let way = [to[0] - from[0], to[1] - from[1]];
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    if way[1] == 0.0 {
        if !(beside[0]..=beside[1]).contains(&from[1]) {
            return None;
        }
    } else {
        let (near, far) = ((beside[0] - from[1]) / way[1], (beside[1] - from[1]) / way[1]);
        enter = enter.max(near.min(far));
        leave = leave.min(near.max(far));
    }
    if enter > leave {
        return None;
    }
    let ends = [enter, leave].map(|share| from[0] + share * way[0]);
    Some([ends[0].min(ends[1]), ends[0].max(ends[1])])
}

/// A strip that a radio is in, and where: along and across, metres.
#[derive(Debug, Clone, Copy, Default)]
struct RadioInStrip {
    strip: u32,
    at_m: [f32; 2],
}

/// The strips that a radio is in.
#[derive(Debug, Clone, Copy, Default)]
struct RadioStrips {
    /// A bit for each, by its number: radios that share none share no strip.
    bits: u64,
    strips: [RadioInStrip; STRIPS_OF_RADIO],
    count: usize,
}

/// A road user in a strip, by a circle that is a little too large.
#[derive(Debug, Clone, Copy)]
struct StripBody {
    /// Along and across, metres.
    at_m: [f32; 2],
    radius_m: f32,
    row: u32,
}

/// Road users of a tick in a strip, ascending along it.
#[derive(Debug, Clone, Default)]
struct StripBodies {
    bodies: Vec<StripBody>,
    largest_m: f32,
}

/// The strips of an episode, and what is in them at a tick.
#[derive(Debug)]
pub struct OpenStrips {
    strips: Vec<OpenStrip>,
    /// Numbers of the strips that are near a cell.
    cells: BTreeMap<[i32; 2], Vec<u32>>,
    /// Attempts to grow a strip that may yet fail.
    attempts: u32,
    radios: Vec<RadioStrips>,
    /// By strip.
    bodies: Vec<StripBodies>,
}

/// Two radios in one strip: its number, and where they are.
#[derive(Debug, Clone, Copy)]
pub struct SharedStrip {
    strip: u32,
    a_m: [f32; 2],
    b_m: [f32; 2],
}

fn cell_of(point: Point) -> [i32; 2] {
    point.map(|value| (value / CELL_M).floor() as i32)
}

impl Default for OpenStrips {
    fn default() -> Self {
        Self {
            strips: Vec::new(),
            cells: BTreeMap::new(),
            attempts: FIRST_ATTEMPTS,
            radios: Vec::new(),
            bodies: Vec::new(),
        }
    }
}

impl OpenStrips {
    /// Grows strips about pairs of points between which no building is, and that no strip holds yet.
    pub fn grow(&mut self, obstacles: &Obstacles, pairs: impl Iterator<Item = [Point; 2]>) {
        self.attempts = FIRST_ATTEMPTS.min(self.attempts + ATTEMPTS_OF_TICK);
        let mut strips_of_tick = 0;
        for pair in pairs {
            if self.attempts == 0 || strips_of_tick == STRIPS_OF_TICK {
                return;
            }
            let [of_a, of_b] = pair.map(|point| self.holding(point));
            let is_full = of_a.len() >= STRIPS_OF_RADIO || of_b.len() >= STRIPS_OF_RADIO;
            if is_full || of_a.iter().any(|strip| of_b.contains(strip)) {
                continue;
            }
            match OpenStrip::about(obstacles, pair[0], pair[1]) {
                Some(strip) => {
                    self.add(strip);
                    strips_of_tick += 1;
                }
                None => self.attempts -= 1,
            }
        }
    }

    /// Numbers of the strips that hold a point.
    fn holding(&self, point: Point) -> Vec<u32> {
        let near = self.cells.get(&cell_of(point)).into_iter().flatten();
        let holds = |number: &&u32| {
            let strip = &self.strips[**number as usize];
            strip.holds(strip.coordinates(point))
        };
        near.filter(holds).copied().collect()
    }

    /// A cell that is missing in the index only makes links in it slower, so cells are found by points half a cell apart.
    fn add(&mut self, strip: OpenStrip) {
        let number = self.strips.len() as u32;
        let steps =
            [0, 1].map(|axis: usize| ((strip.to_m[axis] - strip.from_m[axis]) / (0.5 * CELL_M)).ceil() as usize);
        let at = |axis: usize, step: usize| {
            let share = step as f64 / steps[axis].max(1) as f64;
            strip.from_m[axis] + share * (strip.to_m[axis] - strip.from_m[axis])
        };
        for along in 0..=steps[0] {
            for across in 0..=steps[1] {
                let near = self
                    .cells
                    .entry(cell_of(strip.point([at(0, along), at(1, across)])))
                    .or_default();
                if near.last() != Some(&number) {
                    near.push(number);
                }
            }
        }
        self.strips.push(strip);
    }

    /// Finds the strips of the radios of a tick, and the road users in each strip that has several of them.
    pub fn enter(&mut self, obstacles: &Obstacles, radios: &[Radio]) {
        let Self {
            strips,
            cells,
            radios: of_radio,
            bodies,
            ..
        } = self;
        let mut inside = vec![0_u32; strips.len()];
        of_radio.clear();
        of_radio.extend(radios.iter().map(|radio| {
            let mut found = RadioStrips::default();
            for number in cells.get(&cell_of(radio.antenna.position_m)).into_iter().flatten() {
                let strip = &strips[*number as usize];
                let at = strip.coordinates(radio.antenna.position_m);
                if found.count < STRIPS_OF_RADIO && strip.holds(at) {
                    found.bits |= 1 << (number % 64);
                    found.strips[found.count] = RadioInStrip {
                        strip: *number,
                        at_m: at.map(|value| value as f32),
                    };
                    found.count += 1;
                    inside[*number as usize] += 1;
                }
            }
            found
        }));
        bodies.resize_with(strips.len(), StripBodies::default);
        for ((strip, bodies), inside) in strips.iter().zip(bodies).zip(inside) {
            bodies.bodies.clear();
            if inside > 1 {
                bodies.fill(obstacles, strip);
            }
        }
    }

    /// A strip that two radios of the tick share.
    #[inline]
    pub fn shared(&self, a: usize, b: usize) -> Option<SharedStrip> {
        let (a, b) = (&self.radios[a], &self.radios[b]);
        if a.bits & b.bits == 0 {
            return None;
        }
        let of_b = &b.strips[..b.count];
        a.strips[..a.count].iter().find_map(|in_a| {
            let in_b = of_b.iter().find(|in_b| in_b.strip == in_a.strip)?;
            Some(SharedStrip {
                strip: in_a.strip,
                a_m: in_a.at_m,
                b_m: in_b.at_m,
            })
        })
    }

    /// Top of the highest road user that meets the line between two antennas in a strip, metres: [`Obstacles::highest_vehicle_m`].
    #[must_use]
    pub fn highest_vehicle_m(
        &self,
        shared: &SharedStrip,
        obstacles: &Obstacles,
        a: &Antenna,
        b: &Antenna,
    ) -> Option<f64> {
        let StripBodies { bodies, largest_m } = &self.bodies[shared.strip as usize];
        let (from, to) = (shared.a_m, shared.b_m);
        let way = [to[0] - from[0], to[1] - from[1]];
        let length_m = (way[0] * way[0] + way[1] * way[1]).sqrt();
        let reach_m = largest_m + ROUNDING_M;
        let (least, most) = (from[0].min(to[0]) - reach_m, from[0].max(to[0]) + reach_m);
        let mut top_m = None;
        for body in &bodies[bodies.partition_point(|body| body.at_m[0] < least)..] {
            if body.at_m[0] > most {
                break;
            }
            let area = way[0] * (body.at_m[1] - from[1]) - way[1] * (body.at_m[0] - from[0]);
            if area.abs() > (body.radius_m + ROUNDING_M) * length_m + ROUNDING_M {
                continue;
            }
            top_m = obstacles.higher_of(top_m, body.row, a, b);
        }
        top_m
    }
}

impl StripBodies {
    fn fill(&mut self, obstacles: &Obstacles, strip: &OpenStrip) {
        self.largest_m = 0.0;
        obstacles.visit_circles(&strip.bounds(), |row, centre_m, radius_m| {
            let at = strip.coordinates(centre_m);
            let reaches =
                |axis: usize| strip.from_m[axis] - radius_m <= at[axis] && at[axis] <= strip.to_m[axis] + radius_m;
            if reaches(0) && reaches(1) {
                self.largest_m = self.largest_m.max(radius_m as f32);
                self.bodies.push(StripBody {
                    at_m: at.map(|value| value as f32),
                    radius_m: radius_m as f32,
                    row,
                });
            }
        });
        let along = |a: &StripBody, b: &StripBody| a.at_m[0].total_cmp(&b.at_m[0]).then(a.row.cmp(&b.row));
        self.bodies.sort_unstable_by(along);
        self.bodies.dedup_by(|a, b| along(a, b) == Ordering::Equal);
    }
}

#[cfg(test)]
mod tests {
    use ipc_schema::world::VehicleState;
    use proptest::prelude::*;
    use sim_core::scene::{Prism, Road, Scene, SolidClass};

    use super::*;

    fn house([x_m, y_m]: Point, side_m: f64, turn_rad: f64) -> Prism {
        let (sin, cos) = turn_rad.sin_cos();
        let corner = |[x, y]: Point| [x_m + x * cos - y * sin, y_m + x * sin + y * cos];
        let outline = [[0.0, 0.0], [side_m, 0.0], [side_m, side_m], [0.0, side_m]].map(corner);
        Prism::new("house".into(), SolidClass::Building, outline.to_vec(), 0.0, 9.0).unwrap()
    }

    proptest! {
        /// Beside the walk over the map.
        #[test]
        fn a_strip_finds_what_the_map_has_between_two_radios(
            houses in prop::collection::vec((prop::array::uniform2(-200.0_f64..200.0), 4.0_f64..30.0, -0.3_f64..0.3), 0..12),
            cars in prop::collection::vec((prop::array::uniform2(-200.0_f64..200.0), -3.1_f64..3.1, 1.0_f32..4.0), 2..40),
        ) {
            let houses = houses.into_iter().map(|(corner, side_m, turn_rad)| house(corner, side_m, turn_rad)).collect();
            let mut obstacles = Obstacles::new(&Scene::new(Road::default(), houses, Vec::new()));
            let states: Vec<VehicleState> = cars
                .into_iter()
                .map(|([x_m, y_m], yaw_rad, height_m)| VehicleState {
                    x_m, y_m, yaw_rad, height_m, length_m: 9.0, width_m: 2.5, rear_overhang_m: 1.0, ..VehicleState::default()
                })
                .collect();
            obstacles.update(&states);
            let radios: Vec<Radio> = (0..states.len())
                .map(|slot| Radio {
                    slot,
                    station: slot as u32 + 1,
                    antenna: Antenna { position_m: obstacles.bodies()[slot].centre_m, z_m: 1.6, row: slot as u32 },
                })
                .collect();
            let pairs: Vec<[usize; 2]> = (0..radios.len()).flat_map(|a| (0..a).map(move |b| [a, b])).collect();
            let mut strips = OpenStrips::default();
            for _ in 0..2 {
                strips.enter(&obstacles, &radios);
                let mut apart = Vec::new();
                for pair in &pairs {
                    let [a, b] = pair.map(|radio| &radios[radio].antenna);
                    if let Some(shared) = strips.shared(pair[0], pair[1]) {
                        prop_assert!(!obstacles.meets_building(a, b));
                        prop_assert_eq!(strips.highest_vehicle_m(&shared, &obstacles, a, b), obstacles.highest_vehicle_m(a, b));
                    } else if !obstacles.meets_building(a, b) {
                        apart.push([a.position_m, b.position_m]);
                    }
                }
                strips.grow(&obstacles, apart.into_iter());
            }
        }
    }

    #[test]
    fn a_street_is_one_strip() {
        let houses = (0..10)
            .flat_map(|place| [-40.0, 10.0].map(|y_m| house([40.0 * f64::from(place), y_m], 30.0, 0.0)))
            .collect();
        let obstacles = Obstacles::new(&Scene::new(Road::default(), houses, Vec::new()));
        let mut strips = OpenStrips::default();
        let pairs = (0..20).map(|place| [[20.0 * f64::from(place), 2.0], [380.0, -2.0]]);
        strips.grow(&obstacles, pairs);
        let [strip] = strips.strips[..] else {
            panic!("{:?}", strips.strips)
        };
        // As wide as the street, and far beyond its ends.
        let [length_m, width_m] = [0, 1].map(|axis: usize| strip.to_m[axis] - strip.from_m[axis]);
        assert!(length_m > 1000.0 && (19.0..20.0).contains(&width_m), "{strip:?}");
    }
}
