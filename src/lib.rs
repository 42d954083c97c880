//! The `caraware` command: configuration, process table, supervisor, status, doctor.

pub mod bench;
pub mod checkpoint;
pub mod cli;
pub mod config;
pub mod cores;
pub mod display;
pub mod doctor;
pub mod environment;
pub mod failure;
pub mod install;
pub mod live_table;
pub mod prepare;
pub mod process_table;
pub mod registry;
pub mod report;
pub mod resume;
pub mod revival;
pub mod scenario;
pub mod status;
pub mod succession;
pub mod supervisor;
pub mod swap;
pub mod town;
pub mod view;
