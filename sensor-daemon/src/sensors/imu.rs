//! Inertial measurement unit: accelerometer, gyroscope and compass in the vehicle's frame.
//!
//! Error model of IEEE Std 952-2020 (annex C): white noise, constant bias and a random walk of the bias on each axis; then full
//! scale and resolution. A density N (per √Hz) is a standard deviation of N √f for samples at f Hz; a walk K moves the bias by
//! K √Δt from sample to sample. Both are exact for samples that are means over their period. Errors belong to the sensor's
//! own axes: those of the convention.

use std::f64::consts::{FRAC_PI_2, TAU};

use ipc_schema::{
    config::{ImuConfig as Params, ImuConvention},
    observation::IMU_COLUMNS,
    sensor::NoiseStream,
    world::SubStep,
};

use crate::{
    noise::normals::{BATCH, cos_sin},
    noise::{DrawnNormals, NormalDraws, RandomStream},
    wide::{VectorPath, VectorWork},
};

/// Standard gravity, m/s².
pub const GRAVITY_MPS2: f64 = 9.806_65;

/// One number for each axis: accelerometer x, y, z, gyroscope x, y, z, compass, nothing.
pub type ImuAxes = [f32; 8];
/// One sample: accelerometer x, y, z (m/s²), gyroscope x, y, z (rad/s), compass (clockwise from grid north, radians in [0, 2π)).
pub type ImuSample = [f32; IMU_COLUMNS];

const COMPASS: usize = 6;

/// An IMU as configured.
#[derive(Debug, Clone, PartialEq)]
pub struct ImuModel {
    samples: usize,
    tick_s: f32,
    /// Sign of each axis; 0 for an element of a sub-step that is no axis.
    signs: Pair,
    gravity_mps2: f32,
    bias: Pair,
    white: Pair,
    walk: Pair,
    range: Pair,
    /// Resolution, 1 where there is none.
    divisor: Pair,
    /// All bits where there is a resolution.
    stepped: [u32; 16],
    /// True if any axis has a resolution.
    is_stepped: bool,
    /// True if any axis has white noise.
    is_noisy: bool,
    /// True if any bias walks.
    is_walking: bool,
    /// Standard deviation over units of a constant bias of each axis.
    unit_bias_std: ImuAxes,
    /// True if any axis has one.
    has_unit_bias: bool,
}

/// Heading of a vehicle at the end of a tick, and its motion during the tick.
#[derive(Debug, Clone, Copy)]
pub struct ImuMotion<'a> {
    /// Heading, counter-clockwise from east, radians.
    pub yaw_rad: f64,
    /// Sub-steps of the tick, at least one.
    pub rows: &'a [SubStep],
}

fn axes(accel: [f64; 3], gyro: [f64; 3], compass: f64) -> Pair {
    let [ax, ay, az] = accel.map(|value| value as f32);
    let [gx, gy, gz] = gyro.map(|value| value as f32);
    twice([ax, ay, az, gx, gy, gz, compass as f32, 0.0])
}

fn twice(axes: ImuAxes) -> Pair {
    bytemuck::must_cast([axes, axes])
}

/// The largest multiple of `resolution` within `range`: where a sensor saturates.
fn full_scale(range: f64, resolution: f64) -> f64 {
    if resolution > 0.0 {
        libm::floor(range / resolution * (1.0 + 1e-9)) * resolution
    } else {
        range
    }
}

impl ImuModel {
    /// An IMU that takes `samples` samples in a tick of `tick_s` seconds (1 if its period is longer than a tick).
    #[must_use]
    pub fn new(params: &Params, samples: usize, tick_s: f64) -> Self {
        let white = |std: [f64; 3], density: [f64; 3]| {
            [0, 1, 2].map(|i: usize| (std[i] * std[i] + density[i] * density[i] / params.period_s).sqrt())
        };
        let limits =
            |range: [f64; 3], resolution: [f64; 3]| [0, 1, 2].map(|i: usize| full_scale(range[i], resolution[i]));
        let white = axes(
            white(params.accel_noise_std_mps2, params.accel_noise_density),
            white(params.gyro_noise_std_radps, params.gyro_noise_density),
            params.compass_noise_std_rad,
        );
        let root_s = params.period_s.sqrt();
        let walk = axes(
            params.accel_bias_walk.map(|k| k * root_s),
            params.gyro_bias_walk.map(|k| k * root_s),
            0.0,
        );
        let resolution = axes(params.accel_resolution_mps2, params.gyro_resolution_radps, 0.0);
        let [unit_bias_std, _]: [ImuAxes; 2] = bytemuck::must_cast(axes(
            params.accel_unit_bias_std_mps2,
            params.gyro_unit_bias_std_radps,
            0.0,
        ));
        let any = |axes: &Pair| axes.iter().any(|std| *std > 0.0);
        Self {
            samples: samples.max(1),
            tick_s: tick_s as f32,
            signs: twice(signs(params.convention)),
            gravity_mps2: match params.convention {
                ImuConvention::Kinematic => 0.0,
                ImuConvention::SpecificForce | ImuConvention::Carla => GRAVITY_MPS2 as f32,
            },
            bias: axes(params.accel_bias_mps2, params.gyro_bias_radps, params.compass_bias_rad),
            white,
            walk,
            range: axes(
                limits(params.accel_range_mps2, params.accel_resolution_mps2),
                limits(params.gyro_range_radps, params.gyro_resolution_radps),
                f64::from(f32::MAX),
            ),
            divisor: resolution.map(|step| if step > 0.0 { step } else { 1.0 }),
            stepped: resolution.map(|step| if step > 0.0 { u32::MAX } else { 0 }),
            is_stepped: any(&resolution),
            is_noisy: any(&white),
            is_walking: any(&walk),
            has_unit_bias: unit_bias_std.iter().any(|std| *std > 0.0),
            unit_bias_std,
        }
    }

    /// Plans the numbers of the samples of a tick: white noise sample by sample, then the walk, two blocks each.
    pub fn plan(&self, draws: &mut NormalDraws, tick: u32) {
        let first = tick.wrapping_mul(self.samples as u32);
        let streams = [
            (self.is_noisy, [NoiseStream::ImuFront, NoiseStream::ImuBack]),
            (self.is_walking, [NoiseStream::WalkFront, NoiseStream::WalkBack]),
        ];
        for (is_on, halves) in streams {
            for sample in (0_u32..).take(if is_on { self.samples } else { 0 }) {
                for half in halves {
                    draws.plan(half, first.wrapping_add(sample));
                }
            }
        }
    }

    /// Biases of the unit of a road user that begins a trajectory: its constant ones, before any walk.
    #[must_use]
    pub fn begin(&self, episode_seed: u64, id_hash: u64) -> ImuAxes {
        if !self.has_unit_bias {
            return [0.0; 8];
        }
        let normals = |sensor: NoiseStream| {
            let stream = RandomStream {
                episode_seed,
                id_hash,
                sensor,
            };
            stream.normals(0)
        };
        let halves = [normals(NoiseStream::ImuUnitFront), normals(NoiseStream::ImuUnitBack)];
        std::array::from_fn(|axis| self.unit_bias_std[axis] * halves[axis / 4][axis % 4])
    }

    /// Writes the samples of a tick to `out`, oldest first, with the planned numbers; `walk` holds the biases of the unit so far.
    ///
    /// A sample over several sub-steps is the mean of their accelerations and rates, with the gravity half-way; the heading is that at
    /// its end.
    #[inline]
    pub fn sample(
        &self,
        path: VectorPath,
        body: &ImuMotion,
        drawn: DrawnNormals,
        walk: &mut ImuAxes,
        out: &mut [ImuSample],
    ) {
        path.run(Samples {
            unit: self,
            body,
            drawn,
            walk,
            out,
        });
    }
}

/// The samples of one tick, with the widest vectors: [`BATCH`] of them, in one pass after the other over plain arrays.
struct Samples<'a> {
    unit: &'a ImuModel,
    body: &'a ImuMotion<'a>,
    drawn: DrawnNormals<'a>,
    walk: &'a mut ImuAxes,
    out: &'a mut [ImuSample],
}

/// Numbers of two samples: one register of AVX-512.
type Pair = [f32; 16];
/// Numbers of [`BATCH`] samples.
type Values = [Pair; BATCH / 2];

impl VectorWork for Samples<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let (unit, rows) = (self.unit, self.body.rows);
        let steps = (rows.len() / unit.samples).max(1);
        let of_all = |is_on: bool| if is_on { 2 * unit.samples } else { 0 };
        let mut drawn = self.drawn;
        let white = drawn.split(of_all(unit.is_noisy));
        let drift = drawn.split(of_all(unit.is_walking));
        let mut values: Values = [[0.0; 16]; BATCH / 2];
        let mut first = 0;
        for some in self.out.chunks_mut(BATCH) {
            let values = &mut values[..some.len().div_ceil(2)];
            // With fewer sub-steps than samples, the last ones see the newest that there is.
            let rows_of = |i: usize| &rows[((first + i) * steps).min(rows.len() - steps)..][..steps];
            let gravity = if unit.gravity_mps2 == 0.0 {
                [[0.0; BATCH]; 3]
            } else {
                let sub_step_s = unit.tick_s / rows.len() as f32;
                gravity_body(unit.gravity_mps2, sub_step_s, some.len(), &rows_of)
            };
            for i in 0..some.len() {
                let felt = if steps == 1 {
                    felt(&rows_of(i)[0])
                } else {
                    mean(rows_of(i))
                };
                let gravity = [gravity[0][i], gravity[1][i], gravity[2][i], 0.0, 0.0, 0.0, 0.0, 0.0];
                let value = &mut values[i / 2][8 * (i % 2)..][..8];
                for axis in 0..8 {
                    value[axis] = felt[axis] + gravity[axis];
                }
            }
            unit.add_errors(white, 2 * first, values);
            if unit.is_walking {
                unit.walk(drift, 2 * first, self.walk, values);
            } else if unit.has_unit_bias {
                for (i, value) in values.iter_mut().flatten().enumerate() {
                    *value += self.walk[i % 8];
                }
            }
            unit.quantise(values);
            for (i, out) in some.iter_mut().enumerate() {
                let value = &values[i / 2][8 * (i % 2)..];
                out.copy_from_slice(&value[..IMU_COLUMNS]);
                let yaw_rad = self.body.yaw_rad + f64::from(rows_of(i)[steps - 1].dyaw_rad);
                out[COMPASS] = compass_rad(yaw_rad, f64::from(value[COMPASS]));
            }
            first += some.len();
        }
    }
}

impl ImuModel {
    /// Turns the vehicle's motion into the sensor's axes and adds constant biases and white noise, whose blocks begin at `from`.
    #[inline(always)]
    fn add_errors(&self, white: DrawnNormals, from: usize, values: &mut [Pair]) {
        for (index, value) in values.iter_mut().enumerate() {
            let normals = white.four(from + 4 * index);
            for i in 0..16 {
                value[i] = value[i] * self.signs[i] + (self.bias[i] + self.white[i] * normals[i]);
            }
        }
    }

    /// Adds the random walk of the biases, sample by sample.
    #[inline(always)]
    fn walk(&self, drift: DrawnNormals, from: usize, walk: &mut ImuAxes, values: &mut [Pair]) {
        let mut walked = *walk;
        for (index, value) in values.iter_mut().enumerate() {
            let normals = drift.four(from + 4 * index);
            let mut step = [0.0; 16];
            for i in 0..16 {
                step[i] = self.walk[i] * normals[i];
            }
            for half in [0, 8] {
                for axis in 0..8 {
                    walked[axis] += step[half + axis];
                }
                for axis in 0..8 {
                    value[half + axis] += walked[axis];
                }
            }
        }
        *walk = walked;
    }

    /// Limits values to the sensor's output: multiples of the resolution within the range.
    #[inline(always)]
    #[expect(
        clippy::needless_range_loop,
        reason = "plain indices are what the compiler turns into vectors here"
    )]
    fn quantise(&self, values: &mut [Pair]) {
        if self.is_stepped {
            for value in &mut *values {
                let mut steps: Pair = [0.0; 16];
                for i in 0..16 {
                    steps[i] = value[i] / self.divisor[i];
                }
                for step in &mut steps {
                    *step = step.round_ties_even();
                }
                for i in 0..16 {
                    steps[i] *= self.divisor[i];
                }
                // Bits instead of a condition, which would become a branch for each axis.
                let (stepped, mut kept): ([u32; 16], [u32; 16]) =
                    (bytemuck::must_cast(steps), bytemuck::must_cast(*value));
                for i in 0..16 {
                    kept[i] ^= (kept[i] ^ stepped[i]) & self.stepped[i];
                }
                *value = bytemuck::must_cast(kept);
            }
        }
        for value in values {
            for i in 0..16 {
                let most = self.range[i];
                let below = if value[i] > most { most } else { value[i] };
                value[i] = if below < -most { -most } else { below };
            }
        }
    }
}

/// Acceleration and angular rate of a sub-step; the elements after them have the sign 0.
#[inline(always)]
fn felt(row: &SubStep) -> ImuAxes {
    let [_, felt]: [ImuAxes; 2] = bytemuck::must_cast(*row);
    felt
}

/// Mean acceleration and angular rate over sub-steps.
#[inline(always)]
fn mean(rows: &[SubStep]) -> ImuAxes {
    let mut sum = [0.0; 8];
    for row in rows {
        let felt = felt(row);
        for axis in 0..8 {
            sum[axis] += felt[axis];
        }
    }
    let share = 1.0 / rows.len() as f32;
    for value in &mut sum {
        *value *= share;
    }
    sum
}

/// Signs of the axes of a convention against x forward, y left, z up.
///
/// CARLA's sensors live in Unreal's left-handed frame, x forward, y right, z up (CARLA's documentation, "Sensors reference", IMU;
/// `AInertialMeasurementUnit`): acceleration along y changes its sign, and of the angular rate, an axial vector, the two components
/// that the mirror leaves in place: rolling to the left and turning to the right are positive there, and nose down still is. Its
/// compass is 0 at (0, −1, 0), which is north there, and grows clockwise as ours. Its gravity is 9.81 m/s², ours 9.806 65.
fn signs(convention: ImuConvention) -> ImuAxes {
    match convention {
        ImuConvention::Kinematic | ImuConvention::SpecificForce => [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0],
        ImuConvention::Carla => [1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 0.0, 0.0],
    }
}

/// Gravity as an accelerometer measures it half-way through each sample: the upward reaction, turned into the vehicle's frame (for any
/// roll and pitch). The acceleration is a mean over the sample in the axes half-way; with gravity in those at its end, a navigator
/// would take half of what a lean changes in a sample for a velocity of its own.
#[inline(always)]
fn gravity_body<'r>(
    gravity_mps2: f32,
    sub_step_s: f32,
    samples: usize,
    rows_of: &impl Fn(usize) -> &'r [SubStep],
) -> [[f32; BATCH]; 3] {
    let (mut roll, mut pitch): ([u32; BATCH], [u32; BATCH]) = ([0; BATCH], [0; BATCH]);
    // The rotation from half-way to the end of the middle sub-step; of an even number of sub-steps, half-way is the end of one.
    let mut left = [[0.0; BATCH]; 3];
    for (i, (roll, pitch)) in roll.iter_mut().zip(&mut pitch).take(samples).enumerate() {
        let rows = rows_of(i);
        let middle = rows[(rows.len() - 1) / 2];
        (*roll, *pitch) = (turns(middle.roll_rad), turns(middle.pitch_rad));
        if rows.len() & 1 == 1 {
            for (left, rate) in left.iter_mut().zip(middle.angular_rate_body_radps) {
                left[i] = 0.5 * sub_step_s * rate;
            }
        }
    }
    // Plain arrays, one a component: what the compiler turns into vectors.
    let [mut end_x, mut end_y, mut end_z] = [[0.0; BATCH]; 3];
    for i in 0..BATCH {
        let (cos_pitch, sin_pitch) = cos_sin(pitch[i]);
        let (cos_roll, sin_roll) = cos_sin(roll[i]);
        end_x[i] = gravity_mps2 * sin_pitch;
        end_y[i] = gravity_mps2 * cos_pitch * sin_roll;
        end_z[i] = gravity_mps2 * cos_pitch * cos_roll;
    }
    // Turned back by the rotation vector a, to the second order of its angle: g + a × g + a × (a × g) / 2.
    let [left_x, left_y, left_z] = left;
    let [mut x, mut y, mut z] = [[0.0; BATCH]; 3];
    for i in 0..BATCH {
        let first_x = left_y[i] * end_z[i] - left_z[i] * end_y[i];
        let first_y = left_z[i] * end_x[i] - left_x[i] * end_z[i];
        let first_z = left_x[i] * end_y[i] - left_y[i] * end_x[i];
        let second_x = left_y[i] * first_z - left_z[i] * first_y;
        let second_y = left_z[i] * first_x - left_x[i] * first_z;
        let second_z = left_x[i] * first_y - left_y[i] * first_x;
        x[i] = end_x[i] + (first_x + 0.5 * second_x);
        y[i] = end_y[i] + (first_y + 0.5 * second_y);
        z[i] = end_z[i] + (first_z + 0.5 * second_z);
    }
    [x, y, z]
}

/// An angle in units of 2⁻³² turns, without whole turns. The last bit of a number between 2²⁰ and 2²¹ is one such unit: the addition
/// rounds to it, without a conversion that depends on sign and size.
#[inline(always)]
fn turns(angle_rad: impl Into<f64>) -> u32 {
    const ROUNDS: f64 = 1_572_864.0;
    (angle_rad.into() * (1.0 / TAU) + ROUNDS).to_bits() as u32
}

/// Heading clockwise from north in [0, 2π) to 2⁻²⁴ of a turn, from yaw counter-clockwise from east, with an error clockwise.
#[must_use]
#[inline(always)]
pub fn compass_rad(yaw_rad: f64, error_rad: f64) -> f32 {
    const RAD: f32 = (TAU / 16_777_216.0) as f32;
    let heading = turns(FRAC_PI_2 - yaw_rad + error_rad);
    (heading.wrapping_add(1 << 7) >> 8) as i32 as f32 * RAD
}

#[cfg(test)]
mod tests;
