//! Cameras and radars in whole runs: real traffic, real shared memory, messages read by a spectator.

use std::{collections::BTreeMap, process::Stdio};

use crate::common::{Spectator, Workplace, short_pause};
use ipc_schema::{
    block,
    image::{ImageHead, ImageLayout, ImagePlane, SeenObject},
    radar::{NO_OBJECT, RadarDetection, RadarLayout, RadarScan},
    services::Channel,
    world::{VehicleState, WorldLayout},
};

const CARRIERS: usize = 3;
const TICKS: usize = 120;

/// A received image.
struct Seen {
    head: ImageHead,
    objects: Vec<SeenObject>,
    instance: Vec<u32>,
}

/// What a spectator has received, by tick.
#[derive(Default)]
struct Watched {
    images: Vec<(u64, Seen)>,
    scans: Vec<(u64, RadarScan, Vec<RadarDetection>)>,
    world: BTreeMap<u64, Vec<VehicleState>>,
}

/// The arguments of a short town run with these settings.
fn arguments<'a>(name: &'a str, settings: &[&'a str]) -> Vec<&'a str> {
    let mut arguments = vec!["simulate", "--name", name];
    let always = [
        "episode.training_episodes=1",
        "episode.ticks=120",
        "fanout.enabled=false",
    ];
    always
        .iter()
        .chain(settings)
        .for_each(|setting| arguments.extend(["--set", setting]));
    arguments
}

const SIGHTS: [&str; 4] = [
    "camera.vehicles=3",
    "camera.semantic=false",
    "radar.vehicles=3",
    "run.real_time_factor=10.0",
];

fn watch(workplace: &Workplace, name: &str) -> Watched {
    let mut command = workplace.command(&arguments(name, &SIGHTS));
    let mut run = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let run_file = workplace.path().join("runs").join(name).join("run.json");
    let spectator = Spectator::join(&run_file, &mut run);
    let [images, radar, world] =
        [Channel::Image, Channel::Radar, Channel::World].map(|channel| spectator.subscribe(channel));
    let mut watched = Watched::default();
    // A spectator may miss messages, even the last.
    loop {
        let over = run.try_wait().unwrap().is_some();
        let mut news = 0;
        while let Some(message) = images.receive().unwrap() {
            let layout = ImageLayout::of(message.header());
            let head = block::view::<ImageHead>(message.payload(), layout.head).unwrap()[0];
            let planes: &[u8] = block::view(message.payload(), layout.planes).unwrap();
            let pixels = (head.width * head.height) as usize;
            assert_eq!(head.planes, ImagePlane::Depth.bit() | ImagePlane::Instance.bit());
            assert_eq!(planes.len(), 8 * pixels);
            let word = |bytes: &[u8]| u32::from_le_bytes(std::array::from_fn(|i| bytes[i]));
            let seen = Seen {
                head,
                objects: block::view(message.payload(), layout.objects).unwrap().to_vec(),
                instance: planes[4 * pixels..].chunks_exact(4).map(word).collect(),
            };
            watched.images.push((message.header().tick, seen));
            news += 1;
        }
        while let Some(message) = radar.receive().unwrap() {
            let layout = RadarLayout::of(message.header());
            let scan = block::view::<RadarScan>(message.payload(), layout.scan).unwrap()[0];
            let detections = block::view(message.payload(), layout.detections).unwrap().to_vec();
            watched.scans.push((message.header().tick, scan, detections));
            news += 1;
        }
        while let Some(message) = world.receive().unwrap() {
            let layout = WorldLayout::of(message.header());
            let states = block::view(message.payload(), layout.states).unwrap().to_vec();
            watched.world.insert(message.header().tick, states);
            news += 1;
        }
        if over && news == 0 {
            break;
        }
        short_pause();
    }
    drop((images, radar, world, spectator));
    let output = run.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", crate::common::text(&output));
    watched
}

/// Column, row and depth of a point of the world in an image.
fn projected(head: &ImageHead, point_m: [f64; 3]) -> [f64; 3] {
    let [roll, pitch, yaw] = head.attitude_rad;
    let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), (-pitch).sin_cos(), yaw.sin_cos());
    let off: [f64; 3] = std::array::from_fn(|i| point_m[i] - head.position_m[i]);
    let axes = [
        [cy * cp, sy * cp, -sp],
        [cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr],
        [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr],
    ];
    let [x, y, z] = axes.map(|axis| (0..3).map(|i| axis[i] * off[i]).sum::<f64>());
    let focal = f64::from(head.focal_px);
    [
        0.5 * f64::from(head.width) - y / x * focal,
        0.5 * f64::from(head.height) - z / x * focal,
        x,
    ]
}

#[test]
fn images_and_detections_show_the_road_users_of_their_tick_and_are_made_again() {
    let workplace = Workplace::new();
    let watched = watch(&workplace, "first");
    assert!(watched.images.len() > 50, "only {} images", watched.images.len());
    let mut boxes = 0;
    for (tick, seen) in &watched.images {
        let Some(states) = watched.world.get(tick) else {
            continue;
        };
        let carrier = states.iter().find(|state| state.vehicle == seen.head.vehicle).unwrap();
        assert_eq!(carrier.id_hash, seen.head.id_hash);
        for object in &seen.objects {
            assert_ne!(object.object, seen.head.vehicle, "its own body");
            let counted = seen
                .instance
                .iter()
                .filter(|instance| **instance == object.object)
                .count();
            assert_eq!(counted, object.visible_px as usize);
            // The middle of the road user lies within its box.
            let state = states.iter().find(|state| state.vehicle == object.object).unwrap();
            let ahead = match state.rear_overhang_m {
                0.0 => 0.0,
                rear => 0.5 * f64::from(state.length_m) - f64::from(rear),
            };
            let (sin, cos) = state.yaw_rad.sin_cos();
            let middle_m = [
                state.x_m + ahead * cos,
                state.y_m + ahead * sin,
                state.z_m + 0.5 * f64::from(state.height_m),
            ];
            let [u, v, depth_m] = projected(&seen.head, middle_m);
            let [left, top, right, bottom] = object.full_box_px.map(f64::from);
            if object.depth_m[0] > 0.1 {
                assert!(
                    (left..=right).contains(&u) && (top..=bottom).contains(&v),
                    "{object:?}: ({u}, {v})"
                );
                assert!((f64::from(object.depth_m[0])..=f64::from(object.depth_m[1])).contains(&depth_m));
                boxes += 1;
            }
        }
    }
    assert!(boxes > 50, "only {boxes} boxes");
    let mut detected = 0;
    for (tick, scan, detections) in &watched.scans {
        let Some(states) = watched.world.get(tick) else {
            continue;
        };
        for seen in detections.iter().filter(|seen| seen.object_id < NO_OBJECT >> 1) {
            let state = states.iter().find(|state| state.vehicle == seen.object_id).unwrap();
            let (dx, dy) = (state.x_m - scan.position_m[0], state.y_m - scan.position_m[1]);
            let off_m = (dx.hypot(dy) - f64::from(seen.distance_m)).abs();
            assert!(off_m < f64::from(state.length_m) + 2.0, "{off_m} m off: {seen:?}");
            detected += 1;
        }
    }
    assert!(detected > 100, "only {detected} detections of road users");

    // The same seed gives the same images and detections, whatever a spectator misses.
    workplace.succeed(&arguments("second", &SIGHTS[..3]));
    let [first, second] = ["first", "second"].map(|name| workplace.report(name));
    for sensor in ["camera", "radar"] {
        let messages = first[sensor]["messages"].as_u64().unwrap() as usize;
        assert!(
            (100 * CARRIERS..=TICKS * CARRIERS).contains(&messages),
            "{}",
            first[sensor]
        );
        assert_eq!(first[sensor], second[sensor]);
    }
    assert_eq!(first["observation_hash"], second["observation_hash"]);
    workplace.assert_nothing_left();
}
