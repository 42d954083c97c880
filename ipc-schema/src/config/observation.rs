//! What a row of the observation holds, and how it is scaled.

use serde::{Deserialize, Serialize};

pub use crate::field::Field;

/// Scale of the normalised observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// The paper's text: 0 … 1.
    ZeroToOne,
    /// CarAware's code: −1 … 1.
    MinusOneToOne,
}

/// Fields and normalisation of the observation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObservationConfig {
    /// Fields in order.
    pub fields: Vec<Field>,
    /// Ticks in a row: the newest and those before it, oldest first.
    pub history: u32,
    /// Scale of every field.
    pub scale: Scale,
    /// Full scale of the accelerometer, m/s².
    pub accel_range_mps2: f64,
    /// Full scale of the gyroscope, rad/s.
    pub gyro_range_radps: f64,
    /// Full scale of the speed, m/s.
    pub speed_range_mps: f64,
    /// Full scale of the steering-wheel angle, radians.
    pub steering_range_rad: f64,
    /// Full scale of the ages of samples, seconds.
    pub age_range_s: f64,
}
