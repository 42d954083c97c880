//! What ends the fan-out: an error of shared memory, of zenoh or of a document.

use ipc_schema::{
    failure::{Failure, FailureKind},
    membership::MembershipError,
    ports::PortError,
};

/// The fan-out cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum FanoutError {
    /// Shared memory.
    #[error(transparent)]
    SharedMemory(#[from] MembershipError),
    /// zenoh.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// A document has no form in JSON.
    #[error("cannot write the map or the status as JSON")]
    Json(#[from] serde_json::Error),
}

impl From<PortError> for FanoutError {
    fn from(error: PortError) -> Self {
        Self::SharedMemory(error.into())
    }
}

impl From<FanoutError> for Failure {
    fn from(error: FanoutError) -> Self {
        match error {
            FanoutError::SharedMemory(error) => error.into(),
            FanoutError::Network(error) => error.into(),
            FanoutError::Json(_) => Self::from_error(FailureKind::Run, &error),
        }
    }
}

/// The zenoh side failed.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// `fanout.listen` cannot be listened on.
    #[error("`fanout.listen`: cannot listen on {endpoint}: {reason}")]
    Listen {
        /// The endpoint.
        endpoint: String,
        /// The reason that the operating system or zenoh gives.
        reason: String,
    },
    /// zenoh refused.
    #[error("zenoh: {action} of {key} failed: {reason}")]
    Refused {
        /// "declaration" or "publication".
        action: &'static str,
        /// The key.
        key: String,
        /// zenoh's reason.
        reason: String,
    },
    /// A thread cannot be started.
    #[error("cannot start the thread that {task}: {source}")]
    Thread {
        /// What the thread does.
        task: &'static str,
        /// The reason that the operating system gives.
        source: std::io::Error,
    },
}

impl NetworkError {
    /// The error of an `action` on `key` that zenoh refused.
    pub(crate) fn refused(action: &'static str, key: String) -> impl FnOnce(zenoh::Error) -> Self {
        move |reason| Self::Refused {
            action,
            key,
            reason: reason.to_string(),
        }
    }
}

impl From<NetworkError> for Failure {
    fn from(error: NetworkError) -> Self {
        match error {
            NetworkError::Listen { .. } => Self::from_error(FailureKind::Config, &error).with_help(
                "another run may be using the port: give this one a free port with `--set fanout.listen=tcp/127.0.0.1:PORT`, \
                 or do without viewers with `--set fanout.enabled=false`",
            ),
            NetworkError::Refused { .. } | NetworkError::Thread { .. } => Self::from_error(FailureKind::Run, &error),
        }
    }
}
