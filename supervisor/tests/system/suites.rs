//! Suites in whole runs: vehicles with several cameras and LIDARs, and a mast beside the road.

use std::collections::BTreeSet;

use crate::common::{ONE_TICK_AHEAD, Workplace, of_channel, road_users};
use ipc_schema::{
    block,
    channel::Channel,
    image::{ImageHead, ImageLayout},
    pointcloud::{LidarPoint, PointcloudLayout, ROADSIDE_CARRIER, Scan},
    traffic::id_hash,
    world::VehicleState,
};

const SUITES: &str = r#"
[episode]
training_episodes = 1
ticks = 100

[fanout]
enabled = false

[lidar]
channels = 16
points_per_second = 57600

[[suite]]
name = "stereo"
ids = ["cav.1", "cav.2*"]
first = 8

[[suite.sensor]]
kind = "camera"
name = "left"
mount = [1.6, 0.3, 1.5, 0.0, 0.0, 0.0]
width = 64
height = 48

[[suite.sensor]]
kind = "camera"
name = "right"
mount = [1.6, -0.3, 1.5, 0.0, 0.0, 0.1]
width = 32
height = 24
semantic = false
period_ticks = 2

[[suite.sensor]]
kind = "lidar"
name = "top"
mount = [1.0, 0.0, 2.2, 0.0, 0.0, 0.0]

[[suite.sensor]]
kind = "lidar"
name = "low"
mount = [3.0, 0.0, 0.6, 0.0, 0.0, 0.0]
range_m = 30.0

[[suite]]
name = "mast"

[[suite.sensor]]
kind = "lidar"
name = "head"
mount = [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]

[[suite.sensor]]
kind = "camera"
name = "eye"
mount = [0.0, 0.0, 5.5, 0.0, -0.4, 0.0]

[[roadside]]
name = "crossing"
suite = "mast"
x_m = 129.0
y_m = 126.0
yaw_deg = 90.0
"#;

/// Place of a mount on an upright carrier.
fn place_m(state: &VehicleState, mount: [f64; 3]) -> [f64; 2] {
    let (sin, cos) = state.yaw_rad.sin_cos();
    [
        state.x_m + mount[0] * cos - mount[1] * sin,
        state.y_m + mount[0] * sin + mount[1] * cos,
    ]
}

#[test]
fn vehicles_and_a_mast_carry_the_sensors_of_their_suites_and_the_same_seed_makes_them_again() {
    let workplace = Workplace::new();
    let config = workplace.write("suites.toml", SUITES);
    let channels = [Channel::World, Channel::Image, Channel::Pointcloud];
    let arguments = ["simulate", config.to_str().unwrap(), "--set", ONE_TICK_AHEAD];
    let recording = workplace.record("watched", &arguments, &channels);
    let world = road_users(&recording);
    assert_eq!(world.len(), 100);

    // The table of `run.json` names what the messages number.
    let text = std::fs::read_to_string(workplace.path().join("runs/watched/run.json")).unwrap();
    let run: serde_json::Value = serde_json::from_str(&text).unwrap();
    let named: Vec<String> = run["sensor_units"]
        .as_array()
        .unwrap()
        .iter()
        .map(|unit| format!("{} {} {}/{}", unit["kind"], unit["sensor"], unit["suite"], unit["name"]).replace('"', ""))
        .collect();
    assert_eq!(
        named,
        [
            "lidar 1 stereo/top",
            "lidar 2 stereo/low",
            "lidar 3 mast/head",
            "camera 1 stereo/left",
            "camera 2 stereo/right",
            "camera 3 mast/eye"
        ]
    );

    // Every carrier has an id of the pattern, and each sensor is where its mount says.
    let carriers: BTreeSet<u64> = (1..400).map(|number| id_hash(&format!("cav.{number}"))).collect();
    let stereo: BTreeSet<u64> = (1..400)
        .map(|number| format!("cav.{number}"))
        .filter(|id| id == "cav.1" || id.starts_with("cav.2"))
        .map(|id| id_hash(&id))
        .collect();
    let mast = ROADSIDE_CARRIER;
    let (mut on_vehicles, mut on_mast) = (0, 0);
    for message in of_channel(&recording, Channel::Image) {
        let layout = ImageLayout::of(&message.header);
        let head = block::view::<ImageHead>(message.payload(), layout.head).unwrap()[0];
        if head.vehicle == mast {
            assert_eq!((head.sensor, head.id_hash), (3, id_hash("crossing")));
            let [x, y, z] = head.position_m;
            assert!((x - 129.0).hypot(y - 126.0) < 1e-9 && (z - 5.5).abs() < 0.5, "{head:?}");
            assert!((head.attitude_rad[2] - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
            on_mast += 1;
            continue;
        }
        assert!(
            stereo.contains(&head.id_hash) && carriers.contains(&head.id_hash),
            "{head:?}"
        );
        let (size, mount) = match head.sensor {
            1 => ([64, 48], [1.6, 0.3, 1.5]),
            2 => ([32, 24], [1.6, -0.3, 1.5]),
            other => panic!("camera {other} on a vehicle"),
        };
        assert_eq!([head.width, head.height], size);
        let states = &world[&message.header.tick];
        let state = states.iter().find(|state| state.vehicle == head.vehicle).unwrap();
        let [x, y] = place_m(state, mount);
        // A lean of a few degrees moves a mount of 1.5 m by some centimetres.
        assert!((head.position_m[0] - x).hypot(head.position_m[1] - y) < 0.2, "{head:?}");
        on_vehicles += 1;
    }
    assert!(
        on_vehicles > 50 && on_mast > 20,
        "{on_vehicles} on vehicles, {on_mast} on the mast"
    );
    let (mut scans, mut on_vehicles, mut on_mast) = (0, 0, 0);
    for message in of_channel(&recording, Channel::Pointcloud) {
        scans += 1;
        let layout = PointcloudLayout::of(&message.header);
        let scan = block::view::<Scan>(message.payload(), layout.scan).unwrap()[0];
        let points: &[LidarPoint] = block::view(message.payload(), layout.points).unwrap();
        let objects: BTreeSet<u32> = points.iter().map(|point| point.object).collect();
        assert!(!objects.contains(&scan.vehicle), "its own body");
        assert!(
            objects
                .iter()
                .all(|object| object & ROADSIDE_CARRIER == 0 || object >> 31 == 1),
            "a mast has no body"
        );
        match scan.sensor {
            3 => on_mast += usize::from(scan.vehicle == mast),
            _ => on_vehicles += usize::from(stereo.contains(&scan.id_hash)),
        }
        assert_eq!(
            scan.range_m.to_bits(),
            if scan.sensor == 2 { 30.0_f32 } else { 100.0 }.to_bits()
        );
    }
    assert_eq!(on_vehicles + on_mast, scans);
    assert!(
        on_vehicles > 50 && on_mast > 20,
        "{on_vehicles} on vehicles, {on_mast} on the mast"
    );

    // The same seed, with another window: the same images and points, and the configuration that the run wrote gives the same run.
    workplace.succeed(&[
        "simulate",
        "runs/watched/config.toml",
        "--name",
        "again",
        "--set",
        "run.window_ticks=8",
        "--set",
        "record.manner=off",
    ]);
    let [first, second] = ["watched", "again"].map(|name| workplace.report(name));
    for key in ["camera", "lidar", "observation_hash"] {
        assert_eq!(first[key], second[key], "{key}");
    }
    assert!(
        first["camera"]["messages"].as_u64().unwrap() > 250,
        "{}",
        first["camera"]
    );
    workplace.assert_nothing_left();
}
