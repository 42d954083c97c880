//! `neighbours`: what every connected road user knows of others from the messages that it received, one row for each slot of the
//! observation of the same tick.

use crate::{config::Config, section::payload_layout};

/// Numbers of a known object: x, y (metres, world frame, centre), velocity x, y (m/s, world frame), heading (radians counter-clockwise
/// from east), length, width (metres), age of the measurement (seconds), then standard deviations: of the position on each axis (metres), of
/// the velocity on each axis (m/s), of the heading (radians).
pub const NEIGHBOUR_COLUMNS: usize = 11;
/// Identity of a known object: its station (0 = a perceived object, which has no name), the station that it was heard from, a
/// [`NeighbourSource`].
pub const NEIGHBOUR_ID_COLUMNS: usize = 3;
/// Radio of a slot: 1 if it has one, objects known, messages sent in the tick before, bytes of them, messages received in the tick before.
pub const RADIO_COLUMNS: usize = 5;

/// Numbers of a station in a row of `speech` ([`NeighboursLayout::speech`]); each is in 0 … 1.
///
/// A constant 1; share of time in which the radio found the channel busy; objects that its sensors perceive, in 32; objects that its map
/// knows, in 128; stations that it has heard from, in 64; time since its last collective perception message, in seconds; 1 if a message
/// goes out at this tick without an object too, as its sensor information is due; own speed, in 25 m/s.
pub const SPEAKER_COLUMNS: usize = 8;
/// Numbers of a candidate in a row of `speech`; each is in −1 … 1, and all are 0 where there is none.
///
/// 1; 1 for a person; place ahead and to the left, in 100 m; distance, in 100 m; speed, in 25 m/s; of the station's own last message with
/// it: the time since, in 2 s, how far it has moved, in 8 m, how much its speed has changed, in 1 m/s, and its heading, in 8°, and how far
/// it is from where that message lets one expect it, in 8 m; of the newest view of it in the map: its age, in 2 s, and how far it is from
/// where that view lets one expect it, in 4 m; stations with a view of it, in 8; 1 if it speaks for itself. What never was is 1.
pub const CANDIDATE_COLUMNS: usize = 15;
/// Most candidates of a station: a choice is a bit mask.
pub const MOST_CANDIDATES: usize = 32;
/// What messages have achieved ([`NeighboursLayout::achieved`]): seconds for which others newly know what the slot's collective perception
/// message of the tick before listed, summed over objects and receivers; bytes of that message on air; road users within
/// `v2x.awareness_range_m` that the slot knows at this tick; all road users within that range.
pub const ACHIEVED_COLUMNS: usize = 4;

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
    /// Layout of a `neighbours` message for `slots` slots and `nearest` objects in each. In the messages task `speakers` is `slots` and
    /// `inputs` the width of a row of `speech` ([`speech_width`]), otherwise both are 0.
    NeighboursLayout(slots, nearest, speakers, inputs) => NeighboursSections {
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
        /// `f32 [s, i]`: what the policy of the messages task sees: [`SPEAKER_COLUMNS`] numbers of the station, then
        /// [`CANDIDATE_COLUMNS`] for each object that its sensors perceive, the nearest first.
        speech: f32, [speakers, inputs];
        /// `f32 [s, 4]`: what messages have achieved ([`ACHIEVED_COLUMNS`]), for rewards: no policy may see it.
        achieved: [f32; ACHIEVED_COLUMNS], [speakers];
    }
}

/// Width of a row of `speech` with room for so many candidates.
#[must_use]
pub const fn speech_width(candidates: usize) -> usize {
    SPEAKER_COLUMNS + candidates * CANDIDATE_COLUMNS
}

impl NeighboursLayout {
    /// Layout of a message of a run with this configuration, for `slots` slots.
    #[must_use]
    pub fn of_config(config: &Config, slots: usize) -> Self {
        let nearest = config.v2x.neighbours as usize;
        match config.speaks() {
            true => Self::sized(slots, nearest, slots, speech_width(config.v2x.candidates as usize)),
            false => Self::sized(slots, nearest, 0, 0),
        }
    }
}
