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

/// Most dimensions that the sections of a payload have between them.
pub const DIMENSIONS: usize = 4;

/// Identity, time and shape of a message. 96 bytes, no implicit padding.
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
    /// Counts the replacements of the sending process.
    pub incarnation: u32,
    /// Incarnation of the consumer that the message is meant for; older incarnations of it are stale. 0 if it is meant for all.
    pub addressee: u32,
    /// Bits [`EVALUATION`], [`FIRST_OF_EPISODE`], [`LAST_OF_EPISODE`], [`LAST_OF_RUN`], [`LAST_OF_LESSON`].
    pub flags: u32,
    /// Stage of the curriculum, counted from 1; 0 is the base configuration.
    pub stage: u16,
    /// Index of the map among those of the curriculum; 0 is the run's own.
    pub map: u16,
    /// Episode number, 0-based over the run.
    pub episode: u64,
    /// Seed of the episode: traffic, noise and blackouts draw from it.
    pub episode_seed: u64,
    /// Tick number, 0-based over the run, without gaps.
    pub tick: u64,
    /// Simulated time since the start of the episode, nanoseconds.
    pub sim_time_ns: u64,
    /// Size of each dimension of the payload's sections, in the order in which its layout names them; zeros behind them.
    pub shape: [u32; DIMENSIONS],
    /// Version of the policy that a `prediction` comes from; 0 on every other channel.
    pub policy_version: u64,
    /// Number of `traffic-meta` messages of the run up to this message: a `traffic` message is complete once its receiver has
    /// applied so many. 0 on every channel that `traffic-bridge` does not send.
    pub meta_messages: u64,
}

impl MessageHeader {
    /// True if all bits of `flag` are set.
    #[must_use]
    pub fn has(&self, flag: u32) -> bool {
        self.flags & flag == flag
    }

    /// Number of rows: size of the first dimension.
    #[must_use]
    pub const fn rows(&self) -> usize {
        self.shape[0] as usize
    }
}
