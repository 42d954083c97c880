//! The window over SUMO's last states. Their mean is a path that a vehicle can follow, because it bends before the lane does.
//!
//! SUMO's vehicles turn, brake and start from one step to the next; a real one needs time for each. The mean of the last `n` states
//! changes as gradually as a driver with a view of the road ahead steers and brakes, and it never leaves the hull of SUMO's positions. It
//! is `(n − 1) / 2` steps behind the newest state: the mirror sees that much of the path ahead of it.

use ipc_schema::traffic::TrafficState;

use super::{
    prefetch::PrefetchRange,
    reference::{LaneJump, PathJoin, join},
};
use crate::trig::wrap_angle;

/// Longest leap over a junction, metres.
const LEAP_M: f64 = 40.0;
/// Slowest vehicle that leaps over a junction, m/s: a slower one is moved by a script.
const LEAP_MPS: f32 = 0.5;
/// Cosine of the largest angle between a leap and the headings before and after it.
const LEAST_AHEAD: f64 = 0.2;

/// A window whose ends' headings differ by less is straight: its mean is beside it by millimetres at most, radians.
const STRAIGHT_RAD: f64 = 0.005;

/// What is averaged: position of the front bumper (metres), heading without jumps and slope (radians), speed (m/s).
type Sample = [f64; 6];

/// How the path moves in a SUMO step beside the mean's own motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WindowStep {
    /// A lane change in this step. It counts as made long ago: the whole path moves with it.
    pub lane_change: Option<LaneJump>,
}

/// The last states of a road user.
#[derive(Debug, Clone, PartialEq)]
pub struct StateWindow {
    samples: Vec<Sample>,
    /// Lamps of each sample.
    lamps: Vec<u32>,
    /// Place of the oldest sample.
    oldest: usize,
    /// Of all samples.
    sum: Sample,
    mean: TrafficState,
    newest: TrafficState,
}

impl StateWindow {
    /// A window of `count` states, of no road user.
    #[must_use]
    pub fn new(count: usize) -> Self {
        Self {
            samples: vec![[0.0; 6]; count],
            lamps: vec![0; count],
            oldest: 0,
            sum: [0.0; 6],
            mean: TrafficState::default(),
            newest: TrafficState::default(),
        }
    }

    /// The mean; what cannot be averaged is that of the newest state.
    #[must_use]
    pub fn mean(&self) -> &TrafficState {
        &self.mean
    }

    /// Begins with a road user that has come to `now` straight ahead at its speed, in steps of `step_s`.
    pub fn restart(&mut self, now: &TrafficState, step_s: f64) {
        let newest = sample(now);
        let (sin, cos) = libm::sincos(newest[3]);
        let climb = libm::tan(newest[4]);
        let count = self.samples.len();
        for (place, slot) in self.samples.iter_mut().enumerate() {
            let back_m = newest[5] * step_s * (count - 1 - place) as f64;
            *slot = newest;
            slot[0] -= back_m * cos;
            slot[1] -= back_m * sin;
            slot[2] -= back_m * climb;
        }
        self.lamps.fill(now.signals);
        (self.oldest, self.newest) = (0, *now);
        self.sum = [0.0; 6];
        for slot in &self.samples {
            for (total, part) in self.sum.iter_mut().zip(slot) {
                *total += part;
            }
        }
        self.update_mean();
    }

    /// Prefetches what the next state needs.
    #[inline]
    pub fn prefetch(&self) {
        PrefetchRange::new(&self.samples, self.oldest.saturating_sub(1), 2).fetch_all();
        PrefetchRange::new(&self.lamps, 0, self.lamps.len()).fetch_all();
    }

    /// Takes the next state of a body of `length_m`; `None` if no vehicle moves like that.
    pub fn advance(&mut self, now: &TrafficState, length_m: f64, step_s: f64) -> Option<WindowStep> {
        let (joined, jump) = join(&self.newest, now, length_m, step_s);
        if joined == PathJoin::Broken && !leaps_ahead(&self.newest, now) {
            return None;
        }
        if let Some(LaneJump { vector_m, .. }) = jump {
            for slot in &mut self.samples {
                slot[0] += vector_m[0];
                slot[1] += vector_m[1];
            }
            let count = self.samples.len() as f64;
            for (axis, part) in vector_m.into_iter().enumerate() {
                self.sum[axis] += count * part;
            }
        }
        let count = self.samples.len();
        let last_yaw_rad = self.samples[(self.oldest + count - 1) % count][3];
        let mut next = sample(now);
        next[3] = last_yaw_rad + wrap_angle(next[3] - last_yaw_rad);
        let left = std::mem::replace(&mut self.samples[self.oldest], next);
        for (total, (next, left)) in self.sum.iter_mut().zip(next.iter().zip(left)) {
            *total += next - left;
        }
        self.lamps[self.oldest] = now.signals;
        self.oldest = (self.oldest + 1) % count;
        self.newest = *now;
        self.update_mean();
        Some(WindowStep { lane_change: jump })
    }

    /// Distance of the mean from SUMO's own path, the lines between the states in the middle of the window, metres. Zero where the path
    /// is straight.
    #[must_use]
    pub fn deviation_m(&self) -> f64 {
        let (oldest, newest) = (self.oldest, (self.oldest + self.samples.len() - 1) % self.samples.len());
        if (self.samples[newest][3] - self.samples[oldest][3]).abs() < STRAIGHT_RAD {
            return 0.0;
        }
        let mean = &self.mean;
        let point = [mean.front_x_m, mean.front_y_m];
        let count = self.samples.len();
        let at = |place: usize| {
            let sample = self.samples[(self.oldest + place) % count];
            [sample[0], sample[1]]
        };
        // The mean lies beside the middle of the window.
        let first = (count / 2).saturating_sub(1);
        let lines = (first..count.saturating_sub(1).min(first + 2)).map(|place| (at(place), at(place + 1)));
        lines
            .map(|(from, to)| super::reference::distance_m(point, from, to))
            .fold(f64::INFINITY, f64::min)
    }

    fn update_mean(&mut self) {
        let sum = &self.sum;
        let count = self.samples.len();
        let share = 1.0 / count as f64;
        self.mean = TrafficState {
            front_x_m: sum[0] * share,
            front_y_m: sum[1] * share,
            front_z_m: sum[2] * share,
            yaw_rad: wrap_angle(sum[3] * share) as f32,
            pitch_rad: (sum[4] * share) as f32,
            speed_mps: (sum[5] * share) as f32,
            // Lamps are as late as the vehicle: they are those of the middle.
            signals: self.lamps[(self.oldest + (count - 1) / 2) % count],
            ..self.newest
        };
    }
}

/// True if SUMO has moved a vehicle ahead as over a junction without internal lanes: in one step from the end of a lane to the beginning
/// of the next. The mean drives there, and the mirror is late.
fn leaps_ahead(before: &TrafficState, now: &TrafficState) -> bool {
    let leap = [now.front_x_m - before.front_x_m, now.front_y_m - before.front_y_m];
    let length_m = libm::hypot(leap[0], leap[1]);
    let is_ahead = |yaw_rad: f32| {
        let (sin, cos) = libm::sincos(f64::from(yaw_rad));
        leap[0] * cos + leap[1] * sin > LEAST_AHEAD * length_m
    };
    before.speed_mps > LEAP_MPS && length_m < LEAP_M && is_ahead(before.yaw_rad) && is_ahead(now.yaw_rad)
}

fn sample(state: &TrafficState) -> Sample {
    [
        state.front_x_m,
        state.front_y_m,
        state.front_z_m,
        state.yaw_rad.into(),
        state.pitch_rad.into(),
        state.speed_mps.into(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const STEP_S: f64 = 0.1;
    const LENGTH_M: f64 = 4.5;

    fn state(x_m: f64, y_m: f64, yaw_rad: f64, speed_mps: f64) -> TrafficState {
        TrafficState {
            front_x_m: x_m,
            front_y_m: y_m,
            yaw_rad: yaw_rad as f32,
            speed_mps: speed_mps as f32,
            ..TrafficState::default()
        }
    }

    proptest! {
        #[test]
        fn a_straight_drive_is_followed_at_the_same_distance(speed_mps in 1.0_f64..40.0, yaw_rad in -3.0_f64..3.0) {
            let (sin, cos) = libm::sincos(yaw_rad);
            let at = |step: f64| state(speed_mps * step * STEP_S * cos, speed_mps * step * STEP_S * sin, yaw_rad, speed_mps);
            let mut window = StateWindow::new(10);
            window.restart(&at(0.0), STEP_S);
            for step in 0..40 {
                let mean = window.mean();
                let expected = at(f64::from(step) - 4.5);
                let off = (mean.front_x_m - expected.front_x_m).hypot(mean.front_y_m - expected.front_y_m);
                prop_assert!(off < 1e-5 * speed_mps, "step {}: {} m", step, off);
                prop_assert!(window.deviation_m() < 1e-4);
                window.advance(&at(f64::from(step) + 1.0), LENGTH_M, STEP_S).unwrap();
            }
        }
    }

    #[test]
    fn a_lane_change_is_taken_out_of_the_mean_and_reported_once() {
        let mut window = StateWindow::new(10);
        window.restart(&state(0.0, 0.0, 0.0, 20.0), STEP_S);
        for step in 1..30 {
            let y_m = if step >= 5 { 3.2 } else { 0.0 };
            let before_m = window.mean().front_y_m;
            let found = window
                .advance(&state(2.0 * f64::from(step), y_m, 0.0, 20.0), LENGTH_M, STEP_S)
                .unwrap();
            let change_m = found.lane_change.map_or(0.0, |jump| jump.left_m);
            let shift_m = found.lane_change.map_or(0.0, |jump| jump.vector_m[1]);
            assert!(
                (change_m - if step == 5 { 3.2 } else { 0.0 }).abs() < 1e-9,
                "step {step}"
            );
            let sideways = [before_m + shift_m, window.mean().front_y_m];
            assert!(
                sideways.iter().all(|y| (y - y_m).abs() < 1e-9),
                "step {step}: {sideways:?}"
            );
        }
    }

    #[test]
    fn a_bend_is_taken_gradually_and_its_corner_is_cut_by_little() {
        // 7 m/s into a quarter of a circle of 9 m: 5.4 m/s² from one step to the next.
        let (speed, radius) = (7.0, 9.0);
        let at = |step: u32| {
            let along = speed * STEP_S * f64::from(step) - 14.0;
            let angle = (along / radius).clamp(0.0, std::f64::consts::FRAC_PI_2);
            let (sin, cos) = libm::sincos(angle);
            let rest = along - angle * radius;
            state(
                radius * sin + rest * cos,
                radius * (1.0 - cos) + rest * sin,
                angle,
                speed,
            )
        };
        let mut window = StateWindow::new(10);
        window.restart(&at(0), STEP_S);
        let mut mean = *window.mean();
        let (mut chord, mut accel): (Option<[f64; 2]>, Option<[f64; 2]>) = (None, None);
        for step in 1..70 {
            window.advance(&at(step), LENGTH_M, STEP_S).unwrap();
            let next = *window.mean();
            let now = [
                (next.front_x_m - mean.front_x_m) / STEP_S,
                (next.front_y_m - mean.front_y_m) / STEP_S,
            ];
            let rate = chord.map(|before| [0, 1].map(|i: usize| (now[i] - before[i]) / STEP_S));
            if let (Some(before), Some(rate)) = (accel, rate) {
                let jerk = (rate[0] - before[0]).hypot(rate[1] - before[1]) / STEP_S;
                assert!(jerk < 8.0, "step {step}: {jerk} m/s³");
            }
            assert!(window.deviation_m() < 0.3, "step {step}: {} m", window.deviation_m());
            (mean, chord, accel) = (next, Some(now), rate.or(accel));
        }
    }
}
