//! Scans have the same bits on every instruction set and in any order of objects, even at degenerate positions.

use crate::lidar_city::{Moves, SUB_STEPS, traffic};
use crate::{DATA, car, lidar_city, range, rectangle, scan, small};
use ipc_schema::config::LidarPattern;
use ipc_schema::pointcloud::{GROUND, LidarPoint, Scan};
use sensor_daemon::sensors::lidar::{LidarModel, ScanPath, ScanScratch, Targets};
use sim_core::scene::{Road, Scene};

/// The bits of a scan with noise, loss, weather, persons and wild motion at once.
fn busy(path: ScanPath, pattern: LidarPattern, order: bool, scratch: &mut ScanScratch) -> Vec<u8> {
    let mut config = lidar_city::config();
    config.lidar.pattern = pattern;
    config.lidar.ray_table = Some(format!("{DATA}rays.csv").into());
    config.lidar.dropoff = 0.1;
    config.weather.rain_mmph = 2.0;
    config.weather.sunlight = 0.5;
    let scene = lidar_city::scene(500, 1);
    let moves = if pattern == LidarPattern::Uniform {
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
    let lidar = LidarModel::new(&config, &scene).unwrap().with_path(path);
    let (mut targets, mut scan) = (Targets::default(), Scan::default());
    targets.update(&states, &steps, SUB_STEPS);
    let mut points = vec![LidarPoint::default(); lidar.max_points()];
    let count = lidar.scan(&targets, 0, 3, 1, scratch, &mut scan, &mut points);
    assert!(count > 0 && lidar.path() == path);
    [bytemuck::bytes_of(&scan), bytemuck::cast_slice(&points[..count])].concat()
}

#[test]
fn every_path_gives_the_same_bits() {
    use LidarPattern::{Hdl64e, Pandar40p, Table, Uniform};
    for pattern in [Uniform, Hdl64e, Pandar40p, Table] {
        let expected = busy(ScanPath::Plain, pattern, true, &mut ScanScratch::default());
        for path in ScanPath::ALL.into_iter().filter(|path| path.is_here()) {
            assert!(
                busy(path, pattern, true, &mut ScanScratch::default()) == expected,
                "{path:?} {pattern:?}"
            );
        }
    }
}

#[test]
fn neither_the_order_of_targets_nor_used_scratch_matters() {
    let mut scratch = ScanScratch::default();
    let expected = busy(ScanPath::best(), LidarPattern::Uniform, true, &mut scratch);
    let _ = busy(ScanPath::best(), LidarPattern::Os1_128, true, &mut scratch);
    assert!(busy(ScanPath::best(), LidarPattern::Uniform, true, &mut scratch) == expected);
    assert!(busy(ScanPath::best(), LidarPattern::Uniform, false, &mut scratch) == expected);
}

#[test]
fn a_lean_of_zero_gives_the_same_hits_as_no_lean() {
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
fn degenerate_positions_do_no_harm() {
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
    let lidar = LidarModel::new(&config, &scene).unwrap();
    let (mut targets, mut taken) = (Targets::default(), Scan::default());
    assert_eq!(
        lidar.scan(&targets, 0, 0, 0, &mut ScanScratch::default(), &mut taken, &mut []),
        0
    );
    targets.update(&states, &[], 0);
    let mut few = [LidarPoint::default(); 20];
    assert_eq!(
        lidar.scan(&targets, 0, 0, 0, &mut ScanScratch::default(), &mut taken, &mut few),
        20,
        "no more points than fit"
    );
}
