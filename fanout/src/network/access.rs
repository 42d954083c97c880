//! Access control: the part of zenoh's configuration that follows from `fanout.*`, and a count of refused connections.
//!
//! Access control is always on and denies by default. Every client that may connect may subscribe to [`READ`] and query it; only
//! `fanout.commanders` may query [`COMMAND`]; no client may write.

use std::{
    cell::RefCell,
    path::Path,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use ipc_schema::config::{Commander, EndpointProtocol, FanoutConfig};
use serde_json::{Value, json};
use tracing::{Event, Subscriber, field::Visit};
use tracing_subscriber::layer::{Context, Layer};

/// What every connected client may read.
pub const READ: &str = "caraware/**";
/// What commanders may query.
pub const COMMAND: &str = "caraware-control/**";

/// Time within which a client must identify itself, milliseconds. With a longer one, idle connections keep other clients out.
const ACCEPT_TIMEOUT_MS: u32 = 3000;

/// Settings for zenoh, as key and JSON, in the order in which to insert them.
#[must_use]
pub fn settings(fanout: &FanoutConfig) -> Vec<(&'static str, String)> {
    let mut settings = vec![
        ("transport/unicast/accept_timeout", json!(ACCEPT_TIMEOUT_MS)),
        ("access_control", access_control(&fanout.commanders)),
    ];
    if let Some(users) = &fanout.users {
        settings.push((
            "transport/auth/usrpwd/dictionary_file",
            json!(users.display().to_string()),
        ));
    }
    if fanout.listen.protocol == EndpointProtocol::Tls {
        settings.push(("transport/link/tls", tls_settings(fanout)));
    }
    settings
        .into_iter()
        .map(|(key, value)| (key, value.to_string()))
        .collect()
}

fn tls_settings(fanout: &FanoutConfig) -> Value {
    let text = |path: &Path| json!(path.display().to_string());
    let mut tls = json!({
        "listen_certificate": fanout.tls_certificate.as_deref().map(text),
        "listen_private_key": fanout.tls_private_key.as_deref().map(text),
        "so_sndbuf": 65536,
    });
    if let Some(authority) = &fanout.tls_client_ca {
        tls["root_ca_certificate"] = text(authority);
        tls["enable_mtls"] = json!(true);
    }
    tls
}

fn access_control(commanders: &[Commander]) -> Value {
    let client_to_run = [
        "query",
        "declare_subscriber",
        "liveliness_query",
        "declare_liveliness_subscriber",
    ];
    let run_to_client = ["put", "delete", "reply", "declare_queryable", "liveliness_token"];
    let mut subjects = vec![json!({ "id": "every-client" })];
    let mut policies = vec![json!({ "rules": ["ask-for-data", "send-data"], "subjects": ["every-client"] })];
    let command_rules = ["send-commands", "answer-commands"];
    let names = commanders.iter().filter_map(|commander| match commander {
        Commander::Named(name) => Some(name.as_str()),
        Commander::EveryClient => None,
    });
    let names: Vec<&str> = names.collect();
    if commanders.contains(&Commander::EveryClient) {
        policies.push(json!({ "rules": command_rules, "subjects": ["every-client"] }));
    } else if !names.is_empty() {
        subjects.push(json!({ "id": "users", "usernames": names }));
        subjects.push(json!({ "id": "certificates", "cert_common_names": names }));
        policies.push(json!({ "rules": command_rules, "subjects": ["users", "certificates"] }));
    }
    let allow = |id: &str, flow: &str, messages: &[&str], key: &str| json!({ "id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key] });
    json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": [
            allow("ask-for-data", "ingress", &client_to_run, READ),
            allow("send-data", "egress", &run_to_client, READ),
            allow("send-commands", "ingress", &["query"], COMMAND),
            allow("answer-commands", "egress", &["reply", "declare_queryable"], COMMAND),
        ],
        "subjects": subjects,
        "policies": policies,
    })
}

/// Refused connections that are not logged yet, and the reason of the newest.
#[derive(Debug, Default)]
struct UnloggedRefusals {
    count: u64,
    newest: String,
}

static UNLOGGED: Mutex<UnloggedRefusals> = Mutex::new(UnloggedRefusals {
    count: 0,
    newest: String::new(),
});
/// Refused connections that are logged.
static LOGGED: AtomicU64 = AtomicU64::new(0);

/// Counts a refused connection.
pub fn count_refusal(reason: String) {
    let mut refused = UNLOGGED.lock().unwrap_or_else(PoisonError::into_inner);
    refused.count += 1;
    refused.newest = reason;
}

/// Logs the connections refused since the last call; returns the number of all refused connections.
pub fn log_refusals() -> u64 {
    let refused = std::mem::take(&mut *UNLOGGED.lock().unwrap_or_else(PoisonError::into_inner));
    match refused.count {
        0 => {}
        1 => tracing::warn!("refused a connection: {}", refused.newest),
        count => tracing::warn!("refused {count} connections, the last: {}", refused.newest),
    }
    LOGGED.fetch_add(refused.count, Ordering::Relaxed) + refused.count
}

/// Samples that access control kept from being written.
static FORGED: AtomicU64 = AtomicU64::new(0);

/// Samples that clients tried to put on keys of a run; access control dropped them.
pub fn forged_samples() -> u64 {
    FORGED.load(Ordering::Relaxed)
}

/// The module of zenoh that logs each check of access control, at level trace, and the texts that it logs for denied writing.
const ACCESS_CONTROL_LOG: &str = "zenoh::net::routing::interceptor::access_control";
const DENIED: [&str; 2] = ["unauthorized to Put (ingress)", "unauthorized to Delete (ingress)"];
/// When a client declares a key, zenoh checks all that the client might do there, in this order and without a pause. None of that is a
/// sample.
const CHECKS_OF_A_KEY: [&str; 4] = [
    "Query (ingress)",
    "Reply (ingress)",
    "Put (ingress)",
    "Delete (ingress)",
];

thread_local! {
    static ACCESS_LOG: RefCell<AccessLog> = RefCell::default();
}

/// Tells samples that access control drops from its checks of declared keys, line by line of one thread's log.
#[derive(Debug, Default)]
struct AccessLog {
    /// Place among [`CHECKS_OF_A_KEY`] and key of the line before, if all lines from the first check on were of one declared key.
    last: Option<(usize, String)>,
}

impl AccessLog {
    /// True if a line is about a sample that was dropped.
    fn is_dropped_sample(&mut self, line: &str) -> bool {
        let check = CHECKS_OF_A_KEY.iter().position(|check| line.contains(check));
        let key = line.rsplit_once(" on ").map_or("", |(_, key)| key);
        // A key that is known is not checked again: the line is about a message.
        let is_known = line.starts_with("Using cached result");
        // Every subject of a client has a line of its own.
        let continues = match (check, &self.last) {
            (Some(check), Some((last, last_key))) => (*last..=last + 1).contains(&check) && last_key == key,
            _ => false,
        };
        self.last = match check {
            Some(check) if !is_known && (check == 0 || continues) => Some((check, key.to_owned())),
            _ => None,
        };
        self.last.is_none() && DENIED.iter().any(|denied| line.contains(denied))
    }
}

/// Modules of zenoh that log why a connection was refused, at level debug, and how that text begins.
const REFUSAL_LOGS: [(&str, &str); 3] = [
    ("zenoh_transport::unicast::establishment::accept", ""),
    ("zenoh_transport::unicast::manager", "Failed to accept link"),
    ("zenoh_link_tls::unicast", "Can not accept TLS connection"),
];

/// Texts of the same modules about a client that was let in, or that only tried whether the port is open.
const HARMLESS: [&str; 3] = ["New transport link accepted", "early eof", "handshake eof"];

/// Counts refused connections from zenoh's log. zenoh refuses a peer by closing the connection, and reports that nowhere else.
#[derive(Debug, Clone, Copy)]
pub struct RefusalLayer;

/// The filter for [`RefusalLayer`]: the modules and levels of zenoh that it reads.
pub const REFUSAL_FILTER: &str = "off,zenoh_transport::unicast::establishment::accept=debug,zenoh_transport::unicast::manager=debug,zenoh_link_tls::unicast=debug,\
zenoh::net::routing::interceptor::access_control=trace";

impl<S: Subscriber> Layer<S> for RefusalLayer {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let target = event.metadata().target();
        let mut message = MessageText::default();
        event.record(&mut message);
        let text = message.0;
        if target == ACCESS_CONTROL_LOG {
            if ACCESS_LOG.with_borrow_mut(|log| log.is_dropped_sample(&text)) {
                FORGED.fetch_add(1, Ordering::Relaxed);
            }
            return;
        }
        let is_refusal = REFUSAL_LOGS
            .iter()
            .any(|(module, begin)| *module == target && text.starts_with(begin))
            && !HARMLESS.iter().any(|harmless| text.contains(harmless));
        if is_refusal {
            count_refusal(plain_reason(&text));
        }
    }
}

/// zenoh's reason in plain words where it is about credentials, with its own text in parentheses.
fn plain_reason(text: &str) -> String {
    let known = [
        ("Invalid password", "wrong password"),
        ("Invalid user", "unknown user"),
        ("Expected extension", "no user and password given"),
        ("peer sent no certificates", "no client certificate given"),
        ("received corrupt message", "it does not speak TLS"),
        ("CertificateUnknown", "it does not trust our certificate"),
        ("UnknownCA", "it does not trust our certificate"),
        ("UnknownIssuer", "its certificate is of another authority"),
    ];
    let short: String = text.split(" at ").next().unwrap_or(text).chars().take(200).collect();
    match known.iter().find(|(theirs, _)| text.contains(theirs)) {
        Some((_, ours)) => format!("{ours} ({short})"),
        None => short,
    }
}

/// The message of a log event.
#[derive(Default)]
struct MessageText(String);

impl Visit for MessageText {
    fn record_debug(&mut self, field: &tracing::field::Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" {
            self.0 = format!("{value:?}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fanout(listen: &str, commanders: &[&str]) -> FanoutConfig {
        let mut config =
            ipc_schema::config::Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap();
        config.fanout.listen = listen.parse().unwrap();
        config.fanout.commanders = commanders.iter().map(|name| name.parse().unwrap()).collect();
        config.fanout
    }

    #[test]
    fn checks_of_a_declared_key_are_no_samples() {
        let denied =
            |line: &str, key: &str| format!("5c9 on default is unauthorized to {line} (ingress) on caraware/{key}");
        let allowed =
            |line: &str, key: &str| format!("5c9 on default is authorized to {line} (ingress) on caraware/{key}");
        let cached = |line: &str| format!("Using cached result: 5c9 is unauthorized to {line} (ingress) on caraware/a");
        let mut log = AccessLog::default();
        let mut dropped = |lines: &[String]| lines.iter().filter(|line| log.is_dropped_sample(line)).count();
        let declared = |key: &str| {
            let query = allowed("Query", key);
            [
                query,
                denied("Reply", key),
                denied("Put", key),
                denied("Delete", key),
                allowed("Declare Subscriber", key),
            ]
        };
        assert_eq!(dropped(&declared("a")), 0);
        assert_eq!(dropped(&[denied("Put", "a"), denied("Delete", "a")]), 2, "undeclared");
        assert_eq!(dropped(&[cached("Put"), cached("Delete")]), 2, "declared before");
        assert_eq!(dropped(&[declared("a"), declared("b")].concat()), 0);
        // A client of two subjects.
        assert_eq!(dropped(&declared("a").map(|line| [line.clone(), line]).concat()), 0);
        // A query, and a sample on another key.
        assert_eq!(dropped(&[allowed("Query", "a"), denied("Put", "b")]), 1);
        assert_eq!(
            dropped(&[allowed("Query", "a"), denied("Put", "a")]),
            1,
            "no check skips the reply"
        );
    }

    #[test]
    fn zenoh_takes_every_setting() {
        let mut tls = fanout("tls/127.0.0.1:7447", &["alice"]);
        (tls.tls_certificate, tls.tls_private_key) = (Some("c.pem".into()), Some("k.pem".into()));
        (tls.tls_client_ca, tls.users) = (Some("ca.pem".into()), Some("users.txt".into()));
        for fanout in [
            fanout("tcp/127.0.0.1:7447", &[]),
            fanout("tcp/127.0.0.1:7447", &["*"]),
            tls,
        ] {
            let mut config = zenoh::Config::default();
            for (key, value) in settings(&fanout) {
                config
                    .insert_json5(key, &value)
                    .unwrap_or_else(|error| panic!("{key}: {error}"));
            }
        }
    }

    #[test]
    fn no_client_may_write_and_only_commanders_may_command() {
        let rules = |commanders: &[&str]| access_control(&fanout("tcp/127.0.0.1:1", commanders).commanders);
        for commanders in [&[][..], &["alice"], &["*"]] {
            let control = rules(commanders);
            assert_eq!(control["default_permission"], "deny");
            for rule in control["rules"].as_array().unwrap() {
                if rule["flows"][0] == "ingress" {
                    let messages = rule["messages"].as_array().unwrap();
                    assert!(
                        messages.iter().all(|m| m != "put" && m != "delete" && m != "reply"),
                        "{rule}"
                    );
                }
            }
        }
        let granted = |control: &Value| {
            let policies = control["policies"].as_array().unwrap();
            policies
                .iter()
                .find(|policy| policy["rules"][0] == "send-commands")
                .map(|policy| policy["subjects"].clone())
        };
        assert_eq!(granted(&rules(&[])), None);
        assert_eq!(granted(&rules(&["alice"])), Some(json!(["users", "certificates"])));
        assert_eq!(granted(&rules(&["*"])), Some(json!(["every-client"])));
    }
}
