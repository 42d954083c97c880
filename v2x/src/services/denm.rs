//! Decentralised environmental notification messages: ETSI EN 302 637-3 V1.3.1, sections 6.1 and 8.2: trigger, repetition, update,
//! cancellation.

use super::MS;

/// Deceleration from which a vehicle warns of its emergency braking, m/s² (the C2C Communication Consortium's triggering conditions for the
/// emergency electronic brake light).
pub const EMERGENCY_BRAKING_MPS2: f64 = 7.0;
/// Speed below which braking is not warned of, m/s: 20 km/h (the same).
pub const EMERGENCY_SPEED_MPS: f64 = 20.0 / 3.6;
/// Time between repetitions of a warning, nanoseconds.
pub const REPETITION_NS: u64 = 100 * MS;
/// Validity of a warning, nanoseconds.
pub const VALIDITY_NS: u64 = 2000 * MS;

/// Why a message is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DenmKind {
    /// A new event.
    New,
    /// The event goes on: another detection time under the same identifier.
    Update,
    /// The same content again.
    Repetition,
    /// The event ended before its validity did.
    Cancellation,
}

/// The DEN basic service of one station for its own emergency braking.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DenmService {
    event: Option<WarnedEvent>,
    /// `sequenceNumber` of the action identifier of the next event.
    next_sequence: u16,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct WarnedEvent {
    sequence: u16,
    detected_ns: u64,
    sent_ns: u64,
    brakes: bool,
}

/// A message to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DenmContent {
    /// Why.
    pub kind: DenmKind,
    /// `sequenceNumber` of the action identifier.
    pub sequence: u16,
    /// Detection of the event, nanoseconds.
    pub detected_ns: u64,
}

impl DenmService {
    /// Checks at `now_ns` with the measured speed and longitudinal acceleration whether a message is due, which then counts as sent.
    pub fn check(&mut self, now_ns: u64, speed_mps: f64, accel_mps2: f64) -> Option<DenmContent> {
        let hard = accel_mps2 <= -EMERGENCY_BRAKING_MPS2;
        let Some(event) = &mut self.event else {
            if !hard || speed_mps < EMERGENCY_SPEED_MPS {
                return None;
            }
            let sequence = self.next_sequence;
            self.next_sequence = sequence.wrapping_add(1);
            self.event = Some(WarnedEvent {
                sequence,
                detected_ns: now_ns,
                sent_ns: now_ns,
                brakes: true,
            });
            return Some(DenmContent {
                kind: DenmKind::New,
                sequence,
                detected_ns: now_ns,
            });
        };
        let kind = if hard && !event.brakes {
            (event.brakes, event.detected_ns) = (true, now_ns);
            DenmKind::Update
        } else if now_ns - event.detected_ns >= VALIDITY_NS {
            // Validity is over: receivers forget the event by themselves, unless it goes on.
            if !hard {
                self.event = None;
                return None;
            }
            event.detected_ns = now_ns;
            DenmKind::Update
        } else if accel_mps2 > 0.0 && event.brakes {
            let content = DenmContent {
                kind: DenmKind::Cancellation,
                sequence: event.sequence,
                detected_ns: event.detected_ns,
            };
            self.event = None;
            return Some(content);
        } else if now_ns - event.sent_ns >= REPETITION_NS {
            DenmKind::Repetition
        } else {
            return None;
        };
        event.sent_ns = now_ns;
        Some(DenmContent {
            kind,
            sequence: event.sequence,
            detected_ns: event.detected_ns,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn emergency_braking_is_warned_of_repeated_and_cancelled() {
        let mut service = DenmService::default();
        let mut check = |ms: u64, speed, accel| {
            service
                .check(ms * MS, speed, accel)
                .map(|sent| (sent.kind, sent.sequence))
        };
        assert_eq!(check(0, 20.0, -6.9), None);
        assert_eq!(check(100, 20.0, -7.0), Some((DenmKind::New, 0)));
        assert_eq!(check(150, 19.0, -7.5), None);
        assert_eq!(check(200, 18.0, -7.5), Some((DenmKind::Repetition, 0)));
        assert_eq!(check(300, 17.0, -3.0), Some((DenmKind::Repetition, 0)));
        assert_eq!(check(400, 17.0, 1.0), Some((DenmKind::Cancellation, 0)));
        assert_eq!(check(500, 17.0, 1.0), None);
        // Another event has another number; 20 km/h is the least speed.
        assert_eq!(check(600, 5.5, -8.0), None);
        assert_eq!(check(700, 5.6, -8.0), Some((DenmKind::New, 1)));
    }

    #[test]
    fn a_warning_ends_with_its_validity_unless_it_goes_on() {
        let mut service = DenmService::default();
        assert_eq!(service.check(0, 30.0, -8.0).unwrap().kind, DenmKind::New);
        let kinds: Vec<_> = (1..=21)
            .map(|tenth| service.check(tenth * 100 * MS, 20.0, -1.0))
            .collect();
        assert!(
            kinds[..19]
                .iter()
                .all(|sent| sent.unwrap().kind == DenmKind::Repetition)
        );
        assert_eq!(kinds[19..], [None, None]);
        assert_eq!(service.check(3000 * MS, 30.0, -8.0).unwrap().kind, DenmKind::New);
        let on = (1..=20).map(|tenth| service.check((3000 + tenth * 100) * MS, 20.0, -8.0).unwrap());
        assert_eq!(on.filter(|sent| sent.kind == DenmKind::Update).count(), 1);
    }
}
