//! What the services of a station send at a tick.

use ipc_schema::{
    config::{RoadsideService, V2xAwareness, V2xConfig, V2xInclusion, V2xListing},
    traffic::class_name,
    world::VehicleState,
};
use sim_core::geodesy::Projection;

use super::{
    SlotMeasurement,
    perception::{Observer, ObservingRadio},
    size_of,
};
use crate::{
    local_map::{HeardObjects, KnownObject},
    message::{
        GeodeticPoint, StationKind,
        geonetworking::{self, BtpPort, PacketHead},
        heading_from_yaw, its_time_ms, wsmp,
    },
    parallel,
    radio::{
        links::Radio,
        medium::QueuedMessage,
        obstruction::Obstacles,
        open_strips::OpenStrips,
        reception::{FRAME_BYTES, air_time_s},
    },
    random::RadioRandom,
    roadside::RoadsideUnit,
    services::{MeasuredMotion, congestion::CongestionControl, cpm::PerceivedMotion},
    station::{
        MessageComposer, OwnMeasurement, Perception, PerceptionSpec, SensorDeviations, Station, VehicleSize, station_id,
    },
};

/// Most objects in a message of an edge service: some 1500 bytes, as many as a frame may have. The others are due at the next tick.
const MOST_FUSED: usize = 50;
/// Bit of the number of a message of the services behind the first two.
const LATER_SERVICE: u32 = 1 << 31;

/// A service that sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SendingService {
    /// Cooperative awareness.
    Cam,
    /// Collective perception.
    Cpm,
    /// Warnings.
    Denm,
    /// Awareness of people.
    Vam,
    /// Basic safety.
    Bsm,
}

impl SendingService {
    /// Number of the message that the service sends at a tick. Random numbers depend on it.
    fn number(self, tick: u32) -> u32 {
        match self {
            Self::Cam => tick << 1,
            Self::Cpm => tick << 1 | 1,
            Self::Denm => LATER_SERVICE | tick << 2,
            Self::Vam => LATER_SERVICE | tick << 2 | 1,
            Self::Bsm => LATER_SERVICE | tick << 2 | 2,
        }
    }

    /// The service of a message of this number.
    #[must_use]
    pub fn of(message: u32) -> Self {
        match (message & LATER_SERVICE != 0, message & 3) {
            (false, 0 | 2) => Self::Cam,
            (false, _) => Self::Cpm,
            (true, 0) => Self::Denm,
            (true, 1) => Self::Vam,
            (true, _) => Self::Bsm,
        }
    }

    /// Bytes of a message before it exists, for the table of congestion control.
    fn typical_bytes(self) -> usize {
        match self {
            Self::Cam => 120,
            Self::Cpm => 400,
            Self::Denm => 130,
            Self::Vam | Self::Bsm => 110,
        }
    }

    /// Its port; none for basic safety, which has packets of its own.
    fn port(self) -> Option<BtpPort> {
        match self {
            Self::Cam => Some(BtpPort::Cam),
            Self::Cpm => Some(BtpPort::Cpm),
            Self::Denm => Some(BtpPort::Denm),
            Self::Vam => Some(BtpPort::Vam),
            Self::Bsm => None,
        }
    }
}

/// A message on its way to the radio.
pub struct OutgoingMessage {
    /// The radio's part.
    pub queued: QueuedMessage,
    /// Its bytes, from the header of the network on.
    pub packet: Vec<u8>,
}

/// What all stations share at a tick.
#[derive(Clone, Copy)]
pub struct StationTick<'a> {
    /// Simulated time, nanoseconds.
    pub now_ns: u64,
    /// Number of the tick.
    pub tick: u32,
    /// What each slot measures.
    pub slots: &'a [SlotMeasurement],
    /// Road users.
    pub states: &'a [VehicleState],
    /// Buildings and road users.
    pub obstacles: &'a Obstacles,
    /// Projection of the map.
    pub projection: &'a Projection,
    /// Random numbers of the episode.
    pub random: &'a RadioRandom,
    /// What sensors deviate by.
    pub deviations: &'a SensorDeviations,
    /// What vehicles perceive.
    pub perception: &'a PerceptionSpec,
    /// Roadside units: their places among the stations follow those of the slots.
    pub roadside: &'a [RoadsideUnit],
    /// Everything that was heard lately.
    pub objects: &'a HeardObjects,
    /// Strips that radios are in.
    pub strips: &'a OpenStrips,
    /// By row in the world: the radio of the road user, or `u32::MAX`.
    pub radio_of_row: &'a [u32],
    /// Which messages are sent.
    pub config: &'a V2xConfig,
}

/// A station with a radio, at a tick.
struct StationTurn<'a> {
    number: u32,
    radio: &'a Radio,
    station: &'a mut Station,
    messages: Vec<OutgoingMessage>,
}

/// Messages that the services of all stations with a radio generate, by radio. `radios` ascend by slot.
pub fn outgoing(
    tick: &StationTick,
    radios: &[Radio],
    stations: &mut [Option<Station>],
    threads: usize,
) -> Vec<OutgoingMessage> {
    let mut next = (0_u32..).zip(radios).peekable();
    let mut turns: Vec<StationTurn> = Vec::with_capacity(radios.len());
    for (slot, station) in stations.iter_mut().enumerate() {
        if let (Some((number, radio)), Some(station)) = (next.next_if(|(_, radio)| radio.slot == slot), station) {
            turns.push(StationTurn {
                number,
                radio,
                station,
                messages: Vec::new(),
            });
        }
    }
    parallel::for_each(threads, &mut turns, |_, turn| turn.generate(tick));
    turns.into_iter().flat_map(|turn| turn.messages).collect()
}

impl StationTurn<'_> {
    fn generate(&mut self, tick: &StationTick) {
        match self.radio.slot.checked_sub(tick.slots.len()) {
            None => self.generate_of_road_user(tick),
            Some(unit) => self.generate_of_roadside(tick, &tick.roadside[unit]),
        }
    }

    fn generate_of_roadside(&mut self, tick: &StationTick, unit: &RoadsideUnit) {
        let composer = MessageComposer {
            station: self.station.station,
            kind: StationKind::ROADSIDE_UNIT,
            now_ns: tick.now_ns,
            own: &unit.own,
            size: &VehicleSize::default(),
            deviations: tick.deviations,
            projection: tick.projection,
        };
        let Some(position) = composer.roadside_cam().map(|cam| cam.position) else {
            return;
        };
        if let Some(warning) = self.station.relay.next_waiting() {
            self.send(tick, &composer, SendingService::Denm, &warning, &position);
        }
        if unit.config.offers(RoadsideService::Cam) {
            self.generate_roadside_cam(tick, &composer);
        }
        if unit.config.offers(RoadsideService::Map) {
            self.generate_map(tick, &composer, unit);
        } else if unit.config.offers(RoadsideService::Cpm) {
            let observer = Observer::of_roadside(unit, self.number, self.station.station, tick);
            self.generate_cpm(tick, &composer, &observer, &unit.perception);
        }
    }

    /// A message with everything that the unit hears and perceives, fused, by the rules for perceived objects. What other units have fused is
    /// not fused again.
    fn generate_map(&mut self, tick: &StationTick, composer: &MessageComposer, unit: &RoadsideUnit) {
        let fuses = |unit: &&RoadsideUnit| unit.config.offers(RoadsideService::Map);
        let others: Vec<u32> = tick
            .roadside
            .iter()
            .filter(fuses)
            .map(|unit| station_id(unit.id_hash))
            .collect();
        let heard = self.station.map.all(tick.objects);
        let mut views: Vec<KnownObject> = heard
            .filter(|view| !others.contains(&view.heard_from))
            .copied()
            .collect();
        if unit.perception.range_m > 0.0 {
            let observer = Observer::of_roadside(unit, self.number, self.station.station, tick);
            let perceived = composer.own_view(&observer.perceive(&unit.perception));
            // The first is the unit itself.
            views.extend(perceived.into_iter().skip(1));
        }
        let now_ms = (tick.now_ns / 1_000_000) as i64;
        let fused = self.station.edge.update(now_ms, &views);
        let objects: Vec<Perception> = fused.iter().map(|object| composer.perception_of(object)).collect();
        let motions: Vec<PerceivedMotion> = objects.iter().map(|object| composer.motion_of(object)).collect();
        let gap_ns = self.gap_ns(SendingService::Cpm);
        let Some(content) = self.station.cpm.check_most(tick.now_ns, &motions, gap_ns, MOST_FUSED) else {
            return;
        };
        let has_sensors = content.has_sensor_information && unit.perception.range_m > 0.0;
        if let Some(cpm) = composer.cpm(&unit.perception, &objects, &content.objects, has_sensors) {
            self.send(tick, composer, SendingService::Cpm, &cpm.encode(), &cpm.position);
        }
    }

    /// What stands still has no news: its messages come once a second (EN 302 637-2, section 6.1.4).
    fn generate_roadside_cam(&mut self, tick: &StationTick, composer: &MessageComposer) {
        let gap_ns = self.gap_ns(SendingService::Cam);
        let motion = composer.own.motion(composer.size);
        if self.station.cam.check(tick.now_ns, &motion, gap_ns).is_none() {
            return;
        }
        if let Some(cam) = composer.roadside_cam() {
            self.send(tick, composer, SendingService::Cam, &cam.encode(), &cam.position);
        }
    }

    fn generate_of_road_user(&mut self, tick: &StationTick) {
        self.station.perceived.clear();
        let Some(own) = &tick.slots[self.radio.slot].own else {
            return;
        };
        let state = &tick.states[self.radio.antenna.row as usize];
        let size = size_of(state);
        let composer = MessageComposer {
            station: self.station.station,
            kind: match self.station.is_person {
                true => StationKind::PEDESTRIAN,
                false => StationKind::of_vehicle(class_name(state.class), size.length_m),
            },
            now_ns: tick.now_ns,
            own,
            size: &size,
            deviations: tick.deviations,
            projection: tick.projection,
        };
        if self.station.is_person {
            self.generate_vam(tick, &composer);
            return;
        }
        if tick.config.denm {
            self.generate_denm(tick, &composer);
        }
        match tick.config.awareness {
            V2xAwareness::Cam => self.generate_cam(tick, &composer),
            V2xAwareness::Bsm => self.generate_bsm(tick, &composer),
        }
        if tick.perception.range_m > 0.0 {
            let observer = Observer::at(
                &self.radio.antenna,
                self.station.station,
                tick.tick,
                tick.states,
                tick.obstacles,
                tick.random,
            );
            let observer = Observer {
                radio: Some(ObservingRadio::new(self.number, tick)),
                ..observer
            };
            self.generate_cpm(tick, &composer, &observer, tick.perception);
        }
    }

    fn generate_cam(&mut self, tick: &StationTick, composer: &MessageComposer) {
        let gap_ns = self.gap_ns(SendingService::Cam);
        let motion = composer.own.motion(composer.size);
        let Some(content) = self.station.cam.check(tick.now_ns, &motion, gap_ns) else {
            return;
        };
        if let Some(cam) = composer.cam(content.has_low_frequency) {
            self.send(tick, composer, SendingService::Cam, &cam.encode(), &cam.position);
        }
    }

    fn generate_denm(&mut self, tick: &StationTick, composer: &MessageComposer) {
        let own = composer.own;
        let Some(content) = self.station.denm.check(tick.now_ns, own.speed_mps, own.accel_mps2) else {
            return;
        };
        self.station.warning = composer.denm(&content, self.station.warning);
        if let Some(denm) = self.station.warning {
            self.send(tick, composer, SendingService::Denm, &denm.encode(), &denm.position);
        }
    }

    fn generate_vam(&mut self, tick: &StationTick, composer: &MessageComposer) {
        let gap_ns = self.gap_ns(SendingService::Vam);
        // A phone measures no speed.
        let motion = MeasuredMotion {
            position_m: composer.own.centre_m(composer.size),
            speed_mps: 0.0,
            heading_rad: composer.own.heading_rad,
        };
        let Some(content) = self.station.vam.check(tick.now_ns, &motion, gap_ns) else {
            return;
        };
        if let Some(vam) = composer.vam(content.has_low_frequency) {
            self.send(tick, composer, SendingService::Vam, &vam.encode(), &vam.position);
        }
    }

    fn generate_bsm(&mut self, tick: &StationTick, composer: &MessageComposer) {
        let gap_ns = self.gap_ns(SendingService::Bsm);
        let Some(count) = self.station.bsm.check(tick.now_ns, gap_ns) else {
            return;
        };
        if let Some(bsm) = composer.bsm(count) {
            self.queue(tick, SendingService::Bsm, wsmp::encode(&bsm.encode()));
        }
    }

    fn generate_cpm(
        &mut self,
        tick: &StationTick,
        composer: &MessageComposer,
        observer: &Observer,
        spec: &PerceptionSpec,
    ) {
        // The messages task has looked already.
        let sighted = self.station.sighted.take();
        let perceived = sighted.unwrap_or_else(|| observer.perceive(spec));
        if tick.config.listing == V2xListing::Separate {
            self.station.perceived = composer.own_view(&perceived);
        }
        let motions: Vec<PerceivedMotion> = perceived.iter().map(|object| composer.motion_of(object)).collect();
        let gap_ns = self.gap_ns(SendingService::Cpm);
        let cpm = &mut self.station.cpm;
        let content = match tick.config.inclusion {
            // Roadside units keep to the rules.
            _ if composer.kind == StationKind::ROADSIDE_UNIT => cpm.check(tick.now_ns, &motions, gap_ns),
            V2xInclusion::Standard => cpm.check(tick.now_ns, &motions, gap_ns),
            V2xInclusion::All => {
                let all = (0..motions.len()).collect();
                cpm.check_chosen(tick.now_ns, &motions, all, gap_ns)
            }
            V2xInclusion::Needed | V2xInclusion::Policy => {
                let chosen = std::mem::take(&mut self.station.chosen);
                cpm.check_chosen(tick.now_ns, &motions, chosen, gap_ns)
            }
        };
        let Some(content) = content else { return };
        let has_sensors = content.has_sensor_information;
        if let Some(cpm) = composer.cpm(spec, &perceived, &content.objects, has_sensors) {
            self.send(tick, composer, SendingService::Cpm, &cpm.encode(), &cpm.position);
        }
    }

    /// Least time between two messages of a service, by congestion control, nanoseconds.
    fn gap_ns(&self, service: SendingService) -> u64 {
        let congestion: &CongestionControl = &self.station.congestion;
        congestion.gap_ns(air_time_s(service.typical_bytes()))
    }

    /// Puts headers before a message, and queues it.
    fn send(
        &mut self,
        tick: &StationTick,
        composer: &MessageComposer,
        service: SendingService,
        message: &[u8],
        place: &GeodeticPoint,
    ) {
        let own: &OwnMeasurement = composer.own;
        let Some(port) = service.port() else { return };
        let head = PacketHead {
            port,
            station: composer.station,
            kind: composer.kind.0,
            time_ms: its_time_ms(tick.now_ns) as u32,
            latitude: place.latitude,
            longitude: place.longitude,
            speed_cmps: (own.speed_mps * 100.0).round().clamp(-16_384.0, 16_383.0) as i16,
            heading: heading_from_yaw(own.heading_rad),
        };
        self.queue(tick, service, geonetworking::encode(&head, message));
    }

    fn queue(&mut self, tick: &StationTick, service: SendingService, packet: Vec<u8>) {
        self.messages.push(OutgoingMessage {
            queued: QueuedMessage {
                radio: self.number,
                station: self.station.station,
                message: service.number(tick.tick),
                ready_ns: self.station.phase_ns,
                bytes: (packet.len() + FRAME_BYTES) as u32,
            },
            packet,
        });
    }
}
