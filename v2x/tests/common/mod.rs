//! What the tests of the exchange share: the preset with radios, a projection, cars.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

use ipc_schema::{config::Config, run::MapInfo, world::VehicleState};
use sim_core::geodesy::Projection;

/// The preset with radios, without fading.
pub fn config() -> Config {
    let mut config = Config::from_json(include_str!("../../../ipc-schema/tests/town.json")).unwrap();
    config.v2x.share = 1.0;
    config.v2x.fading = false;
    config
}

pub fn projection() -> Projection {
    let map = MapInfo {
        projection: "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs".into(),
        net_offset_m: [129.0, 126.0],
        world_origin_m: [0.0; 2],
        bounds_m: [0.0, 0.0, 260.0, 260.0],
        traffic_lights: 0,
    };
    Projection::new(&map).unwrap()
}

pub fn car(number: u32, x_m: f64, y_m: f64, speed_mps: f32) -> VehicleState {
    VehicleState {
        x_m,
        y_m,
        id_hash: 1000 + u64::from(number),
        velocity_body_mps: [speed_mps, 0.0, 0.0],
        length_m: 4.5,
        width_m: 1.8,
        height_m: 1.5,
        rear_overhang_m: 1.0,
        vehicle: number,
        ..VehicleState::default()
    }
}
