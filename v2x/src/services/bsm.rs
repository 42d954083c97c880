//! Generation of basic safety messages: every 100 ms (SAE J2945/1, without its congestion control; that of `v2x` may delay them).

use super::MS;

/// Time between two messages, nanoseconds.
pub const INTERVAL_NS: u64 = 100 * MS;
/// Longest time that congestion control delays a message, nanoseconds.
pub const LONGEST_NS: u64 = 1000 * MS;

/// The basic safety service of one vehicle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BsmService {
    sent_ns: Option<u64>,
    next_count: u8,
}

impl BsmService {
    /// Checks at `now_ns` whether a message is due; congestion control allows one every `dcc_ns`. Returns the number of the message, 0 to
    /// 127, which then counts as sent.
    pub fn check(&mut self, now_ns: u64, dcc_ns: u64) -> Option<u8> {
        let gap_ns = dcc_ns.clamp(INTERVAL_NS, LONGEST_NS);
        if self.sent_ns.is_some_and(|sent| now_ns - sent < gap_ns) {
            return None;
        }
        self.sent_ns = Some(now_ns);
        let count = self.next_count;
        self.next_count = (count + 1) % 128;
        Some(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_numbered_and_come_every_tenth_of_a_second() {
        let mut service = BsmService::default();
        let sent: Vec<u64> = (0..12)
            .filter(|check| service.check(check * 50 * MS, 0).is_some())
            .collect();
        assert_eq!(sent, [0, 2, 4, 6, 8, 10]);
        assert_eq!(service.check(600 * MS, 0), Some(6));
        assert_eq!(service.check(800 * MS, 250 * MS), None);
        assert_eq!(service.check(850 * MS, 250 * MS), Some(7));
        let mut service = BsmService::default();
        let counts: Vec<u8> = (0..130)
            .filter_map(|check| service.check(check * 100 * MS, 0))
            .collect();
        assert_eq!(counts[126..], [126, 127, 0, 1]);
    }
}
