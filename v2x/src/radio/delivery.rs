//! Which stations decode which messages of a tick, receiver by receiver: what overlaps at one receiver stands side by side among what it
//! hears, so the work is linear in the links.
//!
//! Nearly every decision follows from bounds: power and random numbers in f32, many links at once, and the error model at tabulated
//! ratios. Where the bounds leave it open, the formulas decide ([`Medium::decodes`]). So the outcome is that of the formulas, bit for bit.

use std::ops::Range;

use sensor_daemon::{
    noise::normals::{cos_sin, minus_two_ln, philox4x32},
    wide::{VectorPath, VectorWork},
};

use super::{
    medium::{Medium, OnAir, QueuedMessage, Transmission, faded_mw},
    reception::{CERTAIN, HOPELESS, decode_probability, log_bit_success},
};
use crate::{
    parallel,
    random::{LinkKey, RadioDraw, RadioRandom},
};

/// A message on air as its receivers need it.
#[derive(Debug, Clone, Copy)]
struct SentMessage {
    start_ns: u64,
    end_ns: u64,
    station: u32,
    message: u32,
    bytes: u32,
}

impl SentMessage {
    /// Time during which another one is on air too, nanoseconds.
    fn overlap_ns(&self, other: &Self) -> u64 {
        let (from, to) = (self.start_ns.max(other.start_ns), self.end_ns.min(other.end_ns));
        to.saturating_sub(from)
    }

    /// Share of its time on air of a time within it, at most 1.
    fn share_of(&self, time_ns: u64) -> f64 {
        (time_ns as f64 / (self.end_ns - self.start_ns) as f64).min(1.0)
    }
}

/// What a thread uses for one receiver after the other.
#[derive(Default)]
struct ReceptionRoom {
    /// A bit for each transmission that the receiver hears.
    heard: Vec<u64>,
    /// By transmission: the place of its link in the receiver's row.
    link: Vec<u32>,
    signals: HeardSignals,
}

/// The messages of others at one receiver by their beginning, a column for each number, with a whole number of batches.
#[derive(Debug, Default)]
struct HeardSignals {
    /// How many they are.
    count: usize,
    /// Places of the transmissions in the schedule.
    numbers: Vec<u32>,
    /// Stations that sent them, numbers of the messages, and their bits.
    senders: Vec<u32>,
    messages: Vec<u32>,
    bits: Vec<f32>,
    /// Mean powers at the receiver, milliwatts, and twice the shapes of their fading; 0 = none.
    powers_mw: Vec<f32>,
    shapes: Vec<u32>,
    estimates: Vec<SignalEstimate>,
    /// By batch: a bit for each signal that may be decoded.
    open: Vec<u32>,
}

impl HeardSignals {
    /// Makes room for so many.
    fn resize(&mut self, count: usize) {
        let padded = count.next_multiple_of(BATCH);
        self.count = count;
        for column in [
            &mut self.numbers,
            &mut self.senders,
            &mut self.messages,
            &mut self.shapes,
        ] {
            column.resize(padded, 0);
        }
        self.bits.resize(padded, 0.0);
        self.powers_mw.resize(padded, 0.0);
        self.estimates.resize(padded, SignalEstimate::default());
        self.open.resize(padded / BATCH, 0);
    }
}

/// Items of each radio, in the order in which they came.
struct ByRadio<T> {
    starts: Vec<u32>,
    items: Vec<T>,
}

impl<T: Copy + Default> ByRadio<T> {
    /// Groups items by their radio.
    fn new(radios: usize, items: impl Iterator<Item = (u32, T)> + Clone) -> Self {
        let mut starts = vec![0_u32; radios + 1];
        items.clone().for_each(|(radio, _)| starts[radio as usize + 1] += 1);
        for radio in 0..radios {
            starts[radio + 1] += starts[radio];
        }
        let mut grouped = vec![T::default(); starts[radios] as usize];
        let mut next = starts.clone();
        items.for_each(|(radio, item)| {
            let place = &mut next[radio as usize];
            grouped[*place as usize] = item;
            *place += 1;
        });
        Self { starts, items: grouped }
    }

    fn of(&self, radio: usize) -> &[T] {
        &self.items[self.starts[radio] as usize..self.starts[radio + 1] as usize]
    }
}

/// The error model at ratios of signal to noise from 1 on in equal steps.
#[derive(Debug, Clone)]
pub struct DecodingTable {
    /// Logarithm of the probability that a bit is decoded.
    log_success: Vec<f32>,
    /// Upper bounds of it for all ratios, by [`step_above`].
    upper: Box<[f32; UPPER_STEPS]>,
}

/// Steps of the table per unit of the ratio.
const STEPS: f32 = 128.0;

impl Default for DecodingTable {
    fn default() -> Self {
        let count = ((CERTAIN as f32 - 1.0) * STEPS) as usize + 3;
        let ratio = |step: usize| 1.0 + step as f64 / f64::from(STEPS);
        let log_success: Vec<f32> = (0..count).map(|step| log_bit_success(ratio(step)) as f32).collect();
        let certain = ((CERTAIN as f32 - 1.0) * STEPS) as usize - 4;
        let mut upper = Box::new([0.0; UPPER_STEPS]);
        upper[..certain].copy_from_slice(&log_success[..certain]);
        Self { log_success, upper }
    }
}

/// Steps that the table of upper bounds has, more than enough for [`CERTAIN`].
const UPPER_STEPS: usize = 4096;

/// Place in the table of upper bounds for a ratio: that of a ratio that is not lower.
#[inline(always)]
fn step_above(ratio: f32) -> u32 {
    // Adding it leaves the nearest whole number in the low bits.
    const WHOLE: f32 = 8_388_608.0;
    let step = ((ratio - 1.0) * STEPS).clamp(0.0, (UPPER_STEPS - 2) as f32);
    ((step + WHOLE).to_bits() & 0x007F_FFFF) + 1
}

impl DecodingTable {
    /// Bounds of the logarithm of the probability that a bit is decoded, for ratios from `low` to `high`.
    fn bounds(&self, [low, high]: [f32; 2]) -> [f32; 2] {
        let last = self.log_success.len() - 1;
        let step = |ratio: f32| (((ratio - 1.0) * STEPS).max(0.0) as usize).min(last);
        let lower = match low < HOPELESS as f32 + 0.01 {
            true => f32::NEG_INFINITY,
            false => self.log_success[step(low)],
        };
        let upper = match high > CERTAIN as f32 - 0.01 {
            true => 0.0,
            false => self.log_success[(step(high) + 1).min(last)],
        };
        [lower, upper]
    }
}

/// Largest error of the gain of fading in f32: 22 (the largest logarithm of a random number) times some 1e-6.
const GAIN_ERROR: f32 = 1e-4;
/// Largest error of a logarithm of a probability in f32, where it decides.
const LOG_ERROR: f32 = 1e-4;

/// Signals that are evaluated at once.
const BATCH: usize = 16;

/// Draws the fading of all signals at a receiver, and finds those that may be decoded without a disturbance.
struct FadedSignals<'a> {
    key: [u32; 2],
    receiver: u32,
    noise_mw: f32,
    table: &'a DecodingTable,
    signals: &'a mut HeardSignals,
}

/// Natural logarithm of a word as a number uniform in (0, 1).
#[inline(always)]
fn log_uniform(word: u32) -> f32 {
    // Two halves are signed numbers, which are cheaper to convert.
    let number = ((word >> 1) as i32 as f32 + 0.5 * ((word & 1) as i32 as f32 + 0.5)) * (1.0 / 2_147_483_648.0);
    -0.5 * minus_two_ln(number)
}

/// One batch: gains of fading, and logarithms of the numbers that decide on decoding.
#[inline(always)]
fn fade_batch(
    key: [u32; 2],
    receiver: u32,
    [senders, messages, shapes]: [&[u32; BATCH]; 3],
    gains: &mut [f32; BATCH],
    log_draws: &mut [f32; BATCH],
) {
    let mut words = [[0_u32; BATCH]; 4];
    for (lane, sender) in senders.iter().enumerate() {
        let counter = RadioRandom::counter(
            LinkKey {
                sender: *sender,
                receiver,
                message: messages[lane],
            },
            RadioDraw::Reception,
            0,
        );
        let drawn = philox4x32(counter, key);
        for (word, lanes) in words.iter_mut().enumerate() {
            lanes[lane] = drawn[word];
        }
    }
    for (lane, gain_of) in gains.iter_mut().enumerate() {
        let (a, b, c) = (
            log_uniform(words[0][lane]),
            log_uniform(words[1][lane]),
            log_uniform(words[2][lane]),
        );
        let (cos, _) = cos_sin(words[2][lane]);
        let shape = shapes[lane];
        let three = (a + b + c) * (-1.0 / 3.0);
        let half = (a + b * cos * cos) * (-2.0 / 3.0);
        let gain = if shape == 6 { three } else { -a };
        let gain = if shape == 3 { half } else { gain };
        *gain_of = if shape == 0 { 1.0 } else { gain };
        log_draws[lane] = log_uniform(words[3][lane]);
    }
}

impl VectorWork for FadedSignals<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let HeardSignals {
            senders,
            messages,
            bits,
            powers_mw,
            shapes,
            estimates,
            open,
            ..
        } = self.signals;
        let (senders, messages) = (senders.as_chunks::<BATCH>().0, messages.as_chunks::<BATCH>().0);
        let (shapes, powers_mw) = (shapes.as_chunks::<BATCH>().0, powers_mw.as_chunks::<BATCH>().0);
        let (bits, estimates) = (bits.as_chunks::<BATCH>().0, estimates.as_chunks_mut::<BATCH>().0);
        for batch in 0..senders.len() {
            let (mut gains, mut log_draws) = ([0.0; BATCH], [0.0; BATCH]);
            let keys = [&senders[batch], &messages[batch], &shapes[batch]];
            fade_batch(self.key, self.receiver, keys, &mut gains, &mut log_draws);
            let (mut ratios, mut errors, mut steps) = ([0.0; BATCH], [0.0; BATCH], [0; BATCH]);
            for lane in 0..BATCH {
                let mean_ratio = powers_mw[batch][lane] / self.noise_mw;
                ratios[lane] = mean_ratio * gains[lane];
                errors[lane] = mean_ratio * GAIN_ERROR + 1e-6;
                steps[lane] = step_above((ratios[lane] + errors[lane]) * (1.0 + 1e-5));
            }
            let mut may_be = 0;
            for lane in 0..BATCH {
                let upper = self.table.upper[steps[lane] as usize % UPPER_STEPS];
                may_be |= u32::from(log_draws[lane] <= bits[batch][lane] * upper + LOG_ERROR) << lane;
            }
            open[batch] = may_be;
            for lane in 0..BATCH {
                estimates[batch][lane] = SignalEstimate {
                    ratio: ratios[lane],
                    error: errors[lane],
                    log_draw: log_draws[lane],
                };
            }
        }
    }
}

/// What each radio hears in a tick.
pub struct Receptions<'a> {
    medium: &'a Medium,
    table: &'a DecodingTable,
    on_air: OnAir<'a>,
    random: &'a RadioRandom,
    path: VectorPath,
    /// By transmission.
    messages: Vec<SentMessage>,
    /// By radio: what it sends itself.
    sent: ByRadio<u32>,
}

impl<'a> Receptions<'a> {
    /// Takes what is on air.
    #[must_use]
    pub fn new(medium: &'a Medium, table: &'a DecodingTable, on_air: OnAir<'a>, random: &'a RadioRandom) -> Self {
        let OnAir { schedule, queue, .. } = on_air;
        let message = |sent: &Transmission| {
            let QueuedMessage {
                station,
                message,
                bytes,
                ..
            } = queue[sent.queued];
            SentMessage {
                start_ns: sent.start_ns,
                end_ns: sent.end_ns,
                station,
                message,
                bytes,
            }
        };
        let senders = schedule.on_air.iter().map(|sent| queue[sent.queued].radio);
        let numbered = (0_u32..).zip(senders);
        Self {
            medium,
            table,
            on_air,
            random,
            path: VectorPath::widest(),
            messages: schedule.on_air.iter().map(message).collect(),
            sent: ByRadio::new(on_air.stations.len(), numbered.map(|(number, sender)| (sender, number))),
        }
    }

    /// By radio: places of the transmissions that it decodes, ascending, into `decoded`.
    pub fn decode(&self, threads: usize, decoded: &mut [Vec<u32>]) {
        parallel::for_each_with(threads, decoded, ReceptionRoom::default, |room, radio, decoded| {
            self.hear(radio, room);
            decoded.clear();
            self.decode_at(radio, &room.signals, decoded);
        });
    }

    /// Finds the signals of others at a radio, and draws their fading.
    fn hear(&self, radio: usize, room: &mut ReceptionRoom) {
        let ReceptionRoom {
            heard,
            link: link_of,
            signals,
        } = room;
        let links = self.on_air.links.of(radio as u32);
        // A bit for each transmission is cheaper than sorting.
        heard.clear();
        heard.resize(self.messages.len().div_ceil(64), 0);
        link_of.resize(self.messages.len(), 0);
        for (place, link) in (0_u32..).zip(links) {
            for number in self.sent.of(link.radio as usize).iter().map(|number| *number as usize) {
                heard[number / 64] |= 1 << (number % 64);
                link_of[number] = place;
            }
        }
        signals.resize(heard.iter().map(|word| word.count_ones() as usize).sum());
        let mut signal = 0;
        for (place, mut word) in (0_u32..).zip(heard.iter().copied()) {
            while word != 0 {
                let number = 64 * place + word.trailing_zeros();
                word &= word - 1;
                let link = &links[link_of[number as usize] as usize];
                let sent = &self.messages[number as usize];
                signals.numbers[signal] = number;
                signals.senders[signal] = sent.station;
                signals.messages[signal] = sent.message;
                signals.bits[signal] = 8.0 * sent.bytes as f32;
                signals.powers_mw[signal] = link.power_mw;
                signals.shapes[signal] = link.twice_shape;
                signal += 1;
            }
        }
        self.path.run(FadedSignals {
            key: self.random.key(),
            receiver: self.on_air.stations[radio],
            noise_mw: self.medium.noise_mw as f32,
            table: self.table,
            signals,
        });
    }

    /// What one radio decodes.
    fn decode_at(&self, radio: usize, signals: &HeardSignals, decoded: &mut Vec<u32>) {
        for (batch, mut open) in signals.open.iter().copied().enumerate() {
            // Most links are too weak even without a disturbance.
            while open != 0 {
                let place = batch * BATCH + open.trailing_zeros() as usize;
                open &= open - 1;
                if place < signals.count && self.is_decoded(radio, signals, place) {
                    decoded.push(signals.numbers[place]);
                }
            }
        }
    }

    fn is_decoded(&self, radio: usize, signals: &HeardSignals, place: usize) -> bool {
        let estimate = &signals.estimates[place];
        // A radio cannot hear while it sends.
        let sent = self.sent_at(signals, place);
        let mut own = self
            .sent
            .of(radio)
            .iter()
            .map(|number| &self.messages[*number as usize]);
        if own.any(|own| sent.overlap_ns(own) > 0) {
            return false;
        }
        let around = self.around(signals, place);
        let [lower, upper] = self.log_probability(signals, place, around.clone());
        if estimate.log_draw < lower - LOG_ERROR {
            true
        } else if estimate.log_draw > upper + LOG_ERROR {
            false
        } else {
            self.decodes(signals, place, around, self.on_air.stations[radio])
        }
    }

    /// The message of a signal.
    fn sent_at(&self, signals: &HeardSignals, place: usize) -> &SentMessage {
        &self.messages[signals.numbers[place] as usize]
    }

    /// Bounds of the logarithm of the probability that a signal is decoded, with what disturbs it.
    fn log_probability(&self, signals: &HeardSignals, place: usize, around: Range<usize>) -> [f32; 2] {
        let (sent, estimate) = (self.sent_at(signals, place), &signals.estimates[place]);
        let bytes = sent.bytes as usize;
        let (mut disturbance, mut disturbed_ns) = ([0.0; 2], 0);
        for other in around.filter(|other| *other != place) {
            let overlap_ns = sent.overlap_ns(self.sent_at(signals, other));
            if overlap_ns > 0 {
                let [low, high] = signals.estimates[other].ratio_range([0.0; 2]);
                disturbance = [disturbance[0] + low, disturbance[1] + high];
                disturbed_ns += overlap_ns;
            }
        }
        let clear = self.table.bounds(estimate.ratio_range([0.0; 2]));
        if disturbed_ns == 0 {
            return clear.map(|log| 8.0 * bytes as f32 * log);
        }
        let disturbed_bytes = Medium::disturbed_bytes(sent.share_of(disturbed_ns), bytes).min(bytes);
        let disturbed = self.table.bounds(estimate.ratio_range(disturbance));
        let part = |bytes: usize, log: f32| if bytes > 0 { 8.0 * bytes as f32 * log } else { 0.0 };
        [0, 1].map(|side: usize| part(bytes - disturbed_bytes, clear[side]) + part(disturbed_bytes, disturbed[side]))
    }

    /// Places of the signals that may overlap with one of them, itself too.
    fn around(&self, signals: &HeardSignals, place: usize) -> Range<usize> {
        let sent = self.sent_at(signals, place);
        let longest_ns = self.on_air.schedule.longest_ns;
        let start_ns = |place: usize| self.sent_at(signals, place).start_ns;
        let (mut from, mut to) = (place, place + 1);
        while from > 0 && start_ns(from - 1) + longest_ns > sent.start_ns {
            from -= 1;
        }
        while to < signals.count && start_ns(to) < sent.end_ns {
            to += 1;
        }
        from..to
    }

    /// The same by the formulas.
    fn decodes(&self, signals: &HeardSignals, place: usize, around: Range<usize>, station: u32) -> bool {
        let draws = |message: &SentMessage| {
            let key = LinkKey {
                sender: message.station,
                receiver: station,
                message: message.message,
            };
            self.random.uniforms(key, RadioDraw::Reception, 0)
        };
        let power_mw = |place: usize, draws: [f64; 4]| faded_mw(signals.powers_mw[place], signals.shapes[place], draws);
        let sent = self.sent_at(signals, place);
        let drawn = draws(sent);
        let bytes = sent.bytes as usize;
        let signal_mw = power_mw(place, drawn);
        if drawn[3] >= decode_probability(signal_mw / self.medium.noise_mw, bytes) {
            return false;
        }
        let (mut disturbance_mw, mut disturbed_ns) = (0.0, 0);
        for other in around.filter(|other| *other != place) {
            let disturbing = self.sent_at(signals, other);
            let overlap_ns = sent.overlap_ns(disturbing);
            if overlap_ns > 0 {
                disturbance_mw += power_mw(other, draws(disturbing));
                disturbed_ns += overlap_ns;
            }
        }
        let share = sent.share_of(disturbed_ns);
        drawn[3] < self.medium.decodes(signal_mw, disturbance_mw, share, bytes)
    }
}

/// A reception by its numbers in f32.
#[derive(Debug, Clone, Copy, Default)]
struct SignalEstimate {
    /// Faded power over the noise.
    ratio: f32,
    /// Most by which it may be wrong.
    error: f32,
    /// Logarithm of the number that decides on decoding.
    log_draw: f32,
}

impl SignalEstimate {
    /// Least and most that the ratio of signal to noise and interference is, with an interference over the noise between two bounds.
    fn ratio_range(&self, [least, most]: [f32; 2]) -> [f32; 2] {
        [
            (self.ratio - self.error).max(0.0) / (1.0 + most) * (1.0 - 1e-5),
            (self.ratio + self.error) / (1.0 + least) * (1.0 + 1e-5),
        ]
    }
}
