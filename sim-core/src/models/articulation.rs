//! Vehicles of several bodies: what a parameter set says of them, and what follows for one vehicle.

use ipc_schema::world::MOST_TRAILING;
use serde::Deserialize;

/// How the vehicles of a parameter set bend. The set's own size is that of the leading body.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Articulation {
    /// One body behind, on a pivot: a semi-trailer, the rear part of a bus. Lengths scale with SUMO's.
    Trailer {
        /// Of the whole vehicle, metres.
        whole_length_m: f64,
        /// From the leading body's rear axle forward to the pivot, metres.
        hitch_ahead_m: f64,
        /// Of the body behind, metres.
        length_m: f64,
        /// From the pivot back to the middle of its axles, metres.
        hitch_to_axle_m: f64,
        /// From the middle of its axles to its rear end, metres.
        rear_overhang_m: f64,
    },
    /// Carriages on rails, all as long as the leading one: as many as make SUMO's length with the least change of theirs.
    Carriages {
        /// Between two carriages, metres.
        gap_m: f64,
        /// From bogie to bogie by the length of a carriage.
        bogie_share: f64,
    },
}

/// The bodies behind the leading one of a vehicle.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum TrailingBodies {
    /// It has one body.
    #[default]
    None,
    /// A body on a pivot.
    Trailer(TrailerBody),
    /// Carriages on the rails that the first one follows.
    Carriages(Carriages),
}

/// A body on a pivot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrailerBody {
    /// From the leading body's rear axle forward to the pivot, metres.
    pub hitch_ahead_m: f64,
    /// Metres.
    pub length_m: f64,
    /// From the pivot back to its axle, metres.
    pub hitch_to_axle_m: f64,
    /// From its axle to its rear end, metres.
    pub rear_overhang_m: f64,
}

/// Carriages of equal length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Carriages {
    /// How many follow the first, at most [`MOST_TRAILING`].
    pub count: u32,
    /// Of each, metres.
    pub length_m: f64,
    /// Between two, metres.
    pub gap_m: f64,
    /// From bogie to bogie, metres.
    pub bogies_m: f64,
}

impl TrailingBodies {
    /// How many there are.
    #[must_use]
    pub fn count(&self) -> u32 {
        match self {
            Self::None => 0,
            Self::Trailer(_) => 1,
            Self::Carriages(carriages) => carriages.count,
        }
    }

    /// From the front of the vehicle to its last axle, metres, if its leading body's rear axle is `front_m` from there; `None` on rails,
    /// which hold every bogie on the path.
    #[must_use]
    pub fn last_axle_m(&self, front_m: f64) -> Option<f64> {
        match self {
            Self::None => Some(front_m),
            Self::Trailer(body) => Some(front_m - body.hitch_ahead_m + body.hitch_to_axle_m),
            Self::Carriages(_) => None,
        }
    }
}

impl Articulation {
    /// The factor of the set's lengths for a vehicle of SUMO's length, and the bodies behind the leading one, whose length in the set is
    /// `leading_m`.
    #[must_use]
    pub fn sized(&self, whole_m: f64, leading_m: f64) -> (f64, TrailingBodies) {
        match *self {
            Self::Trailer {
                whole_length_m,
                hitch_ahead_m,
                length_m,
                hitch_to_axle_m,
                rear_overhang_m,
            } => {
                let scale = whole_m / whole_length_m;
                let body = TrailerBody {
                    hitch_ahead_m: hitch_ahead_m * scale,
                    length_m: length_m * scale,
                    hitch_to_axle_m: hitch_to_axle_m * scale,
                    rear_overhang_m: rear_overhang_m * scale,
                };
                (scale, TrailingBodies::Trailer(body))
            }
            Self::Carriages { gap_m, bogie_share } => {
                let most = f64::from(MOST_TRAILING + 1);
                let count = libm::round((whole_m + gap_m) / (leading_m + gap_m)).clamp(1.0, most);
                let length_m = (whole_m - (count - 1.0) * gap_m) / count;
                let carriages = Carriages {
                    count: count as u32 - 1,
                    length_m,
                    gap_m,
                    bogies_m: bogie_share * length_m,
                };
                (length_m / leading_m, TrailingBodies::Carriages(carriages))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn carriages_make_the_whole_length() {
        let rail = Articulation::Carriages {
            gap_m: 0.6,
            bogie_share: 0.72,
        };
        for (whole_m, behind) in [(26.4, 0), (135.0, 4), (200.0, 6), (9.0, 0), (2000.0, 31)] {
            let (scale, trailing) = rail.sized(whole_m, 26.4);
            let TrailingBodies::Carriages(carriages) = trailing else {
                panic!("{trailing:?}");
            };
            assert_eq!(carriages.count, behind, "{whole_m} m");
            let all_m = f64::from(behind + 1) * carriages.length_m + f64::from(behind) * 0.6;
            assert!((all_m - whole_m).abs() < 1e-9, "{all_m} m");
            assert!((scale - carriages.length_m / 26.4).abs() < 1e-12);
        }
    }
}
