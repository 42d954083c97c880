//! Objects that points lie on: tags, the own body, meshes, the nearest objects, and every point on the surface of its object.

use crate::lidar_city::{Moves, traffic};
use crate::{DATA, car, empty, lidar_city, range, rectangle, scan, scan_with, small};
use ipc_schema::config::{LidarAxes, LidarMode};
use ipc_schema::pointcloud::{GROUND, STATIC_OBJECT, Tag};
use ipc_schema::traffic::Kind;
use ipc_schema::world::VehicleState;
use proptest::prelude::*;
use sensor_daemon::sensors::lidar::{LidarModel, nearest_objects};
use sim_core::scene::{Road, RoadPiece, Scene, SurfaceKind};

#[test]
fn the_own_body_is_not_seen_and_others_are() {
    let config = small(32, 360);
    let states = [car(0, 0.0, 0.0, 0.0), car(7, 10.0, 0.0, 0.0)];
    let scanned = scan(&config, &empty(), &states);
    assert!(scanned.points.iter().all(|point| point.object != 0));
    let seen: Vec<_> = scanned.points.iter().filter(|point| point.object == 7).collect();
    assert!(seen.len() > 20);
    // Its rear is 1 m behind its origin; its roof is seen from above.
    let nearest = seen
        .iter()
        .map(|point| point.position_m[0])
        .fold(f32::INFINITY, f32::min);
    assert!((nearest - 9.0).abs() < 1e-3, "{nearest}");
    assert!(
        seen.iter()
            .any(|point| (point.position_m[2] + 0.5).abs() < 1e-4 && point.position_m[0] > 9.5)
    );
    assert!(seen.iter().all(|point| point.tag == Tag::Vehicle as u16));
}

#[test]
fn tags_name_the_kind_of_object() {
    let config = small(32, 720);
    let mut person = car(1, 0.0, 5.0, 0.0);
    (person.kind, person.length_m, person.width_m, person.height_m) = (Kind::Person as u32, 0.5, 0.4, 1.8);
    let mut bicycle = car(2, 0.0, -5.0, 0.0);
    bicycle.width_m = 0.6;
    let scene = empty();
    let props = [
        "parked_car 6 0 90",
        "tree -5 0",
        "sign -5 4",
        "cone 5 5",
        "crate 5 -5",
        "bin -5 -5",
    ]
    .map(|text| scene.prop(&text.parse().unwrap()));
    let buildings = vec![rectangle([15.0, 16.0], [-3.0, 3.0], 9.0)];
    let scene = Scene::new(Road::default(), buildings, props.to_vec());
    let scanned = scan(&config, &scene, &[car(0, 0.0, 0.0, 0.0), person, bicycle]);
    let tags = [
        Tag::Ground,
        Tag::Building,
        Tag::TwoWheeler,
        Tag::Person,
        Tag::Barrier,
        Tag::Furniture,
        Tag::Pole,
        Tag::Vegetation,
        Tag::ParkedVehicle,
        Tag::Load,
    ];
    for tag in tags {
        assert!(scanned.points.iter().any(|point| point.tag == tag as u16), "{tag:?}");
    }
    let building = scanned
        .points
        .iter()
        .find(|point| point.tag == Tag::Building as u16)
        .unwrap();
    assert_eq!(building.object, STATIC_OBJECT);
    let parked = scanned
        .points
        .iter()
        .find(|point| point.tag == Tag::ParkedVehicle as u16)
        .unwrap();
    assert_eq!(parked.object, STATIC_OBJECT | 1);
}

#[test]
fn interest_keeps_road_users_and_the_props_named() {
    let mut config = small(32, 360);
    config.lidar.mode = LidarMode::Interest;
    config.lidar.interest_props = vec!["cone".parse().unwrap()];
    let scene = empty();
    let props = ["cone 5 5", "tree -5 0"].map(|text| scene.prop(&text.parse().unwrap()));
    let buildings = vec![rectangle([-20.0, -18.0], [-30.0, 30.0], 9.0)];
    let scene = Scene::new(Road::default(), buildings, props.to_vec());
    // A car in the open, and one behind the building.
    let states = [car(0, 0.0, 0.0, 0.0), car(1, 10.0, 0.0, 0.0), car(2, -25.0, 0.0, 0.0)];
    let scanned = scan(&config, &scene, &states);
    let mut seen: Vec<u32> = scanned.points.iter().map(|point| point.object).collect();
    seen.sort_unstable();
    seen.dedup();
    assert_eq!(seen, [1, STATIC_OBJECT | 1]);
}

#[test]
fn meshes_and_ground_with_elevation_are_seen() {
    let mut config = small(16, 360);
    config.scene.meshes = vec![format!("{DATA}wall.obj 5 0 0").parse().unwrap()];
    let states = [car(0, 0.0, 0.0, 0.0), car(1, -9.0, 0.0, 0.0)];
    let scanned = scan(&config, &empty(), &states);
    let mesh: Vec<_> = scanned
        .points
        .iter()
        .filter(|point| point.tag == Tag::Mesh as u16)
        .collect();
    assert!(!mesh.is_empty());
    assert!(
        mesh.iter()
            .all(|point| point.object == STATIC_OBJECT && (point.position_m[0] - 7.0).abs() < 1e-4)
    );
    assert!(scanned.points.iter().any(|point| point.object == 1));
    // A road that climbs by 10 %.
    let road = Road::new(vec![RoadPiece {
        id: "hill_0".into(),
        surface: SurfaceKind::Lane,
        shape_m: vec![[-50.0, 0.0, 0.0], [50.0, 0.0, 10.0]],
        half_width_m: Some(60.0),
        junctions: [u32::MAX; 2],
    }]);
    let scene = Scene::new(road, Vec::new(), Vec::new());
    config.scene.meshes.clear();
    let mut carrier = car(0, 0.0, 0.0, 0.0);
    carrier.z_m = 5.0;
    let scanned = scan(&config, &scene, &[carrier]);
    let ground: Vec<_> = scanned.points.iter().filter(|point| range(point) < 30.0).collect();
    assert!(ground.len() > 500);
    for point in ground {
        assert_eq!((point.object, point.tag), (GROUND, Tag::Ground as u16));
        let [x, _, z] = point.position_m.map(f64::from);
        assert!((z - 0.1 * x + 2.0).abs() < 0.02, "{x} {z}");
    }
}

#[test]
fn the_observation_has_the_nearest_objects() {
    let mut config = small(32, 720);
    config.lidar.mount = [1.0, 0.0, 2.0, 0.0, 0.0, 0.0];
    let scene = empty();
    let prop = scene.prop(&"tree 0 6".parse().unwrap());
    let scene = Scene::new(
        Road::default(),
        vec![rectangle([-4.0, -3.0], [-3.0, 3.0], 5.0)],
        vec![prop],
    );
    let states = [car(0, 0.0, 0.0, 0.0), car(1, 10.0, 0.0, 0.0), car(2, 0.0, -9.0, 0.0)];
    let lidar = LidarModel::new(&config, &scene).unwrap();
    let scanned = scan_with(&lidar, &states, &[], 0, 0, 1);
    let [first, second, third, fourth] = nearest_objects(&scanned.points, &lidar);
    let near = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).abs() < 0.1 && (a[1] - b[1]).abs() < 0.1;
    assert!(
        near(first, [0.0, 5.8]) && near(second, [0.0, -8.0]) && near(third, [9.0, 0.0]),
        "{first:?} {second:?} {third:?}"
    );
    assert_eq!(fourth, [100.0, 100.0]);
    config.lidar.axes = LidarAxes::Paper;
    let lidar = LidarModel::new(&config, &scene).unwrap();
    let scanned = scan_with(&lidar, &states, &[], 0, 0, 1);
    assert!(near(nearest_objects(&scanned.points, &lidar)[0], [0.0, 5.8]));
    assert_eq!(nearest_objects(&[], &lidar), [[100.0; 2]; 4]);
}

/// Distance of a point from the surface of an object, metres.
fn off_surface_m(scene: &Scene, states: &[VehicleState], object: u32, [x, y, z]: [f64; 3]) -> f64 {
    use sim_core::scene::shape::{distance, edges, nearest_on_segment};
    if object == GROUND {
        return z.abs();
    }
    let of = |off_outline: f64, is_inside: bool, low: f64, high: f64| {
        let wall = off_outline.abs().max(low - z).max(z - high);
        let cap = (z - low)
            .abs()
            .min((z - high).abs())
            .max(if is_inside { 0.0 } else { off_outline.abs() });
        wall.min(cap)
    };
    if object & STATIC_OBJECT != 0 {
        let building = &scene.buildings()[(object & !STATIC_OBJECT) as usize];
        let to_edge = |(a, b)| distance(nearest_on_segment(a, b, [x, y]), [x, y]);
        let off = edges(&building.outline_m).map(to_edge).fold(f64::INFINITY, f64::min);
        let [low, high] = building.z_m();
        return of(off, building.contains([x, y]), low, high);
    }
    let state = states.iter().find(|state| state.vehicle == object).unwrap();
    let (dx, dy) = (x - state.x_m, y - state.y_m);
    let high = state.z_m + f64::from(state.height_m);
    if state.kind == Kind::Person as u32 {
        let off = dx.hypot(dy) - 0.5 * f64::from(state.width_m.max(state.length_m));
        return of(off, off < 0.0, state.z_m, high);
    }
    let (sin, cos) = state.yaw_rad.sin_cos();
    let half = 0.5 * f64::from(state.length_m);
    let ahead = (dx * cos + dy * sin - half + f64::from(state.rear_overhang_m)).abs() - half;
    let aside = (dy * cos - dx * sin).abs() - 0.5 * f64::from(state.width_m);
    of(ahead.max(aside), ahead.max(aside) < 0.0, state.z_m, high)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Without noise every point lies on the surface of the object that it names.
    #[test]
    fn every_point_lies_on_its_object(
        x in -60.0_f64..60.0, y in -60.0_f64..60.0, z in 0.0_f64..30.0, yaw in -3.0_f64..3.0, roll in -0.3_f32..0.3, pitch in -0.3_f32..0.3, seed in 0_u64..99,
    ) {
        let config = small(32, 180);
        let scene = lidar_city::scene(60, seed);
        let (mut states, _) = traffic(60, 20, Moves::Straight, 0, seed);
        states.iter_mut().for_each(|state| (state.x_m, state.y_m) = (state.x_m * 0.3, state.y_m * 0.3));
        (states[0].x_m, states[0].y_m, states[0].z_m) = (x, y, z);
        (states[0].yaw_rad, states[0].roll_rad, states[0].pitch_rad) = (yaw, roll, pitch);
        let scanned = scan(&config, &scene, &states);
        let sensor = scanned.scan.position_m;
        let [roll, pitch, yaw] = scanned.scan.attitude_rad;
        let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), pitch.sin_cos(), yaw.sin_cos());
        for point in &scanned.points {
            let [a, b, c] = point.position_m.map(f64::from);
            let (b, c) = (b * cr - c * sr, b * sr + c * cr);
            let (a, c) = (a * cp - c * sp, a * sp + c * cp);
            let place = [sensor[0] + a * cy - b * sy, sensor[1] + a * sy + b * cy, sensor[2] + c];
            prop_assert!(off_surface_m(&scene, &states, point.object, place) < 2e-3, "{point:?}");
            prop_assert!((0.0..=1.0).contains(&point.incidence_cos));
        }
    }
}
