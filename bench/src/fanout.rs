//! Measures what viewers cost a run: its lateness in real time, its rate at full speed, and its longest pause while the fan-out is killed.

use std::{
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, Stdio},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use caraware::{failure::Exit, install};
use ipc_schema::{
    board::State,
    clock,
    ports::BoardReader,
    process::Process,
    run::RunFile,
    services::{self, RunNode},
};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use super::{BenchOptions, BenchReport, MedianSpread, ReportTable, free_port, report::median_interval};

/// Wall time of a paced run, seconds.
const PACED_S: u64 = 20;
/// Time that viewers take to start and to receive all topics.
const SETTLING: Duration = Duration::from_secs(3);
/// Pairs of paced runs, and of free ones.
const PACED_PAIRS: usize = 3;
const FREE_PAIRS: usize = 41;
/// Ticks of a free run.
const FREE_TICKS: u64 = 12_000;
/// Kills of the fan-out.
const KILLS: u32 = 50;
/// Interval at which a board is read: short enough to see every tick.
const POLL_INTERVAL: Duration = Duration::from_millis(2);
/// Rate of the slow viewer's link: 1 Mbit/s.
const SLOW_BYTES_PER_S: u64 = 125_000;
/// Longest wait for any event.
const MAX_WAIT: Duration = Duration::from_secs(120);

/// Measures paced runs, free runs, and kills.
///
/// # Errors
/// A program is missing, or a run fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let mut report = BenchReport::new(
        "fanout",
        "Fan-out",
        format!(
            "The town with 52 road users. A watched run has eight viewers on the same machine: six count frames, one is stopped (SIGSTOP), and \
             one is behind a proxy that reads its socket at {SLOW_BYTES_PER_S} bytes/s (1 Mbit/s). Lateness is the time from the moment when an \
             observation is due to the moment when `sensor-daemon` has sent it, by the clock of `sensor-daemon`. Runs at full speed alternate in \
             {FREE_PAIRS} pairs on all cores, the viewers among them; the cost of watching is the interval of the median ratio, and no less than \
             its width can be claimed."
        ),
    );
    let bench = FanoutBench::new(options)?;
    bench.measure_paced(&mut report)?;
    bench.measure_free(&mut report)?;
    bench.measure_kills(&mut report)?;
    Ok(report)
}

struct FanoutBench {
    caraware: PathBuf,
    watch: PathBuf,
    directory: PathBuf,
}

impl Drop for FanoutBench {
    fn drop(&mut self) {
        if let Err(error) = std::fs::remove_dir_all(&self.directory) {
            tracing::debug!(%error, "cannot remove the measurement's runs");
        }
    }
}

impl FanoutBench {
    fn new(options: &BenchOptions) -> Result<Self, Exit> {
        let directory = std::env::temp_dir().join(format!("caraware-bench-{}", std::process::id()));
        std::fs::create_dir_all(&directory).map_err(|error| Exit::io("create", &directory, &error))?;
        Ok(Self {
            caraware: install::program(&options.bin, "caraware")?,
            watch: install::program(&options.bin, "fanout-watch")?,
            directory,
        })
    }

    fn start(&self, name: &str, port: Option<u16>, settings: &[String]) -> Result<LiveRun, Exit> {
        let fanout = match port {
            Some(port) => format!("fanout.listen=tcp/127.0.0.1:{port}"),
            None => "fanout.enabled=false".into(),
        };
        let settings = settings.iter().chain([&fanout]).flat_map(|setting| ["--set", setting]);
        let mut command = Command::new(&self.caraware);
        command
            .args(["simulate", "town", "--name", name, "--runs"])
            .arg(&self.directory)
            .args(settings)
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        let child = command
            .spawn()
            .map_err(|error| Exit::io("start", &self.caraware, &error))?;
        LiveRun::join(child, self.directory.join(name))
    }

    /// Starts the viewers: six that count, one that is stopped, and one on a slow link.
    fn start_viewers(&self, run: &str, port: u16, seconds: u64) -> Result<Vec<CountingViewer>, Exit> {
        let viewer = |arguments: &[String]| CountingViewer::start(&self.watch, run, port, seconds, arguments);
        let log = self.directory.join("world.csv");
        let healthy = viewer(&[
            "--viewers".into(),
            "6".into(),
            "--log".into(),
            log.display().to_string(),
        ])?;
        let stopped = viewer(&[])?;
        signal(&stopped.child, Signal::STOP);
        let slow = viewer(&["--bytes-per-s".into(), SLOW_BYTES_PER_S.to_string()])?;
        Ok(vec![healthy, slow, stopped])
    }

    /// Measures runs in real time: the lateness of ticks without and with viewers, and the age of the frames that healthy viewers receive.
    fn measure_paced(&self, report: &mut BenchReport) -> Result<(), Exit> {
        let mut table = ReportTable::new(
            "in real time",
            &[
                "run",
                "lateness p50 (ms)",
                "p95 (ms)",
                "p99 (ms)",
                "largest (ms)",
                "hash",
            ],
        );
        let mut hashes = Vec::new();
        for pair in 0..PACED_PAIRS {
            for watched in [false, true] {
                let name = format!("paced-{pair}-{watched}");
                let settings = [
                    "run.real_time_factor=1".to_owned(),
                    format!("episode.ticks={}", (PACED_S + 5) * 10),
                    "episode.training_episodes=1".into(),
                ];
                let port = free_port()?;
                let mut run = self.start(&name, Some(port), &settings)?;
                run.wait_for_ticks(10)?;
                let viewers = match watched {
                    true => self.start_viewers(&name, port, PACED_S)?,
                    false => Vec::new(),
                };
                // The start of eight programs on the cores of the run does not count.
                run.observe(SETTLING);
                let ticks = run.observe(Duration::from_secs(PACED_S - 1) - SETTLING);
                let seen: Vec<_> = viewers
                    .into_iter()
                    .map(CountingViewer::finish)
                    .collect::<Result<_, _>>()?;
                let late = lateness_ms(&ticks);
                let found = run.finish()?;
                let hash = observation_hash(&found)?;
                let case = if watched { "watched" } else { "alone" };
                let at = |share| percentile(&late, share);
                table.row([
                    format!("{case}, {}", pair + 1),
                    format!("{:.2}", at(0.5)),
                    format!("{:.2}", at(0.95)),
                    format!("{:.2}", at(0.99)),
                    format!("{:.2}", at(1.0)),
                    hash.chars().take(8).collect(),
                ]);
                hashes.push(hash);
                report.figure(format!("paced, {case}, lateness p99, ms"), at(0.99));
                if watched {
                    self.report_ages(report, &ticks, &seen)?;
                }
            }
        }
        report.tables.push(table);
        report.figure(
            "observation hashes of paced runs are one, 1 = yes",
            f64::from(u8::from(all_equal(&hashes))),
        );
        Ok(())
    }

    /// Reports the age of frames at healthy viewers: the time since `sensor-daemon` published the tick on its board.
    fn report_ages(&self, report: &mut BenchReport, ticks: &[(u64, u64)], seen: &[Option<Value>]) -> Result<(), Exit> {
        let log = self.directory.join("world.csv");
        let text = std::fs::read_to_string(&log).map_err(|error| Exit::io("read", &log, &error))?;
        let made: std::collections::BTreeMap<u64, u64> = ticks.iter().copied().collect();
        let mut ages_ms: Vec<f64> = text
            .lines()
            .filter_map(|line| {
                let (tick, at_ns) = line.split_once(',')?;
                let made_ns = made.get(&(tick.parse::<u64>().ok()? + 1))?;
                Some((at_ns.parse::<f64>().ok()? - *made_ns as f64) / 1e6)
            })
            .collect();
        ages_ms.sort_by(f64::total_cmp);
        report.figure("median age of world frames, ms", percentile(&ages_ms, 0.5));
        report.figure("p99 age of world frames, ms", percentile(&ages_ms, 0.99));
        if let Some(world) = seen.iter().flatten().next().map(|counts| &counts["world"]) {
            for what in ["received", "lost", "refused"] {
                report.figure(
                    format!("world frames {what} by six healthy viewers"),
                    world[what].as_f64().unwrap_or(f64::NAN),
                );
            }
        }
        Ok(())
    }

    /// Measures runs at full speed, with viewers and without a fan-out, in pairs whose order alternates: what changes slowly on the machine
    /// meets both sides alike.
    fn measure_free(&self, report: &mut BenchReport) -> Result<(), Exit> {
        let settings = [
            format!("episode.ticks={FREE_TICKS}"),
            "episode.training_episodes=1".into(),
        ];
        let (mut ratios, mut hashes) = (Vec::new(), Vec::new());
        let mut table = ReportTable::new(
            "at full speed",
            &["pair", "off (ticks/s)", "watched (ticks/s)", "ratio"],
        );
        for pair in 0..FREE_PAIRS {
            let mut rates = [0.0; 2];
            let mut order = [(0, false), (1, true)];
            if pair % 2 == 1 {
                order.reverse();
            }
            for (place, watched) in order {
                let port = if watched { Some(free_port()?) } else { None };
                let name = format!("free-{pair}-{watched}");
                let mut run = self.start(&name, port, &settings)?;
                run.wait_for_ticks(1)?;
                let viewers = match port {
                    Some(port) => self.start_viewers(&name, port, 600)?,
                    None => Vec::new(),
                };
                // The rate counts from here on, after the viewers have started.
                rates[place] = run.rate();
                drop(viewers);
                hashes.push(observation_hash(&run.finish()?)?);
            }
            let ratio = rates[1] / rates[0];
            ratios.push(ratio);
            table.row([
                (pair + 1).to_string(),
                format!("{:.0}", rates[0]),
                format!("{:.0}", rates[1]),
                format!("{ratio:.3}"),
            ]);
        }
        let (spread, [low, high]) = (MedianSpread::of(ratios.iter().copied())?, median_interval(&ratios)?);
        report.figure("rate watched / off, median", spread.median);
        report.figure("rate watched / off, smallest", spread.smallest);
        report.figure("rate watched / off, lower end of the median's 95 % interval", low);
        report.figure("rate watched / off, upper end of the median's 95 % interval", high);
        table.row([
            "median (95 % interval)".into(),
            String::new(),
            String::new(),
            format!("{:.3} ({low:.3}–{high:.3})", spread.median),
        ]);
        report.figure(
            "observation hashes of free runs are one, 1 = yes",
            f64::from(u8::from(all_equal(&hashes))),
        );
        report.tables.push(table);
        Ok(())
    }

    /// Kills the fan-out again and again, while a viewer watches the run.
    fn measure_kills(&self, report: &mut BenchReport) -> Result<(), Exit> {
        let settings = [
            "run.real_time_factor=10".to_owned(),
            "episode.ticks=1000000".into(),
            "episode.training_episodes=1".into(),
        ];
        let port = free_port()?;
        let mut run = self.start("kills", Some(port), &settings)?;
        run.wait_for_ticks(10)?;
        let viewer = CountingViewer::start(&self.watch, "kills", port, 600, &[])?;
        let undisturbed = longest_gap_ms(&run.observe(Duration::from_secs(10)));
        let (mut ticks, mut memory_mib) = (Vec::new(), Vec::new());
        for kill in 0..KILLS {
            let board = run.fanout()?;
            let begun = Instant::now();
            while board.progress().attached != 1 || board.health().state != State::Running as u32 {
                if begun.elapsed() > MAX_WAIT {
                    return Err(Exit::run("the fan-out was not restarted in time", ""));
                }
                ticks.extend(run.observe(Duration::from_millis(5)));
            }
            let pid = board.health().pid;
            memory_mib.push(resident_mib(pid));
            // A pause between 0 and 0.4 s, scattered without random numbers.
            let wait = Duration::from_millis(u64::from(kill * 7919 % 400));
            ticks.extend(run.observe(wait));
            if let Some(pid) = Pid::from_raw(pid) {
                let _ = kill_process(pid, Signal::KILL);
            }
            ticks.extend(run.observe(Duration::from_millis(100)));
        }
        let disturbed = longest_gap_ms(&ticks);
        let board = run.fanout()?;
        ticks = run.observe(Duration::from_secs(20));
        report.figure("fan-out killed, times", f64::from(KILLS));
        report.figure(
            "longest pause of the run undisturbed, ms (a tick is due every 10)",
            undisturbed,
        );
        report.figure("longest pause of the run while the fan-out is killed, ms", disturbed);
        report.figure("longest pause after, ms", longest_gap_ms(&ticks));
        report.figure(
            "fan-out restarted, 1 = yes",
            f64::from(u8::from(board.progress().attached == 1)),
        );
        report.figure(
            "resident memory of the last fan-out after 20 s, MiB",
            resident_mib(board.health().pid),
        );
        report.figure(
            "resident memory of fresh fan-outs, MiB",
            MedianSpread::of(memory_mib)?.median,
        );
        drop(viewer);
        let mut table = ReportTable::new(
            "fan-out killed 50 times, a tick every 10 ms",
            &["", "longest pause of the run (ms)"],
        );
        table.row(["undisturbed, 10 s".into(), format!("{undisturbed:.1}")]);
        table.row(["while it is killed".into(), format!("{disturbed:.1}")]);
        report.tables.push(table);
        run.stop()
    }
}

/// A run in the background, with its boards. Dropping it stops the run.
struct LiveRun {
    child: Child,
    directory: PathBuf,
    run: RunFile,
    node: RunNode,
    sensors: BoardReader,
    /// UNIX time at which the machine's monotonic clock was 0, ns.
    epoch_ns: u64,
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            signal(&self.child, Signal::INT);
            let _ = self.child.wait();
        }
    }
}

impl LiveRun {
    fn join(mut child: Child, directory: PathBuf) -> Result<Self, Exit> {
        let begun = Instant::now();
        let started = directory.join("logs").join("traffic-bridge.log");
        while begun.elapsed() < MAX_WAIT && matches!(child.try_wait(), Ok(None)) {
            // Processes start once all services exist; before that, services may be incomplete.
            if started.exists()
                && let Ok(run) = RunFile::read(&directory.join("run.json"))
                && let Ok(node) = services::node(&run.shared_memory)
                && let Ok(sensors) = BoardReader::open(&node, &run, 0, Process::SensorDaemon)
            {
                return Ok(Self {
                    child,
                    directory,
                    run,
                    node,
                    sensors,
                    epoch_ns: unix_ns().saturating_sub(clock::monotonic_ns()),
                });
            }
            pause();
        }
        Err(Exit::run(
            format!("the run in {} did not start", directory.display()),
            "",
        ))
    }

    fn ticks(&self) -> u64 {
        self.sensors.health().ticks
    }

    fn lives(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    fn wait_for_ticks(&mut self, ticks: u64) -> Result<(), Exit> {
        let begun = Instant::now();
        while self.ticks() < ticks {
            if begun.elapsed() > MAX_WAIT || !self.lives() {
                return Err(Exit::run(
                    format!("the run in {} did not start", self.directory.display()),
                    "",
                ));
            }
            pause();
        }
        Ok(())
    }

    /// Every new number of ticks with the UNIX time (ns) of the change. The time is that of `sensor-daemon`, because this program may
    /// have to wait for a core.
    fn observe(&mut self, time: Duration) -> Vec<(u64, u64)> {
        let begun = Instant::now();
        let mut seen = Vec::new();
        let mut last = u64::MAX;
        while begun.elapsed() < time {
            let health = self.sensors.health();
            if health.ticks != last {
                seen.push((health.ticks, self.epoch_ns + health.written_ns));
                last = health.ticks;
            }
            pause();
        }
        seen
    }

    /// Ticks per second from now to shortly before the end.
    fn rate(&mut self) -> f64 {
        let (from, begun) = (self.ticks(), Instant::now());
        let to = FREE_TICKS * 9 / 10;
        while self.ticks() < to && self.lives() {
            std::thread::park_timeout(Duration::from_millis(5));
        }
        (self.ticks() - from) as f64 / begun.elapsed().as_secs_f64()
    }

    fn fanout(&self) -> Result<BoardReader, Exit> {
        BoardReader::open(&self.node, &self.run, 0, Process::Fanout)
            .map_err(|error| Exit::run(format!("the board of the fan-out cannot be read: {error}"), ""))
    }

    /// Waits for the end and returns the report.
    fn finish(mut self) -> Result<Value, Exit> {
        let status = self.child.wait();
        let path = self.directory.join("report.json");
        let text = std::fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
        match status {
            Ok(status) if status.success() => {
                serde_json::from_str(&text).map_err(|error| Exit::run(format!("{}: {error}", path.display()), ""))
            }
            status => Err(Exit::run(format!("a run ended with {status:?}"), "")),
        }
    }

    fn stop(mut self) -> Result<(), Exit> {
        signal(&self.child, Signal::INT);
        self.child
            .wait()
            .map(drop)
            .map_err(|error| Exit::io("wait for", &self.directory, &error))
    }
}

/// A viewer that counts frames. Dropping it kills the viewer.
struct CountingViewer {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Drop for CountingViewer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl CountingViewer {
    /// Starts a viewer and waits until it is connected.
    fn start(program: &Path, run: &str, port: u16, seconds: u64, arguments: &[String]) -> Result<Self, Exit> {
        let mut child = Command::new(program)
            .args([&format!("tcp/127.0.0.1:{port}"), run, "--seconds", &seconds.to_string()])
            .args(arguments)
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| Exit::io("start", program, &error))?;
        let output = child.stdout.take().map(BufReader::new);
        let mut output = output.ok_or_else(|| Exit::run("a viewer has no output", ""))?;
        let mut line = String::new();
        match output.read_line(&mut line) {
            Ok(_) if line.trim() == "watching" => Ok(Self { child, output }),
            _ => Err(Exit::run("a viewer cannot connect", "its message is above")),
        }
    }

    /// The counts of the viewer; `None` if it is stopped.
    ///
    /// # Errors
    /// The viewer writes no counts.
    fn finish(mut self) -> Result<Option<Value>, Exit> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id())).unwrap_or_default();
        if stat
            .rsplit(')')
            .next()
            .is_some_and(|rest| rest.trim_start().starts_with('T'))
        {
            return Ok(None);
        }
        let mut line = String::new();
        let counts = match self.output.read_line(&mut line) {
            Ok(_) => serde_json::from_str(&line),
            Err(error) => Err(serde_json::Error::io(error)),
        };
        counts
            .map(Some)
            .map_err(|error| Exit::run(format!("a viewer has written no counts: {error}"), ""))
    }
}

fn signal(child: &Child, signal: Signal) {
    if let Some(pid) = i32::try_from(child.id()).ok().and_then(Pid::from_raw)
        && let Err(error) = kill_process(pid, signal)
    {
        tracing::debug!(%error, "cannot signal");
    }
}

fn pause() {
    std::thread::park_timeout(POLL_INTERVAL);
}

#[expect(
    clippy::disallowed_methods,
    reason = "compared with times that other processes, the viewers, record"
)]
fn unix_ns() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}

/// Lateness of each tick, sorted, milliseconds. The reference is a clock of ten ticks a second that no tick is ahead of.
fn lateness_ms(ticks: &[(u64, u64)]) -> Vec<f64> {
    let behind = |(tick, at_ns): &(u64, u64)| *at_ns as f64 / 1e6 - *tick as f64 * 100.0;
    let earliest = ticks.iter().map(behind).fold(f64::INFINITY, f64::min);
    let mut late: Vec<f64> = ticks.iter().map(|tick| behind(tick) - earliest).collect();
    late.sort_by(f64::total_cmp);
    late
}

/// Longest time between two changes, milliseconds.
fn longest_gap_ms(ticks: &[(u64, u64)]) -> f64 {
    let gaps = ticks.windows(2).map(|pair| (pair[1].1 - pair[0].1) as f64 / 1e6);
    gaps.fold(0.0, f64::max)
}

fn percentile(sorted: &[f64], share: f64) -> f64 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a place in the list"
    )]
    let place = (share * sorted.len().saturating_sub(1) as f64).round() as usize;
    sorted.get(place).copied().unwrap_or(f64::NAN)
}

fn resident_mib(pid: i32) -> f64 {
    let text = std::fs::read_to_string(format!("/proc/{pid}/statm")).unwrap_or_default();
    let pages = text
        .split_whitespace()
        .nth(1)
        .and_then(|pages| pages.parse::<f64>().ok());
    pages.map_or(f64::NAN, |pages| pages * 4.0 / 1024.0)
}

/// The observation hash of a run's report.
fn observation_hash(report: &Value) -> Result<String, Exit> {
    let hash = report["observation_hash"].as_str().filter(|hash| !hash.is_empty());
    hash.map(str::to_owned)
        .ok_or_else(|| Exit::run("the report of a run has no observation hash", ""))
}

fn all_equal(values: &[String]) -> bool {
    values.windows(2).all(|pair| pair[0] == pair[1])
}
