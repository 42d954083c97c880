//! What a process does at present, on its board: a sign of life, and what it waits for.

use iceoryx2::prelude::ZeroCopySend;

use crate::{board::State, clock, process::Process};

/// What a process waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Awaited {
    /// Nothing: it works.
    Nothing,
    /// The next message of this process.
    Input(Process),
    /// The credit of this process, a required consumer.
    Credit(Process),
    /// The trainers of other ranks, in an operation of all.
    Ranks,
    /// A command, the clock, or the end of the run.
    Other,
}

impl Awaited {
    const NOTHING: u32 = 0;
    const INPUT: u32 = 1;
    const CREDIT: u32 = 2;
    const OTHER: u32 = 3;
    const RANKS: u32 = 4;
}

/// What a process does at present. A process that waits in order looks for what it waits for every 50 ms, and notes each look: one
/// without a newer note works, or hangs.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ZeroCopySend)]
#[type_name("caraware::Activity")]
pub struct Activity {
    /// When it last finished a piece of work or looked for what it waits for, monotonic clock of the machine, nanoseconds; 0 before it
    /// has joined.
    pub noted_ns: u64,
    /// 0 nothing, 1 input, 2 credit, 3 something else, 4 the trainers of other ranks.
    pub(crate) awaited: u32,
    /// The process that it waits for, if it waits for input or credit.
    pub(crate) process: u32,
}

impl Activity {
    /// The activity of a process that waits for `awaited` now.
    #[must_use]
    pub fn now(awaited: Awaited) -> Self {
        let (kind, process) = match awaited {
            Awaited::Nothing => (Awaited::NOTHING, 0),
            Awaited::Input(process) => (Awaited::INPUT, process as u32),
            Awaited::Credit(process) => (Awaited::CREDIT, process as u32),
            Awaited::Other => (Awaited::OTHER, 0),
            Awaited::Ranks => (Awaited::RANKS, 0),
        };
        Self {
            noted_ns: clock::monotonic_ns(),
            awaited: kind,
            process,
        }
    }

    /// What the process waits for.
    #[must_use]
    pub fn awaited(&self) -> Awaited {
        let process = Process::ALL.get(self.process as usize).copied();
        match (self.awaited, process) {
            (Awaited::INPUT, Some(process)) => Awaited::Input(process),
            (Awaited::CREDIT, Some(process)) => Awaited::Credit(process),
            (Awaited::NOTHING, _) => Awaited::Nothing,
            (Awaited::RANKS, _) => Awaited::Ranks,
            _ => Awaited::Other,
        }
    }

    /// Seconds since the note, by the clock of this machine.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "a time for people")]
    pub fn age_s(&self) -> f64 {
        clock::monotonic_ns().saturating_sub(self.noted_ns) as f64 * 1e-9
    }

    /// The name of the state of a process whose board says `state`, or `stalled` if it hangs: it has been silent for `stall_s` seconds.
    #[must_use]
    pub fn state_name(&self, state: State, stall_s: f64) -> &'static str {
        match state {
            State::Ready | State::Running if self.age_s() > stall_s => "stalled",
            state => state.name(),
        }
    }
}

impl std::fmt::Display for Awaited {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Nothing => f.pad(""),
            Self::Input(process) => f.pad(process.name()),
            Self::Credit(process) => f.pad(&format!("{process} (credit)")),
            Self::Ranks => f.pad("other ranks"),
            Self::Other => f.pad("–"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_process_waits_for_survives_the_board() {
        let waits = Process::ALL
            .into_iter()
            .flat_map(|process| [Awaited::Input(process), Awaited::Credit(process)]);
        for awaited in waits.chain([Awaited::Nothing, Awaited::Other, Awaited::Ranks]) {
            assert_eq!(Activity::now(awaited).awaited(), awaited);
        }
    }

    #[test]
    fn a_silent_process_is_stalled_unless_it_starts_or_is_done() {
        let activity = Activity::now(Awaited::Nothing);
        assert_eq!(activity.state_name(State::Running, 100.0), "running");
        let silent = Activity {
            noted_ns: 0,
            ..activity
        };
        assert!(silent.age_s() > 0.0);
        let names =
            [State::Starting, State::Ready, State::Running, State::Done].map(|state| silent.state_name(state, 0.0));
        assert_eq!(names, ["starting", "stalled", "stalled", "done"]);
    }
}
