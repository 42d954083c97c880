//! A planned handover from one trainer to its successor. The simulation continues meanwhile: ticks for which no trainer has credit
//! wait in the journal.

use std::time::{Duration, Instant};

use ipc_schema::board::Progress;
use serde::Serialize;

/// While a successor catches up, one tick may be made for every two that it consumes: the simulation continues and the distance shrinks.
const CONSUMED_PER_TICK: u64 = 2;

/// Measurements of one handover.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct HandoverFigures {
    /// Incarnation of the successor.
    pub incarnation: u32,
    /// Longest wait of the simulation before a tick, until the successor had consumed its first tick, wall seconds.
    pub stall_s: f64,
    /// Ticks made while no trainer was attached.
    pub ticks_without_trainer: u64,
    /// Largest number of ticks that were made and not yet consumed.
    pub most_ahead_ticks: u64,
}

/// Consumed and made ticks when the successor took over.
#[derive(Debug, Clone, Copy)]
struct TakenUp {
    consumed: u64,
    made: u64,
}

/// A handover under way, as sensor-daemon sees it.
#[derive(Debug)]
pub struct RunningHandover {
    began: Instant,
    leaving: u32,
    stall: Duration,
    ticks_without_trainer: u64,
    most_ahead_ticks: u64,
    taken: Option<TakenUp>,
    /// The successor has consumed a tick: from here on a wait for it is no stall of the handover.
    has_consumed: bool,
}

impl RunningHandover {
    /// Begins a handover at `now` from the incarnation `leaving`.
    #[must_use]
    pub fn begin(now: Instant, leaving: u32) -> Self {
        Self {
            began: now,
            leaving,
            stall: Duration::ZERO,
            ticks_without_trainer: 0,
            most_ahead_ticks: 0,
            taken: None,
            has_consumed: false,
        }
    }

    /// Takes in the trainer's `progress` after `made` ticks; `waited_for` is true while the supervisor still reports a handover.
    pub fn update(&mut self, progress: &Progress, waited_for: bool, made: u64) {
        if progress.attached == 0 {
            self.taken = None;
            return;
        }
        self.most_ahead_ticks = self.most_ahead_ticks.max(made.saturating_sub(progress.consumed_ticks));
        if !waited_for && self.taken.is_none() {
            self.taken = Some(TakenUp {
                consumed: progress.consumed_ticks,
                made,
            });
        }
        // A trainer attaches with exactly the committed ticks consumed.
        self.has_consumed |= progress.incarnation != self.leaving && progress.consumed_ticks > progress.committed_ticks;
    }

    /// True if the tick after `made` ticks may be made although the trainer has no credit for it.
    #[must_use]
    pub fn allows(&self, progress: &Progress, made: u64) -> bool {
        self.taken.is_none_or(|taken| {
            let consumed = progress.consumed_ticks.saturating_sub(taken.consumed);
            made < taken.made + consumed / CONSUMED_PER_TICK
        })
    }

    /// Counts a tick that was made without credit.
    pub fn count_tick(&mut self, progress: &Progress) {
        if progress.attached == 0 {
            self.ticks_without_trainer += 1;
        }
    }

    /// Adds a wait of the simulation from `since` to `now`; only the part after the handover's begin counts.
    pub fn add_wait(&mut self, since: Instant, now: Instant) {
        if !self.has_consumed {
            self.stall = self.stall.max(now.saturating_duration_since(since.max(self.began)));
        }
    }

    /// True once the successor has taken over.
    #[must_use]
    pub fn has_successor(&self) -> bool {
        self.taken.is_some()
    }

    /// True once the successor has taken over and, by `is_level`, has caught up.
    #[must_use]
    pub fn is_over(&self, is_level: bool) -> bool {
        self.taken.is_some() && is_level
    }

    /// Measurements so far, for the successor `incarnation`.
    #[must_use]
    pub fn figures(&self, incarnation: u32) -> HandoverFigures {
        HandoverFigures {
            incarnation,
            stall_s: self.stall.as_secs_f64(),
            ticks_without_trainer: self.ticks_without_trainer,
            most_ahead_ticks: self.most_ahead_ticks,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn at(consumed_ticks: u64, attached: u32) -> Progress {
        Progress {
            consumed_ticks,
            attached,
            ..Progress::default()
        }
    }

    #[test]
    fn the_simulation_continues_until_the_successor_attaches() {
        let mut handover = RunningHandover::begin(Instant::now(), 0);
        handover.update(&at(100, 1), true, 108);
        assert!(handover.allows(&at(100, 1), 108), "the old trainer is still attached");
        handover.update(&at(0, 0), true, 120);
        assert!(handover.allows(&at(0, 0), 1_000_000), "no trainer is attached");
        handover.count_tick(&at(0, 0));
        assert!(!handover.is_over(true));
        handover.update(&at(90, 1), false, 150);
        assert!(!handover.allows(&at(91, 1), 150));
        assert!(handover.allows(&at(92, 1), 150));
        assert!(handover.is_over(true) && !handover.is_over(false));
        let figures = handover.figures(1);
        assert_eq!((figures.ticks_without_trainer, figures.most_ahead_ticks), (1, 60));
    }

    #[test]
    fn only_a_wait_after_the_begin_is_a_stall() {
        let start = Instant::now();
        let mut handover = RunningHandover::begin(start + Duration::from_millis(40), 0);
        handover.add_wait(start, start + Duration::from_millis(50));
        assert_eq!(handover.figures(1).stall_s, 0.01);
        handover.add_wait(start, start + Duration::from_millis(30));
        assert_eq!(handover.figures(1).stall_s, 0.01);
        let successor = Progress {
            incarnation: 1,
            committed_ticks: 7,
            ..at(8, 1)
        };
        handover.update(&successor, true, 20);
        handover.add_wait(start, start + Duration::from_secs(1));
        assert_eq!(handover.figures(1).stall_s, 0.01, "the successor has consumed a tick");
    }

    proptest! {
        /// A successor that begins `behind` ticks late catches up within twice as many, while every second one a tick is made.
        #[test]
        fn a_successor_catches_up_while_the_simulation_continues(first in 0_u64..1000, behind in 0_u64..1000) {
            let (mut consumed, mut made) = (first, first + behind);
            let mut handover = RunningHandover::begin(Instant::now(), 0);
            handover.update(&at(consumed, 1), false, made);
            while consumed < made {
                consumed += 1;
                let before = made;
                while handover.allows(&at(consumed, 1), made) {
                    made += 1;
                }
                prop_assert!(made - before <= 1);
                prop_assert!(made >= first + behind + (consumed - first) / CONSUMED_PER_TICK);
            }
            prop_assert!(consumed - first <= 2 * behind);
        }
    }
}
