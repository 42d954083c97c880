//! The nanoscopic core: geodesy, vehicle dynamics, and the mirror that tracks SUMO's traffic at the sub-step rate.
//!
//! Pure functions without clock, I/O or shared memory. Only [`process`], the body of the `sim-core` binary, is a shell around
//! [`mirror::Mirror`], [`driving`] and [`collision`]; [`scene`] reads its files once.

// Values leave the core in single precision (positions excepted): the wire's precision, see `ipc_schema::world`.
#![expect(clippy::cast_possible_truncation, reason = "see above")]

#[cfg(test)]
#[path = "../tests/common/preset.rs"]
mod preset;

pub mod action_log;
pub mod collision;
pub mod driving;
mod event_log;
pub mod geodesy;
pub mod mirror;
pub mod models;
mod names;
pub mod process;
mod resynchronisations;
pub mod scene;
pub mod trig;
