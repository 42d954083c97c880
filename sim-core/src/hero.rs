//! A hero: a vehicle that its own model moves, on actions from outside.
//!
//! SUMO says where a hero enters and how fast it is then; from that tick on its state is ours. An action is held over a tick.

use ipc_schema::{
    config,
    traffic::TrafficState,
    world::{SubStep, VehicleState},
};

use crate::{
    attitude::{Felt, Lean, body_from_level},
    fleet::Built,
    rigid_body::{RigidBody, RigidState},
    vehicle::{Input, Model, Motion, State},
};

/// Steering and acceleration, each in −1 … 1.
pub type Action = [f32; 2];

/// The model of a hero: that of its kind and size.
#[must_use]
pub fn model(built: &Built) -> Model {
    built.model
}

/// What an action asks of the vehicle: −1 … 1 of the largest road-wheel angle (left is positive), and of the largest
/// acceleration or deceleration.
#[must_use]
pub fn input([steering, acceleration]: Action, limits: &config::Vehicle) -> Input {
    let largest_mps2 = if acceleration > 0.0 {
        limits.max_accel_mps2
    } else {
        limits.max_decel_mps2
    };
    Input {
        accel_mps2: f64::from(acceleration) * largest_mps2,
        road_wheel_angle_rad: f64::from(steering) * limits.max_road_wheel_angle_rad,
    }
}

/// The part of an action that cannot be used, by name and value: no number, or beyond −1 … 1.
#[must_use]
pub fn fault(action: Action) -> Option<(&'static str, f32)> {
    ["steering", "acceleration"]
        .into_iter()
        .zip(action)
        .find(|(_, value)| !(-1.0..=1.0).contains(value))
}

/// State of a hero and what it is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hero {
    state: State,
    /// What a rigid body has beside it: heave and its rate (m, m/s), and the actuator's acceleration (m/s²).
    beside: [f64; 3],
    input: Input,
}

impl Default for Hero {
    fn default() -> Self {
        Self {
            state: State::new(0.0, 0.0, 0.0, 0.0),
            beside: [0.0; 3],
            input: Input::default(),
        }
    }
}

impl Hero {
    /// What it is asked for from now on.
    pub fn ask(&mut self, input: Input) {
        self.input = input;
    }

    /// Sets it where SUMO has it, `front_m` from the rear axle to the front bumper.
    pub fn set(&mut self, now: &TrafficState, front_m: f64, out: &mut VehicleState, rows: &mut [SubStep]) {
        let (yaw_rad, speed_mps) = (f64::from(now.yaw_rad), f64::from(now.speed_mps));
        let mut state = State::new(now.front_x_m, now.front_y_m, yaw_rad, speed_mps);
        [state.x_m, state.y_m] = state.point_ahead(-front_m);
        (self.state, self.beside) = (state, [0.0; 3]);
        rows.fill(SubStep {
            speed_mps: now.speed_mps,
            pitch_rad: now.pitch_rad,
            ..SubStep::default()
        });
        self.write(now, front_m, rows, out);
    }

    /// Moves through one tick. Height and slope are those of the road under SUMO's copy of it, `[before, now]`.
    pub fn advance(
        &mut self,
        (model, mut body): (&Model, Option<&mut RigidBody>),
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
            let from = Lean::of(&self.state, slope(number as f64));
            let (next, motion) = match &mut body {
                Some(body) => self.step_body(body, libm::sin(slope(number as f64))),
                None => model.step(&self.state, &self.input, sub_step_s),
            };
            let to = Lean::of(&next, slope(number as f64 + 1.0));
            *row = sub_step(&next, &motion, [from, to], 1.0 / sub_step_s);
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

    fn step_body(&mut self, body: &mut RigidBody, slope_sin: f64) -> (State, Motion) {
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
        let lean = Lean::of(state, slope_rad);
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

fn sub_step(state: &State, motion: &Motion, leans: [Lean; 2], rate_per_s: f64) -> SubStep {
    // Its height is SUMO's, linear over a step: no upward acceleration is known.
    let felt = Felt::new(leans, motion, 0.0, rate_per_s);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_number_or_out_of_range_is_a_fault() {
        assert_eq!(fault([1.0, -1.0]), None);
        assert_eq!(fault([0.0, 1.5]), Some(("acceleration", 1.5)));
        assert!(matches!(fault([f32::NAN, 0.0]), Some(("steering", value)) if value.is_nan()));
        assert_eq!(
            fault([0.0, f32::NEG_INFINITY]),
            Some(("acceleration", f32::NEG_INFINITY))
        );
    }
}
