//! SUMO in-process: microscopic traffic as frames in SI units, and a population that drives without end.
//!
//! [`sumo::Sumo`] is SUMO as a value: started, stepped, reloaded, closed. [`population::Population`] puts road
//! users into it, [`heroes`] moves those that our own models drive. [`bridge`] is the process around them.

pub mod bridge;
pub mod heroes;
pub mod population;
pub mod sumo;
