//! Local dynamic map of one station: the objects that it knows from messages.

use std::{
    cmp::Ordering,
    collections::{BTreeMap, VecDeque},
    ops::Range,
};

use ipc_schema::neighbours::{NEIGHBOUR_COLUMNS, NEIGHBOUR_ID_COLUMNS, NeighbourSource};
use sensor_daemon::wide::{VectorPath, VectorWork};

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

/// Everything that was heard lately. Many stations hear the same message, and a map only has which messages its station received: what
/// they say is here once, and is looked up when a map is read.
///
/// Each station that sends has a few slots, and each of its objects keeps one as long as anything that was heard of it lives: the station
/// itself the first.
#[derive(Debug, Clone)]
pub struct HeardObjects {
    objects: VecDeque<KnownObject>,
    /// Numbers of the oldest object and of the next: they are counted from the first one of the episode, and begin again at 0.
    first: u32,
    next: u32,
    /// Where each is now, metres.
    now_m: Vec<[f64; 2]>,
    /// Stations that send. A place among them is used again when all that was heard of its station is forgotten.
    senders: Vec<HeardSender>,
    /// Places by station.
    places: BTreeMap<u32, u32>,
    unused: Vec<u32>,
    /// Words of the bits of each sender's messages.
    words: usize,
    /// What maps read: as of the last [`HeardObjects::advance`].
    now: HeardNow,
    /// Objects that were measured before this time are in no map, ms.
    lives_from_ms: i64,
    /// Place of the first object: f32 is exact to millimetres about it.
    origin_m: Option<[f64; 2]>,
}

impl Default for HeardObjects {
    fn default() -> Self {
        Self {
            objects: VecDeque::new(),
            first: 0,
            next: 0,
            now_m: Vec::new(),
            senders: Vec::new(),
            places: BTreeMap::new(),
            unused: Vec::new(),
            words: 1,
            now: HeardNow::default(),
            lives_from_ms: NEVER_MS,
            origin_m: None,
        }
    }
}

/// A message that was heard.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HeardMessage {
    /// Numbers of its objects.
    pub objects: Range<u32>,
    /// Place of its station among those that send, and the message's bit there.
    sender: u32,
    bit: u32,
}

/// A station that sends.
#[derive(Debug, Clone)]
struct HeardSender {
    station: u32,
    slots: Vec<SenderSlot>,
    /// Bits of messages that are in use.
    used: Vec<u64>,
}

/// An object of a station that sends.
#[derive(Debug, Clone)]
struct SenderSlot {
    /// Number of the object at the station.
    object: u32,
    /// What was said of it, ascending by the time of the measurement, then in the order in which it was heard.
    views: Vec<SlotView>,
}

#[derive(Debug, Clone, Copy)]
struct SlotView {
    measured_ms: i64,
    /// The object.
    number: u32,
    /// Bit of its message.
    bit: u32,
}

/// What maps read at a tick, packed.
#[derive(Debug, Clone, Default)]
struct HeardNow {
    /// By place: bits of the messages that live.
    alive: Vec<u64>,
    /// By place.
    senders: Vec<SenderNow>,
    /// By slot: bits of the messages with something of it, and the first of its views, with one more behind the last slot.
    slot_bits: Vec<u64>,
    slot_views: Vec<u32>,
    /// By slot: about its views.
    slot_circles: Vec<AboutCircle>,
    /// By slot, the newest first.
    views: Vec<ViewNow>,
}

/// What a station that sends has said.
#[derive(Debug, Clone, Copy)]
struct SenderNow {
    /// Its slots among all.
    from: u32,
    to: u32,
    /// About the objects that it perceives.
    perceived: AboutCircle,
}

/// A box about places, from the origin, metres.
#[derive(Debug, Clone, Copy)]
struct AboutBox {
    least_m: [f32; 2],
    most_m: [f32; 2],
}

impl AboutBox {
    const EMPTY: Self = Self {
        least_m: [f32::INFINITY; 2],
        most_m: [f32::NEG_INFINITY; 2],
    };

    fn with(&mut self, other: &Self) {
        for axis in 0..2 {
            self.least_m[axis] = self.least_m[axis].min(other.least_m[axis]);
            self.most_m[axis] = self.most_m[axis].max(other.most_m[axis]);
        }
    }

    /// The circle about it; nothing is in that of an empty one.
    fn circle(&self) -> AboutCircle {
        let [half_x_m, half_y_m] = [0, 1].map(|axis: usize| 0.5 * (self.most_m[axis] - self.least_m[axis]));
        match half_x_m >= 0.0 {
            true => AboutCircle {
                centre_m: [self.least_m[0] + half_x_m, self.least_m[1] + half_y_m],
                radius_m: (half_x_m * half_x_m + half_y_m * half_y_m).sqrt(),
            },
            false => AboutCircle {
                centre_m: [f32::INFINITY; 2],
                radius_m: 0.0,
            },
        }
    }
}

/// A circle about places, from the origin, metres.
#[derive(Debug, Clone, Copy)]
struct AboutCircle {
    centre_m: [f32; 2],
    radius_m: f32,
}

impl AboutCircle {
    /// Square of the distance from a point to the centre, m².
    #[inline(always)]
    fn away2_m2(&self, from_m: [f32; 2]) -> f32 {
        let [x, y] = [self.centre_m[0] - from_m[0], self.centre_m[1] - from_m[1]];
        x * x + y * y
    }

    /// True if all of it is farther from a point than `reach_m`.
    #[inline(always)]
    fn is_beyond(&self, from_m: [f32; 2], reach_m: f32) -> bool {
        let reach_m = reach_m + self.radius_m;
        self.away2_m2(from_m) > reach_m * reach_m
    }
}

/// What a map knows of the objects that others perceive, without those farther than `reach_m` and those that are surely one of the
/// stations at `spoke_m`: numbers into `found`.
struct NearPerceived<'a> {
    map: &'a LocalMap,
    heard: &'a HeardObjects,
    words: usize,
    from_m: [f32; 2],
    reach_m: f32,
    /// x and y in whole vectors; the last one is filled up with places where nothing is.
    spoke_m: &'a [[[f32; LANES]; 2]],
    found: &'a mut Vec<u32>,
}

/// Places nearer to each other than this are surely the same.
const SAME_M: f32 = SAME_OBJECT_M as f32 - ROUNDING_M;
/// Stations that are compared at once.
const LANES: usize = 8;

impl VectorWork for NearPerceived<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let (now, words) = (&self.heard.now, self.words);
        for (sender, received) in self.map.heard_from(self.heard, words) {
            if sender.perceived.is_beyond(self.from_m, self.reach_m) {
                continue;
            }
            // The first slot is the station itself.
            for slot in sender.from as usize + 1..sender.to as usize {
                if now.slot_circles[slot].is_beyond(self.from_m, self.reach_m) {
                    continue;
                }
                if let Some(view) = now.newest(slot, received, words)
                    && !is_one_of(view.about_m, self.spoke_m)
                {
                    self.found.push(view.number);
                }
            }
        }
    }
}

/// True if a place is surely that of one of these stations.
#[inline(always)]
fn is_one_of([x, y]: [f32; 2], spoke_m: &[[[f32; LANES]; 2]]) -> bool {
    let mut least2 = [f32::INFINITY; LANES];
    for [xs, ys] in spoke_m {
        for lane in 0..LANES {
            let (dx, dy) = (xs[lane] - x, ys[lane] - y);
            let away2 = dx * dx + dy * dy;
            least2[lane] = if away2 < least2[lane] { away2 } else { least2[lane] };
        }
    }
    let mut same = 0_u32;
    for away2 in least2 {
        same |= u32::from(away2 < SAME_M * SAME_M);
    }
    same != 0
}

/// What a message said of an object.
#[derive(Debug, Clone, Copy)]
struct ViewNow {
    bit: u32,
    number: u32,
    /// Where that is now, from the origin, metres.
    about_m: [f32; 2],
}

impl HeardNow {
    /// The newest view of a slot in the messages of these bits.
    #[inline(always)]
    fn newest(&self, slot: usize, received: &[u64], words: usize) -> Option<&ViewNow> {
        let bits = &self.slot_bits[slot * words..(slot + 1) * words];
        if !share_a_bit(bits, received, words) {
            return None;
        }
        let views = self.slot_views[slot] as usize..self.slot_views[slot + 1] as usize;
        self.views[views]
            .iter()
            .find(|view| received[view.bit as usize / 64] >> (view.bit % 64) & 1 == 1)
    }
}

/// True if there is a bit in both.
#[inline(always)]
fn share_a_bit(a: &[u64], b: &[u64], words: usize) -> bool {
    let mut shared = 0;
    for word in 0..words {
        shared |= a[word] & b[word];
    }
    shared != 0
}

/// No object was heard of yet.
const NEVER_MS: i64 = i64::MIN;

impl HeardSender {
    fn new(station: u32, words: usize) -> Self {
        // The station itself.
        let own = SenderSlot {
            object: 0,
            views: Vec::new(),
        };
        Self {
            station,
            slots: vec![own],
            used: vec![0; words],
        }
    }

    /// The slot of an object: its own, or one whose object is in no map any more.
    fn slot_of(&mut self, object: u32, lives_from_ms: i64) -> &mut SenderSlot {
        let own = self.slots.iter().position(|slot| slot.object == object);
        let is_free = |slot: &SenderSlot| {
            slot.object != 0 && slot.views.last().is_none_or(|view| view.measured_ms < lives_from_ms)
        };
        let place = own.or_else(|| self.slots.iter().position(is_free)).unwrap_or_else(|| {
            self.slots.push(SenderSlot {
                object,
                views: Vec::new(),
            });
            self.slots.len() - 1
        });
        let slot = &mut self.slots[place];
        if slot.object != object {
            slot.object = object;
            slot.views.clear();
        }
        slot
    }

    /// A bit that no message has.
    fn unused_bit(&self) -> Option<u32> {
        let (place, word) = (0_u32..).zip(&self.used).find(|(_, word)| **word != u64::MAX)?;
        Some(64 * place + word.trailing_ones())
    }
}

impl HeardObjects {
    /// Adds a message with these objects, all of one station.
    pub fn add(&mut self, objects: &[KnownObject]) -> HeardMessage {
        let from = self.next;
        let Some(station) = objects.first().map(|object| object.heard_from) else {
            return HeardMessage {
                objects: from..from,
                sender: 0,
                bit: 0,
            };
        };
        let place = self.place_of(station);
        let sender = &mut self.senders[place as usize];
        let bit = match sender.unused_bit() {
            Some(bit) => bit,
            None => {
                let bit = 64 * self.words as u32;
                self.words += 1;
                self.senders.iter_mut().for_each(|sender| sender.used.push(0));
                bit
            }
        };
        let sender = &mut self.senders[place as usize];
        sender.used[bit as usize / 64] |= 1 << (bit % 64);
        self.origin_m.get_or_insert(objects[0].position_m);
        for object in objects {
            let views = &mut sender.slot_of(object.object, self.lives_from_ms).views;
            let behind = views
                .iter()
                .rev()
                .take_while(|view| view.measured_ms > object.measured_ms);
            let view = SlotView {
                measured_ms: object.measured_ms,
                number: self.next,
                bit,
            };
            views.insert(views.len() - behind.count(), view);
            self.objects.push_back(*object);
            self.next = self.next.wrapping_add(1);
        }
        HeardMessage {
            objects: from..self.next,
            sender: place,
            bit,
        }
    }

    /// The place of a station among those that send, a new one if it has none.
    fn place_of(&mut self, station: u32) -> u32 {
        let Self {
            senders, unused, words, ..
        } = self;
        *self.places.entry(station).or_insert_with(|| {
            let sender = HeardSender::new(station, *words);
            match unused.pop() {
                Some(place) => {
                    senders[place as usize] = sender;
                    place
                }
                None => {
                    senders.push(sender);
                    senders.len() as u32 - 1
                }
            }
        })
    }

    /// Moves every object to its place at `now_ms`, and forgets what was measured more than `lifetime_ms` ago. Every map has to take what its
    /// station received ([`LocalMap::receive`]) before the next message is added.
    pub fn advance(&mut self, now_ms: i64, lifetime_ms: i64) {
        self.lives_from_ms = now_ms - lifetime_ms;
        let lives_from_ms = self.lives_from_ms;
        while self
            .objects
            .front()
            .is_some_and(|object| object.measured_ms < lives_from_ms)
        {
            self.objects.pop_front();
            self.first = self.first.wrapping_add(1);
        }
        self.now_m.clear();
        self.now_m
            .extend(self.objects.iter().map(|object| object.position_at_m(now_ms)));
        self.pack();
    }

    /// Packs what lives for the maps.
    fn pack(&mut self) {
        let origin_m = self.origin_m.unwrap_or_default();
        let words = self.words;
        let now = &mut self.now;
        now.alive.clear();
        now.senders.clear();
        now.slot_bits.clear();
        now.slot_views.clear();
        now.slot_circles.clear();
        now.views.clear();
        for (place, sender) in (0_u32..).zip(&mut self.senders) {
            let from = now.slot_views.len() as u32;
            let mut perceived = AboutBox::EMPTY;
            sender.used.fill(0);
            for (number, slot) in sender.slots.iter_mut().enumerate() {
                let dead = slot.views.partition_point(|view| view.measured_ms < self.lives_from_ms);
                slot.views.drain(..dead);
                let bits_from = now.slot_bits.len();
                now.slot_bits.resize(bits_from + words, 0);
                now.slot_views.push(now.views.len() as u32);
                let mut around = AboutBox::EMPTY;
                for view in slot.views.iter().rev() {
                    now.slot_bits[bits_from + view.bit as usize / 64] |= 1 << (view.bit % 64);
                    let at_m = self.now_m[view.number.wrapping_sub(self.first) as usize];
                    let about_m = [(at_m[0] - origin_m[0]) as f32, (at_m[1] - origin_m[1]) as f32];
                    now.views.push(ViewNow {
                        bit: view.bit,
                        number: view.number,
                        about_m,
                    });
                    around.with(&AboutBox {
                        least_m: about_m,
                        most_m: about_m,
                    });
                }
                now.slot_circles.push(around.circle());
                if number > 0 {
                    perceived.with(&around);
                }
                for (used, bits) in sender.used.iter_mut().zip(&now.slot_bits[bits_from..]) {
                    *used |= bits;
                }
            }
            now.senders.push(SenderNow {
                from,
                to: now.slot_views.len() as u32,
                perceived: perceived.circle(),
            });
            now.alive.extend_from_slice(&sender.used);
            let is_silent = sender.used.iter().all(|word| *word == 0);
            if is_silent && self.places.get(&sender.station) == Some(&place) {
                self.places.remove(&sender.station);
                self.unused.push(place);
            }
        }
        now.slot_views.push(now.views.len() as u32);
    }

    /// The objects of these numbers, which have not been given up.
    pub fn of(&self, numbers: Range<u32>) -> impl Iterator<Item = &KnownObject> {
        numbers_of(numbers).map(|number| self.object(number))
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// The object of this number, which no map has forgotten.
    fn object(&self, number: u32) -> &KnownObject {
        &self.objects[number.wrapping_sub(self.first) as usize]
    }

    /// Its place at the time of the last [`HeardObjects::advance`], metres.
    fn now_m(&self, number: u32) -> [f64; 2] {
        self.now_m[number.wrapping_sub(self.first) as usize]
    }
}

/// Numbers from one to another, which may begin again at 0 in between.
fn numbers_of(numbers: Range<u32>) -> impl Iterator<Item = u32> {
    (0..numbers.end.wrapping_sub(numbers.start)).map(move |place| numbers.start.wrapping_add(place))
}

/// More than what a distance in f32 may be wrong by, metres.
const ROUNDING_M: f32 = 0.25;

/// The map: which of the messages that live the station has received.
#[derive(Debug, Clone, Default)]
pub struct LocalMap {
    /// Places of the stations that it heard from among those that send, ascending.
    senders: Vec<u32>,
    /// Bits of the messages from each.
    received: Vec<u64>,
    /// Words of bits for each.
    words: usize,
    /// Objects in it.
    known: usize,
}

impl LocalMap {
    /// Takes what the station has received since it did so last, and forgets what is too old, after [`HeardObjects::advance`].
    pub fn receive<'a>(&mut self, heard: &HeardObjects, messages: impl Iterator<Item = &'a HeardMessage>) {
        self.widen(heard.words);
        // One word is enough unless objects live long: the loops over it vanish.
        match heard.words {
            1 => self.receive_by_words(heard, messages, 1),
            words => self.receive_by_words(heard, messages, words),
        }
    }

    #[inline(always)]
    fn receive_by_words<'a>(
        &mut self,
        heard: &HeardObjects,
        messages: impl Iterator<Item = &'a HeardMessage>,
        words: usize,
    ) {
        for message in messages.filter(|message| message.objects.start != message.objects.end) {
            let place = match self.senders.binary_search(&message.sender) {
                Ok(place) => place,
                Err(place) => {
                    self.senders.insert(place, message.sender);
                    self.received
                        .splice(place * words..place * words, std::iter::repeat_n(0, words));
                    place
                }
            };
            self.received[place * words + message.bit as usize / 64] |= 1 << (message.bit % 64);
        }
        let now = &heard.now;
        let (mut kept, mut known) = (0, 0);
        for place in 0..self.senders.len() {
            let sender = self.senders[place] as usize;
            let mut any = 0;
            for word in 0..words {
                let alive = self.received[place * words + word] & now.alive[sender * words + word];
                self.received[kept * words + word] = alive;
                any |= alive;
            }
            if any == 0 {
                continue;
            }
            self.senders[kept] = sender as u32;
            let received = &self.received[kept * words..(kept + 1) * words];
            let SenderNow { from, to, .. } = now.senders[sender];
            let slots = now.slot_bits[from as usize * words..to as usize * words].chunks_exact(words);
            for bits in slots {
                known += usize::from(share_a_bit(bits, received, words));
            }
            kept += 1;
        }
        self.senders.truncate(kept);
        self.received.truncate(kept * words);
        self.known = known;
    }

    /// Makes room for more bits of each sender.
    fn widen(&mut self, words: usize) {
        if self.words == words {
            return;
        }
        let mut received = vec![0; self.senders.len() * words];
        for place in 0..self.senders.len() {
            let from = place * self.words..(place + 1) * self.words;
            received[place * words..][..self.words].copy_from_slice(&self.received[from]);
        }
        (self.received, self.words) = (received, words);
    }

    /// Stations that it heard from: what each has said, and the bits of the messages that were received.
    #[inline(always)]
    fn heard_from<'a>(
        &'a self,
        heard: &'a HeardObjects,
        words: usize,
    ) -> impl Iterator<Item = (&'a SenderNow, &'a [u64])> {
        let senders = self.senders.iter().map(|sender| &heard.now.senders[*sender as usize]);
        senders.zip(self.received.chunks_exact(words))
    }

    /// Every known object, each station's view of it by itself, by station and slot.
    pub fn all<'a>(&'a self, heard: &'a HeardObjects) -> impl Iterator<Item = &'a KnownObject> {
        let station = |sender: u32| heard.senders[sender as usize].station;
        let mut senders: Vec<(&SenderNow, &[u64])> = Vec::with_capacity(self.senders.len());
        senders.extend(self.heard_from(heard, heard.words));
        let mut order: Vec<(u32, usize)> = self.senders.iter().map(|sender| station(*sender)).zip(0..).collect();
        order.sort_unstable();
        order.into_iter().flat_map(move |(_, place)| {
            let (sender, received) = senders[place];
            let newest = move |slot: u32| heard.now.newest(slot as usize, received, heard.words);
            (sender.from..sender.to)
                .filter_map(newest)
                .map(|view| heard.object(view.number))
        })
    }

    /// Number of stations that it knows something from.
    #[must_use]
    pub fn stations(&self) -> usize {
        self.senders.len()
    }

    /// True if it knows something from this station.
    #[must_use]
    pub fn has_heard(&self, heard: &HeardObjects, station: u32) -> bool {
        let place = heard.places.get(&station);
        place.is_some_and(|place| self.senders.binary_search(place).is_ok())
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
        match heard.words {
            1 => self.nearest_by_words(heard, from_m, count, nearest, 1),
            words => self.nearest_by_words(heard, from_m, count, nearest, words),
        }
    }

    #[inline(always)]
    fn nearest_by_words<'a>(
        &self,
        heard: &'a HeardObjects,
        from_m: [f64; 2],
        count: usize,
        nearest: &mut Vec<&'a KnownObject>,
        words: usize,
    ) {
        let Some(origin_m) = heard.origin_m else { return };
        let about_from_m = [0, 1].map(|axis: usize| (from_m[axis] - origin_m[axis]) as f32);
        let same2 = SAME_OBJECT_M * SAME_OBJECT_M;
        let away2 = |number: u32| distance2(heard.now_m(number), from_m);
        // Its own word comes before another's at nearly the same place: those that spoke for themselves are chosen first.
        let mut chosen = self.nearest_own(heard, about_from_m, count, away2, words);
        let spoke = chosen.len();
        let mut spoke_m = vec![[[f32::INFINITY; LANES]; 2]; spoke.div_ceil(LANES)];
        for (place, (_, number)) in chosen.iter().enumerate() {
            for axis in 0..2 {
                let at_m = heard.now_m(*number)[axis] - origin_m[axis];
                spoke_m[place / LANES][axis][place % LANES] = at_m as f32;
            }
        }
        // Behind `count` of them no other is listed.
        let farthest2 = chosen
            .get(count.wrapping_sub(1))
            .map_or(f64::INFINITY, |(away2, _)| *away2);
        let mut found = Vec::new();
        VectorPath::widest().run(NearPerceived {
            map: self,
            heard,
            words,
            from_m: about_from_m,
            reach_m: farthest2.sqrt() as f32 + ROUNDING_M,
            spoke_m: &spoke_m,
            found: &mut found,
        });
        let found = found.into_iter().map(|number| (away2(number), number));
        let mut perceived: Vec<(f64, u32)> = found
            .filter(|(away2, _)| *away2 > same2 && *away2 <= farthest2)
            .collect();
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

    /// The `count` nearest of the stations that spoke for themselves, with the squares of their distances. They have their
    /// first slot.
    #[inline(always)]
    fn nearest_own(
        &self,
        heard: &HeardObjects,
        from_m: [f32; 2],
        count: usize,
        away2: impl Fn(u32) -> f64,
        words: usize,
    ) -> Vec<(f64, u32)> {
        let mut near: Vec<(f32, u32, &[u64])> = Vec::with_capacity(self.senders.len());
        for (sender, received) in self.heard_from(heard, words) {
            let slot = sender.from as usize;
            if share_a_bit(&heard.now.slot_bits[slot * words..(slot + 1) * words], received, words) {
                near.push((heard.now.slot_circles[slot].away2_m2(from_m), sender.from, received));
            }
        }
        if count < near.len() {
            // What is farther than `count` others surely are is not among them.
            let radius_m = |slot: u32| heard.now.slot_circles[slot as usize].radius_m;
            let (nearer, last, _) = near.select_nth_unstable_by(count, |a, b| a.0.total_cmp(&b.0));
            let reaches = nearer
                .iter()
                .chain([&*last])
                .map(|(away2, slot, _)| away2.sqrt() + radius_m(*slot));
            let reach_m = reaches.fold(0.0, f32::max) + 2.0 * ROUNDING_M;
            near.retain(|(away2, slot, _)| *away2 <= (reach_m + radius_m(*slot)).powi(2));
        }
        let mut about: Vec<(f32, u32)> = Vec::with_capacity(near.len());
        for (_, slot, received) in near {
            if let Some(view) = heard.now.newest(slot as usize, received, words) {
                let [x, y] = [view.about_m[0] - from_m[0], view.about_m[1] - from_m[1]];
                about.push((x * x + y * y, view.number));
            }
        }
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
    struct Heard(HeardObjects, LocalMap, Vec<HeardMessage>);

    impl Heard {
        fn insert(&mut self, object: KnownObject) {
            self.2.push(self.0.add(&[object]));
        }

        fn advance(&mut self, now_ms: i64, lifetime_ms: i64) {
            self.0.advance(now_ms, lifetime_ms);
            self.1.receive(&self.0, self.2.iter());
            self.2.clear();
        }

        fn nearest(&mut self, now_ms: i64, count: usize) -> Vec<KnownObject> {
            self.advance(now_ms, i64::MAX / 2);
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
        let (numbers, ids) = heard.nearest(300, 4)[0].columns(300);
        assert_eq!(heard.1.len(), 1);
        assert_eq!((numbers[0], numbers[7], ids), (60.0, 0.1, [1, 1, 1]));
        heard.advance(1701, 1500);
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
            let mut messages: Vec<(HeardMessage, Vec<KnownObject>, u8)> = Vec::new();
            for (later_ms, sent) in ticks {
                now_ms += later_ms;
                heard.advance(now_ms, LIFETIME_MS);
                for (receiver, (map, list)) in maps.iter_mut().zip(&mut lists).enumerate() {
                    let received = messages.iter().filter(|(_, _, to)| to >> receiver & 1 == 1);
                    map.receive(&heard, received.clone().map(|(message, _, _)| message));
                    for object in received.flat_map(|(_, objects, _)| objects) {
                        match list.iter_mut().find(|known| key(known) == key(object)) {
                            None => list.push(*object),
                            Some(known) if known.measured_ms <= object.measured_ms => *known = *object,
                            Some(_) => {}
                        }
                    }
                    list.retain(|object| now_ms - object.measured_ms <= LIFETIME_MS);
                    let known: Vec<KnownObject> = map.all(&heard).copied().collect();
                    prop_assert!(known.is_sorted_by_key(|object| object.heard_from));
                    prop_assert_eq!(map.len(), known.len());
                    let by_key = |objects: &[KnownObject]| {
                        let mut sorted = objects.to_vec();
                        sorted.sort_by_key(key);
                        sorted
                    };
                    prop_assert_eq!(by_key(&known), by_key(list));
                    let stations = |station: u32| known.iter().any(|object| object.heard_from == station);
                    prop_assert_eq!((1..5).filter(|station| stations(*station)).count(), map.stations());
                    prop_assert!((1..5).all(|station| stations(station) == map.has_heard(&heard, station)));
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
                let message = heard.add(&[object(1, number, 3.0, 100 * tick)]);
                heard.advance(100 * tick, 400);
                map.receive(&heard, [message].iter());
                prop_assert!(map.len() <= 5 && heard.senders.len() == 1 && heard.senders[0].slots.len() <= 8);
                prop_assert!(heard.words == 1);
            }
        }

        /// More messages of a station live than one word has bits.
        #[test]
        fn messages_may_live_long(heard_by in prop::collection::vec(0_u8..4, 150)) {
            let (mut heard, mut maps) = (HeardObjects::default(), [LocalMap::default(), LocalMap::default()]);
            for (tick, to) in (0_u32..).zip(&heard_by) {
                let message = heard.add(&[object(1, tick + 1, f64::from(tick), 100 * i64::from(tick))]);
                heard.advance(100 * i64::from(tick), 60_000);
                for (receiver, map) in maps.iter_mut().enumerate() {
                    map.receive(&heard, [&message].into_iter().filter(|_| to >> receiver & 1 == 1));
                    let received = heard_by[..=tick as usize].iter().filter(|to| *to >> receiver & 1 == 1);
                    prop_assert_eq!(map.len(), received.count());
                }
            }
            prop_assert_eq!(heard.words, 3);
        }
    }
}
