//! The failure of a process that cannot continue: it writes a small file beside its log, and ends with an exit code.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::storage;

/// Help where the system has refused an operation on a file.
pub const FILE_HELP: &str = "check permissions, free space and the limit on open files (`caraware doctor`)";

/// Kind of a failure; it decides the exit code.
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

/// The reason why a process cannot continue. The message names the file, key or line; the help names the fix.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// Kind of the failure.
    pub kind: FailureKind,
    /// The mistake or the failed operation.
    pub message: String,
    /// The fix.
    pub help: Option<String>,
}

impl Failure {
    /// A failure without help.
    pub fn new(kind: FailureKind, message: impl Into<String>) -> Self {
        Self {
            kind,
            message: message.into(),
            help: None,
        }
    }

    /// Adds the help.
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

    /// Path of the failure of process `name`.
    #[must_use]
    pub fn path(run_dir: &Path, name: &str) -> PathBuf {
        run_dir.join("logs").join(format!("{name}.error.json"))
    }

    /// Writes the failure, which the supervisor then shows. An error while writing is only logged.
    pub fn write(&self, run_dir: &Path, name: &str) {
        let path = Self::path(run_dir, name);
        match serde_json::to_string(self) {
            Ok(text) => {
                if let Err(error) = storage::write_whole(&path, text) {
                    tracing::error!(%error, path = %path.display(), "cannot write the failure");
                }
            }
            Err(error) => tracing::error!(%error, "cannot serialise the failure"),
        }
    }

    /// Removes the failure of process `name`, if there is one.
    pub fn remove(run_dir: &Path, name: &str) {
        let path = Self::path(run_dir, name);
        if let Err(error) = std::fs::remove_file(&path)
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::error!(%error, path = %path.display(), "cannot remove the failure");
        }
    }

    /// Reads the failure of process `name`, if it wrote one.
    #[must_use]
    pub fn read(run_dir: &Path, name: &str) -> Option<Self> {
        let text = std::fs::read_to_string(Self::path(run_dir, name)).ok()?;
        serde_json::from_str(&text).ok()
    }
}
