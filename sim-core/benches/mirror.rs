//! Cost of the mirror: accepting SUMO's states, tracking with 10 sub-steps, and writing the `world` payload.
//!
//! `cargo bench -p sim-core --bench mirror [VEHICLES]…` prints microseconds per vehicle and tick on one core: the median
//! over the measured ticks, and the fastest.

#[path = "../tests/common/preset.rs"]
mod preset;

use std::{hint::black_box, time::Instant};

use ipc_schema::{
    config,
    header::MessageHeader,
    traffic::{Kind, MetaEvent, TrafficState, VehicleMeta},
};
use sim_core::mirror::{Mirror, MirrorSettings};

const TICKS: usize = 70;
const WARM_UP: usize = 20;
/// As in scenarios. Mirrors appear after so long: before the measured ticks.
const PREVIEW_S: f64 = 1.5;
const LENGTH_M: f64 = 4.5;

/// State on a circle or, for every third vehicle, on a straight, at a speed that changes with time.
fn state(vehicle: u32, time_s: f64) -> TrafficState {
    let v = f64::from(vehicle);
    let radius_m = if vehicle.is_multiple_of(3) {
        1e6
    } else {
        12.0 + f64::from(vehicle % 97)
    };
    let (mean, swing, rate) = ((2.5 * radius_m).sqrt().min(14.0), 1.5, 0.4);
    let distance_m = mean * time_s + swing / rate * (1.0 - (rate * time_s).cos());
    let angle = 0.1 * v + distance_m / radius_m;
    TrafficState {
        front_x_m: 20.0 * (v / 70.0).floor() + radius_m * angle.sin(),
        front_y_m: 20.0 * (v % 70.0) - radius_m * angle.cos(),
        yaw_rad: sim_core::trig::wrap_angle(angle - 0.5 * LENGTH_M / radius_m) as f32,
        speed_mps: (mean + swing * (rate * time_s).sin()) as f32,
        vehicle,
        ..TrafficState::default()
    }
}

/// `cavs` of ten vehicles are connected: with the default models these are dynamic, the others kinematic.
fn meta(vehicle: u32, cavs: u32) -> VehicleMeta {
    let mut meta: VehicleMeta = bytemuck::Zeroable::zeroed();
    let kind = if vehicle % 10 < cavs { Kind::Cav } else { Kind::Other };
    (meta.vehicle, meta.kind, meta.event) = (vehicle, kind as u32, MetaEvent::Departed as u32);
    meta.vehicle_class[..9].copy_from_slice(b"passenger");
    (meta.length_m, meta.width_m, meta.height_m) = (LENGTH_M as f32, 1.8, 1.5);
    meta.set_id(&vehicle.to_string());
    meta
}

fn settings(preview_s: f64) -> MirrorSettings {
    MirrorSettings {
        vehicle: config::VehicleConfig {
            preview_s,
            ..preset::town().vehicle
        },
        surface: config::Surface::Dry,
        tick_s: 0.1,
        sub_steps: 10,
        ticks_per_step: 1,
        hero_driver: config::HeroDriver::Actions,
        suites: None,
        wheel_slip: false,
        most_trailing: 100,
    }
}

fn measure(vehicles: u32, cavs: u32, preview_s: f64) {
    let mut mirror = match Mirror::new(settings(preview_s)) {
        Ok(mirror) => mirror,
        Err(error) => return eprintln!("{error}"),
    };
    let header = MessageHeader::default();
    let metas: Vec<VehicleMeta> = (0..vehicles).map(|vehicle| meta(vehicle, cavs)).collect();
    if let Err(error) = mirror.apply_meta(&header, &metas) {
        return eprintln!("{error}");
    }
    let mut payload: Vec<u128> = Vec::new();
    let mut costs_us = Vec::new();
    for tick in 0..TICKS {
        let states: Vec<TrafficState> = (0..vehicles).map(|v| state(v, tick as f64 * 0.1)).collect();
        let start = Instant::now();
        let accepted = mirror.accept(&header, &states);
        payload.resize(mirror.layout(0).len.div_ceil(16), 0);
        let written = mirror.write_tick(0, bytemuck::cast_slice_mut(&mut payload));
        let cost_us = start.elapsed().as_secs_f64() * 1e6 / f64::from(vehicles);
        if let Err(error) = accepted.and(written) {
            return eprintln!("{error}");
        }
        black_box(&payload);
        if tick >= WARM_UP {
            costs_us.push(cost_us);
        }
    }
    costs_us.sort_by(f64::total_cmp);
    let (median, least) = (costs_us[costs_us.len() / 2], costs_us[0]);
    println!(
        "mirror {vehicles:>6} vehicles, {:>3} % dynamic, preview {preview_s} s: median {median:.3} µs, fastest {least:.3} µs per vehicle and tick",
        10 * cavs
    );
    println!("       re-synchronised {}", mirror.resynchronisations());
}

fn main() {
    let wanted: Vec<u32> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let wanted = if wanted.is_empty() {
        vec![500, 5_000, 50_000]
    } else {
        wanted
    };
    for vehicles in wanted {
        // The town's default mix is 32 connected vehicles of 40.
        for (cavs, preview_s) in [(0, 0.0), (8, 0.0), (10, 0.0), (10, PREVIEW_S)] {
            measure(vehicles, cavs, preview_s);
        }
    }
}
