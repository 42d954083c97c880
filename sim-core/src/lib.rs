//! The nanoscopic core: geodesy, vehicle dynamics, and the mirror that tracks SUMO's traffic at the sub-step rate.
//!
//! Pure functions without clock, I/O or shared memory. Only [`process`], the body of the `sim-core` binary, is a shell around
//! [`mirror::Mirror`] and [`collision`]; [`scene`] reads its files once.

// Values leave the core in single precision (positions excepted): the wire's precision, see `ipc_schema::world`.
#![expect(clippy::cast_possible_truncation, reason = "see above")]

#[cfg(test)]
#[path = "../tests/common/preset.rs"]
mod preset;

pub mod actions;
pub mod attitude;
pub mod collision;
pub mod curve;
pub mod dimensions;
pub mod displacement;
pub mod driving;
pub mod dynamic;
pub mod fleet;
pub mod geodesy;
pub mod governor;
pub mod hero;
pub mod lanes;
pub mod mirror;
pub mod parameters;
pub mod person;
pub mod prefetch;
pub mod process;
pub mod reference;
pub mod rigid_body;
pub mod road_user;
pub mod route;
pub mod scene;
pub mod spherical;
pub mod statistics;
pub mod tracking;
pub mod trig;
pub mod vehicle;
