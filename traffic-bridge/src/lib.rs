//! SUMO in-process: microscopic traffic as frames in our units, and the population that keeps driving for ever.
//!
//! [`session::Session`] is SUMO as a value: started, stepped, reloaded, closed. [`population::Population`] puts road
//! users into it. [`bridge`] is the process around both.

pub mod bridge;
pub mod catalogue;
pub mod census;
mod control;
pub mod convention;
mod decisions;
pub mod error;
pub mod fleet;
pub mod frame;
mod graph;
pub mod hero_route;
pub mod heroes;
pub mod inputs;
pub mod options;
mod pacing;
mod pedestrians;
mod placing;
pub mod population;
pub mod roads;
pub mod session;
pub mod sumo;
pub mod trips;
