//! `traffic-bridge RUN_FILE`: started by `caraware`.

use std::process::ExitCode;

use ipc_schema::{process::Process, session};

fn main() -> ExitCode {
    session::main(Process::TrafficBridge, traffic_bridge::bridge::run)
}
