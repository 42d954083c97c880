//! Who may connect, read and command: the part of zenoh's configuration that follows from `fanout.*`, and a count of those refused.
//!
//! Access control is always on and denies by default. Whoever may connect may read [`READ`] and ask it questions; only
//! `fanout.commanders` may query [`COMMAND`]; nobody may write.

use std::sync::{
    Mutex, PoisonError,
    atomic::{AtomicU64, Ordering},
};

use ipc_schema::config::Fanout;
use serde_json::{Value, json};
use tracing::{Event, Subscriber, field::Visit};
use tracing_subscriber::layer::{Context, Layer};

/// What everybody may read who may connect.
pub const READ: &str = "caraware/**";
/// What commanders may query.
pub const COMMAND: &str = "caraware-control/**";
/// In `fanout.commanders`: everybody who may connect.
pub const ANYBODY: &str = "*";

/// Whoever has connected says who he is within this time, milliseconds; longer, idle connections would keep others out.
const ACCEPT_TIMEOUT_MS: u32 = 3000;

/// zenoh's settings, key and JSON, in the order in which they are to be inserted.
#[must_use]
pub fn settings(fanout: &Fanout) -> Vec<(&'static str, String)> {
    let mut settings = vec![
        ("transport/unicast/accept_timeout", json!(ACCEPT_TIMEOUT_MS)),
        ("access_control", access_control(&fanout.commanders)),
    ];
    if !fanout.users.is_empty() {
        settings.push(("transport/auth/usrpwd/dictionary_file", json!(fanout.users)));
    }
    if is_encrypted(&fanout.listen) {
        settings.push(("transport/link/tls", tls_settings(fanout)));
    }
    settings
        .into_iter()
        .map(|(key, value)| (key, value.to_string()))
        .collect()
}

/// True if the endpoint is encrypted.
#[must_use]
pub fn is_encrypted(endpoint: &str) -> bool {
    endpoint.starts_with("tls/")
}

fn tls_settings(fanout: &Fanout) -> Value {
    let mut tls = json!({
        "listen_certificate": fanout.tls_certificate,
        "listen_private_key": fanout.tls_private_key,
        "so_sndbuf": 65536,
    });
    if !fanout.tls_client_ca.is_empty() {
        tls["root_ca_certificate"] = json!(fanout.tls_client_ca);
        tls["enable_mtls"] = json!(true);
    }
    tls
}

fn access_control(commanders: &[String]) -> Value {
    let asks = [
        "query",
        "declare_subscriber",
        "liveliness_query",
        "declare_liveliness_subscriber",
    ];
    let tells = ["put", "delete", "reply", "declare_queryable", "liveliness_token"];
    let mut subjects = vec![json!({ "id": "everybody" })];
    let mut policies = vec![json!({ "rules": ["asks", "tells"], "subjects": ["everybody"] })];
    if commanders.iter().any(|name| name == ANYBODY) {
        policies.push(json!({ "rules": ["commands", "answers"], "subjects": ["everybody"] }));
    } else if !commanders.is_empty() {
        subjects.push(json!({ "id": "users", "usernames": commanders }));
        subjects.push(json!({ "id": "certificates", "cert_common_names": commanders }));
        policies.push(json!({ "rules": ["commands", "answers"], "subjects": ["users", "certificates"] }));
    }
    let allow = |id: &str, flow: &str, messages: &[&str], key: &str| json!({ "id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key] });
    json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": [
            allow("asks", "ingress", &asks, READ),
            allow("tells", "egress", &tells, READ),
            allow("commands", "ingress", &["query"], COMMAND),
            allow("answers", "egress", &["reply", "declare_queryable"], COMMAND),
        ],
        "subjects": subjects,
        "policies": policies,
    })
}

/// Those refused since the last look, and the reason of the newest.
#[derive(Debug, Default)]
struct Refused {
    count: u64,
    newest: String,
}

static REFUSED: Mutex<Refused> = Mutex::new(Refused {
    count: 0,
    newest: String::new(),
});
/// Those told of.
static TOLD: AtomicU64 = AtomicU64::new(0);

/// Logs who has been refused since the last call, and returns how many have been at all.
pub fn tell_refusals() -> u64 {
    let refused = std::mem::take(&mut *REFUSED.lock().unwrap_or_else(PoisonError::into_inner));
    match refused.count {
        0 => {}
        1 => tracing::warn!("refused a connection: {}", refused.newest),
        count => tracing::warn!("refused {count} connections, the last: {}", refused.newest),
    }
    TOLD.fetch_add(refused.count, Ordering::Relaxed) + refused.count
}

/// Samples that were put where nobody may write.
static FORGED: AtomicU64 = AtomicU64::new(0);

/// Samples that others tried to put on keys of ours, and that went nowhere.
pub fn forged_samples() -> u64 {
    FORGED.load(Ordering::Relaxed)
}

/// Where zenoh says what it lets through and what not, in words like these, at level trace.
const GATE: &str = "zenoh::net::routing::interceptor::access_control";
const DENIED: [&str; 2] = ["unauthorized to Put (ingress)", "unauthorized to Delete (ingress)"];

/// Places in zenoh that say why a connection was refused, at level debug.
const WITNESSES: [(&str, &str); 3] = [
    ("zenoh_transport::unicast::establishment::accept", ""),
    ("zenoh_transport::unicast::manager", "Failed to accept link"),
    ("zenoh_link_tls::unicast", "Can not accept TLS connection"),
];

/// What they say of somebody who is let in, or who looked whether the port is open and left.
const HARMLESS: [&str; 3] = ["New transport link accepted", "early eof", "handshake eof"];

/// Hears from zenoh whom it refuses: it answers a peer that it does not let in by hanging up, and tells nobody else.
#[derive(Debug, Clone, Copy)]
pub struct RefusalLayer;

/// What zenoh must be heard of for [`RefusalLayer`].
pub const HEARD: &str = "off,zenoh_transport::unicast::establishment::accept=debug,zenoh_transport::unicast::manager=debug,zenoh_link_tls::unicast=debug,\
zenoh::net::routing::interceptor::access_control=trace";

impl<S: Subscriber> Layer<S> for RefusalLayer {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let target = event.metadata().target();
        let mut words = Words::default();
        event.record(&mut words);
        if target == GATE {
            if DENIED.iter().any(|denied| words.0.contains(denied)) {
                FORGED.fetch_add(1, Ordering::Relaxed);
            }
            return;
        }
        let told = WITNESSES
            .iter()
            .any(|(witness, begin)| *witness == target && words.0.starts_with(begin))
            && !HARMLESS.iter().any(|harmless| words.0.contains(harmless));
        if told {
            let mut refused = REFUSED.lock().unwrap_or_else(PoisonError::into_inner);
            refused.count += 1;
            refused.newest = plain(&words.0);
        }
    }
}

/// zenoh's words in ours where they are about credentials; its own are kept behind.
fn plain(words: &str) -> String {
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
    let short: String = words.split(" at ").next().unwrap_or(words).chars().take(200).collect();
    match known.iter().find(|(theirs, _)| words.contains(theirs)) {
        Some((_, ours)) => format!("{ours} ({short})"),
        None => short,
    }
}

#[derive(Default)]
struct Words(String);

impl Visit for Words {
    fn record_debug(&mut self, field: &tracing::field::Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" {
            self.0 = format!("{value:?}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fanout(listen: &str, commanders: &[&str]) -> Fanout {
        let mut config: ipc_schema::config::Config =
            serde_json::from_str(include_str!("../../ipc-schema/tests/town.json")).unwrap();
        config.fanout.listen = listen.into();
        config.fanout.commanders = commanders.iter().map(|&name| name.into()).collect();
        config.fanout
    }

    #[test]
    fn zenoh_takes_every_setting() {
        let mut tls = fanout("tls/127.0.0.1:7447", &["alice"]);
        (tls.tls_certificate, tls.tls_private_key) = ("c.pem".into(), "k.pem".into());
        (tls.tls_client_ca, tls.users) = ("ca.pem".into(), "users.txt".into());
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
    fn nobody_may_write_and_only_those_named_may_command() {
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
                .find(|policy| policy["rules"][0] == "commands")
                .map(|policy| policy["subjects"].clone())
        };
        assert_eq!(granted(&rules(&[])), None);
        assert_eq!(granted(&rules(&["alice"])), Some(json!(["users", "certificates"])));
        assert_eq!(granted(&rules(&["*"])), Some(json!(["everybody"])));
    }
}
