//! Messages between road users: services, channel, local dynamic maps, the block `neighbours`.
//!
//! Services, messages and the channel are pure functions without clock, I/O or shared memory.

// Positions of 0.1 microdegrees, tenths of metres, counts: values are limited to the ranges of their message before they are cast.
#![expect(clippy::cast_possible_truncation, reason = "see above")]

pub mod capture;
pub mod choices;
pub mod exchange;
pub mod local_map;
pub mod message;
pub mod parallel;
pub mod process;
pub mod radio;
pub mod random;
pub mod roadside;
pub mod services;
pub mod station;
