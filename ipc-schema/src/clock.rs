//! The system's clocks, the same in all processes of a machine.

use rustix::time::{ClockId, clock_gettime};

/// The monotonic clock, nanoseconds: what Python calls `time.monotonic_ns`.
#[must_use]
pub fn monotonic_ns() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    u64::try_from(time.tv_sec).unwrap_or_default() * 1_000_000_000 + u64::try_from(time.tv_nsec).unwrap_or_default()
}

/// The time of `clock`, seconds.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "seconds since a machine or a process started")]
pub fn seconds(clock: ClockId) -> f64 {
    let time = clock_gettime(clock);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}
