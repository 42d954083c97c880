//! Generation of cooperative awareness messages: ETSI EN 302 637-2 V1.4.1, section 6.1.3.

use super::{MS, MeasuredMotion};

/// Shortest time between two messages, `T_GenCamMin`, nanoseconds.
pub const SHORTEST_NS: u64 = 100 * MS;
/// Longest time between two messages, `T_GenCamMax`, nanoseconds.
pub const LONGEST_NS: u64 = 1000 * MS;
/// Messages without news that keep the pace of the last one with news, `N_GenCam`.
pub const PACED_MESSAGES: u32 = 3;
/// Time after which the low-frequency container is due again, nanoseconds (section 6.1.3).
pub const LOW_FREQUENCY_NS: u64 = 500 * MS;

/// What a message consists of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CamContent {
    /// The low-frequency container is included.
    pub has_low_frequency: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct LastCam {
    sent_ns: u64,
    low_frequency_ns: u64,
    motion: MeasuredMotion,
}

/// The CA basic service of one station.
#[derive(Debug, Clone, PartialEq)]
pub struct CamService {
    last: Option<LastCam>,
    /// `T_GenCam`: time after which a message is due without news.
    pace_ns: u64,
    /// Messages in a row that were due without news.
    without_news: u32,
}

impl Default for CamService {
    fn default() -> Self {
        Self {
            last: None,
            pace_ns: LONGEST_NS,
            without_news: 0,
        }
    }
}

impl CamService {
    /// Checks at `now_ns` whether a message is due; congestion control allows one every `dcc_ns`. A message that is returned counts as
    /// sent.
    pub fn check(&mut self, now_ns: u64, motion: &MeasuredMotion, dcc_ns: u64) -> Option<CamContent> {
        let Some(last) = &self.last else {
            return Some(self.send(now_ns, now_ns, motion, true));
        };
        let elapsed_ns = now_ns - last.sent_ns;
        if elapsed_ns < dcc_ns.clamp(SHORTEST_NS, LONGEST_NS) {
            return None;
        }
        if motion.has_news_since(&last.motion) {
            self.pace_ns = elapsed_ns.min(LONGEST_NS);
            self.without_news = 0;
        } else if elapsed_ns >= self.pace_ns {
            self.without_news += 1;
            if self.without_news >= PACED_MESSAGES {
                self.pace_ns = LONGEST_NS;
            }
        } else {
            return None;
        }
        let is_due = now_ns - last.low_frequency_ns >= LOW_FREQUENCY_NS;
        let low_frequency_ns = if is_due { now_ns } else { last.low_frequency_ns };
        Some(self.send(now_ns, low_frequency_ns, motion, is_due))
    }

    fn send(&mut self, sent_ns: u64, low_frequency_ns: u64, motion: &MeasuredMotion, is_due: bool) -> CamContent {
        self.last = Some(LastCam {
            sent_ns,
            low_frequency_ns,
            motion: *motion,
        });
        CamContent {
            has_low_frequency: is_due,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Times of messages (ms) and whether they have the low-frequency container, with checks every 100 ms for `checks` checks.
    fn timeline(checks: u64, dcc_ms: u64, motion: impl Fn(u64) -> MeasuredMotion) -> Vec<(u64, bool)> {
        let mut service = CamService::default();
        let sent = (0..checks).filter_map(|check| {
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
    fn a_station_at_rest_sends_once_a_second() {
        let expected = [(0, true), (1000, true), (2000, true), (3000, true)];
        assert_eq!(timeline(35, 0, straight(0.0)), expected);
    }

    #[test]
    fn a_steady_speed_sends_every_four_metres() {
        // 15 m/s: 4 m are exceeded after 0.3 s (4.5 m). The low-frequency container is due at the first message 0.5 s after the last.
        let expected = [
            (0, true),
            (300, false),
            (600, true),
            (900, false),
            (1200, true),
            (1500, false),
        ];
        assert_eq!(timeline(17, 0, straight(15.0)), expected);
        // 41 m/s: 4.1 m each 0.1 s.
        let fast = timeline(6, 0, straight(41.0));
        assert_eq!(
            fast.iter().map(|(ms, _)| *ms).collect::<Vec<_>>(),
            [0, 100, 200, 300, 400, 500]
        );
        assert_eq!(fast.iter().filter(|(_, low)| *low).count(), 2);
        // Exactly 4 m is not more than 4 m: 20 m/s sends every 0.3 s, not every 0.2 s.
        let exact = timeline(7, 0, straight(20.0));
        assert_eq!(exact.iter().map(|(ms, _)| *ms).collect::<Vec<_>>(), [0, 300, 600]);
    }

    #[test]
    fn the_pace_of_the_last_news_is_kept_for_three_messages() {
        // It drives at 15 m/s until 0.6 s and stands from there on: its speed is news at 0.7 s, 0.1 s after the message of 0.6 s, which
        // sets the pace of three more messages; then once a second.
        let stop = |ms: u64| match ms {
            0..=600 => straight(15.0)(ms),
            _ => MeasuredMotion {
                position_m: [9.0, 0.0],
                ..MeasuredMotion::default()
            },
        };
        let sent: Vec<u64> = timeline(35, 0, stop).into_iter().map(|(ms, _)| ms).collect();
        assert_eq!(sent, [0, 300, 600, 700, 800, 900, 1000, 2000, 3000]);
    }

    #[test]
    fn heading_and_speed_are_news_beyond_their_thresholds() {
        let turning = |degrees: f64| {
            move |ms: u64| MeasuredMotion {
                heading_rad: (179.0 + if ms >= 300 { degrees } else { 0.0 }).to_radians(),
                ..MeasuredMotion::default()
            }
        };
        assert_eq!(timeline(5, 0, turning(4.1))[1].0, 300);
        assert_eq!(timeline(5, 0, turning(3.9)).len(), 1);
        let faster = |mps: f64| {
            move |ms: u64| MeasuredMotion {
                speed_mps: if ms >= 200 { mps } else { 0.0 },
                ..MeasuredMotion::default()
            }
        };
        assert_eq!(timeline(5, 0, faster(0.51))[1].0, 200);
        assert_eq!(timeline(5, 0, faster(0.5)).len(), 1);
    }

    #[test]
    fn congestion_control_delays_news_and_never_beyond_a_second() {
        let sent: Vec<u64> = timeline(17, 500, straight(41.0))
            .into_iter()
            .map(|(ms, _)| ms)
            .collect();
        assert_eq!(sent, [0, 500, 1000, 1500]);
        let sent: Vec<u64> = timeline(25, 5000, straight(41.0))
            .into_iter()
            .map(|(ms, _)| ms)
            .collect();
        assert_eq!(sent, [0, 1000, 2000]);
    }
}
