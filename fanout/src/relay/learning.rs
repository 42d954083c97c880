//! The topic `learning`: the course of training since the start of the run, for viewers that join at any time. The trainer writes it as
//! lines of JSON to a file of the run, so a restarted fan-out has it too.

use std::{
    fs::File,
    io::{self, Read, Seek, SeekFrom},
    os::unix::fs::MetadataExt,
    path::PathBuf,
};

use ipc_schema::run::RunFile;
use serde::de::IgnoredAny;

/// Name of the trainer's file in the directory of environment 0.
const FILE_NAME: &str = "learning.jsonl";
/// Most lines of a kind that are kept. When more come, every second is dropped, so the document stays below 1 MB.
const MAX_LINES: usize = 1000;
/// Lines of a kind in the document that subscribers receive after a change.
const NEWEST_LINES: usize = 32;
/// Longest line that is kept, bytes.
const MAX_LINE_BYTES: usize = 400;
/// Most bytes read at a time; the rest follows with the next status.
const MAX_READ_BYTES: u64 = 4_000_000;

/// Lines of one kind, evenly spaced over the run, and the newest one.
#[derive(Debug, Default)]
struct SparseLines {
    kept: Vec<String>,
    newest: Option<String>,
    seen: usize,
}

impl SparseLines {
    /// Every `stride`-th line is kept.
    fn stride(&self) -> usize {
        self.seen.div_ceil(MAX_LINES).next_power_of_two()
    }

    fn push(&mut self, line: String) {
        let before = self.stride();
        self.seen += 1;
        if self.stride() > before {
            let mut index = 0;
            self.kept.retain(|_| {
                index += 1;
                index % 2 == 1
            });
        }
        if (self.seen - 1).is_multiple_of(self.stride()) {
            self.kept.push(line.clone());
        }
        self.newest = Some(line);
    }

    /// The last `count` lines that are kept, and the newest.
    fn last(&self, count: usize) -> String {
        let from = self.kept.len().saturating_sub(count);
        let kept = self.kept[from..].iter();
        let newest = self.newest.iter().filter(|line| self.kept.last() != Some(line));
        kept.chain(newest).map(String::as_str).collect::<Vec<_>>().join(",")
    }
}

/// The course of training, as it is in the trainer's file.
#[derive(Debug)]
pub struct LearningCourse {
    path: PathBuf,
    /// Beginning of both documents: version and identity of the run.
    head: String,
    /// Inode of the file: a trainer that continues from a checkpoint replaces it.
    inode: u64,
    read_bytes: u64,
    updates: SparseLines,
    evaluations: SparseLines,
}

impl LearningCourse {
    /// The course of `run`, which is the run of environment 0.
    #[must_use]
    pub fn new(run: &RunFile) -> Self {
        Self {
            path: run.run_dir.join(FILE_NAME),
            head: format!(
                "{{\"schema_version\":{},\"run_id\":\"{}\"",
                run.schema_version,
                crate::status::run_id_text(run)
            ),
            inode: 0,
            read_bytes: 0,
            updates: SparseLines::default(),
            evaluations: SparseLines::default(),
        }
    }

    /// Reads the lines that were added since the last call; returns the documents if there are any: one of the newest lines, for
    /// subscribers, and the whole, for queries. A file that cannot be read has no new lines.
    pub fn read_new(&mut self) -> Option<(Vec<u8>, Vec<u8>)> {
        let added = self.add_new_lines().unwrap_or(false);
        added.then(|| (self.document(NEWEST_LINES), self.document(usize::MAX)))
    }

    fn add_new_lines(&mut self) -> io::Result<bool> {
        let mut file = File::open(&self.path)?;
        let metadata = file.metadata()?;
        if metadata.ino() != self.inode || metadata.len() < self.read_bytes {
            self.inode = metadata.ino();
            self.read_bytes = 0;
            (self.updates, self.evaluations) = (SparseLines::default(), SparseLines::default());
        }
        file.seek(SeekFrom::Start(self.read_bytes))?;
        let mut bytes = Vec::new();
        file.take(MAX_READ_BYTES).read_to_end(&mut bytes)?;
        // The last line may not be complete yet.
        let complete = bytes.iter().rposition(|byte| *byte == b'\n').map_or(0, |last| last + 1);
        self.read_bytes += complete as u64;
        for line in bytes[..complete].split(|byte| *byte == b'\n') {
            self.add(line);
        }
        Ok(complete > 0)
    }

    /// Adds a line, if it is a JSON object of a plausible length.
    fn add(&mut self, line: &[u8]) {
        let Ok(text) = std::str::from_utf8(line) else { return };
        let is_object = text.starts_with('{') && serde_json::from_str::<IgnoredAny>(text).is_ok();
        if text.len() > MAX_LINE_BYTES || !is_object {
            return;
        }
        match text.contains("\"evaluation\":") {
            true => self.evaluations.push(text.to_owned()),
            false => self.updates.push(text.to_owned()),
        }
    }

    fn document(&self, count: usize) -> Vec<u8> {
        let (updates, evaluations) = (self.updates.last(count), self.evaluations.last(count));
        format!(
            "{},\"updates\":[{updates}],\"evaluations\":[{evaluations}]}}",
            self.head
        )
        .into_bytes()
    }
}

#[cfg(test)]
mod tests;
