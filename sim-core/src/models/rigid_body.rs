//! The rigid-body model for heroes: rapier's ray-cast vehicle under the tyres, limits and actuators of [`super::dynamic`].
//!
//! A box with mass and moments of inertia stands on four springs. In every sub-step
//! [`rapier3d_f64::control::DynamicRayCastVehicleController`] casts a ray along each spring, presses the spring's and damper's force on
//! the body and drives or brakes it; rapier then moves the body as a free rigid body and keeps it out of the ground. Two
//! parts of the controller have no physical unit and are replaced: its lateral constraint by the tyre of the dynamic model at the
//! load of each wheel's spring, and its clamp on friction by that tyre's friction ellipse.
//!
//! The springs are made from the parameter set so that the body rolls by `roll_per_mps2_rad` with the frequency and damping of
//! the set (T. Gillespie, *Fundamentals of Vehicle Dynamics*, ch. 5, 6): with mass `m`, height of the centre of gravity `h` and
//! track `t`, each of four springs has `k = m (h / gain + g h) / t²`, the moment of inertia about the roll axis is `m h / (gain ω²)`.
//! The springs determine how far it pitches, the set its pitch frequency.
//!
//! All state is in [`RigidState`], in the frame of the road: the slope tilts gravity, not the ground. rapier's world is set
//! up again in every sub-step near its origin, so that rounding far from the origin loses nothing.

use std::f64::consts::TAU;

use ipc_schema::config;
use rapier3d_f64::{
    control::{DynamicRayCastVehicleController, WheelTuning},
    dynamics::{MassProperties, RigidBodyBuilder, RigidBodyHandle},
    geometry::ColliderBuilder,
    math::{Pose, Rotation, Vector},
    na::Unit,
    pipeline::{PhysicsWorld, QueryFilter},
};

use super::{
    dimensions::VehicleDimensions,
    dynamic::{DynamicParams, GRAVITY_MPS2, LEAST_LOAD_MPS2, RESTING, SLIP_SPEED_MPS, carry},
    parameters::ParameterSet,
    state::{ControlInput, ModelState, STANDSTILL_MPS, SubStepMotion, rotate},
};
use crate::trig::{bound, larger, smaller};

/// Track by width: 0.83 to 0.86 on the three cars of commonroad-vehicle-models.
const TRACK_BY_WIDTH: f64 = 0.85;
/// Radius of the wheels, metres. Rays do not depend on it.
const WHEEL_RADIUS_M: f64 = 0.3;
/// Height at which the springs are fixed to the body: the rays start there, metres.
const SPRING_TOP_M: f64 = 0.6;
/// The body's floor by its height.
const FLOOR_BY_HEIGHT: f64 = 0.1;
/// Longest travel of a spring and greatest force, never reached: metres and N.
const UNBOUNDED: f64 = 1e9;
/// Largest share of its sliding that four tyres may take from the body in one sub-step.
const LARGEST_GRIP: f64 = 0.8;

/// A vehicle cannot be moved by the rigid-body model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RigidBodyError {
    /// Four wheels lean out of a bend.
    #[error("the rigid-body model has four wheels and cannot lean into a bend as parameter set `{set}` does")]
    LeansIn {
        /// Name of the set.
        set: String,
    },
}

/// State of a rigid body. Its origin (centre of the rear axle on the ground, when the body stands on a level road) is fixed
/// to the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidState {
    /// Position, heading, roll and pitch against the road, and their rates. Speeds are along the heading and to its left.
    pub level: ModelState,
    /// Height of the origin above the road and its rate, metres and m/s.
    pub heave: [f64; 2],
    /// Acceleration that the driver has by drive and brakes: the actuator's state, m/s².
    pub drive_mps2: f64,
}

impl From<ModelState> for RigidState {
    /// A body on springs at rest.
    fn from(level: ModelState) -> Self {
        Self {
            level,
            heave: [0.0; 2],
            drive_mps2: level.accel_mps2,
        }
    }
}

/// Forces of the axles by mass, m/s².
struct AxleForces {
    front_mps2: f64,
    rear_mps2: f64,
    /// Drag and rolling resistance.
    resistance_mps2: f64,
    /// Acceleration that the driver gets: less than demanded where power, brakes or friction are exhausted.
    got_mps2: f64,
}

/// The body in rapier's world at the start of a sub-step.
struct BodyMotion {
    cg_m: Vector,
    velocity_mps: Vector,
    spin_radps: Vector,
}

/// One vehicle: its parameters and rapier's world around it. It is not `Clone`, because rapier's world is not; a copy of the
/// [`RigidState`] is a copy of the vehicle.
pub struct RigidBody {
    params: DynamicParams,
    mass_kg: f64,
    /// Rear axle on the ground to centre of gravity, body axes, metres.
    cg_m: Vector,
    /// Largest share of the sliding at its contact that one tyre takes in a sub-step.
    grip: f64,
    dt_s: f64,
    world: PhysicsWorld,
    chassis: RigidBodyHandle,
    wheels: DynamicRayCastVehicleController,
}

impl std::fmt::Debug for RigidBody {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RigidBody")
            .field("params", &self.params)
            .field("mass_kg", &self.mass_kg)
            .finish_non_exhaustive()
    }
}

impl RigidBody {
    /// A vehicle of this size with a parameter set, none of its limits above the configured ones, on a road that leaves
    /// `surface` of the friction on dry asphalt, for sub-steps of `dt_s`.
    ///
    /// # Errors
    /// The set is one of a vehicle that leans into bends.
    pub fn new(
        set: &ParameterSet,
        body: &VehicleDimensions,
        limits: &config::VehicleConfig,
        surface: f64,
        dt_s: f64,
    ) -> Result<Self, RigidBodyError> {
        if set.roll_per_mps2_rad <= 0.0 {
            return Err(RigidBodyError::LeansIn { set: set.name.clone() });
        }
        let params = DynamicParams::new(set, body, limits, surface, dt_s);
        let (lf, lr, height) = (params.cg_to_front_m(), params.cg_to_rear_m, set.cg_height_m(body));
        let turn = params.mass_by_inertia_per_m2 * (lf * lf + lr * lr);
        let suspension = SuspensionTuning::new(set, &params, body, height, dt_s);
        let mass_kg = set.mass_kg(body);
        let cg_m = Vector::new(lr, 0.0, height);
        let mut world = PhysicsWorld::new();
        world.gravity = Vector::ZERO;
        world.integration_parameters.dt = dt_s;
        world.insert_collider(
            ColliderBuilder::halfspace(Unit::new_unchecked(Vector::Z)).friction(surface),
            None,
        );
        let inertia = suspension.inertia_by_mass_m2 * mass_kg;
        let chassis = RigidBodyBuilder::dynamic()
            .additional_mass_properties(MassProperties::new(cg_m, mass_kg, inertia))
            .can_sleep(false);
        let (chassis, _) = world.insert(chassis, box_of(body, surface));
        // Registers the ground in rapier's broad phase.
        world.step();
        Ok(Self {
            params,
            mass_kg,
            cg_m,
            grip: smaller(0.25 * LARGEST_GRIP, 0.5 * LARGEST_GRIP / turn),
            dt_s,
            wheels: suspension.wheels(chassis, params.wheelbase_m),
            world,
            chassis,
        })
    }

    /// The state after one sub-step of `input` on a road with this sine of the slope along the heading (positive uphill), and
    /// the mean motion over it.
    pub fn step(&mut self, before: &RigidState, input: &ControlInput, slope_sin: f64) -> (RigidState, SubStepMotion) {
        let state = &before.level;
        let angle = self
            .params
            .road_wheel_angle_after(state, input.road_wheel_angle_rad, self.dt_s);
        let steered = 0.5 * (state.road_wheel_angle_rad + angle);
        let drive = self.drive(before, input, slope_sin, steered);
        let moving = self.place(before);
        self.weigh(&drive, slope_sin);
        self.press_and_drive(&drive, steered);
        self.grip(&moving);
        self.world.step();
        self.read(before, input, angle, &drive)
    }

    /// Shares the acceleration that the driver gets between the axles; the driver compensates resistance, slope and cornering.
    fn drive(&self, before: &RigidState, input: &ControlInput, slope_sin: f64, angle_rad: f64) -> AxleForces {
        let (params, state) = (&self.params, &before.level);
        let actuator = ModelState {
            accel_mps2: before.drive_mps2,
            ..*state
        };
        let wanted = params.accel_after(&actuator, input.accel_mps2, self.dt_s);
        let loads = params.loads_mps2(before.drive_mps2);
        let resistance_mps2 = if state.speed_mps > 0.0 {
            params.drag_by_mass_per_m * state.speed_mps * state.speed_mps + params.rolling_mps2
        } else {
            0.0
        };
        let opposing = resistance_mps2 + GRAVITY_MPS2 * slope_sin;
        let (sin, cos) = libm::sincos(angle_rad);
        let at_front = state.lateral_mps + params.wheelbase_m * state.yaw_rate_radps;
        let front_mps = [
            state.speed_mps * cos + at_front * sin,
            at_front * cos - state.speed_mps * sin,
        ];
        let at_cg = state.lateral_mps + params.cg_to_rear_m * state.yaw_rate_radps;
        let most = smaller(
            params.max_power_by_mass / larger(state.speed_mps, 1.0),
            params.max_accel_mps2 + larger(opposing, 0.0),
        );
        let grip = params.friction * loads[0];
        let mut forces = [0.0; 2];
        let mut cornering = 0.0;
        // Twice: the resistance of cornering depends on the lateral force that driving leaves to the front tyres.
        for _ in 0..2 {
            let left = larger(grip * grip - forces[0] * forces[0], 0.0).sqrt();
            let lateral = tyre(params.stiffness_per_rad[0] * loads[0], left, front_mps);
            cornering = lateral * sin - state.yaw_rate_radps * at_cg;
            let total = bound(wanted + opposing + cornering, -params.max_decel_mps2, most);
            forces = params.axle_forces(total, loads);
        }
        AxleForces {
            front_mps2: forces[0],
            rear_mps2: forces[1],
            resistance_mps2,
            got_mps2: forces[0] + forces[1] - opposing - cornering,
        }
    }

    /// Sets the body in rapier's world: heading along x, origin above the world's origin.
    fn place(&mut self, before: &RigidState) -> BodyMotion {
        let state = &before.level;
        let rotation = lean(state.roll[0], state.pitch[0]);
        let (sin, cos) = libm::sincos(state.pitch[0]);
        let spin = Vector::new(
            state.roll[1] * cos,
            -state.pitch[1],
            state.yaw_rate_radps + state.roll[1] * sin,
        );
        let velocity = Vector::new(state.speed_mps, state.lateral_mps, before.heave[1]);
        let chassis = &mut self.world.bodies[self.chassis];
        chassis.set_position(Pose::from_parts(Vector::new(0.0, 0.0, before.heave[0]), rotation), true);
        let lever = rotation * self.cg_m;
        let moving = BodyMotion {
            cg_m: Vector::new(lever.x, lever.y, lever.z + before.heave[0]),
            velocity_mps: velocity + spin.cross(lever),
            spin_radps: spin,
        };
        chassis.set_linvel(moving.velocity_mps, true);
        chassis.set_angvel(spin, true);
        moving
    }

    /// Gravity, drag and rolling resistance. The slope turns gravity, so that the ground can stay where it is.
    fn weigh(&mut self, drive: &AxleForces, slope_sin: f64) {
        let slope_cos = (1.0 - slope_sin * slope_sin).max(0.0).sqrt();
        let force_by_mass = Vector::new(
            -GRAVITY_MPS2 * slope_sin - drive.resistance_mps2,
            0.0,
            -GRAVITY_MPS2 * slope_cos,
        );
        self.world.bodies[self.chassis].apply_impulse(force_by_mass * (self.mass_kg * self.dt_s), true);
    }

    /// Runs rapier's controller: rays, springs, dampers, driving and braking forces.
    fn press_and_drive(&mut self, drive: &AxleForces, angle_rad: f64) {
        let driving = drive.front_mps2 + drive.rear_mps2 > 0.0;
        for (index, wheel) in self.wheels.wheels_mut().iter_mut().enumerate() {
            let front = index < 2;
            let force = 0.5 * self.mass_kg * if front { drive.front_mps2 } else { drive.rear_mps2 };
            wheel.steering = if front { angle_rad } else { 0.0 };
            wheel.engine_force = if driving { force } else { 0.0 };
            // An impulse, unlike the engine's force.
            wheel.brake = if driving { 0.0 } else { force.abs() * self.dt_s };
        }
        let queries = self.world.broad_phase.as_query_pipeline_mut(
            self.world.narrow_phase.query_dispatcher(),
            &mut self.world.bodies,
            &mut self.world.colliders,
            QueryFilter::default().exclude_rigid_body(self.chassis),
        );
        self.wheels.update_vehicle(self.dt_s, queries);
    }

    /// Lateral forces of the four tyres, at the slip at the start of the sub-step: later the springs have begun to turn the body.
    fn grip(&mut self, moving: &BodyMotion) {
        let chassis = &mut self.world.bodies[self.chassis];
        let mut impulses = [(Vector::ZERO, Vector::ZERO); 4];
        for (index, (wheel, impulse)) in self.wheels.wheels().iter().zip(&mut impulses).enumerate() {
            let ground = wheel.raycast_info();
            if !ground.is_in_contact {
                continue;
            }
            let normal = ground.contact_normal_ws;
            let left = -wheel.axle();
            let left = (left - normal * normal.dot(left)).normalize_or_zero();
            let velocity = moving.velocity_mps + moving.spin_radps.cross(ground.contact_point_ws - moving.cg_m);
            let rolling_mps = [velocity.dot(left.cross(normal)), velocity.dot(left)];
            let load = wheel.wheel_suspension_force;
            let used = wheel.forward_impulse / self.dt_s;
            let most = self.params.friction * load;
            let most = larger(most * most - used * used, 0.0).sqrt();
            let axle = usize::from(index >= 2);
            let force = tyre(self.params.stiffness_per_rad[axle] * load, most, rolling_mps);
            let stops = self.grip * self.mass_kg * rolling_mps[1].abs();
            *impulse = (left * bound(force * self.dt_s, -stops, stops), ground.contact_point_ws);
        }
        for (impulse, point) in impulses {
            chassis.apply_impulse_at_point(impulse, point, true);
        }
    }

    /// Reads the velocities from rapier's world; the pose follows from the mean of the velocities before and after.
    fn read(
        &self,
        before: &RigidState,
        input: &ControlInput,
        angle_rad: f64,
        drive: &AxleForces,
    ) -> (RigidState, SubStepMotion) {
        let (state, dt) = (&before.level, self.dt_s);
        let chassis = &self.world.bodies[self.chassis];
        let (velocity, spin) = (chassis.linvel(), chassis.angvel());
        let (sin, cos) = libm::sincos(state.pitch[0]);
        let turned = 0.5 * dt * (state.yaw_rate_radps + spin.z - spin.x / cos * sin);
        let (turned_sin, turned_cos) = libm::sincos(turned);
        let along_heading = |vector: Vector| {
            let [x, y] = rotate([vector.x, vector.y], turned_cos, -turned_sin);
            Vector::new(x, y, vector.z)
        };
        let (velocity, spin) = (along_heading(velocity), along_heading(spin));
        let roll_rate = spin.x / cos;
        let after = |[angle, rate]: [f64; 2], next: f64| [angle + 0.5 * dt * (rate + next), next];
        let roll = after(state.roll, roll_rate);
        let pitch = after(state.pitch, -spin.y);
        let at_origin = velocity - spin.cross(lean(roll[0], pitch[0]) * self.cg_m);
        let yaw_rate = spin.z - roll_rate * sin;
        let speed = at_origin.x;
        let stands = speed <= 0.0 || (speed < STANDSTILL_MPS && input.accel_mps2 <= 0.0);
        let speed = if stands { 0.0 } else { speed };
        let rests = stands && at_origin.y.abs() + yaw_rate.abs() < RESTING;
        let mut level = ModelState {
            speed_mps: speed,
            accel_mps2: (speed - state.speed_mps) / dt,
            road_wheel_angle_rad: angle_rad,
            lateral_mps: if rests { 0.0 } else { at_origin.y },
            yaw_rate_radps: if rests { 0.0 } else { yaw_rate },
            roll,
            pitch,
            ..*state
        };
        let motion = carry(state, &mut level, dt);
        let next = RigidState {
            level,
            heave: after(before.heave, at_origin.z),
            drive_mps2: if stands { 0.0 } else { drive.got_mps2 },
        };
        (next, motion)
    }
}

/// Springs and moments of inertia, by mass.
struct SuspensionTuning {
    /// Front and rear spring, 1/s².
    stiffness: [f64; 2],
    /// Front and rear damper, 1/s.
    damping: [f64; 2],
    /// Compression of the springs by the weight, metres.
    sag_m: f64,
    half_track_m: f64,
    /// About the body's axes, m².
    inertia_by_mass_m2: Vector,
}

impl SuspensionTuning {
    fn new(set: &ParameterSet, params: &DynamicParams, body: &VehicleDimensions, height_m: f64, dt_s: f64) -> Self {
        let track = TRACK_BY_WIDTH * body.width_m;
        let roll_natural = TAU * set.roll_frequency_hz;
        let pitch_natural = TAU * set.pitch_frequency_hz;
        // The springs' moment less that of the weight.
        let roll_moment = height_m / set.roll_per_mps2_rad;
        let spring = (roll_moment + GRAVITY_MPS2 * height_m) / (track * track);
        let damper = 2.0 * set.roll_damping_ratio * roll_moment / (roll_natural * track * track);
        let (lf, lr) = (params.cg_to_front_m(), params.cg_to_rear_m);
        let pitch_moment = 4.0 * spring * lf * lr - GRAVITY_MPS2 * height_m;
        // As the load is shared, so that heave and pitch are decoupled.
        let shares = [2.0 * lr / params.wheelbase_m, 2.0 * lf / params.wheelbase_m];
        Self {
            stiffness: shares.map(|share| share * spring),
            damping: shares.map(|share| share * damper),
            // The dampers see the speed to which gravity brings the body within a sub-step.
            sag_m: GRAVITY_MPS2 * (1.0 - 4.0 * damper * dt_s) / (4.0 * spring),
            half_track_m: 0.5 * track,
            inertia_by_mass_m2: Vector::new(
                roll_moment / (roll_natural * roll_natural),
                pitch_moment / (pitch_natural * pitch_natural),
                1.0 / params.mass_by_inertia_per_m2,
            ),
        }
    }

    /// Four wheels: front left, front right, rear left, rear right.
    fn wheels(&self, chassis: RigidBodyHandle, wheelbase_m: f64) -> DynamicRayCastVehicleController {
        let mut wheels = DynamicRayCastVehicleController::new(chassis);
        (wheels.index_up_axis, wheels.index_forward_axis) = (2, 0);
        for axle in [0, 1] {
            let tuning = WheelTuning {
                suspension_stiffness: self.stiffness[axle],
                suspension_compression: self.damping[axle],
                suspension_damping: self.damping[axle],
                max_suspension_travel: UNBOUNDED,
                side_friction_stiffness: 0.0,
                friction_slip: UNBOUNDED,
                max_suspension_force: UNBOUNDED,
            };
            let ahead = if axle == 0 { wheelbase_m } else { 0.0 };
            for left in [self.half_track_m, -self.half_track_m] {
                wheels.add_wheel(
                    Vector::new(ahead, left, SPRING_TOP_M),
                    -Vector::Z,
                    -Vector::Y,
                    SPRING_TOP_M - WHEEL_RADIUS_M + self.sag_m,
                    WHEEL_RADIUS_M,
                    &tuning,
                );
            }
        }
        wheels
    }
}

/// Least length of the frame behind the rear axle by the wheelbase.
const LEAST_OVERHANG: f64 = 0.2;

/// The body's box, without mass of its own. It reaches behind the rear axle: a tractor's frame is longer than its cab.
fn box_of(body: &VehicleDimensions, friction: f64) -> ColliderBuilder {
    let floor = FLOOR_BY_HEIGHT * body.height_m;
    let rear_m = body.rear_overhang_m.max(LEAST_OVERHANG * body.wheelbase_m);
    let length_m = body.front_m() + rear_m;
    ColliderBuilder::cuboid(
        0.5 * length_m,
        0.5 * body.width_m,
        0.5 * (body.height_m - floor).max(floor),
    )
    .translation(Vector::new(0.5 * length_m - rear_m, 0.0, 0.5 * (body.height_m + floor)))
    .density(0.0)
    .friction(friction)
}

/// Lateral force of a tyre that rolls with `[along, across]` its plane: that of [`super::dynamic`].
fn tyre(stiffness: f64, most: f64, [along_mps, across_mps]: [f64; 2]) -> f64 {
    let linear = -stiffness * across_mps / larger(along_mps.abs(), SLIP_SPEED_MPS);
    let saturation = linear / larger(most, LEAST_LOAD_MPS2 * 0.01);
    linear / (1.0 + saturation * saturation).sqrt()
}

/// Rotation of a body that pitches (positive nose up), then rolls (positive right side down).
fn lean(roll_rad: f64, pitch_rad: f64) -> Rotation {
    let (sin_pitch, cos_pitch) = libm::sincos(-0.5 * pitch_rad);
    let (sin_roll, cos_roll) = libm::sincos(0.5 * roll_rad);
    Rotation::from_xyzw(
        cos_pitch * sin_roll,
        sin_pitch * cos_roll,
        -sin_pitch * sin_roll,
        cos_pitch * cos_roll,
    )
}
