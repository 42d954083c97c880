//! LIDARs in whole runs: real traffic, real shared memory, scans read from a lossless recording.

use std::collections::BTreeMap;

use crate::common::{Workplace, of_channel, road_users};
use ipc_schema::{
    block,
    channel::Channel,
    pointcloud::{GROUND, LidarPoint, PointcloudLayout, STATIC_OBJECT, Scan, Tag},
    world::VehicleState,
};
use recorder::file::reader::{ChannelMessage, RecordingReader};

const LIDARS: usize = 3;
const TICKS: usize = 40;

/// A town run with LIDARs.
fn record(workplace: &Workplace, name: &str, settings: &[&str]) -> RecordingReader {
    let always = [
        "episode.training_episodes=1",
        "episode.ticks=40",
        "fanout.enabled=false",
        "lidar.vehicles=3",
    ];
    let mut arguments = vec!["simulate"];
    always
        .iter()
        .chain(settings)
        .for_each(|setting| arguments.extend(["--set", setting]));
    workplace.record(name, &arguments, &[Channel::World, Channel::Pointcloud])
}

/// The scan and the points of a message.
fn seen(message: &ChannelMessage) -> (Scan, &[LidarPoint]) {
    let layout = PointcloudLayout::of(&message.header);
    let scan = block::view::<Scan>(message.payload(), layout.scan).unwrap()[0];
    (scan, block::view(message.payload(), layout.points).unwrap())
}

/// A point in the world, from a sensor that looks forward, left and up.
fn world_m(scan: &Scan, point: &LidarPoint) -> [f64; 3] {
    let [roll, pitch, yaw] = scan.attitude_rad;
    let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), (-pitch).sin_cos(), yaw.sin_cos());
    let [x, y, z] = point.position_m.map(f64::from);
    [
        scan.position_m[0] + cy * cp * x + (cy * sp * sr - sy * cr) * y + (cy * sp * cr + sy * sr) * z,
        scan.position_m[1] + sy * cp * x + (sy * sp * sr + cy * cr) * y + (sy * sp * cr - cy * sr) * z,
        scan.position_m[2] - sp * x + cp * sr * y + cp * cr * z,
    ]
}

/// How far a point is outside a road user's box, metres.
fn outside_m(state: &VehicleState, [x, y, z]: [f64; 3]) -> f64 {
    let (sin, cos) = state.yaw_rad.sin_cos();
    let (dx, dy) = (x - state.x_m, y - state.y_m);
    let (ahead, left) = (dx * cos + dy * sin, dy * cos - dx * sin);
    let [length, width, height, overhang] =
        [state.length_m, state.width_m, state.height_m, state.rear_overhang_m].map(f64::from);
    let beyond = [
        -overhang - ahead,
        ahead - (length - overhang),
        left.abs() - 0.5 * width,
        state.z_m - z,
        z - state.z_m - height,
    ];
    beyond.into_iter().fold(0.0, f64::max)
}

#[test]
fn points_lie_on_their_objects_and_the_report_counts_them() {
    let workplace = Workplace::new();
    let recording = record(
        &workplace,
        "still",
        &[
            "lidar.rolling_shutter=false",
            "lidar.range_noise_std_m=0.0",
            "scene.random_props=100",
        ],
    );
    let world = road_users(&recording);
    assert_eq!(world.len(), TICKS);
    let (mut scans, mut vehicles, mut tags) = (0, 0, BTreeMap::<u16, usize>::new());
    for message in of_channel(&recording, Channel::Pointcloud) {
        scans += 1;
        let (scan, points) = seen(&message);
        let states = &world[&message.header.tick];
        let carrier = states.iter().find(|state| state.vehicle == scan.vehicle).unwrap();
        assert_eq!(carrier.id_hash, scan.id_hash);
        assert_eq!(scan.rays, 57_600);
        for point in points {
            *tags.entry(point.tag).or_default() += 1;
            let at = world_m(&scan, point);
            if point.object == GROUND {
                assert!(at[2].abs() < 2e-3, "ground at {at:?}");
            } else if point.object & STATIC_OBJECT == 0 {
                assert_ne!(point.object, scan.vehicle, "its own body");
                let hit = states.iter().find(|state| state.vehicle == point.object).unwrap();
                if point.tag == Tag::Vehicle as u16 {
                    let out_m = outside_m(hit, at);
                    assert!(out_m < 2e-3, "{out_m} m outside the box of {}", hit.vehicle);
                    vehicles += 1;
                }
            }
        }
    }
    assert!(vehicles > 1000, "only {vehicles} points on vehicles");
    for tag in [Tag::Ground, Tag::Building, Tag::Vehicle, Tag::Person] {
        assert!(tags.contains_key(&(tag as u16)), "nothing of {tag:?} in {tags:?}");
    }
    let lidar = &workplace.report("still")["lidar"];
    let count = |name: &str| lidar[name].as_u64().unwrap();
    assert_eq!(count("rays"), count("scans") * 57_600, "{lidar}");
    assert_eq!(count("scans"), scans, "{lidar}");
    // A vehicle that arrives takes its LIDAR with it; at times the next carrier is not there yet.
    let most = TICKS * LIDARS;
    assert!((most as u64 * 13 / 15..=most as u64).contains(&scans), "{lidar}");
    workplace.assert_nothing_left();
}

/// The same seed gives the same points. The nearest objects are part of the observation.
#[test]
fn the_same_seed_gives_the_same_scans() {
    let workplace = Workplace::new();
    let settings = [
        "observation.fields=[\"gnss_x\", \"gnss_y\", \"object_1_x\", \"object_1_y\"]",
        "weather.rain_mmph=10.0",
    ];
    // Hashes of the points of every scan, by tick and vehicle.
    let [first, second] = ["first", "second"].map(|name| {
        let recording = record(&workplace, name, &settings);
        let scans = of_channel(&recording, Channel::Pointcloud).map(|message| {
            let (scan, points) = seen(&message);
            let points = blake3::hash(bytemuck::cast_slice(points));
            ((message.header.tick, scan.vehicle), points)
        });
        scans.collect::<BTreeMap<_, _>>()
    });
    assert!(first.len() > 100, "only {} scans", first.len());
    for (key, points) in &first {
        assert_eq!(second.get(key), Some(points), "scan {key:?} differs");
    }
    assert_eq!(first.len(), second.len());
    let hash = |name: &str| workplace.report(name)["observation_hash"].as_str().unwrap().to_owned();
    assert_eq!(hash("first"), hash("second"));
}

#[test]
fn a_ray_table_that_cannot_be_read_ends_the_run_with_file_and_line() {
    let workplace = Workplace::new();
    let table = workplace.write("rays.csv", "azimuth_deg,elevation_deg\n0,1\n0,upwards\n");
    let pattern = format!("lidar.ray_table={}", table.display());
    let output = workplace.run(&[
        "simulate",
        "--name",
        "table",
        "--set",
        "lidar.vehicles=1",
        "--set",
        "lidar.pattern=table",
        "--set",
        &pattern,
    ]);
    let text = crate::common::text(&output);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("rays.csv") && text.contains("line 3"), "{text}");
    workplace.assert_nothing_left();
}
