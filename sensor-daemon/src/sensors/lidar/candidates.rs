//! Finds the surfaces within range that a scan may see and the columns that may see them, and sorts them into spans, nearest first.

use std::f64::consts::{PI, TAU};

use super::{
    LidarModel, Targets,
    firing::ColumnSpan,
    sensor::SensorPose,
    simd::WIDTH,
    solids::{SolidWall, StillSolids},
};

/// Added to every angle: the error of [`angle_rad`] and of the directions, radians.
const MARGIN_RAD: f64 = 1.5e-3;

/// Kind of a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CandidateKind {
    /// A wall of a building or prop: number of the wall, number of the solid.
    Wall(u32, u32),
    /// Roof and underside of a solid, by its number.
    Cap(u32),
    /// A road user, by row.
    RoadUser(u32),
}

/// A surface, or a road user.
#[derive(Debug, Clone, Copy)]
pub(super) struct ScanCandidate {
    pub(super) kind: CandidateKind,
    /// Lower bound of its horizontal distance during the tick, metres.
    pub(super) near_m: f32,
    /// First and last column of a rotation that may see it, the last beyond a rotation where it lies across its begin.
    columns: [f32; 2],
}

/// A candidate in a span, with the first and last chunk that may see it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SpanCandidate {
    pub(super) candidate: u32,
    pub(super) chunks: [u8; 2],
}

/// Candidates of a scan.
#[derive(Debug, Default)]
pub(super) struct Candidates {
    pub(super) all: Vec<ScanCandidate>,
    order: Vec<u64>,
    /// Span and entry, nearest candidate first.
    found: Vec<(u32, SpanCandidate)>,
    /// Entries sorted by span, and the first entry of each span.
    pub(super) entries: Vec<SpanCandidate>,
    starts: Vec<u32>,
    /// For each column of the tick: the first span that ends after it, and one more than the last span that begins before it.
    first_span: Vec<u16>,
    last_span: Vec<u16>,
}

/// Bounds of the sensor's motion during a tick, for the choice of candidates.
pub(super) struct SensorSweep {
    pub(super) place_m: [f64; 3],
    heading_rad: f64,
    /// Upper bounds of its distance from `place_m`: horizontally and in height, metres.
    motion_m: f64,
    rise_m: f64,
    /// Upper bound of the angle between a ray and the azimuth of its column, radians.
    spread_rad: f64,
}

impl SensorSweep {
    /// From the sensor at the begin and end of each span; `steepest` is the largest tangent of an elevation, infinite for a table.
    pub(super) fn new(sensors: &[[SensorPose; 2]], steepest: f64) -> Option<Self> {
        let middle = &sensors.get(sensors.len() / 2)?[0];
        let heading = |sensor: &SensorPose| angle_rad(sensor.world_from_sensor[0][0], sensor.world_from_sensor[1][0]);
        let heading_rad = heading(middle);
        let mut watch = Self {
            place_m: middle.position_m,
            heading_rad,
            motion_m: 0.0,
            rise_m: 0.0,
            spread_rad: 0.0,
        };
        let mut turned = 0.0_f64;
        let mut least_up = 1.0_f64;
        for sensor in sensors.iter().flatten() {
            let off: [f64; 3] = std::array::from_fn(|axis| sensor.position_m[axis] - middle.position_m[axis]);
            watch.motion_m = watch.motion_m.max((off[0] * off[0] + off[1] * off[1]).sqrt());
            watch.rise_m = watch.rise_m.max(off[2].abs());
            turned = turned.max(wrapped(heading(sensor) - heading_rad).abs());
            least_up = least_up.min(sensor.world_from_sensor[2][2]);
        }
        watch.spread_rad = turned + MARGIN_RAD + tilt_rad(least_up, steepest);
        Some(watch)
    }
}

/// Upper bound of the difference between the azimuths of a ray and its column when the sensor's axis is tilted by the angle θ whose
/// cosine is `up`: a ray moves sideways by at most `tan e sin θ`, over at least `cos θ − tan e sin θ` ahead; the column moves by θ²/2.
fn tilt_rad(up: f64, steepest: f64) -> f64 {
    let sin2 = 1.0 - up * up;
    if sin2 <= 0.0 {
        return 0.0;
    }
    let aside = steepest * sin2.sqrt();
    let ahead = up - aside;
    if ahead < 0.1 {
        TAU
    } else {
        libm::atan(aside / ahead) + sin2
    }
}

/// −π … π.
#[inline(always)]
fn wrapped(angle: f64) -> f64 {
    angle - TAU * (angle * (1.0 / TAU)).round_ties_even()
}

/// Angle of a vector to 2e-4 rad: a polynomial in the smaller over the larger part.
#[inline(always)]
pub(super) fn angle_rad(x: f64, y: f64) -> f64 {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ax < ay { (ax, ay) } else { (ay, ax) };
    let ratio = small / large.max(1e-30);
    let square = ratio * ratio;
    let angle = ratio
        * (0.999_866 + square * (-0.330_299_5 + square * (0.180_141 + square * (-0.085_133 + square * 0.020_835_1))));
    let angle = if ax < ay { 0.5 * PI - angle } else { angle };
    let angle = if x < 0.0 { PI - angle } else { angle };
    if y < 0.0 { -angle } else { angle }
}

/// Rotation of the head, for the choice of the columns that may see an object.
struct Eye<'a> {
    watch: &'a SensorSweep,
    per_rotation: f64,
    is_table: bool,
    range_m: f64,
}

impl Eye<'_> {
    fn whole(&self) -> [f32; 2] {
        [0.0, self.per_rotation as f32]
    }

    /// Columns that may look between two angles, `more` further out on both sides.
    #[inline(always)]
    fn columns(&self, low: f64, high: f64, more: f64) -> [f32; 2] {
        let more = more + self.watch.spread_rad;
        let length = high - low + 2.0 * more;
        if length >= TAU || self.is_table {
            return self.whole();
        }
        let begin = low - self.watch.heading_rad - more;
        let begin = begin - TAU * (begin * (1.0 / TAU)).floor();
        let per_rad = self.per_rotation * (1.0 / TAU);
        [
            (begin * per_rad) as f32 - 1.0,
            ((begin + length) * per_rad) as f32 + 1.0,
        ]
    }

    /// Columns that may see a circle.
    #[inline(always)]
    fn circle(&self, [dx, dy]: [f64; 2], distance_m: f64, radius_m: f64) -> [f32; 2] {
        if distance_m < 1.05 * radius_m {
            return self.whole();
        }
        let half = libm::asin(radius_m / distance_m);
        let centre = angle_rad(dx, dy);
        self.columns(centre - half, centre + half, 0.0)
    }

    /// Least distance of a wall that shows its outside and is within range, and the columns that may see it.
    #[inline(always)]
    fn wall(&self, wall: &SolidWall) -> Option<(f32, [f32; 2])> {
        let [x, y, _] = self.watch.place_m;
        let motion_m = self.watch.motion_m;
        let (p, q) = ([wall.p_m[0] - x, wall.p_m[1] - y], [wall.q_m[0] - x, wall.q_m[1] - y]);
        let offset = wall.normal[0] * p[0] + wall.normal[1] * p[1];
        if offset > motion_m {
            return None;
        }
        let along = [q[0] - p[0], q[1] - p[1]];
        let square = along[0] * along[0] + along[1] * along[1];
        let share = (-(p[0] * along[0] + p[1] * along[1]) / square).clamp(0.0, 1.0);
        let nearest = [p[0] + share * along[0], p[1] + share * along[1]];
        let distance_m = (nearest[0] * nearest[0] + nearest[1] * nearest[1]).sqrt();
        if distance_m > self.range_m {
            return None;
        }
        let (left, right) = (angle_rad(p[0], p[1]), angle_rad(q[0], q[1]));
        let width = wrapped(left - right);
        let is_wide = distance_m < 2.0 * motion_m || width.abs() > 3.0 || distance_m < 0.01;
        let low = if width < 0.0 { left } else { right };
        // asin x < 1.6 x
        let more = if motion_m > 0.0 {
            1.6 * motion_m / distance_m
        } else {
            0.0
        };
        let columns = if is_wide {
            self.whole()
        } else {
            self.columns(low, low + width.abs(), more)
        };
        Some(((distance_m - motion_m).max(0.0) as f32, columns))
    }
}

impl Candidates {
    /// Gathers all surfaces that the carrier in `row` may see.
    #[inline(always)]
    pub(super) fn gather(&mut self, lidar: &LidarModel, targets: &Targets, row: usize, watch: &SensorSweep) {
        self.all.clear();
        let eye = Eye {
            watch,
            per_rotation: lidar.firing.per_rotation as f64,
            is_table: lidar.pattern.is_table,
            range_m: lidar.range_m + watch.motion_m,
        };
        let [x, y, _] = watch.place_m;
        lidar.solids.within([x, y], eye.range_m, |number, distance_m| {
            self.still(&lidar.solids, number, distance_m, &eye);
        });
        for (number, [at_x, at_y, reach_m]) in targets.near.iter().enumerate() {
            let (dx, dy) = (at_x - x, at_y - y);
            let square = dx * dx + dy * dy;
            let most_m = eye.range_m + reach_m;
            if square < most_m * most_m && number != row {
                let (distance_m, reach_m) = (square.sqrt(), reach_m + watch.motion_m);
                self.all.push(ScanCandidate {
                    kind: CandidateKind::RoadUser(number as u32),
                    near_m: (distance_m - reach_m).max(0.0) as f32,
                    columns: eye.circle([dx, dy], distance_m, reach_m),
                });
            }
        }
    }

    /// Adds the roof and the walls of a static solid.
    #[inline(always)]
    fn still(&mut self, solids: &StillSolids, number: usize, distance_m: f64, eye: &Eye<'_>) {
        let (watch, still) = (eye.watch, &solids.stills[number]);
        let [x, y, z] = watch.place_m;
        if z + watch.rise_m > still.z_m[1] || z - watch.rise_m < still.z_m[0] {
            let centre = [still.centre_m[0] - x, still.centre_m[1] - y];
            self.all.push(ScanCandidate {
                kind: CandidateKind::Cap(number as u32),
                near_m: (distance_m - still.reach_m - watch.motion_m).max(0.0) as f32,
                columns: eye.circle(centre, distance_m, still.reach_m + watch.motion_m),
            });
        }
        for index in still.walls.clone() {
            if let Some((near_m, columns)) = eye.wall(&solids.walls[index as usize]) {
                self.all.push(ScanCandidate {
                    kind: CandidateKind::Wall(index, number as u32),
                    near_m,
                    columns,
                });
            }
        }
    }

    /// Sorts the candidates into the spans of a tick that begins at column `begin` of a rotation and has `count` columns.
    #[inline(always)]
    pub(super) fn sort(&mut self, spans: &[ColumnSpan], (begin, count): (usize, usize), per_rotation: usize) {
        self.order.clear();
        let keys = self.all.iter().enumerate();
        self.order
            .extend(keys.map(|(number, one)| u64::from(one.near_m.to_bits()) << 32 | number as u64));
        self.order.sort_unstable();
        self.columns_to_spans(spans, count);
        self.found.clear();
        self.starts.clear();
        self.starts.resize(spans.len() + 1, 0);
        let (begin, round) = (begin as f32, per_rotation as f32);
        for place in 0..self.order.len() {
            let key = self.order[place];
            let number = key as u32;
            let [low, high] = self.all[number as usize].columns;
            let length = (high - low).min(round + 1.0);
            let mut low = low - begin;
            // The first turn of the head whose view of it reaches into the tick.
            low -= round * ((low + length) / round).floor();
            while low < count as f32 {
                let high = low + length;
                if high >= 0.0 {
                    self.enter(number, [low.max(0.0) as usize, (high as usize).min(count - 1)], spans);
                }
                low += round;
            }
        }
        self.gather_by_span(spans.len());
    }

    /// Enters a candidate into the spans of some columns.
    #[inline(always)]
    fn enter(&mut self, candidate: u32, [low, high]: [usize; 2], spans: &[ColumnSpan]) {
        for number in self.first_span[low]..self.last_span[high] {
            let span = &spans[number as usize];
            let chunk = |column: usize| (column.saturating_sub(span.first).min(span.count - 1) / WIDTH) as u8;
            self.starts[number as usize + 1] += 1;
            let chunks = [chunk(low), chunk(high)];
            self.found
                .push((u32::from(number), SpanCandidate { candidate, chunks }));
        }
    }

    fn columns_to_spans(&mut self, spans: &[ColumnSpan], count: usize) {
        self.first_span.clear();
        self.last_span.clear();
        for (number, span) in (0_u16..).zip(spans) {
            self.first_span.resize(span.first + span.count, number);
            self.last_span.resize(span.first, number);
        }
        self.first_span.resize(count, spans.len() as u16);
        self.last_span.resize(count, spans.len() as u16);
    }

    fn gather_by_span(&mut self, spans: usize) {
        for span in 0..spans {
            self.starts[span + 1] += self.starts[span];
        }
        self.entries.resize(self.found.len(), SpanCandidate::default());
        // `order` is reused for the index of the next entry of each span.
        self.order.clear();
        self.order.extend(self.starts.iter().map(|&start| u64::from(start)));
        for (span, entry) in &self.found {
            let next = &mut self.order[*span as usize];
            self.entries[*next as usize] = *entry;
            *next += 1;
        }
    }

    /// Entries of a span.
    #[inline(always)]
    pub(super) fn of_span(&self, span: usize) -> &[SpanCandidate] {
        &self.entries[self.starts[span] as usize..self.starts[span + 1] as usize]
    }
}
