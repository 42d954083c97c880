//! The channels as the fan-out reads them: it holds the newest messages, in place in shared memory, and counts the ticks that it missed.

use std::collections::VecDeque;

use ipc_schema::{
    header::{LAST_OF_RUN, MessageHeader},
    membership::{MembershipError, RunMembership},
    ports::{Message, PortError, Subscriber},
    run::RunFile,
    services::Channel,
};

/// Counts the ticks of a channel: those that arrived and those that were missed.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TickTally {
    /// One more than the newest tick, 0 before the first.
    pub ticks: u64,
    /// Ticks since the first one that never arrived, because the queue was full.
    pub missed: u64,
    /// True once the last tick of the run has arrived.
    pub ended: bool,
}

impl TickTally {
    /// Counts a message. A tick that a restarted producer sends again is not counted as missed twice.
    pub fn count(&mut self, header: &MessageHeader) {
        if self.ticks > 0 {
            self.missed += header.tick.saturating_sub(self.ticks);
        }
        self.ticks = self.ticks.max(header.tick.saturating_add(1));
        self.ended |= header.has(LAST_OF_RUN);
    }
}

/// A channel as a watcher reads it: a message of another run or another version is dropped and counted, and is not fatal.
#[derive(Debug)]
pub struct ChannelWatcher {
    subscriber: Subscriber,
    wrong_versions: u64,
}

impl ChannelWatcher {
    /// Subscribes to `channel` as a watcher: its producer does not wait for it.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn open(membership: &mut RunMembership, channel: Channel) -> Result<Self, MembershipError> {
        Ok(Self {
            subscriber: membership.subscriber(channel)?,
            wrong_versions: 0,
        })
    }

    /// The next message in the queue, if there is one.
    ///
    /// # Errors
    /// The port is broken.
    pub fn receive(&mut self) -> Result<Option<Message>, PortError> {
        loop {
            match self.subscriber.receive() {
                Err(PortError::Version { .. }) => self.wrong_versions += 1,
                received => return received,
            }
        }
    }

    /// Messages that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.subscriber.refused() + self.wrong_versions
    }
}

/// One channel with a message for each tick.
#[derive(Debug)]
pub struct ChannelFeed {
    channel: Channel,
    watcher: ChannelWatcher,
    held: VecDeque<Message>,
    /// Most messages held.
    max_held: usize,
    tally: TickTally,
    /// The newest tick that was published or skipped.
    published: Option<u64>,
}

impl ChannelFeed {
    /// Subscribes to `channel` as a watcher: its producer does not wait for it.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn open(membership: &mut RunMembership, channel: Channel) -> Result<Self, MembershipError> {
        Ok(Self {
            channel,
            watcher: ChannelWatcher::open(membership, channel)?,
            held: VecDeque::new(),
            max_held: max_held(&membership.run, channel),
            tally: TickTally::default(),
            published: None,
        })
    }

    /// Empties the queue and holds its newest messages; returns how many messages were queued.
    ///
    /// # Errors
    /// The port is broken.
    pub fn drain(&mut self) -> Result<usize, PortError> {
        let mut received = 0;
        while let Some(message) = self.watcher.receive()? {
            self.tally.count(message.header());
            self.held.push_back(message);
            if self.held.len() > self.max_held {
                self.held.pop_front();
            }
            received += 1;
            if received > self.max_held {
                break;
            }
        }
        Ok(received)
    }

    /// The channel.
    #[must_use]
    pub fn channel(&self) -> Channel {
        self.channel
    }

    /// Ticks that arrived and ticks that were missed.
    #[must_use]
    pub fn tally(&self) -> &TickTally {
        &self.tally
    }

    /// Messages that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.watcher.refused()
    }

    /// Ticks that are held and not published yet, newest first.
    pub fn fresh_ticks(&self) -> impl Iterator<Item = u64> {
        let published = self.published;
        self.held
            .iter()
            .rev()
            .map(|message| message.header().tick)
            .filter(move |tick| published.is_none_or(|p| *tick > p))
    }

    /// The message of `tick`, if it is held and not published yet.
    #[must_use]
    pub fn fresh(&self, tick: u64) -> Option<&Message> {
        if self.published.is_some_and(|p| tick <= p) {
            return None;
        }
        self.held.iter().find(|message| message.header().tick == tick)
    }

    /// Marks `tick` as published, and returns it and everything older to shared memory.
    pub fn release(&mut self, tick: u64) {
        self.published = Some(tick);
        self.held.retain(|message| message.header().tick > tick);
    }
}

/// A subscriber may hold as many messages as its queue; one of them is needed to read the next.
fn max_held(run: &RunFile, channel: Channel) -> usize {
    channel.queue_length(run).saturating_sub(1).max(1)
}

/// The newest tick that all of `feeds` hold, each given as the ticks that it holds, newest first.
///
/// World, observation and prediction of one tick belong together; each arrives up to a window after the one before it.
#[must_use]
pub fn newest_common(feeds: &[Vec<u64>]) -> Option<u64> {
    let (first, rest) = feeds.split_first()?;
    first
        .iter()
        .copied()
        .filter(|tick| rest.iter().all(|feed| feed.contains(tick)))
        .max()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn header(tick: u64, flags: u32) -> MessageHeader {
        MessageHeader {
            tick,
            flags,
            ..MessageHeader::default()
        }
    }

    #[test]
    fn gaps_are_counted_once_and_joining_late_is_none() {
        let mut tally = TickTally::default();
        for tick in [5, 6, 9, 10, 9, 10, 11] {
            tally.count(&header(tick, 0));
        }
        assert_eq!((tally.ticks, tally.missed, tally.ended), (12, 2, false));
        tally.count(&header(12, LAST_OF_RUN));
        assert!(tally.ended);
    }

    #[test]
    fn the_newest_tick_that_all_feeds_hold_wins() {
        assert_eq!(newest_common(&[vec![9, 8, 7], vec![8, 7, 6], vec![7, 6]]), Some(7));
        assert_eq!(newest_common(&[vec![9, 8], vec![7]]), None);
        assert_eq!(newest_common(&[]), None);
    }

    proptest! {
        /// Two feeds always have a tick in common if one lags by fewer ticks than are held.
        #[test]
        fn a_lag_below_the_held_length_always_meets(held in 2_u64..20, lag in 0_u64..20, newest in 100_u64..200) {
            prop_assume!(lag < held);
            let feed = |newest: u64| (0..held).map(|i| newest - i).collect::<Vec<_>>();
            prop_assert_eq!(newest_common(&[feed(newest), feed(newest - lag)]), Some(newest - lag));
        }
    }
}
