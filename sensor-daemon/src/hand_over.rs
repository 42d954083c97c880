//! A planned hand-over from one trainer to the next, during which the simulation goes on: what nobody has credit for yet waits in the
//! journal.

use std::time::{Duration, Instant};

use ipc_schema::board::Progress;
use serde::Serialize;

/// Of so many ticks that a successor consumes while it catches up, one may be made: the simulation goes on, and the distance shrinks.
const CONSUMED_PER_TICK: u64 = 2;

/// What a hand-over came to.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Account {
    /// The successor.
    pub incarnation: u32,
    /// Longest time that the simulation waited for a trainer before a tick, until the successor had consumed its first, wall seconds.
    pub stall_s: f64,
    /// Ticks made while no trainer was attached.
    pub ticks_without_trainer: u64,
    /// Most ticks made and not consumed at a time.
    pub most_ahead_ticks: u64,
}

/// Where a successor stood when it took up its work.
#[derive(Debug, Clone, Copy)]
struct Taken {
    consumed: u64,
    made: u64,
}

/// A hand-over under way.
#[derive(Debug)]
pub struct HandOver {
    began: Instant,
    leaving: u32,
    stall: Duration,
    ticks_without_trainer: u64,
    most_ahead_ticks: u64,
    taken: Option<Taken>,
    /// The successor has consumed a tick: from here on the simulation waits for it as for any trainer.
    is_at_work: bool,
}

impl HandOver {
    /// It begins now; the incarnation `leaving` is at work.
    #[must_use]
    pub fn begin(now: Instant, leaving: u32) -> Self {
        Self {
            began: now,
            leaving,
            stall: Duration::ZERO,
            ticks_without_trainer: 0,
            most_ahead_ticks: 0,
            taken: None,
            is_at_work: false,
        }
    }

    /// Notes who stands where; `waited_for` says that the supervisor still sees a hand-over, `made` is the number of ticks so far.
    pub fn note(&mut self, progress: &Progress, waited_for: bool, made: u64) {
        if progress.attached == 0 {
            self.taken = None;
            return;
        }
        self.most_ahead_ticks = self.most_ahead_ticks.max(made.saturating_sub(progress.consumed_ticks));
        if !waited_for && self.taken.is_none() {
            self.taken = Some(Taken {
                consumed: progress.consumed_ticks,
                made,
            });
        }
        // Who attaches has consumed what is committed, and nothing else.
        self.is_at_work |= progress.incarnation != self.leaving && progress.consumed_ticks > progress.committed_ticks;
    }

    /// True if the tick after `made` ticks may be made although its consumer has no credit for it.
    #[must_use]
    pub fn allows(&self, progress: &Progress, made: u64) -> bool {
        self.taken.is_none_or(|taken| {
            let consumed = progress.consumed_ticks.saturating_sub(taken.consumed);
            made < taken.made + consumed / CONSUMED_PER_TICK
        })
    }

    /// A tick was made without credit.
    pub fn made_one(&mut self, progress: &Progress) {
        if progress.attached == 0 {
            self.ticks_without_trainer += 1;
        }
    }

    /// The simulation waited for a trainer from `since` to `now`; only what lies after the beginning counts.
    pub fn waited(&mut self, since: Instant, now: Instant) {
        if !self.is_at_work {
            self.stall = self.stall.max(now.saturating_duration_since(since.max(self.began)));
        }
    }

    /// True once the successor has taken up its work.
    #[must_use]
    pub fn has_successor(&self) -> bool {
        self.taken.is_some()
    }

    /// True once a trainer is at work and has nothing to catch up with.
    #[must_use]
    pub fn is_over(&self, is_level: bool) -> bool {
        self.taken.is_some() && is_level
    }

    /// What it came to.
    #[must_use]
    pub fn account(&self, incarnation: u32) -> Account {
        Account {
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
    fn the_simulation_goes_on_until_the_successor_is_there() {
        let mut hand_over = HandOver::begin(Instant::now(), 0);
        hand_over.note(&at(100, 1), true, 108);
        assert!(hand_over.allows(&at(100, 1), 108), "the old trainer is still at work");
        hand_over.note(&at(0, 0), true, 120);
        assert!(hand_over.allows(&at(0, 0), 1_000_000), "nobody is attached");
        hand_over.made_one(&at(0, 0));
        assert!(!hand_over.is_over(true));
        hand_over.note(&at(90, 1), false, 150);
        assert!(!hand_over.allows(&at(91, 1), 150));
        assert!(hand_over.allows(&at(92, 1), 150));
        assert!(hand_over.is_over(true) && !hand_over.is_over(false));
        let account = hand_over.account(1);
        assert_eq!((account.ticks_without_trainer, account.most_ahead_ticks), (1, 60));
    }

    #[test]
    fn only_waiting_after_the_beginning_is_a_stall() {
        let start = Instant::now();
        let mut hand_over = HandOver::begin(start + Duration::from_millis(40), 0);
        hand_over.waited(start, start + Duration::from_millis(50));
        assert_eq!(hand_over.account(1).stall_s, 0.01);
        hand_over.waited(start, start + Duration::from_millis(30));
        assert_eq!(hand_over.account(1).stall_s, 0.01);
        let successor = Progress {
            incarnation: 1,
            committed_ticks: 7,
            ..at(8, 1)
        };
        hand_over.note(&successor, true, 20);
        hand_over.waited(start, start + Duration::from_secs(1));
        assert_eq!(hand_over.account(1).stall_s, 0.01, "the successor is at work");
    }

    proptest! {
        /// However far behind a successor begins, it is level before it has consumed twice that, and a tick is made for every two.
        #[test]
        fn a_successor_gets_level_while_the_simulation_goes_on(first in 0_u64..1000, behind in 0_u64..1000) {
            let (mut consumed, mut made) = (first, first + behind);
            let mut hand_over = HandOver::begin(Instant::now(), 0);
            hand_over.note(&at(consumed, 1), false, made);
            while consumed < made {
                consumed += 1;
                let before = made;
                while hand_over.allows(&at(consumed, 1), made) {
                    made += 1;
                }
                prop_assert!(made - before <= 1);
                prop_assert!(made >= first + behind + (consumed - first) / CONSUMED_PER_TICK);
            }
            prop_assert!(consumed - first <= 2 * behind);
        }
    }
}
