//! Where vehicles are sensed: everywhere, inside a polygon, or around a point.

use serde::{Deserialize, Serialize};

/// The part of the map in which vehicles are sensed; all of it is simulated.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegionConfig {
    /// Corners of a polygon, each "x y" (metres, world), in order; empty = none.
    pub polygon_m: Vec<String>,
    /// x and y of a circle's centre, metres, world.
    pub centre_m: [f64; 2],
    /// The circle's radius, metres; 0 = none.
    pub radius_m: f64,
}

impl RegionConfig {
    /// Corners of the polygon.
    ///
    /// # Errors
    /// The entry that is not two numbers.
    pub fn corners_m(&self) -> Result<Vec<[f64; 2]>, &str> {
        self.polygon_m
            .iter()
            .map(|text| corner(text).ok_or(text.as_str()))
            .collect()
    }
}

fn corner(text: &str) -> Option<[f64; 2]> {
    let numbers: Result<Vec<f64>, _> = text.split_whitespace().map(str::parse).collect();
    numbers
        .ok()?
        .try_into()
        .ok()
        .filter(|corner: &[f64; 2]| corner.iter().all(|part| part.is_finite()))
}
