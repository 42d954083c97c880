//! The ids of a scenario's road users, in a file of the run's directory: observations carry only their hashes.

use std::{
    collections::BTreeSet,
    fs::{File, OpenOptions},
    io::Write as _,
    path::Path,
};

use ipc_schema::{run::VEHICLE_IDS, traffic::id_hash};

/// Writes each id once, before the step in which its road user appears is published.
#[derive(Debug)]
pub(super) struct IdLog {
    /// `None` once it could not be written: a full disk does not end a run.
    file: Option<File>,
    written: BTreeSet<u64>,
    lines: String,
}

impl IdLog {
    /// Continues the file of the run, or begins it.
    pub(super) fn open(run_dir: &Path) -> Self {
        let path = run_dir.join(VEHICLE_IDS);
        let before = std::fs::read_to_string(&path).unwrap_or_default();
        let ids = before
            .lines()
            .filter_map(|line| serde_json::from_str::<String>(line).ok());
        let written: BTreeSet<u64> = ids.map(|id| id_hash(&id)).collect();
        // A process that was killed may have left half a line.
        let lines = if before.is_empty() || before.ends_with('\n') {
            ""
        } else {
            "\n"
        };
        let file = OpenOptions::new().create(true).append(true).open(&path);
        Self {
            file: file.inspect_err(report).ok(),
            written,
            lines: lines.to_owned(),
        }
    }

    /// Adds the ids that are new.
    pub(super) fn add(&mut self, ids: &[String]) {
        let Some(file) = &mut self.file else { return };
        for id in ids {
            if self.written.insert(id_hash(id))
                && let Ok(line) = serde_json::to_string(id)
            {
                self.lines.push_str(&line);
                self.lines.push('\n');
            }
        }
        if self.lines.is_empty() {
            return;
        }
        if let Err(error) = file.write_all(self.lines.as_bytes()) {
            report(&error);
            self.file = None;
        }
        self.lines.clear();
    }
}

fn report(error: &std::io::Error) {
    tracing::warn!(%error, "cannot write {VEHICLE_IDS}: ids of vehicles stay hashes in Python");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_id_is_written_once_and_a_successor_continues_the_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(VEHICLE_IDS);
        let ids = |ids: &[&str]| ids.iter().map(|id| (*id).to_owned()).collect::<Vec<_>>();
        let mut log = IdLog::open(directory.path());
        log.add(&ids(&["a", "b \"c\"\n"]));
        log.add(&ids(&["a"]));
        std::fs::write(&path, std::fs::read_to_string(&path).unwrap() + "\"ha").unwrap();
        let mut log = IdLog::open(directory.path());
        log.add(&ids(&["a", "d"]));
        assert_eq!(
            std::fs::read_to_string(&path).unwrap(),
            "\"a\"\n\"b \\\"c\\\"\\n\"\n\"ha\n\"d\"\n"
        );
    }
}
