//! Moving targets: road users and the path of each during the tick.

use ipc_schema::{
    pointcloud::Tag,
    traffic::Kind,
    world::{APPEARED, RESYNCHRONISED, SubStep, VehicleState, road_users_of},
};

use super::solids::INTEREST;

/// Narrower vehicles count as two-wheelers, metres: motorcycles are up to 0.95 m wide, the smallest cars 1.4 m.
const TWO_WHEELER_M: f32 = 1.1;

/// Position and attitude of a body.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(in crate::sensors) struct Pose {
    pub(in crate::sensors) position_m: [f64; 3],
    /// Roll (right side down), pitch (nose up), heading (counter-clockwise from east).
    pub(in crate::sensors) attitude_rad: [f64; 3],
}

/// Pose at the end of a sub-step: x, y, z and heading relative to the end of the tick, then absolute roll and pitch.
type Knot = [f32; 6];

/// A time within a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::sensors) struct TickMoment {
    sub_step: usize,
    /// Share of the sub-step, 0 … 1.
    at: f64,
    /// Length of a sub-step, seconds.
    dt_s: f64,
}

/// A road user.
#[derive(Debug, Clone, Copy)]
pub(in crate::sensors) struct MovingTarget {
    pub(in crate::sensors) end: Pose,
    /// Extent from the origin: rear, front, half the width, height.
    pub(in crate::sensors) rear_m: f64,
    pub(in crate::sensors) front_m: f64,
    pub(in crate::sensors) half_width_m: f64,
    pub(in crate::sensors) height_m: f64,
    pub(in crate::sensors) object: u32,
    pub(in crate::sensors) word: u32,
    pub(in crate::sensors) is_person: bool,
    /// SUMO's vehicle class, by its number.
    pub(in crate::sensors) class: u16,
    pub(in crate::sensors) id_hash: u64,
    /// Keeps its pose for the whole tick, or its motion is not known.
    is_still: bool,
    /// Rates of a knot at the begin of the first sub-step, per second.
    rates: Knot,
    /// Upper bound of the distance of its origin from the end of the tick, metres.
    pub(in crate::sensors) travel_m: f64,
    /// Radius of the circle about its footprint, from the centre, metres.
    pub(in crate::sensors) radius_m: f64,
}

/// All moving targets of a tick, for all LIDARs.
#[derive(Debug, Clone, Default)]
pub struct Targets {
    pub(in crate::sensors) movers: Vec<MovingTarget>,
    /// How many of `movers` are bodies of road users; those behind them are carriers beside the road, which nothing sees.
    pub(in crate::sensors) road_users: usize,
    /// Poses at the ends of sub-steps, road user by road user.
    knots: Vec<Knot>,
    pub(in crate::sensors) sub_steps: usize,
    /// Length of a tick, seconds; 0 where trailing bodies stand still.
    tick_s: f64,
    /// Centre and reach of each road user, for the test of distance.
    pub(in crate::sensors) near: Vec<[f64; 3]>,
}

impl Targets {
    /// No targets, in ticks of this length: trailing bodies move through them.
    #[must_use]
    pub fn in_ticks_of(tick_s: f64) -> Self {
        Self {
            tick_s,
            ..Self::default()
        }
    }

    /// Replaces the targets by those of a tick: `states` and `sub_steps[row * k + i]`, as in a `world` message. Trailing bodies,
    /// behind the road users, have no sub-steps: they move evenly through the tick. With `k` = 0 nothing moves.
    pub fn update(&mut self, states: &[VehicleState], sub_steps: &[SubStep], k: usize) {
        let road_users = road_users_of(states).len();
        let k = if sub_steps.len() < road_users * k { 0 } else { k };
        self.sub_steps = k;
        self.knots.clear();
        self.knots.extend(sub_steps[..road_users * k].iter().map(knot));
        self.movers.clear();
        self.near.clear();
        let mut even: Vec<SubStep> = Vec::new();
        for (row, state) in states.iter().enumerate() {
            let steps = match row < road_users {
                true => &sub_steps[row * k..(row + 1) * k],
                false => {
                    even.clear();
                    even.extend(even_steps(state, k, self.tick_s));
                    self.knots.extend(even.iter().map(knot));
                    &even[..]
                }
            };
            let mover = MovingTarget::new(state, steps);
            let [x, y] = mover.centre_m(&mover.end);
            self.near.push([x, y, mover.radius_m + mover.travel_m]);
            self.movers.push(mover);
        }
        self.road_users = states.len();
    }

    /// Adds carriers of sensors that stand still and that nothing sees, behind the road users of the last [`Targets::update`].
    pub fn add_fixed(&mut self, states: &[VehicleState]) {
        self.movers
            .extend(states.iter().map(|state| MovingTarget::new(state, &[])));
    }

    /// Replaces the targets by `other`, in the memory that there is.
    pub(in crate::sensors) fn copy_from(&mut self, other: &Self) {
        let Self {
            movers,
            road_users,
            knots,
            sub_steps,
            tick_s,
            near,
        } = other;
        self.movers.clone_from(movers);
        self.knots.clone_from(knots);
        self.near.clone_from(near);
        (self.road_users, self.sub_steps, self.tick_s) = (*road_users, *sub_steps, *tick_s);
    }

    /// The moment `before_end_s` before the end of the tick, which takes `tick_s`.
    pub(in crate::sensors) fn moment(&self, before_end_s: f64, tick_s: f64) -> TickMoment {
        let count = self.sub_steps.max(1);
        let dt_s = tick_s / count as f64;
        let since_begin = ((tick_s - before_end_s) / dt_s).max(0.0);
        let sub_step = (since_begin as usize).min(count - 1);
        TickMoment {
            sub_step,
            at: (since_begin - sub_step as f64).min(1.0),
            dt_s,
        }
    }

    /// Pose of a road user at a moment of the tick.
    #[inline(always)]
    pub(in crate::sensors) fn pose_at(&self, row: usize, moment: &TickMoment) -> Pose {
        self.pose(row, moment.sub_step, moment.at, moment.dt_s)
    }

    /// Upper bound of the distance of a road user's origin from its place at the end of the tick, which takes `tick_s`, metres.
    pub(in crate::sensors) fn most_shift_m(&self, row: usize, tick_s: f64) -> f64 {
        let mover = &self.movers[row];
        if mover.is_still {
            return 0.0;
        }
        let dt_s = tick_s / self.sub_steps.max(1) as f64;
        let knots = &self.knots[row * self.sub_steps..(row + 1) * self.sub_steps];
        let begin: [f64; 3] = std::array::from_fn(|i| f64::from(knots[0][i]) - f64::from(mover.rates[i]) * dt_s);
        let places = knots.iter().map(|knot| [0, 1, 2].map(|i: usize| f64::from(knot[i])));
        // Between two of these places it moves straight.
        let square = std::iter::once(begin)
            .chain(places)
            .map(|[x, y, z]| x * x + y * y + z * z);
        square.fold(0.0, f64::max).sqrt()
    }

    /// Pose of a road user at share `at` (0 … 1) of a sub-step that takes `dt_s`.
    #[inline(always)]
    pub(in crate::sensors) fn pose(&self, row: usize, sub_step: usize, at: f64, dt_s: f64) -> Pose {
        let mover = &self.movers[row];
        if mover.is_still {
            return mover.end;
        }
        let knots = &self.knots[row * self.sub_steps..(row + 1) * self.sub_steps];
        let after = knots[sub_step].map(f64::from);
        let left = 1.0 - at;
        let mut knot = after;
        if sub_step == 0 {
            for (value, rate) in knot.iter_mut().zip(mover.rates) {
                *value -= f64::from(rate) * dt_s * left;
            }
        } else {
            for (value, before) in knot.iter_mut().zip(knots[sub_step - 1]) {
                *value += (f64::from(before) - *value) * left;
            }
        }
        let end = &mover.end;
        Pose {
            position_m: std::array::from_fn(|axis| end.position_m[axis] + knot[axis]),
            attitude_rad: [knot[4], knot[5], end.attitude_rad[2] + knot[3]],
        }
    }

    /// True if the road user keeps its pose for the whole tick.
    pub(in crate::sensors) fn is_still(&self, row: usize) -> bool {
        self.movers[row].is_still
    }

    /// True if a road user is upright all the tick.
    pub(in crate::sensors) fn is_upright(&self, row: usize) -> bool {
        let mover = &self.movers[row];
        let [roll, pitch, _] = mover.end.attitude_rad;
        if roll != 0.0 || pitch != 0.0 || mover.is_still {
            return roll == 0.0 && pitch == 0.0;
        }
        let knots = &self.knots[row * self.sub_steps..(row + 1) * self.sub_steps];
        let level = |knot: &Knot| knot[4] == 0.0 && knot[5] == 0.0;
        knots.iter().all(level) && mover.rates[4] == 0.0 && mover.rates[5] == 0.0
    }
}

#[inline(always)]
fn knot(step: &SubStep) -> Knot {
    [
        step.dx_m,
        step.dy_m,
        step.dz_m,
        step.dyaw_rad,
        step.roll_rad,
        step.pitch_rad,
    ]
}

/// The sub-steps of a body that moves evenly through a tick, as its state says.
fn even_steps(state: &VehicleState, k: usize, tick_s: f64) -> impl Iterator<Item = SubStep> {
    let [along, left, up] = state.velocity_body_mps.map(f64::from);
    let [_, _, yaw_rate] = state.angular_rate_body_radps.map(f64::from);
    let (sin, cos) = libm::sincos(state.yaw_rad);
    let rates = [along * cos - left * sin, along * sin + left * cos, up, yaw_rate];
    let (roll_rad, pitch_rad) = (state.roll_rad, state.pitch_rad);
    (1..=k).map(move |number| {
        let left_s = tick_s * (k - number) as f64 / k as f64;
        let [dx_m, dy_m, dz_m, dyaw_rad] = rates.map(|rate| (-rate * left_s) as f32);
        // Velocities in the axes of this time, which turn with the body.
        let (sin, cos) = libm::sincos(state.yaw_rad + f64::from(dyaw_rad));
        SubStep {
            dx_m,
            dy_m,
            dz_m,
            dyaw_rad,
            roll_rad,
            pitch_rad,
            speed_mps: (rates[0] * cos + rates[1] * sin) as f32,
            lateral_speed_mps: (rates[1] * cos - rates[0] * sin) as f32,
            angular_rate_body_radps: [0.0, 0.0, yaw_rate as f32],
            ..SubStep::default()
        }
    })
}

impl MovingTarget {
    fn new(state: &VehicleState, steps: &[SubStep]) -> Self {
        let is_person = state.kind == Kind::Person as u32;
        let tag = match is_person {
            true => Tag::Person,
            false if state.width_m < TWO_WHEELER_M => Tag::TwoWheeler,
            false => Tag::Vehicle,
        };
        let [length_m, width_m, rear_m] = [state.length_m, state.width_m, state.rear_overhang_m].map(f64::from);
        let mut mover = Self {
            end: Pose {
                position_m: [state.x_m, state.y_m, state.z_m],
                attitude_rad: [f64::from(state.roll_rad), f64::from(state.pitch_rad), state.yaw_rad],
            },
            rear_m: -rear_m,
            front_m: length_m - rear_m,
            half_width_m: 0.5 * width_m,
            height_m: f64::from(state.height_m),
            object: state.vehicle,
            word: tag as u32 | INTEREST,
            is_person,
            class: state.class,
            id_hash: state.id_hash,
            is_still: steps.is_empty() || state.flags & (RESYNCHRONISED | APPEARED) != 0,
            rates: [0.0; 6],
            travel_m: 0.0,
            radius_m: 0.5 * libm::hypot(length_m, width_m),
        };
        if is_person {
            let radius_m = 0.5 * length_m.max(width_m);
            (mover.rear_m, mover.front_m) = (-radius_m, radius_m);
            (mover.half_width_m, mover.radius_m) = (radius_m, radius_m);
        }
        if !mover.is_still {
            mover.start(state.yaw_rad, steps);
        }
        mover
    }

    /// Sets the rates during the first sub-step, from its velocities, and the bound of the travelled distance.
    fn start(&mut self, yaw_rad: f64, steps: &[SubStep]) {
        let first = &steps[0];
        let yaw_rad = yaw_rad + f64::from(first.dyaw_rad);
        let (sin, cos) = libm::sincos(yaw_rad);
        let [along, left] = [first.speed_mps, first.lateral_speed_mps].map(f64::from);
        let [roll_rate, pitch_rate, yaw_rate] = first.angular_rate_body_radps;
        let climb = along * libm::tan(f64::from(first.pitch_rad));
        let climb = if first.dz_m == 0.0 { 0.0 } else { climb as f32 };
        self.rates = [
            (along * cos - left * sin) as f32,
            (along * sin + left * cos) as f32,
            climb,
            yaw_rate,
            roll_rate,
            -pitch_rate,
        ];
        let far = |step: &SubStep| f64::from(step.dx_m).abs().max(f64::from(step.dy_m).abs());
        let travelled = steps.iter().map(far).fold(0.0, f64::max) * std::f64::consts::SQRT_2;
        // The first sub-step starts one sub-step further back: of ten as much again and a half, of one by speed and a second.
        let more = match steps.len() {
            1 => libm::hypot(along, left),
            count => 1.5 * travelled / (count - 1) as f64,
        };
        self.travel_m = travelled + more;
    }

    /// Centre of its footprint in a pose.
    #[inline(always)]
    pub(in crate::sensors) fn centre_m(&self, pose: &Pose) -> [f64; 2] {
        if self.is_person {
            return [pose.position_m[0], pose.position_m[1]];
        }
        let (sin, cos) = libm::sincos(pose.attitude_rad[2]);
        let ahead_m = 0.5 * (self.rear_m + self.front_m);
        [pose.position_m[0] + ahead_m * cos, pose.position_m[1] + ahead_m * sin]
    }

    /// Corners, counter-clockwise from the front left.
    #[inline(always)]
    pub(in crate::sensors) fn corners_m(&self, pose: &Pose) -> [[f64; 2]; 4] {
        let (sin, cos) = libm::sincos(pose.attitude_rad[2]);
        let [x, y, _] = pose.position_m;
        let (front, rear, half) = (self.front_m, self.rear_m, self.half_width_m);
        [[front, half], [rear, half], [rear, -half], [front, -half]]
            .map(|[ahead, left]| [x + ahead * cos - left * sin, y + ahead * sin + left * cos])
    }
}
