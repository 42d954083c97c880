//! Sensors, their blackouts, and the weather they work in. Equations and sources: docs/sensor-models.md.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{LidarPattern, text::optional_path};
use crate::props::PropName;

/// GNSS receiver.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GnssConfig {
    /// Time between fixes, seconds.
    pub period_s: f64,
    /// Standard deviation of latitude and of longitude, degrees of arc on the ground (5e-5 ≙ 5.57 m).
    pub noise_std_deg: [f64; 2],
    /// Bias of latitude and of longitude, degrees of arc on the ground.
    pub bias_deg: [f64; 2],
    /// Standard deviation east, north and up, metres; beside `noise_std_deg`.
    pub noise_std_m: [f64; 3],
    /// Bias east, north and up, metres; beside `bias_deg`.
    pub bias_m: [f64; 3],
    /// Standard deviation of the correlated error (first-order Gauss–Markov) east, north and up, metres.
    pub correlated_std_m: [f64; 3],
    /// Its correlation time, seconds.
    pub correlation_time_s: f64,
    /// Standard deviation over receivers of a constant error east, north and up, metres: each receiver has its own.
    pub unit_bias_std_m: [f64; 3],
    /// Where a vehicle's antenna is: x, y, z from the centre of the rear axle on the ground, metres.
    pub mount: [f64; 3],
    /// Buildings block satellites: fewer, worse, reflected.
    pub sky_view: bool,
    /// Pedestrians carry a receiver (a smartphone), and so a slot in the observation.
    pub pedestrians: bool,
    /// Errors of a smartphone as a multiple of a vehicle's.
    pub pedestrian_noise_factor: f64,
    /// Length of a blackout, shortest and longest, seconds; [0, 0] = none.
    pub blackout_length_s: [f64; 2],
    /// Time between two blackouts, shortest and longest, seconds.
    pub blackout_gap_s: [f64; 2],
}

impl GnssConfig {
    /// Multiplies random errors and biases by `factor`.
    pub(crate) fn scale_noise(&mut self, factor: f64) {
        let angles = [&mut self.noise_std_deg, &mut self.bias_deg];
        let lengths = [
            &mut self.noise_std_m,
            &mut self.bias_m,
            &mut self.correlated_std_m,
            &mut self.unit_bias_std_m,
        ];
        angles.into_iter().flatten().for_each(|value| *value *= factor);
        lengths.into_iter().flatten().for_each(|value| *value *= factor);
    }
}

/// Frame and gravity of what an IMU delivers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImuConvention {
    /// Acceleration without gravity; x forward, y left, z up.
    Kinematic,
    /// Specific force: at rest on level ground +9.80665 m/s² upwards; x forward, y left, z up.
    SpecificForce,
    /// CARLA's: specific force in a left-handed frame; x forward, y right, z up.
    Carla,
}

/// Inertial measurement unit and compass.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImuConfig {
    /// Time between samples, seconds: a whole number of sub-steps.
    pub period_s: f64,
    /// Frame and gravity.
    pub convention: ImuConvention,
    /// Where a vehicle's unit is: x, y, z from the centre of the rear axle on the ground, metres.
    pub mount: [f64; 3],
    /// Standard deviation over units of a constant bias of the accelerometer by axis, m/s²: each unit has its own.
    pub accel_unit_bias_std_mps2: [f64; 3],
    /// Standard deviation over units of a constant bias of the gyroscope by axis, rad/s: each unit has its own.
    pub gyro_unit_bias_std_radps: [f64; 3],
    /// White noise of a sample, standard deviation by axis, m/s²; beside the density.
    pub accel_noise_std_mps2: [f64; 3],
    /// White noise by axis as a density (velocity random walk), m/s²/√Hz.
    pub accel_noise_density: [f64; 3],
    /// Constant bias by axis, m/s².
    pub accel_bias_mps2: [f64; 3],
    /// Random walk of the bias by axis (acceleration random walk), m/s³/√Hz.
    pub accel_bias_walk: [f64; 3],
    /// Full scale by axis, m/s²: beyond, a sample is clamped.
    pub accel_range_mps2: [f64; 3],
    /// Smallest step by axis, m/s²; 0 = continuous.
    pub accel_resolution_mps2: [f64; 3],
    /// White noise of a sample, standard deviation by axis, rad/s; beside the density.
    pub gyro_noise_std_radps: [f64; 3],
    /// White noise by axis as a density (angle random walk), rad/s/√Hz.
    pub gyro_noise_density: [f64; 3],
    /// Constant bias by axis, rad/s.
    pub gyro_bias_radps: [f64; 3],
    /// Random walk of the bias by axis (rate random walk), rad/s²/√Hz.
    pub gyro_bias_walk: [f64; 3],
    /// Full scale by axis, rad/s: beyond, a sample is clamped.
    pub gyro_range_radps: [f64; 3],
    /// Smallest step by axis, rad/s; 0 = continuous.
    pub gyro_resolution_radps: [f64; 3],
    /// White noise of the compass, standard deviation, radians.
    pub compass_noise_std_rad: f64,
    /// Constant error of the compass (declination, mounting), radians, clockwise.
    pub compass_bias_rad: f64,
    /// Length of a blackout, shortest and longest, seconds; [0, 0] = none.
    pub blackout_length_s: [f64; 2],
    /// Time between two blackouts, shortest and longest, seconds.
    pub blackout_gap_s: [f64; 2],
}

impl ImuConfig {
    /// Multiplies random errors and biases by `factor`.
    pub(crate) fn scale_noise(&mut self, factor: f64) {
        let axes = [
            &mut self.accel_noise_std_mps2,
            &mut self.accel_noise_density,
            &mut self.accel_bias_mps2,
            &mut self.accel_bias_walk,
            &mut self.accel_unit_bias_std_mps2,
            &mut self.gyro_unit_bias_std_radps,
            &mut self.gyro_noise_std_radps,
            &mut self.gyro_noise_density,
            &mut self.gyro_bias_radps,
            &mut self.gyro_bias_walk,
        ];
        let compass = [&mut self.compass_noise_std_rad, &mut self.compass_bias_rad];
        axes.into_iter().flatten().for_each(|value| *value *= factor);
        compass.into_iter().for_each(|value| *value *= factor);
    }
}

/// Wheel speed and steering angle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpeedSteeringConfig {
    /// Time between samples, seconds.
    pub period_s: f64,
    /// Standard deviation of the speed, m/s.
    pub speed_noise_std_mps: f64,
    /// Scale error of the speed (tyre radius): standard deviation over vehicles, constant for each.
    pub speed_scale_std: f64,
    /// Standard deviation of the steering-wheel angle, radians.
    pub steering_noise_std_rad: f64,
    /// Scale error of the steering angle: standard deviation over vehicles, constant for each.
    pub steering_scale_std: f64,
    /// Constant error of the steering-wheel angle, radians.
    pub steering_bias_rad: f64,
    /// The wheels slip: the speed is theirs, not that of the ground under them.
    pub wheel_slip: bool,
    /// Length of a blackout, shortest and longest, seconds; [0, 0] = none.
    pub blackout_length_s: [f64; 2],
    /// Time between two blackouts, shortest and longest, seconds.
    pub blackout_gap_s: [f64; 2],
}

impl SpeedSteeringConfig {
    /// Multiplies random errors and biases by `factor`.
    pub(crate) fn scale_noise(&mut self, factor: f64) {
        let values = [
            &mut self.speed_noise_std_mps,
            &mut self.speed_scale_std,
            &mut self.steering_noise_std_rad,
            &mut self.steering_scale_std,
            &mut self.steering_bias_rad,
        ];
        values.into_iter().for_each(|value| *value *= factor);
    }
}

/// What a scan holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LidarMode {
    /// Every return.
    All,
    /// Returns of vehicles, persons and `lidar.interest_props` alone.
    Interest,
}

/// Axes of a scan's points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LidarAxes {
    /// x forward, y left, z up.
    Forward,
    /// The paper's figure 3: y backward, x left, z down.
    Paper,
}

/// Spinning LIDAR.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LidarConfig {
    /// Vehicles that carry one: those in the first so many slots.
    pub vehicles: u32,
    /// Which rays it fires.
    pub pattern: LidarPattern,
    /// Ray table of pattern "table": a CSV file with columns azimuth_deg and elevation_deg, a line for each ray.
    #[serde(with = "optional_path")]
    pub ray_table: Option<PathBuf>,
    /// Lasers one above the other (pattern "uniform").
    pub channels: u32,
    /// Points per second of all channels together.
    pub points_per_second: u64,
    /// Rotations per second.
    pub rotation_hz: f64,
    /// Nearest return, metres.
    pub min_range_m: f64,
    /// Farthest return, metres.
    pub range_m: f64,
    /// Elevation of the highest channel, degrees (pattern "uniform").
    pub upper_fov_deg: f64,
    /// Elevation of the lowest channel, degrees (pattern "uniform").
    pub lower_fov_deg: f64,
    /// Field of view about straight ahead, degrees; 360 = all around.
    pub horizontal_fov_deg: f64,
    /// Where it is mounted: x, y, z from the centre of the rear axle on the ground (metres), then roll, pitch (nose up), yaw (radians).
    pub mount: [f64; 6],
    /// Standard deviation of the range, metres.
    pub range_noise_std_m: f64,
    /// Attenuation of the intensity by the air, 1/m.
    pub attenuation_per_m: f64,
    /// Share of returns lost whatever they are.
    pub dropoff: f64,
    /// Intensity from which on no return is lost for being weak.
    pub dropoff_intensity: f64,
    /// Share of returns lost at intensity 0; in between it falls linearly.
    pub dropoff_zero_intensity: f64,
    /// Each azimuth at its own time while everybody moves; else all at the end of the tick.
    pub rolling_shutter: bool,
    /// What a scan holds.
    pub mode: LidarMode,
    /// Props that are of interest beside vehicles and persons.
    pub interest_props: Vec<PropName>,
    /// Axes of the points.
    pub axes: LidarAxes,
    /// Length of a blackout, shortest and longest, seconds; [0, 0] = none.
    pub blackout_length_s: [f64; 2],
    /// Time between two blackouts, shortest and longest, seconds.
    pub blackout_gap_s: [f64; 2],
}

impl LidarConfig {
    /// Rays fired in a tick of `tick_s` seconds.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        clippy::cast_precision_loss,
        reason = "validated: at most 2e7 rays per second"
    )]
    pub fn rays_per_tick(&self, tick_s: f64) -> usize {
        (self.points_per_second as f64 * tick_s).ceil() as usize
    }

    /// Lasers that fire together: a column of the scan. A table fires as it says.
    #[must_use]
    pub fn lasers(&self) -> u32 {
        self.pattern.lasers().unwrap_or(self.channels)
    }
}

/// What the observation holds while a sensor is dark.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BlackoutPolicy {
    /// The last sample, growing older.
    Hold,
    /// Not a number.
    Nan,
    /// No row: the slot is not valid while a sensor that the observation needs is dark.
    Drop,
}

/// What happens while a sensor is dark.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlackoutConfig {
    /// Switch for all of them.
    pub enabled: bool,
    /// What the observation holds meanwhile.
    pub policy: BlackoutPolicy,
}

/// Rain, fog and sun.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WeatherConfig {
    /// Rain, mm/h: wets the road, attenuates and loses LIDAR returns.
    pub rain_mmph: f64,
    /// Meteorological optical range (visibility), metres; fog is below 1000.
    pub visibility_m: f64,
    /// Height of the sun above the horizon, degrees: its light disturbs LIDAR returns.
    pub sun_elevation_deg: f64,
    /// Direction of the sun, clockwise from north, degrees.
    pub sun_azimuth_deg: f64,
    /// Sunlight: 0 = overcast or night, 1 = clear sky.
    pub sunlight: f64,
    /// Temperature of the air, degrees Celsius: what thermal images show is relative to it.
    pub air_temperature_c: f64,
}

#[cfg(test)]
mod tests {
    use crate::config::{Config, Surface};

    #[test]
    fn rain_wets_a_dry_road_and_no_other() {
        let mut config = Config::from_json(include_str!("../../tests/town.json")).unwrap();
        assert_eq!(config.surface(), Surface::Dry);
        config.weather.rain_mmph = 2.5;
        assert_eq!(config.surface(), Surface::Wet);
        config.road.surface = Surface::Snow;
        assert_eq!(config.surface(), Surface::Snow);
    }
}
