//! What zenoh shows: publishers that drop rather than wait, and the newest value of every key for those who ask.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use ipc_schema::failure::{Failure, FailureKind};
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

use crate::keys::{Keys, Topic};

/// The zenoh side failed.
#[derive(Debug, thiserror::Error)]
pub enum OutletError {
    /// `fanout.listen` cannot be listened on.
    #[error("`fanout.listen`: cannot listen on {endpoint}: {reason}")]
    Listen {
        /// The endpoint.
        endpoint: String,
        /// The operating system's or zenoh's reason.
        reason: String,
    },
    /// zenoh refused.
    #[error("zenoh: {action} of {key} failed: {reason}")]
    Refused {
        /// "declaration", "publication", …
        action: &'static str,
        /// The key.
        key: String,
        /// zenoh's reason.
        reason: String,
    },
    /// No thread for those who ask.
    #[error("cannot start the thread that answers queries: {0}")]
    Thread(std::io::Error),
}

impl From<OutletError> for Failure {
    fn from(error: OutletError) -> Self {
        match error {
            OutletError::Listen { .. } => Self::from_error(FailureKind::Config, &error).with_help(
                "another run may be using the port: give this one a free port with `--set fanout.listen=tcp/127.0.0.1:PORT`, \
                 or do without viewers with `--set fanout.enabled=false`",
            ),
            OutletError::Refused { .. } | OutletError::Thread(_) => Self::from_error(FailureKind::Run, &error),
        }
    }
}

/// Time for the last frames to leave: at most 1 MB for each viewer.
const FAREWELL: Duration = Duration::from_millis(300);
/// Questions that wait for an answer; whoever asks more is not answered. A viewer that stalls while it is answered holds up the
/// others' answers, by at most zenoh's 5 s, and nobody's frames.
const QUESTIONS: usize = 256;

/// A key with the newest value that it had.
#[derive(Clone)]
struct Value {
    key: KeyExpr<'static>,
    encoding: Encoding,
    payload: ZBytes,
    attachment: [u8; 16],
}

type Latest = Arc<Mutex<BTreeMap<String, Value>>>;

/// A key being published.
pub struct Line {
    publisher: Publisher<'static>,
    key: String,
    encoding: Encoding,
    sequence: u64,
}

impl Line {
    /// True while somebody subscribes.
    #[must_use]
    pub fn is_watched(&self) -> bool {
        self.publisher
            .matching_status()
            .wait()
            .is_ok_and(|status| status.matching())
    }
}

/// Everything that one environment of a run shows to viewers.
pub struct Outlet {
    session: zenoh::Session,
    keys: Keys,
    lines: BTreeMap<Topic, Line>,
    latest: Latest,
    foreign: Arc<AtomicU64>,
    // Held: dropping them withdraws them.
    _queryable: Queryable<()>,
    _guard: Subscriber<()>,
    token: Option<LivelinessToken>,
}

impl Outlet {
    /// Declares all keys; `map` is the JSON that answers for [`Topic::Map`].
    ///
    /// # Errors
    /// zenoh or the system refuses.
    pub fn open(session: zenoh::Session, keys: &Keys, map: &str) -> Result<Self, OutletError> {
        let latest: Latest = Arc::default();
        let (sender, questions) = sync_channel(QUESTIONS);
        answer_on_a_thread(&latest, questions)?;
        let queryable = session
            .declare_queryable(keys.all())
            .callback(take_question(sender))
            .wait()
            .map_err(refused("declaration", keys.all()))?;
        let foreign = Arc::new(AtomicU64::new(0));
        let outlet = Self {
            _guard: guard(&session, keys, &foreign)?,
            _queryable: queryable,
            keys: keys.clone(),
            lines: BTreeMap::new(),
            latest,
            foreign,
            session,
            token: None,
        };
        let value = outlet.value(&keys.topic(Topic::Map), &Encoding::APPLICATION_JSON, map, 0)?;
        outlet.store(value);
        outlet.declare_lines()
    }

    fn declare_lines(mut self) -> Result<Self, OutletError> {
        for topic in Topic::ALL.into_iter().filter(|topic| *topic != Topic::Map) {
            let line = self.line(&self.keys.topic(topic), encoding(topic), priority(topic))?;
            self.lines.insert(topic, line);
        }
        Ok(self)
    }

    /// A key of its own for one vehicle's scans.
    ///
    /// # Errors
    /// zenoh refuses.
    pub fn scan_line(&self, id: &str) -> Result<Line, OutletError> {
        self.line(
            &self.keys.scan(id),
            Encoding::APPLICATION_OCTET_STREAM,
            Priority::Background,
        )
    }

    fn line(&self, key: &str, encoding: Encoding, priority: Priority) -> Result<Line, OutletError> {
        let publisher = self
            .session
            .declare_publisher(key.to_owned())
            .encoding(encoding.clone())
            .congestion_control(CongestionControl::Drop)
            .priority(priority)
            .allowed_destination(Locality::Remote)
            .wait()
            .map_err(refused("declaration", key.to_owned()))?;
        Ok(Line {
            publisher,
            key: key.to_owned(),
            encoding,
            sequence: 0,
        })
    }

    /// Says that the run is here.
    ///
    /// # Errors
    /// zenoh refuses.
    pub fn announce(&mut self) -> Result<(), OutletError> {
        let token = self.session.liveliness().declare_token(self.keys.alive()).wait();
        self.token = Some(token.map_err(refused("declaration", self.keys.alive()))?);
        Ok(())
    }

    /// Publishes, and answers with it from now on; never waits for a viewer.
    ///
    /// # Errors
    /// The session is closed.
    pub fn publish(&mut self, topic: Topic, bytes: Vec<u8>) -> Result<(), OutletError> {
        let value = ZBytes::from(bytes);
        self.publish_part(topic, value.clone(), Some(value))
    }

    /// Publishes `part`, and answers with `whole` from now on, if that is given.
    ///
    /// # Errors
    /// As [`Outlet::publish`].
    pub fn publish_part(&mut self, topic: Topic, part: ZBytes, whole: Option<ZBytes>) -> Result<(), OutletError> {
        let Some(mut line) = self.lines.remove(&topic) else {
            return Ok(());
        };
        let result = self.publish_on(&mut line, part, whole);
        self.lines.insert(topic, line);
        result
    }

    /// The same on any line.
    ///
    /// # Errors
    /// As [`Outlet::publish`].
    pub fn publish_on(&self, line: &mut Line, part: ZBytes, whole: Option<ZBytes>) -> Result<(), OutletError> {
        let attachment = attachment(line.sequence);
        line.sequence += 1;
        if let Some(whole) = whole {
            let value = self.value(&line.key, &line.encoding, whole, line.sequence - 1)?;
            self.store(value);
        }
        line.publisher
            .put(part)
            .attachment(attachment.as_slice())
            .wait()
            .map_err(refused("publication", line.key.clone()))
    }

    /// Nobody is to be answered for this line any more.
    pub fn forget(&self, line: &Line) {
        self.locked().remove(&line.key);
    }

    /// Samples that others have put on this run's keys.
    #[must_use]
    pub fn foreign_samples(&self) -> u64 {
        self.foreign.load(Ordering::Relaxed)
    }

    fn value(
        &self,
        key: &str,
        encoding: &Encoding,
        payload: impl Into<ZBytes>,
        sequence: u64,
    ) -> Result<Value, OutletError> {
        Ok(Value {
            key: KeyExpr::new(key.to_owned()).map_err(refused("declaration", key.to_owned()))?,
            encoding: encoding.clone(),
            payload: payload.into(),
            attachment: attachment(sequence),
        })
    }

    fn store(&self, value: Value) {
        self.locked().insert(value.key.to_string(), value);
    }

    fn locked(&self) -> std::sync::MutexGuard<'_, BTreeMap<String, Value>> {
        self.latest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_watched(&self) -> bool {
        self.lines.values().any(Line::is_watched)
    }
}

/// Lets viewers, if there are any, have what is queued, and takes leave of them. zenoh does not tell when its queues are
/// empty and drops them when it closes, so the last frames get [`FAREWELL`].
pub fn close(mut outlets: Vec<Outlet>, session: &zenoh::Session) {
    if outlets.iter().any(Outlet::is_watched) {
        std::thread::park_timeout(FAREWELL);
    }
    for outlet in &mut outlets {
        drop(outlet.token.take());
    }
    if let Err(error) = session.close().wait() {
        tracing::warn!(%error, "zenoh did not close in order");
    }
}

fn refused(action: &'static str, key: String) -> impl FnOnce(zenoh::Error) -> OutletError {
    move |reason| OutletError::Refused {
        action,
        key,
        reason: reason.to_string(),
    }
}

/// Sequence number and time of taking, little endian.
#[expect(
    clippy::disallowed_methods,
    reason = "a label for viewers on other machines; nothing follows from it"
)]
fn attachment(sequence: u64) -> [u8; 16] {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let now_ns = u64::try_from(now.as_nanos()).unwrap_or(u64::MAX);
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&sequence.to_le_bytes());
    bytes[8..].copy_from_slice(&now_ns.to_le_bytes());
    bytes
}

/// Sequence number and UNIX time in nanoseconds of an attachment; `None` if it is none of ours.
#[must_use]
pub fn read_attachment(bytes: &[u8]) -> Option<(u64, u64)> {
    let (sequence, time) = bytes.split_at_checked(8)?;
    Some((
        u64::from_le_bytes(sequence.try_into().ok()?),
        u64::from_le_bytes(time.try_into().ok()?),
    ))
}

/// Each priority has queues of its own: the short and urgent overtake the long.
fn priority(topic: Topic) -> Priority {
    match topic {
        Topic::Map | Topic::Status | Topic::Signals | Topic::Event => Priority::InteractiveLow,
        Topic::Prediction => Priority::DataHigh,
        Topic::World => Priority::Data,
        Topic::Observation | Topic::Vehicles => Priority::DataLow,
    }
}

fn encoding(topic: Topic) -> Encoding {
    match topic {
        Topic::Status | Topic::Map => Encoding::APPLICATION_JSON,
        _ => Encoding::APPLICATION_OCTET_STREAM,
    }
}

/// Counts what others put on this run's keys. Nothing of it is looked at.
fn guard(session: &zenoh::Session, keys: &Keys, foreign: &Arc<AtomicU64>) -> Result<Subscriber<()>, OutletError> {
    let counter = Arc::clone(foreign);
    session
        .declare_subscriber(keys.all())
        .allowed_origin(Locality::Remote)
        .callback(move |_| {
            counter.fetch_add(1, Ordering::Relaxed);
        })
        .wait()
        .map_err(refused("declaration", keys.all()))
}

fn take_question(sender: SyncSender<Query>) -> impl Fn(Query) + Send + Sync + 'static {
    move |query| {
        if sender.try_send(query).is_err() {
            tracing::debug!("too many questions at once");
        }
    }
}

/// zenoh's own threads must not wait for a viewer that is slow to take its answer.
fn answer_on_a_thread(latest: &Latest, questions: Receiver<Query>) -> Result<(), OutletError> {
    let latest = Arc::clone(latest);
    std::thread::Builder::new()
        .name("answers".into())
        .spawn(move || questions.iter().for_each(|query| answer(&latest, &query)))
        .map(drop)
        .map_err(OutletError::Thread)
}

fn answer(latest: &Latest, query: &Query) {
    let values: Vec<Value> = latest
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
            tracing::debug!(%error, key = %value.key, "a query was not answered");
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
