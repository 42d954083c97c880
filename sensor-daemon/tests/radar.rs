//! Radars against closed forms: detection, resolution, bias, velocity, false alarms.

#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping")]

use ipc_schema::{
    config::Config,
    pointcloud::STATIC_OBJECT,
    radar::{NO_OBJECT, RadarDetection, RadarScan},
    traffic::Kind,
    world::{SubStep, VehicleState},
};
use sensor_daemon::sensors::{
    camera::CameraTargets,
    lidar::Targets,
    radar::{RadarEquation, RadarModel, RadarScratch, from_db, to_db},
};
use sim_core::scene::{Prism, Road, Scene, SolidClass};

/// A radar at the origin of its carrier, 0.5 m up, without false alarms to speak of.
fn config() -> Config {
    let mut config = Config::from_json(include_str!("../../ipc-schema/tests/town.json")).unwrap();
    config.radar.mount = [0.0, 0.0, 0.5, 0.0, 0.0, 0.0];
    config.radar.false_alarm_probability = 1e-12;
    config
}

fn empty() -> Scene {
    Scene::new(Road::default(), Vec::new(), Vec::new())
}

fn car(number: u32, x: f64, y: f64, yaw: f64, speed_mps: f32) -> VehicleState {
    VehicleState {
        x_m: x,
        y_m: y,
        yaw_rad: yaw,
        velocity_body_mps: [speed_mps, 0.0, 0.0],
        id_hash: u64::from(number) + 9,
        length_m: 4.5,
        width_m: 1.8,
        height_m: 1.5,
        rear_overhang_m: 1.0,
        vehicle: number,
        kind: Kind::Other as u32,
        ..VehicleState::default()
    }
}

fn person(number: u32, x: f64, y: f64) -> VehicleState {
    VehicleState {
        length_m: 0.4,
        width_m: 0.4,
        height_m: 1.8,
        rear_overhang_m: 0.0,
        kind: Kind::Person as u32,
        ..car(number, x, y, 0.0, 0.0)
    }
}

/// Scans of the ticks, one after the other.
fn scans(config: &Config, scene: &Scene, states: &[VehicleState], ticks: u64) -> Vec<(RadarScan, Vec<RadarDetection>)> {
    let radar = RadarModel::new(config, scene);
    let steps: &[SubStep] = &[];
    let (mut targets, mut seen) = (Targets::default(), CameraTargets::default());
    targets.update(states, steps, 0);
    seen.update(&targets);
    let mut scratch = RadarScratch::default();
    let taken = (0..ticks).map(|tick| {
        let mut detections = Vec::new();
        let scan = radar.scan((&targets, &seen), states, 0, tick, 7, &mut scratch, &mut detections);
        (scan.unwrap(), detections)
    });
    taken.collect()
}

fn of_object(scans: &[(RadarScan, Vec<RadarDetection>)], object: u32) -> Vec<RadarDetection> {
    let all = scans.iter().flat_map(|(_, detections)| detections);
    all.filter(|detection| detection.object_id == object).copied().collect()
}

#[test]
fn the_radar_equation_by_hand() {
    let mut config = config();
    // λ = 3.9189 mm, E = 15.849 mW × 5.12 ms, G = 158.49, N = kT₀ × 31.623: 44.8 dB for 10 m² at 80 m.
    config.radar.antenna_gain_dbi = 22.0;
    let equation = RadarEquation::new(&config.radar, 0.0);
    let lambda: f64 = 299_792_458.0 / 76.5e9;
    let energy = 1e-3 * 10_f64.powf(1.2) * 20e-6 * 256.0;
    let gain = 10_f64.powf(2.2);
    let noise = 1.380_649e-23 * 290.0 * 10_f64.powf(1.5);
    let expected =
        energy * gain * gain * lambda * lambda * 10.0 / ((4.0 * std::f64::consts::PI).powi(3) * 80_f64.powi(4) * noise);
    let snr = equation.snr(10.0, 80.0);
    assert!((to_db(snr) - to_db(expected)).abs() < 1e-9, "{} dB", to_db(snr));
    assert!((equation.rcs_m2(snr, 80.0) - 10.0).abs() < 1e-9);
    assert!((equation.range_resolution_m - 0.499_654).abs() < 1e-6);
    assert!(
        (equation.velocity_resolution_mps - 0.382_704).abs() < 1e-5,
        "{}",
        equation.velocity_resolution_mps
    );
    // Twice the way at 2 dB/km and 80 m: 0.32 dB.
    let rain = RadarEquation::new(&config.radar, 2.0);
    let lost_db = to_db(snr / rain.snr(10.0, 80.0));
    let expected_db = 2.0 * 0.08 * sensor_daemon::sensors::radar::rain_db_per_km(76.5, 2.0);
    assert!((lost_db - expected_db).abs() < 1e-9, "{lost_db}");
}

#[test]
fn detection_follows_swerling_1_at_every_ratio() {
    let mut config = config();
    for false_alarm in [1e-6, 1e-4] {
        config.radar.false_alarm_probability = false_alarm;
        let equation = RadarEquation::new(&config.radar, 0.0);
        for snr_db in [0.0, 6.0, 10.0, 13.0, 20.0, 30.0] {
            let snr = from_db(snr_db);
            let count = 20_000;
            let uniform = |i: u32| (f64::from(i) + 0.5) / f64::from(count);
            let detected = (0..count)
                .filter(|i| equation.detected_power(snr, uniform(*i)).is_some())
                .count();
            let share = detected as f64 / f64::from(count);
            let expected = false_alarm.powf(1.0 / (1.0 + snr));
            assert!(
                (share - expected).abs() <= 1.0 / f64::from(count),
                "{snr_db} dB: {share}, expected {expected}"
            );
            assert!((equation.detection_probability(snr) - expected).abs() < 1e-12);
        }
    }
}

/// A lorry whose flat rear is 2.5 m wide and 4 m tall: 30 m² from behind.
fn lorry(number: u32, x: f64, y: f64, yaw: f64) -> VehicleState {
    VehicleState {
        length_m: 12.0,
        width_m: 2.5,
        height_m: 4.0,
        rear_overhang_m: 1.0,
        ..car(number, x, y, yaw, 0.0)
    }
}

#[test]
fn the_rear_of_a_lorry_is_detected_as_often_as_the_equation_says() {
    let mut config = config();
    config.radar.azimuth_resolution_deg = 4.0;
    config.radar.false_alarm_probability = 1e-5;
    // Turned down until a half of the scans detect it.
    config.radar.transmit_dbm = -30.6;
    // It lies along the ray in the middle of a cell, its rear 60 m away.
    let angle = 2_f64.to_radians();
    let states = [
        car(0, 0.0, 0.0, 0.0, 0.0),
        lorry(1, 61.0 * angle.cos(), 61.0 * angle.sin(), angle),
    ];
    let all = scans(&config, &empty(), &states, 3000);
    let share = of_object(&all, 1).len() as f64 / all.len() as f64;
    let equation = RadarEquation::new(&config.radar, 0.0);
    // The area of its rear is counted in rays, 9.5 × 15 of them: 15 % of the power, and five standard deviations of the count.
    let [low, high] = [0.85, 1.15].map(|part| equation.detection_probability(part * equation.snr(30.0, 60.0)));
    assert!(low > 0.3 && high < 0.7, "{low} {high}");
    let margin = 5.0 * (0.25 / all.len() as f64).sqrt();
    assert!(
        share > low - margin && share < high + margin,
        "{share}, expected {low} to {high}"
    );
}

#[test]
fn approaching_is_positive_receding_negative_and_fast_ones_are_folded() {
    let config = config();
    let own = car(0, 0.0, 0.0, 0.0, 10.0);
    let west = std::f64::consts::PI;
    for (other, expected) in [
        (car(1, 60.0, 0.0, west, 15.0), 25.0),
        (car(1, 60.0, 0.0, 0.0, 30.0), -20.0),
        (car(1, 60.0, 0.0, 0.0, 10.0), 0.0),
        // λ / 2T = 97.97 m/s: 70 m/s look like −27.97 m/s.
        (car(1, 60.0, 0.0, west, 60.0), 70.0 - 97.971),
    ] {
        let all = scans(&config, &empty(), &[own, other], 30);
        let detections = of_object(&all, 1);
        assert!(detections.len() >= 30, "{}", detections.len());
        for seen in detections {
            let off = (f64::from(seen.radial_velocity_mps) - expected).abs();
            assert!(
                off < 0.1 + 6.0 * f64::from(seen.radial_velocity_rmse_mps),
                "{seen:?}, expected {expected}"
            );
        }
    }
    // A wall comes at the speed of the carrier.
    let outline = vec![[50.0, -20.0], [60.0, -20.0], [60.0, 20.0], [50.0, 20.0]];
    let wall = Prism::new("wall".into(), SolidClass::Building, outline, 0.0, 9.0).unwrap();
    let all = scans(
        &config,
        &Scene::new(Road::default(), vec![wall], Vec::new()),
        &[own],
        10,
    );
    let detections = of_object(&all, STATIC_OBJECT);
    assert!(detections.len() > 100);
    for seen in detections {
        let expected = 10.0 * f64::from(seen.azimuth_rad).cos();
        assert!(
            (f64::from(seen.radial_velocity_mps) - expected).abs()
                < 0.3 + 6.0 * f64::from(seen.radial_velocity_rmse_mps),
            "{seen:?}"
        );
    }
}

#[test]
fn ranges_have_no_bias_and_the_stated_deviation() {
    // The rear of a lorry at 80 m, all of it in one cell of the range, at 20 dB.
    let mut config = config();
    config.radar.transmit_dbm = -15.0;
    let states = [car(0, 0.0, 0.0, 0.0, 0.0), lorry(1, 81.0, 0.0, 0.0)];
    let all = scans(&config, &empty(), &states, 600);
    let detections = of_object(&all, 1);
    let near: Vec<_> = detections.iter().filter(|seen| seen.distance_m < 80.3).collect();
    assert!(near.len() > 500, "{}", near.len());
    // A flat rear with y from −1.25 m to 1.25 m and z from −0.5 m to 3.5 m is (E[y²] + E[z²]) / 2R farther on average.
    let [y2, z2] = [1.25_f64.powi(2) / 3.0, (3.5_f64.powi(3) + 0.5_f64.powi(3)) / 12.0];
    let truth_m = 80.0 + (y2 + z2) / 160.0;
    let off: Vec<f64> = near
        .iter()
        .map(|seen| (f64::from(seen.distance_m) - truth_m) / f64::from(seen.position_rmse[0]))
        .collect();
    let count = off.len() as f64;
    let mean = off.iter().sum::<f64>() / count;
    let deviation = (off.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / count).sqrt();
    // Rays do not cover it evenly.
    let tilt = 0.003 / f64::from(near[0].position_rmse[0]);
    assert!(mean.abs() < 5.0 / count.sqrt() + tilt, "{mean}");
    assert!(
        (deviation - 1.0).abs() < 5.0 / (2.0 * count).sqrt() + 0.05,
        "{deviation}"
    );
}

#[test]
fn targets_are_resolved_by_range_and_by_velocity_as_the_waveform_says() {
    let config = config();
    let own = car(0, 0.0, 0.0, 0.0, 0.0);
    let cells = |first: VehicleState, second: VehicleState| {
        let all = scans(&config, &empty(), &[own, first, second], 1);
        let (_, detections) = &all[0];
        [1, 2].map(|object| detections.iter().any(|seen| seen.object_id == object))
    };
    // Side by side within 2° at 40 m, so in the same cells of the azimuth: 1 m apart in range they are two, at one range one.
    assert_eq!(cells(person(1, 40.3, 0.3), person(2, 41.3, 0.8)), [true, true]);
    let together = cells(person(1, 40.3, 0.3), person(2, 40.3, 0.8));
    assert!(together[0] != together[1], "{together:?}");
    // At one range and at speeds 1 m/s apart they are two again.
    let walking = VehicleState {
        velocity_body_mps: [1.0, 0.0, 0.0],
        ..person(2, 40.3, 0.8)
    };
    assert_eq!(cells(person(1, 40.3, 0.3), walking), [true, true]);
}

#[test]
fn false_alarms_are_as_many_as_the_threshold_says() {
    let mut config = config();
    config.radar.false_alarm_probability = 1e-6;
    let all = scans(&config, &empty(), &[car(0, 0.0, 0.0, 0.0, 0.0)], 400);
    let cells = 50.0 * (150.0 / 0.499_654_1) * 256.0;
    let expected = 1e-6 * cells * 400.0;
    let count = of_object(&all, NO_OBJECT).len() as f64;
    assert!(
        (count - expected).abs() < 4.0 * expected.sqrt(),
        "{count}, expected {expected}"
    );
    for seen in of_object(&all, NO_OBJECT) {
        // Noise above the threshold: −ln Pfa = 13.8, so SNR > 12.8.
        assert!(
            seen.snr_db > 11.07 && seen.distance_m <= 150.0 && seen.azimuth_rad.abs() <= 0.873,
            "{seen:?}"
        );
    }
}

#[test]
fn the_same_keys_give_the_same_scan_and_others_do_not() {
    let config = config();
    let states = [car(0, 0.0, 0.0, 0.0, 0.0), car(1, 40.0, 2.0, 0.3, 9.0)];
    let [first, second] = [0, 0].map(|_| scans(&config, &empty(), &states, 2));
    assert!(first == second);
    assert!(first[0].1 != first[1].1, "each tick has numbers of its own");
}
