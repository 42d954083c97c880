//! A hero: a vehicle that its own model moves, on actions from outside.
//!
//! SUMO says where a hero enters and how fast it is then; from that tick on its state is ours. An action is held over a tick.

use ipc_schema::{
    config,
    traffic::TrafficState,
    world::{SubStep, VehicleState},
};

use crate::{
    dimensions::Dimensions,
    road_user::Settings,
    vehicle::{Input, KinematicParams, Model, Motion, State},
};

/// Steering and acceleration, each in −1 … 1.
pub type Action = [f32; 2];

/// The model of heroes and its parameters.
#[must_use]
pub fn model(settings: &Settings, dimensions: &Dimensions) -> Model {
    Model::Kinematic(KinematicParams::new(&settings.vehicle, dimensions.wheelbase_m))
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
    input: Input,
}

impl Default for Hero {
    fn default() -> Self {
        Self {
            state: State::new(0.0, 0.0, 0.0, 0.0),
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
        self.state = state;
        rows.fill(SubStep {
            speed_mps: now.speed_mps,
            ..SubStep::default()
        });
        write(&self.state, rows, out);
    }

    /// Moves through one tick.
    pub fn advance(&mut self, model: &Model, sub_step_s: f64, out: &mut VehicleState, rows: &mut [SubStep]) {
        let mut states = Vec::with_capacity(rows.len());
        for row in &mut *rows {
            let (next, motion) = model.step(&self.state, &self.input, sub_step_s);
            self.state = next;
            states.push(next);
            *row = sub_step(&next, &motion);
        }
        for (row, state) in rows.iter_mut().zip(&states) {
            row.dx_m = (state.x_m - self.state.x_m) as f32;
            row.dy_m = (state.y_m - self.state.y_m) as f32;
            row.dyaw_rad = (state.yaw_rad - self.state.yaw_rad) as f32;
        }
        self.state = self.state.settled();
        write(&self.state, rows, out);
    }
}

fn sub_step(state: &State, motion: &Motion) -> SubStep {
    let [forward, left] = motion.accel_body_mps2;
    SubStep {
        speed_mps: state.speed_mps as f32,
        accel_body_mps2: [forward as f32, left as f32, 0.0],
        angular_rate_body_radps: [0.0, 0.0, motion.yaw_rate_radps as f32],
        road_wheel_angle_rad: state.road_wheel_angle_rad as f32,
        ..SubStep::default()
    }
}

fn write(state: &State, rows: &[SubStep], out: &mut VehicleState) {
    out.x_m = state.x_m;
    out.y_m = state.y_m;
    out.yaw_rad = state.yaw_rad;
    out.velocity_body_mps = [state.speed_mps as f32, 0.0, 0.0];
    out.road_wheel_angle_rad = state.road_wheel_angle_rad as f32;
    if let Some(last) = rows.last() {
        out.accel_body_mps2 = last.accel_body_mps2;
        out.angular_rate_body_radps = last.angular_rate_body_radps;
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
