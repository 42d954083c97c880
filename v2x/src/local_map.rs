//! Local dynamic map of one station: the objects that it knows from messages.

use std::{cmp::Ordering, collections::VecDeque, ops::Range};

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
    fn key(&self) -> (u32, u32) {
        (self.heard_from, self.object)
    }

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
#[derive(Debug, Clone, Default)]
pub struct HeardObjects {
    objects: VecDeque<KnownObject>,
    /// Number of the oldest object: they are counted from the first one of the episode.
    first: u64,
    /// Where each is now, metres.
    now_m: Vec<[f64; 2]>,
}

impl HeardObjects {
    /// Adds the objects of a message; returns their numbers.
    pub fn add(&mut self, objects: impl IntoIterator<Item = KnownObject>) -> Range<u64> {
        let from = self.first + self.objects.len() as u64;
        self.objects.extend(objects);
        from..self.first + self.objects.len() as u64
    }

    /// Moves every object to its place at `now_ms`, and gives up the oldest ones that were measured more than `lifetime_ms` ago: no map
    /// refers to them after [`LocalMap::forget`].
    pub fn advance(&mut self, now_ms: i64, lifetime_ms: i64) {
        let is_old = |object: &KnownObject| now_ms - object.measured_ms > lifetime_ms;
        while self.objects.front().is_some_and(is_old) {
            self.objects.pop_front();
            self.first += 1;
        }
        self.now_m.clear();
        self.now_m
            .extend(self.objects.iter().map(|object| object.position_at_m(now_ms)));
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// The object of this number, which no map has forgotten.
    fn object(&self, number: u64) -> &KnownObject {
        &self.objects[(number - self.first) as usize]
    }

    /// Its place at the time of the last [`HeardObjects::advance`], metres.
    fn now_m(&self, number: u64) -> [f64; 2] {
        self.now_m[(number - self.first) as usize]
    }
}

/// An object of a map.
#[derive(Debug, Clone, Copy, PartialEq)]
struct MapEntry {
    /// Station that it was heard from, and number of the object at that station.
    key: (u32, u32),
    measured_ms: i64,
    /// Its number among all that was heard.
    number: u64,
}

/// The map.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LocalMap {
    /// By key, ascending.
    entries: Vec<MapEntry>,
}

impl LocalMap {
    /// Takes what a message says of these objects, each unless something newer is known of it.
    pub fn insert(&mut self, heard: &HeardObjects, numbers: Range<u64>) {
        for number in numbers {
            let object = heard.object(number);
            let entry = MapEntry {
                key: object.key(),
                measured_ms: object.measured_ms,
                number,
            };
            match self.entries.binary_search_by_key(&entry.key, |entry| entry.key) {
                Ok(place) if self.entries[place].measured_ms <= entry.measured_ms => self.entries[place] = entry,
                Ok(_) => {}
                Err(place) => self.entries.insert(place, entry),
            }
        }
    }

    /// Forgets what was measured more than `lifetime_ms` ago.
    pub fn forget(&mut self, now_ms: i64, lifetime_ms: i64) {
        self.entries.retain(|entry| now_ms - entry.measured_ms <= lifetime_ms);
    }

    /// Number of known objects, each station's view of an object counted.
    #[must_use]
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// True if nothing is known.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// The `count` objects nearest to `from_m` now, into `nearest`. An object that others perceive is left out where it is the station
    /// itself, at `from_m`, or one that is listed already.
    pub fn nearest<'a>(
        &self,
        heard: &'a HeardObjects,
        from_m: [f64; 2],
        count: usize,
        nearest: &mut Vec<&'a KnownObject>,
    ) {
        nearest.clear();
        let same2 = SAME_OBJECT_M * SAME_OBJECT_M;
        // Its own word comes before another's at nearly the same place: those that spoke for themselves are chosen first.
        let (mut own, mut perceived) = (Vec::new(), Vec::new());
        for entry in &self.entries {
            let away2 = distance2(heard.now_m(entry.number), from_m);
            // An object has a number at the station that perceives it.
            match entry.key.1 {
                0 => own.push((away2, entry.number)),
                _ if away2 > same2 => perceived.push((away2, entry.number)),
                _ => {}
            }
        }
        nearest_first(&mut own, count);
        own.truncate(count);
        let spoke = own.len();
        let mut chosen = own;
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
}

fn distance2(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)
}

fn by_distance(a: &(f64, u64), b: &(f64, u64)) -> Ordering {
    a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
}

/// Sorts the `count` nearest, which come first. Returns how many they are.
fn nearest_first(order: &mut [(f64, u64)], count: usize) -> usize {
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

    /// A map, and what it refers to.
    #[derive(Default)]
    struct Heard(HeardObjects, LocalMap);

    impl Heard {
        fn insert(&mut self, object: KnownObject) {
            let numbers = self.0.add([object]);
            self.1.insert(&self.0, numbers);
        }

        fn nearest(&mut self, now_ms: i64, count: usize) -> Vec<KnownObject> {
            self.0.advance(now_ms, i64::MAX / 2);
            let mut found = Vec::new();
            self.1.nearest(&self.0, [0.0, 0.0], count, &mut found);
            found.into_iter().copied().collect()
        }

        fn keys(&mut self, now_ms: i64, count: usize) -> Vec<(u32, u32)> {
            self.nearest(now_ms, count).iter().map(KnownObject::key).collect()
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
        heard.1.forget(1701, 1500);
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
        chosen.iter().take(count).map(|object| object.key()).collect()
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
                if objects.iter().all(|other| other.key() != object.key()) {
                    heard.insert(object);
                    objects.push(object);
                }
            }
            prop_assert_eq!(heard.keys(500, count), chosen_from_all(&objects, 500, count));
        }

        #[test]
        fn what_is_given_up_is_in_no_map(
            steps in prop::collection::vec((1_u32..5, 0_u32..6, 0_i64..300, 0_i64..200), 1..60),
        ) {
            let (mut heard, mut now_ms) = (Heard::default(), 0);
            for (heard_from, number, age_ms, later_ms) in steps {
                now_ms += later_ms;
                heard.insert(object(heard_from, number, 3.0, now_ms - age_ms));
                heard.1.forget(now_ms, 400);
                heard.0.advance(now_ms, 400);
                let kept = heard.0.objects.len() as u64;
                prop_assert!(heard.1.entries.iter().all(|entry| (heard.0.first..heard.0.first + kept).contains(&entry.number)));
            }
        }
    }
}
