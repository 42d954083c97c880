//! The rays that are fired: the elevations of real units, tables, rotations and fields of view.

use crate::{DATA, azimuth, block, car, empty, range, scan, scan_with, small};
use ipc_schema::config::LidarPattern;
use ipc_schema::failure::Failure;
use ipc_schema::pointcloud::{GROUND, LidarPoint, Tag};
use sensor_daemon::sensors::lidar::{LidarError, LidarModel};
use sim_core::scene::{Road, Scene};

fn elevations(pattern: LidarPattern) -> Vec<f64> {
    let mut config = small(1, 8);
    config.lidar.pattern = pattern;
    config.lidar.range_m = 1000.0;
    // In a pit with very high walls every ray returns.
    let ring = |r: f64| [[-r, -r], [r, -r], [r, r], [-r, r]];
    let [a, b, c, d] = ring(5.0);
    let [e, f, g, h] = ring(6.0);
    let walls = [[a, b, f, e], [b, c, g, f], [c, d, h, g], [d, a, e, h]].map(|outline| block(&outline, 500.0));
    let scene = Scene::new(Road::default(), walls.to_vec(), Vec::new());
    let lidar = LidarModel::new(&config, &scene).unwrap();
    let scanned = scan_with(&lidar, &[car(0, 0.0, 0.0, 0.0)], &[], 0, 0, 1);
    let lasers = lidar.max_points() / lidar.columns();
    assert_eq!(scanned.points.len(), lidar.max_points(), "{pattern:?}");
    let elevation = |point: &LidarPoint| (f64::from(point.position_m[2]) / range(point)).asin().to_degrees();
    assert!((0..lasers).all(|laser| usize::from(scanned.points[laser].channel) == laser));
    scanned.points[..lasers].iter().map(elevation).collect()
}

#[test]
fn every_unit_has_the_elevations_of_its_manual() {
    let expected = [
        (LidarPattern::Vlp16, 16, -15.0, 15.0),
        (LidarPattern::Hdl32e, 32, -30.67, 10.67),
        (LidarPattern::Hdl64e, 64, -24.33, 2.0),
        (LidarPattern::Pandar40p, 40, -25.0, 15.0),
        (LidarPattern::Os1_32, 32, -22.5, 22.5),
        (LidarPattern::Os1_64, 64, -22.5, 22.5),
        (LidarPattern::Os1_128, 128, -21.2, 21.2),
        (LidarPattern::Vls128, 128, -25.0, 15.0),
    ];
    for (pattern, lasers, lowest, highest) in expected {
        let table = elevations(pattern);
        assert_eq!(table.len(), lasers, "{pattern:?}");
        assert!(
            (table[0] - lowest).abs() < 0.01 && (table[lasers - 1] - highest).abs() < 0.01,
            "{pattern:?}: {table:?}"
        );
        assert!(
            table.is_sorted_by(|a, b| a < b),
            "{pattern:?}: the lowest laser is number 0"
        );
    }
    let table = elevations(LidarPattern::Vlp16);
    assert!(table.windows(2).all(|two| (two[1] - two[0] - 2.0).abs() < 1e-4));
    let table = elevations(LidarPattern::Pandar40p);
    assert!((table[10] + 6.0).abs() < 1e-4 && (table[11] - table[10] - 1.0 / 3.0).abs() < 1e-4);
    let table = elevations(LidarPattern::Hdl64e);
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
fn a_tick_may_be_part_of_a_rotation_or_several() {
    let mut config = small(4, 0);
    config.lidar.rotation_hz = 2.5;
    config.lidar.points_per_second = 4 * 101 * 10 / 4;
    let lidar = LidarModel::new(&config, &empty()).unwrap();
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
        LidarModel::new(&config, &empty()),
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
    let lidar = LidarModel::new(&config, &empty()).unwrap();
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

#[test]
fn a_table_fires_its_rays() {
    let mut config = small(1, 1);
    config.lidar.pattern = LidarPattern::Table;
    config.lidar.ray_table = Some(format!("{DATA}rays.csv").into());
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
fn bad_tables_and_meshes_are_named_with_file_and_line() {
    let mut config = small(1, 1);
    config.lidar.pattern = LidarPattern::Table;
    let mut refusal = |file: &str| {
        config.lidar.ray_table = Some(format!("{DATA}{file}").into());
        Failure::from(LidarModel::new(&config, &empty()).unwrap_err())
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
        config.scene.meshes = vec![entry.parse().unwrap()];
        Failure::from(LidarModel::new(&config, &empty()).unwrap_err())
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
    let mut config = small(1, 1);
    config.lidar.pattern = LidarPattern::Table;
    assert!(matches!(LidarModel::new(&config, &empty()), Err(LidarError::NoTable)));
}
