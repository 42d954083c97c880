//! The required consumers of a channel: a producer waits for their credit, and wakes them.

use crate::{
    channel::Channel,
    flow,
    ports::{BoardReader, Waker},
    process::Process,
};

/// The required consumers of a channel: the credit that they return, and their wake-ups.
pub struct RequiredConsumers {
    pub(crate) boards: Vec<(Process, BoardReader)>,
    pub(crate) wakers: Vec<Waker>,
    /// The channel that they consume.
    pub(crate) channel: Channel,
    /// Ticks that the producer may be ahead of each of them.
    pub(crate) window: u64,
}

impl std::fmt::Debug for RequiredConsumers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut debug = f.debug_struct("RequiredConsumers");
        debug.field("number", &self.boards.len()).field("window", &self.window);
        debug.finish_non_exhaustive()
    }
}

impl RequiredConsumers {
    /// True if every consumer has credit for `tick`.
    #[must_use]
    pub fn have_credit(&self, tick: u64) -> bool {
        self.lacks_credit(tick).is_none()
    }

    /// The first consumer that has no credit for `tick`.
    pub(crate) fn lacks_credit(&self, tick: u64) -> Option<Process> {
        self.first(|process, board| {
            let progress = board.progress();
            let consumed = progress.consumed_of(process, self.channel);
            !flow::has_credit_at(tick, &progress, consumed, self.window)
        })
    }

    fn first(&self, is_wanted: impl Fn(Process, &BoardReader) -> bool) -> Option<Process> {
        let found = self.boards.iter().find(|(process, board)| is_wanted(*process, board));
        found.map(|(process, _)| *process)
    }

    /// True if every consumer has consumed all ticks below `ticks`.
    #[must_use]
    pub fn have_consumed(&self, ticks: u64) -> bool {
        self.lacks(ticks).is_none()
    }

    /// The first consumer that has not consumed all ticks below `ticks`.
    pub(crate) fn lacks(&self, ticks: u64) -> Option<Process> {
        self.first(|process, board| board.progress().consumed_of(process, self.channel) < ticks)
    }

    /// Wakes every consumer after a message has been sent.
    pub fn wake(&self) {
        self.wakers.iter().for_each(Waker::wake);
    }
}
