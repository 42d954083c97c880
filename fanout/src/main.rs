//! `fanout RUN_FILE`: shared memory → zenoh. Started by `caraware`, not by hand.

use std::process::ExitCode;

use ipc_schema::{process::Process, session};

fn main() -> ExitCode {
    session::main(Process::Fanout, fanout::run)
}
