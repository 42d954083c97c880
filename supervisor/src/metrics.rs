//! `caraware metrics`: how a live run fares, as lines of JSON or for Prometheus.

use std::{os::unix::process::CommandExt as _, path::Path, process::Command};

use crate::{cli::MetricsArgs, failure::Exit, install, registry};

/// This process becomes the Python program that asks `caraware ps --json` again and again until the run ends.
///
/// # Errors
/// The run is not alive, or Python is not installed.
pub fn metrics(args: &MetricsArgs) -> Result<(), Exit> {
    let run = registry::find(args.run.as_deref())?;
    let python = install::python(&install::programs()?)?;
    let program = std::env::current_exe().map_err(|error| Exit::io("find", Path::new("caraware"), &error))?;
    let mut command = Command::new(&python);
    command
        .args(["-m", "caraware.report.live"])
        .arg(&run.name)
        .arg(format!("--interval-s={}", args.interval_s))
        .args(args.prometheus.iter().map(|address| format!("--prometheus={address}")))
        .env("CARAWARE", program);
    let error = command.exec();
    Err(Exit::io("start", &python, &error))
}
