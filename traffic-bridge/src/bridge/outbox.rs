//! Everything the bridge publishes, and the number of its `traffic-meta` messages.

use ipc_schema::{
    block::Section,
    control::{SensorSwitch, SensorSwitchLayout},
    failure::{Failure, FailureKind},
    header::MessageHeader,
    membership::{RequiredConsumers, RunMembership},
    ports::{PortError, Publisher},
    services::Channel,
    traffic::{EVENTS_PER_MESSAGE, RoutePoint, SIGNALS_PER_MESSAGE, TrafficLayout, TrafficMetaLayout},
};

use super::{census::Census, lane_feed::LaneFeed};
use crate::{heroes, sumo::frame::TrafficFrame};

/// The publishers of the process.
pub(super) struct Outbox {
    traffic: Publisher,
    meta: Publisher,
    /// Whole state once a second, in a run that viewers may watch.
    census: Option<(Publisher, Census)>,
    /// Road users in SUMO's terms, in a run that asks for them.
    pub(super) lanes: Option<LaneFeed>,
    /// Sensors that commands switch.
    switches: Publisher,
    /// The required consumers of `traffic`.
    consumers: RequiredConsumers,
    /// `traffic-meta` messages sent.
    meta_messages: u64,
}

impl Outbox {
    pub(super) fn open(membership: &RunMembership) -> Result<Self, Failure> {
        let census = match membership.run.config.fanout.enabled {
            true => Some((membership.publisher(Channel::Census)?, Census::default())),
            false => None,
        };
        let lanes = match membership.run.config.traffic.lane_positions {
            true => Some(LaneFeed::open(membership)?),
            false => None,
        };
        Ok(Self {
            lanes,
            traffic: membership.publisher(Channel::Traffic)?,
            meta: membership.publisher(Channel::TrafficMeta)?,
            census,
            switches: membership.publisher(Channel::Switch)?,
            consumers: membership.required_consumers(Channel::Traffic)?,
            meta_messages: 0,
        })
    }

    /// The required consumers of `traffic`.
    pub(super) fn consumers(&self) -> &RequiredConsumers {
        &self.consumers
    }

    /// Messages of steps that were lost because a queue was full.
    pub(super) fn drops(&self) -> u64 {
        self.traffic.drops() + self.meta.drops()
    }

    /// Sends one step: first what happened, then the states of all road users. Returns the header of the states.
    pub(super) fn publish_step(
        &mut self,
        frame: &TrafficFrame,
        header: MessageHeader,
    ) -> Result<MessageHeader, Failure> {
        self.publish_meta(frame, header)?;
        let layout = TrafficLayout::sized(frame.states.len(), frame.advice.len());
        let header = MessageHeader {
            shape: layout.shape,
            meta_messages: self.meta_messages,
            ..header
        };
        // Before the states: a process that has a tick's states finds its positions.
        if let Some(lanes) = &mut self.lanes {
            lanes.publish(frame, header)?;
        }
        let mut draft = self.traffic.loan(header, layout.len).map_err(too_many)?;
        copy(&frame.states, layout.states, draft.payload_mut());
        copy(&frame.advice, layout.advice, draft.payload_mut());
        draft.send()?;
        self.consumers.sent(header.tick);
        if let Some((publisher, census)) = &mut self.census {
            census.add_step(frame);
            census.publish_if_due(publisher, header)?;
        }
        Ok(header)
    }

    /// Sends events of road users and changes of traffic lights, in as many messages as they need; none if nothing happened.
    fn publish_meta(&mut self, frame: &TrafficFrame, header: MessageHeader) -> Result<(), Failure> {
        let mut events = frame.events.chunks(EVENTS_PER_MESSAGE);
        let mut signals = frame.signals.chunks(SIGNALS_PER_MESSAGE);
        loop {
            let (vehicles, lights) = match (events.next(), signals.next()) {
                (None, None) => return Ok(()),
                (vehicles, lights) => (vehicles.unwrap_or_default(), lights.unwrap_or_default()),
            };
            self.meta_messages += 1;
            let layout = TrafficMetaLayout::new(vehicles.len(), lights.len());
            let header = MessageHeader {
                shape: layout.shape,
                meta_messages: self.meta_messages,
                ..header
            };
            let mut draft = self.meta.loan(header, layout.len).map_err(too_many)?;
            let payload = draft.payload_mut();
            let at = |section: Section| section.offset..section.offset + section.len;
            payload[at(layout.vehicles)].copy_from_slice(bytemuck::cast_slice(vehicles));
            payload[at(layout.signals)].copy_from_slice(bytemuck::cast_slice(lights));
            draft.send()?;
        }
    }

    /// Sends the points of heroes' routes.
    pub(super) fn publish_routes(&mut self, points: &[RoutePoint], header: MessageHeader) -> Result<(), Failure> {
        for part in heroes::parts(points) {
            self.meta_messages += 1;
            let layout = TrafficMetaLayout::sized(0, 0, part.len());
            let header = MessageHeader {
                shape: layout.shape,
                meta_messages: self.meta_messages,
                ..header
            };
            send(&self.meta, header, layout.len, layout.route, part)?;
        }
        Ok(())
    }

    /// Sends the sensors that commands switch at the tick of `header`.
    pub(super) fn publish_switches(&self, switches: &[SensorSwitch], header: MessageHeader) -> Result<(), Failure> {
        let layout = SensorSwitchLayout::sized(switches.len());
        let header = MessageHeader {
            shape: layout.shape,
            ..header
        };
        send(&self.switches, header, layout.len, layout.switches, switches)
    }
}

/// Sends a message of `len` bytes with one section that holds `rows`.
fn send<T: bytemuck::Pod>(
    publisher: &Publisher,
    header: MessageHeader,
    len: usize,
    section: Section,
    rows: &[T],
) -> Result<(), Failure> {
    let mut draft = publisher.loan(header, len).map_err(too_many)?;
    copy(rows, section, draft.payload_mut());
    draft.send()?;
    Ok(())
}

fn copy<T: bytemuck::Pod>(rows: &[T], section: Section, payload: &mut [u8]) {
    payload[section.offset..section.offset + section.len].copy_from_slice(bytemuck::cast_slice(rows));
}

/// The user can settle this failure: the configuration reserves room for fewer road users than there are.
pub(super) fn too_many(error: PortError) -> Failure {
    match &error {
        PortError::TooLong { .. } => Failure::from_error(FailureKind::Config, &error)
            .with_help("raise `traffic.max_road_users`, or use a scenario with fewer road users at the same time"),
        _ => error.into(),
    }
}
