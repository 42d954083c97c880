//! One channel that many stations share: when each sends (carrier sense, IEEE 802.11 outside the context of a BSS), what overlaps at each
//! receiver, and which messages it decodes. Stations that do not hear each other are hidden and collide.

use std::{cmp::Reverse, collections::BinaryHeap};

use super::{
    dbm,
    fading::power_gain,
    milliwatts,
    reception::{air_time_s, decode_probability},
};
use crate::random::{LinkKey, RadioDraw, RadioRandom};

/// Length of a slot at 10 MHz, nanoseconds.
const SLOT_NS: u64 = 13_000;
/// Idle time before a station sends: SIFS and three slots (access category `AC_VI`), nanoseconds.
const AIFS_NS: u64 = 32_000 + 3 * SLOT_NS;
/// Largest number of slots of a backoff, `CWmin` of `AC_VI`.
const WINDOW_SLOTS: u32 = 7;
/// Time after its beginning from which a transmission is heard, nanoseconds. Stations that begin within it collide.
const SENSING_NS: u64 = 8_000;
/// Signals this far below the noise are neither decoded nor disturb, dB.
pub const IRRELEVANT_DB: f64 = 6.0;

/// A message that waits to be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QueuedMessage {
    /// Index of the sending radio.
    pub radio: u32,
    /// Station id of the sender, and the message's number: key of all draws.
    pub station: u32,
    /// Number of the message.
    pub message: u32,
    /// Time at which it is handed to the radio, nanoseconds since the beginning of the tick.
    pub ready_ns: u64,
    /// Bytes of the frame.
    pub bytes: u32,
}

/// Mean power of a sender's messages at one receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MediumLink {
    /// Index of the receiving radio.
    pub radio: u32,
    /// Power with path loss and shadowing, without fast fading, milliwatts.
    pub power_mw: f32,
    /// Twice the shape of Nakagami's distribution; 0 = no fast fading.
    pub twice_shape: u32,
}

impl MediumLink {
    /// A place where a link is to be written.
    pub(super) const NONE: Self = Self {
        radio: 0,
        power_mw: 0.0,
        twice_shape: 0,
    };
}

/// The links of all radios of a tick, in rows. A link is the same in both directions, and stands in the rows of both of its radios.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RadioLinks {
    /// First link of each radio, and one past the last of the last one.
    starts: Vec<u32>,
    /// Where the next link of each is written.
    next: Vec<u32>,
    links: Vec<MediumLink>,
}

impl RadioLinks {
    /// Rows from the links of each radio to those after it, ascending.
    #[must_use]
    pub fn new(to_later: &[Vec<MediumLink>]) -> Self {
        let mut links = Self::default();
        links.fill(to_later);
        links
    }

    /// The same in the memory of those before.
    pub fn fill(&mut self, to_later: &[Vec<MediumLink>]) {
        let Self { starts, next, links } = self;
        starts.clear();
        starts.resize(to_later.len() + 1, 0);
        for (radio, later) in to_later.iter().enumerate() {
            starts[radio + 1] += later.len() as u32;
            for link in later {
                starts[link.radio as usize + 1] += 1;
            }
        }
        for radio in 0..to_later.len() {
            starts[radio + 1] += starts[radio];
        }
        // Each is written below.
        links.resize(starts[to_later.len()] as usize, MediumLink::NONE);
        next.clone_from(starts);
        // In a row come first those before it, then those after it.
        for (radio, later) in to_later.iter().enumerate() {
            let own = next[radio] as usize;
            links[own..own + later.len()].copy_from_slice(later);
            for link in later {
                let place = &mut next[link.radio as usize];
                links[*place as usize] = MediumLink {
                    radio: radio as u32,
                    ..*link
                };
                *place += 1;
            }
        }
    }

    /// Links of a radio, ascending by the other one: to all that it reaches if it sends, else to those of them that send.
    #[must_use]
    pub fn of(&self, radio: u32) -> &[MediumLink] {
        &self.links[self.starts[radio as usize] as usize..self.starts[radio as usize + 1] as usize]
    }
}

/// Power of one message on a link with this mean power, whose draws these are, milliwatts.
pub(super) fn faded_mw(power_mw: f32, twice_shape: u32, draws: [f64; 4]) -> f64 {
    let gain = match twice_shape {
        0 => 1.0,
        halves => power_gain(draws, halves),
    };
    f64::from(power_mw) * gain
}

/// A message on air.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transmission {
    /// The message; its place in the queue.
    pub queued: usize,
    /// Beginning, nanoseconds since the beginning of the tick.
    pub start_ns: u64,
    /// End.
    pub end_ns: u64,
}

impl Transmission {
    /// Time during which another one is on air too, nanoseconds.
    #[must_use]
    pub fn overlap_ns(&self, other: &Self) -> u64 {
        let (from, to) = (self.start_ns.max(other.start_ns), self.end_ns.min(other.end_ns));
        to.saturating_sub(from)
    }

    /// Share of its time on air of a time within it, at most 1.
    #[must_use]
    pub fn share_of(&self, time_ns: u64) -> f64 {
        (time_ns as f64 / (self.end_ns - self.start_ns) as f64).min(1.0)
    }
}

/// Parameters of the channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Medium {
    /// Noise of a receiver, milliwatts.
    pub noise_mw: f64,
    /// Power from which the channel is busy, milliwatts.
    pub busy_mw: f64,
    /// Length of a tick, nanoseconds. A message that could not be sent within it is dropped: a newer one follows.
    pub tick_ns: u64,
}

/// What is on air in a tick.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Schedule {
    /// Transmissions by their beginning.
    pub on_air: Vec<Transmission>,
    /// Longest air time of a message that waits to be sent, nanoseconds.
    pub longest_ns: u64,
    /// Messages that found no time to be sent.
    pub dropped: u32,
}

/// All that is on air in a tick, with the links of each radio that sends and the station ids of all radios.
#[derive(Debug, Clone, Copy)]
pub struct OnAir<'a> {
    /// When each message is sent.
    pub schedule: &'a Schedule,
    /// The messages.
    pub queue: &'a [QueuedMessage],
    /// Links of each radio.
    pub links: &'a RadioLinks,
    /// Station id of each radio.
    pub stations: &'a [u32],
}

/// Links of one radio to a receiver, in the order of their receivers.
fn link_to(links: &[MediumLink], radio: u32) -> Option<&MediumLink> {
    links
        .binary_search_by_key(&radio, |link| link.radio)
        .ok()
        .map(|place| &links[place])
}

/// Time on air of a frame, nanoseconds.
fn air_time_ns(bytes: u32) -> u64 {
    (air_time_s(bytes as usize) * 1e9) as u64
}

impl Medium {
    /// The channel of receivers with a noise figure, which find it busy from a power on.
    #[must_use]
    pub fn new(noise_dbm: f64, busy_dbm: f64, tick_ns: u64) -> Self {
        Self {
            noise_mw: milliwatts(noise_dbm),
            busy_mw: milliwatts(busy_dbm),
            tick_ns,
        }
    }

    /// Power below which a link does not count, dBm.
    #[must_use]
    pub fn irrelevant_dbm(&self) -> f64 {
        dbm(self.noise_mw) - IRRELEVANT_DB
    }

    /// When each message is sent.
    #[must_use]
    pub fn schedule(&self, queue: &[QueuedMessage], links: &RadioLinks, random: &RadioRandom) -> Schedule {
        let mut schedule = Schedule {
            longest_ns: queue
                .iter()
                .map(|message| air_time_ns(message.bytes))
                .max()
                .unwrap_or(0),
            ..Schedule::default()
        };
        // Attempts in the order of their time; at the same time in the order of the queue.
        let mut attempts: BinaryHeap<Reverse<(u64, usize, u32)>> = queue
            .iter()
            .enumerate()
            .map(|(place, message)| Reverse((message.ready_ns, place, 0)))
            .collect();
        // The first transmission that may still be heard.
        let mut heard_from = 0;
        while let Some(Reverse((now_ns, place, attempt))) = attempts.pop() {
            let message = &queue[place];
            let air_ns = air_time_ns(message.bytes);
            if now_ns + air_ns > self.tick_ns {
                schedule.dropped += 1;
                continue;
            }
            while schedule
                .on_air
                .get(heard_from)
                .is_some_and(|sent| sent.end_ns + AIFS_NS <= now_ns)
            {
                heard_from += 1;
            }
            let is_heard = |sent: &&Transmission| {
                let other = &queue[sent.queued];
                let is_recent = sent.end_ns + AIFS_NS > now_ns;
                let has_begun = sent.start_ns + SENSING_NS <= now_ns;
                is_recent
                    && (other.radio == message.radio
                        || has_begun
                            && link_to(links.of(other.radio), message.radio)
                                .is_some_and(|link| f64::from(link.power_mw) >= self.busy_mw))
            };
            let busy_until_ns = schedule.on_air[heard_from..]
                .iter()
                .filter(is_heard)
                .map(|sent| sent.end_ns)
                .max();
            match busy_until_ns {
                None => schedule.on_air.push(Transmission {
                    queued: place,
                    start_ns: now_ns,
                    end_ns: now_ns + air_ns,
                }),
                Some(end_ns) => {
                    let key = LinkKey {
                        sender: message.station,
                        receiver: 0,
                        message: message.message,
                    };
                    let slots = random.words(key, RadioDraw::Backoff, attempt)[0] % (WINDOW_SLOTS + 1);
                    let again_ns = end_ns + AIFS_NS + u64::from(slots) * SLOT_NS;
                    attempts.push(Reverse((again_ns, place, attempt + 1)));
                }
            }
        }
        schedule
    }

    /// Probability that a message is decoded of which a share is disturbed: all disturbers at once during that share.
    #[must_use]
    pub fn decodes(&self, signal_mw: f64, disturbance_mw: f64, share: f64, bytes: usize) -> f64 {
        let disturbed_bytes = Self::disturbed_bytes(share, bytes);
        let clear = decode_probability(signal_mw / self.noise_mw, bytes - disturbed_bytes.min(bytes));
        match disturbed_bytes {
            0 => clear,
            count => clear * decode_probability(signal_mw / (self.noise_mw + disturbance_mw), count),
        }
    }

    /// Bytes of a message that are disturbed during a share of it.
    #[must_use]
    pub fn disturbed_bytes(share: f64, bytes: usize) -> usize {
        (share * bytes as f64).ceil() as usize
    }

    /// Share of the tick in which each of `radios` radios finds the channel busy; its own messages count.
    #[must_use]
    pub fn channel_load(
        &self,
        schedule: &Schedule,
        queue: &[QueuedMessage],
        links: &RadioLinks,
        radios: usize,
    ) -> Vec<f32> {
        let mut busy_ns = vec![0_u64; radios];
        let mut busy_until_ns = vec![0_u64; radios];
        for sent in &schedule.on_air {
            let message = &queue[sent.queued];
            let mut hear = |radio: u32| {
                let radio = radio as usize;
                // Transmissions come by their beginning: what was busy before overlaps only with the beginning.
                let from_ns = sent.start_ns.max(busy_until_ns[radio]);
                busy_ns[radio] += sent.end_ns.saturating_sub(from_ns);
                busy_until_ns[radio] = busy_until_ns[radio].max(sent.end_ns);
            };
            hear(message.radio);
            for link in links.of(message.radio) {
                if f64::from(link.power_mw) >= self.busy_mw {
                    hear(link.radio);
                }
            }
        }
        busy_ns.iter().map(|busy| *busy as f32 / self.tick_ns as f32).collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::radio::{
        delivery::{DecodingTable, Receptions},
        fading, noise_dbm,
    };

    impl Schedule {
        /// Transmissions that overlap with the one of this number, without it.
        fn overlapping(&self, number: usize) -> impl Iterator<Item = &Transmission> {
            let sent = self.on_air[number];
            let from = self
                .on_air
                .partition_point(|other| other.start_ns + self.longest_ns <= sent.start_ns);
            let others = self.on_air[from..].iter().enumerate();
            others
                .take_while(move |(_, other)| other.start_ns < sent.end_ns)
                .filter(move |(place, other)| from + place != number && sent.overlap_ns(other) > 0)
                .map(|(_, other)| other)
        }
    }

    impl Medium {
        /// Message by message: indices of the radios that decode transmission `number`, ascending, into `decoded`.
        fn receivers(&self, number: usize, on_air: &OnAir, random: &RadioRandom, decoded: &mut Vec<u32>) {
            let OnAir {
                schedule,
                queue,
                links,
                stations,
            } = on_air;
            let sent = &schedule.on_air[number];
            let message = &queue[sent.queued];
            let overlapping: Vec<&Transmission> = schedule.overlapping(number).collect();
            decoded.clear();
            for link in links.of(message.radio) {
                // A radio cannot hear while it sends.
                if overlapping.iter().any(|other| queue[other.queued].radio == link.radio) {
                    continue;
                }
                let draws = |message: &QueuedMessage| {
                    let key = LinkKey {
                        sender: message.station,
                        receiver: stations[link.radio as usize],
                        message: message.message,
                    };
                    random.uniforms(key, RadioDraw::Reception, 0)
                };
                let drawn = draws(message);
                let (signal_mw, bytes) = (faded_mw(link.power_mw, link.twice_shape, drawn), message.bytes as usize);
                // Most links are too weak even without a disturbance, which is dearer to compute.
                if drawn[3] >= decode_probability(signal_mw / self.noise_mw, bytes) {
                    continue;
                }
                let (mut disturbance_mw, mut disturbed_ns) = (0.0, 0);
                for other in &overlapping {
                    let disturbing = &queue[other.queued];
                    if let Some(disturber) = link_to(links.of(disturbing.radio), link.radio) {
                        disturbance_mw += faded_mw(disturber.power_mw, disturber.twice_shape, draws(disturbing));
                        disturbed_ns += sent.overlap_ns(other);
                    }
                }
                let share = disturbed_ns as f64 / (sent.end_ns - sent.start_ns) as f64;
                if drawn[3] < self.decodes(signal_mw, disturbance_mw, share.min(1.0), bytes) {
                    decoded.push(link.radio);
                }
            }
        }
    }

    const BYTES: u32 = 350;
    const AIR_NS: u64 = 512_000;

    fn medium() -> Medium {
        Medium::new(noise_dbm(9.0), -85.0, 100_000_000)
    }

    fn message(radio: u32, ready_ns: u64) -> QueuedMessage {
        QueuedMessage {
            radio,
            station: radio + 100,
            message: 7,
            ready_ns,
            bytes: BYTES,
        }
    }

    /// Links with these powers in dBm from each radio to those after it, without fading; NaN = none.
    fn links(power_dbm: &[&[f64]]) -> RadioLinks {
        let row = |(first, row): (usize, &&[f64])| {
            let link = |(place, power): (usize, &f64)| {
                (!power.is_nan()).then(|| MediumLink {
                    radio: (first + 1 + place) as u32,
                    power_mw: milliwatts(*power) as f32,
                    twice_shape: 0,
                })
            };
            row.iter().enumerate().filter_map(link).collect()
        };
        RadioLinks::new(&power_dbm.iter().enumerate().map(row).collect::<Vec<_>>())
    }

    #[test]
    fn a_link_stands_in_the_rows_of_both_radios() {
        let links = links(&[&[-60.0, f64::NAN, -70.0], &[-80.0, f64::NAN], &[f64::NAN], &[]]);
        let rows = (0..4).map(|radio| links.of(radio).iter().map(|link| link.radio).collect());
        assert_eq!(
            rows.collect::<Vec<Vec<u32>>>(),
            [vec![1, 3], vec![0, 2], vec![1], vec![0]]
        );
        assert_eq!(links.of(3)[0].power_mw, links.of(0)[1].power_mw);
    }

    #[test]
    fn a_station_waits_while_it_hears_another_and_then_backs_off() {
        let near = links(&[&[-60.0], &[]]);
        let queue = [message(0, 1_000_000), message(1, 1_100_000)];
        let schedule = medium().schedule(&queue, &near, &RadioRandom::new(1));
        let [first, second] = schedule.on_air[..] else {
            panic!("{schedule:?}")
        };
        assert_eq!((first.start_ns, first.end_ns), (1_000_000, 1_000_000 + AIR_NS));
        let waited_ns = second.start_ns - first.end_ns - AIFS_NS;
        assert!(second.queued == 1 && waited_ns.is_multiple_of(SLOT_NS) && waited_ns <= 7 * SLOT_NS);
        // Below the threshold of carrier sense it is not heard.
        let deaf = links(&[&[-86.0], &[]]);
        let schedule = medium().schedule(&queue, &deaf, &RadioRandom::new(1));
        assert_eq!(schedule.on_air[1].start_ns, 1_100_000);
    }

    #[test]
    fn stations_that_begin_at_once_collide() {
        let links = links(&[&[-60.0], &[]]);
        let queue = [message(0, 5_000), message(1, 9_000)];
        let schedule = medium().schedule(&queue, &links, &RadioRandom::new(1));
        assert_eq!(schedule.on_air[1].start_ns, 9_000);
    }

    #[test]
    fn what_does_not_fit_into_the_tick_is_dropped() {
        let links = links(&[&[-60.0], &[]]);
        let queue = [message(0, 99_400_000), message(1, 99_450_000)];
        let schedule = medium().schedule(&queue, &links, &RadioRandom::new(1));
        assert_eq!((schedule.on_air.len(), schedule.dropped), (1, 1));
    }

    fn decoded_by(queue: &[QueuedMessage], links: &RadioLinks, number: usize) -> Vec<u32> {
        let (medium, random) = (medium(), RadioRandom::new(1));
        let schedule = medium.schedule(queue, links, &random);
        let radios = links.starts.len() as u32 - 1;
        let stations: Vec<u32> = (100..100 + radios).collect();
        let mut decoded = Vec::new();
        let on_air = OnAir {
            schedule: &schedule,
            queue,
            links,
            stations: &stations,
        };
        medium.receivers(number, &on_air, &random, &mut decoded);
        let table = DecodingTable::default();
        let mut by_receiver = vec![Vec::new(); stations.len()];
        Receptions::new(&medium, &table, on_air, &random).decode(1, &mut by_receiver);
        let receivers = (0..radios).filter(|radio| by_receiver[*radio as usize].contains(&(number as u32)));
        assert_eq!(receivers.collect::<Vec<_>>(), decoded);
        decoded
    }

    proptest! {
        /// Receiver by receiver, with bounds, beside message by message, with the formulas.
        #[test]
        fn both_ways_decode_the_same(seed in any::<u64>(), stations in 2_usize..24, busy in 1_u64..40) {
            let random = RadioRandom::new(seed);
            let draw = |radio: usize, other: usize, part: u32| {
                let key = LinkKey { sender: radio.min(other) as u32, receiver: radio.max(other) as u32, message: 0 };
                random.uniforms(key, RadioDraw::Shadowing, part)
            };
            let links: Vec<Vec<MediumLink>> = (0..stations)
                .map(|radio| {
                    let others = radio + 1..stations;
                    let link = |other: usize| {
                        let [power, shape, exists, _] = draw(radio, other, 0);
                        (exists < 0.8).then(|| MediumLink {
                            radio: other as u32,
                            power_mw: milliwatts(-102.0 + 35.0 * power * power) as f32,
                            twice_shape: [0, 2, 3, 6][(4.0 * shape) as usize],
                        })
                    };
                    others.filter_map(link).collect()
                })
                .collect();
            let links = RadioLinks::new(&links);
            let queue: Vec<QueuedMessage> = (0..2 * stations)
                .map(|place| {
                    let [ready, bytes, ..] = draw(place, place, 1);
                    QueuedMessage {
                        radio: (place / 2) as u32,
                        station: (place / 2) as u32 + 100,
                        message: 2 * 7 + (place as u32 & 1),
                        ready_ns: (ready * busy as f64 * 1e6) as u64,
                        bytes: 100 + (bytes * 900.0) as u32,
                    }
                })
                .collect();
            let medium = medium();
            let schedule = medium.schedule(&queue, &links, &random);
            let stations: Vec<u32> = (100..100 + stations as u32).collect();
            let on_air = OnAir { schedule: &schedule, queue: &queue, links: &links, stations: &stations };
            let table = DecodingTable::default();
            let receptions = Receptions::new(&medium, &table, on_air, &random);
            let [mut by_receiver, mut same] = [1, 3].map(|_| vec![Vec::new(); stations.len()]);
            receptions.decode(1, &mut by_receiver);
            receptions.decode(3, &mut same);
            prop_assert_eq!(&by_receiver, &same);
            let mut decoded = Vec::new();
            for number in 0..schedule.on_air.len() {
                medium.receivers(number, &on_air, &random, &mut decoded);
                for radio in 0..stations.len() as u32 {
                    let is_decoded = by_receiver[radio as usize].binary_search(&(number as u32)).is_ok();
                    prop_assert_eq!(is_decoded, decoded.contains(&radio));
                }
            }
        }
    }

    #[test]
    fn hidden_stations_disturb_each_other_between_them() {
        // 0 and 2 do not hear each other; 1 hears both equally strong; 3 hears only 0.
        let hidden = |first_dbm: f64| links(&[&[first_dbm, f64::NAN, -70.0], &[-70.0, f64::NAN], &[f64::NAN], &[]]);
        let (hidden, near) = (hidden(-70.0), hidden(-50.0));
        let both = [message(0, 1_000_000), message(2, 1_100_000)];
        assert_eq!(decoded_by(&both, &hidden, 0), [3]);
        assert_eq!(decoded_by(&both, &hidden, 1), Vec::<u32>::new());
        let one = [message(0, 1_000_000)];
        assert_eq!(decoded_by(&one, &hidden, 0), [1, 3]);
        // 20 dB stronger it is decoded all the same.
        assert_eq!(decoded_by(&both, &near, 0), [1, 3]);
    }

    #[test]
    fn a_radio_that_sends_does_not_hear() {
        let deaf = links(&[&[-86.0], &[]]);
        let queue = [message(0, 1_000_000), message(1, 1_100_000)];
        assert_eq!(decoded_by(&queue, &deaf, 0), Vec::<u32>::new());
        assert_eq!(decoded_by(&queue[..1], &deaf, 0), [1]);
    }

    #[test]
    fn the_load_counts_every_busy_time_once() {
        // 1 hears 0 and 2, which overlap by all but 0.1 ms; 0 hears only itself.
        let hidden = links(&[&[-70.0, f64::NAN], &[-70.0], &[]]);
        let queue = [message(0, 1_000_000), message(2, 1_100_000)];
        let schedule = medium().schedule(&queue, &hidden, &RadioRandom::new(1));
        let load = medium().channel_load(&schedule, &queue, &hidden, 3);
        let expected = [AIR_NS, AIR_NS + 100_000, AIR_NS].map(|ns| ns as f32 / 1e8);
        assert_eq!(load, expected);
    }

    /// Delivery between two stations beside the integral over the distribution of the fading.
    #[test]
    fn two_stations_deliver_as_their_closed_form() {
        const MESSAGES: u32 = 40_000;
        let (medium, random) = (medium(), RadioRandom::new(3));
        let schedule = Schedule {
            on_air: vec![Transmission {
                queued: 0,
                start_ns: 0,
                end_ns: AIR_NS,
            }],
            longest_ns: AIR_NS,
            dropped: 0,
        };
        for (mean_snr_db, halves) in [(3.0, 2), (6.0, 2), (12.0, 2), (5.0, 6), (4.5, 0)] {
            let power_mw = medium.noise_mw * milliwatts(mean_snr_db);
            let links = vec![
                vec![MediumLink {
                    radio: 1,
                    power_mw: power_mw as f32,
                    twice_shape: halves,
                }],
                Vec::new(),
            ];
            let links = RadioLinks::new(&links);
            let mut decoded = Vec::new();
            let delivered = (0..MESSAGES).filter(|number| {
                let queue = [QueuedMessage {
                    message: *number,
                    ..message(0, 0)
                }];
                let on_air = OnAir {
                    schedule: &schedule,
                    queue: &queue,
                    links: &links,
                    stations: &[100, 101],
                };
                medium.receivers(0, &on_air, &random, &mut decoded);
                decoded == [1]
            });
            let found = delivered.count() as f64 / f64::from(MESSAGES);
            let mean = power_mw / medium.noise_mw;
            // Gamma density of shape m and mean 1; midpoints of 1/1000.
            let shape = f64::from(halves) / 2.0;
            let density = |x: f64| shape.powf(shape) * x.powf(shape - 1.0) * (-shape * x).exp() / libm::tgamma(shape);
            let expected = match halves {
                0 => decode_probability(mean, BYTES as usize),
                _ => (0..20_000)
                    .map(|i| (f64::from(i) + 0.5) / 1000.0)
                    .map(|x| 0.001 * density(x) * decode_probability(mean * x, BYTES as usize))
                    .sum(),
            };
            let error = 5.0 * (expected * (1.0 - expected) / f64::from(MESSAGES)).sqrt() + 1e-4;
            assert!(
                (found - expected).abs() < error,
                "{mean_snr_db} dB, m {shape}: {found} for {expected}"
            );
            assert!(fading::twice_shape(10.0) == 6);
        }
    }
}
