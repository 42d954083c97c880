//! The `v2x RUN_FILE` command, which `caraware` starts.

use std::process::ExitCode;

use ipc_schema::{membership, process::Process};

fn main() -> ExitCode {
    membership::main(Process::V2x, v2x::process::run)
}
