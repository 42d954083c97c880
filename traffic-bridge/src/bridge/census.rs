//! The whole state of road users and traffic lights, once per simulated second: for watchers that start late or miss changes.

use std::collections::BTreeMap;

use ipc_schema::{
    block::Section,
    failure::Failure,
    header::MessageHeader,
    ports::Publisher,
    traffic::{MOST_SIGNALS, MetaEvent, SignalMeta, TrafficMetaLayout, VehicleMeta},
};

use crate::sumo::frame::TrafficFrame;

/// Simulated time between two messages, nanoseconds.
const INTERVAL_NS: u64 = 1_000_000_000;

/// The newest announcement of each road user and traffic light in the current episode.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Census {
    vehicles: BTreeMap<u32, VehicleMeta>,
    signals: BTreeMap<u32, SignalMeta>,
    due_ns: u64,
}

impl Census {
    /// Adds the events and signals of a step.
    pub fn add_step(&mut self, frame: &TrafficFrame) {
        if frame.step == 1 {
            *self = Self::default();
        }
        for event in &frame.events {
            if event.event == MetaEvent::Departed as u32 {
                self.vehicles.insert(event.vehicle, *event);
            } else if event.event == MetaEvent::Arrived as u32 {
                self.vehicles.remove(&event.vehicle);
            }
        }
        self.signals
            .extend(frame.signals.iter().map(|signal| (signal.signal, *signal)));
    }

    /// Sends the census if a second has passed since the last one, with the header of the step.
    ///
    /// # Errors
    /// Shared memory fails.
    pub fn publish_if_due(&mut self, publisher: &Publisher, header: MessageHeader) -> Result<(), Failure> {
        if header.sim_time_ns < self.due_ns {
            return Ok(());
        }
        self.due_ns = header.sim_time_ns + INTERVAL_NS;
        let signals = self.signals.len().min(MOST_SIGNALS);
        let layout = TrafficMetaLayout::new(self.vehicles.len(), signals);
        let header = MessageHeader {
            shape: layout.shape,
            ..header
        };
        let mut draft = publisher.loan_unwritten(header, layout.len)?;
        let payload = draft.payload_mut();
        write(payload, layout.vehicles, self.vehicles.values());
        write(payload, layout.signals, self.signals.values().take(signals));
        draft.send()?;
        Ok(())
    }
}

fn write<'a, T: bytemuck::Pod>(payload: &mut [u8], section: Section, rows: impl Iterator<Item = &'a T>) {
    let bytes = &mut payload[section.offset..section.offset + section.len];
    for (place, row) in bytes.chunks_exact_mut(size_of::<T>()).zip(rows) {
        place.copy_from_slice(bytemuck::bytes_of(row));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable as _;

    fn event(vehicle: u32, event: MetaEvent) -> VehicleMeta {
        VehicleMeta {
            vehicle,
            event: event as u32,
            ..VehicleMeta::zeroed()
        }
    }

    fn step(step: u64, events: Vec<VehicleMeta>) -> TrafficFrame {
        TrafficFrame {
            events,
            step,
            ..TrafficFrame::default()
        }
    }

    #[test]
    fn it_holds_the_road_users_present_and_starts_empty_in_each_episode() {
        let mut census = Census::default();
        census.add_step(&step(
            1,
            vec![event(0, MetaEvent::Departed), event(1, MetaEvent::Departed)],
        ));
        census.add_step(&step(
            2,
            vec![event(0, MetaEvent::Arrived), event(1, MetaEvent::Teleported)],
        ));
        assert_eq!(census.vehicles.keys().copied().collect::<Vec<_>>(), [1]);
        assert_eq!(census.vehicles[&1].event, MetaEvent::Departed as u32);
        census.add_step(&step(1, vec![event(0, MetaEvent::Departed)]));
        assert_eq!(census.vehicles.keys().copied().collect::<Vec<_>>(), [0]);
    }
}
