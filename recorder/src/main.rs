//! `recorder RUN_FILE`: shared memory → a file. Started by `caraware`, not by hand.

use std::process::ExitCode;

use ipc_schema::{membership, process::Process};

fn main() -> ExitCode {
    membership::main(Process::Recorder, recorder::process::run)
}
