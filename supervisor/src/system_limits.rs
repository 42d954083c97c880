//! What the system allows a run: the number of open files, and access for other users.

use rustix::{
    fs::Mode,
    process::{Resource, getrlimit, setrlimit, umask},
};

use crate::failure::Exit;

/// Open files of the largest process without an environment: libraries, logs, the network of the fan-out.
const OPEN_FILES: u64 = 128;
/// Open files of the largest process for each environment: its services, boards and connections (137 are counted in the fan-out).
const OPEN_FILES_PER_ENVIRONMENT: u64 = 192;

/// Raises the number of files that this process and its children may open to what the system allows at most.
pub fn raise_open_files() {
    let limit = getrlimit(Resource::Nofile);
    let raised = rustix::process::Rlimit {
        current: limit.maximum,
        ..limit
    };
    if let Err(error) = setrlimit(Resource::Nofile, raised) {
        tracing::debug!(%error, "the number of open files stays as it is");
    }
}

/// Keeps other users from changing what a run writes. They may read its results, as the user's own setting says.
pub fn protect_files() {
    let own = umask(Mode::empty());
    umask(own | Mode::WGRP | Mode::WOTH);
}

/// Refuses a run whose processes would need more open files than they may have.
///
/// # Errors
/// They would.
pub fn check_open_files(envs: u32) -> Result<(), Exit> {
    let needed = OPEN_FILES + OPEN_FILES_PER_ENVIRONMENT * u64::from(envs);
    match getrlimit(Resource::Nofile).current {
        Some(limit) if limit < needed => Err(Exit::missing(
            format!("a process may open {limit} files, but a process of this run may need {needed}"),
            format!(
                "raise the limit: `ulimit -n {needed}` in the shell, or `nofile` in /etc/security/limits.conf (Docker: --ulimit nofile={needed})"
            ),
        )),
        _ => Ok(()),
    }
}
