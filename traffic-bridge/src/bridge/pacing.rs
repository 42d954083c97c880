//! Real time, if the run asks for it. The wall clock decides when a step is simulated, never what it contains.

use std::time::{Duration, Instant};

use ipc_schema::membership::{MembershipError, RunMembership, Wait};

/// Longest time between two checks of the stop flag.
const LOOK: Duration = Duration::from_millis(50);
/// The last wait before a step, which no wake-up can end early: the kernel rounds time-outs of sockets, which carry wake-ups, to
/// its own ticks of up to 10 ms.
const EXACT: Duration = Duration::from_millis(20);
/// A run that is later than this starts a new schedule instead of catching up.
const FORGIVEN: Duration = Duration::from_secs(1);

/// When the next step is due.
#[derive(Debug)]
pub(crate) struct Pacing {
    /// Simulated seconds per wall second; 0 = as fast as possible.
    factor: f64,
    due: Option<Instant>,
}

impl Pacing {
    pub(crate) fn new(factor: f64) -> Self {
        Self { factor, due: None }
    }

    /// Waits until the next step of `step_s` simulated seconds is due.
    pub(crate) fn wait(&mut self, membership: &RunMembership, step_s: f64) -> Result<Wait, MembershipError> {
        if self.factor <= 0.0 {
            return Ok(Wait::Ready);
        }
        let due = self.next_due(Instant::now(), step_s);
        loop {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(Wait::Ready);
            }
            if membership.stopped() {
                return Ok(Wait::Stopped);
            }
            match left.checked_sub(EXACT) {
                Some(rest) if !rest.is_zero() => membership.wait(rest.min(LOOK))?,
                _ => std::thread::park_timeout(left),
            }
        }
    }

    fn next_due(&mut self, now: Instant, step_s: f64) -> Instant {
        let due = self.due.filter(|due| *due + FORGIVEN > now).unwrap_or(now);
        self.due = Some(due + Duration::from_secs_f64(step_s / self.factor));
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_due_at_even_distances_whenever_they_are_asked_for() {
        let mut pacing = Pacing::new(2.0);
        let start = Instant::now();
        assert_eq!(pacing.next_due(start, 0.1), start);
        assert_eq!(
            pacing.next_due(start + Duration::from_millis(70), 0.1),
            start + Duration::from_millis(50)
        );
        assert_eq!(
            pacing.next_due(start + Duration::from_millis(80), 0.1),
            start + Duration::from_millis(100)
        );
    }

    #[test]
    fn a_long_stop_is_not_made_up_for() {
        let mut pacing = Pacing::new(1.0);
        let start = Instant::now();
        pacing.next_due(start, 0.1);
        let late = start + Duration::from_secs(10);
        assert_eq!(pacing.next_due(late, 0.1), late);
    }
}
