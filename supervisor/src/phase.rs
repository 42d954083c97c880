//! What a run does at a moment, and the share of its time that it has spent on each.

use std::time::{Duration, Instant};

use ipc_schema::{
    activity::{Activity, Awaited},
    process::Process,
};

use crate::environment::Environment;

/// A trainer that has not looked for a tick for this long is at work on an update.
const UPDATE_S: f64 = 0.1;
/// A run without a new tick for this long waits for something.
const LONGEST_TICK: Duration = Duration::from_millis(500);

/// What a run does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunPhase {
    /// It makes ticks that are learnt from, or only recorded.
    Simulating,
    /// It makes ticks of an evaluation.
    Evaluating,
    /// The trainer works on an update.
    Learning,
    /// Simulators that were started again make ticks that were made before.
    MakingAgain,
    /// No tick is made: the run is paused, waits for a process that starts, or for a clock.
    Waiting,
}

impl RunPhase {
    const ALL: [Self; 5] = [
        Self::Simulating,
        Self::Evaluating,
        Self::Learning,
        Self::MakingAgain,
        Self::Waiting,
    ];

    /// As it is shown.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Simulating => "simulating",
            Self::Evaluating => "evaluating",
            Self::Learning => "learning",
            Self::MakingAgain => "making ticks again",
            Self::Waiting => "waiting",
        }
    }

    /// The phase that the boards of a run show. `is_evaluation` says whether its slowest environment is in an evaluation, `silence`
    /// for how long no environment has made a tick.
    #[must_use]
    pub fn of(environments: &[Environment], is_evaluation: bool, silence: Duration) -> Self {
        let is_again = |environment: &Environment| {
            let made = environment.board(Process::SensorDaemon).health().ticks;
            environment.run.restart.is_some() && made < environment.sensed_ticks()
        };
        let has_trainer = |environment: &&Environment| environment.run.mode.has_trainer();
        let trainer = environments.first().filter(has_trainer);
        if environments.iter().any(is_again) {
            Self::MakingAgain
        } else if trainer.is_some_and(|first| is_updating(&first.board(Process::Trainer).activity())) {
            Self::Learning
        } else if silence > LONGEST_TICK {
            Self::Waiting
        } else if is_evaluation {
            Self::Evaluating
        } else {
            Self::Simulating
        }
    }
}

fn is_updating(trainer: &Activity) -> bool {
    trainer.noted_ns > 0 && trainer.awaited() == Awaited::Nothing && trainer.age_s() > UPDATE_S
}

/// Time that a run has spent in each phase, by looks at its boards.
#[derive(Debug)]
pub struct PhaseShares {
    spent: [Duration; RunPhase::ALL.len()],
    last: Option<Instant>,
}

impl PhaseShares {
    /// No time yet.
    #[must_use]
    pub fn new() -> Self {
        Self {
            spent: [Duration::ZERO; RunPhase::ALL.len()],
            last: None,
        }
    }

    /// Counts the time since the look before as spent in `phase`.
    pub fn count(&mut self, phase: RunPhase, now: Instant) {
        if let Some(last) = self.last.replace(now) {
            self.spent[phase as usize] += now.saturating_duration_since(last);
        }
    }

    /// The phases but simulation with their shares, such as "learning 31 %"; empty if there was none.
    #[must_use]
    pub fn text(&self) -> String {
        let all_s: f64 = self.spent.iter().map(Duration::as_secs_f64).sum();
        let others = RunPhase::ALL.into_iter().filter(|phase| *phase != RunPhase::Simulating);
        let shares = others.filter_map(|phase| {
            let percent = 100.0 * self.spent[phase as usize].as_secs_f64() / all_s;
            (percent >= 0.5).then(|| format!("{} {percent:.0} %", phase.name()))
        });
        shares.collect::<Vec<_>>().join(", ")
    }
}

impl Default for PhaseShares {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_of_the_time_between_two_looks() {
        let (mut shares, begin) = (PhaseShares::new(), Instant::now());
        let at = |seconds| begin + Duration::from_secs(seconds);
        assert_eq!(shares.text(), "");
        shares.count(RunPhase::Learning, at(0));
        shares.count(RunPhase::Simulating, at(6));
        assert_eq!(shares.text(), "");
        shares.count(RunPhase::Learning, at(9));
        shares.count(RunPhase::Evaluating, at(10));
        assert_eq!(shares.text(), "evaluating 10 %, learning 30 %");
    }

    #[test]
    fn an_update_is_a_long_silence_without_waiting() {
        assert!(!is_updating(&Activity::default()));
        assert!(!is_updating(&Activity::now(Awaited::Nothing)));
        let long_ago = |awaited| {
            let mut activity = Activity::now(awaited);
            activity.noted_ns = activity.noted_ns.saturating_sub(200_000_000).max(1);
            activity
        };
        assert!(is_updating(&long_ago(Awaited::Nothing)));
        assert!(!is_updating(&long_ago(Awaited::Input(Process::SensorDaemon))));
    }
}
