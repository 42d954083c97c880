//! Images per second of one core, beside general renderers on the same boxes and cameras.

use std::path::Path;

use ipc_schema::{config::Config, pointcloud::STATIC_OBJECT, world::VehicleState};
use sensor_daemon::sensors::{
    camera::{
        CameraModel, CameraParams, CameraScratch, CameraShot, CameraTargets, EventMemory, ImagePlanes, PastPoses,
        RollingShutter, SKY_INSTANCE, SampledSpan,
    },
    lidar::{ScanPath, Targets},
};
use sim_core::scene::Scene;

use crate::{
    BenchSize,
    city::Ground,
    lidar_city::{self, oracle},
    now_s,
    peers::{Peers, Scratch, box_of, write_raw},
};

/// The first vehicles carry a camera.
const CAMERAS: usize = 16;
/// Pairs with each peer.
const PAIRS: usize = 5;
const RANGE_M: f64 = 150.0;
const SIZES: [[usize; 2]; 2] = [[84, 84], [320, 160]];

/// What an image shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Shows {
    /// Depth, instance, semantic.
    Labels,
    /// The labels and colours.
    Rgb,
    /// The apparent temperature alone.
    Infrared,
    /// The labels and the optical flow.
    Flow,
    /// The events of a tick of ten sub-steps alone.
    Events,
    /// The labels, by a rolling shutter that reads for 30 ms.
    Rolling,
}

/// Sub-steps of a tick.
const SUB_STEPS: usize = 10;

/// Images per second: the median of the rounds.
fn rate(camera: &CameraModel, (ground, scene): (Ground, &Scene), shows: Shows, size: &BenchSize) -> f64 {
    let [width, height] = camera.size();
    let pixels = width * height;
    let wants = |kinds: &[Shows]| if kinds.contains(&shows) { pixels } else { 0 };
    let labels = wants(&[Shows::Labels, Shows::Rolling, Shows::Rgb, Shows::Flow]);
    let (mut depth_m, mut instance, mut semantic) = (vec![0.0; labels], vec![0; labels], vec![0; labels]);
    let mut rgb = vec![[0; 3]; wants(&[Shows::Rgb])];
    let mut infrared = vec![0; wants(&[Shows::Infrared])];
    let mut flow_px = vec![[0.0; 2]; wants(&[Shows::Flow])];
    let mut brightness = vec![0.0; wants(&[Shows::Events])];
    let (mut poses, mut events) = (PastPoses::default(), Vec::new());
    let mut memories = vec![EventMemory::default(); CAMERAS];
    let (mut scratch, mut objects) = (CameraScratch::default(), Vec::new());
    let (mut targets, mut seen) = (Targets::default(), CameraTargets::default());
    let mut rates: Vec<f64> = (0..size.rounds)
        .map(|round| {
            // A tick of events is ten images.
            let count = size.ticks.div_ceil(if shows == Shows::Events { 5 } else { 1 });
            let ticks: Vec<_> = (0..count)
                .map(|tick| ground.traffic(scene, CAMERAS, round as u64 * size.ticks + tick))
                .collect();
            let since_s = now_s();
            let mut images = 0;
            for (states, steps) in &ticks {
                let sub_steps = if shows == Shows::Events { SUB_STEPS } else { 0 };
                let known_steps = if shows == Shows::Rolling { SUB_STEPS } else { sub_steps };
                targets.update(states, steps, known_steps);
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
                            noise: None,
                            targets: &seen,
                            tick: (sub_steps == 0).then_some(&targets),
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
    rates[size.rounds / 2]
}

impl Shows {
    const ALL: [Self; 6] = [
        Self::Labels,
        Self::Rgb,
        Self::Flow,
        Self::Infrared,
        Self::Events,
        Self::Rolling,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Labels => "depth, semantic, instance",
            Self::Rgb => "these and colours",
            Self::Flow => "the first three and optical flow",
            Self::Infrared => "infrared alone",
            Self::Events => "events alone, ten sub-steps",
            Self::Rolling => "the first three, rolling shutter",
        }
    }
}

fn camera([width, height]: [usize; 2], scene: &Scene, shutter: Option<RollingShutter>) -> CameraModel {
    let params = CameraParams {
        width,
        height,
        horizontal_fov_deg: 90.0,
        range_m: RANGE_M,
        distortion: [0.0; 5],
        mount: [1.5, 0.0, 1.4, 0.0, 0.0, 0.0],
        shutter,
    };
    CameraModel::new(&params, &config(), scene)
}

fn name_of(path: ScanPath) -> &'static str {
    match path {
        ScanPath::Avx512 => "AVX-512",
        ScanPath::Avx2 => "AVX2",
        ScanPath::Plain => "plain",
    }
}

fn config() -> Config {
    lidar_city::config()
}

/// Images per second of every instruction set, size, ground and selection of planes; with peers if `python` has them.
pub fn measure(python: Option<&Path>, bench: &BenchSize) -> serde_json::Value {
    let mut rows = Vec::new();
    for ground in Ground::ALL {
        let scene = ground.scene();
        for size in SIZES {
            for path in ScanPath::ALL.into_iter().filter(|path| path.is_here()) {
                for shows in Shows::ALL {
                    let shutter = (shows == Shows::Rolling).then_some(RollingShutter {
                        readout_s: 0.03,
                        tick_s: lidar_city::TICK_S,
                    });
                    let camera = camera(size, &scene, shutter).with_path(path);
                    let rate = rate(&camera, (ground, &scene), shows, bench);
                    println!(
                        "{} {size:?} {} {}: {rate:.0} images/s",
                        name_of(path),
                        ground.name(),
                        shows.name()
                    );
                    rows.push(serde_json::json!({
                        "path": name_of(path), "size": size, "ground": ground.name(), "planes": shows.name(), "images_per_s": rate,
                    }));
                }
                if bench.is_quick() {
                    break;
                }
            }
        }
    }
    let mut peers = Vec::new();
    if let Some(python) = python {
        for size in SIZES {
            beside_peers(python, size, &mut peers);
        }
    } else {
        println!("peers left out: --python PATH names an interpreter with open3d and mujoco (`make peers`)");
    }
    serde_json::json!({ "rows": rows, "peers": peers })
}

/// The triangles, their owners and the cameras of a frame.
fn write_frame(directory: &Path, scene: &Scene, states: &[VehicleState], camera: &CameraModel, targets: &Targets) {
    let (mut vertices, mut faces, objects) = oracle::triangles(scene);
    // The ground is the owner 0.
    let mut owners: Vec<u32> = objects.iter().map(|object| (object & !STATIC_OBJECT) + 1).collect();
    for (owner, state) in (1 + scene.buildings().len() as u32..).zip(&states[CAMERAS..]) {
        for part in lidar_city::parts(state) {
            box_of(state, part, &mut vertices, &mut faces);
        }
        owners.resize(faces.len(), owner);
    }
    let (first, far) = (vertices.len() as u32, 2000.0);
    vertices.extend([[-far, -far, 0.0], [far, -far, 0.0], [far, far, 0.0], [-far, far, 0.0]]);
    faces.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    owners.resize(faces.len(), 0);
    let mut cameras = Vec::new();
    for row in 0..CAMERAS {
        let pose = camera.pose_on(targets, row).unwrap();
        cameras.extend(pose.position_m());
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| pose.world_from_camera(axis));
        cameras.extend((0..3).flat_map(|part| axes.map(|axis| axis[part])));
    }
    let single = |numbers: &[f64]| numbers.iter().map(|number| *number as f32).collect::<Vec<f32>>();
    write_raw(directory, "vertices.f32", &single(vertices.as_flattened()));
    write_raw(directory, "faces.u32", &faces);
    write_raw(directory, "owner.u32", &owners);
    write_raw(directory, "cameras.f32", &single(&cameras));
    let [width, height] = camera.size();
    let image = serde_json::json!({ "width": width, "height": height, "horizontal_fov_deg": 90.0, "range_m": RANGE_M });
    std::fs::write(directory.join("image.json"), image.to_string()).unwrap();
}

/// Images of one tick from all cameras, again and again.
struct StillScene {
    camera: CameraModel,
    targets: Targets,
    seen: CameraTargets,
    states: Vec<VehicleState>,
    scratch: CameraScratch,
    depth_m: Vec<f32>,
    instance: Vec<u32>,
    semantic: Vec<u8>,
    rgb: Vec<[u8; 3]>,
}

/// One round of a side.
struct ImageRound {
    seconds: f64,
    images: f64,
    /// Share of the pixels that hit something, and the mean depth of these.
    hits: f64,
    depth_m: f64,
}

impl StillScene {
    fn new(size: [usize; 2], scene: &Scene) -> Self {
        let camera = camera(size, scene, None);
        let (mut states, _) = Ground::Upright.traffic(scene, CAMERAS, 0);
        // Vehicles of random traffic overlap, and Open3D sees walls from inside: none is about a camera.
        let carriers: Vec<[f64; 2]> = states[..CAMERAS].iter().map(|state| [state.x_m, state.y_m]).collect();
        for state in &mut states[CAMERAS..] {
            if carriers
                .iter()
                .any(|[x, y]| (state.x_m - x).hypot(state.y_m - y) < 15.0)
            {
                state.height_m = 0.0;
            }
        }
        let (mut targets, pixels) = (Targets::default(), size[0] * size[1]);
        targets.update(&states, &[], 0);
        Self {
            camera,
            targets,
            seen: CameraTargets::default(),
            states,
            scratch: CameraScratch::default(),
            depth_m: vec![0.0; pixels],
            instance: vec![0; pixels],
            semantic: vec![0; pixels],
            rgb: vec![[0; 3]; pixels],
        }
    }

    /// All cameras again and again, the road users placed anew each time, with or without colours: for about as long as a peer needs.
    fn round(&mut self, with_rgb: bool) -> ImageRound {
        let mut round = ImageRound {
            seconds: 0.0,
            images: 0.0,
            hits: 0.0,
            depth_m: 0.0,
        };
        let mut objects = Vec::new();
        for again in 0..60 {
            let since_s = now_s();
            self.targets.update(&self.states, &[], 0);
            self.seen.update(&self.targets);
            round.seconds += now_s() - since_s;
            for row in 0..CAMERAS {
                let since_s = now_s();
                let shot = CameraShot {
                    noise: None,
                    targets: &self.seen,
                    tick: None,
                    carrier: Some(row),
                    pose: self.camera.pose_on(&self.targets, row).unwrap(),
                    past: None,
                };
                let mut planes = ImagePlanes {
                    depth_m: &mut self.depth_m,
                    instance: &mut self.instance,
                    semantic: &mut self.semantic,
                    ..ImagePlanes::default()
                };
                if with_rgb {
                    planes.rgb = &mut self.rgb;
                }
                self.camera.take(&shot, &mut self.scratch, &mut planes, &mut objects);
                round.seconds += now_s() - since_s;
                round.images += 1.0;
                if again == 0 {
                    let seen = self
                        .instance
                        .iter()
                        .zip(&self.depth_m)
                        .filter(|(instance, _)| **instance != SKY_INSTANCE);
                    let (count, sum) = seen.fold((0, 0.0), |(count, sum), (_, depth_m)| {
                        (count + 1, sum + f64::from(*depth_m))
                    });
                    round.hits += f64::from(count);
                    round.depth_m += sum;
                }
            }
        }
        round.depth_m /= round.hits;
        round.hits /= (CAMERAS * self.depth_m.len()) as f64;
        round
    }
}

/// Alternating rounds with every peer.
fn beside_peers(python: &Path, size: [usize; 2], report: &mut Vec<serde_json::Value>) {
    let directory = Scratch::new("sights-bench");
    let scene = Ground::Upright.scene();
    let mut ours = StillScene::new(size, &scene);
    write_frame(&directory.0, &scene, &ours.states, &ours.camera, &ours.targets);
    let mut peers = Peers::start(python, "camera_peers.py", &directory.0);
    // MuJoCo's colours need a pass of their own: they are added to its labels, because ours have both.
    let sides: [(&str, &[&str], bool); 3] = [
        ("open3d, labels", &["open3d"], false),
        ("mujoco, labels", &["mujoco"], false),
        ("mujoco, labels and colours", &["mujoco", "mujoco_rgb"], true),
    ];
    for (title, names, with_rgb) in sides {
        if names.iter().any(|name| !peers.names.iter().any(|known| known == name)) {
            continue;
        }
        let mut rates = Vec::new();
        let mut ratios = Vec::new();
        for pair in 0..=PAIRS {
            let mine = ours.round(with_rgb);
            let [mut seconds, mut images] = [0.0; 2];
            for name in names {
                let [s, count, hits, depth_m] = peers.round::<4>(name);
                (seconds, images) = (seconds + s, count);
                let (off_hits, off_depth) = ((hits - mine.hits).abs(), (depth_m / mine.depth_m - 1.0).abs());
                assert!(
                    off_hits < 0.01 && off_depth < 0.01,
                    "{name} does not see the same: {hits} of the pixels at {depth_m} m; here {} at {} m",
                    mine.hits,
                    mine.depth_m
                );
            }
            // The first round compiles shaders.
            if pair > 0 {
                rates.push(images / seconds);
                ratios.push(mine.images / mine.seconds / (images / seconds));
            }
        }
        rates.sort_by(f64::total_cmp);
        ratios.sort_by(f64::total_cmp);
        let [low, median, high] = [0, PAIRS / 2, PAIRS - 1].map(|place| ratios[place]);
        println!(
            "{size:?} {title}: {:.0} images/s; sensor-daemon is {median:.1} x as fast ({low:.1} ... {high:.1} in {PAIRS} pairs)",
            rates[PAIRS / 2]
        );
        report.push(serde_json::json!({
            "name": title, "size": size, "images_per_s": rates[PAIRS / 2], "ratio": median, "spread": [low, high],
        }));
    }
}
