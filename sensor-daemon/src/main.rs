//! The `sensor-daemon RUN_FILE` command, which `caraware` starts.

use std::process::ExitCode;

use ipc_schema::{membership, process::Process};

fn main() -> ExitCode {
    membership::main(Process::SensorDaemon, sensor_daemon::daemon::run)
}
