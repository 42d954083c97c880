//! Publishing on zenoh: publishers that drop a sample rather than wait, and a queryable that answers with the newest value of every key.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use ipc_schema::services::Channel;
use zenoh::{
    Wait,
    bytes::{Encoding, ZBytes},
    key_expr::KeyExpr,
    liveliness::LivelinessToken,
    pubsub::{Publisher, Subscriber},
    qos::{CongestionControl, Priority},
    query::{Query, Queryable},
    sample::Locality,
};

use crate::{
    error::NetworkError,
    network::keys::{RunKeys, Topic},
};

/// Time for the last frames to leave zenoh's queues: at most 1 MB for each viewer.
pub(crate) const CLOSE_DELAY: Duration = Duration::from_millis(500);
/// Most queries that wait for an answer; more are not answered. A viewer that stalls while it is answered delays the other answers by at
/// most zenoh's 5 s, and delays no frame.
const MAX_QUERIES: usize = 256;

/// The newest value of a key.
#[derive(Clone)]
struct LatestValue {
    key: KeyExpr<'static>,
    encoding: Encoding,
    payload: ZBytes,
    attachment: [u8; 16],
}

/// The newest value of every key.
type LatestValues = Arc<Mutex<BTreeMap<String, LatestValue>>>;

/// How often zenoh is asked whether a key has a subscriber.
const MATCHING_INTERVAL: Duration = Duration::from_millis(200);

/// A publisher of one key.
pub struct KeyPublisher {
    publisher: Publisher<'static>,
    key: String,
    encoding: Encoding,
    sequence: u64,
    /// The newest answer to whether a client subscribes, and when zenoh is asked next.
    is_watched: bool,
    ask_at: Duration,
}

impl KeyPublisher {
    /// True while a client subscribes to the key.
    #[must_use]
    pub fn has_subscriber(&self) -> bool {
        self.publisher
            .matching_status()
            .wait()
            .is_ok_and(|status| status.matching())
    }

    /// As [`KeyPublisher::has_subscriber`], at most [`MATCHING_INTERVAL`] late: `now` is the time since the start.
    pub fn is_watched(&mut self, now: Duration) -> bool {
        if now >= self.ask_at {
            self.ask_at = now + MATCHING_INTERVAL;
            self.is_watched = self.has_subscriber();
        }
        self.is_watched
    }
}

/// Publishes all keys of one environment of a run, and answers queries for them.
pub struct EnvironmentPublisher {
    session: zenoh::Session,
    keys: RunKeys,
    topics: BTreeMap<Topic, KeyPublisher>,
    latest: LatestValues,
    foreign_samples: Arc<AtomicU64>,
    // Dropping these withdraws their keys.
    _queryable: Queryable<()>,
    _foreign_subscriber: Subscriber<()>,
    /// The liveliness token, once announced.
    token: Option<LivelinessToken>,
}

impl EnvironmentPublisher {
    /// Declares all keys; `map` is the JSON that answers for [`Topic::Map`].
    ///
    /// # Errors
    /// zenoh or the operating system refuses.
    pub fn open(session: zenoh::Session, keys: &RunKeys, map: &str) -> Result<Self, NetworkError> {
        let latest: LatestValues = Arc::default();
        let (sender, queries) = sync_channel(MAX_QUERIES);
        answer_on_a_thread(&latest, queries)?;
        let queryable = session
            .declare_queryable(keys.all())
            .callback(queue_query(sender))
            .wait()
            .map_err(NetworkError::refused("declaration", keys.all()))?;
        let foreign_samples = Arc::new(AtomicU64::new(0));
        let publisher = Self {
            _foreign_subscriber: count_foreign_samples(&session, keys, &foreign_samples)?,
            _queryable: queryable,
            keys: keys.clone(),
            topics: BTreeMap::new(),
            latest,
            foreign_samples,
            session,
            token: None,
        };
        let value = publisher.value(&keys.topic(Topic::Map), &Encoding::APPLICATION_JSON, map, 0)?;
        publisher.store(value);
        publisher.declare_topics()
    }

    fn declare_topics(mut self) -> Result<Self, NetworkError> {
        for topic in Topic::ALL.into_iter().filter(|topic| *topic != Topic::Map) {
            let key_publisher = self.declare_key(&self.keys.topic(topic), encoding(topic), priority(topic))?;
            self.topics.insert(topic, key_publisher);
        }
        Ok(self)
    }

    /// Declares the key of what `channel` carries of the mounted sensor with this name ([`RunKeys::sensor`]).
    ///
    /// # Errors
    /// zenoh refuses.
    pub fn declare_sensor(&self, channel: Channel, name: &str) -> Result<KeyPublisher, NetworkError> {
        self.declare_sensor_key(&self.keys.sensor(channel, name))
    }

    /// Declares an expression over the keys of all sensors of `channel`, to be asked for subscribers.
    ///
    /// # Errors
    /// zenoh refuses.
    pub fn declare_every_sensor(&self, channel: Channel) -> Result<KeyPublisher, NetworkError> {
        self.declare_sensor_key(&self.keys.every_sensor(channel))
    }

    fn declare_sensor_key(&self, key: &str) -> Result<KeyPublisher, NetworkError> {
        self.declare_key(key, Encoding::APPLICATION_OCTET_STREAM, Priority::Background)
    }

    fn declare_key(&self, key: &str, encoding: Encoding, priority: Priority) -> Result<KeyPublisher, NetworkError> {
        let publisher = self
            .session
            .declare_publisher(key.to_owned())
            .encoding(encoding.clone())
            .congestion_control(CongestionControl::Drop)
            .priority(priority)
            .allowed_destination(Locality::Remote)
            .wait()
            .map_err(NetworkError::refused("declaration", key.to_owned()))?;
        Ok(KeyPublisher {
            publisher,
            key: key.to_owned(),
            encoding,
            sequence: 0,
            is_watched: false,
            ask_at: Duration::ZERO,
        })
    }

    /// Declares the liveliness token: the run is present.
    ///
    /// # Errors
    /// zenoh refuses.
    pub fn announce(&mut self) -> Result<(), NetworkError> {
        let token = self.session.liveliness().declare_token(self.keys.alive()).wait();
        self.token = Some(token.map_err(NetworkError::refused("declaration", self.keys.alive()))?);
        Ok(())
    }

    /// Publishes `bytes`, and answers queries with them from now on; never waits for a viewer.
    ///
    /// # Errors
    /// The session is closed.
    pub fn publish(&mut self, topic: Topic, bytes: Vec<u8>) -> Result<(), NetworkError> {
        let value = ZBytes::from(bytes);
        self.publish_part(topic, value.clone(), Some(value))
    }

    /// Publishes `part`, and answers queries with `whole` from now on, if that is given.
    ///
    /// # Errors
    /// As [`EnvironmentPublisher::publish`].
    pub fn publish_part(&mut self, topic: Topic, part: ZBytes, whole: Option<ZBytes>) -> Result<(), NetworkError> {
        let Some(mut key_publisher) = self.topics.remove(&topic) else {
            return Ok(());
        };
        let result = self.publish_on(&mut key_publisher, part, whole);
        self.topics.insert(topic, key_publisher);
        result
    }

    /// Publishes `part` on any key, as [`EnvironmentPublisher::publish_part`] does.
    ///
    /// # Errors
    /// As [`EnvironmentPublisher::publish`].
    pub fn publish_on(
        &self,
        key_publisher: &mut KeyPublisher,
        part: ZBytes,
        whole: Option<ZBytes>,
    ) -> Result<(), NetworkError> {
        let attachment = attachment(key_publisher.sequence);
        key_publisher.sequence += 1;
        if let Some(whole) = whole {
            let value = self.value(
                &key_publisher.key,
                &key_publisher.encoding,
                whole,
                key_publisher.sequence - 1,
            )?;
            self.store(value);
        }
        key_publisher
            .publisher
            .put(part)
            .attachment(attachment.as_slice())
            .wait()
            .map_err(NetworkError::refused("publication", key_publisher.key.clone()))
    }

    /// Stops answering queries for this key.
    pub fn forget(&self, key_publisher: &KeyPublisher) {
        self.locked().remove(&key_publisher.key);
    }

    /// Samples that other clients have put on this run's keys.
    #[must_use]
    pub fn foreign_samples(&self) -> u64 {
        self.foreign_samples.load(Ordering::Relaxed)
    }

    fn value(
        &self,
        key: &str,
        encoding: &Encoding,
        payload: impl Into<ZBytes>,
        sequence: u64,
    ) -> Result<LatestValue, NetworkError> {
        Ok(LatestValue {
            key: KeyExpr::new(key.to_owned()).map_err(NetworkError::refused("declaration", key.to_owned()))?,
            encoding: encoding.clone(),
            payload: payload.into(),
            attachment: attachment(sequence),
        })
    }

    fn store(&self, value: LatestValue) {
        self.locked().insert(value.key.to_string(), value);
    }

    fn locked(&self) -> std::sync::MutexGuard<'_, BTreeMap<String, LatestValue>> {
        self.latest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn has_subscriber(&self) -> bool {
        self.topics.values().any(KeyPublisher::has_subscriber)
    }

    /// True while a client subscribes to the topic, as [`KeyPublisher::is_watched`].
    pub fn is_watched(&mut self, topic: Topic, now: Duration) -> bool {
        let key_publisher = self.topics.get_mut(&topic);
        key_publisher.is_some_and(|key_publisher| key_publisher.is_watched(now))
    }
}

/// Closes the session after what is queued for viewers, if there are any, has been sent. zenoh does not report when its queues are empty,
/// and drops them when it closes, so the last frames get [`CLOSE_DELAY`].
pub fn close(mut publishers: Vec<EnvironmentPublisher>, session: &zenoh::Session) {
    if publishers.iter().any(EnvironmentPublisher::has_subscriber) {
        std::thread::park_timeout(CLOSE_DELAY);
    }
    for publisher in &mut publishers {
        drop(publisher.token.take());
    }
    if let Err(error) = session.close().wait() {
        tracing::warn!(%error, "zenoh did not close cleanly");
    }
}

/// The attachment of a sample: its sequence number and the time at which it was taken out of shared memory, little endian.
#[expect(
    clippy::disallowed_methods,
    reason = "a label for viewers on other machines; no result depends on it"
)]
fn attachment(sequence: u64) -> [u8; 16] {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let now_ns = u64::try_from(now.as_nanos()).unwrap_or(u64::MAX);
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&sequence.to_le_bytes());
    bytes[8..].copy_from_slice(&now_ns.to_le_bytes());
    bytes
}

/// Sequence number and UNIX time in nanoseconds of an attachment; `None` if it has another form.
#[must_use]
pub fn read_attachment(bytes: &[u8]) -> Option<(u64, u64)> {
    let (sequence, time) = bytes.split_at_checked(8)?;
    Some((
        u64::from_le_bytes(sequence.try_into().ok()?),
        u64::from_le_bytes(time.try_into().ok()?),
    ))
}

/// Each priority has its own queues, so that short and urgent samples overtake long ones.
fn priority(topic: Topic) -> Priority {
    match topic {
        Topic::Map | Topic::Status | Topic::Learning | Topic::Signals | Topic::Event => Priority::InteractiveLow,
        Topic::Prediction => Priority::DataHigh,
        Topic::World => Priority::Data,
        Topic::Observation | Topic::Neighbours | Topic::Vehicles | Topic::Routes => Priority::DataLow,
    }
}

fn encoding(topic: Topic) -> Encoding {
    match topic {
        Topic::Status | Topic::Learning | Topic::Map => Encoding::APPLICATION_JSON,
        _ => Encoding::APPLICATION_OCTET_STREAM,
    }
}

/// Counts the samples that other clients put on this run's keys; their contents are ignored.
fn count_foreign_samples(
    session: &zenoh::Session,
    keys: &RunKeys,
    count: &Arc<AtomicU64>,
) -> Result<Subscriber<()>, NetworkError> {
    let counter = Arc::clone(count);
    session
        .declare_subscriber(keys.all())
        .allowed_origin(Locality::Remote)
        .callback(move |_| {
            counter.fetch_add(1, Ordering::Relaxed);
        })
        .wait()
        .map_err(NetworkError::refused("declaration", keys.all()))
}

/// Queues a query for [`answer_on_a_thread`].
fn queue_query(sender: SyncSender<Query>) -> impl Fn(Query) + Send + Sync + 'static {
    move |query| {
        if sender.try_send(query).is_err() {
            tracing::debug!("too many queries at once: one is not answered");
        }
    }
}

/// Answers queries on a separate thread, because zenoh's own threads must not wait for a viewer that reads its answer slowly.
fn answer_on_a_thread(latest: &LatestValues, queries: Receiver<Query>) -> Result<(), NetworkError> {
    let latest = Arc::clone(latest);
    std::thread::Builder::new()
        .name("answers".into())
        .spawn(move || queries.iter().for_each(|query| answer(&latest, &query)))
        .map(drop)
        .map_err(|source| NetworkError::Thread {
            task: "answers queries",
            source,
        })
}

fn answer(latest: &LatestValues, query: &Query) {
    let values: Vec<LatestValue> = latest
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .values()
        .filter(|value| query.key_expr().intersects(&value.key))
        .cloned()
        .collect();
    for value in values {
        let reply = query
            .reply(value.key.clone(), value.payload)
            .encoding(value.encoding)
            .attachment(value.attachment.as_slice());
        if let Err(error) = reply.wait() {
            tracing::debug!(%error, key = %value.key, "the answer to a query could not be sent");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attachments_come_back() {
        let bytes = attachment(7);
        assert!(read_attachment(&bytes).is_some_and(|(sequence, at_ns)| sequence == 7 && at_ns > 1 << 60));
        assert_eq!(read_attachment(&bytes[..15]), None);
        assert_eq!(read_attachment(&[]), None);
    }
}
