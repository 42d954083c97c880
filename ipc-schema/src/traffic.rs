//! `traffic` and `traffic-meta`: SUMO's road users and traffic lights in SI units and the world frame.

use bytemuck::{Pod, Zeroable};

use crate::section::payload_layout;

/// Kind of a road user, as carried in [`VehicleMeta::kind`] and [`TrafficState::kind`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Kind {
    /// Connected vehicle: it carries sensors and gets a slot in the observation.
    Cav = 0,
    /// Vehicle without sensors.
    Other = 1,
    /// Pedestrian.
    Person = 2,
    /// Vehicle that actions drive (driving task); it carries sensors like a [`Kind::Cav`].
    Hero = 3,
    /// Trailing body of an articulated vehicle, in `world` alone: a trailer or a carriage, which has no sensors and no row of its own in
    /// any other message.
    Trailing = 4,
}

/// SUMO set this road user's position (teleport, insertion, `moveToXY`): do not interpolate across this step.
pub const DISCONTINUOUS: u32 = 1;

/// One road user at one SUMO step. World frame: metres in the net's own projected coordinates, x east, y north, z up.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct TrafficState {
    /// Front-bumper centre on the ground (persons: centre), x, metres.
    pub front_x_m: f64,
    /// Front-bumper centre on the ground (persons: centre), y, metres.
    pub front_y_m: f64,
    /// Height of the road at the front bumper, metres.
    pub front_z_m: f64,
    /// Heading, counter-clockwise from east, radians in (-π, π].
    pub yaw_rad: f32,
    /// Slope, positive uphill, radians.
    pub pitch_rad: f32,
    /// Speed along the lane, metres per second.
    pub speed_mps: f32,
    /// Acceleration along the lane over the last SUMO step, m/s².
    pub accel_mps2: f32,
    /// Dense index of the road user within its episode, in order of appearance.
    pub vehicle: u32,
    /// A [`Kind`].
    pub kind: u32,
    /// SUMO's signal bits (blinkers, brake light, …).
    pub signals: u32,
    /// Bits: [`DISCONTINUOUS`].
    pub flags: u32,
}

/// An event of a road user, as carried in [`VehicleMeta::event`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum MetaEvent {
    /// It entered the net; the other fields describe it.
    Departed = 0,
    /// It left the net: it reached its destination, or SUMO removed it.
    Arrived = 1,
    /// SUMO began to teleport it.
    Teleported = 2,
}

/// SUMO's vehicle classes.
pub const VEHICLE_CLASSES: [&str; 34] = [
    "passenger",
    "private",
    "emergency",
    "authority",
    "army",
    "vip",
    "hov",
    "taxi",
    "bus",
    "coach",
    "delivery",
    "truck",
    "trailer",
    "motorcycle",
    "moped",
    "bicycle",
    "evehicle",
    "tram",
    "rail_urban",
    "rail",
    "rail_electric",
    "rail_fast",
    "ship",
    "container",
    "cable_car",
    "subway",
    "aircraft",
    "wheelchair",
    "scooter",
    "drone",
    "custom1",
    "custom2",
    "pedestrian",
    "ignoring",
];

/// Place of a class in [`VEHICLE_CLASSES`]; an unknown one counts as "ignoring", SUMO's class without properties.
#[must_use]
pub fn class_number(name: &str) -> u16 {
    let place = VEHICLE_CLASSES.iter().position(|class| *class == name);
    place.unwrap_or(VEHICLE_CLASSES.len() - 1) as u16
}

/// The class of this number ([`VehicleState::class`](crate::world::VehicleState::class)); of a larger one "ignoring".
#[must_use]
pub fn class_name(number: u16) -> &'static str {
    let last = VEHICLE_CLASSES.len() - 1;
    VEHICLE_CLASSES[usize::from(number).min(last)]
}

/// Longest id that is carried as it is, as long as those that commands carry. Of a longer one its begin is carried, then
/// [`CUT_MARK`] and the 16 digits of its hash, so that two ids stay different.
pub const ID_BYTES: usize = 128;
/// Stands between the begin of an id that is too long and its hash.
pub const CUT_MARK: char = '~';
/// Longest name of a vehicle type that is carried.
pub const TYPE_ID_BYTES: usize = 32;

/// Slowly changing facts about a road user.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct VehicleMeta {
    /// Hash of SUMO's id ([`id_hash`]): keys the road user's random streams.
    pub id_hash: u64,
    /// Dense index within the episode.
    pub vehicle: u32,
    /// A [`MetaEvent`].
    pub event: u32,
    /// A [`Kind`].
    pub kind: u32,
    /// Index of SUMO's vehicle type in order of first appearance.
    pub type_index: u32,
    /// Bumper to bumper, metres.
    pub length_m: f32,
    /// Metres.
    pub width_m: f32,
    /// Metres.
    pub height_m: f32,
    /// Bytes of `id` in use.
    pub id_len: u32,
    /// SUMO's id, UTF-8.
    pub id: [u8; ID_BYTES],
    /// SUMO's vehicle class ("passenger", "truck", …), UTF-8, zero padded.
    pub vehicle_class: [u8; 16],
    /// SUMO's vehicle type, UTF-8, zero padded; cut.
    pub type_id: [u8; TYPE_ID_BYTES],
    /// Largest acceleration of SUMO's vehicle type, m/s²; 0 for a person.
    pub type_accel_mps2: f32,
    /// Largest deceleration of SUMO's vehicle type, in an emergency too, m/s²; 0 for a person.
    pub type_decel_mps2: f32,
    /// Top speed of SUMO's vehicle type, m/s; 0 for a person.
    pub type_speed_mps: f32,
    /// Zero.
    pub reserved: u32,
}

impl VehicleMeta {
    /// SUMO's id as text ([`ID_BYTES`] at most).
    #[must_use]
    pub fn id_text(&self) -> String {
        let len = (self.id_len as usize).min(ID_BYTES);
        String::from_utf8_lossy(&self.id[..len]).into_owned()
    }

    /// SUMO's vehicle class as text.
    #[must_use]
    pub fn class_text(&self) -> String {
        let class = self.vehicle_class.split(|&byte| byte == 0).next().unwrap_or_default();
        String::from_utf8_lossy(class).into_owned()
    }

    /// SUMO's vehicle type as text ([`TYPE_ID_BYTES`] at most).
    #[must_use]
    pub fn type_text(&self) -> String {
        let name = self.type_id.split(|&byte| byte == 0).next().unwrap_or_default();
        String::from_utf8_lossy(name).into_owned()
    }

    /// Stores `id`, shortened to [`ID_BYTES`], with the hash of the whole.
    pub fn set_id(&mut self, id: &str) {
        (self.id, self.id_len) = id_text_bytes(id);
        self.id_hash = id_hash(id);
    }
}

/// Most links of one traffic light that are carried. SUMO allows 256 at one junction; a light may control several.
pub const SIGNAL_LINKS: usize = 512;

/// Most events of road users in one `traffic-meta` message; a step with more events sends more messages.
pub const EVENTS_PER_MESSAGE: usize = 1024;

/// Most traffic lights in one `traffic-meta` message; a step with more changes sends more messages.
pub const SIGNALS_PER_MESSAGE: usize = 256;

/// Most traffic lights in a census; further ones are sent only when they change.
pub const MOST_SIGNALS: usize = 4096;

/// State of one traffic light, sent when the episode begins and whenever it changes.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct SignalMeta {
    /// Hash of SUMO's id ([`id_hash`]).
    pub id_hash: u64,
    /// Index of the traffic light, in the order of SUMO's sorted ids.
    pub signal: u32,
    /// Bytes of `id` in use.
    pub id_len: u32,
    /// SUMO's id, UTF-8, shortened to [`ID_BYTES`].
    pub id: [u8; ID_BYTES],
    /// Links that it controls; those beyond [`SIGNAL_LINKS`] are not carried.
    pub links: u32,
    /// Zero.
    pub reserved: u32,
    /// SUMO's letter for each link (`r`, `y`, `g`, `G`, `u`, `o`, `O`, `s`), zero padded.
    pub state: [u8; SIGNAL_LINKS],
}

impl SignalMeta {
    /// SUMO's id as text ([`ID_BYTES`] at most).
    #[must_use]
    pub fn id_text(&self) -> String {
        let len = (self.id_len as usize).min(ID_BYTES);
        String::from_utf8_lossy(&self.id[..len]).into_owned()
    }
}

/// `id` shortened to [`ID_BYTES`] where it is longer, zero padded, with the number of bytes in use.
#[must_use]
pub fn id_text_bytes(id: &str) -> ([u8; ID_BYTES], u32) {
    let shortened;
    let text = if id.len() <= ID_BYTES {
        id
    } else {
        let hash = format!("{CUT_MARK}{:016x}", id_hash(id));
        shortened = format!("{}{hash}", &id[..id.floor_char_boundary(ID_BYTES - hash.len())]);
        &shortened
    };
    let mut bytes = [0; ID_BYTES];
    bytes[..text.len()].copy_from_slice(text.as_bytes());
    (bytes, u32::try_from(text.len()).unwrap_or(0))
}

payload_layout! {
    /// Layout of a `traffic-meta` message.
    TrafficMetaLayout(events, changes, points) {
        /// `VehicleMeta [events]`: events of road users.
        vehicles: VehicleMeta, [events];
        /// `SignalMeta [changes]`: traffic lights that changed.
        signals: SignalMeta, [changes];
        /// `RoutePoint [points]`: points of heroes' routes. A message that has any has no other rows.
        route: RoutePoint, [points];
    }
}

/// What SUMO's own driver would have done with a hero in this step, from where actions had brought it before.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct HeroAdvice {
    /// Dense index of the hero.
    pub vehicle: u32,
    /// Acceleration along the lane, m/s²; SUMO's driver brakes as hard as it has to.
    pub accel_mps2: f32,
}

payload_layout! {
    /// Where the arrays of a `traffic` message lie.
    TrafficLayout(road_users, advised) {
        /// `TrafficState [road_users]`.
        states: TrafficState, [road_users];
        /// `HeroAdvice [advised]`, by ascending dense index; only if a hero's observation has it.
        advice: HeroAdvice, [advised];
    }
}

impl TrafficMetaLayout {
    /// Layout for `vehicles` events of road users and `signals` changes of traffic lights.
    #[must_use]
    pub fn new(vehicles: usize, signals: usize) -> Self {
        Self::sized(vehicles, signals, 0)
    }
}

/// Most points of routes in one message; longer routes take more messages.
pub const ROUTE_POINTS_PER_MESSAGE: usize = 2048;
/// [`RoutePoint::signal`] where there is none.
pub const NO_SIGNAL: u32 = u32::MAX;

/// One point of a hero's route: a line along the centres of its lanes and across junctions.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct RoutePoint {
    /// x, world, metres.
    pub x_m: f64,
    /// y, world, metres.
    pub y_m: f64,
    /// Speed limit from here on, m/s.
    pub speed_limit_mps: f32,
    /// Dense index of the hero.
    pub vehicle: u32,
    /// Number of the point in the hero's route, from 0.
    pub index: u32,
    /// Number of the edge in the hero's route, from 0; a way across a junction belongs to the edge before it.
    pub edge: u32,
    /// [`SignalMeta::signal`] of the traffic light whose stop line this is, or [`NO_SIGNAL`].
    pub signal: u32,
    /// Link of that traffic light that controls the hero.
    pub link: u32,
    /// What begins at this point, from here to the next point with another value: [`ON_EDGE`], or a way across a junction with
    /// [`RIGHT_OF_WAY`] or [`YIELDS`].
    pub way: u32,
    /// Zero.
    pub reserved: u32,
}

/// [`RoutePoint::way`] on an edge.
pub const ON_EDGE: u32 = 0;
/// [`RoutePoint::way`] across a junction on which the hero has right of way.
pub const RIGHT_OF_WAY: u32 = 1;
/// [`RoutePoint::way`] across a junction on which others may have right of way.
pub const YIELDS: u32 = 2;

/// First eight bytes of the BLAKE3 hash of a SUMO id, little endian.
#[must_use]
pub fn id_hash(id: &str) -> u64 {
    let mut first = [0_u8; 8];
    first.copy_from_slice(&blake3::hash(id.as_bytes()).as_bytes()[..8]);
    u64::from_le_bytes(first)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_ids_that_begin_alike_stay_different() {
        let long = "\u{e4}".repeat(100);
        let texts = [format!("{long}1"), format!("{long}2"), long].map(|id| {
            let (bytes, len) = id_text_bytes(&id);
            let text = String::from_utf8(bytes[..len as usize].to_vec()).unwrap();
            assert!(text.ends_with(&format!("{CUT_MARK}{:016x}", id_hash(&id))), "{text}");
            text
        });
        assert!(texts[0] != texts[1] && texts[1] != texts[2]);
        let whole = "x".repeat(ID_BYTES);
        assert_eq!(id_text_bytes(&whole), (whole.as_bytes().try_into().unwrap(), 128));
    }
}
