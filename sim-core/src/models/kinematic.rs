//! The kinematic single-track model: no slip (R. Rajamani, *Vehicle Dynamics and Control*, section 2.2).
//!
//! The origin is the centre of the rear axle: `x' = v cos ψ, y' = v sin ψ, ψ' = v tan(δ) / L`. Two actuators stand before it: the
//! acceleration follows its demand with a lag and a bounded jerk, the road-wheel angle with a lag and a bounded rate.
//! Speed, acceleration and road-wheel angle are therefore continuous, and so is what an inertial sensor feels.

use bytemuck::{Pod, Zeroable};
use ipc_schema::config;

use super::{
    parameters::ParameterSet,
    state::{
        ACCEL_RATE_PER_S, ControlInput, MAX_JERK_MPS3, ModelState, STANDSTILL_MPS, STEERING_RATE_PER_S, SubStepMotion,
        rotate, share,
    },
};
use crate::trig::{bound, pick, sin_cos_small, tan_wheel};

/// Largest lateral acceleration of the kinematic model, m/s². It has no tyres; SUMO takes bends within an edge at full speed
/// (14 m/s² on a corner of 18 m radius at 16 m/s), and a mirror that did not would leave the road.
const MAX_LATERAL_MPS2: f64 = 15.0;

/// Parameters of the kinematic model.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct KinematicParams {
    /// Rear axle to front axle, metres.
    pub wheelbase_m: f64,
    /// Largest road-wheel angle, radians.
    pub max_road_wheel_angle_rad: f64,
    /// Largest rate of the road-wheel angle, rad/s.
    pub max_road_wheel_rate_radps: f64,
    /// Largest acceleration, m/s².
    pub max_accel_mps2: f64,
    /// Largest deceleration, m/s².
    pub max_decel_mps2: f64,
    /// Largest lateral acceleration that a driver asks for, m/s².
    pub max_lateral_mps2: f64,
    /// Largest curvature of the rear axle's way, 1/m.
    pub max_curvature_per_m: f64,
}

impl KinematicParams {
    /// The limits of a parameter set, none above the configured ones, on a vehicle with this wheelbase.
    #[must_use]
    pub fn new(set: &ParameterSet, limits: &config::VehicleConfig, wheelbase_m: f64) -> Self {
        let max_road_wheel_angle_rad = set.max_road_wheel_angle_rad.min(limits.max_road_wheel_angle_rad);
        Self {
            wheelbase_m,
            max_curvature_per_m: libm::tan(max_road_wheel_angle_rad) / wheelbase_m,
            max_road_wheel_angle_rad,
            max_road_wheel_rate_radps: set.max_road_wheel_rate_radps.min(limits.max_road_wheel_rate_radps),
            max_accel_mps2: set.max_accel_mps2.min(limits.max_accel_mps2),
            max_decel_mps2: set.max_decel_mps2.min(limits.max_decel_mps2),
            max_lateral_mps2: MAX_LATERAL_MPS2,
        }
    }

    /// Acceleration after `dt_s`: lag, bounded jerk, bounded acceleration.
    #[inline(always)]
    fn accel_after(&self, state: &ModelState, demand_mps2: f64, dt_s: f64) -> f64 {
        let most = MAX_JERK_MPS3 * dt_s;
        let change = bound(
            (demand_mps2 - state.accel_mps2) * share(ACCEL_RATE_PER_S * dt_s),
            -most,
            most,
        );
        bound(state.accel_mps2 + change, -self.max_decel_mps2, self.max_accel_mps2)
    }

    /// Road-wheel angle after `dt_s`: lag, bounded rate, bounded angle.
    #[inline(always)]
    fn road_wheel_angle_after(&self, state: &ModelState, demand_rad: f64, dt_s: f64) -> f64 {
        let most = self.max_road_wheel_rate_radps * dt_s;
        let lag = share(STEERING_RATE_PER_S * dt_s);
        let change = bound((demand_rad - state.road_wheel_angle_rad) * lag, -most, most);
        let angle = state.road_wheel_angle_rad + change;
        bound(angle, -self.max_road_wheel_angle_rad, self.max_road_wheel_angle_rad)
    }

    /// The state after `dt_s`: an exact arc with the mean speed and the curvature half-way (second order in `dt_s`).
    #[must_use]
    #[inline(always)]
    pub fn step(&self, state: &ModelState, input: &ControlInput, dt_s: f64) -> (ModelState, SubStepMotion) {
        let accel = self.accel_after(state, input.accel_mps2, dt_s);
        let speed = state.speed_mps + 0.5 * (state.accel_mps2 + accel) * dt_s;
        let stands = (speed <= 0.0) | ((speed < STANDSTILL_MPS) & (input.accel_mps2 <= 0.0));
        let (speed, accel) = (pick(stands, 0.0, speed), pick(stands, 0.0, accel));
        let angle = self.road_wheel_angle_after(state, input.road_wheel_angle_rad, dt_s);
        let mean_speed = 0.5 * (state.speed_mps + speed);
        let turn = mean_speed * dt_s * tan_wheel(0.5 * (state.road_wheel_angle_rad + angle)) / self.wheelbase_m;
        Self::arc(state, [speed, accel, angle], turn, dt_s)
    }

    /// Moves along an arc that turns by `turn` radians and ends with `[speed, accel, angle]`.
    #[inline(always)]
    fn arc(state: &ModelState, [speed, accel, angle]: [f64; 3], turn: f64, dt_s: f64) -> (ModelState, SubStepMotion) {
        let (sin_half, cos_half) = sin_cos_small(0.5 * turn);
        let half_way = rotate(state.heading, cos_half, sin_half);
        // Chord of an arc: its length times sin(turn/2) / (turn/2).
        let chord = 0.5 * (state.speed_mps + speed) * dt_s * (1.0 - turn * turn * (1.0 / 24.0));
        let rate = 1.0 / dt_s;
        let next = ModelState {
            x_m: state.x_m + chord * half_way[0],
            y_m: state.y_m + chord * half_way[1],
            yaw_rad: state.yaw_rad + turn,
            heading: rotate(half_way, cos_half, sin_half),
            speed_mps: speed,
            accel_mps2: accel,
            road_wheel_angle_rad: angle,
            lateral_mps: 0.0,
            yaw_rate_radps: turn * rate,
            roll: [0.0; 2],
            pitch: [0.0; 2],
        };
        let motion = SubStepMotion {
            accel_level_mps2: [
                (speed - state.speed_mps) * cos_half * rate,
                (speed + state.speed_mps) * sin_half * rate,
            ],
            yaw_rate_radps: turn * rate,
        };
        (next, motion)
    }
}
