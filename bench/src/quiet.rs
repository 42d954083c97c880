//! Commands beside a measurement: what they print is not shown, and what they report is kept for an error.

use std::{
    fs::OpenOptions,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use caraware::failure::Exit;

/// Lines of a report that an error repeats.
const REPEATED: usize = 8;

/// The directory in which commands have their runs and their registry.
#[derive(Debug, Clone)]
pub struct QuietPlace {
    directory: PathBuf,
}

impl QuietPlace {
    /// The place in `directory`.
    #[must_use]
    pub fn new(directory: &Path) -> Self {
        Self {
            directory: directory.to_owned(),
        }
    }

    /// Its directory.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    fn log(&self) -> PathBuf {
        self.directory.join("reported.log")
    }

    /// A command of `program` in this place.
    ///
    /// # Errors
    /// The directory is not writable.
    pub fn command(&self, program: &Path) -> Result<Command, Exit> {
        let log = OpenOptions::new().create(true).append(true).open(self.log());
        let log = log.map_err(|error| Exit::io("write", &self.log(), &error))?;
        let mut command = Command::new(program);
        command
            .current_dir(&self.directory)
            .env("CARAWARE_RUNTIME_DIR", self.directory.join("r"))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log);
        Ok(command)
    }

    /// The failure `message` of a command, with the last lines that commands have reported.
    #[must_use]
    pub fn failure(&self, message: &str, help: &str) -> Exit {
        let reported = std::fs::read_to_string(self.log()).unwrap_or_default();
        let lines: Vec<&str> = reported.lines().collect();
        let last = &lines[lines.len().saturating_sub(REPEATED)..];
        Exit::run([&[message], last].concat().join("\n"), help)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::panic, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn a_failure_repeats_what_was_reported_last() {
        let directory = tempfile::tempdir().unwrap();
        let place = QuietPlace::new(directory.path());
        let script = "echo shown; for line in $(seq 20); do echo line $line >&2; done; exit 3";
        let command = place.command(Path::new("sh"));
        let status = command.ok().unwrap().args(["-c", script]).status().unwrap();
        assert_eq!(status.code(), Some(3));
        let Exit::Failure(failure) = place.failure("it failed", "") else {
            panic!("no failure");
        };
        assert!(
            failure.message.starts_with("it failed\nline 13\n"),
            "{}",
            failure.message
        );
        assert!(failure.message.ends_with("\nline 20"), "{}", failure.message);
        assert!(!failure.message.contains("shown"), "{}", failure.message);
    }
}
