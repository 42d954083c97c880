//! The topics `pointcloud/<id>`: a key for each LIDAR, published while a viewer subscribes to it. That of a suite's sensor is
//! `pointcloud/<id>@<sensor>`; a carrier beside the road has its name for an id.

use std::{collections::BTreeMap, time::Duration};

use bytemuck::pod_read_unaligned;
use ipc_schema::{
    config::OWN_SENSOR,
    membership::{MembershipError, RunMembership},
    pointcloud::{ROADSIDE_CARRIER, Scan},
    ports::Message,
    sensor::SensorKind,
    services::Channel,
};
use zenoh::bytes::ZBytes;

use crate::{
    directory::RoadUserDirectory,
    error::FanoutError,
    feed::ChannelWatcher,
    frame::{self, MAX_SCAN_BYTES},
    network::publisher::{EnvironmentPublisher, KeyPublisher},
    relay::pace::RateBudget,
    status::FanoutCounters,
};

/// A vehicle without a scan for this long has left.
const VEHICLE_TIMEOUT: Duration = Duration::from_secs(5);

/// The scans of one LIDAR.
struct ScanStream {
    key_publisher: KeyPublisher,
    budget: RateBudget,
    last_scan_at: Duration,
}

/// The scans of an environment.
pub struct ScanTopics {
    watcher: ChannelWatcher,
    rate_hz: f64,
    /// By the hash of the carrier's id and the number of the LIDAR.
    streams: BTreeMap<(u64, u32), ScanStream>,
    /// Names of the LIDARs of suites by their numbers.
    names: BTreeMap<u32, String>,
    /// Names of the carriers beside the road, in the order of their numbers.
    roadsides: Vec<String>,
}

impl ScanTopics {
    /// Subscribes to the channel; `None` if no vehicle carries a LIDAR, or `fanout.pointcloud_hz` is 0.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn open(membership: &mut RunMembership) -> Result<Option<Self>, MembershipError> {
        let rate_hz = membership.run.config.fanout.pointcloud_hz;
        let config = &membership.run.config;
        if !config.carries(SensorKind::Lidar) || rate_hz <= 0.0 {
            return Ok(None);
        }
        let units = config.sensor_units(SensorKind::Lidar);
        let of_suites = units.into_iter().filter(|unit| unit.sensor != OWN_SENSOR);
        let names = of_suites.map(|unit| (unit.sensor, unit.name)).collect();
        let roadsides = config.roadsides.iter().map(|roadside| roadside.name.clone()).collect();
        Ok(Some(Self {
            names,
            roadsides,
            watcher: ChannelWatcher::open(membership, Channel::Pointcloud)?,
            rate_hz,
            streams: BTreeMap::new(),
        }))
    }

    /// Messages that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.watcher.refused()
    }

    /// Publishes the queued scans that are due, at most as many as a viewer's queue holds.
    ///
    /// # Errors
    /// A port or zenoh broke.
    pub fn publish_due(
        &mut self,
        now: Duration,
        directory: &RoadUserDirectory,
        publisher: &EnvironmentPublisher,
        counters: &mut FanoutCounters,
    ) -> Result<(), FanoutError> {
        let mut burst_bytes = 0;
        while let Some(message) = self.watcher.receive()? {
            if burst_bytes < MAX_SCAN_BYTES {
                burst_bytes += self.publish_scan(&message, now, directory, publisher, counters)?;
            }
        }
        self.streams.retain(|_, stream| {
            let stays = now.saturating_sub(stream.last_scan_at) < VEHICLE_TIMEOUT;
            if !stays {
                publisher.forget(&stream.key_publisher);
            }
            stays
        });
        Ok(())
    }

    /// The name of a LIDAR in its topic; `None` as long as the id of its carrier is not known.
    fn name(&self, directory: &RoadUserDirectory, id_hash: u64, vehicle: u32, sensor: u32) -> Option<String> {
        let id = match vehicle & ROADSIDE_CARRIER {
            0 => directory
                .vehicle(vehicle)
                .filter(|meta| meta.id_hash == id_hash)?
                .id_text(),
            _ => self.roadsides.get((vehicle & !ROADSIDE_CARRIER) as usize)?.clone(),
        };
        Some(match self.names.get(&sensor) {
            Some(name) => format!("{id}@{name}"),
            None => id,
        })
    }

    /// Publishes one scan if it is due; returns its length, bytes.
    fn publish_scan(
        &mut self,
        message: &Message,
        now: Duration,
        directory: &RoadUserDirectory,
        publisher: &EnvironmentPublisher,
        counters: &mut FanoutCounters,
    ) -> Result<usize, FanoutError> {
        // Find the vehicle's stream, or declare one for a vehicle whose id is known.
        let header = message.header();
        let Some(scan) = message.payload().get(..size_of::<Scan>()) else {
            counters.refused_messages += 1;
            return Ok(0);
        };
        let Scan {
            id_hash,
            vehicle,
            sensor,
            ..
        } = pod_read_unaligned(scan);
        if !self.streams.contains_key(&(id_hash, sensor)) {
            let Some(name) = self.name(directory, id_hash, vehicle, sensor) else {
                counters.unnamed_scans += 1;
                return Ok(0);
            };
            let stream = ScanStream {
                key_publisher: publisher.declare_scan(&name)?,
                budget: RateBudget::new(self.rate_hz),
                last_scan_at: now,
            };
            self.streams.insert((id_hash, sensor), stream);
        }
        let Some(stream) = self.streams.get_mut(&(id_hash, sensor)) else {
            return Ok(0);
        };
        // Is there a subscriber, and is a scan due?
        stream.last_scan_at = now;
        if !stream.key_publisher.is_watched(now) || !stream.budget.allows(now) {
            return Ok(0);
        }
        // Publish it.
        match frame::encode(Channel::Pointcloud, header, message.payload()) {
            Ok(frame) => {
                let bytes = frame.bytes.len();
                stream.budget.spend(bytes);
                counters.frames += 1;
                counters.thinned_rows += frame.left_out as u64;
                let value = ZBytes::from(frame.bytes);
                publisher.publish_on(&mut stream.key_publisher, value.clone(), Some(value))?;
                Ok(bytes)
            }
            Err(error) => {
                counters.refuse("pointcloud", &error);
                Ok(0)
            }
        }
    }
}
