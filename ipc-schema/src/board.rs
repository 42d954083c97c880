//! The board of a process: its latest progress and health, newest wins, readable by every process at any time.

use iceoryx2::prelude::ZeroCopySend;
use serde::Serialize;

use crate::{
    channel::Channel,
    metric::{self, MetricValues, NOT_MEASURED},
    process::Process,
};

/// Where a process stands in the data it consumes and commits.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ZeroCopySend)]
#[type_name("caraware::Progress")]
pub struct Progress {
    /// Number of ticks consumed: all ticks below this one may be overwritten.
    pub consumed_ticks: u64,
    /// Of a trainer: number of ticks received when it turned to the sender [`Progress::sender_incarnation`].
    pub received_ticks: u64,
    /// Number of ticks contained in the last checkpoint that was renamed into place.
    pub committed_ticks: u64,
    /// Counts the replacements of the process.
    pub incarnation: u32,
    /// 1 once the process has opened its ports and will miss nothing, else 0.
    pub attached: u32,
    /// Of a trainer with a curriculum: how many lessons have a stage.
    pub decided_lessons: u64,
    /// The first lesson of the newest stage; the lesson before it belongs to the stage before.
    pub since_lesson: u64,
    /// The newest stage, counted from 0. Equal to the number of stages when all are done; `since_lesson` is then unused.
    pub stage: u32,
    /// Of a trainer: incarnation of `sensor-daemon` whose observations it receives; it has read all that an earlier one sent.
    pub sender_incarnation: u32,
    /// Of `recorder`, which consumes several channels: number of ticks consumed of each, in the order of [`Channel::ALL`].
    pub recorded_ticks: [u64; Channel::COUNT],
    /// Of `recorder`: incarnation of the sender whose ticks are counted, of each channel; `u32::MAX` before the first message.
    pub recorded_senders: [u32; Channel::COUNT],
    /// Of `recorder`: incarnation that these ticks were addressed to.
    pub recorded_addressees: [u32; Channel::COUNT],
}

impl Progress {
    /// Number of ticks of `channel` that `process`, of which this is the progress, has consumed.
    #[must_use]
    pub fn consumed_of(&self, process: Process, channel: Channel) -> u64 {
        match process {
            Process::Recorder => self.recorded_ticks[channel as usize],
            _ => self.consumed_ticks,
        }
    }

    /// Of `recorder`: the stream of `channel` whose ticks it has counted last.
    #[must_use]
    pub fn recorded_stream(&self, channel: Channel) -> MessageStream {
        MessageStream {
            sender: self.recorded_senders[channel as usize],
            addressee: self.recorded_addressees[channel as usize],
        }
    }

    /// The stage, counted from 0, that `lesson` belongs to; `None` before that is decided. Only the newest decided lesson and the one
    /// before it have an answer.
    #[must_use]
    pub fn stage_of(&self, lesson: u64) -> Option<u32> {
        (lesson < self.decided_lessons).then(|| {
            if lesson < self.since_lesson {
                self.stage.saturating_sub(1)
            } else {
                self.stage
            }
        })
    }
}

/// Messages of a channel that follow each other: those of one sender to one addressee. Another stream may begin with ticks of this one again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct MessageStream {
    /// Incarnation of the sender.
    pub sender: u32,
    /// Incarnation that the messages are addressed to; 0 where it does not matter.
    pub addressee: u32,
}

impl MessageStream {
    /// None: no message has come.
    pub const NONE: Self = Self {
        sender: u32::MAX,
        addressee: u32::MAX,
    };
}

/// Which incarnation of each process counts, in the order of [`crate::process::Process::ALL`]; written by the supervisor alone.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ZeroCopySend)]
#[type_name("caraware::Roster")]
pub struct Roster {
    /// Incarnation of each process.
    pub incarnations: [u32; Process::COUNT],
    /// 1 while a successor that is ready waits for that incarnation to leave, or opens its ports, else 0.
    pub handing_over: [u32; Process::COUNT],
}

/// State of a process, [`Health::state`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum State {
    /// Not there yet.
    Starting = 0,
    /// Ports open, waiting for data.
    Ready = 1,
    /// At work.
    Running = 2,
    /// All work done.
    Done = 3,
}

impl State {
    /// State from its number; unknown numbers are [`State::Starting`].
    #[must_use]
    pub fn from_u32(value: u32) -> Self {
        match value {
            1 => Self::Ready,
            2 => Self::Running,
            3 => Self::Done,
            _ => Self::Starting,
        }
    }

    /// For the process table.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Starting => "starting",
            Self::Ready => "ready",
            Self::Running => "running",
            Self::Done => "done",
        }
    }
}

/// How a process fares.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("caraware::Health")]
pub struct Health {
    /// A [`State`].
    pub state: u32,
    /// Process id.
    pub pid: i32,
    /// Number of ticks produced or consumed.
    pub ticks: u64,
    /// Episode at work.
    pub episode: u64,
    /// Simulated time of the episode, nanoseconds.
    pub sim_time_ns: u64,
    /// Road users in the newest tick.
    pub road_users: u32,
    /// Connected vehicles in the newest tick.
    pub cavs: u32,
    /// Messages dropped towards consumers that are not required.
    pub drops: u64,
    /// Vehicle-steps produced so far (sensor-daemon: observations).
    pub vehicle_steps: u64,
    /// Road users that have left the network so far: they have arrived, or were removed (traffic-bridge).
    pub arrived: u64,
    /// Mirrors set onto SUMO because no motion leads there (sim-core).
    pub resynchronisations: u64,
    /// Total ticks of the run, 0 if unknown.
    pub total_ticks: u64,
    /// When this was written, monotonic clock of the machine, nanoseconds.
    pub written_ns: u64,
}

/// How learning goes. Its fields are also those of the fan-out's status, with the measured metrics by name.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ZeroCopySend)]
#[type_name("caraware::TrainingStatus")]
pub struct TrainingStatus {
    /// Episode of the newest sample.
    pub episode: u64,
    /// Samples used for training so far.
    pub env_steps: u64,
    /// Updates of the policy so far.
    pub updates: u64,
    /// Samples per wall second, lately.
    pub env_steps_per_s: f64,
    /// Standard deviation of the policy.
    pub policy_std: f64,
    /// Mean reward, lately.
    pub reward: f64,
    /// Largest of those so far.
    pub best_reward: f64,
    /// Value of each metric on the samples of the newest update, in the order of [`crate::metric::METRICS`].
    #[serde(serialize_with = "metric::serialize_measured")]
    pub metrics: MetricValues,
}

impl Default for TrainingStatus {
    fn default() -> Self {
        Self {
            episode: 0,
            env_steps: 0,
            updates: 0,
            env_steps_per_s: 0.0,
            policy_std: 0.0,
            reward: 0.0,
            best_reward: 0.0,
            metrics: NOT_MEASURED,
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_training_status_is_written_with_the_measured_metrics_by_name() {
        let mut status = TrainingStatus {
            updates: 3,
            reward: 0.5,
            ..TrainingStatus::default()
        };
        status.metrics[0] = 4.5;
        let expected = json!({
            "episode": 0, "env_steps": 0, "updates": 3, "env_steps_per_s": 0.0, "policy_std": 0.0, "reward": 0.5,
            "best_reward": 0.0, "metrics": [{"name": "error_m", "label": "error", "unit": "m", "value": 4.5}],
        });
        assert_eq!(serde_json::to_value(status).unwrap(), expected);
    }
}
