//! Watches one long run with viewers and handovers: does the memory or the number of handles of a process grow, do the logs?

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::Child,
    time::{Duration, Instant},
};

use caraware::{failure::Exit, install};
use rustix::process::{Pid, Signal};
use serde_json::Value;

use super::{BenchOptions, BenchReport, MedianSpread, ReportTable, free_port, sides::BenchDirectory};
use crate::{
    quiet::QuietPlace,
    target::{CountedMemory, Target, resources, signal},
};

const NAME: &str = "soak";
/// A run without end in short episodes, with messages between vehicles, at full speed.
const SETTINGS: [&str; 6] = [
    "v2x.share=0.5",
    "episode.ticks=600",
    "episode.training_episodes=1000000",
    "episode.evaluation_interval=20",
    "trainer.horizon=4096",
    "trainer.checkpoint_interval=10",
];
const VIEWERS: usize = 2;
/// Shortest watch whose growth is judged: a shorter one sees what a process needs at first.
const JUDGED_H: f64 = 0.5;
/// Part of the watch that is not counted, while the process fills what it keeps.
const FILLING: f64 = 0.2;
/// Largest growth of a process that is no fault, MiB per hour and handles per hour.
const MOST_GROWTH: (f64, f64) = (1.0, 2.0);
/// Time from one handover to the next. A trainer needs minutes until it has all that it keeps: a growth of 1 MiB an hour shows only in a
/// life that is much longer.
const HANDOVER_INTERVAL: Duration = Duration::from_secs(2400);
const DEADLINE: Duration = Duration::from_secs(300);

/// A process, or all of its kind, at one moment.
#[derive(Debug, Clone)]
struct SoakSample {
    at_h: f64,
    private_mib: f64,
    handles: f64,
    pids: Vec<Pid>,
}

/// Values in the order of their hours, of one process after the other.
type Lives = Vec<Vec<(f64, f64)>>;

/// The values of `samples`, of each process for itself: a trainer that takes over begins with less memory than the one before had.
fn lives(samples: &[SoakSample], value: impl Fn(&SoakSample) -> f64) -> Lives {
    let of_one = samples.chunk_by(|one, next| one.pids == next.pids);
    of_one
        .map(|samples| samples.iter().map(|sample| (sample.at_h, value(sample))).collect())
        .collect()
}

/// Watches a run for as long as `options` say.
///
/// # Errors
/// The run cannot be started, ends by itself, or cannot be stopped. What grows is in the report's faults.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let (time, interval, handover_interval) = match options.quick {
        true => (Duration::from_secs(30), Duration::from_secs(1), Duration::from_secs(12)),
        false => (
            Duration::from_secs(60 * u64::from(options.minutes)),
            Duration::from_secs(10),
            HANDOVER_INTERVAL,
        ),
    };
    // Of this process and all that it starts. With huge pages Linux turns one page of 4 KiB that a process has touched into 2 MiB, at a
    // moment of its own.
    rustix::thread::disable_transparent_huge_pages(true)
        .map_err(|error| Exit::run(format!("cannot do without huge pages: {error}"), ""))?;
    let directory = BenchDirectory::new(NAME)?;
    let mut run = SoakRun::start(options, directory.path())?;
    run.wait_for_update()?;
    let begun = Instant::now();
    let mut samples: BTreeMap<Target, Vec<SoakSample>> = BTreeMap::new();
    let mut logs: Vec<(f64, f64)> = Vec::new();
    let (mut handover_due, mut refused) = (handover_interval, 0);
    while begun.elapsed() < time {
        run.check_alive()?;
        let at_h = begun.elapsed().as_secs_f64() / 3600.0;
        for target in Target::ALL {
            samples.entry(target).or_default().extend(run.sample(target, at_h));
        }
        logs.push((at_h, size_mib(&run.directory, &["checkpoints"])));
        if begun.elapsed() >= handover_due {
            refused += u32::from(!run.hand_over()?);
            handover_due += handover_interval;
        }
        std::thread::park_timeout(interval);
    }
    let (handovers, final_report) = (run.handovers, run.stop()?);
    let mut report = BenchReport::new(
        NAME,
        "Memory, handles and logs of a long run",
        format!(
            "The town with messages between vehicles, at full speed without end, {VIEWERS} viewers that count frames, {handovers} handovers \
             after an update or at once in turn ({refused} more were refused), watched for {:.1} h. The memory is that \
             which belongs to a process alone (RssAnon), without huge pages, of which Linux makes one wherever a process has touched a page of \
             a region that asks for them. Growth is the median of the slopes between all pairs of samples of one process, \
             those of the first {:.0} % of its life left out; first and last are medians of a tenth of the samples.",
            time.as_secs_f64() / 3600.0,
            100.0 * FILLING
        ),
    );
    report.command = format!("caraware bench soak --minutes {}", options.minutes);
    report.figure("ticks", final_report["ticks"].as_f64().unwrap_or(f64::NAN));
    report.figure("handovers", f64::from(handovers));
    report.figure("refused handovers", f64::from(refused));
    add_growth(&mut report, &samples, &logs, time.as_secs_f64() / 3600.0);
    for key in ["lost_ticks", "duplicated_ticks"] {
        if final_report[key] != 0 {
            report.faults.push(format!("{key} is {}", final_report[key]));
        }
    }
    Ok(report)
}

/// Adds the growth of each process and of the logs, and a fault for what grows too fast in a watch that is long enough.
fn add_growth(
    report: &mut BenchReport,
    samples: &BTreeMap<Target, Vec<SoakSample>>,
    logs: &[(f64, f64)],
    watched_h: f64,
) {
    let mut table = ReportTable::new(
        "growth",
        &[
            "process",
            "memory at first (MiB)",
            "at last",
            "growth (MiB/h)",
            "handles at first",
            "at last",
            "growth (1/h)",
        ],
    );
    for (target, samples) in samples.iter().filter(|(_, samples)| !samples.is_empty()) {
        let memory = Growth::of(&lives(samples, |sample| sample.private_mib));
        let handles = Growth::of(&lives(samples, |sample| sample.handles));
        table.row([
            target.name().into(),
            format!("{:.1}", memory.first),
            format!("{:.1}", memory.last),
            format!("{:+.2}", memory.per_h),
            format!("{:.0}", handles.first),
            format!("{:.0}", handles.last),
            format!("{:+.2}", handles.per_h),
        ]);
        report.figure(format!("{}, MiB/h", target.name()), memory.per_h);
        report.figure(format!("{}, handles/h", target.name()), handles.per_h);
        if watched_h >= JUDGED_H && (memory.per_h > MOST_GROWTH.0 || handles.per_h > MOST_GROWTH.1) {
            report.faults.push(format!(
                "{} grows by {:.2} MiB and {:.2} handles an hour",
                target.name(),
                memory.per_h,
                handles.per_h
            ));
        }
    }
    let files = Growth::of(&[logs.to_vec()]);
    table.row([
        "files of the run without checkpoints".into(),
        format!("{:.1}", files.first),
        format!("{:.1}", files.last),
        format!("{:+.2}", files.per_h),
        String::new(),
        String::new(),
        String::new(),
    ]);
    report.figure("files of the run without checkpoints, MiB/h", files.per_h);
    report.tables.push(table);
}

/// How a value changes over a watch.
#[derive(Debug, Clone, Copy)]
struct Growth {
    /// Medians of the first and of the last tenth of what is counted.
    first: f64,
    last: f64,
    /// Slope per hour: the median of the slopes between all pairs of samples (Theil 1950, Sen 1968).
    ///
    /// A handover fills the journal for a minute. The line of least squares follows such peaks, and rises or falls with where they happen
    /// to stand in the watch; the median is not moved by them while they are fewer than 29 % of the samples.
    per_h: f64,
}

impl Growth {
    /// The growth of a value, without those of the filling of each life.
    fn of(lives: &[Vec<(f64, f64)>]) -> Self {
        let counted: Lives = lives.iter().map(|life| without_filling(life)).collect();
        let slopes = counted.iter().flat_map(|life| {
            life.iter().enumerate().flat_map(|(n, (begin_h, begin))| {
                let later = life[n + 1..].iter().filter(move |(end_h, _)| end_h > begin_h);
                later.map(move |(end_h, end)| (end - begin) / (end_h - begin_h))
            })
        });
        let values: Vec<f64> = counted.iter().flatten().map(|(_, value)| *value).collect();
        let tenth = values.len().div_ceil(10);
        Self {
            first: median(values.iter().take(tenth).copied()).unwrap_or(f64::NAN),
            last: median(values.iter().rev().take(tenth).copied()).unwrap_or(f64::NAN),
            per_h: median(slopes).unwrap_or(0.0),
        }
    }
}

/// What a life has been after its first [`FILLING`].
fn without_filling(life: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let (begin_h, end_h) = (
        life.first().map_or(0.0, |(at_h, _)| *at_h),
        life.last().map_or(0.0, |(at_h, _)| *at_h),
    );
    let filled_h = begin_h + FILLING * (end_h - begin_h);
    life.iter().copied().filter(|(at_h, _)| *at_h >= filled_h).collect()
}

/// `None` if there is no value.
fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    MedianSpread::of(values).ok().map(|spread| spread.median)
}

/// The run that is watched, and its viewers. Dropping it ends them.
struct SoakRun {
    caraware: PathBuf,
    place: QuietPlace,
    directory: PathBuf,
    child: Child,
    viewers: Vec<Child>,
    handovers: u32,
}

impl Drop for SoakRun {
    fn drop(&mut self) {
        for viewer in &mut self.viewers {
            // A viewer that has ended cannot be killed.
            let _ = viewer.kill();
            let _ = viewer.wait();
        }
        if matches!(self.child.try_wait(), Ok(None)) {
            signal(Pid::from_child(&self.child), Signal::TERM);
            let _ = self.child.wait();
        }
    }
}

impl SoakRun {
    fn start(options: &BenchOptions, place: &Path) -> Result<Self, Exit> {
        let caraware = install::program(&options.bin, "caraware")?;
        let watch = install::program(&options.bin, "fanout-watch")?;
        let port = free_port()?;
        let fanout = format!("fanout.listen=tcp/127.0.0.1:{port}");
        let settings = SETTINGS.into_iter().chain([fanout.as_str()]);
        let arguments = ["train", "town", "--quiet", "--name", NAME]
            .into_iter()
            .chain(settings.flat_map(|setting| ["--set", setting]));
        let quiet = QuietPlace::new(place);
        let start = |program: &Path, arguments: &[&str]| {
            let child = quiet.command(program)?.args(arguments).spawn();
            child.map_err(|error| Exit::io("start", program, &error))
        };
        let mut run = Self {
            child: start(&caraware, &arguments.collect::<Vec<_>>())?,
            directory: place.join("runs").join(NAME),
            place: quiet.clone(),
            caraware,
            viewers: Vec::new(),
            handovers: 0,
        };
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let seconds = (3600 + 60 * options.minutes).to_string();
        for _ in 0..VIEWERS {
            run.viewers
                .push(start(&watch, &[&endpoint, NAME, "--seconds", &seconds])?);
        }
        Ok(run)
    }

    /// Waits for the first update: before it the trainer has not allocated what it needs.
    fn wait_for_update(&mut self) -> Result<(), Exit> {
        let begun = Instant::now();
        let course = self.directory.join("learning.jsonl");
        while fs::metadata(&course).map_or(0, |file| file.len()) == 0 {
            self.check_alive()?;
            if begun.elapsed() > DEADLINE {
                return Err(Exit::run("the run has not learnt anything", "see its logs"));
            }
            std::thread::park_timeout(Duration::from_millis(100));
        }
        Ok(())
    }

    fn check_alive(&mut self) -> Result<(), Exit> {
        match self.child.try_wait() {
            Ok(None) => Ok(()),
            Ok(Some(status)) => Err(self
                .place
                .failure(&format!("the run ended by itself with {status}"), "")),
            Err(error) => Err(Exit::io("wait for", &self.caraware, &error)),
        }
    }

    /// All processes of a kind; `None` if there is none now.
    fn sample(&self, target: Target, at_h: f64) -> Option<SoakSample> {
        let pids = match target {
            Target::Supervisor => vec![Pid::from_child(&self.child)],
            _ => target.processes(&self.directory),
        };
        let (private_mib, handles) = pids
            .iter()
            .filter_map(|pid| resources(*pid, CountedMemory::Private))
            .reduce(|sum, of_one| (sum.0 + of_one.0, sum.1 + of_one.1))?;
        Some(SoakSample {
            at_h,
            private_mib,
            handles,
            pids,
        })
    }

    /// Replaces the trainer, after an update or at once in turn. Returns false if that is refused, as it is if the successor is not
    /// ready in time on a machine with other work.
    fn hand_over(&mut self) -> Result<bool, Exit> {
        let now = self.handovers % 2 == 1;
        let status = self
            .place
            .command(&self.caraware)?
            .args(["handover", NAME])
            .args(now.then_some("--now"))
            .status();
        let status = status.map_err(|error| Exit::io("start", &self.caraware, &error))?;
        self.handovers += u32::from(status.success());
        Ok(status.success())
    }

    /// Stops the run, and reads its report.
    fn stop(mut self) -> Result<Value, Exit> {
        let stopped = self.place.command(&self.caraware)?.args(["stop", NAME]).status();
        stopped.map_err(|error| Exit::io("start", &self.caraware, &error))?;
        let status = self.child.wait();
        status.map_err(|error| Exit::io("wait for", &self.caraware, &error))?;
        let path = self.directory.join("report.json");
        let text = fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
        serde_json::from_str(&text).map_err(|error| Exit::run(format!("{}: {error}", path.display()), ""))
    }
}

/// Size of all files below a directory (MiB), without some of its entries.
fn size_mib(directory: &Path, without: &[&str]) -> f64 {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let counted = entries.filter(|entry| !without.iter().any(|name| entry.file_name() == *name));
    counted
        .map(|entry| match entry.metadata() {
            Ok(metadata) if metadata.is_dir() => size_mib(&entry.path(), &[]),
            Ok(metadata) => metadata.len() as f64 / f64::from(1 << 20),
            // A log may be renamed meanwhile.
            Err(_) => 0.0,
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn growth_is_the_slope_after_the_filling() {
        let values: Vec<(f64, f64)> = (0..=100)
            .map(f64::from)
            .map(|n| (n / 50.0, if n < 20.0 { 7.0 * n } else { 140.0 + 3.0 * n / 50.0 }))
            .collect();
        let growth = Growth::of(&[values]);
        assert!((growth.per_h - 3.0).abs() < 1e-9, "{growth:?}");
        assert!(
            (growth.first - 141.44).abs() < 0.1 && (growth.last - 145.76).abs() < 0.1,
            "{growth:?}"
        );
        assert_eq!(Growth::of(&[vec![(0.0, 1.0)]]).per_h, 0.0);
    }

    #[test]
    fn peaks_after_handovers_are_no_growth_and_steps_are() {
        // Ten hours, one sample a minute, and a peak of 20 MiB in one minute of five, more of them late than early.
        let samples = |rise: fn(f64) -> f64| -> Vec<(f64, f64)> {
            let is_peak = |n: u32| n.is_multiple_of(5) && n > 200;
            (0..600)
                .map(|n| (f64::from(n) / 60.0, if is_peak(n) { 55.0 } else { 35.0 }))
                .map(|(at_h, value)| (at_h, value + rise(at_h)))
                .collect()
        };
        let [flat, stepped] =
            [samples(|_| 0.0), samples(|at_h| 2.0 * at_h.floor())].map(|values| Growth::of(&[values]).per_h);
        assert!(flat.abs() < 0.01, "{flat}");
        assert!((stepped - 2.0).abs() < 0.1, "{stepped}");
    }

    #[test]
    fn a_successor_that_begins_with_less_is_no_growth() {
        // Two trainers, of which each grows while it fills; the second has more.
        let samples: Vec<SoakSample> = (0..200)
            .map(|n| {
                let (life, age) = (n / 100, n % 100);
                SoakSample {
                    at_h: f64::from(n) / 100.0,
                    private_mib: 200.0 + 9.0 * f64::from(life) + f64::from(age.min(20)),
                    handles: 80.0,
                    pids: Pid::from_raw(1 + life).into_iter().collect(),
                }
            })
            .collect();
        let lives = lives(&samples, |sample| sample.private_mib);
        assert_eq!(lives.len(), 2);
        let growth = Growth::of(&lives);
        assert_eq!((growth.first, growth.last, growth.per_h), (220.0, 229.0, 0.0));
    }
}
