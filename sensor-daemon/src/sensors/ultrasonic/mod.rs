//! Ultrasonic sensors in the bumpers of connected vehicles: the range of the first echo of each.
//!
//! A sensor hears in an elliptic cone whose axis is level. Its echo comes from the closest point of a building, a prop or a road user in
//! that cone ([`cone`]). Walls that are seen at more than 60° return nothing. Own body, ground and meshes return nothing.

use std::sync::Arc;

use ipc_schema::{
    config::{Config, ULTRASONIC_MOUNTS},
    header::MessageHeader,
    sensor::{NoiseStream, SensorKind},
    world::VehicleState,
};
use sim_core::scene::{Scene, Solid, shape::Bounds, shape::Point};

use crate::{noise::RandomStream, sensing::Sensing, tick::TickTime};

mod bodies;
pub mod cone;
#[cfg(test)]
mod tests;

use bodies::MovingBodies;
use cone::{ConeOpening, EchoSearch, SensorAxis};

/// Range that each mount measures, metres; the end of the range stands for no echo.
pub type UltrasonicRanges = [f32; ULTRASONIC_MOUNTS];

/// Normal numbers in a block of a noise stream.
const BLOCK: usize = 4;
/// Blocks of normal numbers in a sample.
const BLOCKS: u32 = (ULTRASONIC_MOUNTS / BLOCK) as u32;

/// A mount as configured.
#[derive(Debug, Clone, Copy, PartialEq)]
struct UltrasonicMount {
    /// Shares of half the length and of half the width.
    place: Point,
    /// Unit vector along its axis, forward and left.
    ahead: Point,
}

/// The ultrasonic sensors of a vehicle as configured.
#[derive(Debug, Clone, PartialEq)]
pub struct UltrasonicModel {
    mounts: Vec<UltrasonicMount>,
    height_m: f64,
    opening: ConeOpening,
    /// Nearest and farthest range that is measured, metres.
    range_m: [f64; 2],
}

impl UltrasonicModel {
    /// The sensors as configured.
    #[must_use]
    pub fn new(config: &Config) -> Self {
        let params = &config.ultrasonic;
        let mount = |index: usize| {
            let (sin, cos) = libm::sincos(params.mount_yaw_deg[index].to_radians());
            UltrasonicMount {
                place: [params.mount_ahead[index], params.mount_left[index]],
                ahead: [cos, sin],
            }
        };
        Self {
            mounts: (0..ULTRASONIC_MOUNTS.min(params.mounts as usize)).map(mount).collect(),
            height_m: params.mount_height_m,
            opening: ConeOpening::new(params.horizontal_half_angle_deg, params.vertical_half_angle_deg),
            range_m: [params.min_range_m, params.range_m],
        }
    }

    /// Position and axis of each sensor of a vehicle, in the order of the mounts. Roll and pitch move a sensor up and down and leave its
    /// axis level.
    pub fn axes(&self, carrier: &VehicleState) -> impl Iterator<Item = SensorAxis> {
        let (sin, cos) = libm::sincos(carrier.yaw_rad);
        let [half_length_m, half_width_m] = [carrier.length_m, carrier.width_m].map(|size_m| 0.5 * f64::from(size_m));
        let centre_m = half_length_m - f64::from(carrier.rear_overhang_m);
        let [sin_pitch, sin_roll] =
            [carrier.pitch_rad, carrier.roll_rad].map(|angle_rad| libm::sin(f64::from(angle_rad)));
        self.mounts.iter().map(move |mount| {
            let ahead_m = centre_m + mount.place[0] * half_length_m;
            let left_m = mount.place[1] * half_width_m;
            let [x, y] = mount.ahead;
            SensorAxis {
                place_m: [
                    carrier.x_m + ahead_m * cos - left_m * sin,
                    carrier.y_m + ahead_m * sin + left_m * cos,
                ],
                z_m: carrier.z_m + self.height_m + ahead_m * sin_pitch + left_m * sin_roll,
                ahead: [x * cos - y * sin, x * sin + y * cos],
            }
        })
    }

    /// The value that a sensor delivers: the range of its echo with the error `error_m`, within the ranges that it measures.
    #[must_use]
    pub fn reading(&self, echo_m: Option<f64>, error_m: f64) -> f32 {
        let [nearest_m, farthest_m] = self.range_m;
        echo_m.map_or(farthest_m, |echo_m| (echo_m + error_m).max(nearest_m).min(farthest_m)) as f32
    }
}

/// Standard normal numbers of a sample, one for each mount.
#[must_use]
pub fn normals(now: &TickTime, id_hash: u64) -> [f64; ULTRASONIC_MOUNTS] {
    let stream = RandomStream {
        episode_seed: now.episode_seed,
        id_hash,
        sensor: NoiseStream::Ultrasonic,
    };
    let mut normals = [0.0; ULTRASONIC_MOUNTS];
    for (block, places) in (0..BLOCKS).zip(normals.chunks_exact_mut(BLOCK)) {
        let drawn = stream.normals(now.tick.wrapping_mul(BLOCKS).wrapping_add(block));
        places.copy_from_slice(&drawn.map(f64::from));
    }
    normals
}

/// The ultrasonic sensors of a run.
pub struct UltrasonicSampling {
    model: UltrasonicModel,
    /// Standard deviation of the range in each stage of the curriculum, metres; the first is that of the base configuration.
    noise_std_m: Vec<f64>,
    /// Scene of each map of the run.
    scenes: Vec<Arc<Scene>>,
    bodies: MovingBodies,
    /// Slot and row of each carrier that samples.
    carriers: Vec<(usize, usize)>,
    /// Numbers of the solids near a carrier.
    near: Vec<u32>,
}

impl UltrasonicSampling {
    /// Sensors as configured, in the scenes of the run's maps.
    #[must_use]
    pub fn new(config: &Config, scenes: &[Arc<Scene>]) -> Self {
        let noise_std_m = |stage| config.in_stage(stage).ultrasonic.range_noise_std_m;
        Self {
            model: UltrasonicModel::new(config),
            noise_std_m: (0..=config.curriculum.stages.len()).map(noise_std_m).collect(),
            scenes: scenes.to_vec(),
            bodies: MovingBodies::default(),
            carriers: Vec::new(),
            near: Vec::new(),
        }
    }

    /// Samples every carrier that is due at the tick of the last [`Sensing::assign`], and passes the ranges to `sensing`.
    pub fn sample(&mut self, header: &MessageHeader, states: &[VehicleState], sensing: &mut Sensing) {
        self.carriers.clear();
        self.carriers.extend(sensing.carriers_due(SensorKind::Ultrasonic));
        if self.carriers.is_empty() {
            return;
        }
        self.bodies.update(states);
        let now = sensing.now(header);
        let noise_std_m = self
            .noise_std_m
            .get(usize::from(header.stage))
            .copied()
            .unwrap_or_default();
        let map = usize::from(header.map).min(self.scenes.len().saturating_sub(1));
        let carriers = std::mem::take(&mut self.carriers);
        for &(slot, row) in &carriers {
            let normals = match noise_std_m > 0.0 {
                true => normals(&now, states[row].id_hash),
                false => [0.0; ULTRASONIC_MOUNTS],
            };
            let errors_m = normals.map(|normal| noise_std_m * normal);
            let ranges_m = self.ranges_m(map, &states[row], row, &errors_m);
            if let Some(readings) = sensing.readings_mut(slot) {
                readings.ultrasonic_m = ranges_m;
            }
        }
        self.carriers = carriers;
    }

    /// What the sensors of a vehicle measure with these errors.
    fn ranges_m(
        &mut self,
        map: usize,
        carrier: &VehicleState,
        row: usize,
        errors_m: &[f64; ULTRASONIC_MOUNTS],
    ) -> UltrasonicRanges {
        let [_, farthest_m] = self.model.range_m;
        let mut ranges_m = [farthest_m as f32; ULTRASONIC_MOUNTS];
        let scene = self.scenes.get(map);
        if let Some(scene) = scene {
            let reach_m = farthest_m + f64::from(carrier.length_m) + f64::from(carrier.width_m);
            scene.solids_near(&Bounds::about([carrier.x_m, carrier.y_m], reach_m), &mut self.near);
        }
        for ((range_m, error_m), axis) in ranges_m.iter_mut().zip(errors_m).zip(self.model.axes(carrier)) {
            let mut search = EchoSearch::new(self.model.opening, axis, farthest_m);
            let heard = Bounds::about(axis.place_m, farthest_m);
            for number in &self.near {
                if let Some(scene) = scene {
                    reflect(&scene.solid(*number), &heard, &mut search);
                }
            }
            for body in self.bodies.near(axis.place_m, farthest_m) {
                if body.row != row {
                    body.reflect(&mut search);
                }
            }
            *range_m = self.model.reading(search.range_m(), *error_m);
        }
        ranges_m
    }
}

/// Adds a building or a prop to a search if it meets `heard`. A prop with a square footprint is round: cones, posts and trees are.
fn reflect(solid: &Solid<'_>, heard: &Bounds, search: &mut EchoSearch) {
    match solid {
        Solid::Building(building) if building.bounds.meets(heard) => search.prism(&building.outline_m, building.z_m()),
        Solid::Prop(prop) if prop.body.bounds().meets(heard) => {
            let [half_length_m, half_width_m] = prop.body.half_m;
            if half_length_m == half_width_m {
                search.cylinder(prop.body.centre_m, half_width_m, prop.body.z_m);
            } else {
                search.prism(&prop.body.corners(), prop.body.z_m);
            }
        }
        Solid::Building(_) | Solid::Prop(_) => {}
    }
}
