//! The header that every message carries.

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;

/// The episode is an evaluation: its seed is never used in training.
pub const EVALUATION: u32 = 1;
/// First tick of an episode: all vehicle indices and slots start anew.
pub const FIRST_OF_EPISODE: u32 = 1 << 1;
/// Last tick of an episode.
pub const LAST_OF_EPISODE: u32 = 1 << 2;
/// Last tick of the run: the producer sends nothing after it.
pub const LAST_OF_RUN: u32 = 1 << 3;
/// Last tick of a lesson: before the next one the producer waits for the trainer's decision about its stage of the curriculum.
pub const LAST_OF_LESSON: u32 = 1 << 4;
/// First bit of the stage of the curriculum, counted from 1; 0 is the base configuration.
const STAGE_SHIFT: u32 = 16;
/// First bit of the map, counted from 0.
const MAP_SHIFT: u32 = 24;

/// The flags of a tick in stage `stage` of the curriculum, counted from 1; 0 is the base configuration.
#[must_use]
pub const fn stage_flags(stage: u8) -> u32 {
    (stage as u32) << STAGE_SHIFT
}

/// The flags of a tick on map `map` of a curriculum, counted from 0, the run's own.
#[must_use]
pub const fn map_flags(map: u8) -> u32 {
    (map as u32) << MAP_SHIFT
}

/// Identity and time of a message. 72 bytes, no implicit padding.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable, ZeroCopySend)]
#[type_name("caraware::MessageHeader")]
pub struct MessageHeader {
    /// [`crate::SCHEMA_VERSION`] of the sender.
    pub schema_version: u32,
    /// Index of the environment, 0-based.
    pub env_index: u32,
    /// Random identity of the run; a message of another run is refused.
    pub run_id: u64,
    /// Counts the replacements of the sending process. `observation`: of the trainer that it is meant for.
    pub incarnation: u32,
    /// Bits [`EVALUATION`], [`FIRST_OF_EPISODE`], [`LAST_OF_EPISODE`], [`LAST_OF_RUN`], [`LAST_OF_LESSON`]; from bit 8 on what the
    /// payload says; from bit 16 on [`stage_flags`]; from bit 24 on [`map_flags`].
    pub flags: u32,
    /// Episode number, 0-based over the run.
    pub episode: u64,
    /// Seed of the episode: traffic, noise and blackouts draw from it.
    pub episode_seed: u64,
    /// Tick number, 0-based over the run, without gaps.
    pub tick: u64,
    /// Simulated time since the start of the episode, nanoseconds.
    pub sim_time_ns: u64,
    /// Number of rows.
    pub count: u32,
    /// Second dimension where a payload has one: sub-steps per vehicle (`world`), fields per row (`observation`, `prediction`).
    pub columns: u32,
    /// `traffic`: number of `traffic-meta` messages sent before this one. `world`: number of heroes. `observation`: IMU samples
    /// in a tick. `prediction`: version of the policy. `pointcloud`: index of the vehicle.
    pub sequence: u64,
}

impl MessageHeader {
    /// True if all bits of `flag` are set.
    #[must_use]
    pub fn has(&self, flag: u32) -> bool {
        self.flags & flag == flag
    }

    /// Stage of the curriculum, counted from 1; 0 is the base configuration.
    #[must_use]
    pub const fn stage(&self) -> usize {
        (self.flags >> STAGE_SHIFT & 0xff) as usize
    }

    /// Place of the map among those of the curriculum; 0 is the run's own.
    #[must_use]
    pub const fn map(&self) -> usize {
        (self.flags >> MAP_SHIFT) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stage_and_map_have_bytes_of_their_own() {
        for (stage, map) in [(0, 0), (1, 255), (255, 1), (255, 255)] {
            let header = MessageHeader {
                flags: LAST_OF_LESSON | stage_flags(stage) | map_flags(map),
                ..MessageHeader::default()
            };
            assert_eq!((header.stage(), header.map()), (usize::from(stage), usize::from(map)));
            assert!(header.has(LAST_OF_LESSON) && !header.has(EVALUATION));
        }
    }
}
