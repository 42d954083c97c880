//! Guidance: leads a vehicle along its path as if on rails, where no driving would keep it there.
//!
//! SUMO turns vehicles within less than their turning circle, lets them change lanes while they stand, and now and then drives faster
//! than their tyres allow, with no room ahead to brake. A mirror that sees its path ahead is not set back then: its front bumper moves
//! on the path exactly, with SUMO's own heading, which is that of a body whose rear bumper is on the path as well. The distance and the
//! angle by which the vehicle was away from it when guidance began return like critically damped springs, so neither position nor
//! velocity jumps. A lane change moves the body sideways as it stands.

use ipc_schema::world::SubStep;

use super::{
    batch::road_at,
    curve::{ReferenceCurve, ReferencePoint, RoadRise},
    governor::DrivingLimits,
    hero::sub_step,
    pace::PathLimits,
    resynchronisation::ResynchronisationCause,
};
use crate::{
    models::{
        attitude::BodyLean,
        catalogue::SizedModel,
        state::{ModelState, SubStepMotion, rotate},
    },
    trig::wrap_angle,
};

/// Distance from the path at which guidance begins, metres.
const BEGIN_M: f64 = 0.6;
/// The same near a turn that is narrower than the turning circle: no driving returns the vehicle there.
const BEGIN_NARROW_M: f64 = 0.3;
/// Below this speed a lane change is not driven, m/s: SUMO changes lanes in a standing queue.
const SLOW_MPS: f64 = 1.5;
/// Rest of a lane change that a slow vehicle is led through, metres.
const BEGIN_LANE_CHANGE_M: f64 = 0.3;
/// Distance from the path below which guidance may end, metres: the governor returns it.
const END_M: f64 = 0.3;
/// Below this speed the wheels keep their angle, m/s.
const LEAST_MPS: f64 = 0.3;
/// Share of the limits that the motion at the end of guidance may need.
const END_SHARE: f64 = 0.9;
/// Rate at which a difference in heading returns, 1/s.
const RETURN_PER_S: f64 = 2.0;
/// Below this speed it returns by distance, m/s.
const RETURN_MPS: f64 = 3.0;
/// Sideways speed at the rear axle below which guidance may end, by the speed.
const END_SLIP: f64 = 0.05;

/// Limits that hold nothing back: a guided vehicle stays on its path.
pub const UNLIMITED: DrivingLimits = DrivingLimits {
    lateral_mps2: f64::INFINITY,
    curvature_per_m: f64::INFINITY,
    accel_mps2: f64::INFINITY,
    decel_mps2: f64::INFINITY,
    power_by_mass: f64::INFINITY,
    drag_by_mass_per_m: 0.0,
    rolling_mps2: 0.0,
};

/// Whether a vehicle's path turns more narrowly than it can.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NarrowTurn {
    /// Not near it.
    None,
    /// Near it: no driving returns the vehicle to the path there.
    Near,
    /// It begins here, and is far too narrow: the vehicle is led from its beginning, before it is off the path.
    Begins,
}

/// Why a vehicle has to be guided that is `away_m` from its reference and path, with `lane_change_m` of a lane change left.
#[must_use]
pub fn cause(
    state: &ModelState,
    [error_m, undriven_m]: [f64; 2],
    lane_change_m: f64,
    turn: NarrowTurn,
) -> Option<ResynchronisationCause> {
    let is_narrow = turn != NarrowTurn::None;
    let most_m = if is_narrow { BEGIN_NARROW_M } else { BEGIN_M };
    if state.speed_mps < SLOW_MPS && lane_change_m > BEGIN_LANE_CHANGE_M {
        Some(ResynchronisationCause::SlowLaneChange)
    } else if turn == NarrowTurn::Begins {
        Some(ResynchronisationCause::NarrowTurn)
    } else if error_m + undriven_m <= most_m {
        None
    } else if is_narrow {
        Some(ResynchronisationCause::NarrowTurn)
    } else if undriven_m > error_m {
        Some(ResynchronisationCause::LeftPath)
    } else {
        Some(ResynchronisationCause::TrackingError)
    }
}

/// True if a guided vehicle `away_m` from its path, lane changes included, can drive on by itself.
#[must_use]
pub fn ends(state: &ModelState, away_m: f64, is_narrow: bool, limits: &PathLimits) -> bool {
    let [turn, speed, slip] = [state.yaw_rate_radps.abs(), state.speed_mps, state.lateral_mps.abs()];
    away_m < END_M
        && !is_narrow
        && speed >= 0.0
        && slip <= END_SLIP * speed
        && turn <= END_SHARE * limits.driving.curvature_per_m * speed
        && turn * speed <= END_SHARE * limits.driving.lateral_mps2
}

/// The path of a guided vehicle over one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GuidedPath {
    /// Where its front bumper should be, without the rest of a lane change.
    pub curve: ReferenceCurve,
    /// The rest of a lane change.
    pub sideways: ReferenceCurve,
    /// SUMO's heading at the start of the tick and its rate, rad and rad/s.
    pub heading: [f64; 2],
    /// Road under the front bumper.
    pub rise: RoadRise,
}

/// Leads a vehicle along `curve` in sub-steps of `dt_s`, with SUMO's heading at the start and its rate, and moves it `sideways` as it
/// stands. The leading body of an articulated vehicle turns as its front draws it instead. `turned` is by how much the vehicle's heading differs from SUMO's, and the rate. Returns, at the end, the height of the rear
/// axle above the road under the front bumper at the start, its rate, and the pitch of the road.
pub fn lead(
    state: &mut ModelState,
    turned: &mut [f64; 2],
    GuidedPath {
        curve,
        sideways,
        heading,
        rise,
    }: &GuidedPath,
    vehicle: &SizedModel,
    dt_s: f64,
    rows: &mut [SubStep],
) -> [f64; 3] {
    let front_m = vehicle.dimensions.front_m();
    let mut road = road_at(rise, front_m, 0.0);
    let origin = (*state, road[0]);
    let mut states = Vec::with_capacity(rows.len());
    for (number, row) in rows.iter_mut().enumerate() {
        let time_s = (number + 1) as f64 * dt_s;
        let road_next = road_at(rise, front_m, time_s);
        let target = curve.at(time_s);
        let pace = (target.velocity_mps[0].abs() + target.velocity_mps[1].abs()).min(RETURN_MPS) / RETURN_MPS;
        let [angle, rate] = *turned;
        let rate = rate - RETURN_PER_S * (2.0 * rate + RETURN_PER_S * angle) * pace * dt_s;
        *turned = [angle + rate * pace * dt_s, rate];
        let mut wanted = GuidedPose {
            front: target,
            shift: sideways.at(time_s),
            yaw_rad: heading[0] + heading[1] * time_s + turned[0],
            yaw_rate_radps: heading[1] + turned[1] * pace,
        };
        if vehicle.trailing.count() > 0 {
            wanted.draw(state, front_m, dt_s);
        }
        let (next, motion) = follow(state, &wanted, vehicle, dt_s);
        let leans = [BodyLean::of(state, road[2]), BodyLean::of(&next, road_next[2])];
        *row = sub_step(&next, &motion, leans, (road_next[1] - road[1]) / dt_s, 1.0 / dt_s);
        states.push((next, road_next[0]));
        (*state, road) = (next, road_next);
    }
    let (end, end_m) = states.last().copied().unwrap_or(origin);
    for (row, (state, height_m)) in rows.iter_mut().zip(&states) {
        row.dx_m = (state.x_m - end.x_m) as f32;
        row.dy_m = (state.y_m - end.y_m) as f32;
        row.dz_m = (height_m - end_m) as f32;
        row.dyaw_rad = (state.yaw_rad - end.yaw_rad) as f32;
    }
    *state = state.settled();
    road
}

/// Where a guided vehicle has to be.
struct GuidedPose {
    /// Its front bumper, without the rest of a lane change.
    front: ReferencePoint,
    /// The rest of a lane change.
    shift: ReferencePoint,
    yaw_rad: f64,
    yaw_rate_radps: f64,
}

impl GuidedPose {
    /// Turns the body as if it was drawn by its front: SUMO's heading is that of all bodies of the vehicle in one line.
    fn draw(&mut self, state: &ModelState, front_m: f64, dt_s: f64) {
        let [x, y] = [0, 1].map(|axis: usize| self.front.position_m[axis] + self.shift.position_m[axis]);
        let (ahead_m, aside_m) = (x - state.x_m, y - state.y_m);
        // A body without a rod does not turn.
        let turn_rad = match front_m > 0.0 {
            true => wrap_angle(libm::atan2(aside_m, ahead_m) - state.yaw_rad),
            false => 0.0,
        };
        self.yaw_rad = state.yaw_rad + turn_rad;
        self.yaw_rate_radps = turn_rad / dt_s;
    }
}

/// One sub-step, at the end of which the vehicle has the wanted pose.
fn follow(state: &ModelState, wanted: &GuidedPose, vehicle: &SizedModel, dt_s: f64) -> (ModelState, SubStepMotion) {
    let front_m = vehicle.dimensions.front_m();
    let turn_rad = wrap_angle(wanted.yaw_rad - state.yaw_rad);
    let (sin, cos) = libm::sincos(wanted.yaw_rad);
    let velocity = [0, 1].map(|axis: usize| wanted.front.velocity_mps[axis] + wanted.shift.velocity_mps[axis]);
    let position = [0, 1].map(|axis: usize| wanted.front.position_m[axis] + wanted.shift.position_m[axis]);
    let speed_mps = velocity[0] * cos + velocity[1] * sin;
    let lateral_mps = velocity[1] * cos - velocity[0] * sin - front_m * wanted.yaw_rate_radps;
    // The change of the rear axle's velocity, in the axes half-way.
    let before = rotate(state.heading, state.speed_mps, state.lateral_mps);
    let after = rotate([cos, sin], speed_mps, lateral_mps);
    let change = [0, 1].map(|axis: usize| (after[axis] - before[axis]) / dt_s);
    let (sin_half, cos_half) = libm::sincos(0.5 * turn_rad);
    let half_way = rotate(state.heading, cos_half, sin_half);
    let motion = SubStepMotion {
        accel_level_mps2: [
            change[0] * half_way[0] + change[1] * half_way[1],
            change[1] * half_way[0] - change[0] * half_way[1],
        ],
        yaw_rate_radps: turn_rad / dt_s,
    };
    let (most_rad, wheelbase_m) = (vehicle.model.max_road_wheel_angle_rad(), vehicle.dimensions.wheelbase_m);
    let angle = match speed_mps > LEAST_MPS {
        true => libm::atan(wheelbase_m * wanted.yaw_rate_radps / speed_mps).clamp(-most_rad, most_rad),
        false => state.road_wheel_angle_rad,
    };
    let [roll, pitch] = vehicle.model.lean_after(state, motion.accel_level_mps2);
    let next = ModelState {
        x_m: position[0] - front_m * cos,
        y_m: position[1] - front_m * sin,
        yaw_rad: state.yaw_rad + turn_rad,
        heading: [cos, sin],
        speed_mps,
        accel_mps2: (speed_mps - state.speed_mps) / dt_s,
        road_wheel_angle_rad: angle,
        lateral_mps,
        yaw_rate_radps: wanted.yaw_rate_radps,
        roll,
        pitch,
    };
    (next, motion)
}
