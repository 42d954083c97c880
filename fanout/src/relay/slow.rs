//! The topics that change slowly: `vehicles` (the table of road users), `signals` (traffic lights), `routes` (of heroes) and `event`
//! (contacts).

use std::{collections::VecDeque, time::Duration};

use ipc_schema::{
    block::BlockError,
    membership::{MembershipError, RunMembership},
    ports::PortError,
    services::Channel,
    traffic::{RoutePoint, SignalMeta, VehicleMeta},
};

use crate::{
    directory::RoadUserDirectory,
    error::FanoutError,
    feed::ChannelWatcher,
    frame::{self, FrameError},
    network::{keys::Topic, publisher::EnvironmentPublisher},
    relay::pace::RateBudget,
    status::FanoutCounters,
};

/// Most messages of contacts that wait to be published; the oldest are dropped.
const MAX_WAITING_CONTACTS: usize = 64;

/// The topics `vehicles`, `signals`, `routes` and `event`.
pub struct SlowTopics {
    directory: RoadUserDirectory,
    census: ChannelWatcher,
    changes: ChannelWatcher,
    contacts: ChannelWatcher,
    /// Messages taken from a queue at a time.
    max_drained: usize,
    vehicles: TableStream,
    signals: TableStream,
    routes: TableStream,
    event_budget: RateBudget,
    /// Traffic lights that are not published yet.
    signal_rows: Option<Vec<u8>>,
    /// Points of routes that are not published yet.
    route_rows: Option<Vec<u8>>,
    /// Encoded contacts that are not published yet.
    contact_frames: VecDeque<Vec<u8>>,
}

/// A table that is published in parts, and its rate.
struct TableStream {
    budget: RateBudget,
    /// First row of the next part.
    next_row: usize,
}

impl TableStream {
    fn new(rate_hz: f64) -> Self {
        Self {
            budget: RateBudget::new(rate_hz),
            next_row: 0,
        }
    }
}

impl SlowTopics {
    /// Subscribes to the channels.
    ///
    /// # Errors
    /// A service cannot be opened.
    pub fn open(membership: &mut RunMembership) -> Result<Self, MembershipError> {
        let settings = membership.run.config.fanout.clone();
        Ok(Self {
            directory: RoadUserDirectory::default(),
            max_drained: Channel::TrafficMeta.queue_length(&membership.run),
            census: ChannelWatcher::open(membership, Channel::Census)?,
            changes: ChannelWatcher::open(membership, Channel::TrafficMeta)?,
            contacts: ChannelWatcher::open(membership, Channel::Event)?,
            vehicles: TableStream::new(settings.vehicles_hz),
            signals: TableStream::new(settings.signals_hz),
            routes: TableStream::new(settings.vehicles_hz),
            event_budget: RateBudget::new(settings.event_hz),
            signal_rows: None,
            route_rows: None,
            contact_frames: VecDeque::new(),
        })
    }

    /// The road users and traffic lights known so far.
    #[must_use]
    pub fn directory(&self) -> &RoadUserDirectory {
        &self.directory
    }

    /// Messages that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.census.refused() + self.changes.refused() + self.contacts.refused()
    }

    /// Empties the queues; returns how many changes were queued.
    ///
    /// # Errors
    /// A port is broken.
    pub fn drain_queues(&mut self, counters: &mut FanoutCounters) -> Result<usize, PortError> {
        // The census: all road users and traffic lights.
        while let Some(message) = self.census.receive()? {
            let applied = self.directory.apply_census(message.header(), message.payload());
            count_refused(counters, applied);
        }
        // The changes since.
        let mut changes = 0;
        while let Some(message) = self.changes.receive()? {
            let applied = self.directory.apply_changes(message.header(), message.payload());
            count_refused(counters, applied);
            changes += 1;
            if changes > self.max_drained {
                break;
            }
        }
        // Contacts, of which the newest are kept.
        let mut contacts = 0;
        while let Some(message) = self.contacts.receive()? {
            match frame::encode(Channel::Event, message.header(), message.payload()) {
                Ok(frame) => self.contact_frames.push_back(frame.bytes),
                Err(error) => counters.refuse(Topic::Event.name(), &error),
            }
            contacts += 1;
            if contacts > self.max_drained {
                break;
            }
        }
        let too_many = self.contact_frames.len().saturating_sub(MAX_WAITING_CONTACTS);
        self.contact_frames.drain(..too_many);
        Ok(changes)
    }

    /// Publishes what is due.
    ///
    /// # Errors
    /// zenoh broke.
    pub fn publish_due(
        &mut self,
        now: Duration,
        publisher: &mut EnvironmentPublisher,
        counters: &mut FanoutCounters,
    ) -> Result<(), FanoutError> {
        let header = *self.directory.header();
        // Road users, once the directory has heard of any.
        if header.schema_version != 0 && self.vehicles.budget.allows(now) {
            self.vehicles.budget.spend(0);
            let rows = self.directory.vehicle_rows();
            let (part, whole) = frame::table(&header, &rows, size_of::<VehicleMeta>(), &mut self.vehicles.next_row);
            counters.frames += 1;
            publisher.publish_part(Topic::Vehicles, part.into(), Some(whole.into()))?;
        }
        // Traffic lights, after a change.
        self.signal_rows = self.directory.take_signal_rows().or(self.signal_rows.take());
        if self.signals.budget.allows(now)
            && let Some(rows) = self.signal_rows.take()
        {
            self.signals.budget.spend(0);
            let (part, whole) = frame::table(&header, &rows, size_of::<SignalMeta>(), &mut self.signals.next_row);
            counters.frames += 1;
            // A net with more lights than a frame holds is published part by part.
            if part.len() < whole.len() {
                self.signal_rows = Some(rows);
            }
            publisher.publish_part(Topic::Signals, part.into(), Some(whole.into()))?;
        }
        // Routes, after a change.
        self.route_rows = self.directory.take_route_rows().or(self.route_rows.take());
        if self.routes.budget.allows(now)
            && let Some(rows) = self.route_rows.take()
        {
            self.routes.budget.spend(0);
            let (part, whole) = frame::table(&header, &rows, size_of::<RoutePoint>(), &mut self.routes.next_row);
            counters.frames += 1;
            if part.len() < whole.len() {
                self.route_rows = Some(rows);
            }
            publisher.publish_part(Topic::Routes, part.into(), Some(whole.into()))?;
        }
        // Contacts, one message at a time.
        if self.event_budget.allows(now)
            && let Some(frame) = self.contact_frames.pop_front()
        {
            self.event_budget.spend(0);
            counters.frames += 1;
            publisher.publish(Topic::Event, frame)?;
        }
        Ok(())
    }
}

/// Counts a census or a change whose payload is shorter than its header promises.
fn count_refused(counters: &mut FanoutCounters, applied: Result<(), BlockError>) {
    if let Err(error) = applied {
        counters.refuse(Topic::Vehicles.name(), &FrameError::from(error));
    }
}
