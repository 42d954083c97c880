//! `sim-core RUN_FILE`: `caraware` starts this program.

use std::process::ExitCode;

use ipc_schema::{process::Process, session};

fn main() -> ExitCode {
    session::main(Process::SimCore, sim_core::process::run)
}
