//! The motion that an inertial sensor in the body measures, from the motion of the body's origin and the body's roll and pitch.
//!
//! `world_from_body = Rz(ψ) Ry(−θ) Rx(φ)` with yaw ψ, pitch θ (positive nose up) and roll φ (positive right side down). Values
//! are means over a sub-step, turned with the angles half-way: integrating them gives the motion again.

use super::state::{ModelState, SubStepMotion};
use crate::trig::sin_cos_small;

/// Roll and pitch, radians.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct BodyLean {
    /// Positive right side down.
    pub roll_rad: f64,
    /// Positive nose up, road's slope included.
    pub pitch_rad: f64,
}

impl BodyLean {
    /// Roll and pitch of a vehicle on a road with this slope (positive uphill, radians).
    #[must_use]
    #[inline(always)]
    pub fn of(state: &ModelState, slope_rad: f64) -> Self {
        Self {
            roll_rad: state.roll[0],
            pitch_rad: state.pitch[0] + slope_rad,
        }
    }
}

/// Acceleration and angular rate in one sub-step, in the body's axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeltMotion {
    /// Kinematic acceleration, m/s².
    pub accel_mps2: [f64; 3],
    /// Angular rate, rad/s.
    pub rate_radps: [f64; 3],
}

impl FeltMotion {
    /// From the leans at both ends of a sub-step of `1 / rate_per_s`, the motion in the plane, and the upward acceleration (m/s²).
    #[must_use]
    #[inline(always)]
    pub fn new([before, after]: [BodyLean; 2], motion: &SubStepMotion, up_mps2: f64, rate_per_s: f64) -> Self {
        let [along, left] = motion.accel_level_mps2;
        Self {
            accel_mps2: body_from_level(&half_way(&before, &after), [along, left, up_mps2]),
            rate_radps: angular_rate(&before, &after, motion.yaw_rate_radps, rate_per_s),
        }
    }
}

/// `vector` (along the heading, to the left, up) in the axes of a body that leans.
#[must_use]
#[inline(always)]
pub fn body_from_level(lean: &BodyLean, vector: [f64; 3]) -> [f64; 3] {
    let (sin_pitch, cos_pitch) = sin_cos_small(lean.pitch_rad);
    let (sin_roll, cos_roll) = sin_cos_small(lean.roll_rad);
    let [along, left, up] = vector;
    let normal = cos_pitch * up - sin_pitch * along;
    [
        cos_pitch * along + sin_pitch * up,
        cos_roll * left + sin_roll * normal,
        cos_roll * normal - sin_roll * left,
    ]
}

/// Angular rate in the axes of the body, rad/s, from the rate of yaw and the change from one lean to the other in `1 / rate_per_s`.
#[must_use]
#[inline(always)]
fn angular_rate(before: &BodyLean, after: &BodyLean, yaw_rate_radps: f64, rate_per_s: f64) -> [f64; 3] {
    let roll_rate = (after.roll_rad - before.roll_rad) * rate_per_s;
    let pitch_rate = (after.pitch_rad - before.pitch_rad) * rate_per_s;
    let between = half_way(before, after);
    let (sin_pitch, cos_pitch) = sin_cos_small(between.pitch_rad);
    let (sin_roll, cos_roll) = sin_cos_small(between.roll_rad);
    [
        roll_rate + yaw_rate_radps * sin_pitch,
        yaw_rate_radps * cos_pitch * sin_roll - pitch_rate * cos_roll,
        yaw_rate_radps * cos_pitch * cos_roll + pitch_rate * sin_roll,
    ]
}

/// The mean of two leans.
#[must_use]
#[inline(always)]
fn half_way(before: &BodyLean, after: &BodyLean) -> BodyLean {
    BodyLean {
        roll_rad: 0.5 * (before.roll_rad + after.roll_rad),
        pitch_rad: 0.5 * (before.pitch_rad + after.pitch_rad),
    }
}
