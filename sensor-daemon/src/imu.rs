//! Inertial measurement unit: accelerometer, gyroscope and compass in the vehicle's body frame (x forward, y left, z up).

use ipc_schema::{
    config::{Imu as Params, ImuConvention},
    world::VehicleState,
};

/// Standard gravity, m/s².
pub const GRAVITY_MPS2: f64 = 9.806_65;

use crate::noise::{Sensor, Stream};

/// One sample.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sample {
    /// Acceleration of the body's origin, m/s²; specific force where the configuration gives it gravity.
    pub accel_mps2: [f64; 3],
    /// Angular rate, rad/s.
    pub gyro_radps: [f64; 3],
    /// Heading clockwise from grid north, radians in [0, 2π).
    pub compass_rad: f64,
}

/// The IMU's sample of a vehicle that moves as `state`.
#[must_use]
pub fn sample(params: &Params, state: &VehicleState, episode_seed: u64, index: u32) -> Sample {
    let stream = |sensor| Stream {
        episode_seed,
        id_hash: state.id_hash,
        sensor,
    };
    let accel_noise = stream(Sensor::Accelerometer).normals(index);
    let gyro_noise = stream(Sensor::Gyroscope).normals(index);
    let gravity_mps2 = if params.convention == ImuConvention::Kinematic {
        0.0
    } else {
        GRAVITY_MPS2
    };
    let gravity = gravity_body(gravity_mps2, state);
    let axis =
        |i: usize| f64::from(state.accel_body_mps2[i]) + gravity[i] + params.accel_noise_std_mps2[i] * accel_noise[i];
    let rate = |i: usize| {
        f64::from(state.angular_rate_body_radps[i])
            + params.gyro_bias_radps[i]
            + params.gyro_noise_std_radps[i] * gyro_noise[i]
    };
    Sample {
        accel_mps2: [axis(0), axis(1), axis(2)],
        gyro_radps: [rate(0), rate(1), rate(2)],
        compass_rad: compass_rad(state.yaw_rad + params.compass_noise_std_rad * gyro_noise[3]),
    }
}

/// What an accelerometer feels of gravity: the upward reaction, turned into the body (roll and pitch small or large).
fn gravity_body(gravity_mps2: f64, state: &VehicleState) -> [f64; 3] {
    if gravity_mps2 == 0.0 {
        return [0.0; 3];
    }
    let (sin_pitch, cos_pitch) = libm::sincos(f64::from(state.pitch_rad));
    let (sin_roll, cos_roll) = libm::sincos(f64::from(state.roll_rad));
    [
        gravity_mps2 * sin_pitch,
        gravity_mps2 * cos_pitch * sin_roll,
        gravity_mps2 * cos_pitch * cos_roll,
    ]
}

/// Heading clockwise from north in [0, 2π), from yaw counter-clockwise from east.
#[must_use]
pub fn compass_rad(yaw_rad: f64) -> f64 {
    let heading = (std::f64::consts::FRAC_PI_2 - yaw_rad).rem_euclid(std::f64::consts::TAU);
    // The remainder of a tiny negative number rounds up to the whole circle.
    if heading >= std::f64::consts::TAU { 0.0 } else { heading }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset::town;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_2, PI, TAU};

    fn quiet() -> Params {
        Params {
            accel_noise_std_mps2: [0.0; 3],
            gyro_noise_std_radps: [0.0; 3],
            compass_noise_std_rad: 0.0,
            ..town().imu
        }
    }

    #[test]
    fn the_compass_knows_the_four_winds() {
        for (yaw, heading) in [(FRAC_PI_2, 0.0), (0.0, FRAC_PI_2), (-FRAC_PI_2, PI), (PI, 1.5 * PI)] {
            assert!((compass_rad(yaw) - heading).abs() < 1e-12);
        }
    }

    proptest! {
        #[test]
        fn the_compass_stays_in_the_circle(yaw in -100.0_f64..100.0) {
            prop_assert!((0.0..TAU).contains(&compass_rad(yaw)));
        }
    }

    #[test]
    fn a_quiet_imu_at_rest_feels_gravity_as_configured() {
        let state = VehicleState::default();
        assert_eq!(sample(&quiet(), &state, 1, 0).accel_mps2, [0.0; 3]);
        assert_eq!(
            sample(
                &Params {
                    convention: ImuConvention::SpecificForce,
                    ..quiet()
                },
                &state,
                1,
                0
            )
            .accel_mps2,
            [0.0, 0.0, GRAVITY_MPS2]
        );
        // Nose up by 30°: the accelerometer is pushed forward by half of gravity.
        let uphill = VehicleState {
            pitch_rad: (PI / 6.0) as f32,
            ..state
        };
        let felt = sample(
            &Params {
                convention: ImuConvention::SpecificForce,
                ..quiet()
            },
            &uphill,
            1,
            0,
        )
        .accel_mps2;
        assert!(
            (felt[0] - 4.903_325).abs() < 1e-5 && (felt[2] - 8.4928).abs() < 1e-3,
            "{felt:?}"
        );
    }

    /// Rolled to the right by 30°, the left side is up: the seat pushes the sensor to its left by half of gravity.
    #[test]
    fn a_roll_to_the_right_is_felt_to_the_left() {
        let rolled = VehicleState {
            roll_rad: (PI / 6.0) as f32,
            ..VehicleState::default()
        };
        let params = Params {
            convention: ImuConvention::SpecificForce,
            ..quiet()
        };
        let felt = sample(&params, &rolled, 1, 0).accel_mps2;
        assert!(
            (felt[1] - 4.903_325).abs() < 1e-5 && (felt[2] - 8.4928).abs() < 1e-3,
            "{felt:?}"
        );
    }

    #[test]
    fn noise_has_the_configured_level_and_bias_stays() {
        const N: u32 = 20_000;
        let params = Params {
            accel_noise_std_mps2: [0.5; 3],
            gyro_noise_std_radps: [0.1; 3],
            gyro_bias_radps: [0.02; 3],
            ..quiet()
        };
        let samples: Vec<Sample> = (0..N)
            .map(|index| sample(&params, &VehicleState::default(), 3, index))
            .collect();
        let n = f64::from(N);
        for axis in 0..3 {
            let std = (samples.iter().map(|s| s.accel_mps2[axis].powi(2)).sum::<f64>() / n).sqrt();
            assert!((std - 0.5).abs() < 5.0 * 0.5 / (2.0 * n).sqrt(), "accelerometer {std}");
            let mean = samples.iter().map(|s| s.gyro_radps[axis]).sum::<f64>() / n;
            assert!((mean - 0.02).abs() < 5.0 * 0.1 / n.sqrt(), "gyroscope {mean}");
        }
    }
}
