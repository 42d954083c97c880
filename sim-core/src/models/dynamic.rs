//! The dynamic single-track model: saturating tyres, load transfer, drive and brake limits, roll and pitch on springs.
//!
//! Forces are divided by the mass. With the centre of gravity `lf` behind the front and `lr` ahead of the rear axle, speed
//! `u` along the body and `w` to the left, yaw rate `r`, road-wheel angle `δ` (R. Rajamani, *Vehicle Dynamics and Control*,
//! sections 2.3, 4.1; H. Pacejka, *Tire and Vehicle Dynamics*, sections 1.3, 4.3):
//!
//! - `u' = Xf cos δ + Xr − Yf sin δ + r w − resistance`, `w' = Yf cos δ + Xf sin δ + Yr − r u`,
//!   `r' = m/I (lf (Yf cos δ + Xf sin δ) − lr Yr)`;
//! - slip `tan α = −lateral / longitudinal` velocity of the wheel in its own frame;
//! - tyre: Pacejka's magic formula with shape factor 1 and curvature 0, `Y = D sin(atan(C N tan α / D))`, which is
//!   `C N tan α / √(1 + (C N tan α / D)²)`, with what longitudinal force leaves of the friction, `D = √((μ N)² − X²)`;
//! - vertical load `N` static ∓ `u' h / L`;
//! - roll and pitch as damped springs driven by lateral and longitudinal acceleration, solved exactly for a held input.
//!
//! `w` and `r` are stiff at low speed (their rate is about `2 C g / u`). They are integrated by the two-stage Rosenbrock method
//! ROS2 (J. Verwer et al., *A second-order Rosenbrock method applied to photochemical dispersion problems*, 1999), which is of
//! second order for any Jacobian and damps stiff parts entirely: the model becomes the kinematic one as the vehicle
//! slows down, without a switch. Slip is divided by at least [`SLIP_SPEED_MPS`].

use bytemuck::{Pod, Zeroable};
use ipc_schema::config;

use super::{
    dimensions::VehicleDimensions,
    parameters::ParameterSet,
    state::{
        ACCEL_RATE_PER_S, ControlInput, MAX_JERK_MPS3, ModelState, STANDSTILL_MPS, STEERING_RATE_PER_S, SubStepMotion,
        rotate, share,
    },
};
use crate::trig::{bound, larger, pick, sin_cos_small, smaller};

/// Acceleration of gravity, m/s².
pub const GRAVITY_MPS2: f64 = 9.81;
/// Slip is taken against at least this speed, m/s.
pub const SLIP_SPEED_MPS: f64 = 1.0;
/// Share of the friction that brakes and drive may use (anti-lock, traction control); the rest is left for steering.
const LONGITUDINAL_SHARE: f64 = 0.95;
/// Lateral grip of the front axle by that of the rear: cars are built to slide over their front wheels first.
const FRONT_GRIP: f64 = 0.95;
/// Least vertical load of an axle by mass, m/s²: none lifts off.
pub(crate) const LEAST_LOAD_MPS2: f64 = 0.5;
/// A standing vehicle that slides and turns by less than this comes to rest (m/s and rad/s).
pub(crate) const RESTING: f64 = 0.02;
/// Square of the lateral force that is always left, m²/s⁴.
const LEAST_FORCE_SQUARED: f64 = 1e-4;
/// Share of the cornering resistance that the driver compensates: all up to a sideslip of 0.1 at the rear axle, none from 0.25.
const SLIDE: [f64; 2] = [5.0 / 3.0, 20.0 / 3.0];
/// γ of ROS2: 1 − 1/√2.
const GAMMA: f64 = 1.0 - std::f64::consts::FRAC_1_SQRT_2;

/// A damped spring over one sub-step of held input: `x ← e + M (x − e)`, e = gain · input.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct DampedSpring {
    gain: f64,
    step: [[f64; 2]; 2],
}

impl DampedSpring {
    /// A spring with this steady deflection by input, natural frequency (Hz, above 0) and damping ratio (below 1), for
    /// sub-steps of `dt_s`.
    #[must_use]
    pub fn new(gain: f64, frequency_hz: f64, damping_ratio: f64, dt_s: f64) -> Self {
        let natural = std::f64::consts::TAU * frequency_hz;
        let decay = damping_ratio * natural;
        let damped = natural * libm::sqrt(1.0 - damping_ratio * damping_ratio);
        let (sin, cos) = libm::sincos(damped * dt_s);
        let fade = libm::exp(-decay * dt_s);
        let step = [
            [fade * (cos + decay / damped * sin), fade * sin / damped],
            [
                -fade * natural * natural / damped * sin,
                fade * (cos - decay / damped * sin),
            ],
        ];
        Self { gain, step }
    }

    #[inline(always)]
    pub(super) fn after(&self, [angle, rate]: [f64; 2], input: f64) -> [f64; 2] {
        let rest = self.gain * input;
        let off = angle - rest;
        let [[a, b], [c, d]] = self.step;
        [rest + a * off + b * rate, c * off + d * rate]
    }
}

/// Parameters of the dynamic model, made from a [`ParameterSet`] for one size of vehicle and one length of sub-step.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct DynamicParams {
    /// Rear axle to front axle, metres.
    pub wheelbase_m: f64,
    /// Rear axle to centre of gravity, metres.
    pub cg_to_rear_m: f64,
    /// Mass by moment of inertia, 1/m².
    pub mass_by_inertia_per_m2: f64,
    /// Height of the centre of gravity by wheelbase.
    pub height_by_wheelbase: f64,
    /// Lateral force by vertical load and slip, front and rear, 1/rad.
    pub stiffness_per_rad: [f64; 2],
    /// Greatest force by vertical load.
    pub friction: f64,
    /// Largest road-wheel angle, radians.
    pub max_road_wheel_angle_rad: f64,
    /// Largest rate of the road-wheel angle, rad/s.
    pub max_road_wheel_rate_radps: f64,
    /// Largest acceleration, m/s².
    pub max_accel_mps2: f64,
    /// Largest deceleration, m/s².
    pub max_decel_mps2: f64,
    /// Driving power by mass, m²/s³.
    pub max_power_by_mass: f64,
    /// Share of the driving and of the braking force on the front axle.
    pub share_front: [f64; 2],
    /// Drag by mass and speed squared, 1/m.
    pub drag_by_mass_per_m: f64,
    /// Rolling resistance by mass, m/s².
    pub rolling_mps2: f64,
    /// Roll by lateral acceleration.
    pub roll: DampedSpring,
    /// Pitch by longitudinal acceleration.
    pub pitch: DampedSpring,
    /// Rate at which acceleration and road-wheel angle follow their demands, 1/s.
    pub actuator_rate_per_s: [f64; 2],
    /// Largest jerk of the drive and brake actuators, m/s³.
    pub max_jerk_mps3: f64,
    /// Largest curvature of the rear axle's way, 1/m.
    pub max_curvature_per_m: f64,
    /// Acceleration of the front bumper by forces by mass: 1 / (1 + x m/I lf) of the front and (1 − x m/I lr) of the rear axle, with the
    /// bumper x ahead of the centre of gravity.
    pub bumper: [f64; 2],
}

/// Density of air, kg/m³ (ISO 2533, 15 °C at sea level).
pub const AIR_KGPM3: f64 = 1.225;

impl DynamicParams {
    /// A vehicle of this size with a parameter set, none of its limits above the configured ones, on a road that leaves
    /// `surface` of the tyres' friction on dry asphalt.
    #[must_use]
    pub fn new(
        set: &ParameterSet,
        body: &VehicleDimensions,
        limits: &config::VehicleConfig,
        surface: f64,
        dt_s: f64,
    ) -> Self {
        let mass_kg = set.mass_kg(body);
        let cg_to_rear_m = set.front_load_share * body.wheelbase_m;
        let mass_by_inertia_per_m2 = 1.0 / set.yaw_inertia_by_mass_m2(body);
        let leverage = (body.front_m() - cg_to_rear_m) * mass_by_inertia_per_m2;
        let max_road_wheel_angle_rad = set.max_road_wheel_angle_rad.min(limits.max_road_wheel_angle_rad);
        Self {
            wheelbase_m: body.wheelbase_m,
            cg_to_rear_m,
            mass_by_inertia_per_m2,
            bumper: [
                1.0 / (1.0 + leverage * (body.wheelbase_m - cg_to_rear_m)),
                1.0 - leverage * cg_to_rear_m,
            ],
            height_by_wheelbase: set.cg_height_m(body) / body.wheelbase_m,
            stiffness_per_rad: [
                set.cornering_stiffness_front_per_rad,
                set.cornering_stiffness_rear_per_rad,
            ],
            friction: set.friction * surface,
            max_road_wheel_angle_rad,
            max_curvature_per_m: libm::tan(max_road_wheel_angle_rad) / body.wheelbase_m,
            max_road_wheel_rate_radps: set.max_road_wheel_rate_radps.min(limits.max_road_wheel_rate_radps),
            max_accel_mps2: set.max_accel_mps2.min(limits.max_accel_mps2),
            max_decel_mps2: set.max_decel_mps2.min(limits.max_decel_mps2),
            max_power_by_mass: set.max_power_w / mass_kg,
            share_front: [set.drive_share_front, set.brake_share_front],
            drag_by_mass_per_m: 0.5 * AIR_KGPM3 * set.drag_area_m2 / mass_kg,
            rolling_mps2: set.rolling_resistance * GRAVITY_MPS2,
            roll: DampedSpring::new(
                set.roll_per_mps2_rad,
                set.roll_frequency_hz,
                set.roll_damping_ratio,
                dt_s,
            ),
            pitch: DampedSpring::new(
                set.pitch_per_mps2_rad,
                set.pitch_frequency_hz,
                set.pitch_damping_ratio,
                dt_s,
            ),
            actuator_rate_per_s: [ACCEL_RATE_PER_S, STEERING_RATE_PER_S],
            max_jerk_mps3: MAX_JERK_MPS3,
        }
    }

    /// Front axle to centre of gravity, metres.
    #[must_use]
    #[inline(always)]
    pub fn cg_to_front_m(&self) -> f64 {
        self.wheelbase_m - self.cg_to_rear_m
    }

    /// Vertical loads of the front and the rear axle by mass, m/s², at this acceleration.
    #[inline(always)]
    #[must_use]
    pub fn loads_mps2(&self, accel_mps2: f64) -> [f64; 2] {
        let front = GRAVITY_MPS2 * self.cg_to_rear_m / self.wheelbase_m - accel_mps2 * self.height_by_wheelbase;
        let front = bound(front, LEAST_LOAD_MPS2, GRAVITY_MPS2 - LEAST_LOAD_MPS2);
        [front, GRAVITY_MPS2 - front]
    }

    /// Acceleration after `dt_s`: lag, bounded jerk, bounded demand.
    #[inline(always)]
    pub(crate) fn accel_after(&self, state: &ModelState, demand_mps2: f64, dt_s: f64) -> f64 {
        let most = self.max_jerk_mps3 * dt_s;
        let lag = share(self.actuator_rate_per_s[0] * dt_s);
        let change = bound((demand_mps2 - state.accel_mps2) * lag, -most, most);
        bound(state.accel_mps2 + change, -self.max_decel_mps2, self.max_accel_mps2)
    }

    /// Road-wheel angle after `dt_s`: lag, bounded rate, bounded angle.
    #[inline(always)]
    pub(crate) fn road_wheel_angle_after(&self, state: &ModelState, demand_rad: f64, dt_s: f64) -> f64 {
        let most = self.max_road_wheel_rate_radps * dt_s;
        let lag = share(self.actuator_rate_per_s[1] * dt_s);
        let change = bound((demand_rad - state.road_wheel_angle_rad) * lag, -most, most);
        bound(
            state.road_wheel_angle_rad + change,
            -self.max_road_wheel_angle_rad,
            self.max_road_wheel_angle_rad,
        )
    }

    /// Longitudinal forces of the axles by mass for a total of `force_mps2`: shared as built. When braking, force beyond the friction
    /// of one axle goes to the other; a driven axle spins no further than its friction.
    #[inline(always)]
    pub(crate) fn axle_forces(&self, force_mps2: f64, loads_mps2: [f64; 2]) -> [f64; 2] {
        let driving = force_mps2 > 0.0;
        let share = pick(driving, self.share_front[0], self.share_front[1]);
        let [front_most, rear_most] = loads_mps2.map(|load| LONGITUDINAL_SHARE * self.friction * load);
        let rear = bound((1.0 - share) * force_mps2, -rear_most, rear_most);
        let rest = pick(driving, share * force_mps2, force_mps2 - rear);
        let front = bound(rest, -front_most, front_most);
        let handed_over = bound(force_mps2 - front, -rear_most, rear_most);
        [front, pick(driving, rear, handed_over)]
    }

    /// Longitudinal slip of the rear wheels, `(wheel speed − speed) / speed`, on a road with this sine of the slope: that at which the
    /// tyre gives the axle's force, `X = D sin(atan(C N κ / D))` with `D = μ N`. The longitudinal stiffness is the cornering stiffness:
    /// 22.3 and 21.9 by load for the tyre of commonroad-vehicle-models. The resistance of cornering is left out.
    #[must_use]
    pub fn rear_wheel_slip(&self, state: &ModelState, slope_sin: f64) -> f64 {
        if state.speed_mps <= 0.0 {
            return 0.0;
        }
        let resistance =
            self.drag_by_mass_per_m * state.speed_mps * state.speed_mps + self.rolling_mps2 + GRAVITY_MPS2 * slope_sin;
        let loads = self.loads_mps2(state.accel_mps2);
        let [_, rear] = self.axle_forces(state.accel_mps2 + resistance, loads);
        let used = rear / (self.friction * loads[1]);
        rear / (self.stiffness_per_rad[1] * loads[1] * (1.0 - used * used).sqrt())
    }

    /// The state after `dt_s` on a road with this sine of the slope (positive uphill), and the mean motion over it.
    #[must_use]
    #[inline(always)]
    pub fn step(
        &self,
        state: &ModelState,
        input: &ControlInput,
        slope_sin: f64,
        dt_s: f64,
    ) -> (ModelState, SubStepMotion) {
        // Actuators: road-wheel angle and demanded acceleration.
        let angle = self.road_wheel_angle_after(state, input.road_wheel_angle_rad, dt_s);
        let wanted = self.accel_after(state, input.accel_mps2, dt_s);
        let resistance = self.drag_by_mass_per_m * state.speed_mps * state.speed_mps
            + pick(state.speed_mps > 0.0, self.rolling_mps2, 0.0)
            + GRAVITY_MPS2 * slope_sin;
        // Tyres at the start of the sub-step.
        let before = Slipping {
            lateral_mps: state.lateral_mps + self.cg_to_rear_m * state.yaw_rate_radps,
            yaw_rate_radps: state.yaw_rate_radps,
        };
        let loads = self.loads_mps2(state.accel_mps2);
        let level = self.axle_forces(
            bound(wanted + resistance, -self.max_decel_mps2, self.max_accel_mps2),
            loads,
        );
        let wheels = self.wheels(state, &before, angle, loads, level, dt_s);
        let start = self.forces(&wheels, &before);
        // Resistance of cornering. The driver compensates it, but not the resistance of a slide.
        let cornering = start.lateral_front_mps2 * wheels.sin - before.yaw_rate_radps * before.lateral_mps;
        let slide = state.lateral_mps.abs() * smaller(wheels.inverse_mps[1], 0.5);
        let made_up = cornering * bound(SLIDE[0] - SLIDE[1] * slide, 0.0, 1.0);
        let asked = self.force(wheels.inverse_mps[1], wanted + resistance + made_up, resistance);
        let [front, rear] = self.axle_forces(asked, loads);
        let accel = front * wheels.cos + rear - cornering - resistance;
        // The actuator's state is the acceleration that the driver gets. Further losses are not part of it: they would add up.
        let got = front + rear - made_up - resistance;
        let speed = state.speed_mps + (accel - 0.5 * (got - state.accel_mps2)) * dt_s;
        let stands = (speed <= 0.0) | ((speed < STANDSTILL_MPS) & (input.accel_mps2 <= 0.0));
        // Lateral velocity and yaw rate after the sub-step.
        let after = self.slip_after(&wheels, &before, &start, dt_s);
        // Only the tyres stop a body that still slides sideways.
        let rests = stands & (after.lateral_mps.abs() + after.yaw_rate_radps.abs() < RESTING);
        let after = Slipping {
            lateral_mps: pick(rests, 0.0, after.lateral_mps),
            yaw_rate_radps: pick(rests, 0.0, after.yaw_rate_radps),
        };
        let felt = (after.lateral_mps - before.lateral_mps) * (1.0 / dt_s)
            + 0.5 * (after.yaw_rate_radps + before.yaw_rate_radps) * wheels.speed_mps;
        let got = pick(stands, 0.0, got);
        // The body on its springs, and the pose.
        let mut next = ModelState {
            speed_mps: pick(stands, 0.0, speed),
            accel_mps2: got,
            road_wheel_angle_rad: angle,
            lateral_mps: after.lateral_mps - self.cg_to_rear_m * after.yaw_rate_radps,
            yaw_rate_radps: after.yaw_rate_radps,
            roll: self.roll.after(state.roll, pick(rests, 0.0, felt)),
            pitch: self.pitch.after(state.pitch, got),
            ..*state
        };
        let motion = carry(state, &mut next, dt_s);
        (next, motion)
    }

    /// The force by mass that drive and brakes give when `wanted_mps2` is asked for, against a `resistance`, at 1 / `inverse_speed`.
    #[inline(always)]
    fn force(&self, inverse_speed: f64, wanted_mps2: f64, resistance: f64) -> f64 {
        let power = self.max_power_by_mass * inverse_speed;
        let most = smaller(power, self.max_accel_mps2 + larger(resistance, 0.0));
        bound(wanted_mps2, -self.max_decel_mps2, most)
    }

    /// The wheels of one sub-step, with angle and speed half-way.
    #[inline(always)]
    fn wheels(
        &self,
        state: &ModelState,
        before: &Slipping,
        angle: f64,
        loads: [f64; 2],
        used: [f64; 2],
        dt_s: f64,
    ) -> Wheels {
        let (sin, cos) = sin_cos_small(0.5 * (state.road_wheel_angle_rad + angle));
        let speed_mps = larger(state.speed_mps + 0.5 * state.accel_mps2 * dt_s, 0.0);
        let at_front = before.lateral_mps + self.cg_to_front_m() * before.yaw_rate_radps;
        Wheels {
            sin,
            cos,
            speed_mps,
            inverse_mps: inverses(
                larger(speed_mps * cos + at_front * sin, SLIP_SPEED_MPS),
                larger(speed_mps, SLIP_SPEED_MPS),
            ),
            // A wheel that hardly rolls forward has no direction in which to brake.
            drive_front_mps2: used[0] * bound(speed_mps * cos + at_front * sin, 0.0, 1.0),
            stiffness: [0, 1].map(|axle: usize| self.stiffness_per_rad[axle] * loads[axle]),
            most_squared: [0, 1].map(|axle: usize| {
                let most = self.friction * loads[axle];
                let left = most * most - used[axle] * used[axle];
                larger([FRONT_GRIP * FRONT_GRIP, 1.0][axle] * left, LEAST_FORCE_SQUARED)
            }),
        }
    }

    /// Forces of the tyres at this slip, and their derivatives.
    #[inline(always)]
    fn forces(&self, wheels: &Wheels, slipping: &Slipping) -> Forces {
        let Wheels {
            sin, cos, speed_mps, ..
        } = *wheels;
        let (lf, lr) = (self.cg_to_front_m(), self.cg_to_rear_m);
        let at_front = slipping.lateral_mps + lf * slipping.yaw_rate_radps;
        let at_rear = slipping.lateral_mps - lr * slipping.yaw_rate_radps;
        let [front_inverse, rear_inverse] = wheels.inverse_mps;
        let slips = [
            (speed_mps * sin - at_front * cos) * front_inverse,
            -at_rear * rear_inverse,
        ];
        let linear = [0, 1].map(|axle: usize| wheels.stiffness[axle] * slips[axle]);
        let whole = [0, 1].map(|axle: usize| wheels.most_squared[axle] + linear[axle] * linear[axle]);
        let inverse = inverses(whole[0], whole[1]);
        let [front, rear] = [0, 1].map(|axle: usize| {
            // cos² of the magic formula's angle: most² / (most² + linear²).
            let square = wheels.most_squared[axle] * inverse[axle];
            let factor = square.sqrt();
            (linear[axle] * factor, wheels.stiffness[axle] * square * factor)
        });
        let across_front = front.0 * cos + wheels.drive_front_mps2 * sin;
        let falls = [front.1 * cos * cos * front_inverse, rear.1 * rear_inverse];
        let turning = lr * falls[1] - lf * falls[0];
        Forces {
            lateral_front_mps2: front.0,
            rates: [
                across_front + rear.0 - slipping.yaw_rate_radps * speed_mps,
                self.mass_by_inertia_per_m2 * (lf * across_front - lr * rear.0),
            ],
            jacobian: [
                [-(falls[0] + falls[1]), turning - speed_mps],
                [
                    self.mass_by_inertia_per_m2 * turning,
                    -self.mass_by_inertia_per_m2 * (lf * lf * falls[0] + lr * lr * falls[1]),
                ],
            ],
        }
    }

    /// One step of ROS2.
    #[inline(always)]
    fn slip_after(&self, wheels: &Wheels, before: &Slipping, start: &Forces, dt_s: f64) -> Slipping {
        let scale = GAMMA * dt_s;
        let [[a, b], [c, d]] = start.jacobian;
        let (a, b, c, d) = (1.0 - scale * a, -scale * b, -scale * c, 1.0 - scale * d);
        let inverse = 1.0 / (a * d - b * c);
        let solve = |[x, y]: [f64; 2]| [(d * x - b * y) * inverse, (a * y - c * x) * inverse];
        let first = solve(start.rates);
        let moved = self.forces(
            wheels,
            &Slipping {
                lateral_mps: before.lateral_mps + dt_s * first[0],
                yaw_rate_radps: before.yaw_rate_radps + dt_s * first[1],
            },
        );
        let second = solve([moved.rates[0] - 2.0 * first[0], moved.rates[1] - 2.0 * first[1]]);
        Slipping {
            lateral_mps: before.lateral_mps + dt_s * (1.5 * first[0] + 0.5 * second[0]),
            yaw_rate_radps: before.yaw_rate_radps + dt_s * (1.5 * first[1] + 0.5 * second[1]),
        }
    }
}

/// 1 / a and 1 / b with one division.
#[inline(always)]
pub(crate) fn inverses(a: f64, b: f64) -> [f64; 2] {
    let inverse = 1.0 / (a * b);
    [b * inverse, a * inverse]
}

/// Motion of the centre of gravity across the heading.
#[derive(Clone, Copy)]
struct Slipping {
    lateral_mps: f64,
    yaw_rate_radps: f64,
}

/// The wheels in one sub-step; forces by mass.
#[derive(Clone, Copy)]
struct Wheels {
    sin: f64,
    cos: f64,
    speed_mps: f64,
    /// 1 / speed of the front and of the rear wheels for their slip, s/m.
    inverse_mps: [f64; 2],
    drive_front_mps2: f64,
    /// Lateral force by slip, front and rear, m/s².
    stiffness: [f64; 2],
    /// Square of the greatest lateral force, m²/s⁴.
    most_squared: [f64; 2],
}

/// Lateral force of the front axle by mass, and the rates of [`Slipping`] with their derivatives.
struct Forces {
    lateral_front_mps2: f64,
    rates: [f64; 2],
    jacobian: [[f64; 2]; 2],
}

/// Moves the origin with the mean of the two velocities and turns it with the mean of the two yaw rates.
#[inline(always)]
pub(crate) fn carry(state: &ModelState, next: &mut ModelState, dt_s: f64) -> SubStepMotion {
    let turn = 0.5 * (state.yaw_rate_radps + next.yaw_rate_radps) * dt_s;
    let (sin, cos) = sin_cos_small(0.5 * turn);
    let half_way = rotate(state.heading, cos, sin);
    let before = rotate([state.speed_mps, state.lateral_mps], cos, -sin);
    let after = rotate([next.speed_mps, next.lateral_mps], cos, sin);
    let rate = 1.0 / dt_s;
    let moved = rotate(
        half_way,
        0.5 * dt_s * (before[0] + after[0]),
        0.5 * dt_s * (before[1] + after[1]),
    );
    next.x_m = state.x_m + moved[0];
    next.y_m = state.y_m + moved[1];
    next.yaw_rad = state.yaw_rad + turn;
    next.heading = rotate(half_way, cos, sin);
    SubStepMotion {
        accel_level_mps2: [(after[0] - before[0]) * rate, (after[1] - before[1]) * rate],
        yaw_rate_radps: turn * rate,
    }
}
