//! Persons: SUMO's positions, smoothed like those of vehicles, with velocity and acceleration from differences.

use ipc_schema::{
    traffic::TrafficState,
    world::{SubStep, VehicleState},
};

use super::{
    curve::{ReferenceCurve, ReferencePoint},
    reference::half_a_step_before,
    settings::MirrorSettings,
};
use crate::trig::wrap_angle;

/// Motion of a person over the current SUMO step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Person {
    curve: ReferenceCurve,
    /// Velocity over the last chord, world frame, m/s.
    chord_mps: [f64; 2],
    /// Heading at the start of the step and its rate, rad and rad/s.
    heading: [f64; 2],
    /// Standing where SUMO has set it, until the next step.
    set: bool,
}

impl Person {
    /// Takes the step from `before` to `now`, `step_s` later.
    pub fn advance(&mut self, before: &TrafficState, now: &TrafficState, step_s: f64) {
        let from = [before.front_x_m, before.front_y_m];
        let chord = [(now.front_x_m - from[0]) / step_s, (now.front_y_m - from[1]) / step_s];
        self.curve = ReferenceCurve::straight(half_a_step_before(from, self.chord_mps, step_s), self.chord_mps);
        self.curve.cubic[1] = [0, 1].map(|axis: usize| 0.5 * (chord[axis] - self.chord_mps[axis]) / step_s);
        self.chord_mps = chord;
        let turn = wrap_angle(f64::from(now.yaw_rad) - f64::from(before.yaw_rad));
        self.heading = [f64::from(before.yaw_rad), turn / step_s];
        self.set = false;
    }

    /// Sets the person to SUMO's position and speed.
    pub fn set(&mut self, now: &TrafficState, step_s: f64) {
        let (sin, cos) = libm::sincos(f64::from(now.yaw_rad));
        let speed = f64::from(now.speed_mps);
        self.chord_mps = [speed * cos, speed * sin];
        let from = half_a_step_before([now.front_x_m, now.front_y_m], self.chord_mps, step_s);
        self.curve = ReferenceCurve::straight(from, self.chord_mps);
        self.heading = [f64::from(now.yaw_rad), 0.0];
        self.set = true;
    }

    /// Continues as in the last step: what a person does until it is set elsewhere.
    pub fn coast(&mut self, before: &TrafficState, step_s: f64) {
        let from = half_a_step_before([before.front_x_m, before.front_y_m], self.chord_mps, step_s);
        self.curve = ReferenceCurve::straight(from, self.chord_mps);
        self.heading = [f64::from(before.yaw_rad), 0.0];
    }

    fn at(&self, time_s: f64) -> (ReferencePoint, f64) {
        let time_s = if self.set { 0.0 } else { time_s };
        (self.curve.at(time_s), self.heading[0] + time_s * self.heading[1])
    }

    /// Writes the tick that starts `start_s` after the start of the step, at height `z_m`.
    pub(crate) fn write(
        &self,
        start_s: f64,
        settings: &MirrorSettings,
        z_m: f64,
        out: &mut VehicleState,
        rows: &mut [SubStep],
    ) {
        let (end, yaw_rad) = self.at(start_s + settings.tick_s);
        let (sin, cos) = libm::sincos(yaw_rad);
        let body = |[x, y]: [f64; 2]| [(x * cos + y * sin) as f32, (y * cos - x * sin) as f32, 0.0];
        out.x_m = end.position_m[0];
        out.y_m = end.position_m[1];
        out.z_m = z_m;
        out.yaw_rad = wrap_angle(yaw_rad);
        out.velocity_body_mps = body(end.velocity_mps);
        out.accel_body_mps2 = body(self.curve.cubic[1].map(|half| 2.0 * half));
        out.angular_rate_body_radps = [0.0, 0.0, self.heading[1] as f32];
        let mut time_s = start_s;
        for row in rows {
            time_s += settings.sub_step_s();
            let (here, here_yaw_rad) = self.at(time_s);
            *row = SubStep {
                dx_m: (here.position_m[0] - end.position_m[0]) as f32,
                dy_m: (here.position_m[1] - end.position_m[1]) as f32,
                dyaw_rad: (here_yaw_rad - yaw_rad) as f32,
                speed_mps: body(here.velocity_mps)[0],
                accel_body_mps2: out.accel_body_mps2,
                angular_rate_body_radps: out.angular_rate_body_radps,
                ..SubStep::default()
            };
        }
    }
}
