//! Cost of the rigid-body model: one hero, 10 sub-steps a tick.
//!
//! `cargo bench -p sim-core --bench rigid_body` prints microseconds per vehicle and tick on one core: the median over the
//! measured ticks, and the fastest.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a measurement asserts by unwrapping"
)]

#[path = "../tests/common/preset.rs"]
mod preset;

use std::{hint::black_box, time::Instant};

use ipc_schema::config;
use sim_core::models::{
    parameters::ParameterCatalogue,
    rigid_body::{RigidBody, RigidState},
    state::{ControlInput, ModelState},
};

const TICKS: u32 = 2000;
const SUB_STEPS: u32 = 10;
const DT_S: f64 = 0.005;

fn main() {
    let limits = config::VehicleConfig {
        max_accel_mps2: 6.0,
        max_decel_mps2: 10.0,
        ..preset::town().vehicle
    };
    let catalogue = ParameterCatalogue::new().unwrap();
    let set = &catalogue.sets()[catalogue.choose(b"passenger", 4.8).set];
    let body = set.dimensions(4.8, 1.8, 1.5);
    let mut vehicle = RigidBody::new(set, &body, &limits, 1.0, DT_S).unwrap();
    let mut state: RigidState = ModelState::new(0.0, 0.0, 0.0, 15.0).into();
    let mut ticks_us: Vec<f64> = (0..TICKS)
        .map(|tick| {
            let t = f64::from(tick * SUB_STEPS) * DT_S;
            let input = ControlInput {
                accel_mps2: 2.0 * (0.7 * t).sin(),
                road_wheel_angle_rad: 0.05 * t.sin(),
            };
            let start = Instant::now();
            for _ in 0..SUB_STEPS {
                state = vehicle.step(&state, black_box(&input), 0.01).0;
            }
            start.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    ticks_us.sort_by(f64::total_cmp);
    println!(
        "{SUB_STEPS} sub-steps: {:.2} us per vehicle and tick (median), {:.2} us (fastest); end {:.1} m/s",
        ticks_us[ticks_us.len() / 2],
        ticks_us[0],
        state.level.speed_mps,
    );
}
