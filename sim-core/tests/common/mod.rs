//! Synthetic SUMO traffic, and a mirror that follows it.
#![allow(dead_code, reason = "each test uses a part")]
#![allow(clippy::unwrap_used, reason = "test code may assert by unwrapping")]

pub mod preset;

use ipc_schema::{
    block::view,
    config,
    header::MessageHeader,
    traffic::{Kind, MetaEvent, TrafficState, VehicleMeta},
    world::{SubStep, VehicleState},
};
use sim_core::mirror::{Mirror, MirrorSettings};
use sim_core::models::kinematic::KinematicParams;

/// Body of the vehicles in these tests, metres.
pub const LENGTH_M: f64 = 4.3;

pub fn settings(tick_s: f64, sub_steps: u32, ticks_per_step: u32) -> MirrorSettings {
    MirrorSettings {
        vehicle: limits(),
        surface: config::Surface::Dry,
        tick_s,
        sub_steps,
        ticks_per_step,
        hero_driver: config::HeroDriver::Actions,
        suites: None,
        wheel_slip: false,
        most_trailing: 100,
    }
}

/// A mirror with frames of 0.1 s with a preview of 0.5 s: five frames behind.
pub fn previewing() -> Mirror {
    let settings = settings(0.1, 10, 1);
    let vehicle = config::VehicleConfig {
        preview_s: 0.5,
        ..settings.vehicle
    };
    Mirror::new(MirrorSettings { vehicle, ..settings }).unwrap()
}

pub fn limits() -> config::VehicleConfig {
    config::VehicleConfig {
        cav_model: config::SingleTrackModel::Kinematic,
        ..preset::town().vehicle
    }
}

/// The kinematic model with these limits.
pub fn kinematic(limits: &config::VehicleConfig, wheelbase_m: f64) -> KinematicParams {
    KinematicParams {
        wheelbase_m,
        max_road_wheel_angle_rad: limits.max_road_wheel_angle_rad,
        max_road_wheel_rate_radps: limits.max_road_wheel_rate_radps,
        max_accel_mps2: limits.max_accel_mps2,
        max_decel_mps2: limits.max_decel_mps2,
        max_lateral_mps2: 15.0,
        max_curvature_per_m: limits.max_road_wheel_angle_rad.tan() / wheelbase_m,
    }
}

pub fn meta(vehicle: u32, kind: Kind) -> VehicleMeta {
    let mut meta: VehicleMeta = bytemuck::Zeroable::zeroed();
    meta.vehicle = vehicle;
    meta.kind = kind as u32;
    meta.event = MetaEvent::Departed as u32;
    (meta.length_m, meta.width_m, meta.height_m) = (LENGTH_M as f32, 1.8, 1.5);
    meta.vehicle_class[..9].copy_from_slice(b"passenger");
    meta.set_id(&format!("vehicle {vehicle}"));
    meta
}

/// A road as a list of corners, with positions by distance.
pub struct Road(pub Vec<[f64; 2]>);

impl Road {
    /// A straight, an arc of `radius_m` turning left by `angle_rad` in `pieces` straight pieces, and a straight.
    pub fn corner(straight_m: f64, radius_m: f64, angle_rad: f64, pieces: u32) -> Self {
        let mut points = vec![[0.0, 0.0]];
        for i in 0..=pieces {
            let a = angle_rad * f64::from(i) / f64::from(pieces);
            points.push([straight_m + radius_m * a.sin(), radius_m * (1.0 - a.cos())]);
        }
        let last = points[points.len() - 1];
        points.push([
            last[0] + straight_m * angle_rad.cos(),
            last[1] + straight_m * angle_rad.sin(),
        ]);
        Self(points)
    }

    pub fn at(&self, mut s_m: f64) -> [f64; 2] {
        let last = self.0.len() - 2;
        for (i, pair) in self.0.windows(2).enumerate() {
            let (dx, dy) = (pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]);
            let length = dx.hypot(dy);
            if s_m <= length || i == last {
                return [pair[0][0] + dx * s_m / length, pair[0][1] + dy * s_m / length];
            }
            s_m -= length;
        }
        unreachable!("a road has two points")
    }

    /// SUMO's state of a vehicle whose front bumper is at `s_m`: heading from rear bumper to front bumper.
    pub fn state(&self, vehicle: u32, s_m: f64, speed_mps: f64) -> TrafficState {
        let (front, rear) = (self.at(s_m), self.at(s_m - LENGTH_M));
        TrafficState {
            front_x_m: front[0],
            front_y_m: front[1],
            yaw_rad: (front[1] - rear[1]).atan2(front[0] - rear[0]) as f32,
            speed_mps: speed_mps as f32,
            vehicle,
            ..TrafficState::default()
        }
    }
}

/// States along a road with SUMO's Euler update: the new speed moves the vehicle for the whole step.
pub fn drive(road: &Road, start_m: f64, step_s: f64, speeds: &[f64]) -> Vec<TrafficState> {
    let mut s_m = start_m;
    let mut states = vec![road.state(0, s_m, speeds[0])];
    for &speed in &speeds[1..] {
        s_m += speed * step_s;
        states.push(road.state(0, s_m, speed));
    }
    states
}

/// One tick of the world.
pub struct Tick {
    pub states: Vec<VehicleState>,
    pub rows: Vec<SubStep>,
}

/// The world's ticks for one frame.
pub fn frame(mirror: &mut Mirror, header: &MessageHeader, states: &[TrafficState]) -> Vec<Tick> {
    mirror.accept(header, states).unwrap();
    (0..mirror.settings().ticks_per_step)
        .map(|tick| {
            let layout = mirror.layout(tick);
            let mut aligned = Aligned::new(layout.len);
            mirror.write_tick(tick, aligned.bytes()).unwrap();
            Tick {
                states: view(aligned.bytes(), layout.states).unwrap().to_vec(),
                rows: view(aligned.bytes(), layout.sub_steps).unwrap().to_vec(),
            }
        })
        .collect()
}

/// Bytes aligned for every payload type.
pub struct Aligned(Vec<u128>, usize);

impl Aligned {
    pub fn new(len: usize) -> Self {
        Self(vec![0; len.div_ceil(16)], len)
    }

    pub fn bytes(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.0)[..self.1]
    }
}

/// The ticks of one vehicle with SUMO's `states`.
pub fn mirror_one(settings: MirrorSettings, states: &[TrafficState]) -> (Vec<VehicleState>, Vec<SubStep>) {
    let mut mirror = Mirror::new(settings).unwrap();
    mirror
        .apply_meta(&MessageHeader::default(), &[meta(0, Kind::Cav)])
        .unwrap();
    let (mut all, mut rows) = (Vec::new(), Vec::new());
    for state in states {
        for tick in frame(&mut mirror, &MessageHeader::default(), &[*state]) {
            all.extend(tick.states);
            rows.extend(tick.rows);
        }
    }
    (all, rows)
}

/// Largest lateral and longitudinal tracking error, metres.
pub fn worst(states: &[VehicleState]) -> (f32, f32) {
    states.iter().fold((0.0_f32, 0.0_f32), |(lat, long), s| {
        (
            lat.max(s.tracking_lateral_m.abs()),
            long.max(s.tracking_longitudinal_m.abs()),
        )
    })
}
