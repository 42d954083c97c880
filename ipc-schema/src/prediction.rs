//! `prediction`: what the policy makes of an observation and, where the trainer runs it, the Kalman filter beside it.

use crate::{
    block::{Section, sections},
    header::MessageHeader,
};

/// Header flag of a `prediction` message whose second section holds the estimates of the filter.
pub const ESTIMATES: u32 = 1 << 8;

/// Number of columns of an estimate: x, y (metres, world frame, rear axle).
pub const ESTIMATE_COLUMNS: usize = 2;

/// Where the arrays of a `prediction` message lie, for `n` slots and `a` numbers in a row (the header's `count` and `columns`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PredictionLayout {
    /// `f32 [n, a]`: positions (metres, world), or actions in the driving task.
    pub prediction: Section,
    /// `f32 [n, 2]`: where the extended Kalman filter thinks the vehicle is, not-a-number where it does not say; empty without
    /// [`ESTIMATES`].
    pub estimate_m: Section,
    /// Length of the payload in bytes.
    pub len: usize,
}

impl PredictionLayout {
    /// Layout for `n` slots and `a` numbers in a row, with or without estimates.
    #[must_use]
    pub fn new(n: usize, a: usize, estimates: bool) -> Self {
        let value = size_of::<f32>();
        let estimate_len = if estimates { n * ESTIMATE_COLUMNS * value } else { 0 };
        let ([prediction, estimate_m], len) = sections([n * a * value, estimate_len]);
        Self {
            prediction,
            estimate_m,
            len,
        }
    }

    /// Layout of the message with this header.
    #[must_use]
    pub fn of(header: &MessageHeader) -> Self {
        Self::new(header.count as usize, header.columns as usize, header.has(ESTIMATES))
    }
}
