//! Starts the real command in its own directory, and checks what it leaves behind.
#![allow(dead_code, reason = "each test file uses its own part")]

use std::{
    cell::RefCell,
    collections::{BTreeMap, BTreeSet},
    fs::DirBuilder,
    mem::MaybeUninit,
    net::TcpListener,
    os::{fd::OwnedFd, unix::fs::DirBuilderExt as _},
    path::{Path, PathBuf},
    process::{Child, Command, Output},
    sync::{Condvar, Mutex, PoisonError},
    time::{Duration, Instant, SystemTime},
};

use ipc_schema::{
    block,
    ports::{BoardReader, Subscriber},
    process::Process,
    run::RunFile,
    services::{self, Channel, RunNode},
    world::{VehicleState, WorldLayout},
};
use recorder::file::{
    reader::{ChannelMessage, RecordedMessage, RecordingReader},
    writer::LineTopic,
};
use rustix::{
    fs::inotify,
    process::{Pid, Signal, kill_process},
};
use serde_json::Value;
use tempfile::TempDir;

/// For nets that have no origin of their own, and without a socket.
pub const BARE_NET_SETTINGS: [&str; 6] = [
    "--set",
    "map.origin_latitude_deg=52",
    "--set",
    "map.origin_longitude_deg=10",
    "--set",
    "fanout.enabled=false",
];

/// How many tests have a workplace. A whole run has several processes, which wait for each other much of the time.
static TAKEN: Mutex<usize> = Mutex::new(0);
static RETURNED: Condvar = Condvar::new();

/// One of the tests that run at once: as many as there are cores.
struct Turn;

impl Turn {
    fn take() -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
        let mut taken = RETURNED
            .wait_while(taken, |taken| *taken >= cores)
            .unwrap_or_else(PoisonError::into_inner);
        *taken += 1;
        Self
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        *TAKEN.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
        RETURNED.notify_one();
    }
}

/// A directory for runs, with a registry of its own.
pub struct Workplace {
    pub directory: TempDir,
    /// Reports every name that appears in the registry: the shared memory of a run carries it.
    registry: OwnedFd,
    names: RefCell<BTreeSet<String>>,
    _turn: Turn,
}

impl Drop for Workplace {
    /// A test that fails may leave a run alive, or what it has in shared memory.
    fn drop(&mut self) {
        let is_here = |entry: &std::fs::DirEntry| {
            let directory = std::fs::read_link(entry.path().join("cwd"));
            directory.is_ok_and(|directory| directory.starts_with(self.path()))
        };
        let alive = std::fs::read_dir("/proc").unwrap().flatten().filter(is_here);
        let pids = alive.filter_map(|entry| Pid::from_raw(entry.file_name().to_str()?.parse().ok()?));
        // The processes of a run end with its supervisor.
        let killed = pids.filter(|pid| kill_process(*pid, Signal::KILL).is_ok()).count();
        if killed > 0 {
            eprintln!("{killed} processes were left in {}", self.path().display());
        }
        for file in self.shared_memory() {
            // A process that ends meanwhile removes its own.
            let _ = std::fs::remove_file(Path::new("/dev/shm").join(file));
        }
    }
}

impl Workplace {
    pub fn new() -> Self {
        let turn = Turn::take();
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run");
        DirBuilder::new().mode(0o700).create(&path).unwrap();
        let registry = inotify::init(inotify::CreateFlags::NONBLOCK | inotify::CreateFlags::CLOEXEC).unwrap();
        let created = inotify::WatchFlags::CREATE | inotify::WatchFlags::MOVED_TO;
        inotify::add_watch(&registry, &path, created).unwrap();
        Self {
            directory,
            registry,
            names: RefCell::default(),
            _turn: turn,
        }
    }

    pub fn path(&self) -> &Path {
        self.directory.path()
    }

    /// The command with its runs in this directory and its own registry.
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_caraware"));
        command
            .args(arguments)
            .current_dir(self.path())
            .env("CARAWARE_RUNTIME_DIR", self.path().join("run"))
            .env("NO_COLOR", "1");
        if std::env::var_os("PYTHONDONTWRITEBYTECODE").is_some() {
            // Without bytecode every learner compiles 1 700 modules when it starts: 4 to 7 s of a core. The tests keep it in `target`.
            command
                .env_remove("PYTHONDONTWRITEBYTECODE")
                .env("PYTHONPYCACHEPREFIX", concat!(env!("CARGO_TARGET_TMPDIR"), "/bytecode"));
        }
        command
    }

    pub fn run(&self, arguments: &[&str]) -> Output {
        self.command(arguments).output().unwrap()
    }

    /// Runs a command that must succeed.
    pub fn succeed(&self, arguments: &[&str]) -> Output {
        let output = self.run(arguments);
        assert!(
            output.status.success(),
            "{arguments:?}: {}\n{}",
            output.status,
            text(&output)
        );
        output
    }

    /// Runs the simulation `name` with a lossless recording of `channels`, and opens the recording.
    ///
    /// No tick of `world`, `observation` or `pointcloud` is missing. Cameras and radars wait for no process: [`ONE_TICK_AHEAD`].
    pub fn record(&self, name: &str, arguments: &[&str], channels: &[Channel]) -> RecordingReader {
        let names: Vec<String> = channels
            .iter()
            .map(|channel| format!("\"{}\"", channel.name()))
            .collect();
        let channels = format!("record.channels=[{}]", names.join(","));
        let recorded = ["--name", name, "--record", "--set", &channels];
        self.succeed(&[arguments, &recorded].concat());
        let recording = RecordingReader::open(&self.path().join("runs").join(name).join("recording.mcap")).unwrap();
        assert!(recording.damage().is_none(), "{:?}", recording.damage());
        recording
    }

    pub fn report(&self, name: &str) -> Value {
        let text = std::fs::read_to_string(self.path().join("runs").join(name).join("report.json")).unwrap();
        serde_json::from_str(&text).unwrap()
    }

    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    /// Asserts that no run of this workplace left anything in shared memory, in the registry, or as a process.
    pub fn assert_nothing_left(&self) {
        let registry: Vec<_> = std::fs::read_dir(self.path().join("run"))
            .into_iter()
            .flatten()
            .flatten()
            .collect();
        assert!(registry.is_empty(), "left in the registry: {registry:?}");
        let here = self.path().to_string_lossy().into_owned();
        let processes: Vec<String> = command_lines()
            .into_iter()
            .filter(|line| line.contains(&here))
            .collect();
        assert!(processes.is_empty(), "still running: {processes:?}");
        let files = self.shared_memory();
        assert!(files.is_empty(), "left in shared memory: {files:?}");
    }

    /// Files that the runs of this workplace have in shared memory. Other runs of the machine may start and end meanwhile.
    pub fn shared_memory(&self) -> Vec<String> {
        let mut names = self.names.borrow_mut();
        let mut buffer = [MaybeUninit::uninit(); 4096];
        let mut events = inotify::Reader::new(&self.registry, &mut buffer);
        while let Ok(event) = events.next() {
            names.extend(event.file_name().map(|name| name.to_string_lossy().into_owned()));
        }
        let prefixes: Vec<String> = names.iter().map(|name| format!("caraware_{name}_")).collect();
        let mut files = shared_memory();
        files.retain(|file| prefixes.iter().any(|prefix| file.starts_with(prefix)));
        files
    }
}

/// Keeps `sensor-daemon` one tick ahead of a recorder: the queues of cameras and radars hold the messages of a tick.
pub const ONE_TICK_AHEAD: &str = "run.window_ticks=1";

/// The messages of one channel in a recording.
pub fn of_channel(recording: &RecordingReader, channel: Channel) -> impl Iterator<Item = ChannelMessage> {
    let messages = recording.channel_messages().map(Result::unwrap);
    messages.filter(move |message| message.channel == channel)
}

/// The lines of one of the run's logs in a recording.
pub fn lines_of(recording: &RecordingReader, topic: LineTopic) -> Vec<String> {
    let messages = recording.messages().map(Result::unwrap);
    let lines = messages.filter_map(|message| match message {
        RecordedMessage::Line(found, line) if found == topic => Some(line),
        _ => None,
    });
    lines.collect()
}

/// The road users of every tick in a recording.
pub fn road_users(recording: &RecordingReader) -> BTreeMap<u64, Vec<VehicleState>> {
    of_channel(recording, Channel::World)
        .map(|message| {
            let layout = WorldLayout::of(&message.header);
            let states = block::view(message.payload(), layout.states).unwrap().to_vec();
            (message.header.tick, states)
        })
        .collect()
}

/// Asserts that every entry of a run's directory is in the table of `docs/run-directory.md`, which has the version of the report.
pub fn assert_documented(run_dir: &Path) {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/run-directory.md")).unwrap();
    let report = std::fs::read_to_string(run_dir.join("report.json")).unwrap();
    let report: Value = serde_json::from_str(&report).unwrap();
    let version = format!("**version {}**", report["layout_version"]);
    assert!(page.contains(&version), "{version}");
    let first_cells = page
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split(" | ").next());
    let names: BTreeSet<&str> = first_cells
        .flat_map(|cell| cell.split(", "))
        .map(|name| name.trim_matches(['`', '/']))
        .collect();
    for entry in std::fs::read_dir(run_dir).unwrap().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        // A number stands for `N`, a format for `FORMAT`.
        let numbered: String = name
            .chars()
            .map(|letter| if letter.is_ascii_digit() { 'N' } else { letter })
            .collect();
        let is_known = names.contains(name.as_str())
            || names.contains(numbered.as_str())
            || name.strip_prefix("export-").is_some();
        assert!(is_known, "docs/run-directory.md has no row for {name}");
    }
}

/// Files of any run in shared memory.
fn shared_memory() -> Vec<String> {
    let names = std::fs::read_dir("/dev/shm")
        .unwrap()
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned());
    names.filter(|name| name.starts_with("caraware_")).collect()
}

/// Every file below a directory and when it was last written.
pub fn tree(directory: &Path) -> BTreeMap<PathBuf, SystemTime> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(directory).unwrap().flatten() {
        match entry.metadata().unwrap() {
            data if data.is_dir() => files.extend(tree(&entry.path())),
            data => drop(files.insert(entry.path(), data.modified().unwrap())),
        }
    }
    files
}

/// Command lines of all processes.
pub fn command_lines() -> Vec<String> {
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    processes
        .filter_map(|entry| std::fs::read(entry.path().join("cmdline")).ok())
        .map(|bytes| String::from_utf8_lossy(&bytes).replace('\0', " "))
        .collect()
}

/// Everything the command printed.
pub fn text(output: &Output) -> String {
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

/// A free port on loopback.
pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// `command` in a mount namespace of its own, after `prepare` in the shell; `None` if this system allows no such namespace.
pub fn with_mounts(command: &Command, prepare: &str) -> Option<Command> {
    let user: &[&str] = if rustix::process::getuid().is_root() {
        &[]
    } else {
        &["--map-root-user"]
    };
    let unshare = |script: &str| {
        let mut unshare = Command::new("unshare");
        unshare.args(user).args(["--mount", "sh", "-c", script, "sh"]);
        unshare
    };
    let may_mount = unshare("mount -t tmpfs none /mnt")
        .output()
        .is_ok_and(|output| output.status.success());
    may_mount.then(|| {
        let mut alone = unshare(&format!("{prepare} && exec \"$@\""));
        alone.arg(command.get_program()).args(command.get_args());
        alone.current_dir(command.get_current_dir().unwrap());
        alone.envs(command.get_envs().filter_map(|(key, value)| Some((key, value?))));
        alone
    })
}

/// A program of the SUMO wheel.
pub fn sumo_program(name: &str) -> PathBuf {
    caraware::install::Install::find()
        .unwrap_or_else(|exit| panic!("{exit:?}"))
        .sumo_program(name)
}

/// Runs a program that must succeed.
pub fn tool(program: &Path, arguments: &[&str], directory: &Path) {
    let output = Command::new(program)
        .args(arguments)
        .current_dir(directory)
        .output()
        .unwrap();
    assert!(output.status.success(), "{program:?}: {}", text(&output));
}

/// A watcher of a live run: it reads boards and channels in the run's shared memory.
pub struct Spectator {
    node: RunNode,
    file: RunFile,
}

impl Spectator {
    /// Joins the run as soon as its services exist.
    pub fn join(run_file: &Path, run: &mut Child) -> Self {
        Self::join_after(run_file, run, Process::TrafficBridge)
    }

    /// As [`Spectator::join`] where `first` is the first process to start.
    pub fn join_after(run_file: &Path, run: &mut Child, first: Process) -> Self {
        let started = run_file.with_file_name("logs").join(format!("{}.log", first.name()));
        caught(run, "services", || {
            // Processes start once all services exist; before that, services may be incomplete.
            started.exists().then_some(())?;
            let file = RunFile::read(run_file).ok()?;
            let node = services::node(&file.shared_memory).ok()?;
            Some(Self { node, file })
        })
    }

    pub fn board(&self, process: Process) -> BoardReader {
        BoardReader::open(&self.node, &self.file, 0, process).unwrap()
    }

    pub fn subscribe(&self, channel: Channel) -> Subscriber {
        let service = services::open_data(&self.node, &self.file, 0, channel).unwrap();
        Subscriber::create(&service, channel, &self.file).unwrap()
    }
}

/// Six vehicles, four training episodes with one evaluation in between: 640 ticks of which 80 are evaluations, a checkpoint for every
/// update. Small networks, and no estimates that only viewers see.
pub const SMALL: [&str; 16] = [
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "episode.ticks=140",
    "episode.training_episodes=4",
    "episode.evaluation_interval=2",
    "episode.evaluation_ticks=40",
    "episode.final_evaluations=1",
    "trainer.horizon=300",
    "trainer.plots=false",
    "trainer.batch_size=150",
    "trainer.hidden=[32, 32]",
    "trainer.estimates=never",
    "trainer.checkpoint_interval=1",
    "trainer.matmul_precision=float32",
    "fanout.enabled=false",
];

/// Short runs of tasks whose world waits for actions: four heroes or stations make 300 samples in 75 ticks of one environment.
pub const ACTING: [&str; 13] = [
    "traffic.others=3",
    "traffic.pedestrians=2",
    "episode.ticks=110",
    "episode.training_episodes=6",
    "episode.evaluation_interval=2",
    "episode.evaluation_ticks=40",
    "episode.final_evaluations=1",
    "trainer.horizon=300",
    "trainer.plots=false",
    "trainer.batch_size=150",
    "trainer.checkpoint_interval=2",
    "trainer.matmul_precision=float32",
    "fanout.enabled=false",
];

/// A curriculum on the preset `paper`: three stages, of which the first continues without restarts, a horizon that ends within lessons,
/// and gates of σ that some updates pass.
pub const CURRICULUM: [&str; 14] = [
    "curriculum.stages=[{cavs=1,restart=false,until_std=0.66},{cavs=1,ticks=350,until_std=0.63,noise=2.0},{cavs=5,ticks=100,until_std=0.6}]",
    "episode.ticks=450",
    "episode.training_episodes=60",
    "episode.evaluation_ticks=80",
    "episode.final_evaluations=1",
    "trainer.horizon=500",
    "trainer.plots=false",
    "trainer.batch_size=100",
    "trainer.hidden=[32, 32]",
    "trainer.estimates=never",
    "trainer.learning_rate=1e-3",
    "trainer.matmul_precision=float32",
    "traffic.others=2",
    "fanout.enabled=false",
];

/// Calls `ask` until it returns a value; fails if the run ends before.
pub fn until<T>(run: &mut Child, what: &str, ask: impl FnMut() -> Option<T>) -> T {
    poll(run, what, ask, || std::thread::park_timeout(Duration::from_millis(1)))
}

/// As [`until`] with short pauses: for values that exist only for a short time, such as the last message of a run.
pub fn caught<T>(run: &mut Child, what: &str, ask: impl FnMut() -> Option<T>) -> T {
    poll(run, what, ask, short_pause)
}

/// A pause that leaves the core to the processes that are watched, and is shorter than any tick.
pub fn short_pause() {
    std::thread::park_timeout(Duration::from_micros(100));
}

fn poll<T>(run: &mut Child, what: &str, mut ask: impl FnMut() -> Option<T>, pause: impl Fn()) -> T {
    let begin = Instant::now();
    loop {
        // The state of the run is read first: if it has ended, `ask` sees everything that it left.
        let over = run.try_wait().unwrap();
        if let Some(answer) = ask() {
            return answer;
        }
        if begin.elapsed() > Duration::from_mins(2) {
            run.kill().unwrap();
            panic!("{what}: not within two minutes");
        }
        assert!(over.is_none(), "{what}: the run is over: {over:?}");
        pause();
    }
}
