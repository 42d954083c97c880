//! Shared memory → zenoh: shows the newest state of a run to any number of remote viewers, and none of them can slow the run down.
//!
//! The fan-out is a watcher: the run does not wait for it, so it gives no credit, and it counts the ticks that it misses.
//! Keys, payloads and rates: `docs/fanout.md`. Every published key also answers queries with its newest value, so a viewer
//! that joins late gets the whole picture at once.

pub mod directory;
pub mod error;
pub mod feed;
pub mod frame;
pub mod meter;
pub mod network;
pub mod reader;
pub mod relay;
pub mod status;

use std::path::Path;

use ipc_schema::{failure::Failure, membership::RunMembership, process::Process};

/// Fans out the run of `run_file` until the run ends or the process receives a signal to stop.
///
/// # Errors
/// The process cannot join the run, the endpoint cannot be listened on, or a port broke.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let membership = RunMembership::join(run_file, Process::Fanout)?;
    Ok(relay::RunRelay::open(membership)?.run()?)
}
