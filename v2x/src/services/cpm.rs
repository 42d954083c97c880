//! Generation of collective perception messages: ETSI TS 103 324 V2.1.1, section 6.1.

use std::collections::BTreeMap;

use super::{MS, MeasuredMotion};

/// Shortest time between two messages, `T_GenCpmMin`, nanoseconds.
pub const SHORTEST_NS: u64 = 100 * MS;
/// Longest time between two messages, `T_GenCpmMax`, nanoseconds.
pub const LONGEST_NS: u64 = 1000 * MS;
/// Time after which the sensor information container is due again, `T_AddSensorInformation`, nanoseconds.
pub const SENSOR_INFORMATION_NS: u64 = 1000 * MS;
/// Time after which all people are included again, half of `T_GenCpmMax`, nanoseconds.
pub const PEOPLE_NS: u64 = LONGEST_NS / 2;

/// Which inclusion rule an object follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ObjectKind {
    /// People and animals ("type A"): all of them if any is new or due.
    Person,
    /// Vehicles ("type B"): each by its own change.
    Vehicle,
}

/// An object that the station perceives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PerceivedMotion {
    /// Number of the object in its track list.
    pub object: u64,
    /// Inclusion rule.
    pub kind: ObjectKind,
    /// Motion.
    pub motion: MeasuredMotion,
}

/// What a message consists of.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct CpmContent {
    /// Places of the included objects among those that were given, ascending.
    pub objects: Vec<usize>,
    /// The sensor information container is included.
    pub has_sensor_information: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct IncludedObject {
    included_ns: u64,
    motion: MeasuredMotion,
}

/// The CP service of one station.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CpmService {
    sent_ns: Option<u64>,
    sensor_information_ns: Option<u64>,
    included: BTreeMap<u64, IncludedObject>,
}

impl CpmService {
    /// Checks at `now_ns` whether a message is due for the objects that are perceived now; congestion control allows one every `dcc_ns`.
    /// A message that is returned counts as sent.
    pub fn check(&mut self, now_ns: u64, perceived: &[PerceivedMotion], dcc_ns: u64) -> Option<CpmContent> {
        let objects = self.due(now_ns, perceived);
        self.check_chosen(now_ns, perceived, objects, dcc_ns)
    }

    /// The same for a message that has room for `most` objects: those that were not included for the longest time come first.
    pub fn check_most(
        &mut self,
        now_ns: u64,
        perceived: &[PerceivedMotion],
        dcc_ns: u64,
        most: usize,
    ) -> Option<CpmContent> {
        let mut objects = self.due(now_ns, perceived);
        if objects.len() > most {
            objects.sort_by_key(|place| {
                self.last_included(perceived[*place].object)
                    .map(|(included_ns, _)| included_ns)
            });
            objects.truncate(most);
            objects.sort_unstable();
        }
        self.check_chosen(now_ns, perceived, objects, dcc_ns)
    }

    /// The same for a message with the objects at `objects`, whichever they are.
    pub fn check_chosen(
        &mut self,
        now_ns: u64,
        perceived: &[PerceivedMotion],
        objects: Vec<usize>,
        dcc_ns: u64,
    ) -> Option<CpmContent> {
        let gap_ns = dcc_ns.clamp(SHORTEST_NS, LONGEST_NS);
        if self.sent_ns.is_some_and(|sent| now_ns - sent < gap_ns) {
            return None;
        }
        let has_sensor_information = self.is_sensor_information_due(now_ns);
        if objects.is_empty() && !has_sensor_information {
            return None;
        }
        self.sent_ns = Some(now_ns);
        if has_sensor_information {
            self.sensor_information_ns = Some(now_ns);
        }
        for object in objects.iter().map(|place| &perceived[*place]) {
            let included = IncludedObject {
                included_ns: now_ns,
                motion: object.motion,
            };
            self.included.insert(object.object, included);
        }
        // An object that nothing was heard of for so long is new when it comes back, whatever is remembered.
        self.included
            .retain(|_, included| now_ns - included.included_ns <= 2 * LONGEST_NS);
        Some(CpmContent {
            objects,
            has_sensor_information,
        })
    }

    /// When the last message was sent, nanoseconds.
    #[must_use]
    pub fn sent_ns(&self) -> Option<u64> {
        self.sent_ns
    }

    /// True if a message with sensor information is due.
    #[must_use]
    pub fn is_sensor_information_due(&self, now_ns: u64) -> bool {
        self.sensor_information_ns
            .is_none_or(|sent| now_ns - sent >= SENSOR_INFORMATION_NS)
    }

    /// When an object was included for the last time, nanoseconds, and how it moved.
    #[must_use]
    pub fn last_included(&self, object: u64) -> Option<(u64, MeasuredMotion)> {
        let included = self.included.get(&object)?;
        Some((included.included_ns, included.motion))
    }

    /// Places of the objects that the rules include.
    fn due(&self, now_ns: u64, perceived: &[PerceivedMotion]) -> Vec<usize> {
        let is_person = |object: &PerceivedMotion| object.kind == ObjectKind::Person;
        let all_people = perceived
            .iter()
            .filter(|object| is_person(object))
            .any(|person| self.is_left_out_for(person, now_ns, PEOPLE_NS));
        let is_included = |place: &usize| {
            let object = &perceived[*place];
            match is_person(object) {
                true => all_people,
                false => self.is_due(object, now_ns),
            }
        };
        (0..perceived.len()).filter(is_included).collect()
    }

    /// True if the object is new, or was not included for `longest_ns`.
    fn is_left_out_for(&self, object: &PerceivedMotion, now_ns: u64, longest_ns: u64) -> bool {
        let before = self.included.get(&object.object);
        before.is_none_or(|before| now_ns - before.included_ns >= longest_ns)
    }

    /// A vehicle is included if it is new, has news, or was not included for a second.
    fn is_due(&self, object: &PerceivedMotion, now_ns: u64) -> bool {
        let before = self.included.get(&object.object);
        self.is_left_out_for(object, now_ns, LONGEST_NS)
            || before.is_some_and(|before| object.motion.has_news_since(&before.motion))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(object: u64, kind: ObjectKind, x_m: f64, speed_mps: f64) -> PerceivedMotion {
        PerceivedMotion {
            object,
            kind,
            motion: MeasuredMotion {
                position_m: [x_m, 0.0],
                speed_mps,
                heading_rad: 0.0,
            },
        }
    }

    #[test]
    fn vehicles_are_included_by_their_own_change() {
        let mut service = CpmService::default();
        let mut sent = Vec::new();
        for tenth in 0..=12_u64 {
            let t = tenth as f64 / 10.0;
            // One at 15 m/s: news every 0.3 s; one at rest: after a second.
            let seen = [
                object(1, ObjectKind::Vehicle, 15.0 * t, 15.0),
                object(2, ObjectKind::Vehicle, -30.0, 0.0),
            ];
            if let Some(content) = service.check(tenth * 100 * MS, &seen, 0) {
                sent.push((tenth, content.objects, content.has_sensor_information));
            }
        }
        let expected = [
            (0, vec![0, 1], true),
            (3, vec![0], false),
            (6, vec![0], false),
            (9, vec![0], false),
            (10, vec![1], true),
            (12, vec![0], false),
        ];
        assert_eq!(sent, expected);
    }

    #[test]
    fn people_are_included_together_when_one_is_new_or_half_a_second_old() {
        let mut service = CpmService::default();
        let mut sent = Vec::new();
        for tenth in 0..=9_u64 {
            let mut seen = vec![object(1, ObjectKind::Person, 0.0, 1.0)];
            if tenth >= 2 {
                seen.push(object(2, ObjectKind::Person, 9.0, 1.0));
            }
            if let Some(content) = service.check(tenth * 100 * MS, &seen, 0) {
                sent.push((tenth, content.objects.len()));
            }
        }
        // The second person is new at 0.2 s: both are included, and again 0.5 s later.
        assert_eq!(sent, [(0, 1), (2, 2), (7, 2)]);
    }

    #[test]
    fn without_objects_the_sensor_information_alone_is_sent_every_second() {
        let mut service = CpmService::default();
        let sent: Vec<u64> = (0..25)
            .filter(|tenth| service.check(tenth * 100 * MS, &[], 0).is_some())
            .collect();
        assert_eq!(sent, [0, 10, 20]);
    }

    #[test]
    fn congestion_control_delays_messages() {
        let mut service = CpmService::default();
        let seen = |tenth: u64| [object(1, ObjectKind::Vehicle, 5.0 * tenth as f64, 50.0)];
        let sent: Vec<u64> = (0..10)
            .filter(|tenth| service.check(tenth * 100 * MS, &seen(*tenth), 400 * MS).is_some())
            .collect();
        assert_eq!(sent, [0, 4, 8]);
    }
}
