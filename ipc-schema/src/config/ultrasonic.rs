//! Ultrasonic sensors in the bumpers. Equations and sources: docs/sensor-models.md.

use serde::{Deserialize, Serialize};

/// Most ultrasonic sensors of a vehicle. Each has its own observation field.
pub const ULTRASONIC_MOUNTS: usize = 12;

/// Ultrasonic sensors in the bumpers of a vehicle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UltrasonicConfig {
    /// Vehicles that carry them: those in the first so many slots.
    pub vehicles: u32,
    /// Sensors of a vehicle: the first so many mounts.
    pub mounts: u32,
    /// Time between samples, seconds.
    pub period_s: f64,
    /// Place of each mount along the vehicle, as a share of half its length: 1 = front bumper, −1 = rear bumper.
    pub mount_ahead: [f64; ULTRASONIC_MOUNTS],
    /// Place of each mount across the vehicle, as a share of half its width: 1 = left side, −1 = right side.
    pub mount_left: [f64; ULTRASONIC_MOUNTS],
    /// Direction of each mount, degrees counter-clockwise from straight ahead.
    pub mount_yaw_deg: [f64; ULTRASONIC_MOUNTS],
    /// Height of the mounts above the ground, metres.
    pub mount_height_m: f64,
    /// Largest angle to the left and to the right of a mount's direction, degrees.
    pub horizontal_half_angle_deg: f64,
    /// Largest angle above and below a mount's direction, degrees.
    pub vertical_half_angle_deg: f64,
    /// Nearest range that is measured, metres; what is nearer reads as this.
    pub min_range_m: f64,
    /// Farthest range that is measured, metres; no echo reads as this.
    pub range_m: f64,
    /// Standard deviation of the range, metres.
    pub range_noise_std_m: f64,
    /// Length of a blackout, shortest and longest, seconds; [0, 0] = none.
    pub blackout_length_s: [f64; 2],
    /// Time between two blackouts, shortest and longest, seconds.
    pub blackout_gap_s: [f64; 2],
}

impl UltrasonicConfig {
    /// Multiplies random errors by `factor`.
    pub(crate) fn scale_noise(&mut self, factor: f64) {
        self.range_noise_std_m *= factor;
    }
}
