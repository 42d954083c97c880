//! Failures as the user sees them: printed once, with the file, key or line, with the fix, and with an exit code.

use std::process::ExitCode;

use ipc_schema::{
    failure::{FILE_HELP, Failure, FailureKind},
    ports::{BoardError, PortError},
    run::RunFileError,
    services::ServiceError,
};
use miette::{Diagnostic, Report};

use crate::{config::ConfigError, display::notice};

/// Exit code after Ctrl-C, as a shell reports it: 128 and the number of SIGINT.
pub const INTERRUPTED: u8 = 130;

/// The reason why the command ends without success.
#[derive(Debug)]
pub enum Exit {
    /// A wrong configuration, printed with its place in the source; exit code 2.
    Config(Box<ConfigError>),
    /// A failure, printed with its help; its kind decides the exit code.
    Failure(Failure),
    /// Ctrl-C: exit code [`INTERRUPTED`].
    Interrupted,
}

#[derive(Debug, thiserror::Error)]
#[error("{}", .0.message)]
struct ShownFailure(Failure);

impl Diagnostic for ShownFailure {
    fn help<'a>(&'a self) -> Option<Box<dyn std::fmt::Display + 'a>> {
        self.0
            .help
            .as_ref()
            .map(|help| Box::new(help) as Box<dyn std::fmt::Display>)
    }
}

impl Exit {
    /// Prints the failure to standard error and returns the exit code.
    #[must_use]
    pub fn report(self) -> ExitCode {
        match self {
            Self::Config(error) => {
                notice(&format!("{:?}", Report::new(*error)));
                ExitCode::from(FailureKind::Config.exit_code())
            }
            Self::Failure(failure) => {
                let code = failure.kind.exit_code();
                notice(&format!("{:?}", Report::new(ShownFailure(failure))));
                ExitCode::from(code)
            }
            Self::Interrupted => ExitCode::from(INTERRUPTED),
        }
    }

    /// Message and advice, for a report.
    #[must_use]
    pub fn summary(&self) -> (String, Option<String>) {
        match self {
            Self::Config(error) => (error.to_string(), error.help().map(|help| help.to_string())),
            Self::Failure(failure) => (failure.message.clone(), failure.help.clone()),
            Self::Interrupted => ("interrupted".into(), None),
        }
    }

    /// Wrong input.
    pub fn config(message: impl Into<String>, help: impl Into<String>) -> Self {
        Self::Failure(Failure::new(FailureKind::Config, message).with_help(help))
    }

    /// Something this machine lacks.
    pub fn missing(message: impl Into<String>, help: impl Into<String>) -> Self {
        Self::Failure(Failure::new(FailureKind::Missing, message).with_help(help))
    }

    /// A failed run.
    pub fn run(message: impl Into<String>, help: impl Into<String>) -> Self {
        Self::Failure(Failure::new(FailureKind::Run, message).with_help(help))
    }

    /// An operation on a file that the system refused.
    pub fn io(action: &str, path: &std::path::Path, error: &std::io::Error) -> Self {
        Self::run(format!("cannot {action} {}: {error}", path.display()), FILE_HELP)
    }
}

impl From<ConfigError> for Exit {
    fn from(error: ConfigError) -> Self {
        Self::Config(Box::new(error))
    }
}

impl From<Failure> for Exit {
    fn from(failure: Failure) -> Self {
        Self::Failure(failure)
    }
}

impl From<ServiceError> for Exit {
    fn from(error: ServiceError) -> Self {
        let failure = Failure::from_error(FailureKind::Run, &error);
        Self::Failure(failure.with_help("`caraware doctor` lists and removes stale shared memory"))
    }
}

impl From<PortError> for Exit {
    fn from(error: PortError) -> Self {
        Self::Failure(Failure::from_error(FailureKind::Run, &error))
    }
}

impl From<BoardError> for Exit {
    fn from(error: BoardError) -> Self {
        match error {
            BoardError::Service(error) => error.into(),
            BoardError::Port(error) => error.into(),
        }
    }
}

impl From<RunFileError> for Exit {
    fn from(error: RunFileError) -> Self {
        Self::Failure(Failure::from_error(FailureKind::Run, &error))
    }
}
