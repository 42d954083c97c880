//! Measures the learner, compared with Stable-Baselines3 and a plain loop, and the cost of a tick before the update.

use std::process::Command;

use caraware::{failure::Exit, install};
use serde::Deserialize;

use super::{BenchOptions, BenchReport, MedianSpread, ReportTable};

/// Samples in a horizon, as in `caraware_bench.trainer`.
const HORIZON: f64 = 32_768.0;
/// Visits of a sample in an update, as in `caraware_bench.trainer`.
const EPOCHS: f64 = 4.0;

/// The output of `caraware_bench.trainer`.
#[derive(Debug, Deserialize)]
struct TrainerFigures {
    threads: u32,
    precision: String,
    updates: Vec<LearnerTimes>,
    rollouts: Vec<RolloutTimes>,
    ticks: Vec<TickTimes>,
}

/// Seconds of one learner, by round.
#[derive(Debug, Deserialize)]
struct LearnerTimes {
    name: String,
    wall_s: Vec<f64>,
    cpu_s: Vec<f64>,
}

/// The same rollout on all sides.
#[derive(Debug, Deserialize)]
struct RolloutTimes {
    /// Ticks of eight vehicles, or as many sub-environments, in a forward pass.
    window: u32,
    learners: Vec<LearnerTimes>,
}

#[derive(Debug, Deserialize)]
struct TickTimes {
    vehicles: u64,
    us_per_tick: f64,
    forward_us_per_tick: f64,
    calls_per_tick: f64,
}

/// Runs `python -m caraware_bench.trainer`.
///
/// # Errors
/// Python is missing, or the program fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let python = match &options.python {
        Some(python) => python.clone(),
        None => install::python(&options.bin)?,
    };
    let mut command = Command::new(python);
    command.args(["-m", "caraware_bench.trainer"]);
    let measured: TrainerFigures = super::report::from_program(command)?;
    let mut report = BenchReport::new(
        "trainer",
        "The learner",
        format!(
            "The paper's networks (9 → 500 → 300, separate for policy and value) with a horizon of 32 768, minibatches of 2 048, four epochs, {} \
             threads on every side, the same allocator, and {} matrix products. Only PPO is measured, without the supervised network \
             (`trainer.supervised`). All learners alternate in one process; figures are medians of {} rounds, and a ratio compares one round \
             (smallest–largest). CPU is the processor time of all threads. Rollouts are the same on all sides: eight rows in a forward pass, or \
             512 (64 waiting ticks of eight vehicles, or 512 sub-environments).",
            measured.threads,
            measured.precision,
            measured.updates.first().map_or(0, |ours| ours.wall_s.len())
        ),
    );
    let first = ["one update", "sample-visits/s"];
    let mut tables = vec![learners(
        &mut report,
        "update",
        first,
        HORIZON * EPOCHS,
        &measured.updates,
    )?];
    for rollout in &measured.rollouts {
        let label = match rollout.window {
            1 => "rollout and update, a tick in a forward pass".to_owned(),
            window => format!("rollout and update, {window} ticks in a forward pass"),
        };
        let first = [label.as_str(), "env-steps/s"];
        tables.push(learners(&mut report, &label, first, HORIZON, &rollout.learners)?);
    }
    tables.push(ticks(&mut report, &measured.ticks));
    report.tables = tables;
    Ok(report)
}

/// A row for each learner, the first of which is ours; `amount` is done in a round.
fn learners(
    report: &mut BenchReport,
    label: &str,
    first: [&str; 2],
    amount: f64,
    learners: &[LearnerTimes],
) -> Result<ReportTable, Exit> {
    let Some(ours) = learners.first() else {
        return Err(Exit::run("a measurement without a learner", ""));
    };
    let columns = [first[0], first[1], "ours is faster by", "CPU s", "CPU, × ours"];
    let mut table = ReportTable::new("", &columns);
    for each in learners {
        let rate = MedianSpread::of(each.wall_s.iter().map(|seconds| amount / seconds))?.median;
        let cpu_s = MedianSpread::of(each.cpu_s.iter().copied())?.median;
        let [mut wall, mut cpu] = [String::new(), String::new()];
        if each.name != ours.name {
            let (of_wall, of_cpu) = (ratio(&each.wall_s, &ours.wall_s)?, ratio(&each.cpu_s, &ours.cpu_s)?);
            report.figure(format!("{label}, ratio to {}", each.name), of_wall.median);
            report.figure(format!("{label}, CPU, ratio to {}", each.name), of_cpu.median);
            [wall, cpu] = [format!("{of_wall} ×"), format!("{of_cpu} ×")];
        }
        table.row([
            each.name.clone(),
            format!("{rate:.0}"),
            wall,
            format!("{cpu_s:.2}"),
            cpu,
        ]);
    }
    Ok(table)
}

/// Their seconds to ours, round by round.
fn ratio(theirs: &[f64], ours: &[f64]) -> Result<MedianSpread, Exit> {
    MedianSpread::of(theirs.iter().zip(ours).map(|(theirs, ours)| theirs / ours))
}

fn ticks(report: &mut BenchReport, ticks: &[TickTimes]) -> ReportTable {
    let columns = [
        "vehicles in a tick",
        "µs/tick",
        "of these the policy's forward pass",
        "µs/vehicle",
        "calls from Python/tick",
    ];
    let mut table = ReportTable::new("", &columns);
    for tick in ticks {
        #[expect(clippy::cast_precision_loss, reason = "some thousands")]
        let each = tick.us_per_tick / tick.vehicles as f64;
        table.row([
            tick.vehicles.to_string(),
            format!("{:.0}", tick.us_per_tick),
            format!("{:.0}", tick.forward_us_per_tick),
            format!("{each:.2}"),
            format!("{:.1}", tick.calls_per_tick),
        ]);
        report.figure(
            format!("calls per tick of {} vehicles", tick.vehicles),
            tick.calls_per_tick,
        );
    }
    table
}
