//! Measures what a recorder beside a live run costs it: in one run, with the recorder there and not there, in many short segments.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use caraware::{failure::Exit, generate::GeneratedCity, install, install::Install};
use ipc_schema::{ports::BoardReader, process::Process, run::RunFile, services};
use rustix::process::{Pid, Signal};

use super::{BenchOptions, BenchReport, ReportTable, sides::BenchDirectory};
use crate::target::signal;

const NAME: &str = "watched";
/// Time for the run to start, and for a recorder to begin or end.
const DEADLINE: Duration = Duration::from_secs(120);
/// The processes whose work the ticks are.
const LOOP: [Process; 3] = [Process::TrafficBridge, Process::SimCore, Process::SensorDaemon];
/// Simulated time of the city, seconds: more than a measurement takes, because the run is stopped at its end.
const CITY_S: f64 = 7200.0;
/// Most that watching may cost.
const MOST: f64 = 1.01;
/// Cores of the loop's processes, and one for the recorder.
const CORES: usize = 5;

/// How much is measured.
struct WatchSize {
    vehicles: u32,
    /// Time for blocks of one watched segment and two without a recorder, in random order; there are two blocks at least.
    time: Duration,
    /// Time between a change and the segment.
    settling: Duration,
    segment: Duration,
}

const SIZE: WatchSize = WatchSize {
    vehicles: 1000,
    time: Duration::from_secs(60),
    settling: Duration::from_millis(300),
    segment: Duration::from_millis(2000),
};
const QUICK: WatchSize = WatchSize {
    vehicles: 60,
    time: Duration::ZERO,
    settling: Duration::from_millis(50),
    segment: Duration::from_millis(300),
};

/// What happens in a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Segment {
    /// No recorder is there. There are two such segments in a block, which show how far equal segments differ.
    Alone(usize),
    Watched,
}

/// What a segment has cost.
#[derive(Debug, Clone, Copy, PartialEq)]
struct SegmentCost {
    wall_s_per_tick: f64,
    /// Processor time of the loop's processes.
    cpu_s_per_tick: f64,
}

/// Runs a generated city once, and records it for some of the time.
///
/// # Errors
/// The run cannot be started, or ends by itself.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let size = if options.quick {
        QUICK
    } else {
        WatchSize {
            time: SIZE.time * options.minutes,
            ..SIZE
        }
    };
    let place = BenchDirectory::new("watch")?;
    let mut run = WatchedRun::start(options, &size, &place)?;
    let mut random = fastrand::Rng::with_seed(options.seed);
    let mut ratios = SegmentRatios::default();
    let (begin, mut blocks) = (Instant::now(), 0);
    while blocks < 2 || begin.elapsed() < size.time {
        blocks += 1;
        let mut order = [Segment::Alone(0), Segment::Alone(1), Segment::Watched];
        random.shuffle(&mut order);
        let (mut alone, mut watched) = ([None; 2], None);
        for segment in order {
            let cost = run.segment(segment, &size)?;
            match segment {
                Segment::Alone(number) => alone[number] = Some(cost),
                Segment::Watched => watched = Some(cost),
            }
        }
        if let ([Some(first), Some(second)], Some(watched)) = (alone, watched) {
            ratios.add([first, second], watched);
        }
    }
    let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let (missed, message_mb_per_s) = (run.missed_ticks, run.message_mb / run.recorded_s.max(1e-9));
    run.stop()?;
    let mut report = report(&size, &ratios, missed, message_mb_per_s, load.trim())?;
    report.command = format!("caraware bench watch --minutes {}", options.minutes);
    Ok(report)
}

fn report(
    size: &WatchSize,
    ratios: &SegmentRatios,
    missed: f64,
    message_mb_per_s: f64,
    load: &str,
) -> Result<BenchReport, Exit> {
    let [wall, cpu, null_wall, null_cpu] =
        [&ratios.wall, &ratios.cpu, &ratios.null_wall, &ratios.null_cpu].map(|ratios| MedianInterval::of(ratios));
    let wall = wall.ok_or_else(|| Exit::run("no segment was measured", ""))?;
    let mut report = BenchReport::new(
        "watch",
        "A recorder that watches",
        format!(
            "{} vehicles on a generated city, `caraware simulate` at full speed without viewers, one run. {} blocks of three segments of {:.1} s \
             in random order: with `caraware record` beside the run, and twice without. A ratio compares the watched segment of a block with \
             the mean of the other two; the last rows compare those two with each other. Intervals are those of the median, 95 % at least, from the \
             order of the ratios alone. Processor time is that of `traffic-bridge`, `sim-core` and `sensor-daemon`. The recorder received {:.0} \
             MB/s and missed {missed:.0} ticks. Load of the machine at the end: {load}.",
            size.vehicles,
            ratios.wall.len(),
            size.segment.as_secs_f64(),
            message_mb_per_s,
        ),
    );
    let mut table = ReportTable::new("of alone", &["what", "median", "95 % interval"]);
    for (name, interval) in [
        ("wall time of a tick, watched", Some(wall)),
        ("processor time of a tick, watched", cpu),
        ("wall time of a tick, alone beside alone", null_wall),
        ("processor time of a tick, alone beside alone", null_cpu),
    ] {
        let Some(interval) = interval else { continue };
        let MedianInterval { median, low, high } = interval;
        table.row([name.into(), format!("{median:.4}"), format!("{low:.4}–{high:.4}")]);
        for (part, value) in [("median", median), ("low", low), ("high", high)] {
            report.figure(format!("{name}, {part}"), value);
        }
    }
    report.tables.push(table);
    report.figure("ticks missed", missed);
    report.figure("MB/s of messages", message_mb_per_s);
    if report.machine.cores < CORES {
        report.text += &format!(
            " With fewer than {CORES} cores the recorder takes processor time from the run itself: nothing follows from the ratio of wall times."
        );
    } else if wall.low > MOST {
        report
            .faults
            .push(format!("watching costs more than 1 %: {:.4}", wall.median));
    }
    Ok(report)
}

/// Ratios of all blocks.
#[derive(Debug, Default)]
struct SegmentRatios {
    wall: Vec<f64>,
    cpu: Vec<f64>,
    null_wall: Vec<f64>,
    null_cpu: Vec<f64>,
}

impl SegmentRatios {
    fn add(&mut self, [first, second]: [SegmentCost; 2], watched: SegmentCost) {
        let of_mean = |value: f64, alone: [f64; 2]| value / f64::midpoint(alone[0], alone[1]);
        let wall = [first, second].map(|cost| cost.wall_s_per_tick);
        let cpu = [first, second].map(|cost| cost.cpu_s_per_tick);
        self.wall.push(of_mean(watched.wall_s_per_tick, wall));
        self.cpu.push(of_mean(watched.cpu_s_per_tick, cpu));
        self.null_wall.push(wall[0] / wall[1]);
        self.null_cpu.push(cpu[0] / cpu[1]);
    }
}

/// The median of a sample, and an interval that has the population's median in 95 % of all samples.
#[derive(Debug, Clone, Copy, PartialEq)]
struct MedianInterval {
    median: f64,
    low: f64,
    high: f64,
}

impl MedianInterval {
    /// Any distribution: the number of values below its median is binomial. `None` without a value.
    fn of(values: &[f64]) -> Option<Self> {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let count = sorted.len();
        let last = count.checked_sub(1)?;
        // Values left out at each end: as many as keep the probability of both tails at 5 % or below.
        let mut tail = 0.5_f64.powi(i32::try_from(count).unwrap_or(i32::MAX));
        let (mut term, mut left_out) = (tail, 0);
        while tail <= 0.025 && left_out < last / 2 {
            left_out += 1;
            term *= (count - left_out + 1) as f64 / left_out as f64;
            tail += term;
        }
        let left_out = left_out.saturating_sub(usize::from(tail > 0.025));
        Some(Self {
            median: f64::midpoint(sorted[last / 2], sorted[count / 2]),
            low: sorted[left_out],
            high: sorted[last - left_out],
        })
    }
}

/// The run that is measured. Dropping it ends it.
struct WatchedRun {
    caraware: PathBuf,
    place: PathBuf,
    child: Child,
    recorder: Option<Child>,
    /// Boards of [`LOOP`].
    boards: Vec<BoardReader>,
    missed_ticks: f64,
    message_mb: f64,
    recorded_s: f64,
}

impl Drop for WatchedRun {
    fn drop(&mut self) {
        for child in self.recorder.iter_mut().chain([&mut self.child]) {
            if matches!(child.try_wait(), Ok(None)) {
                signal(Pid::from_child(child), Signal::TERM);
                let _ = child.wait();
            }
        }
    }
}

impl WatchedRun {
    fn start(options: &BenchOptions, size: &WatchSize, place: &BenchDirectory) -> Result<Self, Exit> {
        let caraware = install::program(&options.bin, "caraware")?;
        let city = GeneratedCity::of(size.vehicles, CITY_S, 0.1, 1);
        let sumocfg = city.write(&Install::find()?, &place.path().join("city"))?;
        let settings = [
            "fanout.enabled=false",
            "map.origin_latitude_deg=52.0",
            "map.origin_longitude_deg=10.0",
        ];
        let child = command(&caraware, place.path())
            .arg("simulate")
            .arg(&sumocfg)
            .args(["--quiet", "--name", NAME])
            .args(settings.into_iter().flat_map(|setting| ["--set", setting]))
            .spawn()
            .map_err(|error| Exit::io("start", &caraware, &error))?;
        let mut run = Self {
            caraware,
            place: place.path().to_owned(),
            child,
            recorder: None,
            boards: Vec::new(),
            missed_ticks: 0.0,
            message_mb: 0.0,
            recorded_s: 0.0,
        };
        let run_file = place.path().join("runs").join(NAME).join("run.json");
        run.wait_until("the run has started", |run| {
            if run.boards.is_empty()
                && let Ok(file) = RunFile::read(&run_file)
                && let Ok(node) = services::node(&file.shared_memory)
            {
                let boards = LOOP.map(|process| BoardReader::open(&node, &file, 0, process));
                run.boards = boards.into_iter().collect::<Result<_, _>>().unwrap_or_default();
            }
            run.boards.last().is_some_and(|board| board.health().ticks > 0)
        })?;
        Ok(run)
    }

    fn check_alive(&mut self) -> Result<(), Exit> {
        match self.child.try_wait() {
            Ok(None) => Ok(()),
            Ok(Some(status)) => Err(Exit::run(
                format!("the run ended by itself with {status}"),
                "its city lasts two simulated hours: give a smaller measurement to a faster machine",
            )),
            Err(error) => Err(Exit::io("wait for", &self.caraware, &error)),
        }
    }

    fn wait_until(&mut self, what: &str, mut is_so: impl FnMut(&mut Self) -> bool) -> Result<(), Exit> {
        let begun = Instant::now();
        while !is_so(self) {
            self.check_alive()?;
            if begun.elapsed() > DEADLINE {
                return Err(Exit::run(format!("waited {DEADLINE:.0?} until {what}"), "see its logs"));
            }
            std::thread::park_timeout(Duration::from_millis(5));
        }
        Ok(())
    }

    /// Measures one segment.
    fn segment(&mut self, segment: Segment, size: &WatchSize) -> Result<SegmentCost, Exit> {
        let file = self.place.join("segment.mcap");
        if segment == Segment::Watched {
            self.recorder = Some(self.start_recorder(&file)?);
            // Its first bytes are there once it has attached to the run.
            self.wait_until("the recorder has begun", |_| {
                fs::metadata(&file).is_ok_and(|file| file.len() > 0)
            })?;
        }
        pause(size.settling);
        let (begun, before) = (Instant::now(), self.work());
        pause(size.segment);
        let (wall_s, after) = (begun.elapsed().as_secs_f64(), self.work());
        self.check_alive()?;
        if let Some(recorder) = self.recorder.take() {
            self.stop_recorder(recorder, &file, size.settling.as_secs_f64() + wall_s)?;
        }
        let ticks = after.ticks - before.ticks;
        if ticks <= 0.0 {
            return Err(Exit::run("a segment has no tick", "see the logs of the run"));
        }
        Ok(SegmentCost {
            wall_s_per_tick: wall_s / ticks,
            cpu_s_per_tick: (after.cpu_s - before.cpu_s) / ticks,
        })
    }

    fn start_recorder(&self, file: &Path) -> Result<Child, Exit> {
        command(&self.caraware, &self.place)
            .args(["record", NAME, "--output"])
            .arg(file)
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| Exit::io("start", &self.caraware, &error))
    }

    /// Ends the recorder, counts what it has received, and removes its file.
    fn stop_recorder(&mut self, recorder: Child, file: &Path, recorded_s: f64) -> Result<(), Exit> {
        signal(Pid::from_child(&recorder), Signal::INT);
        let output = recorder.wait_with_output();
        let output = output.map_err(|error| Exit::io("wait for", &self.caraware, &error))?;
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        // Its last line: `FILE: A MB of B MB, N ticks missed`.
        let before = |word: &str| said.rsplit_once(word)?.0.split_whitespace().last()?.parse::<f64>().ok();
        let (Some(message_mb), Some(missed)) = (before(" MB, "), before(" ticks missed")) else {
            return Err(Exit::run(
                format!("the recorder ended with {}: {said}", output.status),
                "",
            ));
        };
        self.message_mb += message_mb;
        self.missed_ticks += missed;
        self.recorded_s += recorded_s;
        fs::remove_file(file).map_err(|error| Exit::io("remove", file, &error))
    }

    /// Ticks that are sensed, and the processor time of the loop's processes.
    fn work(&self) -> LoopWork {
        let healths = self.boards.iter().map(BoardReader::health);
        let cpu_s = healths.clone().map(|health| threads_cpu_s(health.pid)).sum();
        LoopWork {
            ticks: healths.last().map_or(0.0, |health| health.ticks as f64),
            cpu_s,
        }
    }

    fn stop(mut self) -> Result<(), Exit> {
        let stopped = command(&self.caraware, &self.place).args(["stop", NAME]).status();
        stopped.map_err(|error| Exit::io("start", &self.caraware, &error))?;
        let status = self.child.wait();
        status.map_err(|error| Exit::io("wait for", &self.caraware, &error))?;
        Ok(())
    }
}

/// What the loop has done at a moment.
#[derive(Debug, Clone, Copy)]
struct LoopWork {
    ticks: f64,
    cpu_s: f64,
}

/// Processor time of all threads of a process, seconds. The kernel counts it in nanoseconds here.
fn threads_cpu_s(pid: i32) -> f64 {
    let threads = fs::read_dir(format!("/proc/{pid}/task"))
        .into_iter()
        .flatten()
        .flatten();
    let nanoseconds = threads.filter_map(|thread| {
        let text = fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<f64>().ok()
    });
    nanoseconds.sum::<f64>() * 1e-9
}

/// A pause that nothing shortens.
fn pause(time: Duration) {
    let begun = Instant::now();
    while let Some(left) = time.checked_sub(begun.elapsed()).filter(|left| !left.is_zero()) {
        std::thread::park_timeout(left);
    }
}

/// A silent command whose runs and registry are in `place`.
fn command(program: &Path, place: &Path) -> Command {
    let mut command = Command::new(program);
    command
        .current_dir(place)
        .env("CARAWARE_RUNTIME_DIR", place.join("r"))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    command
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::float_cmp, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn the_interval_of_a_median_is_that_of_the_sign_test() {
        let of = |count: i32| {
            let interval = MedianInterval::of(&(1..=count).rev().map(f64::from).collect::<Vec<_>>()).unwrap();
            [interval.low, interval.median, interval.high]
        };
        // Conover's table: 95 % and more between the 2nd and the 9th of ten, the 10th and the 21st of thirty.
        assert_eq!(of(10), [2.0, 5.5, 9.0]);
        assert_eq!(of(30), [10.0, 15.5, 21.0]);
        // With fewer than six values even the extremes are no interval of 95 %.
        assert_eq!(of(3), [1.0, 2.0, 3.0]);
        assert_eq!(MedianInterval::of(&[]), None);
    }

    #[test]
    fn a_ratio_is_that_of_the_block() {
        let cost = |wall_s_per_tick: f64| SegmentCost {
            wall_s_per_tick,
            cpu_s_per_tick: 2.0 * wall_s_per_tick,
        };
        let mut ratios = SegmentRatios::default();
        ratios.add([cost(1.0), cost(3.0)], cost(4.0));
        assert_eq!(
            (ratios.wall[0], ratios.cpu[0], ratios.null_wall[0]),
            (2.0, 2.0, 1.0 / 3.0)
        );
    }
}
