//! A recording: an MCAP file of compressed chunks, each complete in itself.

use std::{io, path::PathBuf};

use ipc_schema::{SCHEMA_VERSION, run::RunFile};
use serde::{Deserialize, Serialize};

mod pages;
mod place;
pub mod reader;
pub mod writer;

/// Version of the structure of a recording: topics, attachments, and the bytes of a message.
pub const RECORDING_VERSION: u32 = 1;
/// Profile in the header of the file.
pub const PROFILE: &str = "caraware";
/// Name of the recording in the directory of an environment.
pub const RECORDING: &str = "recording.mcap";
/// Encoding of the schemas: `layout.json`.
pub const SCHEMA_ENCODING: &str = "caraware-layout";
/// Encoding of a recorded message: the header of shared memory, then the payload.
pub const MESSAGE_ENCODING: &str = "caraware-message";
/// Attachment that every recording begins with: a [`RecordingStart`] as JSON.
pub const START: &str = "start.json";
/// Attachment of a recording that was finished: a [`RecordingEnd`] as JSON.
pub const END: &str = "end.json";
/// Topic of the first message of each chunk: its number, from 0, as `u64`. A missing chunk is found by it.
pub const CHUNK_TOPIC: &str = "chunk";

/// What a recording is of; it stands at its beginning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordingStart {
    /// [`RECORDING_VERSION`] of the writer.
    pub recording_version: u32,
    /// [`SCHEMA_VERSION`] of the writer.
    pub schema_version: u32,
    /// Version of the program.
    pub program_version: String,
    /// Name of the run.
    pub run: String,
    /// Environment.
    pub env_index: u32,
    /// Seed of the environment.
    pub seed: u64,
    /// BLAKE3 of the configuration's canonical JSON.
    pub config_hash: String,
    /// Length of a tick, seconds.
    pub tick_s: f64,
    /// True if the producers waited for the recording.
    pub is_lossless: bool,
    /// Names of the recorded channels.
    pub channels: Vec<String>,
}

impl RecordingStart {
    /// The start of a recording of `channels` of `run`.
    #[must_use]
    pub fn of(run: &RunFile, channels: Vec<String>, is_lossless: bool) -> Self {
        Self {
            recording_version: RECORDING_VERSION,
            schema_version: SCHEMA_VERSION,
            program_version: env!("CARGO_PKG_VERSION").into(),
            run: run.name.clone(),
            env_index: run.env_index,
            seed: run.seed(),
            config_hash: run.config_hash.clone(),
            tick_s: run.config.run.tick_s,
            is_lossless,
            channels,
        }
    }

    /// Time of a tick since the start of the run, nanoseconds.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a tick is positive and far below a second's 2⁶⁴ nanoseconds"
    )]
    pub fn time_ns(&self, tick: u64) -> u64 {
        tick.saturating_mul((self.tick_s * 1e9).round() as u64)
    }
}

/// What a finished recording holds.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RecordingEnd {
    /// Observation hash over the recorded observations; that of the run, if none is missing.
    pub observation_hash: String,
    /// Ticks that are missing, of all channels that have a message for each tick.
    pub missed_ticks: u64,
    /// Messages, by channel.
    pub messages: std::collections::BTreeMap<String, u64>,
}

/// A recording cannot be written, or cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be created, read or written.
    #[error("cannot access {path}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The file is not a recording.
    #[error("{path} is not a recording of caraware: byte {offset}: {reason}")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Where.
        offset: u64,
        /// Why.
        reason: String,
    },
    /// The file is damaged from here on.
    #[error("{path} is damaged at byte {offset}: {reason}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where.
        offset: u64,
        /// What is wrong there.
        reason: String,
    },
    /// Another version wrote the file.
    #[error("{path} has {what} version {found}, this program reads {ours}")]
    Version {
        /// The file.
        path: PathBuf,
        /// "recording" or "schema".
        what: &'static str,
        /// Its version.
        found: u32,
        /// This program's.
        ours: u32,
    },
    /// A message cannot be brought into the file's format.
    #[error("{path}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

impl RecordingError {
    /// What the user can do about it.
    #[must_use]
    pub fn advice(&self) -> &'static str {
        match self {
            Self::Version { .. } => "read it with the program that wrote it",
            Self::Damaged { .. } => "what comes before that byte is in the file: cut it there, and it opens",
            Self::Foreign { .. } => "give the recording.mcap of a run",
            Self::Io { .. } | Self::Format { .. } => "check the path and its permissions",
        }
    }

    /// True if the disk, or the user's share of it, is full.
    #[must_use]
    pub fn is_full(&self) -> bool {
        matches!(self, Self::Io { source, .. } if ipc_schema::storage::is_full(source))
    }
}
