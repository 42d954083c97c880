//! `event`: contacts that begin in a tick. No process waits for these messages.

use bytemuck::{Pod, Zeroable};

use crate::section::payload_layout;

/// Kind of the object that a vehicle touches, [`Collision::other_class`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Struck {
    /// A vehicle.
    Vehicle = 0,
    /// A pedestrian.
    Person = 1,
    /// A building.
    Building = 2,
    /// A static obstacle or prop.
    Obstacle = 3,
}

/// A contact that begins in this tick.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct Collision {
    /// Point of contact, world, metres.
    pub position_m: [f64; 3],
    /// Hash of the vehicle's SUMO id.
    pub id_hash: u64,
    /// Hash of the other's id: SUMO's id of a road user or polygon, the name of an obstacle.
    pub other_id_hash: u64,
    /// Dense index of the vehicle.
    pub vehicle: u32,
    /// Dense index of the other road user, or index of the object in the scene.
    pub other: u32,
    /// A [`Struck`].
    pub other_class: u32,
    /// Magnitude of the difference of the two velocities, m/s.
    pub relative_speed_mps: f32,
}

payload_layout! {
    /// Where the array of an `event` message lies.
    CollisionLayout(contacts) {
        /// `Collision [contacts]`.
        collisions: Collision, [contacts];
    }
}
