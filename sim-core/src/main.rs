//! `sim-core RUN_FILE`: `caraware` starts this program.

use std::process::ExitCode;

use ipc_schema::{membership, process::Process};

fn main() -> ExitCode {
    membership::main(Process::SimCore, sim_core::process::run)
}
