//! A hero: a vehicle that its own model moves, driven by actions from outside.
//!
//! SUMO sets position and speed of a hero when it enters; from that tick on the model owns its state. An action is held over a tick.

use ipc_schema::{
    traffic::TrafficState,
    world::{SubStep, VehicleState},
};

use crate::models::{
    attitude::{BodyLean, FeltMotion, body_from_level},
    catalogue::MotionModel,
    rigid_body::{RigidBody, RigidState},
    state::{ControlInput, ModelState, SubStepMotion},
};

/// State and control input of a hero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hero {
    state: ModelState,
    /// Additional state of a rigid body: heave and its rate (m, m/s), and the actuator's acceleration (m/s²).
    beside: [f64; 3],
    input: ControlInput,
}

impl Default for Hero {
    fn default() -> Self {
        Self {
            state: ModelState::new(0.0, 0.0, 0.0, 0.0),
            beside: [0.0; 3],
            input: ControlInput::default(),
        }
    }
}

impl Hero {
    /// Longitudinal slip of the rear wheels on a road with this sine of the slope.
    #[must_use]
    pub fn rear_wheel_slip(&self, model: &MotionModel, slope_sin: f64) -> f64 {
        model.rear_wheel_slip(&self.state, slope_sin)
    }

    /// Sets the control input from now on.
    pub fn set_input(&mut self, input: ControlInput) {
        self.input = input;
    }

    /// Sets it to SUMO's state, `front_m` from the rear axle to the front bumper.
    pub fn set(&mut self, now: &TrafficState, front_m: f64, out: &mut VehicleState, rows: &mut [SubStep]) {
        let (yaw_rad, speed_mps) = (f64::from(now.yaw_rad), f64::from(now.speed_mps));
        let mut state = ModelState::new(now.front_x_m, now.front_y_m, yaw_rad, speed_mps);
        [state.x_m, state.y_m] = state.point_ahead(-front_m);
        (self.state, self.beside) = (state, [0.0; 3]);
        rows.fill(SubStep {
            speed_mps: now.speed_mps,
            pitch_rad: now.pitch_rad,
            ..SubStep::default()
        });
        self.write(now, front_m, rows, out);
    }

    /// Moves through one tick. Height and slope are those of the road under SUMO's copy of the hero, `[before, now]`.
    pub fn advance(
        &mut self,
        (model, mut body): (&MotionModel, Option<&mut RigidBody>),
        [before, now]: [&TrafficState; 2],
        front_m: f64,
        sub_step_s: f64,
        out: &mut VehicleState,
        rows: &mut [SubStep],
    ) {
        let count = rows.len() as f64;
        let between = |a: f64, b: f64, done: f64| a + (b - a) * done / count;
        let slope = |done: f64| between(before.pitch_rad.into(), now.pitch_rad.into(), done);
        let mut states = Vec::with_capacity(rows.len());
        for (number, row) in rows.iter_mut().enumerate() {
            let from = BodyLean::of(&self.state, slope(number as f64));
            let (next, motion) = match &mut body {
                Some(body) => self.step_body(body, libm::sin(slope(number as f64))),
                None => model.step(&self.state, &self.input, sub_step_s),
            };
            let to = BodyLean::of(&next, slope(number as f64 + 1.0));
            // The height is SUMO's, linear over a step: there is no upward acceleration.
            *row = sub_step(&next, &motion, [from, to], 0.0, 1.0 / sub_step_s);
            row.dz_m = (between(before.front_z_m, now.front_z_m, number as f64 + 1.0) - now.front_z_m) as f32;
            self.state = next;
            states.push(next);
        }
        for (row, state) in rows.iter_mut().zip(&states) {
            row.dx_m = (state.x_m - self.state.x_m) as f32;
            row.dy_m = (state.y_m - self.state.y_m) as f32;
            row.dyaw_rad = (state.yaw_rad - self.state.yaw_rad) as f32;
        }
        self.state = self.state.settled();
        self.write(now, front_m, rows, out);
    }

    fn step_body(&mut self, body: &mut RigidBody, slope_sin: f64) -> (ModelState, SubStepMotion) {
        let [heave_m, heave_mps, drive_mps2] = self.beside;
        let before = RigidState {
            level: self.state,
            heave: [heave_m, heave_mps],
            drive_mps2,
        };
        let (after, motion) = body.step(&before, &self.input, slope_sin);
        self.beside = [after.heave[0], after.heave[1], after.drive_mps2];
        (after.level, motion)
    }

    fn write(&self, now: &TrafficState, front_m: f64, rows: &[SubStep], out: &mut VehicleState) {
        let (state, slope_rad) = (&self.state, f64::from(now.pitch_rad));
        let lean = BodyLean::of(state, slope_rad);
        out.x_m = state.x_m;
        out.y_m = state.y_m;
        out.z_m = now.front_z_m - front_m * libm::tan(slope_rad);
        out.yaw_rad = state.yaw_rad;
        out.roll_rad = lean.roll_rad as f32;
        out.pitch_rad = lean.pitch_rad as f32;
        out.velocity_body_mps =
            body_from_level(&lean, [state.speed_mps, state.lateral_mps, 0.0]).map(|part| part as f32);
        out.road_wheel_angle_rad = state.road_wheel_angle_rad as f32;
        if let Some(last) = rows.last() {
            out.accel_body_mps2 = last.accel_body_mps2;
            out.angular_rate_body_radps = last.angular_rate_body_radps;
        }
    }
}

/// What a sub-step of `1 / rate_per_s` ends with; its pose is left out.
pub(super) fn sub_step(
    state: &ModelState,
    motion: &SubStepMotion,
    leans: [BodyLean; 2],
    up_mps2: f64,
    rate_per_s: f64,
) -> SubStep {
    let felt = FeltMotion::new(leans, motion, up_mps2, rate_per_s);
    SubStep {
        roll_rad: leans[1].roll_rad as f32,
        pitch_rad: leans[1].pitch_rad as f32,
        speed_mps: state.speed_mps as f32,
        lateral_speed_mps: state.lateral_mps as f32,
        accel_body_mps2: felt.accel_mps2.map(|part| part as f32),
        angular_rate_body_radps: felt.rate_radps.map(|part| part as f32),
        road_wheel_angle_rad: state.road_wheel_angle_rad as f32,
        ..SubStep::default()
    }
}
