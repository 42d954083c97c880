//! Local dynamic map of one station: the objects that it knows from messages.

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

/// The map.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LocalMap {
    /// By station heard from and object, ascending.
    objects: Vec<KnownObject>,
}

impl LocalMap {
    /// Takes what a message says of an object, unless something newer is known of it.
    pub fn insert(&mut self, object: KnownObject) {
        match self.objects.binary_search_by_key(&object.key(), KnownObject::key) {
            Ok(place) if self.objects[place].measured_ms <= object.measured_ms => self.objects[place] = object,
            Ok(_) => {}
            Err(place) => self.objects.insert(place, object),
        }
    }

    /// Forgets what was measured more than `lifetime_ms` ago.
    pub fn forget(&mut self, now_ms: i64, lifetime_ms: i64) {
        self.objects.retain(|object| now_ms - object.measured_ms <= lifetime_ms);
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.objects.clear();
    }

    /// Number of known objects, each station's view of an object counted.
    #[must_use]
    pub fn len(&self) -> usize {
        self.objects.len()
    }

    /// True if nothing is known.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// The `count` objects nearest to `from_m` at a time, into `nearest`. An object that others perceive is left out where it is the
    /// station itself, at `from_m`, or one that is listed already.
    pub fn nearest(&self, from_m: [f64; 2], now_ms: i64, count: usize, nearest: &mut Vec<KnownObject>) {
        nearest.clear();
        let distance2 = |object: &KnownObject, point: [f64; 2]| {
            let [x, y] = object.position_at_m(now_ms);
            (x - point[0]).powi(2) + (y - point[1]).powi(2)
        };
        let mut order: Vec<(f64, usize)> = self
            .objects
            .iter()
            .enumerate()
            .map(|(place, object)| (distance2(object, from_m), place))
            .collect();
        // Its own word comes before another's at nearly the same place: those that spoke for themselves are chosen first.
        let same2 = SAME_OBJECT_M * SAME_OBJECT_M;
        let is_own = |place: usize| self.objects[place].source != NeighbourSource::Cpm;
        let mut own: Vec<(f64, usize)> = order.iter().copied().filter(|(_, place)| is_own(*place)).collect();
        order.retain(|(away2, place)| !is_own(*place) && *away2 > same2);
        let by_distance = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        own.sort_unstable_by(by_distance);
        order.sort_unstable_by(by_distance);
        let mut chosen: Vec<(f64, usize)> = own.into_iter().take(count).collect();
        let mut perceived = 0;
        for (away2, place) in order {
            if perceived == count {
                break;
            }
            let point = self.objects[place].position_at_m(now_ms);
            if chosen
                .iter()
                .all(|(_, other)| distance2(&self.objects[*other], point) > same2)
            {
                chosen.push((away2, place));
                perceived += 1;
            }
        }
        chosen.sort_unstable_by(by_distance);
        nearest.extend(chosen.into_iter().take(count).map(|(_, place)| self.objects[place]));
    }
}

#[cfg(test)]
mod tests {
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

    fn nearest(map: &LocalMap, now_ms: i64, count: usize) -> Vec<(u32, u32)> {
        let mut found = Vec::new();
        map.nearest([0.0, 0.0], now_ms, count, &mut found);
        found.iter().map(KnownObject::key).collect()
    }

    #[test]
    fn the_newest_word_on_an_object_counts() {
        let mut map = LocalMap::default();
        map.insert(object(1, 0, 50.0, 100));
        map.insert(object(1, 0, 60.0, 200));
        map.insert(object(1, 0, 70.0, 150));
        assert_eq!(map.len(), 1);
        let mut found = Vec::new();
        map.nearest([0.0, 0.0], 300, 4, &mut found);
        let (numbers, ids) = found[0].columns(300);
        assert_eq!((numbers[0], numbers[7], ids), (60.0, 0.1, [1, 1, 1]));
        map.forget(1701, 1500);
        assert!(map.is_empty());
    }

    #[test]
    fn objects_come_by_their_distance_now() {
        let mut map = LocalMap::default();
        map.insert(object(1, 0, -30.0, 0));
        map.insert(object(2, 0, 20.0, 0));
        map.insert(object(3, 0, 5.0, 900));
        // At 1 s: 1 at −20 m, 2 at 30 m, 3 at 6 m.
        assert_eq!(nearest(&map, 1000, 9), [(3, 0), (1, 0), (2, 0)]);
        assert_eq!(nearest(&map, 1000, 2), [(3, 0), (1, 0)]);
    }

    #[test]
    fn perceived_objects_give_way_to_the_same_object_and_to_oneself() {
        let mut map = LocalMap::default();
        map.insert(object(1, 0, 30.0, 0));
        map.insert(object(2, 0, 80.0, 0));
        // 2 perceives 1, the station itself, and a third object, which 1 perceives too.
        map.insert(object(2, 7, 31.0, 0));
        map.insert(object(2, 8, 1.0, 0));
        map.insert(object(2, 9, 50.0, 0));
        map.insert(object(1, 4, 51.0, 0));
        assert_eq!(nearest(&map, 0, 9), [(1, 0), (2, 9), (2, 0)]);
    }
}
