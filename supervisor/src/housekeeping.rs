//! What the supervisor looks after beside the processes: the space of the run's disk, the size of the logs, and unfinished
//! files in shared memory.

use std::{
    fs::{File, OpenOptions},
    io::{Read as _, Seek as _, SeekFrom, Write as _},
    path::{Path, PathBuf},
    sync::mpsc::{RecvTimeoutError, Sender, channel},
    thread::JoinHandle,
    time::Duration,
};

use ipc_schema::{run::RunFile, services};
use serde::Serialize;

use crate::{display::notice, prepare::free_bytes};

/// Time between two looks.
const INTERVAL: Duration = Duration::from_millis(250);
/// Every so many looks there is one at the files in shared memory: any process, the supervisor too, may wait for one that a killed
/// process has left unfinished.
const TURNS_OF_MEMORY: u32 = 4;
/// Below this many free bytes the disk counts as full: file systems keep the last blocks to themselves.
const FULL_BYTES: u64 = 64 << 10;
/// Largest size of a log, bytes. A longer one is kept in two parts of this size, its first and its newest.
const LOG_BYTES: u64 = 32 << 20;

/// What happened to the disk and the logs during a run.
#[derive(Debug, Clone, Default, Serialize)]
pub struct HousekeepingFigures {
    /// Times at which the disk was found full.
    pub disk_full: u64,
    /// Logs of which only the first and the newest part were kept.
    pub shortened_logs: Vec<PathBuf>,
}

/// The thread that looks after a run. It ends when this is dropped.
#[derive(Debug)]
pub struct Housekeeping {
    thread: Option<(Sender<()>, JoinHandle<HousekeepingFigures>)>,
}

impl Housekeeping {
    /// Starts to look after `run`.
    #[must_use]
    pub fn start(run: &RunFile) -> Self {
        let run_dir = run.run_dir.clone();
        let logs: Vec<PathBuf> = (0..run.config.run.envs)
            .map(|index| run.environment(index).run_dir.join("logs"))
            .collect();
        let memory = run.shared_memory.clone();
        let (sender, ended) = channel::<()>();
        let look = move || {
            let (mut figures, mut was_full) = (HousekeepingFigures::default(), false);
            for turn in 1_u32.. {
                if ended.recv_timeout(INTERVAL) != Err(RecvTimeoutError::Timeout) {
                    break;
                }
                if turn.is_multiple_of(TURNS_OF_MEMORY) {
                    services::remove_unfinished(&memory);
                }
                was_full = look_at_disk(&run_dir, was_full, &mut figures);
                logs.iter().for_each(|logs| shorten_logs(logs, LOG_BYTES, &mut figures));
            }
            figures
        };
        let thread = std::thread::Builder::new().name("housekeeping".into()).spawn(look);
        Self {
            thread: thread.ok().map(|thread| (sender, thread)),
        }
    }

    /// Ends the thread and returns what it has found.
    #[must_use]
    pub fn finish(mut self) -> HousekeepingFigures {
        let Some((sender, thread)) = self.thread.take() else {
            return HousekeepingFigures::default();
        };
        drop(sender);
        thread.join().unwrap_or_default()
    }
}

/// True if the disk of `path` is full.
#[must_use]
pub fn is_disk_full(path: &Path) -> bool {
    free_bytes(path).is_ok_and(|free| free < FULL_BYTES)
}

/// Reports a disk that becomes full, and one that has space again. True if it is full.
fn look_at_disk(run_dir: &Path, was_full: bool, figures: &mut HousekeepingFigures) -> bool {
    let is_full = is_disk_full(run_dir);
    match (was_full, is_full) {
        (false, true) => {
            figures.disk_full += 1;
            notice(&format!(
                "the disk of {} is full: the run waits where it must write, and drops TensorBoard's events, plots and contacts",
                run_dir.display()
            ));
        }
        (true, false) => notice(&format!("the disk of {} has space again", run_dir.display())),
        _ => {}
    }
    is_full
}

/// Shortens the logs in a directory that are longer than `limit_bytes`.
fn shorten_logs(directory: &Path, limit_bytes: u64, figures: &mut HousekeepingFigures) {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let logs = entries.map(|entry| entry.path()).filter(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let is_part = name.ends_with(".first.log") || name.ends_with(".newest.log");
        name.ends_with(".log") && !is_part
    });
    for log in logs {
        if log.metadata().is_ok_and(|data| data.len() > limit_bytes) {
            if let Err(error) = shorten(&log, limit_bytes) {
                tracing::debug!(%error, log = %log.display(), "cannot be shortened");
                continue;
            }
            if !figures.shortened_logs.contains(&log) {
                notice(&format!(
                    "{} is longer than {} MiB: only its first and its newest part are kept",
                    log.display(),
                    limit_bytes >> 20
                ));
                figures.shortened_logs.push(log);
            }
        }
    }
}

/// Moves the content of a log, the first time to `<name>.first.log`, later to `<name>.newest.log`. Processes write at the end of the file,
/// wherever that is; a line that is written between the copy and the cut is lost.
fn shorten(log: &Path, limit_bytes: u64) -> std::io::Result<()> {
    let first = log.with_extension("first.log");
    let is_first = !first.exists();
    let copy = if is_first {
        first
    } else {
        log.with_extension("newest.log")
    };
    let mut file = OpenOptions::new().read(true).write(true).open(log)?;
    // A process that writes faster than this looks has written more than the limit.
    let end = file.metadata()?.len();
    let begin = if is_first { 0 } else { end.saturating_sub(limit_bytes) };
    file.seek(SeekFrom::Start(begin))?;
    let copied = std::io::copy(&mut (&file).take(limit_bytes), &mut File::create(&copy)?);
    file.set_len(0)?;
    let mut appended = OpenOptions::new().append(true).open(log)?;
    writeln!(appended, "… earlier lines are in {}", copy.display())?;
    copied.map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_log_keeps_its_first_and_its_newest_part() {
        let directory = tempfile::tempdir().unwrap();
        let log = directory.path().join("trainer.log");
        let mut writer = OpenOptions::new().create(true).append(true).open(&log).unwrap();
        let mut figures = HousekeepingFigures::default();
        for number in 0..10_000 {
            writeln!(writer, "line {number}").unwrap();
            shorten_logs(directory.path(), 1000, &mut figures);
        }
        let read = |end: &str| std::fs::read_to_string(log.with_extension(end)).unwrap();
        assert!(read("first.log").starts_with("line 0\nline 1\n"));
        let newest = read("newest.log") + &read("log");
        assert!(newest.ends_with("line 9998\nline 9999\n"), "{newest}");
        assert_eq!(figures.shortened_logs, [log]);
        let bytes: u64 = std::fs::read_dir(directory.path())
            .unwrap()
            .map(|entry| entry.unwrap().metadata().unwrap().len())
            .sum();
        assert!(bytes <= 3 * 1100, "{bytes}");
    }
}
