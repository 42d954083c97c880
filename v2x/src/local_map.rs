//! Local dynamic map of one station: the objects that it knows from messages.

use std::{
    cmp::Ordering,
    collections::{BTreeMap, VecDeque},
    ops::Range,
};

use ipc_schema::neighbours::{NEIGHBOUR_COLUMNS, NEIGHBOUR_ID_COLUMNS, NeighbourSource};

/// Two objects nearer to each other than this are one, unless both spoke for themselves, metres. It is about half a car's length.
pub const SAME_OBJECT_M: f64 = 2.5;

/// An object as a message describes it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownObject {
    /// Station of the object; 0 for one that another station perceives.
    pub station: u32,
    /// Station that it was heard from.
    pub heard_from: u32,
    /// Number of the object at that station; 0 for the station itself.
    pub object: u32,
    /// The message.
    pub source: NeighbourSource,
    /// Centre, world, metres.
    pub position_m: [f64; 2],
    /// Velocity, world, m/s.
    pub velocity_mps: [f64; 2],
    /// Radians counter-clockwise from east.
    pub heading_rad: f64,
    /// Length and width, metres.
    pub size_m: [f32; 2],
    /// Simulated time of the measurement, ms.
    pub measured_ms: i64,
    /// Standard deviations: of the position on each axis (metres), of the velocity on each axis (m/s), of the heading (radians).
    pub deviations: [f32; 3],
}

impl KnownObject {
    /// Position at a time, with its velocity unchanged, metres.
    #[must_use]
    pub fn position_at_m(&self, now_ms: i64) -> [f64; 2] {
        let age_s = (now_ms - self.measured_ms) as f64 / 1000.0;
        [0, 1].map(|axis: usize| self.position_m[axis] + age_s * self.velocity_mps[axis])
    }

    /// The numbers and the identity of a row of `neighbours`.
    #[must_use]
    pub fn columns(&self, now_ms: i64) -> ([f32; NEIGHBOUR_COLUMNS], [u32; NEIGHBOUR_ID_COLUMNS]) {
        let [x, y] = self.position_m.map(|value| value as f32);
        let [vx, vy] = self.velocity_mps.map(|value| value as f32);
        let [length, width] = self.size_m;
        let age_s = (now_ms - self.measured_ms) as f32 / 1000.0;
        let [position, velocity, heading] = self.deviations;
        let numbers = [
            x,
            y,
            vx,
            vy,
            self.heading_rad as f32,
            length,
            width,
            age_s,
            position,
            velocity,
            heading,
        ];
        (numbers, [self.station, self.heard_from, self.source as u32])
    }
}

/// Everything that was heard lately. Many stations hear the same message: their maps refer to one copy of its objects.
///
/// Each station that sends has a few slots, and each of its objects keeps one as long as anything that was heard of it lives: the station
/// itself the first. So a map finds what it knows of an object by its slot, without a search.
#[derive(Debug, Clone, Default)]
pub struct HeardObjects {
    objects: VecDeque<KnownObject>,
    /// Slot and time of each, in the same order.
    entries: VecDeque<HeardEntry>,
    /// Numbers of the oldest object and of the next: they are counted from the first one of the episode, and begin again at 0 behind
    /// [`NO_OBJECT`].
    first: u32,
    next: u32,
    /// Where each is now, metres.
    now_m: Vec<[f64; 2]>,
    /// The same from the origin.
    about_now_m: Vec<[f32; 2]>,
    /// By station.
    senders: BTreeMap<u32, SenderSlots>,
    /// Objects that were measured before this time are in no map, ms.
    lives_from_ms: i64,
    /// Place of the first object: f32 is exact to millimetres about it.
    origin_m: Option<[f64; 2]>,
}

/// What a map needs of an object that it hears of.
#[derive(Debug, Clone, Copy)]
struct HeardEntry {
    measured_ms: i64,
    /// Nothing that was heard of it before was measured later.
    is_newest: bool,
    /// Station that it was heard from.
    sender: u32,
    /// Its slot there.
    slot: u32,
}

/// Slots of a station that sends.
#[derive(Debug, Clone)]
struct SenderSlots {
    slots: Vec<SenderSlot>,
    /// When the newest of its objects was measured, ms.
    newest_ms: i64,
}

#[derive(Debug, Clone, Copy)]
struct SenderSlot {
    /// Number of the object at the station.
    object: u32,
    /// When it was measured at last, ms.
    newest_ms: i64,
}

/// No object was heard of yet.
const NEVER_MS: i64 = i64::MIN;

impl Default for SenderSlots {
    fn default() -> Self {
        // The station itself.
        let own = SenderSlot {
            object: 0,
            newest_ms: NEVER_MS,
        };
        Self {
            slots: vec![own],
            newest_ms: NEVER_MS,
        }
    }
}

impl SenderSlots {
    /// The slot of an object: its own, or one whose object is in no map any more.
    fn slot_of(&mut self, object: u32, lives_from_ms: i64) -> usize {
        if let Some(slot) = self.slots.iter().position(|slot| slot.object == object) {
            return slot;
        }
        let taken = SenderSlot {
            object,
            newest_ms: NEVER_MS,
        };
        let is_free = |slot: &SenderSlot| slot.object != 0 && slot.newest_ms < lives_from_ms;
        match self.slots.iter().position(is_free) {
            Some(slot) => {
                self.slots[slot] = taken;
                slot
            }
            None => {
                self.slots.push(taken);
                self.slots.len() - 1
            }
        }
    }
}

impl HeardObjects {
    /// Adds the objects of a message; returns their numbers.
    pub fn add(&mut self, objects: &[KnownObject]) -> Range<u32> {
        // One number is that of no object.
        if self.next.checked_add(objects.len() as u32).is_none() {
            objects.iter().for_each(|object| self.push(*object));
        }
        let from = self.next;
        objects.iter().for_each(|object| self.push(*object));
        from..self.next
    }

    fn push(&mut self, object: KnownObject) {
        let (sender, measured_ms) = (object.heard_from, object.measured_ms);
        self.origin_m.get_or_insert(object.position_m);
        let slots = self.senders.entry(sender).or_default();
        slots.newest_ms = slots.newest_ms.max(measured_ms);
        let number = slots.slot_of(object.object, self.lives_from_ms);
        let slot = &mut slots.slots[number];
        self.entries.push_back(HeardEntry {
            measured_ms,
            is_newest: measured_ms >= slot.newest_ms,
            sender,
            slot: number as u32,
        });
        slot.newest_ms = slot.newest_ms.max(measured_ms);
        self.objects.push_back(object);
        self.next = self.next.wrapping_add(1);
    }

    /// Moves every object to its place at `now_ms`, and gives up the oldest ones that were measured more than `lifetime_ms` ago: no map
    /// refers to them after [`LocalMap::forget`].
    pub fn advance(&mut self, now_ms: i64, lifetime_ms: i64) {
        self.lives_from_ms = now_ms - lifetime_ms;
        let lives_from_ms = self.lives_from_ms;
        while self
            .objects
            .front()
            .is_some_and(|object| object.measured_ms < lives_from_ms)
        {
            self.objects.pop_front();
            self.entries.pop_front();
            self.first = self.first.wrapping_add(1);
        }
        self.senders.retain(|_, slots| slots.newest_ms >= lives_from_ms);
        self.now_m.clear();
        self.now_m
            .extend(self.objects.iter().map(|object| object.position_at_m(now_ms)));
        let origin_m = self.origin_m.unwrap_or_default();
        self.about_now_m.clear();
        self.about_now_m.extend(
            self.now_m
                .iter()
                .map(|place| [(place[0] - origin_m[0]) as f32, (place[1] - origin_m[1]) as f32]),
        );
    }

    /// The objects of these numbers, which have not been given up.
    pub fn of(&self, numbers: Range<u32>) -> impl Iterator<Item = &KnownObject> {
        numbers.map(|number| self.object(number))
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Its place among those that live.
    fn place(&self, number: u32) -> usize {
        number.wrapping_sub(self.first) as usize
    }

    /// The object of this number, which no map has forgotten.
    fn object(&self, number: u32) -> &KnownObject {
        &self.objects[self.place(number)]
    }

    /// What maps need of the object of this number.
    fn entry(&self, number: u32) -> &HeardEntry {
        &self.entries[self.place(number)]
    }

    /// Its place at the time of the last [`HeardObjects::advance`], metres.
    fn now_m(&self, number: u32) -> [f64; 2] {
        self.now_m[self.place(number)]
    }
}

/// Number of no object.
const NO_OBJECT: u32 = u32::MAX;
/// Slots of a block are a multiple of this.
const BLOCK_SLOTS: usize = 4;
/// More than what a distance in f32 may be wrong by, metres.
const ROUNDING_M: f32 = 0.25;

/// What a map knows from one station.
#[derive(Debug, Clone, Copy)]
struct SenderBlock {
    /// The station.
    sender: u32,
    /// First of its slots in the map.
    from: u32,
    slots: u32,
    /// Nothing in it was measured before this time, ms.
    oldest_ms: i64,
}

impl SenderBlock {
    fn range(&self) -> Range<usize> {
        self.from as usize..(self.from + self.slots) as usize
    }
}

/// The map: for each station that it heard from, the newest object of each of the station's slots.
#[derive(Debug, Clone, Default)]
pub struct LocalMap {
    /// Ascending by station.
    blocks: Vec<SenderBlock>,
    /// Numbers of objects among all that was heard, block by block.
    numbers: Vec<u32>,
    /// Places of `numbers` that no block has.
    unused: usize,
    /// Objects in it.
    known: usize,
}

impl LocalMap {
    /// Takes what a message says of these objects, each unless something newer is known of it.
    pub fn insert(&mut self, heard: &HeardObjects, numbers: Range<u32>) {
        let mut place = None;
        for number in numbers {
            let entry = heard.entry(number);
            // All objects of a message are of one station.
            let block = match place {
                Some(place) if self.blocks[place as usize].sender == entry.sender => place as usize,
                _ => self.block_of(entry.sender),
            };
            place = Some(block as u32);
            if entry.slot >= self.blocks[block].slots {
                self.grow(block, entry.slot as usize + 1);
            }
            let block = &mut self.blocks[block];
            block.oldest_ms = block.oldest_ms.min(entry.measured_ms);
            let known = &mut self.numbers[(block.from + entry.slot) as usize];
            if *known == NO_OBJECT {
                self.known += 1;
                *known = number;
            } else if entry.is_newest || heard.entry(*known).measured_ms <= entry.measured_ms {
                *known = number;
            }
        }
    }

    /// The place of a station's block, a new one if there is none.
    fn block_of(&mut self, sender: u32) -> usize {
        match self.blocks.binary_search_by_key(&sender, |block| block.sender) {
            Ok(place) => place,
            Err(place) => {
                let block = SenderBlock {
                    sender,
                    from: self.numbers.len() as u32,
                    slots: 0,
                    oldest_ms: i64::MAX,
                };
                self.blocks.insert(place, block);
                place
            }
        }
    }

    /// Moves a block behind the last, with at least `slots` slots.
    fn grow(&mut self, place: usize, slots: usize) {
        let block = &mut self.blocks[place];
        let (old, from) = (block.range(), self.numbers.len());
        self.unused += old.len();
        let slots = slots.next_multiple_of(BLOCK_SLOTS);
        (block.from, block.slots) = (from as u32, slots as u32);
        self.numbers.extend_from_within(old);
        self.numbers.resize(from + slots, NO_OBJECT);
    }

    /// Forgets what was measured more than `lifetime_ms` ago.
    pub fn forget(&mut self, heard: &HeardObjects, now_ms: i64, lifetime_ms: i64) {
        let lives_from_ms = now_ms - lifetime_ms;
        let (numbers, known, unused) = (&mut self.numbers, &mut self.known, &mut self.unused);
        self.blocks.retain_mut(|block| {
            if block.oldest_ms >= lives_from_ms {
                return true;
            }
            block.oldest_ms = i64::MAX;
            for number in &mut numbers[block.range()] {
                if *number == NO_OBJECT {
                    continue;
                }
                let measured_ms = heard.entry(*number).measured_ms;
                if measured_ms < lives_from_ms {
                    *number = NO_OBJECT;
                    *known -= 1;
                } else {
                    block.oldest_ms = block.oldest_ms.min(measured_ms);
                }
            }
            let is_empty = block.oldest_ms == i64::MAX;
            *unused += if is_empty { block.slots as usize } else { 0 };
            !is_empty
        });
        if 2 * self.unused > self.numbers.len() {
            self.compact();
        }
    }

    /// Gives up what no block uses.
    fn compact(&mut self) {
        let mut numbers = Vec::with_capacity(self.numbers.len() - self.unused);
        for block in &mut self.blocks {
            let from = numbers.len() as u32;
            numbers.extend_from_slice(&self.numbers[block.range()]);
            block.from = from;
        }
        (self.numbers, self.unused) = (numbers, 0);
    }

    /// Every known object, each station's view of it by itself, by station and slot.
    pub fn all<'a>(&'a self, heard: &'a HeardObjects) -> impl Iterator<Item = &'a KnownObject> {
        let numbers = self.blocks.iter().flat_map(|block| &self.numbers[block.range()]);
        numbers
            .filter(|number| **number != NO_OBJECT)
            .map(|number| heard.object(*number))
    }

    /// Number of stations that it knows something from.
    #[must_use]
    pub fn stations(&self) -> usize {
        self.blocks.len()
    }

    /// True if it knows something from this station.
    #[must_use]
    pub fn has_heard(&self, station: u32) -> bool {
        self.blocks.binary_search_by_key(&station, |block| block.sender).is_ok()
    }

    /// Number of known objects, each station's view of an object counted.
    #[must_use]
    pub fn len(&self) -> usize {
        self.known
    }

    /// True if nothing is known.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.known == 0
    }

    /// The `count` objects nearest to `from_m` at the time of the last [`HeardObjects::advance`], into `nearest`. An object that others
    /// perceive is left out where it is the station itself, at `from_m`, or one that is listed already.
    ///
    /// Most objects are farther than those that are listed, or the same as one that spoke for itself. Both show in f32.
    pub fn nearest<'a>(
        &self,
        heard: &'a HeardObjects,
        from_m: [f64; 2],
        count: usize,
        nearest: &mut Vec<&'a KnownObject>,
    ) {
        nearest.clear();
        let Some(origin_m) = heard.origin_m else { return };
        let about_from_m = [0, 1].map(|axis: usize| (from_m[axis] - origin_m[axis]) as f32);
        let same2 = SAME_OBJECT_M * SAME_OBJECT_M;
        let away2 = |number: u32| distance2(heard.now_m(number), from_m);
        // Its own word comes before another's at nearly the same place: those that spoke for themselves are chosen first.
        let mut chosen = self.nearest_own(heard, about_from_m, count, away2);
        let spoke = chosen.len();
        let spoke_m: Vec<[f32; 2]> = chosen
            .iter()
            .map(|(_, number)| {
                let place = heard.now_m(*number);
                [0, 1].map(|axis: usize| (place[axis] - from_m[axis]) as f32)
            })
            .collect();
        // Behind `count` of them no other is listed.
        let farthest2 = chosen
            .get(count.wrapping_sub(1))
            .map_or(f64::INFINITY, |(away2, _)| *away2);
        let about_farthest2 = (farthest2.sqrt() as f32 + ROUNDING_M).powi(2);
        let about_same2 = (SAME_OBJECT_M as f32 - ROUNDING_M).powi(2);
        let mut perceived = Vec::new();
        for block in &self.blocks {
            for number in &self.numbers[block.range()][1..] {
                if *number == NO_OBJECT {
                    continue;
                }
                let [x, y] = heard.about_now_m[heard.place(*number)];
                let [x, y] = [x - about_from_m[0], y - about_from_m[1]];
                let is_same = |place: &[f32; 2]| (x - place[0]).powi(2) + (y - place[1]).powi(2) < about_same2;
                if x * x + y * y > about_farthest2 || spoke_m.iter().any(is_same) {
                    continue;
                }
                let away2 = away2(*number);
                if away2 > same2 && away2 <= farthest2 {
                    perceived.push((away2, *number));
                }
            }
        }
        let mut rest = &mut perceived[..];
        'all: while !rest.is_empty() {
            let part = nearest_first(rest, count);
            let (sorted, farther) = rest.split_at_mut(part);
            for &mut (away2, number) in sorted {
                let nearer = chosen[..spoke].partition_point(|(other2, _)| *other2 < away2);
                if nearer + chosen.len() - spoke >= count {
                    break 'all;
                }
                let place = heard.now_m(number);
                if chosen
                    .iter()
                    .all(|(_, other)| distance2(heard.now_m(*other), place) > same2)
                {
                    chosen.push((away2, number));
                }
            }
            rest = farther;
        }
        chosen.sort_unstable_by(by_distance);
        nearest.extend(chosen.into_iter().take(count).map(|(_, number)| heard.object(number)));
    }

    /// The `count` nearest of the stations that spoke for themselves, with the squares of their distances. They have the first slot of
    /// their block.
    fn nearest_own(
        &self,
        heard: &HeardObjects,
        from_m: [f32; 2],
        count: usize,
        away2: impl Fn(u32) -> f64,
    ) -> Vec<(f64, u32)> {
        let own = self.blocks.iter().map(|block| self.numbers[block.from as usize]);
        let about_away2 = |number: u32| {
            let [x, y] = heard.about_now_m[heard.place(number)];
            (x - from_m[0]).powi(2) + (y - from_m[1]).powi(2)
        };
        let mut about: Vec<(f32, u32)> = own
            .filter(|number| *number != NO_OBJECT)
            .map(|number| (about_away2(number), number))
            .collect();
        if count < about.len() {
            let (_, last, _) = about.select_nth_unstable_by(count, |a, b| a.0.total_cmp(&b.0));
            let most2 = (last.0.sqrt() + 2.0 * ROUNDING_M).powi(2);
            about.retain(|(about2, _)| *about2 <= most2);
        }
        let mut own: Vec<(f64, u32)> = about.into_iter().map(|(_, number)| (away2(number), number)).collect();
        nearest_first(&mut own, count);
        own.truncate(count);
        own
    }
}

fn distance2(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)
}

fn by_distance(a: &(f64, u32), b: &(f64, u32)) -> Ordering {
    a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
}

/// Sorts the `count` nearest, which come first. Returns how many they are.
fn nearest_first(order: &mut [(f64, u32)], count: usize) -> usize {
    if count < order.len() {
        order.select_nth_unstable_by(count, by_distance);
    }
    let count = count.min(order.len());
    order[..count].sort_unstable_by(by_distance);
    count
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn object(heard_from: u32, object: u32, x_m: f64, measured_ms: i64) -> KnownObject {
        let is_own = object == 0;
        KnownObject {
            station: if is_own { heard_from } else { 0 },
            heard_from,
            object,
            source: if is_own {
                NeighbourSource::Cam
            } else {
                NeighbourSource::Cpm
            },
            position_m: [x_m, 0.0],
            velocity_mps: [10.0, 0.0],
            heading_rad: 0.0,
            size_m: [4.0, 2.0],
            measured_ms,
            deviations: [1.0, 0.5, 0.1],
        }
    }

    fn key(object: &KnownObject) -> (u32, u32) {
        (object.heard_from, object.object)
    }

    /// A map, and what it refers to.
    #[derive(Default)]
    struct Heard(HeardObjects, LocalMap);

    impl Heard {
        fn insert(&mut self, object: KnownObject) {
            let numbers = self.0.add(&[object]);
            self.1.insert(&self.0, numbers);
        }

        fn nearest(&mut self, now_ms: i64, count: usize) -> Vec<KnownObject> {
            self.0.advance(now_ms, i64::MAX / 2);
            let mut found = Vec::new();
            self.1.nearest(&self.0, [0.0, 0.0], count, &mut found);
            found.into_iter().copied().collect()
        }

        fn keys(&mut self, now_ms: i64, count: usize) -> Vec<(u32, u32)> {
            self.nearest(now_ms, count).iter().map(key).collect()
        }
    }

    #[test]
    fn the_newest_word_on_an_object_counts() {
        let mut heard = Heard::default();
        heard.insert(object(1, 0, 50.0, 100));
        heard.insert(object(1, 0, 60.0, 200));
        heard.insert(object(1, 0, 70.0, 150));
        assert_eq!(heard.1.len(), 1);
        let (numbers, ids) = heard.nearest(300, 4)[0].columns(300);
        assert_eq!((numbers[0], numbers[7], ids), (60.0, 0.1, [1, 1, 1]));
        heard.1.forget(&heard.0, 1701, 1500);
        assert!(heard.1.is_empty());
    }

    #[test]
    fn objects_come_by_their_distance_now() {
        let mut heard = Heard::default();
        heard.insert(object(1, 0, -30.0, 0));
        heard.insert(object(2, 0, 20.0, 0));
        heard.insert(object(3, 0, 5.0, 900));
        // At 1 s: 1 at −20 m, 2 at 30 m, 3 at 6 m.
        assert_eq!(heard.keys(1000, 9), [(3, 0), (1, 0), (2, 0)]);
        assert_eq!(heard.keys(1000, 2), [(3, 0), (1, 0)]);
    }

    #[test]
    fn perceived_objects_give_way_to_the_same_object_and_to_oneself() {
        let mut heard = Heard::default();
        heard.insert(object(1, 0, 30.0, 0));
        heard.insert(object(2, 0, 80.0, 0));
        // 2 perceives 1, the station itself, and a third object, which 1 perceives too.
        heard.insert(object(2, 7, 31.0, 0));
        heard.insert(object(2, 8, 1.0, 0));
        heard.insert(object(2, 9, 50.0, 0));
        heard.insert(object(1, 4, 51.0, 0));
        assert_eq!(heard.keys(0, 9), [(1, 0), (2, 9), (2, 0)]);
    }

    /// All of them sorted, and chosen one after the other.
    fn chosen_from_all(objects: &[KnownObject], now_ms: i64, count: usize) -> Vec<(u32, u32)> {
        let away = |object: &KnownObject| distance2(object.position_at_m(now_ms), [0.0, 0.0]);
        let mut sorted: Vec<&KnownObject> = objects.iter().collect();
        sorted.sort_by(|a, b| away(a).total_cmp(&away(b)));
        let same2 = SAME_OBJECT_M * SAME_OBJECT_M;
        let (own, perceived): (Vec<&KnownObject>, Vec<&KnownObject>) =
            sorted.into_iter().partition(|object| object.object == 0);
        let mut chosen: Vec<&KnownObject> = own.into_iter().take(count).collect();
        for object in perceived.into_iter().filter(|object| away(object) > same2) {
            let place = object.position_at_m(now_ms);
            if chosen
                .iter()
                .all(|other| distance2(other.position_at_m(now_ms), place) > same2)
            {
                chosen.push(object);
            }
        }
        chosen.sort_by(|a, b| away(a).total_cmp(&away(b)));
        chosen.iter().take(count).map(|object| key(object)).collect()
    }

    proptest! {
        #[test]
        fn the_nearest_are_those_of_a_search_of_everything(
            places in prop::collection::vec((1_u32..6, 0_u32..30, -60.0_f64..60.0, 0_i64..500), 0..80), count in 1_usize..12,
        ) {
            let mut heard = Heard::default();
            let mut objects: Vec<KnownObject> = Vec::new();
            for (heard_from, number, x_m, measured_ms) in places {
                let object = object(heard_from, number, x_m, measured_ms);
                if objects.iter().all(|other| key(other) != key(&object)) {
                    heard.insert(object);
                    objects.push(object);
                }
            }
            prop_assert_eq!(heard.keys(500, count), chosen_from_all(&objects, 500, count));
        }

        /// Beside a list that is searched for each object. Stations hear each other by chance, and what is measured comes in any order.
        #[test]
        fn maps_know_what_a_list_of_objects_knows(
            ticks in prop::collection::vec(
                (0_i64..200, prop::collection::vec((1_u32..5, prop::collection::vec((0_u32..12, 0_i64..450), 0..6), 0_u8..8), 0..6)),
                1..40,
            ),
        ) {
            const LIFETIME_MS: i64 = 400;
            let mut heard = HeardObjects::default();
            let mut maps = vec![LocalMap::default(); 3];
            let mut lists: Vec<Vec<KnownObject>> = vec![Vec::new(); 3];
            let mut now_ms = 0;
            let mut messages: Vec<(Range<u32>, Vec<KnownObject>, u8)> = Vec::new();
            for (later_ms, sent) in ticks {
                now_ms += later_ms;
                for (receiver, (map, list)) in maps.iter_mut().zip(&mut lists).enumerate() {
                    for (numbers, objects, _) in messages.iter().filter(|(_, _, to)| to >> receiver & 1 == 1) {
                        map.insert(&heard, numbers.clone());
                        for object in objects {
                            match list.iter_mut().find(|known| key(known) == key(object)) {
                                None => list.push(*object),
                                Some(known) if known.measured_ms <= object.measured_ms => *known = *object,
                                Some(_) => {}
                            }
                        }
                    }
                    map.forget(&heard, now_ms, LIFETIME_MS);
                    list.retain(|object| now_ms - object.measured_ms <= LIFETIME_MS);
                }
                heard.advance(now_ms, LIFETIME_MS);
                for (map, list) in maps.iter().zip(&lists) {
                    let mut known: Vec<KnownObject> = map
                        .blocks
                        .iter()
                        .flat_map(|block| &map.numbers[block.range()])
                        .filter(|number| **number != NO_OBJECT)
                        .map(|number| *heard.object(*number))
                        .collect();
                    known.sort_by_key(key);
                    let mut expected = list.clone();
                    expected.sort_by_key(key);
                    prop_assert_eq!(map.len(), known.len());
                    prop_assert_eq!(known, expected);
                    prop_assert!(2 * map.unused <= map.numbers.len());
                }
                messages.clear();
                for (sender, content, to) in sent {
                    let mut objects: Vec<KnownObject> = Vec::new();
                    for (number, age_ms) in content {
                        objects.push(object(sender, number, f64::from(number), now_ms - age_ms));
                    }
                    messages.push((heard.add(&objects), objects, to));
                }
            }
        }

        #[test]
        fn slots_are_used_again(objects in prop::collection::vec(1_u32..1_000_000, 200)) {
            let (mut heard, mut map) = (HeardObjects::default(), LocalMap::default());
            for (tick, number) in (0_i64..).zip(objects) {
                let numbers = heard.add(&[object(1, number, 3.0, 100 * tick)]);
                map.insert(&heard, numbers);
                map.forget(&heard, 100 * tick, 400);
                heard.advance(100 * tick, 400);
                prop_assert!(map.numbers.len() <= 16 && heard.senders[&1].slots.len() <= 8);
            }
        }
    }
}
