//! `caraware bench`: measures a part of caraware on this machine, side by side with what others use for the same work.
//!
//! The `caraware` command starts this program with its arguments. One file for each part; all end in a [`BenchReport`]. Decision 9.

mod cli;
mod envs;
mod fanout;
mod ipc;
mod lidar;
mod overhead;
mod page;
mod peers;
mod plots;
mod report;
mod scale;
mod sides;
mod stages;
mod trainer;

use std::{io::Write as _, path::PathBuf, process::ExitCode};

use caraware::{failure::Exit, install};
use clap::Parser as _;

use crate::cli::{BenchArgs, BenchPart};
use report::{BenchReport, CurveLine, MedianSpread, ReportCurve, ReportTable};

/// What every measurement may need.
#[derive(Debug, Clone)]
pub struct BenchOptions {
    /// Directory of our programs.
    pub bin: PathBuf,
    /// Python that has the peers installed, if there is one.
    pub python: Option<PathBuf>,
    /// Whether only the way is tried: small, short, no figures to keep.
    pub quick: bool,
}

fn main() -> ExitCode {
    match bench(&BenchArgs::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(exit) => exit.report(),
    }
}

/// Measures, prints, and writes what is asked for.
///
/// # Errors
/// Something the measurement needs is missing, or it fails.
fn bench(args: &BenchArgs) -> Result<(), Exit> {
    let bin = install::programs()?;
    // The peers are Python packages that nothing else needs: without them, ours is measured alone.
    let python = args
        .python
        .clone()
        .or_else(|| install::environment_python(&bin, install::PEERS));
    let python = python.or_else(|| install::python(&bin).ok());
    let options = BenchOptions {
        bin,
        python,
        quick: args.quick,
    };
    let parts = match args.part {
        BenchPart::All => BenchPart::measured().collect(),
        part => vec![part],
    };
    let mut reports = Vec::new();
    for part in parts {
        let report = measure(part, &options)?;
        // A reader that went away (`| head`) does not undo a measurement.
        let _ = writeln!(std::io::stdout(), "{report}");
        if args.keep {
            page::keep(&report)?;
        }
        reports.push(report);
    }
    if args.keep {
        page::write()?;
    }
    if let Some(path) = &args.json {
        let text = match reports.as_slice() {
            [report] => serde_json::to_string_pretty(report),
            reports => serde_json::to_string_pretty(reports),
        };
        std::fs::write(path, text.unwrap_or_default() + "\n").map_err(|error| Exit::io("write", path, &error))?;
    }
    if let Some(directory) = &args.plots {
        plots::draw(&install::python(&options.bin)?, &reports, directory)?;
    }
    Ok(())
}

fn measure(part: BenchPart, options: &BenchOptions) -> Result<BenchReport, Exit> {
    match part {
        BenchPart::Envs => envs::measure(options),
        BenchPart::Ipc => ipc::measure(options),
        BenchPart::Lidar => lidar::measure(options),
        BenchPart::Fanout => fanout::measure(options),
        BenchPart::Trainer => trainer::measure(options),
        BenchPart::Overhead => overhead::measure(options),
        BenchPart::Scale => scale::measure(options),
        BenchPart::Peers => peers::measure(options),
        BenchPart::All => Err(Exit::config("`all` is not a part", "")),
    }
}
