//! Sensors of connected vehicles, and the assembly of what they deliver into observations.
//!
//! A library of pure functions without clock, I/O or shared memory; the `sensor-daemon` binary is a thin shell around
//! [`sensing::Sensing`]: [`daemon`], with the [`delivery`] to the trainer, its [`journal`], and the [`hand_over`] to the next.

// Sensor values leave in single precision: the wire's precision, see `ipc_schema::observation`.
#![expect(clippy::cast_possible_truncation, reason = "see above")]

pub mod blackout;
pub mod carrier;
pub mod daemon;
pub mod delivery;
pub mod digest;
pub mod fields;
pub mod gnss;
pub mod hand_over;
pub mod history;
pub mod imu;
pub mod journal;
pub mod lidar;
pub mod noise;
pub mod normals;
#[cfg(test)]
#[path = "../../sim-core/tests/common/preset.rs"]
mod preset;
pub mod region;
pub mod scanning;
pub mod sections;
pub mod sensing;
pub mod sky;
pub mod slots;
pub mod speed_steering;
pub mod suite;
pub mod switches;
pub mod wide;
