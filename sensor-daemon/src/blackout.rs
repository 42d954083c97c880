//! Blackouts: times in which a sensor delivers nothing, with gaps between them.
//!
//! Lengths and gaps are uniform between the configured ends. Time counts from the vehicle's own first tick, and a sequence begins
//! with a uniform part of a gap. So no vehicle appears in a blackout and every sensor has a sample to hold; vehicles that appear
//! together are out of phase.

use ipc_schema::sensor::{BlackoutSpans, NoiseStream};

use crate::noise::RandomStream;

/// Blackouts of one sensor, as configured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlackoutSchedule {
    sensor: NoiseStream,
    length_ns: [f64; 2],
    gap_ns: [f64; 2],
    tick_ns: u64,
}

/// Position of one vehicle's sensor in its sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BlackoutPhase {
    /// Time at which the gap or the blackout ends, nanoseconds.
    until_ns: u64,
    /// Tick of the vehicle's first sample: a vehicle that leaves and returns gets another sequence.
    start: u32,
    /// Gaps and blackouts before this one: even in a gap, odd in a blackout.
    number: u32,
}

impl BlackoutPhase {
    /// True in a blackout.
    #[must_use]
    pub fn is_dark(&self) -> bool {
        self.number % 2 == 1
    }

    /// Time at which the gap or the blackout ends, nanoseconds.
    #[must_use]
    pub fn until_ns(&self) -> u64 {
        self.until_ns
    }
}

impl BlackoutSchedule {
    /// Blackouts with these lengths and gaps; none if the longest has no length. What is shorter
    /// than a tick lasts a tick.
    #[must_use]
    pub fn new(sensor: NoiseStream, spans: BlackoutSpans, tick_ns: u64) -> Option<Self> {
        let BlackoutSpans { length_s, gap_s } = spans;
        (length_s[1] > 0.0).then(|| Self {
            sensor,
            length_ns: length_s.map(|s| 1e9 * s),
            gap_ns: gap_s.map(|s| 1e9 * s),
            tick_ns,
        })
    }

    /// The sequence of a vehicle that is first sensed at `now_ns`, the time of tick `start`.
    #[must_use]
    pub fn begin(&self, episode_seed: u64, id_hash: u64, start: u32, now_ns: u64) -> BlackoutPhase {
        let [place, share] = self.stream(episode_seed, id_hash).uniform_pair(start, 0);
        BlackoutPhase {
            until_ns: now_ns + (((1.0 - share) * between(self.gap_ns, place)) as u64).max(1),
            start,
            number: 0,
        }
    }

    /// Advances to `now_ns`, over the gaps and blackouts that have ended by then.
    pub fn advance(&self, phase: &mut BlackoutPhase, episode_seed: u64, id_hash: u64, now_ns: u64) {
        while now_ns >= phase.until_ns {
            phase.number = phase.number.wrapping_add(1);
            let [place, _] = self
                .stream(episode_seed, id_hash)
                .uniform_pair(phase.start, phase.number & 0x00FF_FFFF);
            let range_ns = if phase.is_dark() { self.length_ns } else { self.gap_ns };
            phase.until_ns += (between(range_ns, place) as u64).max(self.tick_ns);
        }
    }

    fn stream(&self, episode_seed: u64, id_hash: u64) -> RandomStream {
        RandomStream {
            episode_seed,
            id_hash,
            sensor: self.sensor,
        }
    }
}

fn between([least, most]: [f64; 2], place: f64) -> f64 {
    least + place * (most - least)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TICK_NS: u64 = 100_000_000;

    fn schedule(length_s: [f64; 2], gap_s: [f64; 2]) -> BlackoutSchedule {
        BlackoutSchedule::new(NoiseStream::GnssBlackout, BlackoutSpans { length_s, gap_s }, TICK_NS).unwrap()
    }

    /// Lengths of the runs of light and darkness, ticks, the first and the last one left out.
    fn runs(schedule: &BlackoutSchedule, id_hash: u64, ticks: u64) -> [Vec<f64>; 2] {
        let mut phase = schedule.begin(5, id_hash, 0, 0);
        let (mut runs, mut last, mut since) = ([vec![], vec![]], false, None);
        for tick in 0..ticks {
            schedule.advance(&mut phase, 5, id_hash, tick * TICK_NS);
            assert!(tick > 0 || !phase.is_dark());
            if phase.is_dark() != last {
                if let Some(since) = since {
                    runs[usize::from(last)].push((tick - since) as f64);
                }
                (last, since) = (phase.is_dark(), Some(tick));
            }
        }
        runs
    }

    #[test]
    fn lengths_and_gaps_are_in_their_ranges_and_their_means_right() {
        let schedule = schedule([5.0, 10.0], [20.0, 60.0]);
        let all: Vec<[Vec<f64>; 2]> = (0..50).map(|id| runs(&schedule, id, 40_000)).collect();
        for (kind, least, most) in [(0, 200.0, 600.0), (1, 50.0, 100.0)] {
            let lengths: Vec<f64> = all.iter().flat_map(|runs| runs[kind].iter().copied()).collect();
            assert!(lengths.iter().all(|ticks| (least - 1.0..=most + 1.0).contains(ticks)));
            let (n, mean) = (lengths.len() as f64, lengths.iter().sum::<f64>() / lengths.len() as f64);
            // Five standard errors of the mean of a uniform number.
            let tolerance = 5.0 * (most - least) / (12.0 * n).sqrt();
            assert!(
                n > 3000.0 && (mean - 0.5 * (least + most)).abs() < tolerance,
                "{mean} of {n}"
            );
        }
    }

    #[test]
    fn vehicles_are_out_of_phase_and_the_first_blackout_comes_within_a_gap() {
        const N: u64 = 2000;
        let schedule = schedule([5.0, 5.0], [10.0, 10.0]);
        let firsts: Vec<f64> = (0..N)
            .map(|id| schedule.begin(5, id, 0, 0).until_ns as f64 * 1e-9)
            .collect();
        assert!(firsts.iter().all(|s| (0.0..=10.0).contains(s) && *s > 0.0));
        let mean = firsts.iter().sum::<f64>() / N as f64;
        assert!((mean - 5.0).abs() < 5.0 * 10.0 / (12.0 * N as f64).sqrt(), "{mean}");
        let early = firsts.iter().filter(|s| **s < 1.0).count() as f64;
        let expected = N as f64 / 10.0;
        assert!((early - expected).abs() < 5.0 * expected.sqrt(), "{early}");
    }

    #[test]
    fn a_vehicle_that_returns_gets_another_sequence_and_steps_do_not_matter() {
        let schedule = schedule([1.0, 9.0], [1.0, 9.0]);
        let later = schedule.begin(5, 3, 70, 0);
        assert_ne!(schedule.begin(5, 3, 0, 0).until_ns, later.until_ns);
        let (mut often, mut once) = (later, later);
        for tick in 0..1000 {
            schedule.advance(&mut often, 5, 3, tick * TICK_NS);
        }
        schedule.advance(&mut once, 5, 3, 999 * TICK_NS);
        assert_eq!(often, once);
        assert!(often.number > 10);
    }

    #[test]
    fn no_length_is_no_blackout_and_tiny_ones_last_a_tick() {
        assert_eq!(
            BlackoutSchedule::new(
                NoiseStream::GnssBlackout,
                BlackoutSpans {
                    length_s: [0.0; 2],
                    gap_s: [0.0; 2]
                },
                TICK_NS
            ),
            None
        );
        let [light, dark] = runs(&schedule([0.0, 1e-9], [0.0, 0.0]), 1, 100);
        assert!(light.iter().chain(&dark).all(|ticks| *ticks == 1.0) && light.len() > 40);
    }
}
