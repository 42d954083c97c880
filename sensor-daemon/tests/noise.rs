//! Statistics of many ticks of sensing: Allan deviations, correlation times, and random streams independent of other vehicles.

#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping")]

mod allan;
mod common;

use allan::{overlapping_deviation, slope};
use common::{Run, cavs, config, quiet, road_user};
use ipc_schema::sensor::NoiseStream;
use ipc_schema::{
    config::Config,
    traffic::Kind,
    world::{SubStep, VehicleState},
};
use sensor_daemon::noise::RandomStream;

/// By definition: means over two samples of 1 2 3 4 are 1.5 2.5 3.5; their second neighbours differ by 2.
#[test]
fn the_overlapping_allan_deviation_by_hand() {
    assert!((overlapping_deviation(&[1.0, 2.0, 3.0, 4.0], 2) - 2.0_f64.sqrt()).abs() < 1e-12);
    assert!((overlapping_deviation(&[1.0, 3.0, 2.0], 1) - (5.0_f64 / 4.0).sqrt()).abs() < 1e-12);
    assert_eq!(overlapping_deviation(&[7.0; 50], 5), 0.0);
    assert!((slope(&[(1.0, 5.0), (2.0, 20.0), (4.0, 80.0)]) - 2.0).abs() < 1e-12);
}

/// A drift R t has the deviation R τ / √2 (IEEE Std 952).
#[test]
fn the_allan_deviation_of_a_ramp_rises_with_time() {
    let ramp: Vec<f64> = (0..1000).map(|i| 0.01 * f64::from(i)).collect();
    for m in [1, 10, 100] {
        let expected = 0.01 * m as f64 / 2.0_f64.sqrt();
        assert!((overlapping_deviation(&ramp, m) / expected - 1.0).abs() < 1e-9);
    }
}

const TICK_S: f64 = 0.1;
const SAMPLES: usize = 10;

/// Allan deviations of one axis over vehicles, root mean square, at each number of samples.
fn deviations(config: &Config, axis: usize, vehicles: u32, ticks: usize, spans: &[usize]) -> Vec<(f64, f64)> {
    let mut run = Run::new(config);
    let states = cavs(vehicles);
    let mut rates = vec![vec![]; vehicles as usize];
    for _ in 0..ticks {
        let samples: Vec<[f32; 7]> = run.tick(&states).section("imu");
        for (rates, samples) in rates.iter_mut().zip(samples.chunks_exact(SAMPLES)) {
            rates.extend(samples.iter().map(|sample| f64::from(sample[axis])));
        }
    }
    let period_s = TICK_S / SAMPLES as f64;
    let over = |m: usize| {
        let squares = rates.iter().map(|rates| overlapping_deviation(rates, m).powi(2));
        (squares.sum::<f64>() / f64::from(vehicles)).sqrt()
    };
    spans.iter().map(|m| (*m as f64 * period_s, over(*m))).collect()
}

fn fast() -> Config {
    let mut config = quiet();
    config.imu.period_s = TICK_S / SAMPLES as f64;
    config
}

/// White noise of density N: N/√τ, slope −1/2.
#[test]
fn white_noise_has_its_allan_deviation() {
    let mut config = fast();
    config.imu.accel_noise_density = [0.0, 0.03, 0.0];
    config.imu.gyro_noise_density = [0.0, 0.0, 0.002];
    for (axis, density) in [(1, 0.03), (5, 0.002)] {
        let curve = deviations(&config, axis, 20, 2000, &[1, 4, 16, 64, 256]);
        for (tau_s, deviation) in &curve {
            let ratio = deviation / (density / tau_s.sqrt());
            // 20 vehicles with 78 independent spans each at the longest: five standard errors of 1/√(2·1560) are 9 %.
            assert!((ratio - 1.0).abs() < 0.1, "{ratio} at {tau_s} s");
        }
        let slope = slope(&curve);
        assert!((slope + 0.5).abs() < 0.03, "slope {slope}");
    }
}

/// A random walk of density K: K √(τ/3), slope +1/2.
#[test]
fn a_walking_bias_has_its_allan_deviation() {
    let mut config = fast();
    config.imu.accel_bias_walk = [0.0, 0.0, 0.2];
    config.imu.gyro_bias_walk = [0.01, 0.0, 0.0];
    for (axis, density) in [(2, 0.2), (3, 0.01)] {
        // Over one sample the means do not average over the walk; from a dozen on they do, to below 1 %.
        let curve = deviations(&config, axis, 60, 2000, &[16, 64, 256]);
        for (tau_s, deviation) in &curve {
            let ratio = deviation / (density * (tau_s / 3.0).sqrt());
            // 60 vehicles with some 78 spans at the longest: five standard errors are 5 %.
            assert!((ratio - 1.0).abs() < 0.1, "{ratio} at {tau_s} s");
        }
        let slope = slope(&curve);
        assert!((slope - 0.5).abs() < 0.03, "slope {slope}");
    }
}

/// The correlated error of fixes decays as exp(−t/τ) and has its variance from the first fix on, up included.
#[test]
fn correlated_fixes_forget_in_their_correlation_time() {
    const VEHICLES: u32 = 2000;
    let mut config = quiet();
    config.gnss.correlated_std_m = [2.0, 3.0, 4.0];
    config.gnss.correlation_time_s = 1.5;
    config.gnss.period_s = 0.2;
    let mut run = Run::new(&config);
    let states = cavs(VEHICLES);
    let fixes: Vec<Vec<[f32; 3]>> = (0..31).map(|_| run.tick(&states).section("gnss_m")).collect();
    let error = |tick: usize, vehicle: usize, axis: usize| {
        let truth = [states[vehicle].x_m, states[vehicle].y_m, 0.0];
        f64::from(fixes[tick][vehicle][axis]) - truth[axis]
    };
    let n = f64::from(VEHICLES);
    for (axis, sigma) in [2.0_f64, 3.0, 4.0].into_iter().enumerate() {
        for tick in [0, 2, 30] {
            let variance = (0..VEHICLES as usize)
                .map(|v| error(tick, v, axis).powi(2))
                .sum::<f64>()
                / n;
            let ratio = variance / sigma.powi(2);
            assert!((ratio - 1.0).abs() < 5.0 * (2.0 / n).sqrt(), "{ratio} at tick {tick}");
            let product = (0..VEHICLES as usize).map(|v| error(0, v, axis) * error(tick, v, axis));
            let correlation = product.sum::<f64>() / n / sigma.powi(2);
            let expected = (-0.1 * tick as f64 / 1.5_f64).exp();
            let tolerance = 5.0 * ((1.0 + expected * expected) / n).sqrt();
            assert!(
                (correlation - expected).abs() < tolerance,
                "{correlation} after {tick} ticks"
            );
        }
    }
}

/// A unit of docs/sensor-models.md, "Typical values": keys, and the data sheet that they stand for.
struct Unit {
    name: &'static str,
    /// `gyro_noise_density` and `gyro_bias_walk`.
    gyro: [f64; 2],
    /// `accel_noise_density` and `accel_bias_walk`.
    accel: [f64; 2],
    /// Data sheet: angle random walk, rad/√s, and the lowest Allan deviation, rad/s.
    gyro_sheet: [f64; 2],
    /// Data sheet: velocity random walk, m/s/√s, and the lowest Allan deviation, m/s².
    accel_sheet: [f64; 2],
}

const MICRO_G: f64 = 9.806_65e-6;

/// The Bosch BMI160's data sheet has no lowest point: 20 °/h and 80 µg are typical of its class.
fn units() -> [Unit; 3] {
    let per_hour = |degrees: f64| degrees.to_radians() / 3600.0;
    [
        Unit {
            name: "consumer (BMI160)",
            gyro: [1.2e-4, 6.7e-5],
            accel: [1.8e-3, 3.0e-4],
            gyro_sheet: [0.007_f64.to_radians(), per_hour(20.0)],
            accel_sheet: [180.0 * MICRO_G, 80.0 * MICRO_G],
        },
        Unit {
            name: "industrial (ADIS16470)",
            gyro: [1.4e-4, 9.3e-6],
            accel: [9.8e-4, 1.4e-5],
            gyro_sheet: [0.008_f64.to_radians(), per_hour(8.0)],
            accel_sheet: [100.0 * MICRO_G, 13.0 * MICRO_G],
        },
        Unit {
            name: "tactical (STIM300)",
            gyro: [4.4e-5, 1.2e-7],
            accel: [1.0e-3, 2.1e-4],
            gyro_sheet: [0.15_f64.to_radians() / 60.0, per_hour(0.5)],
            accel_sheet: [0.06 / 60.0, 50.0 * MICRO_G],
        },
    ]
}

/// The noise of units with published data, as delivered: the density from the Allan deviation of short spans, where it falls with √τ,
/// and its lowest point where the walk is on a scale that a run shows.
#[test]
fn units_of_the_docs_have_the_allan_deviations_of_their_data_sheets() {
    for unit in units() {
        let mut config = fast();
        config.imu.gyro_noise_density = [unit.gyro[0]; 3];
        config.imu.gyro_bias_walk = [unit.gyro[1]; 3];
        config.imu.accel_noise_density = [unit.accel[0]; 3];
        config.imu.accel_bias_walk = [unit.accel[1]; 3];
        for (axis, keys, sheet) in [(1, unit.accel, unit.accel_sheet), (5, unit.gyro, unit.gyro_sheet)] {
            // Seconds from one sample to 1 024 of them.
            let curve = deviations(&config, axis, 30, 1_000, &[1, 4, 16, 64, 256, 1_024]);
            // √τ times the deviation of a span of 0.04 s: the density, on a data sheet to two digits.
            let density = curve[1].1 * curve[1].0.sqrt();
            assert!(
                (density / sheet[0] - 1.0).abs() < 0.1,
                "{}, axis {axis}: density {density}, data sheet {}",
                unit.name,
                sheet[0]
            );
            for (tau_s, deviation) in &curve {
                let expected = (keys[0] * keys[0] / tau_s + keys[1] * keys[1] * tau_s / 3.0).sqrt();
                // 30 vehicles with 10 independent spans of the longest: five standard errors of 1/√(2·300) are 20 %.
                assert!(
                    (deviation / expected - 1.0).abs() < 0.2,
                    "{}, axis {axis}: {deviation} instead of {expected} at {tau_s} s",
                    unit.name
                );
            }
            // The lowest point, √(2 N K / √3), is the data sheet's.
            let lowest = (2.0 * keys[0] * keys[1] / 3.0_f64.sqrt()).sqrt();
            assert!(
                (lowest / sheet[1] - 1.0).abs() < 0.1,
                "{}, axis {axis}: lowest {lowest}, data sheet {}",
                unit.name,
                sheet[1]
            );
        }
    }
}

/// The circle in which half of the fixes lie (CEP) is that of the receiver's data sheet: docs/sensor-models.md, "Typical values".
#[test]
fn receivers_of_the_docs_have_the_circle_of_their_data_sheets() {
    const VEHICLES: u32 = 4_000;
    // White and correlated deviation by axis, and the data sheet's CEP, metres.
    for (white_m, correlated_m, cep_m) in [(0.5, 2.0, 2.5), (0.3, 1.2, 1.5), (0.008, 0.005, 0.01), (1.5, 4.0, 4.9)] {
        let mut config = quiet();
        config.gnss.noise_std_m = [white_m; 3];
        config.gnss.correlated_std_m = [correlated_m; 3];
        let mut run = Run::new(&config);
        let states = cavs(VEHICLES);
        let fixes: Vec<[f32; 3]> = run.tick(&states).section("gnss_m");
        let mut away: Vec<f64> = fixes
            .iter()
            .zip(&states)
            .map(|(fix, state)| (f64::from(fix[0]) - state.x_m).hypot(f64::from(fix[1]) - state.y_m))
            .collect();
        away.sort_by(f64::total_cmp);
        let found = away[away.len() / 2];
        // Five standard errors of the median are 7 %; the docs round the deviations to a digit or two.
        assert!((found / cep_m - 1.0).abs() < 0.15, "{found} m instead of {cep_m} m");
    }
}

/// All errors on, so that every random stream and every memory has an effect.
fn everything() -> Config {
    let mut config = config();
    config.gnss.noise_std_m = [1.0; 3];
    config.gnss.correlated_std_m = [1.0; 3];
    config.imu.period_s = 0.02;
    config.imu.accel_noise_density = [0.01; 3];
    config.imu.accel_bias_walk = [0.1; 3];
    config.imu.gyro_bias_walk = [0.1; 3];
    config.imu.compass_noise_std_rad = 0.1;
    config.speed_steering.speed_scale_std = 0.1;
    config.speed_steering.steering_scale_std = 0.1;
    config.blackout.enabled = true;
    config.imu.blackout_length_s = [1.0, 2.0];
    config.imu.blackout_gap_s = [1.0, 2.0];
    config.speed_steering.blackout_length_s = [1.0, 2.0];
    config.speed_steering.blackout_gap_s = [1.0, 2.0];
    config
}

/// All values of a vehicle's sensors at a tick, as bits.
fn samples(run: &mut Run, states: &[VehicleState], id_hash: u64) -> Vec<u32> {
    let tick = run.tick(states);
    let slot = tick
        .section::<u64>("id_hash")
        .iter()
        .position(|id| *id == id_hash)
        .unwrap();
    let mut bits = vec![];
    for name in [
        "observation",
        "gnss_m",
        "gnss_geodetic",
        "gnss_quality",
        "imu",
        "speed_steering",
        "sensors",
        "age_s",
    ] {
        let words: Vec<u32> = tick.section(name);
        let width = words.len() / tick.n;
        bits.extend_from_slice(&words[slot * width..(slot + 1) * width]);
    }
    bits
}

#[test]
fn a_vehicle_senses_the_same_alone_in_another_order_and_among_many() {
    let all = cavs(40);
    let me = all[23];
    let mut backwards = all.clone();
    backwards.reverse();
    let runs: [&dyn Fn(usize) -> Vec<VehicleState>; 4] = [
        &|_| vec![me],
        &|_| all.clone(),
        &|_| backwards.clone(),
        // Other vehicles come and go, with lower and higher numbers.
        &|tick| {
            all.iter()
                .filter(|v| v.vehicle == 23 || !(v.vehicle as usize + tick).is_multiple_of(3))
                .copied()
                .collect()
        },
    ];
    let everything = everything();
    let all: Vec<Vec<Vec<u32>>> = runs
        .iter()
        .map(|states| {
            let mut run = Run::new(&everything);
            (0..60)
                .map(|tick| samples(&mut run, &states(tick), me.id_hash))
                .collect()
        })
        .collect();
    assert!(all.iter().all(|samples| *samples == all[0]));
    assert!(all[0].windows(2).all(|pair| pair[0] != pair[1]));
}

#[test]
fn an_episode_starts_without_state_and_depends_on_its_seed() {
    let config = everything();
    let states = cavs(20);
    let id = states[7].id_hash;
    let mut run = Run::new(&config);
    let first: Vec<_> = (0..30).map(|_| samples(&mut run, &states, id)).collect();
    run.restart(6);
    let other: Vec<_> = (0..30).map(|_| samples(&mut run, &states[3..], id)).collect();
    run.restart(5);
    let again: Vec<_> = (0..30).map(|_| samples(&mut run, &states[2..], id)).collect();
    assert_eq!(first, again);
    assert!(first.iter().zip(&other).all(|(a, b)| a != b));
}

/// A slot passes no state to its next vehicle, and a vehicle that returns in the same episode draws new noise.
#[test]
fn a_slot_passes_no_state_to_its_next_vehicle() {
    let config = everything();
    let (a, b) = (road_user(1, Kind::Cav), road_user(2, Kind::Cav));
    let mut changed = Run::new(&config);
    (0..20).for_each(|_| drop(changed.tick(&[a])));
    (0..2).for_each(|_| drop(changed.tick(&[])));
    let mut fresh = Run::new(&config);
    (0..22).for_each(|_| drop(fresh.tick(&[])));
    for _ in 0..30 {
        assert_eq!(
            samples(&mut changed, &[b], b.id_hash),
            samples(&mut fresh, &[b], b.id_hash)
        );
    }
}

#[test]
fn threads_do_not_matter() {
    let config = everything();
    let bits = || {
        let mut run = Run::new(&config);
        let states = cavs(33);
        (0..20)
            .flat_map(|_| run.tick(&states).bytes().to_vec())
            .collect::<Vec<u64>>()
    };
    let alone = bits();
    std::thread::scope(|scope| {
        let others: Vec<_> = (0..3).map(|_| scope.spawn(bits)).collect();
        for other in others {
            assert!(other.join().unwrap() == alone);
        }
    });
}

/// Correlations between all values of two vehicles, over many vehicles.
#[test]
fn vehicles_sensors_axes_and_samples_are_independent() {
    const VEHICLES: u32 = 4000;
    let mut config = quiet();
    config.gnss.noise_std_m = [1.0; 3];
    config.imu.period_s = 0.05;
    config.imu.accel_noise_std_mps2 = [1.0; 3];
    config.imu.gyro_noise_std_radps = [1.0; 3];
    config.speed_steering.steering_noise_std_rad = 1.0;
    let mut run = Run::new(&config);
    let states = cavs(VEHICLES);
    let (now, next) = (run.tick(&states), run.tick(&states));
    let columns = |tick: &common::Tick| {
        let fixes: Vec<[f32; 3]> = tick.section("gnss_m");
        let imu: Vec<[f32; 14]> = tick.section("imu");
        let steering: Vec<[f32; 2]> = tick.section("speed_steering");
        let of = |i: usize| {
            let mut all = vec![
                f64::from(fixes[i][0]) - states[i].x_m,
                f64::from(fixes[i][1]) - states[i].y_m,
                f64::from(fixes[i][2]),
                f64::from(steering[i][1]),
            ];
            all.extend((0..14).filter(|i| i % 7 != 6).map(|axis| f64::from(imu[i][axis])));
            all
        };
        (0..VEHICLES as usize).map(of).collect::<Vec<_>>()
    };
    let (now, next) = (columns(&now), columns(&next));
    let n = f64::from(VEHICLES);
    let correlation = |a: &dyn Fn(usize) -> f64, b: &dyn Fn(usize) -> f64| {
        (0..VEHICLES as usize).map(|v| a(v) * b(v)).sum::<f64>() / n
    };
    for i in 0..16 {
        let variance = correlation(&|v| now[v][i], &|v| now[v][i]);
        assert!(
            (variance - 1.0).abs() < 5.0 * (2.0 / n).sqrt(),
            "variance {variance} of {i}"
        );
        for j in 0..16 {
            let beside = |v: usize| &now[(v + 1) % VEHICLES as usize];
            let next_vehicle = correlation(&|v| now[v][i], &|v| beside(v)[j]);
            let next_tick = correlation(&|v| now[v][i], &|v| next[v][j]);
            let others = if i == j {
                0.0
            } else {
                correlation(&|v| now[v][i], &|v| now[v][j])
            };
            for found in [next_vehicle, next_tick, others] {
                // 760 correlations: five and a half standard errors.
                assert!(found.abs() < 5.5 / n.sqrt(), "{found} between {i} and {j}");
            }
        }
    }
}

#[test]
fn scale_errors_are_constant_for_a_vehicle_and_differ_between_vehicles() {
    const VEHICLES: u32 = 3000;
    let mut config = quiet();
    config.speed_steering.speed_scale_std = 0.02;
    let mut run = Run::new(&config);
    let states = cavs(VEHICLES);
    let speeds = |run: &mut Run| run.tick(&states).section::<[f32; 2]>("speed_steering");
    let first = speeds(&mut run);
    assert_eq!(first, speeds(&mut run));
    let variance = first.iter().map(|s| (f64::from(s[0]) / 7.0 - 1.0).powi(2)).sum::<f64>() / f64::from(VEHICLES);
    assert!((variance.sqrt() / 0.02 - 1.0).abs() < 5.0 / (2.0 * f64::from(VEHICLES)).sqrt());
    run.restart(6);
    assert_ne!(first, speeds(&mut run), "another episode, other tyres");
}

#[test]
fn a_fast_imu_delivers_every_sample_and_the_newest_is_observed() {
    let mut config = quiet();
    config.imu.period_s = 0.02;
    let mut run = Run::new(&config);
    let states = cavs(2);
    let rows: Vec<SubStep> = (0..20_u8)
        .map(|i| SubStep {
            accel_body_mps2: [f32::from(i), 0.0, 0.0],
            ..SubStep::default()
        })
        .collect();
    let tick = run.tick_with(&states, &rows, |_| ());
    let samples: Vec<[f32; 7]> = tick.section("imu");
    let forward: Vec<f32> = samples.iter().map(|sample| sample[0]).collect();
    assert_eq!(forward, [0.5, 2.5, 4.5, 6.5, 8.5, 10.5, 12.5, 14.5, 16.5, 18.5]);
    let row = tick.section::<f32>("observation");
    assert!((row[2] - 8.5 / 20.0).abs() < 1e-6 && (row[11] - 18.5 / 20.0).abs() < 1e-6);
}

#[test]
fn a_slow_imu_samples_when_it_is_due_and_holds() {
    let mut config = config();
    config.imu.period_s = 0.3;
    let mut run = Run::new(&config);
    let all: Vec<[f32; 7]> = (0..6)
        .map(|_| run.tick(&cavs(1)).section::<[f32; 7]>("imu")[0])
        .collect();
    assert!(all[0] == all[1] && all[1] == all[2] && all[2] != all[3] && all[3] == all[5]);
    let normals = RandomStream {
        episode_seed: 5,
        id_hash: cavs(1)[0].id_hash,
        sensor: NoiseStream::ImuFront,
    }
    .normals(4);
    assert_eq!(all[3][0], 0.001 * normals[0], "the fourth tick's own numbers");
}
