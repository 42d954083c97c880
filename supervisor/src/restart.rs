//! Decides when an ended process is started again.
//!
//! A watcher that had opened its ports is started again at once. One that had not is started after a growing pause, a limited
//! number of times. A trainer is replaced as long as its replacements reach new commits.

use std::time::{Duration, Instant};

/// Number of starts in a row, none of which opened its ports, after which a watcher is not started again.
const MAX_VAIN_STARTS: u32 = 20;
/// Most replacements of a trainer in a row without a new commit.
const MAX_VAIN_REPLACEMENTS: u32 = 5;
/// Pause after the first start in vain. It doubles with each further one.
const PAUSE: Duration = Duration::from_millis(100);
/// Longest pause.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// The decision on an ended watcher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RestartVerdict {
    /// Start it now.
    Start,
    /// Decide again later.
    Wait,
    /// Never start it again.
    GiveUp,
}

/// Restarts of one watcher.
#[derive(Debug, Clone, Copy, Default)]
pub struct WatcherRestarts {
    /// Starts in vain since the watcher last opened its ports.
    vain: u32,
    /// Time of the next start.
    due: Option<Instant>,
}

impl WatcherRestarts {
    /// Decides on the watcher, which has ended by `now`. `worked` is true if it had opened its ports.
    pub fn verdict(&mut self, worked: bool, now: Instant) -> RestartVerdict {
        let due = *self.due.get_or_insert_with(|| {
            self.vain = if worked { 0 } else { self.vain + 1 };
            now + pause(self.vain)
        });
        if self.vain > MAX_VAIN_STARTS {
            RestartVerdict::GiveUp
        } else if now < due {
            RestartVerdict::Wait
        } else {
            self.due = None;
            RestartVerdict::Start
        }
    }
}

/// Restarts of the simulator processes of one environment.
#[derive(Debug, Clone, Copy, Default)]
pub struct EnvironmentRestarts {
    /// Ends since the last new tick.
    vain: u32,
    /// Of these, crashes.
    crashes: u32,
    /// Most ticks that were sensed at an end.
    sensed_ticks: u64,
    due: Option<Instant>,
}

impl EnvironmentRestarts {
    /// What to do about an end that is found at `now`, when `sensed_ticks` had been sensed.
    pub fn verdict(&mut self, sensed_ticks: u64, is_crash: bool, now: Instant) -> RestartVerdict {
        let due = match self.due {
            Some(due) => due,
            None => {
                if sensed_ticks > self.sensed_ticks {
                    (self.sensed_ticks, self.vain, self.crashes) = (sensed_ticks, 0, 0);
                }
                let due = now + pause(self.vain);
                self.vain += 1;
                self.crashes += u32::from(is_crash);
                *self.due.insert(due)
            }
        };
        if self.crashes > MAX_VAIN_REPLACEMENTS {
            return RestartVerdict::GiveUp;
        }
        if now < due {
            return RestartVerdict::Wait;
        }
        self.due = None;
        RestartVerdict::Start
    }
}

/// Replacements of a trainer that was killed.
#[derive(Debug, Clone, Copy, Default)]
pub struct TrainerRestarts {
    /// Replacements since the last commit.
    vain: u32,
    /// Ticks committed at the last replacement.
    committed_ticks: u64,
}

impl TrainerRestarts {
    /// Counts a replacement of a trainer that has committed `committed_ticks`.
    ///
    /// # Errors
    /// Too many replacements in a row reached no new commit. The error is their number.
    pub fn allow(&mut self, committed_ticks: u64) -> Result<(), u32> {
        if committed_ticks > self.committed_ticks {
            self.committed_ticks = committed_ticks;
            self.vain = 0;
        }
        self.vain += 1;
        if self.vain > MAX_VAIN_REPLACEMENTS {
            return Err(MAX_VAIN_REPLACEMENTS);
        }
        Ok(())
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
    fn a_trainer_is_replaced_while_it_commits_and_given_up_after_five_in_vain() {
        let mut restarts = TrainerRestarts::default();
        for committed_ticks in [0, 0, 0, 0, 0, 7, 7, 7, 7, 7] {
            assert_eq!(restarts.allow(committed_ticks), Ok(()));
        }
        assert_eq!(restarts.allow(7), Err(MAX_VAIN_REPLACEMENTS));
    }

    #[test]
    fn a_killed_environment_is_started_ever_less_often_and_a_crashing_one_given_up() {
        let (mut restarts, now) = (EnvironmentRestarts::default(), Instant::now());
        assert_eq!(restarts.verdict(5, false, now), RestartVerdict::Start);
        assert_eq!(
            restarts.verdict(5, false, now),
            RestartVerdict::Wait,
            "nothing new since"
        );
        assert_eq!(restarts.verdict(5, false, now + LONGEST_PAUSE), RestartVerdict::Start);
        for _ in 0..1000 {
            restarts.verdict(5, false, now);
            assert_eq!(restarts.verdict(5, false, now + LONGEST_PAUSE), RestartVerdict::Start);
        }
        assert_eq!(restarts.verdict(6, true, now), RestartVerdict::Start, "a new tick");
        let crash = |restarts: &mut EnvironmentRestarts| {
            restarts.verdict(6, true, now);
            restarts.verdict(6, true, now + LONGEST_PAUSE)
        };
        let verdicts: Vec<_> = (0..MAX_VAIN_REPLACEMENTS).map(|_| crash(&mut restarts)).collect();
        assert_eq!(verdicts.last(), Some(&RestartVerdict::GiveUp));
        assert!(verdicts[..4].iter().all(|verdict| *verdict == RestartVerdict::Start));
    }

    #[test]
    fn a_watcher_that_works_is_restarted_however_often_it_is_killed() {
        let (mut restarts, now) = (WatcherRestarts::default(), Instant::now());
        assert!((0..1000).all(|_| restarts.verdict(true, now) == RestartVerdict::Start));
    }

    #[test]
    fn a_watcher_that_never_works_is_started_ever_less_often_and_given_up() {
        let (mut restarts, mut now) = (WatcherRestarts::default(), Instant::now());
        let begun = now;
        for _ in 0..MAX_VAIN_STARTS {
            assert_eq!(restarts.verdict(false, now), RestartVerdict::Wait);
            now += LONGEST_PAUSE;
            assert_eq!(restarts.verdict(false, now), RestartVerdict::Start);
        }
        assert_eq!(restarts.verdict(false, now), RestartVerdict::GiveUp);
        assert_eq!(restarts.verdict(false, now + LONGEST_PAUSE), RestartVerdict::GiveUp);
        assert!(begun < now);
        let mut again = WatcherRestarts::default();
        assert_eq!(again.verdict(false, now), RestartVerdict::Wait);
        assert_eq!(again.verdict(false, now + PAUSE), RestartVerdict::Start);
        assert_eq!(again.verdict(true, now + PAUSE), RestartVerdict::Start);
    }
}
