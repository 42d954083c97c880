//! The topics of mounted sensors: what cameras, radars and LIDARs send goes to those who subscribe to a sensor's key, and to no others.

#![allow(clippy::unwrap_used, reason = "a failed step fails the test")]

#[cfg(test)]
#[allow(dead_code, reason = "each test file uses its own part")]
mod harness;

use bytemuck::{bytes_of, pod_read_unaligned};
use fanout::{frame::MAX_SENSOR_BYTES, network::keys::Topic, reader};
use harness::{PATIENCE, Run, ask, decoded, header, next, publisher, send_census, send_world, until, watch};
use ipc_schema::{
    block::view_mut,
    config::Config,
    image::{ImageHead, ImageLayout, ImagePlane, SeenObject},
    membership::RunMembership,
    pointcloud::{PointcloudLayout, Scan},
    ports::Publisher,
    process::Process,
    radar::{RadarDetection, RadarLayout, RadarScan},
    run::Mode,
    services::Channel,
    traffic::id_hash,
};
use zenoh::Wait as _;

const IDS: [&str; 2] = ["cav.0", "a/b #?$*"];
/// Planes of the images in these runs.
const PLANES: [ImagePlane; 2] = [ImagePlane::Semantic, ImagePlane::Rgb];

/// Two vehicles with a camera of `width` × `height` pixels, a radar and a LIDAR each.
fn sensing(width: u32, height: u32) -> impl FnOnce(&mut Config) {
    move |config| {
        let camera = &mut config.camera;
        (camera.vehicles, camera.width, camera.height) = (2, width, height);
        (camera.semantic, camera.rgb) = (true, true);
        (camera.depth, camera.instance, camera.binary) = (false, false, false);
        config.radar.vehicles = 2;
    }
}

/// An image whose pixels are numbers that depend on the tick, with one road user.
fn image(tick: u64, index: u32, width: u32, height: u32) -> (ImageLayout, Vec<u8>) {
    let bytes_of_planes: usize = PLANES.iter().map(|plane| plane.pixel_bytes()).sum();
    let layout = ImageLayout::new(1, (width * height) as usize * bytes_of_planes, 0);
    let mut words = vec![0_u64; layout.len.div_ceil(8)];
    let payload: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
    view_mut::<ImageHead>(payload, layout.head).unwrap()[0] = ImageHead {
        id_hash: id_hash(IDS[index as usize]),
        vehicle: index,
        width,
        height,
        planes: PLANES.iter().map(|plane| plane.bit()).sum(),
        ..ImageHead::default()
    };
    let pixels: &mut [u8] = view_mut(payload, layout.planes).unwrap();
    for (place, pixel) in pixels.iter_mut().enumerate() {
        *pixel = (place as u64 * 31 + tick) as u8;
    }
    view_mut::<SeenObject>(payload, layout.objects).unwrap()[0].object = 5;
    (layout, payload[..layout.len].to_vec())
}

/// Sends a message; returns the number of subscribers that it went to.
fn send(sensors: &RunMembership, port: &Publisher, tick: u64, shape: [u32; 4], payload: &[u8]) -> usize {
    let mut draft = port.loan(header(sensors, tick, 0, shape), payload.len()).unwrap();
    draft.payload_mut().copy_from_slice(payload);
    draft.send().unwrap()
}

/// Announces the road users of a run whose fan-out is attached, and waits until it knows their ids.
fn announce(run: &Run, viewer: &zenoh::Session) {
    let (bridge, censuses) = publisher(run, Channel::Census);
    let (sim, worlds) = publisher(run, Channel::World);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    send_world(&sim, &worlds, 0, 0, 2);
    send_census(&bridge, &censuses, 0, &IDS, "r");
    until("the table of road users", || {
        ask(viewer, &run.key(Topic::Vehicles)).is_some()
    });
}

/// An image has the bytes of shared memory, is sent under the key of its carrier alone, and only while a viewer subscribes: before and
/// after, the fan-out takes no message.
#[test]
fn an_image_goes_to_those_who_subscribe_while_they_do() {
    let run = Run::with_settings("images", Mode::Simulate, 50.0, sensing(84, 60));
    let _fanout = run.start_fanout();
    let viewer = run.attach();
    announce(&run, &viewer);
    let (sensors, images) = publisher(&run, Channel::Image);
    let mut tick = 0;
    let mut send_both = || {
        tick += 1;
        [0, 1].map(|index| {
            let (layout, payload) = image(tick, index, 84, 60);
            send(&sensors, &images, tick, layout.shape, &payload)
        })
    };
    assert_eq!(send_both(), [0, 0], "no message is kept for a fan-out without viewers");

    let key = run.sensor_key(Channel::Image, IDS[1]);
    let seen = watch(&viewer, key.clone());
    until("an image", || {
        send_both();
        ask(&viewer, &key).is_some()
    });
    assert_eq!(send_both(), [1, 1]);
    for _ in 0..3 {
        // Images that come before the next is due are not sent on.
        let mut came = None;
        until("another image", || {
            send_both();
            came = seen.try_recv().unwrap();
            came.is_some()
        });
        let (header, payload) = decoded(&came.unwrap());
        let (layout, expected) = image(header.tick, 1, 84, 60);
        assert_eq!((header.shape, payload), (layout.shape, expected));
    }
    assert!(ask(&viewer, &run.sensor_key(Channel::Image, IDS[0])).is_none());
    assert!(ask(&viewer, &run.sensor_key(Channel::Radar, IDS[1])).is_none());

    seen.undeclare().wait().unwrap();
    until("the end of the subscription", || send_both() == [0, 0]);
    until("the end of the answers", || ask(&viewer, &key).is_none());
}

/// A fan-out adds to the reserve of a run what it has in hand, and no queue of images of its own.
#[test]
fn a_fan_out_needs_few_images_more() {
    let run = Run::with_settings("reserve", Mode::Simulate, 50.0, sensing(84, 60));
    let mut alone = run.file.clone();
    alone.config.fanout.enabled = false;
    for channel in [Channel::Image, Channel::Radar, Channel::Pointcloud] {
        let spec = channel.spec();
        let [with, without] = [&run.file, &alone].map(|file| channel.worst_case_messages(file));
        assert_eq!(with, without + (spec.in_hand)(&run.file), "{}", spec.name);
        assert!(without > channel.queue_length(&alone), "{}", spec.name);
    }
}

/// An image that is too long for a frame goes out reduced, and is counted.
#[test]
fn a_large_image_goes_out_reduced_and_is_counted() {
    let (width, height) = (900, 500);
    let run = Run::with_settings("large images", Mode::Simulate, 50.0, sensing(width, height));
    let _fanout = run.start_fanout();
    let viewer = run.attach();
    announce(&run, &viewer);
    let (sensors, images) = publisher(&run, Channel::Image);
    let key = run.sensor_key(Channel::Image, IDS[0]);
    let seen = watch(&viewer, key.clone());
    let mut tick = 0;
    until("an image", || {
        tick += 1;
        let (layout, payload) = image(tick, 0, width, height);
        send(&sensors, &images, tick, layout.shape, &payload);
        ask(&viewer, &key).is_some()
    });
    let sample = seen.recv_timeout(PATIENCE).unwrap().unwrap();
    let bytes = sample.payload().to_bytes();
    assert!(bytes.len() <= MAX_SENSOR_BYTES && reader::check("image/x", &bytes, None).is_ok());
    let (header, payload) = fanout::frame::decode(&bytes).unwrap();
    let head: ImageHead = pod_read_unaligned(&payload[..size_of::<ImageHead>()]);
    assert_eq!(
        (head.width, head.height, head.planes),
        (450, 250, ImagePlane::Rgb.bit())
    );
    // The classes come before the colours.
    let (whole, expected) = image(header.tick, 0, width, height);
    let colours = &expected[whole.planes.offset + (width * height) as usize..];
    let pixels = &payload[ImageLayout::of(&header).planes.offset..];
    for (row, column) in [(0_usize, 0_usize), (0, 449), (249, 0), (249, 449), (100, 200)] {
        let place = 3 * ((2 * row + 1) * width as usize + 2 * column + 1);
        let shown = 3 * (row * 450 + column);
        assert_eq!(pixels[shown..shown + 3], colours[place..place + 3], "{row} {column}");
    }
    until("the count of reduced images", || {
        let status: serde_json::Value =
            serde_json::from_slice(&ask(&viewer, &run.key(Topic::Status)).unwrap()).unwrap();
        status["fanout"]["reduced_images"].as_u64().unwrap() > 0
    });
}

/// Images, points and detections of one vehicle go out at the same time, each under its own key.
#[test]
fn the_three_kinds_of_mounted_sensors_go_out_beside_one_another() {
    let run = Run::with_settings("three kinds", Mode::Simulate, 50.0, sensing(84, 60));
    let _fanout = run.start_fanout();
    let viewer = run.attach();
    announce(&run, &viewer);
    let (sensors, images) = publisher(&run, Channel::Image);
    let [radars, lidars] = [Channel::Radar, Channel::Pointcloud].map(|channel| sensors.publisher(channel).unwrap());
    let kinds = [Channel::Image, Channel::Radar, Channel::Pointcloud];
    let keys = kinds.map(|channel| run.sensor_key(channel, IDS[1]));
    let [seen, detected, scanned] = keys.clone().map(|key| watch(&viewer, key));
    let mut tick = 0;
    until("a frame of each", || {
        tick += 1;
        let (layout, payload) = image(tick, 1, 84, 60);
        send(&sensors, &images, tick, layout.shape, &payload);
        let (layout, payload) = detections(tick);
        send(&sensors, &radars, tick, layout.shape, &payload);
        let layout = PointcloudLayout::new(7);
        let mut payload = vec![0; layout.len];
        let scan = Scan {
            id_hash: id_hash(IDS[1]),
            vehicle: 1,
            ..Scan::default()
        };
        payload[..size_of::<Scan>()].copy_from_slice(bytes_of(&scan));
        send(&sensors, &lidars, tick, layout.shape, &payload);
        keys.iter().all(|key| ask(&viewer, key).is_some())
    });
    let (header, payload) = next(&detected);
    let (layout, expected) = detections(header.tick);
    assert_eq!(header.shape, layout.shape);
    for section in [layout.scan, layout.detections] {
        let part = section.offset..section.offset + section.len;
        assert_eq!(payload[part.clone()], expected[part]);
    }
    assert_eq!(next(&seen).0.shape, image(0, 1, 84, 60).0.shape);
    assert_eq!(next(&scanned).0.rows(), 7);
}

/// Four detections of the second vehicle, at distances that depend on the tick.
fn detections(tick: u64) -> (RadarLayout, Vec<u8>) {
    let layout = RadarLayout::new(4);
    let mut words = vec![0_u64; layout.len.div_ceil(8)];
    let payload: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
    view_mut::<RadarScan>(payload, layout.scan).unwrap()[0] = RadarScan {
        id_hash: id_hash(IDS[1]),
        vehicle: 1,
        ..RadarScan::default()
    };
    let rows: &mut [RadarDetection] = view_mut(payload, layout.detections).unwrap();
    for (row, place) in rows.iter_mut().zip(0_u8..) {
        row.distance_m = tick as f32 + f32::from(place);
    }
    (layout, payload[..layout.len].to_vec())
}
