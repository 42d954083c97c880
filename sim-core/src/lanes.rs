//! Many vehicles at once: the tracker and the kinematic model on [`LANES`] vehicles side by side, for all sub-steps of a tick.
//!
//! One vehicle alone is a chain of some 300 dependent operations in each sub-step, which the processor waits for: 0.7 µs per
//! tick of 10 sub-steps, measured. Side by side they fill its vector units: the whole mirror, reading and writing included,
//! then takes 0.34 µs with SSE2 and 0.18 µs with AVX-512. The functions are those of [`crate::tracking`] and
//! [`crate::vehicle`], no operation is fused or reordered, so every vehicle gets the same bits as alone, on any machine.

use ipc_schema::config;

use crate::{
    curve::Curve,
    tracking::{self, Driven},
    vehicle::{KinematicParams, State},
};

/// Vehicles side by side: two registers of AVX-512 or eight of SSE2 for each number.
pub const LANES: usize = 16;

type Lane = [f64; LANES];

/// Motion of all lanes over one sub-step, with the state at its end.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Row {
    /// Rear axle, metres.
    pub x_m: Lane,
    /// Rear axle, metres.
    pub y_m: Lane,
    /// Radians, not wrapped.
    pub yaw_rad: Lane,
    /// m/s.
    pub speed_mps: Lane,
    /// Forward, m/s².
    pub accel_x_mps2: Lane,
    /// To the left, m/s².
    pub accel_y_mps2: Lane,
    /// rad/s.
    pub yaw_rate_radps: Lane,
    /// Radians.
    pub road_wheel_angle_rad: Lane,
}

/// Vehicles side by side.
#[derive(Debug, Clone)]
pub struct Lanes {
    x_m: Lane,
    y_m: Lane,
    yaw_rad: Lane,
    heading: [Lane; 2],
    speed_mps: Lane,
    accel_mps2: Lane,
    road_wheel_angle_rad: Lane,
    start_m: [Lane; 2],
    cubic: [[Lane; 2]; 3],
    path_accel_mps2: Lane,
    front_m: Lane,
    wheelbase_m: Lane,
    /// What moved, one for each sub-step.
    pub rows: Vec<Row>,
}

impl Lanes {
    /// Empty lanes for `sub_steps` sub-steps.
    #[must_use]
    pub fn new(sub_steps: usize) -> Self {
        // Empty lanes compute too: a body of one metre keeps their numbers finite.
        let zero = [0.0; LANES];
        Self {
            x_m: zero,
            y_m: zero,
            yaw_rad: zero,
            heading: [[1.0; LANES], zero],
            speed_mps: zero,
            accel_mps2: zero,
            road_wheel_angle_rad: zero,
            start_m: [zero; 2],
            cubic: [[zero; 2]; 3],
            path_accel_mps2: zero,
            front_m: [1.0; LANES],
            wheelbase_m: [1.0; LANES],
            rows: vec![Row::default(); sub_steps],
        }
    }

    /// Puts a vehicle and its reference into a lane.
    pub fn load(&mut self, lane: usize, state: &State, curve: &Curve, front_m: f64, wheelbase_m: f64) {
        self.x_m[lane] = state.x_m;
        self.y_m[lane] = state.y_m;
        self.yaw_rad[lane] = state.yaw_rad;
        self.speed_mps[lane] = state.speed_mps;
        self.accel_mps2[lane] = state.accel_mps2;
        self.road_wheel_angle_rad[lane] = state.road_wheel_angle_rad;
        self.path_accel_mps2[lane] = curve.accel_mps2;
        self.front_m[lane] = front_m;
        self.wheelbase_m[lane] = wheelbase_m;
        for axis in 0..2 {
            self.heading[axis][lane] = state.heading[axis];
            self.start_m[axis][lane] = curve.start_m[axis];
            for power in 0..3 {
                self.cubic[power][axis][lane] = curve.cubic[power][axis];
            }
        }
    }

    /// The state of the vehicle in a lane.
    #[must_use]
    #[inline(always)]
    pub fn state(&self, lane: usize) -> State {
        State {
            x_m: self.x_m[lane],
            y_m: self.y_m[lane],
            yaw_rad: self.yaw_rad[lane],
            heading: [self.heading[0][lane], self.heading[1][lane]],
            speed_mps: self.speed_mps[lane],
            accel_mps2: self.accel_mps2[lane],
            road_wheel_angle_rad: self.road_wheel_angle_rad[lane],
        }
    }

    #[inline(always)]
    fn set_state(&mut self, lane: usize, state: &State) {
        self.x_m[lane] = state.x_m;
        self.y_m[lane] = state.y_m;
        self.yaw_rad[lane] = state.yaw_rad;
        self.heading[0][lane] = state.heading[0];
        self.heading[1][lane] = state.heading[1];
        self.speed_mps[lane] = state.speed_mps;
        self.accel_mps2[lane] = state.accel_mps2;
        self.road_wheel_angle_rad[lane] = state.road_wheel_angle_rad;
    }

    /// The reference of the vehicle in a lane.
    #[must_use]
    #[inline(always)]
    pub fn curve(&self, lane: usize) -> Curve {
        let at = |pair: &[Lane; 2]| [pair[0][lane], pair[1][lane]];
        Curve {
            start_m: at(&self.start_m),
            cubic: [at(&self.cubic[0]), at(&self.cubic[1]), at(&self.cubic[2])],
            accel_mps2: self.path_accel_mps2[lane],
        }
    }

    /// Tracks all lanes through one tick of `rows.len()` sub-steps, with the widest vectors this machine has.
    pub fn advance(&mut self, limits: &config::Vehicle, dt_s: f64) {
        #[cfg(target_arch = "x86_64")]
        #[expect(
            unsafe_code,
            reason = "calls of functions compiled for more than the baseline processor: twice as fast"
        )]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has been asked in this very condition and has the feature.
                return unsafe { self.advance_avx512(limits, dt_s) };
            }
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: as above.
                return unsafe { self.advance_avx2(limits, dt_s) };
            }
        }
        self.advance_here(limits, dt_s);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    fn advance_avx512(&mut self, limits: &config::Vehicle, dt_s: f64) {
        self.advance_here(limits, dt_s);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn advance_avx2(&mut self, limits: &config::Vehicle, dt_s: f64) {
        self.advance_here(limits, dt_s);
    }

    /// The same code for every processor: compiled anew into each caller.
    #[inline(always)]
    fn advance_here(&mut self, limits: &config::Vehicle, dt_s: f64) {
        let mut rows = std::mem::take(&mut self.rows);
        for (index, row) in rows.iter_mut().enumerate() {
            self.sub_step(limits, index as f64 * dt_s, dt_s, row);
        }
        self.rows = rows;
    }

    /// One sub-step of all lanes: the loop that the compiler turns into vector instructions.
    #[inline(always)]
    fn sub_step(&mut self, limits: &config::Vehicle, time_s: f64, dt_s: f64, row: &mut Row) {
        for lane in 0..LANES {
            let state = self.state(lane);
            let params = KinematicParams::new(limits, self.wheelbase_m[lane]);
            let driven = Driven::new(&params, self.front_m[lane]);
            let input = tracking::demand(&driven, &state, &self.curve(lane).at(time_s));
            let (next, motion) = params.step(&state, &input, dt_s);
            self.set_state(lane, &next);
            row.x_m[lane] = next.x_m;
            row.y_m[lane] = next.y_m;
            row.yaw_rad[lane] = next.yaw_rad;
            row.speed_mps[lane] = next.speed_mps;
            row.accel_x_mps2[lane] = motion.accel_body_mps2[0];
            row.accel_y_mps2[lane] = motion.accel_body_mps2[1];
            row.yaw_rate_radps[lane] = motion.yaw_rate_radps;
            row.road_wheel_angle_rad[lane] = next.road_wheel_angle_rad;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vehicle::Motion;
    use proptest::prelude::*;

    fn limits() -> config::Vehicle {
        config::Vehicle {
            cav_model: config::VehicleModel::Kinematic,
            other_model: config::VehicleModel::Kinematic,
            hero_model: config::VehicleModel::Kinematic,
            class_models: Vec::new(),
            lane_change_s: 3.0,
            max_road_wheel_angle_rad: 0.6,
            max_road_wheel_rate_radps: 1.0,
            max_accel_mps2: 5.0,
            max_decel_mps2: 9.0,
            steering_ratio: 15.0,
            resynchronise_m: 5.0,
        }
    }

    fn vehicle() -> impl Strategy<Value = (State, Curve, f64, f64)> {
        let state = (
            -3.1_f64..3.1,
            prop_oneof![Just(0.0), 0.0_f64..40.0],
            -9.0_f64..5.0,
            -0.6_f64..0.6,
        );
        let curve = prop::array::uniform4(-15.0_f64..15.0);
        (state, curve, 1.0_f64..15.0, 0.5_f64..10.0).prop_map(|((yaw, speed, accel, angle), c, front, wheelbase)| {
            let state = State {
                accel_mps2: accel,
                road_wheel_angle_rad: angle,
                ..State::new(5.0, -7.0, yaw, speed)
            };
            let start = state.point_ahead(front);
            let curve = Curve::hermite(
                [start[0] + 0.1 * c[0], start[1]],
                [c[1], c[2]],
                [[c[2], c[3]], [c[0], c[1]]],
                0.7,
            );
            (state, curve, front, wheelbase)
        })
    }

    /// The same vehicle alone: tracker and model one after the other.
    fn alone(
        mut state: State,
        curve: &Curve,
        front_m: f64,
        wheelbase_m: f64,
        sub_steps: usize,
    ) -> Vec<(State, Motion)> {
        let params = KinematicParams::new(&limits(), wheelbase_m);
        let driven = Driven::new(&params, front_m);
        (0..sub_steps)
            .map(|index| {
                let input = tracking::demand(&driven, &state, &curve.at(index as f64 * 0.01));
                let (next, motion) = params.step(&state, &input, 0.01);
                state = next;
                (next, motion)
            })
            .collect()
    }

    proptest! {
        #[test]
        fn side_by_side_gives_the_same_bits_as_alone(vehicles in prop::collection::vec(vehicle(), 1..=LANES)) {
            let mut lanes = Lanes::new(10);
            for (lane, (state, curve, front_m, wheelbase_m)) in vehicles.iter().enumerate() {
                lanes.load(lane, state, curve, *front_m, *wheelbase_m);
            }
            let mut baseline = lanes.clone();
            lanes.advance(&limits(), 0.01);
            baseline.advance_here(&limits(), 0.01);
            prop_assert_eq!(&lanes.rows, &baseline.rows, "whatever the processor's vectors");
            for (lane, (state, curve, front_m, wheelbase_m)) in vehicles.iter().enumerate() {
                let steps = alone(*state, curve, *front_m, *wheelbase_m, 10);
                for ((state, motion), row) in steps.iter().zip(&lanes.rows) {
                    prop_assert_eq!(state.x_m.to_bits(), row.x_m[lane].to_bits());
                    prop_assert_eq!(state.yaw_rad.to_bits(), row.yaw_rad[lane].to_bits());
                    prop_assert_eq!(motion.accel_body_mps2[0].to_bits(), row.accel_x_mps2[lane].to_bits());
                    prop_assert_eq!(motion.accel_body_mps2[1].to_bits(), row.accel_y_mps2[lane].to_bits());
                }
                prop_assert_eq!(steps[9].0, lanes.state(lane));
            }
        }
    }
}
