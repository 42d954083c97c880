//! Cameras and radars in whole runs: real traffic, real shared memory, messages read from a recording.

use crate::common::{ONE_TICK_AHEAD, Workplace, of_channel, road_users, text};
use ipc_schema::{
    block,
    channel::Channel,
    image::{BrightnessEvent, ImageHead, ImageLayout, ImagePlane, SKY_INSTANCE, SeenObject},
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

/// The axes of a camera in the world: ahead, left, up.
fn axes(head: &ImageHead) -> [[f64; 3]; 3] {
    let [roll, pitch, yaw] = head.attitude_rad;
    let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), (-pitch).sin_cos(), yaw.sin_cos());
    [
        [cy * cp, sy * cp, -sp],
        [cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr],
        [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr],
    ]
}

/// Column, row and depth of a point of the world in an image.
fn projected(head: &ImageHead, point_m: [f64; 3]) -> [f64; 3] {
    let off: [f64; 3] = std::array::from_fn(|i| point_m[i] - head.position_m[i]);
    let [x, y, z] = axes(head).map(|axis| (0..3).map(|i| axis[i] * off[i]).sum::<f64>());
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

/// The head of an image, its optical flow, depths and instances, and its events.
struct MovingImage<'a> {
    head: ImageHead,
    depth_m: Vec<f32>,
    instance: Vec<u32>,
    flow_px: Vec<[f32; 2]>,
    infrared: Vec<u16>,
    events: &'a [BrightnessEvent],
}

/// The numbers of a plane.
fn numbers<T: bytemuck::Pod>(plane: &[u8]) -> Vec<T> {
    plane
        .chunks_exact(size_of::<T>())
        .map(bytemuck::pod_read_unaligned)
        .collect()
}

impl<'a> MovingImage<'a> {
    fn new(message: &'a ChannelMessage) -> Self {
        let layout = ImageLayout::of(&message.header);
        let planes: &[u8] = block::view(message.payload(), layout.planes).unwrap();
        let head = block::view::<ImageHead>(message.payload(), layout.head).unwrap()[0];
        let pixels = (head.width * head.height) as usize;
        assert_eq!(planes.len(), 18 * pixels);
        let part = |first: usize, bytes: usize| &planes[first * pixels..(first + bytes) * pixels];
        Self {
            head,
            depth_m: numbers(part(0, 4)),
            instance: numbers(part(4, 4)),
            flow_px: numbers(part(8, 8)),
            infrared: numbers(part(16, 2)),
            events: block::view(message.payload(), layout.events).unwrap(),
        }
    }

    /// The point of the world that a pixel shows.
    fn point_m(&self, pixel: usize) -> [f64; 3] {
        let (width, height) = (self.head.width as usize, self.head.height as usize);
        let focal = f64::from(self.head.focal_px);
        let a = (0.5 * width as f64 - (pixel % width) as f64 - 0.5) / focal;
        let b = (0.5 * height as f64 - (pixel / width) as f64 - 0.5) / focal;
        let (depth, axes) = (f64::from(self.depth_m[pixel]), axes(&self.head));
        std::array::from_fn(|i| self.head.position_m[i] + depth * (axes[0][i] + a * axes[1][i] + b * axes[2][i]))
    }
}

#[test]
fn flow_events_and_temperatures_are_those_of_the_traffic_and_are_made_again() {
    let settings = [
        "camera.vehicles=3",
        "camera.semantic=false",
        "camera.flow=true",
        "camera.infrared=true",
        "camera.events=true",
        ONE_TICK_AHEAD,
    ];
    let workplace = Workplace::new();
    let recording = workplace.record("first", &arguments(&settings), &[Channel::Image]);
    let mut heads = std::collections::BTreeMap::new();
    let (mut compared, mut moved, mut events) = (0, 0, 0);
    for message in of_channel(&recording, Channel::Image) {
        let image = MovingImage::new(&message);
        let (tick, vehicle) = (message.header.tick, image.head.vehicle);
        let width = image.head.width as usize;
        // The temperatures of 15 °C under an overcast sky.
        assert!(image.infrared.iter().all(|pixel| (28_500..30_500).contains(pixel)));
        // Where the still world was in the image before, by that image's own pose.
        if let Some(before) = heads.get(&(tick.wrapping_sub(1), vehicle)) {
            for pixel in (0..image.instance.len()).step_by(7) {
                let flow_px = image.flow_px[pixel].map(f64::from);
                if image.instance[pixel] < 1 << 31 || image.instance[pixel] == SKY_INSTANCE {
                    continue;
                }
                let [u, v, depth_m] = projected(before, image.point_m(pixel));
                if depth_m < 0.5 {
                    continue;
                }
                let now = [(pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5];
                let off = [now[0] - flow_px[0] - u, now[1] - flow_px[1] - v];
                assert!(off.iter().all(|part| part.abs() < 0.05), "{flow_px:?} {off:?}");
                compared += 1;
                moved += u32::from(flow_px[0].hypot(flow_px[1]) > 0.5);
            }
        } else if tick == 0 {
            assert!(image.flow_px.iter().all(|flow| flow.iter().all(|part| part.is_nan())));
        }
        let times = image.events.iter().map(|event| event.time_us);
        assert!(times.is_sorted_by(|a, b| a <= b));
        for event in image.events {
            assert!(event.time_us <= 100_000 && event.polarity.abs() == 1);
            assert!(u32::from(event.x) < image.head.width && u32::from(event.y) < image.head.height);
        }
        events += image.events.len();
        heads.insert((tick, vehicle), image.head);
    }
    assert!(
        compared > 20_000 && moved > 2_000,
        "{compared} pixels, {moved} of them moved"
    );
    assert!(events > 1_000, "only {events} events");

    // The same seed gives the same bytes, with another window too.
    workplace.succeed(&[&arguments(&settings[..5])[..], &["--name", "second"]].concat());
    let [first, second] = ["first", "second"].map(|name| workplace.report(name));
    assert_eq!(first["camera"], second["camera"]);
    workplace.assert_nothing_left();
}

#[test]
fn images_of_a_rolling_shutter_differ_from_those_of_a_global_one_and_are_made_again() {
    let settings = [
        "camera.vehicles=3",
        "camera.semantic=false",
        "camera.readout_s=0.05",
        ONE_TICK_AHEAD,
    ];
    let workplace = Workplace::new();
    let recording = workplace.record("first", &arguments(&settings), &[Channel::Image]);
    let mut boxes = 0;
    for message in of_channel(&recording, Channel::Image) {
        let (head, objects, instance) = image(&message);
        assert!((head.readout_s - 0.05).abs() < 1e-9);
        for object in objects {
            let counted = instance.iter().filter(|instance| **instance == object.object).count();
            assert_eq!(counted, object.visible_px as usize);
            boxes += 1;
        }
    }
    assert!(boxes > 50, "only {boxes} boxes");

    // The same seed gives the same images with another window too; a global shutter sees the same traffic otherwise.
    workplace.succeed(&[&arguments(&settings[..3])[..], &["--name", "second"]].concat());
    workplace.succeed(&[&arguments(&settings[..2])[..], &["--name", "global"]].concat());
    let [first, second, global] = ["first", "second", "global"].map(|name| workplace.report(name));
    assert_eq!(first["camera"], second["camera"]);
    assert_eq!(first["camera"]["messages"], global["camera"]["messages"]);
    assert_ne!(first["camera"]["hash"], global["camera"]["hash"]);
    assert_eq!(first["observation_hash"], global["observation_hash"]);
    workplace.assert_nothing_left();
}

#[test]
fn a_lens_that_folds_within_the_image_is_refused() {
    let workplace = Workplace::new();
    let settings = ["camera.vehicles=1", "camera.distortion=[-0.5, 0.0, 0.0, 0.0, 0.0]"];
    let output = workplace.run(&arguments(&settings));
    let text = text(&output);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(
        text.contains("the distortion of `camera` folds within the image"),
        "{text}"
    );
    assert!(text.contains("arrives at the pixel (0, 0)"), "{text}");
}

#[test]
fn a_dynamic_vision_sensor_that_misses_ticks_is_refused() {
    let workplace = Workplace::new();
    let settings = ["camera.vehicles=1", "camera.events=true", "camera.period_s=0.2"];
    let output = workplace.run(&arguments(&settings));
    let text = text(&output);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(
        text.contains("`camera` has events, but takes an image every 2 ticks only"),
        "{text}"
    );
}
