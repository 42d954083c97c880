//! Tests with real SUMO, and nets built by the wheel's own tools.
#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping, their helpers too")]

mod advice;
mod interpolation;
mod lifecycle;
mod objects;
mod passing;
mod population;
mod process;
mod right_of_way;
mod scenario;
mod signals;
mod stages;
mod support;
mod waiting;
