//! Ground of a net with elevation: the profile along each column against parry's triangles, where a profile is hard to follow.

use crate::{
    car, exact_config,
    lidar_city::{
        hilly,
        oracle::{WorldTick, compare, rays},
    },
    small,
};
use ipc_schema::{
    config::Config,
    pointcloud::{GROUND, LidarPoint, Scan},
    world::VehicleState,
};
use sensor_daemon::sensors::lidar::{LidarModel, ScanPath, ScanScratch, Targets};
use sim_core::scene::{Road, RoadPiece, Scene, SurfaceKind};

/// Hills with nothing on them.
fn bare() -> Scene {
    Scene::new(hilly().road().clone(), Vec::new(), Vec::new())
}

fn points(lidar: &LidarModel, states: &[VehicleState]) -> Vec<LidarPoint> {
    let (mut targets, mut scan) = (Targets::default(), Scan::default());
    targets.update(states, &[], 0);
    let mut points = vec![LidarPoint::default(); lidar.max_points()];
    let count = lidar.scan(&targets, 0, 3, 1, &mut ScanScratch::default(), &mut scan, &mut points);
    points.truncate(count);
    points
}

/// Scans of a carrier in these states, every ray against parry.
fn check(config: &Config, scene: &Scene, states: &[VehicleState]) {
    // A carrier does not see itself, and is the only road user: one world serves all.
    let world = WorldTick::new(config, scene, &states[..1], &[]);
    let lidar = LidarModel::new(config, scene).unwrap();
    for state in states {
        let scanned = points(&lidar, &[*state]);
        let totals = compare(&world, &rays(config, state, &[]), 0, &scanned);
        assert!(totals.hits * 4 > totals.rays, "{totals:?}");
        assert_eq!(totals.same + totals.grazing, totals.rays, "{totals:?} {state:?}");
        assert!(totals.grazing * 1000 <= totals.rays, "{totals:?} {state:?}");
    }
}

/// A sensor that sees 200 m, most of it ground.
fn far() -> Config {
    let mut config = small(64, 720);
    (config.lidar.lower_fov_deg, config.lidar.upper_fov_deg) = (-40.0, 10.0);
    config.lidar.range_m = 200.0;
    config
}

fn on_ground(scene: &Scene, x: f64, y: f64, yaw: f64) -> VehicleState {
    VehicleState {
        z_m: scene.ground_height_m(x, y),
        ..car(0, x, y, yaw)
    }
}

#[test]
fn open_country_is_seen_to_the_end_of_the_range() {
    let scene = bare();
    let states = [[13.0, 7.0], [-101.5, 58.2], [211.0, -160.0], [-330.0, 302.0]];
    let states = states.map(|[x, y]| VehicleState {
        roll_rad: 0.04,
        pitch_rad: -0.06,
        ..on_ground(&scene, x, y, 0.3 * x)
    });
    check(&far(), &scene, &states);
}

/// Columns along the edges and the diagonals of the triangles, from their corners and edges.
#[test]
fn lines_through_corners_do_not_break() {
    let scene = bare();
    // The lattice begins 100 m beyond the outermost streets: its corners are at multiples of 5 m.
    let places = [
        [0.0, 0.0],
        [50.0, -25.0],
        [52.5, 10.0],
        [10.0, 12.5],
        [2.5, 2.5],
        [7.4, 7.6],
    ];
    let states: Vec<_> = places
        .into_iter()
        .flat_map(|[x, y]| [0.0, 0.25, 0.5].map(|turn| on_ground(&scene, x, y, turn * std::f64::consts::PI)))
        .collect();
    check(&far(), &scene, &states);
}

#[test]
fn steep_leans_are_followed_or_cast_ray_by_ray() {
    let scene = bare();
    let leans = [
        [0.5, 0.0],
        [0.0, -0.9],
        [-0.7, 0.6],
        [1.0, 0.2],
        [1.2, 0.0],
        [3.1, 0.1],
        [0.0, 1.5],
    ];
    let mut config = far();
    config.lidar.range_m = 120.0;
    let carrier = [car(0, 0.0, 0.0, 0.0)];
    let world = WorldTick::new(&config, &scene, &carrier, &[]);
    let lidar = LidarModel::new(&config, &scene).unwrap();
    for [roll, pitch] in leans {
        let state = VehicleState {
            roll_rad: roll,
            pitch_rad: pitch,
            z_m: 3.0 + scene.ground_height_m(33.0, -46.0),
            ..car(0, 33.0, -46.0, 0.7)
        };
        let scanned = points(&lidar, &[state]);
        let totals = compare(&world, &rays(&config, &state, &[]), 0, &scanned);
        assert!(totals.hits > 1000, "{totals:?}");
        assert!(
            (totals.rays - totals.same) * 1000 <= totals.rays,
            "{totals:?} {roll} {pitch}"
        );
    }
}

#[test]
fn the_ground_ends_where_its_triangles_end() {
    let scene = bare();
    // The last corners are 100 m beyond the streets, which end at 420 m.
    let states = [[515.0, 3.0], [-519.0, -519.0], [470.0, 518.0]];
    let states = states.map(|[x, y]| VehicleState {
        pitch_rad: 0.02,
        ..on_ground(&scene, x, y, 0.4)
    });
    let mut config = far();
    config.lidar.upper_fov_deg = -1.0;
    check(&config, &scene, &states);
    // From beyond its edge, over it, and from far away.
    let lidar = LidarModel::new(&config, &scene).unwrap();
    for x in [560.0, 2000.0, 1e7] {
        let mut state = on_ground(&scene, x, 0.0, 0.0);
        state.z_m = 30.0;
        let scanned = points(&lidar, &[state]);
        let outside = |point: &LidarPoint| f64::from(point.position_m[0]) + x > 520.01;
        assert!(!scanned.iter().any(outside), "{x}");
        assert_eq!(scanned.is_empty(), x > 1000.0, "{x}");
    }
}

#[test]
fn below_the_ground_there_is_none() {
    let scene = bare();
    let mut state = on_ground(&scene, 20.0, 20.0, 0.0);
    state.z_m -= 10.0;
    let scanned = points(&LidarModel::new(&far(), &scene).unwrap(), &[state]);
    let height_m = |point: &LidarPoint| state.z_m + 2.0 + f64::from(point.position_m[2]);
    let above = |point: &&LidarPoint| {
        let [x, y, _] = point.position_m.map(f64::from);
        height_m(point) > scene.ground_height_m(20.0 + x, 20.0 + y) + 1.0
    };
    assert_eq!(scanned.iter().filter(above).count(), 0);
    assert!(
        scanned
            .iter()
            .all(|point| point.object == GROUND && point.position_m[2] < 0.0)
    );
}

#[test]
fn every_path_sees_the_same_bits() {
    let scene = hilly();
    let mut config = exact_config();
    config.lidar.mount[3..5].copy_from_slice(&[0.1, -0.2]);
    let mut states = vec![on_ground(&scene, 4.0, 30.0, 0.2), on_ground(&scene, 12.0, 38.0, 1.0)];
    states[1].vehicle = 1;
    let bytes = |path| {
        let lidar = LidarModel::new(&config, &scene).unwrap().with_path(path);
        bytemuck::cast_slice::<_, u8>(&points(&lidar, &states)).to_vec()
    };
    let plain = bytes(ScanPath::Plain);
    for path in ScanPath::ALL.into_iter().filter(|path| path.is_here()) {
        assert!(bytes(path) == plain, "{path:?}");
    }
}

/// Cells of a large map are larger, and no longer a whole number of metres.
#[test]
fn a_large_map_has_larger_cells() {
    let corners = [
        [0.0, 0.0, 0.0],
        [3000.0, 100.0, 90.0],
        [3100.0, 2900.0, 20.0],
        [-200.0, 2800.0, 140.0],
    ];
    let road = Road::new(vec![RoadPiece {
        id: "ring_0".into(),
        surface: SurfaceKind::Lane,
        shape_m: corners.to_vec(),
        half_width_m: Some(4.0),
        junctions: [u32::MAX; 2],
    }]);
    let scene = Scene::new(road, Vec::new(), Vec::new());
    let states = [[1500.0, 52.0], [-90.0, 1300.0]].map(|[x, y]| on_ground(&scene, x, y, 0.4));
    check(&far(), &scene, &states);
}
