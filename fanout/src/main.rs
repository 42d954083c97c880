//! `fanout RUN_FILE`: shared memory → zenoh. Started by `caraware`, not by hand.

use std::process::ExitCode;

use fanout::network::access::{REFUSAL_FILTER, RefusalLayer};
use ipc_schema::{membership, process::Process};

/// Niceness of the fan-out, of at most 19: a process that the run waits for gets a core before it.
const NICENESS: i32 = 10;

fn main() -> ExitCode {
    // Threads inherit the niceness, so it is set first. Where the system forbids it, the fan-out runs without it.
    let _ = rustix::process::setpriority_process(None, NICENESS);
    membership::main_heard(Process::Fanout, RefusalLayer, REFUSAL_FILTER, fanout::run)
}
