//! The `sensor-daemon RUN_FILE` command, which `caraware` starts.

use std::process::ExitCode;

use ipc_schema::{process::Process, session};

fn main() -> ExitCode {
    session::main(Process::SensorDaemon, sensor_daemon::daemon::run)
}
