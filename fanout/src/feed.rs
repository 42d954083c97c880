//! What the fan-out holds of each channel: the last few messages, in place in shared memory, and what it missed.

use std::collections::VecDeque;

use ipc_schema::{
    header::{LAST_OF_RUN, MessageHeader},
    ports::{Message, PortError, Subscriber},
    run::RunFile,
    services::Channel,
    session::{Session, SessionError},
};

/// Where ticks are counted: what came, what is missing.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Tally {
    /// One more than the newest tick, 0 before the first.
    pub ticks: u64,
    /// Ticks that never came since the first one: the queue was full.
    pub missed: u64,
    /// True once the last tick of the run has come.
    pub ended: bool,
}

impl Tally {
    /// Counts a message. A tick sent again (by a restarted producer) is not missed twice.
    pub fn count(&mut self, header: &MessageHeader) {
        if self.ticks > 0 {
            self.missed += header.tick.saturating_sub(self.ticks);
        }
        self.ticks = self.ticks.max(header.tick.saturating_add(1));
        self.ended |= header.has(LAST_OF_RUN);
    }
}

/// A channel as a spectator sees it: what is of another run or another version is refused and counted, and nobody dies of it.
#[derive(Debug)]
pub struct Watch {
    subscriber: Subscriber,
    wrong_versions: u64,
}

impl Watch {
    /// Attends `channel`, as a consumer nobody waits for.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn open(session: &mut Session, channel: Channel) -> Result<Self, SessionError> {
        Ok(Self {
            subscriber: session.subscriber(channel)?,
            wrong_versions: 0,
        })
    }

    /// The next message, if one waits.
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
pub struct Feed {
    channel: Channel,
    watch: Watch,
    held: VecDeque<Message>,
    most: usize,
    tally: Tally,
    published: Option<u64>,
}

impl Feed {
    /// Attends `channel`, as a consumer nobody waits for.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn open(session: &mut Session, channel: Channel) -> Result<Self, SessionError> {
        Ok(Self {
            channel,
            watch: Watch::open(session, channel)?,
            held: VecDeque::new(),
            most: most_held(&session.run, channel),
            tally: Tally::default(),
            published: None,
        })
    }

    /// Takes everything that waits, keeps the newest, and returns how many messages came.
    ///
    /// # Errors
    /// The port is broken.
    pub fn drain(&mut self) -> Result<usize, PortError> {
        let mut came = 0;
        while let Some(message) = self.watch.receive()? {
            self.tally.count(message.header());
            self.held.push_back(message);
            if self.held.len() > self.most {
                self.held.pop_front();
            }
            came += 1;
            if came > self.most {
                break;
            }
        }
        Ok(came)
    }

    /// The channel.
    #[must_use]
    pub fn channel(&self) -> Channel {
        self.channel
    }

    /// What came and what is missing.
    #[must_use]
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Messages that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.watch.refused()
    }

    /// Ticks that are held and have not been published, newest first.
    pub fn fresh_ticks(&self) -> impl Iterator<Item = u64> {
        let published = self.published;
        self.held
            .iter()
            .rev()
            .map(|message| message.header().tick)
            .filter(move |tick| published.is_none_or(|p| *tick > p))
    }

    /// The message of `tick`, if it is held and has not been published.
    #[must_use]
    pub fn fresh(&self, tick: u64) -> Option<&Message> {
        if self.published.is_some_and(|p| tick <= p) {
            return None;
        }
        self.held.iter().find(|message| message.header().tick == tick)
    }

    /// `tick` is out: it and everything older goes back to shared memory.
    pub fn release(&mut self, tick: u64) {
        self.published = Some(tick);
        self.held.retain(|message| message.header().tick > tick);
    }
}

/// A subscriber may hold as many messages as its queue; one is needed to look at the next.
fn most_held(run: &RunFile, channel: Channel) -> usize {
    channel.queue_length(run).saturating_sub(1).max(1)
}

/// The newest tick that all of `feeds` hold, of those that hold anything.
///
/// Prediction, observation and world of one tick belong together; each arrives up to a window after the one before.
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
        let mut tally = Tally::default();
        for tick in [5, 6, 9, 10, 9, 10, 11] {
            tally.count(&header(tick, 0));
        }
        assert_eq!((tally.ticks, tally.missed, tally.ended), (12, 2, false));
        tally.count(&header(12, LAST_OF_RUN));
        assert!(tally.ended);
    }

    #[test]
    fn the_newest_tick_that_everybody_has_wins() {
        assert_eq!(newest_common(&[vec![9, 8, 7], vec![8, 7, 6], vec![7, 6]]), Some(7));
        assert_eq!(newest_common(&[vec![9, 8], vec![7]]), None);
        assert_eq!(newest_common(&[]), None);
    }

    proptest! {
        /// A pipeline whose stages lag by less than what is held always has a tick in common.
        #[test]
        fn a_lag_below_the_held_length_always_meets(held in 2_u64..20, lag in 0_u64..20, newest in 100_u64..200) {
            prop_assume!(lag < held);
            let feed = |newest: u64| (0..held).map(|i| newest - i).collect::<Vec<_>>();
            prop_assert_eq!(newest_common(&[feed(newest), feed(newest - lag)]), Some(newest - lag));
        }
    }
}
