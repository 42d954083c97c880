//! `caraware metrics`: how a live run fares, as lines of JSON or for Prometheus.

use crate::{cli::MetricsArgs, failure::Exit, install, registry};

/// This process becomes the Python program that asks `caraware ps --json` again and again until the run ends.
///
/// # Errors
/// The run is not alive, or Python is not installed.
pub fn metrics(args: &MetricsArgs) -> Result<(), Exit> {
    let mut arguments = vec![
        registry::find(args.run.as_deref())?.name,
        format!("--interval-s={}", args.interval_s),
    ];
    arguments.extend(args.prometheus.iter().map(|address| format!("--prometheus={address}")));
    install::become_module("caraware.report.live", arguments)
}
