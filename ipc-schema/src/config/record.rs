//! Shared memory → a file: what is recorded, in which manner, and what happens where it cannot be.

use serde::{Deserialize, Serialize};

use crate::channel::Channel;

/// Shared memory → a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordConfig {
    /// Whether and how the run is recorded.
    pub manner: RecordManner,
    /// Names of the recorded channels.
    pub channels: Vec<String>,
    /// How chunks are compressed. Runs and recordings of earlier programs do not say it.
    #[serde(default)]
    pub compression: ChunkCompression,
    /// Level of zstd, which has negative ones too.
    pub compression_level: i32,
    /// Uncompressed size of a chunk, MiB: the most that a kill loses.
    pub chunk_mib: u32,
    /// What happens while the disk is full.
    pub on_full_disk: FullDiskAction,
    /// What the death of `recorder` means.
    pub on_death: DeathAction,
}

/// Whether and how a run is recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordManner {
    /// It is not.
    Off,
    /// No process waits for `recorder`, and what it misses is counted.
    Watching,
    /// `recorder` is a required consumer: its credit bounds the producers, and nothing is missed.
    Lossless,
}

/// How the chunks of a recording are compressed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ChunkCompression {
    /// Not at all: half the processor time, and a larger file.
    None,
    /// Zstandard.
    #[default]
    Zstd,
}

/// What happens while the disk is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FullDiskAction {
    /// `recorder` waits for space. With a lossless recording the run waits with it.
    Wait,
    /// The recording ends where it is, and the run continues without it.
    StopRecording,
    /// The run ends.
    EndRun,
}

/// What the death of `recorder` means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeathAction {
    /// It is started again, and records the rest into another file.
    Continue,
    /// The run ends.
    EndRun,
}

impl RecordConfig {
    /// True if the run is recorded.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.manner != RecordManner::Off
    }

    /// True if `channel` is recorded.
    #[must_use]
    pub fn records(&self, channel: Channel) -> bool {
        self.is_on() && self.channels.iter().any(|name| name == channel.name())
    }

    /// True if no message of `channel` may be missing from the recording.
    #[must_use]
    pub fn is_lossless(&self, channel: Channel) -> bool {
        self.manner == RecordManner::Lossless && self.records(channel)
    }

    /// True if the producer of `channel` needs the credit of `recorder`: the channel is recorded without loss, or paces one that is.
    #[must_use]
    pub fn needs_credit(&self, channel: Channel) -> bool {
        let mut paced = Channel::ALL
            .into_iter()
            .filter(|other| other.spec().paced_by == channel);
        paced.any(|other| self.is_lossless(other))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use super::ChunkCompression;
    use crate::config::Config;

    #[test]
    fn what_an_earlier_program_wrote_is_compressed_by_zstd() {
        let town = include_str!("../../tests/town.json");
        let earlier = town.replace("    \"compression\": \"zstd\",\n", "");
        assert_ne!(earlier, town);
        let record = Config::from_json(&earlier).unwrap().record;
        assert_eq!(record.compression, ChunkCompression::Zstd);
    }
}
