//! `radar`: the detections of one radar in a scan.
//!
//! One message for each radar and each scan. The payload is one [`RadarScan`], then the detections. Their fields are
//! those of `RadarDetection` of ASAM OSI 3.7.

use bytemuck::{Pod, Zeroable};

use crate::section::payload_layout;

/// Most detections of a scan: the nearest of them.
pub const MOST_DETECTIONS: usize = 2048;
/// `object_id` of a detection that is noise.
pub const NO_OBJECT: u32 = u32::MAX - 1;

/// Pose and parameters of one scan.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct RadarScan {
    /// Radar at the end of the tick, world, metres.
    pub position_m: [f64; 3],
    /// Roll, pitch (nose up) and heading (counter-clockwise from east) of the radar, radians.
    pub attitude_rad: [f64; 3],
    /// Hash of the vehicle's SUMO id.
    pub id_hash: u64,
    /// Dense index of the vehicle within the episode, or [`crate::pointcloud::ROADSIDE_CARRIER`] and a number.
    pub vehicle: u32,
    /// Farthest range, metres.
    pub range_m: f32,
    /// Resolution of the range, metres.
    pub range_resolution_m: f32,
    /// Resolution of the radial velocity, m/s.
    pub velocity_resolution_mps: f32,
    /// Radial velocities are known up to multiples of this, m/s.
    pub velocity_ambiguity_mps: f32,
    /// Resolution of the azimuth, radians.
    pub azimuth_resolution_rad: f32,
    /// Number of the radar among those of the run ([`crate::config::SensorUnit`]).
    pub sensor: u32,
    /// Zero.
    pub reserved: u32,
}

/// One detection. Azimuth and elevation are those of the sensor's frame: x ahead, y left, z up.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct RadarDetection {
    /// Dense index of the road user, `STATIC_OBJECT` and the number of a building or prop, or [`NO_OBJECT`]: truth, never measured.
    pub object_id: u32,
    /// Probability that noise alone would have been weaker.
    pub existence_probability: f32,
    /// Range, metres.
    pub distance_m: f32,
    /// Counter-clockwise from ahead, radians.
    pub azimuth_rad: f32,
    /// Upwards, radians.
    pub elevation_rad: f32,
    /// Standard deviations of range (metres), azimuth and elevation (radians).
    pub position_rmse: [f32; 3],
    /// Positive towards the sensor, folded into ± half of the ambiguity, m/s.
    pub radial_velocity_mps: f32,
    /// Its standard deviation, m/s.
    pub radial_velocity_rmse_mps: f32,
    /// Radar cross section as measured, dB m².
    pub rcs_dbsm: f32,
    /// Signal to noise ratio, dB.
    pub snr_db: f32,
}

payload_layout! {
    /// Layout of a `radar` message.
    RadarLayout(detection_count, scans) {
        /// `RadarScan [1]`.
        scan: RadarScan, [scans];
        /// `RadarDetection [count]`.
        detections: RadarDetection, [detection_count];
    }
}

impl RadarLayout {
    /// Layout for `count` detections.
    #[must_use]
    pub fn new(count: usize) -> Self {
        Self::sized(count, 1)
    }
}
