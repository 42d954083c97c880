//! Disturbs runs at random moments, and compares each with an undisturbed run: the same observations, the same parameters, nothing lost.

mod case;
mod disk;
mod run;

use std::{
    fs,
    path::Path,
    process::Stdio,
    time::{Duration, Instant},
};

use caraware::{failure::Exit, install};
use serde_json::Value;

use self::{
    case::EnduranceCase,
    disk::SmallDisk,
    run::{DisturbedRun, EnduranceCounts, EndurancePlace},
};
use super::{BenchOptions, BenchReport, MedianSpread, ReportTable, sides::BenchDirectory};

/// A quick measurement gives up what it could not do in so many runs of a case.
const MOST_QUICK_ROUNDS: u32 = 4;

/// Disturbs runs for as long as `options` say, at least one of each case.
///
/// # Errors
/// A program is missing, a file cannot be read, or an undisturbed run fails. What a disturbance breaks is in the report's faults.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let directory = BenchDirectory::new("endurance")?;
    let disk = SmallDisk::mount(directory.path())?;
    let place = EndurancePlace {
        caraware: install::program(&options.bin, "caraware")?,
        watch: install::program(&options.bin, "fanout-watch")?,
        directory: directory.path().to_owned(),
        has_small_disk: disk.is_some(),
        is_quick: options.quick,
    };
    let mut report = BenchReport::new(
        "endurance",
        "Endurance",
        "Small runs are disturbed at random moments until each has completed: processes are killed (the supervisor too: then the run is \
         resumed), stopped for up to 1.5 s, or stopped until they are killed as hanging. Trainers are replaced, in paused runs too. Viewers \
         come, stop and die, and the disk is full for up to 1.5 s. Each run is compared with the undisturbed run of the same seed. \
         `town` has one environment, a step of 0.1 s and messages between vehicles; `grid` is a generated `.sumocfg` with a step of \
         1 s, two environments and a lossless recording. In `learners` the town's trainer is replaced by another learner and back. What was learnt is not compared there, and lost ticks count where the last \
         learner counts them. In `heroes` a policy drives four vehicles of the town, and the disk is never full. Not disturbed: the \
         memory.",
    );
    if disk.is_none() {
        report.text += " ";
        report.text += disk::NO_DISK;
    }
    report.command = format!(
        "caraware bench endurance --minutes {} --seed {}",
        options.minutes, options.seed
    );
    let cases = EnduranceCase::all(&place.directory)?;
    let mut counts = [(); 4].map(|()| EnduranceCounts::default());
    let mut undisturbed = Vec::new();
    for case in &cases {
        undisturbed.push(Outcome::of_undisturbed(&place, case)?);
    }
    let time = Duration::from_secs(60 * u64::from(options.minutes));
    let mut random = fastrand::Rng::with_seed(options.seed);
    let begun = Instant::now();
    for round in 0.. {
        for ((case, counts), whole) in cases.iter().zip(&mut counts).zip(&undisturbed) {
            // A short run may end before a process was there for each disturbance: the next round does what is left.
            if options.quick && round > 0 && !counts.has_missed() {
                continue;
            }
            let name = format!("{}-{round}", case.name);
            let run = DisturbedRun::start(&place, case, &name, random.fork(), counts)?;
            if let Some(report) = run.disturb()? {
                let outcome = Outcome::read(case, &place.run(&name), &report)?;
                let differences = outcome.differences(whole);
                let faults = differences.into_iter().map(|text| format!("run {name}: {text}"));
                counts.faults.extend(faults);
            }
            // What was compared is not needed any more; hours of runs would fill the disk.
            remove(&place.run(&name))?;
        }
        let is_done = match options.quick {
            true => round + 1 == MOST_QUICK_ROUNDS || !counts.iter().any(EnduranceCounts::has_missed),
            false => begun.elapsed() >= time,
        };
        if is_done {
            break;
        }
        let [runs, faults] = [
            counts.iter().map(|counts| counts.runs as usize).sum::<usize>(),
            counts.iter().map(|counts| counts.faults.len()).sum(),
        ];
        caraware::display::notice(&format!(
            "{:.0} min: {runs} runs completed, {faults} faults",
            begun.elapsed().as_secs_f64() / 60.0
        ));
    }
    add_counts(&mut report, &cases, &counts)?;
    report.faults = counts.into_iter().flat_map(|counts| counts.faults).collect();
    Ok(report)
}

fn remove(directory: &Path) -> Result<(), Exit> {
    match fs::remove_dir_all(directory) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(Exit::io("remove", directory, &error)),
        _ => Ok(()),
    }
}

/// What a completed run has observed and learnt.
#[derive(Debug, Clone, PartialEq)]
struct Outcome {
    result: Value,
    observation_hash: Value,
    vehicle_steps: Value,
    lost_ticks: Value,
    duplicated_ticks: Value,
    /// Bytes of the parameters, of Adam's moments and of the random numbers' states; none of learners that take turns.
    learnt: Vec<u8>,
}

impl Outcome {
    fn of_undisturbed(place: &EndurancePlace, case: &EnduranceCase) -> Result<Self, Exit> {
        let name = format!("{}-undisturbed", case.name);
        let output = place
            .command(&case.arguments(&name, 0.0, None))
            .stderr(Stdio::piped())
            .output()
            .map_err(|error| Exit::io("start", &place.caraware, &error))?;
        if !output.status.success() {
            let text = String::from_utf8_lossy(&output.stderr).into_owned();
            return Err(Exit::run(
                format!("the undisturbed run of {} failed: {text}", case.name),
                "",
            ));
        }
        let path = place.run(&name).join("report.json");
        let text = fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
        let report = serde_json::from_str(&text);
        let report = report.map_err(|error| Exit::run(format!("{}: {error}", path.display()), ""))?;
        let outcome = Self::read(case, &place.run(&name), &report)?;
        remove(&place.run(&name))?;
        Ok(outcome)
    }

    fn read(case: &EnduranceCase, directory: &Path, report: &Value) -> Result<Self, Exit> {
        let learnt = match case.learners_take_turns {
            true => Vec::new(),
            false => learnt(&directory.join("checkpoints"))?,
        };
        // The learner of docs/learners.md does not count ticks: a report that it has ended has null.
        let counted = |key: &str| match &report[key] {
            Value::Null if case.learners_take_turns => 0.into(),
            value => value.clone(),
        };
        Ok(Self {
            result: report["result"].clone(),
            observation_hash: report["observation_hash"].clone(),
            vehicle_steps: report["vehicle_steps"].clone(),
            lost_ticks: counted("lost_ticks"),
            duplicated_ticks: counted("duplicated_ticks"),
            learnt,
        })
    }

    /// Where a disturbed run differs from the undisturbed one.
    fn differences(&self, whole: &Self) -> Vec<String> {
        let values = [
            ("result", &self.result, &whole.result),
            ("observation hash", &self.observation_hash, &whole.observation_hash),
            ("vehicle-steps", &self.vehicle_steps, &whole.vehicle_steps),
            ("ticks lost", &self.lost_ticks, &whole.lost_ticks),
            ("ticks learnt twice", &self.duplicated_ticks, &whole.duplicated_ticks),
        ];
        let differing = values.into_iter().filter(|(_, ours, theirs)| ours != theirs);
        let mut differences: Vec<String> = differing
            .map(|(name, ours, theirs)| format!("{name} {ours} instead of {theirs}"))
            .collect();
        if self.learnt != whole.learnt {
            differences.push("other parameters, moments or random numbers were learnt".into());
        }
        differences
    }
}

/// What the newest of these checkpoints holds.
fn learnt(checkpoints: &Path) -> Result<Vec<u8>, Exit> {
    let read = |path: &Path| fs::read(path).map_err(|error| Exit::io("read", path, &error));
    let newest = String::from_utf8_lossy(&read(&checkpoints.join("latest"))?)
        .trim()
        .to_owned();
    let mut learnt = Vec::new();
    for name in ["parameters", "optimiser", "random"] {
        learnt.extend(read(&checkpoints.join(&newest).join(format!("{name}.safetensors")))?);
    }
    Ok(learnt)
}

fn add_counts(report: &mut BenchReport, cases: &[EnduranceCase], counts: &[EnduranceCounts]) -> Result<(), Exit> {
    let mut table = ReportTable::new("what was done", &["case", "what", "times"]);
    let mut resources = ReportTable::new(
        "largest of all runs",
        &["case", "process", "resident memory (MiB)", "handles"],
    );
    for (case, counts) in cases.iter().zip(counts) {
        let figures = [("runs completed", counts.runs), ("times resumed", counts.resumed)];
        let done = counts.disturbances.iter().map(|(name, times)| (name.as_str(), *times));
        for (name, times) in figures.into_iter().chain(done) {
            table.row([case.name.into(), name.into(), times.to_string()]);
            report.figure(format!("{}: {name}", case.name), f64::from(times));
        }
        let faults = counts.faults.len();
        table.row([
            case.name.into(),
            "runs or checks that failed".into(),
            faults.to_string(),
        ]);
        report.figure(format!("{}: runs or checks that failed", case.name), faults as f64);
        if !counts.recoveries_s.is_empty() {
            let spread = MedianSpread::of(counts.recoveries_s.iter().copied())?;
            let what = "seconds from a simulator's death to a new tick";
            table.row([case.name.into(), what.into(), format!("{spread:.1}")]);
            report.figure(format!("{}: {what}, median", case.name), spread.median);
            report.figure(format!("{}: {what}, largest", case.name), spread.largest);
        }
        for (target, (resident_mib, handles)) in &counts.peaks {
            resources.row([
                case.name.into(),
                target.name().into(),
                format!("{resident_mib:.0}"),
                format!("{handles:.0}"),
            ]);
        }
    }
    let mut refusals = ReportTable::new("handovers refused or given up", &["case", "reason", "times"]);
    for (case, counts) in cases.iter().zip(counts) {
        for (reason, times) in &counts.refusals {
            refusals.row([case.name.into(), reason.clone(), times.to_string()]);
        }
    }
    report.tables.extend([table, resources, refusals]);
    Ok(())
}
