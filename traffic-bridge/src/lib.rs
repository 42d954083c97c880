//! SUMO in-process: microscopic traffic as frames in our units, and the population that keeps driving for ever.
//!
//! [`sumo::Sumo`] is SUMO as a value: started, stepped, reloaded, closed. [`population::Population`] puts road
//! users into it, [`heroes`] moves those that our own models drive. [`bridge`] is the process around them.

pub mod bridge;
pub mod heroes;
pub mod population;
pub mod sumo;
