//! The observation hop: from publish to a visible tensor in another process, over the size of the block.

use std::{
    collections::BTreeMap,
    path::Path,
    process::{Child, Command, Stdio},
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use ipc_schema::{
    block,
    board::State,
    clock::monotonic_ns,
    header::{LAST_OF_RUN, MessageHeader},
    observation::ObservationLayout,
    ports::{BoardReader, RosterWriter},
    process::Process,
    run::{Mode, RunFile},
    services::{self, Channel, ServiceHolder},
    session::Session,
};
use serde::Deserialize;

use super::{Curve, Line, Options, Report, Table};
use crate::{cli::RunArgs, failure::Exit, install, prepare::prepare};

/// Sizes of the block, bytes.
const SIZES: [usize; 8] = [1 << 10, 1 << 12, 1 << 14, 1 << 16, 1 << 18, 1 << 20, 1 << 22, 1 << 24];
/// Fields of a row.
const FIELDS: usize = 9;
/// Messages of each size: before the measurement, and measured.
const WARM_UP: usize = 200;
const MEASURED: usize = 5_000;
const MEASURED_OF_LARGE: usize = 500;
/// Pause after a message has been taken: the receiver polls again.
const PAUSE: Duration = Duration::from_micros(100);
/// Longest wait for the receiver.
const PATIENCE: Duration = Duration::from_secs(60);

/// What the receivers write: latencies in nanoseconds.
#[derive(Debug, Deserialize)]
struct Bare {
    latencies_ns: Vec<f64>,
}

/// Measures ours, the bare message and the peers.
///
/// # Errors
/// Shared memory is too small, or a program is missing or fails.
pub fn measure(options: &Options) -> Result<Report, Exit> {
    let mut bare = Command::new(install::program(&options.bin, "ipc-bench")?);
    bare.args(["--messages", "20000"]);
    let bare: Bare = super::report::from_program(bare)?;
    let bare = Percentiles::of(bare.latencies_ns)?;
    let ours = ours()?;
    let peers = peers(options)?;
    Ok(report(bare, &ours, &peers))
}

/// Size of the block, bytes → latencies.
type BySize = BTreeMap<usize, Percentiles>;

/// Ours: until the block is in the receiver's hands, until it is a tensor that is lent, and until it is a tensor of an observation that
/// may be kept.
struct Ours {
    taken: BySize,
    tensor: BySize,
    received: BySize,
}

/// One-way latencies, microseconds.
#[derive(Debug, Clone, Copy)]
struct Percentiles {
    median: f64,
    ninety: f64,
    ninety_nine: f64,
}

impl Percentiles {
    fn of(mut latencies_ns: Vec<f64>) -> Result<Self, Exit> {
        latencies_ns.sort_by(f64::total_cmp);
        #[expect(
            clippy::cast_precision_loss,
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "an index of a short list"
        )]
        let at = |share: f64| {
            let index = (share * latencies_ns.len().saturating_sub(1) as f64).round() as usize;
            latencies_ns.get(index).map(|ns| ns / 1e3)
        };
        match (at(0.5), at(0.9), at(0.99)) {
            (Some(median), Some(ninety), Some(ninety_nine)) => Ok(Self {
                median,
                ninety,
                ninety_nine,
            }),
            _ => Err(Exit::run("a receiver measured nothing", "")),
        }
    }

    fn cells(self) -> [String; 3] {
        [self.median, self.ninety, self.ninety_nine].map(|us| format!("{us:.2}"))
    }
}

/// Rows whose block has `bytes` bytes.
fn rows(bytes: usize) -> usize {
    bytes / (ObservationLayout::new(1024, FIELDS, 1).len / 1024)
}

/// Sends blocks of every size through the services of a real run to a trainer process that polls.
fn ours() -> Result<Ours, Exit> {
    let directory = tempfile::tempdir().map_err(|error| Exit::io("create", &std::env::temp_dir(), &error))?;
    let args = RunArgs {
        set: vec![
            format!("traffic.max_road_users={}", rows(1 << 24)),
            "fanout.enabled=false".into(),
            "run.window_ticks=1".into(),
            "trainer.module=caraware.benchmarks.ipc_receive".into(),
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
    let receiver = Command::new(&prepared.install.python)
        .args(["-m", &run.config.trainer.module])
        .arg(&run_file)
        .stdin(Stdio::null())
        .spawn()
        .map_err(|error| Exit::io("start", &prepared.install.python, &error))?;
    let mut receiver = Receiver(receiver);
    receiver.wait_until("attach", || board.progress().attached == 1)?;
    send_all(&run, &board, &mut receiver)?;
    receiver.wait_until("finish", || State::from_u32(board.health().state) == State::Done)?;
    let latencies: BTreeMap<String, BTreeMap<usize, Vec<[f64; 2]>>> = read(&run.run_dir.join("latencies.json"))?;
    let of = |way: &str, which: usize| {
        let sizes = SIZES.iter().map(|&bytes| {
            let all = latencies.get(way).and_then(|by_rows| by_rows.get(&rows(bytes)));
            let measured = all
                .into_iter()
                .flatten()
                .skip(WARM_UP / 2)
                .map(|latencies| latencies[which]);
            Ok((bytes, Percentiles::of(measured.collect())?))
        });
        sizes.collect::<Result<BySize, Exit>>()
    };
    Ok(Ours {
        taken: of("lent", 0)?,
        tensor: of("lent", 1)?,
        received: of("received", 1)?,
    })
}

/// The trainer's process; killed when dropped.
struct Receiver(Child);

impl Receiver {
    fn wait_until(&mut self, what: &str, done: impl Fn() -> bool) -> Result<(), Exit> {
        let begin = Instant::now();
        while !done() {
            if let Ok(Some(status)) = self.0.try_wait() {
                return Err(Exit::run(
                    format!("the receiver ended with {status}"),
                    "its message above says why",
                ));
            }
            if begin.elapsed() > PATIENCE {
                return Err(Exit::run(format!("the receiver did not {what} in time"), ""));
            }
            std::thread::park_timeout(Duration::from_millis(5));
        }
        Ok(())
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        // Gone already, unless the measurement failed.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn send_all(run: &RunFile, board: &BoardReader, receiver: &mut Receiver) -> Result<(), Exit> {
    let failed = |error: ipc_schema::session::SessionError| Exit::run(error.to_string(), "");
    let session = Session::join_from_outside(run.clone(), Process::SensorDaemon, 0, Arc::new(AtomicBool::new(false)))
        .map_err(failed)?;
    let publisher = session.publisher(Channel::Observation).map_err(failed)?;
    let mut tick = 0;
    for (index, bytes) in SIZES.into_iter().enumerate() {
        let rows = rows(bytes);
        let layout = ObservationLayout::new(rows, FIELDS, 1);
        let measured = if bytes > 1 << 20 { MEASURED_OF_LARGE } else { MEASURED };
        for message in 0..WARM_UP + measured {
            let is_last = index + 1 == SIZES.len() && message + 1 == WARM_UP + measured;
            let mut draft = publisher.loan_unwritten(session.header(), layout.len)?;
            let values: &mut [f32] = block::view_mut(draft.payload_mut(), layout.observation)
                .map_err(|error| Exit::run(error.to_string(), ""))?;
            #[expect(clippy::cast_precision_loss, reason = "numbers below 2^24")]
            let (first, last) = (rows as f32, tick as f32);
            values.fill(first);
            if let Some(value) = values.last_mut() {
                *value = last;
            }
            let asked = Instant::now();
            while board.progress().consumed_ticks < tick {
                std::hint::spin_loop();
                if asked.elapsed() > PATIENCE {
                    return receiver.wait_until("take a block", || false);
                }
            }
            let taken = Instant::now();
            while taken.elapsed() < PAUSE {
                std::hint::spin_loop();
            }
            *draft.header_mut() = MessageHeader {
                tick,
                count: u32::try_from(rows).unwrap_or(u32::MAX),
                columns: u32::try_from(FIELDS).unwrap_or(u32::MAX),
                sequence: 1,
                flags: if is_last { LAST_OF_RUN } else { 0 },
                sim_time_ns: monotonic_ns(),
                ..session.header()
            };
            draft.send()?;
            tick += 1;
        }
    }
    Ok(())
}

fn peers(options: &Options) -> Result<BTreeMap<String, BySize>, Exit> {
    let Some(python) = &options.python else {
        return Ok(BTreeMap::new());
    };
    let file = std::env::temp_dir().join(format!("caraware-bench-{}.json", std::process::id()));
    let sizes: Vec<String> = SIZES.iter().map(ToString::to_string).collect();
    let status = Command::new(python)
        .args(["-m", "caraware.benchmarks.ipc_peers", &sizes.join(",")])
        .arg(&file)
        .status()
        .map_err(|error| Exit::io("start", python, &error))?;
    if !status.success() {
        return Err(Exit::run(
            format!("the peers ended with {status}"),
            "their message above says why",
        ));
    }
    let all: BTreeMap<String, BTreeMap<usize, Vec<f64>>> = read(&file)?;
    // Read: nobody needs it any more.
    let _ = std::fs::remove_file(&file);
    let percentiles = |by_size: BTreeMap<usize, Vec<f64>>| {
        let each = by_size
            .into_iter()
            .map(|(bytes, all)| Ok((bytes, Percentiles::of(all)?)));
        each.collect::<Result<BySize, Exit>>()
    };
    all.into_iter()
        .map(|(peer, by_size)| Ok((peer, percentiles(by_size)?)))
        .collect()
}

fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, Exit> {
    let text = std::fs::read_to_string(path).map_err(|error| Exit::io("read", path, &error))?;
    serde_json::from_str(&text).map_err(|error| Exit::run(format!("{}: {error}", path.display()), ""))
}

fn name(bytes: usize) -> String {
    match bytes >> 10 {
        kibi if kibi < 1024 => format!("{kibi} KiB"),
        kibi => format!("{} MiB", kibi >> 10),
    }
}

fn report(bare: Percentiles, ours: &Ours, peers: &BTreeMap<String, BySize>) -> Report {
    let mut report = Report::new(
        "ipc",
        "Observation hop",
        "One way, from right before publish in one process, microseconds, both sides polling. Ours is the `observation` channel of a run and \
         `Channel.lease`, read in place whatever the size: until the block is in the receiver's hands, and until Python has a torch tensor \
         over it, which is lent until the next is taken. Every other tick comes by `Channel.receive(busy=True)`: a tensor of an observation \
         with all its arrays that may be kept. The bare message is eight bytes between two Rust processes that poll iceoryx2. The peers send the same number of bytes \
         from Python to Python and make a tensor of what arrives without further copies; they sleep until the kernel wakes them. One message is \
         under way at a time.",
    );
    let all = || {
        let ours = [
            ("ours, taken", &ours.taken),
            ("ours, tensor", &ours.tensor),
            ("ours, tensor of an observation to keep", &ours.received),
        ];
        ours.into_iter()
            .chain(peers.iter().map(|(name, by_size)| (name.as_str(), by_size)))
    };
    let mut table = Table::new("", &["message", "median µs", "90 %", "99 %"]);
    let [median, ninety, ninety_nine] = bare.cells();
    table.row(["bare iceoryx2, 8 bytes".into(), median, ninety, ninety_nine]);
    report.figure("bare iceoryx2, median µs", bare.median);
    for (who, by_size) in all() {
        for (bytes, percentiles) in by_size {
            let [median, ninety, ninety_nine] = percentiles.cells();
            table.row([format!("{who}, {}", name(*bytes)), median, ninety, ninety_nine]);
            report.figure(format!("{who}, {}, median µs", name(*bytes)), percentiles.median);
        }
    }
    let mut ratios = Table::new("", &["ratio of medians", "figure"]);
    for (what, by_size) in [
        ("taken", &ours.taken),
        ("tensor", &ours.tensor),
        ("tensor of an observation to keep", &ours.received),
    ] {
        let medians = || by_size.values().map(|percentiles| percentiles.median);
        let (smallest, largest) = (medians().fold(f64::MAX, f64::min), medians().fold(0.0, f64::max));
        for (of, ratio) in [
            ("slowest size to fastest size, 1 KiB to 16 MiB", largest / smallest),
            ("slowest size to the bare message", largest / bare.median),
        ] {
            ratios.row([format!("ours, {what}: {of}"), format!("{ratio:.2} ×")]);
            report.figure(format!("{what}: {of}"), ratio);
        }
    }
    for (peer, by_size) in peers {
        for bytes in [1 << 10, 1 << 20, 1 << 24] {
            if let (Some(theirs), Some(ours)) = (by_size.get(&bytes), ours.tensor.get(&bytes)) {
                let ratio = format!("{:.0} ×", theirs.median / ours.median);
                ratios.row([format!("{peer} to our tensor, {}", name(bytes)), ratio]);
            }
        }
    }
    report.tables.extend([ratios, table]);
    let line = |(who, by_size): (&str, &BySize)| {
        #[expect(clippy::cast_precision_loss, reason = "a coordinate")]
        let points = by_size.iter().map(|(bytes, p)| [*bytes as f64, p.median]);
        Line {
            name: who.into(),
            points: points.collect(),
        }
    };
    report.curves.push(Curve {
        name: "ipc".into(),
        title: "From publish to a visible tensor".into(),
        x: "message (bytes)".into(),
        y: "one way, median (µs)".into(),
        logarithmic: [true, true],
        lines: all().map(line).collect(),
    });
    report
}
