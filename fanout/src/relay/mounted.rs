//! The topics of mounted sensors, of which each message is of one sensor: `pointcloud/<id>`, `image/<id>` and `radar/<id>`. A sensor's
//! key is published while a viewer subscribes to it. That of a suite's sensor is `<topic>/<id>@<sensor>`; a carrier beside the road has
//! its name for an id.

use std::{collections::BTreeMap, time::Duration};

use bytemuck::{Pod, pod_read_unaligned};
use ipc_schema::{
    config::{FanoutConfig, OWN_SENSOR},
    image::ImageHead,
    membership::{MembershipError, RunMembership},
    pointcloud::{ROADSIDE_CARRIER, Scan},
    ports::Message,
    radar::RadarScan,
    sensor::SensorKind,
    services::Channel,
};
use zenoh::bytes::ZBytes;

use crate::{
    directory::RoadUserDirectory,
    error::FanoutError,
    feed::ChannelWatcher,
    frame::{self, MAX_SENSOR_BYTES},
    network::publisher::{EnvironmentPublisher, KeyPublisher},
    relay::pace::RateBudget,
    status::FanoutCounters,
};

/// A sensor without a message for this long has left, or its key has no subscriber.
const SENSOR_TIMEOUT: Duration = Duration::from_secs(5);

/// A pass publishes no further message after this many bytes, so that what it adds to a viewer's queue is rarely more than one long frame.
const PASS_BYTES: usize = MAX_SENSOR_BYTES / 2;

/// The sensor that a message is of.
#[derive(Debug, Clone, Copy)]
struct MessageOrigin {
    /// Hash of the carrier's id.
    id_hash: u64,
    /// Dense index of the carrier, or [`ROADSIDE_CARRIER`] and a number.
    vehicle: u32,
    /// Number of the sensor among those of its kind.
    sensor: u32,
}

/// One row of [`MOUNTED`].
struct MountedKind {
    kind: SensorKind,
    channel: Channel,
    /// Most frames of a sensor per wall second.
    rate_hz: fn(&FanoutConfig) -> f64,
    /// The sensor that a payload is of; `None` if the payload is too short.
    origin: fn(&[u8]) -> Option<MessageOrigin>,
    /// Counts what a frame leaves out.
    count: fn(&mut FanoutCounters, usize),
}

/// The kinds of sensors whose messages are published. Those with short frames come first: a pass continues after them.
const MOUNTED: [MountedKind; 3] = [
    MountedKind {
        kind: SensorKind::Radar,
        channel: Channel::Radar,
        rate_hz: |fanout| fanout.radar_hz,
        origin: |payload| {
            first::<RadarScan>(payload).map(|scan| MessageOrigin {
                id_hash: scan.id_hash,
                vehicle: scan.vehicle,
                sensor: scan.sensor,
            })
        },
        count: |counters, rows| counters.thinned_rows += rows as u64,
    },
    MountedKind {
        kind: SensorKind::Lidar,
        channel: Channel::Pointcloud,
        rate_hz: |fanout| fanout.pointcloud_hz,
        origin: |payload| {
            first::<Scan>(payload).map(|scan| MessageOrigin {
                id_hash: scan.id_hash,
                vehicle: scan.vehicle,
                sensor: scan.sensor,
            })
        },
        count: |counters, rows| counters.thinned_rows += rows as u64,
    },
    MountedKind {
        kind: SensorKind::Camera,
        channel: Channel::Image,
        rate_hz: |fanout| fanout.image_hz,
        origin: |payload| {
            first::<ImageHead>(payload).map(|head| MessageOrigin {
                id_hash: head.id_hash,
                vehicle: head.vehicle,
                sensor: head.sensor,
            })
        },
        count: |counters, bytes| counters.reduced_images += u64::from(bytes > 0),
    },
];

/// The record at the start of a payload.
fn first<T: Pod>(payload: &[u8]) -> Option<T> {
    payload.get(..size_of::<T>()).map(pod_read_unaligned)
}

/// The messages of one sensor.
struct SensorStream {
    key_publisher: KeyPublisher,
    budget: RateBudget,
    last_message_at: Duration,
}

/// The sensors of one kind.
struct MountedTopic {
    spec: &'static MountedKind,
    rate_hz: f64,
    /// Stands for every key of the topic, so that zenoh can be asked for subscribers before a sensor is known. Nothing is put on it.
    every_key: KeyPublisher,
    /// Takes messages while a viewer subscribes to a key of the topic: without one, none is kept for the fan-out.
    watcher: Option<ChannelWatcher>,
    /// Messages that earlier watchers refused.
    refused_before: u64,
    /// By the hash of the carrier's id and the number of the sensor.
    streams: BTreeMap<(u64, u32), SensorStream>,
    /// Names of the sensors of suites by their numbers.
    names: BTreeMap<u32, String>,
}

/// The mounted sensors of an environment.
pub struct MountedTopics {
    topics: Vec<MountedTopic>,
    /// Names of the carriers beside the road, in the order of their numbers.
    roadsides: Vec<String>,
}

impl MountedTopics {
    /// The topics of those kinds of sensors that the run's carriers have and whose rate is not 0.
    ///
    /// # Errors
    /// zenoh refuses.
    pub fn open(membership: &RunMembership, publisher: &EnvironmentPublisher) -> Result<Self, FanoutError> {
        let config = &membership.run.config;
        let used = MOUNTED
            .iter()
            .filter(|spec| config.carries(spec.kind) && (spec.rate_hz)(&config.fanout) > 0.0);
        let topics = used
            .map(|spec| {
                let units = config.sensor_units(spec.kind);
                let of_suites = units.into_iter().filter(|unit| unit.sensor != OWN_SENSOR);
                Ok(MountedTopic {
                    spec,
                    rate_hz: (spec.rate_hz)(&config.fanout),
                    every_key: publisher.declare_every_sensor(spec.channel)?,
                    watcher: None,
                    refused_before: 0,
                    streams: BTreeMap::new(),
                    names: of_suites.map(|unit| (unit.sensor, unit.name)).collect(),
                })
            })
            .collect::<Result<_, FanoutError>>()?;
        Ok(Self {
            topics,
            roadsides: config.roadsides.iter().map(|roadside| roadside.name.clone()).collect(),
        })
    }

    /// Messages that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.topics.iter().map(MountedTopic::refused).sum()
    }

    /// Publishes queued messages that are due, until they have [`PASS_BYTES`]; the next call publishes the others.
    ///
    /// # Errors
    /// A port or zenoh broke.
    pub fn publish_due(
        &mut self,
        now: Duration,
        membership: &mut RunMembership,
        directory: &RoadUserDirectory,
        publisher: &EnvironmentPublisher,
        counters: &mut FanoutCounters,
    ) -> Result<(), FanoutError> {
        let mut burst_bytes = 0;
        for topic in &mut self.topics {
            topic.follow_demand(now, membership)?;
            while burst_bytes < PASS_BYTES
                && let Some(message) = topic.receive()?
            {
                let name = |origin: &MessageOrigin| carrier_id(directory, &self.roadsides, origin);
                burst_bytes += topic.publish_message(&message, now, name, publisher, counters)?;
            }
            topic.forget_silent(now, publisher);
        }
        Ok(())
    }
}

/// The id of a message's carrier; `None` as long as it is not known.
fn carrier_id(directory: &RoadUserDirectory, roadsides: &[String], origin: &MessageOrigin) -> Option<String> {
    match origin.vehicle & ROADSIDE_CARRIER {
        0 => {
            let known = directory.vehicle(origin.vehicle);
            Some(known.filter(|meta| meta.id_hash == origin.id_hash)?.id_text())
        }
        _ => roadsides.get((origin.vehicle & !ROADSIDE_CARRIER) as usize).cloned(),
    }
}

impl MountedTopic {
    /// Opens the channel once a viewer subscribes to a key of the topic, and closes it once none does.
    fn follow_demand(&mut self, now: Duration, membership: &mut RunMembership) -> Result<(), MembershipError> {
        match (self.every_key.is_watched(now), &self.watcher) {
            (true, None) => self.watcher = Some(ChannelWatcher::open(membership, self.spec.channel)?),
            (false, Some(_)) => {
                self.refused_before = self.refused();
                self.watcher = None;
            }
            _ => {}
        }
        Ok(())
    }

    fn refused(&self) -> u64 {
        self.refused_before + self.watcher.as_ref().map_or(0, ChannelWatcher::refused)
    }

    /// The next queued message, if the channel is open and has one.
    fn receive(&mut self) -> Result<Option<Message>, FanoutError> {
        match &mut self.watcher {
            Some(watcher) => Ok(watcher.receive()?),
            None => Ok(None),
        }
    }

    /// Publishes one message if it is due; returns the length of its frame, bytes. `carrier_id` gives the id of its carrier, if that is known.
    fn publish_message(
        &mut self,
        message: &Message,
        now: Duration,
        carrier_id: impl FnOnce(&MessageOrigin) -> Option<String>,
        publisher: &EnvironmentPublisher,
        counters: &mut FanoutCounters,
    ) -> Result<usize, FanoutError> {
        // Find the sensor's stream, or declare one if the id of its carrier is known.
        let Some(origin) = (self.spec.origin)(message.payload()) else {
            counters.refused_messages += 1;
            return Ok(0);
        };
        let key = (origin.id_hash, origin.sensor);
        if !self.streams.contains_key(&key) {
            let Some(id) = carrier_id(&origin) else {
                counters.unnamed_messages += 1;
                return Ok(0);
            };
            let name = match self.names.get(&origin.sensor) {
                Some(name) => format!("{id}@{name}"),
                None => id,
            };
            let stream = SensorStream {
                key_publisher: publisher.declare_sensor(self.spec.channel, &name)?,
                budget: RateBudget::new(self.rate_hz),
                last_message_at: now,
            };
            self.streams.insert(key, stream);
        }
        let Some(stream) = self.streams.get_mut(&key) else {
            return Ok(0);
        };
        // Is there a subscriber, and is a message due?
        stream.last_message_at = now;
        if !stream.key_publisher.is_watched(now) || !stream.budget.allows(now) {
            return Ok(0);
        }
        // Publish it.
        match frame::encode(self.spec.channel, message.header(), message.payload()) {
            Ok(frame) => {
                let bytes = frame.bytes.len();
                stream.budget.spend(bytes);
                counters.frames += 1;
                (self.spec.count)(counters, frame.left_out);
                let value = ZBytes::from(frame.bytes);
                publisher.publish_on(&mut stream.key_publisher, value.clone(), Some(value))?;
                Ok(bytes)
            }
            Err(error) => {
                counters.refuse(self.spec.channel.name(), &error);
                Ok(0)
            }
        }
    }

    /// Forgets the sensors that have been silent for [`SENSOR_TIMEOUT`], and what queries for them were answered with.
    fn forget_silent(&mut self, now: Duration, publisher: &EnvironmentPublisher) {
        self.streams.retain(|_, stream| {
            let stays = now.saturating_sub(stream.last_message_at) < SENSOR_TIMEOUT;
            if !stays {
                publisher.forget(&stream.key_publisher);
            }
            stays
        });
    }
}
