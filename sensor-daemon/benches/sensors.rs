//! Cost of GNSS, IMU, speed and steering sensors and observations of 5 000 vehicles on one core: with the default preset, and with ten
//! IMU samples in a tick and all errors. `cargo bench -p sensor-daemon`

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]
#![expect(clippy::panic, reason = "a benchmark that cannot run panics with the reason")]

use std::time::Instant;

use ipc_schema::{
    config::{Config, Field, ImuConvention},
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::ObservationLayout,
    run::MapInfo,
    world::{SubStep, VehicleState},
};
use sensor_daemon::{
    noise::NormalDraws,
    noise::normals::BATCH,
    sensing::{Sensing, WorldTick},
    sensors::imu::{ImuModel, ImuMotion},
    wide::VectorPath,
};

const VEHICLES: u32 = 5000;
const SUB_STEPS: usize = 10;
const TICKS: u64 = 100;
const ROUNDS: usize = 9;

fn main() {
    // The default preset as the `caraware` command resolves it.
    let preset = Config::from_json(include_str!("../../ipc-schema/tests/town.json"))
        .unwrap_or_else(|error| panic!("town.json: {error}"));
    let fast = Config {
        imu: ipc_schema::config::ImuConfig {
            period_s: 0.01,
            ..preset.imu.clone()
        },
        ..preset.clone()
    };
    for (name, config) in [
        ("default preset", &preset),
        ("10 IMU samples, the preset's noise", &fast),
        ("10 IMU samples, everything on", &everything(&preset)),
    ] {
        let [median, least] = measured((0..ROUNDS).map(|_| round(config)));
        println!(
            "{name}: {median:.3} µs per vehicle and tick, least {least:.3} ({VEHICLES} vehicles, {TICKS} ticks, median of {ROUNDS})"
        );
    }
    let [median, least] = measured((0..ROUNDS).map(|_| imu_alone(&everything(&preset))));
    println!(
        "IMU alone, everything on: {:.1} million samples/s, most {:.1}",
        1.0 / median,
        1.0 / least
    );
}

/// Every error of GNSS, IMU, speed and steering, and blackouts of each.
fn everything(preset: &Config) -> Config {
    let mut config = preset.clone();
    config.gnss.noise_std_m = [1.0, 1.0, 2.0];
    config.gnss.bias_m = [0.5, -0.5, 1.0];
    config.gnss.correlated_std_m = [1.0, 1.0, 2.0];
    let imu = &mut config.imu;
    imu.period_s = 0.01;
    imu.convention = ImuConvention::SpecificForce;
    imu.accel_noise_density = [2e-3; 3];
    imu.accel_bias_mps2 = [0.05; 3];
    imu.accel_bias_walk = [1e-3; 3];
    imu.accel_resolution_mps2 = [1e-3; 3];
    imu.gyro_noise_density = [1e-4; 3];
    imu.gyro_bias_radps = [1e-3; 3];
    imu.gyro_bias_walk = [1e-5; 3];
    imu.gyro_resolution_radps = [1e-4; 3];
    imu.compass_noise_std_rad = 0.02;
    config.speed_steering.speed_scale_std = 0.01;
    config.speed_steering.steering_scale_std = 0.01;
    config.blackout.enabled = true;
    config.imu.blackout_length_s = [1.0, 5.0];
    config.speed_steering.blackout_length_s = [1.0, 5.0];
    config
        .observation
        .fields
        .extend([Field::Speed, Field::Steering, Field::GnssAge, Field::GnssValid]);
    config
}

/// Median and least.
fn measured(rounds: impl Iterator<Item = f64>) -> [f64; 2] {
    let mut rounds: Vec<f64> = rounds.collect();
    rounds.sort_by(f64::total_cmp);
    [rounds[rounds.len() / 2], rounds[0]]
}

fn states() -> Vec<VehicleState> {
    let states = (0..VEHICLES).map(|vehicle| VehicleState {
        x_m: f64::from(vehicle % 100) * 100.0,
        y_m: f64::from(vehicle / 100) * 200.0,
        yaw_rad: f64::from(vehicle) * 0.01,
        velocity_body_mps: [10.0, 0.0, 0.0],
        id_hash: u64::from(vehicle).wrapping_mul(0x9E37_79B9_7F4A_7C15),
        vehicle,
        ..VehicleState::default()
    });
    states.collect()
}

/// Microseconds per vehicle and tick.
fn round(config: &Config) -> f64 {
    let map = MapInfo {
        projection: "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs".into(),
        net_offset_m: [-385_000.0, -5_815_000.0],
        bounds_m: [0.0, 0.0, 10_000.0, 10_000.0],
        traffic_lights: 0,
        world_origin_m: [0.0; 2],
    };
    let mut sensing = Sensing::new(config, &map).unwrap_or_else(|error| panic!("{error}"));
    let states = states();
    let sub_steps = vec![SubStep::default(); states.len() * SUB_STEPS];
    let world = WorldTick {
        states: &states,
        bodies: &states,
        sub_steps: &sub_steps,
        views: &[],
    };
    let mut header = MessageHeader {
        flags: FIRST_OF_EPISODE,
        ..MessageHeader::default()
    };
    let n = sensing.assign(&header, &states).unwrap();
    let layout = ObservationLayout::new(n, sensing.width(), sensing.imu_samples());
    let mut payload = vec![0_u64; layout.len.div_ceil(8)];
    let start = Instant::now();
    for tick in 0..TICKS {
        header.tick = tick;
        header.sim_time_ns = (tick + 1) * 100_000_000;
        sensing.assign(&header, &states).unwrap();
        sensing
            .observe(&header, &world, bytemuck::cast_slice_mut(&mut payload))
            .unwrap_or_else(|error| panic!("{error}"));
        header.flags = 0;
    }
    start.elapsed().as_secs_f64() * 1e6 / (TICKS as f64 * f64::from(VEHICLES))
}

/// Microseconds per sample of the IMU, including its random numbers: 16 vehicles, ten samples a tick.
fn imu_alone(config: &Config) -> f64 {
    const RUNS: u32 = 5000;
    let unit = ImuModel::new(&config.imu, SUB_STEPS, config.run.tick_s);
    let mut draws = NormalDraws::default();
    let rows = [SubStep::default(); SUB_STEPS];
    let body = ImuMotion {
        yaw_rad: 1.0,
        rows: &rows,
    };
    let ids: [u64; BATCH] = std::array::from_fn(|member| member as u64);
    let (mut walks, mut out) = ([[0.0; 8]; BATCH], [[0.0; 7]; SUB_STEPS]);
    let start = Instant::now();
    for run in 0..RUNS {
        draws.clear();
        unit.plan(&mut draws, run);
        draws.draw(1, &ids);
        for (member, walk) in walks.iter_mut().enumerate() {
            unit.sample(VectorPath::widest(), &body, draws.of(member), walk, &mut out);
            std::hint::black_box(&out);
        }
    }
    start.elapsed().as_secs_f64() * 1e6 / (f64::from(RUNS) * (SUB_STEPS * BATCH) as f64)
}
