//! The values that every vehicle model shares: its state, its control input, and its motion over a sub-step.

use bytemuck::{Pod, Zeroable};

use crate::trig::{smaller, wrap_angle};

/// Largest jerk of any vehicle, m/s³: a full brake application builds up 9 m/s² in about 0.3 s.
pub const MAX_JERK_MPS3: f64 = 30.0;
/// Rate at which the acceleration follows its demand, 1/s.
pub const ACCEL_RATE_PER_S: f64 = 12.0;
/// Rate at which the road wheels follow their demand, 1/s.
pub const STEERING_RATE_PER_S: f64 = 20.0;
/// Below this speed a vehicle that does not want to move stands, m/s.
pub(crate) const STANDSTILL_MPS: f64 = 0.002;

/// State of a vehicle. World frame; origin of the body at the centre of the rear axle on the ground.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct ModelState {
    /// Metres.
    pub x_m: f64,
    /// Metres.
    pub y_m: f64,
    /// Heading, counter-clockwise from east, radians; not wrapped within a tick.
    pub yaw_rad: f64,
    /// Cosine and sine of the heading: stored because a sub-step needs them several times.
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

impl ModelState {
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

/// The demand of a driver or tracker.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ControlInput {
    /// Longitudinal acceleration, m/s².
    pub accel_mps2: f64,
    /// Road-wheel angle, positive to the left, radians.
    pub road_wheel_angle_rad: f64,
}

/// The mean motion of the origin over one sub-step, as an inertial sensor there integrates it. `R(ψ) · accel · dt`, ψ half-way, is exactly the change of the velocity; `yaw_rate · dt` that of the heading.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SubStepMotion {
    /// Kinematic acceleration along the heading and to the left, in the horizontal plane, m/s².
    pub accel_level_mps2: [f64; 2],
    /// Yaw rate, rad/s.
    pub yaw_rate_radps: f64,
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
