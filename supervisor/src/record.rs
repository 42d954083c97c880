//! `caraware record`, `diff` and `export`: a recording beside a live run, two recordings compared, and one in other formats.

use std::{
    cell::Cell,
    ffi::OsString,
    path::{Path, PathBuf},
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use ipc_schema::{channel::Channel, run::RunFile};
use recorder::{
    diff,
    file::{RECORDING, RecordingError, reader::RecordingReader},
    outside,
    process::free_path,
};

use crate::{
    cli::{DiffArgs, ExportArgs, RecordArgs},
    failure::Exit,
    install, registry,
};

/// Time between two looks at whether the run is alive.
const CHECK: Duration = Duration::from_millis(200);

impl From<RecordingError> for Exit {
    fn from(error: RecordingError) -> Self {
        let failure = ipc_schema::failure::Failure::from_error(ipc_schema::failure::FailureKind::Config, &error);
        Self::Failure(failure.with_help(error.advice()))
    }
}

/// Records a live run until it ends, or until Ctrl-C.
///
/// # Errors
/// The run is not alive, a channel does not exist, or the file cannot be written.
pub fn record(args: &RecordArgs) -> Result<(), Exit> {
    let run = registry::find(args.run.as_deref())?;
    let env = args.env.unwrap_or(0);
    if env >= run.config.run.envs {
        return Err(Exit::config(
            format!("the run {} has no environment {env}", run.name),
            format!("its environments are 0 to {}", run.config.run.envs - 1),
        ));
    }
    let whole_run_dir = run.run_dir.clone();
    let mut run = RunFile::read(&run.environment(env).run_dir.join("run.json"))?;
    run.config.record.compression = args.compression.unwrap_or(run.config.record.compression);
    let channels = chosen_channels(args, &run)?;
    let path = match &args.output {
        Some(path) => path.clone(),
        None => free_path(&run.run_dir).ok_or_else(|| Exit::run("the run has too many recordings", "name a file"))?,
    };
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop))
            .map_err(|error| Exit::run(format!("cannot watch signals: {error}"), ""))?;
    }
    crate::say!(
        "recording {} into {} until it ends, or until Ctrl-C",
        run.name,
        path.display()
    );
    // Its lock, not its process: one that has ended is there until its parent has waited for it.
    let checked = Cell::new(Instant::now());
    let is_alive = || {
        if checked.get().elapsed() < CHECK {
            return true;
        }
        checked.set(Instant::now());
        registry::is_alive(&whole_run_dir)
    };
    let figures = outside::record(&run, &channels, &path, &stop, is_alive)?;
    #[expect(clippy::cast_precision_loss, reason = "megabytes for people")]
    let megabytes = |bytes: u64| bytes as f64 / 1e6;
    crate::say!(
        "{}: {:.1} MB of {:.1} MB, {} ticks missed",
        path.display(),
        megabytes(figures.file_bytes),
        megabytes(figures.message_bytes),
        figures.missed_ticks
    );
    Ok(())
}

/// The channels that the command names, or those of the configuration.
fn chosen_channels(args: &RecordArgs, run: &RunFile) -> Result<Vec<Channel>, Exit> {
    let names = match args.channel.as_slice() {
        [] => run.config.record.channels.as_slice(),
        names => names,
    };
    let by_name = |name: &String| {
        let channel = Channel::ALL.into_iter().find(|channel| channel.name() == name);
        channel.ok_or_else(|| {
            let names = Channel::ALL.map(Channel::name).join(", ");
            Exit::config(format!("there is no channel \"{name}\""), format!("channels: {names}"))
        })
    };
    names.iter().map(by_name).collect()
}

/// The recording that an argument names: a file, a run's directory, or a run below `runs`.
#[must_use]
pub fn recording_path(argument: &Path, runs: &Path) -> PathBuf {
    let in_directory = |directory: &Path| directory.join(RECORDING);
    if argument.is_dir() {
        return in_directory(argument);
    }
    let of_run = in_directory(&runs.join(argument));
    if !argument.exists() && of_run.exists() {
        of_run
    } else {
        argument.to_owned()
    }
}

/// Compares two recordings, and says where they first differ.
///
/// # Errors
/// A recording cannot be read, or they differ.
pub fn diff(args: &DiffArgs) -> Result<(), Exit> {
    let open = |argument: &PathBuf| RecordingReader::open(&recording_path(argument, &args.runs));
    let (first, second) = (open(&args.first)?, open(&args.second)?);
    if first.start.config_hash != second.start.config_hash {
        crate::say!(
            "the configurations differ (BLAKE3 {} and {})",
            first.start.config_hash,
            second.start.config_hash
        );
    }
    // A network's last bits depend on how many ticks were waiting when it was asked.
    let is_wanted = |channel| args.predictions || channel != Channel::Prediction;
    let comparison = diff::compare(&first, &second, is_wanted);
    if let Some(damage) = &comparison.damage {
        crate::say!("compared up to here: {damage}");
    }
    match comparison.first {
        None => {
            crate::say!("{} messages are equal", comparison.compared);
            Ok(())
        }
        Some(difference) => Err(Exit::run(
            format!("the recordings differ first at {difference}"),
            "runs of one binary, configuration, seed and list of commands have equal observations",
        )),
    }
}

/// Writes a recording in another format: this process becomes the Python program that does.
///
/// # Errors
/// The recording cannot be read, or Python is not installed.
pub fn export(args: &ExportArgs) -> Result<(), Exit> {
    let path = recording_path(&args.recording, &args.runs);
    RecordingReader::open(&path)?;
    let mut arguments: Vec<OsString> = vec![path.into(), "--to".into(), args.to.clone().into()];
    arguments.extend(
        args.output
            .iter()
            .map(|directory| format!("--output={}", directory.display()).into()),
    );
    arguments.extend(args.jobs.map(|jobs| format!("--jobs={jobs}").into()));
    install::become_module("caraware.data.export", arguments)
}
