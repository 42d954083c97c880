//! Road users as heroes see them: what does not depend on the hero is computed once in a tick.

use ipc_schema::{traffic::Kind, world::VehicleState};

use super::{PERSON_ROOM_M, ahead_by};

/// Bits of SUMO's vehicle signals.
const BLINKS_RIGHT: u32 = 1;
const BLINKS_LEFT: u32 = 2;

/// All road users of a tick, in their rows.
#[derive(Debug, Clone, Default)]
pub struct TickBodies {
    bodies: Vec<TickBody>,
    /// Their origins side by side: most are only compared by distance.
    origins_m: Vec<[f64; 2]>,
    /// Discs that hold each with the room beside it: x and y of the middle, and the radius, metres.
    discs_m: Vec<[f64; 3]>,
}

impl TickBodies {
    /// The bodies of these states.
    #[must_use]
    pub fn of(states: &[VehicleState]) -> Self {
        let bodies: Vec<TickBody> = states.iter().map(TickBody::of).collect();
        let disc = |body: &TickBody| {
            let [x_m, y_m] = body.spine_m[1];
            let half_m = 0.5 * (f64::from(body.length_m) + f64::from(body.width_m));
            [x_m, y_m, half_m + PERSON_ROOM_M]
        };
        Self {
            origins_m: bodies.iter().map(|body| body.origin_m).collect(),
            discs_m: bodies.iter().map(disc).collect(),
            bodies,
        }
    }

    /// The body in a row.
    #[must_use]
    pub fn body(&self, row: usize) -> &TickBody {
        &self.bodies[row]
    }

    /// Rows of the bodies whose origins are nearer than `within_m` to a point, ascending.
    pub fn near(&self, [x_m, y_m]: [f64; 2], within_m: f64) -> impl Iterator<Item = usize> {
        let square_m2 = within_m * within_m;
        let is_near = move |[ox, oy]: &[f64; 2]| {
            let (dx, dy) = (ox - x_m, oy - y_m);
            dx * dx + dy * dy < square_m2
        };
        let rows = self.origins_m.iter().enumerate();
        rows.filter(move |(_, origin)| is_near(origin)).map(|(row, _)| row)
    }

    /// Middle of the disc that holds the body in a row with the room beside it, and its radius, metres. Rows are in their order.
    pub fn discs(&self) -> impl Iterator<Item = ([f64; 2], f64)> {
        self.discs_m
            .iter()
            .map(|[x_m, y_m, radius_m]| ([*x_m, *y_m], *radius_m))
    }
}

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
    /// Cosine and sine of its heading.
    pub heading: [f64; 2],
    /// Rate of its heading, rad/s.
    pub yaw_rate_radps: f64,
    /// What it indicates: 1 a turn to the left, -1 to the right, 0 neither or both.
    pub turn: f32,
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
            heading: [cos, sin],
            yaw_rate_radps: f64::from(state.angular_rate_body_radps[2]),
            turn: match state.signals & (BLINKS_RIGHT | BLINKS_LEFT) {
                BLINKS_LEFT => 1.0,
                BLINKS_RIGHT => -1.0,
                _ => 0.0,
            },
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
