//! Radar. Equations and sources: docs/sensor-models.md.

use serde::{Deserialize, Serialize};

/// The radar of a vehicle: frequency-modulated chirps, a fixed number of them in each scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RadarConfig {
    /// Vehicles that carry one: those in the first so many slots.
    pub vehicles: u32,
    /// Time between scans, seconds.
    pub period_s: f64,
    /// Where it is mounted: x, y, z from the centre of the rear axle on the ground (metres), then roll, pitch (nose up), yaw (radians).
    pub mount: [f64; 6],
    /// Carrier frequency, GHz.
    pub frequency_ghz: f64,
    /// Bandwidth of a chirp, MHz: the resolution of the range is c / 2B.
    pub bandwidth_mhz: f64,
    /// Time from chirp to chirp, microseconds: velocities beyond ± λ / 4T are ambiguous.
    pub chirp_us: f64,
    /// Chirps of a scan: the resolution of the velocity is λ / 2NT.
    pub chirps: u32,
    /// Transmitted power, dBm.
    pub transmit_dbm: f64,
    /// Gain of each antenna, dBi.
    pub antenna_gain_dbi: f64,
    /// Noise figure of the receiver and losses together, dB.
    pub noise_and_losses_db: f64,
    /// Probability that noise alone is detected in a resolution cell.
    pub false_alarm_probability: f64,
    /// Farthest range, metres.
    pub range_m: f64,
    /// Horizontal field of view, degrees.
    pub horizontal_fov_deg: f64,
    /// Vertical field of view, degrees.
    pub vertical_fov_deg: f64,
    /// Resolution of the azimuth, degrees.
    pub azimuth_resolution_deg: f64,
    /// Length of a blackout, shortest and longest, seconds; [0, 0] = none.
    pub blackout_length_s: [f64; 2],
    /// Time between two blackouts, shortest and longest, seconds.
    pub blackout_gap_s: [f64; 2],
}
