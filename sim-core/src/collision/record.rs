//! Reporting of contacts: a message, a line in the run's directory, a count in its report.

use std::sync::Arc;

use ipc_schema::{
    block::{self, BlockError, Section},
    event::{Collision, CollisionLayout, Struck},
    failure::{Failure, FailureKind},
    header::MessageHeader,
    membership::RunMembership,
    ports::Publisher,
    services::Channel,
    world::{BODY_SHIFT, VehicleState, vehicle_of},
};
use serde::{Deserialize, Serialize};

use super::{
    CollisionDetector,
    body::{CollisionBody, boxes_touch},
};
use crate::{
    event_log::EventLog,
    mirror::{Mirror, departure::ContactCause},
    names::RoadUserNames,
    scene::{
        Scene, Solid,
        shape::{OrientedBox, Point},
    },
};

/// Contacts that began in the run, by what was struck.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CollisionCounts {
    /// All of them.
    pub total: u64,
    /// With vehicles.
    pub vehicle: u64,
    /// Of these, those that SUMO's own poses have too.
    #[serde(default)]
    pub vehicle_in_sumo: u64,
    /// Of these, those of the mirrors alone, by what explains them.
    #[serde(default)]
    pub own: OwnContactCounts,
    /// With persons.
    pub person: u64,
    /// With buildings.
    pub building: u64,
    /// With obstacles and props.
    pub obstacle: u64,
    /// Of all, those without a line in `events/collisions.jsonl`: the disk was full, or the file had its largest size.
    #[serde(default)]
    pub without_line: u64,
}

/// Contacts of two vehicles that SUMO's own poses do not have, by [`ContactCause`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OwnContactCounts {
    /// See [`ContactCause::Led`], and so on.
    pub led: u64,
    /// A lane change takes time.
    pub lane_change: u64,
    /// Late for a bend.
    pub late: u64,
    /// The path is beside SUMO's.
    pub path: u64,
    /// Not on the path.
    pub tracking: u64,
    /// The shape of the bodies.
    pub body: u64,
}

impl OwnContactCounts {
    fn add(&mut self, cause: ContactCause) {
        *match cause {
            ContactCause::Led => &mut self.led,
            ContactCause::LaneChange => &mut self.lane_change,
            ContactCause::Late => &mut self.late,
            ContactCause::Path => &mut self.path,
            ContactCause::Tracking => &mut self.tracking,
            ContactCause::Body => &mut self.body,
        } += 1;
    }
}

impl CollisionCounts {
    fn add(&mut self, class: u32) {
        self.total += 1;
        let count = match class {
            class if class == Struck::Vehicle as u32 => &mut self.vehicle,
            class if class == Struck::Person as u32 => &mut self.person,
            class if class == Struck::Building as u32 => &mut self.building,
            _ => &mut self.obstacle,
        };
        *count += 1;
    }
}

/// Contacts before an episode: their counts, and the length of their lines.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContactState {
    counts: CollisionCounts,
    /// Bytes in `events/collisions.jsonl`.
    line_bytes: u64,
}

/// A line of `events/collisions.jsonl`.
#[derive(Debug, Serialize)]
struct CollisionLine<'a> {
    tick: u64,
    episode: u64,
    sim_time_s: f64,
    vehicle: &'a str,
    what: &'static str,
    other: &'a str,
    position_m: [f64; 3],
    relative_speed_mps: f32,
    #[serde(flatten)]
    own: ContactBody,
    #[serde(rename = "other_body", skip_serializing_if = "Option::is_none")]
    struck: Option<ContactBody>,
    /// Of two vehicles: whether SUMO's own poses overlap at that time too.
    #[serde(skip_serializing_if = "Option::is_none")]
    in_sumo: Option<bool>,
    /// If they do not: what explains the contact.
    #[serde(skip_serializing_if = "Option::is_none")]
    cause: Option<ContactCause>,
}

/// How a road user was in a contact.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct ContactBody {
    /// Speed over the ground, m/s.
    speed_mps: f32,
    /// Side of its outline that is next to the point of contact.
    side: &'static str,
    /// The trailing body that it was, from 1 on; 0 = the leading or only one.
    #[serde(skip_serializing_if = "is_leading")]
    trailing_body: u32,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_leading(place: &u32) -> bool {
    *place == 0
}

impl ContactBody {
    fn of(state: &VehicleState, position_m: [f64; 3]) -> Self {
        let [forward_mps, left_mps, _] = state.velocity_body_mps;
        Self {
            speed_mps: libm::hypotf(forward_mps, left_mps),
            side: nearest_side(&CollisionBody::of(state).solid, [position_m[0], position_m[1]]),
            trailing_body: state.vehicle >> BODY_SHIFT,
        }
    }

    /// The body of a vehicle that is nearest to the point of contact.
    fn nearest(vehicle: u32, states: &[VehicleState], position_m: [f64; 3]) -> Option<Self> {
        let away_m = |state: &VehicleState| {
            let solid = CollisionBody::of(state).solid;
            let local = solid.local_from_world([position_m[0], position_m[1]]);
            (local[0].abs() - solid.half_m[0]).max(local[1].abs() - solid.half_m[1])
        };
        let bodies = states.iter().filter(|state| vehicle_of(state.vehicle) == vehicle);
        let nearest = bodies.min_by(|a, b| away_m(a).total_cmp(&away_m(b)));
        nearest.map(|state| Self::of(state, position_m))
    }
}

/// The side of an outline that is nearest to a point in it.
fn nearest_side(outline: &OrientedBox, point: Point) -> &'static str {
    let [ahead_m, left_m] = outline.local_from_world(point);
    let [half_length_m, half_width_m] = outline.half_m;
    let is_at_end = half_length_m - ahead_m.abs() < half_width_m - left_m.abs();
    match (is_at_end, ahead_m >= 0.0, left_m >= 0.0) {
        (true, true, _) => "front",
        (true, false, _) => "rear",
        (false, _, true) => "left",
        (false, _, false) => "right",
    }
}

/// Finds, publishes and counts the contacts of a run.
#[derive(Debug)]
pub struct ContactReporter {
    /// One for each map of the run.
    detectors: Vec<CollisionDetector>,
    publisher: Publisher,
    /// Most collisions in one message.
    most: usize,
    lines: EventLog,
    /// Contacts without a line before this process.
    without_line_before: u64,
    counts: CollisionCounts,
}

impl ContactReporter {
    /// Opens the contacts of a run in the scenes of its maps; `None` if the run does not detect them. Lines behind those of `before` are
    /// removed from the file: their ticks are made again.
    ///
    /// # Errors
    /// The service does not exist, or the file cannot be created.
    pub fn open(
        membership: &RunMembership,
        scenes: &[Arc<Scene>],
        before: ContactState,
    ) -> Result<Option<Self>, Failure> {
        if !membership.run.config.collision.detect {
            return Ok(None);
        }
        let publisher = membership.publisher(Channel::Event)?;
        let lines = EventLog::of_run(&membership.run.run_dir, "collisions.jsonl", before.line_bytes)?;
        Ok(Some(Self {
            detectors: scenes.iter().cloned().map(CollisionDetector::new).collect(),
            publisher,
            most: (membership.run.config.traffic.max_road_users as usize).max(1),
            lines,
            without_line_before: before.counts.without_line,
            counts: before.counts,
        }))
    }

    /// Contacts so far.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn state(&mut self) -> Result<ContactState, Failure> {
        let counts = self.finish()?;
        let line_bytes = self.lines.written_bytes();
        Ok(ContactState { counts, line_bytes })
    }

    /// Looks for contacts in the states of a finished tick (section `states` of `payload`), flags them there, and publishes those that begin.
    ///
    /// # Errors
    /// The payload is too short, or an event can be neither sent nor written.
    pub fn report_contacts(
        &mut self,
        header: &MessageHeader,
        payload: &mut [u8],
        states: Section,
        names: &RoadUserNames,
        mirror: &Mirror,
    ) -> Result<(), Failure> {
        let states: &mut [VehicleState] = block::view_mut(payload, states).map_err(unreadable)?;
        let map = usize::from(header.map).min(self.detectors.len() - 1);
        let detector = &mut self.detectors[map];
        detector.detect(header.episode, states);
        let begun = detector.begun();
        if begun.is_empty() {
            return Ok(());
        }
        for part in begun.chunks(self.most) {
            let layout = CollisionLayout::sized(part.len());
            let header = MessageHeader {
                shape: layout.shape,
                ..*header
            };
            let mut draft = self.publisher.loan(header, layout.len)?;
            let contacts = block::view_mut(draft.payload_mut(), layout.collisions).map_err(unreadable)?;
            contacts.copy_from_slice(part);
            draft.send()?;
        }
        for collision in begun {
            let in_sumo = (collision.other_class == Struck::Vehicle as u32)
                .then(|| overlap_in_sumo(mirror, [collision.vehicle, collision.other]));
            self.counts.add(collision.other_class);
            self.counts.vehicle_in_sumo += u64::from(in_sumo == Some(true));
            let state = |vehicle: u32| states.iter().find(|state| state.vehicle == vehicle);
            let cause = match (in_sumo, state(collision.vehicle), state(collision.other)) {
                (Some(false), Some(a), Some(b)) => Some(mirror.contact_cause([a, b])),
                _ => None,
            };
            if let Some(cause) = cause {
                self.counts.own.add(cause);
            }
            let body = |vehicle: u32| ContactBody::nearest(vehicle, states, collision.position_m);
            let Some(own) = body(collision.vehicle) else { continue };
            let is_road_user = [Struck::Vehicle, Struck::Person]
                .map(|class| class as u32)
                .contains(&collision.other_class);
            let struck = is_road_user.then(|| body(collision.other)).flatten();
            let (what, other) = struck_object(collision, names, detector.scene());
            self.lines.push(&CollisionLine {
                tick: header.tick,
                episode: header.episode,
                sim_time_s: sim_time_s(header),
                vehicle: names.id(collision.vehicle),
                what,
                other,
                position_m: collision.position_m,
                relative_speed_mps: collision.relative_speed_mps,
                own,
                struck,
                in_sumo,
                cause,
            })?;
        }
        Ok(())
    }

    /// Writes what is buffered to the file and returns the counts so far.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(&mut self) -> Result<CollisionCounts, Failure> {
        self.lines.flush()?;
        self.counts.without_line = self.without_line_before + self.lines.dropped_lines();
        Ok(self.counts)
    }
}

/// True if SUMO itself has both vehicles in one place at the mirrors' time, a frame more or less: SUMO lets bodies overlap where lanes
/// meet.
fn overlap_in_sumo(mirror: &Mirror, vehicles: [u32; 2]) -> bool {
    let [a, b] = vehicles.map(|vehicle| mirror.sumo_boxes(vehicle));
    a.iter().zip(&b).any(|(a, b)| boxes_touch(a, b))
}

fn unreadable(error: BlockError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}

#[expect(clippy::cast_precision_loss, reason = "a time for human readers")]
fn sim_time_s(header: &MessageHeader) -> f64 {
    header.sim_time_ns as f64 / 1e9
}

/// What was struck: its class and its name.
fn struck_object<'a>(collision: &Collision, names: &'a RoadUserNames, scene: &'a Scene) -> (&'static str, &'a str) {
    let name = |index: u32| names.id(index);
    let is = |class: Struck| collision.other_class == class as u32;
    if is(Struck::Vehicle) {
        ("vehicle", name(collision.other))
    } else if is(Struck::Person) {
        ("person", name(collision.other))
    } else {
        match scene.solid(collision.other) {
            Solid::Building(building) => ("building", building.id.as_str()),
            Solid::Prop(prop) => ("obstacle", prop.kind.name),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_side_of_a_contact_is_the_nearest_of_four() {
        // 4 m long and 2 m wide, heading north.
        let outline = OrientedBox {
            centre_m: [10.0, 20.0],
            along: [0.0, 1.0],
            half_m: [2.0, 1.0],
            z_m: [0.0, 1.5],
        };
        for (point, side) in [
            ([10.2, 21.9], "front"),
            ([9.5, 18.1], "rear"),
            ([9.1, 20.5], "left"),
            ([10.9, 19.0], "right"),
            // A corner that the front has a little less of.
            ([10.95, 21.9], "right"),
        ] {
            assert_eq!(nearest_side(&outline, point), side, "{point:?}");
        }
    }
}
