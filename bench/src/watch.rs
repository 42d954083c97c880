//! Measures what a recorder beside a live run costs it: two equal runs go side by side, and a recorder watches now the one, now the other.
//!
//! The time of a tick changes by a factor of three with the traffic lights, so only the same ticks can be compared: one run makes them
//! with a recorder, the other run makes them without. In the next stretch of ticks the roles change. The geometric mean of both ratios
//! leaves out that the cores of one run are faster. Stretches are short, because the speed of a core changes from second to second
//! where others use the machine too.
//!
//! A recorder also keeps a core busy, as any program does. In some stretches a process that only counts takes its place, and shows what
//! that alone costs on this machine: where cores share their clock, power or hardware threads, it is not nothing.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use caraware::{failure::Exit, generate::GeneratedCity, install, install::Install};
use ipc_schema::{ports::BoardReader, process::Process, run::RunFile, services};
use rustix::process::{Pid, Signal};

use super::{BenchOptions, BenchReport, ReportTable, cores::BenchCores, sides::BenchDirectory};
use crate::{quiet::QuietPlace, target::signal};

/// Names of the runs.
const NAMES: [&str; 2] = ["one", "other"];
/// Time for a run to start, and for a tick.
const DEADLINE: Duration = Duration::from_secs(120);
/// The processes whose work the ticks are. Each has one thread that works.
const LOOP: [Process; 3] = [Process::TrafficBridge, Process::SimCore, Process::SensorDaemon];
/// Cores beside those of the loops: so many that a recorder compresses on two threads.
const OTHER_CORES: usize = 6;
/// Simulated time of the city, seconds: more than a measurement takes, because the runs are stopped at its end.
const CITY_S: f64 = 21_600.0;
/// Time between two looks at the runs: a small part of a tick.
const POLL: Duration = Duration::from_micros(200);
/// Most that watching may cost.
const MOST: f64 = 1.01;

/// How much is measured.
struct WatchSize {
    vehicles: u32,
    /// Time for pairs of stretches; there is one at least of each kind.
    time: Duration,
    /// `run.real_time_factor`: 0 is as fast as the runs can.
    real_time_factor: u32,
    /// Ticks of a stretch.
    stretch: u64,
    /// Ticks at its beginning that are not measured, because a recorder comes or goes.
    settling: u64,
    /// Most ticks by which the first or last look at a stretch may be late. A stretch that is looked at later is left out.
    tolerance: u64,
    /// What is beside a run in pairs of stretches that follow each other, from the beginning again and again.
    cycle: &'static [Company],
}

const SIZE: WatchSize = WatchSize {
    vehicles: 1000,
    time: Duration::from_secs(60),
    real_time_factor: 0,
    // Ratios of 200 ticks scatter as much as those of 40, because the speed of a core changes from second to second.
    stretch: 70,
    settling: 30,
    tolerance: 1,
    cycle: &[
        Company::Recorder,
        Company::Counter,
        Company::Recorder,
        Company::Counter,
        Company::Recorder,
        Company::Nothing,
    ],
};
// Not at full speed: beside other work a recorder starts more slowly than such a small run makes a stretch.
const QUICK: WatchSize = WatchSize {
    vehicles: 60,
    time: Duration::ZERO,
    real_time_factor: 100,
    stretch: 2400,
    settling: 1000,
    tolerance: 1300,
    cycle: &Company::ALL,
};

/// What is beside a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Company {
    /// `caraware record`, which watches the run.
    Recorder,
    /// A process that only counts: it keeps a core busy, and reads no memory.
    Counter,
    /// Nothing, which shows how far equal stretches differ.
    Nothing,
}

impl Company {
    const ALL: [Self; 3] = [Self::Recorder, Self::Counter, Self::Nothing];

    fn name(self) -> &'static str {
        match self {
            Self::Recorder => "watched",
            Self::Counter => "beside a process that counts",
            Self::Nothing => "alone beside alone",
        }
    }
}

/// In which stretches of ticks which run has company. Two stretches in a row are a pair: one run has its turn in the first, the other run
/// in the second.
#[derive(Debug, Clone, Copy)]
struct WatchPlan {
    seed: u64,
    /// The company in one pair after the other. The last has none, so that a recorder has ended before the order of the runs changes.
    cycle: &'static [Company],
}

impl WatchPlan {
    fn company_of(self, pair: u64) -> Company {
        #[expect(clippy::cast_possible_truncation, reason = "below the length of the cycle")]
        let at = (pair % self.cycle.len() as u64) as usize;
        self.cycle[at]
    }

    /// The run that has its turn in the first stretch of a pair: at random, but the same for a cycle, so that a recorder has a stretch to
    /// end before the run has its next.
    fn first_run(self, pair: u64) -> usize {
        let cycle = pair / self.cycle.len() as u64;
        usize::from(fastrand::Rng::with_seed(self.seed.wrapping_add(cycle)).bool())
    }

    /// What is beside a run in a stretch.
    fn company(self, run: usize, stretch: u64) -> Company {
        let pair = stretch / 2;
        let turn = match stretch % 2 {
            0 => self.first_run(pair),
            _ => 1 - self.first_run(pair),
        };
        match run == turn {
            true => self.company_of(pair),
            false => Company::Nothing,
        }
    }
}

/// What can be compared: the wall time, and the processor times of the loop and of each of its processes.
const COSTS: [&str; 2 + LOOP.len()] = [
    "wall time",
    "processor time",
    "processor time of `traffic-bridge`",
    "processor time of `sim-core`",
    "processor time of `sensor-daemon`",
];

/// What a run had paid at a moment, or pays for each tick of a stretch; seconds, by [`COSTS`].
type Costs = [f64; COSTS.len()];

/// Runs a generated city twice at once, and records one of the runs for some of the time.
///
/// # Errors
/// A run cannot be started, or ends by itself.
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
    let plan = WatchPlan {
        seed: options.seed,
        cycle: size.cycle,
    };
    let cores = BenchCores::of_machine(NAMES.len() * LOOP.len(), OTHER_CORES)?;
    let mut runs = LiveRuns::start(options, &size, &place, cores.as_ref())?;
    let begin = Instant::now();
    let mut ratios = PairRatios::default();
    while ratios.fewest() == 0 || begin.elapsed() < size.time {
        if runs.look(&size, plan)? {
            ratios = PairRatios::measured(plan, &runs.costs());
        }
        std::thread::park_timeout(POLL);
    }
    let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let received = runs.stop()?;
    if let Some(cores) = &cores {
        cores.release()?;
    }
    let mut report = report(&size, &ratios, received, load.trim(), cores.is_some())?;
    report.command = format!("caraware bench watch --minutes {}", options.minutes);
    Ok(report)
}

fn report(
    size: &WatchSize,
    ratios: &PairRatios,
    received: Received,
    load: &str,
    is_pinned: bool,
) -> Result<BenchReport, Exit> {
    let pace = match size.real_time_factor {
        0 => "at full speed".to_owned(),
        factor => format!("at {factor} × real time"),
    };
    let message_mb_per_s = received.message_mb / received.wall_s.max(1e-9);
    let mut report = BenchReport::new(
        "watch",
        "A recorder that watches",
        format!(
            "{} vehicles on a generated city, `caraware simulate` {pace} without viewers, two equal runs side by side. Stretches of {} ticks \
             are compared with the same ticks of the other run, without the first {}, in which a recorder comes or goes. A pair of stretches \
             has `caraware record` beside the one run and then beside the other, and a ratio is the geometric mean of both. So have {} \
             pairs; {} pairs have a process that only counts, so that one more core is busy; and {} have neither. Intervals are those of \
             the median, 95 % at least, from the order of the ratios alone. Processor time is that of `traffic-bridge`, `sim-core` and \
             `sensor-daemon`. The recorders received {message_mb_per_s:.0} MB/s and missed {:.0} ticks. At the end one run was {} ticks \
             ahead, and the load of the machine was {load}.",
            size.vehicles,
            size.stretch,
            size.settling,
            ratios.of(Company::Recorder).len(),
            ratios.of(Company::Counter).len(),
            ratios.of(Company::Nothing).len(),
            received.missed_ticks,
            received.ticks_apart,
        ),
    );
    let mut table = ReportTable::new("of alone", &["what", "median", "95 % interval"]);
    let mut watched = None;
    for company in Company::ALL {
        for (cost, name) in COSTS.into_iter().enumerate() {
            let values: Vec<f64> = ratios.of(company).iter().map(|costs| costs[cost]).collect();
            let Some(MedianInterval { median, low, high }) = MedianInterval::of(&values) else {
                return Err(Exit::run("no stretch was measured", ""));
            };
            if cost == 0 && company == Company::Recorder {
                watched = Some(low);
            }
            let name = format!("{name} of a tick, {}", company.name());
            table.row([name.clone(), format!("{median:.4}"), format!("{low:.4}–{high:.4}")]);
            for (part, value) in [("median", median), ("low", low), ("high", high)] {
                report.figure(format!("{name}, {part}"), value);
            }
        }
    }
    report.tables.push(table);
    report.figure("ticks missed", received.missed_ticks);
    report.figure("MB/s of messages", message_mb_per_s);
    if is_pinned {
        report.text += " Each process of the loops had a core of its own.";
        let dear = watched.filter(|low| *low > MOST);
        report
            .faults
            .extend(dear.map(|low| format!("watching costs more than 1 %: {low:.4} at least")));
    } else {
        report.text += &format!(
            " With fewer than {} cores the runs and the recorder take processor time from each other: nothing follows from the wall times.",
            NAMES.len() * LOOP.len() + OTHER_CORES
        );
    }
    Ok(report)
}

/// Ratios of the pairs that both runs have measured: the run that has its turn to the other.
#[derive(Debug, Default)]
struct PairRatios(BTreeMap<Company, Vec<Costs>>);

impl PairRatios {
    /// Ratios of the costs of both runs, by stretch.
    fn measured(plan: WatchPlan, costs: &[&BTreeMap<u64, Costs>; 2]) -> Self {
        let mut ratios = Self::default();
        let stretches = costs[0].keys().filter(|stretch| stretch.is_multiple_of(2));
        for pair in stretches.map(|stretch| stretch / 2) {
            let run = plan.first_run(pair);
            let at = |run: usize, half: u64| costs[run].get(&(2 * pair + half));
            let (Some(a), Some(b), Some(c), Some(d)) = (at(run, 0), at(1 - run, 0), at(1 - run, 1), at(run, 1)) else {
                continue;
            };
            let crossed = std::array::from_fn(|cost| (a[cost] / b[cost] * (c[cost] / d[cost])).sqrt());
            ratios.0.entry(plan.company_of(pair)).or_default().push(crossed);
        }
        ratios
    }

    fn of(&self, company: Company) -> &[Costs] {
        self.0.get(&company).map_or(&[], Vec::as_slice)
    }

    /// Pairs of the company that has the fewest.
    fn fewest(&self) -> usize {
        Company::ALL
            .map(|company| self.of(company).len())
            .into_iter()
            .min()
            .unwrap_or(0)
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

/// The runs that are measured.
struct LiveRuns {
    caraware: PathBuf,
    place: QuietPlace,
    runs: Vec<LiveRun>,
}

/// What the recorders have received, and how far the runs were apart at the end.
#[derive(Debug, Clone, Copy)]
struct Received {
    missed_ticks: f64,
    message_mb: f64,
    wall_s: f64,
    ticks_apart: u64,
}

impl LiveRuns {
    fn start(
        options: &BenchOptions,
        size: &WatchSize,
        place: &BenchDirectory,
        cores: Option<&BenchCores>,
    ) -> Result<Self, Exit> {
        let city = GeneratedCity::of(size.vehicles, CITY_S, 0.1, 1);
        let sumocfg = city.write(&Install::find()?, &place.path().join("city"))?;
        let mut pair = Self {
            caraware: install::program(&options.bin, "caraware")?,
            place: QuietPlace::new(place.path()),
            runs: Vec::new(),
        };
        // What is started from here on is not on the cores of the loops.
        cores.map_or(Ok(()), BenchCores::keep_off)?;
        for (index, name) in NAMES.into_iter().enumerate() {
            let run = LiveRun::start(&pair.caraware, &pair.place, name, &sumocfg, size.real_time_factor)?;
            if let Some(cores) = cores {
                let pids = run.boards.iter().map(|board| board.health().pid);
                cores.pin(index * LOOP.len(), pids)?;
            }
            pair.runs.push(run);
        }
        Ok(pair)
    }

    /// Looks at the runs, and lets their company come and go. True if a stretch has been measured.
    fn look(&mut self, size: &WatchSize, plan: WatchPlan) -> Result<bool, Exit> {
        let mut is_measured = false;
        for (index, run) in self.runs.iter_mut().enumerate() {
            is_measured |= run.look(size, |stretch| plan.company(index, stretch))?;
        }
        Ok(is_measured)
    }

    /// What each of the two runs has paid for a tick of each stretch.
    fn costs(&self) -> [&BTreeMap<u64, Costs>; 2] {
        [0, 1].map(|run: usize| &self.runs[run].costs)
    }

    fn stop(mut self) -> Result<Received, Exit> {
        let ticks = [0, 1].map(|run: usize| self.runs[run].tick());
        for run in &mut self.runs {
            run.end_recorder()?;
            let stopped = self.place.command(&self.caraware)?.args(["stop", run.name]).status();
            stopped.map_err(|error| Exit::io("start", &self.caraware, &error))?;
            let status = run.child.wait();
            status.map_err(|error| Exit::io("wait for", &self.caraware, &error))?;
        }
        let sum = |part: fn(&LiveRun) -> f64| self.runs.iter().map(part).sum();
        Ok(Received {
            missed_ticks: sum(|run| run.missed_ticks),
            message_mb: sum(|run| run.message_mb),
            wall_s: sum(|run| run.recorded_s),
            ticks_apart: ticks[0].abs_diff(ticks[1]),
        })
    }
}

/// One of the runs. Dropping it ends it.
struct LiveRun {
    name: &'static str,
    caraware: PathBuf,
    place: QuietPlace,
    child: Child,
    /// Boards of [`LOOP`].
    boards: Vec<BoardReader>,
    /// The stretch that is under way.
    stretch: Option<u64>,
    /// The tick that its measurement began with, and what the run had paid then; `None` before that, and in a stretch that is left out.
    begun: Option<(u64, Costs)>,
    costs: BTreeMap<u64, Costs>,
    newest_tick: (u64, Instant),
    recorder: Option<(Child, Instant)>,
    counter: Option<Counter>,
    /// A recorder that was asked to end.
    ending: Option<Child>,
    missed_ticks: f64,
    message_mb: f64,
    recorded_s: f64,
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        let recorder = self.recorder.as_mut().map(|(recorder, _)| recorder);
        for child in recorder.into_iter().chain(&mut self.ending).chain([&mut self.child]) {
            if matches!(child.try_wait(), Ok(None)) {
                signal(Pid::from_child(child), Signal::TERM);
                let _ = child.wait();
            }
        }
    }
}

impl LiveRun {
    /// Starts a run and waits for its first tick.
    fn start(
        caraware: &Path,
        place: &QuietPlace,
        name: &'static str,
        sumocfg: &Path,
        real_time_factor: u32,
    ) -> Result<Self, Exit> {
        let pace = format!("run.real_time_factor={real_time_factor}");
        let settings = [
            &pace,
            "fanout.enabled=false",
            "map.origin_latitude_deg=52.0",
            "map.origin_longitude_deg=10.0",
        ];
        let child = place
            .command(caraware)?
            .arg("simulate")
            .arg(sumocfg)
            .args(["--quiet", "--name", name])
            .args(settings.into_iter().flat_map(|setting| ["--set", setting]))
            .spawn()
            .map_err(|error| Exit::io("start", caraware, &error))?;
        let mut run = Self {
            name,
            caraware: caraware.to_owned(),
            place: place.clone(),
            child,
            boards: Vec::new(),
            stretch: None,
            begun: None,
            costs: BTreeMap::new(),
            newest_tick: (0, Instant::now()),
            recorder: None,
            counter: None,
            ending: None,
            missed_ticks: 0.0,
            message_mb: 0.0,
            recorded_s: 0.0,
        };
        let run_file = place.directory().join("runs").join(name).join("run.json");
        while run.tick() == 0 {
            run.check_alive()?;
            if run.boards.is_empty()
                && let Ok(file) = RunFile::read(&run_file)
                && let Ok(node) = services::node(&file.shared_memory)
            {
                let boards = LOOP.map(|process| BoardReader::open(&node, &file, 0, process));
                run.boards = boards.into_iter().collect::<Result<_, _>>().unwrap_or_default();
            }
            std::thread::park_timeout(Duration::from_millis(5));
        }
        Ok(run)
    }

    /// Ticks that are sensed.
    fn tick(&self) -> u64 {
        self.boards.last().map_or(0, |board| board.health().ticks)
    }

    fn check_alive(&mut self) -> Result<(), Exit> {
        match self.child.try_wait() {
            Ok(None) if self.newest_tick.1.elapsed() < DEADLINE => Ok(()),
            Ok(None) => Err(Exit::run(
                format!("a run made no tick in {DEADLINE:.0?}"),
                "see its logs",
            )),
            Ok(Some(status)) => Err(self.place.failure(
                &format!("a run ended by itself with {status}"),
                "its city lasts six simulated hours: give a smaller measurement to a faster machine",
            )),
            Err(error) => Err(Exit::io("wait for", &self.caraware, &error)),
        }
    }

    /// Looks at the newest tick. Measures stretches, and lets company come and go where stretches begin. True if a stretch has been measured.
    fn look(&mut self, size: &WatchSize, company: impl Fn(u64) -> Company) -> Result<bool, Exit> {
        let tick = self.tick();
        if tick == self.newest_tick.0 {
            self.check_alive()?;
            return Ok(false);
        }
        self.newest_tick = (tick, Instant::now());
        let (stretch, ticks_in) = (tick / size.stretch, tick % size.stretch);
        let is_on_time = |from: u64| (from..=from + size.tolerance).contains(&ticks_in);
        let mut is_measured = false;
        if self.stretch != Some(stretch) {
            if let (Some(before), Some((first_tick, begin))) = (self.stretch, self.begun.take())
                && before + 1 == stretch
                && is_on_time(0)
            {
                let (ticks, end) = ((tick - first_tick) as f64, self.paid());
                let costs = std::array::from_fn(|cost| (end[cost] - begin[cost]) / ticks);
                self.costs.insert(before, costs);
                is_measured = true;
            }
            self.stretch = Some(stretch);
            self.ask_recorder_to_end();
            self.counter = None;
            match company(stretch) {
                Company::Recorder => self.start_recorder()?,
                Company::Counter => self.counter = Some(Counter::start()?),
                Company::Nothing => {}
            }
        } else if self.begun.is_none() && is_on_time(size.settling) {
            // Its first bytes are there once it has attached to the run.
            let is_recorded = fs::metadata(self.recording()).is_ok_and(|file| file.len() > 0);
            if self.recorder.is_none() || is_recorded {
                self.begun = Some((tick, self.paid()));
            }
        }
        Ok(is_measured)
    }

    /// What the run has paid so far.
    fn paid(&self) -> Costs {
        let healths = self.boards.iter().map(BoardReader::health);
        let written_ns = healths.clone().last().map_or(0, |health| health.written_ns);
        let cpu_s: Vec<f64> = healths.map(|health| threads_cpu_s(health.pid)).collect();
        let mut paid = [0.0; COSTS.len()];
        paid[0] = written_ns as f64 * 1e-9;
        paid[1] = cpu_s.iter().sum();
        paid[2..].copy_from_slice(&cpu_s);
        paid
    }

    fn recording(&self) -> PathBuf {
        self.place.directory().join(format!("{}.mcap", self.name))
    }

    fn start_recorder(&mut self) -> Result<(), Exit> {
        self.end_recorder()?;
        let recorder = self
            .place
            .command(&self.caraware)?
            .args(["record", self.name, "--output"])
            .arg(self.recording())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| Exit::io("start", &self.caraware, &error))?;
        self.recorder = Some((recorder, Instant::now()));
        Ok(())
    }

    fn ask_recorder_to_end(&mut self) {
        if let Some((recorder, begun)) = self.recorder.take() {
            signal(Pid::from_child(&recorder), Signal::INT);
            self.recorded_s += begun.elapsed().as_secs_f64();
            self.ending = Some(recorder);
        }
    }

    /// Waits for the end of a recorder, counts what it has received, and removes its file.
    fn end_recorder(&mut self) -> Result<(), Exit> {
        self.ask_recorder_to_end();
        let Some(recorder) = self.ending.take() else {
            return Ok(());
        };
        let output = recorder.wait_with_output();
        let output = output.map_err(|error| Exit::io("wait for", &self.caraware, &error))?;
        let file = self.recording();
        if !file.exists() {
            // The stretch was over before it had begun.
            return Ok(());
        }
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
        fs::remove_file(&file).map_err(|error| Exit::io("remove", &file, &error))
    }
}

/// A process that only counts. Dropping it ends it.
struct Counter(Child);

impl Counter {
    /// It looks now and then whether this program is there, and ends if that was killed.
    const PROGRAM: &str =
        "while kill -0 $PPID 2>/dev/null; do i=0; while [ $i -lt 1000000 ]; do i=$((i + 1)); done; done";

    fn start() -> Result<Self, Exit> {
        let shell = Path::new("/bin/sh");
        let child = Command::new(shell)
            .args(["-c", Self::PROGRAM])
            .stdin(Stdio::null())
            .spawn();
        child.map(Self).map_err(|error| Exit::io("start", shell, &error))
    }
}

impl Drop for Counter {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
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

    /// Ticks differ in work, the second run has faster cores, watching costs 5 % and a busy core 2 %.
    #[test]
    fn neither_the_work_nor_the_cores_are_in_the_ratios() {
        let plan = WatchPlan {
            seed: 1,
            cycle: SIZE.cycle,
        };
        let cost = |run: usize, stretch: u64| {
            let work = [3.0, 7.0, 2.0, 5.0][stretch as usize % 4];
            let cores = [1.6, 1.0][run];
            let company = [1.05, 1.02, 1.0][plan.company(run, stretch) as usize];
            [work * cores * company; COSTS.len()]
        };
        let costs = [0, 1].map(|run: usize| (0..84).map(|stretch| (stretch, cost(run, stretch))).collect());
        let ratios = PairRatios::measured(plan, &costs.each_ref());
        let expected = [(1.05, 21), (1.02, 14), (1.0, 7)];
        for (company, (expected, pairs)) in Company::ALL.into_iter().zip(expected) {
            let values = ratios.of(company).as_flattened();
            assert_eq!(values.len(), pairs * COSTS.len());
            assert!(
                values.iter().all(|ratio| (ratio - expected).abs() < 1e-12),
                "{values:?}"
            );
        }
        // Either run is the first, and a pair that one run lacks gives nothing.
        let firsts: Vec<usize> = (0..42).map(|pair| plan.first_run(pair)).collect();
        assert!(firsts.contains(&0) && firsts.contains(&1), "{firsts:?}");
        let [whole, mut short]: [BTreeMap<u64, Costs>; 2] = costs;
        short.remove(&11);
        assert_eq!(PairRatios::measured(plan, &[&whole, &short]).fewest(), 6);
    }
}
