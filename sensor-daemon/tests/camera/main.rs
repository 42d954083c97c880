//! Images of cameras: against parry3d, on every instruction set, and in closed form.

#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping")]

use ipc_schema::{
    config::Config,
    pointcloud::GROUND,
    traffic::Kind,
    world::{SubStep, VehicleState},
};
use sensor_daemon::sensors::{
    camera::{
        CameraModel, CameraParams, CameraPose, CameraScratch, CameraShot, CameraTargets, ImageNoise, ImagePlanes,
        PastPoses, SeenObject,
    },
    lidar::Targets,
};
use sim_core::scene::{Prism, Road, Scene, SolidClass};

mod boxes;
mod closed_form;
mod flow;
#[path = "../lidar_city/mod.rs"]
mod lidar_city;
mod noise;
mod oracle;
mod paths;
mod shutter;

/// An image with all planes.
#[derive(Debug, Default, Clone, PartialEq)]
struct Taken {
    depth_m: Vec<f32>,
    instance: Vec<u32>,
    semantic: Vec<u8>,
    rgb: Vec<[u8; 3]>,
    binary: Vec<u8>,
    infrared: Vec<u16>,
    flow_px: Vec<[f32; 2]>,
    brightness: Vec<f32>,
    objects: Vec<SeenObject>,
}

fn params(width: usize, height: usize, mount: [f64; 6]) -> CameraParams {
    CameraParams {
        width,
        height,
        horizontal_fov_deg: 90.0,
        range_m: 120.0,
        distortion: [0.0; 5],
        mount,
        shutter: None,
    }
}

fn config() -> Config {
    lidar_city::config()
}

/// Takes an image from the road user in `row`.
fn take(camera: &CameraModel, states: &[VehicleState], row: usize, scratch: &mut CameraScratch) -> (Taken, CameraPose) {
    take_since(camera, None, states, row, scratch)
}

/// Takes an image from the road user in `row` during the last of these ticks, with the optical flow since the first of them.
fn take_rolling(
    camera: &CameraModel,
    before: Option<(&[VehicleState], &[SubStep])>,
    (states, steps): (&[VehicleState], &[SubStep]),
    row: usize,
    scratch: &mut CameraScratch,
) -> Taken {
    take_in(camera, before, (states, steps), row, None, scratch).0
}

/// Takes an image from the road user in `row`, with noise.
fn take_noisy(camera: &CameraModel, states: &[VehicleState], row: usize, noise: Option<ImageNoise>) -> Taken {
    take_with(camera, None, states, row, noise, &mut CameraScratch::default()).0
}

/// Takes an image from the road user in `row`, with the optical flow since `before`.
fn take_since(
    camera: &CameraModel,
    before: Option<&[VehicleState]>,
    states: &[VehicleState],
    row: usize,
    scratch: &mut CameraScratch,
) -> (Taken, CameraPose) {
    take_with(camera, before, states, row, None, scratch)
}

fn take_with(
    camera: &CameraModel,
    before: Option<&[VehicleState]>,
    states: &[VehicleState],
    row: usize,
    noise: Option<ImageNoise>,
    scratch: &mut CameraScratch,
) -> (Taken, CameraPose) {
    let before = before.map(|before| (before, &[][..]));
    take_in(camera, before, (states, &[]), row, noise, scratch)
}

fn take_in(
    camera: &CameraModel,
    before: Option<(&[VehicleState], &[SubStep])>,
    (states, steps): (&[VehicleState], &[SubStep]),
    row: usize,
    noise: Option<ImageNoise>,
    scratch: &mut CameraScratch,
) -> (Taken, CameraPose) {
    let mut poses = PastPoses::default();
    if let Some((states, steps)) = before {
        let mut targets = Targets::default();
        targets.update(states, steps, steps.len() / states.len());
        poses.record(&targets);
    }
    let past = camera.past_pose_on(states[row].vehicle, &poses);
    let mut targets = Targets::default();
    targets.update(states, steps, steps.len() / states.len());
    let mut seen = CameraTargets::default();
    seen.update(&targets);
    let [width, height] = camera.size();
    let pixels = width * height;
    let mut taken = Taken {
        depth_m: vec![0.0; pixels],
        instance: vec![0; pixels],
        semantic: vec![0; pixels],
        rgb: vec![[0; 3]; pixels],
        binary: vec![0; pixels],
        infrared: vec![0; pixels],
        flow_px: vec![[9e9; 2]; pixels],
        brightness: vec![-1.0; pixels],
        objects: Vec::new(),
    };
    let pose = camera.pose_on(&targets, row).unwrap();
    let mut planes = ImagePlanes {
        depth_m: &mut taken.depth_m,
        instance: &mut taken.instance,
        semantic: &mut taken.semantic,
        rgb: &mut taken.rgb,
        binary: &mut taken.binary,
        infrared: &mut taken.infrared,
        flow_px: &mut taken.flow_px,
        brightness: &mut taken.brightness,
    };
    let shot = CameraShot {
        noise,
        targets: &seen,
        tick: Some(&targets),
        carrier: Some(row),
        pose,
        past: past.map(|pose| (pose, &poses)),
    };
    camera.take(&shot, scratch, &mut planes, &mut taken.objects);
    // Images are compared, and "not a number" differs from itself.
    let flows = taken.flow_px.iter_mut();
    flows
        .filter(|flow| flow.iter().any(|part| part.is_nan()))
        .for_each(|flow| *flow = flow::UNKNOWN);
    (taken, pose)
}

fn car(number: u32, x: f64, y: f64, yaw: f64) -> VehicleState {
    VehicleState {
        x_m: x,
        y_m: y,
        yaw_rad: yaw,
        id_hash: u64::from(number) + 9,
        length_m: 4.0,
        width_m: 2.0,
        height_m: 1.5,
        rear_overhang_m: 1.0,
        vehicle: number,
        kind: Kind::Other as u32,
        ..VehicleState::default()
    }
}

fn rectangle(x: [f64; 2], y: [f64; 2], height_m: f64) -> Prism {
    let outline = vec![[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]];
    Prism::new("block".into(), SolidClass::Building, outline, 0.0, height_m).unwrap()
}

fn scene_of(buildings: Vec<Prism>) -> Scene {
    Scene::new(Road::default(), buildings, Vec::new())
}
