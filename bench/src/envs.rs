//! Measures the rate of 1, 2 and 4 environments side by side, compared with one environment on a single core.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use caraware::{cores, failure::Exit, install};
use serde::Deserialize;

use super::{BenchOptions, BenchReport, CurveLine, MedianSpread, ReportCurve, ReportTable};

/// Numbers of environments.
const ENVIRONMENTS: [usize; 3] = [1, 2, 4];
/// Rounds, each with all numbers of environments in turn. Ratios compare runs of one round.
const ROUNDS: usize = 5;
/// Traffic of the town.
const LOADS: [TownLoad; 2] = [
    TownLoad {
        name: "town: 32 connected vehicles, 8 others, 12 pedestrians",
        short: "town",
        cavs: 32,
        others: 8,
        pedestrians: 12,
        ticks: 4000,
    },
    TownLoad {
        name: "town, busy: 150 connected vehicles, 50 others, 50 pedestrians",
        short: "busy town",
        cavs: 150,
        others: 50,
        pedestrians: 50,
        ticks: 1200,
    },
];

struct TownLoad {
    name: &'static str,
    short: &'static str,
    cavs: u32,
    others: u32,
    pedestrians: u32,
    ticks: u32,
}

/// The figures that are read from a run's report.
#[derive(Debug, Deserialize)]
struct RunFigures {
    vehicle_steps: u64,
    wall_s: f64,
}

/// A directory for the runs. Dropping it removes the directory.
struct RunsDirectory(PathBuf);

impl Drop for RunsDirectory {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.0) {
            tracing::warn!(%error, path = %self.0.display(), "cannot remove");
        }
    }
}

/// Runs `caraware simulate --envs N` in turn.
///
/// # Errors
/// A run fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let caraware = install::program(&options.bin, "caraware")?;
    let runs = RunsDirectory(std::env::temp_dir().join(format!("caraware-bench-envs-{}", std::process::id())));
    let cores = cores::available();
    let mut report = BenchReport::new(
        "envs",
        "Environments side by side",
        format!(
            "`caraware simulate town --envs N` runs SUMO, dynamics and sensors N times, without a learner. The figures are vehicle-steps \
             (observations) per wall second, from the moment when all processes are ready to the end. The base is one environment whose \
             processes share one core. A ratio compares two runs of one round; it is the median of {ROUNDS} rounds (smallest–largest). The \
             ideal is the number of environments, or of cores ({}) if that is less.",
            cores.len()
        ),
    );
    let mut lines = Vec::new();
    for load in &LOADS {
        lines.push(compare(load, &caraware, &runs.0, &cores, &mut report)?);
    }
    report.curves.push(ReportCurve {
        name: "envs".into(),
        title: "Environments side by side".into(),
        x: "environments".into(),
        y: "vehicle-steps, of those of one environment on one core".into(),
        logarithmic: [false, false],
        lines,
    });
    Ok(report)
}

/// Measures one load in all rounds, and adds its table and figures to the report.
fn compare(
    load: &TownLoad,
    caraware: &Path,
    runs: &Path,
    cores: &[usize],
    report: &mut BenchReport,
) -> Result<CurveLine, Exit> {
    let mut base = Vec::new();
    let mut rates = vec![Vec::new(); ENVIRONMENTS.len()];
    for _ in 0..ROUNDS {
        base.push(rate(load, 1, cores.get(..1), caraware, runs)?);
        for (place, envs) in ENVIRONMENTS.into_iter().enumerate() {
            rates[place].push(rate(load, envs, None, caraware, runs)?);
        }
    }
    let columns = ["environments", "vehicle-steps/s", "of the base", "of the ideal"];
    let mut table = ReportTable::new(load.name, &columns);
    let thousand =
        |rates: &[f64]| MedianSpread::of(rates.iter().map(|rate| rate / 1e3)).map(|spread| format!("{spread:.0} k"));
    table.row(["1, on one core (base)".into(), thousand(&base)?, "1".into(), "1".into()]);
    let mut points = Vec::new();
    for (envs, rates) in ENVIRONMENTS.into_iter().zip(&rates) {
        let ratio = MedianSpread::of(rates.iter().zip(&base).map(|(rate, base)| rate / base))?;
        #[expect(clippy::cast_precision_loss, reason = "small numbers")]
        let (x, ideal) = (envs as f64, envs.min(cores.len()) as f64);
        let of_ideal = format!("{:.0} %", 100.0 * ratio.median / ideal);
        table.row([envs.to_string(), thousand(rates)?, format!("{ratio:.2} ×"), of_ideal]);
        report.figure(
            format!("{}, {envs} environments, of one on one core", load.short),
            ratio.median,
        );
        points.push([x, ratio.median]);
    }
    report.tables.push(table);
    Ok(CurveLine {
        name: load.name.into(),
        points,
    })
}

/// Vehicle-steps per second of one run.
fn rate(load: &TownLoad, envs: usize, cores: Option<&[usize]>, caraware: &Path, runs: &Path) -> Result<f64, Exit> {
    let settings = [
        format!("run.envs={envs}"),
        format!("traffic.cavs={}", load.cavs),
        format!("traffic.others={}", load.others),
        format!("traffic.pedestrians={}", load.pedestrians),
        format!("episode.ticks={}", load.ticks),
        "episode.training_episodes=1".into(),
        "fanout.enabled=false".into(),
    ];
    let mut command = Command::new(caraware);
    command.args(["simulate", "town", "--name", "run", "--runs"]).arg(runs);
    settings.iter().for_each(|setting| {
        command.args(["--set", setting]);
    });
    let output = cores::within(cores, || command.stdin(Stdio::null()).output())
        .map_err(|error| Exit::io("start", caraware, &error))?;
    if !output.status.success() {
        return Err(Exit::run(
            format!("a run of {envs} environments ended with {}", output.status),
            String::from_utf8_lossy(&output.stderr).into_owned(),
        ));
    }
    let path = runs.join("run").join("report.json");
    let text = fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
    let result: RunFigures =
        serde_json::from_str(&text).map_err(|error| Exit::run(format!("{}: {error}", path.display()), ""))?;
    let run = runs.join("run");
    fs::remove_dir_all(&run).map_err(|error| Exit::io("remove", &run, &error))?;
    #[expect(clippy::cast_precision_loss, reason = "a rate")]
    Ok(result.vehicle_steps as f64 / result.wall_s)
}
