//! Which road users and traffic lights there are, for viewers that come late or miss changes.

use std::collections::BTreeMap;

use ipc_schema::{
    block::{self, BlockError},
    failure::Failure,
    header::MessageHeader,
    ports::Publisher,
    traffic::{MOST_SIGNALS, MetaEvent, SignalMeta, TrafficMetaLayout, VehicleMeta},
};

/// Simulated time between two messages, nanoseconds.
const INTERVAL_NS: u64 = 1_000_000_000;

/// The newest announcement of each road user and traffic light of the episode that is played.
#[derive(Debug, Default)]
pub struct PlayedCensus {
    episode: u64,
    vehicles: BTreeMap<u32, VehicleMeta>,
    signals: BTreeMap<u32, SignalMeta>,
    due_ns: u64,
}

impl PlayedCensus {
    /// Adds a recorded message of `traffic-meta`.
    ///
    /// # Errors
    /// The message is shorter than its header says.
    pub fn add(&mut self, header: &MessageHeader, payload: &[u8]) -> Result<(), BlockError> {
        self.enter(header.episode);
        let layout = TrafficMetaLayout::of(header);
        let vehicles: &[VehicleMeta] = block::view(payload, layout.vehicles)?;
        for meta in vehicles {
            if meta.event == MetaEvent::Departed as u32 {
                self.vehicles.insert(meta.vehicle, *meta);
            } else if meta.event == MetaEvent::Arrived as u32 {
                self.vehicles.remove(&meta.vehicle);
            }
        }
        let signals: &[SignalMeta] = block::view(payload, layout.signals)?;
        self.signals
            .extend(signals.iter().map(|signal| (signal.signal, *signal)));
        Ok(())
    }

    fn enter(&mut self, episode: u64) {
        if episode != self.episode {
            *self = Self {
                episode,
                ..Self::default()
            };
        }
    }

    /// Sends all of it if a simulated second has passed since the last time, with the header of the tick that is played.
    ///
    /// # Errors
    /// Shared memory fails.
    pub fn publish_if_due(&mut self, publisher: &Publisher, header: MessageHeader) -> Result<(), Failure> {
        if header.episode != self.episode || header.sim_time_ns < self.due_ns {
            return Ok(());
        }
        self.due_ns = header.sim_time_ns + INTERVAL_NS;
        let vehicles: Vec<VehicleMeta> = self.vehicles.values().copied().collect();
        let signals: Vec<SignalMeta> = self.signals.values().copied().take(MOST_SIGNALS).collect();
        let layout = TrafficMetaLayout::new(vehicles.len(), signals.len());
        let header = MessageHeader {
            shape: layout.shape,
            ..header
        };
        let mut draft = publisher.loan(header, layout.len)?;
        let payload = draft.payload_mut();
        let failed = |error: BlockError| Failure::from_error(ipc_schema::failure::FailureKind::Run, &error);
        block::view_mut(payload, layout.vehicles)
            .map_err(failed)?
            .copy_from_slice(&vehicles);
        block::view_mut(payload, layout.signals)
            .map_err(failed)?
            .copy_from_slice(&signals);
        draft.send()?;
        Ok(())
    }
}
