//! When a process that only watches is started again: at once if it had got to work, else after a growing pause, and not for ever.

use std::time::{Duration, Instant};

/// Deaths in a row before it got to work, after which it is given up.
const MOST_VAIN: u32 = 20;
/// First pause after a vain start; it doubles.
const PAUSE: Duration = Duration::from_millis(100);
/// Longest pause.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// What to do about a dead process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Start it.
    Start,
    /// Ask again later.
    Wait,
    /// It is of no use.
    Never,
}

/// The deaths of one process.
#[derive(Debug, Clone, Copy, Default)]
pub struct Revival {
    vain: u32,
    due: Option<Instant>,
}

impl Revival {
    /// What to do about the process, dead at `now`; `worked` if it had opened its ports.
    pub fn verdict(&mut self, worked: bool, now: Instant) -> Verdict {
        let due = *self.due.get_or_insert_with(|| {
            self.vain = if worked { 0 } else { self.vain + 1 };
            now + pause(self.vain)
        });
        if self.vain > MOST_VAIN {
            Verdict::Never
        } else if now < due {
            Verdict::Wait
        } else {
            self.due = None;
            Verdict::Start
        }
    }
}

fn pause(vain: u32) -> Duration {
    match vain {
        0 => Duration::ZERO,
        vain => (PAUSE * 2_u32.pow((vain - 1).min(10))).min(LONGEST_PAUSE),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_works_is_started_again_however_often_it_is_killed() {
        let (mut revival, now) = (Revival::default(), Instant::now());
        assert!((0..1000).all(|_| revival.verdict(true, now) == Verdict::Start));
    }

    #[test]
    fn what_never_works_is_tried_ever_more_seldom_and_given_up() {
        let (mut revival, mut now) = (Revival::default(), Instant::now());
        let begun = now;
        for _ in 0..MOST_VAIN {
            assert_eq!(revival.verdict(false, now), Verdict::Wait);
            now += LONGEST_PAUSE;
            assert_eq!(revival.verdict(false, now), Verdict::Start);
        }
        assert_eq!(revival.verdict(false, now), Verdict::Never);
        assert_eq!(revival.verdict(false, now + LONGEST_PAUSE), Verdict::Never);
        assert!(begun < now);
        let mut again = Revival::default();
        assert_eq!(again.verdict(false, now), Verdict::Wait);
        assert_eq!(again.verdict(false, now + PAUSE), Verdict::Start);
        assert_eq!(again.verdict(true, now + PAUSE), Verdict::Start);
    }
}
