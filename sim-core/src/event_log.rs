//! A log of lines in a run's directory `events`, which the run does not need: a full disk costs lines, and the file has a largest size.

use std::{
    fs::{File, OpenOptions},
    io::{Result, Seek as _, SeekFrom, Write as _},
    path::{Path, PathBuf},
};

use ipc_schema::{
    failure::{Failure, FailureKind},
    storage,
};

/// Largest size of a log, bytes: some two million contacts.
const LIMIT_BYTES: u64 = 512 << 20;
/// Bytes that are kept in memory before they are written.
const BUFFER_BYTES: usize = 64 << 10;

/// The lines cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {path}")]
pub struct EventLogError {
    path: PathBuf,
    #[source]
    source: std::io::Error,
}

impl From<EventLogError> for Failure {
    fn from(error: EventLogError) -> Self {
        Self::from_error(FailureKind::Run, &error).with_help("check free space and permissions of the run directory")
    }
}

/// The open log.
#[derive(Debug)]
pub struct EventLog {
    path: PathBuf,
    file: File,
    limit_bytes: u64,
    /// Bytes in the file.
    written_bytes: u64,
    buffer: Vec<u8>,
    buffered_lines: u64,
    dropped_lines: u64,
}

impl EventLog {
    /// Opens the log `events/NAME` of a run with its first `bytes`; what lies behind them is removed.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn of_run(run_dir: &Path, name: &str, bytes: u64) -> std::result::Result<Self, EventLogError> {
        let directory = run_dir.join("events");
        let path = directory.join(name);
        std::fs::create_dir_all(&directory)
            .and_then(|()| Self::open(&path, bytes, LIMIT_BYTES))
            .map_err(|source| EventLogError { path, source })
    }

    /// Opens the log with its first `bytes`, and at most `limit_bytes`.
    fn open(path: &Path, bytes: u64, limit_bytes: u64) -> Result<Self> {
        let mut file = OpenOptions::new().create(true).truncate(false).write(true).open(path)?;
        let written_bytes = bytes.min(file.metadata()?.len());
        file.set_len(written_bytes)?;
        file.seek(SeekFrom::Start(written_bytes))?;
        Ok(Self {
            path: path.into(),
            file,
            limit_bytes,
            written_bytes,
            buffer: Vec::with_capacity(2 * BUFFER_BYTES),
            buffered_lines: 0,
            dropped_lines: 0,
        })
    }

    /// Adds a line, or drops it if the log has its largest size.
    ///
    /// # Errors
    /// The file cannot be written, though the disk is not full.
    pub fn push(&mut self, line: &impl serde::Serialize) -> std::result::Result<(), EventLogError> {
        self.try_push(line).map_err(|source| self.failed(source))
    }

    fn failed(&self, source: std::io::Error) -> EventLogError {
        EventLogError {
            path: self.path.clone(),
            source,
        }
    }

    fn try_push(&mut self, line: &impl serde::Serialize) -> Result<()> {
        let before = self.buffer.len();
        serde_json::to_writer(&mut self.buffer, line)?;
        self.buffer.push(b'\n');
        if self.written_bytes + self.buffer.len() as u64 > self.limit_bytes {
            self.buffer.truncate(before);
            self.drop_lines(1, &format!("it has {} MiB", self.limit_bytes >> 20));
            return Ok(());
        }
        self.buffered_lines += 1;
        match self.buffer.len() > BUFFER_BYTES {
            true => self.try_flush(),
            false => Ok(()),
        }
    }

    /// Writes what is buffered. On a full disk it drops those lines.
    ///
    /// # Errors
    /// The file cannot be written, though the disk is not full.
    pub fn flush(&mut self) -> std::result::Result<(), EventLogError> {
        self.try_flush().map_err(|source| self.failed(source))
    }

    fn try_flush(&mut self) -> Result<()> {
        match self.file.write_all(&self.buffer) {
            Ok(()) => self.written_bytes += self.buffer.len() as u64,
            Err(error) if storage::is_full(&error) => {
                // Half a line is worse than none.
                self.file.set_len(self.written_bytes)?;
                self.file.seek(SeekFrom::Start(self.written_bytes))?;
                self.drop_lines(self.buffered_lines, "the disk is full");
            }
            Err(error) => return Err(error),
        }
        self.buffer.clear();
        self.buffered_lines = 0;
        Ok(())
    }

    fn drop_lines(&mut self, lines: u64, reason: &str) {
        if self.dropped_lines == 0 && lines > 0 {
            tracing::warn!("{} loses lines: {reason}; the report counts them", self.path.display());
        }
        self.dropped_lines += lines;
    }

    /// Bytes in the file.
    #[must_use]
    pub fn written_bytes(&self) -> u64 {
        self.written_bytes
    }

    /// Lines that were not written.
    #[must_use]
    pub fn dropped_lines(&self) -> u64 {
        self.dropped_lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_continues_behind_its_first_bytes_and_ends_at_its_limit() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("events.jsonl");
        std::fs::write(&path, "1\n2\n3\n").unwrap();
        let mut log = EventLog::open(&path, 4, 10).unwrap();
        for number in [44, 55, 66] {
            log.push(&number).unwrap();
        }
        log.flush().unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "1\n2\n44\n55\n");
        assert_eq!((log.written_bytes(), log.dropped_lines()), (10, 1));
    }

    #[test]
    fn a_full_disk_costs_lines() {
        // Every write to this device fails as on a full disk.
        let file = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("events.jsonl");
        let mut log = EventLog::open(&path, 0, LIMIT_BYTES).unwrap();
        let real = std::mem::replace(&mut log.file, file);
        log.push(&1).unwrap();
        // The device has no length either: only the error of the write counts here.
        assert!(log.flush().is_err() || log.dropped_lines() == 1);
        log.file = real;
        log.buffer.clear();
        log.push(&2).unwrap();
        log.flush().unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "2\n");
    }
}
