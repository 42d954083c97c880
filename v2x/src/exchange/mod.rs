//! One tick of messages: what has arrived goes into the stations' maps, the maps into `neighbours`, and what is due goes on air.
//!
//! A message is made from what its station measured at a tick. It is sent and received before the next tick, whose `neighbours` show it.

use std::sync::Arc;

use ipc_schema::{
    config::{Config, RoadsideService, V2xConfig, V2xInclusion, V2xListing},
    header::{FIRST_OF_EPISODE, MessageHeader},
    neighbours::{ACHIEVED_COLUMNS, NEIGHBOUR_COLUMNS, NEIGHBOUR_ID_COLUMNS, NeighboursSections, RADIO_COLUMNS},
    observation::EMPTY_SLOT,
    traffic::Kind,
    world::{VehicleState, road_users_of},
};
use serde::{Deserialize, Serialize};
use sim_core::{geodesy::Projection, scene::Scene};

use crate::{
    local_map::{HeardMessage, HeardObjects, KnownObject, LocalMap},
    message::{
        bsm::BsmCore,
        cam::Cam,
        cpm::Cpm,
        denm::Denm,
        geonetworking::{self, BtpPort},
        vam::Vam,
        wsmp,
    },
    parallel,
    radio::{
        delivery::{DecodingTable, Receptions},
        links::{LinkComputer, Radio, RadioTick},
        medium::{Medium, OnAir, QueuedMessage, RadioLinks, Schedule, Transmission},
        noise_dbm,
        obstruction::{Antenna, Obstacles},
    },
    random::{LinkKey, RadioDraw, RadioRandom},
    roadside::RoadsideUnit,
    services::{
        bsm::BsmService, cam::CamService, congestion::CongestionControl, cpm::CpmService, denm::DenmService,
        edge::FusedMap, relay::WarningRelay, vam::VamService,
    },
    station::{
        OwnMeasurement, PerceptionSpec, SensorDeviations, Station, VehicleSize, object_of_bsm, object_of_cam,
        object_of_vam, objects_of_cpm, station_id,
    },
};

mod outgoing;
mod perception;
pub mod speech;

use outgoing::{OutgoingMessage, SendingService, StationTick, outgoing};
use speech::SpeechCounts;

/// Height of an antenna above the roof, metres.
const ANTENNA_M: f64 = 0.1;
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
    /// Warnings sent, repetitions included.
    pub denms: u64,
    /// Awareness messages of people sent.
    pub vams: u64,
    /// Basic safety messages sent.
    pub bsms: u64,
    /// Bytes of them, headers included.
    pub bytes: u64,
    /// Messages that found no time to be sent.
    pub dropped: u64,
    /// Links computed.
    pub links: u64,
    /// Receptions, one for each message and receiver.
    pub received: u64,
    /// Messages that roadside units sent; they are among the others too.
    pub roadside_sent: u64,
    /// Receptions by roadside units; they are among the others too.
    pub roadside_received: u64,
}

/// A message that was on air.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AirPacket {
    /// Beginning, nanoseconds since the beginning of the tick.
    pub start_ns: u64,
    /// Station that sent it.
    pub station: u32,
    /// Its bytes, from the header of the network on.
    pub packet: Vec<u8>,
}

/// What a slot's radio did in the tick before.
#[derive(Debug, Clone, Copy, Default)]
struct RadioActivity {
    sent: u32,
    bytes: u32,
    /// Those of collective perception messages.
    cpm_bytes: u32,
    received: u32,
    load: f32,
}

/// A map of the run.
struct ExchangeMap {
    obstacles: Obstacles,
    projection: Projection,
    roadside: Vec<RoadsideUnit>,
}

/// The messages of a run.
pub struct MessageExchange {
    config: V2xConfig,
    deviations: SensorDeviations,
    perception: PerceptionSpec,
    medium: Medium,
    decoding: DecodingTable,
    maps: Vec<ExchangeMap>,
    /// Index of the map of the episode.
    at: usize,
    random: RadioRandom,
    links: LinkComputer,
    /// Those of the last tick. Kept for their memory.
    radio_links: RadioLinks,
    /// Slots of the tick.
    slots: usize,
    /// By slot, then by roadside unit; so are `activity`, `inbox` and `rows`.
    stations: Vec<Option<Station>>,
    activity: Vec<RadioActivity>,
    /// Objects of the messages that maps may refer to.
    objects: HeardObjects,
    /// Messages of the tick before, and the slots of their senders.
    heard: Vec<HeardMessage>,
    senders: Vec<usize>,
    /// By slot: the messages that it received in the tick before.
    inbox: Vec<Vec<u32>>,
    /// Row in the world of each slot's vehicle.
    rows: Vec<Option<u32>>,
    /// Messages of the last tick, where they are captured.
    air: Vec<AirPacket>,
    counts: ExchangeCounts,
    /// The messages task: what messages have achieved in all.
    speech: SpeechCounts,
    /// By slot: what the messages of the tick before have achieved.
    achieved: Vec<[f32; ACHIEVED_COLUMNS]>,
    speaks: bool,
}

impl MessageExchange {
    /// The messages of a run with this configuration, on its maps.
    #[must_use]
    pub fn new(config: &Config, maps: Vec<(Arc<Scene>, Projection)>) -> Self {
        let v2x = config.v2x.clone();
        let random = RadioRandom::new(0);
        let medium = Medium::new(
            noise_dbm(v2x.noise_figure_db),
            v2x.carrier_sense_dbm,
            (config.run.tick_s * 1e9).round() as u64,
        );
        Self {
            deviations: SensorDeviations::new(config),
            perception: PerceptionSpec {
                range_m: v2x.perception_range_m,
                position_std_m: v2x.perception_position_std_m,
                speed_std_mps: v2x.perception_speed_std_mps,
                opening_rad: None,
            },
            maps: maps
                .into_iter()
                .map(|(scene, projection)| ExchangeMap {
                    obstacles: Obstacles::new(&scene),
                    projection,
                    roadside: v2x
                        .roadside
                        .iter()
                        .map(|unit| RoadsideUnit::new(unit, &v2x, &scene))
                        .collect(),
                })
                .collect(),
            at: 0,
            links: LinkComputer::new(&v2x, &medium, random),
            radio_links: RadioLinks::default(),
            medium,
            decoding: DecodingTable::default(),
            random,
            slots: 0,
            stations: vec![None; v2x.roadside.len()],
            activity: vec![RadioActivity::default(); v2x.roadside.len()],
            objects: HeardObjects::default(),
            heard: Vec::new(),
            senders: Vec::new(),
            inbox: vec![Vec::new(); v2x.roadside.len()],
            rows: Vec::new(),
            air: Vec::new(),
            counts: ExchangeCounts::default(),
            speech: SpeechCounts::default(),
            achieved: Vec::new(),
            speaks: config.speaks(),
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

    /// Messages of the last [`MessageExchange::send`] by their beginning, where the configuration asks for them (`v2x.pcap`).
    #[must_use]
    pub fn on_air(&self) -> &[AirPacket] {
        &self.air
    }

    /// Slots of the senders of the messages of the last [`MessageExchange::send`], by the beginning of the message.
    pub fn senders(&self) -> impl Iterator<Item = usize> {
        self.senders.iter().copied()
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
        if self.speaks || self.config.inclusion == V2xInclusion::Needed {
            self.perceive(header.sim_time_ns, slots, states);
            self.weigh(header.sim_time_ns, self.config.inclusion == V2xInclusion::Needed);
        }
        let now_ms = (header.sim_time_ns / 1_000_000) as i64;
        let lifetime_ms = (self.config.object_lifetime_s * 1000.0) as i64;
        self.objects.advance(now_ms, lifetime_ms);
        let (objects, heard, inbox) = (&self.objects, &self.heard, &self.inbox);
        parallel::for_each(self.config.threads as usize, &mut self.stations, |slot, station| {
            let Some(station) = station else { return };
            let received = inbox.get(slot).into_iter().flatten();
            station
                .map
                .receive(objects, received.map(|message| &heard[*message as usize]));
        });
        for (station, activity) in self.stations.iter_mut().zip(&self.activity) {
            if let Some(station) = station {
                station.congestion.measure(header.sim_time_ns, activity.load.into());
            }
        }
        self.write(slots, states, now_ms, out);
        if self.speaks {
            let width = out.speech.len().checked_div(slots.len()).unwrap_or(0);
            self.write_speech(header.sim_time_ns, slots, states, width, out.speech);
            out.achieved.copy_from_slice(&self.achieved);
        }
    }

    fn begin_episode(&mut self, header: &MessageHeader) {
        self.random = RadioRandom::new(header.episode_seed);
        self.links = LinkComputer::new(&self.config, &self.medium, self.random);
        self.at = usize::from(header.map).min(self.maps.len() - 1);
        self.stations.fill(None);
        self.activity.fill(RadioActivity::default());
        self.objects.clear();
        self.heard.clear();
        self.senders.clear();
        self.inbox.iter_mut().for_each(Vec::clear);
    }

    /// Gives each slot its station; one whose vehicle is new begins with an empty map.
    fn take_slots(&mut self, slots: &[SlotMeasurement], states: &[VehicleState]) {
        let states = road_users_of(states);
        let before = std::mem::replace(&mut self.slots, slots.len());
        set_slots(&mut self.stations, before, slots.len());
        set_slots(&mut self.activity, before, slots.len());
        set_slots(&mut self.inbox, before, slots.len());
        self.rows.clear();
        self.rows.resize(self.stations.len(), None);
        for (place, unit) in (slots.len()..).zip(&self.maps[self.at].roadside) {
            if self.stations[place].is_none() {
                let station = Station {
                    is_equipped: true,
                    ..self.begin_station(unit.id_hash, false)
                };
                self.stations[place] = Some(station);
            }
        }
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
            let state = row.map(|row| &states[row as usize]);
            let is_person = state.is_some_and(|state| state.kind == Kind::Person as u32);
            if measured.vehicle == EMPTY_SLOT || state.is_none() || is_person && !self.config.vam {
                self.stations[slot] = None;
                continue;
            }
            let is_same = self.stations[slot]
                .as_ref()
                .is_some_and(|station| station.id_hash == measured.id_hash);
            if !is_same || measured.episode_step == 0 {
                self.stations[slot] = Some(self.begin_station(measured.id_hash, is_person));
                self.activity[slot] = RadioActivity::default();
                self.inbox[slot].clear();
            }
        }
    }

    fn begin_station(&self, id_hash: u64, is_person: bool) -> Station {
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
            is_person,
            is_equipped: equipped < self.config.share,
            phase_ns: (phase * self.medium.tick_ns as f64) as u64,
            cam: CamService::default(),
            cpm: CpmService::default(),
            bsm: BsmService::default(),
            vam: VamService::default(),
            denm: DenmService::default(),
            warning: None,
            perceived: Vec::new(),
            sighted: None,
            chosen: Vec::new(),
            edge: FusedMap::default(),
            relay: WarningRelay::default(),
            congestion: CongestionControl::new(self.config.congestion_control),
            map: LocalMap::default(),
        }
    }

    fn write(&mut self, slots: &[SlotMeasurement], states: &[VehicleState], now_ms: i64, out: &mut NeighboursSections) {
        let count = self.config.neighbours as usize;
        struct WrittenRow<'a> {
            objects: &'a mut [[f32; NEIGHBOUR_COLUMNS]],
            ids: &'a mut [[u32; NEIGHBOUR_ID_COLUMNS]],
            radio: &'a mut [u32; RADIO_COLUMNS],
        }
        let mut rows: Vec<WrittenRow> = out
            .objects
            .chunks_mut(count)
            .zip(out.ids.chunks_mut(count))
            .zip(out.radio.iter_mut())
            .map(|((objects, ids), radio)| WrittenRow { objects, ids, radio })
            .collect();
        let (stations, activity, at_row, heard) = (&self.stations, &self.activity, &self.rows, &self.objects);
        let listing = self.config.listing;
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
            match listing {
                V2xListing::Merged => station.map.nearest(heard, own.centre_m(&size), count, &mut nearest),
                V2xListing::Separate => {
                    let views = station.map.all(heard).chain(&station.perceived);
                    nearest_views(views, own.centre_m(&size), now_ms, count, &mut nearest);
                }
            }
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
        let mut radio_of_row = vec![u32::MAX; states.len()];
        for (number, radio) in (0_u32..).zip(&radios) {
            if let Some(of_row) = radio_of_row.get_mut(radio.antenna.row as usize) {
                *of_row = number;
            }
        }
        self.links.enter(&self.maps[self.at].obstacles, &radios);
        let ExchangeMap {
            obstacles,
            projection,
            roadside,
        } = &self.maps[self.at];
        let tick = StationTick {
            now_ns: header.sim_time_ns,
            tick: (header.sim_time_ns / self.medium.tick_ns) as u32,
            slots,
            states,
            obstacles,
            projection,
            random: &self.random,
            deviations: &self.deviations,
            perception: &self.perception,
            roadside,
            objects: &self.objects,
            strips: self.links.strips(),
            radio_of_row: &radio_of_row,
            config: &self.config,
        };
        let outgoing = outgoing(&tick, &radios, &mut self.stations, self.config.threads as usize);
        self.activity.fill(RadioActivity::default());
        let queue: Vec<QueuedMessage> = outgoing.iter().map(|message| message.queued).collect();
        let mut sends = vec![false; radios.len()];
        queue.iter().for_each(|message| sends[message.radio as usize] = true);
        let mut links = std::mem::take(&mut self.radio_links);
        let radio_tick = RadioTick {
            radios: &radios,
            sends: &sends,
            obstacles,
        };
        self.links.links(radio_tick, &mut links);
        let of_senders = (0..).zip(&sends).filter(|(_, sends)| **sends);
        self.counts.links += of_senders.map(|(radio, _)| links.of(radio).len() as u64).sum::<u64>();
        let schedule = self.medium.schedule(&queue, &links, &self.random);
        self.deliver(header, &outgoing, &queue, &links, &schedule, &radios);
        self.relay_warnings(&outgoing, &schedule);
        if self.config.pcap {
            self.capture(outgoing, &schedule);
        }
        let loads = self.medium.channel_load(&schedule, &queue, &links, radios.len());
        for (radio, load) in radios.iter().zip(loads) {
            self.activity[radio.slot].load = load;
        }
        self.radio_links = links;
    }

    /// Gives each roadside unit that sends warnings once more those that it heard.
    fn relay_warnings(&mut self, outgoing: &[OutgoingMessage], schedule: &Schedule) {
        let units = &self.maps[self.at].roadside;
        for (place, unit) in (self.slots..).zip(units) {
            let (Some(station), true) = (&mut self.stations[place], unit.config.offers(RoadsideService::Denm)) else {
                continue;
            };
            for number in &self.inbox[place] {
                let sent = &outgoing[schedule.on_air[*number as usize].queued];
                if SendingService::of(sent.queued.message) != SendingService::Denm {
                    continue;
                }
                let message = geonetworking::decode(&sent.packet).map(|(_, message)| message);
                if let Ok((warning, bytes)) = message.and_then(|bytes| Ok((Denm::decode(bytes)?, bytes))) {
                    station.relay.hear(&warning, bytes);
                }
            }
        }
    }

    /// Keeps what was on air.
    fn capture(&mut self, mut outgoing: Vec<OutgoingMessage>, schedule: &Schedule) {
        let sent = schedule.on_air.iter().map(|sent| AirPacket {
            start_ns: sent.start_ns,
            station: outgoing[sent.queued].queued.station,
            packet: std::mem::take(&mut outgoing[sent.queued].packet),
        });
        self.air = sent.collect();
    }

    /// Radios of the equipped stations, by slot.
    fn radios(&self, states: &[VehicleState]) -> Vec<Radio> {
        let bodies = self.maps[self.at].obstacles.bodies();
        let radio = |(slot, station): (usize, &Option<Station>)| {
            let row = self.rows[slot]?;
            let station = station.as_ref().filter(|station| station.is_equipped)?;
            let state = &states[row as usize];
            Some(Radio {
                slot,
                station: station.station,
                antenna: Antenna {
                    position_m: bodies[row as usize].centre_m,
                    z_m: state.z_m + f64::from(state.height_m) + ANTENNA_M,
                    row,
                },
            })
        };
        let unit = |(place, unit): (usize, &RoadsideUnit)| {
            let station = self.stations[place].as_ref()?;
            Some(Radio {
                slot: place,
                station: station.station,
                antenna: unit.antenna,
            })
        };
        let slots = self.stations[..self.slots].iter().enumerate().filter_map(radio);
        let units = (self.slots..).zip(&self.maps[self.at].roadside).filter_map(unit);
        slots.chain(units).collect()
    }

    /// Puts what is decoded into the receivers' inboxes.
    fn deliver(
        &mut self,
        header: &MessageHeader,
        outgoing: &[OutgoingMessage],
        queue: &[QueuedMessage],
        links: &RadioLinks,
        schedule: &Schedule,
        radios: &[Radio],
    ) {
        let stations: Vec<u32> = radios.iter().map(|radio| radio.station).collect();
        let on_air = OnAir {
            schedule,
            queue,
            links,
            stations: &stations,
        };
        let mut decoded: Vec<Vec<u32>> = radios
            .iter()
            .map(|radio| std::mem::take(&mut self.inbox[radio.slot]))
            .collect();
        Receptions::new(&self.medium, &self.decoding, on_air, &self.random)
            .decode(self.config.threads as usize, &mut decoded);
        let (threads, projection) = (self.config.threads as usize, &self.maps[self.at].projection);
        let listing = self.config.listing;
        let mut contents: Vec<Vec<KnownObject>> = vec![Vec::new(); schedule.on_air.len()];
        parallel::for_each(threads, &mut contents, |number, objects| {
            let packet = &outgoing[schedule.on_air[number].queued].packet;
            read_packet(packet, header.sim_time_ns, projection, listing, objects);
        });
        self.heard.clear();
        self.heard
            .extend(contents.iter().map(|contents| self.objects.add(contents)));
        let slot_of = |sent: &Transmission| radios[queue[sent.queued].radio as usize].slot;
        self.senders.clear();
        self.senders.extend(schedule.on_air.iter().map(slot_of));
        for sent in &schedule.on_air {
            let message = &queue[sent.queued];
            let slot = radios[message.radio as usize].slot;
            self.counts.roadside_sent += u64::from(slot >= self.slots);
            let sender = &mut self.activity[slot];
            sender.sent += 1;
            sender.bytes += message.bytes;
            match SendingService::of(message.message) {
                SendingService::Cam => self.counts.cams += 1,
                SendingService::Cpm => {
                    self.counts.cpms += 1;
                    sender.cpm_bytes += message.bytes;
                }
                SendingService::Denm => self.counts.denms += 1,
                SendingService::Vam => self.counts.vams += 1,
                SendingService::Bsm => self.counts.bsms += 1,
            }
            self.counts.bytes += u64::from(message.bytes);
        }
        self.inbox.iter_mut().for_each(Vec::clear);
        for (radio, decoded) in radios.iter().zip(decoded) {
            self.activity[radio.slot].received += decoded.len() as u32;
            self.counts.received += decoded.len() as u64;
            if radio.slot >= self.slots {
                self.counts.roadside_received += decoded.len() as u64;
            }
            self.inbox[radio.slot] = decoded;
        }
        self.counts.dropped += u64::from(schedule.dropped);
    }
}

/// Gives `items` as many places for slots as there are now, with those of roadside units behind them.
fn set_slots<T: Clone + Default>(items: &mut Vec<T>, before: usize, now: usize) {
    if now > before {
        items.splice(before..before, vec![T::default(); now - before]);
    } else {
        items.drain(now..before);
    }
}

/// The `count` views nearest to `from_m` at `now_ms`, into `nearest`; at the same distance in the order in which they came.
fn nearest_views<'a>(
    views: impl Iterator<Item = &'a KnownObject>,
    from_m: [f64; 2],
    now_ms: i64,
    count: usize,
    nearest: &mut Vec<&'a KnownObject>,
) {
    let distance2 = |view: &KnownObject| {
        let [x, y] = view.position_at_m(now_ms);
        (x - from_m[0]).powi(2) + (y - from_m[1]).powi(2)
    };
    let mut all: Vec<(f64, &KnownObject)> = views.map(|view| (distance2(view), view)).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    nearest.clear();
    nearest.extend(all.into_iter().take(count).map(|(_, view)| view));
}

fn size_of(state: &VehicleState) -> VehicleSize {
    let length_m = f64::from(state.length_m);
    // A person's origin is its centre.
    let rear_overhang_m = match state.kind == Kind::Person as u32 {
        true => 0.5 * length_m,
        false => state.rear_overhang_m.into(),
    };
    let behind_m = match state.trailing {
        0 => 0.0,
        _ => f64::from(state.whole_length_m) - length_m,
    };
    VehicleSize {
        length_m: length_m + behind_m,
        width_m: state.width_m.into(),
        rear_overhang_m: rear_overhang_m + behind_m,
        has_trailer: state.trailing > 0,
    }
}

/// Reads a packet as a receiver does, from its bytes.
fn read_packet(packet: &[u8], now_ns: u64, projection: &Projection, listing: V2xListing, known: &mut Vec<KnownObject>) {
    if let Ok(message) = wsmp::decode(packet) {
        let bsm = BsmCore::decode(message);
        known.extend(bsm.ok().and_then(|bsm| object_of_bsm(&bsm, now_ns, projection)));
        return;
    }
    let Ok((head, message)) = geonetworking::decode(packet) else {
        return;
    };
    match head.port {
        // That of a roadside unit is of no road user.
        BtpPort::Cam => {
            let cam = Cam::decode(message);
            known.extend(cam.ok().and_then(|cam| object_of_cam(&cam, now_ns, projection)));
        }
        BtpPort::Cpm => {
            if let Ok(cpm) = Cpm::decode(message) {
                objects_of_cpm(&cpm, now_ns, projection, listing, known);
            }
        }
        BtpPort::Vam => {
            let vam = Vam::decode(message);
            known.extend(vam.ok().and_then(|vam| object_of_vam(&vam, now_ns, projection)));
        }
        // A warning is of an event, not of an object.
        BtpPort::Denm => {}
    }
}
