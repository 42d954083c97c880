//! Radars: detections of road users, buildings and props, with the errors of a real waveform.
//!
//! Rays are cast by the kernel of the cameras. The echoes of a resolution cell (range, azimuth, radial velocity) add up; a cell is
//! detected with the probability that Swerling's case 1 gives. Random numbers are keyed by episode, vehicle, tick and cell. Equations and
//! sources: docs/sensor-models.md.

use std::{collections::BTreeMap, f64::consts::TAU, sync::Arc};

use ipc_schema::{
    config::{Config, OWN_SENSOR, RadarConfig},
    pointcloud::{GROUND, STATIC_OBJECT},
    radar::{NO_OBJECT, RadarDetection, RadarScan},
    sensor::NoiseStream,
    world::VehicleState,
};
use sim_core::scene::Scene;

mod equation;

pub use equation::{RadarEquation, from_db, rain_db_per_km, to_db};

use super::camera::{
    CameraModel, CameraParams, CameraPose, CameraScratch, CameraShot, CameraTargets, ImagePlanes, SKY_INSTANCE,
    SemanticLabel, SightScene,
};
use crate::{noise::normals::philox4x32, sensors::lidar::Targets};

/// Rays in a cell of the azimuth, side by side, at least.
const RAYS_PER_CELL: f64 = 8.0;
/// Largest angle between two rays, degrees: a person at 80 m is as wide.
const STEP_DEG: f64 = 0.25;
/// Most rays side by side.
const MOST_COLUMNS: usize = 4096;
/// Cross section of walls for each square metre square to the ray: −10 dB, of the constant-γ model (M. Skolnik, *Introduction to Radar
/// Systems*, 3rd edition, section 7.3). With it a patch returns `γ R² dΩ` under any incidence.
const WALL_GAMMA: f64 = 0.1;

/// A radar and the scene around it; one model serves all vehicles that carry it.
#[derive(Debug)]
pub struct RadarModel {
    eyes: CameraModel,
    equation: RadarEquation,
    mount_m: [f64; 3],
    half_fov_rad: f64,
    /// Directions of the rays in the sensor's frame, of length 1, and the solid angle of each.
    rays: Vec<([f64; 3], f64)>,
    /// Resolution cells of a scan.
    cells: f64,
}

/// Working memory of one thread: empty at first, then kept.
#[derive(Debug, Default)]
pub struct RadarScratch {
    camera: CameraScratch,
    depth_m: Vec<f32>,
    instance: Vec<u32>,
    semantic: Vec<u8>,
    objects: Vec<ipc_schema::image::SeenObject>,
    cells: BTreeMap<CellKey, CellEcho>,
    /// Row of each road user, by index.
    rows: BTreeMap<u32, usize>,
}

/// Range, azimuth and velocity of a resolution cell, in cells.
type CellKey = (u32, i32, i32);

/// The echoes of a resolution cell: sums weighted with the signal to noise ratio.
#[derive(Debug, Clone, Copy, Default)]
struct CellEcho {
    snr: f64,
    distance_m: f64,
    azimuth_rad: f64,
    elevation_rad: f64,
    velocity_mps: f64,
    /// The strongest contribution, and its object.
    strongest: f64,
    object: u32,
}

/// The numbers of a scan: a function of the key, the cell and the number's place.
struct ScanNoise {
    key: [u32; 2],
    stream: u32,
}

impl ScanNoise {
    fn new(episode_seed: u64, id_hash: u64, tick: u64) -> Self {
        let low = |word: u64| [word as u32, (word >> 32) as u32];
        let ([seed0, seed1], [id0, id1], [tick0, tick1]) = (low(episode_seed), low(id_hash), low(tick));
        let drawn = philox4x32([id0, id1, tick0, tick1], [seed0, seed1 ^ NoiseStream::Radar as u32]);
        Self {
            key: [drawn[0], drawn[1]],
            stream: NoiseStream::Radar as u32,
        }
    }

    /// Four uniform numbers in (0, 1).
    fn uniform(&self, cell: u32, part: u32) -> [f64; 4] {
        philox4x32([cell, part, 0, self.stream], self.key).map(|word| (f64::from(word) + 0.5) / 4_294_967_296.0)
    }

    /// Four standard normal numbers (Box and Muller).
    fn normals(&self, cell: u32, part: u32) -> [f64; 4] {
        let [a, b, c, d] = self.uniform(cell, part);
        let pair = |u: f64, v: f64| {
            let (sin, cos) = libm::sincos(TAU * v);
            let radius = (-2.0 * libm::log(u)).sqrt();
            [radius * cos, radius * sin]
        };
        let ([x, y], [z, w]) = (pair(a, b), pair(c, d));
        [x, y, z, w]
    }
}

/// Mean cross section of a class as seen from the front or rear, and from the side, m². Cars and pedestrians: N. Yamada, Y. Tanaka and
/// K. Nishikawa, *Radar Cross Section for Pedestrian in 76 GHz Band*, EuMC 2005 (pedestrians −8 dB m²); T. Schipper et al., *RCS of
/// cars at 76 to 81 GHz*, GeMiC 2011 (cars 10 dB m² along, 20 dB m² broadside). Lorries, buses, trains and two-wheelers are scaled from these.
fn mean_rcs_m2(label: u8) -> [f64; 2] {
    let is = |known: SemanticLabel| label == known as u8;
    if is(SemanticLabel::Person) {
        [0.16, 0.16]
    } else if is(SemanticLabel::Bicycle) || is(SemanticLabel::Motorcycle) {
        [1.0, 5.0]
    } else if [SemanticLabel::Truck, SemanticLabel::Bus, SemanticLabel::Train]
        .into_iter()
        .any(is)
    {
        [30.0, 300.0]
    } else {
        [10.0, 100.0]
    }
}

impl RadarModel {
    /// The radar of a configuration in a scene.
    #[must_use]
    pub fn new(config: &Config, scene: &Scene) -> Self {
        Self::in_sight(config, Arc::new(SightScene::new(config, scene)))
    }

    /// The radar of a configuration in a scene that it shares with others.
    #[must_use]
    pub fn in_sight(config: &Config, sight: Arc<SightScene>) -> Self {
        let radar = &config.radar;
        let equation = RadarEquation::new(radar, config.weather.rain_mmph);
        let params = rays(radar);
        let eyes = CameraModel::in_sight(&params, sight);
        let focal = eyes.focal_px();
        let [width, height] = eyes.size();
        let directions = (0..width * height).map(|pixel| {
            let a = (0.5 * width as f64 - (pixel % width) as f64 - 0.5) / focal;
            let b = (0.5 * height as f64 - (pixel / width) as f64 - 0.5) / focal;
            let length = (1.0 + a * a + b * b).sqrt();
            let solid_angle = 1.0 / (focal * focal * length * length * length);
            ([1.0 / length, a / length, b / length], solid_angle)
        });
        let azimuths = radar.horizontal_fov_deg / radar.azimuth_resolution_deg;
        let ranges = radar.range_m / equation.range_resolution_m;
        Self {
            rays: directions.collect(),
            cells: azimuths * ranges * f64::from(radar.chirps),
            half_fov_rad: 0.5 * radar.horizontal_fov_deg.to_radians(),
            mount_m: [radar.mount[0], radar.mount[1], radar.mount[2]],
            eyes,
            equation,
        }
    }

    /// Its waveform and receiver.
    #[must_use]
    pub fn equation(&self) -> &RadarEquation {
        &self.equation
    }

    /// Resolution cells of a scan.
    #[must_use]
    pub fn cells(&self) -> f64 {
        self.cells
    }

    /// Scans from the road user in `row` at the end of the tick of `states`: fills `detections`, nearest first, and returns the scan's
    /// head. `targets` and `seen` are of the same tick. `None` if there is no such row.
    #[expect(clippy::too_many_arguments, reason = "inputs and outputs of a scan")]
    pub fn scan(
        &self,
        (targets, seen): (&Targets, &CameraTargets),
        states: &[VehicleState],
        row: usize,
        tick: u64,
        episode_seed: u64,
        scratch: &mut RadarScratch,
        detections: &mut Vec<RadarDetection>,
    ) -> Option<RadarScan> {
        let carrier = states.get(row)?;
        let pose = self.eyes.pose_on(targets, row)?;
        detections.clear();
        self.look(seen, row, &pose, scratch);
        self.gather(states, carrier, &pose, scratch);
        let noise = ScanNoise::new(episode_seed, carrier.id_hash, tick);
        for (number, (_, echo)) in (0_u32..).zip(&scratch.cells) {
            detections.extend(self.detection(echo, &noise, number));
        }
        self.false_alarms(&noise, detections);
        detections.sort_by(|a, b| a.distance_m.total_cmp(&b.distance_m));
        let equation = &self.equation;
        Some(RadarScan {
            position_m: pose.position_m(),
            attitude_rad: pose.attitude_rad(),
            id_hash: carrier.id_hash,
            vehicle: carrier.vehicle,
            range_m: equation.range_m as f32,
            range_resolution_m: equation.range_resolution_m as f32,
            velocity_resolution_mps: equation.velocity_resolution_mps as f32,
            velocity_ambiguity_mps: equation.velocity_ambiguity_mps as f32,
            azimuth_resolution_rad: equation.azimuth_resolution_rad as f32,
            sensor: OWN_SENSOR,
            reserved: 0,
        })
    }

    /// Casts the rays.
    fn look(&self, seen: &CameraTargets, row: usize, pose: &CameraPose, scratch: &mut RadarScratch) {
        let count = self.rays.len();
        scratch.depth_m.resize(count, 0.0);
        scratch.instance.resize(count, 0);
        scratch.semantic.resize(count, 0);
        let mut planes = ImagePlanes {
            depth_m: &mut scratch.depth_m,
            instance: &mut scratch.instance,
            semantic: &mut scratch.semantic,
            ..ImagePlanes::default()
        };
        let (camera, objects) = (&mut scratch.camera, &mut scratch.objects);
        let shot = CameraShot {
            noise: None,
            targets: seen,
            tick: None,
            carrier: Some(row),
            pose: *pose,
            past: None,
        };
        self.eyes.take(&shot, camera, &mut planes, objects);
    }

    /// Adds up the echoes of each cell.
    fn gather(&self, states: &[VehicleState], carrier: &VehicleState, pose: &CameraPose, scratch: &mut RadarScratch) {
        scratch.cells.clear();
        scratch.rows.clear();
        scratch
            .rows
            .extend(states.iter().enumerate().map(|(row, state)| (state.vehicle, row)));
        let equation = &self.equation;
        let own_mps = self.own_velocity(carrier);
        for (pixel, (direction, solid_angle)) in self.rays.iter().enumerate() {
            let instance = scratch.instance[pixel];
            let range_m = f64::from(scratch.depth_m[pixel]) / direction[0];
            if instance == SKY_INSTANCE || instance == GROUND || range_m >= equation.range_m {
                continue;
            }
            let ray = pose.world_from_camera(*direction);
            let state = match instance & STATIC_OBJECT {
                0 => scratch.rows.get(&instance).map(|row| &states[*row]),
                _ => None,
            };
            let area_m2 = range_m * range_m * solid_angle;
            let (rcs_m2, velocity) = match state {
                Some(state) => (
                    user_rcs_m2(state, scratch.semantic[pixel], ray, area_m2),
                    velocity_mps(state),
                ),
                None => (WALL_GAMMA * area_m2, [0.0; 2]),
            };
            // Towards the sensor.
            let closing = (0..2).map(|i| (own_mps[i] - velocity[i]) * ray[i]).sum();
            let velocity_mps = equation.folded(closing);
            let azimuth_rad = libm::atan2(direction[1], direction[0]);
            let key = (
                (range_m / equation.range_resolution_m) as u32,
                (azimuth_rad / equation.azimuth_resolution_rad).floor() as i32,
                (velocity_mps / equation.velocity_resolution_mps).round_ties_even() as i32,
            );
            let snr = equation.snr(rcs_m2, range_m);
            let cell = scratch.cells.entry(key).or_default();
            cell.snr += snr;
            cell.distance_m += snr * range_m;
            cell.azimuth_rad += snr * azimuth_rad;
            cell.elevation_rad += snr * libm::asin(direction[2]);
            cell.velocity_mps += snr * velocity_mps;
            if snr > cell.strongest {
                (cell.strongest, cell.object) = (snr, instance);
            }
        }
    }

    /// Velocity of the sensor, east and north: that of its carrier's rear axle, and the turn about it.
    fn own_velocity(&self, carrier: &VehicleState) -> [f64; 2] {
        let (sin, cos) = libm::sincos(carrier.yaw_rad);
        let [x, y, _] = self.mount_m;
        let turn = f64::from(carrier.angular_rate_body_radps[2]);
        let [vx, vy] = velocity_mps(carrier);
        [vx + turn * -(x * sin + y * cos), vy + turn * (x * cos - y * sin)]
    }

    /// The detection of a cell, or none.
    fn detection(&self, echo: &CellEcho, noise: &ScanNoise, number: u32) -> Option<RadarDetection> {
        let power = self.equation.detected_power(echo.snr, noise.uniform(number, 0)[0])?;
        let [range, azimuth, elevation, velocity] = noise.normals(number, 1);
        let mean = |sum: f64| sum / echo.snr;
        Some(self.measured(
            echo.object,
            power,
            [
                mean(echo.distance_m),
                mean(echo.azimuth_rad),
                mean(echo.elevation_rad),
                mean(echo.velocity_mps),
            ],
            [range, azimuth, elevation, velocity],
        ))
    }

    /// A detection with this power over the noise's; `errors` are standard normal numbers.
    fn measured(&self, object_id: u32, power: f64, truth: [f64; 4], errors: [f64; 4]) -> RadarDetection {
        let equation = &self.equation;
        let snr = (power - 1.0).max(1e-3);
        let resolutions = [
            equation.range_resolution_m,
            equation.azimuth_resolution_rad,
            equation.azimuth_resolution_rad,
            equation.velocity_resolution_mps,
        ];
        let rmse = resolutions.map(|resolution| RadarEquation::deviation(resolution, snr));
        let value: [f64; 4] = std::array::from_fn(|i| truth[i] + rmse[i] * errors[i]);
        let distance_m = value[0].max(1e-3);
        RadarDetection {
            object_id,
            existence_probability: (1.0 - libm::exp(-power)) as f32,
            distance_m: distance_m as f32,
            azimuth_rad: value[1] as f32,
            elevation_rad: value[2] as f32,
            position_rmse: [rmse[0], rmse[1], rmse[2]].map(|part| part as f32),
            radial_velocity_mps: equation.folded(value[3]) as f32,
            radial_velocity_rmse_mps: rmse[3] as f32,
            rcs_dbsm: to_db(equation.rcs_m2(snr, distance_m)) as f32,
            snr_db: to_db(snr) as f32,
        }
    }

    /// Adds the cells in which noise alone is detected: their number has Poisson's distribution.
    fn false_alarms(&self, noise: &ScanNoise, detections: &mut Vec<RadarDetection>) {
        let mean = self.equation.false_alarms(self.cells);
        let count = poisson(mean, noise.uniform(u32::MAX, 0)[0]);
        for number in 0..count {
            let [u, v, w, x] = noise.uniform(u32::MAX, 1 + number);
            let truth = [
                u * self.equation.range_m,
                (2.0 * v - 1.0) * self.half_fov_rad,
                0.0,
                (w - 0.5) * self.equation.velocity_ambiguity_mps,
            ];
            let power = self.equation.false_alarm_power(x);
            detections.push(self.measured(NO_OBJECT, power, truth, [0.0; 4]));
        }
    }
}

/// The rays of a radar, as a camera casts them.
fn rays(radar: &RadarConfig) -> CameraParams {
    let half_rad = 0.5 * radar.horizontal_fov_deg.to_radians();
    let tan = |angle: f64| {
        let (sin, cos) = libm::sincos(angle);
        sin / cos
    };
    // Cells are widest ahead: there the tangent grows by as much as the angle.
    let step_rad = (radar.azimuth_resolution_deg / RAYS_PER_CELL)
        .min(STEP_DEG)
        .to_radians();
    let columns = 2.0 * tan(half_rad) / step_rad;
    let width = (columns.ceil() as usize).clamp(8, MOST_COLUMNS);
    let focal_px = 0.5 * width as f64 / tan(half_rad);
    let height = (2.0 * focal_px * tan(0.5 * radar.vertical_fov_deg.to_radians())).ceil() as usize;
    CameraParams {
        width,
        height: height.max(1),
        horizontal_fov_deg: radar.horizontal_fov_deg,
        range_m: radar.range_m,
        distortion: [0.0; 5],
        mount: radar.mount,
        shutter: None,
    }
}

/// Velocity of a road user, east and north, m/s.
fn velocity_mps(state: &VehicleState) -> [f64; 2] {
    let (sin, cos) = libm::sincos(state.yaw_rad);
    let [along, left, _] = state.velocity_body_mps.map(f64::from);
    [along * cos - left * sin, along * sin + left * cos]
}

/// Share of a road user's mean cross section that a ray meets: `area_m2` of the silhouette that it shows from there.
fn user_rcs_m2(state: &VehicleState, label: u8, ray: [f64; 3], area_m2: f64) -> f64 {
    let (sin, cos) = libm::sincos(state.yaw_rad);
    let flat = (ray[0] * ray[0] + ray[1] * ray[1]).sqrt().max(1e-9);
    // Cosine and sine of the aspect: the angle between the ray and the vehicle's axis.
    let along = ((ray[0] * cos + ray[1] * sin) / flat).abs();
    let across = ((ray[1] * cos - ray[0] * sin) / flat).abs();
    let [length_m, width_m, height_m] = [state.length_m, state.width_m, state.height_m].map(f64::from);
    let silhouette_m2 = (length_m * across + width_m * along) * height_m;
    let [front_m2, side_m2] = mean_rcs_m2(label);
    let rcs_m2 = front_m2 * along * along + side_m2 * across * across;
    rcs_m2 * area_m2 / silhouette_m2.max(1e-3)
}

/// A number with Poisson's distribution of this mean, by inversion with a uniform number.
fn poisson(mean: f64, uniform: f64) -> u32 {
    let mean = mean.min(600.0);
    let mut share = libm::exp(-mean);
    let (mut sum, mut count) = (share, 0);
    while uniform > sum && count < 2000 {
        count += 1;
        share *= mean / f64::from(count);
        sum += share;
    }
    count
}
