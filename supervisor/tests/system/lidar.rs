//! LIDARs in whole runs: real traffic, real shared memory, scans read by a spectator.

use std::{collections::BTreeMap, process::Stdio};

use crate::common::{Spectator, Workplace, short_pause};
use ipc_schema::{
    block,
    pointcloud::{GROUND, LidarPoint, PointcloudLayout, STATIC_OBJECT, Scan, Tag},
    services::Channel,
    world::{VehicleState, WorldLayout},
};

/// A received scan.
struct Seen {
    scan: Scan,
    points: Vec<LidarPoint>,
}

/// Scans by tick and vehicle, and road users by tick.
struct Watched {
    scans: BTreeMap<(u64, u32), Seen>,
    world: BTreeMap<u64, Vec<VehicleState>>,
}

const LIDARS: usize = 3;

/// A town run with LIDARs, slow enough for a spectator to see most scans.
fn watch(workplace: &Workplace, name: &str, settings: &[&str]) -> Watched {
    let always = [
        "episode.training_episodes=1",
        "episode.ticks=150",
        "run.real_time_factor=10.0",
        "fanout.enabled=false",
        "lidar.vehicles=3",
    ];
    let mut arguments = vec!["simulate", "--name", name];
    always
        .iter()
        .chain(settings)
        .for_each(|setting| arguments.extend(["--set", setting]));
    let mut command = workplace.command(&arguments);
    let mut run = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let run_file = workplace.path().join("runs").join(name).join("run.json");
    let spectator = Spectator::join(&run_file, &mut run);
    let (clouds, world) = (
        spectator.subscribe(Channel::Pointcloud),
        spectator.subscribe(Channel::World),
    );
    let mut watched = Watched {
        scans: BTreeMap::new(),
        world: BTreeMap::new(),
    };
    // A spectator may miss messages, even the last.
    loop {
        let over = run.try_wait().unwrap().is_some();
        let mut news = 0;
        while let Some(message) = clouds.receive().unwrap() {
            let header = *message.header();
            let layout = PointcloudLayout::of(&header);
            let seen = Seen {
                scan: block::view::<Scan>(message.payload(), layout.scan).unwrap()[0],
                points: block::view(message.payload(), layout.points).unwrap().to_vec(),
            };
            watched.scans.insert((header.tick, seen.scan.vehicle), seen);
            news += 1;
        }
        while let Some(message) = world.receive().unwrap() {
            let header = *message.header();
            let layout = WorldLayout::of(&header);
            let states = block::view(message.payload(), layout.states).unwrap().to_vec();
            watched.world.insert(header.tick, states);
            news += 1;
        }
        if over && news == 0 {
            break;
        }
        short_pause();
    }
    drop((clouds, world, spectator));
    let output = run.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", crate::common::text(&output));
    watched
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
    let watched = watch(
        &workplace,
        "still",
        &[
            "lidar.rolling_shutter=false",
            "lidar.range_noise_std_m=0.0",
            "scene.random_props=100",
        ],
    );
    assert!(watched.scans.len() > 100, "only {} scans", watched.scans.len());
    let (mut vehicles, mut tags) = (0, BTreeMap::<u16, usize>::new());
    for ((tick, _), seen) in &watched.scans {
        let Some(states) = watched.world.get(tick) else {
            continue;
        };
        let carrier = states.iter().find(|state| state.vehicle == seen.scan.vehicle).unwrap();
        assert_eq!(carrier.id_hash, seen.scan.id_hash);
        assert_eq!(seen.scan.rays, 57_600);
        for point in &seen.points {
            *tags.entry(point.tag).or_default() += 1;
            let at = world_m(&seen.scan, point);
            if point.object == GROUND {
                assert!(at[2].abs() < 2e-3, "ground at {at:?}");
            } else if point.object & STATIC_OBJECT == 0 {
                assert_ne!(point.object, seen.scan.vehicle, "its own body");
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
    assert!(
        count("scans") > 130 * LIDARS as u64 && count("scans") <= 150 * LIDARS as u64,
        "{lidar}"
    );
    workplace.assert_nothing_left();
}

/// The same seed gives the same points, whichever scans a spectator misses. The nearest objects are part of the observation.
#[test]
fn the_same_seed_gives_the_same_scans() {
    let workplace = Workplace::new();
    let settings = [
        "observation.fields=[\"gnss_x\", \"gnss_y\", \"object_1_x\", \"object_1_y\"]",
        "weather.rain_mmph=10.0",
    ];
    let [first, second] = ["first", "second"].map(|name| watch(&workplace, name, &settings));
    let both: Vec<_> = first
        .scans
        .keys()
        .filter(|key| second.scans.contains_key(*key))
        .collect();
    assert!(both.len() > 100, "only {} scans seen twice", both.len());
    for key in both {
        let bytes = |watched: &Watched| bytemuck::cast_slice::<_, u8>(&watched.scans[key].points).to_vec();
        assert!(bytes(&first) == bytes(&second), "scan {key:?} differs");
    }
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
