//! Delivery over distance, channel load and age of information in a grid of streets with houses between them, and the cost of it.
//!
//! `cargo bench -p v2x --bench exchange -- [STATIONS …] [--threads=N] [--cam]`: CAMs alone, then CAMs and CPMs (not with `--cam`). The hash
//! is over every block of neighbours: what is computed in another way has the same.

#![allow(clippy::unwrap_used, reason = "a measurement asserts by unwrapping")]

use std::{sync::Arc, time::Instant};

use ipc_schema::{
    config::Config,
    header::{FIRST_OF_EPISODE, MessageHeader},
    neighbours::{NEIGHBOUR_COLUMNS, NEIGHBOUR_ID_COLUMNS, NeighboursSections, RADIO_COLUMNS},
    run::MapInfo,
    usage,
    world::VehicleState,
};
use sim_core::{
    geodesy::Projection,
    scene::{Prism, Road, Scene, SolidClass},
};
use v2x::{
    exchange::{MessageExchange, SlotMeasurement},
    radio::{
        obstruction::{Antenna, Obstacles},
        path_loss::LinkState,
    },
    station::OwnMeasurement,
};

/// Distance between two streets, metres.
const BLOCK_M: f64 = 100.0;
/// Width of a street between the houses, metres.
const STREET_M: f64 = 20.0;
/// Vehicles on a kilometre of street.
const VEHICLES_PER_KM: f64 = 25.0;
/// Simulated seconds that are measured, after one that is not.
const SECONDS: u64 = 5;
/// Width of a bin of distances, metres.
const BIN_M: f64 = 50.0;

/// Streets to the east and north around square houses, as many as `stations` vehicles need.
struct StreetGrid {
    streets: usize,
    side_m: f64,
}

impl StreetGrid {
    fn new(stations: usize) -> Self {
        // 2 n streets of n blocks have 2 n² blocks of street.
        let blocks = stations as f64 / (VEHICLES_PER_KM * BLOCK_M / 1000.0);
        let streets = (blocks / 2.0).sqrt().ceil().max(1.0) as usize;
        Self {
            streets,
            side_m: streets as f64 * BLOCK_M,
        }
    }

    fn houses(&self) -> Vec<Prism> {
        let side_m = BLOCK_M - STREET_M;
        let corner = |number: usize| number as f64 * BLOCK_M + 0.5 * STREET_M;
        let house = |place: usize| {
            let [x, y] = [corner(place % self.streets), corner(place / self.streets)];
            let outline = vec![[x, y], [x + side_m, y], [x + side_m, y + side_m], [x, y + side_m]];
            Prism::new(format!("house.{place}"), SolidClass::Building, outline, 0.0, 12.0).unwrap()
        };
        (0..self.streets * self.streets).map(house).collect()
    }

    /// A vehicle at a time: it drives along its street at 8 to 14 m/s and begins again at its end.
    fn vehicle(&self, number: usize, time_s: f64) -> VehicleState {
        let street = number / 2 % self.streets;
        let speed_mps = 8.0 + (number * 7 % 13) as f64 * 0.5;
        let along_m = ((number * 7919) as f64 * 1.37 + speed_mps * time_s).rem_euclid(self.side_m);
        let across_m = street as f64 * BLOCK_M + if (number / 4).is_multiple_of(2) { -2.0 } else { 2.0 };
        let (x_m, y_m, yaw_rad) = match number % 2 {
            0 => (along_m, across_m, 0.0),
            _ => (across_m, along_m, std::f64::consts::FRAC_PI_2),
        };
        let is_lorry = number.is_multiple_of(15);
        VehicleState {
            x_m,
            y_m,
            yaw_rad,
            id_hash: (number as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15),
            velocity_body_mps: [speed_mps as f32, 0.0, 0.0],
            length_m: if is_lorry { 10.0 } else { 4.5 },
            width_m: if is_lorry { 2.5 } else { 1.8 },
            height_m: if is_lorry { 3.5 } else { 1.5 },
            rear_overhang_m: 1.0,
            vehicle: number as u32,
            ..VehicleState::default()
        }
    }
}

#[derive(Default, Clone, Copy)]
struct Delivery {
    sent: u64,
    received: u64,
}

/// FNV-1a over bytes.
fn hash(before: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(before, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01B3)
    })
}

fn measure(stations: usize, perception_range_m: f64, threads: u32) {
    let grid = StreetGrid::new(stations);
    let mut config: Config = serde_json::from_str(include_str!("../../ipc-schema/tests/town.json")).unwrap();
    config.v2x.share = 1.0;
    config.v2x.threads = threads;
    config.v2x.perception_range_m = perception_range_m;
    let map = MapInfo {
        projection: "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs".into(),
        net_offset_m: [0.0; 2],
        world_origin_m: [0.0; 2],
        bounds_m: [0.0, 0.0, grid.side_m, grid.side_m],
        traffic_lights: 0,
    };
    let scene = Arc::new(Scene::new(Road::default(), grid.houses(), Vec::new()));
    let mut exchange = MessageExchange::new(&config, vec![(Arc::clone(&scene), Projection::new(&map).unwrap())]);
    let mut obstacles = Obstacles::new(&scene);
    let nearest = config.v2x.neighbours as usize;
    let mut bins = [[Delivery::default(); 10]; 3];
    let (mut work_s, mut wall_s, mut load, mut age_s, mut known) = (0.0, 0.0, 0.0, Vec::new(), 0_u64);
    let mut blocks = 0xCBF2_9CE4_8422_2325;
    let mut before = exchange.counts();
    for tick in 0..(SECONDS + 1) * 10 {
        let states: Vec<VehicleState> = (0..stations)
            .map(|number| grid.vehicle(number, tick as f64 * 0.1))
            .collect();
        let slots: Vec<SlotMeasurement> = states
            .iter()
            .map(|state| SlotMeasurement {
                vehicle: state.vehicle,
                id_hash: state.id_hash,
                episode_step: tick as u32,
                own: Some(OwnMeasurement {
                    fix_m: [state.x_m, state.y_m],
                    accuracy_m: Some(1.0),
                    speed_mps: state.velocity_body_mps[0].into(),
                    heading_rad: state.yaw_rad,
                    ..OwnMeasurement::default()
                }),
            })
            .collect();
        let header = MessageHeader {
            flags: if tick == 0 { FIRST_OF_EPISODE } else { 0 },
            episode_seed: 5,
            tick,
            sim_time_ns: tick * 100_000_000,
            ..MessageHeader::default()
        };
        let (mut objects, mut ids) = (
            vec![[0.0; NEIGHBOUR_COLUMNS]; stations * nearest],
            vec![[0; NEIGHBOUR_ID_COLUMNS]; stations * nearest],
        );
        let (mut radio, mut channel_load, mut vehicle) = (
            vec![[0; RADIO_COLUMNS]; stations],
            vec![0.0; stations],
            vec![0; stations],
        );
        let mut sections = NeighboursSections {
            objects: &mut objects,
            ids: &mut ids,
            radio: &mut radio,
            channel_load: &mut channel_load,
            vehicle: &mut vehicle,
        };
        let (start_s, start) = (usage::processor_time_s(), Instant::now());
        exchange.receive(&header, &slots, &states, &mut sections);
        exchange.send(&header, &slots, &states);
        let took_s = usage::processor_time_s() - start_s;
        let passed_s = start.elapsed().as_secs_f64();
        blocks = hash(blocks, bytemuck::cast_slice(&objects));
        blocks = hash(blocks, bytemuck::cast_slice(&ids));
        blocks = hash(blocks, bytemuck::cast_slice(&radio));
        blocks = hash(blocks, bytemuck::cast_slice(&channel_load));
        if tick < 10 {
            before = exchange.counts();
            continue;
        }
        work_s += took_s;
        wall_s += passed_s;
        load += channel_load.iter().map(|load| f64::from(*load)).sum::<f64>() / stations as f64;
        let rows = objects.iter().zip(&ids).filter(|(_, ids)| ids[2] != 0);
        age_s.extend(rows.map(|(numbers, _)| numbers[7]));
        known += radio.iter().map(|radio| u64::from(radio[1])).sum::<u64>();
        // Delivery is counted outside the measured time.
        if tick % 10 == 0 {
            obstacles.update(&states);
            count(&exchange, &obstacles, &states, &mut bins);
        }
    }
    let counts = exchange.counts();
    let per_s = |count: u64| count as f64 / SECONDS as f64;
    let links = counts.links - before.links;
    age_s.sort_unstable_by(f32::total_cmp);
    let share = |share: f64| age_s[((age_s.len() - 1) as f64 * share) as usize];
    println!(
        "{stations} stations, {} with {threads} thread(s): {:.2} ms of processor time and {:.2} ms per simulated second ({:.1} x real time), {:.0} links/s, {:.0} ns a link; hash {blocks:016x}",
        if perception_range_m > 0.0 { "CAM and CPM" } else { "CAM" },
        1e3 * work_s / SECONDS as f64,
        1e3 * wall_s / SECONDS as f64,
        SECONDS as f64 / wall_s,
        per_s(links),
        1e9 * work_s / links as f64,
    );
    println!(
        "  {:.1} CAM/s and {:.1} CPM/s a station, {:.0} bytes a message, {} dropped; channel busy ratio {:.3}; age of a listed object \
         median {:.2} s, 95 % {:.2} s; {:.1} objects known",
        per_s(counts.cams - before.cams) / stations as f64,
        per_s(counts.cpms - before.cpms) / stations as f64,
        (counts.bytes - before.bytes) as f64 / (counts.cams + counts.cpms - before.cams - before.cpms) as f64,
        counts.dropped - before.dropped,
        load / (SECONDS * 10) as f64,
        share(0.5),
        share(0.95),
        known as f64 / (SECONDS * 10) as f64 / stations as f64,
    );
    for (name, bins) in ["line of sight", "behind vehicles", "behind houses"].iter().zip(bins) {
        let shares: Vec<String> = bins
            .iter()
            .map(|bin| match bin.sent {
                0 => "-".into(),
                sent => format!("{:.3}", bin.received as f64 / sent as f64),
            })
            .collect();
        println!("  delivery by {BIN_M} m, {name}: {}", shares.join(" "));
    }
}

/// Counts what was delivered of the messages of the last tick, by state of the link and distance.
fn count(exchange: &MessageExchange, obstacles: &Obstacles, states: &[VehicleState], bins: &mut [[Delivery; 10]; 3]) {
    let antenna = |slot: usize| Antenna {
        position_m: obstacles.bodies()[slot].centre_m,
        z_m: f64::from(states[slot].height_m) + 0.1,
        row: slot as u32,
    };
    for (number, sender) in exchange.senders().enumerate() {
        let from = antenna(sender);
        for receiver in (0..states.len()).filter(|receiver| *receiver != sender) {
            let to = antenna(receiver);
            let [dx, dy] = [0, 1].map(|axis: usize| to.position_m[axis] - from.position_m[axis]);
            let bin = (dx.hypot(dy) / BIN_M) as usize;
            if bin >= 10 {
                continue;
            }
            let row = match obstacles.between(&from, &to).state {
                LinkState::Clear => 0,
                LinkState::Vehicles => 1,
                LinkState::Building => 2,
            };
            let is_received = exchange.received_by(receiver).binary_search(&(number as u32)).is_ok();
            bins[row][bin].sent += 1;
            bins[row][bin].received += u64::from(is_received);
        }
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let counts: Vec<usize> = arguments.iter().filter_map(|argument| argument.parse().ok()).collect();
    let counts = if counts.is_empty() { vec![250, 1000] } else { counts };
    let threads = arguments
        .iter()
        .find_map(|argument| argument.strip_prefix("--threads="));
    let threads = threads.map_or(1, |count| count.parse().unwrap());
    for stations in counts {
        measure(stations, 0.0, threads);
        if !arguments.iter().any(|argument| argument == "--cam") {
            measure(stations, 80.0, threads);
        }
    }
}
