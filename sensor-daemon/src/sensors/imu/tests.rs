//! Conventions against values by hand, and errors against their parameters.

use super::*;
use crate::{noise::RandomStream, preset::town};
use ipc_schema::sensor::NoiseStream;
use proptest::prelude::*;
use std::f64::consts::PI;

fn quiet() -> Params {
    Params {
        accel_noise_std_mps2: [0.0; 3],
        gyro_noise_std_radps: [0.0; 3],
        compass_noise_std_rad: 0.0,
        ..town().imu
    }
}

fn with(convention: ImuConvention) -> Params {
    Params { convention, ..quiet() }
}

/// One sample at the end of these sub-steps, heading north.
fn sample(params: &Params, rows: &[SubStep]) -> ImuSample {
    samples(params, rows, 1)[0]
}

fn samples(params: &Params, rows: &[SubStep], count: usize) -> Vec<ImuSample> {
    let unit = ImuModel::new(params, count, 0.1);
    let mut out = vec![[9.0; 7]; count];
    let body = ImuMotion {
        yaw_rad: FRAC_PI_2,
        rows,
    };
    assert!(blocks(&unit, 1, 0).of(0).is_empty());
    unit.sample(
        VectorPath::widest(),
        &body,
        DrawnNormals::default(),
        &mut [0.0; 8],
        &mut out,
    );
    out
}

#[test]
fn the_compass_knows_the_four_winds() {
    for (yaw, heading) in [(FRAC_PI_2, 0.0), (0.0, FRAC_PI_2), (-FRAC_PI_2, PI), (PI, 1.5 * PI)] {
        assert!((f64::from(compass_rad(yaw, 0.0)) - heading).abs() < 1e-6);
    }
    assert!((compass_rad(FRAC_PI_2, 0.25) - 0.25).abs() < 1e-6);
}

proptest! {
    #[test]
    fn the_compass_stays_in_the_circle(yaw in -100.0_f64..100.0, tiny in -1e-7_f64..1e-7) {
        prop_assert!((0.0..TAU).contains(&f64::from(compass_rad(yaw, 0.0))));
        prop_assert!((0.0..TAU).contains(&f64::from(compass_rad(FRAC_PI_2, tiny))));
    }
}

#[test]
fn at_rest_it_feels_gravity_as_configured() {
    let rest = [SubStep::default()];
    assert_eq!(sample(&with(ImuConvention::Kinematic), &rest), [0.0; 7]);
    let g = GRAVITY_MPS2 as f32;
    for convention in [ImuConvention::SpecificForce, ImuConvention::Carla] {
        let felt = sample(&with(convention), &rest);
        assert_eq!(felt, [0.0, 0.0, g, 0.0, 0.0, 0.0, 0.0], "{convention:?}");
    }
}

/// A body rolls at 0.4 rad/s through 0.2 rad to the end of the sample, which takes 0.1 s: half-way it leans by 0.18 rad, whatever the
/// number of sub-steps.
#[test]
fn gravity_is_that_half_way_through_the_sample() {
    for sub_steps in [1_u8, 2, 5, 10] {
        let rows: Vec<SubStep> = (1..=sub_steps)
            .map(|step| SubStep {
                roll_rad: 0.16 + 0.04 * f32::from(step) / f32::from(sub_steps),
                angular_rate_body_radps: [0.4, 0.0, 0.0],
                ..SubStep::default()
            })
            .collect();
        let felt = sample(&with(ImuConvention::SpecificForce), &rows);
        let g = GRAVITY_MPS2 as f32;
        let off = [felt[1] - g * 0.18_f32.sin(), felt[2] - g * 0.18_f32.cos()];
        assert!(off.iter().all(|off| off.abs() < 2e-5), "{sub_steps} sub-steps: {off:?}");
    }
}

/// Nose up by 30°: the seat pushes the sensor forward by half of gravity. Rolled to the right by 30°, the left side is up: it
/// pushes to the left; CARLA's y points to the right.
#[test]
fn slopes_and_rolls_turn_gravity() {
    let angle = (PI / 6.0) as f32;
    let near = |felt: ImuSample, expected: [f32; 3]| {
        let off = (0..3).map(|i| (felt[i] - expected[i]).abs()).fold(0.0, f32::max);
        assert!(off < 1e-5, "{felt:?} is not {expected:?}");
    };
    let up = SubStep {
        pitch_rad: angle,
        ..SubStep::default()
    };
    let rolled = SubStep {
        roll_rad: angle,
        ..SubStep::default()
    };
    for (convention, y) in [
        (ImuConvention::SpecificForce, 4.903_325),
        (ImuConvention::Carla, -4.903_325),
    ] {
        near(sample(&with(convention), &[up]), [4.903_325, 0.0, 8.492_808]);
        near(sample(&with(convention), &[rolled]), [0.0, y, 8.492_808]);
    }
    let over = SubStep {
        roll_rad: PI as f32,
        ..SubStep::default()
    };
    near(
        sample(&with(ImuConvention::SpecificForce), &[over]),
        [0.0, 0.0, -9.806_65],
    );
}

/// Braking in a bend to the left while rolling to the right and pitching nose down.
#[test]
fn every_convention_by_hand() {
    let row = SubStep {
        accel_body_mps2: [-2.0, 3.0, 0.5],
        angular_rate_body_radps: [0.1, 0.2, 0.3],
        ..SubStep::default()
    };
    let kinematic = sample(&with(ImuConvention::Kinematic), &[row]);
    assert_eq!(kinematic, [-2.0, 3.0, 0.5, 0.1, 0.2, 0.3, 0.0]);
    // Level at the end of 0.1 s: half-way it still rolls by 0.005 rad to the left and pitches by 0.01 rad up.
    let g = GRAVITY_MPS2 as f32;
    let felt = [-2.0 + 0.01 * g, 3.0 - 0.005 * g, 0.5 + g];
    let near = |sample: ImuSample, expected: ImuSample| {
        let off = sample
            .iter()
            .zip(expected)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(off < 1e-3, "{sample:?} is not {expected:?}");
    };
    let [x, y, z] = felt;
    near(
        sample(&with(ImuConvention::SpecificForce), &[row]),
        [x, y, z, 0.1, 0.2, 0.3, 0.0],
    );
    // y to the right: the bend pushes to −y; rolling to the left, nose down and turning to the right are positive.
    near(
        sample(&with(ImuConvention::Carla), &[row]),
        [x, -y, z, -0.1, 0.2, -0.3, 0.0],
    );
}

#[test]
fn samples_divide_the_sub_steps_and_are_their_means() {
    let rows: Vec<SubStep> = (0..6_u8)
        .map(|i| SubStep {
            accel_body_mps2: [f32::from(i), 0.0, 0.0],
            angular_rate_body_radps: [0.0, 0.0, -f32::from(i)],
            dyaw_rad: (f32::from(i) - 5.0) * -0.1,
            ..SubStep::default()
        })
        .collect();
    let all = samples(&quiet(), &rows, 6);
    assert!((0..6_u8).all(|i| all[usize::from(i)][0] == f32::from(i)));
    let pairs = samples(&quiet(), &rows, 3);
    assert_eq!(pairs.iter().map(|s| s[0]).collect::<Vec<_>>(), [0.5, 2.5, 4.5]);
    assert_eq!(pairs.iter().map(|s| s[5]).collect::<Vec<_>>(), [-0.5, -2.5, -4.5]);
    // Turning to the right, the heading grows towards north; it is that at the end of each sample.
    let headings: Vec<f32> = pairs.iter().map(|s| s[6]).collect();
    assert!(
        (headings[1] - (TAU - 0.2) as f32).abs() < 1e-6 && headings[2] == 0.0,
        "{headings:?}"
    );
    assert_eq!(sample(&quiet(), &rows)[0], 2.5);
    // Fewer sub-steps than samples: each sample sees the newest that there is.
    assert_eq!(samples(&quiet(), &rows[..2], 4)[3][0], 1.0);
}

#[test]
fn values_are_multiples_of_the_resolution_within_the_range() {
    let params = Params {
        accel_range_mps2: [10.0, 9.9, 50.0],
        accel_resolution_mps2: [0.25, 0.25, 0.0],
        gyro_range_radps: [1.0; 3],
        gyro_resolution_radps: [0.0, 0.5, 0.0],
        ..quiet()
    };
    let row = |accel, rate| SubStep {
        accel_body_mps2: accel,
        angular_rate_body_radps: rate,
        ..SubStep::default()
    };
    let read = sample(&params, &[row([0.3, -0.4, 0.3], [0.3, 0.3, -3.0])]);
    assert_eq!(read[..6], [0.25, -0.5, 0.3, 0.3, 0.5, -1.0]);
    let read = sample(&params, &[row([99.0, -99.0, 99.0], [3.0, -3.0, 0.0])]);
    assert_eq!(read[..6], [10.0, -9.75, 50.0, 1.0, -1.0, 0.0]);
}

fn blocks(unit: &ImuModel, id_hash: u64, tick: u32) -> NormalDraws {
    let mut draws = NormalDraws::default();
    unit.plan(&mut draws, tick);
    draws.draw(1, &[id_hash; BATCH]);
    draws
}

/// Standard deviation and density add as variances; constant biases stay; every axis has its own noise.
#[test]
fn white_noise_has_the_configured_level_on_every_axis() {
    const N: usize = 40_000;
    let params = Params {
        period_s: 0.01,
        accel_noise_std_mps2: [0.3, 0.0, 0.1],
        accel_noise_density: [0.04, 0.02, 0.0],
        accel_bias_mps2: [1.0, -2.0, 0.0],
        gyro_noise_std_radps: [0.1, 0.2, 0.3],
        gyro_noise_density: [0.0; 3],
        gyro_bias_radps: [0.0, 0.0, 0.5],
        compass_noise_std_rad: 0.05,
        compass_bias_rad: 1.0,
        ..town().imu
    };
    let unit = ImuModel::new(&params, N, 0.1);
    let mut out = vec![[0.0; 7]; N];
    let body = ImuMotion {
        yaw_rad: FRAC_PI_2,
        rows: &[SubStep::default()],
    };
    let normals = blocks(&unit, 3, 0);
    assert_eq!(normals.of(5).len(), 2 * N);
    unit.sample(VectorPath::widest(), &body, normals.of(5), &mut [0.0; 8], &mut out);
    let stds = [0.5, 0.2, 0.1, 0.1, 0.2, 0.3, 0.05];
    let means = [1.0, -2.0, 0.0, 0.0, 0.0, 0.5, 1.0];
    let n = N as f64;
    for axis in 0..7 {
        let mean = out.iter().map(|s| f64::from(s[axis])).sum::<f64>() / n;
        let std = (out.iter().map(|s| (f64::from(s[axis]) - mean).powi(2)).sum::<f64>() / n).sqrt();
        assert!(
            (mean - means[axis]).abs() < 5.0 * stds[axis] / n.sqrt(),
            "mean {mean} of {axis}"
        );
        assert!(
            (std / stds[axis] - 1.0).abs() < 5.0 / (2.0 * n).sqrt(),
            "std {std} of {axis}"
        );
        for other in 0..axis {
            let product = out
                .iter()
                .map(|s| (f64::from(s[axis]) - means[axis]) * (f64::from(s[other]) - means[other]));
            let correlation = product.sum::<f64>() / n / (stds[axis] * stds[other]);
            assert!(
                correlation.abs() < 5.0 / n.sqrt(),
                "axes {axis} and {other}: {correlation}"
            );
        }
    }
}

/// A walk of many ticks is the walk of one long one, and grows with the square root of time: K √t.
#[test]
fn biases_walk_and_remember() {
    const VEHICLES: u64 = 2000;
    let params = Params {
        period_s: 0.01,
        accel_bias_walk: [0.2; 3],
        gyro_bias_walk: [0.0, 0.0, 0.1],
        ..quiet()
    };
    let (short, long) = (ImuModel::new(&params, 10, 0.1), ImuModel::new(&params, 100, 0.1));
    let body = ImuMotion {
        yaw_rad: 0.0,
        rows: &[SubStep::default()],
    };
    let (mut accel, mut gyro) = (0.0, 0.0);
    for id in 0..VEHICLES {
        let (mut walk, mut whole) = ([0.0; 8], [0.0; 8]);
        let (mut few, mut many) = ([[0.0; 7]; 10], vec![[0.0; 7]; 100]);
        for tick in 0..10_u32 {
            short.sample(
                VectorPath::widest(),
                &body,
                blocks(&short, id, tick).of(1),
                &mut walk,
                &mut few,
            );
        }
        long.sample(
            VectorPath::widest(),
            &body,
            blocks(&long, id, 0).of(9),
            &mut whole,
            &mut many,
        );
        assert_eq!(walk, whole);
        assert_eq!(few[9], many[99]);
        assert_eq!(few[9][0], walk[0]);
        accel += f64::from(walk[1]).powi(2) / VEHICLES as f64;
        gyro += f64::from(walk[5]).powi(2) / VEHICLES as f64;
        assert_eq!((walk[3], walk[4], walk[6]), (0.0, 0.0, 0.0));
    }
    // After one second; five standard errors of a variance, 2 √(2/N).
    let tolerance = 5.0 * (2.0 / VEHICLES as f64).sqrt();
    assert!((accel / 0.04 - 1.0).abs() < tolerance, "{accel}");
    assert!((gyro / 0.01 - 1.0).abs() < tolerance, "{gyro}");
}

#[test]
fn streams_are_independent_of_how_many_are_asked_for() {
    let unit = ImuModel::new(&town().imu, 1, 0.1);
    let alone = blocks(&unit, 3, 77);
    let stream = RandomStream {
        episode_seed: 1,
        id_hash: 3,
        sensor: NoiseStream::ImuFront,
    };
    assert_eq!(alone.of(2).at(0), stream.normals(77));
}

/// With all errors on, over ticks of several sub-steps: all instruction sets give the same bits.
#[test]
fn every_path_gives_the_same_samples() {
    let params = Params {
        period_s: 0.01,
        convention: ImuConvention::Carla,
        accel_bias_walk: [0.2; 3],
        accel_resolution_mps2: [0.01, 0.0, 0.02],
        accel_range_mps2: [10.0; 3],
        gyro_noise_density: [0.01; 3],
        gyro_bias_walk: [0.1; 3],
        compass_noise_std_rad: 0.3,
        ..town().imu
    };
    let rows: Vec<SubStep> = (0..40_u8)
        .map(|i| SubStep {
            accel_body_mps2: [f32::from(i) * 0.37, -f32::from(i), 0.1],
            angular_rate_body_radps: [0.1, -0.2, f32::from(i) * 0.01],
            roll_rad: f32::from(i) * 0.01,
            pitch_rad: f32::from(i) * -0.02,
            dyaw_rad: f32::from(i) * 0.3,
            ..SubStep::default()
        })
        .collect();
    for samples in [1, 10, 20, 40] {
        let unit = ImuModel::new(&params, samples, 0.1);
        let normals = blocks(&unit, 3, 100);
        let on = |path| {
            let (mut walk, mut out) = ([0.5; 8], vec![[0.0; 7]; samples]);
            let body = ImuMotion {
                yaw_rad: 2.0,
                rows: &rows,
            };
            unit.sample(path, &body, normals.of(5), &mut walk, &mut out);
            let bits: Vec<u32> = walk.iter().chain(out.as_flattened()).map(|v| v.to_bits()).collect();
            bits
        };
        let plain = on(VectorPath::Plain);
        for path in VectorPath::available() {
            assert!(on(path) == plain, "{path:?} of {samples}");
        }
    }
}
