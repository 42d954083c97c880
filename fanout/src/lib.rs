//! Shared memory → zenoh: the newest state of a run for any number of remote viewers, none of whom can slow it down.
//!
//! The fan-out is a spectator in shared memory: it gives credit to nobody, and what it misses is counted, not waited for.
//! Keys of a run, with its name percent-encoded ([`keys`]):
//!
//! | key                           | what                                                        | published                        |
//! |-------------------------------|-------------------------------------------------------------|----------------------------------|
//! | `caraware/RUN/ENV/world`      | [`frame`]: header, `[VehicleState; count]`, no sub-steps    | at most `fanout.rate_hz`         |
//! | `caraware/RUN/ENV/observation`| [`frame`]: header, the payload of the shared memory         | at most `fanout.rate_hz`         |
//! | `caraware/RUN/ENV/prediction` | [`frame`]: header, the payload of the shared memory         | at most `fanout.rate_hz`         |
//! | `caraware/RUN/ENV/status`     | JSON of [`status::Status`]                                  | twice a second                   |
//! | `caraware/RUN/ENV/map`        | JSON of [`status::Map`]                                     | answers queries only             |
//! | `caraware/RUN/ENV/alive`      | liveliness token                                            | while the fan-out runs           |
//!
//! Every published key also answers queries with its newest value: a late joiner has the whole picture at once.

pub mod feed;
pub mod frame;
pub mod keys;
pub mod outlet;
pub mod pace;
pub mod relay;
pub mod status;

use std::path::Path;

use ipc_schema::{failure::Failure, process::Process, session::Session};

/// Fans out the run of `run_file` until the run ends or the process is asked to stop.
///
/// # Errors
/// The run cannot be joined, the endpoint cannot be listened on, or a port broke.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let session = Session::join(run_file, Process::Fanout)?;
    let env_index = session.run.env_index;
    Ok(relay::Relay::open(session, env_index)?.run()?)
}
