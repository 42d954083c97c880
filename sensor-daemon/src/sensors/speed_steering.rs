//! Speed and steering sensor: speed of the rear wheels, and steering-wheel angle from the road-wheel angle and the steering ratio.

use ipc_schema::{config::SpeedSteeringConfig as Params, sensor::NoiseStream, world::VehicleState};

use crate::noise::{DrawnNormals, NormalDraws, RandomStream, normals::NormalBlock};

/// One sample.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SpeedSteeringSample {
    /// Speed of the rear wheels, m/s; never negative, as a pulse counter does not know the direction.
    pub speed_mps: f64,
    /// Steering-wheel angle, positive to the left, radians.
    pub steering_rad: f64,
}

/// Constant scale factors of one vehicle's speed and steering angle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpeedSteeringScales {
    /// Factor on the speed: tyres are worn, or differ from the size that the counter is set to.
    pub speed: f64,
    /// Factor on the steering angle.
    pub steering: f64,
}

impl SpeedSteeringScales {
    /// The factors of a vehicle from its own standard normal numbers.
    #[must_use]
    pub fn new(params: &Params, normals: &NormalBlock) -> Self {
        Self {
            speed: 1.0 + params.speed_scale_std * f64::from(normals[0]),
            steering: 1.0 + params.steering_scale_std * f64::from(normals[1]),
        }
    }
}

/// A sensor as configured.
#[derive(Debug, Clone, PartialEq)]
pub struct SpeedSteeringModel {
    params: Params,
    steering_ratio: f64,
    has_noise: bool,
}

impl SpeedSteeringModel {
    /// The sensor of vehicles with this steering ratio (steering-wheel angle over road-wheel angle); 0: each that of its parameter set.
    #[must_use]
    pub fn new(params: &Params, steering_ratio: f64) -> Self {
        Self {
            steering_ratio,
            has_noise: params.speed_noise_std_mps > 0.0 || params.steering_noise_std_rad > 0.0,
            params: params.clone(),
        }
    }

    /// Plans the noise of a tick, if there is any.
    pub fn plan(&self, draws: &mut NormalDraws, tick: u32) {
        if self.has_noise {
            draws.plan(NoiseStream::SpeedSteering, tick);
        }
    }

    /// Takes the numbers that [`SpeedSteeringModel::plan`] planned.
    #[inline(always)]
    pub fn take(&self, drawn: &mut DrawnNormals) -> NormalBlock {
        drawn.take(self.has_noise)
    }

    /// Scale factors of a vehicle that begins a trajectory: the same at each of its trajectories in an episode.
    #[must_use]
    pub fn begin(&self, episode_seed: u64, id_hash: u64) -> SpeedSteeringScales {
        let stream = RandomStream {
            episode_seed,
            id_hash,
            sensor: NoiseStream::Scale,
        };
        SpeedSteeringScales::new(&self.params, &stream.normals(0))
    }

    /// The sample of a vehicle with this state, with standard normal numbers for speed and steering.
    #[must_use]
    #[inline(always)]
    pub fn sample(
        &self,
        scales: &SpeedSteeringScales,
        state: &VehicleState,
        normals: &NormalBlock,
    ) -> SpeedSteeringSample {
        let params = &self.params;
        let slip = if params.wheel_slip {
            f64::from(state.rear_wheel_slip)
        } else {
            0.0
        };
        let true_speed = f64::from(state.velocity_body_mps[0]).abs() * (1.0 + slip);
        let ratio = if self.steering_ratio > 0.0 {
            self.steering_ratio
        } else {
            state.steering_ratio.into()
        };
        let true_steering = f64::from(state.road_wheel_angle_rad) * ratio;
        SpeedSteeringSample {
            speed_mps: (true_speed * scales.speed + params.speed_noise_std_mps * f64::from(normals[0])).max(0.0),
            steering_rad: true_steering * scales.steering
                + params.steering_bias_rad
                + params.steering_noise_std_rad * f64::from(normals[1]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset::town;

    const EXACT: SpeedSteeringScales = SpeedSteeringScales {
        speed: 1.0,
        steering: 1.0,
    };

    fn stream(id_hash: u64, sensor: NoiseStream) -> RandomStream {
        RandomStream {
            episode_seed: 1,
            id_hash,
            sensor,
        }
    }

    fn model(params: &Params) -> SpeedSteeringModel {
        SpeedSteeringModel::new(params, 16.0)
    }

    #[test]
    fn without_noise_it_measures_wheel_speed_and_steering_wheel_angle() {
        let params = Params {
            speed_noise_std_mps: 0.0,
            steering_noise_std_rad: 0.0,
            ..town().speed_steering
        };
        assert!(!model(&params).has_noise && model(&town().speed_steering).has_noise);
        let state = VehicleState {
            velocity_body_mps: [-12.5, 3.0, 0.0],
            road_wheel_angle_rad: -0.25,
            ..VehicleState::default()
        };
        assert_eq!(
            model(&params).sample(&EXACT, &state, &[1.0; 4]),
            SpeedSteeringSample {
                speed_mps: 12.5,
                steering_rad: -4.0
            }
        );
        let biased = Params {
            steering_bias_rad: 0.5,
            ..params
        };
        let scales = SpeedSteeringScales {
            speed: 1.02,
            steering: 0.5,
        };
        assert_eq!(
            model(&biased).sample(&scales, &state, &[1.0; 4]),
            SpeedSteeringSample {
                speed_mps: 12.75,
                steering_rad: -1.5
            }
        );
    }

    #[test]
    fn wheels_slip_and_each_set_has_its_steering_ratio_if_configured() {
        let params = Params {
            speed_noise_std_mps: 0.0,
            steering_noise_std_rad: 0.0,
            ..town().speed_steering
        };
        let state = VehicleState {
            velocity_body_mps: [20.0, 0.0, 0.0],
            road_wheel_angle_rad: 0.1,
            steering_ratio: 22.0,
            rear_wheel_slip: -0.05,
            ..VehicleState::default()
        };
        let sample = |params: &Params, ratio| SpeedSteeringModel::new(params, ratio).sample(&EXACT, &state, &[0.0; 4]);
        let plain = sample(&params, 15.0);
        assert!((plain.speed_mps - 20.0).abs() < 1e-6 && (plain.steering_rad - 1.5).abs() < 1e-6);
        let slipping = sample(
            &Params {
                wheel_slip: true,
                ..params
            },
            0.0,
        );
        assert!((slipping.speed_mps - 19.0).abs() < 1e-6 && (slipping.steering_rad - 2.2).abs() < 1e-6);
    }

    #[test]
    fn noise_has_the_configured_level_and_never_makes_speed_negative() {
        const N: u32 = 20_000;
        let params = Params {
            speed_noise_std_mps: 0.3,
            steering_noise_std_rad: 0.1,
            ..town().speed_steering
        };
        let moving = VehicleState {
            velocity_body_mps: [20.0, 0.0, 0.0],
            ..VehicleState::default()
        };
        let at = |state: &VehicleState, index| {
            let normals = stream(1, NoiseStream::SpeedSteering).normals(index);
            model(&params).sample(&EXACT, state, &normals)
        };
        let std = |of: &dyn Fn(u32) -> f64| ((0..N).map(|i| of(i).powi(2)).sum::<f64>() / f64::from(N)).sqrt();
        let share = 5.0 / (2.0 * f64::from(N)).sqrt();
        let speed = std(&|i| at(&moving, i).speed_mps - 20.0);
        assert!((speed / 0.3 - 1.0).abs() < share, "{speed}");
        let steering = std(&|i| at(&moving, i).steering_rad);
        assert!((steering / 0.1 - 1.0).abs() < share, "{steering}");
        assert!((0..N).all(|index| at(&VehicleState::default(), index).speed_mps >= 0.0));
    }

    #[test]
    fn scale_errors_vary_over_vehicles_as_configured() {
        const N: u64 = 20_000;
        let params = Params {
            speed_scale_std: 0.02,
            steering_scale_std: 0.005,
            ..town().speed_steering
        };
        let scales: Vec<SpeedSteeringScales> = (0..N)
            .map(|id| SpeedSteeringScales::new(&params, &stream(id, NoiseStream::Scale).normals(0)))
            .collect();
        let std = |of: &dyn Fn(&SpeedSteeringScales) -> f64| {
            (scales.iter().map(|s| (of(s) - 1.0).powi(2)).sum::<f64>() / N as f64).sqrt()
        };
        let share = 5.0 / (2.0 * N as f64).sqrt();
        assert!((std(&|s| s.speed) / 0.02 - 1.0).abs() < share);
        assert!((std(&|s| s.steering) / 0.005 - 1.0).abs() < share);
    }
}
