//! Every ray of whole scans against parry3d: the same hit, the same range to a millimetre.

#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping")]

mod lidar_city;

use ipc_schema::pointcloud::{LidarPoint, Scan};
use lidar_city::{
    Moves, SUB_STEPS, exact_config, hilly,
    oracle::{ScanTotals, WorldTick, compare, rays},
    scene, traffic,
};
use sensor_daemon::sensors::lidar::{LidarModel, ScanScratch, Targets};
use sim_core::scene::Scene;

/// One scan of each of `carriers` against parry.
fn tally(
    scene: &Scene,
    moves: Moves,
    is_rolling: bool,
    lean: [f64; 2],
    carriers: impl IntoIterator<Item = usize>,
) -> ScanTotals {
    let mut config = exact_config();
    config.lidar.rolling_shutter = is_rolling;
    config.lidar.mount = [1.0, 0.1, 2.0, lean[0], lean[1], 0.2];
    let (mut states, steps) = traffic(200, 60, moves, 0, 2);
    lidar_city::stand_on(scene, &mut states);
    let lidar = LidarModel::new(&config, scene).unwrap();
    let world = WorldTick::new(&config, scene, &states, &steps);
    let mut targets = Targets::default();
    targets.update(&states, &steps, SUB_STEPS);
    let (mut scratch, mut scan) = (ScanScratch::default(), Scan::default());
    let mut points = vec![LidarPoint::default(); lidar.max_points()];
    let mut tally = ScanTotals::default();
    for row in carriers {
        let count = lidar.scan(&targets, row, 0, 1, &mut scratch, &mut scan, &mut points);
        let of_row = &steps[row * SUB_STEPS..(row + 1) * SUB_STEPS];
        tally.add(&compare(
            &world,
            &rays(&config, &states[row], of_row),
            row,
            &points[..count],
        ));
    }
    tally
}

fn check(tally: &ScanTotals) {
    println!("{tally:?}, mean range {} m", tally.range_sum_m / tally.hits as f64);
    let off = tally.rays - tally.same;
    assert!(off * 10_000 <= tally.rays, "{off} of {} differ", tally.rays);
    assert_eq!(off, tally.grazing, "every difference is a grazed edge");
    assert!(tally.hits * 10 > tally.rays * 8, "a dense city");
}

#[test]
fn upright_and_all_at_once() {
    check(&tally(&scene(500, 1), Moves::Straight, false, [0.0; 2], 0..4));
}

#[test]
fn upright_with_rolling_shutter() {
    check(&tally(&scene(500, 1), Moves::Straight, true, [0.0; 2], 4..9));
}

#[test]
fn leaning_and_all_at_once() {
    check(&tally(&scene(500, 1), Moves::Wildly, false, [0.05, -0.08], 9..13));
}

#[test]
fn leaning_with_rolling_shutter() {
    check(&tally(&scene(500, 1), Moves::Wildly, true, [-0.03, 0.06], 13..18));
}

/// No scan of these is upright: the city lies on slopes of up to 13 %.
#[test]
fn on_hills_and_all_at_once() {
    check(&tally(&hilly(), Moves::Wildly, false, [0.05, -0.08], 18..22));
}

#[test]
fn on_hills_with_rolling_shutter() {
    check(&tally(&hilly(), Moves::Wildly, true, [-0.03, 0.06], 22..26));
}

#[test]
fn upright_on_hills() {
    check(&tally(&hilly(), Moves::Straight, true, [0.0; 2], 26..30));
}

/// LIDARs on a viaduct and below it.
#[test]
fn on_and_under_a_bridge() {
    let scene = lidar_city::bridged();
    for (moves, is_rolling) in [(Moves::Straight, true), (Moves::Wildly, false)] {
        let carriers = lidar_city::carriers_at_the_bridge(&scene, moves, 2);
        let tally = tally(&scene, moves, is_rolling, [0.0; 2], carriers);
        let off = tally.rays - tally.same;
        assert!(off * 10_000 <= tally.rays, "{off} of {} differ", tally.rays);
        assert_eq!(off, tally.grazing, "every difference is a grazed edge");
    }
}
