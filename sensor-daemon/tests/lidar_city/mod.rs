//! A dense test city: blocks of buildings, half of them not convex, between streets full of moving vehicles and persons. It also holds
//! the rays of a LIDAR in double precision, computed without the library under test. Tests and `lidar-bench` share it.

#![allow(
    dead_code,
    clippy::unwrap_used,
    reason = "each test uses a part; tests assert by unwrapping"
)]

use ipc_schema::{
    config::Config,
    traffic::Kind,
    world::{SubStep, VehicleState},
};
use sim_core::scene::{Prism, Road, RoadPiece, Scene, SolidClass, SurfaceKind, shape::contains};

pub mod oracle;

/// Distance of two streets, metres.
const PITCH_M: f64 = 50.0;
/// Blocks in a row.
const BLOCKS: usize = 16;
/// Sub-steps of a tick.
pub const SUB_STEPS: usize = 10;
/// Length of a tick, seconds.
pub const TICK_S: f64 = 0.1;

/// A small generator of numbers in 0 … 1 (SplitMix64).
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + self.next() * (high - low)
    }
}

/// The default configuration with the LIDAR that measurements use: 32 × 1800 rays, 100 m.
pub fn config() -> Config {
    let mut config = Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap();
    config.lidar.vehicles = 16;
    config
}

/// The same configuration without random errors, and with every return.
pub fn exact_config() -> Config {
    let mut config = config();
    config.lidar.range_noise_std_m = 0.0;
    config.lidar.dropoff = 0.0;
    config.lidar.dropoff_zero_intensity = 0.0;
    config.lidar.min_range_m = 0.0;
    config
}

/// Motion of the vehicles.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Moves {
    /// Along the street, upright.
    Straight,
    /// Turning, rolling and pitching.
    Wildly,
}

/// `buildings` buildings in blocks of two: boxes, and Ls and Us by turns.
pub fn scene(buildings: usize, seed: u64) -> Scene {
    let mut random = Random(seed);
    let prisms = (0..buildings).map(|number| {
        let (block, half) = (number / 2, number % 2);
        let corner = [block % BLOCKS, block / BLOCKS].map(|i| PITCH_M * (i as f64 - BLOCKS as f64 / 2.0) + 10.0);
        let x = corner[0] + 15.5 * half as f64;
        let (w, d) = (random.between(12.0, 14.5), random.between(24.0, 30.0));
        let local: Vec<[f64; 2]> = match number % 4 {
            0 | 1 => vec![[0.0, 0.0], [w, 0.0], [w, d], [0.0, d]],
            2 => vec![
                [0.0, 0.0],
                [w, 0.0],
                [w, 0.4 * d],
                [0.5 * w, 0.4 * d],
                [0.5 * w, d],
                [0.0, d],
            ],
            _ => vec![
                [0.0, 0.0],
                [w, 0.0],
                [w, d],
                [0.7 * w, d],
                [0.7 * w, 0.3 * d],
                [0.3 * w, 0.35 * d],
                [0.3 * w, d],
                [0.0, d],
            ],
        };
        let turn = random.between(-0.03, 0.03);
        let outline = local.iter().map(|[a, b]| {
            [
                x + a * turn.cos() - b * turn.sin(),
                corner[1] + a * turn.sin() + b * turn.cos(),
            ]
        });
        // One in eight is low enough to be looked down on by a sensor on a roof.
        let height = if number % 8 == 5 {
            random.between(1.0, 1.9)
        } else {
            random.between(7.0, 25.0)
        };
        let id = format!("building {number}");
        Prism::new(id, SolidClass::Building, outline.collect(), 0.0, height).unwrap()
    });
    Scene::new(Default::default(), prisms.collect(), Vec::new())
}

/// The test city on hills: streets that rise and fall by up to 8 m, and buildings whose lowest corner is on the ground.
pub fn hilly() -> Scene {
    let height_m = |x: f64, y: f64| 4.0 * (x / 55.0).sin() + 4.0 * (y / 70.0).cos();
    let streets = (0..17).flat_map(|street| [(street, false), (street, true)]);
    let pieces = streets.map(|(street, is_north)| {
        let across = 50.0 * (f64::from(street) - 8.0);
        let at = |step: u32| {
            let along = 10.0 * f64::from(step) - 420.0;
            let [x, y] = if is_north { [across, along] } else { [along, across] };
            [x, y, height_m(x, y)]
        };
        RoadPiece {
            id: format!("street{street}{is_north}_0"),
            surface: SurfaceKind::Lane,
            shape_m: (0..85).map(at).collect(),
            half_width_m: Some(4.0),
            junctions: [0; 2],
        }
    });
    let bare = Scene::new(Road::new(pieces.collect()), Vec::new(), Vec::new());
    let buildings = scene(500, 1).buildings().to_vec().into_iter().map(|building| {
        let heights_m = building.outline_m.iter().map(|[x, y]| bare.ground_height_m(*x, *y));
        let base_m = heights_m.fold(f64::INFINITY, f64::min);
        Prism::new(
            building.id,
            building.class,
            building.outline_m,
            base_m,
            building.height_m,
        )
        .unwrap()
    });
    Scene::new(bare.road().clone(), buildings.collect(), Vec::new())
}

/// The test city on hills with a viaduct of 8 m width over the street in its middle.
pub fn bridged() -> Scene {
    let hills = hilly();
    let at = |step: u32| {
        let x = 20.0 * f64::from(step) - 380.0;
        [x, 0.0, 15.0 + 2.0 * (x / 90.0).sin()]
    };
    let mut pieces = hills.road().pieces().to_vec();
    pieces.push(RoadPiece {
        id: "viaduct_0".into(),
        surface: SurfaceKind::Lane,
        shape_m: (0..39).map(at).collect(),
        half_width_m: Some(4.0),
        junctions: [1; 2],
    });
    Scene::new(Road::new(pieces), hills.buildings().to_vec(), Vec::new())
}

/// Rows of vehicles on the viaduct and below it, some of each.
pub fn carriers_at_the_bridge(scene: &Scene, moves: Moves, seed: u64) -> Vec<usize> {
    let (mut states, _) = traffic(200, 60, moves, 0, seed);
    stand_on(scene, &mut states);
    let at_bridge = |state: &VehicleState| deck_at(scene, state).is_some() && state.kind == Kind::Cav as u32;
    let (mut above, mut below) = (Vec::new(), Vec::new());
    for (row, state) in states.iter().enumerate().filter(|(_, state)| at_bridge(state)) {
        let is_above = state.z_m > scene.ground_height_m(state.x_m, state.y_m) + 1.0;
        if is_above { &mut above } else { &mut below }.push(row);
    }
    assert!(!above.is_empty() && !below.is_empty(), "{above:?} {below:?}");
    [&above[..above.len().min(2)], &below[..below.len().min(2)]].concat()
}

/// Top of the deck above or below a road user, metres.
fn deck_at(scene: &Scene, state: &VehicleState) -> Option<f64> {
    let place = [state.x_m, state.y_m];
    let deck = scene.decks().iter().find(|deck| contains(&deck.outline_m, place));
    deck.map(|deck| deck.z_m[1])
}

/// Parts of a vehicle, as shares of its length from the rear and of its height: those of docs/camera.md.
pub fn parts(state: &VehicleState) -> Vec<[f64; 4]> {
    match (state.length_m, state.height_m) {
        (length, height) if length >= 10.0 && height < 3.7 => vec![[0.0, 1.0, 0.0, 1.0]],
        (length, height) if length >= 6.0 || height > 2.1 => vec![[0.0, 0.78, 0.0, 1.0], [0.78, 1.0, 0.0, 0.85]],
        _ => vec![[0.0, 1.0, 0.0, 0.55], [0.08, 0.72, 0.55, 1.0]],
    }
}

/// Puts road users onto the ground, and every second one that is at a deck onto that.
pub fn stand_on(scene: &Scene, states: &mut [VehicleState]) {
    for state in states {
        state.z_m = match deck_at(scene, state) {
            Some(deck_m) if state.vehicle % 2 == 0 => deck_m,
            _ => scene.ground_height_m(state.x_m, state.y_m),
        };
    }
}

/// Vehicles and persons in the streets at the end of tick `tick`, with their sub-steps.
pub fn traffic(
    vehicles: usize,
    persons: usize,
    moves: Moves,
    tick: u64,
    seed: u64,
) -> (Vec<VehicleState>, Vec<SubStep>) {
    let mut random = Random(seed);
    let (mut states, mut steps) = (Vec::new(), Vec::new());
    for number in 0..vehicles + persons {
        let is_person = number >= vehicles;
        let is_north = random.next() < 0.5;
        let street = PITCH_M * ((random.next() * BLOCKS as f64).floor() - BLOCKS as f64 / 2.0);
        let along = random.between(-0.45, 0.45) * PITCH_M * BLOCKS as f64;
        let side = if random.next() < 0.5 { 1.0 } else { -1.0 };
        let speed = if is_person { 1.4 } else { random.between(0.0, 14.0) };
        let across = side * if is_person { 6.0 } else { 2.0 };
        let heading =
            f64::from(is_north) * std::f64::consts::FRAC_PI_2 + if side > 0.0 { std::f64::consts::PI } else { 0.0 };
        let yaw = heading + random.between(-0.05, 0.05);
        let along = along - side * speed * TICK_S * tick as f64;
        let place = if is_north {
            [street - across, along]
        } else {
            [along, street + across]
        };
        let wild = moves == Moves::Wildly && !is_person;
        let turning = if wild { random.between(-0.6, 0.6) } else { 0.0 };
        let lean: [f64; 2] = if wild {
            [random.between(-0.04, 0.04), random.between(-0.04, 0.04)]
        } else {
            [0.0; 2]
        };
        let length = if is_person {
            0.5
        } else if number % 9 == 4 {
            12.0
        } else {
            random.between(3.8, 5.0)
        };
        let height = if is_person {
            1.75
        } else if number % 9 == 4 {
            3.1
        } else {
            random.between(1.4, 1.95)
        };
        states.push(VehicleState {
            x_m: place[0],
            y_m: place[1],
            yaw_rad: yaw,
            roll_rad: lean[0] as f32,
            pitch_rad: lean[1] as f32,
            id_hash: 77 + number as u64,
            length_m: length as f32,
            width_m: if is_person { 0.5 } else { 1.8 },
            height_m: height as f32,
            rear_overhang_m: if is_person { 0.0 } else { 0.9 },
            vehicle: number as u32,
            kind: if is_person { Kind::Person } else { Kind::Cav } as u32,
            ..VehicleState::default()
        });
        for step in 1..=SUB_STEPS {
            let t = TICK_S * (step as f64 / SUB_STEPS as f64 - 1.0);
            let way = yaw + 0.5 * turning * t;
            steps.push(SubStep {
                dx_m: (speed * t * way.cos()) as f32,
                dy_m: (speed * t * way.sin()) as f32,
                dyaw_rad: (turning * t) as f32,
                roll_rad: (lean[0] * (1.0 + t)) as f32,
                pitch_rad: (lean[1] * (1.0 - t)) as f32,
                speed_mps: speed as f32,
                angular_rate_body_radps: [lean[0] as f32, lean[1] as f32, turning as f32],
                ..SubStep::default()
            });
        }
    }
    (states, steps)
}
