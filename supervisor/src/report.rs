//! `report.json`: the results of a run, assembled from the parts that its processes write at their end.

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    path::{Path, PathBuf},
    time::Duration,
};

use ipc_schema::{
    metric::{self, METRICS, MetricSpec},
    process::Process,
    run::{LAYOUT_VERSION, Mode, RunFile},
    storage,
};
use serde::Deserialize;
use serde_json::{Map, Value, json};

use crate::{
    failure::Exit,
    housekeeping::HousekeepingFigures,
    resume,
    socket::HandoverReport,
    supervisor::{RunEnding, RunOutcome},
};

/// Longest wait for space on a full disk at the end of a run.
const SPACE_WITHIN: Duration = Duration::from_secs(60);

/// Reasons for resynchronisations that the summary names.
const SHOWN_CAUSES: usize = 3;
/// Vehicle classes that the summary names.
const SHOWN_CLASSES: usize = 6;

/// The estimators that an evaluation compares, by their prefixes of the report's keys: the policy, the raw fix, the Kalman filter, the
/// same with a map, the smoother, which also uses later samples, and the policy's network trained by regression.
const ESTIMATORS: [&str; 6] = ["ppo", "raw_gnss", "ekf", "map_ekf", "rts", "supervised"];

/// The part of the report that `sensor-daemon` writes at its end; all zero if `sensor-daemon` was ended before.
#[derive(Debug, Clone, Deserialize, Default)]
struct Sensing {
    observation_hash: String,
    /// The first tick that the hash covers.
    first_tick: u64,
    observations: u64,
    ticks: u64,
    drops: u64,
    redelivered_ticks: u64,
    journal_mib: u64,
    handovers: Vec<HandoverMeasurement>,
    cavs_max: u64,
    // `sensor-daemon` writes null for a missing value, and always writes the key.
    #[serde(deserialize_with = "Option::deserialize")]
    raw_gnss_mean_error_m: Option<f64>,
    #[serde(deserialize_with = "Option::deserialize")]
    lidar: Option<Value>,
    #[serde(deserialize_with = "Option::deserialize")]
    camera: Option<Value>,
    #[serde(deserialize_with = "Option::deserialize")]
    radar: Option<Value>,
}

/// The part of the trainer's report that the run's report repeats; a trainer of the user may leave out any of it.
#[derive(Debug, Deserialize, Default)]
struct TrainerFigures {
    env_steps: Option<u64>,
    lost_ticks: Option<u64>,
    duplicated_ticks: Option<u64>,
    evaluation_seeds: Option<u64>,
    policy_std: Option<f64>,
    raw_gnss_mean_error_m: Option<f64>,
    /// Outputs that a full disk did not take, with the first reason for each.
    dropped: Option<Value>,
    /// Means and intervals of the estimators, and everything else.
    #[serde(flatten)]
    others: Map<String, Value>,
}

impl Sensing {
    /// Sums over all environments. The hash is that of the first environment, and the error is the mean over all samples.
    fn total(environments: &[Self]) -> Self {
        let sum = |part: fn(&Self) -> u64| environments.iter().map(part).sum();
        #[expect(clippy::cast_precision_loss, reason = "weights of a mean")]
        let errors_m = environments.iter().filter_map(|one| {
            let mean_m = one.raw_gnss_mean_error_m?;
            Some((one.observations as f64, one.observations as f64 * mean_m))
        });
        let (samples, error_m) = errors_m.fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
        let Some(first) = environments.first() else {
            return Self::default();
        };
        Self {
            observations: sum(|one| one.observations),
            ticks: sum(|one| one.ticks),
            drops: sum(|one| one.drops),
            redelivered_ticks: sum(|one| one.redelivered_ticks),
            journal_mib: sum(|one| one.journal_mib),
            cavs_max: sum(|one| one.cavs_max),
            raw_gnss_mean_error_m: (samples > 0.0).then(|| error_m / samples),
            ..first.clone()
        }
    }
}

/// The results of one environment.
fn environment_report(run: &RunFile, sensing: &Sensing, [dynamics, v2x, recording]: [Option<Value>; 3]) -> Value {
    json!({
        "environment": run.env_index,
        "seed": run.seed(),
        "observation_hash": sensing.observation_hash,
        "vehicle_steps": sensing.observations,
        "ticks": sensing.ticks,
        "vehicles": sensing.cavs_max,
        "raw_gnss_mean_error_m": sensing.raw_gnss_mean_error_m,
        "drops": sensing.drops,
        "redelivered_ticks": sensing.redelivered_ticks,
        "dynamics": dynamics,
        "lidar": sensing.lidar,
        "camera": sensing.camera,
        "radar": sensing.radar,
        "v2x": v2x,
        "recording": recording,
    })
}

/// Reads the parts of the report that the processes wrote at their ends, and keeps the errors.
#[derive(Debug, Default)]
struct PartReader {
    /// Files that cannot be read, each with the reason.
    unreadable: Vec<String>,
}

impl PartReader {
    /// Processor time and memory of each process, by its name.
    fn usage(&mut self, run_dir: &Path) -> Map<String, Value> {
        let mut usage = Map::new();
        for process in Process::ALL {
            let part: Option<Value> = self.read(run_dir, process);
            if let Some(used) = part.as_ref().and_then(|part| part.get("process")) {
                usage.insert(process.name().to_owned(), used.clone());
            }
        }
        usage
    }

    /// Reads the part of a process of an environment; `None` if the process did not write it, or if it is unreadable.
    fn read<T: serde::de::DeserializeOwned>(&mut self, run_dir: &Path, process: Process) -> Option<T> {
        let path = run_dir.join("parts").join(format!("{process}.json"));
        let reason = match std::fs::read_to_string(&path) {
            Ok(text) => match serde_json::from_str(&text) {
                Ok(part) => return Some(part),
                Err(error) => error.to_string(),
            },
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return None,
            Err(error) => error.to_string(),
        };
        let entry = format!("{}: {reason}", path.display());
        if !self.unreadable.contains(&entry) {
            self.unreadable.push(entry);
        }
        None
    }
}

/// A planned handover as `sensor-daemon` measured it.
#[derive(Debug, Clone, Deserialize)]
struct HandoverMeasurement {
    incarnation: u32,
    stall_s: f64,
    ticks_without_trainer: u64,
    most_ahead_ticks: u64,
}

/// The handovers of a run, each with its effect on the simulation. `tick_s` is the mean wall time of a tick, seconds.
fn handovers(outcome: &RunOutcome, sensing: &Sensing, tick_s: f64) -> Vec<Value> {
    let with_figures = |handover: &HandoverReport| {
        let mut value = json!(handover);
        if let Some(seen) = sensing
            .handovers
            .iter()
            .find(|seen| seen.incarnation == handover.incarnation)
        {
            value["stall_s"] = json!(seen.stall_s);
            value["stall_ticks"] = json!(seen.stall_s / tick_s);
            value["ticks_without_trainer"] = json!(seen.ticks_without_trainer);
            value["most_ahead_ticks"] = json!(seen.most_ahead_ticks);
        }
        value
    };
    outcome.handovers.iter().map(with_figures).collect()
}

/// Message and advice of the failure that ended the run; null if none did.
fn failure(ending: &RunEnding) -> Value {
    let RunEnding::Failed(exit) = ending else {
        return Value::Null;
    };
    let (message, help) = exit.summary();
    json!({ "message": message, "help": help })
}

/// The newest checkpoint, from which `caraware train --resume` continues; null without one.
fn newest_checkpoint(run: &RunFile) -> Option<PathBuf> {
    let folder = run.run_dir.join("checkpoints");
    let name = std::fs::read_to_string(folder.join("latest")).ok()?;
    Some(folder.join(name.trim()))
}

/// Share of the run's ticks that this start has made: a resumed run continues the counts of its earlier parts, but not their time.
fn share_made(runs: &[RunFile], sensings: &[Sensing]) -> f64 {
    let made = |(run, sensing): (&RunFile, &Sensing)| {
        let begin = run
            .beginning
            .as_ref()
            .map_or(0, |beginning| beginning.start.episode_tick);
        (sensing.first_tick + sensing.ticks)
            .saturating_sub(begin)
            .min(sensing.ticks)
    };
    let made: u64 = runs.iter().zip(sensings).map(made).sum();
    let all: u64 = sensings.iter().map(|sensing| sensing.ticks).sum();
    #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
    let share = made as f64 / all.max(1) as f64;
    share
}

/// Assembles the report and writes it.
///
/// # Errors
/// The run directory is not writable.
pub fn write(run: &RunFile, outcome: &RunOutcome, housekeeping: &HousekeepingFigures) -> Result<WrittenReport, Exit> {
    let runs: Vec<RunFile> = (0..run.config.run.envs).map(|index| run.environment(index)).collect();
    let mut parts = PartReader::default();
    let sensings: Vec<Sensing> = runs
        .iter()
        .map(|run| parts.read(&run.run_dir, Process::SensorDaemon).unwrap_or_default())
        .collect();
    let environments: Vec<Value> = runs
        .iter()
        .zip(&sensings)
        .map(|(run, sensing)| {
            let processes = [Process::SimCore, Process::V2x, Process::Recorder];
            environment_report(run, sensing, processes.map(|process| parts.read(&run.run_dir, process)))
        })
        .collect();
    let sensing = Sensing::total(&sensings);
    let trainer: TrainerFigures = parts.read(&run.run_dir, Process::Trainer).unwrap_or_default();
    let metric = metric::headline(run.config.task.kind);
    let env_steps = match run.mode {
        Mode::Train => trainer.env_steps,
        Mode::Simulate | Mode::Play => Some(sensing.observations),
    };
    let raw_m = match run.mode {
        Mode::Train | Mode::Play => trainer.raw_gnss_mean_error_m,
        Mode::Simulate => sensing.raw_gnss_mean_error_m,
    };
    // Without a trainer, no tick is lost.
    let [lost_ticks, duplicated_ticks] = match run.mode {
        Mode::Train | Mode::Play => [trainer.lost_ticks, trainer.duplicated_ticks],
        Mode::Simulate => [Some(0); 2],
    };
    let share = share_made(&runs, &sensings);
    #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
    let (rate, simulated_s) = (
        env_steps.map(|steps| share * steps as f64 / outcome.wall_s),
        sensing.ticks as f64 * run.config.run.tick_s,
    );
    let mut report = json!({
        "name": run.name,
        "mode": run.mode,
        "result": match outcome.ending {
            RunEnding::Completed => "completed",
            RunEnding::Interrupted => "interrupted",
            RunEnding::Failed(_) => "failed",
        },
        "failure": failure(&outcome.ending),
        "checkpoint": newest_checkpoint(run),
        "env_steps": env_steps,
        "wall_s": outcome.wall_s,
        "env_steps_per_s": rate,
        "raw_gnss_mean_error_m": raw_m,
        "metric": metric.name,
        "evaluation_seeds": trainer.evaluation_seeds,
        "policy_std": trainer.policy_std,
        "vehicles": sensing.cavs_max,
        "observation_hash": sensing.observation_hash,
        "first_tick": sensing.first_tick,
        "lost_ticks": lost_ticks,
        "duplicated_ticks": duplicated_ticks,
        "drops": sensing.drops,
        "restarts": outcome.restarts,
        "handovers": handovers(outcome, &sensing, outcome.wall_s / sensing.ticks.max(1) as f64),
        "redelivered_ticks": sensing.redelivered_ticks,
        "journal_mib": sensing.journal_mib,
        "vehicle_steps": sensing.observations,
        "ticks": sensing.ticks,
        "simulated_s": simulated_s,
        "real_time_factor": share * simulated_s / outcome.wall_s,
        "beginning": run.beginning,
        "seed": run.seed(),
        "config_hash": run.config_hash,
        "trainer": parts.read::<Map<_, _>>(&run.run_dir, Process::Trainer).unwrap_or_default(),
        "dynamics": parts.read::<Map<_, _>>(&run.run_dir, Process::SimCore).unwrap_or_default(),
        "lidar": sensing.lidar,
        "camera": sensing.camera,
        "radar": sensing.radar,
        "environments": environments,
        "v2x": parts.read::<Value>(&run.run_dir, Process::V2x),
        "traffic": parts.read::<Value>(&run.run_dir, Process::TrafficBridge),
        "processes": parts.usage(&run.run_dir),
        "dropped": trainer.dropped,
        "disk_full": housekeeping.disk_full,
        "shortened_logs": housekeeping.shortened_logs,
    });
    report["layout_version"] = json!(LAYOUT_VERSION);
    report["evaluated_at_env_steps"] = json!(evaluated_at(&report));
    report["earlier_starts"] = json!(resume::earlier_starts(&run.run_dir));
    add_estimators(&mut report, metric, &trainer);
    let path = run.run_dir.join("report.json");
    let text = format!("{report:#}\n");
    storage::wait_for_space(&path, SPACE_WITHIN, || storage::write_whole(&path, &text))
        .map_err(|error| Exit::io("write", &path, &error))?;
    Ok(WrittenReport {
        report,
        path,
        unreadable: parts.unreadable,
    })
}

/// Adds the task's metric of every estimator, where the report does not have it yet.
fn add_estimators(report: &mut Value, metric: &MetricSpec, trainer: &TrainerFigures) {
    for estimator in ESTIMATORS {
        for key in [metric.mean_key(estimator), metric.interval_key(estimator)] {
            if report[&key].is_null() {
                report[&key] = json!(trainer.others.get(&key));
            }
        }
    }
}

/// The written report.
#[derive(Debug)]
pub struct WrittenReport {
    report: Value,
    path: PathBuf,
    /// Unreadable parts, which the report lacks, each with the reason.
    unreadable: Vec<String>,
}

impl WrittenReport {
    /// The report in a few lines for the terminal.
    #[must_use]
    pub fn summary(&self) -> String {
        summary(&self.report, &self.path)
    }

    /// Checks that the report has every part that a process wrote.
    ///
    /// # Errors
    /// A part cannot be read.
    pub fn check_complete(&self) -> Result<(), Exit> {
        match self.unreadable.as_slice() {
            [] => Ok(()),
            parts => Err(Exit::run(
                format!("the report lacks parts that cannot be read: {}", parts.join("; ")),
                "a trainer of your own must write its part as JSON, which has no NaN, with counts as whole numbers",
            )),
        }
    }
}

/// The observation hash; with several environments a line for each with its hash.
fn hashes(report: &Value) -> Vec<String> {
    let hash = |of: &Value| of["observation_hash"].as_str().unwrap_or_default().to_owned();
    let environments = report["environments"].as_array().map_or(&[][..], Vec::as_slice);
    if environments.len() < 2 {
        let since = match report["first_tick"].as_u64() {
            Some(tick) if tick > 0 => format!(" (from tick {tick} on, where the run was resumed)"),
            _ => String::new(),
        };
        return vec![format!("observation hash {}{since}", hash(report))];
    }
    let line = |one: &Value| {
        format!(
            "environment {}: {} vehicle-steps, seed {}, observation hash {}",
            one["environment"],
            one["vehicle_steps"],
            one["seed"],
            hash(one)
        )
    };
    environments.iter().map(line).collect()
}

/// The most important figures of the report, for the terminal.
fn summary(report: &Value, path: &Path) -> String {
    let mut lines = vec![format!(
        "{} {}: {} vehicle-steps in {} s ({} per second, {} × real time)",
        report["name"].as_str().unwrap_or_default(),
        report["result"].as_str().unwrap_or_default(),
        report["vehicle_steps"],
        number(report, "wall_s", 1),
        number(report, "env_steps_per_s", 0),
        number(report, "real_time_factor", 1),
    )];
    lines.extend(errors(report));
    let heroes = &report["dynamics"]["heroes"];
    if !heroes.is_null() {
        lines.push(format!(
            "heroes: {} episodes, of which {} arrived, {} collided, {} left the road, {} blocked, {} ran out of time; {} actions refused",
            heroes["episodes"],
            heroes["arrived"],
            heroes["collided"],
            heroes["off_road"],
            heroes["blocked"],
            heroes["time_limit"],
            heroes["refused_actions"]
        ));
    }
    let lidar = &report["lidar"];
    if !lidar.is_null() {
        lines.push(format!(
            "LIDAR: {} scans, {} points of {} rays",
            lidar["scans"], lidar["points"], lidar["rays"]
        ));
    }
    for (name, label, entries) in [("camera", "cameras", "road users"), ("radar", "radars", "detections")] {
        let totals = &report[name];
        if !totals.is_null() {
            let (messages, count) = (&totals["messages"], &totals["entries"]);
            lines.push(format!("{label}: {messages} messages with {count} {entries}"));
        }
    }
    lines.extend(traffic(report));
    lines.extend(recordings(report));
    lines.extend(resynchronisations(report));
    lines.extend(guidances(report));
    lines.push(format!(
        "ticks lost {}, duplicated {}; restarts {}; messages that watchers missed {}",
        number(report, "lost_ticks", 0),
        number(report, "duplicated_ticks", 0),
        report["restarts"],
        report["drops"]
    ));
    lines.extend(hashes(report));
    lines.push(format!("report: {}", path.display()));
    lines.join("\n")
}

/// The parts of the report that each environment has.
fn environments(report: &Value) -> &[Value] {
    let environments = report["environments"].as_array();
    environments.map_or(std::slice::from_ref(report), Vec::as_slice)
}

/// The road users of the first environment by class, their teleports, and contacts here and in SUMO.
fn traffic(report: &Value) -> Option<String> {
    let departed = report["traffic"]["departed"].as_object()?;
    let mut classes: Vec<(&str, u64)> = departed
        .iter()
        .map(|(class, count)| (class.as_str(), count.as_u64().unwrap_or(0)))
        .collect();
    classes.sort_by_key(|&(class, count)| (Reverse(count), class));
    let all: u64 = classes.iter().map(|(_, count)| count).sum();
    let shown: Vec<String> = classes
        .iter()
        .take(SHOWN_CLASSES)
        .map(|(class, count)| format!("{count} {class}"))
        .collect();
    let rest = match classes.len().checked_sub(SHOWN_CLASSES) {
        Some(more) if more > 0 => format!(" and {more} more classes"),
        _ => String::new(),
    };
    let contacts = match report["dynamics"]["collisions"]["total"].as_u64() {
        Some(contacts) => format!("contacts {contacts}, in SUMO"),
        None => "contacts in SUMO".to_owned(),
    };
    let carried = [("rides", "rides of persons"), ("container_loads", "containers loaded")]
        .map(|(key, label)| match report["traffic"][key].as_u64() {
            Some(count) if count > 0 => format!("; {label} {count}"),
            _ => String::new(),
        })
        .concat();
    Some(format!(
        "road users {all} ({}{rest}){carried}; teleports {}; {contacts} {}; resets {}",
        shown.join(", "),
        report["traffic"]["teleports"],
        report["traffic"]["contacts"],
        report["traffic"]["resets"]
    ))
}

/// A line for each recording: its size, and what it lacks.
fn recordings(report: &Value) -> Vec<String> {
    let environments = report["environments"].as_array().map_or(&[][..], Vec::as_slice);
    let recordings = environments.iter().map(|environment| &environment["recording"]);
    let line = |recording: &Value| {
        let bytes = |key: &str| recording[key].as_f64().unwrap_or(0.0) / 1e6;
        format!(
            "recording: {} ({:.1} MB of {:.1} MB), {} ticks missed{}",
            recording["file"].as_str().unwrap_or_default(),
            bytes("file_bytes"),
            bytes("message_bytes"),
            recording["missed_ticks"],
            recording["stopped"]
                .as_str()
                .map_or(String::new(), |reason| format!("; it ended early: {reason}"))
        )
    };
    recordings.filter(|recording| !recording.is_null()).map(line).collect()
}

/// How often mirrors were set onto SUMO, in all environments, and the commonest reasons.
fn resynchronisations(report: &Value) -> Option<String> {
    let parts = environments(report);
    let sum = |key: &str| -> Option<u64> { parts.iter().map(|part| part["dynamics"][key].as_u64()).sum() };
    let (set, steps) = (
        sum("resynchronisations")?,
        sum("vehicle_steps").filter(|&steps| steps > 0)?,
    );
    #[expect(clippy::cast_precision_loss, reason = "a rate for readers")]
    let rate = 1e6 * set as f64 / steps as f64;
    // Two of seven million are not none.
    let decimals = if set > 0 && rate < 10.0 { 2 } else { 0 };
    let reasons = commonest_causes(parts, "resynchronisation_causes");
    Some(format!(
        "mirrors set onto SUMO: {set} ({rate:.decimals$} per million vehicle-ticks){reasons}"
    ))
}

/// How long mirrors were led along their paths, in all environments, and the commonest reasons.
fn guidances(report: &Value) -> Option<String> {
    let parts = environments(report);
    let ticks =
        |of: fn(&Value) -> &Value| -> Option<u64> { parts.iter().map(|part| of(&part["dynamics"]).as_u64()).sum() };
    let guided = ticks(|dynamics| &dynamics["tracking"]["guided"]).filter(|&guided| guided > 0)?;
    let steps = ticks(|dynamics| &dynamics["vehicle_steps"])?;
    #[expect(clippy::cast_precision_loss, reason = "a share for readers")]
    let share = 100.0 * guided as f64 / steps.max(1) as f64;
    let reasons = commonest_causes(parts, "guidance_causes");
    Some(format!(
        "mirrors led where no vehicle drives like SUMO's: {share:.2} % of vehicle-ticks{reasons}"
    ))
}

/// The commonest of `dynamics.KEY`, counts by class and cause, after a colon; empty if there is none.
fn commonest_causes(parts: &[Value], key: &str) -> String {
    let mut causes: BTreeMap<String, u64> = BTreeMap::new();
    for part in parts {
        let classes = part["dynamics"][key].as_object();
        for (class, counts) in classes.into_iter().flatten() {
            for (cause, count) in counts.as_object().into_iter().flatten() {
                let cause = format!("{class} {}", cause.replace('_', " "));
                *causes.entry(cause).or_default() += count.as_u64().unwrap_or(0);
            }
        }
    }
    let mut causes: Vec<(String, u64)> = causes.into_iter().collect();
    causes.sort_by_key(|(_, count)| Reverse(*count));
    let most: Vec<String> = causes
        .iter()
        .take(SHOWN_CAUSES)
        .map(|(cause, count)| format!("{cause} {count}"))
        .collect();
    match most.is_empty() {
        true => String::new(),
        false => format!(": {}", most.join(", ")),
    }
}

/// A number of the report with `digits` decimals; a dash if it is missing.
fn number(report: &Value, key: &str, digits: usize) -> String {
    report[key]
        .as_f64()
        .map_or("–".into(), |value| format!("{value:.digits$}"))
}

/// Samples that the policy of the last evaluation had seen.
fn evaluated_at(report: &Value) -> Option<u64> {
    let evaluations = report["trainer"]["evaluations"].as_array()?;
    evaluations.last()?["env_steps"].as_u64()
}

/// When the last evaluation was, if the run ended before another one: " after 12000 of 40000 samples".
fn evaluated_before(report: &Value) -> String {
    match (evaluated_at(report), report["env_steps"].as_u64()) {
        (Some(last), Some(all)) if last < all && report["result"] != "completed" => {
            format!(" after {last} of {all} samples")
        }
        _ => String::new(),
    }
}

/// Means of the task's metric for the policy and for the estimators that it is compared with.
fn errors(report: &Value) -> Vec<String> {
    let Some(metric) = METRICS.iter().find(|metric| report["metric"] == metric.name) else {
        return Vec::new();
    };
    let error = |estimator: &str| {
        let mean = number(report, &metric.mean_key(estimator), 2);
        match report[metric.interval_key(estimator)].as_f64() {
            Some(half) => format!("{mean} ± {half:.2} {}", metric.unit),
            None => format!("{mean} {}", metric.unit),
        }
    };
    let measured = |estimator: &str| !report[metric.mean_key(estimator)].is_null();
    let mut lines = Vec::new();
    if measured("ppo") {
        let seeds = match report["evaluation_seeds"].as_u64() {
            Some(seeds) if seeds > 1 => format!("{seeds} unseen seeds (± 95 %)"),
            _ => "unseen seeds".to_owned(),
        };
        let references = METRICS
            .iter()
            .filter(|other| other.reference_for == Some(metric.name))
            .map(|other| format!(", {} {}", other.label, error(other.estimator())));
        lines.push(format!(
            "mean {} on {seeds}{}: policy {}{}   (policy σ {})",
            metric.label,
            evaluated_before(report),
            error("ppo"),
            references.collect::<String>(),
            number(report, "policy_std", 3)
        ));
    }
    if measured("supervised") {
        let by = "the policy's network trained by regression on the truth";
        lines.push(format!(
            "from the same samples and gradient steps: {by} {}",
            error("supervised")
        ));
    }
    if measured("ekf") {
        let mut line = format!("from the same samples: EKF {}", error("ekf"));
        if measured("map_ekf") {
            line += &format!(", EKF with a map {}", error("map_ekf"));
        }
        if measured("rts") {
            let note = "sees the future: a bound, not an estimator";
            line += &format!(", RTS smoother {} ({note})", error("rts"));
        }
        lines.push(line);
    }
    lines
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn an_evaluation_of_long_ago_is_named_as_such() {
        let report = |evaluated: u64, result: &str| {
            let evaluations = [json!({"env_steps": 5}), json!({"env_steps": evaluated})];
            json!({"env_steps": 40, "result": result, "trainer": {"evaluations": evaluations}})
        };
        assert_eq!(evaluated_before(&report(12, "interrupted")), " after 12 of 40 samples");
        assert_eq!(evaluated_before(&report(40, "interrupted")), "");
        assert_eq!(evaluated_before(&report(12, "completed")), "");
        assert_eq!(evaluated_before(&json!({})), "");
    }

    #[test]
    fn a_small_rate_of_jumps_is_not_rounded_to_none() {
        let line = |set: u64| {
            let dynamics = json!({"resynchronisations": set, "vehicle_steps": 7_000_000});
            resynchronisations(&json!({"environments": [{"dynamics": dynamics}]})).unwrap()
        };
        assert_eq!(line(0), "mirrors set onto SUMO: 0 (0 per million vehicle-ticks)");
        assert_eq!(line(2), "mirrors set onto SUMO: 2 (0.29 per million vehicle-ticks)");
        assert_eq!(
            line(1400),
            "mirrors set onto SUMO: 1400 (200 per million vehicle-ticks)"
        );
    }

    #[test]
    fn the_error_names_an_unreadable_part_and_a_missing_part_is_none() {
        let run_dir = tempfile::tempdir().unwrap();
        let write = |process: Process, part: &Value| {
            let path = run_dir.path().join("parts").join(format!("{process}.json"));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, part.to_string()).unwrap();
        };
        let mut sensing = json!({
            "observation_hash": "ab", "first_tick": 0, "observations": 3, "ticks": 2, "drops": 0, "redelivered_ticks": 0, "journal_mib": 1,
            "handovers": [], "cavs_max": 2, "raw_gnss_mean_error_m": null, "lidar": null, "camera": null, "radar": null, "process": {},
        });
        let mut parts = PartReader::default();
        let read = |parts: &mut PartReader| parts.read::<Sensing>(run_dir.path(), Process::SensorDaemon);
        assert!(
            read(&mut parts).is_none() && parts.unreadable.is_empty(),
            "it was not written"
        );
        write(Process::SensorDaemon, &sensing);
        assert_eq!(read(&mut parts).unwrap().observations, 3);
        for key in ["observations", "lidar"] {
            let value = sensing.as_object_mut().unwrap().remove(key).unwrap();
            sensing["misspelt"] = value.clone();
            write(Process::SensorDaemon, &sensing);
            assert!(read(&mut parts).is_none());
            assert!(parts.unreadable.last().unwrap().contains(key), "{:?}", parts.unreadable);
            sensing[key] = value;
        }
        write(Process::Trainer, &json!({ "env_steps": "many" }));
        let trainer = parts.read::<TrainerFigures>(run_dir.path(), Process::Trainer);
        assert!(trainer.is_none() && parts.unreadable.last().unwrap().contains("trainer.json"));
        write(Process::Trainer, &json!({ "ppo_mean_error_m": 1.5 }));
        let trainer: TrainerFigures = parts.read(run_dir.path(), Process::Trainer).unwrap();
        assert_eq!(
            (trainer.env_steps, &trainer.others["ppo_mean_error_m"]),
            (None, &json!(1.5))
        );
    }
}
