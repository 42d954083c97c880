//! Many vehicles at once: the tracker and one model on [`LANES`] vehicles side by side, for all sub-steps of a tick.
//!
//! One vehicle alone is a chain of some 300 dependent operations in each sub-step, which the processor waits for: 0.7 µs per
//! tick of 10 sub-steps, measured. Side by side they fill its vector units. The functions are those of [`crate::tracking`],
//! [`crate::vehicle`], [`crate::dynamic`] and [`crate::attitude`], no operation is fused or reordered, so every vehicle gets the
//! same bits as alone, on any machine.

use bytemuck::Pod;
use ipc_schema::world::SubStep;

use crate::{
    attitude::{Felt, Lean},
    curve::{Curve, Rise, Target},
    dynamic::{DynamicParams, GRAVITY_MPS2},
    governor::Ability,
    tracking::{self, Driven},
    vehicle::{Input, KinematicParams, Motion, State},
};

/// Vehicles side by side: two registers of AVX-512 or eight of SSE2 for each number.
pub const LANES: usize = 16;

/// Share of a vehicle's friction, steering and power that references use; the rest is for following them.
const LATERAL_SHARE: f64 = 0.6;
const LONGITUDINAL_SHARE: f64 = 0.85;
const POWER_SHARE: f64 = 0.8;
const CURVATURE_SHARE: f64 = 0.9;

/// Time between two demands of a driver, seconds.
const DEMAND_S: f64 = 0.02;

type Lane = [f64; LANES];
/// Numbers in a [`State`], a [`Curve`] and a [`Rise`].
const STATE: usize = size_of::<State>() / 8;
const CURVE: usize = size_of::<Curve>() / 8;
const RISE: usize = size_of::<Rise>() / 8;
/// Numbers in a [`SubStep`].
const SUB_STEP: usize = size_of::<SubStep>() / 4;

/// A model with `N` parameters that can run in lanes: free of branches.
pub trait Drive<const N: usize>: Pod {
    /// What the driver asks for to reach `target` with a front bumper `front_m` ahead of the rear axle.
    fn demand(&self, front_m: f64, state: &State, target: &Target) -> Input;
    /// The state after `dt_s`, and what moved on the way.
    fn step(&self, state: &State, input: &Input, slope_sin: f64, dt_s: f64) -> (State, Motion);
    /// What a reference may ask for.
    fn ability(&self) -> Ability;
    /// Parameters that keep the numbers of an empty lane finite.
    fn empty() -> [f64; N];
}

/// Parameters of the kinematic model.
pub const KINEMATIC: usize = size_of::<KinematicParams>() / 8;
/// Parameters of the dynamic model.
pub const DYNAMIC: usize = size_of::<DynamicParams>() / 8;

impl Drive<KINEMATIC> for KinematicParams {
    #[inline(always)]
    fn demand(&self, front_m: f64, state: &State, target: &Target) -> Input {
        tracking::demand(&Driven::new(self, front_m), state, target)
    }

    #[inline(always)]
    fn step(&self, state: &State, input: &Input, _: f64, dt_s: f64) -> (State, Motion) {
        Self::step(self, state, input, dt_s)
    }

    fn ability(&self) -> Ability {
        Ability {
            lateral_mps2: self.max_lateral_mps2,
            curvature_per_m: CURVATURE_SHARE * self.max_curvature_per_m,
            accel_mps2: self.max_accel_mps2,
            decel_mps2: self.max_decel_mps2,
            power_by_mass: f64::INFINITY,
            drag_by_mass_per_m: 0.0,
            rolling_mps2: 0.0,
        }
    }

    fn empty() -> [f64; KINEMATIC] {
        [1.0; KINEMATIC]
    }
}

impl Drive<DYNAMIC> for DynamicParams {
    #[inline(always)]
    fn demand(&self, front_m: f64, state: &State, target: &Target) -> Input {
        tracking::demand_with_tyres(self, front_m, state, target)
    }

    #[inline(always)]
    fn step(&self, state: &State, input: &Input, slope_sin: f64, dt_s: f64) -> (State, Motion) {
        Self::step(self, state, input, slope_sin, dt_s)
    }

    fn ability(&self) -> Ability {
        let friction = self.friction * GRAVITY_MPS2;
        Ability {
            lateral_mps2: LATERAL_SHARE * friction,
            curvature_per_m: CURVATURE_SHARE * self.max_curvature_per_m,
            accel_mps2: self.max_accel_mps2.min(LONGITUDINAL_SHARE * friction),
            decel_mps2: self.max_decel_mps2.min(LONGITUDINAL_SHARE * friction),
            power_by_mass: POWER_SHARE * self.max_power_by_mass,
            drag_by_mass_per_m: self.drag_by_mass_per_m,
            rolling_mps2: self.rolling_mps2,
        }
    }

    fn empty() -> [f64; DYNAMIC] {
        [0.25; DYNAMIC]
    }
}

/// Motion of all lanes over one sub-step in the order of [`SubStep`]; the first four fields count from the start of the tick.
pub type Row = [[f32; LANES]; SUB_STEP];

/// Vehicles of one model side by side.
#[derive(Debug, Clone)]
pub struct Lanes<P, const N: usize> {
    state: [Lane; STATE],
    curve: [Lane; CURVE],
    rise: [Lane; RISE],
    front_m: Lane,
    params: [Lane; N],
    /// Height of the rear axle above the front bumper's place at the start of the tick (metres), its rate (m/s), and the pitch
    /// of the road (radians).
    road: [Lane; 3],
    /// x, y, z and yaw at the start of the tick.
    origin: [Lane; 4],
    /// What the driver asks for: acceleration and road-wheel angle.
    input: [Lane; 2],
    /// What moved, one for each sub-step.
    pub rows: Vec<Row>,
    model: std::marker::PhantomData<P>,
}

#[inline(always)]
fn scatter<T: Pod, const N: usize>(lanes: &mut [Lane; N], lane: usize, value: &T) {
    let numbers: &[f64; N] = bytemuck::must_cast_ref(value);
    for (place, number) in lanes.iter_mut().zip(numbers) {
        place[lane] = *number;
    }
}

#[inline(always)]
fn gather<T: Pod, const N: usize>(lanes: &[Lane; N], lane: usize) -> T {
    bytemuck::must_cast(std::array::from_fn::<f64, N, _>(|i| lanes[i][lane]))
}

impl<P: Drive<N>, const N: usize> Lanes<P, N> {
    /// Empty lanes for `sub_steps` sub-steps.
    #[must_use]
    pub fn new(sub_steps: usize) -> Self {
        let zero = [0.0; LANES];
        let mut lanes = Self {
            state: [zero; STATE],
            curve: [zero; CURVE],
            rise: [zero; RISE],
            front_m: [1.0; LANES],
            params: P::empty().map(|value| [value; LANES]),
            road: [zero; 3],
            origin: [zero; 4],
            input: [zero; 2],
            rows: vec![[[0.0; LANES]; SUB_STEP]; sub_steps],
            model: std::marker::PhantomData,
        };
        let standing = State::new(0.0, 0.0, 0.0, 0.0);
        (0..LANES).for_each(|lane| scatter(&mut lanes.state, lane, &standing));
        lanes
    }

    /// Puts a vehicle into a lane, with its reference and the road under its front bumper, `front_m` ahead of the rear axle.
    pub fn load(&mut self, lane: usize, params: &P, state: &State, reference: (&Curve, &Rise), front_m: f64) {
        scatter(&mut self.state, lane, state);
        scatter(&mut self.curve, lane, reference.0);
        scatter(&mut self.rise, lane, reference.1);
        scatter(&mut self.params, lane, params);
        self.front_m[lane] = front_m;
    }

    /// Writes the sub-steps of the vehicle in a lane, relative to the last of them.
    pub fn write(&self, lane: usize, rows: &mut [SubStep]) {
        let Some(last) = self.rows.last() else { return };
        let end: [f32; 4] = std::array::from_fn(|i| last[i][lane]);
        for (row, moved) in rows.iter_mut().zip(&self.rows) {
            let mut numbers: [f32; SUB_STEP] = std::array::from_fn(|i| moved[i][lane]);
            numbers.iter_mut().zip(end).for_each(|(number, end)| *number -= end);
            *row = bytemuck::must_cast(numbers);
        }
    }

    /// Height of the rear axle above the front bumper's place at the start of the tick (metres), its rate (m/s), and the pitch of
    /// the road (radians), at the end of the tick.
    #[must_use]
    pub fn road(&self, lane: usize) -> [f64; 3] {
        gather(&self.road, lane)
    }

    /// The state of the vehicle in a lane.
    #[must_use]
    #[inline(always)]
    pub fn state(&self, lane: usize) -> State {
        gather(&self.state, lane)
    }

    /// The reference of the vehicle in a lane.
    #[must_use]
    #[inline(always)]
    pub fn curve(&self, lane: usize) -> Curve {
        gather(&self.curve, lane)
    }

    /// Tracks all lanes through one tick of `rows.len()` sub-steps, with the widest vectors this machine has. `meanwhile` is called
    /// with the number of each sub-step: a place to ask for the memory of the next vehicles.
    pub fn advance(&mut self, dt_s: f64, meanwhile: &impl Fn(usize)) {
        #[cfg(target_arch = "x86_64")]
        #[expect(
            unsafe_code,
            reason = "calls of functions compiled for more than the baseline processor: twice as fast"
        )]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has been asked in this very condition and has the feature.
                return unsafe { self.advance_avx512(dt_s, meanwhile) };
            }
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: as above.
                return unsafe { self.advance_avx2(dt_s, meanwhile) };
            }
        }
        self.advance_here(dt_s, meanwhile);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    fn advance_avx512(&mut self, dt_s: f64, meanwhile: &impl Fn(usize)) {
        self.advance_here(dt_s, meanwhile);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn advance_avx2(&mut self, dt_s: f64, meanwhile: &impl Fn(usize)) {
        self.advance_here(dt_s, meanwhile);
    }

    /// The same code for every processor: compiled anew into each caller.
    #[inline(always)]
    fn advance_here(&mut self, dt_s: f64, meanwhile: &impl Fn(usize)) {
        let mut rows = std::mem::take(&mut self.rows);
        self.start_road();
        let between = between_demands(dt_s);
        for (index, row) in rows.iter_mut().enumerate() {
            let time_s = index as f64 * dt_s;
            if index.is_multiple_of(between) {
                self.ask(time_s);
            }
            self.sub_step(time_s, dt_s, row);
            meanwhile(index);
        }
        self.rows = rows;
    }

    /// The road under the rear axle at the start of the tick.
    #[inline(always)]
    fn start_road(&mut self) {
        for lane in 0..LANES {
            let road = road_at(&gather(&self.rise, lane), self.front_m[lane], 0.0);
            scatter(&mut self.road, lane, &road);
            let state: State = gather(&self.state, lane);
            scatter(&mut self.origin, lane, &[state.x_m, state.y_m, road[0], state.yaw_rad]);
        }
    }

    /// What the drivers of all lanes ask for.
    #[inline(always)]
    fn ask(&mut self, time_s: f64) {
        for lane in 0..LANES {
            let (state, params): (State, P) = (gather(&self.state, lane), gather(&self.params, lane));
            let input = params.demand(self.front_m[lane], &state, &self.curve(lane).at(time_s));
            scatter(&mut self.input, lane, &[input.accel_mps2, input.road_wheel_angle_rad]);
        }
    }

    /// One sub-step of all lanes: the loop that the compiler turns into vector instructions.
    #[inline(always)]
    fn sub_step(&mut self, time_s: f64, dt_s: f64, row: &mut Row) {
        for lane in 0..LANES {
            let state: State = gather(&self.state, lane);
            let params: P = gather(&self.params, lane);
            let front_m = self.front_m[lane];
            let road: [f64; 3] = gather(&self.road, lane);
            let [accel_mps2, road_wheel_angle_rad] = gather(&self.input, lane);
            let input = Input {
                accel_mps2,
                road_wheel_angle_rad,
            };
            let (next, motion) = params.step(&state, &input, road[2], dt_s);
            let road_next = road_at(&gather(&self.rise, lane), front_m, time_s + dt_s);
            let leans = [Lean::of(&state, road[2]), Lean::of(&next, road_next[2])];
            let rate = 1.0 / dt_s;
            let felt = Felt::new(leans, &motion, (road_next[1] - road[1]) * rate, rate);
            scatter(&mut self.state, lane, &next);
            scatter(&mut self.road, lane, &road_next);
            let origin: [f64; 4] = gather(&self.origin, lane);
            let numbers = [
                next.x_m - origin[0],
                next.y_m - origin[1],
                road_next[0] - origin[2],
                next.yaw_rad - origin[3],
                leans[1].roll_rad,
                leans[1].pitch_rad,
                next.speed_mps,
                next.lateral_mps,
                felt.accel_mps2[0],
                felt.accel_mps2[1],
                felt.accel_mps2[2],
                felt.rate_radps[0],
                felt.rate_radps[1],
                felt.rate_radps[2],
                next.road_wheel_angle_rad,
                0.0,
            ];
            for (field, number) in row.iter_mut().zip(numbers) {
                field[lane] = number as f32;
            }
        }
    }
}

/// Sub-steps of `dt_s` from one demand of the drivers to the next: they look 50 times a second, as often as a steering actuator
/// that follows at 20/s needs.
fn between_demands(dt_s: f64) -> usize {
    libm::round(DEMAND_S / dt_s).max(1.0) as usize
}

/// Height of the rear axle above the front bumper's place at the start of the tick, its rate, and the pitch of the road, `time_s`
/// into the tick. The slope counts as its own sine and tangent: 0.3 % off at 10 %.
#[inline(always)]
fn road_at(rise: &Rise, front_m: f64, time_s: f64) -> [f64; 3] {
    let [height_m, climb_mps, slope_rad, slope_rate] = rise.at(time_s);
    [
        height_m - front_m * slope_rad,
        climb_mps - front_m * slope_rate,
        slope_rad,
    ]
}

#[cfg(test)]
mod tests;
