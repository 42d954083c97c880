//! The `main` of a process binary: its log, its run file, its failure and its exit code.

use std::{path::Path, process::ExitCode};

use tracing_subscriber::{EnvFilter, Layer, Registry, layer::SubscriberExt as _, util::SubscriberInitExt as _};

use crate::{
    failure::{Failure, FailureKind},
    process::Process,
};

/// Sends the warnings of this process to standard error, a line each. For programs that have no log of their own.
pub fn show_warnings() {
    let log = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .without_time()
        .with_target(false)
        .with_filter(EnvFilter::try_from_default_env().unwrap_or_else(|_| "warn".into()));
    tracing_subscriber::registry().with(log).init();
}

/// The `main` of a process binary: reads the run file named by the first argument, logs to standard error, runs `body`,
/// and turns its failure into a failure file and an exit code.
pub fn main(process: Process, body: impl FnOnce(&Path) -> Result<(), Failure>) -> ExitCode {
    main_heard(process, tracing_subscriber::layer::Identity::new(), "off", body)
}

/// As [`main`], with a layer that receives what the libraries log, as far as the filter `heard` lets it through.
pub fn main_heard(
    process: Process,
    hearer: impl Layer<Registry> + Send + Sync + 'static,
    heard: &str,
    body: impl FnOnce(&Path) -> Result<(), Failure>,
) -> ExitCode {
    let log = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .with_filter(EnvFilter::try_from_default_env().unwrap_or_else(|_| "info,zenoh=error".into()));
    let hearer = hearer.with_filter(EnvFilter::new(heard));
    tracing_subscriber::registry().with(hearer).with(log).init();
    let Some(run_file) = std::env::args_os().nth(1) else {
        tracing::error!("usage: {process} RUN_FILE   (started by `caraware`, not by hand)");
        return ExitCode::from(FailureKind::Config.exit_code());
    };
    let run_file = Path::new(&run_file);
    match body(run_file) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            tracing::error!(help = failure.help.as_deref(), "{}", failure.message);
            if let Some(run_dir) = run_file.parent() {
                failure.write(run_dir, process.name());
            }
            ExitCode::from(failure.kind.exit_code())
        }
    }
}
