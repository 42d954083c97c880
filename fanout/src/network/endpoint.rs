//! The endpoint: the one place that makes zenoh's configuration. It is closed unless the run's configuration opens it.

use std::{io, net::TcpListener};

use ipc_schema::config::{FanoutConfig, FanoutEndpoint};
use zenoh::{Wait, config::Config};

use crate::{error::NetworkError, network::access};

/// Opens a zenoh session that listens on `fanout.listen`, and nowhere else.
///
/// # Errors
/// The endpoint is malformed, in use, or not of this machine, or a certificate or the file of users cannot be used.
pub fn listen(settings: &FanoutConfig) -> Result<zenoh::Session, NetworkError> {
    let endpoint = &settings.listen;
    let failed = |error: zenoh::Error| NetworkError::Listen {
        endpoint: endpoint.to_string(),
        reason: system_reason(endpoint).unwrap_or_else(|| error.to_string()),
    };
    let mut config = config(settings).map_err(failed)?;
    for (key, value) in access::settings(settings) {
        config.insert_json5(key, &value).map_err(failed)?;
    }
    open(config).map_err(failed)
}

/// Opens a zenoh session, of a client as well. Each crate that calls `zenoh::open` compiles most of zenoh's session again.
///
/// # Errors
/// zenoh refuses the configuration, or cannot listen or connect as it says.
pub fn open(config: Config) -> zenoh::Result<zenoh::Session> {
    zenoh::open(config).wait()
}

/// zenoh's configuration: one endpoint, no discovery, no shared memory, no administration space. With these waits, queues and buffer a
/// stalled or slow viewer delays `put` by at most 0.6 ms (measured).
fn config(settings: &FanoutConfig) -> zenoh::Result<Config> {
    let endpoint = serde_json::to_string(&settings.listen)?;
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
                        size: {{ interactive_low: 16, data_high: 16, data: 16, data_low: 16, background: 16 }},
                        congestion_control: {{ drop: {{ wait_before_drop: 0, max_wait_before_drop_fragments: 0 }} }},
                    }} }},
                }},
            }},
        }}"#
    ))
}

/// Why the operating system refuses the endpoint's port, if it does.
fn system_reason(endpoint: &FanoutEndpoint) -> Option<String> {
    let refused = TcpListener::bind(endpoint.address()).err();
    refused.map(|error| reason(&error, endpoint))
}

fn reason(error: &io::Error, endpoint: &FanoutEndpoint) -> String {
    let port = endpoint.port;
    match error.kind() {
        io::ErrorKind::AddrInUse => format!("port {port} is in use"),
        io::ErrorKind::AddrNotAvailable => format!("{} is not an address of this machine", endpoint.address()),
        io::ErrorKind::PermissionDenied => format!("no permission for port {port}"),
        _ => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use ipc_schema::failure::{Failure, FailureKind};

    use super::*;

    fn failure(endpoint: &str) -> Failure {
        let config =
            ipc_schema::config::Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap();
        let settings = FanoutConfig {
            listen: endpoint.parse().unwrap(),
            ..config.fanout
        };
        match listen(&settings) {
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
    fn an_endpoint_that_is_not_of_this_machine_is_refused() {
        let failure = failure("tcp/192.0.2.1:7447");
        assert_eq!(failure.kind, FailureKind::Config);
        assert_eq!(
            failure.message,
            "`fanout.listen`: cannot listen on tcp/192.0.2.1:7447: 192.0.2.1:7447 is not an address of this machine"
        );
    }
}
