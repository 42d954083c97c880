//! `replay RUN_FILE`: a recording → shared memory. Started by `caraware replay`, not by hand.

use std::process::ExitCode;

use ipc_schema::{membership, process::Process};

fn main() -> ExitCode {
    membership::main(Process::SensorDaemon, replay::run)
}
