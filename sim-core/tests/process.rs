//! The real program `sim-core`; the test plays the supervisor, `traffic-bridge` and `sensor-daemon`.

#![allow(clippy::unwrap_used, reason = "test code may assert by unwrapping")]

use std::{
    path::PathBuf,
    process::{Child, Command, Stdio},
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use ipc_schema::{
    SCHEMA_VERSION, block,
    config::Config,
    event::{Collision, CollisionLayout, Struck},
    failure::{Failure, FailureKind},
    header::{FIRST_OF_EPISODE, LAST_OF_EPISODE, LAST_OF_RUN, MessageHeader},
    membership::RunMembership,
    ports::{Message, Publisher, Subscriber},
    process::Process,
    run::{MapInfo, Mode, RunFile, RunMap, ScenarioOptions, SceneFiles, SharedMemory, Source},
    services::{self, Channel, ServiceHolder},
    traffic::{Kind, MetaEvent, SignalMeta, TrafficMetaLayout, TrafficState, VehicleMeta, id_hash},
    world::{COLLIDED, VehicleState, WorldLayout},
};
use serde_json::Value;

const PATIENCE: Duration = Duration::from_secs(20);
/// A crate whose near side is 39.4 m east of the origin, and a building ten metres behind it.
const OBSTACLE: &str = "crate 40 0 0";
const SPEED_MPS: f64 = 10.0;

/// A run in a directory of its own.
struct Run {
    directory: tempfile::TempDir,
    file: RunFile,
    holder: Option<ServiceHolder>,
}

impl Run {
    fn new(name: &str, change: impl FnOnce(&mut Config)) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let run_dir = directory.path().to_path_buf();
        for part in ["logs", "parts"] {
            std::fs::create_dir(run_dir.join(part)).unwrap();
        }
        let poly = run_dir.join("a.poly.xml");
        let house = "<poly id=\"house\" type=\"building\" shape=\"50,-5 60,-5 60,5 50,5\"/>";
        std::fs::write(&poly, format!("<additional>{house}</additional>")).unwrap();
        let net_file = run_dir.join("a.net.xml");
        std::fs::write(&net_file, "<net></net>").unwrap();
        let mut config = Config::from_json(include_str!("../../ipc-schema/tests/town.json")).unwrap();
        config.scene.obstacles = vec![OBSTACLE.parse().unwrap()];
        change(&mut config);
        let file = RunFile {
            schema_version: SCHEMA_VERSION,
            env_index: 0,
            run_id: 5,
            name: name.into(),
            mode: Mode::Simulate,
            supervisor_pid: std::process::id().try_into().unwrap(),
            shared_memory: SharedMemory {
                root: run_dir.join("shm"),
                prefix: format!("sim_core_test_{}_{name}_", std::process::id()),
            },
            source: Source::Scenario {
                sumocfg: PathBuf::new(),
                own: ScenarioOptions::default(),
            },
            map: MapInfo {
                projection: "!".into(),
                net_offset_m: [0.0; 2],
                bounds_m: [0.0, 0.0, 100.0, 100.0],
                traffic_lights: 0,
                world_origin_m: [0.0; 2],
            },
            scene_files: SceneFiles {
                net_file,
                additional_files: vec![poly],
            },
            maps: Vec::new(),
            sumo_home: PathBuf::new(),
            config,
            config_hash: String::new(),
            beginning: None,
            restart: None,
            replay: None,
            run_dir,
        };
        file.write().unwrap();
        std::fs::create_dir_all(&file.shared_memory.root).unwrap();
        let node = services::node(&file.shared_memory).unwrap();
        let holder = Some(ServiceHolder::create(&node, &file, 0).unwrap());
        Self {
            directory,
            file,
            holder,
        }
    }

    fn start(&self) -> Child {
        let command = Command::new(env!("CARGO_BIN_EXE_sim-core"))
            .arg(self.directory.path().join("run.json"))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        command.unwrap()
    }

    /// Joins the run as another process.
    fn join(&self, process: Process) -> RunMembership {
        let parent = rustix::process::getppid().map_or(0, |p| p.as_raw_nonzero().get());
        let file = RunFile {
            supervisor_pid: parent,
            ..self.file.clone()
        };
        RunMembership::join_with(file, process, 0, Arc::new(AtomicBool::new(false))).unwrap()
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        self.holder = None;
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with(&self.file.shared_memory.prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < deadline, "{what} did not happen");
        std::thread::park_timeout(Duration::from_millis(2));
    }
}

fn next(subscriber: &Subscriber) -> Message {
    until("a message", || subscriber.receive().unwrap())
}

fn send(publisher: &Publisher, header: MessageHeader, bytes: &[u8]) {
    let mut draft = publisher.loan(header, bytes.len()).unwrap();
    draft.payload_mut().copy_from_slice(bytes);
    draft.send().unwrap();
}

/// A connected vehicle, 4.5 m long.
fn departure() -> VehicleMeta {
    let mut meta: VehicleMeta = bytemuck::Zeroable::zeroed();
    (meta.kind, meta.event) = (Kind::Cav as u32, MetaEvent::Departed as u32);
    (meta.length_m, meta.width_m, meta.height_m) = (4.5, 1.8, 1.5);
    meta.vehicle_class[..9].copy_from_slice(b"passenger");
    meta.set_id("runaway");
    meta
}

/// Drives one vehicle straight through crate and house for `ticks`; returns the messages on `world` and `event`.
fn drive(run: &Run, ticks: u64) -> (Vec<VehicleState>, Vec<(u64, Collision)>) {
    drive_on(run, ticks, 0)
}

/// The same on a map of the run.
fn drive_on(run: &Run, ticks: u64, map: u16) -> (Vec<VehicleState>, Vec<(u64, Collision)>) {
    let bridge = run.join(Process::TrafficBridge);
    let mut daemon = run.join(Process::SensorDaemon);
    let (traffic, metas) = (
        bridge.publisher(Channel::Traffic).unwrap(),
        bridge.publisher(Channel::TrafficMeta).unwrap(),
    );
    let (world, events) = (
        daemon.subscriber(Channel::World).unwrap(),
        daemon.subscriber(Channel::Event).unwrap(),
    );
    daemon.attach();
    let core = bridge.board_of(Process::SimCore).unwrap();
    until("sim-core at its ports", || {
        (core.progress().attached == 1).then_some(())
    });
    let (mut states, mut collisions) = (Vec::new(), Vec::new());
    for tick in 0..ticks {
        let flag = |bit: u32, is_set: bool| if is_set { bit } else { 0 };
        let header = MessageHeader {
            tick,
            sim_time_ns: (tick + 1) * 100_000_000,
            shape: [1, 0, 0, 0],
            meta_messages: 1,
            flags: flag(FIRST_OF_EPISODE, tick == 0) | flag(LAST_OF_EPISODE | LAST_OF_RUN, tick + 1 == ticks),
            map,
            ..bridge.header()
        };
        if tick == 0 {
            // A traffic light beside it, which `sim-core` skips.
            let layout = TrafficMetaLayout::new(1, 1);
            let mut payload = vec![0_u64; layout.len / 8];
            let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut payload);
            block::view_mut(bytes, layout.vehicles).unwrap()[0] = departure();
            let light: &mut [SignalMeta] = block::view_mut(bytes, layout.signals).unwrap();
            light[0].links = 3;
            send(
                &metas,
                MessageHeader {
                    shape: layout.shape,
                    ..header
                },
                bytes,
            );
        }
        let state = TrafficState {
            front_x_m: 5.0 + SPEED_MPS * 0.1 * tick as f64,
            speed_mps: SPEED_MPS as f32,
            kind: Kind::Cav as u32,
            ..TrafficState::default()
        };
        send(&traffic, header, bytemuck::bytes_of(&state));
        let message = next(&world);
        let header = *message.header();
        let layout = WorldLayout::of(&header);
        states.extend_from_slice(block::view::<VehicleState>(message.payload(), layout.states).unwrap());
        drop(message);
        while let Some(message) = events.receive().unwrap() {
            let contacts = CollisionLayout::of(message.header()).collisions;
            let rows: &[Collision] = block::view(message.payload(), contacts).unwrap();
            collisions.extend(rows.iter().map(|row| (message.header().tick, *row)));
        }
        daemon.consumed(tick + 1);
    }
    (states, collisions)
}

#[test]
fn contacts_are_with_the_buildings_of_the_ticks_map() {
    let mut run = Run::new("maps", |config| config.scene.obstacles.clear());
    let poly = run.file.run_dir.join("b.poly.xml");
    let tower = "<poly id=\"tower\" type=\"building\" shape=\"70,-5 80,-5 80,5 70,5\"/>";
    std::fs::write(&poly, format!("<additional>{tower}</additional>")).unwrap();
    let map = |name: &str, additional: PathBuf| RunMap {
        name: name.into(),
        source: run.file.source.clone(),
        info: run.file.map.clone(),
        scene_files: SceneFiles {
            additional_files: vec![additional],
            ..run.file.scene_files.clone()
        },
    };
    let first = run.file.scene_files.additional_files[0].clone();
    run.file.maps = vec![map("a", first), map("b", poly)];
    run.file.write().unwrap();
    for (number, name, near_side_m) in [(0, "house", 50.0), (1, "tower", 70.0)] {
        let mut process = run.start();
        let (_, collisions) = drive_on(&run, 100, number);
        assert_eq!(process.wait().unwrap().code(), Some(0));
        let struck: Vec<u64> = collisions.iter().map(|(_, event)| event.other_id_hash).collect();
        assert_eq!(struck, [id_hash(name)], "map {number}");
        assert!((collisions[0].1.position_m[0] - near_side_m).abs() < 1.1);
    }
}

#[test]
fn contacts_are_flagged_published_written_and_counted() {
    let run = Run::new("contacts", |_| {});
    let mut process = run.start();
    let (states, collisions) = drive(&run, 100);
    assert_eq!(process.wait().unwrap().code(), Some(0));
    let classes: Vec<u32> = collisions.iter().map(|(_, event)| event.other_class).collect();
    assert_eq!(classes, [Struck::Obstacle as u32, Struck::Building as u32]);
    let flagged: Vec<u64> = (0..)
        .zip(&states)
        .filter(|(_, s)| s.flags & COLLIDED != 0)
        .map(|(tick, _)| tick)
        .collect();
    assert_eq!(flagged, collisions.iter().map(|(tick, _)| *tick).collect::<Vec<_>>());
    for ((tick, event), near_side_m) in collisions.iter().zip([39.4, 50.0]) {
        let state = &states[*tick as usize];
        let front_m = state.x_m + f64::from(state.length_m - state.rear_overhang_m);
        assert!(
            front_m >= near_side_m && front_m < near_side_m + 1.1,
            "{front_m} at tick {tick}"
        );
        assert_eq!((event.id_hash, event.vehicle), (id_hash("runaway"), 0));
        assert!((event.relative_speed_mps - 10.0).abs() < 0.1);
        assert!(
            (event.position_m[0] - 0.5 * (near_side_m + front_m)).abs() < 0.01,
            "{event:?}"
        );
    }
    assert_eq!(collisions[0].1.other_id_hash, id_hash("crate"));
    assert_eq!(collisions[1].1.other_id_hash, id_hash("house"));

    let lines = std::fs::read_to_string(run.file.run_dir.join("events/collisions.jsonl")).unwrap();
    let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 2);
    for ((tick, event), line) in collisions.iter().zip(&lines) {
        assert_eq!(
            (line["tick"].as_u64(), line["vehicle"].as_str()),
            (Some(*tick), Some("runaway"))
        );
        assert_eq!(line["sim_time_s"].as_f64().unwrap(), (*tick + 1) as f64 / 10.0);
        assert_eq!(line["position_m"][0].as_f64(), Some(event.position_m[0]));
    }
    assert_eq!(
        (&lines[0]["what"], &lines[0]["other"]),
        (&"obstacle".into(), &"crate".into())
    );
    assert_eq!(
        (&lines[1]["what"], &lines[1]["other"]),
        (&"building".into(), &"house".into())
    );
    let part = std::fs::read_to_string(run.file.run_dir.join("parts/sim-core.json")).unwrap();
    let part: Value = serde_json::from_str(&part).unwrap();
    let counts = serde_json::json!({
        "total": 2, "vehicle": 0, "vehicle_in_sumo": 0, "person": 0, "building": 1, "obstacle": 1, "without_line": 0,
        "own": {"led": 0, "lane_change": 0, "late": 0, "path": 0, "tracking": 0, "body": 0}
    });
    assert_eq!(
        (&part["collisions"], &part["buildings"], &part["props"]),
        (&counts, &1.into(), &1.into())
    );
}

#[test]
fn contacts_are_not_searched_unless_configured() {
    let run = Run::new("blind", |config| config.collision.detect = false);
    let mut process = run.start();
    let (states, collisions) = drive(&run, 60);
    assert_eq!(process.wait().unwrap().code(), Some(0));
    assert!(collisions.is_empty() && states.iter().all(|state| state.flags & COLLIDED == 0));
    assert!(!run.file.run_dir.join("events/collisions.jsonl").exists());
    let part = std::fs::read_to_string(run.file.run_dir.join("parts/sim-core.json")).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&part).unwrap()["collisions"], Value::Null);
}

#[test]
fn an_unreadable_scene_ends_the_process_with_file_and_line() {
    let run = Run::new("broken", |_| {});
    let poly = &run.file.scene_files.additional_files[0];
    std::fs::write(poly, "<additional>\n<poly id=\"a\" shape=\"1,2 x\"/></additional>").unwrap();
    assert_eq!(run.start().wait().unwrap().code(), Some(2));
    let failure = Failure::read(&run.file.run_dir, Process::SimCore.name()).unwrap();
    assert_eq!(failure.kind, FailureKind::Config);
    assert!(
        failure
            .message
            .contains("a.poly.xml, line 2: \"x\" is not a usable shape"),
        "{}",
        failure.message
    );
    assert!(failure.help.is_some());
}
