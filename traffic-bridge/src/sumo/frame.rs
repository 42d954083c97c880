//! One SUMO step in SI units and the project's frames.

use std::collections::BTreeMap;

use ipc_schema::{
    lane_position::{LanePosition, NO_INDEX},
    traffic::{
        HeroAdvice, Kind, MetaEvent, SIGNAL_LINKS, SignalMeta, TrafficState, VehicleMeta, id_hash, id_text_bytes,
    },
};

use super::{
    connected::ConnectedRule,
    convention,
    interpolation::VehiclePlace,
    lanes::LanePlace,
    libsumo::ffi::{RawEvent, RawEventKind, RawSignal, RawState},
};

/// All road users on the road after one SUMO step, and what happened in it. Reused from step to step.
#[derive(Debug, Clone, Default)]
pub struct TrafficFrame {
    /// All road users on the road, by ascending dense index.
    pub states: Vec<TrafficState>,
    /// Where each of `states` is on its lane, if lanes are read ([`super::Sumo::read_lanes`]); otherwise empty.
    pub places: Vec<VehiclePlace>,
    /// The road users in SUMO's terms and the persons in vehicles, by ascending dense index, if they are read
    /// ([`super::Sumo::read_positions`]); otherwise empty.
    pub positions: Vec<LanePosition>,
    /// What SUMO's own driver would have done with heroes in this step, if it is asked; otherwise empty.
    pub advice: Vec<HeroAdvice>,
    /// Arrivals, departures and teleports of this step.
    pub events: Vec<VehicleMeta>,
    /// Ids of the road users that departed in this step, in the order of `events`.
    pub departed_ids: Vec<String>,
    /// Traffic lights that changed in this step; in the first step of an episode all of them.
    pub signals: Vec<SignalMeta>,
    /// Simulated time since the start of the episode, seconds.
    pub time_s: f64,
    /// SUMO steps since the start of the episode.
    pub step: u64,
    /// Connected vehicles and heroes among `states`.
    pub cavs: u32,
}

/// Attributes of road users that SUMO reports at their departure and that later steps need, for one episode.
#[derive(Debug)]
pub(crate) struct RoadUserRegister {
    rule: ConnectedRule,
    /// The world frame's (0, 0) in the net's coordinates, metres.
    world_origin_m: [f64; 2],
    /// Of each road user, by its dense index.
    kinds: Vec<Kind>,
    lengths_m: Vec<f64>,
    /// Fill [`TrafficFrame::places`].
    pub(crate) reads_lanes: bool,
    /// Fill [`TrafficFrame::positions`].
    pub(crate) reads_positions: bool,
    id_hashes: Vec<u64>,
    /// Connected vehicles that have departed and not arrived.
    cavs: u32,
    types: BTreeMap<String, u32>,
}

impl RoadUserRegister {
    pub(crate) fn new(rule: ConnectedRule, world_origin_m: [f64; 2]) -> Self {
        Self {
            rule,
            world_origin_m,
            kinds: Vec::new(),
            lengths_m: Vec::new(),
            reads_lanes: false,
            reads_positions: false,
            id_hashes: Vec::new(),
            cavs: 0,
            types: BTreeMap::new(),
        }
    }

    /// Replaces states and events of `frame`.
    pub(crate) fn fill(&mut self, frame: &mut TrafficFrame, states: &[RawState], events: &[RawEvent], step_s: f64) {
        frame.departed_ids.clear();
        let departed = events.iter().filter(|event| event.kind == RawEventKind::Departed);
        frame.departed_ids.extend(departed.map(|event| event.id.clone()));
        frame.events.clear();
        frame.events.extend(events.iter().map(|event| self.meta(event)));
        frame.states.clear();
        frame.places.clear();
        frame.positions.clear();
        frame.cavs = 0;
        for raw in states {
            let kind = self.kind(raw.index);
            if self.reads_positions {
                frame.positions.extend(self.position(raw));
            }
            if let Some(state) = convention::traffic_state(raw, kind, step_s, self.world_origin_m) {
                frame.cavs += u32::from(matches!(kind, Kind::Cav | Kind::Hero));
                frame.states.push(state);
                if self.reads_lanes {
                    frame.places.push(self.place(raw));
                }
            }
        }
    }

    fn kind(&self, index: u32) -> Kind {
        self.kinds.get(index as usize).copied().unwrap_or(Kind::Other)
    }

    /// The road user in SUMO's terms; `None` if it is neither on the road nor in a vehicle.
    fn position(&self, raw: &RawState) -> Option<LanePosition> {
        let index = |place: i32| u32::try_from(place).unwrap_or(NO_INDEX);
        let carrier = index(raw.carrier);
        let nowhere = LanePosition {
            id_hash: self.id_hashes.get(raw.index as usize).copied().unwrap_or(0),
            lane_position_m: f64::NAN,
            odometer_m: f64::NAN,
            vehicle: raw.index,
            lane: NO_INDEX,
            edge: NO_INDEX,
            route_edge: NO_INDEX,
            carrier,
            reserved: 0,
        };
        if !convention::is_on_road(raw) {
            return (carrier != NO_INDEX).then_some(nowhere);
        }
        let edge = index(raw.edge);
        Some(LanePosition {
            lane_position_m: if edge == NO_INDEX { f64::NAN } else { raw.lane_position },
            odometer_m: convention::valid(raw.odometer).unwrap_or(f64::NAN),
            lane: index(raw.lane),
            edge,
            route_edge: index(raw.route_index),
            ..nowhere
        })
    }

    fn place(&self, raw: &RawState) -> VehiclePlace {
        VehiclePlace {
            lane: u32::try_from(raw.lane).ok().map(|lane| LanePlace {
                lane,
                position_m: raw.lane_position,
            }),
            length_m: self.lengths_m.get(raw.index as usize).copied().unwrap_or(0.0),
        }
    }

    fn meta(&mut self, event: &RawEvent) -> VehicleMeta {
        let departed = event.kind == RawEventKind::Departed;
        if departed {
            // The shim assigns indices in order of departure, without gaps.
            self.lengths_m.push(event.length);
            self.kinds.push(if event.is_person {
                Kind::Person
            } else {
                self.rule.kind_of_vehicle(&event.id, self.cavs)
            });
        }
        let is_cav = self.kind(event.index) == Kind::Cav;
        match event.kind {
            RawEventKind::Departed => self.cavs += u32::from(is_cav),
            RawEventKind::Arrived => self.cavs -= u32::from(is_cav),
            _ => {}
        }
        let mut meta = VehicleMeta {
            id_hash: 0,
            vehicle: event.index,
            event: meta_event(event.kind) as u32,
            kind: self.kind(event.index) as u32,
            type_index: if departed {
                self.type_index(&event.vehicle_type)
            } else {
                0
            },
            length_m: convention::single(event.length),
            width_m: convention::single(event.width),
            height_m: convention::single(event.height),
            id_len: 0,
            id: [0; ipc_schema::traffic::ID_BYTES],
            vehicle_class: padded(&event.vehicle_class),
            type_id: padded(&event.vehicle_type),
            type_accel_mps2: convention::single(event.accel),
            type_decel_mps2: convention::single(event.decel),
            type_speed_mps: convention::single(event.max_speed),
            reserved: 0,
        };
        meta.set_id(&event.id);
        if departed {
            self.id_hashes.push(meta.id_hash);
        }
        meta
    }

    fn type_index(&mut self, vehicle_type: &str) -> u32 {
        if let Some(index) = self.types.get(vehicle_type) {
            return *index;
        }
        let index = u32::try_from(self.types.len()).unwrap_or(u32::MAX);
        self.types.insert(vehicle_type.to_owned(), index);
        index
    }
}

/// A traffic light as `traffic-meta` carries it; links beyond its size are counted but cut off.
pub(crate) fn signal_meta(raw: &RawSignal) -> SignalMeta {
    let (id, id_len) = id_text_bytes(&raw.id);
    let mut state = [0; SIGNAL_LINKS];
    let carried = raw.state.len().min(SIGNAL_LINKS);
    state[..carried].copy_from_slice(&raw.state.as_bytes()[..carried]);
    SignalMeta {
        id_hash: id_hash(&raw.id),
        signal: raw.index,
        id_len,
        id,
        links: u32::try_from(raw.state.len()).unwrap_or(u32::MAX),
        reserved: 0,
        state,
    }
}

fn meta_event(kind: RawEventKind) -> MetaEvent {
    match kind {
        RawEventKind::Arrived => MetaEvent::Arrived,
        RawEventKind::Teleported => MetaEvent::Teleported,
        _ => MetaEvent::Departed,
    }
}

/// `text` cut at a character border, zero padded.
fn padded<const N: usize>(text: &str) -> [u8; N] {
    let mut bytes = [0; N];
    let len = text.floor_char_boundary(N);
    bytes[..len].copy_from_slice(&text.as_bytes()[..len]);
    bytes
}
