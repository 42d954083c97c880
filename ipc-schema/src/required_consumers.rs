//! The required consumers of a channel: a producer waits for their credit, and wakes them.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use crate::{
    board::{MessageStream, Progress},
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
    pub(crate) stream: SentStream,
}

/// What a producer has sent in its present stream. `recorder` lives on where a producer is made again or a trainer is replaced, and then
/// receives ticks again that it has: their number is no credit for them, or they would overflow its queue.
#[derive(Debug)]
pub(crate) struct SentStream {
    sender: u32,
    addressee: AtomicU32,
    /// The first tick of the stream that was sent; [`NO_TICK`] before.
    first: AtomicU64,
    /// One more than the newest tick of the stream that was sent; 0 before the first.
    ticks: AtomicU64,
    /// The newest earlier stream of this process in which something was sent: the incarnation that it was addressed to, and one more than its newest tick;
    /// 0 if there is none. All of it has to be consumed before this stream begins. An older one may have had later ticks.
    earlier: (AtomicU32, AtomicU64),
    /// Incarnation of `recorder` that all of this is about.
    recorder: AtomicU32,
}

const NO_TICK: u64 = u64::MAX;

impl SentStream {
    /// The first stream of a sender.
    pub(crate) fn of(sender: u32) -> Self {
        Self {
            sender,
            addressee: AtomicU32::new(0),
            first: AtomicU64::new(NO_TICK),
            ticks: AtomicU64::new(0),
            earlier: (AtomicU32::new(0), AtomicU64::new(0)),
            recorder: AtomicU32::new(0),
        }
    }

    fn turn_to(&self, addressee: u32) {
        let before = self.addressee.swap(addressee, Relaxed);
        if before == addressee {
            return;
        }
        let ticks = self.ticks.swap(0, Relaxed);
        if ticks > 0 {
            self.earlier.0.store(before, Relaxed);
            self.earlier.1.store(ticks, Relaxed);
        }
        self.first.store(NO_TICK, Relaxed);
    }

    fn add(&self, tick: u64) {
        if self.first.load(Relaxed) == NO_TICK {
            self.first.store(tick, Relaxed);
        }
        self.ticks.fetch_max(tick + 1, Relaxed);
    }

    /// True if `recorder`, with this progress, has credit for `tick` of `channel`.
    fn has_credit_of_recorder(&self, channel: Channel, tick: u64, progress: &Progress, window: u64) -> bool {
        if self.recorder.swap(progress.incarnation, Relaxed) != progress.incarnation {
            // What was sent to the one before it is not in the queue of this one.
            self.first.store(NO_TICK, Relaxed);
            self.ticks.store(0, Relaxed);
            self.earlier.1.store(0, Relaxed);
        }
        let recorded_ticks = progress.consumed_of(Process::Recorder, channel);
        let to = |addressee: &AtomicU32| MessageStream {
            sender: self.sender,
            addressee: addressee.load(Relaxed),
        };
        let recorded = progress.recorded_stream(channel);
        if recorded == to(&self.addressee) {
            return flow::has_credit_at(tick, progress, recorded_ticks, window);
        }
        // None of this stream has been consumed yet.
        let first = match self.first.load(Relaxed) {
            NO_TICK => tick,
            first => first,
        };
        let earlier_ticks = self.earlier.1.load(Relaxed);
        let is_earlier_consumed = recorded == to(&self.earlier.0) && recorded_ticks >= earlier_ticks;
        (earlier_ticks == 0 || is_earlier_consumed) && flow::has_credit_at(tick, progress, first, window)
    }
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
    #[must_use]
    pub fn lacks_credit(&self, tick: u64) -> Option<Process> {
        self.first(|process, board| {
            let progress = board.progress();
            match process {
                Process::Recorder => !self
                    .stream
                    .has_credit_of_recorder(self.channel, tick, &progress, self.window),
                _ => !flow::has_credit(tick, &progress, self.window),
            }
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

    /// Counts `tick`, which has been sent, and wakes every consumer.
    pub fn sent(&self, tick: u64) {
        self.stream.add(tick);
        self.wake();
    }

    /// What follows is addressed to this incarnation of its receiver, and may begin with ticks that were sent before.
    pub fn turn_to(&self, addressee: u32) {
        self.stream.turn_to(addressee);
    }

    /// Wakes every consumer.
    pub fn wake(&self) {
        self.wakers.iter().for_each(Waker::wake);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WORLD: Channel = Channel::World;
    const WINDOW: u64 = 8;

    fn progress(stream: MessageStream, ticks: u64, incarnation: u32) -> Progress {
        let mut progress = Progress {
            attached: 1,
            incarnation,
            ..Progress::default()
        };
        progress.recorded_ticks[WORLD as usize] = ticks;
        progress.recorded_senders[WORLD as usize] = stream.sender;
        progress.recorded_addressees[WORLD as usize] = stream.addressee;
        progress
    }

    /// Sends from `first` on for as long as there is credit; returns the tick that there is none for.
    fn send_all(stream: &SentStream, first: u64, progress: &Progress) -> u64 {
        let has_credit = |tick: &u64| stream.has_credit_of_recorder(WORLD, *tick, progress, WINDOW);
        (first..first + 1000)
            .take_while(has_credit)
            .inspect(|tick| stream.add(*tick))
            .last()
            .map_or(first, |tick| tick + 1)
    }

    #[test]
    fn a_sender_that_begins_again_has_a_window_until_recorder_has_turned_to_it() {
        let [before, now] = [0, 1].map(|sender| MessageStream { sender, addressee: 0 });
        let stream = SentStream::of(1);
        // The recorder has 200 ticks of the incarnation before; this one begins at 150.
        assert_eq!(send_all(&stream, 150, &progress(before, 200, 0)), 158);
        assert_eq!(send_all(&stream, 158, &progress(now, 151, 0)), 159);
        assert_eq!(send_all(&stream, 159, &progress(now, 159, 0)), 167);
        // A recorder that is made again has received nothing yet.
        assert_eq!(send_all(&stream, 167, &progress(MessageStream::NONE, 167, 1)), 175);
        assert_eq!(send_all(&stream, 175, &progress(MessageStream::NONE, 167, 1)), 175);
    }

    #[test]
    fn what_is_sent_again_to_a_successor_waits_until_recorder_has_consumed_the_rest() {
        let [before, now] = [0, 1].map(|addressee| MessageStream { sender: 0, addressee });
        let stream = SentStream::of(0);
        assert_eq!(send_all(&stream, 0, &progress(before, 92, 0)), 100);
        stream.turn_to(0);
        assert_eq!(send_all(&stream, 100, &progress(before, 93, 0)), 101, "the same stream");
        stream.turn_to(1);
        assert_eq!(
            send_all(&stream, 64, &progress(before, 100, 0)),
            64,
            "tick 100 is in the queue"
        );
        assert_eq!(send_all(&stream, 64, &progress(before, 101, 0)), 72);
        assert_eq!(send_all(&stream, 72, &progress(now, 72, 0)), 80);
    }

    /// Each successor is sent the ticks since the checkpoint again, and may die after a few of them.
    #[test]
    fn successors_that_die_early_leave_no_claim_behind() {
        let to = |addressee| MessageStream { sender: 0, addressee };
        let stream = SentStream::of(0);
        assert_eq!(send_all(&stream, 0, &progress(to(0), 92, 0)), 100);
        stream.turn_to(1);
        assert_eq!(send_all(&stream, 64, &progress(to(0), 100, 0)), 72);
        stream.turn_to(2);
        assert_eq!(
            send_all(&stream, 64, &progress(to(0), 100, 0)),
            64,
            "the queue has 64 to 71"
        );
        assert_eq!(send_all(&stream, 64, &progress(to(1), 71, 0)), 64, "the queue has 71");
        // Nothing is sent to the next one.
        stream.turn_to(3);
        stream.turn_to(4);
        assert_eq!(send_all(&stream, 64, &progress(to(1), 72, 0)), 72);
        assert_eq!(send_all(&stream, 72, &progress(to(4), 65, 0)), 73);
    }
}
