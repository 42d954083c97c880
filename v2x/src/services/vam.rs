//! Generation of vulnerable road user awareness messages: ETSI TS 103 300-3 V2.1.1, section 6.4.1, without clusters.

use super::{MS, MeasuredMotion};

/// Shortest time between two messages, `T_GenVamMin`, nanoseconds.
pub const SHORTEST_NS: u64 = 100 * MS;
/// Longest time between two messages, `T_GenVamMax`, nanoseconds.
pub const LONGEST_NS: u64 = 5000 * MS;

/// The VRU basic service of one person.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct VamService {
    last: Option<(u64, MeasuredMotion)>,
}

impl VamService {
    /// Checks at `now_ns` whether a message is due; congestion control allows one every `dcc_ns`. A message that is due counts as sent.
    pub fn check(&mut self, now_ns: u64, motion: &MeasuredMotion, dcc_ns: u64) -> bool {
        let is_due = match &self.last {
            None => true,
            Some((sent_ns, before)) => {
                let elapsed_ns = now_ns - sent_ns;
                elapsed_ns >= dcc_ns.clamp(SHORTEST_NS, LONGEST_NS)
                    && (elapsed_ns >= LONGEST_NS || motion.has_news_since(before))
            }
        };
        if is_due {
            self.last = Some((now_ns, *motion));
        }
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_person_sends_every_four_metres_and_at_rest_every_five_seconds() {
        let sent = |speed_mps: f64| {
            let mut service = VamService::default();
            let checks = (0..=110_u64).map(|check| check * 100);
            let due = checks.filter(|ms| {
                let motion = MeasuredMotion {
                    position_m: [speed_mps * *ms as f64 / 1000.0, 0.0],
                    speed_mps,
                    heading_rad: 0.0,
                };
                service.check(ms * MS, &motion, 0)
            });
            due.collect::<Vec<_>>()
        };
        assert_eq!(sent(0.0), [0, 5000, 10_000]);
        // 1.5 m/s: 4.05 m after 2.7 s.
        assert_eq!(sent(1.5), [0, 2700, 5400, 8100, 10_800]);
    }
}
