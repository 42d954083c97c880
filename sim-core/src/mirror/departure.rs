//! By how much a mirror is not where SUMO has its vehicle, and which part of that explains a contact that SUMO does not have.

use serde::{Deserialize, Serialize};

/// A lane change counts from this rest on, metres.
const LANE_CHANGE_M: f64 = 0.5;
/// A mirror is late from this distance on, metres.
const LATE_M: f64 = 0.5;
/// Its path is another one than SUMO's from this distance on, metres.
const PATH_M: f64 = 0.15;
/// It does not follow its reference from this distance on, metres.
const TRACKING_M: f64 = 0.3;

/// By how much a mirror is not where SUMO has its vehicle.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Departure {
    /// It is led along its path ([`super::guidance`]).
    pub is_led: bool,
    /// Rest of a lane change that SUMO has made at once, metres.
    pub lane_change_m: f64,
    /// Distance along the path by which it is later than the other mirrors, metres.
    pub late_m: f64,
    /// Distance of its reference from SUMO's own path, lane changes left out, metres.
    pub path_m: f64,
    /// Distance from its reference, metres.
    pub tracking_m: f64,
}

/// What explains a contact of two mirrors that SUMO's own poses do not have. Of several the first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ContactCause {
    /// A mirror is led, because SUMO moves as no vehicle drives.
    Led,
    /// A lane change takes a mirror time.
    LaneChange,
    /// A mirror is late: it slowed down for a bend.
    Late,
    /// A mirror's path is beside SUMO's.
    Path,
    /// A mirror is not on its path.
    Tracking,
    /// The shape of the bodies: SUMO's have both bumpers on the lane, those of mirrors roll.
    Body,
}

impl Departure {
    /// The part of it that explains a contact.
    #[must_use]
    pub fn cause(&self) -> ContactCause {
        if self.is_led {
            ContactCause::Led
        } else if self.lane_change_m > LANE_CHANGE_M {
            ContactCause::LaneChange
        } else if self.late_m > LATE_M {
            ContactCause::Late
        } else if self.path_m > PATH_M {
            ContactCause::Path
        } else if self.tracking_m > TRACKING_M {
            ContactCause::Tracking
        } else {
            ContactCause::Body
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_part_that_is_large_explains_a_contact() {
        let mut departure = Departure::default();
        assert_eq!(departure.cause(), ContactCause::Body);
        departure.tracking_m = 0.4;
        assert_eq!(departure.cause(), ContactCause::Tracking);
        departure.path_m = 0.2;
        assert_eq!(departure.cause(), ContactCause::Path);
        departure.late_m = 0.6;
        assert_eq!(departure.cause(), ContactCause::Late);
        departure.lane_change_m = 0.6;
        assert_eq!(departure.cause(), ContactCause::LaneChange);
        departure.is_led = true;
        assert_eq!(departure.cause(), ContactCause::Led);
    }
}
