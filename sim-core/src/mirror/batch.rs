//! A batch of vehicles: the tracker and one model on [`BATCH`] vehicles side by side, for all sub-steps of a tick.
//!
//! One vehicle alone is a chain of some 300 dependent operations in each sub-step, and the processor waits for each of them:
//! 0.7 µs per tick of 10 sub-steps, measured. A batch fills its vector units. The functions are those of [`super::tracking`] and
//! [`crate::models`]. No operation is fused or reordered, so every vehicle gets the same bits as alone, on any machine.

use bytemuck::Pod;
use ipc_schema::world::SubStep;

use super::{
    curve::{ReferenceCurve, ReferencePoint, RoadRise},
    governor::DrivingLimits,
    pace::PathLimits,
    tracking::{self, TrackedVehicle},
};
use crate::models::{
    attitude::{BodyLean, FeltMotion},
    catalogue::{MotionModel, SizedModel},
    dynamic::{DynamicParams, GRAVITY_MPS2},
    kinematic::KinematicParams,
    parameters::POWER_SHARE,
    state::{ControlInput, ModelState, SubStepMotion},
};

/// Vehicles in a batch: two registers of AVX-512 or eight of SSE2 for each number.
pub const BATCH: usize = 16;

/// Shares of a vehicle's friction and steering that references use, as [`POWER_SHARE`] of its power; the tracker uses the rest to follow them.
const LATERAL_SHARE: f64 = 0.6;
const LONGITUDINAL_SHARE: f64 = 0.85;
/// With a preview the reference does not surprise the tracker. SUMO's own paths ask for more than the friction at their worst.
const PREVIEW_LATERAL_SHARE: f64 = 0.66;
const CURVATURE_SHARE: f64 = 0.9;

/// Share of the distance out of a bend that would bring the middle of the body to SUMO's: the rest keeps the front bumper in its lane.
const SWING_SHARE: f64 = 0.4;

/// Time between two demands of the tracker, seconds.
const DEMAND_S: f64 = 0.02;

/// One number of each member.
type BatchColumn = [f64; BATCH];
/// Numbers in a [`ModelState`], a [`ReferenceCurve`] and a [`RoadRise`].
const STATE: usize = size_of::<ModelState>() / 8;
const CURVE: usize = size_of::<ReferenceCurve>() / 8;
const RISE: usize = size_of::<RoadRise>() / 8;
/// Numbers in a [`SubStep`].
const SUB_STEP: usize = size_of::<SubStep>() / 4;

/// A model with `N` parameters that can run in a batch: free of branches.
pub trait BatchModel<const N: usize>: Pod {
    /// The demand that brings the front bumper, `front_m` ahead of the rear axle, to `target`.
    fn demand(&self, front_m: f64, state: &ModelState, target: &ReferencePoint) -> ControlInput;
    /// The state after `dt_s`, and the mean motion over it.
    fn step(&self, state: &ModelState, input: &ControlInput, slope_sin: f64, dt_s: f64) -> (ModelState, SubStepMotion);
    /// Longitudinal slip of the rear wheels.
    fn rear_wheel_slip(&self, state: &ModelState, slope_sin: f64) -> f64;
    /// The limits that a reference respects.
    fn driving_limits(&self) -> DrivingLimits;
    /// The same with a preview.
    fn preview_limits(&self) -> DrivingLimits;
    /// Parameters that keep the numbers of an empty member finite.
    fn empty() -> [f64; N];
}

/// Parameters of the kinematic model.
pub const KINEMATIC: usize = size_of::<KinematicParams>() / 8;
/// Parameters of the dynamic model.
pub const DYNAMIC: usize = size_of::<DynamicParams>() / 8;

impl BatchModel<KINEMATIC> for KinematicParams {
    #[inline(always)]
    fn demand(&self, front_m: f64, state: &ModelState, target: &ReferencePoint) -> ControlInput {
        tracking::demand(&TrackedVehicle::new(self, front_m), state, target)
    }

    #[inline(always)]
    fn step(&self, state: &ModelState, input: &ControlInput, _: f64, dt_s: f64) -> (ModelState, SubStepMotion) {
        Self::step(self, state, input, dt_s)
    }

    fn rear_wheel_slip(&self, _: &ModelState, _: f64) -> f64 {
        0.0
    }

    fn driving_limits(&self) -> DrivingLimits {
        DrivingLimits {
            lateral_mps2: self.max_lateral_mps2,
            curvature_per_m: CURVATURE_SHARE * self.max_curvature_per_m,
            accel_mps2: self.max_accel_mps2,
            decel_mps2: self.max_decel_mps2,
            power_by_mass: f64::INFINITY,
            drag_by_mass_per_m: 0.0,
            rolling_mps2: 0.0,
        }
    }

    fn preview_limits(&self) -> DrivingLimits {
        self.driving_limits()
    }

    fn empty() -> [f64; KINEMATIC] {
        [1.0; KINEMATIC]
    }
}

impl BatchModel<DYNAMIC> for DynamicParams {
    #[inline(always)]
    fn demand(&self, front_m: f64, state: &ModelState, target: &ReferencePoint) -> ControlInput {
        tracking::demand_with_tyres(self, front_m, state, target)
    }

    #[inline(always)]
    fn step(&self, state: &ModelState, input: &ControlInput, slope_sin: f64, dt_s: f64) -> (ModelState, SubStepMotion) {
        Self::step(self, state, input, slope_sin, dt_s)
    }

    fn rear_wheel_slip(&self, state: &ModelState, slope_sin: f64) -> f64 {
        Self::rear_wheel_slip(self, state, slope_sin)
    }

    fn driving_limits(&self) -> DrivingLimits {
        let friction = self.friction * GRAVITY_MPS2;
        DrivingLimits {
            lateral_mps2: LATERAL_SHARE * friction,
            curvature_per_m: CURVATURE_SHARE * self.max_curvature_per_m,
            accel_mps2: self.max_accel_mps2.min(LONGITUDINAL_SHARE * friction),
            decel_mps2: self.max_decel_mps2.min(LONGITUDINAL_SHARE * friction),
            power_by_mass: POWER_SHARE * self.max_power_by_mass,
            drag_by_mass_per_m: self.drag_by_mass_per_m,
            rolling_mps2: self.rolling_mps2,
        }
    }

    fn preview_limits(&self) -> DrivingLimits {
        DrivingLimits {
            lateral_mps2: PREVIEW_LATERAL_SHARE * self.friction * GRAVITY_MPS2,
            ..self.driving_limits()
        }
    }

    fn empty() -> [f64; DYNAMIC] {
        [0.25; DYNAMIC]
    }
}

/// What a vehicle can drive.
pub(super) fn path_limits(vehicle: &SizedModel) -> PathLimits {
    let (driving, rear_per_m) = match &vehicle.model {
        MotionModel::Kinematic(params) => (params.preview_limits(), params.max_curvature_per_m),
        MotionModel::Dynamic(params) => (params.preview_limits(), params.max_curvature_per_m),
    };
    let (front_m, length_m) = (vehicle.dimensions.front_m(), vehicle.dimensions.whole_length_m);
    let last_axle_m = vehicle.trailing.last_axle_m(front_m);
    let turn = rear_per_m * front_m;
    PathLimits {
        // In a circle of radius R whose front bumper is `swing / R` outside SUMO's, both bodies have their middle in one place.
        swing_m2: last_axle_m.map_or(0.0, |last_axle_m| {
            SWING_SHARE * 0.5 * length_m * (last_axle_m - 0.5 * length_m).max(0.0)
        }),
        driving,
        front_curvature_per_m: rear_per_m / (1.0 + turn * turn).sqrt(),
    }
}

/// Motion of all members over one sub-step in the order of [`SubStep`]; the first four fields count from the start of the tick.
pub type BatchRow = [[f32; BATCH]; SUB_STEP];

/// No model of the catalogue.
const NO_MODEL: u32 = u32::MAX;
/// What is transposed at once: as many vehicles as fields of a sub-step.
const BLOCK: usize = 4;

/// Vehicles of one model side by side.
#[derive(Debug, Clone)]
pub struct VehicleBatch<P, const N: usize> {
    /// Index in the catalogue of the model whose parameters and limits each member has.
    models: [u32; BATCH],
    limits: [DrivingLimits; BATCH],
    state: [BatchColumn; STATE],
    curve: [BatchColumn; CURVE],
    rise: [BatchColumn; RISE],
    front_m: BatchColumn,
    params: [BatchColumn; N],
    /// Height of the rear axle above the road under the front bumper at the start of the tick (metres), its rate (m/s), and the
    /// pitch of the road (radians).
    road: [BatchColumn; 3],
    /// x, y, z and yaw at the start of the tick.
    origin: [BatchColumn; 4],
    /// Demanded acceleration and road-wheel angle.
    input: [BatchColumn; 2],
    /// The motion, one row for each sub-step.
    pub rows: Vec<BatchRow>,
    model: std::marker::PhantomData<P>,
}

#[inline(always)]
fn scatter<T: Pod, const N: usize>(batch: &mut [BatchColumn; N], member: usize, value: &T) {
    let numbers: &[f64; N] = bytemuck::must_cast_ref(value);
    for (place, number) in batch.iter_mut().zip(numbers) {
        place[member] = *number;
    }
}

#[inline(always)]
fn gather<T: Pod, const N: usize>(batch: &[BatchColumn; N], member: usize) -> T {
    bytemuck::must_cast(std::array::from_fn::<f64, N, _>(|i| batch[i][member]))
}

impl<P: BatchModel<N>, const N: usize> VehicleBatch<P, N> {
    /// An empty batch for `sub_steps` sub-steps.
    #[must_use]
    pub fn new(sub_steps: usize) -> Self {
        let zero = [0.0; BATCH];
        let mut batch = Self {
            models: [NO_MODEL; BATCH],
            limits: [DrivingLimits::NONE; BATCH],
            state: [zero; STATE],
            curve: [zero; CURVE],
            rise: [zero; RISE],
            front_m: [1.0; BATCH],
            params: P::empty().map(|value| [value; BATCH]),
            road: [zero; 3],
            origin: [zero; 4],
            input: [zero; 2],
            rows: vec![[[0.0; BATCH]; SUB_STEP]; sub_steps],
            model: std::marker::PhantomData,
        };
        let standing = ModelState::new(0.0, 0.0, 0.0, 0.0);
        (0..BATCH).for_each(|member| scatter(&mut batch.state, member, &standing));
        batch
    }

    /// Gives `member` the parameters of the model with this index in the catalogue, and its limits with or without a preview.
    #[inline]
    pub fn set_model(&mut self, member: usize, model: u32, params: &P, has_preview: bool) {
        // Few models move most vehicles: a member mostly has its parameters already.
        if self.models[member] != model {
            self.models[member] = model;
            scatter(&mut self.params, member, params);
            self.limits[member] = match has_preview {
                true => params.preview_limits(),
                false => params.driving_limits(),
            };
        }
    }

    /// The limits that the reference of a member respects.
    #[must_use]
    pub fn limits(&self, member: usize) -> &DrivingLimits {
        &self.limits[member]
    }

    /// Loads a vehicle as `member`, with its reference and the road under its front bumper, `front_m` ahead of the rear axle. Its model is
    /// that of the last [`VehicleBatch::set_model`].
    #[inline]
    pub fn load(&mut self, member: usize, state: &ModelState, reference: (&ReferenceCurve, &RoadRise), front_m: f64) {
        scatter(&mut self.state, member, state);
        scatter(&mut self.curve, member, reference.0);
        scatter(&mut self.rise, member, reference.1);
        self.front_m[member] = front_m;
    }

    /// Writes the sub-steps of the first members, relative to the last of them: those of each member from its place in `rows` on.
    pub fn write_all(&self, places: impl ExactSizeIterator<Item = usize>, rows: &mut [SubStep]) {
        let (count, mut places_of) = (places.len().min(BATCH), [0; BATCH]);
        places_of.iter_mut().zip(places).for_each(|(to, place)| *to = place);
        #[cfg(target_arch = "x86_64")]
        #[expect(
            unsafe_code,
            reason = "a call of a function compiled for more than the baseline processor: copies no registers"
        )]
        {
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: this condition has just found the feature on this processor.
                return unsafe { self.write_all_avx2(&places_of, count, rows) };
            }
        }
        self.write_all_here(&places_of, count, rows);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn write_all_avx2(&self, places_of: &[usize; BATCH], count: usize, rows: &mut [SubStep]) {
        self.write_all_here(places_of, count, rows);
    }

    /// The same code for every processor, compiled into each caller.
    #[inline(always)]
    fn write_all_here(&self, places_of: &[usize; BATCH], count: usize, rows: &mut [SubStep]) {
        let Some(last) = self.rows.last() else { return };
        let whole = count - count % BLOCK;
        let parts: &mut [[[f32; BLOCK]; SUB_STEP / BLOCK]] = bytemuck::must_cast_slice_mut(rows);
        for (block, places) in places_of[..whole].as_chunks::<BLOCK>().0.iter().enumerate() {
            let of_block = |field: &[f32; BATCH]| field.as_chunks::<BLOCK>().0[block];
            let end = [0, 1, 2, 3].map(|field: usize| of_block(&last[field]));
            for (index, moved) in self.rows.iter().enumerate() {
                let (fields, _) = moved.as_chunks::<BLOCK>();
                let places = places.map(|place| place + index);
                for (part, fields) in fields.iter().enumerate() {
                    let mut numbers = [0, 1, 2, 3].map(|field: usize| of_block(&fields[field]));
                    if part == 0 {
                        for (numbers, end) in numbers.iter_mut().zip(&end) {
                            numbers.iter_mut().zip(end).for_each(|(number, end)| *number -= end);
                        }
                    }
                    for (place, numbers) in places.into_iter().zip(transposed(numbers)) {
                        parts[place][part] = numbers;
                    }
                }
            }
        }
        for member in whole..count {
            self.write(member, &mut rows[places_of[member]..][..self.rows.len()]);
        }
    }

    /// Writes the sub-steps of a member, relative to the last of them.
    pub fn write(&self, member: usize, rows: &mut [SubStep]) {
        let Some(last) = self.rows.last() else { return };
        let end: [f32; 4] = std::array::from_fn(|i| last[i][member]);
        for (row, moved) in rows.iter_mut().zip(&self.rows) {
            let mut numbers: [f32; SUB_STEP] = std::array::from_fn(|i| moved[i][member]);
            numbers.iter_mut().zip(end).for_each(|(number, end)| *number -= end);
            *row = bytemuck::must_cast(numbers);
        }
    }

    /// Height of the rear axle above the road under the front bumper at the start of the tick (metres), its rate (m/s), and the
    /// pitch of the road (radians), at the end of the tick.
    #[must_use]
    pub fn road(&self, member: usize) -> [f64; 3] {
        gather(&self.road, member)
    }

    /// The state of a member.
    #[must_use]
    #[inline(always)]
    pub fn state(&self, member: usize) -> ModelState {
        gather(&self.state, member)
    }

    /// The parameters of a member.
    #[must_use]
    #[inline(always)]
    pub fn params(&self, member: usize) -> P {
        gather(&self.params, member)
    }

    /// The reference of a member.
    #[must_use]
    #[inline(always)]
    pub fn curve(&self, member: usize) -> ReferenceCurve {
        gather(&self.curve, member)
    }

    /// Tracks all members through one tick of `rows.len()` sub-steps, with the widest vectors of this machine. Calls `meanwhile` with
    /// the number of each sub-step: there the mirror prefetches the next vehicles.
    pub fn advance(&mut self, dt_s: f64, meanwhile: &impl Fn(usize)) {
        #[cfg(target_arch = "x86_64")]
        #[expect(
            unsafe_code,
            reason = "calls of functions compiled for more than the baseline processor: twice as fast"
        )]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: this condition has just found the feature on this processor.
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

    /// The same code for every processor, compiled into each caller.
    #[inline(always)]
    fn advance_here(&mut self, dt_s: f64, meanwhile: &impl Fn(usize)) {
        let mut rows = std::mem::take(&mut self.rows);
        self.start_road();
        let between = between_demands(dt_s);
        for (index, row) in rows.iter_mut().enumerate() {
            let time_s = index as f64 * dt_s;
            if index.is_multiple_of(between) {
                self.update_demands(time_s);
            }
            self.sub_step(time_s, dt_s, row);
            meanwhile(index);
        }
        self.rows = rows;
    }

    /// The road under the rear axle at the start of the tick.
    #[inline(always)]
    fn start_road(&mut self) {
        for member in 0..BATCH {
            let road = road_at(&gather(&self.rise, member), self.front_m[member], 0.0);
            scatter(&mut self.road, member, &road);
            let state: ModelState = gather(&self.state, member);
            scatter(
                &mut self.origin,
                member,
                &[state.x_m, state.y_m, road[0], state.yaw_rad],
            );
        }
    }

    /// Updates the demands of all members.
    #[inline(always)]
    fn update_demands(&mut self, time_s: f64) {
        for member in 0..BATCH {
            let (state, params): (ModelState, P) = (gather(&self.state, member), gather(&self.params, member));
            let input = params.demand(self.front_m[member], &state, &self.curve(member).at(time_s));
            scatter(&mut self.input, member, &[input.accel_mps2, input.road_wheel_angle_rad]);
        }
    }

    /// One sub-step of all members: the loop that the compiler turns into vector instructions.
    #[inline(always)]
    fn sub_step(&mut self, time_s: f64, dt_s: f64, row: &mut BatchRow) {
        for member in 0..BATCH {
            let state: ModelState = gather(&self.state, member);
            let params: P = gather(&self.params, member);
            let front_m = self.front_m[member];
            let road: [f64; 3] = gather(&self.road, member);
            let [accel_mps2, road_wheel_angle_rad] = gather(&self.input, member);
            let input = ControlInput {
                accel_mps2,
                road_wheel_angle_rad,
            };
            let (next, motion) = params.step(&state, &input, road[2], dt_s);
            let road_next = road_at(&gather(&self.rise, member), front_m, time_s + dt_s);
            let leans = [BodyLean::of(&state, road[2]), BodyLean::of(&next, road_next[2])];
            let rate = 1.0 / dt_s;
            let felt = FeltMotion::new(leans, &motion, (road_next[1] - road[1]) * rate, rate);
            scatter(&mut self.state, member, &next);
            scatter(&mut self.road, member, &road_next);
            let origin: [f64; 4] = gather(&self.origin, member);
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
                field[member] = number as f32;
            }
        }
    }
}

/// Rows become columns.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
#[expect(
    unsafe_code,
    reason = "the intrinsics: without them each number takes three instructions"
)]
fn transposed(rows: [[f32; BLOCK]; BLOCK]) -> [[f32; BLOCK]; BLOCK] {
    use std::arch::x86_64::{_mm_movehl_ps, _mm_movelh_ps, _mm_unpackhi_ps, _mm_unpacklo_ps};
    let [a, b, c, d] = rows.map(bytemuck::must_cast);
    // SAFETY: every processor of this architecture has SSE.
    let columns = unsafe {
        let (front, back) = (
            [_mm_unpacklo_ps(a, b), _mm_unpacklo_ps(c, d)],
            [_mm_unpackhi_ps(a, b), _mm_unpackhi_ps(c, d)],
        );
        [
            _mm_movelh_ps(front[0], front[1]),
            _mm_movehl_ps(front[1], front[0]),
            _mm_movelh_ps(back[0], back[1]),
            _mm_movehl_ps(back[1], back[0]),
        ]
    };
    columns.map(bytemuck::must_cast)
}

/// Rows become columns.
#[cfg(not(target_arch = "x86_64"))]
fn transposed(rows: [[f32; BLOCK]; BLOCK]) -> [[f32; BLOCK]; BLOCK] {
    std::array::from_fn(|column| rows.map(|row| row[column]))
}

/// Sub-steps of `dt_s` from one demand to the next: the tracker updates demands 50 times a second, as often as a steering actuator
/// that follows at 20/s needs.
fn between_demands(dt_s: f64) -> usize {
    libm::round(DEMAND_S / dt_s).max(1.0) as usize
}

/// Height of the rear axle above the road under the front bumper at the start of the tick, its rate, and the pitch of the road,
/// `time_s` into the tick. The slope stands for its own sine and tangent: an error of 0.3 % at a slope of 10 %.
#[inline(always)]
pub(super) fn road_at(rise: &RoadRise, front_m: f64, time_s: f64) -> [f64; 3] {
    let [height_m, climb_mps, slope_rad, slope_rate] = rise.at(time_s);
    [
        height_m - front_m * slope_rad,
        climb_mps - front_m * slope_rate,
        slope_rad,
    ]
}

#[cfg(test)]
mod tests;
