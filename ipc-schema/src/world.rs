//! `world`: every road user after `sim-core` has moved it.

use bytemuck::{Pod, Zeroable};

use crate::{block::Section, section::payload_layout, traffic::Kind};

/// The pose was set instead of reached by motion: insertion, teleport or resynchronisation.
pub const RESYNCHRONISED: u32 = 1;
/// First tick of this road user in the episode.
pub const APPEARED: u32 = 1 << 1;
/// It touches an object that it did not touch in the tick before.
pub const COLLIDED: u32 = 1 << 2;
/// A hero has left the road surface: its episode ends.
pub const OFF_ROAD: u32 = 1 << 3;
/// A hero has reached the end of its route: its episode ends.
pub const ARRIVED: u32 = 1 << 4;
/// A hero has reached its time limit: its episode is cut.
pub const TIME_LIMIT: u32 = 1 << 5;
/// The action for this tick was refused; the last valid one was held.
pub const ACTION_REFUSED: u32 = 1 << 6;

/// The front bumper of a hero has crossed a stop line whose signal is red: its episode ends.
pub const RED_LIGHT: u32 = 1 << 7;
/// A hero drives against the direction of the lane it is on: its episode ends.
pub const AGAINST_TRAFFIC: u32 = 1 << 8;
/// It is led along its path as if on rails, because no driving would keep it there.
pub const GUIDED: u32 = 1 << 9;
/// Bit of [`VehicleState::flags`]: the hero has stood for `task.blocked_s`, and its trajectory ends.
pub const BLOCKED: u32 = 1 << 10;

/// Place of the first bit that names a suite of [`crate::config::Config::suites`]: that of suite *n* is set if class, type, id and share
/// let the vehicle carry it. Bits of flags are below.
pub const SUITES_SHIFT: u32 = 16;

/// First bit of [`VehicleState::vehicle`] that numbers the bodies of an articulated vehicle. The bits below are the dense index of the
/// vehicle, those from here on the place of a trailing body behind its leading one, from 1 on.
pub const BODY_SHIFT: u32 = 25;
/// Most trailing bodies of a vehicle: the two highest bits of an index name static objects and carriers beside the road.
pub const MOST_TRAILING: u32 = 31;

/// Index of the trailing body `place` (from 1 on) of a vehicle.
#[must_use]
pub const fn trailing_index(vehicle: u32, place: u32) -> u32 {
    vehicle | place << BODY_SHIFT
}

/// Dense index of the vehicle that a body belongs to.
#[must_use]
pub const fn vehicle_of(body: u32) -> u32 {
    body & ((1 << BODY_SHIFT) - 1)
}

/// The road users among the states of a `world` message: those before the trailing bodies.
#[must_use]
pub fn road_users_of(states: &[VehicleState]) -> &[VehicleState] {
    &states[..states.partition_point(|state| state.kind != Kind::Trailing as u32)]
}

/// Trailing bodies that a `world` message of `road_users` has room for. The bodies of the last vehicles are left out beyond that.
#[must_use]
pub const fn most_trailing(road_users: usize) -> usize {
    road_users / 2 + 32
}

/// One road user at the end of a tick, or a trailing body of one.
///
/// World frame: metres in the net's projected coordinates, x east, y north, z up. Body frame: x forward, y left, z up,
/// origin at the centre of the rear axle on the ground (persons: their centre on the ground; carriages and vehicles on rails: midway
/// between the bogies).
///
/// An articulated vehicle is its leading body, and the size is that body's. Each trailing body is a state of its own with the kind
/// [`crate::traffic::Kind::Trailing`], the hash of its vehicle and an index by [`trailing_index`]. Its origin is its axle, or midway
/// between its bogies. It moved evenly through the tick, so its velocities are means over the tick. It has no acceleration, wheel angle,
/// tracking error or sensors; signals and the flags [`RESYNCHRONISED`] and [`APPEARED`] are those of its vehicle.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct VehicleState {
    /// Rear-axle centre, x, world, metres.
    pub x_m: f64,
    /// Rear-axle centre, y, world, metres.
    pub y_m: f64,
    /// Rear-axle centre, z, world, metres.
    pub z_m: f64,
    /// Heading, counter-clockwise from east, radians in (-π, π].
    pub yaw_rad: f64,
    /// Hash of SUMO's id.
    pub id_hash: u64,
    /// Roll, positive to the right side down, radians.
    pub roll_rad: f32,
    /// Pitch, positive nose up, radians.
    pub pitch_rad: f32,
    /// Velocity of the origin in the body frame, m/s.
    pub velocity_body_mps: [f32; 3],
    /// Kinematic acceleration of the origin in the body frame (no gravity), mean over the last sub-step, m/s².
    pub accel_body_mps2: [f32; 3],
    /// Angular rate in the body frame, mean over the last sub-step, rad/s.
    pub angular_rate_body_radps: [f32; 3],
    /// Road-wheel steering angle, positive to the left, radians.
    pub road_wheel_angle_rad: f32,
    /// Reference minus moved front bumper, across the heading, positive to the left, metres.
    pub tracking_lateral_m: f32,
    /// Reference minus moved front bumper, along the heading, positive ahead, metres.
    pub tracking_longitudinal_m: f32,
    /// Bumper to bumper, metres.
    pub length_m: f32,
    /// Metres.
    pub width_m: f32,
    /// Metres.
    pub height_m: f32,
    /// Rear axle to front axle, metres. Of a trailing body: axle to hitch, or half the distance of the bogies.
    pub wheelbase_m: f32,
    /// Rear axle to the rear end of the body, metres; negative if the body ends before the axle, as a tractor's cab does.
    pub rear_overhang_m: f32,
    /// From the front to the end of the last body in a straight line, metres: SUMO's length.
    pub whole_length_m: f32,
    /// Trailing bodies behind this one that belong to the same vehicle and are in the message.
    pub trailing: u16,
    /// SUMO's vehicle class, as the place in [`crate::traffic::VEHICLE_CLASSES`]; of a trailing body that of its vehicle.
    pub class: u16,
    /// Dense index within the episode; of a trailing body [`trailing_index`].
    pub vehicle: u32,
    /// A [`crate::traffic::Kind`].
    pub kind: u32,
    /// SUMO's signal bits.
    pub signals: u32,
    /// Bits [`RESYNCHRONISED`], [`APPEARED`], [`COLLIDED`], [`OFF_ROAD`], [`ARRIVED`], [`TIME_LIMIT`], [`ACTION_REFUSED`],
    /// [`RED_LIGHT`], [`AGAINST_TRAFFIC`], [`GUIDED`], [`BLOCKED`], and from [`SUITES_SHIFT`] on the suites that it may carry.
    pub flags: u32,
    /// Distance between the reference and SUMO's own path (lane changes spread in time, kinks rounded), metres.
    pub reference_offset_m: f32,
    /// Steering-wheel angle by road-wheel angle of its parameter set; 0 for persons.
    pub steering_ratio: f32,
    /// Longitudinal slip of the rear wheels, `(wheel speed − speed) / speed`: positive when they drive, negative when they brake; 0
    /// without `speed_steering.wheel_slip`, without tyres, and for road users that carry no sensors.
    pub rear_wheel_slip: f32,
}

/// Motion at one sub-step; the last sub-step of a tick coincides with its [`VehicleState`].
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct SubStep {
    /// x minus the x of the tick's [`VehicleState`], metres.
    pub dx_m: f32,
    /// y minus the y of the tick's [`VehicleState`], metres.
    pub dy_m: f32,
    /// z minus the z of the tick's [`VehicleState`], metres.
    pub dz_m: f32,
    /// Heading minus the heading of the tick's [`VehicleState`], radians.
    pub dyaw_rad: f32,
    /// Roll, positive to the right side down, radians.
    pub roll_rad: f32,
    /// Pitch, positive nose up, radians.
    pub pitch_rad: f32,
    /// Speed of the rear axle along the heading, in the horizontal plane, m/s.
    pub speed_mps: f32,
    /// Speed of the rear axle to the left of the heading, in the horizontal plane, m/s.
    pub lateral_speed_mps: f32,
    /// Kinematic acceleration of the origin in the body frame, mean over the sub-step, m/s².
    pub accel_body_mps2: [f32; 3],
    /// Angular rate in the body frame, mean over the sub-step, rad/s.
    pub angular_rate_body_radps: [f32; 3],
    /// Road-wheel steering angle, radians.
    pub road_wheel_angle_rad: f32,
    /// Zero.
    pub reserved: u32,
}

/// Bits that end a hero's episode; [`TIME_LIMIT`] alone cuts it, the others terminate it.
pub const HERO_ENDS: u32 = COLLIDED | OFF_ROAD | ARRIVED | TIME_LIMIT | RED_LIGHT | AGAINST_TRAFFIC | BLOCKED;

/// Distances ahead, along the route, of the route points that a hero sees, metres.
pub const ROUTE_AHEAD_M: [f64; 4] = [5.0, 10.0, 20.0, 40.0];
/// Distance at which a hero sees road users and signals on its route, metres.
pub const SIGHT_M: f64 = 100.0;

/// Distance within which a hero senses road users around it, metres.
pub const SENSING_M: f64 = 50.0;
/// Nearest road users that a hero senses.
pub const SENSED_USERS: usize = 8;
/// Numbers for each of them: x and y of its middle (m), cosine and sine of its heading, its velocity forward and to the left (m/s), all in
/// the hero's body frame; length and width (m). Then its encounter with the hero's way, if it keeps its speed and yaw rate: distance along
/// the route from the front bumper to the first place where it will be in the way (m, [`SENSING_M`] for none), the times at which the hero
/// reaches that place at its speed, at which the road user's front is in the middle of the way and at which its rear has left it (s, at most
/// [`LONGEST_GAP_S`], which also stands for none). Last 1 if it indicates a turn to the left, -1 to the right, 0 neither. Without a road
/// user: both coordinates and the distance [`SENSING_M`], the times [`LONGEST_GAP_S`], all others 0.
pub const USER_COLUMNS: usize = 13;
/// Next junctions of its route that a hero sees.
pub const SEEN_CONFLICTS: usize = 3;
/// Numbers for each of them: distance from the front bumper to its stop line (m), 1 if the hero has right of way there and 0 if not, and the
/// time until the next rival reaches the hero's way across it (s). Without a junction: [`SIGHT_M`], 1, [`LONGEST_GAP_S`].
pub const CONFLICT_COLUMNS: usize = 3;
/// Time to a rival's arrival beyond which there is none, seconds.
pub const LONGEST_GAP_S: f64 = 10.0;
/// Next traffic lights of its route that a hero sees.
pub const SEEN_SIGNALS: usize = 2;
/// Numbers for each of them: distance from the front bumper to its stop line (m), and 1 for green, 0 for red; yellow begins at ½ and falls
/// by 0.15 a second to 0.05. Without a traffic light: [`SIGHT_M`], 1.
pub const SIGNAL_COLUMNS: usize = 2;
/// Nearest persons beside its route that a hero sees.
pub const SEEN_PERSONS: usize = 2;
/// Numbers for each of them: distance along the route from the front bumper (m), to the left of the route (m), and speed to the left (m/s).
/// Without a person: [`SENSING_M`], [`PERSON_BESIDE_M`], 0.
pub const PERSON_COLUMNS: usize = 3;
/// Distance beside its route within which a hero watches persons, metres.
pub const PERSON_BESIDE_M: f64 = 10.0;
/// Numbers of [`HeroView::around`]: road users, junctions, traffic lights, persons.
pub const AROUND: usize = SENSED_USERS * USER_COLUMNS
    + SEEN_CONFLICTS * CONFLICT_COLUMNS
    + SEEN_SIGNALS * SIGNAL_COLUMNS
    + SEEN_PERSONS * PERSON_COLUMNS;

/// A hero's view of its route and of the traffic on it, at the end of a tick.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct HeroView {
    /// Points of its route [`ROUTE_AHEAD_M`] ahead, forward and left of the rear axle, body frame, metres.
    pub route_m: [[f32; 2]; 4],
    /// Highest speed at its position from which braking with 2 m/s² keeps the limits there and ahead, m/s.
    pub speed_limit_mps: f32,
    /// Offset from the rear axle to the nearest point of its route, positive to the left, metres.
    pub route_offset_m: f32,
    /// Distance along the route from the front bumper to its end, metres.
    pub route_left_m: f32,
    /// Gap between its front bumper and the next road user on its route, metres, at most [`SIGHT_M`].
    pub leader_gap_m: f32,
    /// Speed of that road user along the route, m/s; 0 if there is none.
    pub leader_speed_mps: f32,
    /// Distance from the front bumper to the next stop line with a signal that is not green, metres, at most [`SIGHT_M`].
    pub signal_gap_m: f32,
    /// Acceleration that SUMO's own driver would have chosen in the last step, m/s²; 0 if it was not asked.
    pub advised_accel_mps2: f32,
    /// Dense index of the hero within the episode.
    pub vehicle: u32,
    /// What is around it: [`SENSED_USERS`] road users, [`SEEN_CONFLICTS`] junctions, [`SEEN_SIGNALS`] traffic lights and [`SEEN_PERSONS`]
    /// persons, the nearest of each first.
    pub around: [f32; AROUND],
}

impl HeroView {
    /// Nothing is in sight.
    pub const NONE: Self = Self {
        route_m: [[0.0; 2]; 4],
        speed_limit_mps: 0.0,
        route_offset_m: 0.0,
        route_left_m: 0.0,
        leader_gap_m: 0.0,
        leader_speed_mps: 0.0,
        signal_gap_m: 0.0,
        advised_accel_mps2: 0.0,
        vehicle: 0,
        around: [0.0; AROUND],
    };
}

impl Default for HeroView {
    fn default() -> Self {
        Self::NONE
    }
}

payload_layout! {
    /// Layout of a `world` message: road users by ascending index and behind them trailing bodies by vehicle and place, the sub-steps of
    /// the road users one after the other, and the views of the heroes by ascending index.
    WorldLayout(road_users, sub_steps_each, hero_count, bodies) {
        /// `VehicleState [bodies]`.
        states: VehicleState, [bodies];
        /// `SubStep [road_users, sub_steps]`.
        sub_steps: SubStep, [road_users, sub_steps_each];
        /// `HeroView [heroes]`.
        heroes: HeroView, [hero_count];
    }
}

impl WorldLayout {
    /// Layout for `count` road users with `sub_steps` samples each, none of them a hero or articulated.
    #[must_use]
    pub fn new(count: usize, sub_steps: usize) -> Self {
        Self::sized(count, sub_steps, 0, count)
    }

    /// Layout for `count` road users with `sub_steps` samples each, `heroes` of them heroes, and `trailing` bodies behind them.
    #[must_use]
    pub fn with_heroes(count: usize, sub_steps: usize, heroes: usize, trailing: usize) -> Self {
        Self::sized(count, sub_steps, heroes, count.saturating_add(trailing))
    }

    /// The first of `states`: road users without trailing bodies.
    #[must_use]
    pub fn road_users(&self) -> Section {
        let len = (self.shape[0] as usize).saturating_mul(size_of::<VehicleState>());
        Section {
            len: len.min(self.states.len),
            ..self.states
        }
    }
}
