//! The `main` of a process binary: its log, its run file, its failure and its exit code.

use std::{io::Write as _, path::Path, process::ExitCode};

use tracing_subscriber::{EnvFilter, Layer, Registry, layer::SubscriberExt as _, util::SubscriberInitExt as _};

use crate::{failure::Failure, process::Process};

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

/// Prints `usage` and ends this program if its arguments ask for help. For programs that people rarely start by hand.
pub fn answer_help(usage: &str) {
    if std::env::args()
        .skip(1)
        .any(|argument| argument == "--help" || argument == "-h")
    {
        // A closed standard output (`| head`) has read what it wanted.
        let _ = writeln!(std::io::stdout(), "{usage}");
        std::process::exit(0);
    }
}

/// Says what is wrong with the arguments of this program and how it is used, and ends it with exit code 2.
pub fn misused(why: &str, usage: &str) -> ! {
    let _ = writeln!(std::io::stderr(), "error: {why}\n\n{usage}");
    std::process::exit(2)
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
    // `replay` is in the place of another process.
    let program = std::env::args_os().next().unwrap_or_default();
    let program = Path::new(&program).file_name().unwrap_or_default().to_string_lossy();
    let usage =
        format!("usage: {program} RUN_FILE\n\nA process of a run, which `caraware` starts: see `caraware --help`.");
    answer_help(&usage);
    let Some(run_file) = std::env::args_os().nth(1) else {
        misused("RUN_FILE is missing", &usage);
    };
    let log = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .with_filter(EnvFilter::try_from_default_env().unwrap_or_else(|_| "info,zenoh=error".into()));
    let hearer = hearer.with_filter(EnvFilter::new(heard));
    tracing_subscriber::registry().with(hearer).with(log).init();
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
