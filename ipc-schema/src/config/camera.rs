//! Cameras. How they work: docs/camera.md.

use serde::{Deserialize, Serialize};

/// The camera of a vehicle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(clippy::struct_excessive_bools, reason = "the planes of an image, each by itself")]
pub struct CameraConfig {
    /// Vehicles that carry one: those in the first so many slots.
    pub vehicles: u32,
    /// Time between images, seconds.
    pub period_s: f64,
    /// Columns of an image.
    pub width: u32,
    /// Rows of an image.
    pub height: u32,
    /// Horizontal field of view, degrees.
    pub horizontal_fov_deg: f64,
    /// Depth at which an image ends, metres: what is farther is sky.
    pub range_m: f64,
    /// Where it is mounted: x, y, z from the centre of the rear axle on the ground (metres), then roll, pitch (nose up), yaw (radians).
    pub mount: [f64; 6],
    /// Images have depths.
    pub depth: bool,
    /// Images have instances.
    pub instance: bool,
    /// Images have classes.
    pub semantic: bool,
    /// Images have colours.
    pub rgb: bool,
    /// Images have what is of interest in white.
    pub binary: bool,
    /// Length of a blackout, shortest and longest, seconds; [0, 0] = none.
    pub blackout_length_s: [f64; 2],
    /// Time between two blackouts, shortest and longest, seconds.
    pub blackout_gap_s: [f64; 2],
}

impl CameraConfig {
    /// Pixels of an image.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}
