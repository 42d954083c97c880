//! The zenoh side: a closed session that listens where it was told, publishers that drop rather than wait, and the
//! newest value of every key for those who ask.

use std::{
    collections::BTreeMap,
    io,
    net::TcpListener,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use ipc_schema::failure::{Failure, FailureKind};
use zenoh::{
    Wait,
    bytes::{Encoding, ZBytes},
    config::Config,
    key_expr::KeyExpr,
    liveliness::LivelinessToken,
    pubsub::Publisher,
    qos::{CongestionControl, Priority},
    query::{Query, Queryable},
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
}

impl From<OutletError> for Failure {
    fn from(error: OutletError) -> Self {
        match error {
            OutletError::Listen { .. } => Self::from_error(FailureKind::Config, &error).with_help(
                "another run may be using the port: give this one a free port with `--set fanout.listen=tcp/127.0.0.1:PORT`, \
                 or do without viewers with `--set fanout.enabled=false`",
            ),
            OutletError::Refused { .. } => Self::from_error(FailureKind::Run, &error),
        }
    }
}

/// Time for the last frames to leave: at most 1 MB for each viewer.
const FAREWELL: Duration = Duration::from_millis(300);

type Latest = Arc<Mutex<BTreeMap<Topic, ZBytes>>>;

/// Everything a run shows to viewers.
pub struct Outlet {
    session: zenoh::Session,
    publishers: BTreeMap<Topic, Publisher<'static>>,
    latest: Latest,
    // Held: dropping them withdraws them.
    _queryable: Queryable<()>,
    _token: LivelinessToken,
}

impl Outlet {
    /// Listens on `endpoint` and declares all keys; `map` is the JSON that answers for [`Topic::Map`].
    ///
    /// # Errors
    /// The endpoint is malformed, taken, or not of this machine.
    pub fn open(endpoint: &str, keys: &Keys, map: &str) -> Result<Self, OutletError> {
        let session = listen(endpoint)?;
        let latest: Latest = Arc::default();
        store(&latest, Topic::Map, ZBytes::from(map));
        let publishers = Topic::ALL
            .into_iter()
            .filter(|topic| *topic != Topic::Map)
            .map(|topic| Ok((topic, publisher(&session, topic, keys)?)))
            .collect::<Result<_, OutletError>>()?;
        let queryable = session
            .declare_queryable(keys.all())
            .callback(answers(&latest, keys)?)
            .wait()
            .map_err(refused("declaration", keys.all()))?;
        let token = session
            .liveliness()
            .declare_token(keys.alive())
            .wait()
            .map_err(refused("declaration", keys.alive()))?;
        Ok(Self {
            session,
            publishers,
            latest,
            _queryable: queryable,
            _token: token,
        })
    }

    /// Publishes; never waits for a viewer.
    ///
    /// # Errors
    /// The session is closed.
    pub fn publish(&self, topic: Topic, bytes: Vec<u8>) -> Result<(), OutletError> {
        let value = ZBytes::from(bytes);
        store(&self.latest, topic, value.clone());
        match self.publishers.get(&topic) {
            Some(publisher) => publisher
                .put(value)
                .wait()
                .map_err(refused("publication", topic.name().to_owned())),
            None => Ok(()),
        }
    }

    /// Lets viewers, if there are any, have what is queued, and takes leave of them. zenoh does not tell when its queues are
    /// empty and drops them when it closes, so the last frames get [`FAREWELL`].
    pub fn close(self) {
        let watched = self
            .publishers
            .values()
            .any(|publisher| publisher.matching_status().wait().is_ok_and(|m| m.matching()));
        if watched {
            std::thread::park_timeout(FAREWELL);
        }
        if let Err(error) = self.session.close().wait() {
            tracing::warn!(%error, "zenoh did not close in order");
        }
    }
}

fn refused(action: &'static str, key: String) -> impl FnOnce(zenoh::Error) -> OutletError {
    move |reason| OutletError::Refused {
        action,
        key,
        reason: reason.to_string(),
    }
}

fn store(latest: &Latest, topic: Topic, value: ZBytes) {
    latest
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .insert(topic, value);
}

/// Frames have priorities of their own, so each has a queue of its own; the short ones overtake the long ones.
fn publisher(session: &zenoh::Session, topic: Topic, keys: &Keys) -> Result<Publisher<'static>, OutletError> {
    let priority = match topic {
        Topic::Status | Topic::Map => Priority::DataHigh,
        Topic::World => Priority::Data,
        Topic::Prediction => Priority::DataLow,
        Topic::Observation => Priority::Background,
    };
    session
        .declare_publisher(keys.topic(topic))
        .encoding(encoding(topic))
        .congestion_control(CongestionControl::Drop)
        .priority(priority)
        .wait()
        .map_err(refused("declaration", keys.topic(topic)))
}

fn encoding(topic: Topic) -> Encoding {
    match topic {
        Topic::Status | Topic::Map => Encoding::APPLICATION_JSON,
        _ => Encoding::APPLICATION_OCTET_STREAM,
    }
}

fn answers(latest: &Latest, keys: &Keys) -> Result<impl Fn(Query) + Send + Sync + 'static, OutletError> {
    let latest = Arc::clone(latest);
    let topics = Topic::ALL
        .into_iter()
        .map(|topic| Ok((topic, key_expr(keys.topic(topic))?)))
        .collect::<Result<Vec<_>, OutletError>>()?;
    Ok(move |query: Query| {
        for (topic, key) in topics.iter().filter(|(_, key)| query.key_expr().intersects(key)) {
            let value = latest
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .get(topic)
                .cloned();
            let Some(value) = value else { continue };
            if let Err(error) = query.reply(key, value).encoding(encoding(*topic)).wait() {
                tracing::debug!(%error, %key, "a query was not answered");
            }
        }
    })
}

fn key_expr(key: String) -> Result<KeyExpr<'static>, OutletError> {
    KeyExpr::new(key.clone()).map_err(refused("declaration", key))
}

fn listen(endpoint: &str) -> Result<zenoh::Session, OutletError> {
    let failed = |error: zenoh::Error| OutletError::Listen {
        endpoint: endpoint.to_owned(),
        reason: plain_reason(endpoint).unwrap_or_else(|| error.to_string()),
    };
    let config = config(endpoint).map_err(failed)?;
    zenoh::open(config).wait().map_err(failed)
}

/// Closed by default: one endpoint, no discovery, no shared memory, no administration. A viewer that stalls or is slow
/// costs `put` nothing: measured with these waits, queues and buffer, at most 0.6 ms.
fn config(endpoint: &str) -> zenoh::Result<Config> {
    let endpoint = serde_json::to_string(endpoint)?;
    Config::from_json5(&format!(
        r#"{{
            mode: "router",
            listen: {{ endpoints: [{endpoint}], timeout_ms: 0, exit_on_failure: true }},
            connect: {{ endpoints: [] }},
            scouting: {{ delay: 0, multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }},
            adminspace: {{ enabled: false }},
            transport: {{
                shared_memory: {{ enabled: false }},
                link: {{
                    tcp: {{ so_sndbuf: 65536 }},
                    tx: {{ queue: {{
                        size: {{ data_high: 16, data: 16, data_low: 16, background: 16 }},
                        congestion_control: {{ drop: {{ wait_before_drop: 0, max_wait_before_drop_fragments: 0 }} }},
                    }} }},
                }},
            }},
        }}"#
    ))
}

/// Why the operating system does not give out the endpoint's port, if that is the trouble.
fn plain_reason(endpoint: &str) -> Option<String> {
    let address = endpoint
        .strip_prefix("tcp/")
        .map(|a| a.split(['?', '#']).next().unwrap_or(a));
    let Some(address) = address else {
        return Some("this program speaks tcp only: `tcp/HOST:PORT`".to_owned());
    };
    TcpListener::bind(address).err().map(|error| reason(&error, address))
}

fn reason(error: &io::Error, address: &str) -> String {
    let port = address.rsplit(':').next().unwrap_or(address);
    match error.kind() {
        io::ErrorKind::AddrInUse => format!("port {port} is in use"),
        io::ErrorKind::AddrNotAvailable => format!("{address} is not an address of this machine"),
        io::ErrorKind::PermissionDenied => format!("no permission for port {port}"),
        _ => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn failure(endpoint: &str) -> Failure {
        match Outlet::open(endpoint, &Keys::new("t", 0), "{}") {
            Ok(_) => panic!("{endpoint} was accepted"),
            Err(error) => error.into(),
        }
    }

    #[test]
    fn a_port_in_use_is_named() {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = taken.local_addr().unwrap().port();
        let failure = failure(&format!("tcp/127.0.0.1:{port}"));
        assert_eq!(failure.kind, FailureKind::Config);
        assert_eq!(
            failure.message,
            format!("`fanout.listen`: cannot listen on tcp/127.0.0.1:{port}: port {port} is in use")
        );
        assert!(failure.help.is_some());
    }

    #[test]
    fn what_is_no_endpoint_of_this_machine_is_refused() {
        for endpoint in [
            "",
            "7447",
            "udp/127.0.0.1:7447",
            "tcp/127.0.0.1",
            "tcp/192.0.2.1:7447",
            "tcp/127.0.0.1:99999",
        ] {
            let failure = failure(endpoint);
            assert_eq!(failure.kind, FailureKind::Config);
            assert!(
                failure.message.starts_with("`fanout.listen`: cannot listen on"),
                "{}",
                failure.message
            );
        }
    }
}
