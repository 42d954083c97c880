//! Roadside units: stations at fixed places, which were surveyed.

use ipc_schema::{
    config::{RoadsideUnitConfig, V2xConfig},
    traffic::id_hash,
};
use sim_core::scene::Scene;

use crate::{
    radio::obstruction::Antenna,
    station::{OwnMeasurement, PerceptionSpec},
};

/// Farthest road that gives a unit its ground, metres.
const GROUND_REACH_M: f64 = 100.0;
/// Row of no road user.
pub const NO_ROW: u32 = u32::MAX;

/// A roadside unit of the run.
#[derive(Debug, Clone)]
pub struct RoadsideUnit {
    /// As it is configured.
    pub config: RoadsideUnitConfig,
    /// Hash of its name.
    pub id_hash: u64,
    /// Antenna and sensors.
    pub antenna: Antenna,
    /// What it knows of itself.
    pub own: OwnMeasurement,
    /// What it perceives.
    pub perception: PerceptionSpec,
}

impl RoadsideUnit {
    /// A unit on the ground of a scene.
    #[must_use]
    pub fn new(config: &RoadsideUnitConfig, v2x: &V2xConfig, scene: &Scene) -> Self {
        let position_m = [config.x_m, config.y_m];
        let road = scene.road();
        let nearest = || road.nearest(position_m, GROUND_REACH_M, |_| true);
        let ground_m = road
            .flat_height_m()
            .or_else(|| nearest().map(|(_, height_m)| height_m))
            .unwrap_or(0.0);
        let z_m = ground_m + config.height_m;
        let whole_circle = 360.0;
        Self {
            // No road user has this name.
            id_hash: id_hash(&format!("roadside unit {}", config.id)),
            antenna: Antenna {
                position_m,
                z_m,
                row: NO_ROW,
            },
            own: OwnMeasurement {
                fix_m: position_m,
                altitude_m: z_m,
                accuracy_m: Some(0.0),
                heading_rad: config.heading_deg.unwrap_or(0.0).to_radians(),
                ..OwnMeasurement::default()
            },
            perception: PerceptionSpec {
                range_m: config.range_m(),
                position_std_m: v2x.perception_position_std_m,
                speed_std_mps: v2x.perception_speed_std_mps,
                opening_rad: config
                    .field_of_view_deg
                    .filter(|angle| *angle < whole_circle)
                    .map(f64::to_radians),
            },
            config: config.clone(),
        }
    }
}
