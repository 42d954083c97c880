//! A run without simulator or trainer: real services under private names in shared memory, real messages, the real binary.

use std::{
    cell::RefCell,
    fs::File,
    io,
    net::TcpListener,
    path::PathBuf,
    process::{Child, Command, Stdio},
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use bytemuck::{cast_slice, cast_slice_mut};
use fanout::network::{
    endpoint,
    keys::{RunKeys, Topic},
};
use ipc_schema::{
    SCHEMA_VERSION,
    block::view_mut,
    config::Config,
    header::{DIMENSIONS, MessageHeader},
    membership::RunMembership,
    neighbours::{NEIGHBOUR_COLUMNS, NeighboursLayout},
    observation::ObservationLayout,
    pointcloud::{PointcloudLayout, Scan},
    ports::{Publisher, RosterWriter},
    prediction::PredictionLayout,
    process::Process,
    run::{MapInfo, Mode, RunFile, ScenarioOptions, SceneFiles, SharedMemory, Source},
    services::{self, Channel, ServiceHolder},
    traffic::{SignalMeta, TrafficMetaLayout, VehicleMeta, id_hash},
    world::{VehicleState, WorldLayout},
};
use tempfile::TempDir;
use zenoh::{Wait, handlers::RingChannelHandler, pubsub::Subscriber, sample::Sample};

/// Longest wait for any condition, long enough for a machine whose cores are busy with other work.
pub const PATIENCE: Duration = Duration::from_secs(60);
/// Fields of an observation in these runs.
pub const FIELDS: u32 = 2;
const SUB_STEPS: u32 = 10;

/// Services and run file of a run, whose processes are children of this test.
pub struct Run {
    pub file: RunFile,
    pub port: u16,
    _reserved_port: ReservedPort,
    path: PathBuf,
    roster: RefCell<RosterWriter>,
    holder: RefCell<ServiceHolder>,
    node: services::RunNode,
    _dir: TempDir,
    _sweep: SharedMemorySweep,
}

/// Removes what is left of a run in shared memory, also that of killed processes; dropped last.
struct SharedMemorySweep(String);

impl Drop for SharedMemorySweep {
    fn drop(&mut self) {
        for file in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if file.file_name().to_string_lossy().starts_with(&self.0) {
                let _ = std::fs::remove_file(file.path());
            }
        }
    }
}

/// A TCP port that no other test takes while this exists. It lies below Linux's ephemeral ports (32768 to 60999), which outgoing
/// connections of other programs may take at any time.
struct ReservedPort {
    number: u16,
    _lock: File,
}

impl ReservedPort {
    fn take() -> Self {
        let locks = std::env::temp_dir().join("caraware-test-ports");
        std::fs::create_dir_all(&locks).unwrap();
        let first = u16::try_from(std::process::id() % 10_000).unwrap();
        (0..10_000)
            .map(|offset| 20_000 + (first + offset) % 10_000)
            .find_map(|number| {
                let lock = File::create(locks.join(number.to_string())).ok()?;
                let is_free = lock.try_lock().is_ok() && TcpListener::bind(("127.0.0.1", number)).is_ok();
                is_free.then_some(Self { number, _lock: lock })
            })
            .expect("a free port")
    }
}

impl Run {
    pub fn new(name: &str, mode: Mode) -> Self {
        Self::at_rate(name, mode, 50.0)
    }

    pub fn at_rate(name: &str, mode: Mode, rate_hz: f64) -> Self {
        Self::with_settings(name, mode, rate_hz, |_| {})
    }

    /// A run whose configuration `change` has changed.
    pub fn with_settings(name: &str, mode: Mode, rate_hz: f64, change: impl FnOnce(&mut Config)) -> Self {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("logs")).unwrap();
        let port = ReservedPort::take();
        let mut file = run_file(name, mode, dir.path().into(), port.number);
        let settings = &mut file.config.fanout;
        settings.world_hz = rate_hz;
        settings.observation_hz = rate_hz;
        settings.prediction_hz = rate_hz;
        settings.neighbours_hz = rate_hz;
        change(&mut file.config);
        let path = file.write().unwrap();
        std::fs::create_dir_all(&file.shared_memory.root).unwrap();
        let node = services::node(&file.shared_memory).unwrap();
        let holder = ServiceHolder::create(&node, &file, 0).unwrap();
        Self {
            _sweep: SharedMemorySweep(file.shared_memory.prefix.clone()),
            file,
            port: port.number,
            _reserved_port: port,
            path,
            roster: RefCell::new(RosterWriter::create(&holder).unwrap()),
            holder: RefCell::new(holder),
            node,
            _dir: dir,
        }
    }

    pub fn start_fanout(&self) -> Fanout {
        self.spawn_fanout(0)
    }

    /// Starts the fan-out again as incarnation `incarnation`, on a board of its own, as `caraware` does.
    pub fn restart_fanout(&self, incarnation: u32) -> Fanout {
        self.holder
            .borrow_mut()
            .add_board(&self.node, &self.file, Process::Fanout, incarnation)
            .unwrap();
        self.roster.borrow_mut().set(Process::Fanout, incarnation);
        self.spawn_fanout(incarnation)
    }

    fn spawn_fanout(&self, incarnation: u32) -> Fanout {
        let child = Command::new(env!("CARGO_BIN_EXE_fanout"))
            .arg(&self.path)
            .env(ipc_schema::membership::INCARNATION, incarnation.to_string())
            .stderr(Stdio::inherit())
            .spawn()
            .unwrap();
        Fanout(child)
    }

    /// Joins as another process of the run, within this test's process.
    pub fn join(&self, process: Process) -> RunMembership {
        let parent = rustix::process::getppid().map_or(0, |p| p.as_raw_nonzero().get());
        let file = RunFile {
            supervisor_pid: parent,
            ..self.file.clone()
        };
        RunMembership::join_with(file, process, 0, Arc::new(AtomicBool::new(false))).unwrap()
    }

    pub fn key(&self, topic: Topic) -> String {
        RunKeys::new(&self.file.name, 0).topic(topic)
    }

    /// Key of what `channel` carries of one mounted sensor.
    pub fn sensor_key(&self, channel: Channel, name: &str) -> String {
        RunKeys::new(&self.file.name, 0).sensor(channel, name)
    }

    /// Cleans up after a dead process, as `caraware` does.
    pub fn forget_dead(&self) {
        services::forget_dead(&self.node);
    }

    pub fn alive_key(&self) -> String {
        RunKeys::new(&self.file.name, 0).alive()
    }

    /// A viewer's zenoh session, once the fan-out listens.
    pub fn attach(&self) -> zenoh::Session {
        let config = zenoh::Config::from_json5(&format!(
            r#"{{ mode: "client", connect: {{ endpoints: ["tcp/127.0.0.1:{}"], timeout_ms: 60000 }},
                 scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }} }}"#,
            self.port
        ));
        endpoint::open(config.unwrap()).unwrap()
    }
}

/// The newest frames of one topic.
pub fn watch(session: &zenoh::Session, key: String) -> Subscriber<RingChannelHandler<Sample>> {
    let subscriber = session
        .declare_subscriber(key)
        .with(zenoh::handlers::RingChannel::new(64))
        .wait()
        .unwrap();
    // The answer to a later question proves that the fan-out knows of the subscriber.
    until("an answer with the map", || ask(session, "caraware/**/map").is_some());
    subscriber
}

/// The next frame, as header and payload.
pub fn next(frames: &Subscriber<RingChannelHandler<Sample>>) -> (MessageHeader, Vec<u8>) {
    decoded(&frames.recv_timeout(PATIENCE).unwrap().expect("no frame came"))
}

/// A frame, as header and payload.
pub fn decoded(sample: &Sample) -> (MessageHeader, Vec<u8>) {
    let bytes = sample.payload().to_bytes();
    let (header, payload) = fanout::frame::decode(&bytes).unwrap();
    (header, payload.to_vec())
}

/// The answer to a query.
pub fn ask(session: &zenoh::Session, key: &str) -> Option<Vec<u8>> {
    let replies = session.get(key).timeout(PATIENCE).wait().unwrap();
    let reply = replies.recv().ok()?;
    Some(reply.result().ok()?.payload().to_bytes().into_owned())
}

/// Waits for a condition; fails after [`PATIENCE`].
pub fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < deadline, "{what} did not happen");
        std::thread::park_timeout(Duration::from_millis(5));
    }
}

/// A fan-out process, killed when it is dropped.
pub struct Fanout(pub Child);

impl Fanout {
    pub fn exit_code(&mut self) -> Option<i32> {
        let mut status = None;
        until("the end of the fan-out", || {
            status = self.0.try_wait().unwrap();
            status.is_some()
        });
        status.unwrap().code()
    }

    pub fn terminate(&self) -> io::Result<()> {
        let pid = rustix::process::Pid::from_child(&self.0);
        Ok(rustix::process::kill_process(pid, rustix::process::Signal::TERM)?)
    }
}

impl Drop for Fanout {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

pub fn header(membership: &RunMembership, tick: u64, flags: u32, shape: [u32; DIMENSIONS]) -> MessageHeader {
    MessageHeader {
        tick,
        sim_time_ns: tick * 100_000_000,
        flags,
        shape,
        ..membership.header()
    }
}

pub fn states(tick: u64, count: usize) -> Vec<VehicleState> {
    (0..count)
        .map(|i| VehicleState {
            x_m: tick as f64 + i as f64,
            vehicle: u32::try_from(i).unwrap(),
            ..VehicleState::default()
        })
        .collect()
}

pub fn send_world(membership: &RunMembership, publisher: &Publisher, tick: u64, flags: u32, count: usize) {
    let layout = WorldLayout::new(count, SUB_STEPS as usize);
    let mut draft = publisher
        .loan(header(membership, tick, flags, layout.shape), layout.len)
        .unwrap();
    let rows: &mut [VehicleState] = view_mut(draft.payload_mut(), layout.states).unwrap();
    rows.copy_from_slice(&states(tick, count));
    draft.send().unwrap();
}

/// Payload of an observation whose truth is (tick, slot, 0, 0).
pub fn observation(tick: u64, count: usize) -> Vec<u8> {
    let layout = ObservationLayout::new(count, FIELDS as usize, 0);
    let mut words = vec![0_u64; layout.len / 8];
    let truth: &mut [[f32; 4]] = view_mut(cast_slice_mut(&mut words), layout.truth).unwrap();
    for (slot, row) in truth.iter_mut().enumerate() {
        *row = [tick as f32, slot as f32, 0.0, 0.0];
    }
    cast_slice(&words).to_vec()
}

pub fn send(publisher: &Publisher, header: MessageHeader, payload: &[u8]) {
    let mut draft = publisher.loan(header, payload.len()).unwrap();
    draft.payload_mut().copy_from_slice(payload);
    draft.send().unwrap();
}

pub fn send_observation(membership: &RunMembership, publisher: &Publisher, tick: u64, flags: u32, count: usize) {
    let shape = ObservationLayout::new(count, FIELDS as usize, 0).shape;
    send(
        publisher,
        header(membership, tick, flags, shape),
        &observation(tick, count),
    );
}

pub fn send_prediction(membership: &RunMembership, publisher: &Publisher, tick: u64, count: usize) {
    let layout = PredictionLayout::new(count, 2, false);
    let header = header(membership, tick, 0, layout.shape);
    let mut payload = vec![0; layout.len];
    let rows = vec![[tick as f32, 0.5]; count];
    payload[..layout.prediction.len].copy_from_slice(cast_slice(&rows));
    send(publisher, header, &payload);
}

/// Objects that each slot knows in [`neighbours`].
pub const NEAREST: usize = 3;

/// What `count` slots know from messages at `tick`; with `speakers` there is what the policy of the messages task sees, too.
pub fn neighbours(tick: u64, count: usize, speakers: usize) -> (NeighboursLayout, Vec<u8>) {
    let layout = NeighboursLayout::sized(count, NEAREST, speakers, 8 * speakers.min(1));
    let mut payload = vec![0xee; layout.len];
    let objects: &mut [[f32; NEIGHBOUR_COLUMNS]] = view_mut(&mut payload, layout.objects).unwrap();
    for (place, object) in objects.iter_mut().enumerate() {
        *object = [tick as f32; NEIGHBOUR_COLUMNS];
        object[0] = place as f32;
    }
    let vehicles: &mut [u32] = view_mut(&mut payload, layout.vehicle).unwrap();
    vehicles
        .iter_mut()
        .zip(0..)
        .for_each(|(vehicle, index)| *vehicle = index);
    (layout, payload)
}

pub fn send_neighbours(membership: &RunMembership, publisher: &Publisher, tick: u64, flags: u32, count: usize) {
    let (layout, payload) = neighbours(tick, count, count);
    send(publisher, header(membership, tick, flags, layout.shape), &payload);
}

/// Sends a census: a road user for each of `ids`, by index, and a traffic light in the state of each letter.
pub fn send_census(membership: &RunMembership, publisher: &Publisher, tick: u64, ids: &[&str], letters: &str) {
    let layout = TrafficMetaLayout::new(ids.len(), letters.len());
    let header = header(membership, tick, 0, layout.shape);
    let mut draft = publisher.loan(header, layout.len).unwrap();
    let vehicles: &mut [VehicleMeta] = view_mut(draft.payload_mut(), layout.vehicles).unwrap();
    for (index, (meta, id)) in vehicles.iter_mut().zip(ids).enumerate() {
        meta.set_id(id);
        meta.vehicle = u32::try_from(index).unwrap();
    }
    let signals: &mut [SignalMeta] = view_mut(draft.payload_mut(), layout.signals).unwrap();
    for (index, (meta, letter)) in signals.iter_mut().zip(letters.bytes()).enumerate() {
        (meta.signal, meta.links, meta.state[0]) = (u32::try_from(index).unwrap(), 1, letter);
    }
    draft.send().unwrap();
}

/// Sends a scan of `points` points by the vehicle with this id and index.
pub fn send_scan(
    membership: &RunMembership,
    publisher: &Publisher,
    tick: u64,
    (id, index): (&str, u32),
    points: usize,
) {
    let layout = PointcloudLayout::new(points);
    let header = header(membership, tick, 0, layout.shape);
    let mut draft = publisher.loan(header, layout.len).unwrap();
    let scan = Scan {
        id_hash: id_hash(id),
        vehicle: index,
        ..Scan::default()
    };
    draft.payload_mut()[..size_of::<Scan>()].copy_from_slice(bytemuck::bytes_of(&scan));
    draft.send().unwrap();
}

/// Joins as the producer of `channel`, and opens its publisher.
pub fn publisher(run: &Run, channel: Channel) -> (RunMembership, Publisher) {
    let membership = run.join(channel.producer());
    let publisher = membership.publisher(channel).unwrap();
    (membership, publisher)
}

fn run_file(name: &str, mode: Mode, run_dir: PathBuf, port: u16) -> RunFile {
    RunFile {
        schema_version: SCHEMA_VERSION,
        env_index: 0,
        run_id: u64::from(port) << 32 | u64::from(std::process::id()),
        name: name.to_owned(),
        mode,
        supervisor_pid: i32::try_from(std::process::id()).unwrap(),
        shared_memory: SharedMemory {
            root: run_dir.join("shm"),
            prefix: format!("fanout_test_{}_{port}_", std::process::id()),
        },
        source: Source::Scenario {
            sumocfg: "none.sumocfg".into(),
            own: ScenarioOptions::default(),
        },
        map: MapInfo {
            projection: "+proj=utm +zone=32 +ellps=WGS84".into(),
            net_offset_m: [0.0, 0.0],
            bounds_m: [0.0, 0.0, 220.0, 200.0],
            traffic_lights: 0,
            world_origin_m: [0.0; 2],
        },
        scene_files: SceneFiles::default(),
        maps: Vec::new(),
        sumo_home: "none".into(),
        config: config(port),
        config_hash: String::new(),
        beginning: None,
        restart: None,
        replay: None,
        run_dir,
    }
}

/// The default preset with fewer sub-steps, room for more road users, and LIDARs.
fn config(port: u16) -> Config {
    let mut config = Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap();
    config.run.sub_steps = SUB_STEPS;
    config.traffic.max_road_users = 2100;
    config.lidar.vehicles = 2;
    config.fanout.listen = format!("tcp/127.0.0.1:{port}").parse().unwrap();
    config
}
