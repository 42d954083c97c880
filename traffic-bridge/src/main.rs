//! `traffic-bridge RUN_FILE`: `caraware` starts this program.

use std::process::ExitCode;

use ipc_schema::{membership, process::Process};

/// Overrides `malloc` and `new` for SUMO too. SUMO's step visits millions of small objects: with mimalloc they lie closer together,
/// in larger pages, and a step takes a quarter less time than with the system's allocator.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    membership::main(Process::TrafficBridge, traffic_bridge::bridge::run)
}
