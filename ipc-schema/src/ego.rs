//! `ego-pose`: the poses of the heroes, which `sim-core` sends to `traffic-bridge`.

use bytemuck::{Pod, Zeroable};

use crate::section::payload_layout;

/// The pose of one hero at the end of a tick. `traffic-bridge` moves it there in SUMO before the next step.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct EgoPose {
    /// Front-bumper centre, x, world, metres.
    pub front_x_m: f64,
    /// Front-bumper centre, y, world, metres.
    pub front_y_m: f64,
    /// Heading, counter-clockwise from east, radians.
    pub yaw_rad: f64,
    /// Speed along the heading, m/s.
    pub speed_mps: f64,
    /// Acceleration along the heading, m/s².
    pub accel_mps2: f64,
    /// Dense index within the episode.
    pub vehicle: u32,
    /// Bits of [`crate::world::HERO_ENDS`] that end the hero's episode; 0 while it lasts.
    pub flags: u32,
}

payload_layout! {
    /// Where the array of an `ego-pose` message lies.
    EgoPoseLayout(heroes) {
        /// `EgoPose [heroes]`.
        poses: EgoPose, [heroes];
    }
}
