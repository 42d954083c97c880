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

/// A message as one receiver hears it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct HeardSignal {
    /// Place of its transmission in the schedule.
    number: u32,
    /// Mean power at the receiver, milliwatts.
    power_mw: f32,
    /// Twice the shape of its fading; 0 = none.
    twice_shape: u32,
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
}

/// Steps of the table per unit of the ratio.
const STEPS: f32 = 128.0;

impl Default for DecodingTable {
    fn default() -> Self {
        let count = ((CERTAIN as f32 - 1.0) * STEPS) as usize + 3;
        let ratio = |step: usize| 1.0 + step as f64 / f64::from(STEPS);
        Self {
            log_success: (0..count).map(|step| log_bit_success(ratio(step)) as f32).collect(),
        }
    }
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

/// A batch of receptions: keys and shapes in; gains of fading, and logarithms of the numbers that decide on decoding, out.
struct FadingBatch<'a> {
    key: [u32; 2],
    receiver: u32,
    senders: &'a [u32; BATCH],
    messages: &'a [u32; BATCH],
    shapes: &'a [u32; BATCH],
    gains: &'a mut [f32; BATCH],
    log_draws: &'a mut [f32; BATCH],
}

/// Natural logarithm of a word as a number uniform in (0, 1).
#[inline(always)]
fn log_uniform(word: u32) -> f32 {
    // Two halves are signed numbers, which are cheaper to convert.
    let number = ((word >> 1) as i32 as f32 + 0.5 * ((word & 1) as i32 as f32 + 0.5)) * (1.0 / 2_147_483_648.0);
    -0.5 * minus_two_ln(number)
}

impl VectorWork for FadingBatch<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let mut words = [[0_u32; BATCH]; 4];
        for (lane, sender) in self.senders.iter().enumerate() {
            let counter = RadioRandom::counter(
                LinkKey {
                    sender: *sender,
                    receiver: self.receiver,
                    message: self.messages[lane],
                },
                RadioDraw::Reception,
                0,
            );
            let drawn = philox4x32(counter, self.key);
            for (word, lanes) in words.iter_mut().enumerate() {
                lanes[lane] = drawn[word];
            }
        }
        for (lane, gain_of) in self.gains.iter_mut().enumerate() {
            let (a, b, c) = (
                log_uniform(words[0][lane]),
                log_uniform(words[1][lane]),
                log_uniform(words[2][lane]),
            );
            let (cos, _) = cos_sin(words[2][lane]);
            let shape = self.shapes[lane];
            let three = (a + b + c) * (-1.0 / 3.0);
            let half = (a + b * cos * cos) * (-2.0 / 3.0);
            let gain = if shape == 6 { three } else { -a };
            let gain = if shape == 3 { half } else { gain };
            *gain_of = if shape == 0 { 1.0 } else { gain };
            self.log_draws[lane] = log_uniform(words[3][lane]);
        }
    }
}

/// Who hears what in a tick.
pub struct Receptions<'a> {
    medium: &'a Medium,
    table: &'a DecodingTable,
    on_air: OnAir<'a>,
    random: &'a RadioRandom,
    path: VectorPath,
    /// By receiver: the signals of others, by their beginning.
    heard: ByRadio<HeardSignal>,
    /// By radio: what it sends itself.
    sent: ByRadio<u32>,
}

impl<'a> Receptions<'a> {
    /// Finds what each of the radios hears.
    #[must_use]
    pub fn new(medium: &'a Medium, table: &'a DecodingTable, on_air: OnAir<'a>, random: &'a RadioRandom) -> Self {
        let OnAir {
            schedule,
            queue,
            links,
            stations,
        } = on_air;
        let senders = schedule.on_air.iter().map(|sent| queue[sent.queued].radio);
        let numbered = (0_u32..).zip(senders);
        let signals = numbered.clone().flat_map(|(number, sender)| {
            links[sender as usize].iter().map(move |link| {
                let signal = HeardSignal {
                    number,
                    power_mw: link.power_mw,
                    twice_shape: link.twice_shape,
                };
                (link.radio, signal)
            })
        });
        let heard = ByRadio::new(stations.len(), signals);
        let sent = ByRadio::new(stations.len(), numbered.map(|(number, sender)| (sender, number)));
        Self {
            medium,
            table,
            on_air,
            random,
            path: VectorPath::widest(),
            heard,
            sent,
        }
    }

    /// By radio: places of the transmissions that it decodes, ascending.
    #[must_use]
    pub fn decoded(&self, threads: usize) -> Vec<Vec<u32>> {
        let mut decoded = vec![Vec::new(); self.on_air.stations.len()];
        parallel::for_each(threads, &mut decoded, |radio, decoded| self.decode(radio, decoded));
        decoded
    }

    fn transmission(&self, number: u32) -> &Transmission {
        &self.on_air.schedule.on_air[number as usize]
    }

    fn message(&self, number: u32) -> &QueuedMessage {
        &self.on_air.queue[self.transmission(number).queued]
    }

    /// What one radio decodes.
    fn decode(&self, radio: usize, decoded: &mut Vec<u32>) {
        let (signals, station) = (self.heard.of(radio), self.on_air.stations[radio]);
        let estimates = self.estimates(signals, station);
        for (place, (signal, estimate)) in signals.iter().zip(&estimates).enumerate() {
            // Most links are too weak even without a disturbance.
            let bits = 8.0 * self.message(signal.number).bytes as f32;
            let [_, upper] = self.table.bounds(estimate.ratio_range([0.0; 2]));
            if estimate.log_draw > bits * upper + LOG_ERROR {
                continue;
            }
            // A radio cannot hear while it sends.
            let sent = self.transmission(signal.number);
            let mut own = self.sent.of(radio).iter().map(|number| self.transmission(*number));
            if own.any(|own| sent.overlap_ns(own) > 0) {
                continue;
            }
            let around = self.around(signals, place);
            let [lower, upper] = self.log_probability(signals, &estimates, place, around.clone());
            let is_decoded = if estimate.log_draw < lower - LOG_ERROR {
                true
            } else if estimate.log_draw > upper + LOG_ERROR {
                false
            } else {
                self.decodes(signals, place, around, station)
            };
            if is_decoded {
                decoded.push(signal.number);
            }
        }
    }

    /// Bounds of the logarithm of the probability that a signal is decoded, with what disturbs it.
    fn log_probability(
        &self,
        signals: &[HeardSignal],
        estimates: &[SignalEstimate],
        place: usize,
        around: Range<usize>,
    ) -> [f32; 2] {
        let (sent, estimate) = (self.transmission(signals[place].number), &estimates[place]);
        let bytes = self.message(signals[place].number).bytes as usize;
        let (mut disturbance, mut disturbed_ns) = ([0.0; 2], 0);
        for other in around.filter(|other| *other != place) {
            let overlap_ns = sent.overlap_ns(self.transmission(signals[other].number));
            if overlap_ns > 0 {
                let [low, high] = estimates[other].ratio_range([0.0; 2]);
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
    fn around(&self, signals: &[HeardSignal], place: usize) -> Range<usize> {
        let sent = self.transmission(signals[place].number);
        let longest_ns = self.on_air.schedule.longest_ns;
        let start_ns = |place: usize| self.transmission(signals[place].number).start_ns;
        let (mut from, mut to) = (place, place + 1);
        while from > 0 && start_ns(from - 1) + longest_ns > sent.start_ns {
            from -= 1;
        }
        while to < signals.len() && start_ns(to) < sent.end_ns {
            to += 1;
        }
        from..to
    }

    fn estimates(&self, signals: &[HeardSignal], station: u32) -> Vec<SignalEstimate> {
        let mut estimates = Vec::with_capacity(signals.len());
        let noise_mw = self.medium.noise_mw as f32;
        for batch in signals.chunks(BATCH) {
            let [mut senders, mut messages, mut shapes] = [[0; BATCH]; 3];
            for (lane, signal) in batch.iter().enumerate() {
                let message = self.message(signal.number);
                (senders[lane], messages[lane], shapes[lane]) = (message.station, message.message, signal.twice_shape);
            }
            let (mut gains, mut log_draws) = ([0.0; BATCH], [0.0; BATCH]);
            self.path.run(FadingBatch {
                key: self.random.key(),
                receiver: station,
                senders: &senders,
                messages: &messages,
                shapes: &shapes,
                gains: &mut gains,
                log_draws: &mut log_draws,
            });
            for (lane, signal) in batch.iter().enumerate() {
                let mean_ratio = signal.power_mw / noise_mw;
                estimates.push(SignalEstimate {
                    ratio: mean_ratio * gains[lane],
                    error: mean_ratio * GAIN_ERROR + 1e-6,
                    log_draw: log_draws[lane],
                });
            }
        }
        estimates
    }

    /// The same by the formulas.
    fn decodes(&self, signals: &[HeardSignal], place: usize, around: Range<usize>, station: u32) -> bool {
        let signal = &signals[place];
        let message = self.message(signal.number);
        let draws = |message: &QueuedMessage| {
            let key = LinkKey {
                sender: message.station,
                receiver: station,
                message: message.message,
            };
            self.random.uniforms(key, RadioDraw::Reception, 0)
        };
        let drawn = draws(message);
        let bytes = message.bytes as usize;
        let signal_mw = faded_mw(signal.power_mw, signal.twice_shape, drawn);
        if drawn[3] >= decode_probability(signal_mw / self.medium.noise_mw, bytes) {
            return false;
        }
        let sent = self.transmission(signal.number);
        let (mut disturbance_mw, mut disturbed_ns) = (0.0, 0);
        for other in around.filter(|other| *other != place).map(|other| &signals[other]) {
            let overlap_ns = sent.overlap_ns(self.transmission(other.number));
            if overlap_ns > 0 {
                disturbance_mw += faded_mw(other.power_mw, other.twice_shape, draws(self.message(other.number)));
                disturbed_ns += overlap_ns;
            }
        }
        let share = sent.share_of(disturbed_ns);
        drawn[3] < self.medium.decodes(signal_mw, disturbance_mw, share, bytes)
    }
}

/// A reception by its numbers in f32.
#[derive(Debug, Clone, Copy)]
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
