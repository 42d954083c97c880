//! Rays per second of the LIDAR on one core, beside general ray tracers in the same run, and its agreement with parry3d.
//!
//! `lidar-bench --help` lists the options. Open3D is `pip install open3d-cpu`; it needs libusb-1.0, libGL and libgomp.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a benchmark that cannot run panics with the reason"
)]

use std::path::{Path as FilePath, PathBuf};

use ipc_schema::{
    config::Config,
    pointcloud::{LidarPoint, Scan},
    process_main::{answer_help, misused},
    world::{SubStep, VehicleState},
};
use sensor_daemon::sensors::lidar::{LidarModel, ScanPath, ScanScratch, Targets};
use sim_core::scene::Scene;

#[path = "../../tests/lidar_city/mod.rs"]
mod lidar_city;
use lidar_city::{Moves, SUB_STEPS, oracle};
#[path = "../../benches/peers/mod.rs"]
mod peers;
use peers::{Peers, Scratch, box_of, write_raw};

const USAGE: &str = "\
usage: lidar-bench [OPTIONS]

Measures rays per second of the LIDAR on one core; `caraware bench lidar` starts it.

  --python PATH                  a Python that can `import open3d`, and perhaps `embreex`: they are measured too
  --path auto|avx512|avx2|plain  instructions; default auto, the best of this processor
  --only CASE                    measures one case
  --json FILE                    where the figures go
  --oracle                       compares fifteen million rays with parry3d instead";

const CARRIERS: usize = 16;
const BUILDINGS: usize = 500;
const VEHICLES: usize = 200;
const PAIRS: usize = 5;
/// Ticks of one round.
const TICKS: u64 = 10;

/// Options of the command line.
struct Options {
    python: Option<PathBuf>,
    path: ScanPath,
    only: Option<String>,
    json: Option<PathBuf>,
    is_oracle: bool,
}

fn options() -> Options {
    let mut options = Options {
        python: None,
        path: ScanPath::best(),
        only: None,
        json: None,
        is_oracle: false,
    };
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || {
            arguments
                .next()
                .unwrap_or_else(|| misused(&format!("{argument} needs a value"), USAGE))
        };
        match argument.as_str() {
            "--python" => options.python = Some(value().into()),
            "--only" => options.only = Some(value()),
            "--json" => options.json = Some(value().into()),
            "--path" => {
                options.path = match value().as_str() {
                    "auto" => ScanPath::best(),
                    "avx512" => ScanPath::Avx512,
                    "avx2" => ScanPath::Avx2,
                    "plain" => ScanPath::Plain,
                    other => misused(&format!("--path {other}: auto, avx512, avx2 or plain"), USAGE),
                }
            }
            "--oracle" => options.is_oracle = true,
            other => misused(&format!("unknown option {other}"), USAGE),
        }
    }
    assert!(options.path.is_here(), "this processor has no {:?}", options.path);
    options
}

fn main() {
    answer_help(USAGE);
    let options = options();
    if options.is_oracle {
        return hold_against_parry(options.path);
    }
    let mut report = serde_json::json!({ "path": format!("{:?}", options.path), "cases": {}, "lidars": {} });
    let cases = [
        ("upright", Moves::Straight, false, Ground::Flat),
        ("upright, rolling shutter", Moves::Straight, true, Ground::Flat),
        ("tilted", Moves::Wildly, false, Ground::FlatAndTilted),
        ("tilted, rolling shutter", Moves::Wildly, true, Ground::FlatAndTilted),
        ("hills", Moves::Wildly, false, Ground::Hills),
        ("hills, rolling shutter", Moves::Wildly, true, Ground::Hills),
    ];
    println!(
        "{BUILDINGS} buildings, {VEHICLES} moving vehicles, {CARRIERS} LIDARs of 32 x 1800 rays, one core, {:?}",
        options.path
    );
    let wanted = |name: &str| options.only.as_deref().is_none_or(|only| only == name);
    for (name, moves, is_rolling, ground) in cases.into_iter().filter(|case| wanted(case.0)) {
        let mut bench = Bench::new(options.path, moves, is_rolling, ground, CARRIERS);
        bench.round();
        let mut rates: Vec<f64> = (0..PAIRS).map(|_| bench.round().rate()).collect();
        rates.sort_by(f64::total_cmp);
        let round = bench.round();
        println!(
            "{name:28} {:7.1} M rays/s (best {:.1})  {:.4} ms per scan   mean range {:.1} m, returns {:.3}",
            rates[PAIRS / 2] / 1e6,
            rates[PAIRS - 1] / 1e6,
            1e3 * 57_600.0 / rates[PAIRS / 2],
            round.mean_range_m,
            round.points as f64 / round.rays as f64,
        );
        report["cases"][name] =
            serde_json::json!({ "rays_per_s": rates[PAIRS / 2], "spread": [rates[0], rates[PAIRS - 1]] });
    }
    for lidars in [1, 10, 100].into_iter().filter(|_| options.only.is_none()) {
        let mut bench = Bench::new(options.path, Moves::Wildly, true, Ground::FlatAndTilted, lidars);
        bench.round();
        let mut rates: Vec<f64> = (0..PAIRS).map(|_| bench.round().rate()).collect();
        rates.sort_by(f64::total_cmp);
        println!(
            "{lidars:4} LIDARs, tilted, rolling    {:7.1} M rays/s",
            rates[PAIRS / 2] / 1e6
        );
        report["lidars"][lidars.to_string()] = rates[PAIRS / 2].into();
    }
    if let Some(python) = &options.python {
        report["peers"] = beside_peers(python, options.path);
    } else {
        println!("peers left out: --python PATH names an interpreter with open3d (pip install open3d-cpu)");
    }
    if let Some(file) = &options.json {
        std::fs::write(file, format!("{report:#}\n")).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    }
}

/// One round.
struct Round {
    rays: usize,
    points: usize,
    seconds: f64,
    mean_range_m: f64,
}

impl Round {
    fn rate(&self) -> f64 {
        self.rays as f64 / self.seconds
    }
}

/// CPU time of this thread, seconds: other programs may run on the machine.
fn cpu_s() -> f64 {
    ipc_schema::clock::seconds(rustix::time::ClockId::ThreadCPUTime)
}

/// What the city stands on, and how the LIDARs are mounted.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Ground {
    /// A plane, and upright LIDARs.
    Flat,
    /// A plane, and LIDARs that lean.
    FlatAndTilted,
    /// Streets that rise and fall by 8 m, on slopes of up to 13 %, and LIDARs that lean.
    Hills,
}

/// A city, its traffic tick by tick, and LIDARs in it that write into shared memory.
struct Bench {
    config: Config,
    scene: Scene,
    lidar: LidarModel,
    lidars: usize,
    ticks: Vec<(Vec<VehicleState>, Vec<SubStep>)>,
    targets: Targets,
    scratch: ScanScratch,
    points: SharedMemory,
}

impl Bench {
    fn new(path: ScanPath, moves: Moves, is_rolling: bool, ground: Ground, lidars: usize) -> Self {
        let mut config = lidar_city::config();
        config.lidar.rolling_shutter = is_rolling;
        if ground != Ground::Flat {
            config.lidar.mount[3..5].copy_from_slice(&[0.02, -0.03]);
        }
        let scene = match ground {
            Ground::Hills => lidar_city::hilly(),
            _ => lidar_city::scene(BUILDINGS, 1),
        };
        let lidar = LidarModel::new(&config, &scene)
            .unwrap_or_else(|error| panic!("{error}"))
            .with_path(path);
        let ticks = (0..TICKS).map(|tick| {
            let (mut states, steps) = lidar_city::traffic(VEHICLES, 0, moves, tick, 2);
            lidar_city::stand_on(&scene, &mut states);
            // Carriers do not see themselves, and the peers leave them out too.
            states[..CARRIERS].iter_mut().for_each(|state| state.height_m = 0.0);
            (states, steps)
        });
        Self {
            ticks: ticks.collect(),
            points: SharedMemory::new(lidar.max_points()),
            config,
            scene,
            lidar,
            lidars,
            targets: Targets::default(),
            scratch: ScanScratch::default(),
        }
    }

    fn round(&mut self) -> Round {
        let mut round = Round {
            rays: 0,
            points: 0,
            seconds: 0.0,
            mean_range_m: 0.0,
        };
        let mut scan = Scan::default();
        let begin = cpu_s();
        let mut last = 0;
        for (tick, (states, steps)) in (0..).zip(&self.ticks) {
            self.targets.update(states, steps, SUB_STEPS);
            for row in 0..self.lidars {
                let points = self.points.get();
                last = self
                    .lidar
                    .scan(&self.targets, row, tick, 1, &mut self.scratch, &mut scan, points);
                round.rays += scan.rays as usize;
                round.points += last;
            }
        }
        round.seconds = cpu_s() - begin;
        let range = |point: &LidarPoint| {
            point
                .position_m
                .iter()
                .map(|part| f64::from(part * part))
                .sum::<f64>()
                .sqrt()
        };
        round.mean_range_m = self.points.get()[..last].iter().map(range).sum::<f64>() / last.max(1) as f64;
        round
    }
}

/// Shared memory that another process could read, as in a real run.
struct SharedMemory {
    at: *mut LidarPoint,
    count: usize,
}

impl SharedMemory {
    #[expect(unsafe_code, reason = "mapping memory")]
    fn new(count: usize) -> Self {
        use rustix::{
            fs::{MemfdFlags, ftruncate, memfd_create},
            mm::{MapFlags, ProtFlags, mmap},
        };
        let bytes = count * size_of::<LidarPoint>();
        let file = memfd_create("lidar-bench", MemfdFlags::CLOEXEC).unwrap();
        ftruncate(&file, bytes as u64).unwrap();
        let access = ProtFlags::READ | ProtFlags::WRITE;
        // SAFETY: a fresh mapping at an address of the kernel's choice aliases nothing; it lives until the process ends.
        let at = unsafe { mmap(std::ptr::null_mut(), bytes, access, MapFlags::SHARED, &file, 0) }.unwrap();
        Self { at: at.cast(), count }
    }

    #[expect(unsafe_code, reason = "mapped memory as a slice")]
    fn get(&mut self) -> &mut [LidarPoint] {
        // SAFETY: the mapping is page-aligned, `count` points long, zeroed (a valid point), and borrowed through `self` alone.
        unsafe { std::slice::from_raw_parts_mut(self.at, self.count) }
    }
}

/// Triangles and rays of one frame into raw files of single precision.
fn write_frame(directory: &FilePath, bench: &Bench) {
    let (states, _) = bench.ticks.last().unwrap();
    let (mut vertices, mut faces, _) = oracle::triangles(&bench.scene);
    for state in &states[CARRIERS..] {
        box_of(state, [0.0, 1.0, 0.0, 1.0], &mut vertices, &mut faces);
    }
    let far = 2000.0;
    let first = vertices.len() as u32;
    vertices.extend([[-far, -far, 0.0], [far, -far, 0.0], [far, far, 0.0], [-far, far, 0.0]]);
    faces.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    let vertices: Vec<f32> = vertices.iter().flatten().map(|part| *part as f32).collect();
    let mut rays = Vec::new();
    for state in &states[..CARRIERS] {
        for ray in oracle::rays(&bench.config, state, &[]) {
            rays.extend(ray.origin_m.iter().chain(&ray.direction).map(|part| *part as f32));
        }
    }
    write_raw(directory, "vertices.f32", &vertices);
    write_raw(directory, "faces.u32", &faces);
    write_raw(directory, "rays.f32", &rays);
}

fn beside_peers(python: &FilePath, path: ScanPath) -> serde_json::Value {
    let directory = Scratch::new("lidar-bench");
    let mut bench = Bench::new(path, Moves::Straight, false, Ground::Flat, CARRIERS);
    write_frame(&directory.0, &bench);
    let mut report = serde_json::json!({});
    let mut peers = Peers::start(python, "lidar_peers.py", &directory.0);
    for name in peers.names.clone() {
        // Rays per second, share of hits and mean range.
        let (_, warm) = (bench.round(), peers.round::<3>(&name));
        let mut ratios = Vec::new();
        let mut rates = Vec::new();
        for _ in 0..PAIRS {
            let ours = bench.round().rate();
            let [theirs, ..] = peers.round::<3>(&name);
            ratios.push(ours / theirs);
            rates.push(theirs);
        }
        ratios.sort_by(f64::total_cmp);
        rates.sort_by(f64::total_cmp);
        println!(
            "{name:10} {:7.2} M rays/s (hits {:.3}, mean range {:.1} m); sensor-daemon is {:.1} x as fast ({:.1} ... {:.1} in {PAIRS} pairs)",
            rates[PAIRS / 2] / 1e6,
            warm[1],
            warm[2],
            ratios[PAIRS / 2],
            ratios[0],
            ratios[PAIRS - 1],
        );
        report[name] = serde_json::json!({ "rays_per_s": rates[PAIRS / 2], "ratio": ratios[PAIRS / 2], "spread": [ratios[0], ratios[PAIRS - 1]] });
    }
    report
}

/// Compares fifteen million rays, upright, tilted and on hills, with and without rolling shutter, with parry3d.
fn hold_against_parry(path: ScanPath) {
    let mut all = oracle::ScanTotals::default();
    for (number, (moves, is_rolling, lean, is_hilly)) in [
        (Moves::Straight, false, [0.0, 0.0], false),
        (Moves::Straight, true, [0.0, 0.0], false),
        (Moves::Wildly, false, [0.05, -0.08], false),
        (Moves::Wildly, true, [-0.03, 0.06], false),
        (Moves::Wildly, false, [0.05, -0.08], true),
        (Moves::Wildly, true, [-0.03, 0.06], true),
    ]
    .into_iter()
    .enumerate()
    {
        let mut config = lidar_city::exact_config();
        config.lidar.rolling_shutter = is_rolling;
        config.lidar.mount = [1.0, 0.1, 2.0, lean[0], lean[1], 0.2];
        let scene = match is_hilly {
            true => lidar_city::hilly(),
            false => lidar_city::scene(BUILDINGS, 1 + number as u64),
        };
        let (mut states, steps) = lidar_city::traffic(VEHICLES, 60, moves, number as u64, 2);
        lidar_city::stand_on(&scene, &mut states);
        let lidar = LidarModel::new(&config, &scene).unwrap().with_path(path);
        let world = oracle::WorldTick::new(&config, &scene, &states, &steps);
        let mut targets = Targets::default();
        targets.update(&states, &steps, SUB_STEPS);
        let (mut scratch, mut scan) = (ScanScratch::default(), Scan::default());
        let mut points = vec![LidarPoint::default(); lidar.max_points()];
        for row in 0..44 {
            let count = lidar.scan(&targets, row, 0, 1, &mut scratch, &mut scan, &mut points);
            let rays = oracle::rays(&config, &states[row], &steps[row * SUB_STEPS..(row + 1) * SUB_STEPS]);
            all.add(&oracle::compare(&world, &rays, row, &points[..count]));
        }
        println!(
            "{moves_name}, hills {is_hilly}, rolling shutter {is_rolling}: {all:?}",
            moves_name = if lean[0] == 0.0 { "upright" } else { "tilted" }
        );
    }
    let off = all.rays - all.same;
    println!(
        "{} rays, {} with a hit: {} the same ({:.5} %), {off} not, of which {} graze an edge",
        all.rays,
        all.hits,
        all.same,
        100.0 * all.same as f64 / all.rays as f64,
        all.grazing
    );
}
