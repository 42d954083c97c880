//! What changes slowly, from shared memory to zenoh: who is who, traffic lights, contacts.

use std::{collections::VecDeque, time::Duration};

use ipc_schema::{
    ports::PortError,
    services::Channel,
    session::Session,
    traffic::{SignalMeta, VehicleMeta},
};

use crate::{
    directory::Directory,
    feed::Watch,
    frame::{self, FrameError},
    keys::Topic,
    outlet::Outlet,
    pace::Budget,
    relay::RelayError,
    status::Counters,
};

/// Messages of contacts that wait for their turn, at most.
const WAITING_CONTACTS: usize = 64;

/// Road users, traffic lights and contacts on their way.
pub struct Facts {
    directory: Directory,
    census: Watch,
    changes: Watch,
    contacts: Watch,
    most_changes: usize,
    vehicles: Table,
    signals: Table,
    event_budget: Budget,
    /// Traffic lights that have not gone out.
    signal_rows: Option<Vec<u8>>,
    /// Contacts that have not gone out, framed.
    contact_frames: VecDeque<Vec<u8>>,
}

/// A table on its way, a part at a time.
struct Table {
    budget: Budget,
    place: usize,
}

impl Table {
    fn new(rate_hz: f64) -> Self {
        Self {
            budget: Budget::new(rate_hz),
            place: 0,
        }
    }
}

impl Facts {
    /// Attends the channels.
    ///
    /// # Errors
    /// A service cannot be opened.
    pub fn open(session: &mut Session) -> Result<Self, RelayError> {
        let settings = session.run.config.fanout.clone();
        Ok(Self {
            directory: Directory::default(),
            most_changes: Channel::TrafficMeta.queue_length(&session.run),
            census: Watch::open(session, Channel::Census)?,
            changes: Watch::open(session, Channel::TrafficMeta)?,
            contacts: Watch::open(session, Channel::Event)?,
            vehicles: Table::new(settings.vehicles_hz),
            signals: Table::new(settings.signals_hz),
            event_budget: Budget::new(settings.event_hz),
            signal_rows: None,
            contact_frames: VecDeque::new(),
        })
    }

    /// Who is who.
    #[must_use]
    pub fn directory(&self) -> &Directory {
        &self.directory
    }

    /// Messages that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.census.refused() + self.changes.refused() + self.contacts.refused()
    }

    /// Empties the queues; returns how many changes waited.
    ///
    /// # Errors
    /// A port is broken.
    pub fn look(&mut self, counters: &mut Counters) -> Result<usize, PortError> {
        while let Some(message) = self.census.receive()? {
            let applied = self.directory.apply_census(message.header(), message.payload());
            note(counters, "vehicles", applied);
        }
        let mut came = 0;
        while let Some(message) = self.changes.receive()? {
            let applied = self.directory.apply_changes(message.header(), message.payload());
            note(counters, "vehicles", applied);
            came += 1;
            if came > self.most_changes {
                break;
            }
        }
        let mut contacts = 0;
        while let Some(message) = self.contacts.receive()? {
            match frame::encode(Channel::Event, message.header(), message.payload()) {
                Ok(frame) => self.contact_frames.push_back(frame.bytes),
                Err(error) => counters.refuse(Topic::Event.name(), &error),
            }
            contacts += 1;
            if contacts > self.most_changes {
                break;
            }
        }
        // Newest win.
        let too_many = self.contact_frames.len().saturating_sub(WAITING_CONTACTS);
        self.contact_frames.drain(..too_many);
        Ok(came)
    }

    /// Publishes what is due.
    ///
    /// # Errors
    /// zenoh broke.
    pub fn relay(&mut self, now: Duration, outlet: &mut Outlet, counters: &mut Counters) -> Result<(), RelayError> {
        let header = *self.directory.header();
        if header.schema_version != 0 && self.vehicles.budget.allows(now) {
            self.vehicles.budget.spend(0);
            let rows = self.directory.vehicle_rows();
            let (part, whole) = frame::table(&header, &rows, size_of::<VehicleMeta>(), &mut self.vehicles.place);
            counters.frames += 1;
            outlet.publish_part(Topic::Vehicles, part.into(), Some(whole.into()))?;
        }
        self.signal_rows = self.directory.take_signal_rows().or(self.signal_rows.take());
        if self.signals.budget.allows(now)
            && let Some(rows) = self.signal_rows.take()
        {
            self.signals.budget.spend(0);
            let (part, whole) = frame::table(&header, &rows, size_of::<SignalMeta>(), &mut self.signals.place);
            counters.frames += 1;
            // Those of a net with more lights than a frame holds take turns.
            if part.len() < whole.len() {
                self.signal_rows = Some(rows);
            }
            outlet.publish_part(Topic::Signals, part.into(), Some(whole.into()))?;
        }
        if self.event_budget.allows(now)
            && let Some(frame) = self.contact_frames.pop_front()
        {
            self.event_budget.spend(0);
            counters.frames += 1;
            outlet.publish(Topic::Event, frame)?;
        }
        Ok(())
    }
}

fn note(counters: &mut Counters, topic: &'static str, applied: Result<(), ipc_schema::block::BlockError>) {
    if let Err(error) = applied {
        counters.refuse(topic, &FrameError::from(error));
    }
}
