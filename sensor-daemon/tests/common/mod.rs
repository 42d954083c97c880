//! Common parts of the sensing tests: a map, road users, and a run of ticks with access to the sections of each tick.

#![allow(
    dead_code,
    clippy::unwrap_used,
    reason = "each test uses a part; tests assert by unwrapping"
)]

use ipc_schema::{
    block,
    config::Config,
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::ObservationLayout,
    run::MapInfo,
    traffic::{Kind, id_hash},
    world::{SubStep, VehicleState},
};
use sensor_daemon::sensing::{Sensing, WorldTick};

pub fn config() -> Config {
    Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap()
}

/// The preset without any noise.
pub fn quiet() -> Config {
    let mut config = config();
    config.gnss.noise_std_deg = [0.0; 2];
    config.imu.accel_noise_std_mps2 = [0.0; 3];
    config.imu.gyro_noise_std_radps = [0.0; 3];
    config.imu.compass_noise_std_rad = 0.0;
    config.speed_steering.speed_noise_std_mps = 0.0;
    config.speed_steering.steering_noise_std_rad = 0.0;
    config
}

pub fn map() -> MapInfo {
    MapInfo {
        projection: "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs".into(),
        net_offset_m: [129.0, 126.0],
        bounds_m: [0.0, 0.0, 260.0, 260.0],
        traffic_lights: 0,
        world_origin_m: [0.0; 2],
    }
}

pub fn road_user(number: u32, kind: Kind) -> VehicleState {
    VehicleState {
        x_m: 50.0 + f64::from(number % 100),
        y_m: 80.0,
        yaw_rad: 1.0,
        velocity_body_mps: [7.0, 0.0, 0.0],
        id_hash: id_hash(&format!("cav.{number}")),
        vehicle: number,
        kind: kind as u32,
        ..VehicleState::default()
    }
}

pub fn cavs(count: u32) -> Vec<VehicleState> {
    (0..count).map(|number| road_user(number, Kind::Cav)).collect()
}

/// The payload of one tick, as 8-byte words, which are aligned enough for every section.
pub struct Tick {
    pub n: usize,
    layout: ObservationLayout,
    payload: Vec<u64>,
}

impl Tick {
    pub fn section<T: bytemuck::Pod>(&self, name: &str) -> Vec<T> {
        let (_, place) = self
            .layout
            .named()
            .into_iter()
            .find(|(known, _)| *known == name)
            .unwrap();
        block::view::<T>(bytemuck::cast_slice(&self.payload), place)
            .unwrap()
            .to_vec()
    }

    pub fn bytes(&self) -> &[u64] {
        &self.payload
    }
}

/// A run that advances tick by tick.
pub struct Run {
    pub sensing: Sensing,
    tick: u64,
    seed: u64,
    tick_ns: u64,
    flags: u32,
    stage: u16,
    map: u16,
}

impl Run {
    pub fn new(config: &Config) -> Self {
        Self::with(config, Sensing::new(config, &map()).unwrap())
    }

    pub fn with(config: &Config, sensing: Sensing) -> Self {
        Self {
            sensing,
            tick: 0,
            seed: 5,
            tick_ns: (config.run.tick_s * 1e9) as u64,
            flags: FIRST_OF_EPISODE,
            stage: 0,
            map: 0,
        }
    }

    /// Begins a new episode at time 0.
    pub fn restart(&mut self, seed: u64) {
        self.restart_in(seed, 0, 0);
    }

    /// Begins a new episode in a stage (from 1; 0 is none) and on a map.
    pub fn restart_in(&mut self, seed: u64, stage: u16, map: u16) {
        (self.tick, self.seed, self.flags) = (0, seed, FIRST_OF_EPISODE);
        (self.stage, self.map) = (stage, map);
    }

    pub fn tick(&mut self, states: &[VehicleState]) -> Tick {
        self.tick_with(states, &[], |_| ())
    }

    pub fn tick_with(
        &mut self,
        states: &[VehicleState],
        sub_steps: &[SubStep],
        between: impl FnOnce(&mut Sensing),
    ) -> Tick {
        let header = MessageHeader {
            tick: self.tick,
            sim_time_ns: (self.tick + 1) * self.tick_ns,
            flags: self.flags,
            stage: self.stage,
            map: self.map,
            episode_seed: self.seed,
            ..MessageHeader::default()
        };
        (self.tick, self.flags) = (self.tick + 1, 0);
        let n = self.sensing.assign(&header, states).unwrap();
        between(&mut self.sensing);
        let layout = ObservationLayout::new(n, self.sensing.width(), self.sensing.imu_samples());
        let mut payload = vec![0_u64; layout.len / 8];
        let world = WorldTick {
            states,
            bodies: states,
            sub_steps,
            views: &[],
        };
        self.sensing
            .observe(&header, &world, bytemuck::cast_slice_mut(&mut payload))
            .unwrap();
        Tick { n, layout, payload }
    }
}
