//! `neighbours`: what every connected road user knows of others from the messages that it received, one row for each slot of the
//! observation of the same tick.

use crate::section::payload_layout;

/// Numbers of a known object: x, y (metres, world frame, centre), velocity x, y (m/s, world frame), heading (radians counter-clockwise
/// from east), length, width (metres), age of the measurement (seconds), then standard deviations: of the position on each axis (metres), of
/// the velocity on each axis (m/s), of the heading (radians).
pub const NEIGHBOUR_COLUMNS: usize = 11;
/// Identity of a known object: its station (0 = a perceived object, which has no name), the station that it was heard from, a
/// [`NeighbourSource`].
pub const NEIGHBOUR_ID_COLUMNS: usize = 3;
/// Radio of a slot: 1 if it has one, objects known, messages sent in the tick before, bytes of them, messages received in the tick before.
pub const RADIO_COLUMNS: usize = 5;

/// The message that an object is known from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum NeighbourSource {
    /// No object: the place is empty.
    Empty = 0,
    /// Cooperative awareness message: the object's own.
    Cam = 1,
    /// Collective perception message: another station perceives the object.
    Cpm = 2,
    /// Vulnerable road user awareness message: the object's own.
    Vam = 3,
    /// Basic safety message: the object's own.
    Bsm = 4,
    /// No message: the road user's own sensors perceive the object.
    Own = 5,
}

payload_layout! {
    /// Layout of a `neighbours` message for `slots` slots and `nearest` objects in each.
    NeighboursLayout(slots, nearest) => NeighboursSections {
        /// `f32 [n, k, 11]`: known objects, the nearest first ([`NEIGHBOUR_COLUMNS`]); zeros where there is none.
        objects: [f32; NEIGHBOUR_COLUMNS], [slots, nearest];
        /// `u32 [n, k, 3]`: their identity ([`NEIGHBOUR_ID_COLUMNS`]).
        ids: [u32; NEIGHBOUR_ID_COLUMNS], [slots, nearest];
        /// `u32 [n, 5]`: the radio of the slot ([`RADIO_COLUMNS`]).
        radio: [u32; RADIO_COLUMNS], [slots];
        /// `f32 [n]`: share of the tick before in which the slot's radio found the channel busy, 0 … 1.
        channel_load: f32, [slots];
        /// `u32 [n]`: dense vehicle index within the episode, as in the observation.
        vehicle: u32, [slots];
    }
}
