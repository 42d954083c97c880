//! Points of a LIDAR, and configurations that it refuses.

#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping")]

use ipc_schema::config::Config;
use ipc_schema::pointcloud::{LidarPoint, Scan};
use ipc_schema::traffic::Kind;
use ipc_schema::world::{SubStep, VehicleState};
use lidar_city::exact_config;
use sensor_daemon::sensors::lidar::{LidarModel, ScanScratch, Targets};
use sim_core::scene::{Prism, Road, Scene, SolidClass};

mod disturbances;
mod hills;
#[path = "../lidar_city/mod.rs"]
mod lidar_city;
mod motion;
mod objects;
mod paths;
mod patterns;

const DATA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/");

/// A sensor of few rays at the origin of its carrier, 2 m up, without random errors.
fn small(channels: u32, columns: u64) -> Config {
    let mut config = exact_config();
    config.lidar.channels = channels;
    config.lidar.points_per_second = u64::from(channels) * columns * 10;
    config.lidar.mount = [0.0, 0.0, 2.0, 0.0, 0.0, 0.0];
    config.lidar.rolling_shutter = false;
    config.lidar.attenuation_per_m = 0.0;
    config
}

fn empty() -> Scene {
    Scene::new(Road::default(), Vec::new(), Vec::new())
}

fn car(number: u32, x: f64, y: f64, yaw: f64) -> VehicleState {
    VehicleState {
        x_m: x,
        y_m: y,
        yaw_rad: yaw,
        id_hash: u64::from(number) + 9,
        length_m: 4.0,
        width_m: 2.0,
        height_m: 1.5,
        rear_overhang_m: 1.0,
        vehicle: number,
        kind: Kind::Other as u32,
        ..VehicleState::default()
    }
}

fn block(outline: &[[f64; 2]], height_m: f64) -> Prism {
    Prism::new("block".into(), SolidClass::Building, outline.to_vec(), 0.0, height_m).unwrap()
}

fn rectangle(x: [f64; 2], y: [f64; 2], height_m: f64) -> Prism {
    block(&[[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]], height_m)
}

struct Scanned {
    scan: Scan,
    points: Vec<LidarPoint>,
}

fn scan_with(
    lidar: &LidarModel,
    states: &[VehicleState],
    steps: &[SubStep],
    k: usize,
    tick: u64,
    seed: u64,
) -> Scanned {
    let (mut targets, mut scan) = (Targets::default(), Scan::default());
    targets.update(states, steps, k);
    let mut points = vec![LidarPoint::default(); lidar.max_points()];
    let count = lidar.scan(
        &targets,
        0,
        tick,
        seed,
        &mut ScanScratch::default(),
        &mut scan,
        &mut points,
    );
    points.truncate(count);
    Scanned { scan, points }
}

fn scan(config: &Config, scene: &Scene, states: &[VehicleState]) -> Scanned {
    scan_with(&LidarModel::new(config, scene).unwrap(), states, &[], 0, 0, 1)
}

fn range(point: &LidarPoint) -> f64 {
    point
        .position_m
        .iter()
        .map(|part| f64::from(*part).powi(2))
        .sum::<f64>()
        .sqrt()
}

fn azimuth(point: &LidarPoint) -> f64 {
    f64::from(point.position_m[1]).atan2(f64::from(point.position_m[0]))
}
