//! Shared memory → zenoh: the endpoint, its users and the rates of topics.

use std::{convert::Infallible, fmt, path::PathBuf, str::FromStr};

use serde::{Deserialize, Serialize};

use super::text::{optional_path, serde_as_text};

/// Shared memory → zenoh.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FanoutConfig {
    /// Start the fan-out process.
    pub enabled: bool,
    /// zenoh endpoint to listen on.
    pub listen: FanoutEndpoint,
    /// File of the users that may connect, a line `user:password` each; `None` = no client needs a password.
    #[serde(with = "optional_path")]
    pub users: Option<PathBuf>,
    /// Certificate of this machine, PEM, for an encrypted endpoint.
    #[serde(with = "optional_path")]
    pub tls_certificate: Option<PathBuf>,
    /// Its private key, PEM.
    #[serde(with = "optional_path")]
    pub tls_private_key: Option<PathBuf>,
    /// Certificate of the authority, PEM, that must have signed the clients' certificates; `None` = clients need none.
    #[serde(with = "optional_path")]
    pub tls_client_ca: Option<PathBuf>,
    /// Clients that may send commands.
    pub commanders: Vec<Commander>,
    /// Most frames of `world` per wall second.
    pub world_hz: f64,
    /// The same of `observation`.
    pub observation_hz: f64,
    /// The same of `prediction`.
    pub prediction_hz: f64,
    /// The same of `neighbours`.
    pub neighbours_hz: f64,
    /// The same of each LIDAR's `pointcloud`.
    pub pointcloud_hz: f64,
    /// The same of each camera's `image`.
    pub image_hz: f64,
    /// The same of each radar's `radar`.
    pub radar_hz: f64,
    /// The same of `event`.
    pub event_hz: f64,
    /// The same of `signals`.
    pub signals_hz: f64,
    /// The same of `vehicles`.
    pub vehicles_hz: f64,
    /// The same of `status`.
    pub status_hz: f64,
}

/// A zenoh endpoint. Configurations and run files write it as "tcp/HOST:PORT" or "tls/HOST:PORT".
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FanoutEndpoint {
    /// Protocol of the connection.
    pub protocol: EndpointProtocol,
    /// Name or address of this machine; an IPv6 address is in brackets.
    pub host: String,
    /// Port; 0 = one that is free.
    pub port: u16,
}

/// Protocol by which clients connect to an endpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndpointProtocol {
    /// Plain text.
    Tcp,
    /// Encrypted.
    Tls,
}

/// The text is not an endpoint.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is no endpoint")]
pub struct FanoutEndpointError(pub String);

impl FanoutEndpoint {
    /// "HOST:PORT".
    #[must_use]
    pub fn address(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    /// The endpoint that a client on this machine connects to: the loopback address replaces a wildcard, which cannot be connected to.
    #[must_use]
    pub fn on_this_machine(&self) -> Self {
        let host = match self.host.as_str() {
            "0.0.0.0" => "127.0.0.1",
            "[::]" => "[::1]",
            host => host,
        };
        Self {
            host: host.to_owned(),
            ..*self
        }
    }
}

serde_as_text!(FanoutEndpoint, Commander);

impl FromStr for FanoutEndpoint {
    type Err = FanoutEndpointError;

    fn from_str(text: &str) -> Result<Self, FanoutEndpointError> {
        let malformed = || FanoutEndpointError(text.to_owned());
        let (protocol, address) = text.split_once('/').ok_or_else(malformed)?;
        let protocol = match protocol {
            "tcp" => EndpointProtocol::Tcp,
            "tls" => EndpointProtocol::Tls,
            _ => return Err(malformed()),
        };
        let (host, port) = address.rsplit_once(':').ok_or_else(malformed)?;
        let is_bracketed = host.starts_with('[') && host.ends_with(']');
        if host.is_empty() || (host.contains(':') && !is_bracketed) {
            return Err(malformed());
        }
        Ok(Self {
            protocol,
            host: host.to_owned(),
            port: port.parse().map_err(|_| malformed())?,
        })
    }
}

impl fmt::Display for FanoutEndpoint {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let protocol = match self.protocol {
            EndpointProtocol::Tcp => "tcp",
            EndpointProtocol::Tls => "tls",
        };
        write!(formatter, "{protocol}/{}:{}", self.host, self.port)
    }
}

/// Clients that may send commands. Configurations and run files write "*" or the name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Commander {
    /// Every client that may connect.
    EveryClient,
    /// A user, or the clients whose certificate has this common name.
    Named(String),
}

impl FromStr for Commander {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(match text {
            "*" => Self::EveryClient,
            name => Self::Named(name.to_owned()),
        })
    }
}

impl fmt::Display for Commander {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::EveryClient => formatter.write_str("*"),
            Self::Named(name) => formatter.write_str(name),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_is_a_protocol_a_host_and_a_port() {
        for text in [
            "tcp/127.0.0.1:7447",
            "tls/watch.example.org:0",
            "tcp/[::1]:7448",
            "tcp/10.0.0.0:1",
        ] {
            let endpoint: FanoutEndpoint = text.parse().unwrap();
            assert_eq!(endpoint.to_string(), text);
            assert_eq!(endpoint.on_this_machine(), endpoint);
        }
        for text in [
            "",
            "7447",
            "127.0.0.1:7447",
            "udp/127.0.0.1:7447",
            "tcp/127.0.0.1",
            "tcp/:7447",
            "tcp/::1:7447",
            "tcp/127.0.0.1:99999",
            "tcp/127.0.0.1:7447?option",
        ] {
            assert_eq!(
                text.parse::<FanoutEndpoint>(),
                Err(FanoutEndpointError(text.to_owned()))
            );
        }
    }

    #[test]
    fn the_loopback_address_replaces_a_wildcard() {
        for (listen, call) in [
            ("tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447"),
            ("tls/[::]:1", "tls/[::1]:1"),
        ] {
            let listen: FanoutEndpoint = listen.parse().unwrap();
            assert_eq!(listen.on_this_machine().to_string(), call);
        }
    }
}
