//! How a process that cannot go on tells why: a small file beside its log, and its exit code.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// What kind of failure, and so which exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FailureKind {
    /// The run failed: exit code 1.
    Run,
    /// The user's input is wrong: exit code 2.
    Config,
    /// Something is missing on this machine: exit code 3.
    Missing,
}

impl FailureKind {
    /// Exit code of a process that failed this way.
    #[must_use]
    pub fn exit_code(self) -> u8 {
        match self {
            Self::Run => 1,
            Self::Config => 2,
            Self::Missing => 3,
        }
    }
}

/// Why a process could not go on. The message names file, key or line; the help says what to do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// Decides the exit code.
    pub kind: FailureKind,
    /// What is wrong.
    pub message: String,
    /// What to do.
    pub help: Option<String>,
}

impl Failure {
    /// A failure without advice.
    pub fn new(kind: FailureKind, message: impl Into<String>) -> Self {
        Self {
            kind,
            message: message.into(),
            help: None,
        }
    }

    /// The same with advice.
    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }

    /// The message of `error` with all its causes, each once.
    pub fn from_error(kind: FailureKind, error: &dyn std::error::Error) -> Self {
        let mut message = error.to_string();
        let mut cause = error.source();
        while let Some(inner) = cause {
            message = format!("{message}: {inner}");
            cause = inner.source();
        }
        Self::new(kind, message)
    }

    /// Where the failure of process `name` is written.
    #[must_use]
    pub fn path(run_dir: &Path, name: &str) -> PathBuf {
        run_dir.join("logs").join(format!("{name}.error.json"))
    }

    /// Writes the failure for the supervisor to show; a failure to write is only logged.
    pub fn write(&self, run_dir: &Path, name: &str) {
        let path = Self::path(run_dir, name);
        match serde_json::to_string(self) {
            Ok(text) => {
                if let Err(error) = std::fs::write(&path, text) {
                    tracing::error!(%error, path = %path.display(), "cannot write the failure");
                }
            }
            Err(error) => tracing::error!(%error, "cannot serialise the failure"),
        }
    }

    /// Reads the failure of process `name`, if it wrote one.
    #[must_use]
    pub fn read(run_dir: &Path, name: &str) -> Option<Self> {
        let text = std::fs::read_to_string(Self::path(run_dir, name)).ok()?;
        serde_json::from_str(&text).ok()
    }
}
