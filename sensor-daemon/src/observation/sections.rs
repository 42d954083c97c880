//! The arrays of an observation message, written slot by slot.

use ipc_schema::{
    block::{self, BlockError},
    observation::{
        AGE_COLUMNS, GEODETIC_COLUMNS, GNSS_COLUMNS, IMU_COLUMNS, ObservationLayout, QUALITY_COLUMNS,
        SPEED_STEERING_COLUMNS, TRUTH_COLUMNS,
    },
};

/// The sections of [`ObservationLayout`], as their elements.
#[derive(Debug)]
pub struct ObservationSections<'a> {
    /// `[n, d]`.
    pub observation: &'a mut [f32],
    /// `[n]`.
    pub truth: &'a mut [[f32; TRUTH_COLUMNS]],
    /// `[n]`.
    pub gnss_m: &'a mut [[f32; GNSS_COLUMNS]],
    /// `[n]`.
    pub gnss_geodetic: &'a mut [[f64; GEODETIC_COLUMNS]],
    /// `[n]`.
    pub gnss_quality: &'a mut [[f32; QUALITY_COLUMNS]],
    /// `[n, k]`.
    pub imu: &'a mut [[f32; IMU_COLUMNS]],
    /// `[n]`.
    pub speed_steering: &'a mut [[f32; SPEED_STEERING_COLUMNS]],
    /// `[n]`.
    pub id_hash: &'a mut [u64],
    /// `[n]`.
    pub vehicle: &'a mut [u32],
    /// `[n]`.
    pub flags: &'a mut [u32],
    /// `[n]`.
    pub sensors: &'a mut [u32],
    /// `[n]`.
    pub episode_step: &'a mut [u32],
    /// `[n]`.
    pub age_s: &'a mut [[f32; AGE_COLUMNS]],
}

impl<'a> ObservationSections<'a> {
    /// The sections of a payload.
    ///
    /// # Errors
    /// The payload is too short.
    pub fn split(payload: &'a mut [u8], layout: &ObservationLayout) -> Result<Self, BlockError> {
        let [
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
        ] = block::split_mut(payload, &layout.named().map(|(_, section)| section))?;
        Ok(Self {
            observation: bytemuck::cast_slice_mut(observation),
            truth: bytemuck::cast_slice_mut(truth),
            gnss_m: bytemuck::cast_slice_mut(gnss_m),
            gnss_geodetic: bytemuck::cast_slice_mut(gnss_geodetic),
            gnss_quality: bytemuck::cast_slice_mut(gnss_quality),
            imu: bytemuck::cast_slice_mut(imu),
            speed_steering: bytemuck::cast_slice_mut(speed_steering),
            id_hash: bytemuck::cast_slice_mut(id_hash),
            vehicle: bytemuck::cast_slice_mut(vehicle),
            flags: bytemuck::cast_slice_mut(flags),
            sensors: bytemuck::cast_slice_mut(sensors),
            episode_step: bytemuck::cast_slice_mut(episode_step),
            age_s: bytemuck::cast_slice_mut(age_s),
        })
    }
}
