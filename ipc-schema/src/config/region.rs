//! Where vehicles are sensed: everywhere, inside a polygon, or around a point.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use super::text::{finite_numbers, serde_as_text};

/// The part of the map in which vehicles are sensed; all of it is simulated.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegionConfig {
    /// Corners of a polygon, in order; empty = none.
    pub polygon_m: Vec<RegionCorner>,
    /// x and y of a circle's centre, metres, world.
    pub centre_m: [f64; 2],
    /// The circle's radius, metres; 0 = none.
    pub radius_m: f64,
}

/// A corner of a polygon: x and y, metres, world. Configurations and run files write it as "x y".
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegionCorner(pub [f64; 2]);

/// A text is not a corner.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is no corner")]
pub struct RegionCornerError(pub String);

serde_as_text!(RegionCorner);

impl FromStr for RegionCorner {
    type Err = RegionCornerError;

    fn from_str(text: &str) -> Result<Self, RegionCornerError> {
        match finite_numbers(text.split_whitespace()).as_deref() {
            Some([x_m, y_m]) => Ok(Self([*x_m, *y_m])),
            _ => Err(RegionCornerError(text.to_owned())),
        }
    }
}

impl fmt::Display for RegionCorner {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self([x_m, y_m]) = self;
        write!(formatter, "{x_m} {y_m}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_corner_is_two_finite_numbers_and_comes_back_from_json() {
        let corner: RegionCorner = serde_json::from_str("\" 120  45.5 \"").unwrap();
        assert_eq!(corner, RegionCorner([120.0, 45.5]));
        assert_eq!(serde_json::to_string(&corner).unwrap(), "\"120 45.5\"");
        for text in ["", "1", "1 2 3", "1 zero", "1 inf"] {
            assert_eq!(text.parse::<RegionCorner>(), Err(RegionCornerError(text.to_owned())));
        }
    }
}
