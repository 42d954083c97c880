//! Carriers beside the road: sensors of a suite at a fixed place, such as on a mast.

use std::{f64::consts::PI, sync::Arc};

use ipc_schema::{
    config::{RoadsideConfig, RoadsidePlace},
    failure::Failure,
    pointcloud::ROADSIDE_CARRIER,
    run::{MapInfo, RunFile},
    sensor::SensorKind,
    traffic::{Kind, id_hash},
    world::VehicleState,
};
use sim_core::{
    geodesy::{GeodesyError, Geodetic, NetPosition, Projection},
    scene::Scene,
};

use crate::{
    mounts::{DueUnit, MountedSuites},
    surroundings::projection_failure,
};

/// The carriers beside the road of a run.
#[derive(Debug)]
pub struct RoadsideCarriers {
    /// Where each stands: a road user without a body.
    states: Vec<VehicleState>,
    /// Place of the suite of each among those of the run.
    suites: Vec<usize>,
    mounted: MountedSuites,
}

impl RoadsideCarriers {
    /// The carriers of a run, on its own map.
    ///
    /// # Errors
    /// One has a longitude and latitude that the map's projection does not know.
    pub fn new(run: &RunFile, scenes: &[Arc<Scene>]) -> Result<Self, Failure> {
        let config = &run.config;
        let (mut states, mut suites) = (Vec::new(), Vec::new());
        for (number, roadside) in (0_u32..).zip(&config.roadsides) {
            let [x_m, y_m] = place_m(roadside, &run.map).map_err(projection_failure)?;
            let ground_m = || scenes.first().map_or(0.0, |scene| scene.ground_height_m(x_m, y_m));
            states.push(VehicleState {
                x_m,
                y_m,
                z_m: roadside.z_m.unwrap_or_else(ground_m),
                yaw_rad: roadside.yaw_deg * PI / 180.0,
                id_hash: id_hash(&roadside.name),
                vehicle: ROADSIDE_CARRIER | number,
                kind: Kind::Other as u32,
                ..VehicleState::default()
            });
            let named = config.suites.iter().position(|suite| suite.name == roadside.suite);
            // Validated: every name is that of a suite.
            suites.push(named.unwrap_or(usize::MAX));
        }
        Ok(Self {
            states,
            suites,
            mounted: MountedSuites::new(config),
        })
    }

    /// Where they stand, in the order of their numbers.
    #[must_use]
    pub fn states(&self) -> &[VehicleState] {
        &self.states
    }

    /// Adds the sensors of this kind that sample at a tick of the episode, on rows behind those of `road_users` road users.
    pub fn add_due(&self, sensor: SensorKind, tick: u32, road_users: usize, due: &mut Vec<DueUnit>) {
        for (number, suite) in self.suites.iter().enumerate() {
            let mounted = self.mounted.due(Some(*suite), sensor, tick);
            due.extend(mounted.map(|(number_of_kind, is_first)| DueUnit {
                slot: None,
                row: road_users + number,
                sensor: number_of_kind,
                is_first,
            }));
        }
    }
}

fn place_m(roadside: &RoadsideConfig, map: &MapInfo) -> Result<[f64; 2], GeodesyError> {
    match roadside.place() {
        Some(RoadsidePlace::Geodetic([longitude_deg, latitude_deg])) => {
            let place = Geodetic {
                latitude_deg,
                longitude_deg,
            };
            let NetPosition { x_m, y_m } = Projection::new(map)?.net_from_geodetic(place)?;
            Ok([x_m, y_m])
        }
        Some(RoadsidePlace::World(place_m)) => Ok(place_m),
        // Validated: one of the two is given.
        None => Ok([0.0; 2]),
    }
}
