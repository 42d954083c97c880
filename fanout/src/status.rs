//! What is told in JSON: the map once, the state of the run twice a second.

use ipc_schema::{
    board::{Health, State, TrainingStatus},
    config::Field,
    process::Process,
    run::{MapInfo, Mode, RunFile},
};
use serde::Serialize;

/// What a viewer needs to know once.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Map<'a> {
    /// Of every frame of this run.
    pub schema_version: u32,
    /// Name of the run.
    pub run: &'a str,
    /// What the run is for.
    pub mode: Mode,
    /// Projection, offset and bounds of the net.
    pub map: &'a MapInfo,
    /// Length of a tick, seconds.
    pub tick_s: f64,
    /// Sub-steps in a tick.
    pub sub_steps: u32,
    /// Simulated seconds per wall second; 0 = as fast as possible.
    pub real_time_factor: f64,
    /// Columns of the observation.
    pub observation_fields: &'a [Field],
    /// Most frames per wall second and topic.
    pub rate_hz: f64,
}

impl<'a> Map<'a> {
    /// What the run file says.
    #[must_use]
    pub fn of(run: &'a RunFile) -> Self {
        Self {
            schema_version: run.schema_version,
            run: &run.name,
            mode: run.mode,
            map: &run.map,
            tick_s: run.config.run.tick_s,
            sub_steps: run.config.run.sub_steps,
            real_time_factor: run.config.run.real_time_factor,
            observation_fields: &run.config.observation.fields,
            rate_hz: run.config.fanout.rate_hz,
        }
    }
}

/// How one process fares.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ProcessStatus {
    /// Its name.
    pub name: &'static str,
    /// Its state.
    pub state: &'static str,
    /// Ticks produced or consumed.
    pub ticks: u64,
    /// Episode at work.
    pub episode: u64,
    /// Road users in its newest tick.
    pub road_users: u32,
    /// Connected vehicles in its newest tick.
    pub cavs: u32,
    /// Messages dropped.
    pub drops: u64,
    /// Vehicle-steps so far.
    pub vehicle_steps: u64,
    /// Ticks of the whole run, 0 if unknown.
    pub total_ticks: u64,
}

impl ProcessStatus {
    /// What `process` wrote on its board.
    #[must_use]
    pub fn of(process: Process, health: &Health) -> Self {
        Self {
            name: process.name(),
            state: State::from_u32(health.state).name(),
            ticks: health.ticks,
            episode: health.episode,
            road_users: health.road_users,
            cavs: health.cavs,
            drops: health.drops,
            vehicle_steps: health.vehicle_steps,
            total_ticks: health.total_ticks,
        }
    }
}

/// How learning goes, from the trainer's board.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Training {
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
    /// Mean error of the policy, metres.
    pub error_m: f64,
    /// Mean error of the raw GNSS fix, metres.
    pub raw_gnss_error_m: f64,
}

impl From<TrainingStatus> for Training {
    fn from(status: TrainingStatus) -> Self {
        Self {
            episode: status.episode,
            env_steps: status.env_steps,
            updates: status.updates,
            env_steps_per_s: status.env_steps_per_s,
            policy_std: status.policy_std,
            reward: status.reward,
            error_m: status.error_m,
            raw_gnss_error_m: status.raw_gnss_error_m,
        }
    }
}

/// What the fan-out itself did.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Counters {
    /// Frames handed to zenoh.
    pub frames: u64,
    /// Ticks that came too fast for the queues in shared memory.
    pub missed_ticks: u64,
    /// Messages refused: of another run, or not what their header promises.
    pub refused_messages: u64,
    /// Road users left out of frames that were too long.
    pub thinned_rows: u64,
    /// Frames that were too long and could not be thinned.
    pub oversize_frames: u64,
    /// Sets that lowered the rate because a frame was long.
    pub slowed_sets: u64,
}

/// The state of the run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Status {
    /// Newest tick published.
    pub tick: u64,
    /// Episode of that tick.
    pub episode: u64,
    /// Simulated time within that episode, nanoseconds.
    pub sim_time_ns: u64,
    /// True in an evaluation episode.
    pub evaluation: bool,
    /// Every process of the run.
    pub processes: Vec<ProcessStatus>,
    /// How learning goes; `None` in a run without.
    pub training: Option<Training>,
    /// What the fan-out itself did.
    pub fanout: Counters,
}
