//! Time of a tick and motion of a road user during it: the inputs of every sensor.

use ipc_schema::world::{SubStep, VehicleState};

/// The time of a tick, as noise and blackouts use it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TickTime {
    /// Seed of the episode.
    pub episode_seed: u64,
    /// Ticks since the start of the episode: a vehicle that leaves and returns draws new noise.
    pub tick: u32,
    /// Time of the episode, nanoseconds.
    pub time_ns: u64,
}

/// One road user's motion over a tick.
#[derive(Debug, Clone, Copy)]
pub struct TickMotion<'a> {
    /// At the end of the tick.
    pub state: &'a VehicleState,
    /// Sub-steps, at least one.
    pub rows: &'a [SubStep],
    /// Ticks since the road user took its slot.
    pub step: u32,
}
