//! Steps of training, each with its own population, noise, blackouts and maps, and a gate to the next.

use serde::{Deserialize, Serialize};

use super::{Config, Traffic};

/// Steps of training.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Curriculum {
    /// In order; none = every training episode is as the rest of the configuration says.
    pub steps: Vec<Step>,
    /// `actions.jsonl` of a run whose steps a simulation without learner repeats; "" = none.
    pub log: String,
}

/// One step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Connected vehicles kept alive.
    pub cavs: u32,
    /// Ticks in a lesson; none = `episode.ticks`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ticks: Option<u64>,
    /// Every lesson begins with all vehicles at new places; else it goes on where the one before ended.
    #[serde(default = "yes")]
    pub restart: bool,
    /// Factor on the random errors and biases of all sensors.
    #[serde(default = "one")]
    pub noise: f64,
    /// Factor on the lengths of blackouts; 0 = none.
    #[serde(default = "one")]
    pub blackout: f64,
    /// Passed once the policy's standard deviation is at most this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_std: Option<f64>,
    /// Passed once the policy's mean error in an update's samples is at most this, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_error_m: Option<f64>,
    /// Passed after so many lessons.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_lessons: Option<u64>,
}

fn yes() -> bool {
    true
}

fn one() -> f64 {
    1.0
}

impl Config {
    /// What `step` of the curriculum (counted from 1) makes of this configuration; 0 is the configuration itself.
    #[must_use]
    pub fn in_step(&self, step: usize) -> Self {
        let mut config = self.clone();
        let Some(step) = step.checked_sub(1).and_then(|index| self.curriculum.steps.get(index)) else {
            return config;
        };
        config.traffic = Traffic {
            cavs: step.cavs,
            ..config.traffic
        };
        config.scale_noise(step.noise);
        config.scale_blackouts(step.blackout);
        config
    }

    fn scale_noise(&mut self, factor: f64) {
        let (gnss, imu, speed) = (&mut self.gnss, &mut self.imu, &mut self.speed_steering);
        let triples = [
            &mut gnss.noise_std_m,
            &mut gnss.bias_m,
            &mut gnss.correlated_std_m,
            &mut imu.accel_noise_std_mps2,
            &mut imu.accel_noise_density,
            &mut imu.accel_bias_mps2,
            &mut imu.accel_bias_walk,
            &mut imu.gyro_noise_std_radps,
            &mut imu.gyro_noise_density,
            &mut imu.gyro_bias_radps,
            &mut imu.gyro_bias_walk,
        ];
        let singles = [
            &mut imu.compass_noise_std_rad,
            &mut imu.compass_bias_rad,
            &mut speed.speed_noise_std_mps,
            &mut speed.speed_scale_std,
            &mut speed.steering_noise_std_rad,
            &mut speed.steering_scale_std,
            &mut speed.steering_bias_rad,
        ];
        let pairs = [&mut gnss.noise_std_deg, &mut gnss.bias_deg];
        let values = triples
            .into_iter()
            .flatten()
            .chain(pairs.into_iter().flatten())
            .chain(singles);
        values.for_each(|value| *value *= factor);
    }

    fn scale_blackouts(&mut self, factor: f64) {
        let lengths = [
            &mut self.gnss.blackout_length_s,
            &mut self.imu.blackout_length_s,
            &mut self.speed_steering.blackout_length_s,
            &mut self.lidar.blackout_length_s,
        ];
        lengths.into_iter().flatten().for_each(|length_s| *length_s *= factor);
    }
}
