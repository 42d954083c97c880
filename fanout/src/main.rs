//! `fanout RUN_FILE`: shared memory → zenoh. Started by `caraware`, not by hand.

use std::process::ExitCode;

use fanout::access::{HEARD, RefusalLayer};
use ipc_schema::{process::Process, session};

fn main() -> ExitCode {
    session::main_heard(Process::Fanout, RefusalLayer, HEARD, fanout::run)
}
