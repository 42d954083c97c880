//! Road users as heroes see them: what does not depend on the hero is computed once in a tick.

use ipc_schema::{traffic::Kind, world::VehicleState};

use super::ahead_by;

/// A road user of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickBody {
    /// Rear, middle and front on its centre line, world frame, metres.
    pub spine_m: [[f64; 2]; 3],
    /// Its middle, world frame, metres; of a person its position.
    pub middle_m: [f64; 2],
    /// Origin of its state, world frame, metres.
    pub origin_m: [f64; 2],
    /// Velocity in the world frame, m/s.
    pub velocity_mps: [f64; 2],
    /// Length of the velocity, m/s.
    pub speed_mps: f64,
    /// Metres.
    pub length_m: f32,
    /// Metres.
    pub width_m: f32,
    /// True for pedestrians.
    pub is_person: bool,
}

impl TickBody {
    /// The body of a state.
    #[must_use]
    pub fn of(state: &VehicleState) -> Self {
        let (sin, cos) = libm::sincos(state.yaw_rad);
        let place = |ahead_m: f64| ahead_by(state, ahead_m, [sin, cos]);
        let is_person = state.kind == Kind::Person as u32;
        let rear_m = if is_person {
            -0.5 * f64::from(state.length_m)
        } else {
            -f64::from(state.rear_overhang_m)
        };
        let [forward, left, _] = state.velocity_body_mps.map(f64::from);
        let [vx, vy] = [cos * forward - sin * left, sin * forward + cos * left];
        Self {
            spine_m: [0.0, 0.5, 1.0].map(|share| place(rear_m + share * f64::from(state.length_m))),
            middle_m: match is_person {
                true => [state.x_m, state.y_m],
                false => place(f64::from(0.5 * state.length_m - state.rear_overhang_m)),
            },
            origin_m: [state.x_m, state.y_m],
            velocity_mps: [vx, vy],
            speed_mps: libm::sqrt(vx * vx + vy * vy),
            length_m: state.length_m,
            width_m: state.width_m,
            is_person,
        }
    }

    /// Speed along a direction of length one, m/s.
    #[must_use]
    pub fn speed_along(&self, [dx, dy]: [f64; 2]) -> f64 {
        let [vx, vy] = self.velocity_mps;
        vx * dx + vy * dy
    }
}
