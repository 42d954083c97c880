//! Files of a run that belong into its recording: those that exist at the start, and the lines that its logs gain.

use std::{
    fs::File,
    io::{Read as _, Seek as _, SeekFrom},
    path::PathBuf,
};

use ipc_schema::{
    control::COMMAND_LOG,
    layout,
    run::{CURRICULUM_LOG, RunFile},
};

use crate::file::{
    RecordingError,
    writer::{LineTopic, RecordingWriter},
};

/// Name of the run file among the attachments.
pub const RUN_FILE: &str = "run.json";
/// Name of the chart of the scene among the attachments.
pub const CHART: &str = "chart.json";

/// The files at the beginning of a recording, with their names. One that cannot be read is left out.
#[must_use]
pub fn first_attachments(run: &RunFile) -> Vec<(String, Vec<u8>)> {
    let mut files = vec![(
        "layout.json".to_owned(),
        layout::json().unwrap_or_default().into_bytes(),
    )];
    for name in [RUN_FILE, "config.toml"] {
        if let Ok(content) = std::fs::read(run.run_dir.join(name)) {
            files.push((name.to_owned(), content));
        }
    }
    files
}

/// A log that grows line by line.
#[derive(Debug)]
struct GrowingLog {
    topic: LineTopic,
    path: PathBuf,
    read_bytes: u64,
}

impl GrowingLog {
    /// The whole lines since the last call.
    fn new_lines(&mut self) -> Vec<String> {
        let mut text = String::new();
        let read = File::open(&self.path).and_then(|mut file| {
            file.seek(SeekFrom::Start(self.read_bytes))?;
            file.read_to_string(&mut text)
        });
        // It does not exist before its first line.
        let end = text.rfind('\n').filter(|_| read.is_ok());
        let Some(end) = end else { return Vec::new() };
        self.read_bytes += end as u64 + 1;
        text[..end].lines().map(str::to_owned).collect()
    }
}

/// The logs of an environment, and its chart, which `sim-core` draws after the start.
#[derive(Debug)]
pub struct RunLogs {
    logs: [GrowingLog; 2],
    chart: Option<PathBuf>,
}

impl RunLogs {
    /// The logs of the environment of `run`, from their beginning.
    #[must_use]
    pub fn new(run: &RunFile) -> Self {
        let log = |topic, name| GrowingLog {
            topic,
            path: run.run_dir.join(name),
            read_bytes: 0,
        };
        Self {
            logs: [
                log(LineTopic::Commands, COMMAND_LOG),
                log(LineTopic::Curriculum, CURRICULUM_LOG),
            ],
            chart: run.config.fanout.enabled.then(|| run.chart_path()),
        }
    }

    /// Adds what is new.
    ///
    /// # Errors
    /// The recording failed.
    pub fn add_new(&mut self, writer: &mut RecordingWriter) -> Result<(), RecordingError> {
        for log in &mut self.logs {
            for line in log.new_lines() {
                writer.add_line(log.topic, &line)?;
            }
        }
        let chart = self.chart.as_ref().and_then(|path| std::fs::read(path).ok());
        // It is written whole or not at all.
        if let Some(chart) = chart {
            self.chart = None;
            writer.attach(CHART, &chart)?;
        }
        Ok(())
    }
}
