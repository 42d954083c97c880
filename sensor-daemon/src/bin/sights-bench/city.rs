//! The city of the measurements.

use ipc_schema::world::{SubStep, VehicleState};
use sim_core::scene::{Road, RoadPiece, Scene, SurfaceKind};

use crate::lidar_city::{self, Moves};

/// What the city stands on, and how vehicles move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ground {
    /// Flat, and all vehicles upright.
    Upright,
    /// Flat, and vehicles that turn and lean.
    Leaning,
    /// Streets that rise and fall by 8 m.
    Hills,
}

impl Ground {
    pub const ALL: [Self; 3] = [Self::Upright, Self::Leaning, Self::Hills];

    pub fn name(self) -> &'static str {
        match self {
            Self::Upright => "upright",
            Self::Leaning => "leaning",
            Self::Hills => "hills",
        }
    }

    pub fn scene(self) -> Scene {
        match self {
            Self::Hills => lidar_city::hilly(),
            _ => paved(),
        }
    }

    /// Road users at the end of a tick. The first `carriers` see nothing of each other: they have no height.
    pub fn traffic(self, scene: &Scene, carriers: usize, tick: u64) -> (Vec<VehicleState>, Vec<SubStep>) {
        let moves = match self {
            Self::Upright => Moves::Straight,
            _ => Moves::Wildly,
        };
        let (mut states, steps) = lidar_city::traffic(200, 0, moves, tick, 2);
        lidar_city::stand_on(scene, &mut states);
        states[..carriers].iter_mut().for_each(|state| state.height_m = 0.0);
        (states, steps)
    }
}

/// The test city with a net: two lanes and two pavements in every street.
fn paved() -> Scene {
    let bare = lidar_city::scene(500, 1);
    let mut pieces = Vec::new();
    for street in 0..17 {
        let at = 50.0 * (f64::from(street) - 8.0);
        for (lane, off) in [-5.0, -2.0, 2.0, 5.0].into_iter().enumerate() {
            for is_north in [false, true] {
                let ends = [-420.0, 420.0].map(|along| {
                    if is_north {
                        [at + off, along, 0.0]
                    } else {
                        [along, at + off, 0.0]
                    }
                });
                let is_lane = off.abs() < 3.0;
                pieces.push(RoadPiece {
                    id: format!("street{street}{is_north}_{lane}"),
                    surface: if is_lane {
                        SurfaceKind::Lane
                    } else {
                        SurfaceKind::Sidewalk
                    },
                    shape_m: ends.to_vec(),
                    half_width_m: Some(if is_lane { 2.0 } else { 1.0 }),
                    junctions: [0; 2],
                });
            }
        }
    }
    Scene::new(Road::new(pieces), bare.buildings().to_vec(), Vec::new())
}
