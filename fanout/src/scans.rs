//! Scans of LIDARs: a key for each vehicle that carries one, published while somebody watches it.

use std::{collections::BTreeMap, time::Duration};

use bytemuck::pod_read_unaligned;
use ipc_schema::{pointcloud::Scan, ports::Message, services::Channel, session::Session};
use zenoh::bytes::ZBytes;

use crate::{
    directory::Directory,
    feed::Watch,
    frame::{self, MAX_SCAN_BYTES},
    outlet::{Line, Outlet},
    pace::Budget,
    relay::RelayError,
    status::Counters,
};

/// How often zenoh is asked whether somebody watches a key.
const ASK_AGAIN: Duration = Duration::from_millis(200);
/// A vehicle without a scan for so long has left.
const FORGOTTEN: Duration = Duration::from_secs(5);

/// One vehicle's scans.
struct Carrier {
    line: Line,
    budget: Budget,
    is_watched: bool,
    ask_at: Duration,
    seen_at: Duration,
}

/// The scans of a run.
pub struct Scans {
    watch: Watch,
    rate_hz: f64,
    carriers: BTreeMap<u64, Carrier>,
}

impl Scans {
    /// Attends the channel; `None` if no vehicle carries a LIDAR, or nobody is to see it.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn open(session: &mut Session) -> Result<Option<Self>, RelayError> {
        let rate_hz = session.run.config.fanout.pointcloud_hz;
        if session.run.config.lidar.vehicles == 0 || rate_hz <= 0.0 {
            return Ok(None);
        }
        Ok(Some(Self {
            watch: Watch::open(session, Channel::Pointcloud)?,
            rate_hz,
            carriers: BTreeMap::new(),
        }))
    }

    /// Messages that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.watch.refused()
    }

    /// Publishes the scans that wait and are due; not more at a time than a viewer's queue holds.
    ///
    /// # Errors
    /// A port or zenoh broke.
    pub fn relay(
        &mut self,
        now: Duration,
        directory: &Directory,
        outlet: &Outlet,
        counters: &mut Counters,
    ) -> Result<(), RelayError> {
        let mut burst_bytes = 0;
        while let Some(message) = self.watch.receive()? {
            if burst_bytes < MAX_SCAN_BYTES {
                burst_bytes += self.scan(&message, now, directory, outlet, counters)?;
            }
        }
        self.carriers.retain(|_, carrier| {
            let stays = now.saturating_sub(carrier.seen_at) < FORGOTTEN;
            if !stays {
                outlet.forget(&carrier.line);
            }
            stays
        });
        Ok(())
    }

    /// Publishes one scan if it is due; returns its length, bytes.
    fn scan(
        &mut self,
        message: &Message,
        now: Duration,
        directory: &Directory,
        outlet: &Outlet,
        counters: &mut Counters,
    ) -> Result<usize, RelayError> {
        let header = message.header();
        let Some(scan) = message.payload().get(..size_of::<Scan>()) else {
            counters.refused_messages += 1;
            return Ok(0);
        };
        let id_hash = pod_read_unaligned::<Scan>(scan).id_hash;
        if !self.carriers.contains_key(&id_hash) {
            let index = u32::try_from(header.sequence).unwrap_or(u32::MAX);
            let Some(meta) = directory.vehicle(index).filter(|meta| meta.id_hash == id_hash) else {
                counters.unnamed_scans += 1;
                return Ok(0);
            };
            let carrier = Carrier {
                line: outlet.scan_line(&meta.id_text())?,
                budget: Budget::new(self.rate_hz),
                is_watched: false,
                ask_at: Duration::ZERO,
                seen_at: now,
            };
            self.carriers.insert(id_hash, carrier);
        }
        let Some(carrier) = self.carriers.get_mut(&id_hash) else {
            return Ok(0);
        };
        carrier.seen_at = now;
        if now >= carrier.ask_at {
            carrier.ask_at = now + ASK_AGAIN;
            carrier.is_watched = carrier.line.is_watched();
        }
        if !carrier.is_watched || !carrier.budget.allows(now) {
            return Ok(0);
        }
        match frame::encode(Channel::Pointcloud, header, message.payload()) {
            Ok(frame) => {
                let bytes = frame.bytes.len();
                carrier.budget.spend(bytes);
                counters.frames += 1;
                counters.thinned_rows += frame.left_out as u64;
                let value = ZBytes::from(frame.bytes);
                outlet.publish_on(&mut carrier.line, value.clone(), Some(value))?;
                Ok(bytes)
            }
            Err(error) => {
                counters.refuse("pointcloud", &error);
                Ok(0)
            }
        }
    }
}
