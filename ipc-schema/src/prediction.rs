//! `prediction`: the policy's output for an observation. Beside it are the Kalman filter's estimates if the trainer runs the filter, and
//! the vehicles that the actions of the driving task are for.

use crate::section::payload_layout;

/// Number of columns of an estimate: x, y (metres, world frame, rear axle).
pub const ESTIMATE_COLUMNS: usize = 2;
/// Number of columns of an action in the driving task: steering and acceleration, each in −1 … 1.
pub const ACTION_COLUMNS: usize = 2;

payload_layout! {
    /// Layout of a `prediction` message.
    PredictionLayout(slots, columns, estimated_slots, answered_slots) {
        /// `f32 [n, a]`: positions (metres, world), or actions in the driving task.
        prediction: f32, [slots, columns];
        /// `f32 [n, 2]`: position by the extended Kalman filter, not-a-number for a slot without one; empty where the filter does not run.
        estimate_m: [f32; ESTIMATE_COLUMNS], [estimated_slots];
        /// `u32 [n]` in the driving task: dense vehicle index of each slot, as the observation has it, so that `sim-core` needs no
        /// observation to apply the actions. Empty in other tasks.
        vehicle: u32, [answered_slots];
    }
}

impl PredictionLayout {
    /// Layout for `n` slots and `a` numbers in a row, with or without estimates, and without vehicles.
    #[must_use]
    pub fn new(n: usize, a: usize, estimates: bool) -> Self {
        Self::sized(n, a, if estimates { n } else { 0 }, 0)
    }

    /// Layout for the actions of `n` slots, `a` numbers each, with the vehicle of each slot.
    #[must_use]
    pub fn of_actions(n: usize, a: usize) -> Self {
        Self::sized(n, a, 0, n)
    }
}
