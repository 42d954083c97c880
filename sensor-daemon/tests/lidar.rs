//! What a LIDAR delivers, and what it refuses.

#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping")]

use ipc_schema::{
    config::{Config, LidarAxes, LidarMode},
    failure::Failure,
    pointcloud::{GROUND, LidarPoint, STATIC_OBJECT, Scan, Tag},
    props::Obstacle,
    traffic::Kind,
    world::{SubStep, VehicleState},
};
use proptest::prelude::*;
use sensor_daemon::lidar::{Lidar, LidarError, Path, Scratch, Targets, nearest_objects};
use sim_core::{
    scene::{Piece, Prism, Road, Scene, SolidClass, Surface},
    spherical::top_view_from_lidar,
};

mod lidar_city;
use lidar_city::{Moves, SUB_STEPS, exact_config, traffic};

const DATA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/");

/// A sensor of few rays at the origin of its carrier, 2 m up, without anything random.
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

fn scan_with(lidar: &Lidar, states: &[VehicleState], steps: &[SubStep], k: usize, tick: u64, seed: u64) -> Scanned {
    let (mut targets, mut scan) = (Targets::default(), Scan::default());
    targets.update(states, steps, k);
    let mut points = vec![LidarPoint::default(); lidar.max_points()];
    let count = lidar.scan(&targets, 0, tick, seed, &mut Scratch::default(), &mut scan, &mut points);
    points.truncate(count);
    Scanned { scan, points }
}

fn scan(config: &Config, scene: &Scene, states: &[VehicleState]) -> Scanned {
    scan_with(&Lidar::new(config, scene).unwrap(), states, &[], 0, 0, 1)
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

fn elevations(pattern: &str) -> Vec<f64> {
    let mut config = small(1, 8);
    config.lidar.pattern = pattern.into();
    config.lidar.range_m = 1000.0;
    // In a pit with walls as high as the sky, every ray returns.
    let ring = |r: f64| [[-r, -r], [r, -r], [r, r], [-r, r]];
    let [a, b, c, d] = ring(5.0);
    let [e, f, g, h] = ring(6.0);
    let walls = [[a, b, f, e], [b, c, g, f], [c, d, h, g], [d, a, e, h]].map(|outline| block(&outline, 500.0));
    let scene = Scene::new(Road::default(), walls.to_vec(), Vec::new());
    let lidar = Lidar::new(&config, &scene).unwrap();
    let scanned = scan_with(&lidar, &[car(0, 0.0, 0.0, 0.0)], &[], 0, 0, 1);
    let lasers = lidar.max_points() / lidar.columns();
    assert_eq!(scanned.points.len(), lidar.max_points(), "{pattern}");
    let elevation = |point: &LidarPoint| (f64::from(point.position_m[2]) / range(point)).asin().to_degrees();
    assert!((0..lasers).all(|laser| usize::from(scanned.points[laser].channel) == laser));
    scanned.points[..lasers].iter().map(elevation).collect()
}

#[test]
fn every_unit_has_the_elevations_of_its_manual() {
    let expected = [
        ("vlp16", 16, -15.0, 15.0),
        ("hdl32e", 32, -30.67, 10.67),
        ("hdl64e", 64, -24.33, 2.0),
        ("pandar40p", 40, -25.0, 15.0),
        ("os1_32", 32, -22.5, 22.5),
        ("os1_64", 64, -22.5, 22.5),
        ("os1_128", 128, -21.2, 21.2),
        ("vls128", 128, -25.0, 15.0),
    ];
    for (name, lasers, lowest, highest) in expected {
        let table = elevations(name);
        assert_eq!(table.len(), lasers, "{name}");
        assert!(
            (table[0] - lowest).abs() < 0.01 && (table[lasers - 1] - highest).abs() < 0.01,
            "{name}: {table:?}"
        );
        assert!(table.is_sorted_by(|a, b| a < b), "{name}: the lowest laser is number 0");
    }
    let table = elevations("vlp16");
    assert!(table.windows(2).all(|two| (two[1] - two[0] - 2.0).abs() < 1e-4));
    let table = elevations("pandar40p");
    assert!((table[10] + 6.0).abs() < 1e-4 && (table[11] - table[10] - 1.0 / 3.0).abs() < 1e-4);
    let table = elevations("hdl64e");
    assert!((table[31] + 8.83).abs() < 1e-4 && (table[32] + 8.33).abs() < 1e-4);
}

#[test]
fn an_empty_scene_is_ground_alone() {
    let config = small(16, 100);
    let scanned = scan(&config, &empty(), &[car(0, 5.0, 6.0, 1.0)]);
    // Of 16 lasers from −30° to 10°, eleven look down by more than 1.15° and reach the ground within 100 m.
    assert_eq!(scanned.points.len(), 11 * 100);
    assert_eq!(scanned.scan.rays, 1600);
    assert_eq!(scanned.scan.position_m, [5.0, 6.0, 2.0]);
    for point in &scanned.points {
        assert_eq!((point.object, point.tag, point.age_us), (GROUND, Tag::Ground as u16, 0));
        assert!((f64::from(point.position_m[2]) + 2.0).abs() < 1e-4);
        assert!((f64::from(point.incidence_cos) - 2.0 / range(point)).abs() < 1e-5);
    }
}

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
fn tags_tell_what_a_point_lies_on() {
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
    .map(|text| scene.prop(&Obstacle::parse(text).unwrap()));
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
    config.lidar.interest_props = vec!["cone".into()];
    let scene = empty();
    let props = ["cone 5 5", "tree -5 0"].map(|text| scene.prop(&Obstacle::parse(text).unwrap()));
    let buildings = vec![rectangle([-20.0, -18.0], [-30.0, 30.0], 9.0)];
    let scene = Scene::new(Road::default(), buildings, props.to_vec());
    // A car in the open, and one behind the building.
    let states = [car(0, 0.0, 0.0, 0.0), car(1, 10.0, 0.0, 0.0), car(2, -25.0, 0.0, 0.0)];
    let scanned = scan(&config, &scene, &states);
    let mut seen: Vec<u32> = scanned.points.iter().map(|point| point.object).collect();
    seen.sort_unstable();
    seen.dedup();
    assert_eq!(seen, [1, STATIC_OBJECT | 1]);
    config.lidar.interest_props = vec!["unicorn".into()];
    assert!(matches!(Lidar::new(&config, &scene), Err(LidarError::Prop { .. })));
}

/// Figure 3: y backward, x left, z down. A car 10 m ahead is at y = −10; equation 4 with the heading brings (−y, x) into the world.
#[test]
fn equation_4_and_the_papers_axes() {
    let mut config = small(32, 360);
    let states = [
        car(0, 100.0, 50.0, 0.7),
        car(1, 100.0 + 10.0 * 0.7_f64.cos(), 50.0 + 10.0 * 0.7_f64.sin(), 0.7),
    ];
    let forward = scan(&config, &empty(), &states);
    config.lidar.axes = LidarAxes::Paper;
    let paper = scan(&config, &empty(), &states);
    assert_eq!((forward.scan.axes, paper.scan.axes), (0, 1));
    assert_eq!(forward.points.len(), paper.points.len());
    for (f, p) in forward.points.iter().zip(&paper.points) {
        assert_eq!([-p.position_m[1], p.position_m[0], -p.position_m[2]], f.position_m);
    }
    let point = paper.points.iter().find(|point| point.object == 1).unwrap();
    let [x, y, z] = point.position_m.map(f64::from);
    assert!(y < -8.9 && z > 0.0);
    let [east, north] = top_view_from_lidar(states[0].yaw_rad, [-y, x]);
    // The world's plane in the frame of the other car: its rear is 1 m behind its origin, its half width 1 m.
    let (dx, dy) = (
        states[0].x_m + east - states[1].x_m,
        states[0].y_m + north - states[1].y_m,
    );
    let (sin, cos) = states[1].yaw_rad.sin_cos();
    let (ahead, left) = (dx * cos + dy * sin, dy * cos - dx * sin);
    assert!((ahead + 1.0).abs() < 1e-3 && left.abs() < 1.001, "{ahead} {left}");
}

#[test]
fn a_tick_may_be_part_of_a_rotation_or_several() {
    let mut config = small(4, 0);
    config.lidar.rotation_hz = 2.5;
    config.lidar.points_per_second = 4 * 101 * 10 / 4;
    let lidar = Lidar::new(&config, &empty()).unwrap();
    assert_eq!(lidar.columns(), 26, "101 columns in four ticks");
    let mut columns = 0;
    for tick in 0..8 {
        let scanned = scan_with(&lidar, &[car(0, 0.0, 0.0, 0.0)], &[], 0, tick, 1);
        let quarter = std::f64::consts::FRAC_PI_2 * (tick % 4) as f64;
        assert!(
            (f64::from(scanned.scan.azimuth_rad) - quarter).abs() < 0.07,
            "{}",
            scanned.scan.azimuth_rad
        );
        columns += scanned.scan.rays / 4;
    }
    assert_eq!(columns, 2 * 101);
    config.lidar.rotation_hz = 30.0;
    config.lidar.points_per_second = 4 * 100 * 30;
    let scanned = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    assert_eq!(scanned.scan.rays, 4 * 300);
    config.lidar.rotation_hz = 7.0;
    assert!(matches!(
        Lidar::new(&config, &empty()),
        Err(LidarError::Rotation { .. })
    ));
}

#[test]
fn three_rotations_in_a_tick_see_everything_three_times() {
    let mut config = small(16, 300);
    config.lidar.rotation_hz = 30.0;
    config.lidar.points_per_second = 16 * 300 * 30;
    let states = [car(0, 0.0, 0.0, 0.3), car(1, 8.0, 1.0, 0.0), car(2, -9.0, 2.0, 1.0)];
    let scanned = scan(&config, &empty(), &states);
    let third = scanned.points.len() / 3;
    for place in 0..third {
        let all = [0, 1, 2].map(|turn| scanned.points[place + turn * third].position_m);
        assert!(all[0] == all[1] && all[1] == all[2]);
    }
}

#[test]
fn a_field_of_view_is_about_straight_ahead() {
    let mut config = small(8, 360);
    config.lidar.horizontal_fov_deg = 90.0;
    config.lidar.rolling_shutter = true;
    let states = [car(0, 0.0, 0.0, 0.4), car(1, 6.0, 2.0, 0.0)];
    let lidar = Lidar::new(&config, &empty()).unwrap();
    assert_eq!(lidar.columns(), 91);
    let scanned = scan_with(&lidar, &states, &[], 0, 0, 1);
    assert_eq!(scanned.scan.rays, 8 * 91);
    assert!(
        scanned
            .points
            .iter()
            .all(|point| azimuth(point).abs() < 45.1_f64.to_radians())
    );
    assert!(
        scanned.points.iter().any(|point| azimuth(point) < -0.7)
            && scanned.points.iter().any(|point| azimuth(point) > 0.7)
    );
    assert!(scanned.points.iter().any(|point| point.object == 1));
}

/// Steps of a road user that moves straight at a constant velocity.
fn straight(velocity: [f64; 2], yaw_rate: f64, yaw: f64) -> Vec<SubStep> {
    (1..=10)
        .map(|i| {
            let t = 0.01 * f64::from(i) - 0.1;
            let (sin, cos) = (yaw + yaw_rate * t).sin_cos();
            SubStep {
                dx_m: (velocity[0] * t) as f32,
                dy_m: (velocity[1] * t) as f32,
                dyaw_rad: (yaw_rate * t) as f32,
                speed_mps: (velocity[0] * cos + velocity[1] * sin) as f32,
                lateral_speed_mps: (velocity[1] * cos - velocity[0] * sin) as f32,
                angular_rate_body_radps: [0.0, 0.0, yaw_rate as f32],
                ..SubStep::default()
            }
        })
        .collect()
}

#[test]
fn a_moving_target_is_where_it_was_when_its_azimuth_fired() {
    let mut config = small(32, 1800);
    config.lidar.rolling_shutter = true;
    // Abeam to the right (three quarters of the tick) a car drives past at 20 m/s.
    let states = [car(0, 0.0, 0.0, 0.0), car(1, 0.0, -8.0, 0.0)];
    let steps = [straight([0.0; 2], 0.0, 0.0), straight([20.0, 0.0], 0.0, 0.0)].concat();
    let lidar = Lidar::new(&config, &empty()).unwrap();
    let scanned = scan_with(&lidar, &states, &steps, 10, 0, 1);
    let seen: Vec<_> = scanned.points.iter().filter(|point| point.object == 1).collect();
    assert!(seen.len() > 100);
    for point in &seen {
        let age = f64::from(point.age_us) * 1e-6;
        let fired = (azimuth(point).rem_euclid(std::f64::consts::TAU) / std::f64::consts::TAU) * 0.1 + 0.1 / 1800.0;
        assert!((0.1 - age - fired).abs() < 2e-6, "fired by azimuth");
        let x = f64::from(point.position_m[0]) + 20.0 * age;
        assert!((-1.001..=3.001).contains(&x), "{x}");
    }
    // Its whole length is seen: from rear to front bumper, by columns 2.8 cm apart.
    let along: Vec<f64> = seen
        .iter()
        .map(|point| f64::from(point.position_m[0]) + 20.0 * f64::from(point.age_us) * 1e-6)
        .collect();
    let (least, most) = along
        .iter()
        .fold((9.0_f64, -9.0_f64), |(a, b), x| (a.min(*x), b.max(*x)));
    assert!(least < -0.95 && most > 2.95, "{least} {most}");
}

#[test]
fn a_wall_seen_from_a_turning_car_is_straight() {
    let mut config = small(16, 1800);
    config.lidar.rolling_shutter = true;
    let (rate, velocity) = (0.8, [10.0, 3.0]);
    let scene = Scene::new(
        Road::default(),
        vec![rectangle([12.0, 13.0], [-90.0, 90.0], 30.0)],
        Vec::new(),
    );
    let steps = straight(velocity, rate, 0.5);
    let lidar = Lidar::new(&config, &scene).unwrap();
    let scanned = scan_with(&lidar, &[car(0, 0.0, 0.0, 0.5)], &steps, 10, 0, 1);
    let mut seen = 0;
    for point in scanned.points.iter().filter(|point| point.object == STATIC_OBJECT) {
        let t = -f64::from(point.age_us) * 1e-6;
        let (sin, cos) = (0.5 + rate * t).sin_cos();
        let [x, y] = [0, 1].map(|axis: usize| f64::from(point.position_m[axis]));
        let world = velocity[0] * t + x * cos - y * sin;
        // Half a microsecond of rounding in the age, the precision of the wire, and 8·10⁻⁶ rad of heading.
        assert!((world - 12.0).abs() < 2e-3, "{world}");
        seen += 1;
    }
    assert!(seen > 3000);
}

#[test]
fn noise_has_the_level_that_is_asked_for() {
    let mut config = small(32, 1800);
    config.lidar.range_noise_std_m = 0.05;
    let exact = scan(&small(32, 1800), &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    let noisy = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    let errors: Vec<f64> = exact
        .points
        .iter()
        .zip(&noisy.points)
        .map(|(a, b)| range(b) - range(a))
        .collect();
    let n = errors.len() as f64;
    let mean = errors.iter().sum::<f64>() / n;
    let std = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    assert!(mean.abs() < 5.0 * 0.05 / n.sqrt(), "{mean}");
    assert!((std / 0.05 - 1.0).abs() < 5.0 / (2.0 * n).sqrt(), "{std}");
    // Neighbours, and the two rays of one draw, are independent.
    for apart in [1, 16, 27] {
        let pairs = errors.iter().zip(&errors[apart..]);
        let correlation = pairs.map(|(a, b)| a * b).sum::<f64>() / n / 0.05_f64.powi(2);
        assert!(correlation.abs() < 5.0 / n.sqrt(), "{apart}: {correlation}");
    }
}

#[test]
fn intensity_falls_with_range_and_weak_returns_get_lost() {
    let mut config = small(32, 1800);
    config.lidar.attenuation_per_m = 0.02;
    let all = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    for point in &all.points {
        assert!((f64::from(point.intensity) / (-0.02 * range(point)).exp() - 1.0).abs() < 1e-5);
    }
    config.lidar.dropoff = 0.25;
    config.lidar.dropoff_intensity = 0.8;
    config.lidar.dropoff_zero_intensity = 0.4;
    let some = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    for channel in [0_u16, 12, 20] {
        let of = |scanned: &Scanned| scanned.points.iter().filter(|point| point.channel == channel).count() as f64;
        let point = all.points.iter().find(|point| point.channel == channel).unwrap();
        let weak = 0.4 * (1.0 - f64::from(point.intensity) / 0.8).max(0.0);
        let kept = 0.75 * (1.0 - weak);
        let share = of(&some) / of(&all);
        assert!(
            (share - kept).abs() < 5.0 * (kept * (1.0 - kept) / of(&all)).sqrt(),
            "{channel}: {share} of {kept}"
        );
    }
}

#[test]
fn rain_fog_and_sun_disturb() {
    let mut config = small(32, 1800);
    config.lidar.attenuation_per_m = 0.0;
    let clear = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    config.weather.rain_mmph = 10.0;
    let rain = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    // e^(−2 α d) (range / d)² falls to 1 at d = 44.3 m for α = 0.039 81 1/m, range 100 m.
    let farthest = rain.points.iter().map(range).fold(0.0, f64::max);
    assert!(rain.points.len() < clear.points.len() && farthest < 32.0, "{farthest}");
    config.weather.rain_mmph = 0.0;
    config.weather.visibility_m = 100.0;
    let fog = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    let point = fog.points[0];
    assert!(point.intensity < 0.9 && fog.points.len() < clear.points.len());
    config.weather.visibility_m = 50_000.0;
    config.weather.sunlight = 1.0;
    config.weather.sun_elevation_deg = 5.0;
    let sunny = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    let noise = |towards_sun: bool| {
        let errors = clear
            .points
            .iter()
            .zip(&sunny.points)
            .filter(|(a, _)| (a.position_m[1] < 0.0) == towards_sun);
        let errors: Vec<f64> = errors.map(|(a, b)| (range(b) - range(a)).abs()).collect();
        errors.iter().sum::<f64>() / errors.len() as f64
    };
    assert!(
        noise(true) > 0.01 && noise(false) < 1e-5,
        "{} {}",
        noise(true),
        noise(false)
    );
}

/// The bits of a scan of everything at once: noise, loss, weather, persons, wild motion.
fn busy(path: Path, pattern: &str, order: bool, scratch: &mut Scratch) -> Vec<u8> {
    let mut config = lidar_city::config();
    config.lidar.pattern = pattern.into();
    config.lidar.ray_table = format!("{DATA}rays.csv");
    config.lidar.dropoff = 0.1;
    config.weather.rain_mmph = 2.0;
    config.weather.sunlight = 0.5;
    let scene = lidar_city::scene(500, 1);
    let moves = if pattern == "uniform" {
        Moves::Straight
    } else {
        Moves::Wildly
    };
    let (mut states, mut steps) = traffic(200, 60, moves, 0, 2);
    if !order {
        // The same road users in another order, the carrier in front.
        let k = SUB_STEPS;
        let rows: Vec<usize> = std::iter::once(0).chain((1..states.len()).rev()).collect();
        steps = rows
            .iter()
            .flat_map(|row| steps[row * k..(row + 1) * k].to_vec())
            .collect();
        states = rows.iter().map(|row| states[*row]).collect();
    }
    let lidar = Lidar::new(&config, &scene).unwrap().with_path(path);
    let (mut targets, mut scan) = (Targets::default(), Scan::default());
    targets.update(&states, &steps, SUB_STEPS);
    let mut points = vec![LidarPoint::default(); lidar.max_points()];
    let count = lidar.scan(&targets, 0, 3, 1, scratch, &mut scan, &mut points);
    assert!(count > 0 && lidar.path() == path);
    [bytemuck::bytes_of(&scan), bytemuck::cast_slice(&points[..count])].concat()
}

#[test]
fn every_path_gives_the_same_bits() {
    for pattern in ["uniform", "hdl64e", "pandar40p", "table"] {
        let expected = busy(Path::Plain, pattern, true, &mut Scratch::default());
        for path in Path::ALL.into_iter().filter(|path| path.is_here()) {
            assert!(
                busy(path, pattern, true, &mut Scratch::default()) == expected,
                "{path:?} {pattern}"
            );
        }
    }
}

#[test]
fn neither_the_order_of_targets_nor_used_scratch_matters() {
    let mut scratch = Scratch::default();
    let expected = busy(Path::best(), "uniform", true, &mut scratch);
    let _ = busy(Path::best(), "os1_128", true, &mut scratch);
    assert!(busy(Path::best(), "uniform", true, &mut scratch) == expected);
    assert!(busy(Path::best(), "uniform", false, &mut scratch) == expected);
}

#[test]
fn a_lean_of_nothing_gives_the_hits_of_none() {
    let mut config = small(32, 900);
    let scene = lidar_city::scene(100, 4);
    let (states, _) = traffic(100, 30, Moves::Straight, 0, 5);
    for row in [0, 1, 2] {
        let carriers: Vec<_> = std::iter::once(states[row])
            .chain(states[3..].iter().copied())
            .collect();
        config.lidar.mount[3] = 0.0;
        let upright = scan(&config, &scene, &carriers);
        config.lidar.mount[3] = 1e-9;
        let leaning = scan(&config, &scene, &carriers);
        assert_eq!(upright.points.len(), leaning.points.len());
        let differs = |(a, b): &(&LidarPoint, &LidarPoint)| a.object != b.object || (range(a) - range(b)).abs() > 1e-3;
        let differ = upright.points.iter().zip(&leaning.points).filter(differs).count();
        assert!(differ * 10_000 <= upright.points.len(), "{differ}");
    }
}

#[test]
fn strange_places_do_no_harm() {
    let config = small(32, 360);
    let scene = Scene::new(
        Road::default(),
        vec![rectangle([-5.0, 5.0], [-5.0, 5.0], 9.0)],
        Vec::new(),
    );
    let mut states = [car(0, 0.0, 0.0, 0.0), car(1, 0.0, 0.0, 0.0), car(2, 20.0, 0.0, 0.0)];
    let _ = scan(&config, &scene, &states);
    states[0].z_m = -30.0;
    let below = scan(&config, &scene, &states);
    assert!(below.points.iter().all(|point| point.object != GROUND));
    states[0].z_m = 30.0;
    assert!(!scan(&config, &scene, &states).points.is_empty());
    // On a corner, in a wall, on another vehicle's side.
    for [x, y] in [[5.0, 5.0], [5.0, 0.0], [19.0, 1.0], [5.0 + 1e-9, 1e-9]] {
        (states[0].x_m, states[0].y_m, states[0].z_m) = (x, y, 0.0);
        let _ = scan(&config, &scene, &states);
    }
    let lidar = Lidar::new(&config, &scene).unwrap();
    let (mut targets, mut taken) = (Targets::default(), Scan::default());
    assert_eq!(
        lidar.scan(&targets, 0, 0, 0, &mut Scratch::default(), &mut taken, &mut []),
        0
    );
    targets.update(&states, &[], 0);
    let mut few = [LidarPoint::default(); 20];
    assert_eq!(
        lidar.scan(&targets, 0, 0, 0, &mut Scratch::default(), &mut taken, &mut few),
        20,
        "no more than fit"
    );
}

#[test]
fn a_table_fires_as_it_says() {
    let mut config = small(1, 1);
    config.lidar.pattern = "table".into();
    config.lidar.ray_table = format!("{DATA}rays.csv");
    let scanned = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    assert_eq!(scanned.scan.rays, 3);
    let expected = [(0.0, -10.0, 1), (90.0, -10.0, 1), (180.0, -20.0, 0)];
    assert_eq!(scanned.points.len(), 3);
    for (point, (azimuth_deg, elevation_deg, channel)) in scanned.points.iter().zip(expected) {
        let off = (azimuth(point).to_degrees() - azimuth_deg).rem_euclid(360.0);
        assert!(!(1e-4..359.999).contains(&off));
        assert!(((f64::from(point.position_m[2]) / range(point)).asin().to_degrees() - elevation_deg).abs() < 1e-4);
        assert_eq!(point.channel, channel);
    }
}

#[test]
fn bad_tables_and_meshes_are_named_with_their_place() {
    let mut config = small(1, 1);
    config.lidar.pattern = "table".into();
    let mut refusal = |file: &str| {
        config.lidar.ray_table = format!("{DATA}{file}");
        Failure::from(Lidar::new(&config, &empty()).unwrap_err())
    };
    let bad = refusal("rays_bad.csv");
    assert!(
        bad.message.contains("rays_bad.csv, line 3: column 2"),
        "{}",
        bad.message
    );
    assert!(bad.help.unwrap().contains("azimuth_deg,elevation_deg"));
    assert!(refusal("rays_steep.csv").message.contains("line 4"));
    assert!(refusal("nowhere.csv").message.contains("nowhere.csv"));
    let mut config = small(1, 1);
    let mut refusal = |entry: String| {
        config.scene.meshes = vec![entry];
        Failure::from(Lidar::new(&config, &empty()).unwrap_err())
    };
    assert!(
        refusal(format!("{DATA}nowhere.obj 1 2"))
            .message
            .contains("nowhere.obj")
    );
    assert!(
        refusal(format!("{DATA}no_faces.obj 1 2 3"))
            .message
            .contains("no faces")
    );
    assert!(
        refusal(format!("{DATA}wall.obj 1 two"))
            .message
            .contains("scene.meshes")
    );
    let mut config = small(1, 1);
    config.lidar.pattern = "abacus".into();
    assert!(matches!(Lidar::new(&config, &empty()), Err(LidarError::Pattern { .. })));
}

#[test]
fn meshes_and_ground_with_elevation_are_seen() {
    let mut config = small(16, 360);
    config.scene.meshes = vec![format!("{DATA}wall.obj 5 0 0")];
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
    let road = Road::new(vec![Piece {
        id: "hill_0".into(),
        surface: Surface::Lane,
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
        assert_eq!((point.object, point.tag), (GROUND, Tag::Mesh as u16));
        let [x, _, z] = point.position_m.map(f64::from);
        assert!((z - 0.1 * x + 2.0).abs() < 0.02, "{x} {z}");
    }
}

#[test]
fn the_nearest_objects_go_into_the_observation() {
    let mut config = small(32, 720);
    config.lidar.mount = [1.0, 0.0, 2.0, 0.0, 0.0, 0.0];
    let scene = empty();
    let prop = scene.prop(&Obstacle::parse("tree 0 6").unwrap());
    let scene = Scene::new(
        Road::default(),
        vec![rectangle([-4.0, -3.0], [-3.0, 3.0], 5.0)],
        vec![prop],
    );
    let states = [car(0, 0.0, 0.0, 0.0), car(1, 10.0, 0.0, 0.0), car(2, 0.0, -9.0, 0.0)];
    let lidar = Lidar::new(&config, &scene).unwrap();
    let scanned = scan_with(&lidar, &states, &[], 0, 0, 1);
    let [first, second, third, fourth] = nearest_objects(&scanned.points, &lidar);
    let near = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).abs() < 0.1 && (a[1] - b[1]).abs() < 0.1;
    assert!(
        near(first, [0.0, 5.8]) && near(second, [0.0, -8.0]) && near(third, [9.0, 0.0]),
        "{first:?} {second:?} {third:?}"
    );
    assert_eq!(fourth, [100.0, 100.0]);
    config.lidar.axes = LidarAxes::Paper;
    let lidar = Lidar::new(&config, &scene).unwrap();
    let scanned = scan_with(&lidar, &states, &[], 0, 0, 1);
    assert!(near(nearest_objects(&scanned.points, &lidar)[0], [0.0, 5.8]));
    assert_eq!(nearest_objects(&[], &lidar), [[100.0; 2]; 4]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Without noise every point lies on the surface of what it names.
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

/// Distance of a place from the surface of an object, metres.
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
