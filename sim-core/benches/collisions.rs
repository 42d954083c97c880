//! Cost of the search for contacts: every connected vehicle against all road users and objects, without contacts; and of loading
//! scenes.
//!
//! `cargo bench -p sim-core --bench collisions [VEHICLES]…` prints microseconds per vehicle and tick on one core: the median over the
//! measured ticks, and the fastest. With `NET[,ADDITIONAL…]` arguments it prints how long these files take to load as a scene.

use std::{hint::black_box, sync::Arc, time::Instant};

use ipc_schema::{
    run::{MapInfo, SceneFiles},
    traffic::Kind,
    world::{COLLIDED, VehicleState},
};
use sim_core::{
    collision::CollisionDetector,
    scene::{Prism, Road, Scene, SolidClass},
};

const TICKS: usize = 120;
const WARM_UP: usize = 20;
/// Side of a block of houses with the street around it, metres.
const BLOCK_M: f64 = 90.0;
/// Vehicles on each street between two crossings, one lane each way.
const ON_STREET: u32 = 8;

/// Rotation of the whole grid of streets.
const TURN_RAD: f64 = 0.5;

/// Streets along both axes in turn, rotated so that rectangles about vehicles are large; gaps of 3 to 7 m move with time.
fn state(vehicle: u32, time_s: f64, blocks: u32) -> VehicleState {
    let (street, place) = (vehicle / ON_STREET, vehicle % ON_STREET);
    let (column, row, is_up) = (street / 2 % blocks, street / 2 / blocks, street % 2 == 1);
    let lane = place % 2;
    let along_m = 8.0 + 10.0 * f64::from(place) + (0.3 * time_s + f64::from(vehicle)).sin();
    let across_m = if lane == 0 { -1.75 } else { 1.75 };
    let corner = [f64::from(column) * BLOCK_M, f64::from(row) * BLOCK_M];
    let (x, y) = if is_up {
        (corner[0] - across_m, corner[1] + along_m)
    } else {
        (corner[0] + along_m, corner[1] + across_m)
    };
    let heading = f64::from(u32::from(is_up)) * std::f64::consts::FRAC_PI_2 + f64::from(lane) * std::f64::consts::PI;
    let (sin, cos) = TURN_RAD.sin_cos();
    VehicleState {
        x_m: x * cos - y * sin,
        y_m: x * sin + y * cos,
        yaw_rad: sim_core::trig::wrap_angle(heading + TURN_RAD),
        velocity_body_mps: [8.0, 0.0, 0.0],
        length_m: 4.5,
        width_m: 1.8,
        height_m: 1.5,
        rear_overhang_m: 0.9,
        vehicle,
        kind: Kind::Cav as u32,
        ..VehicleState::default()
    }
}

/// Four houses along each side of every block.
fn houses(blocks: u32, rows: u32) -> Vec<Prism> {
    let (sin, cos) = TURN_RAD.sin_cos();
    let turned = |[x, y]: [f64; 2]| [x * cos - y * sin, x * sin + y * cos];
    let mut houses = Vec::new();
    for block in 0..blocks * rows {
        let corner = [f64::from(block % blocks) * BLOCK_M, f64::from(block / blocks) * BLOCK_M];
        for house in 0..16 {
            let (side, place) = (house / 4, f64::from(house % 4));
            let (x, y) = (8.0 + 19.0 * place, 8.0);
            let at = match side {
                0 => [x, y],
                1 => [x, BLOCK_M - y - 12.0],
                2 => [y, x + 1.0],
                _ => [BLOCK_M - y - 12.0, x + 1.0],
            };
            let [x, y] = [corner[0] + at[0], corner[1] + at[1]];
            let outline = [[x, y], [x + 14.0, y], [x + 14.0, y + 12.0], [x, y + 12.0]].map(turned);
            houses.extend(Prism::new(
                house.to_string(),
                SolidClass::Building,
                outline.into(),
                0.0,
                9.0,
            ));
        }
    }
    houses
}

fn measure(vehicles: u32) {
    let streets = vehicles.div_ceil(ON_STREET);
    let blocks = f64::from(streets.div_ceil(2)).sqrt().ceil() as u32;
    let scene = Arc::new(Scene::new(Road::default(), houses(blocks, blocks), Vec::new()));
    let buildings = scene.buildings().len();
    let mut detector = CollisionDetector::new(scene);
    let mut costs_us = Vec::new();
    let mut contacts = 0;
    for tick in 0..TICKS {
        let mut states: Vec<VehicleState> = (0..vehicles).map(|v| state(v, tick as f64 * 0.1, blocks)).collect();
        let start = Instant::now();
        detector.detect(0, &mut states);
        let cost_us = start.elapsed().as_secs_f64() * 1e6 / f64::from(vehicles);
        contacts += black_box(&states)
            .iter()
            .filter(|state| state.flags & COLLIDED != 0)
            .count();
        if tick >= WARM_UP {
            costs_us.push(cost_us);
        }
    }
    costs_us.sort_by(f64::total_cmp);
    let (median, least) = (costs_us[costs_us.len() / 2], costs_us[0]);
    println!(
        "collisions {vehicles:>6} vehicles, {buildings} buildings: median {median:.3} µs, fastest {least:.3} µs per vehicle and tick; {contacts} contacts"
    );
}

fn load(files: &str) {
    let mut files = files.split(',');
    let files = SceneFiles {
        net_file: files.next().unwrap_or_default().into(),
        additional_files: files.map(Into::into).collect(),
    };
    let map = MapInfo {
        projection: "!".into(),
        net_offset_m: [0.0; 2],
        bounds_m: [0.0; 4],
        traffic_lights: 0,
        world_origin_m: [0.0; 2],
    };
    let mut costs_ms = Vec::new();
    for _ in 0..9 {
        let start = Instant::now();
        match Scene::read(&files, &map, 8.0) {
            Ok(scene) => {
                costs_ms.push(start.elapsed().as_secs_f64() * 1e3);
                if costs_ms.len() == 9 {
                    costs_ms.sort_by(f64::total_cmp);
                    println!(
                        "{}: {} pieces of road, {} buildings in {:.1} ms (median of 9)",
                        files.net_file.display(),
                        scene.road().pieces().len(),
                        scene.buildings().len(),
                        costs_ms[4]
                    );
                }
            }
            Err(error) => return eprintln!("{error}"),
        }
    }
}

fn main() {
    let wanted: Vec<String> = std::env::args()
        .skip(1)
        .filter(|argument| !argument.starts_with('-'))
        .collect();
    if wanted.is_empty() {
        [500, 5_000, 50_000].into_iter().for_each(measure);
    }
    for argument in wanted {
        match argument.parse() {
            Ok(vehicles) => measure(vehicles),
            Err(_) => load(&argument),
        }
    }
}
