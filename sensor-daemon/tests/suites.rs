//! Suites: which vehicle carries what, when each sensor samples, where antenna and inertial unit are, and what differs between units.

#![expect(clippy::cast_possible_truncation, reason = "observations are single precision")]

mod common;

use common::{Run, config, quiet, road_user};
use ipc_schema::{
    config::{Config, LeverArm, MountedModel, SuiteConfig, SuiteSensor},
    field::Field,
    sensor::SensorKind,
    traffic::Kind,
    world::{SUITES_SHIFT, SubStep, VehicleState},
};
use sensor_daemon::mounts::DueUnit;

const CAMERA: u32 = SensorKind::Camera.bit();

fn sensor(name: &str, period_ticks: u32, model: MountedModel) -> SuiteSensor {
    SuiteSensor {
        name: name.into(),
        period_ticks,
        model,
    }
}

fn suite(name: &str, first: Option<u32>, sensors: Vec<SuiteSensor>) -> SuiteConfig {
    SuiteConfig {
        name: name.into(),
        classes: Vec::new(),
        types: Vec::new(),
        ids: Vec::new(),
        share: 1.0,
        first,
        sensors,
    }
}

/// A suite of two cameras for the first slot, and one of a camera that every vehicle with its bit carries.
fn two_suites() -> Config {
    let mut config = config();
    let camera = || MountedModel::Camera(Box::new(config.camera.clone()));
    let pair = vec![sensor("left", 1, camera()), sensor("slow", 3, camera())];
    let one = vec![sensor("front", 2, camera())];
    config.suites = vec![suite("pair", Some(1), pair), suite("one", None, one)];
    config
}

/// Connected vehicles whose class, type, id and share admit these suites.
fn admitted(suites: &[u32]) -> Vec<VehicleState> {
    let numbered = (0_u32..).zip(suites);
    numbered
        .map(|(number, bits)| VehicleState {
            flags: bits << SUITES_SHIFT,
            ..road_user(number, Kind::Cav)
        })
        .collect()
}

#[test]
fn a_vehicle_carries_the_first_suite_that_admits_it_and_each_camera_has_its_period() {
    let mut config = two_suites();
    config.camera.vehicles = 1;
    let mut run = Run::new(&config);
    // Both suites, both without a slot of the first, none.
    let states = admitted(&[0b11, 0b11, 0b00]);
    for tick in 0..7 {
        let mut due = Vec::new();
        let seen = run.tick_with(&states, &[], |sensing| sensing.units_due(SensorKind::Camera, &mut due));
        let due: Vec<_> = due
            .iter()
            .map(|unit: &DueUnit| (unit.slot, unit.row, unit.sensor, unit.is_first))
            .collect();
        let mut expected = vec![(Some(0), 0, 0, true), (Some(0), 0, 1, false)];
        if tick % 3 == 0 {
            expected.push((Some(0), 0, 2, false));
        }
        if tick % 2 == 0 {
            expected.push((Some(1), 1, 3, true));
        }
        assert_eq!(due, expected, "tick {tick}");
        let bits: Vec<bool> = seen
            .section::<u32>("sensors")
            .iter()
            .map(|bits| bits & CAMERA != 0)
            .collect();
        assert_eq!(bits, [true, true, false]);
    }
}

#[test]
fn without_its_bits_a_suite_changes_no_byte() {
    let (mut with, mut without) = (Run::new(&two_suites()), Run::new(&config()));
    let states = admitted(&[0, 0]);
    for _ in 0..5 {
        assert_eq!(with.tick(&states).bytes(), without.tick(&states).bytes());
    }
}

/// Heading 0.6, nose up by 0.1: the antenna's place follows from the three rotations by hand.
#[test]
fn the_fix_is_that_of_the_antenna() {
    let arm = [1.2, -0.4, 1.5];
    let mut by_section = quiet();
    by_section.gnss.mount = arm;
    let mut by_suite = quiet();
    let antenna = MountedModel::Gnss(LeverArm { mount: arm });
    by_suite.suites = vec![suite("a", None, vec![sensor("antenna", 1, antenna)])];
    let (yaw, pitch) = (0.6_f64, 0.1_f64);
    let states = [VehicleState {
        yaw_rad: yaw,
        pitch_rad: pitch as f32,
        z_m: 3.0,
        ..admitted(&[1])[0]
    }];
    // Nose up turns x towards z.
    let (ahead, up) = (
        arm[0] * pitch.cos() - arm[2] * pitch.sin(),
        arm[0] * pitch.sin() + arm[2] * pitch.cos(),
    );
    let expected = [
        states[0].x_m + ahead * yaw.cos() - arm[1] * yaw.sin(),
        states[0].y_m + ahead * yaw.sin() + arm[1] * yaw.cos(),
        states[0].z_m + up,
    ];
    for config in [&by_section, &by_suite] {
        let tick = Run::new(config).tick(&states);
        let fix = tick.section::<[f32; 3]>("gnss_m")[0];
        assert!(
            fix.iter()
                .zip(expected)
                .all(|(fix, place)| (f64::from(*fix) - place).abs() < 1e-3),
            "{fix:?} {expected:?}"
        );
        assert_eq!(tick.section::<[f32; 4]>("truth")[0][0], states[0].x_m as f32);
    }
}

/// A steady turn with a unit ahead of the axle: ω² r to the rear, at every sample of the tick, and α r across while it grows.
#[test]
fn the_inertial_unit_feels_the_turn_at_its_place() {
    let mut config = quiet();
    config.imu.mount = [2.0, 0.0, 0.0];
    config.imu.period_s = 0.01;
    let states = admitted(&[0]);
    let steps = |first: f32, growth: f32| -> Vec<SubStep> {
        let rate = |step: u8| first + growth * 0.01 * f32::from(step);
        (0..10)
            .map(|step| SubStep {
                angular_rate_body_radps: [0.0, 0.0, rate(step)],
                ..SubStep::default()
            })
            .collect()
    };
    let mut run = Run::new(&config);
    let gravity = run.tick(&states).section::<[f32; 7]>("imu")[0][2];
    let turning = run.tick_with(&states, &steps(0.5, 0.0), |_| ());
    for sample in turning.section::<[f32; 7]>("imu").iter().skip(1) {
        assert!((sample[0] + 0.5).abs() < 1e-5 && sample[1].abs() < 1e-5, "{sample:?}");
        assert!((sample[2] - gravity).abs() < 1e-5 && (sample[5] - 0.5).abs() < 1e-6);
    }
    let growing = run.tick_with(&states, &steps(0.5, 1.5), |_| ());
    for sample in growing.section::<[f32; 7]>("imu").iter().skip(1) {
        let across = 2.0 * 1.5;
        assert!((sample[1] - across).abs() < 1e-3, "{sample:?}");
        assert!((sample[0] + 2.0 * sample[5] * sample[5]).abs() < 1e-4, "{sample:?}");
    }
}

/// Each unit has a constant error of its own: over 400 vehicles its spread is the configured one, and it stays from tick to tick.
#[test]
fn biases_of_units_are_constant_and_differ_between_vehicles() {
    let mut config = quiet();
    config.gnss.unit_bias_std_m = [2.0, 1.0, 0.5];
    config.imu.accel_unit_bias_std_mps2 = [0.2; 3];
    config.imu.gyro_unit_bias_std_radps = [0.01; 3];
    config.observation.fields = vec![Field::GnssX];
    let states = admitted(&[0; 400]);
    let mut run = Run::new(&config);
    let (first, second) = (run.tick(&states), run.tick(&states));
    let imu = |tick: &common::Tick| {
        let samples = tick.section::<[f32; 7]>("imu");
        samples
            .chunks(run.sensing.imu_samples())
            .map(|of_slot| of_slot[0])
            .collect::<Vec<_>>()
    };
    assert_eq!(
        first.section::<[f32; 3]>("gnss_m"),
        second.section::<[f32; 3]>("gnss_m")
    );
    assert_eq!(imu(&first), imu(&second));
    let spread = |values: &[f64]| {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
    };
    // Five standard deviations of a standard deviation over 400: 5 / √800 = 18 %.
    let is_near = |values: &[f64], std: f64| (spread(values) / std - 1.0).abs() < 0.18;
    let fixes = first.section::<[f32; 3]>("gnss_m");
    for (axis, std) in [2.0, 1.0, 0.5].into_iter().enumerate() {
        let truth = |state: &VehicleState| [state.x_m, state.y_m, state.z_m][axis];
        let off: Vec<f64> = fixes
            .iter()
            .zip(&states)
            .map(|(fix, state)| f64::from(fix[axis]) - truth(state))
            .collect();
        assert!(is_near(&off, std), "axis {axis}: {}", spread(&off));
    }
    for axis in 0..6 {
        let values: Vec<f64> = imu(&first).iter().map(|sample| f64::from(sample[axis])).collect();
        assert!(
            is_near(&values, if axis < 3 { 0.2 } else { 0.01 }),
            "axis {axis}: {}",
            spread(&values)
        );
    }
}
