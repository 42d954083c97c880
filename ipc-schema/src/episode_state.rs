//! What a process has counted when an episode begins, as a file: a process that is started again continues its report from there.
//!
//! Everything else that a simulator process knows begins anew with an episode, so an episode is where it can start again.

use std::path::{Path, PathBuf};

use serde::{Serialize, de::DeserializeOwned};

use crate::{
    failure::{FILE_HELP, Failure, FailureKind},
    process::Process,
    run::RunFile,
    storage,
};

/// Directory of these files below that of an environment.
const DIRECTORY: &str = "state";

/// Stores what `process` has counted before `tick`, the first one of an episode.
///
/// # Errors
/// Not writable.
pub fn store(run: &RunFile, process: Process, tick: u64, state: &impl Serialize) -> Result<(), Failure> {
    let directory = run.run_dir.join(DIRECTORY);
    let path = directory.join(file_name(process, tick));
    let partial = path.with_extension("partial");
    let written = storage::when_there_is_space(&path, || {
        std::fs::create_dir_all(&directory)
            .and_then(|()| std::fs::write(&partial, serde_json::to_vec(state)?))
            .and_then(|()| std::fs::rename(&partial, &path))
    });
    written.map_err(|error| failed("write", &path, &error))
}

/// What `process` stored for `tick`; `None` if it stored nothing, as before the first tick of a run.
///
/// # Errors
/// The file is not readable, or another version wrote it.
pub fn load<T: DeserializeOwned>(run: &RunFile, process: Process, tick: u64) -> Result<Option<T>, Failure> {
    let path = run.run_dir.join(DIRECTORY).join(file_name(process, tick));
    let text = match std::fs::read(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(failed("read", &path, &error)),
    };
    serde_json::from_slice(&text)
        .map(Some)
        .map_err(|error| failed("read", &path, &error))
}

/// First ticks of the episodes for which `process` of the environment in `run_dir` has stored a state, ascending.
#[must_use]
pub fn stored_ticks(run_dir: &Path, process: Process) -> Vec<u64> {
    let prefix = format!("{process}-");
    let entries = std::fs::read_dir(run_dir.join(DIRECTORY))
        .into_iter()
        .flatten()
        .flatten();
    let mut ticks: Vec<u64> = entries
        .filter_map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            name.strip_prefix(&prefix)?.strip_suffix(".json")?.parse().ok()
        })
        .collect();
    ticks.sort_unstable();
    ticks
}

/// Removes what no restart needs any more: it begins at the newest state at or before `committed_ticks`, or later.
pub fn forget_before(run: &RunFile, process: Process, committed_ticks: u64) {
    let ticks = stored_ticks(&run.run_dir, process);
    let needed = ticks.partition_point(|tick| *tick <= committed_ticks).saturating_sub(1);
    for tick in &ticks[..needed] {
        let path = run.run_dir.join(DIRECTORY).join(file_name(process, *tick));
        if let Err(error) = std::fs::remove_file(&path) {
            tracing::debug!(%error, path = %path.display(), "cannot remove an old state");
        }
    }
}

/// Removes the states of `process` behind `tick`: the run goes another way from there.
///
/// # Errors
/// A file cannot be removed.
pub fn forget_after(run_dir: &Path, process: Process, tick: u64) -> Result<(), Failure> {
    for later in stored_ticks(run_dir, process)
        .into_iter()
        .filter(|stored| *stored > tick)
    {
        let path = run_dir.join(DIRECTORY).join(file_name(process, later));
        std::fs::remove_file(&path).map_err(|error| failed("remove", &path, &error))?;
    }
    Ok(())
}

fn file_name(process: Process, tick: u64) -> PathBuf {
    format!("{process}-{tick:012}.json").into()
}

fn failed(action: &str, path: &Path, reason: &dyn std::fmt::Display) -> Failure {
    Failure::new(
        FailureKind::Run,
        format!("cannot {action} {}: {reason}", path.display()),
    )
    .with_help(FILE_HELP)
}
