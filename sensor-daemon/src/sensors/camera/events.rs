//! Dynamic vision sensors: pixels that became brighter or darker, each with its time.
//!
//! A pixel fires whenever the logarithm of its brightness has changed by the threshold since it last fired; between two samples that
//! logarithm is linear in time (H. Rebecq, D. Gehrig and D. Scaramuzza, "ESIM: an Open Event Camera Simulator", CoRL 2018). There is no
//! noise, no refractory time and no limit of the rate but that of the message.

use ipc_schema::image::BrightnessEvent;

/// Brightness below which pixels do not tell darkness apart: a step of an eight-bit image.
const DARKEST: f32 = 1.0 / 255.0;

/// What a dynamic vision sensor knows of its pixels; empty before its first sample.
#[derive(Debug, Clone, Default)]
pub struct EventMemory {
    /// Brightness and its logarithm at the last sample.
    last: Vec<[f32; 2]>,
    /// Logarithm at which each pixel last fired.
    fired: Vec<f32>,
}

/// The time between two samples.
#[derive(Debug, Clone, Copy)]
pub struct SampledSpan {
    /// Since the begin of the tick, microseconds.
    pub begin_us: f64,
    /// Length, microseconds.
    pub length_us: f64,
}

impl EventMemory {
    /// Adds a sample of the `brightness` of all pixels, row by row, and appends the events of the time since the last one. The first
    /// sample gives none.
    pub fn sample(
        &mut self,
        brightness: &[f32],
        width: usize,
        threshold: f32,
        span: SampledSpan,
        events: &mut Vec<BrightnessEvent>,
    ) {
        if self.last.len() != brightness.len() {
            self.last = brightness.iter().map(|now| [*now, logarithm(*now)]).collect();
            self.fired = self.last.iter().map(|[_, log]| *log).collect();
            return;
        }
        for (pixel, now) in brightness.iter().enumerate() {
            let [linear, before] = self.last[pixel];
            // Most pixels see the same surface in the same light as before.
            if linear == *now {
                continue;
            }
            let after = logarithm(*now);
            self.last[pixel] = [*now, after];
            let polarity = if after > before { 1 } else { -1 };
            let step = threshold * polarity as f32;
            let mut next = self.fired[pixel] + step;
            while (after - next) * polarity as f32 >= 0.0 {
                let share = f64::from((next - before) / (after - before)).clamp(0.0, 1.0);
                events.push(BrightnessEvent {
                    time_us: (span.begin_us + share * span.length_us) as u32,
                    x: (pixel % width) as u16,
                    y: (pixel / width) as u16,
                    polarity,
                });
                self.fired[pixel] = next;
                next += step;
            }
        }
    }
}

fn logarithm(brightness: f32) -> f32 {
    libm::logf(brightness.max(0.0) + DARKEST)
}

/// Sorts events by time, row and column. Those of one pixel keep their order.
pub fn sort_events(events: &mut [BrightnessEvent]) {
    events.sort_by_key(|event| (event.time_us, event.y, event.x));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Brightness with this logarithm.
    fn bright(log: f32) -> f32 {
        libm::expf(log) - DARKEST
    }

    fn events(samples: &[[f32; 2]]) -> Vec<(u32, u16, i32)> {
        let (mut memory, mut events) = (EventMemory::default(), Vec::new());
        for (place, logs) in samples.iter().enumerate() {
            let span = SampledSpan {
                begin_us: place as f64 * 1000.0,
                length_us: 1000.0,
            };
            memory.sample(&logs.map(bright), 2, 0.25, span, &mut events);
        }
        sort_events(&mut events);
        events
            .into_iter()
            .map(|event| (event.time_us, event.x, event.polarity))
            .collect()
    }

    #[test]
    fn a_pixel_fires_at_each_threshold_in_turn() {
        // The left pixel rises by 1.1 in one span and falls by 0.6 in the next; the right one stands still.
        let fired = events(&[[-2.0, -1.0], [-0.9, -1.0], [-1.5, -1.0]]);
        let rise = [0.25, 0.5, 0.75, 1.0].map(|part| (1000.0 + 1000.0 * part / 1.1, 1));
        // It last fired at −1.0: next at −1.25 and −1.5.
        let fall = [0.35, 0.6].map(|part: f64| (2000.0 + 1000.0 * part / 0.6, -1));
        let expected: Vec<(f64, i32)> = rise.into_iter().chain(fall).collect();
        // The last threshold is the last sample itself, so rounding decides whether it is reached.
        assert!((5..=6).contains(&fired.len()), "{fired:?}");
        for ((time_us, x, polarity), (expected_us, expected_polarity)) in fired.iter().zip(expected) {
            assert!((f64::from(*time_us) - expected_us).abs() < 2.0, "{fired:?}");
            assert_eq!((*x, *polarity), (0, expected_polarity));
        }
    }

    #[test]
    fn small_changes_add_up_and_a_way_back_fires_nothing() {
        assert_eq!(events(&[[-1.0; 2], [-1.2, -1.0], [-1.0, -1.0], [-1.2, -1.0]]), []);
        let fired = events(&[[-1.0; 2], [-1.0, -1.1], [-1.0, -1.2], [-1.0, -1.3]]);
        assert_eq!(fired.len(), 1);
        assert!(
            fired[0].0.abs_diff(3500) <= 2 && fired[0].1 == 1 && fired[0].2 == -1,
            "{fired:?}"
        );
    }

    #[test]
    fn black_pixels_do_no_harm() {
        let (mut memory, mut events) = (EventMemory::default(), Vec::new());
        let span = SampledSpan {
            begin_us: 0.0,
            length_us: 100.0,
        };
        for brightness in [0.0, -1.0, 1.0, 0.0] {
            memory.sample(&[brightness], 1, 0.2, span, &mut events);
        }
        // ln(256) / 0.2 = 27.7 there, and as many back.
        assert_eq!(events.iter().filter(|event| event.polarity == 1).count(), 27);
        assert_eq!(events.iter().filter(|event| event.polarity == -1).count(), 27);
    }
}
