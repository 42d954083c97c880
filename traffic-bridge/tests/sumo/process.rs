//! The real program `traffic-bridge`; the test plays the supervisor and `sim-core`.

use std::{
    os::unix::process::ExitStatusExt,
    path::PathBuf,
    process::{Child, Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use ipc_schema::{
    SCHEMA_VERSION, block,
    board::State,
    config::Config,
    failure::{Failure, FailureKind},
    header::{FIRST_OF_EPISODE, LAST_OF_EPISODE, LAST_OF_RUN, MessageHeader},
    membership::RunMembership,
    ports::{Message, Subscriber},
    process::Process,
    run::{MapInfo, Mode, RunFile, SceneFiles, SharedMemory, Source},
    services::{self, Channel, ServiceHolder},
    traffic::{Kind, SIGNALS_PER_MESSAGE, SignalMeta, TrafficLayout, TrafficMetaLayout, TrafficState, VehicleMeta},
};

use crate::support::{Bench, sumo_home};

const PATIENCE: Duration = Duration::from_secs(20);
const CAVS: u32 = 6;
const WINDOW_TICKS: u64 = 4;

/// Numbers the runs of one test process.
static RUNS: AtomicU32 = AtomicU32::new(0);

/// A run whose supervisor and sim-core are this test.
struct Run {
    file: RunFile,
    path: PathBuf,
    holder: Option<ServiceHolder>,
}

impl Run {
    fn new(bench: &Bench, source: Source, ticks: u64, step_s: f64) -> Self {
        let run_dir = bench.folder.path().join("run");
        for part in ["logs", "parts"] {
            std::fs::create_dir_all(run_dir.join(part)).unwrap();
        }
        let file = run_file(run_dir, source, ticks, step_s);
        let path = file.write().unwrap();
        std::fs::create_dir_all(&file.shared_memory.root).unwrap();
        let node = services::node(&file.shared_memory).unwrap();
        let holder = ServiceHolder::create(&node, &file, 0).unwrap();
        Self {
            file,
            path,
            holder: Some(holder),
        }
    }

    fn start(&self) -> Running {
        let program = env!("CARGO_BIN_EXE_traffic-bridge");
        let command = Command::new(program)
            .arg(&self.path)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        Running(command.unwrap())
    }

    fn sim_core(&self) -> (RunMembership, Subscriber, Subscriber) {
        let parent = rustix::process::getppid().map_or(0, |p| p.as_raw_nonzero().get());
        let file = RunFile {
            supervisor_pid: parent,
            ..self.file.clone()
        };
        let mut membership =
            RunMembership::join_with(file, Process::SimCore, 0, Arc::new(AtomicBool::new(false))).unwrap();
        let traffic = membership.subscriber(Channel::Traffic).unwrap();
        let meta = membership.subscriber(Channel::TrafficMeta).unwrap();
        membership.attach();
        (membership, traffic, meta)
    }
}

impl Drop for Run {
    /// iceoryx2 keeps one file for each prefix: the test removes it, as the supervisor does.
    fn drop(&mut self) {
        self.holder = None;
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry
                .file_name()
                .to_string_lossy()
                .starts_with(&self.file.shared_memory.prefix)
            {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

/// A bridge process; killed if the test fails.
struct Running(Child);

impl Running {
    fn exit_code(&mut self) -> Option<i32> {
        let mut status = None;
        until("the end of the process", || {
            status = self.0.try_wait().unwrap();
            status.is_some()
        });
        assert_eq!(status.unwrap().signal(), None);
        status.unwrap().code()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < deadline, "{what} did not happen");
        std::thread::park_timeout(Duration::from_millis(2));
    }
}

fn next(subscriber: &Subscriber) -> Message {
    let mut message = None;
    until("a message", || {
        message = subscriber.receive().unwrap();
        message.is_some()
    });
    message.unwrap()
}

/// One step as `sim-core` receives it: header and rows, and the announcements of road users and traffic lights.
type Step = (MessageHeader, Vec<TrafficState>, Vec<VehicleMeta>, Vec<SignalMeta>);

/// All messages of a run.
fn consume(run: &Run) -> Vec<Step> {
    let (mut membership, traffic, meta) = run.sim_core();
    let (mut steps, mut meta_messages) = (Vec::new(), 0);
    loop {
        let message = next(&traffic);
        let header = *message.header();
        let states: &[TrafficState] = block::view(message.payload(), TrafficLayout::of(&header).states).unwrap();
        let states = states.to_vec();
        drop(message);
        let (mut events, mut signals) = (Vec::new(), Vec::new());
        while meta_messages < header.meta_messages {
            // Events are sent before the states.
            let message = meta.receive().unwrap().unwrap();
            meta_messages += 1;
            assert_eq!(
                (message.header().tick, message.header().meta_messages),
                (header.tick, meta_messages)
            );
            let header = message.header();
            let layout = TrafficMetaLayout::of(header);
            assert_eq!(message.payload().len(), layout.len);
            assert!(header.shape[1] as usize <= SIGNALS_PER_MESSAGE && header.shape[0] + header.shape[1] > 0);
            events.extend_from_slice(block::view(message.payload(), layout.vehicles).unwrap());
            signals.extend_from_slice(block::view(message.payload(), layout.signals).unwrap());
        }
        membership.consumed(header.tick + 1);
        steps.push((header, states, events, signals));
        if header.has(LAST_OF_RUN) {
            return steps;
        }
    }
}

#[test]
fn episodes_are_sent_step_by_step_under_credit() {
    let bench = Bench::new();
    let source = Source::Population {
        net_file: bench.grid(),
        additional_files: Vec::new(),
    };
    // Two ticks to a step, 15 steps to an episode, two episodes.
    let run = Run::new(&bench, source, 30, 0.2);
    let mut process = run.start();
    let steps = consume(&run);
    assert_eq!(process.exit_code(), Some(0));
    let board = run.sim_core().0.board_of(Process::TrafficBridge).unwrap();
    let health = board.health();
    assert_eq!(
        (State::from_u32(health.state), health.ticks, health.total_ticks),
        (State::Done, 60, 60)
    );
    assert_eq!((health.road_users, health.cavs), (CAVS, CAVS));
    let ticks: Vec<u64> = steps.iter().map(|(header, ..)| header.tick).collect();
    assert_eq!(ticks, (0..30).map(|step| 2 * step + 1).collect::<Vec<_>>());
    for (place, (header, states, ..)) in steps.iter().enumerate() {
        let step = place as u64 % 15 + 1;
        assert_eq!(header.episode, place as u64 / 15);
        assert_eq!(header.sim_time_ns, step * 200_000_000);
        assert_eq!(header.rows(), states.len());
        assert_eq!(header.has(FIRST_OF_EPISODE), step == 1);
        assert_eq!(header.has(LAST_OF_EPISODE), step == 15);
        assert_eq!(header.has(LAST_OF_RUN), place == 29);
    }
    let seeds: Vec<u64> = (0..)
        .map_while(|index| run.file.episode(index))
        .map(|episode| episode.seed)
        .collect();
    assert_eq!([steps[0].0.episode_seed, steps[29].0.episode_seed], seeds[..]);
    for episode in steps.chunks(15) {
        let departed: Vec<_> = episode
            .iter()
            .flat_map(|(_, _, events, _)| events)
            .map(|event| event.vehicle)
            .collect();
        assert_eq!(departed, (0..CAVS).collect::<Vec<_>>(), "indices start again");
        assert!(episode[14].1.iter().all(|state| state.kind == Kind::Cav as u32));
        assert_eq!(episode[14].1.len(), CAVS as usize);
    }
}

#[test]
fn more_lights_than_a_message_holds_are_sent_in_several() {
    let bench = Bench::new();
    let source = Source::Population {
        net_file: bench.signalled_grid(20),
        additional_files: Vec::new(),
    };
    let run = Run::new(&bench, source, 3, 0.1);
    let mut process = run.start();
    let steps = consume(&run);
    assert_eq!(process.exit_code(), Some(0));
    for first in steps.iter().filter(|(header, ..)| header.has(FIRST_OF_EPISODE)) {
        let signals: Vec<u32> = first.3.iter().map(|signal| signal.signal).collect();
        assert!(signals.len() > SIGNALS_PER_MESSAGE, "{}", signals.len());
        assert_eq!(signals, (0..signals.len() as u32).collect::<Vec<_>>());
    }
    // One message for departures and 256 lights, one for the rest; two episodes.
    let messages = steps.last().unwrap().0.meta_messages;
    assert!((4..=8).contains(&messages), "{messages}");
}

#[test]
fn a_scenario_runs_to_its_own_end() {
    let bench = Bench::new();
    let sumocfg =
        bench.scenario("<routes><vehicle id=\"a\" depart=\"0\"><route edges=\"A0B0 B0C0\"/></vehicle></routes>");
    let run = Run::new(&bench, bench.source(sumocfg), 1, 1.0);
    let mut process = run.start();
    let steps = consume(&run);
    assert_eq!(process.exit_code(), Some(0));
    let (last, states, ..) = steps.last().unwrap();
    assert!(last.has(LAST_OF_EPISODE) && states.is_empty());
    assert_eq!(last.tick + 1, 10 * steps.len() as u64);
}

#[test]
fn a_stop_is_a_clean_end_even_while_waiting_for_credit() {
    let bench = Bench::new();
    let source = Source::Population {
        net_file: bench.grid(),
        additional_files: Vec::new(),
    };
    let run = Run::new(&bench, source, 1000, 0.1);
    let mut process = run.start();
    let (_membership, traffic, _meta) = run.sim_core();
    let sent = (0..WINDOW_TICKS)
        .map(|_| next(&traffic).header().tick)
        .collect::<Vec<_>>();
    assert_eq!(sent, (0..WINDOW_TICKS).collect::<Vec<_>>());
    assert!(
        traffic.receive().unwrap().is_none(),
        "no more than the window is in flight"
    );
    let pid = rustix::process::Pid::from_child(&process.0);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    let exit_code = process.exit_code();
    let failure = Failure::read(&run.file.run_dir, Process::TrafficBridge.name());
    assert_eq!((exit_code, failure), (Some(0), None));
}

#[test]
fn wrong_input_ends_the_process_with_a_failure_that_names_the_file() {
    let bench = Bench::new();
    let sumocfg =
        bench.scenario("<routes><vehicle id=\"a\" depart=\"0\"><route edges=\"A0B0 nope\"/></vehicle></routes>");
    let run = Run::new(&bench, bench.source(sumocfg), 1, 1.0);
    assert_eq!(run.start().exit_code(), Some(2));
    let failure = Failure::read(&run.file.run_dir, Process::TrafficBridge.name()).unwrap();
    assert_eq!(failure.kind, FailureKind::Config);
    assert!(
        failure.message.contains("a.rou.xml, line 1") && failure.message.contains("nope"),
        "{}",
        failure.message
    );
}

fn run_file(run_dir: PathBuf, source: Source, ticks: u64, step_s: f64) -> RunFile {
    let number = RUNS.fetch_add(1, Ordering::Relaxed);
    let pid = std::process::id();
    RunFile {
        schema_version: SCHEMA_VERSION,
        env_index: 0,
        run_id: u64::from(pid) << 32 | u64::from(number),
        name: "test".to_owned(),
        mode: Mode::Simulate,
        supervisor_pid: i32::try_from(pid).unwrap(),
        shared_memory: SharedMemory {
            root: run_dir.join("shm"),
            prefix: format!("traffic_bridge_test_{pid}_{number}_"),
        },
        source,
        map: MapInfo {
            projection: "!".into(),
            net_offset_m: [0.0; 2],
            bounds_m: [0.0, 0.0, 400.0, 400.0],
            traffic_lights: 0,
            world_origin_m: [0.0; 2],
        },
        scene_files: SceneFiles::default(),
        maps: Vec::new(),
        sumo_home: sumo_home(),
        config: config(ticks, step_s),
        config_hash: String::new(),
        beginning: None,
        restart: None,
        replay: None,
        run_dir,
    }
}

/// The default preset with the values that these tests need.
fn config(ticks: u64, step_s: f64) -> Config {
    let mut config = Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap();
    config.run.window_ticks = u32::try_from(WINDOW_TICKS).unwrap();
    config.traffic.step_s = step_s;
    config.traffic.cavs = CAVS;
    config.traffic.others = 0;
    config.traffic.pedestrians = 0;
    config.episode.ticks = ticks;
    config.episode.training_episodes = 2;
    config
}
