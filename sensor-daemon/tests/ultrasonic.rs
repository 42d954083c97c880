//! Ultrasonic sensors of road users in a scene: fields, carriers, blackouts, switches, stages of a curriculum.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

mod common;

use std::sync::Arc;

use common::{Run, Tick, quiet, road_user};
use ipc_schema::{
    config::{Config, Field},
    control::{EVERY_VEHICLE, SWITCHED_ON, SensorSwitch},
    field::FieldPreset,
    header::MessageHeader,
    observation::VALID,
    props::Obstacle,
    sensor::SensorKind,
    traffic::Kind,
    world::VehicleState,
};
use sensor_daemon::sensors::ultrasonic::UltrasonicSampling;
use sim_core::scene::{Prism, Scene, SolidClass};

const ULTRASONIC: u32 = SensorKind::Ultrasonic.bit();
/// Place among the twelve fields of the sensor in front that is left of the middle.
const FRONT: usize = 2;
/// Place of the sensor on the left side of the front bumper.
const LEFT: usize = 0;
/// Place of the sensor behind that is right of the middle.
const REAR: usize = 8;

/// All twelve ranges in 0 … 1, of two vehicles, without errors.
fn config() -> Config {
    let mut config = quiet();
    config.ultrasonic.vehicles = 2;
    config.ultrasonic.range_noise_std_m = 0.0;
    let fields = FieldPreset::by_name("ultrasonic").unwrap().fields();
    config.observation.fields = fields[11..].to_vec();
    config.observation.scale = ipc_schema::config::Scale::ZeroToOne;
    config
}

/// A car that heads east, with its front bumper at `front_m` and its middle at y = 80.
fn car(number: u32, front_m: f64) -> VehicleState {
    VehicleState {
        x_m: front_m - 3.6,
        yaw_rad: 0.0,
        length_m: 4.5,
        width_m: 1.8,
        height_m: 1.5,
        rear_overhang_m: 0.9,
        ..road_user(number, Kind::Cav)
    }
}

fn person(number: u32, x_m: f64, y_m: f64) -> VehicleState {
    VehicleState {
        x_m,
        y_m,
        length_m: 0.4,
        width_m: 0.5,
        height_m: 1.7,
        ..road_user(number, Kind::Person)
    }
}

/// A house 2 m ahead of x = 100, and a lamp post.
fn scene() -> Arc<Scene> {
    let corners = vec![[102.0, 70.0], [110.0, 70.0], [110.0, 90.0], [102.0, 90.0]];
    let house = Prism::new("house".into(), SolidClass::Building, corners, 0.0, 6.0).unwrap();
    let empty = Scene::new(Default::default(), Vec::new(), Vec::new());
    let post = empty.prop(&"lamp_post 98.5 82".parse::<Obstacle>().unwrap());
    Arc::new(Scene::new(Default::default(), vec![house], vec![post]))
}

/// A run with its ultrasonic sensors.
struct Sonar {
    run: Run,
    sampling: UltrasonicSampling,
    tick: u64,
    seed: u64,
    stage: u16,
}

impl Sonar {
    fn new(config: &Config) -> Self {
        Self {
            run: Run::new(config),
            sampling: UltrasonicSampling::new(config, &[scene()]),
            tick: 0,
            seed: 5,
            stage: 0,
        }
    }

    fn restart_in(&mut self, seed: u64, stage: u16) {
        self.run.restart_in(seed, stage, 0);
        (self.tick, self.seed, self.stage) = (0, seed, stage);
    }

    fn tick(&mut self, states: &[VehicleState]) -> Tick {
        let header = MessageHeader {
            tick: self.tick,
            sim_time_ns: (self.tick + 1) * 100_000_000,
            episode_seed: self.seed,
            stage: self.stage,
            ..MessageHeader::default()
        };
        self.tick += 1;
        let sampling = &mut self.sampling;
        self.run
            .tick_with(states, &[], |sensing| sampling.sample(&header, states, sensing))
    }
}

/// The ranges of a slot, metres.
fn ranges_m(tick: &Tick, slot: usize) -> Vec<f32> {
    let shares = tick.section::<f32>("observation");
    shares[12 * slot..12 * (slot + 1)]
        .iter()
        .map(|share| 5.0 * share)
        .collect()
}

#[test]
fn every_mount_has_a_field_and_hears_houses_posts_vehicles_and_persons() {
    let mut sonar = Sonar::new(&config());
    // The second car is 1.5 m behind the first; a person stands 1 m to the left of its front bumper's left side.
    let first = car(0, 100.0);
    let second = car(1, 100.0 - 4.5 - 1.5);
    let beside = person(2, 93.75, 80.0 + 0.9 + 1.0 + 0.25);
    let tick = sonar.tick(&[first, second, beside]);
    let [ahead, behind] = [ranges_m(&tick, 0), ranges_m(&tick, 1)];
    assert!((ahead[FRONT] - 2.0).abs() < 1e-5, "the house: {ahead:?}");
    assert!((ahead[REAR] - 1.5).abs() < 1e-5, "the car behind: {ahead:?}");
    // The post of radius 0.1 m stands at (98.5, 82); the mount is at (99.6625, 80.9).
    let post_m = (99.6625_f32 - 98.5).hypot(82.0 - 80.9) - 0.1;
    assert!((ahead[LEFT] - post_m).abs() < 1e-4, "{} and not {post_m}", ahead[LEFT]);
    assert!((behind[FRONT] - 1.5).abs() < 1e-5, "the car ahead: {behind:?}");
    let person_m = (93.6625_f32 - 93.75).hypot(1.25) - 0.25;
    assert!(
        (behind[LEFT] - person_m).abs() < 1e-4,
        "{} and not {person_m}",
        behind[LEFT]
    );
    assert_eq!(behind[REAR], 5.0, "nothing behind");
    assert_eq!(tick.section::<u32>("flags"), [VALID; 2], "no range is clipped");
}

#[test]
fn what_is_too_near_reads_as_the_nearest_range() {
    let tick = Sonar::new(&config()).tick(&[car(0, 101.95)]);
    assert!((ranges_m(&tick, 0)[FRONT] - 0.15).abs() < 1e-6);
    let far = VehicleState {
        y_m: 75.0,
        ..car(0, 96.95)
    };
    let far = Sonar::new(&config()).tick(&[far]);
    assert_eq!(ranges_m(&far, 0)[FRONT], 5.0);
}

#[test]
fn vehicles_in_the_first_slots_carry_them_and_pedestrians_do_not() {
    let mut config = config();
    config.gnss.pedestrians = true;
    config.observation.fields.push(Field::UltrasonicValid);
    let mut sonar = Sonar::new(&config);
    let tick = sonar.tick(&[car(0, 100.0), person(1, 101.0, 80.0), car(2, 100.0)]);
    let bits: Vec<u32> = tick
        .section::<u32>("sensors")
        .iter()
        .map(|bits| bits & ULTRASONIC)
        .collect();
    assert_eq!(bits, [ULTRASONIC, 0, 0], "not the person, not the third slot");
    let rows = tick.section::<f32>("observation");
    assert_eq!(rows[13..], [[1.0; 12].as_slice(), &[0.0], &[1.0; 12], &[0.0]].concat());
    assert_eq!(tick.section::<u32>("flags"), [VALID; 3]);
}

#[test]
fn a_dark_sensor_holds_its_ranges_and_its_age_grows() {
    let mut config = config();
    config.blackout.enabled = true;
    config.gnss.blackout_length_s = [0.0; 2];
    config.ultrasonic.blackout_length_s = [0.5; 2];
    config.ultrasonic.blackout_gap_s = [1.0; 2];
    config.observation.fields.push(Field::UltrasonicAge);
    config.observation.age_range_s = 1.0;
    let mut sonar = Sonar::new(&config);
    let (mut dark, mut held_m, mut age_s) = (0, 0.0, 0.0);
    for number in 0..90 {
        let gap_m = 1.0 + 0.02 * f64::from(number);
        let tick = sonar.tick(&[car(0, 102.0 - gap_m)]);
        let row = tick.section::<f32>("observation");
        let range_m = 5.0 * row[FRONT];
        if tick.section::<u32>("sensors")[0] & ULTRASONIC == 0 {
            age_s += 0.1;
            assert_eq!(range_m, held_m);
            dark += 1;
        } else {
            age_s = 0.0;
            assert!((f64::from(range_m) - gap_m).abs() < 1e-5);
        }
        assert!((row[12] - age_s).abs() < 1e-5, "{} and not {age_s}", row[12]);
        held_m = range_m;
    }
    // A third of the time, with the ends of the first gap and of the last.
    assert!((20..=40).contains(&dark), "{dark}");
}

#[test]
fn a_command_switches_them_like_any_sensor() {
    let mut sonar = Sonar::new(&config());
    let switch = |flags| SensorSwitch {
        id_hash: 0,
        sensors: ULTRASONIC,
        flags: EVERY_VEHICLE | flags,
    };
    sonar.run.sensing.switches_mut().push(2, switch(0));
    sonar.run.sensing.switches_mut().push(4, switch(SWITCHED_ON));
    let on: Vec<bool> = (0..6)
        .map(|_| sonar.tick(&[car(0, 100.0)]).section::<u32>("sensors")[0] & ULTRASONIC != 0)
        .collect();
    assert_eq!(on, [true, true, false, false, true, true]);
}

#[test]
fn a_longer_period_repeats_a_sample() {
    let mut config = config();
    config.ultrasonic.period_s = 0.3;
    let mut sonar = Sonar::new(&config);
    let ranges: Vec<f32> = (0..6)
        .map(|number| ranges_m(&sonar.tick(&[car(0, 100.0 - 0.1 * f64::from(number))]), 0)[FRONT])
        .collect();
    let expected = [2.0, 2.0, 2.0, 2.3, 2.3, 2.3];
    assert!(
        ranges
            .iter()
            .zip(expected)
            .all(|(range, expected)| (range - expected).abs() < 1e-5),
        "{ranges:?}"
    );
}

/// Mean and deviation to five standard errors, in the base configuration and in a stage of a curriculum with three times the noise.
#[test]
fn a_range_has_the_noise_of_its_stage() {
    const TICKS: u32 = 4000;
    let mut config = config();
    config.ultrasonic.range_noise_std_m = 0.01;
    config.curriculum.stages = serde_json::from_value(serde_json::json!([{"cavs": 1, "noise": 3.0}])).unwrap();
    let mut sonar = Sonar::new(&config);
    for (stage, std_m) in [(0, 0.01), (1, 0.03)] {
        sonar.restart_in(5, stage);
        let errors_m: Vec<f64> = (0..TICKS)
            .map(|_| f64::from(ranges_m(&sonar.tick(&[car(0, 100.0)]), 0)[FRONT]) - 2.0)
            .collect();
        let n = f64::from(TICKS);
        let mean_m = errors_m.iter().sum::<f64>() / n;
        let found_m = (errors_m.iter().map(|error_m| error_m * error_m).sum::<f64>() / n).sqrt();
        assert!(mean_m.abs() < 5.0 * std_m / n.sqrt(), "{mean_m}");
        assert!((found_m / std_m - 1.0).abs() < 5.0 / (2.0 * n).sqrt(), "{found_m}");
    }
    let again = |sonar: &mut Sonar, seed| {
        sonar.restart_in(seed, 0);
        (0..5)
            .map(|_| ranges_m(&sonar.tick(&[car(0, 100.0)]), 0))
            .collect::<Vec<_>>()
    };
    let (first, second, other) = (again(&mut sonar, 5), again(&mut sonar, 5), again(&mut sonar, 6));
    assert!(first == second && first != other);
}
