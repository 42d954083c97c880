//! Decides when an ended process is started again.
//!
//! A watcher that had opened its ports is started again at once. One that had not is started after a growing pause. A process that the
//! run needs is started again after a pause that grows while it makes no progress. Only ends of its own fault can make the supervisor
//! give one of them up.

use std::{
    os::unix::process::ExitStatusExt as _,
    process::ExitStatus,
    time::{Duration, Instant},
};

use signal_hook::consts::{SIGHUP, SIGINT, SIGKILL, SIGTERM, SIGUSR1};

/// Ends of its own fault in a row, before which it did not open its ports, after which a watcher is not started again.
const MAX_WATCHER_FAULTS: u32 = 20;
/// Most restarts in a row without progress after ends of a process's own fault.
pub const MAX_VAIN_FAULTS: u32 = 5;
/// Signals that come from outside.
const KILLS: [i32; 5] = [SIGKILL, SIGTERM, SIGINT, SIGHUP, SIGUSR1];
/// Exit code of a trainer that ends because that of another rank was replaced, `caraware.learn.meeting.LOST_ANOTHER`.
const LOST_ANOTHER: i32 = 75;
/// Pause after the first start in vain. It doubles with each further one.
const PAUSE: Duration = Duration::from_millis(100);
/// Longest pause.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// The decision on an ended process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RestartVerdict {
    /// Start it now.
    Start,
    /// Start it after this time.
    Postpone(Duration),
    /// Its start is postponed: decide again later.
    Wait,
    /// Never start it again. A watcher is given up once; later verdicts are to wait.
    GiveUp,
}

/// Restarts of one watcher.
#[derive(Debug, Clone, Copy, Default)]
pub struct WatcherRestarts {
    /// Starts in vain since the watcher last opened its ports.
    vain: u32,
    /// Of these, those that ended by its own fault.
    faults: u32,
    /// Time of the next start.
    due: Option<Instant>,
}

impl WatcherRestarts {
    /// Decides on the watcher, which has ended by `now`. `worked` is true if it had opened its ports.
    pub fn verdict(&mut self, worked: bool, cause: EndCause, now: Instant) -> RestartVerdict {
        let (is_new, was_given_up) = (self.due.is_none(), self.is_given_up());
        let due = *self.due.get_or_insert_with(|| {
            if worked {
                (self.vain, self.faults) = (0, 0);
            } else {
                self.vain += 1;
                self.faults += u32::from(cause == EndCause::OwnFault);
            }
            now + pause(self.vain)
        });
        if self.is_given_up() {
            match is_new && !was_given_up {
                true => RestartVerdict::GiveUp,
                false => RestartVerdict::Wait,
            }
        } else if now < due {
            RestartVerdict::Wait
        } else {
            self.due = None;
            RestartVerdict::Start
        }
    }

    fn is_given_up(&self) -> bool {
        self.faults > MAX_WATCHER_FAULTS
    }
}

/// Whose fault the end of a process is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndCause {
    /// Another process, or a user, has killed it, or the trainer of another rank.
    Kill,
    /// The program itself: a crash, or an exit before its work was done.
    OwnFault,
}

impl EndCause {
    /// The cause of an end with this status. The signals of [`KILLS`] come from outside; a program sends itself others when it crashes.
    #[must_use]
    pub fn of(status: ExitStatus) -> Self {
        match status.signal() {
            Some(signal) if KILLS.contains(&signal) => Self::Kill,
            None if lost_another(status) => Self::Kill,
            _ => Self::OwnFault,
        }
    }
}

/// True if a trainer with this status has ended because that of another rank was replaced.
#[must_use]
pub fn lost_another(status: ExitStatus) -> bool {
    status.code() == Some(LOST_ANOTHER)
}

/// Restarts of a process, or of the processes of an environment, that the run needs. After a kill it is started again however often
/// that happens; after [`MAX_VAIN_FAULTS`] ends of its own fault without progress it is not.
#[derive(Debug, Clone, Copy, Default)]
pub struct RequiredRestarts {
    /// Ends since the last progress.
    vain: u32,
    /// Of these, ends of its own fault.
    faults: u32,
    /// Most ticks that were sensed, or committed, at an end.
    progress_ticks: u64,
    due: Option<Instant>,
}

impl RequiredRestarts {
    /// What to do about an end that is found at `now`, when it had come to `progress_ticks`. The first verdict on an end that has to
    /// wait is [`RestartVerdict::Postpone`].
    pub fn verdict(&mut self, progress_ticks: u64, cause: EndCause, now: Instant) -> RestartVerdict {
        let is_new = self.due.is_none();
        let due = match self.due {
            Some(due) => due,
            None => self.note_end(progress_ticks, cause, now),
        };
        if self.faults > MAX_VAIN_FAULTS {
            return RestartVerdict::GiveUp;
        }
        match due.saturating_duration_since(now) {
            Duration::ZERO => {
                self.due = None;
                RestartVerdict::Start
            }
            left if is_new => RestartVerdict::Postpone(left),
            _ => RestartVerdict::Wait,
        }
    }

    fn note_end(&mut self, progress_ticks: u64, cause: EndCause, now: Instant) -> Instant {
        if progress_ticks > self.progress_ticks {
            (self.progress_ticks, self.vain, self.faults) = (progress_ticks, 0, 0);
        }
        let due = now + pause(self.vain);
        self.vain += 1;
        self.faults += u32::from(cause == EndCause::OwnFault);
        *self.due.insert(due)
    }

    /// Notes that the postponed start takes place.
    pub fn start_now(&mut self) {
        self.due = None;
    }

    /// Time until the next start, while one is postponed.
    #[must_use]
    pub fn wait(&self, now: Instant) -> Option<Duration> {
        let left = self.due?.saturating_duration_since(now);
        (!left.is_zero()).then_some(left)
    }

    /// Ends since the last progress.
    #[must_use]
    pub fn vain_ends(&self) -> u32 {
        self.vain
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

    /// The verdict on an end once its pause is over.
    fn after_pause(restarts: &mut RequiredRestarts, progress_ticks: u64, cause: EndCause) -> RestartVerdict {
        let now = Instant::now();
        match restarts.verdict(progress_ticks, cause, now) {
            RestartVerdict::Postpone(pause) => {
                assert_eq!(restarts.verdict(progress_ticks, cause, now), RestartVerdict::Wait);
                assert_eq!(restarts.wait(now), Some(pause));
                restarts.verdict(progress_ticks, cause, now + pause)
            }
            verdict => verdict,
        }
    }

    #[test]
    fn a_killed_process_is_started_ever_less_often_and_never_given_up() {
        let (mut restarts, now) = (RequiredRestarts::default(), Instant::now());
        assert_eq!(restarts.verdict(5, EndCause::Kill, now), RestartVerdict::Start);
        let pauses: Vec<Duration> = (0..1000)
            .map(|_| match restarts.verdict(5, EndCause::Kill, now) {
                RestartVerdict::Postpone(pause) => {
                    assert_eq!(restarts.verdict(5, EndCause::Kill, now + pause), RestartVerdict::Start);
                    pause
                }
                verdict => panic!("{verdict:?}"),
            })
            .collect();
        assert_eq!((pauses[0], pauses[1], pauses[999]), (PAUSE, 2 * PAUSE, LONGEST_PAUSE));
        assert!(pauses.is_sorted());
        assert_eq!(
            restarts.verdict(6, EndCause::Kill, now),
            RestartVerdict::Start,
            "progress"
        );
    }

    #[test]
    fn a_process_that_ends_by_its_own_fault_is_given_up_after_five_restarts_without_progress() {
        let mut restarts = RequiredRestarts::default();
        for progress_ticks in [0, 7] {
            for _ in 0..MAX_VAIN_FAULTS {
                let verdict = after_pause(&mut restarts, progress_ticks, EndCause::OwnFault);
                assert_eq!(verdict, RestartVerdict::Start);
                // Kills in between do not count.
                let verdict = after_pause(&mut restarts, progress_ticks, EndCause::Kill);
                assert_eq!(verdict, RestartVerdict::Start);
            }
        }
        let verdict = after_pause(&mut restarts, 7, EndCause::OwnFault);
        assert_eq!(verdict, RestartVerdict::GiveUp);
    }

    #[test]
    fn a_kill_comes_from_outside_and_a_crash_does_not() {
        let cause = |wait_status| EndCause::of(ExitStatus::from_raw(wait_status));
        assert!(
            [SIGKILL, SIGTERM]
                .map(cause)
                .iter()
                .all(|cause| *cause == EndCause::Kill)
        );
        assert_eq!(cause(LOST_ANOTHER << 8), EndCause::Kill);
        let crashes = [
            signal_hook::consts::SIGSEGV,
            signal_hook::consts::SIGABRT,
            1 << 8,
            76 << 8,
            0,
        ];
        assert!(crashes.map(cause).iter().all(|cause| *cause == EndCause::OwnFault));
    }

    #[test]
    fn a_watcher_that_works_is_restarted_however_often_it_ends() {
        let (mut restarts, now) = (WatcherRestarts::default(), Instant::now());
        for cause in [EndCause::Kill, EndCause::OwnFault] {
            assert!((0..1000).all(|_| restarts.verdict(true, cause, now) == RestartVerdict::Start));
        }
    }

    /// The verdict on the end of a watcher before it had opened its ports, after the longest pause.
    fn after_vain_start(restarts: &mut WatcherRestarts, cause: EndCause, now: &mut Instant) -> RestartVerdict {
        let verdict = restarts.verdict(false, cause, *now);
        if verdict != RestartVerdict::Wait {
            return verdict;
        }
        *now += LONGEST_PAUSE;
        restarts.verdict(false, cause, *now)
    }

    #[test]
    fn a_watcher_that_is_killed_while_it_starts_is_started_ever_less_often_and_never_given_up() {
        let (mut restarts, mut now) = (WatcherRestarts::default(), Instant::now());
        assert_eq!(restarts.verdict(false, EndCause::Kill, now), RestartVerdict::Wait);
        assert_eq!(
            restarts.verdict(false, EndCause::Kill, now + PAUSE),
            RestartVerdict::Start
        );
        assert_eq!(restarts.verdict(false, EndCause::Kill, now), RestartVerdict::Wait);
        assert_eq!(
            restarts.verdict(false, EndCause::Kill, now + PAUSE),
            RestartVerdict::Wait
        );
        now += LONGEST_PAUSE;
        assert_eq!(restarts.verdict(false, EndCause::Kill, now), RestartVerdict::Start);
        for _ in 0..1000 {
            assert_eq!(
                after_vain_start(&mut restarts, EndCause::Kill, &mut now),
                RestartVerdict::Start
            );
        }
        assert_eq!(restarts.verdict(true, EndCause::Kill, now), RestartVerdict::Start);
    }

    #[test]
    fn a_watcher_that_never_works_by_its_own_fault_is_given_up_once() {
        let (mut restarts, mut now) = (WatcherRestarts::default(), Instant::now());
        for _ in 0..MAX_WATCHER_FAULTS {
            // Kills in between do not count.
            for cause in [EndCause::OwnFault, EndCause::Kill] {
                assert_eq!(after_vain_start(&mut restarts, cause, &mut now), RestartVerdict::Start);
            }
        }
        assert_eq!(restarts.verdict(false, EndCause::OwnFault, now), RestartVerdict::GiveUp);
        for later in [now, now + 2 * LONGEST_PAUSE] {
            assert_eq!(restarts.verdict(false, EndCause::OwnFault, later), RestartVerdict::Wait);
        }
    }
}
