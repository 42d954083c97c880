//! The path that a mirrored vehicle follows between two SUMO states: position and speed of the front bumper at any time.
//!
//! SUMO's positions are those of its Euler update: the new speed holds for the whole step, so the speed jumps where a step
//! begins, and its headings are chords from rear to front bumper. The path is therefore built from the positions alone, as
//! their uniform quadratic B-spline: from the middle of the last chord to the middle of the next, with the chords' own
//! velocities there and a constant acceleration in between, the very acceleration SUMO meant (C. de Boor, *A Practical Guide
//! to Splines*, chapter IX). It cannot overshoot, has no jump in velocity, and cuts a corner by an eighth of the change of
//! chord. The price: the mirror runs half a SUMO step behind SUMO (0.05 s at steps of 0.1 s), all road users alike.
//!
//! Height and slope of the road are smoothed the same way. SUMO changes lanes in one step: the mirror removes the sideways jump from
//! the path and returns it over a configured time with a minimum-jerk profile, while the vehicle moves.

use ipc_schema::traffic::TrafficState;

use super::{
    curve::{ReferenceCurve, ReferencePoint, RoadRise},
    governor::{DrivingLimits, ReferenceGovernor},
    guidance::{GuidedPath, UNLIMITED},
};
use crate::trig::wrap_angle;

/// Shortest distance over which it is spread, metres.
const LANE_CHANGE_M: f64 = 12.0;
/// Time before a lane change that is known ahead, as a share of the time that it takes.
const LANE_CHANGE_WAIT: f64 = 0.17;
/// Sideways jump within one SUMO step that counts as a lane change, metres.
const LANE_JUMP_M: f64 = 1.0;
/// No vehicle changes lanes by more than this in one step, metres.
const LANE_JUMP_MOST_M: f64 = 5.0;
/// A step that turns the vehicle by more than this is a turn, not a lane change, radians.
const LANE_JUMP_TURN_RAD: f64 = 0.35;
/// A step longer than this plus twice the distance at the vehicle's speed is not driving, metres.
const UNEXPLAINED_M: f64 = 2.0;

/// A sideways offset on its way to zero.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct LaneChange {
    /// Offset to the left of SUMO's path at the start, metres; zero if there is none.
    offset_m: f64,
    /// Share done, 0 … 1; below 0 it has yet to begin.
    phase: f64,
}

impl LaneChange {
    /// Remaining offset (metres) and its derivative by the phase.
    fn remaining(&self) -> [f64; 2] {
        let s = self.phase.max(0.0);
        let profile = s * s * s * (10.0 - s * (15.0 - 6.0 * s));
        let slope = 30.0 * s * s * (1.0 - s) * (1.0 - s);
        [self.offset_m * (1.0 - profile), -self.offset_m * slope]
    }

    /// Share of a lane change that takes `spread_s` done per second at a speed.
    fn rate_per_s(speed_mps: f64, spread_s: f64) -> f64 {
        speed_mps / (speed_mps * spread_s).max(LANE_CHANGE_M)
    }
}

/// Whether a new SUMO state continues the path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PathJoin {
    /// The path continues.
    Continued,
    /// No vehicle moves like that: the mirror has to be set.
    Broken,
}

/// The path over the current SUMO step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferencePath {
    /// Without the offset of a lane change.
    curve: ReferenceCurve,
    /// SUMO's heading at the start of the step and its rate, rad and rad/s.
    heading: [f64; 2],
    /// Velocity over the last chord, m/s.
    chord_mps: [f64; 2],
    /// Road under the front bumper over the step, from `height_m` on.
    rise: RoadRise,
    height_m: f64,
    /// Rates of height and slope over the last chord, m/s and rad/s.
    rising: [f64; 2],
    /// SUMO's path over the step: start, and the two half chords that the curve rounds.
    chords: [[f64; 2]; 3],
    lane_change: LaneChange,
    governor: ReferenceGovernor,
}

impl ReferencePath {
    /// The path of a road user seen for the first time, or set to a new position, in a simulation with steps of `step_s`: straight ahead.
    #[must_use]
    pub fn from_here(now: &TrafficState, step_s: f64) -> Self {
        let (sin, cos) = libm::sincos(f64::from(now.yaw_rad));
        let speed = f64::from(now.speed_mps);
        let velocity = [speed * cos, speed * sin];
        let start_m = half_a_step_before([now.front_x_m, now.front_y_m], velocity, step_s);
        let mut path = Self {
            curve: ReferenceCurve::straight(start_m, velocity),
            heading: [f64::from(now.yaw_rad), 0.0],
            chord_mps: velocity,
            rise: RoadRise::default(),
            height_m: 0.0,
            rising: [speed * libm::tan(f64::from(now.pitch_rad)), 0.0],
            chords: [start_m, start_m, start_m],
            lane_change: LaneChange::default(),
            governor: ReferenceGovernor::default(),
        };
        path.climb(now, path.rising, step_s);
        path
    }

    /// Takes the step from `before` to `now`, `step_s` later, of a body of `length_m`.
    pub fn advance(&mut self, before: &TrafficState, now: &TrafficState, length_m: f64, step_s: f64) -> PathJoin {
        let (joined, jump) = join(before, now, length_m, step_s);
        if joined == PathJoin::Broken {
            return PathJoin::Broken;
        }
        let mut start_m = [before.front_x_m, before.front_y_m];
        let mut moved_m = [now.front_x_m - start_m[0], now.front_y_m - start_m[1]];
        let turn = wrap_angle(f64::from(now.yaw_rad) - f64::from(before.yaw_rad));
        if let Some(jump) = jump {
            for axis in 0..2 {
                start_m[axis] += jump.vector_m[axis];
                moved_m[axis] -= jump.vector_m[axis];
            }
            self.change_lane(jump.left_m);
        }
        self.heading = [f64::from(before.yaw_rad), turn / step_s];
        self.bend(start_m, moved_m, step_s);
        let slope_change = f64::from(now.pitch_rad) - f64::from(before.pitch_rad);
        let rising = [now.front_z_m - before.front_z_m, slope_change].map(|change| change / step_s);
        self.climb(before, rising, step_s);
        PathJoin::Continued
    }

    /// Begins to return a lane change to the left, which the path has made at once.
    fn change_lane(&mut self, left_m: f64) {
        self.lane_change = LaneChange {
            offset_m: self.lane_change.remaining()[0] - left_m,
            phase: 0.0,
        };
    }

    /// The same for a path that is ahead of its road user: it waits a little, because SUMO changes lanes right behind a faster vehicle,
    /// which has not passed here yet.
    pub(super) fn change_lane_ahead(&mut self, left_m: f64) {
        self.change_lane(left_m);
        self.lane_change.phase = -LANE_CHANGE_WAIT;
    }

    /// Continues as in the last step: what a road user does until it is set elsewhere.
    pub fn coast(&mut self, before: &TrafficState, step_s: f64) {
        let start_m = half_a_step_before([before.front_x_m, before.front_y_m], self.chord_mps, step_s);
        self.curve = ReferenceCurve::straight(start_m, self.chord_mps);
        self.heading = [f64::from(before.yaw_rad), 0.0];
        self.chords = [start_m; 3];
        self.climb(before, self.rising, step_s);
    }

    /// Height and slope from the middle of the last chord to the middle of the next, whose rates are `rising`.
    fn climb(&mut self, from: &TrafficState, rising: [f64; 2], step_s: f64) {
        let [height, slope] = [0, 1].map(|i: usize| 0.5 * (rising[i] - self.rising[i]) / step_s);
        self.height_m = from.front_z_m - 0.5 * step_s * self.rising[0];
        let slope_rad = f64::from(from.pitch_rad) - 0.5 * step_s * self.rising[1];
        self.rise = RoadRise {
            height_m: [0.0, self.rising[0], height],
            slope_rad: [slope_rad, self.rising[1], slope],
        };
        self.rising = rising;
    }

    /// Height of the road and the road itself from `start_s` after the start of the step on.
    #[must_use]
    pub fn road(&self, start_s: f64) -> (f64, RoadRise) {
        (self.height_m + self.rise.at(start_s)[0], self.rise.from_time(start_s))
    }

    /// How far the reference is from SUMO's own path `t_s` after the start of the step of `step_s`, at most: the sum of the rest of a lane change, the distance by which the curve cuts the corner,
    /// and the distance that could not be driven, metres.
    #[must_use]
    pub fn offset_m(&self, t_s: f64, step_s: f64) -> f64 {
        let undriven = self.lane_change.remaining()[0].abs() + self.governor.distance_m();
        if t_s >= step_s {
            // The curve touches the path in the middle of each chord, where a step ends.
            return undriven;
        }
        let point = self.curve.at(t_s).position_m;
        let [start, corner, end] = self.chords;
        let cut = distance_m(point, start, corner).min(distance_m(point, corner, end));
        cut + undriven
    }

    /// From the middle of the last chord to the middle of this one.
    fn bend(&mut self, start_m: [f64; 2], moved_m: [f64; 2], step_s: f64) {
        let (before, chord) = (self.chord_mps, moved_m.map(|moved| moved / step_s));
        self.curve = ReferenceCurve::straight(half_a_step_before(start_m, before, step_s), before);
        self.curve.cubic[1] = [0, 1].map(|axis: usize| 0.5 * (chord[axis] - before[axis]) / step_s);
        self.curve.accel_mps2 = (norm(chord) - norm(before)) / step_s;
        self.chords = [
            self.curve.start_m,
            start_m,
            half_a_step_before(start_m, chord.map(|speed| -speed), step_s),
        ];
        self.chord_mps = chord;
    }

    /// The reference over one tick that starts `start_s` after the start of the step, for a vehicle at this speed, which
    /// continues a lane change that takes `spread_s`, limited to what the vehicle can do.
    pub fn tick(
        &mut self,
        start_s: f64,
        tick_s: f64,
        speed_mps: f64,
        spread_s: f64,
        ability: &DrivingLimits,
    ) -> ReferenceCurve {
        let curve = self.curve.from_time(start_s);
        let rate_per_s = LaneChange::rate_per_s(speed_mps, spread_s);
        let path = match self.lane_change_curve(start_s, tick_s, rate_per_s) {
            Some(sideways) => curve.plus(&sideways),
            None => curve,
        };
        self.governor.tick(&path, tick_s, ability)
    }

    /// The same for a guided vehicle: the reference, which nothing limits, and the rest of a lane change, whose time passes at any speed.
    pub fn guided_tick(&mut self, start_s: f64, tick_s: f64, spread_s: f64) -> GuidedPath {
        let curve = self.curve.from_time(start_s);
        let sideways = self.lane_change_curve(start_s, tick_s, 1.0 / spread_s.max(tick_s));
        GuidedPath {
            curve: self.governor.tick(&curve, tick_s, &UNLIMITED),
            sideways: sideways.unwrap_or_default(),
            heading: [self.heading_at(start_s), self.heading[1]],
            rise: self.rise.from_time(start_s),
        }
    }

    /// By how much a heading and its rate differ from SUMO's at `t_s`, rad and rad/s.
    #[must_use]
    pub fn turned_from(&self, t_s: f64, [yaw_rad, rate_radps]: [f64; 2]) -> [f64; 2] {
        [wrap_angle(yaw_rad - self.heading_at(t_s)), rate_radps - self.heading[1]]
    }

    /// Rest of a lane change, metres.
    #[must_use]
    pub fn lane_change_m(&self) -> f64 {
        self.lane_change.remaining()[0].abs()
    }

    /// The path itself at the start of the step.
    #[must_use]
    pub fn start(&self) -> ReferenceCurve {
        self.curve
    }

    /// Drops lane change and offset, and returns SUMO's own path from `t_s` after the start of the step on.
    pub fn resynchronise(&mut self, t_s: f64) -> ReferenceCurve {
        self.lane_change = LaneChange::default();
        self.governor = ReferenceGovernor::default();
        self.curve.from_time(t_s)
    }

    /// Makes the reference one that is `away_m` from `target`, the present one, and leaves it at `leaving_mps`.
    pub fn move_reference(&mut self, target: &ReferencePoint, away_m: [f64; 2], leaving_mps: [f64; 2]) {
        self.governor
            .move_reference(away_m, leaving_mps, norm(target.velocity_mps));
    }

    /// Distance of the reference from the path without the governor's limits, metres.
    #[must_use]
    pub fn undriven_m(&self) -> f64 {
        self.governor.distance_m()
    }

    /// What a lane change, of which `rate` passes per second, adds to the path.
    fn lane_change_curve(&mut self, start_s: f64, tick_s: f64, rate: f64) -> Option<ReferenceCurve> {
        if self.lane_change.offset_m == 0.0 {
            return None;
        }
        let [from, u0] = self.shift(start_s, rate);
        self.lane_change.phase = (self.lane_change.phase + rate * tick_s).min(1.0);
        let [to, u1] = self.shift(start_s + tick_s, rate);
        if self.lane_change.phase >= 1.0 {
            self.lane_change = LaneChange::default();
        }
        let moved = [to[0] - from[0], to[1] - from[1]];
        Some(ReferenceCurve::hermite(from, moved, [u0, u1], tick_s))
    }

    /// The rest of a lane change, to the left of SUMO's heading at `t_s`: offset and its velocity, world frame.
    fn shift(&self, t_s: f64, phase_rate_per_s: f64) -> [[f64; 2]; 2] {
        let [offset, slope] = self.lane_change.remaining();
        let (sin, cos) = libm::sincos(self.heading_at(t_s));
        let (closing, turning) = (slope * phase_rate_per_s, offset * self.heading[1]);
        [
            [-offset * sin, offset * cos],
            [-closing * sin - turning * cos, closing * cos - turning * sin],
        ]
    }

    /// SUMO's heading `t_s` after the start of the step, radians.
    #[must_use]
    pub fn heading_at(&self, t_s: f64) -> f64 {
        self.heading[0] + self.heading[1] * t_s
    }
}

/// A lane change in one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LaneJump {
    /// World frame, metres.
    pub vector_m: [f64; 2],
    /// Positive to the left, metres.
    pub left_m: f64,
}

/// Whether a vehicle of `length_m` can have moved from `before` to `now` in `step_s`, and its lane change meanwhile.
///
/// Inlined: its result would otherwise come through memory, part by part, and be waited for.
#[inline(always)]
pub(super) fn join(
    before: &TrafficState,
    now: &TrafficState,
    length_m: f64,
    step_s: f64,
) -> (PathJoin, Option<LaneJump>) {
    let mut moved_m = [now.front_x_m - before.front_x_m, now.front_y_m - before.front_y_m];
    let turn = wrap_angle(f64::from(now.yaw_rad) - f64::from(before.yaw_rad));
    let speed_mps = f64::from(before.speed_mps.max(now.speed_mps));
    let jump = sideways_jump(moved_m, f64::from(before.yaw_rad) + 0.5 * turn, turn, length_m);
    if let Some(jump) = &jump {
        if jump.left_m.abs() > LANE_JUMP_MOST_M {
            return (PathJoin::Broken, None);
        }
        for (moved, jumped) in moved_m.iter_mut().zip(jump.vector_m) {
            *moved -= jumped;
        }
    }
    match norm(moved_m) > 2.0 * speed_mps * step_s + UNEXPLAINED_M {
        true => (PathJoin::Broken, None),
        false => (PathJoin::Continued, jump),
    }
}

/// The sideways part of a chord that the heading half-way and the turn do not explain, if it is a lane change.
///
/// SUMO's heading is the chord of the body, so in a turn the front bumper moves `turn · length / 2` further to the inside.
#[inline]
fn sideways_jump(chord_m: [f64; 2], heading_rad: f64, turn_rad: f64, length_m: f64) -> Option<LaneJump> {
    let far = dot(chord_m, chord_m) > LANE_JUMP_M * LANE_JUMP_M;
    if !far || turn_rad.abs() > LANE_JUMP_TURN_RAD {
        return None;
    }
    let (sin, cos) = libm::sincos(heading_rad);
    let left_m = -chord_m[0] * sin + chord_m[1] * cos;
    let unexplained_m = left_m - 0.5 * turn_rad * length_m;
    (unexplained_m.abs() > LANE_JUMP_M).then(|| LaneJump {
        vector_m: [-left_m * sin, left_m * cos],
        left_m,
    })
}

/// The middle of a chord that ends here.
pub(crate) fn half_a_step_before(end_m: [f64; 2], chord_mps: [f64; 2], step_s: f64) -> [f64; 2] {
    [0, 1].map(|axis: usize| end_m[axis] - 0.5 * step_s * chord_mps[axis])
}

/// Distance of a point from the straight line between two others, metres.
pub(super) fn distance_m(point: [f64; 2], from: [f64; 2], to: [f64; 2]) -> f64 {
    let (line, way) = (minus(to, from), minus(point, from));
    let square = dot(line, line);
    let share = if square > 0.0 {
        (dot(way, line) / square).clamp(0.0, 1.0)
    } else {
        0.0
    };
    norm(minus(way, line.map(|part| part * share)))
}

fn minus(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

fn norm(a: [f64; 2]) -> f64 {
    dot(a, a).sqrt()
}
