//! Whole runs of the command with all its processes. They are one program: a program a file would compile the channels again for each,
//! and leave cores without work at the end of each. `cargo test --test system handover::` runs one file.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

mod common;

mod awaited_actions;
mod bad_input;
mod classes;
mod collisions;
mod control;
mod curriculum;
mod driving;
mod environment_restart;
mod environments;
mod fanout;
mod handover;
mod import;
mod large;
mod lidar;
mod malformed;
mod other_users;
mod play;
mod recording;
mod remote;
mod resume;
mod running_out;
mod scenario_forms;
mod scenario_trust;
mod seeing;
mod sights;
mod stall;
mod suites;
mod traci;
mod v2x;
mod view;
mod wheel;
mod whole_system;
mod world;
