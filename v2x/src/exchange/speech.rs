//! The messages task: what a policy sees of each station, what a choice becomes, and what messages have achieved (docs/messages.md).
//!
//! A station knows a road user as long as its own sensors perceive it, or a message that it received describes a place within
//! [`SAME_ROAD_USER_M`] of it, no longer ago than objects live. A message achieves the time by which it extends that, summed over its
//! objects and those of its receivers that would have known the object for less than [`NEWS_MS`] more.

use std::collections::BTreeMap;

use ipc_schema::{
    neighbours::{ACHIEVED_COLUMNS, CANDIDATE_COLUMNS, NeighbourSource, SPEAKER_COLUMNS},
    world::VehicleState,
};
use serde::{Deserialize, Serialize};
use sim_core::scene::shape::{Bounds, Point};

use super::{ExchangeMap, MessageExchange, SlotMeasurement, perception::Observer, size_of};
use crate::{
    local_map::{HeardMessage, HeardObjects, KnownObject},
    parallel,
    radio::obstruction::Antenna,
    services::{MeasuredMotion, turn},
    station::{OwnMeasurement, Perception, Station, VehicleSize},
};

/// A description farther than this from a road user is not of it, metres.
pub const SAME_ROAD_USER_M: f64 = 4.0;

/// What a station knows for at least so long is no news to it, ms: a message that is lost can be said again in that time.
pub const NEWS_MS: i64 = 300;

const FAR_M: f64 = 100.0;
const FAST_MPS: f64 = 25.0;
const OLD_S: f64 = 2.0;
const MOVED_M: f64 = 8.0;
const FASTER_MPS: f64 = 1.0;
const TURNED_RAD: f64 = 8.0 * std::f64::consts::PI / 180.0;
const MANY_PERCEIVED: f64 = 32.0;
const MANY_KNOWN: f64 = 128.0;
const MANY_STATIONS: f64 = 64.0;
const MANY_VIEWS: f64 = 8.0;
const NS_PER_S: f64 = 1e9;

/// What messages have achieved in a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct SpeechCounts {
    /// Road users in range that stations knew, one for each station and tick.
    pub known: u64,
    /// All road users in range of stations.
    pub in_range: u64,
    /// Bytes of the collective perception messages of vehicles.
    pub cpm_bytes: u64,
    /// Stations with a radio, one for each tick.
    pub station_ticks: u64,
    /// Time for which others newly knew what these messages list, seconds.
    pub told_s: f64,
}

/// What the messages of a tick have brought one station.
#[derive(Debug, Clone, Default)]
struct Heard {
    known: u32,
    in_range: u32,
    /// Slot of each sender, and the time for which this station newly knows what it told, seconds.
    told_s: Vec<(usize, f64)>,
    /// Rows of the road users in range that it would not know at the next tick.
    lacks: Vec<u32>,
}

/// A road user in range of a station.
struct InRange {
    row: u32,
    centre_m: Point,
    /// The time until which the station knows it, ms.
    until_ms: i64,
    /// What messages of the tick before extend that time to, by the slot of their senders, ms.
    extended: Vec<(usize, i64)>,
}

/// The views that a station's map has of an object.
#[derive(Debug, Clone, Copy, Default)]
struct ObjectViews {
    /// Time of the newest, ms, and where it lets one expect the object now.
    newest: Option<(i64, Point)>,
    count: usize,
    /// The object speaks for itself.
    speaks: bool,
}

/// What happens at a tick, for all stations.
#[derive(Clone, Copy)]
struct SpeechTick<'a> {
    now_ns: u64,
    now_ms: i64,
    lifetime_ms: i64,
    tick_ms: i64,
    range_m: f64,
    map: &'a ExchangeMap,
    objects: &'a HeardObjects,
    heard: &'a [HeardMessage],
    /// Slots of their senders.
    senders: &'a [usize],
}

impl MessageExchange {
    /// Finds out what each station perceives at this tick. Call it before the messages of the tick before are read.
    pub(super) fn perceive(&mut self, now_ns: u64, slots: &[SlotMeasurement], states: &[VehicleState]) {
        self.maps[self.at].obstacles.update(states);
        let radios = self.radios(states);
        let mut antennas: Vec<Option<Antenna>> = vec![None; slots.len()];
        for radio in radios.into_iter().filter(|radio| radio.slot < slots.len()) {
            antennas[radio.slot] = Some(radio.antenna);
        }
        let (at, random) = (&self.maps[self.at], &self.random);
        let tick = (now_ns / self.medium.tick_ns) as u32;
        let spec = &self.perception;
        let stations = &mut self.stations[..slots.len()];
        parallel::for_each(self.config.threads as usize, stations, |slot, station| {
            let Some(station) = station else { return };
            station.chosen.clear();
            station.sighted = match &antennas[slot] {
                Some(antenna) if !station.is_person && slots[slot].own.is_some() => {
                    let observer = Observer::at(antenna, station.station, tick, states, &at.obstacles, random);
                    let mut sighted = observer.perceive(spec);
                    sighted.sort_by(|a, b| a.distance_m().total_cmp(&b.distance_m()));
                    Some(sighted)
                }
                _ => None,
            };
        });
    }

    /// Finds out what the messages of the tick before achieve at their receivers. Call it before maps take them.
    pub(super) fn weigh(&mut self, now_ns: u64, needed: bool) {
        let tick = self.speech_tick(now_ns);
        let mut heard: Vec<Heard> = vec![Heard::default(); self.slots];
        let (stations, rows, inbox) = (&self.stations, &self.rows, &self.inbox);
        parallel::for_each(self.config.threads as usize, &mut heard, |slot, heard| {
            if let (Some(station), Some(row)) = (&stations[slot], rows[slot])
                && station.is_equipped
            {
                *heard = tick.hear(station, row, &inbox[slot]);
            }
        });
        self.achieved.clear();
        self.achieved.resize(self.slots, [0.0; ACHIEVED_COLUMNS]);
        for (slot, of_slot) in heard.iter().enumerate() {
            let is_equipped = self.stations[slot].as_ref().is_some_and(|station| station.is_equipped);
            for (sender, told_s) in &of_slot.told_s {
                if let Some(achieved) = self.achieved.get_mut(*sender) {
                    achieved[0] += *told_s as f32;
                    self.speech.told_s += told_s;
                }
            }
            let bytes = self.activity[slot].cpm_bytes;
            self.achieved[slot][1] = bytes as f32;
            self.achieved[slot][2] = of_slot.known as f32;
            self.achieved[slot][3] = of_slot.in_range as f32;
            self.speech.cpm_bytes += u64::from(bytes);
            self.speech.known += u64::from(of_slot.known);
            self.speech.in_range += u64::from(of_slot.in_range);
            self.speech.station_ticks += u64::from(is_equipped);
        }
        if needed {
            self.choose_needed(&heard);
        }
    }

    /// Lets the nearest station that perceives it tell each station what it lacks, where the one hears the other.
    fn choose_needed(&mut self, heard: &[Heard]) {
        let mut seen_by: BTreeMap<u32, Vec<(usize, usize)>> = BTreeMap::new();
        for (slot, station) in self.stations[..self.slots].iter().enumerate() {
            let sighted = station.as_ref().and_then(|station| station.sighted.as_ref());
            for (place, object) in sighted.into_iter().flatten().enumerate() {
                seen_by.entry(object.row).or_default().push((slot, place));
            }
        }
        let bodies = self.maps[self.at].obstacles.bodies();
        let place_of = |slot: usize| self.rows[slot].map(|row| bodies[row as usize].centre_m);
        let mut chosen: Vec<(usize, usize)> = Vec::new();
        for (slot, of_slot) in heard.iter().enumerate() {
            let (Some(station), Some(here_m)) = (&self.stations[slot], place_of(slot)) else {
                continue;
            };
            for row in &of_slot.lacks {
                let speakers = seen_by.get(row).into_iter().flatten().filter(|(speaker, _)| {
                    let name = self.stations[*speaker].as_ref().map_or(0, |speaker| speaker.station);
                    *speaker != slot && station.map.has_heard(&self.objects, name)
                });
                let away2 =
                    |speaker: usize| place_of(speaker).map_or(f64::INFINITY, |there_m| distance2(here_m, there_m));
                chosen.extend(speakers.min_by(|(a, _), (b, _)| away2(*a).total_cmp(&away2(*b))));
            }
        }
        for (slot, place) in chosen {
            if let Some(station) = &mut self.stations[slot] {
                station.chosen.push(place);
            }
        }
        for station in self.stations.iter_mut().flatten() {
            station.chosen.sort_unstable();
            station.chosen.dedup();
        }
    }

    /// Takes what a policy chose for the station of a slot: the candidates whose bits are set.
    pub fn choose(&mut self, slot: usize, places: u32) {
        let most = self.config.candidates as usize;
        if let Some(Some(station)) = self.stations.get_mut(slot) {
            let candidates = station.sighted.as_ref().map_or(0, Vec::len).min(most);
            station.chosen.clear();
            station
                .chosen
                .extend((0..candidates).filter(|place| places & 1 << place != 0));
        }
    }

    /// What messages have achieved so far.
    #[must_use]
    pub fn speech_counts(&self) -> SpeechCounts {
        self.speech
    }

    /// Continues counting.
    pub fn set_speech_counts(&mut self, counts: SpeechCounts) {
        self.speech = counts;
    }

    /// Writes what the policy sees of each station into zeroed rows of `width` numbers. Call it after maps have taken their messages.
    pub(super) fn write_speech(
        &self,
        now_ns: u64,
        slots: &[SlotMeasurement],
        states: &[VehicleState],
        width: usize,
        speech: &mut [f32],
    ) {
        let tick = self.speech_tick(now_ns);
        let most = self.config.candidates as usize;
        let (stations, rows, activity) = (&self.stations, &self.rows, &self.activity);
        let mut out: Vec<&mut [f32]> = speech.chunks_mut(width.max(1)).collect();
        parallel::for_each(self.config.threads as usize, &mut out, |slot, out| {
            let (Some(station), Some(row), Some(own)) = (&stations[slot], rows[slot], &slots[slot].own) else {
                return;
            };
            let Some(sighted) = &station.sighted else { return };
            let (speaker, candidates) = out.split_at_mut(SPEAKER_COLUMNS);
            speaker.copy_from_slice(&tick.speaker(station, own, sighted.len(), activity[slot].load));
            let size = size_of(&states[row as usize]);
            let candidates = candidates.chunks_exact_mut(CANDIDATE_COLUMNS);
            let described = tick.candidates(station, own, &size, &sighted[..sighted.len().min(most)]);
            for (out, numbers) in candidates.zip(described) {
                out.copy_from_slice(&numbers);
            }
        });
    }

    fn speech_tick(&self, now_ns: u64) -> SpeechTick<'_> {
        SpeechTick {
            now_ns,
            now_ms: (now_ns / 1_000_000) as i64,
            lifetime_ms: (self.config.object_lifetime_s * 1000.0) as i64,
            tick_ms: (self.medium.tick_ns / 1_000_000) as i64,
            range_m: self.config.awareness_range_m,
            map: &self.maps[self.at],
            objects: &self.objects,
            heard: &self.heard,
            senders: &self.senders,
        }
    }
}

impl SpeechTick<'_> {
    /// What a station whose vehicle is at `row` knows, and what the messages of its inbox bring it.
    fn hear(&self, station: &Station, row: u32, inbox: &[u32]) -> Heard {
        let mut in_range = self.in_range(row);
        for object in station.sighted.iter().flatten() {
            if let Some(user) = in_range.iter_mut().find(|user| user.row == object.row) {
                user.until_ms = i64::MAX;
            }
        }
        for view in station.map.all(self.objects) {
            if let Some((user, until_ms)) = self.of(view, &mut in_range) {
                user.until_ms = user.until_ms.max(until_ms);
            }
        }
        for message in inbox {
            let (message, sender) = (&self.heard[*message as usize], self.senders[*message as usize]);
            for view in self.objects.of(message.objects.clone()) {
                let Some((user, until_ms)) = self.of(view, &mut in_range) else {
                    continue;
                };
                match view.source {
                    NeighbourSource::Cpm => user.extended.push((sender, until_ms)),
                    // Its own word comes anyway: what others say at the same time adds nothing to it.
                    _ => user.until_ms = user.until_ms.max(until_ms),
                }
            }
        }
        let mut heard = Heard {
            in_range: in_range.len() as u32,
            ..Heard::default()
        };
        for user in in_range {
            let known_ms = user.until_ms.max(self.now_ms);
            let is_news = known_ms < self.now_ms + NEWS_MS;
            let gain_ms = |until_ms: i64| {
                if is_news {
                    (until_ms - known_ms).max(0) as f64
                } else {
                    0.0
                }
            };
            let all_ms: f64 = user.extended.iter().map(|(_, until_ms)| gain_ms(*until_ms)).sum();
            let most_ms = user
                .extended
                .iter()
                .map(|(_, until_ms)| gain_ms(*until_ms))
                .fold(0.0, f64::max);
            // Several that tell the same share what the one that helps most achieves.
            for (sender, until_ms) in &user.extended {
                let gain_ms = gain_ms(*until_ms);
                if gain_ms > 0.0 {
                    heard.told_s.push((*sender, gain_ms / all_ms * most_ms / 1000.0));
                }
            }
            let until_ms = user.extended.iter().map(|(_, until_ms)| *until_ms).max();
            let until_ms = user.until_ms.max(until_ms.unwrap_or(i64::MIN));
            heard.known += u32::from(until_ms > self.now_ms);
            if until_ms <= self.now_ms + self.tick_ms {
                heard.lacks.push(user.row);
            }
        }
        heard
    }

    /// Road users in range of the one at `row`.
    fn in_range(&self, row: u32) -> Vec<InRange> {
        let bodies = self.map.obstacles.bodies();
        let here_m = bodies[row as usize].centre_m;
        let mut rows = Vec::new();
        self.map
            .obstacles
            .road_users_near(&Bounds::about(here_m, self.range_m), &mut rows);
        rows.retain(|other| {
            *other != row && distance2(bodies[*other as usize].centre_m, here_m) <= self.range_m * self.range_m
        });
        rows.sort_unstable();
        let user = |row: u32| InRange {
            row,
            centre_m: bodies[row as usize].centre_m,
            until_ms: i64::MIN,
            extended: Vec::new(),
        };
        rows.into_iter().map(user).collect()
    }

    /// The road user that a view is of, and the time until which the view makes it known, ms.
    fn of<'b>(&self, view: &KnownObject, in_range: &'b mut [InRange]) -> Option<(&'b mut InRange, i64)> {
        let until_ms = view.measured_ms + self.lifetime_ms;
        if until_ms <= self.now_ms {
            return None;
        }
        let there_m = view.position_at_m(self.now_ms);
        let away2 = |user: &InRange| distance2(user.centre_m, there_m);
        let nearest = in_range.iter_mut().min_by(|a, b| away2(a).total_cmp(&away2(b)))?;
        (away2(nearest) <= SAME_ROAD_USER_M * SAME_ROAD_USER_M).then_some((nearest, until_ms))
    }

    fn speaker(&self, station: &Station, own: &OwnMeasurement, perceived: usize, load: f32) -> [f32; SPEAKER_COLUMNS] {
        let since_s = station
            .cpm
            .sent_ns()
            .map_or(f64::INFINITY, |sent| (self.now_ns - sent) as f64 / NS_PER_S);
        let is_due = station.cpm.is_sensor_information_due(self.now_ns);
        [
            1.0,
            load,
            share(perceived as f64, MANY_PERCEIVED),
            share(station.map.len() as f64, MANY_KNOWN),
            share(station.map.stations() as f64, MANY_STATIONS),
            share(since_s, 1.0),
            if is_due { 1.0 } else { 0.0 },
            share(own.speed_mps, FAST_MPS),
        ]
    }

    /// The numbers of each candidate.
    fn candidates(
        &self,
        station: &Station,
        own: &OwnMeasurement,
        size: &VehicleSize,
        sighted: &[Perception],
    ) -> Vec<[f32; CANDIDATE_COLUMNS]> {
        let motions: Vec<MeasuredMotion> = sighted.iter().map(|object| object.motion(own, size)).collect();
        let views = self.views_of(station, &motions);
        let described = sighted.iter().zip(&motions).zip(&views);
        described
            .map(|((object, motion), views)| {
                let [ahead, left] = object.position_body_m;
                let [since, moved, faster, turned, astray] = self.since_told(station, object, motion);
                let [age, error] = match views.newest {
                    None => [1.0; 2],
                    Some((measured_ms, there_m)) => [
                        share((self.now_ms - measured_ms) as f64 / 1000.0, OLD_S),
                        share(distance2(motion.position_m, there_m).sqrt(), SAME_ROAD_USER_M),
                    ],
                };
                [
                    1.0,
                    if object.is_person { 1.0 } else { 0.0 },
                    (ahead / FAR_M).clamp(-1.0, 1.0) as f32,
                    (left / FAR_M).clamp(-1.0, 1.0) as f32,
                    share(object.distance_m(), FAR_M),
                    share(motion.speed_mps, FAST_MPS),
                    since,
                    moved,
                    faster,
                    turned,
                    astray,
                    age,
                    error,
                    share(views.count as f64, MANY_VIEWS),
                    if views.speaks { 1.0 } else { 0.0 },
                ]
            })
            .collect()
    }

    /// What the station's map has of each of the objects that it perceives: a view is of the nearest.
    fn views_of(&self, station: &Station, motions: &[MeasuredMotion]) -> Vec<ObjectViews> {
        let mut views = vec![ObjectViews::default(); motions.len()];
        for view in station.map.all(self.objects) {
            let there_m = view.position_at_m(self.now_ms);
            let away2 = |motion: &MeasuredMotion| distance2(motion.position_m, there_m);
            let nearest = motions
                .iter()
                .zip(&mut views)
                .min_by(|(a, _), (b, _)| away2(a).total_cmp(&away2(b)));
            let Some((_, of_object)) =
                nearest.filter(|(motion, _)| away2(motion) <= SAME_ROAD_USER_M * SAME_ROAD_USER_M)
            else {
                continue;
            };
            of_object.count += 1;
            of_object.speaks |= view.source != NeighbourSource::Cpm;
            if of_object
                .newest
                .is_none_or(|(measured_ms, _)| measured_ms < view.measured_ms)
            {
                of_object.newest = Some((view.measured_ms, there_m));
            }
        }
        views
    }

    /// What has changed since the station listed the object for the last time: time, place, speed, heading, and the distance from where
    /// that message lets receivers expect it.
    fn since_told(&self, station: &Station, object: &Perception, motion: &MeasuredMotion) -> [f32; 5] {
        let Some((told_ns, before)) = station.cpm.last_included(object.object.into()) else {
            return [1.0; 5];
        };
        let since_s = (self.now_ns - told_ns) as f64 / NS_PER_S;
        let (sin, cos) = libm::sincos(before.heading_rad);
        let way_m = since_s * before.speed_mps;
        let expected_m = [before.position_m[0] + way_m * cos, before.position_m[1] + way_m * sin];
        [
            share(since_s, OLD_S),
            share(distance2(motion.position_m, before.position_m).sqrt(), MOVED_M),
            share((motion.speed_mps - before.speed_mps).abs(), FASTER_MPS),
            share(turn(before.heading_rad, motion.heading_rad).abs(), TURNED_RAD),
            share(distance2(motion.position_m, expected_m).sqrt(), MOVED_M),
        ]
    }
}

/// `value` in `most`, at most 1.
fn share(value: f64, most: f64) -> f32 {
    (value / most).clamp(0.0, 1.0) as f32
}

fn distance2(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)
}
