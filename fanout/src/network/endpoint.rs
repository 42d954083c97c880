//! The endpoint: the one place that makes zenoh's configuration. It is closed unless the run's configuration opens it.

use std::{io, net::TcpListener, path::Path};

use ipc_schema::{
    config::{EndpointProtocol, FanoutConfig, FanoutEndpoint},
    run::RunFile,
};
use zenoh::{Wait, config::Config};

use crate::{
    error::NetworkError,
    network::{
        access,
        loopback::LoopbackGate,
        publisher::{self, EnvironmentPublisher},
    },
};

/// The socket file on which zenoh listens behind a [`LoopbackGate`], in a directory that only its user can enter.
const SOCKET: &str = "viewers";

/// The zenoh session of a run, and what stands before it.
#[derive(Debug)]
pub struct Endpoint {
    /// The session that publishes, and answers queries.
    pub session: zenoh::Session,
    /// Of an endpoint without passwords and certificates.
    gate: Option<LoopbackGate>,
}

impl Endpoint {
    /// Listens on `fanout.listen`, and nowhere else.
    ///
    /// # Errors
    /// The endpoint is malformed, in use, or not of this machine, or a certificate or the file of users cannot be used.
    pub fn open(run: &RunFile) -> Result<Self, NetworkError> {
        let settings = &run.config.fanout;
        if !authenticates(settings) {
            return Self::open_behind_gate(settings, &run.shared_memory.root.join(SOCKET));
        }
        let endpoint = &settings.listen;
        let session = listen(settings, &endpoint.to_string())
            .map_err(|error| refused(endpoint, system_reason(endpoint).unwrap_or_else(|| error.to_string())))?;
        Ok(Self { session, gate: None })
    }

    fn open_behind_gate(settings: &FanoutConfig, socket: &Path) -> Result<Self, NetworkError> {
        let endpoint = &settings.listen;
        let failed = |error: io::Error| refused(endpoint, reason(&error, endpoint));
        let listener = TcpListener::bind(endpoint.address()).map_err(failed)?;
        let session = listen(settings, &format!("unixsock-stream/{}", socket.display()))
            .map_err(|error| refused(endpoint, error.to_string()))?;
        let gate = LoopbackGate::open(listener, socket).map_err(failed)?;
        Ok(Self {
            session,
            gate: Some(gate),
        })
    }

    /// Closes the session after what is queued for viewers has been sent.
    pub fn close(self, publishers: Vec<EnvironmentPublisher>) {
        publisher::close(publishers, &self.session);
        if let Some(gate) = self.gate {
            gate.close(publisher::CLOSE_DELAY);
        }
    }
}

/// True if zenoh itself listens on `fanout.listen`: it asks who a client is, or encrypts, which the supervisor does not allow without.
fn authenticates(settings: &FanoutConfig) -> bool {
    settings.users.is_some() || settings.tls_client_ca.is_some() || settings.listen.protocol == EndpointProtocol::Tls
}

fn refused(endpoint: &FanoutEndpoint, reason: String) -> NetworkError {
    NetworkError::Listen {
        endpoint: endpoint.to_string(),
        reason,
    }
}

/// Opens a zenoh session that listens on `locator`.
fn listen(settings: &FanoutConfig, locator: &str) -> zenoh::Result<zenoh::Session> {
    let mut config = config(locator)?;
    for (key, value) in access::settings(settings) {
        config.insert_json5(key, &value)?;
    }
    open(config)
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
fn config(locator: &str) -> zenoh::Result<Config> {
    let endpoint = serde_json::to_string(locator)?;
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
        let dir = tempfile::tempdir().unwrap();
        match Endpoint::open_behind_gate(&settings, &dir.path().join(SOCKET)) {
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
