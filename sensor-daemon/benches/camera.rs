//! Images per second of one core: 500 buildings, 200 moving vehicles, 16 cameras. `cargo bench -p sensor-daemon --bench camera`
//!
//! Times are of the thread's processor time, because other work may run on the machine.

#![allow(clippy::unwrap_used, reason = "measurements assert by unwrapping")]

#[path = "../tests/lidar_city/mod.rs"]
mod lidar_city;

use lidar_city::{Moves, traffic};
use sensor_daemon::sensors::{
    camera::{
        CameraModel, CameraParams, CameraScratch, CameraShot, CameraTargets, EventMemory, ImagePlanes, PastPoses,
        SampledSpan,
    },
    lidar::{ScanPath, Targets},
};
use sim_core::scene::{Road, RoadPiece, Scene, SurfaceKind};

const CAMERAS: usize = 16;
const ROUNDS: usize = 7;

/// Processor time of this thread, seconds.
fn now_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// The test city with a net: two lanes and two pavements in every street.
fn city() -> Scene {
    let bare = lidar_city::scene(500, 1);
    let mut pieces = Vec::new();
    for street in 0..17 {
        let at = 50.0 * (f64::from(street) - 8.0);
        for (lane, off) in [-5.0, -2.0, 2.0, 5.0].into_iter().enumerate() {
            for is_north in [false, true] {
                let ends = [-420.0, 420.0].map(|along| {
                    if is_north {
                        [at + off, along, 0.0]
                    } else {
                        [along, at + off, 0.0]
                    }
                });
                let is_lane = off.abs() < 3.0;
                pieces.push(RoadPiece {
                    id: format!("street{street}{is_north}_{lane}"),
                    surface: if is_lane {
                        SurfaceKind::Lane
                    } else {
                        SurfaceKind::Sidewalk
                    },
                    shape_m: ends.to_vec(),
                    half_width_m: Some(if is_lane { 2.0 } else { 1.0 }),
                    junctions: [0; 2],
                });
            }
        }
    }
    Scene::new(Road::new(pieces), bare.buildings().to_vec(), Vec::new())
}

/// What an image shows.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shows {
    /// Depth, instance, semantic.
    Labels,
    /// These and colours.
    Rgb,
    /// The apparent temperature alone.
    Infrared,
    /// These and the optical flow.
    Flow,
    /// The events of a tick of ten sub-steps alone.
    Events,
}

/// Sub-steps of a tick.
const SUB_STEPS: usize = 10;

/// Images per second: the median of the rounds.
fn rate(camera: &CameraModel, moves: Moves, shows: Shows) -> f64 {
    let [width, height] = camera.size();
    let pixels = width * height;
    let wants = |kinds: &[Shows]| if kinds.contains(&shows) { pixels } else { 0 };
    let labels = wants(&[Shows::Labels, Shows::Rgb, Shows::Flow]);
    let (mut depth_m, mut instance, mut semantic) = (vec![0.0; labels], vec![0; labels], vec![0; labels]);
    let mut rgb = vec![[0; 3]; wants(&[Shows::Rgb])];
    let mut infrared = vec![0; wants(&[Shows::Infrared])];
    let mut flow_px = vec![[0.0; 2]; wants(&[Shows::Flow])];
    let mut brightness = vec![0.0; wants(&[Shows::Events])];
    let (mut poses, mut events) = (PastPoses::default(), Vec::new());
    let mut memories = vec![EventMemory::default(); CAMERAS];
    let (mut scratch, mut objects) = (CameraScratch::default(), Vec::new());
    let (mut targets, mut seen) = (Targets::default(), CameraTargets::default());
    let mut rates: Vec<f64> = (0..ROUNDS)
        .map(|round| {
            let ticks: Vec<_> = (0..20)
                .map(|tick| traffic(200, 0, moves, round as u64 * 20 + tick, 2))
                .collect();
            let since_s = now_s();
            let mut images = 0;
            for (states, steps) in &ticks {
                let sub_steps = if shows == Shows::Events { SUB_STEPS } else { 0 };
                targets.update(states, steps, sub_steps);
                seen.update(&targets);
                for sub_step in 0..sub_steps.max(1) {
                    if sub_steps > 0 {
                        seen.update_within(&targets, sub_step);
                    }
                    for (row, memory) in memories.iter_mut().enumerate() {
                        let pose = match sub_steps {
                            0 => camera.pose_on(&targets, row),
                            _ => camera.pose_within(&targets, row, sub_step),
                        };
                        let past = camera.past_pose_on(states[row].vehicle, &poses);
                        let mut planes = ImagePlanes {
                            depth_m: &mut depth_m,
                            instance: &mut instance,
                            semantic: &mut semantic,
                            rgb: &mut rgb,
                            infrared: &mut infrared,
                            flow_px: &mut flow_px,
                            brightness: &mut brightness,
                            ..ImagePlanes::default()
                        };
                        let shot = CameraShot {
                            targets: &seen,
                            carrier: Some(row),
                            pose: pose.unwrap(),
                            past: past.map(|pose| (pose, &poses)),
                        };
                        camera.take(&shot, &mut scratch, &mut planes, &mut objects);
                        if sub_steps > 0 {
                            let span = SampledSpan {
                                begin_us: 0.0,
                                length_us: 1e4,
                            };
                            events.clear();
                            memory.sample(&brightness, width, 0.2, span, &mut events);
                        }
                        images += u32::from(sub_step == 0);
                    }
                }
                if shows == Shows::Flow {
                    poses.record(&targets);
                }
            }
            f64::from(images) / (now_s() - since_s)
        })
        .collect();
    rates.sort_by(f64::total_cmp);
    rates[ROUNDS / 2]
}

fn main() {
    let scene = city();
    println!(
        "images/s of one core, 500 buildings, 200 moving vehicles, 90°, 150 m: depth + semantic + instance; with colours; infrared \
         alone; depth + semantic + instance with optical flow; ticks of events alone, of ten sub-steps"
    );
    for path in ScanPath::ALL.into_iter().filter(|path| path.is_here()) {
        for (width, height) in [(84, 84), (320, 160)] {
            let params = CameraParams {
                width,
                height,
                horizontal_fov_deg: 90.0,
                range_m: 150.0,
                distortion: [0.0; 5],
                mount: [1.5, 0.0, 1.4, 0.0, 0.0, 0.0],
            };
            let camera = CameraModel::new(&params, &lidar_city::config(), &scene).with_path(path);
            for (name, moves) in [("upright", Moves::Straight), ("leaning", Moves::Wildly)] {
                let kinds = [Shows::Labels, Shows::Rgb, Shows::Infrared, Shows::Flow, Shows::Events];
                let rates = kinds.map(|shows| format!("{:.0}", rate(&camera, moves, shows)));
                println!("{path:?} {width} x {height} {name}: {}", rates.join(", "));
            }
        }
    }
}
