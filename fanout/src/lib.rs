//! Shared memory → zenoh: the newest state of a run for any number of remote viewers, none of whom can slow it down.
//!
//! The fan-out is a spectator in shared memory: it gives credit to nobody, and what it misses is counted, not waited for.
//! Keys, payloads and rates: `docs/fanout.md`. Every published key also answers queries with its newest value: a late joiner
//! has the whole picture at once.

pub mod access;
pub mod commands;
pub mod directory;
pub mod endpoint;
pub mod facts;
pub mod feed;
pub mod frame;
pub mod keys;
pub mod meter;
pub mod outlet;
pub mod pace;
pub mod reader;
pub mod relay;
pub mod scans;
pub mod status;

use std::path::Path;

use ipc_schema::{failure::Failure, process::Process, session::Session};

/// Fans out the run of `run_file` until the run ends or the process is asked to stop.
///
/// # Errors
/// The run cannot be joined, the endpoint cannot be listened on, or a port broke.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let session = Session::join(run_file, Process::Fanout)?;
    Ok(relay::Relays::open(session)?.run()?)
}
