//! Cost of sensing: GNSS, IMU, speed and steering, observation, for 5 000 vehicles on one core.
//! `cargo bench -p sensor-daemon`

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]
#![expect(clippy::panic, reason = "a benchmark that cannot run says why and ends")]

use std::time::Instant;

use ipc_schema::{
    config::Config,
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::ObservationLayout,
    run::MapInfo,
    world::VehicleState,
};
use sensor_daemon::sensing::{Sensing, World};

const VEHICLES: u32 = 5000;
const TICKS: u64 = 100;
const ROUNDS: usize = 5;

fn main() {
    // The default preset as the `caraware` command resolves it.
    let config: Config = serde_json::from_str(include_str!("../../ipc-schema/tests/town.json"))
        .unwrap_or_else(|error| panic!("town.json: {error}"));
    let map = MapInfo {
        projection: "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs".into(),
        net_offset_m: [-385_000.0, -5_815_000.0],
        bounds_m: [0.0, 0.0, 10_000.0, 10_000.0],
    };
    let states: Vec<VehicleState> = (0..VEHICLES)
        .map(|vehicle| VehicleState {
            x_m: f64::from(vehicle % 100) * 100.0,
            y_m: f64::from(vehicle / 100) * 200.0,
            id_hash: u64::from(vehicle) * 0x9E37_79B9_7F4A_7C15,
            vehicle,
            ..VehicleState::default()
        })
        .collect();
    let mut rounds: Vec<f64> = (0..ROUNDS).map(|_| round(&config, &map, &states)).collect();
    rounds.sort_by(f64::total_cmp);
    println!(
        "sensing: {:.3} µs per vehicle and tick (median of {ROUNDS}, {VEHICLES} vehicles, {TICKS} ticks)",
        rounds[ROUNDS / 2]
    );
}

/// Microseconds per vehicle and tick.
fn round(config: &Config, map: &MapInfo, states: &[VehicleState]) -> f64 {
    let mut sensing = Sensing::new(config, map).unwrap_or_else(|error| panic!("{error}"));
    let mut header = MessageHeader {
        flags: FIRST_OF_EPISODE,
        ..MessageHeader::default()
    };
    let n = sensing.assign(&header, states);
    let mut payload = vec![
        0_u64;
        ObservationLayout::new(n, sensing.width(), sensing.imu_samples())
            .len
            .div_ceil(8)
    ];
    let start = Instant::now();
    for tick in 0..TICKS {
        header.tick = tick;
        sensing.assign(&header, states);
        sensing
            .observe(
                &header,
                &World {
                    states,
                    ..World::default()
                },
                bytemuck::cast_slice_mut(&mut payload),
            )
            .unwrap_or_else(|error| panic!("{error}"));
        header.flags = 0;
    }
    start.elapsed().as_secs_f64() * 1e6 / (TICKS as f64 * f64::from(VEHICLES))
}
