//! Samples the sensors of connected vehicles and assembles their values into observations.
//!
//! The [`sensors`] and [`sensing::Sensing`] are pure functions without clock, I/O or shared memory. The process is a thin shell around
//! them: [`daemon`] receives `world` and publishes `observation`, and [`delivery`] sends observations to the trainer.

// Sensor values are published in single precision, the precision of the wire (`ipc_schema::observation`).
#![expect(clippy::cast_possible_truncation, reason = "see above")]

pub mod blackout;
pub mod carrier;
pub mod daemon;
pub mod delivery;
pub mod echoing;
pub mod imaging;
pub mod mounts;
pub mod noise;
pub mod observation;
#[cfg(test)]
#[path = "../../sim-core/tests/common/preset.rs"]
mod preset;
pub mod region;
pub mod roadside;
pub mod scanning;
pub mod sensing;
pub mod sensors;
pub mod suite;
pub mod surroundings;
pub mod switches;
pub mod tick;
pub mod wide;
