//! Measures what a recording costs a run, as a watcher and without loss, compared with the same run alone.

use std::{
    fs,
    path::Path,
    process::{Command, Stdio},
};

use caraware::{failure::Exit, generate::GeneratedCity, install, install::Install};
use serde_json::Value;

use super::{BenchOptions, BenchReport, MedianSpread, ReportTable, sides::BenchDirectory};

/// Vehicles, simulated seconds, rounds.
const SIZE: (u32, f64, usize) = (1000, 240.0, 12);
/// The same with `--quick`.
const QUICK: (u32, f64, usize) = (60, 6.0, 1);
/// The manners that are compared with a run without a recording.
const MANNERS: [&str; 2] = ["watching", "lossless"];

/// A finished run.
struct RecordedRun {
    wall_s: f64,
    /// Processor time of `recorder`, seconds; 0 without one.
    recorder_cpu_s: f64,
    message_mb: f64,
    file_mb: f64,
    missed_ticks: f64,
}

/// Runs a generated city alone, watched, and recorded without loss, in turn.
///
/// # Errors
/// A run fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let (vehicles, duration_s, rounds) = if options.quick { QUICK } else { SIZE };
    let place = BenchDirectory::new("record")?;
    let sumocfg =
        GeneratedCity::of(vehicles, duration_s, 0.1, 1).write(&Install::find()?, &place.path().join("city"))?;
    let caraware = install::program(&options.bin, "caraware")?;
    let mut table = ReportTable::new(
        "Rounds",
        &[
            "round",
            "recording",
            "wall, s",
            "of alone",
            "recorder, CPU s",
            "messages, MB/s",
            "file, MB",
            "missed",
        ],
    );
    let mut ratios = [const { Vec::new() }; MANNERS.len()];
    let mut rates = Vec::new();
    for round in 1..=rounds {
        // The order changes from round to round, so that what warms up favours none.
        let alone_first = round % 2 == 1;
        let mut alone = None;
        if alone_first {
            alone = Some(run(&caraware, &sumocfg, &place, "off")?);
        }
        let mut recorded = Vec::new();
        for manner in MANNERS {
            recorded.push(run(&caraware, &sumocfg, &place, manner)?);
        }
        let alone = match alone {
            Some(alone) => alone,
            None => run(&caraware, &sumocfg, &place, "off")?,
        };
        table.row([
            round.to_string(),
            "none".into(),
            format!("{:.2}", alone.wall_s),
            "1".into(),
            String::new(),
            String::new(),
            String::new(),
            String::new(),
        ]);
        for ((manner, run), ratios) in MANNERS.into_iter().zip(&recorded).zip(&mut ratios) {
            let ratio = run.wall_s / alone.wall_s;
            ratios.push(ratio);
            table.row([
                round.to_string(),
                manner.into(),
                format!("{:.2}", run.wall_s),
                format!("{ratio:.3}"),
                format!("{:.2}", run.recorder_cpu_s),
                format!("{:.0}", run.message_mb / run.wall_s),
                format!("{:.1}", run.file_mb),
                format!("{:.0}", run.missed_ticks),
            ]);
        }
        rates.extend(
            recorded
                .iter()
                .skip(1)
                .map(|run| run.message_mb / run.recorder_cpu_s.max(1e-9)),
        );
    }
    let [watching, lossless] = ratios;
    let (watching, lossless, rate) = (
        MedianSpread::of(watching)?,
        MedianSpread::of(lossless)?,
        MedianSpread::of(rates)?,
    );
    let mut report = BenchReport::new(
        "record",
        "Recording a run",
        format!(
            "{vehicles} vehicles on a generated city, {duration_s} s at steps of 0.1 s, `caraware simulate` at full speed without viewers, in \
             turn alone, with `--record=watching` and with `--record`, default channels. The ratio of wall times to the run alone is \
             {watching:.3} watching and {lossless:.3} without loss. `recorder` takes {rate:.0} MB of messages per second of its own processor \
             time (copying, compressing, hashing, writing)."
        ),
    );
    report.figure("wall time, watching, of alone", watching.median);
    report.figure("wall time, lossless, of alone", lossless.median);
    report.figure("MB per processor second of the recorder", rate.median);
    report.tables.push(table);
    Ok(report)
}

/// Runs the scenario once, recorded in this manner.
fn run(caraware: &Path, sumocfg: &Path, place: &BenchDirectory, manner: &str) -> Result<RecordedRun, Exit> {
    let output = Command::new(caraware)
        .arg("simulate")
        .arg(sumocfg)
        .args(["--quiet", "--name", "run", "--runs"])
        .arg(place.path())
        .args([
            "--set",
            "fanout.enabled=false",
            "--set",
            &format!("record.manner={manner}"),
        ])
        .args([
            "--set",
            "map.origin_latitude_deg=52.0",
            "--set",
            "map.origin_longitude_deg=10.0",
        ])
        .stdin(Stdio::null())
        .output()
        .map_err(|error| Exit::io("start", caraware, &error))?;
    if !output.status.success() {
        return Err(Exit::run(
            format!("a run ended with {}", output.status),
            String::from_utf8_lossy(&output.stderr).into_owned(),
        ));
    }
    let directory = place.path().join("run");
    let path = directory.join("report.json");
    let text = fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
    let report: Value =
        serde_json::from_str(&text).map_err(|error| Exit::run(format!("{}: {error}", path.display()), ""))?;
    fs::remove_dir_all(&directory).map_err(|error| Exit::io("remove", &directory, &error))?;
    let number = |pointer: &str| report.pointer(pointer).and_then(Value::as_f64).unwrap_or(0.0);
    Ok(RecordedRun {
        wall_s: number("/wall_s"),
        recorder_cpu_s: number("/processes/recorder/cpu_s"),
        message_mb: number("/environments/0/recording/message_bytes") / 1e6,
        file_mb: number("/environments/0/recording/file_bytes") / 1e6,
        missed_ticks: number("/environments/0/recording/missed_ticks"),
    })
}
