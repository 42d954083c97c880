//! Path tracking: the demand that keeps a vehicle's front bumper on its reference path.
//!
//! Input/output linearisation of the front bumper P, `d` ahead of the rear axle (A. De Luca, G. Oriolo and M. Vendittelli,
//! *Control of wheeled mobile robots*, 2001, section 4): `P' = v t + d ψ' n` with t along and n across the heading, so any
//! wanted P' fixes speed and yaw rate: `v = P'·t`, `ψ' = P'·n / d`. The wanted P' is the path's velocity plus a gain on the
//! error. The curvature `ψ' / v = tan β / d` depends only on the direction β of P' in the body, which keeps its meaning
//! down to walking pace; below [`HOLD_MPS`] the wheels are held.
//!
//! With tyres ([`DynamicParams`]) P is reached through forces. Its lateral acceleration is `Yf (1 + x m/I lf) + Yr (1 − x m/I lr)`
//! with P `x` ahead of the centre of gravity: the front force that gives a wanted acceleration, and from the tyre's inverse the
//! angle at which the front wheel must stand against its own velocity, follow at once. The error of P then obeys
//! `e'' + 2 ω e' + ω² e = 0`; what is left, the yaw about P, is a damped oscillation (`ω₀² = m/I L C N / (1 + x m/I lf)`, damped by
//! `ω₀² d / v`), because P lies ahead of the centre of percussion.

use super::curve::ReferencePoint;
use crate::{
    models::{
        dynamic::{DynamicParams, GRAVITY_MPS2, SLIP_SPEED_MPS, inverses},
        kinematic::KinematicParams,
        state::{ACCEL_RATE_PER_S, ControlInput, MAX_JERK_MPS3, ModelState},
    },
    trig::{atan_demand, bound, larger, pick, smaller},
};

/// Gain of the longitudinal error, 1/s. With [`SPEED_GAIN_PER_S`] and the model's lag of 12/s: three poles at −4/s.
const POSITION_GAIN_PER_S: f64 = 4.0 / 3.0;
/// Gain of the speed error, 1/s.
const SPEED_GAIN_PER_S: f64 = 4.0;
/// Largest change of the wanted speed by a position error, m/s.
const MAX_CATCH_UP_MPS: f64 = 3.0;
/// Gain of the lateral error, 1/s.
const LATERAL_GAIN_PER_S: f64 = 2.5;
/// Below this speed the lateral error is corrected per distance instead of per time, m/s.
const LOW_SPEED_MPS: f64 = 3.0;
/// Largest tan β: 55°.
const MAX_TAN_BETA: f64 = 1.43;
/// ω of the lateral error of a vehicle with tyres, 1/s.
const LATERAL_FREQUENCY_PER_S: f64 = 4.0;
/// Below this speed a vehicle with tyres is steered as if it rolled without slip, at twice this speed by its forces alone, m/s.
const ROLLING_MPS: f64 = 2.0;
/// Share of the friction that tracking uses: the rest keeps the tyres' slip small.
const FRICTION_SHARE: f64 = 0.9;
/// Below this speed of vehicle or path the wheels are held, m/s.
const HOLD_MPS: f64 = 0.05;
/// A standing vehicle starts only when its path moves at [`HOLD_MPS`] or is this far ahead, metres.
const START_M: f64 = 0.5;
/// Jerk with which a stop ends, m/s³.
const STOP_JERK_MPS3: f64 = 0.25 * MAX_JERK_MPS3;
/// Deceleration in the last moment before standstill, m/s².
const LEAST_STOPPING_MPS2: f64 = 0.1;

/// The parameters that the tracker needs of a vehicle, for every model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackedVehicle {
    /// Rear axle to front bumper, metres.
    pub front_m: f64,
    /// Rear axle to front axle, metres.
    pub wheelbase_m: f64,
    /// Largest acceleration, m/s².
    pub max_accel_mps2: f64,
    /// Largest deceleration, m/s².
    pub max_decel_mps2: f64,
    /// Largest lateral acceleration, m/s².
    pub max_lateral_mps2: f64,
}

impl TrackedVehicle {
    /// A vehicle of the kinematic model with its front bumper `front_m` ahead of the rear axle.
    #[must_use]
    #[inline(always)]
    pub fn new(params: &KinematicParams, front_m: f64) -> Self {
        Self {
            front_m,
            wheelbase_m: params.wheelbase_m,
            max_accel_mps2: params.max_accel_mps2,
            max_decel_mps2: params.max_decel_mps2,
            max_lateral_mps2: params.max_lateral_mps2,
        }
    }
}

/// Reference minus front bumper in the body frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TrackingError {
    /// Positive ahead, metres.
    pub longitudinal_m: f64,
    /// Positive to the left, metres.
    pub lateral_m: f64,
}

/// How far the front bumper, `front_m` ahead of the rear axle, is from its target.
#[must_use]
#[inline(always)]
pub fn error(state: &ModelState, front_m: f64, target: &ReferencePoint) -> TrackingError {
    let front = state.point_ahead(front_m);
    let [cos, sin] = state.heading;
    let (dx, dy) = (target.position_m[0] - front[0], target.position_m[1] - front[1]);
    TrackingError {
        longitudinal_m: dx * cos + dy * sin,
        lateral_m: dy * cos - dx * sin,
    }
}

/// The demand that brings the front bumper onto its target.
#[must_use]
#[inline(always)]
pub fn demand(driven: &TrackedVehicle, state: &ModelState, target: &ReferencePoint) -> ControlInput {
    let error = error(state, driven.front_m, target);
    let [cos, sin] = state.heading;
    let [vx, vy] = target.velocity_mps;
    let (along, across) = (vx * cos + vy * sin, vy * cos - vx * sin);
    ControlInput {
        accel_mps2: accel_demand(driven, state, target.accel_mps2, along, error.longitudinal_m),
        road_wheel_angle_rad: steering_demand(driven, state, [along, across], error.lateral_m),
    }
}

/// Acceleration from the wanted speed: never backwards, at rest when the path rests, with a soft end of every stop.
#[inline(always)]
fn accel_demand(driven: &TrackedVehicle, state: &ModelState, path_accel: f64, along: f64, ahead_m: f64) -> f64 {
    let catch_up = bound(POSITION_GAIN_PER_S * ahead_m, -MAX_CATCH_UP_MPS, MAX_CATCH_UP_MPS);
    let wanted = along + catch_up;
    let path_rests = (along < HOLD_MPS) & (ahead_m < START_M);
    let stays = (state.speed_mps == 0.0) & (path_rests | (wanted < HOLD_MPS));
    // A vehicle that is too far ahead waits: it does not follow the path's acceleration.
    let path_accel = pick(wanted <= 0.0, smaller(path_accel, 0.0), path_accel);
    let demand = path_accel + SPEED_GAIN_PER_S * (larger(wanted, 0.0) - state.speed_mps);
    let least = smaller(stopping_decel(state), driven.max_decel_mps2);
    pick(stays, 0.0, bound(demand, -least, driven.max_accel_mps2))
}

/// Deceleration that reaches zero together with the speed, at constant jerk, m/s². It uses the speed that remains when
/// the actuator, which lags, has followed.
#[inline(always)]
fn stopping_decel(state: &ModelState) -> f64 {
    let left_mps = state.speed_mps + smaller(state.accel_mps2, 0.0) * (1.0 / ACCEL_RATE_PER_S);
    larger(
        (2.0 * STOP_JERK_MPS3 * larger(left_mps, 0.0)).sqrt(),
        LEAST_STOPPING_MPS2,
    )
}

/// Road-wheel angle from the direction in which the front bumper should move.
#[inline(always)]
fn steering_demand(driven: &TrackedVehicle, state: &ModelState, [along, across]: [f64; 2], left_m: f64) -> f64 {
    let holds = (state.speed_mps < HOLD_MPS) | (along < HOLD_MPS);
    let feed_forward = across / larger(along, 0.5 * across.abs());
    let pace = 1.0 / larger(state.speed_mps, LOW_SPEED_MPS);
    let tan_beta = bound(
        feed_forward + LATERAL_GAIN_PER_S * left_m * pace,
        -MAX_TAN_BETA,
        MAX_TAN_BETA,
    );
    let most = driven.max_lateral_mps2 * pace * pace;
    let curvature_per_m = bound(tan_beta / driven.front_m, -most, most);
    let angle = atan_demand(driven.wheelbase_m * curvature_per_m);
    pick(holds, state.road_wheel_angle_rad, angle)
}

/// The demand that brings the front bumper, `front_m` ahead of the rear axle, of a vehicle with tyres onto its target.
#[must_use]
#[inline(always)]
pub fn demand_with_tyres(
    params: &DynamicParams,
    front_m: f64,
    state: &ModelState,
    target: &ReferencePoint,
) -> ControlInput {
    let error = error(state, front_m, target);
    let [cos, sin] = state.heading;
    let [vx, vy] = target.velocity_mps;
    let along = vx * cos + vy * sin;
    let driven = TrackedVehicle {
        front_m,
        wheelbase_m: params.wheelbase_m,
        max_accel_mps2: params.max_accel_mps2,
        max_decel_mps2: params.max_decel_mps2,
        max_lateral_mps2: FRICTION_SHARE * params.friction * GRAVITY_MPS2,
    };
    let closing = vy * cos - vx * sin - (state.lateral_mps + front_m * state.yaw_rate_radps);
    let bend = target.bend_mps2[1] * cos - target.bend_mps2[0] * sin;
    let frequency = LATERAL_FREQUENCY_PER_S * smaller(state.speed_mps * (1.0 / LOW_SPEED_MPS), 1.0);
    let wanted = bend + frequency * (2.0 * closing + frequency * error.lateral_m);
    let wanted = bound(wanted, -driven.max_lateral_mps2, driven.max_lateral_mps2);
    let across = vy * cos - vx * sin;
    let rolling = steering_demand(&driven, state, [along, across], error.lateral_m);
    let slipping = angle_for(params, state, wanted);
    let share = bound((state.speed_mps - ROLLING_MPS) * (1.0 / ROLLING_MPS), 0.0, 1.0);
    ControlInput {
        accel_mps2: accel_demand(&driven, state, target.accel_mps2, along, error.longitudinal_m),
        road_wheel_angle_rad: rolling + share * (slipping - rolling),
    }
}

/// Road-wheel angle that accelerates the front bumper to the left by `wanted_mps2`.
#[inline(always)]
fn angle_for(params: &DynamicParams, state: &ModelState, wanted_mps2: f64) -> f64 {
    let loads = params.loads_mps2(state.accel_mps2);
    let moving = 1.0 / larger(state.speed_mps, HOLD_MPS);
    let pace = larger(state.speed_mps, SLIP_SPEED_MPS) * moving;
    let rear_linear =
        -params.stiffness_per_rad[1] * loads[1] * state.lateral_mps * smaller(moving, 1.0 / SLIP_SPEED_MPS);
    let rear_most = params.friction * loads[1];
    let rear_square = rear_most * rear_most;
    let [front_inverse, rear_inverse] = inverses(params.friction * loads[0], rear_square + rear_linear * rear_linear);
    let rear = rear_linear * (rear_square * rear_inverse).sqrt();
    let front = (wanted_mps2 - rear * params.bumper[1]) * params.bumper[0];
    let share = bound(front * front_inverse, -FRICTION_SHARE, FRICTION_SHARE);
    let slip = share * params.friction / (params.stiffness_per_rad[0] * (1.0 - share * share).sqrt());
    let direction = atan_demand((state.lateral_mps + params.wheelbase_m * state.yaw_rate_radps) * moving);
    direction + slip * pace
}
