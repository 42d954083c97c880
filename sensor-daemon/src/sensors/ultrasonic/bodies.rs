//! Road users as ultrasonic sensors hear them: boxes, and cylinders for persons, sorted by place.

use ipc_schema::{traffic::Kind, world::VehicleState};
use sim_core::scene::shape::{OrientedBox, Point};

use super::cone::EchoSearch;

/// Outline of a road user.
#[derive(Debug, Clone, Copy, PartialEq)]
enum BodyOutline {
    /// A vehicle: corners, counter-clockwise.
    Box([Point; 4]),
    /// A person: radius, metres.
    Round(f64),
}

/// A road user at the end of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MovingBody {
    /// Its row in the world.
    pub(super) row: usize,
    pub(super) centre_m: Point,
    /// Radius of the circle about its outline, metres.
    pub(super) reach_m: f64,
    /// Lowest and highest point, metres.
    z_m: [f64; 2],
    outline: BodyOutline,
}

/// All road users of a tick, from west to east.
#[derive(Debug, Clone, Default)]
pub(super) struct MovingBodies {
    sorted: Vec<MovingBody>,
    most_reach_m: f64,
}

impl MovingBody {
    fn new(row: usize, state: &VehicleState) -> Self {
        let [length_m, width_m, rear_m] = [state.length_m, state.width_m, state.rear_overhang_m].map(f64::from);
        let z_m = [state.z_m, state.z_m + f64::from(state.height_m)];
        if state.kind == Kind::Person as u32 {
            let radius_m = 0.5 * length_m.max(width_m);
            return Self {
                row,
                centre_m: [state.x_m, state.y_m],
                reach_m: radius_m,
                z_m,
                outline: BodyOutline::Round(radius_m),
            };
        }
        let (sin, cos) = libm::sincos(state.yaw_rad);
        let ahead_m = 0.5 * length_m - rear_m;
        let body = OrientedBox {
            centre_m: [state.x_m + ahead_m * cos, state.y_m + ahead_m * sin],
            along: [cos, sin],
            half_m: [0.5 * length_m, 0.5 * width_m],
            z_m,
        };
        Self {
            row,
            centre_m: body.centre_m,
            reach_m: 0.5 * (length_m * length_m + width_m * width_m).sqrt(),
            z_m,
            outline: BodyOutline::Box(body.corners()),
        }
    }

    /// Adds the body to a search.
    pub(super) fn reflect(&self, search: &mut EchoSearch) {
        match &self.outline {
            BodyOutline::Box(corners_m) => search.prism(corners_m, self.z_m),
            BodyOutline::Round(radius_m) => search.cylinder(self.centre_m, *radius_m, self.z_m),
        }
    }
}

impl MovingBodies {
    /// Replaces the bodies by those of a tick.
    pub(super) fn update(&mut self, states: &[VehicleState]) {
        self.sorted.clear();
        let bodies = states.iter().enumerate();
        self.sorted
            .extend(bodies.map(|(row, state)| MovingBody::new(row, state)));
        let order = |a: &MovingBody, b: &MovingBody| a.centre_m[0].total_cmp(&b.centre_m[0]).then(a.row.cmp(&b.row));
        self.sorted.sort_unstable_by(order);
        self.most_reach_m = self.sorted.iter().map(|body| body.reach_m).fold(0.0, f64::max);
    }

    /// The bodies whose circles may be within `range_m` of `place_m`.
    pub(super) fn near(&self, place_m: Point, range_m: f64) -> impl Iterator<Item = &MovingBody> {
        let reach_m = range_m + self.most_reach_m;
        let first = self
            .sorted
            .partition_point(|body| body.centre_m[0] < place_m[0] - reach_m);
        let in_reach = self.sorted[first..]
            .iter()
            .take_while(move |body| body.centre_m[0] <= place_m[0] + reach_m);
        in_reach.filter(move |body| {
            let [x, y] = [0, 1].map(|axis: usize| body.centre_m[axis] - place_m[axis]);
            let far_m = range_m + body.reach_m;
            x * x + y * y <= far_m * far_m
        })
    }
}
