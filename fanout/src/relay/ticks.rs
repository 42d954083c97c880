//! The topics of a tick: `world`, `observation`, `prediction` and `neighbours` of one tick are published together, at the newest tick that
//! all of them have. `neighbours` counts among them while a viewer subscribes to it.

use std::time::Duration;

use ipc_schema::{
    config::TaskKind,
    header::MessageHeader,
    membership::{MembershipError, RunMembership},
    ports::PortError,
    services::Channel,
};

use crate::{
    error::FanoutError,
    feed::{ChannelFeed, newest_common},
    frame,
    meter::{ObservationView, RoadUserCounts, TickFigures},
    network::{keys::Topic, publisher::EnvironmentPublisher},
    relay::pace::RateBudget,
    status::FanoutCounters,
};

/// How long messages of different ticks wait for one another before they are published as they are.
const COMMON_TICK_LIMIT: Duration = Duration::from_millis(500);

/// The channels with a message for each tick, in the order of the data.
const TICK_CHANNELS: [(Channel, Topic); 4] = [
    (Channel::World, Topic::World),
    (Channel::Observation, Topic::Observation),
    (Channel::Prediction, Topic::Prediction),
    (Channel::Neighbours, Topic::Neighbours),
];
/// The place of the observation among them, whose slots the later ones have.
const OBSERVATION: usize = 1;

/// A channel with a message for each tick, and its rate.
struct TickStream {
    topic: Topic,
    feed: ChannelFeed,
    budget: RateBudget,
    /// It is published: always, or while a viewer subscribes.
    is_watched: bool,
}

/// True if a topic is published while a viewer subscribes, and otherwise costs nothing.
fn is_on_demand(topic: Topic) -> bool {
    topic == Topic::Neighbours
}

/// The topics of a tick.
pub struct TickTopics {
    streams: Vec<TickStream>,
    /// Header of the newest message that was published or skipped.
    newest: MessageHeader,
    figures: TickFigures,
    /// A prediction is a position; in the driving task it is an action.
    predicts_positions: bool,
    /// Since when the held messages have no tick in common.
    apart_since: Option<Duration>,
}

impl TickTopics {
    /// Subscribes to the channels.
    ///
    /// # Errors
    /// A service cannot be opened.
    pub fn open(membership: &mut RunMembership) -> Result<Self, MembershipError> {
        let settings = &membership.run.config.fanout;
        let rates_hz = [
            settings.world_hz,
            settings.observation_hz,
            settings.prediction_hz,
            settings.neighbours_hz,
        ];
        let run = &membership.run;
        let used: Vec<(Channel, Topic, f64)> = TICK_CHANNELS
            .into_iter()
            .zip(rates_hz)
            .map(|((channel, topic), rate_hz)| (channel, topic, rate_hz))
            .filter(|(channel, ..)| (channel.spec().is_used)(run))
            .collect();
        let streams = used
            .into_iter()
            .map(|(channel, topic, rate_hz)| {
                Ok(TickStream {
                    topic,
                    feed: ChannelFeed::open(membership, channel)?,
                    budget: RateBudget::new(rate_hz),
                    is_watched: !is_on_demand(topic),
                })
            })
            .collect::<Result<_, MembershipError>>()?;
        Ok(Self {
            streams,
            newest: MessageHeader::default(),
            figures: TickFigures::default(),
            predicts_positions: membership.run.config.task.kind == TaskKind::Localisation,
            apart_since: None,
        })
    }

    /// Empties the queues; returns the length of the fullest one, messages.
    ///
    /// # Errors
    /// A port is broken.
    pub fn drain_queues(&mut self) -> Result<usize, PortError> {
        self.streams
            .iter_mut()
            .try_fold(0, |most, stream| Ok(stream.feed.drain()?.max(most)))
    }

    /// Publishes a tick if a topic is due and the channels have a tick in common, or have waited too long for one.
    ///
    /// # Errors
    /// zenoh broke.
    pub fn publish_due(
        &mut self,
        now: Duration,
        publisher: &mut EnvironmentPublisher,
        counters: &mut FanoutCounters,
    ) -> Result<(), FanoutError> {
        self.streams
            .iter_mut()
            .filter(|stream| is_on_demand(stream.topic))
            .for_each(|stream| stream.is_watched = publisher.is_watched(stream.topic, now));
        // Every budget is asked: asking is what refills it. A channel without a tick to publish makes nothing due: the others' newest
        // tick would be skipped, and in a paused run no other follows.
        let mut due = false;
        for stream in &mut self.streams {
            let allowed = stream.budget.allows(now);
            due |= allowed && stream.is_watched && stream.feed.fresh_ticks().next().is_some();
        }
        if !due {
            return Ok(());
        }
        let ticks = match self.common_tick() {
            Some(tick) => vec![Some(tick); self.streams.len()],
            None if self.apart_too_long(now) => self.newest_ticks(),
            None => return Ok(()),
        };
        self.apart_since = None;
        self.publish_set(now, &ticks, publisher, counters)
    }

    /// Publishes the newest tick, whatever the rate.
    ///
    /// # Errors
    /// zenoh broke.
    pub fn publish_rest(
        &mut self,
        now: Duration,
        publisher: &mut EnvironmentPublisher,
        counters: &mut FanoutCounters,
    ) -> Result<(), FanoutError> {
        let ticks = match self.common_tick() {
            Some(tick) => vec![Some(tick); self.streams.len()],
            None => self.newest_ticks(),
        };
        self.streams.iter_mut().for_each(|stream| stream.budget.refill());
        self.publish_set(now, &ticks, publisher, counters)
    }

    /// The newest tick that every channel in use holds.
    fn common_tick(&self) -> Option<u64> {
        let in_use = self.watched_feeds().filter(|feed| feed.tally().ticks > 0);
        let ticks: Vec<Vec<u64>> = in_use.map(|feed| feed.fresh_ticks().collect()).collect();
        newest_common(&ticks)
    }

    /// The newest tick of each channel.
    fn newest_ticks(&self) -> Vec<Option<u64>> {
        self.feeds().map(|feed| feed.fresh_ticks().next()).collect()
    }

    /// True if a message has waited longer than [`COMMON_TICK_LIMIT`] for those of the same tick.
    fn apart_too_long(&mut self, now: Duration) -> bool {
        if self.newest_ticks().iter().all(Option::is_none) {
            self.apart_since = None;
            return false;
        }
        now.saturating_sub(*self.apart_since.get_or_insert(now)) > COMMON_TICK_LIMIT
    }

    fn feeds(&self) -> impl Iterator<Item = &ChannelFeed> {
        self.streams.iter().map(|stream| &stream.feed)
    }

    fn watched_feeds(&self) -> impl Iterator<Item = &ChannelFeed> {
        let watched = self.streams.iter().filter(|stream| stream.is_watched);
        watched.map(|stream| &stream.feed)
    }

    /// Publishes the given tick of each channel that is due and holds it.
    fn publish_set(
        &mut self,
        now: Duration,
        ticks: &[Option<u64>],
        publisher: &mut EnvironmentPublisher,
        counters: &mut FanoutCounters,
    ) -> Result<(), FanoutError> {
        self.measure(ticks);
        let chosen = self.chosen_slots(ticks);
        let observed = ticks.get(OBSERVATION).copied().flatten();
        // Encode what is due, and give the messages back to shared memory.
        let mut longest = 0;
        let mut encoded = Vec::new();
        for (stream, tick) in self.streams.iter_mut().zip(ticks) {
            let Some(tick) = *tick else { continue };
            let Some(message) = stream.feed.fresh(tick) else {
                continue;
            };
            let header = *message.header();
            let is_due = stream.is_watched && (stream.budget.allows(now) || stream.budget.joins());
            let chosen = chosen.as_deref().filter(|_| observed == Some(tick));
            let framed = is_due.then(|| match stream.topic {
                Topic::Prediction => frame::encode_prediction(&header, message.payload(), chosen),
                Topic::Neighbours => frame::encode_neighbours(&header, message.payload(), chosen),
                _ => frame::encode(stream.feed.channel(), &header, message.payload()),
            });
            stream.feed.release(tick);
            if header.tick >= self.newest.tick {
                self.newest = header;
            }
            match framed {
                Some(Ok(frame)) => {
                    longest = longest.max(frame.bytes.len());
                    encoded.push((stream.topic, frame));
                }
                Some(Err(error)) => counters.refuse(stream.topic.name(), &error),
                None => {}
            }
        }
        // Charge the budgets for the longest frame of the set.
        let mut slowed = false;
        for stream in &mut self.streams {
            if encoded.iter().any(|(topic, _)| *topic == stream.topic) {
                slowed |= stream.budget.spend(longest);
            }
        }
        counters.slowed_sets += u64::from(slowed);
        // Publish.
        for (topic, frame) in encoded {
            counters.frames += 1;
            *counters.left_out(topic) += frame.left_out as u64;
            publisher.publish(topic, frame.bytes)?;
        }
        Ok(())
    }

    /// The slots of the observation that its frame keeps, if it does not keep all: later topics of the same tick have the same ones.
    fn chosen_slots(&self, ticks: &[Option<u64>]) -> Option<Vec<usize>> {
        let observed = ticks.get(OBSERVATION).copied().flatten()?;
        let message = self.streams.get(OBSERVATION)?.feed.fresh(observed)?;
        frame::chosen_slots(message.header(), message.payload()).ok().flatten()
    }

    /// Takes the figures of the status from the ticks that are about to be published.
    fn measure(&mut self, ticks: &[Option<u64>]) {
        let message = |index: usize| {
            let message = self.streams.get(index)?.feed.fresh((*ticks.get(index)?)?)?;
            Some((message.header(), message.payload()))
        };
        if let Some(counts) = message(0).and_then(|(header, payload)| RoadUserCounts::of(header, payload)) {
            self.figures.road_users = counts;
        }
        if let Some(observation) = message(1).and_then(|(header, payload)| ObservationView::of(header, payload)) {
            let prediction = message(2).filter(|_| self.predicts_positions);
            self.figures.sensors = observation.delivering();
            self.figures.errors_m = observation.position_errors(prediction);
        }
    }

    /// One more than the newest tick that arrived on any channel, 0 before the first.
    #[must_use]
    pub fn ticks(&self) -> u64 {
        self.feeds().map(|feed| feed.tally().ticks).max().unwrap_or(0)
    }

    /// Ticks missed on all channels.
    #[must_use]
    pub fn missed(&self) -> u64 {
        self.feeds().map(|feed| feed.tally().missed).sum()
    }

    /// Messages refused on all channels.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.feeds().map(ChannelFeed::refused).sum()
    }

    /// Header of the newest message that was published or skipped.
    #[must_use]
    pub fn newest(&self) -> &MessageHeader {
        &self.newest
    }

    /// Figures of the newest set.
    #[must_use]
    pub fn figures(&self) -> &TickFigures {
        &self.figures
    }

    /// True once the last tick of the run has arrived on `channel`.
    #[must_use]
    pub fn has_ended(&self, channel: Channel) -> bool {
        self.feeds().any(|feed| feed.channel() == channel && feed.tally().ended)
    }

    /// True if every channel in use has the newest tick and holds nothing unpublished.
    #[must_use]
    pub fn all_published(&self) -> bool {
        let mut in_use = self.watched_feeds().filter(|feed| feed.tally().ticks > 0);
        let newest = self.feeds().map(|feed| feed.tally().ticks).max();
        in_use.all(|feed| Some(feed.tally().ticks) == newest && feed.fresh_ticks().next().is_none())
    }
}
