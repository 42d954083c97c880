//! Generation of vulnerable road user awareness messages: ETSI TS 103 300-3 V2.1.1, section 6.4.1, without clusters.

use super::{MS, MeasuredMotion};

/// Shortest time between two messages, `T_GenVamMin`, nanoseconds.
pub const SHORTEST_NS: u64 = 100 * MS;
/// Longest time between two messages, `T_GenVamMax`, nanoseconds.
pub const LONGEST_NS: u64 = 5000 * MS;

/// Time after which the low-frequency container is due again, `T_GenVamLFMin`, nanoseconds.
pub const LOW_FREQUENCY_NS: u64 = 2000 * MS;

/// What a message consists of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VamContent {
    /// The low-frequency container is included.
    pub has_low_frequency: bool,
}

#[derive(Debug, Clone, PartialEq)]
struct LastVam {
    sent_ns: u64,
    low_frequency_ns: u64,
    motion: MeasuredMotion,
}

/// The VRU basic service of one person.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct VamService {
    last: Option<LastVam>,
}

impl VamService {
    /// Checks at `now_ns` whether a message is due; congestion control allows one every `dcc_ns`. A message that is returned counts as
    /// sent.
    pub fn check(&mut self, now_ns: u64, motion: &MeasuredMotion, dcc_ns: u64) -> Option<VamContent> {
        let mut low_frequency_ns = now_ns;
        if let Some(last) = &self.last {
            let elapsed_ns = now_ns - last.sent_ns;
            let is_allowed = elapsed_ns >= dcc_ns.clamp(SHORTEST_NS, LONGEST_NS);
            if !is_allowed || elapsed_ns < LONGEST_NS && !motion.has_news_since(&last.motion) {
                return None;
            }
            if now_ns - last.low_frequency_ns < LOW_FREQUENCY_NS {
                low_frequency_ns = last.low_frequency_ns;
            }
        }
        self.last = Some(LastVam {
            sent_ns: now_ns,
            low_frequency_ns,
            motion: *motion,
        });
        Some(VamContent {
            has_low_frequency: low_frequency_ns == now_ns,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Times of messages (ms) and whether they have the low-frequency container, with checks every 100 ms for 11 s.
    fn timeline(dcc_ms: u64, motion: impl Fn(u64) -> MeasuredMotion) -> Vec<(u64, bool)> {
        let mut service = VamService::default();
        let sent = (0..=110_u64).filter_map(|check| {
            let content = service.check(check * 100 * MS, &motion(check * 100), dcc_ms * MS)?;
            Some((check * 100, content.has_low_frequency))
        });
        sent.collect()
    }

    fn straight(speed_mps: f64) -> impl Fn(u64) -> MeasuredMotion {
        move |ms| MeasuredMotion {
            position_m: [speed_mps * ms as f64 / 1000.0, 0.0],
            speed_mps,
            heading_rad: 0.0,
        }
    }

    #[test]
    fn a_person_sends_every_four_metres_and_at_rest_every_five_seconds() {
        assert_eq!(timeline(0, straight(0.0)), [(0, true), (5000, true), (10_000, true)]);
        // 1.5 m/s: 4.05 m after 2.7 s.
        let expected = [0, 2700, 5400, 8100, 10_800].map(|ms| (ms, true));
        assert_eq!(timeline(0, straight(1.5)), expected);
    }

    #[test]
    fn the_low_frequency_container_comes_after_two_seconds() {
        // 3 m/s: 4.2 m after 1.4 s; 2 s have passed at every second message.
        let expected = [
            (0, true),
            (1400, false),
            (2800, true),
            (4200, false),
            (5600, true),
            (7000, false),
            (8400, true),
            (9800, false),
        ];
        assert_eq!(timeline(0, straight(3.0)), expected);
    }

    #[test]
    fn a_turn_is_news_and_congestion_control_delays_it() {
        let turning = |ms: u64| MeasuredMotion {
            heading_rad: if ms >= 300 { 4.1_f64.to_radians() } else { 0.0 },
            ..MeasuredMotion::default()
        };
        let times = |dcc_ms| -> Vec<u64> { timeline(dcc_ms, turning).into_iter().map(|(ms, _)| ms).collect() };
        assert_eq!(times(0), [0, 300, 5300, 10_300]);
        assert_eq!(times(1000), [0, 1000, 6000, 11_000]);
        // Never beyond five seconds.
        assert_eq!(times(9000), [0, 5000, 10_000]);
    }
}
