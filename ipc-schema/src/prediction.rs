//! `prediction`: the policy's output for an observation and, if the trainer runs the Kalman filter, the filter's estimates.

use crate::section::payload_layout;

/// Number of columns of an estimate: x, y (metres, world frame, rear axle).
pub const ESTIMATE_COLUMNS: usize = 2;

payload_layout! {
    /// Layout of a `prediction` message.
    PredictionLayout(slots, columns, estimated_slots) {
        /// `f32 [n, a]`: positions (metres, world), or actions in the driving task.
        prediction: f32, [slots, columns];
        /// `f32 [n, 2]`: position by the extended Kalman filter, not-a-number for a slot without one; empty where the filter does not run.
        estimate_m: [f32; ESTIMATE_COLUMNS], [estimated_slots];
    }
}

impl PredictionLayout {
    /// Layout for `n` slots and `a` numbers in a row, with or without estimates.
    #[must_use]
    pub fn new(n: usize, a: usize, estimates: bool) -> Self {
        Self::sized(n, a, if estimates { n } else { 0 })
    }
}
