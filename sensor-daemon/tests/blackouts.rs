//! Blackouts in observations: ages, bits and the three policies; a sky without satellites; blackouts of the LIDAR.

mod common;

use common::{Run, cavs, config, quiet, road_user};
use ipc_schema::sensor::SensorKind;
use ipc_schema::{
    config::{BlackoutPolicy, Config, Field},
    control::{EVERY_VEHICLE, SWITCHED_ON, SensorSwitch},
    observation::{CLIPPED, VALID},
    traffic::Kind,
};
use sensor_daemon::sensors::gnss::{SatelliteSky, SkyView};

const GNSS: u32 = SensorKind::Gnss.bit();
const IMU: u32 = SensorKind::Imu.bit();
const SPEED_STEERING: u32 = SensorKind::SpeedSteering.bit();
const LIDAR: u32 = SensorKind::Lidar.bit();
const ALL: u32 = GNSS | IMU | SPEED_STEERING;

/// GNSS blackouts of exactly two seconds every four.
fn dark(policy: BlackoutPolicy) -> Config {
    let mut config = config();
    config.blackout.enabled = true;
    config.blackout.policy = policy;
    config.gnss.blackout_length_s = [2.0; 2];
    config.gnss.blackout_gap_s = [4.0; 2];
    config.observation.fields = vec![Field::GnssX, Field::AccelX, Field::GnssAge, Field::GnssValid];
    config
}

#[test]
fn a_held_fix_grows_older_and_its_bit_is_cleared() {
    let mut run = Run::new(&dark(BlackoutPolicy::Hold));
    let (mut last, mut age, mut dark_ticks) = ([0.0; 3], 0, 0);
    for tick in 0..600 {
        let seen = run.tick(&cavs(1));
        let fix = seen.section::<[f32; 3]>("gnss_m")[0];
        let row = seen.section::<f32>("observation");
        let sensors = seen.section::<u32>("sensors")[0];
        let ages = seen.section::<[f32; 4]>("age_s")[0];
        assert_eq!(seen.section::<u32>("flags")[0] & VALID, VALID);
        assert_eq!(sensors & !GNSS, IMU | SPEED_STEERING);
        assert!(tick > 0 || sensors & GNSS != 0, "no vehicle appears in a blackout");
        if sensors & GNSS == 0 {
            (age, dark_ticks) = (age + 1, dark_ticks + 1);
            assert_eq!(fix, last);
            assert_eq!(row[3], -1.0);
        } else {
            age = 0;
            assert_ne!(fix, last);
            assert_eq!(row[3], 1.0);
        }
        assert!((ages[0] - 0.1 * age as f32).abs() < 1e-5 && age <= 20);
        assert!(
            (row[2] - (0.02 * age as f32 - 1.0)).abs() < 1e-5,
            "age over 10 s, from −1 to 1"
        );
        assert_eq!(ages[1..], [0.0; 3]);
        last = fix;
    }
    // A third of the time, to within one period.
    assert!((180..=220).contains(&dark_ticks), "{dark_ticks}");
}

/// Samples that a vehicle's sensors have delivered.
#[derive(Default)]
struct Raw {
    fix: Vec<[f32; 3]>,
    imu: Option<[f32; 7]>,
    speed: Vec<f32>,
}

#[test]
fn fields_are_not_a_number_while_dark_and_raw_samples_the_last() {
    let mut config = dark(BlackoutPolicy::Nan);
    for (length, gap) in [
        (&mut config.imu.blackout_length_s, &mut config.imu.blackout_gap_s),
        (
            &mut config.speed_steering.blackout_length_s,
            &mut config.speed_steering.blackout_gap_s,
        ),
    ] {
        (*length, *gap) = ([1.0, 3.0], [1.0, 3.0]);
    }
    config.imu.period_s = 0.05;
    config.observation.fields.push(Field::Speed);
    let mut run = Run::new(&config);
    let mut seen = 0;
    let mut last = Raw::default();
    for _ in 0..300 {
        let tick = run.tick(&cavs(1));
        let sensors = tick.section::<u32>("sensors")[0];
        let row = tick.section::<f32>("observation");
        assert_eq!(
            row.iter().map(|v| v.is_nan()).collect::<Vec<_>>(),
            [
                sensors & GNSS == 0,
                sensors & IMU == 0,
                false,
                false,
                sensors & SPEED_STEERING == 0
            ]
        );
        let raw = Raw {
            fix: tick.section("gnss_m"),
            imu: tick.section::<[f32; 7]>("imu").last().copied(),
            speed: tick.section("speed_steering"),
        };
        for (bit, held, moved) in [
            (GNSS, raw.fix == last.fix, raw.fix != last.fix),
            (IMU, raw.imu == last.imu, raw.imu != last.imu),
            (SPEED_STEERING, raw.speed == last.speed, raw.speed != last.speed),
        ] {
            assert!(
                if sensors & bit == 0 { held } else { moved },
                "the raw sample is the last"
            );
        }
        last = raw;
        assert_eq!(tick.section::<u32>("flags")[0] & CLIPPED, 0);
        seen |= 1 << sensors;
    }
    assert_eq!(seen, 0b1111_1111, "every combination has occurred");
}

#[test]
fn a_row_is_dropped_while_one_of_its_sensors_is_dark() {
    let mut needs = Run::new(&dark(BlackoutPolicy::Drop));
    let mut config = dark(BlackoutPolicy::Drop);
    config.observation.fields = vec![Field::AccelX, Field::GnssAge];
    let mut does_not = Run::new(&config);
    let mut dropped = 0;
    let mut last = [0.0; 3];
    for _ in 0..100 {
        let tick = needs.tick(&cavs(1));
        let is_dark = tick.section::<u32>("sensors")[0] & GNSS == 0;
        let fix = tick.section::<[f32; 3]>("gnss_m")[0];
        assert_eq!(tick.section::<u32>("flags")[0] & VALID == 0, is_dark);
        assert_eq!(fix == last, is_dark, "raw samples are held");
        dropped += u32::from(is_dark);
        last = fix;
        let tick = does_not.tick(&cavs(1));
        assert_eq!(tick.section::<u32>("sensors")[0] & GNSS == 0, is_dark);
        assert_eq!(tick.section::<u32>("flags")[0], VALID);
    }
    assert!(dropped >= 20);
    assert_eq!(needs.sensing.observations(), u64::from(100 - dropped));
    assert_eq!(needs.sensing.raw_error().count, u64::from(100 - dropped));
}

#[test]
fn nothing_is_dark_unless_enabled() {
    let mut config = dark(BlackoutPolicy::Hold);
    config.blackout.enabled = false;
    let mut run = Run::new(&config);
    assert!((0..200).all(|_| run.tick(&cavs(2)).section::<u32>("sensors") == [ALL; 2]));
}

#[test]
fn vehicles_go_dark_out_of_phase_and_independently_of_other_vehicles() {
    let mut config = dark(BlackoutPolicy::Hold);
    config.gnss.blackout_length_s = [0.5, 3.5];
    config.gnss.blackout_gap_s = [1.0, 7.0];
    let (mut many, mut one) = (Run::new(&config), Run::new(&config));
    let states = cavs(200);
    let mut at_once = vec![];
    for _ in 0..600 {
        let sensors = many.tick(&states).section::<u32>("sensors");
        at_once.push(sensors.iter().filter(|bits| **bits & GNSS == 0).count());
        assert_eq!(one.tick(&states[77..78]).section::<u32>("sensors")[0], sensors[77]);
    }
    // Once the phases no longer depend on the start, a third of 200 is dark: 67 ± 5 standard deviations of 6.7.
    let settled = &at_once[300..];
    assert!(settled.iter().all(|count| (33..=100).contains(count)), "{settled:?}");
    let first_dark = at_once.iter().take(10).filter(|count| **count > 0).count();
    assert!(first_dark >= 8, "the first ones go dark at once");
}

/// No satellites within 2 s of the start, and later from second 4 to 5.
struct Tunnel;

impl SatelliteSky for Tunnel {
    fn at(&self, _x_m: f64, _y_m: f64, z_m: f64, time_s: f64) -> SkyView {
        assert_eq!(z_m, 0.0);
        SkyView {
            satellites: 7,
            noise_factor: 3.0,
            offset_m: [5.0, -3.0, 2.0],
            has_fix: time_s > 2.05 && !(4.05..5.05).contains(&time_s),
        }
    }
}

#[test]
fn without_a_first_fix_a_row_is_not_valid_and_a_lost_one_is_held() {
    let mut config = quiet();
    config.observation.fields = vec![Field::GnssX, Field::GnssValid];
    config.observation.history = 2;
    let mut run = Run::new(&config);
    run.sensing.set_sky(Box::new(Tunnel));
    for number in 0..60 {
        let tick = run.tick(&cavs(1));
        let (flags, sensors) = (tick.section::<u32>("flags")[0], tick.section::<u32>("sensors")[0]);
        let row = tick.section::<f32>("observation");
        let fix = tick.section::<[f32; 3]>("gnss_m")[0];
        let age = tick.section::<[f32; 4]>("age_s")[0][0];
        assert_eq!(flags & VALID != 0, number >= 20, "tick {number}");
        if number < 20 {
            assert_eq!((sensors & GNSS, fix), (0, [0.0; 3]));
            assert_eq!(row, [0.0; 4]);
            continue;
        }
        let lost = (40..50).contains(&number);
        assert_eq!(sensors & GNSS == 0, lost, "tick {number}");
        assert!((age - if lost { 0.1 * (number - 39) as f32 } else { 0.0 }).abs() < 1e-5);
        // A true metre is one of the net's to 0.1 mm here.
        assert!(
            (fix[0] - 55.0).abs() < 1e-3 && (fix[1] - 77.0).abs() < 1e-3 && fix[2] == 2.0,
            "{fix:?}"
        );
        assert_eq!(tick.section::<[f32; 2]>("gnss_quality")[0], [0.0, 7.0]);
        assert_eq!(row[3], if lost { -1.0 } else { 1.0 });
        // The first valid frame is repeated for the frames before it.
        assert_eq!(row[1], if lost && number > 40 || number == 50 { -1.0 } else { 1.0 });
    }
}

#[test]
fn lidars_scan_in_the_first_slots_unless_dark_and_their_objects_are_observed() {
    let mut config = config();
    config.lidar.vehicles = 3;
    config.lidar.range_m = 50.0;
    config.lidar.blackout_length_s = [1.0; 2];
    config.lidar.blackout_gap_s = [2.0; 2];
    config.blackout.enabled = true;
    config.gnss.pedestrians = true;
    config.gnss.blackout_length_s = [0.0; 2];
    config.observation.fields = vec![Field::Object1X, Field::Object1Y, Field::Object4X];
    let states = [
        road_user(0, Kind::Other),
        road_user(1, Kind::Cav),
        road_user(2, Kind::Person),
        road_user(3, Kind::Cav),
        road_user(4, Kind::Cav),
    ];
    let mut run = Run::new(&config);
    let mut scans = vec![];
    let first = run.tick_with(&states, &[], |sensing| {
        scans = sensing.carriers_due(SensorKind::Lidar).collect()
    });
    assert_eq!(scans, [(0, 1), (2, 3)], "slot and row; not the person, not the fourth");
    assert_eq!(first.section::<f32>("observation"), [1.0; 12], "none = the range");
    let mut dark = 0;
    for number in 0..60 {
        let forward_m = number as f32 - 30.0;
        let tick = run.tick_with(&states, &[], |sensing| {
            scans = sensing.carriers_due(SensorKind::Lidar).collect();
            for (slot, _) in scans.clone() {
                let none = [f32::INFINITY; 2];
                sensing.set_objects(slot, [[forward_m, -25.0], none, none, [f32::NAN, 1.0]]);
            }
        });
        let scanning = scans.iter().any(|(slot, _)| *slot == 2);
        let sensors = tick.section::<u32>("sensors");
        assert_eq!(sensors[2] & LIDAR != 0, scanning);
        assert_eq!((sensors[1] & LIDAR, sensors[3] & LIDAR), (0, 0));
        let age = tick.section::<[f32; 4]>("age_s")[2][3];
        assert_eq!(age == 0.0, scanning);
        if scanning {
            let row = &tick.section::<f32>("observation")[6..9];
            assert!((row[0] - forward_m / 50.0).abs() < 1e-6, "{row:?}");
            assert_eq!(row[1..], [-0.5, 1.0]);
        }
        dark += u32::from(!scanning);
    }
    assert!((15..=25).contains(&dark), "{dark}");
}

/// A sensor that a command switches off is dark from its tick to the end of the episode, for one vehicle or for all. Other sensors have
/// the same values as without commands.
#[test]
fn a_switched_sensor_is_dark_until_it_is_switched_on_or_the_episode_ends() {
    let switch = |id: Option<u32>, sensors: u32, on: u32| SensorSwitch {
        id_hash: id.map_or(0, |number| road_user(number, Kind::Cav).id_hash),
        sensors,
        flags: on | if id.is_none() { EVERY_VEHICLE } else { 0 },
    };
    let (mut run, mut plain) = (Run::new(&config()), Run::new(&config()));
    let switches = run.sensing.switches_mut();
    switches.push(3, switch(Some(1), GNSS, 0));
    switches.push(5, switch(None, IMU, 0));
    switches.push(8, switch(Some(1), ALL, SWITCHED_ON));
    for tick in 0..12 {
        let (seen, untouched) = (run.tick(&cavs(3)), plain.tick(&cavs(3)));
        let expected = match tick {
            0..3 => [ALL, ALL, ALL],
            3..5 => [ALL, ALL & !GNSS, ALL],
            5..8 => [ALL & !IMU, ALL & !GNSS & !IMU, ALL & !IMU],
            _ => [ALL & !IMU, ALL, ALL & !IMU],
        };
        assert_eq!(seen.section::<u32>("sensors"), expected, "tick {tick}");
        let fixes = [&seen, &untouched].map(|tick| tick.section::<[f32; 3]>("gnss_m"));
        for vehicle in 0..3 {
            let is_dark = expected[vehicle] & GNSS == 0;
            assert_eq!(
                fixes[0][vehicle] != fixes[1][vehicle],
                is_dark,
                "tick {tick}, vehicle {vehicle}"
            );
        }
    }
    run.restart(6);
    assert_eq!(run.tick(&cavs(3)).section::<u32>("sensors"), [ALL; 3]);
}
