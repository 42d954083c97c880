//! When to read shared memory and when to publish: pure functions of the time since the start.

use std::time::Duration;

/// Frames up to this size, bytes, are published at the full rate; longer ones less often, so that a viewer's queue has time to empty.
pub const FULL_RATE_FRAME_BYTES: usize = 500_000;

/// Sets that may be saved up. The half above one absorbs the jitter of a run paced at the rate; it is too little for a burst.
const BURST_FRAMES: f64 = 1.5;
/// Sets that a topic must have saved to go out with others.
const JOINING_SETS: f64 = 0.5;

/// A token bucket: at most `rate_hz` sets of frames per second in the long run.
#[derive(Debug, Clone)]
pub struct RateBudget {
    rate_hz: f64,
    tokens: f64,
    at: Duration,
}

impl RateBudget {
    /// A full budget of `rate_hz` sets per second; a rate of 0 never allows a set.
    #[must_use]
    pub fn new(rate_hz: f64) -> Self {
        Self {
            rate_hz,
            tokens: if rate_hz > 0.0 { BURST_FRAMES } else { 0.0 },
            at: Duration::ZERO,
        }
    }

    /// True if a set may be published at `now`.
    pub fn allows(&mut self, now: Duration) -> bool {
        let elapsed_s = now.saturating_sub(self.at).as_secs_f64();
        self.at = self.at.max(now);
        self.tokens = (self.tokens + elapsed_s * self.rate_hz).min(BURST_FRAMES);
        self.tokens >= 1.0
    }

    /// True if a set of other topics that is due may take this one along: it is then at most half a set ahead of its rate. So topics of
    /// one rate go out with the same tick again after one of them went out alone.
    #[must_use]
    pub fn joins(&self) -> bool {
        self.tokens >= JOINING_SETS
    }

    /// Fills the budget, so that a set may be published at once; a rate of 0 still allows none.
    pub fn refill(&mut self) {
        self.tokens = Self::new(self.rate_hz).tokens;
    }

    /// Pays for a set whose longest frame has `longest_bytes`: above [`FULL_RATE_FRAME_BYTES`] the rate falls.
    /// Returns true if it fell.
    pub fn spend(&mut self, longest_bytes: usize) -> bool {
        let cost = longest_bytes.div_ceil(FULL_RATE_FRAME_BYTES).max(1);
        self.tokens -= f64::from(u32::try_from(cost).unwrap_or(u32::MAX));
        cost > 1
    }
}

/// How long to wait between two reads of shared memory: long enough to cost little, short enough for the queues not to overflow.
#[derive(Debug, Clone)]
pub struct PollInterval {
    wait: Duration,
    queue_length: usize,
}

impl PollInterval {
    /// Shortest wait: 500 reads a second cost about one per cent of a core.
    const SHORTEST: Duration = Duration::from_millis(2);
    /// Longest wait: it makes what a viewer sees at most this much older.
    const LONGEST: Duration = Duration::from_millis(20);

    /// The interval for queues of `queue_length` messages.
    #[must_use]
    pub fn new(queue_length: usize) -> Self {
        Self {
            wait: Self::SHORTEST,
            queue_length,
        }
    }

    /// The next wait, after a read that found `messages` in the fullest queue.
    pub fn next(&mut self, messages: usize) -> Duration {
        if 2 * messages > self.queue_length {
            self.wait = (self.wait / 2).max(Self::SHORTEST);
        } else if 5 * messages < self.queue_length {
            self.wait = (self.wait * 5 / 4).min(Self::LONGEST);
        }
        self.wait
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_rate_is_never_exceeded(rate_hz in 0.5_f64..200.0, steps_ms in prop::collection::vec(0_u64..50, 1..400)) {
            let mut budget = RateBudget::new(rate_hz);
            let (mut now, mut sets) = (Duration::ZERO, 0);
            for step in steps_ms {
                now += Duration::from_millis(step);
                if budget.allows(now) {
                    budget.spend(1000);
                    sets += 1;
                }
            }
            prop_assert!(f64::from(sets) <= now.as_secs_f64() * rate_hz + BURST_FRAMES + 1e-6);
        }

        /// Every tick of a run paced at the rate is published, though each is read up to one interval late.
        #[test]
        fn jitter_costs_no_frame(late_ms in prop::collection::vec(0_u64..20, 1..300)) {
            let mut budget = RateBudget::new(10.0);
            for (tick, late) in late_ms.into_iter().enumerate() {
                prop_assert!(budget.allows(Duration::from_millis(100 * tick as u64 + late)));
                budget.spend(100_000);
            }
        }
    }

    #[test]
    fn topics_of_one_rate_fall_into_step_and_keep_the_rate() {
        let (mut world, mut prediction) = (RateBudget::new(10.0), RateBudget::new(10.0));
        let (mut together, mut alone, mut predictions) = (0, 0, 0);
        for step in 0..1000_u32 {
            let now = Duration::from_millis(10) * step;
            // The first prediction is late, so that it goes out without the world of its tick.
            let (world_due, prediction_due) = (world.allows(now), prediction.allows(now) && step > 3);
            if !world_due && !prediction_due {
                continue;
            }
            let both = [
                world_due || world.joins(),
                step > 3 && (prediction_due || prediction.joins()),
            ];
            if both[0] {
                world.spend(0);
            }
            if both[1] {
                prediction.spend(0);
                predictions += 1;
            }
            if both == [true, true] {
                together += 1;
            } else {
                alone += 1;
            }
        }
        assert!(alone <= 3 && together >= 97, "{alone} {together}");
        assert!((98..=102).contains(&predictions), "{predictions}");
        assert!(!RateBudget::new(0.0).joins());
    }

    #[test]
    fn long_frames_halve_the_rate() {
        let mut budget = RateBudget::new(10.0);
        let published = (0..1000)
            .filter(|i| {
                let due = budget.allows(Duration::from_millis(10 * i));
                due && budget.spend(800_000)
            })
            .count();
        assert!((50..=52).contains(&published), "{published}");
    }

    #[test]
    fn waits_follow_the_load_within_bounds() {
        let mut interval = PollInterval::new(10);
        let idle: Vec<Duration> = (0..30).map(|_| interval.next(0)).collect();
        assert_eq!(idle.last(), Some(&PollInterval::LONGEST));
        assert_eq!(interval.next(4), PollInterval::LONGEST);
        let busy: Vec<Duration> = (0..30).map(|_| interval.next(10)).collect();
        assert_eq!(busy.last(), Some(&PollInterval::SHORTEST));
    }
}
