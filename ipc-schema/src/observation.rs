//! `observation`: what every connected vehicle senses at a tick, one row for each slot.

use crate::{
    block::{Section, sections},
    header::MessageHeader,
};

/// `vehicle` value of an empty slot.
pub const EMPTY_SLOT: u32 = u32::MAX;

/// Number of truth columns: x, y (metres, world frame, rear axle), yaw (radians), speed (m/s).
pub const TRUTH_COLUMNS: usize = 4;
/// Number of raw GNSS columns: x, y, z (metres, world frame: east, north, up).
pub const GNSS_COLUMNS: usize = 3;
/// Number of geodetic columns: latitude, longitude (degrees), altitude (metres).
pub const GEODETIC_COLUMNS: usize = 3;
/// Number of columns of the quality of a fix: own estimate of the horizontal error (metres, 1σ of the distance), satellites in use.
pub const QUALITY_COLUMNS: usize = 2;
/// Number of columns of an IMU sample: acceleration x, y, z (m/s²), angular rate x, y, z (rad/s), compass (rad), as `imu.convention` says.
pub const IMU_COLUMNS: usize = 7;
/// Number of columns of speed and steering: wheel speed (m/s), steering-wheel angle (rad).
pub const SPEED_STEERING_COLUMNS: usize = 2;
/// Number of columns of ages: the first kinds of [`crate::sensor::SensorKind`], which every run has had. The age of a later kind is an observation
/// field, so that a sensor that is off changes no byte of an observation.
pub const AGE_COLUMNS: usize = 4;

/// The slot holds a vehicle whose sensors have all delivered at least once.
pub const VALID: u32 = 1;
/// The trajectory that held this slot at the previous tick ended there: arrival, removal, collision, off-road. Never bootstrap across it.
pub const TERMINATED: u32 = 1 << 1;
/// The trajectory that held this slot at the previous tick was cut there: end of episode, or a hero's time limit. Bootstrap, then cut.
pub const TRUNCATED: u32 = 1 << 2;
/// At least one field was outside its range and has been clipped.
pub const CLIPPED: u32 = 1 << 3;

/// Where the arrays of an `observation` message lie, for `n` slots, `d` numbers in a row and `k` IMU samples in a tick (the header's
/// `count`, `columns` and `sequence`).
///
/// A slot belongs to one vehicle until that vehicle leaves; `n` never shrinks within a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ObservationLayout {
    /// `f32 [n, d]`: normalised observation; with a history, ticks one behind the other, the newest last.
    pub observation: Section,
    /// `f32 [n, 4]`: ground truth ([`TRUTH_COLUMNS`]), never part of the observation.
    pub truth: Section,
    /// `f32 [n, 3]`: newest raw GNSS fix, metres in the world frame ([`GNSS_COLUMNS`]); the baseline.
    pub gnss_m: Section,
    /// `f64 [n, 3]`: the same fix, geodetic ([`GEODETIC_COLUMNS`]).
    pub gnss_geodetic: Section,
    /// `f32 [n, 2]`: what the receiver says of it ([`QUALITY_COLUMNS`]).
    pub gnss_quality: Section,
    /// `f32 [n, k, 7]`: IMU samples since the last tick, oldest first ([`IMU_COLUMNS`]).
    pub imu: Section,
    /// `f32 [n, 2]`: newest speed and steering sample ([`SPEED_STEERING_COLUMNS`]).
    pub speed_steering: Section,
    /// `u64 [n]`: hash of the vehicle's SUMO id.
    pub id_hash: Section,
    /// `u32 [n]`: dense vehicle index within the episode, or [`EMPTY_SLOT`].
    pub vehicle: Section,
    /// `u32 [n]`: bits [`VALID`], [`TERMINATED`], [`TRUNCATED`], [`CLIPPED`].
    pub flags: Section,
    /// `u32 [n]`: bits of the sensors that deliver ([`crate::sensor::SensorKind::bit`]); never that of a sensor which the slot's holder does not carry.
    pub sensors: Section,
    /// `u32 [n]`: ticks since this vehicle took the slot.
    pub episode_step: Section,
    /// `f32 [n, 4]` ([`AGE_COLUMNS`]): age of the newest sample of each sensor, by [`crate::sensor::SensorKind`], seconds; 0 for one that it does not carry.
    pub age_s: Section,
    /// Length of the payload in bytes.
    pub len: usize,
}

impl ObservationLayout {
    /// Layout for `n` slots, `d` numbers in a row and `k` IMU samples in a tick.
    #[must_use]
    pub fn new(n: usize, d: usize, k: usize) -> Self {
        let f32_size = size_of::<f32>();
        let (
            [
                observation,
                truth,
                gnss_m,
                gnss_geodetic,
                gnss_quality,
                imu,
                speed_steering,
                id_hash,
                vehicle,
                flags,
                sensors,
                episode_step,
                age_s,
            ],
            len,
        ) = sections([
            n * d * f32_size,
            n * TRUTH_COLUMNS * f32_size,
            n * GNSS_COLUMNS * f32_size,
            n * GEODETIC_COLUMNS * size_of::<f64>(),
            n * QUALITY_COLUMNS * f32_size,
            n * k * IMU_COLUMNS * f32_size,
            n * SPEED_STEERING_COLUMNS * f32_size,
            n * size_of::<u64>(),
            n * size_of::<u32>(),
            n * size_of::<u32>(),
            n * size_of::<u32>(),
            n * size_of::<u32>(),
            n * AGE_COLUMNS * f32_size,
        ]);
        Self {
            observation,
            truth,
            gnss_m,
            gnss_geodetic,
            gnss_quality,
            imu,
            speed_steering,
            id_hash,
            vehicle,
            flags,
            sensors,
            episode_step,
            age_s,
            len,
        }
    }

    /// Layout of the message with this header.
    #[must_use]
    pub fn of(header: &MessageHeader) -> Self {
        Self::new(header.count as usize, header.columns as usize, header.sequence as usize)
    }

    /// Name and place of every section, in order: the table that other languages read.
    #[must_use]
    pub fn named(&self) -> [(&'static str, Section); 13] {
        [
            ("observation", self.observation),
            ("truth", self.truth),
            ("gnss_m", self.gnss_m),
            ("gnss_geodetic", self.gnss_geodetic),
            ("gnss_quality", self.gnss_quality),
            ("imu", self.imu),
            ("speed_steering", self.speed_steering),
            ("id_hash", self.id_hash),
            ("vehicle", self.vehicle),
            ("flags", self.flags),
            ("sensors", self.sensors),
            ("episode_step", self.episode_step),
            ("age_s", self.age_s),
        ]
    }
}
