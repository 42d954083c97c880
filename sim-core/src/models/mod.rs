//! Vehicle models: pure functions of (parameters, state, input, dt).
//!
//! [`kinematic`] rolls without slip, [`dynamic`] has tyres, [`rigid_body`] stands on four springs. The functions of the first two
//! are free of branches and library calls so that [`crate::mirror::batch`] can run them on many vehicles at once; one vehicle
//! alone gives the same bits. [`catalogue`] chooses model and parameters of each vehicle.

pub mod articulation;
pub mod attitude;
pub mod catalogue;
pub mod dimensions;
pub mod dynamic;
pub mod kinematic;
pub mod parameters;
pub mod rigid_body;
pub mod state;
