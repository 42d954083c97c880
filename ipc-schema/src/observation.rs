//! `observation`: what every connected vehicle senses at a tick, one row for each slot.

use crate::{config::Config, section::payload_layout, world};

/// `vehicle` value of an empty slot.
pub const EMPTY_SLOT: u32 = u32::MAX;

/// Number of truth columns: x, y (metres, world frame, rear axle), yaw (radians), speed (m/s).
pub const TRUTH_COLUMNS: usize = 4;
/// Number of raw GNSS columns: x, y, z (metres, world frame: east, north, up).
pub const GNSS_COLUMNS: usize = 3;
/// Number of geodetic columns: latitude, longitude (degrees), altitude (metres).
pub const GEODETIC_COLUMNS: usize = 3;
/// Number of columns of the quality of a fix: the receiver's estimate of its horizontal error (metres, 1σ of the distance), satellites in
/// use.
pub const QUALITY_COLUMNS: usize = 2;
/// Number of columns of an IMU sample: acceleration x, y, z (m/s²), angular rate x, y, z (rad/s), compass (rad), as `imu.convention` says.
pub const IMU_COLUMNS: usize = 7;
/// Number of columns of speed and steering: wheel speed (m/s), steering-wheel angle (rad).
pub const SPEED_STEERING_COLUMNS: usize = 2;
/// Number of columns of ages: those of the first kinds of [`crate::sensor::SensorKind`]. The age of a later kind is an observation field,
/// so a sensor that is off does not change a byte of an observation.
pub const AGE_COLUMNS: usize = 4;
/// The slot holds a vehicle whose sensors have all delivered at least once.
pub const VALID: u32 = 1;
/// The trajectory that held this slot at the previous tick ended there by arrival, removal, collision, or leaving the road. Never bootstrap
/// across it.
pub const TERMINATED: u32 = 1 << 1;
/// The trajectory that held this slot at the previous tick was cut there by the end of the episode, a hero's time limit, or because its
/// vehicle was set elsewhere ([`RESYNCHRONISED`]). Bootstrap, then
/// cut.
pub const TRUNCATED: u32 = 1 << 2;
/// At least one field was outside its range and has been clipped.
pub const CLIPPED: u32 = 1 << 3;
/// The vehicle did not drive to where it is: it was set onto SUMO's position ([`crate::world::RESYNCHRONISED`]). Its trajectory was cut at
/// the previous tick ([`TRUNCATED`]), and a new one begins here with fresh sensors.
pub const RESYNCHRONISED: u32 = 1 << 4;
/// Beside [`TERMINATED`]: the hero collided.
pub const ENDED_BY_COLLISION: u32 = 1 << 5;
/// Beside [`TERMINATED`]: the hero left the road.
pub const ENDED_OFF_ROAD: u32 = 1 << 6;
/// Beside [`TERMINATED`]: the hero arrived.
pub const ENDED_BY_ARRIVAL: u32 = 1 << 7;
/// Beside [`TERMINATED`]: the hero ran a red light.
pub const ENDED_AT_RED: u32 = 1 << 8;
/// Beside [`TERMINATED`]: the hero drove against the traffic.
pub const ENDED_AGAINST_TRAFFIC: u32 = 1 << 9;
/// Beside [`TRUNCATED`]: the hero's time limit. Without it, the run's episode ended.
pub const ENDED_BY_TIME: u32 = 1 << 10;
/// Beside [`TERMINATED`]: the hero stood for too long.
pub const ENDED_BLOCKED: u32 = 1 << 11;

/// The bits of a slot's end for a hero's bits of [`crate::world::HERO_ENDS`].
#[must_use]
pub const fn end_bits(hero_ends: u32) -> u32 {
    let mut bits = 0;
    let pairs = [
        (world::COLLIDED, ENDED_BY_COLLISION),
        (world::OFF_ROAD, ENDED_OFF_ROAD),
        (world::ARRIVED, ENDED_BY_ARRIVAL),
        (world::RED_LIGHT, ENDED_AT_RED),
        (world::AGAINST_TRAFFIC, ENDED_AGAINST_TRAFFIC),
        (world::BLOCKED, ENDED_BLOCKED),
        (world::TIME_LIMIT, ENDED_BY_TIME),
    ];
    let mut place = 0;
    while place < pairs.len() {
        if hero_ends & pairs[place].0 != 0 {
            bits |= pairs[place].1;
        }
        place += 1;
    }
    bits
}

payload_layout! {
    /// Layout of an `observation` message for `n` slots, `d` numbers in a row, `k` IMU samples in a tick and so many bytes of images.
    ///
    /// A slot belongs to one vehicle until that vehicle leaves; `n` never shrinks within a run.
    ObservationLayout(slots, fields, imu_samples, image_bytes) => ObservationSections {
        /// `f32 [n, d]`: normalised observation; with a history, the ticks in order, the newest last.
        observation: f32, [slots, fields];
        /// `f32 [n, 4]`: ground truth ([`TRUTH_COLUMNS`]), never part of the observation.
        truth: [f32; TRUTH_COLUMNS], [slots];
        /// `f32 [n, 3]`: newest raw GNSS fix, metres in the world frame ([`GNSS_COLUMNS`]); the baseline.
        gnss_m: [f32; GNSS_COLUMNS], [slots];
        /// `f64 [n, 3]`: the same fix, geodetic ([`GEODETIC_COLUMNS`]).
        gnss_geodetic: [f64; GEODETIC_COLUMNS], [slots];
        /// `f32 [n, 2]`: quality of the fix as the receiver reports it ([`QUALITY_COLUMNS`]).
        gnss_quality: [f32; QUALITY_COLUMNS], [slots];
        /// `f32 [n, k, 7]`: IMU samples since the last tick, oldest first ([`IMU_COLUMNS`]).
        imu: [f32; IMU_COLUMNS], [slots, imu_samples];
        /// `f32 [n, 2]`: newest speed and steering sample ([`SPEED_STEERING_COLUMNS`]).
        speed_steering: [f32; SPEED_STEERING_COLUMNS], [slots];
        /// `u64 [n]`: hash of the vehicle's SUMO id.
        id_hash: u64, [slots];
        /// `u32 [n]`: dense vehicle index within the episode, or [`EMPTY_SLOT`].
        vehicle: u32, [slots];
        /// `u32 [n]`: bits [`VALID`], [`TERMINATED`], [`TRUNCATED`], [`CLIPPED`], [`RESYNCHRONISED`], and why a hero's trajectory
        /// ended.
        flags: u32, [slots];
        /// `u32 [n]`: bits of the sensors that deliver ([`crate::sensor::SensorKind::bit`]). A sensor that the carrier lacks never has its bit
        /// set.
        sensors: u32, [slots];
        /// `u32 [n]`: ticks since this vehicle took the slot.
        episode_step: u32, [slots];
        /// `f32 [n, 4]`: age of the newest sample of each of the first sensors ([`AGE_COLUMNS`]), by
        /// [`crate::sensor::SensorKind`], seconds; 0 for a sensor that the carrier lacks.
        age_s: [f32; AGE_COLUMNS], [slots];
        /// `u8 [m, h, w, c]`: the newest image of each of the first m slots (`camera.observed`); empty in a run without images in its
        /// observations.
        images: u8, [image_bytes];
    }
}

impl ObservationLayout {
    /// Layout for `n` slots, `d` numbers in a row and `k` IMU samples in a tick, without images.
    #[must_use]
    pub fn new(n: usize, d: usize, k: usize) -> Self {
        Self::sized(n, d, k, 0)
    }

    /// Layout for `n` slots of a run with this configuration.
    #[must_use]
    pub fn of_run(n: usize, config: &Config) -> Self {
        let images = n.min(config.camera.vehicles as usize) * config.camera.observed_bytes();
        Self::sized(n, config.observation_width(), config.imu_samples(), images)
    }
}
