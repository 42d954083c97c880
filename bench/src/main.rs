//! `caraware bench`: measures a part of caraware on this machine, compared with other tools for the same work.
//!
//! The `caraware` command starts this program with its arguments. Each part has a file, and its result is a [`BenchReport`] (decision 9).

mod allocator;
mod cli;
mod cores;
mod driving;
mod endurance;
mod envs;
mod fanout;
mod guard;
mod heroes;
mod ipc;
mod lidar;
mod overhead;
mod page;
mod peers;
mod plots;
mod quiet;
mod record;
mod report;
mod scale;
mod sides;
mod sights;
mod soak;
mod stages;
mod target;
mod trainer;
mod v2x;
mod watch;

use std::{io::Write as _, path::PathBuf, process::ExitCode};

use caraware::{failure::Exit, install};
use clap::Parser as _;

use crate::cli::{BenchArgs, BenchDriver, BenchPart};
use report::{BenchReport, CurveLine, MedianSpread, ReportCurve, ReportTable};

/// Options of a measurement.
#[derive(Debug, Clone)]
pub struct BenchOptions {
    /// Directory of caraware's programs.
    pub bin: PathBuf,
    /// Python that has the peers installed, if there is one.
    pub python: Option<PathBuf>,
    /// True if only a small case is measured, whose figures are not kept.
    pub quick: bool,
    /// Time for which runs are disturbed or watched, minutes.
    pub minutes: u32,
    /// Seed of the disturbances.
    pub seed: u64,
    /// The map that is driven through; the town without one.
    pub map: Option<String>,
    /// The policy whose driving is measured.
    pub policy: Option<PathBuf>,
    /// Trips of each driver.
    pub trips: u32,
    /// The drivers; empty: all.
    pub drivers: Vec<BenchDriver>,
}

fn main() -> ExitCode {
    // Wrong arguments are refused, and the help is printed, without another process.
    let args = BenchArgs::parse();
    if let Some(code) = guard::measured_elsewhere() {
        return code;
    }
    match bench(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(exit) => exit.report(),
    }
}

/// Measures the parts, prints their reports, and writes the files that the arguments ask for.
///
/// # Errors
/// A program or package is missing, or a measurement fails.
fn bench(args: &BenchArgs) -> Result<(), Exit> {
    let bin = install::programs()?;
    // Only the benchmarks need the peers. Without them caraware is measured alone.
    let python = args
        .python
        .clone()
        .or_else(|| install::environment_python(&bin, install::PEERS));
    let python = python.or_else(|| install::python(&bin).ok());
    let options = BenchOptions {
        bin,
        python,
        quick: args.quick,
        minutes: args.minutes,
        seed: args.seed,
        policy: args
            .policy
            .as_ref()
            .map(|path| std::path::absolute(path).unwrap_or_else(|_| path.clone())),
        trips: args.trips,
        drivers: args.drivers.clone(),
        map: args.map.clone(),
    };
    let parts = match args.part {
        BenchPart::All => BenchPart::speeds().collect(),
        part => vec![part],
    };
    let mut reports = Vec::new();
    for part in parts {
        let report = measure(part, &options)?;
        // A closed standard output (`| head`) is ignored: the measurement is done.
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
        match reports.as_slice() {
            [report] => report::write_json(path, report)?,
            reports => report::write_json(path, reports)?,
        }
    }
    if let Some(directory) = &args.plots {
        plots::draw(&install::python(&options.bin)?, &reports, directory)?;
    }
    let faults: Vec<&str> = reports
        .iter()
        .flat_map(|report| &report.faults)
        .map(String::as_str)
        .collect();
    match faults.is_empty() {
        true => Ok(()),
        false => Err(Exit::run(format!("faults were found: {}", faults.join("; ")), "")),
    }
}

fn measure(part: BenchPart, options: &BenchOptions) -> Result<BenchReport, Exit> {
    match part {
        BenchPart::Driving => driving::measure(options),
        BenchPart::Heroes => heroes::measure(options),
        BenchPart::Endurance => endurance::measure(options),
        BenchPart::Soak => soak::measure(options),
        BenchPart::Envs => envs::measure(options),
        BenchPart::Ipc => ipc::measure(options),
        BenchPart::Lidar => lidar::measure(options),
        BenchPart::Camera => sights::camera(options),
        BenchPart::Radar => sights::radar(options),
        BenchPart::Fanout => fanout::measure(options),
        BenchPart::Trainer => trainer::measure(options),
        BenchPart::Overhead => overhead::measure(options),
        BenchPart::Scale => scale::measure(options),
        BenchPart::Peers => peers::measure(options),
        BenchPart::Record => record::measure(options),
        BenchPart::Watch => watch::measure(options),
        BenchPart::V2x => v2x::measure(options),
        BenchPart::All => Err(Exit::config("`all` is not a part", "")),
    }
}

/// Ports below Linux's ephemeral ones (32768 to 60999), which outgoing connections of other programs may take while a run starts again.
const PORTS: std::ops::Range<u16> = 20_000..30_000;

/// A port of this machine that no process uses, and that another benchmark beside this one hardly draws.
///
/// # Errors
/// There is none.
fn free_port() -> Result<u16, Exit> {
    let first = fastrand::u16(PORTS);
    let ports = (first..PORTS.end).chain(PORTS.start..first);
    let is_free = |port: &u16| std::net::TcpListener::bind(("127.0.0.1", *port)).is_ok();
    ports
        .into_iter()
        .find(is_free)
        .ok_or_else(|| Exit::run(format!("no port of {PORTS:?} is free"), ""))
}
