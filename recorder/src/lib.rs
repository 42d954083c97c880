//! Shared memory → a file: every message of chosen channels of a run as it lies in shared memory, in MCAP; and such files read and compared.
//!
//! [`process`] is the process `recorder`, [`outside`] a recorder beside a run, [`file`] the file, and [`diff`] the comparison of two.
//! What a recording contains and what survives a kill: `docs/recording.md`.

pub mod diff;
pub mod file;
pub mod intake;
pub mod outside;
pub mod process;
pub mod run_logs;
