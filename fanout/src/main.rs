//! `fanout RUN_FILE`: shared memory → zenoh. Started by `caraware`, not by hand.

use std::process::ExitCode;

use fanout::access::{HEARD, RefusalLayer};
use ipc_schema::{process::Process, session};

/// How far it stands back behind the run, on a scale of 19: whoever keeps to the clock gets a core at once.
const NICENESS: i32 = 10;

fn main() -> ExitCode {
    // Threads inherit it, so it comes first. A machine that forbids even this loses nothing but the courtesy.
    let _ = rustix::process::setpriority_process(None, NICENESS);
    session::main_heard(Process::Fanout, RefusalLayer, HEARD, fanout::run)
}
