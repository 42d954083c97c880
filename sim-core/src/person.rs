//! Persons pass through: SUMO's position between its steps in a straight line, velocity and acceleration from differences.

use ipc_schema::{
    traffic::TrafficState,
    world::{SubStep, VehicleState},
};

use crate::{road_user::Settings, trig::wrap_angle};

/// Motion of a person over the current SUMO step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Person {
    /// Velocity over the step, world frame, m/s.
    velocity_mps: [f64; 2],
    /// Change of the velocity since the step before, per second, m/s².
    accel_mps2: [f64; 2],
    /// Rate of the heading, rad/s.
    yaw_rate_radps: f64,
    /// Standing where SUMO has set it.
    set: bool,
}

impl Person {
    /// Takes the step from `before` to `now`, `step_s` later.
    pub fn advance(&mut self, before: &TrafficState, now: &TrafficState, step_s: f64) {
        let velocity_mps = [
            (now.front_x_m - before.front_x_m) / step_s,
            (now.front_y_m - before.front_y_m) / step_s,
        ];
        let accel = |axis: usize| (velocity_mps[axis] - self.velocity_mps[axis]) / step_s;
        *self = Self {
            velocity_mps,
            accel_mps2: if self.set { [0.0; 2] } else { [accel(0), accel(1)] },
            yaw_rate_radps: wrap_angle(f64::from(now.yaw_rad) - f64::from(before.yaw_rad)) / step_s,
            set: false,
        };
    }

    /// Puts the person where SUMO has it, with SUMO's speed.
    pub fn set(&mut self, now: &TrafficState) {
        let (sin, cos) = libm::sincos(f64::from(now.yaw_rad));
        let speed = f64::from(now.speed_mps);
        *self = Self {
            velocity_mps: [speed * cos, speed * sin],
            set: true,
            ..Self::default()
        };
    }

    /// Writes the tick that starts `start_s` after the start of the step.
    pub(crate) fn write(
        &self,
        start_s: f64,
        settings: &Settings,
        before: &TrafficState,
        now: &TrafficState,
        out: &mut VehicleState,
        rows: &mut [SubStep],
    ) {
        // Time still to go to SUMO's state at the end of the step.
        let left_s = if self.set {
            0.0
        } else {
            settings.step_s() - start_s - settings.tick_s
        };
        let share = 1.0 - left_s / settings.step_s();
        out.x_m = now.front_x_m - left_s * self.velocity_mps[0];
        out.y_m = now.front_y_m - left_s * self.velocity_mps[1];
        out.z_m = if self.set {
            now.front_z_m
        } else {
            before.front_z_m + share * (now.front_z_m - before.front_z_m)
        };
        out.yaw_rad = wrap_angle(f64::from(now.yaw_rad) - left_s * self.yaw_rate_radps);
        let (sin, cos) = libm::sincos(out.yaw_rad);
        let body = |[x, y]: [f64; 2]| [(x * cos + y * sin) as f32, (y * cos - x * sin) as f32, 0.0];
        out.velocity_body_mps = body(self.velocity_mps);
        out.accel_body_mps2 = body(self.accel_mps2);
        out.angular_rate_body_radps = [0.0, 0.0, self.yaw_rate_radps as f32];
        self.write_rows(settings, out, rows);
    }

    fn write_rows(&self, settings: &Settings, out: &VehicleState, rows: &mut [SubStep]) {
        let mut left_s = settings.tick_s;
        for row in rows {
            left_s -= settings.sub_step_s();
            let back_s = if self.set { 0.0 } else { left_s.max(0.0) };
            *row = SubStep {
                dx_m: (-back_s * self.velocity_mps[0]) as f32,
                dy_m: (-back_s * self.velocity_mps[1]) as f32,
                dyaw_rad: (-back_s * self.yaw_rate_radps) as f32,
                speed_mps: out.velocity_body_mps[0],
                accel_body_mps2: out.accel_body_mps2,
                angular_rate_body_radps: out.angular_rate_body_radps,
                road_wheel_angle_rad: 0.0,
                reserved: 0,
            };
        }
    }
}
