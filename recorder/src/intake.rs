//! The messages of one channel on their way into a recording: each once, with what is missing counted.

use ipc_schema::{
    board::MessageStream,
    channel::Channel,
    header::MessageHeader,
    ports::{PortError, Subscriber},
    run::RunFile,
};

use crate::file::{RecordingError, writer::RecordingWriter};

/// A message cannot be received or recorded.
#[derive(Debug, thiserror::Error)]
pub enum IntakeError {
    /// The port failed.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The file failed.
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

/// The order of a channel's messages. A restarted producer makes messages again that have been recorded: they are recognised.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MessageOrder {
    /// One more than the newest tick that was taken in.
    next_tick: Option<u64>,
    /// Incarnation of the sender of the newest message.
    incarnation: u32,
    /// Incarnation that the newest message was addressed to.
    addressee: u32,
    /// Number of the newest `traffic-meta` message.
    meta_messages: u64,
    /// Ticks below this are made again by a restarted producer, or are sent again to another consumer.
    repeated_below: u64,
    missed: u64,
}

impl MessageOrder {
    /// True if the message is new. `ticks_per_message` is 0 for a channel that does not have a message for each tick.
    pub fn is_new(&mut self, header: &MessageHeader, ticks_per_message: u64) -> bool {
        if (header.incarnation, header.addressee) != (self.incarnation, self.addressee) {
            (self.incarnation, self.addressee) = (header.incarnation, header.addressee);
            self.repeated_below = self.next_tick.unwrap_or(0);
        }
        let next_tick = self.next_tick.unwrap_or(header.tick);
        // Channels without a message for each tick may have several for one.
        let is_repeated = match ticks_per_message {
            0 => header.tick < self.repeated_below,
            _ => header.tick < next_tick,
        };
        if is_repeated {
            return false;
        }
        if ticks_per_message > 0 && self.next_tick.is_some() {
            let due = next_tick + ticks_per_message - 1;
            self.missed += header.tick.saturating_sub(due);
        }
        self.next_tick = Some(next_tick.max(header.tick + 1));
        true
    }

    /// As [`MessageOrder::is_new`] for `traffic-meta`, whose messages each incarnation of the producer numbers from 1.
    pub fn is_new_meta(&mut self, header: &MessageHeader) -> bool {
        let is_same_sender = self.next_tick.is_some() && header.incarnation == self.incarnation;
        let is_new = self.is_new(header, 0);
        if is_same_sender {
            self.missed += header.meta_messages.saturating_sub(self.meta_messages + 1);
        }
        self.meta_messages = header.meta_messages;
        is_new
    }

    /// Ticks, or messages of `traffic-meta`, that are missing.
    #[must_use]
    pub fn missed(&self) -> u64 {
        self.missed
    }
}

/// A channel that is recorded, or that paces one that is.
#[derive(Debug)]
pub struct ChannelIntake {
    channel: Channel,
    subscriber: Subscriber,
    order: MessageOrder,
    ticks_per_message: u64,
    queue_length: usize,
    /// One more than the newest tick received.
    received_ticks: u64,
    /// The newest stream of which a message came, and one more than its newest tick, repeated or not.
    stream: (MessageStream, u64),
    newest: MessageHeader,
}

impl ChannelIntake {
    /// Takes messages of `channel` in from `subscriber`.
    #[must_use]
    pub fn new(channel: Channel, subscriber: Subscriber, run: &RunFile) -> Self {
        Self {
            channel,
            subscriber,
            order: MessageOrder::default(),
            ticks_per_message: ticks_per_message(channel, run),
            queue_length: channel.queue_length(run),
            received_ticks: 0,
            stream: (MessageStream::NONE, 0),
            newest: MessageHeader::default(),
        }
    }

    /// The channel.
    #[must_use]
    pub fn channel(&self) -> Channel {
        self.channel
    }

    /// Length of its queue, messages.
    #[must_use]
    pub fn queue_length(&self) -> usize {
        self.queue_length
    }

    /// Adds what is queued to the recording, at most a queue of it; returns the number of messages.
    ///
    /// # Errors
    /// The port or the recording failed.
    pub fn drain(&mut self, writer: &mut Option<RecordingWriter>) -> Result<usize, IntakeError> {
        let mut received = 0;
        while received < self.queue_length
            && let Some(message) = self.subscriber.receive()?
        {
            received += 1;
            let header = message.header();
            self.follow(header);
            let is_new = match self.channel {
                Channel::TrafficMeta => self.order.is_new_meta(header),
                _ => self.order.is_new(header, self.ticks_per_message),
            };
            if !is_new {
                continue;
            }
            self.received_ticks = self.received_ticks.max(header.tick + 1);
            self.newest = *header;
            if let Some(writer) = writer {
                writer.add(self.channel, header, message.payload())?;
            }
        }
        Ok(received)
    }

    /// What the sender has credit for: repeated messages fill the queue too.
    fn follow(&mut self, header: &MessageHeader) {
        let stream = MessageStream {
            sender: header.incarnation,
            addressee: header.addressee,
        };
        let (before, ticks) = self.stream;
        if before == MessageStream::NONE || stream > before {
            self.stream = (stream, header.tick + 1);
        } else if stream == before {
            self.stream.1 = ticks.max(header.tick + 1);
        }
    }

    /// The newest stream, and one more than the newest tick received of it.
    #[must_use]
    pub fn stream(&self) -> (MessageStream, u64) {
        self.stream
    }

    /// One more than the newest tick received; 0 before the first.
    #[must_use]
    pub fn received_ticks(&self) -> u64 {
        self.received_ticks
    }

    /// Header of the newest message.
    #[must_use]
    pub fn newest(&self) -> &MessageHeader {
        &self.newest
    }

    /// Ticks that are missing.
    #[must_use]
    pub fn missed(&self) -> u64 {
        self.order.missed()
    }
}

/// Ticks from one message of `channel` to the next; 0 if they come at other times.
fn ticks_per_message(channel: Channel, run: &RunFile) -> u64 {
    match channel {
        Channel::Traffic | Channel::LanePosition => run.ticks_per_frame(),
        Channel::World | Channel::Observation | Channel::Measurement | Channel::Neighbours | Channel::Prediction => 1,
        Channel::EgoPose => u64::from(run.config.drives()),
        Channel::TrafficMeta
        | Channel::Census
        | Channel::Event
        | Channel::Pointcloud
        | Channel::Image
        | Channel::Radar
        | Channel::Switch => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(tick: u64, incarnation: u32) -> MessageHeader {
        MessageHeader {
            tick,
            incarnation,
            ..MessageHeader::default()
        }
    }

    #[test]
    fn a_tick_is_taken_once_and_a_gap_is_counted() {
        let mut order = MessageOrder::default();
        let new = [5, 6, 9, 10].map(|tick| order.is_new(&header(tick, 0), 1));
        assert_eq!((new, order.missed()), ([true; 4], 2), "joining late is no gap");
        // A restarted producer begins earlier.
        let again = [7, 8, 9, 10, 11].map(|tick| order.is_new(&header(tick, 1), 1));
        assert_eq!(again, [false, false, false, false, true]);
        assert_eq!(order.missed(), 2);
    }

    #[test]
    fn a_frame_of_several_ticks_has_the_number_of_its_last() {
        let mut order = MessageOrder::default();
        let new = [9, 19, 39].map(|tick| order.is_new(&header(tick, 0), 10));
        assert_eq!((new, order.missed()), ([true; 3], 10));
    }

    #[test]
    fn several_messages_of_a_tick_are_taken_unless_they_are_made_again() {
        let mut order = MessageOrder::default();
        assert!([3, 3, 7].iter().all(|tick| order.is_new(&header(*tick, 0), 0)));
        assert_eq!(
            [3, 7, 8, 8].map(|tick| order.is_new(&header(tick, 1), 0)),
            [false, false, true, true]
        );
    }

    #[test]
    fn announcements_are_numbered() {
        let mut order = MessageOrder::default();
        let mut take = |number, incarnation| {
            order.is_new_meta(&MessageHeader {
                meta_messages: number,
                ..header(number, incarnation)
            })
        };
        assert!(take(1, 0) && take(2, 0) && take(5, 0));
        assert_eq!(
            [1, 4, 5].map(|number| take(number, 1)),
            [false; 3],
            "a restarted producer"
        );
        assert!(take(6, 1));
        assert_eq!(order.missed(), 4, "two before the restart, two after");
    }
}
