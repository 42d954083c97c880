//! Measures the learner, compared with Stable-Baselines3 and a plain loop, and the cost of a tick before the update.

use std::process::Command;

use caraware::{failure::Exit, install};
use serde::Deserialize;

use super::{BenchOptions, BenchReport, MedianSpread, ReportTable};

/// Samples in a horizon, as in `caraware_bench.trainer`.
const HORIZON: f64 = 32_768.0;
/// Visits of a sample in an update, as in `caraware_bench.trainer`.
const EPOCHS: f64 = 4.0;

/// The output of `caraware_bench.trainer`: seconds, by round.
#[derive(Debug, Deserialize)]
struct TrainerFigures {
    threads: u32,
    precision: String,
    update_s: UpdateTimes,
    horizon_s: HorizonTimes,
    ticks: Vec<TickTimes>,
}

#[derive(Debug, Deserialize)]
struct UpdateTimes {
    ours: Vec<f64>,
    plain: Vec<f64>,
    sb3: Vec<f64>,
}

#[derive(Debug, Deserialize)]
struct HorizonTimes {
    ours: Vec<f64>,
    sb3: Vec<f64>,
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
             threads, and {} matrix products. Only PPO is measured, without the supervised network (`trainer.supervised`). All learners \
             alternate in one process; figures are medians of {} rounds.",
            measured.threads,
            measured.precision,
            measured.update_s.ours.len()
        ),
    );
    report.tables = vec![
        updates(&mut report, &measured.update_s)?,
        rollouts(&mut report, &measured.horizon_s)?,
        ticks(&mut report, &measured.ticks),
    ];
    Ok(report)
}

fn updates(report: &mut BenchReport, seconds: &UpdateTimes) -> Result<ReportTable, Exit> {
    let visits = HORIZON * EPOCHS;
    let columns = ["one update", "sample-visits/s", "ours is faster by", "smallest–largest"];
    let mut table = ReportTable::new("", &columns);
    table.row([
        "ours".into(),
        rate(&seconds.ours, visits)?,
        String::new(),
        String::new(),
    ]);
    for (name, theirs) in [
        ("plain loop (CleanRL's manner)", &seconds.plain),
        ("Stable-Baselines3's PPO", &seconds.sb3),
    ] {
        let [ratio, range] = compare(report, &format!("update, ratio to {name}"), &seconds.ours, theirs)?;
        table.row([name.into(), rate(theirs, visits)?, ratio, range]);
    }
    Ok(table)
}

fn rollouts(report: &mut BenchReport, seconds: &HorizonTimes) -> Result<ReportTable, Exit> {
    let columns = [
        "rollout and update, free environment",
        "env-steps/s",
        "ours is faster by",
        "smallest–largest",
    ];
    let mut table = ReportTable::new("", &columns);
    let ours = rate(&seconds.ours, HORIZON)?;
    table.row(["ours, 8 vehicles".into(), ours, String::new(), String::new()]);
    let name = "rollout and update, ratio to Stable-Baselines3's PPO";
    let [ratio, range] = compare(report, name, &seconds.ours, &seconds.sb3)?;
    let theirs = rate(&seconds.sb3, HORIZON)?;
    table.row(["Stable-Baselines3's PPO, 8 environments".into(), theirs, ratio, range]);
    Ok(table)
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

/// Median rate of rounds of `amount` each.
fn rate(seconds: &[f64], amount: f64) -> Result<String, Exit> {
    let spread = MedianSpread::of(seconds.iter().map(|seconds| amount / seconds))?;
    Ok(format!("{:.0}", spread.median))
}

/// Ratio of their time to ours, round by round: the median, and the smallest and the largest.
fn compare(report: &mut BenchReport, name: &str, ours: &[f64], theirs: &[f64]) -> Result<[String; 2], Exit> {
    let spread = MedianSpread::of(ours.iter().zip(theirs).map(|(ours, theirs)| theirs / ours))?;
    report.figure(name, spread.median);
    Ok([
        format!("{:.2} ×", spread.median),
        format!("{:.2}–{:.2}", spread.smallest, spread.largest),
    ])
}
