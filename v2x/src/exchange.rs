//! One tick of messages: what has arrived goes into the stations' maps, the maps into `neighbours`, and what is due goes on air.
//!
//! A message is made from what its station measured at a tick. It is sent and received before the next tick, whose `neighbours` show it.

use std::sync::Arc;

use ipc_schema::{
    config::{Config, V2xConfig},
    header::{FIRST_OF_EPISODE, MessageHeader},
    neighbours::{NeighboursSections, RADIO_COLUMNS},
    observation::EMPTY_SLOT,
    traffic::Kind,
    world::VehicleState,
};
use serde::{Deserialize, Serialize};
use sim_core::{
    geodesy::Projection,
    scene::{Scene, shape::Bounds},
};

use crate::{
    local_map::{KnownObject, LocalMap},
    message::{
        StationKind,
        cam::Cam,
        cpm::Cpm,
        geonetworking::{self, BtpPort, PacketHead},
    },
    parallel,
    radio::{
        fading,
        medium::{Medium, MediumLink, OnAir, QueuedMessage, Schedule},
        milliwatts, noise_dbm,
        obstruction::{Antenna, Obstacles},
        path_loss::{LinkState, decorrelation_m, path_loss_db, shadowing_std_db, vehicle_loss_db},
        reception::{FRAME_BYTES, air_time_s},
        shadowing::ShadowingField,
    },
    random::{LinkKey, RadioDraw, RadioRandom},
    services::{
        cam::CamService,
        congestion::CongestionControl,
        cpm::{CpmService, ObjectKind, PerceivedMotion},
    },
    station::{
        MessageComposer, OwnMeasurement, Perception, PerceptionSpec, SensorDeviations, Station, VehicleSize,
        object_of_cam, objects_of_cpm, rotate, station_id,
    },
};

/// Height of an antenna above the roof, metres.
const ANTENNA_M: f64 = 0.1;
/// Length from which a vehicle calls itself a lorry, metres.
const TRUCK_LENGTH_M: f64 = 7.0;

/// A slot as it is measured at a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SlotMeasurement {
    /// Dense index of its vehicle, or [`EMPTY_SLOT`].
    pub vehicle: u32,
    /// Hash of its vehicle's SUMO id.
    pub id_hash: u64,
    /// Ticks since the vehicle took the slot.
    pub episode_step: u32,
    /// What it measures; `None` before its receiver has delivered a fix.
    pub own: Option<OwnMeasurement>,
}

/// Counts of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ExchangeCounts {
    /// Cooperative awareness messages sent.
    pub cams: u64,
    /// Collective perception messages sent.
    pub cpms: u64,
    /// Bytes of them, headers included.
    pub bytes: u64,
    /// Messages that found no time to be sent.
    pub dropped: u64,
    /// Links computed.
    pub links: u64,
    /// Receptions, one for each message and receiver.
    pub received: u64,
}

/// A message as its receivers read it.
#[derive(Debug, Clone)]
struct HeardMessage {
    /// Slot of its sender.
    sender: usize,
    objects: Vec<KnownObject>,
}

/// What a slot's radio did in the tick before.
#[derive(Debug, Clone, Copy, Default)]
struct RadioActivity {
    sent: u32,
    bytes: u32,
    received: u32,
    load: f32,
}

/// A map of the run.
struct ExchangeMap {
    obstacles: Obstacles,
    projection: Projection,
}

/// The messages of a run.
pub struct MessageExchange {
    config: V2xConfig,
    deviations: SensorDeviations,
    perception: PerceptionSpec,
    medium: Medium,
    maps: Vec<ExchangeMap>,
    /// Index of the map of the episode.
    at: usize,
    random: RadioRandom,
    shadowing: ShadowingField,
    /// By slot.
    stations: Vec<Option<Station>>,
    activity: Vec<RadioActivity>,
    /// Messages of the tick before.
    heard: Vec<HeardMessage>,
    /// By slot: the messages that it received in the tick before.
    inbox: Vec<Vec<u32>>,
    /// Row in the world of each slot's vehicle.
    rows: Vec<Option<u32>>,
    counts: ExchangeCounts,
}

/// A radio of a tick.
#[derive(Debug, Clone, Copy)]
struct Radio {
    slot: usize,
    antenna: Antenna,
}

/// A message on its way to the radio.
struct OutgoingMessage {
    queued: QueuedMessage,
    packet: Vec<u8>,
}

impl MessageExchange {
    /// The messages of a run with this configuration, on its maps.
    #[must_use]
    pub fn new(config: &Config, maps: Vec<(Arc<Scene>, Projection)>) -> Self {
        let v2x = config.v2x.clone();
        let random = RadioRandom::new(0);
        Self {
            deviations: SensorDeviations::new(config),
            perception: PerceptionSpec {
                range_m: v2x.perception_range_m,
                position_std_m: v2x.perception_position_std_m,
                speed_std_mps: v2x.perception_speed_std_mps,
            },
            medium: Medium::new(
                noise_dbm(v2x.noise_figure_db),
                v2x.carrier_sense_dbm,
                (config.run.tick_s * 1e9).round() as u64,
            ),
            maps: maps
                .into_iter()
                .map(|(scene, projection)| ExchangeMap {
                    obstacles: Obstacles::new(scene),
                    projection,
                })
                .collect(),
            at: 0,
            shadowing: ShadowingField::new(&random),
            random,
            stations: Vec::new(),
            activity: Vec::new(),
            heard: Vec::new(),
            inbox: Vec::new(),
            rows: Vec::new(),
            counts: ExchangeCounts::default(),
            config: v2x,
        }
    }

    /// Counts so far.
    #[must_use]
    pub fn counts(&self) -> ExchangeCounts {
        self.counts
    }

    /// Continues counting.
    pub fn set_counts(&mut self, counts: ExchangeCounts) {
        self.counts = counts;
    }

    /// Slots of the senders of the messages of the last [`MessageExchange::send`], by the beginning of the message.
    pub fn senders(&self) -> impl Iterator<Item = usize> {
        self.heard.iter().map(|message| message.sender)
    }

    /// Places among [`MessageExchange::senders`] of the messages that a slot has received, ascending.
    #[must_use]
    pub fn received_by(&self, slot: usize) -> &[u32] {
        self.inbox.get(slot).map_or(&[], Vec::as_slice)
    }

    /// What a slot's radio knows; `None` for an empty slot.
    #[must_use]
    pub fn map_of(&self, slot: usize) -> Option<&LocalMap> {
        self.stations.get(slot)?.as_ref().map(|station| &station.map)
    }

    /// Takes the slots of a tick and what has arrived since the tick before, and writes `neighbours` into zeroed sections.
    pub fn receive(
        &mut self,
        header: &MessageHeader,
        slots: &[SlotMeasurement],
        states: &[VehicleState],
        out: &mut NeighboursSections,
    ) {
        if header.has(FIRST_OF_EPISODE) {
            self.begin_episode(header);
        }
        self.take_slots(slots, states);
        let now_ms = (header.sim_time_ns / 1_000_000) as i64;
        let lifetime_ms = (self.config.object_lifetime_s * 1000.0) as i64;
        let (heard, inbox) = (&self.heard, &self.inbox);
        parallel::for_each(self.config.threads as usize, &mut self.stations, |slot, station| {
            let Some(station) = station else { return };
            for message in inbox.get(slot).into_iter().flatten() {
                for object in &heard[*message as usize].objects {
                    station.map.insert(*object);
                }
            }
            station.map.forget(now_ms, lifetime_ms);
        });
        for (station, activity) in self.stations.iter_mut().zip(&self.activity) {
            if let Some(station) = station {
                station.congestion.measure(header.sim_time_ns, activity.load.into());
            }
        }
        self.write(slots, states, now_ms, out);
    }

    fn begin_episode(&mut self, header: &MessageHeader) {
        self.random = RadioRandom::new(header.episode_seed);
        self.shadowing = ShadowingField::new(&self.random);
        self.at = usize::from(header.map).min(self.maps.len() - 1);
        self.stations.fill(None);
        self.activity.fill(RadioActivity::default());
        self.heard.clear();
        self.inbox.iter_mut().for_each(Vec::clear);
    }

    /// Gives each slot its station; one whose vehicle is new begins with an empty map.
    fn take_slots(&mut self, slots: &[SlotMeasurement], states: &[VehicleState]) {
        self.stations.resize(slots.len(), None);
        self.activity.resize(slots.len(), RadioActivity::default());
        self.inbox.resize(slots.len(), Vec::new());
        self.rows.clear();
        self.rows.resize(slots.len(), None);
        // Dense indices of vehicles → rows.
        let most = states
            .iter()
            .map(|state| state.vehicle)
            .max()
            .map_or(0, |most| most as usize + 1);
        let mut row_of = vec![u32::MAX; most];
        for (row, state) in (0_u32..).zip(states) {
            row_of[state.vehicle as usize] = row;
        }
        for (slot, measured) in slots.iter().enumerate() {
            let row = row_of
                .get(measured.vehicle as usize)
                .copied()
                .filter(|row| *row != u32::MAX);
            self.rows[slot] = row;
            let is_vehicle = row.is_some_and(|row| states[row as usize].kind != Kind::Person as u32);
            if measured.vehicle == EMPTY_SLOT || !is_vehicle {
                self.stations[slot] = None;
                continue;
            }
            let is_same = self.stations[slot]
                .as_ref()
                .is_some_and(|station| station.id_hash == measured.id_hash);
            if !is_same || measured.episode_step == 0 {
                self.stations[slot] = Some(self.begin_station(measured.id_hash));
                self.activity[slot] = RadioActivity::default();
                self.inbox[slot].clear();
            }
        }
    }

    fn begin_station(&self, id_hash: u64) -> Station {
        let station = station_id(id_hash);
        let key = LinkKey {
            sender: station,
            ..LinkKey::default()
        };
        let [equipped, ..] = self.random.uniforms(key, RadioDraw::Equipped, 0);
        let [phase, ..] = self.random.uniforms(key, RadioDraw::Phase, 0);
        Station {
            id_hash,
            station,
            is_equipped: equipped < self.config.share,
            phase_ns: (phase * self.medium.tick_ns as f64) as u64,
            cam: CamService::default(),
            cpm: CpmService::default(),
            congestion: CongestionControl::new(self.config.congestion_control),
            map: LocalMap::default(),
        }
    }

    fn write(&mut self, slots: &[SlotMeasurement], states: &[VehicleState], now_ms: i64, out: &mut NeighboursSections) {
        let count = self.config.neighbours as usize;
        struct WrittenRow<'a> {
            objects: &'a mut [[f32; ipc_schema::neighbours::NEIGHBOUR_COLUMNS]],
            ids: &'a mut [[u32; ipc_schema::neighbours::NEIGHBOUR_ID_COLUMNS]],
            radio: &'a mut [u32; RADIO_COLUMNS],
        }
        let mut rows: Vec<WrittenRow> = out
            .objects
            .chunks_mut(count)
            .zip(out.ids.chunks_mut(count))
            .zip(out.radio.iter_mut())
            .map(|((objects, ids), radio)| WrittenRow { objects, ids, radio })
            .collect();
        let (stations, activity, at_row) = (&self.stations, &self.activity, &self.rows);
        parallel::for_each(self.config.threads as usize, &mut rows, |slot, row| {
            let Some(station) = &stations[slot] else { return };
            let done = activity[slot];
            *row.radio = [
                station.is_equipped.into(),
                station.map.len() as u32,
                done.sent,
                done.bytes,
                done.received,
            ];
            let (Some(own), Some(world)) = (&slots[slot].own, at_row[slot]) else {
                return;
            };
            let size = size_of(&states[world as usize]);
            let mut nearest = Vec::new();
            station.map.nearest(own.centre_m(&size), now_ms, count, &mut nearest);
            for (place, object) in nearest.iter().enumerate() {
                (row.objects[place], row.ids[place]) = object.columns(now_ms);
            }
        });
        for (slot, measured) in slots.iter().enumerate() {
            out.vehicle[slot] = measured.vehicle;
            out.channel_load[slot] = self.activity[slot].load;
        }
    }

    /// Sends what is due after the tick, and finds out which stations receive it. Call it after [`MessageExchange::receive`].
    pub fn send(&mut self, header: &MessageHeader, slots: &[SlotMeasurement], states: &[VehicleState]) {
        self.maps[self.at].obstacles.update(states);
        let radios = self.radios(states);
        let outgoing = self.outgoing(header, slots, states, &radios);
        self.activity.fill(RadioActivity::default());
        let queue: Vec<QueuedMessage> = outgoing.iter().map(|message| message.queued).collect();
        let links = self.links(&queue, &radios);
        let schedule = self.medium.schedule(&queue, &links, &self.random);
        self.deliver(header, &outgoing, &queue, &links, &schedule, &radios);
        let loads = self.medium.channel_load(&schedule, &queue, &links, radios.len());
        for (radio, load) in radios.iter().zip(loads) {
            self.activity[radio.slot].load = load;
        }
    }

    /// Radios of the equipped stations, by slot.
    fn radios(&self, states: &[VehicleState]) -> Vec<Radio> {
        let bodies = self.maps[self.at].obstacles.bodies();
        let radio = |(slot, station): (usize, &Option<Station>)| {
            let row = self.rows[slot]?;
            station.as_ref().filter(|station| station.is_equipped)?;
            let state = &states[row as usize];
            Some(Radio {
                slot,
                antenna: Antenna {
                    position_m: bodies[row as usize].centre_m,
                    z_m: state.z_m + f64::from(state.height_m) + ANTENNA_M,
                    row,
                },
            })
        };
        self.stations.iter().enumerate().filter_map(radio).collect()
    }

    /// Messages that the services of all stations generate.
    fn outgoing(
        &mut self,
        header: &MessageHeader,
        slots: &[SlotMeasurement],
        states: &[VehicleState],
        radios: &[Radio],
    ) -> Vec<OutgoingMessage> {
        let ExchangeMap { obstacles, projection } = &self.maps[self.at];
        let (random, deviations, perception) = (&self.random, &self.deviations, &self.perception);
        let tick = (header.sim_time_ns / self.medium.tick_ns) as u32;
        struct StationTurn<'a> {
            radio: u32,
            station: &'a mut Station,
            messages: Vec<OutgoingMessage>,
        }
        let mut places = radios.iter().enumerate().peekable();
        let mut turns: Vec<StationTurn> = Vec::with_capacity(radios.len());
        for (slot, station) in self.stations.iter_mut().enumerate() {
            if let (Some((place, _)), Some(station)) = (places.next_if(|(_, radio)| radio.slot == slot), station) {
                turns.push(StationTurn {
                    radio: place as u32,
                    station,
                    messages: Vec::new(),
                });
            }
        }
        parallel::for_each(self.config.threads as usize, &mut turns, |_, turn| {
            let radio = &radios[turn.radio as usize];
            let Some(own) = &slots[radio.slot].own else { return };
            let state = &states[radio.antenna.row as usize];
            let size = size_of(state);
            let (station, now_ns) = (&mut *turn.station, header.sim_time_ns);
            let kind = match size.length_m > TRUCK_LENGTH_M {
                true => StationKind::HEAVY_TRUCK,
                false => StationKind::PASSENGER_CAR,
            };
            let composer = MessageComposer {
                station: station.station,
                kind,
                now_ns,
                own,
                size: &size,
                deviations,
                projection,
            };
            let mut emit = |service: u32, port: BtpPort, message: Vec<u8>, place: &crate::message::GeodeticPoint| {
                let head = PacketHead {
                    port,
                    station: station.station,
                    kind: kind.0,
                    time_ms: crate::message::its_time_ms(now_ns) as u32,
                    latitude: place.latitude,
                    longitude: place.longitude,
                    speed_cmps: (own.speed_mps * 100.0).round().clamp(-16_384.0, 16_383.0) as i16,
                    heading: crate::message::heading_from_yaw(own.heading_rad),
                };
                let packet = geonetworking::encode(&head, &message);
                turn.messages.push(OutgoingMessage {
                    queued: QueuedMessage {
                        radio: turn.radio,
                        station: station.station,
                        message: tick << 1 | service,
                        ready_ns: station.phase_ns,
                        bytes: (packet.len() + FRAME_BYTES) as u32,
                    },
                    packet,
                });
            };
            let gap = |bytes: usize, congestion: &CongestionControl| congestion.gap_ns(air_time_s(bytes));
            // Typical sizes decide the table of congestion control before the message exists.
            let cam_gap_ns = gap(120, &station.congestion);
            if let Some(content) = station.cam.check(now_ns, &own.motion(&size), cam_gap_ns) {
                let cam = composer.cam(content.has_low_frequency);
                if let Some(cam) = cam {
                    emit(0, BtpPort::Cam, cam.encode(), &cam.position);
                }
            }
            if perception.range_m > 0.0 {
                let observer = Observer {
                    antenna: &radio.antenna,
                    station: station.station,
                    tick,
                    states,
                    obstacles,
                    random,
                };
                let perceived = observer.perceive(perception);
                let motions: Vec<PerceivedMotion> = perceived
                    .iter()
                    .map(|object| PerceivedMotion {
                        object: object.object.into(),
                        kind: if object.is_person {
                            ObjectKind::Person
                        } else {
                            ObjectKind::Vehicle
                        },
                        motion: object.motion(own, &size),
                    })
                    .collect();
                let cpm_gap_ns = gap(400, &station.congestion);
                if let Some(content) = station.cpm.check(now_ns, &motions, cpm_gap_ns) {
                    let has_sensors = content.has_sensor_information;
                    let cpm = composer.cpm(perception, &perceived, &content.objects, has_sensors);
                    if let Some(cpm) = cpm {
                        emit(1, BtpPort::Cpm, cpm.encode(), &cpm.position);
                    }
                }
            }
        });
        turns.into_iter().flat_map(|turn| turn.messages).collect()
    }

    /// Links of every radio that has a message, ascending by receiver.
    fn links(&mut self, queue: &[QueuedMessage], radios: &[Radio]) -> Vec<Vec<MediumLink>> {
        let bounds: Vec<Bounds> = radios
            .iter()
            .map(|radio| Bounds::about(radio.antenna.position_m, 0.0))
            .collect();
        let index = sim_core::scene::Grid::new(&bounds, 0.5 * self.config.range_m);
        let mut is_sender = vec![false; radios.len()];
        queue
            .iter()
            .for_each(|message| is_sender[message.radio as usize] = true);
        let mut links: Vec<Vec<MediumLink>> = vec![Vec::new(); radios.len()];
        let this = &*self;
        parallel::for_each(this.config.threads as usize, &mut links, |sender, links| {
            if !is_sender[sender] {
                return;
            }
            let mut near = Vec::new();
            index.near(
                &Bounds::about(radios[sender].antenna.position_m, this.config.range_m),
                &mut near,
            );
            let link = |receiver: &u32| this.link(radios, sender, *receiver);
            links.extend(
                near.iter()
                    .filter(|receiver| **receiver as usize != sender)
                    .filter_map(link),
            );
        });
        self.counts.links += links.iter().map(|links| links.len() as u64).sum::<u64>();
        links
    }

    /// The link from `sender` to `receiver`, if it counts.
    fn link(&self, radios: &[Radio], sender: usize, receiver: u32) -> Option<MediumLink> {
        // Both directions are the same link.
        let (low, high) = (sender.min(receiver as usize), sender.max(receiver as usize));
        let (a, b) = (&radios[low].antenna, &radios[high].antenna);
        let [dx, dy] = [0, 1].map(|axis: usize| b.position_m[axis] - a.position_m[axis]);
        let distance_m = (dx * dx + dy * dy + (b.z_m - a.z_m).powi(2)).sqrt();
        if dx * dx + dy * dy > self.config.range_m * self.config.range_m {
            return None;
        }
        let least_dbm = self.medium.irrelevant_dbm();
        let between = self.maps[self.at].obstacles.between(a, b);
        let mut power_dbm = self.config.power_dbm - path_loss_db(self.config.path_loss, between.state, distance_m);
        if self.config.fading {
            // What four standard deviations of shadowing cannot lift above it does not count.
            let std_db = shadowing_std_db(between.state);
            if power_dbm + 4.0 * std_db < least_dbm {
                return None;
            }
            let decorrelation = decorrelation_m(self.config.path_loss, between.state);
            power_dbm += std_db * self.shadowing.normal(a.position_m, b.position_m, decorrelation);
        }
        if between.state == LinkState::Vehicles {
            let [mean_db, std_db] = vehicle_loss_db(between.above, distance_m);
            let key = LinkKey {
                sender: self.station_at(radios, low),
                receiver: self.station_at(radios, high),
                message: 0,
            };
            let normal = match self.config.fading {
                true => f64::from(self.random.normals(key, RadioDraw::Blocking, 0)[0]),
                false => 0.0,
            };
            power_dbm -= (mean_db + std_db * normal).max(0.0);
        }
        (power_dbm >= least_dbm).then(|| MediumLink {
            radio: receiver,
            power_mw: milliwatts(power_dbm) as f32,
            twice_shape: if self.config.fading {
                fading::twice_shape(distance_m)
            } else {
                0
            },
        })
    }

    fn station_at(&self, radios: &[Radio], radio: usize) -> u32 {
        self.stations[radios[radio].slot]
            .as_ref()
            .map_or(0, |station| station.station)
    }

    /// Puts what is decoded into the receivers' inboxes.
    fn deliver(
        &mut self,
        header: &MessageHeader,
        outgoing: &[OutgoingMessage],
        queue: &[QueuedMessage],
        links: &[Vec<MediumLink>],
        schedule: &Schedule,
        radios: &[Radio],
    ) {
        let stations: Vec<u32> = (0..radios.len()).map(|radio| self.station_at(radios, radio)).collect();
        let mut decoded: Vec<Vec<u32>> = vec![Vec::new(); schedule.on_air.len()];
        let (medium, random) = (&self.medium, &self.random);
        let on_air = OnAir {
            schedule,
            queue,
            links,
            stations: &stations,
        };
        parallel::for_each(self.config.threads as usize, &mut decoded, |number, decoded| {
            medium.receivers(number, &on_air, random, decoded);
        });
        let (threads, projection) = (self.config.threads as usize, &self.maps[self.at].projection);
        let mut heard: Vec<HeardMessage> = schedule
            .on_air
            .iter()
            .map(|sent| HeardMessage {
                sender: radios[queue[sent.queued].radio as usize].slot,
                objects: Vec::new(),
            })
            .collect();
        parallel::for_each(threads, &mut heard, |number, heard| {
            let packet = &outgoing[schedule.on_air[number].queued].packet;
            read_packet(packet, header.sim_time_ns, projection, &mut heard.objects);
        });
        self.inbox.iter_mut().for_each(Vec::clear);
        for (number, (sent, receivers)) in schedule.on_air.iter().zip(&decoded).enumerate() {
            let message = &queue[sent.queued];
            let sender = &mut self.activity[radios[message.radio as usize].slot];
            sender.sent += 1;
            sender.bytes += message.bytes;
            for receiver in receivers {
                let slot = radios[*receiver as usize].slot;
                self.inbox[slot].push(number as u32);
                self.activity[slot].received += 1;
            }
            *(if message.message & 1 == 0 {
                &mut self.counts.cams
            } else {
                &mut self.counts.cpms
            }) += 1;
            self.counts.bytes += u64::from(message.bytes);
            self.counts.received += receivers.len() as u64;
        }
        self.counts.dropped += u64::from(schedule.dropped);
        self.heard = heard;
    }
}

fn size_of(state: &VehicleState) -> VehicleSize {
    VehicleSize {
        length_m: state.length_m.into(),
        width_m: state.width_m.into(),
        rear_overhang_m: state.rear_overhang_m.into(),
    }
}

/// Reads a packet as a receiver does, from its bytes.
fn read_packet(packet: &[u8], now_ns: u64, projection: &Projection, known: &mut Vec<KnownObject>) {
    let Ok((head, message)) = geonetworking::decode(packet) else {
        return;
    };
    match head.port {
        BtpPort::Cam => {
            let cam = Cam::decode(message);
            known.extend(cam.ok().and_then(|cam| object_of_cam(&cam, now_ns, projection)));
        }
        BtpPort::Cpm => {
            if let Ok(cpm) = Cpm::decode(message) {
                objects_of_cpm(&cpm, now_ns, projection, known);
            }
        }
        BtpPort::Denm | BtpPort::Vam => {}
    }
}

/// A vehicle that perceives others at a tick.
struct Observer<'a> {
    antenna: &'a Antenna,
    station: u32,
    tick: u32,
    states: &'a [VehicleState],
    obstacles: &'a Obstacles,
    random: &'a RadioRandom,
}

impl Observer<'_> {
    /// Objects that the vehicle sees: in range, and neither a building nor another road user in the way of their centre.
    fn perceive(&self, spec: &PerceptionSpec) -> Vec<Perception> {
        let Self { states, obstacles, .. } = self;
        let (bodies, state) = (obstacles.bodies(), &states[self.antenna.row as usize]);
        let own = &bodies[self.antenna.row as usize];
        let front_m = own.world_from_local([own.half_m[0], 0.0]);
        let mut near = Vec::new();
        obstacles.road_users_near(&Bounds::about(own.centre_m, spec.range_m), &mut near);
        let object = |row: &u32| {
            let (body, other) = (&bodies[*row as usize], &states[*row as usize]);
            let [dx, dy] = [0, 1].map(|axis: usize| body.centre_m[axis] - own.centre_m[axis]);
            if *row == self.antenna.row || dx * dx + dy * dy > spec.range_m * spec.range_m {
                return None;
            }
            let target = Antenna {
                position_m: body.centre_m,
                z_m: body.z_m[1],
                row: *row,
            };
            let hidden = obstacles.meets_building(self.antenna, &target)
                || obstacles.highest_vehicle_m(self.antenna, &target).is_some();
            if hidden {
                return None;
            }
            let key = LinkKey {
                sender: self.station,
                receiver: station_id(other.id_hash),
                message: self.tick,
            };
            let [ex, ey, ev, ew] = self.random.normals(key, RadioDraw::Perception, 0).map(f64::from);
            let offset = [body.centre_m[0] - front_m[0], body.centre_m[1] - front_m[1]];
            let [ahead, left] = rotate(offset, -state.yaw_rad);
            let velocity = rotate(
                [
                    f64::from(other.velocity_body_mps[0]),
                    f64::from(other.velocity_body_mps[1]),
                ],
                other.yaw_rad - state.yaw_rad,
            );
            Some(Perception {
                object: (other.vehicle % 65_535) as u16,
                position_body_m: [ahead + spec.position_std_m * ex, left + spec.position_std_m * ey],
                velocity_body_mps: [
                    velocity[0] + spec.speed_std_mps * ev,
                    velocity[1] + spec.speed_std_mps * ew,
                ],
                turn_rad: other.yaw_rad - state.yaw_rad,
                size_m: [other.length_m.into(), other.width_m.into()],
                is_person: other.kind == Kind::Person as u32,
            })
        };
        near.iter().filter_map(object).collect()
    }
}
