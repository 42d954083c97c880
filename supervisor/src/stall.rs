//! Finds processes that hang: they neither finish a piece of work nor look for what they wait for.
//!
//! A process that waits in order notes every look on its board, so it does not hang however long it waits: for a producer that hangs,
//! for the end of a pause, for a slow consumer. Time counts as this process measures it, from check to check: while it is stopped
//! itself, hardly any time counts. Nor does the time in which a process could run but gets no core, on an overloaded machine.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use ipc_schema::{config::RunConfig, process::Process};

/// Most time that counts between two checks.
const LONGEST_COUNTED: Duration = Duration::from_millis(500);

/// A process of a run and its environment.
pub type ProcessPlace = (Process, u32);

/// What the board of a running process says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LifeSign {
    /// The process.
    pub place: ProcessPlace,
    /// Its incarnation.
    pub incarnation: u32,
    /// The newest note of its activity.
    pub noted_ns: u64,
    /// Time that it has waited for a core since its start.
    pub queued: Duration,
    /// True until it is ready.
    pub is_starting: bool,
    /// True while it may be silent: it is done, or its first start has a deadline of its own.
    pub is_excused: bool,
}

/// A change that a check has found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StallChange {
    /// The process hangs.
    Begins {
        /// The process.
        place: ProcessPlace,
        /// Time without a sign of life.
        silence: Duration,
        /// True if it was not ready in time.
        is_starting: bool,
    },
    /// A process that hung gives signs of life again.
    Ends(ProcessPlace),
}

#[derive(Debug, Clone, Copy)]
struct Silence {
    incarnation: u32,
    noted_ns: u64,
    /// Time that the process had waited for a core at its last sign of life.
    queued: Duration,
    /// Time since then.
    passed: Duration,
    /// Of this, the time in which the process did not wait for a core.
    lasts: Duration,
    is_stall: bool,
}

/// The time since the last sign of life of every process.
#[derive(Debug)]
pub struct StallWatch {
    /// `run.stall_s`.
    limit: Duration,
    /// `run.ready_s`, for processes that start.
    ready_limit: Duration,
    last_check: Instant,
    silences: BTreeMap<ProcessPlace, Silence>,
}

impl StallWatch {
    /// A watch for processes that give no sign of life for `run.stall_s`, or `run.ready_s` from their start.
    #[must_use]
    pub fn new(run: &RunConfig, now: Instant) -> Self {
        Self {
            limit: Duration::from_secs_f64(run.stall_s),
            ready_limit: Duration::from_secs_f64(run.ready_s),
            last_check: now,
            silences: BTreeMap::new(),
        }
    }

    /// Reads the signs of all running processes at `now`, and returns the stalls that begin and end.
    pub fn check(&mut self, now: Instant, signs: &[LifeSign]) -> Vec<StallChange> {
        let passed = now.saturating_duration_since(self.last_check).min(LONGEST_COUNTED);
        self.last_check = now;
        // A process that has ended hangs no more.
        self.silences
            .retain(|place, _| signs.iter().any(|sign| sign.place == *place));
        signs.iter().filter_map(|sign| self.check_one(passed, *sign)).collect()
    }

    fn check_one(&mut self, passed: Duration, sign: LifeSign) -> Option<StallChange> {
        let fresh = Silence {
            incarnation: sign.incarnation,
            noted_ns: sign.noted_ns,
            queued: sign.queued,
            passed: Duration::ZERO,
            lasts: Duration::ZERO,
            is_stall: false,
        };
        let silence = self.silences.entry(sign.place).or_insert(fresh);
        if sign.is_excused || (silence.incarnation, silence.noted_ns) != (sign.incarnation, sign.noted_ns) {
            let is_over = silence.is_stall && silence.incarnation == sign.incarnation;
            *silence = fresh;
            return is_over.then_some(StallChange::Ends(sign.place));
        }
        silence.passed += passed;
        let queued = sign.queued.saturating_sub(silence.queued);
        silence.lasts = silence.passed.saturating_sub(queued);
        let limit = if sign.is_starting { self.ready_limit } else { self.limit };
        if silence.is_stall || silence.lasts < limit {
            return None;
        }
        silence.is_stall = true;
        Some(StallChange::Begins {
            place: sign.place,
            silence: silence.lasts,
            is_starting: sign.is_starting,
        })
    }

    /// The processes that hang, with the time since their last sign of life.
    pub fn stalls(&self) -> impl Iterator<Item = (ProcessPlace, Duration)> {
        let stalls = self.silences.iter().filter(|(_, silence)| silence.is_stall);
        stalls.map(|(place, silence)| (*place, silence.lasts))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CORE: ProcessPlace = (Process::SimCore, 0);
    const CHECK: Duration = Duration::from_millis(100);

    /// A watch with `run.stall_s` = 2 and `run.ready_s` = 40.
    fn watch(now: Instant) -> StallWatch {
        StallWatch {
            limit: Duration::from_secs(2),
            ready_limit: Duration::from_secs(40),
            last_check: now,
            silences: BTreeMap::new(),
        }
    }

    fn sign(noted_ns: u64) -> LifeSign {
        LifeSign {
            place: CORE,
            incarnation: 0,
            noted_ns,
            queued: Duration::ZERO,
            is_starting: false,
            is_excused: false,
        }
    }

    /// Checks the same sign `checks` times, one every [`CHECK`].
    fn repeat(watch: &mut StallWatch, now: &mut Instant, checks: u32, sign: LifeSign) -> Vec<StallChange> {
        let check = |_| {
            *now += CHECK;
            watch.check(*now, &[sign])
        };
        (0..checks).flat_map(check).collect()
    }

    #[test]
    fn a_process_without_a_sign_of_life_hangs_until_the_next_sign() {
        let mut now = Instant::now();
        let mut watch = watch(now);
        assert_eq!(repeat(&mut watch, &mut now, 15, sign(1)), []);
        assert_eq!(repeat(&mut watch, &mut now, 15, sign(2)), [], "a sign of life");
        let silence = Duration::from_secs(2);
        let begins = StallChange::Begins {
            place: CORE,
            silence,
            is_starting: false,
        };
        assert_eq!(repeat(&mut watch, &mut now, 15, sign(2)), [begins], "once");
        assert!(watch.stalls().all(|(place, lasts)| place == CORE && lasts > silence));
        assert_eq!(watch.stalls().count(), 1);
        assert_eq!(watch.check(now, &[sign(3)]), [StallChange::Ends(CORE)]);
        assert_eq!(watch.stalls().count(), 0);
    }

    #[test]
    fn a_process_that_is_excused_or_replaced_does_not_hang() {
        let mut now = Instant::now();
        let mut watch = watch(now);
        let excused = LifeSign {
            is_excused: true,
            ..sign(1)
        };
        assert_eq!(repeat(&mut watch, &mut now, 100, excused), []);
        assert_eq!(repeat(&mut watch, &mut now, 15, sign(1)), []);
        let next = LifeSign {
            incarnation: 1,
            noted_ns: 0,
            is_starting: true,
            ..sign(1)
        };
        assert_eq!(repeat(&mut watch, &mut now, 390, next), [], "it starts");
        let late = repeat(&mut watch, &mut now, 20, next);
        assert!(
            matches!(late[..], [StallChange::Begins { is_starting: true, .. }]),
            "{late:?}"
        );
        assert_eq!(watch.check(now, &[]), []);
        assert_eq!(watch.stalls().count(), 0, "it has ended");
    }

    #[test]
    fn the_time_in_which_a_process_gets_no_core_does_not_count() {
        let mut now = Instant::now();
        let mut watch = watch(now);
        for check in 1..=1000 {
            let starved = LifeSign {
                queued: CHECK * check,
                ..sign(1)
            };
            assert_eq!(repeat(&mut watch, &mut now, 1, starved), []);
        }
        let runs = LifeSign {
            queued: CHECK * 1000,
            ..sign(1)
        };
        assert_eq!(
            repeat(&mut watch, &mut now, 30, runs).len(),
            1,
            "it runs, and does nothing"
        );
    }

    #[test]
    fn the_time_in_which_the_supervisor_itself_was_stopped_does_not_count() {
        let mut now = Instant::now();
        let mut watch = watch(now);
        assert_eq!(repeat(&mut watch, &mut now, 10, sign(1)), []);
        now += Duration::from_secs(3600);
        assert_eq!(watch.check(now, &[sign(1)]), []);
        assert_eq!(repeat(&mut watch, &mut now, 3, sign(1)), []);
        assert_eq!(repeat(&mut watch, &mut now, 10, sign(1)).len(), 1);
    }
}
