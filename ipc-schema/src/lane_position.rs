//! `lane-position`: where SUMO has each road user in its own terms – lane, edge, place on its route – and SUMO's absolute time.
//!
//! Sent if `traffic.lane_positions` is set, with each `traffic` message, as late as the mirrored road users move: the message of a tick
//! belongs to the states of the same tick in `world`.

use bytemuck::{Pod, Zeroable};

use crate::section::payload_layout;

/// [`LanePosition::lane`], [`LanePosition::edge`], [`LanePosition::route_edge`] and [`LanePosition::carrier`] where there is none.
pub const NO_INDEX: u32 = u32::MAX;

/// File in the run directory with the ids of lanes and edges by their indices, one JSON list for each map.
pub const LANE_IDS: &str = "lanes.json";

/// A road user in SUMO's terms.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct LanePosition {
    /// Hash of SUMO's id.
    pub id_hash: u64,
    /// Front bumper from the lane's beginning (persons: from their edge's), metres of the lane's own length; not-a-number off every lane.
    pub lane_position_m: f64,
    /// Driven since departure, metres; not-a-number for persons.
    pub odometer_m: f64,
    /// Dense index within the episode.
    pub vehicle: u32,
    /// Index of the lane in [`LANE_IDS`], or [`NO_INDEX`].
    pub lane: u32,
    /// Index of the edge in [`LANE_IDS`], or [`NO_INDEX`].
    pub edge: u32,
    /// Number of the edge in the vehicle's route, from 0 (on a junction that of the edge before), or [`NO_INDEX`] for persons.
    pub route_edge: u32,
    /// Dense index of the vehicle in which a person rides, or [`NO_INDEX`]. A person that rides is not in `world`.
    pub carrier: u32,
    /// Zero.
    pub reserved: u32,
}

payload_layout! {
    /// Layout of a `lane-position` message.
    LanePositionLayout(road_users, clocks) => LanePositionSections {
        /// `f64 [1]`: SUMO's absolute time at the end of the step that the positions belong to, seconds.
        sumo_time_s: f64, [clocks];
        /// `LanePosition [road_users]`, by ascending dense index.
        positions: LanePosition, [road_users];
    }
}

impl LanePositionLayout {
    /// Layout for `road_users` road users.
    #[must_use]
    pub fn new(road_users: usize) -> Self {
        Self::sized(road_users, 1)
    }
}
