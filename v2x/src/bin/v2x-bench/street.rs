//! A grid of streets with houses between them, and the vehicles that drive there.

use std::sync::Arc;

use ipc_schema::{
    config::Config,
    header::{FIRST_OF_EPISODE, MessageHeader},
    neighbours::{NEIGHBOUR_COLUMNS, NEIGHBOUR_ID_COLUMNS, NeighboursSections, RADIO_COLUMNS},
    run::MapInfo,
    world::VehicleState,
};
use sim_core::{
    geodesy::Projection,
    scene::{Prism, Road, Scene, SolidClass},
};
use v2x::{
    exchange::{MessageExchange, SlotMeasurement},
    radio::{
        obstruction::{Antenna, Obstacles},
        path_loss::LinkState,
    },
    station::OwnMeasurement,
};

/// Distance between two streets, metres.
const BLOCK_M: f64 = 100.0;
/// Width of a street between the houses, metres.
const STREET_M: f64 = 20.0;
/// Vehicles on a kilometre of street.
const VEHICLES_PER_KM: f64 = 25.0;
/// Width of a bin of distances, metres.
pub const BIN_M: f64 = 50.0;

/// Streets to the east and north around square houses, as many as `stations` vehicles need.
pub struct StreetGrid {
    streets: usize,
    side_m: f64,
}

impl StreetGrid {
    /// The grid for this many vehicles.
    pub fn new(stations: usize) -> Self {
        // 2 n streets of n blocks have 2 n² blocks of street.
        let blocks = stations as f64 / (VEHICLES_PER_KM * BLOCK_M / 1000.0);
        let streets = (blocks / 2.0).sqrt().ceil().max(1.0) as usize;
        Self {
            streets,
            side_m: streets as f64 * BLOCK_M,
        }
    }

    /// A house in each block.
    pub fn houses(&self) -> Vec<Prism> {
        let side_m = BLOCK_M - STREET_M;
        let corner = |number: usize| number as f64 * BLOCK_M + 0.5 * STREET_M;
        let house = |place: usize| {
            let [x, y] = [corner(place % self.streets), corner(place / self.streets)];
            let outline = vec![[x, y], [x + side_m, y], [x + side_m, y + side_m], [x, y + side_m]];
            Prism::new(format!("house.{place}"), SolidClass::Building, outline, 0.0, 12.0).unwrap()
        };
        (0..self.streets * self.streets).map(house).collect()
    }

    /// A vehicle at a time: it drives along its street at 8 to 14 m/s and begins again at its end.
    pub fn vehicle(&self, number: usize, time_s: f64) -> VehicleState {
        let street = number / 2 % self.streets;
        let speed_mps = 8.0 + (number * 7 % 13) as f64 * 0.5;
        let along_m = ((number * 7919) as f64 * 1.37 + speed_mps * time_s).rem_euclid(self.side_m);
        let across_m = street as f64 * BLOCK_M + if (number / 4).is_multiple_of(2) { -2.0 } else { 2.0 };
        let (x_m, y_m, yaw_rad) = match number % 2 {
            0 => (along_m, across_m, 0.0),
            _ => (across_m, along_m, std::f64::consts::FRAC_PI_2),
        };
        let is_lorry = number.is_multiple_of(15);
        VehicleState {
            x_m,
            y_m,
            yaw_rad,
            id_hash: (number as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15),
            velocity_body_mps: [speed_mps as f32, 0.0, 0.0],
            length_m: if is_lorry { 10.0 } else { 4.5 },
            width_m: if is_lorry { 2.5 } else { 1.8 },
            height_m: if is_lorry { 3.5 } else { 1.5 },
            rear_overhang_m: 1.0,
            vehicle: number as u32,
            ..VehicleState::default()
        }
    }
}

/// Fields of a block of `neighbours`.
pub struct NeighboursBlock {
    pub objects: Vec<[f32; NEIGHBOUR_COLUMNS]>,
    pub ids: Vec<[u32; NEIGHBOUR_ID_COLUMNS]>,
    pub radio: Vec<[u32; RADIO_COLUMNS]>,
    pub channel_load: Vec<f32>,
    vehicle: Vec<u32>,
}

impl NeighboursBlock {
    fn new(vehicles: usize, nearest: usize) -> Self {
        Self {
            objects: vec![[0.0; NEIGHBOUR_COLUMNS]; vehicles * nearest],
            ids: vec![[0; NEIGHBOUR_ID_COLUMNS]; vehicles * nearest],
            radio: vec![[0; RADIO_COLUMNS]; vehicles],
            channel_load: vec![0.0; vehicles],
            vehicle: vec![0; vehicles],
        }
    }
}

/// A tick before its messages are exchanged.
pub struct StreetTick {
    header: MessageHeader,
    pub states: Vec<VehicleState>,
    slots: Vec<SlotMeasurement>,
    pub block: NeighboursBlock,
}

/// Vehicles in the grid that exchange messages.
pub struct StreetRun {
    grid: StreetGrid,
    scene: Arc<Scene>,
    vehicles: usize,
    nearest: usize,
    pub exchange: MessageExchange,
}

impl StreetRun {
    /// Vehicles with this configuration.
    pub fn new(vehicles: usize, config: &Config) -> Self {
        let grid = StreetGrid::new(vehicles);
        let map = MapInfo {
            projection: "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"
                .into(),
            net_offset_m: [0.0; 2],
            world_origin_m: [0.0; 2],
            bounds_m: [0.0, 0.0, grid.side_m, grid.side_m],
            traffic_lights: 0,
        };
        let scene = Arc::new(Scene::new(Road::default(), grid.houses(), Vec::new()));
        let projection = Projection::new(&map).unwrap();
        Self {
            exchange: MessageExchange::new(config, vec![(Arc::clone(&scene), projection)]),
            grid,
            scene,
            vehicles,
            nearest: config.v2x.neighbours as usize,
        }
    }

    /// What is in the way of links.
    pub fn obstacles(&self) -> Obstacles {
        Obstacles::new(&self.scene)
    }

    /// The tick of a number. A vehicle's fix errs by `fix_error_m`.
    pub fn tick(&self, tick: u64, fix_error_m: impl Fn(usize) -> [f64; 2], accuracy_m: f64) -> StreetTick {
        let states: Vec<VehicleState> = (0..self.vehicles)
            .map(|number| self.grid.vehicle(number, tick as f64 * 0.1))
            .collect();
        let measured = |(number, state): (usize, &VehicleState)| {
            let [east_m, north_m] = fix_error_m(number);
            SlotMeasurement {
                vehicle: state.vehicle,
                id_hash: state.id_hash,
                episode_step: tick as u32,
                own: Some(OwnMeasurement {
                    fix_m: [state.x_m + east_m, state.y_m + north_m],
                    accuracy_m: Some(accuracy_m),
                    speed_mps: state.velocity_body_mps[0].into(),
                    heading_rad: state.yaw_rad,
                    ..OwnMeasurement::default()
                }),
            }
        };
        StreetTick {
            header: MessageHeader {
                flags: if tick == 0 { FIRST_OF_EPISODE } else { 0 },
                episode_seed: 5,
                tick,
                sim_time_ns: tick * 100_000_000,
                ..MessageHeader::default()
            },
            slots: states.iter().enumerate().map(measured).collect(),
            block: NeighboursBlock::new(self.vehicles, self.nearest),
            states,
        }
    }

    /// Exchanges the messages of a tick.
    pub fn exchange(&mut self, tick: &mut StreetTick) {
        let block = &mut tick.block;
        let mut sections = NeighboursSections {
            objects: &mut block.objects,
            ids: &mut block.ids,
            radio: &mut block.radio,
            channel_load: &mut block.channel_load,
            vehicle: &mut block.vehicle,
            speech: &mut [],
            achieved: &mut [],
        };
        self.exchange
            .receive(&tick.header, &tick.slots, &tick.states, &mut sections);
        self.exchange.send(&tick.header, &tick.slots, &tick.states);
    }
}

/// Messages that were sent to receivers at a distance, and those that arrived.
#[derive(Default, Clone, Copy)]
pub struct DeliveredShare {
    pub sent: u64,
    pub received: u64,
}

/// Counts what was delivered of the messages of the last tick, by state of the link and distance.
pub fn count(
    exchange: &MessageExchange,
    obstacles: &Obstacles,
    states: &[VehicleState],
    bins: &mut [[DeliveredShare; 10]; 3],
) {
    let antenna = |slot: usize| Antenna {
        position_m: obstacles.bodies()[slot].centre_m,
        z_m: f64::from(states[slot].height_m) + 0.1,
        row: slot as u32,
    };
    for (number, sender) in exchange.senders().enumerate() {
        let from = antenna(sender);
        for receiver in (0..states.len()).filter(|receiver| *receiver != sender) {
            let to = antenna(receiver);
            let [dx, dy] = [0, 1].map(|axis: usize| to.position_m[axis] - from.position_m[axis]);
            let bin = (dx.hypot(dy) / BIN_M) as usize;
            if bin >= 10 {
                continue;
            }
            let row = match obstacles.between(&from, &to).state {
                LinkState::Clear => 0,
                LinkState::Vehicles => 1,
                LinkState::Building => 2,
            };
            let is_received = exchange.received_by(receiver).binary_search(&(number as u32)).is_ok();
            bins[row][bin].sent += 1;
            bins[row][bin].received += u64::from(is_received);
        }
    }
}
