//! Vehicle models: pure functions of (parameters, state, input, dt).
//!
//! The kinematic single-track model (no slip; R. Rajamani, *Vehicle Dynamics and Control*, section 2.2) with its origin at
//! the centre of the rear axle: `x' = v cos ψ, y' = v sin ψ, ψ' = v tan(δ) / L`. Two actuators stand before it: the
//! acceleration follows its demand with a lag and a bounded jerk, the road-wheel angle with a lag and a bounded rate.
//! Speed, acceleration and road-wheel angle are therefore continuous, and so is what an inertial sensor feels.
//!
//! [`crate::dynamic`] has the model with tyres. The functions here are free of branches and library calls so that [`crate::lanes`] can run them on many vehicles at
//! once; one vehicle alone gives the same bits.

use bytemuck::{Pod, Zeroable};
use ipc_schema::config;

use crate::trig::{bound, pick, sin_cos_small, smaller, tan_wheel, wrap_angle};
use crate::{dynamic::DynamicParams, parameters::Set};

/// Largest jerk of any vehicle, m/s³: a full brake application builds up 9 m/s² in about 0.3 s.
pub const MAX_JERK_MPS3: f64 = 30.0;
/// Rate at which the acceleration follows its demand, 1/s.
pub const ACCEL_RATE_PER_S: f64 = 12.0;
/// Rate at which the road wheels follow their demand, 1/s.
pub const STEERING_RATE_PER_S: f64 = 20.0;
/// Largest lateral acceleration of the kinematic model, m/s². It has no tyres; SUMO takes bends within an edge at full speed
/// (14 m/s² on a corner of 18 m radius at 16 m/s), and a mirror that refused would leave the road.
const MAX_LATERAL_MPS2: f64 = 15.0;
/// Below this speed a vehicle that does not want to move stands, m/s.
pub(crate) const STANDSTILL_MPS: f64 = 0.002;

/// State of a vehicle. World frame; origin of the body at the centre of the rear axle on the ground.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct State {
    /// Metres.
    pub x_m: f64,
    /// Metres.
    pub y_m: f64,
    /// Heading, counter-clockwise from east, radians; not wrapped while a tick is under way.
    pub yaw_rad: f64,
    /// Cosine and sine of the heading: carried along because they are needed several times in a sub-step.
    pub heading: [f64; 2],
    /// Speed along the body's x, never negative, m/s.
    pub speed_mps: f64,
    /// Derivative of the speed, m/s².
    pub accel_mps2: f64,
    /// Road-wheel angle, positive to the left, radians.
    pub road_wheel_angle_rad: f64,
    /// Speed of the rear axle to the left, m/s: zero without slip.
    pub lateral_mps: f64,
    /// Yaw rate, rad/s.
    pub yaw_rate_radps: f64,
    /// Roll of the body on its springs, positive to the right side down, and its rate: rad and rad/s.
    pub roll: [f64; 2],
    /// Pitch of the body on its springs against the road, positive nose up, and its rate: rad and rad/s.
    pub pitch: [f64; 2],
}

impl State {
    /// A vehicle that rolls straight ahead.
    #[must_use]
    pub fn new(x_m: f64, y_m: f64, yaw_rad: f64, speed_mps: f64) -> Self {
        let (sin, cos) = libm::sincos(yaw_rad);
        let heading = [cos, sin];
        Self {
            x_m,
            y_m,
            yaw_rad: wrap_angle(yaw_rad),
            heading,
            speed_mps,
            accel_mps2: 0.0,
            road_wheel_angle_rad: 0.0,
            lateral_mps: 0.0,
            yaw_rate_radps: 0.0,
            roll: [0.0; 2],
            pitch: [0.0; 2],
        }
    }

    /// The same state with the heading wrapped and its cosine and sine of length one again: once a tick is often enough
    /// (a sub-step leaves an error of 1e-16).
    #[must_use]
    pub fn settled(mut self) -> Self {
        let [cos, sin] = self.heading;
        let factor = 1.5 - 0.5 * (cos * cos + sin * sin);
        self.heading = [cos * factor, sin * factor];
        self.yaw_rad = wrap_angle(self.yaw_rad);
        self
    }

    /// Position `ahead_m` in front of the rear axle, metres.
    #[must_use]
    #[inline]
    pub fn point_ahead(&self, ahead_m: f64) -> [f64; 2] {
        [
            self.x_m + ahead_m * self.heading[0],
            self.y_m + ahead_m * self.heading[1],
        ]
    }
}

/// What a driver asks for.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Input {
    /// Longitudinal acceleration, m/s².
    pub accel_mps2: f64,
    /// Road-wheel angle, positive to the left, radians.
    pub road_wheel_angle_rad: f64,
}

/// What an inertial sensor at the origin integrates over one sub-step, divided by the sub-step: means, not values at an
/// instant. `R(ψ) · accel · dt`, ψ half-way, is exactly the change of the velocity; `yaw_rate · dt` that of the heading.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// Kinematic acceleration along the heading and to the left, in the horizontal plane, m/s².
    pub accel_level_mps2: [f64; 2],
    /// Yaw rate, rad/s.
    pub yaw_rate_radps: f64,
}

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
    pub fn new(set: &Set, limits: &config::Vehicle, wheelbase_m: f64) -> Self {
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
    fn accel_after(&self, state: &State, demand_mps2: f64, dt_s: f64) -> f64 {
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
    fn road_wheel_angle_after(&self, state: &State, demand_rad: f64, dt_s: f64) -> f64 {
        let most = self.max_road_wheel_rate_radps * dt_s;
        let lag = share(STEERING_RATE_PER_S * dt_s);
        let change = bound((demand_rad - state.road_wheel_angle_rad) * lag, -most, most);
        let angle = state.road_wheel_angle_rad + change;
        bound(angle, -self.max_road_wheel_angle_rad, self.max_road_wheel_angle_rad)
    }

    /// The state after `dt_s`: an exact arc with the mean speed and the curvature half-way (second order in `dt_s`).
    #[must_use]
    #[inline(always)]
    pub fn step(&self, state: &State, input: &Input, dt_s: f64) -> (State, Motion) {
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
    fn arc(state: &State, [speed, accel, angle]: [f64; 3], turn: f64, dt_s: f64) -> (State, Motion) {
        let (sin_half, cos_half) = sin_cos_small(0.5 * turn);
        let half_way = rotate(state.heading, cos_half, sin_half);
        // Chord of an arc: its length times sin(turn/2) / (turn/2).
        let chord = 0.5 * (state.speed_mps + speed) * dt_s * (1.0 - turn * turn * (1.0 / 24.0));
        let rate = 1.0 / dt_s;
        let next = State {
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
        let motion = Motion {
            accel_level_mps2: [
                (speed - state.speed_mps) * cos_half * rate,
                (speed + state.speed_mps) * sin_half * rate,
            ],
            yaw_rate_radps: turn * rate,
        };
        (next, motion)
    }
}

/// Share of a lag that passes in one sub-step.
#[inline(always)]
pub(crate) fn share(rate: f64) -> f64 {
    smaller(rate, 1.0)
}

#[inline(always)]
pub(crate) fn rotate(direction: [f64; 2], cos: f64, sin: f64) -> [f64; 2] {
    [
        direction[0] * cos - direction[1] * sin,
        direction[0] * sin + direction[1] * cos,
    ]
}

/// A vehicle model with its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Model {
    /// Kinematic single-track model.
    Kinematic(KinematicParams),
    /// Single-track model with tyres, load transfer, roll and pitch.
    Dynamic(DynamicParams),
}

impl Model {
    /// The state after `dt_s` seconds of `input`, and what moved on the way.
    #[must_use]
    pub fn step(&self, state: &State, input: &Input, dt_s: f64) -> (State, Motion) {
        match self {
            Self::Kinematic(params) => params.step(state, input, dt_s),
            Self::Dynamic(params) => params.step(state, input, 0.0, dt_s),
        }
    }
}
