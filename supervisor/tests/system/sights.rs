//! Cameras and radars in whole runs: real traffic, real shared memory, messages read from a recording.

use crate::common::{ONE_TICK_AHEAD, Workplace, of_channel, road_users};
use ipc_schema::{
    block,
    channel::Channel,
    image::{ImageHead, ImageLayout, ImagePlane, SeenObject},
    radar::{NO_OBJECT, RadarDetection, RadarLayout, RadarScan},
};
use recorder::file::reader::ChannelMessage;

const CARRIERS: usize = 3;
const TICKS: usize = 60;

/// The arguments of a short town run with these settings.
fn arguments<'a>(settings: &[&'a str]) -> Vec<&'a str> {
    let mut arguments = vec!["simulate"];
    let always = [
        "episode.training_episodes=1",
        "episode.ticks=60",
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
    ONE_TICK_AHEAD,
];

/// Head, objects and the road user of each pixel of an image.
fn image(message: &ChannelMessage) -> (ImageHead, &[SeenObject], Vec<u32>) {
    let layout = ImageLayout::of(&message.header);
    let head = block::view::<ImageHead>(message.payload(), layout.head).unwrap()[0];
    let planes: &[u8] = block::view(message.payload(), layout.planes).unwrap();
    let pixels = (head.width * head.height) as usize;
    assert_eq!(head.planes, ImagePlane::Depth.bit() | ImagePlane::Instance.bit());
    assert_eq!(planes.len(), 8 * pixels);
    let word = |bytes: &[u8]| u32::from_le_bytes(std::array::from_fn(|i| bytes[i]));
    let instance = planes[4 * pixels..].chunks_exact(4).map(word).collect();
    let objects = block::view(message.payload(), layout.objects).unwrap();
    (head, objects, instance)
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
    let channels = [Channel::World, Channel::Image, Channel::Radar];
    let recording = workplace.record("first", &arguments(&SIGHTS), &channels);
    let world = road_users(&recording);
    assert_eq!(world.len(), TICKS);
    let (mut images, mut boxes) = (0, 0);
    for message in of_channel(&recording, Channel::Image) {
        images += 1;
        let states = &world[&message.header.tick];
        let (head, objects, instance) = image(&message);
        let carrier = states.iter().find(|state| state.vehicle == head.vehicle).unwrap();
        assert_eq!(carrier.id_hash, head.id_hash);
        for object in objects {
            assert_ne!(object.object, head.vehicle, "its own body");
            let counted = instance.iter().filter(|instance| **instance == object.object).count();
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
            let [u, v, depth_m] = projected(&head, middle_m);
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
    assert!(images > 50, "only {images} images");
    assert!(boxes > 50, "only {boxes} boxes");
    let mut detected = 0;
    for message in of_channel(&recording, Channel::Radar) {
        let layout = RadarLayout::of(&message.header);
        let scan = block::view::<RadarScan>(message.payload(), layout.scan).unwrap()[0];
        let detections: &[RadarDetection] = block::view(message.payload(), layout.detections).unwrap();
        let states = &world[&message.header.tick];
        for seen in detections.iter().filter(|seen| seen.object_id < NO_OBJECT >> 1) {
            let state = states.iter().find(|state| state.vehicle == seen.object_id).unwrap();
            let (dx, dy) = (state.x_m - scan.position_m[0], state.y_m - scan.position_m[1]);
            let off_m = (dx.hypot(dy) - f64::from(seen.distance_m)).abs();
            assert!(off_m < f64::from(state.length_m) + 2.0, "{off_m} m off: {seen:?}");
            detected += 1;
        }
    }
    assert!(detected > 100, "only {detected} detections of road users");

    // The same seed gives the same images and detections, without a recorder and with another window too.
    workplace.succeed(&[&arguments(&SIGHTS[..3])[..], &["--name", "second"]].concat());
    let [first, second] = ["first", "second"].map(|name| workplace.report(name));
    for sensor in ["camera", "radar"] {
        let messages = first[sensor]["messages"].as_u64().unwrap() as usize;
        assert!(
            (50 * CARRIERS..=TICKS * CARRIERS).contains(&messages),
            "{}",
            first[sensor]
        );
        assert_eq!(first[sensor], second[sensor]);
    }
    assert_eq!(first["observation_hash"], second["observation_hash"]);
    workplace.assert_nothing_left();
}
