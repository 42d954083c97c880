//! `observation`: what every connected vehicle senses at a tick, one row for each slot.

use crate::block::{Section, sections};

/// `vehicle` value of an empty slot.
pub const EMPTY_SLOT: u32 = u32::MAX;

/// Number of truth columns: x, y (metres, world frame, rear axle), yaw (radians), speed (m/s).
pub const TRUTH_COLUMNS: usize = 4;
/// Number of raw GNSS columns: x, y (metres, world frame).
pub const GNSS_COLUMNS: usize = 2;

/// The slot holds a vehicle whose sensors have all delivered at least once.
pub const VALID: u32 = 1;
/// The trajectory that held this slot at the previous tick ended there: arrival, removal, collision, off-road. Never bootstrap across it.
pub const TERMINATED: u32 = 1 << 1;
/// The trajectory that held this slot at the previous tick was cut there: end of episode, or a hero's time limit. Bootstrap, then cut.
pub const TRUNCATED: u32 = 1 << 2;
/// At least one field was outside its range and has been clipped.
pub const CLIPPED: u32 = 1 << 3;

/// Where the arrays of an `observation` message lie, for `n` slots and `d` fields.
///
/// A slot belongs to one vehicle until that vehicle leaves; `n` never shrinks within a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ObservationLayout {
    /// `f32 [n, d]`: normalised observation.
    pub observation: Section,
    /// `f32 [n, 4]`: ground truth ([`TRUTH_COLUMNS`]), never part of the observation.
    pub truth: Section,
    /// `f32 [n, 2]`: newest raw GNSS fix, metres in the world frame; the baseline.
    pub gnss_m: Section,
    /// `u64 [n]`: hash of the vehicle's SUMO id.
    pub id_hash: Section,
    /// `u32 [n]`: dense vehicle index within the episode, or [`EMPTY_SLOT`].
    pub vehicle: Section,
    /// `u32 [n]`: bits [`VALID`], [`TERMINATED`], [`TRUNCATED`], [`CLIPPED`].
    pub flags: Section,
    /// `u32 [n]`: ticks since this vehicle took the slot.
    pub episode_step: Section,
    /// `f32 [n, 3]`: age of the newest GNSS, IMU and speed-steering sample, seconds.
    pub age_s: Section,
    /// Length of the payload in bytes.
    pub len: usize,
}

impl ObservationLayout {
    /// Layout for `n` slots and `d` fields.
    #[must_use]
    pub fn new(n: usize, d: usize) -> Self {
        let f32_size = size_of::<f32>();
        let ([observation, truth, gnss_m, id_hash, vehicle, flags, episode_step, age_s], len) = sections([
            n * d * f32_size,
            n * TRUTH_COLUMNS * f32_size,
            n * GNSS_COLUMNS * f32_size,
            n * size_of::<u64>(),
            n * size_of::<u32>(),
            n * size_of::<u32>(),
            n * size_of::<u32>(),
            n * 3 * f32_size,
        ]);
        Self {
            observation,
            truth,
            gnss_m,
            id_hash,
            vehicle,
            flags,
            episode_step,
            age_s,
            len,
        }
    }

    /// Name and place of every section, in order: the table that other languages read.
    #[must_use]
    pub fn named(&self) -> [(&'static str, Section); 8] {
        [
            ("observation", self.observation),
            ("truth", self.truth),
            ("gnss_m", self.gnss_m),
            ("id_hash", self.id_hash),
            ("vehicle", self.vehicle),
            ("flags", self.flags),
            ("episode_step", self.episode_step),
            ("age_s", self.age_s),
        ]
    }
}
