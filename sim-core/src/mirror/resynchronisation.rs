//! Why a mirrored road user was set onto SUMO, or was led there, instead of driving there.

use serde::{Deserialize, Serialize};

/// The reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResynchronisationCause {
    /// SUMO moved it: a teleport, or a script's `moveToXY`.
    MovedBySumo,
    /// SUMO had it off the road in between, for instance parked or on board.
    Returned,
    /// No vehicle moves as far, or as far sideways, in one step as SUMO says.
    ImpossibleStep,
    /// SUMO's path turns more narrowly there than the vehicle can: SUMO turns vehicles on the spot.
    NarrowTurn,
    /// SUMO let it change lanes at less than walking pace, which no vehicle drives.
    SlowLaneChange,
    /// Its tracking error exceeded `vehicle.resynchronise_m`.
    TrackingError,
    /// What it could drive was farther from SUMO's path than `vehicle.leave_path_m`.
    LeftPath,
}

/// A road user that was set onto SUMO.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Resynchronisation {
    /// Dense index.
    pub vehicle: u32,
    /// The reason.
    pub cause: ResynchronisationCause,
    /// Where it is now, world frame, metres.
    pub position_m: [f64; 3],
    /// How far it was set, metres.
    pub jump_m: f64,
}

/// A road user that is led along its path from now on ([`super::guidance`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Guidance {
    /// Dense index.
    pub vehicle: u32,
    /// The reason.
    pub cause: ResynchronisationCause,
    /// Where it is now, world frame, metres.
    pub position_m: [f64; 3],
    /// Its distance from the path, metres.
    pub away_m: f64,
}
