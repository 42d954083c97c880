//! Warnings that a roadside unit hears and sends once more, so that they reach behind buildings: in the manner of keep-alive forwarding of
//! ETSI EN 302 637-3, without its timers.

use std::collections::{BTreeMap, VecDeque};

use crate::message::denm::Denm;

/// What of a warning makes it news: detection, content, end.
type WarningVersion = (u64, u64, bool);

/// The warnings of others at one station.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct WarningRelay {
    /// By originating station and number of the event.
    known: BTreeMap<(u32, u16), WarningVersion>,
    waiting: VecDeque<Vec<u8>>,
}

impl WarningRelay {
    /// Takes a warning that was heard: one that is new, updated or cancelled is sent once more.
    pub fn hear(&mut self, warning: &Denm, bytes: &[u8]) {
        let version = (warning.detected_ms, warning.reference_ms, warning.termination.is_some());
        let key = (warning.originator, warning.sequence);
        if self.known.get(&key).is_none_or(|known| *known < version) {
            self.known.insert(key, version);
            self.waiting.push_back(bytes.to_vec());
        }
        // Nothing is heard of a warning whose validity was over long ago.
        let oldest_ms = warning
            .reference_ms
            .saturating_sub(10 * u64::from(warning.validity_s) * 1000);
        self.known.retain(|_, (_, reference_ms, _)| *reference_ms >= oldest_ms);
    }

    /// The bytes of the next warning to send.
    pub fn next_waiting(&mut self) -> Option<Vec<u8>> {
        self.waiting.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::{GeodeticPoint, StationKind, denm::DenmTermination};

    fn warning(originator: u32, reference_ms: u64) -> Denm {
        Denm {
            station: originator,
            kind: StationKind::PASSENGER_CAR,
            originator,
            sequence: 0,
            detected_ms: 1000,
            reference_ms,
            termination: None,
            position: GeodeticPoint::default(),
            relevance: None,
            traffic: None,
            validity_s: 2,
            interval_ms: None,
            event: None,
        }
    }

    #[test]
    fn each_version_of_a_warning_is_sent_once_more() {
        let mut relay = WarningRelay::default();
        let mut hear = |warning: &Denm| {
            relay.hear(warning, &[warning.originator as u8]);
            relay.next_waiting()
        };
        assert_eq!(hear(&warning(1, 1000)), Some(vec![1]));
        // A repetition is no news, nor is an older version.
        assert_eq!(hear(&warning(1, 1000)), None);
        assert_eq!(hear(&warning(2, 1000)), Some(vec![2]));
        assert_eq!(hear(&warning(1, 1500)), Some(vec![1]));
        assert_eq!(hear(&warning(1, 1000)), None);
        let ended = Denm {
            termination: Some(DenmTermination::Cancellation),
            ..warning(1, 1500)
        };
        assert_eq!(hear(&ended), Some(vec![1]));
        assert_eq!(hear(&ended), None);
    }
}
