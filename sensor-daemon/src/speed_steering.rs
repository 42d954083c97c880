//! Speed and steering sensor: wheel speed, and steering-wheel angle from the road-wheel angle through the steering ratio.

use ipc_schema::{config::SpeedSteering as Params, world::VehicleState};

use crate::noise::{Sensor, Stream};

/// One sample.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sample {
    /// Speed of the rear wheels, m/s; never negative, as a pulse counter's.
    pub speed_mps: f64,
    /// Steering-wheel angle, positive to the left, radians.
    pub steering_rad: f64,
}

/// The sensor's sample of a vehicle that moves as `state`.
#[must_use]
pub fn sample(params: &Params, steering_ratio: f64, state: &VehicleState, episode_seed: u64, index: u32) -> Sample {
    let [speed, steering] = Stream {
        episode_seed,
        id_hash: state.id_hash,
        sensor: Sensor::SpeedSteering,
    }
    .normal_pair(index);
    let true_speed = f64::from(state.velocity_body_mps[0]).abs();
    Sample {
        speed_mps: (true_speed + params.speed_noise_std_mps * speed).max(0.0),
        steering_rad: f64::from(state.road_wheel_angle_rad) * steering_ratio + params.steering_noise_std_rad * steering,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset::town;

    #[test]
    fn without_noise_it_tells_wheel_speed_and_steering_wheel_angle() {
        let params = Params {
            speed_noise_std_mps: 0.0,
            steering_noise_std_rad: 0.0,
            ..town().speed_steering
        };
        let state = VehicleState {
            velocity_body_mps: [12.5, 0.0, 0.0],
            road_wheel_angle_rad: -0.25,
            ..VehicleState::default()
        };
        assert_eq!(
            sample(&params, 16.0, &state, 1, 0),
            Sample {
                speed_mps: 12.5,
                steering_rad: -4.0
            }
        );
    }

    #[test]
    fn speed_noise_has_the_configured_level_and_never_makes_speed_negative() {
        const N: u32 = 20_000;
        let params = Params {
            speed_noise_std_mps: 0.3,
            steering_noise_std_rad: 0.0,
            ..town().speed_steering
        };
        let moving = VehicleState {
            velocity_body_mps: [20.0, 0.0, 0.0],
            ..VehicleState::default()
        };
        let errors = (0..N).map(|index| sample(&params, 16.0, &moving, 1, index).speed_mps - 20.0);
        let std = (errors.map(|e| e * e).sum::<f64>() / f64::from(N)).sqrt();
        assert!((std - 0.3).abs() < 5.0 * 0.3 / (2.0 * f64::from(N)).sqrt(), "{std}");
        assert!((0..N).all(|index| sample(&params, 16.0, &VehicleState::default(), 1, index).speed_mps >= 0.0));
    }
}
