//! The pace at which a mirror follows the path ahead of it: it slows down for a bend that SUMO drives too fast, and catches up afterwards.
//!
//! The path is a line through the means of SUMO's last states ([`super::window`]). The mirror aims at the mean of some frames ago, so it
//! knows the path ahead. Where the aim's speed asks for more lateral acceleration than the tyres should give, the mirror brakes *before*
//! the bend and stays on the path. It falls behind its aim meanwhile, and drives faster afterwards, within what the vehicle can do.

use ipc_schema::{config::PreviewFrames, traffic::TrafficState};

use super::{governor::DrivingLimits, prefetch::PrefetchRange, reference::LaneJump, window::WindowStep};
use crate::trig::wrap_angle;

/// Most frames by which a mirror may be later than it should be.
const MOST_LATE: usize = 24;
/// Share of the lateral limit that the pace asks for: the rest is for tracking.
const LATERAL_SHARE: f64 = 0.9;
/// Share of the longitudinal limits that the pace asks for.
const LONGITUDINAL_SHARE: f64 = 0.7;
/// Deceleration with which a mirror brakes before a bend, m/s²: firm, not an emergency.
const BRAKE_MPS2: f64 = 3.5;
/// Rate at which lost distance is caught up, 1/s.
const CATCH_UP_PER_S: f64 = 0.5;
/// Distance from a narrow turn within which it is the reason for what goes wrong, metres.
const NARROW_REACH_M: f64 = 12.0;
/// A path that turns this much more narrowly than the vehicle can is not tried: the vehicle is led from its beginning.
const FAR_TOO_NARROW: f64 = 1.4;
/// Frames before such a turn at which guidance begins.
const NARROW_FRAMES: usize = 3;
/// Distance, and time at the aim's speed, by which a mirror may be late for a bend; at twice as much it keeps pace and may have to be led.
const MOST_LATE_M: f64 = 2.0;
const MOST_LATE_S: f64 = 0.15;
/// Distance ahead and behind over which a bend is measured, metres.
const BEND_REACH_M: f64 = 2.0;
/// Points that it usually reaches behind the mirror.
const BEHIND_POINTS: usize = 3;
/// Turns below this are straight, radians.
const STRAIGHT_RAD: f64 = 1e-4;
/// Largest distance by which a mirror's place is moved out of a bend, metres.
const MOST_OUTSIDE_M: f64 = 1.2;
/// Points of the path are at least so far apart, metres: nearer ones have no direction.
const APART_M: f64 = 0.02;

/// What a vehicle can drive, as its pace needs it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathLimits {
    /// Limits of acceleration.
    pub driving: DrivingLimits,
    /// Largest curvature of the front bumper's path, 1/m.
    pub front_curvature_per_m: f64,
    /// By how much the front bumper moves out of a bend, by the curvature, so that the body is nearer to where SUMO has it, m².
    pub swing_m2: f64,
}

/// A mean of SUMO's states on the path, in a cache line of its own.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(align(64))]
struct PathPoint {
    /// Front bumper.
    position_m: [f64; 3],
    yaw_rad: f32,
    pitch_rad: f32,
    /// Distance along the path from where it begins, metres.
    station_m: f64,
    /// Square of the speed that the bend up to here allows, and from which a mirror can brake to what every bend ahead allows, m²/s².
    allowed_square: f64,
    /// Distance from SUMO's own path, metres.
    deviation_m: f32,
    lamps: u32,
    /// The path turns far too narrowly here.
    is_narrow: bool,
}

/// A road user's path and its progress on it.
#[derive(Debug, Clone, PartialEq)]
pub struct PacedPath {
    /// A ring; the newest point is at `newest`.
    points: Vec<PathPoint>,
    newest: usize,
    /// Frames by which the aim is behind the newest point.
    late: usize,
    /// By how much the mean cuts a corner: half the variance of the frames that it is made of, squared frames.
    cut_frames2: f64,
    /// Distance of the mirror's place from the mean, out of the bend, metres.
    outside_m: f64,
    /// Station of the mirror and its speed.
    station_m: f64,
    speed_mps: f64,
    /// Frames by which the first point ahead of the mirror is behind the newest.
    ahead: usize,
    /// Station of the newest point at which the path turns more narrowly than the vehicle can.
    narrow_m: f64,
    /// Direction of the path at the newest point, a unit vector; zero where it begins.
    direction: [f64; 2],
}

impl PacedPath {
    /// A path of the means over a window. It belongs to no road user yet.
    #[must_use]
    pub fn new(frames: PreviewFrames) -> Self {
        let (late, window) = (frames.late, frames.window_states as f64);
        Self {
            points: vec![PathPoint::default(); late + MOST_LATE + 2],
            newest: 0,
            late,
            cut_frames2: (window * window - 1.0) / 24.0,
            outside_m: 0.0,
            station_m: 0.0,
            speed_mps: 0.0,
            ahead: late,
            narrow_m: f64::NEG_INFINITY,
            direction: [0.0; 2],
        }
    }

    /// Begins with a road user that has come to `mean` straight ahead at its speed, in frames of `frame_s`. Returns its state.
    pub fn restart(&mut self, mean: &TrafficState, frame_s: f64) -> TrafficState {
        let (sin, cos) = libm::sincos(f64::from(mean.yaw_rad));
        let climb = libm::tan(f64::from(mean.pitch_rad));
        let count = self.points.len();
        let chord_m = f64::from(mean.speed_mps) * frame_s;
        for (place, point) in self.points.iter_mut().enumerate() {
            let back_m = chord_m * (count - 1 - place) as f64;
            *point = PathPoint {
                position_m: [
                    mean.front_x_m - back_m * cos,
                    mean.front_y_m - back_m * sin,
                    mean.front_z_m - back_m * climb,
                ],
                yaw_rad: mean.yaw_rad,
                pitch_rad: mean.pitch_rad,
                station_m: -back_m,
                allowed_square: f64::INFINITY,
                deviation_m: 0.0,
                lamps: mean.signals,
                is_narrow: false,
            };
        }
        self.outside_m = 0.0;
        self.newest = count - 1;
        self.direction = [0.0; 2];
        self.ahead = self.late;
        self.narrow_m = f64::NEG_INFINITY;
        self.station_m = self.behind(self.late).station_m;
        self.speed_mps = mean.speed_mps.into();
        self.find_ahead();
        let mut mirror = *mean;
        self.place_mirror(&mut mirror);
        mirror
    }

    /// Prefetches the points between the mirror, or a little behind it, and the next mean.
    #[inline]
    pub fn prefetch(&self) {
        let behind = self.ahead + 1 + BEHIND_POINTS;
        let first = self.newest.saturating_sub(behind);
        // The last of them is the oldest point.
        PrefetchRange::new(&self.points, first, self.newest + 4 - first).fetch_all();
        // Those before the beginning of the ring are at its end.
        let rest = behind.saturating_sub(self.newest);
        PrefetchRange::new(&self.points, self.points.len().saturating_sub(rest), rest).fetch_all();
    }

    /// Takes the next mean and its distance from SUMO's path, and moves the mirror for a frame. Without `limits` it is on time.
    pub fn advance(
        &mut self,
        (mean, deviation_m): (&TrafficState, f64),
        step: WindowStep,
        limits: Option<&PathLimits>,
        frame_s: f64,
        mirror: &mut TrafficState,
    ) {
        if let Some(LaneJump { vector_m, .. }) = step.lane_change {
            for point in &mut self.points {
                point.position_m[0] += vector_m[0];
                point.position_m[1] += vector_m[1];
            }
        }
        self.push(mean, deviation_m, limits);
        self.ahead += 1;
        let aim_m = self.behind(self.late).station_m;
        let aim_mps = (aim_m - self.behind(self.late + 1).station_m) / frame_s;
        (self.station_m, self.speed_mps) = match limits {
            None => (aim_m, aim_mps),
            Some(limits) => {
                let wanted_mps = aim_mps + CATCH_UP_PER_S * (aim_m - self.station_m);
                let bend_mps = self.bend_speed_mps();
                let most_late_m = MOST_LATE_M + MOST_LATE_S * aim_mps;
                let share = ((aim_m - self.station_m) / most_late_m - 1.0).clamp(0.0, 1.0);
                let bend_mps = bend_mps + share * (aim_mps - bend_mps).max(0.0);
                let [most_accel, most_decel, _] = limits.driving.at(self.speed_mps.max(1.0));
                let speed_mps = wanted_mps
                    .min(bend_mps)
                    .clamp(
                        self.speed_mps - LONGITUDINAL_SHARE * most_decel * frame_s,
                        self.speed_mps + LONGITUDINAL_SHARE * most_accel * frame_s,
                    )
                    .max(0.0);
                // On time or later, and never behind the points that are kept.
                let oldest_m = self.behind(self.points.len() - 2).station_m;
                let station_m = (self.station_m + speed_mps * frame_s).min(aim_m).max(oldest_m);
                (station_m, (station_m - self.station_m) / frame_s)
            }
        };
        self.find_ahead();
        self.place_mirror(mirror);
        // What does not move is SUMO's.
        mirror.accel_mps2 = mean.accel_mps2;
        mirror.flags = mean.flags;
        if let Some(limits) = limits {
            self.move_outside(limits.swing_m2, mirror);
        }
    }

    /// True near a turn of the path that is narrower than the vehicle's turning circle.
    #[must_use]
    pub fn is_narrow(&self) -> bool {
        (self.station_m - self.narrow_m).abs() < NARROW_REACH_M
    }

    /// True where the path begins to turn so narrowly that the vehicle has to be led.
    #[must_use]
    pub fn turns_narrowly(&self) -> bool {
        self.behind(self.ahead.saturating_sub(NARROW_FRAMES)).is_narrow
    }

    /// Distance along the path by which the mirror is later than it should be, metres.
    #[must_use]
    pub fn late_m(&self) -> f64 {
        self.behind(self.late).station_m - self.station_m
    }

    /// Distance of the mirror's place from SUMO's own path, metres.
    #[must_use]
    pub fn deviation_m(&self) -> f64 {
        (f64::from(self.behind(self.ahead).deviation_m) - self.outside_m).abs()
    }

    /// The point `frames` before the newest.
    fn behind(&self, frames: usize) -> &PathPoint {
        &self.points[self.place(frames)]
    }

    /// Position in the ring, for less frames than points.
    fn place(&self, frames: usize) -> usize {
        if frames <= self.newest {
            self.newest - frames
        } else {
            self.newest + self.points.len() - frames
        }
    }

    fn push(&mut self, mean: &TrafficState, deviation_m: f64, limits: Option<&PathLimits>) {
        let last = self.points[self.newest];
        let position_m = [mean.front_x_m, mean.front_y_m, mean.front_z_m];
        let chord = [0, 1].map(|axis: usize| position_m[axis] - last.position_m[axis]);
        let length_m = (chord[0] * chord[0] + chord[1] * chord[1]).sqrt();
        let station_m = last.station_m + length_m;
        // No bend ahead of the newest point is known.
        let (mut allowed_square, mut is_narrow) = (last.allowed_square, last.is_narrow);
        if length_m > APART_M {
            let per_m = 1.0 / length_m;
            let [ahead, left] = chord.map(|part| part * per_m);
            let [cos, sin] = std::mem::replace(&mut self.direction, [ahead, left]);
            // The sine of the turn, and twice its half-angle's from a right angle on: no path turns back on the spot.
            let (dot, cross) = (cos * ahead + sin * left, (cos * left - sin * ahead).abs());
            let curvature_per_m = if dot >= 0.0 { cross } else { 2.0 } * per_m;
            if let Some(limits) = limits {
                // Single precision is enough, and observations keep the hashes that they had with it.
                allowed_square =
                    f64::from((LATERAL_SHARE * limits.driving.lateral_mps2 / curvature_per_m.max(1e-6)) as f32);
                if curvature_per_m > limits.front_curvature_per_m {
                    self.narrow_m = station_m;
                    // It is led there at SUMO's speed: to brake would only make it late.
                    allowed_square = f64::INFINITY;
                }
                is_narrow = curvature_per_m > FAR_TOO_NARROW * limits.front_curvature_per_m;
            }
        }
        self.newest += 1;
        if self.newest == self.points.len() {
            self.newest = 0;
        }
        self.points[self.newest] = PathPoint {
            position_m,
            yaw_rad: mean.yaw_rad,
            pitch_rad: mean.pitch_rad,
            station_m,
            allowed_square,
            deviation_m: deviation_m as f32,
            lamps: mean.signals,
            is_narrow,
        };
        self.brake_before(allowed_square, station_m);
    }

    /// Lowers what the points before the newest allow to what can be braked from. A point that allows no more than that ends the search: so
    /// do all before it.
    fn brake_before(&mut self, newest_square: f64, newest_m: f64) {
        let (mut square, mut next_m) = (newest_square, newest_m);
        for frames in 1..self.points.len() {
            let place = self.place(frames);
            let point = &mut self.points[place];
            let braking = square + 2.0 * BRAKE_MPS2 * (next_m - point.station_m);
            if braking >= point.allowed_square {
                return;
            }
            point.allowed_square = braking;
            (square, next_m) = (braking, point.station_m);
        }
    }

    /// Moves the mirror's place out of a bend: by as much as the mean cuts the corner, and so far that the body is nearer to SUMO's. SUMO's
    /// bodies have both bumpers on the lane, where the rear of one that rolls cuts the corner.
    fn move_outside(&mut self, swing_m2: f64, mirror: &mut TrafficState) {
        let [before_rad, after_rad] = [-BEND_REACH_M, BEND_REACH_M].map(|away_m| self.yaw_at(self.station_m + away_m));
        let turn_rad = wrap_angle(after_rad - before_rad);
        self.outside_m = 0.0;
        if turn_rad.abs() < STRAIGHT_RAD {
            return;
        }
        let curvature_per_m = turn_rad / (2.0 * BEND_REACH_M);
        let frame_m = self.behind(self.ahead).station_m - self.behind(self.ahead + 1).station_m;
        let outside_m = curvature_per_m * (swing_m2 + self.cut_frames2 * frame_m * frame_m);
        let outside_m = outside_m.clamp(-MOST_OUTSIDE_M, MOST_OUTSIDE_M);
        // SUMO's heading is that of the lane under the middle of the body; the front bumper is ahead of it.
        let (sin, cos) = libm::sincos(after_rad);
        mirror.front_x_m += outside_m * sin;
        mirror.front_y_m -= outside_m * cos;
        self.outside_m = outside_m.abs();
    }

    /// The mean of SUMO's headings at a station near the mirror, radians.
    fn yaw_at(&self, station_m: f64) -> f64 {
        let frames = self.first_ahead_of(station_m);
        let (to, from) = (self.behind(frames), self.behind(frames + 1));
        let turn_rad = wrap_angle(f64::from(to.yaw_rad) - f64::from(from.yaw_rad));
        f64::from(from.yaw_rad) + share_of_way(from, to, station_m) * turn_rad
    }

    /// Finds the first point ahead of the mirror, near the one of the frame before.
    fn find_ahead(&mut self) {
        self.ahead = self.first_ahead_of(self.station_m);
    }

    /// Frames by which the first point ahead of a station is behind the newest. The search begins at the mirror's.
    fn first_ahead_of(&self, station_m: f64) -> usize {
        let last = self.points.len() - 2;
        // A vehicle that stands has all points at one place.
        if self.behind(last).station_m > station_m {
            return last;
        }
        let mut frames = self.ahead.min(last);
        while frames < last && self.behind(frames + 1).station_m > station_m {
            frames += 1;
        }
        while frames > 0 && self.behind(frames).station_m < station_m {
            frames -= 1;
        }
        frames
    }

    /// The speed from which the mirror can brake to what every bend ahead allows, m/s.
    fn bend_speed_mps(&self) -> f64 {
        let next = self.behind(self.ahead);
        (next.allowed_square + 2.0 * BRAKE_MPS2 * (next.station_m - self.station_m).max(0.0)).sqrt()
    }

    /// Writes place, speed and lamps of the mirror. Number by number, into the state that is read so: a processor waits if it loads as a
    /// vector what it has just stored otherwise.
    fn place_mirror(&self, mirror: &mut TrafficState) {
        let (to, from) = (self.behind(self.ahead), self.behind(self.ahead + 1));
        let share = share_of_way(from, to, self.station_m);
        let mix = |axis: usize| from.position_m[axis] + share * (to.position_m[axis] - from.position_m[axis]);
        let turn_rad = wrap_angle(f64::from(to.yaw_rad) - f64::from(from.yaw_rad));
        mirror.front_x_m = mix(0);
        mirror.front_y_m = mix(1);
        mirror.front_z_m = mix(2);
        mirror.yaw_rad = wrap_angle(f64::from(from.yaw_rad) + share * turn_rad) as f32;
        mirror.pitch_rad = from.pitch_rad + share as f32 * (to.pitch_rad - from.pitch_rad);
        mirror.speed_mps = self.speed_mps as f32;
        mirror.signals = to.lamps;
    }
}

/// Share of the way between two points at which a station lies, 0 … 1.
fn share_of_way(from: &PathPoint, to: &PathPoint, station_m: f64) -> f64 {
    let way_m = to.station_m - from.station_m;
    match way_m > 0.0 {
        true => ((station_m - from.station_m) / way_m).clamp(0.0, 1.0),
        false => 1.0,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const FRAME_S: f64 = 0.1;
    const LATE: usize = 5;
    const FRAMES: PreviewFrames = PreviewFrames {
        window_states: 1,
        late: LATE,
    };
    const DRIVING: DrivingLimits = DrivingLimits {
        lateral_mps2: 6.0,
        curvature_per_m: 1.0,
        accel_mps2: 3.0,
        decel_mps2: 8.0,
        power_by_mass: 100.0,
        drag_by_mass_per_m: 3e-4,
        rolling_mps2: 0.1,
    };
    const LIMITS: PathLimits = PathLimits {
        driving: DRIVING,
        front_curvature_per_m: 1.0,
        swing_m2: 0.0,
    };

    const STRAIGHT_ON: WindowStep = WindowStep { lane_change: None };

    /// Means of a vehicle at `speed_mps` that drives 40 m straight, a quarter of a circle, and straight on.
    fn means(speed_mps: f64, radius_m: f64) -> impl Iterator<Item = TrafficState> {
        (0..200).map(move |frame| {
            let along = speed_mps * FRAME_S * f64::from(frame) - 40.0;
            let angle = (along / radius_m).clamp(0.0, std::f64::consts::FRAC_PI_2);
            let (sin, cos) = libm::sincos(angle);
            let rest = along - angle * radius_m;
            TrafficState {
                front_x_m: radius_m * sin + rest * cos,
                front_y_m: radius_m * (1.0 - cos) + rest * sin,
                yaw_rad: angle as f32,
                speed_mps: speed_mps as f32,
                ..TrafficState::default()
            }
        })
    }

    /// The mirror's states along the means.
    fn paced(means: impl Iterator<Item = TrafficState>, limits: Option<&PathLimits>) -> Vec<TrafficState> {
        let mut path = PacedPath::new(FRAMES);
        let mut mirror: Option<TrafficState> = None;
        let states = means.map(|mean| match &mut mirror {
            None => *mirror.insert(path.restart(&mean, FRAME_S)),
            Some(mirror) => {
                path.advance((&mean, 0.0), STRAIGHT_ON, limits, FRAME_S, mirror);
                *mirror
            }
        });
        states.collect()
    }

    fn gap_m(a: &TrafficState, b: &TrafficState) -> f64 {
        libm::hypot(a.front_x_m - b.front_x_m, a.front_y_m - b.front_y_m)
    }

    #[test]
    fn a_bend_that_can_be_driven_changes_nothing() {
        let expected: Vec<TrafficState> = means(7.0, 20.0).collect();
        for limits in [None, Some(&LIMITS)] {
            let states = paced(means(7.0, 20.0), limits);
            for (state, expected) in states[LATE..].iter().zip(&expected) {
                assert!(gap_m(state, expected) < 1e-6, "{state:?} {expected:?}");
                assert!((state.speed_mps - 7.0).abs() < 0.01, "{state:?}");
            }
        }
    }

    #[test]
    fn a_bend_that_is_too_fast_is_driven_later_and_the_time_is_made_good_afterwards() {
        // 8.2 m/s² of lateral acceleration, where 5.4 are wanted.
        let (speed_mps, radius_m) = (7.0, 6.0);
        let expected: Vec<TrafficState> = means(speed_mps, radius_m).collect();
        let states = paced(means(speed_mps, radius_m), Some(&LIMITS));
        let mut slowest_mps = f64::INFINITY;
        for (number, pair) in states.windows(2).enumerate() {
            let accel_mps2 = f64::from(pair[1].speed_mps - pair[0].speed_mps) / FRAME_S;
            assert!(
                accel_mps2 > -DRIVING.decel_mps2 && accel_mps2 < DRIVING.accel_mps2 + 1e-3,
                "frame {number}: {accel_mps2}"
            );
            slowest_mps = slowest_mps.min(pair[1].speed_mps.into());
            // On the path: on one of the straights or on the circle.
            let [x, y] = [pair[1].front_x_m, pair[1].front_y_m];
            let off_m = match (x <= 0.0, y >= radius_m) {
                (true, _) => y.abs(),
                (_, true) => (x - radius_m).abs(),
                _ => (libm::hypot(x, y - radius_m) - radius_m).abs(),
            };
            assert!(off_m < 0.02, "frame {number}: {off_m} m from the path");
        }
        let allowed_mps = (LATERAL_SHARE * DRIVING.lateral_mps2 * radius_m).sqrt();
        assert!(
            (slowest_mps - allowed_mps).abs() < 0.2,
            "{slowest_mps} m/s, allowed {allowed_mps}"
        );
        let late_m = |frame: usize| gap_m(&states[frame], &expected[frame - LATE]);
        assert!((10..199).map(late_m).fold(0.0, f64::max) > 0.5, "it was never late");
        assert!(late_m(199) < 0.1, "{} m late at the end", late_m(199));
    }

    proptest! {
        /// The sum over all points ahead, from the newest to the oldest, is what the points know when each new one only lowers some.
        #[test]
        fn every_point_allows_what_can_be_braked_from_before_the_bends_ahead(
            steps in prop::collection::vec((0.0_f64..2.5, -0.5_f64..0.5), 1..120),
        ) {
            let mut path = PacedPath::new(FRAMES);
            let (mut mean, mut alone) = (TrafficState::default(), std::collections::VecDeque::new());
            let mut mirror = path.restart(&mean, FRAME_S);
            let (mut yaw_rad, mut bends) = (0.0, 0);
            for (length_m, turn_rad) in steps {
                yaw_rad += turn_rad;
                let (sin, cos) = libm::sincos(yaw_rad);
                mean.front_x_m += length_m * cos;
                mean.front_y_m += length_m * sin;
                path.advance((&mean, 0.0), STRAIGHT_ON, Some(&LIMITS), FRAME_S, &mut mirror);
                // Nothing is ahead of the newest point.
                alone.push_front(path.behind(0).allowed_square);
                let (mut square, mut next_m) = (f64::INFINITY, path.behind(0).station_m);
                for frames in 0..path.points.len() {
                    let point = path.behind(frames);
                    let braking = square + 2.0 * BRAKE_MPS2 * (next_m - point.station_m);
                    let own = alone.get(frames).copied().unwrap_or(f64::INFINITY);
                    bends += usize::from(braking < own);
                    square = own.min(braking);
                    next_m = point.station_m;
                    prop_assert_eq!(point.allowed_square, square, "{} frames behind the newest", frames);
                }
                let searched = (0..=path.points.len() - 2).rev().find(|&frames| path.behind(frames).station_m >= path.station_m);
                prop_assert_eq!(path.behind(path.ahead).station_m, path.behind(searched.unwrap_or(0)).station_m);
            }
            prop_assume!(bends > 0);
        }
    }

    #[test]
    fn a_stop_is_reached_and_left_without_a_jump() {
        // Stops at 1 m after braking with 5 m/s², stands, and starts with 6 m/s², which the limits do not allow.
        let states = || {
            (0..250).map(|frame| {
                let time_s = FRAME_S * f64::from(frame);
                let x_m = match time_s {
                    time_s if time_s < 2.0 => 10.0 * time_s - 2.5 * time_s * time_s,
                    time_s if time_s < 4.0 => 10.0,
                    time_s => {
                        10.0 + 3.0 * (time_s - 4.0).min(2.0) * ((time_s - 4.0).min(2.0) + 2.0 * (time_s - 6.0).max(0.0))
                    }
                };
                TrafficState {
                    front_x_m: x_m,
                    speed_mps: 10.0,
                    ..TrafficState::default()
                }
            })
        };
        let expected: Vec<TrafficState> = states().collect();
        let mirrored = paced(states(), Some(&LIMITS));
        for (number, three) in mirrored.windows(3).enumerate().skip(LATE) {
            let [first, second] = [0, 1].map(|i: usize| (three[i + 1].front_x_m - three[i].front_x_m) / FRAME_S);
            let accel_mps2 = (second - first) / FRAME_S;
            assert!(second > -1e-9, "frame {number}: {second} m/s");
            assert!(
                accel_mps2 < DRIVING.accel_mps2 && accel_mps2 > -DRIVING.decel_mps2,
                "frame {number}: {accel_mps2} m/s²"
            );
            assert!(three[1].front_x_m <= expected[number + 1 - LATE].front_x_m + 1e-9);
        }
        assert!(
            (mirrored[44].front_x_m - 10.0).abs() < 0.2,
            "{}",
            mirrored[44].front_x_m
        );
        assert!(gap_m(&mirrored[249], &expected[249 - LATE]) < 0.5);
    }

    #[test]
    fn a_lane_change_moves_the_whole_path() {
        let mut path = PacedPath::new(FRAMES);
        let at = |x_m: f64, y_m: f64| TrafficState {
            front_x_m: x_m,
            front_y_m: y_m,
            speed_mps: 10.0,
            ..TrafficState::default()
        };
        let mut mirror = path.restart(&at(0.0, 0.0), FRAME_S);
        let before = mirror;
        let step = WindowStep {
            lane_change: Some(LaneJump {
                vector_m: [0.0, 3.2],
                left_m: 3.2,
            }),
        };
        path.advance((&at(1.0, 3.2), 0.0), step, Some(&LIMITS), FRAME_S, &mut mirror);
        assert!((mirror.front_y_m - 3.2).abs() < 1e-9, "{mirror:?}");
        assert!((mirror.front_x_m - before.front_x_m - 1.0).abs() < 1e-9);
    }
}
