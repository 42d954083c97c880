//! Measures the observation hop: the time from publish to a visible tensor in another process, by the size of the block.

mod summary;

use std::{
    collections::BTreeMap,
    path::Path,
    process::{Child, Command, Stdio},
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use caraware::{cli::RunArgs, failure::Exit, install, prepare::prepare};
use ipc_schema::{
    block,
    board::State,
    clock::monotonic_ns,
    header::{LAST_OF_RUN, MessageHeader},
    membership::RunMembership,
    observation::ObservationLayout,
    ports::{BoardReader, RosterWriter},
    process::Process,
    run::{Mode, RunFile},
    services::{self, Channel, ServiceHolder},
};
use serde::Deserialize;

use super::{BenchOptions, BenchReport};

/// Sizes of the block, bytes.
const SIZES: [usize; 8] = [1 << 10, 1 << 12, 1 << 14, 1 << 16, 1 << 18, 1 << 20, 1 << 22, 1 << 24];
/// Fields of a row.
const FIELDS: usize = 9;
/// Rounds. Each measures the bare message and then ours, in new processes.
const ROUNDS: usize = 5;
/// Bare messages in a round.
const BARE: usize = 4_000;
/// Turns in a round; each turn sends all sizes, because the machine's pace changes from second to second.
///
/// In every other turn the sender writes the whole block, as `sensor-daemon` does. In the others it writes only the first and the last
/// value, so that the contents of its caches do not depend on the size.
const TURNS: usize = 40;
/// Messages of a turn, and those at its beginning that are not measured.
const MESSAGES: usize = 60;
const WARM_UP: usize = 12;
/// Ways of receiving, which take messages in turn.
const WAYS: usize = 3;
/// Pause after a message was taken, until the receiver polls again.
const PAUSE: Duration = Duration::from_micros(100);
/// Longest wait for the receiver.
const MAX_WAIT: Duration = Duration::from_secs(60);

/// The output of `ipc-bench`: latencies in nanoseconds.
#[derive(Debug, Deserialize)]
struct BareLatencies {
    latencies_ns: Vec<f64>,
}

/// Measures ours, the bare message and the peers.
///
/// # Errors
/// Shared memory is too small, or a program is missing or fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let mut rounds = Vec::new();
    for _ in 0..ROUNDS {
        let mut program = Command::new(install::program(&options.bin, "ipc-bench")?);
        program.args(["--messages", &BARE.to_string()]);
        let bare: BareLatencies = super::report::from_program(program)?;
        rounds.push(LatencyRound {
            bare: bare.latencies_ns,
            ours: measure_ours()?,
        });
    }
    let peers = measure_peers(options)?;
    summary::report(&rounds, &peers)
}

/// Latencies of one round: the bare message, then ours, nanoseconds.
struct LatencyRound {
    bare: Vec<f64>,
    ours: OurLatencies,
}

/// Size of the block, bytes → latencies, nanoseconds.
type LatenciesBySize = BTreeMap<usize, Vec<f64>>;

/// Latencies of the channel `observation`.
struct OurLatencies {
    /// Until the receiver has taken the block.
    taken: LatenciesBySize,
    /// Until Python has a lent tensor over the block.
    tensor: LatenciesBySize,
    /// Until Python has the tensor of an observation that it may keep.
    received: LatenciesBySize,
    /// The same, where the receiver slept until the message came.
    asleep: LatenciesBySize,
    /// As `tensor`, where the sender wrote only two values of the block.
    two_values_written: LatenciesBySize,
}

/// Number of rows in a block of `bytes` bytes.
fn rows(bytes: usize) -> usize {
    bytes / (ObservationLayout::new(1024, FIELDS, 1).len / 1024)
}

/// Sends blocks of every size through the services of a real run to a trainer process.
fn measure_ours() -> Result<OurLatencies, Exit> {
    // A real run without processes: its services, its roster and its run file.
    let directory = tempfile::tempdir().map_err(|error| Exit::io("create", &std::env::temp_dir(), &error))?;
    let args = RunArgs {
        set: vec![
            format!("traffic.max_road_users={}", rows(1 << 24)),
            "fanout.enabled=false".into(),
            "run.window_ticks=1".into(),
            "trainer.module=caraware_bench.ipc_receive".into(),
        ],
        runs: directory.path().into(),
        ..RunArgs::default()
    };
    let prepared = prepare(&args, Mode::Train)?;
    let run = prepared.run;
    let node = services::node(&run.shared_memory)?;
    let holder = ServiceHolder::create(&node, &run, 0)?;
    let _roster = RosterWriter::create(&holder)?;
    let run_file = run.write()?;
    let board = BoardReader::open(&node, &run, 0, Process::Trainer)?;
    // The receiver attaches as the trainer and receives all blocks.
    let receiver = Command::new(&prepared.install.python)
        .args(["-m", &run.config.trainer.module])
        .arg(&run_file)
        .stdin(Stdio::null())
        .spawn()
        .map_err(|error| Exit::io("start", &prepared.install.python, &error))?;
    let mut receiver = ReceiverProcess(receiver);
    receiver.wait_until("attach", || board.progress().attached == 1)?;
    send_all(&run, &board, &mut receiver)?;
    receiver.wait_until("finish", || State::from_u32(board.health().state) == State::Done)?;
    // Latencies by way, size and kind of turn, without the first messages of each turn.
    let latencies: BTreeMap<String, BTreeMap<usize, Vec<[f64; 2]>>> = read(&run.run_dir.join("latencies.json"))?;
    let of = |way: &str, which: usize, first_turn: usize| -> LatenciesBySize {
        let measured = |bytes: usize| {
            let all = latencies.get(way).and_then(|by_rows| by_rows.get(&rows(bytes)));
            let turns = all.map_or(&[][..], Vec::as_slice).chunks(MESSAGES / WAYS);
            turns
                .skip(first_turn)
                .step_by(2)
                .flat_map(|turn| turn.iter().skip(WARM_UP / WAYS))
                .map(|latencies| latencies[which])
                .collect()
        };
        SIZES.iter().map(|&bytes| (bytes, measured(bytes))).collect()
    };
    Ok(OurLatencies {
        taken: of("lent", 0, 0),
        tensor: of("lent", 1, 0),
        received: of("received", 1, 0),
        asleep: of("asleep", 1, 0),
        two_values_written: of("lent", 1, 1),
    })
}

/// The process that receives as the trainer. Dropping it kills the process.
struct ReceiverProcess(Child);

impl ReceiverProcess {
    fn wait_until(&mut self, what: &str, done: impl Fn() -> bool) -> Result<(), Exit> {
        let begin = Instant::now();
        while !done() {
            if let Ok(Some(status)) = self.0.try_wait() {
                return Err(Exit::run(
                    format!("the receiver ended with {status}"),
                    "its message is above",
                ));
            }
            if begin.elapsed() > MAX_WAIT {
                return Err(Exit::run(format!("the receiver did not {what} in time"), ""));
            }
            std::thread::park_timeout(Duration::from_millis(5));
        }
        Ok(())
    }
}

impl Drop for ReceiverProcess {
    fn drop(&mut self) {
        // It has already ended unless the measurement failed.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Sends the blocks of all turns, each once the receiver has taken the one before.
fn send_all(run: &RunFile, board: &BoardReader, receiver: &mut ReceiverProcess) -> Result<(), Exit> {
    let failed = |error: ipc_schema::membership::MembershipError| Exit::run(error.to_string(), "");
    let membership =
        RunMembership::join_from_outside(run.clone(), Process::SensorDaemon, 0, Arc::new(AtomicBool::new(false)))
            .map_err(failed)?;
    let publisher = membership.publisher(Channel::Observation).map_err(failed)?;
    let waker = membership.waker(Process::Trainer).map_err(failed)?;
    let turns = (0..TURNS).flat_map(|turn| SIZES.map(|bytes| (rows(bytes), turn % 2 == 0)));
    let messages = turns.flat_map(|turn| std::iter::repeat_n(turn, MESSAGES));
    let last = (TURNS * SIZES.len() * MESSAGES - 1) as u64;
    for (tick, (rows, whole)) in (0..).zip(messages) {
        let asked = Instant::now();
        while board.progress().consumed_ticks < tick {
            std::hint::spin_loop();
            if asked.elapsed() > MAX_WAIT {
                return receiver.wait_until("take a block", || false);
            }
        }
        let taken = Instant::now();
        while taken.elapsed() < PAUSE {
            std::hint::spin_loop();
        }
        let layout = ObservationLayout::new(rows, FIELDS, 1);
        let mut draft = publisher.loan_unwritten(membership.header(), layout.len)?;
        let values: &mut [f32] = block::view_mut(draft.payload_mut(), layout.observation)
            .map_err(|error| Exit::run(error.to_string(), ""))?;
        #[expect(clippy::cast_precision_loss, reason = "numbers below 2^24")]
        let (first, newest) = (rows as f32, tick as f32);
        if whole {
            values.fill(first);
        }
        if let [begin, .., end] = values {
            (*begin, *end) = (first, newest);
        }
        *draft.header_mut() = MessageHeader {
            tick,
            shape: layout.shape,
            flags: if tick == last { LAST_OF_RUN } else { 0 },
            ..membership.header()
        };
        // The time is written last, right before the message is sent.
        draft.header_mut().sim_time_ns = monotonic_ns();
        draft.send()?;
        waker.wake();
    }
    Ok(())
}

fn measure_peers(options: &BenchOptions) -> Result<BTreeMap<String, LatenciesBySize>, Exit> {
    let Some(python) = &options.python else {
        return Ok(BTreeMap::new());
    };
    let file = std::env::temp_dir().join(format!("caraware-bench-{}.json", std::process::id()));
    let sizes: Vec<String> = SIZES.iter().map(ToString::to_string).collect();
    let status = Command::new(python)
        .args(["-m", "caraware_bench.ipc_peers", &sizes.join(",")])
        .arg(&file)
        .status()
        .map_err(|error| Exit::io("start", python, &error))?;
    if !status.success() {
        return Err(Exit::run(
            format!("the peers ended with {status}"),
            "their message is above",
        ));
    }
    let all = read(&file)?;
    // The file has been read and is not needed any more.
    let _ = std::fs::remove_file(&file);
    Ok(all)
}

fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, Exit> {
    let text = std::fs::read_to_string(path).map_err(|error| Exit::io("read", path, &error))?;
    serde_json::from_str(&text).map_err(|error| Exit::run(format!("{}: {error}", path.display()), ""))
}
