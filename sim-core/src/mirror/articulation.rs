//! The bodies behind the leading one of an articulated vehicle, tick by tick.
//!
//! A trailer is drawn by its pivot: its axle stays at the end of a rod and moves along it, exactly for a pivot that moves straight in
//! each sub-step (a tractrix: the kinematic model of a trailer whose wheels do not slip). A carriage stands with both bogies on the
//! path of the vehicle's front, the first one too. What follows does not push the leading body.
//!
//! The road's height is that of the leading body's origin when it was there.

use ipc_schema::{
    traffic::Kind,
    world::{APPEARED, RESYNCHRONISED, SubStep, VehicleState, trailing_index},
};

use crate::{
    models::articulation::{Carriages, TrailerBody, TrailingBodies},
    scene::shape::{Point, dot, from_to},
    trig::wrap_angle,
};

mod rod;
mod trail;

use rod::DrawnRod;
use trail::{RigidMotion, TRAIL_STEP_M, Trail};

/// Pose of a trailing body.
#[derive(Debug, Clone, Copy, Default)]
struct BodyPose {
    place_m: Point,
    yaw_rad: f64,
    z_m: f64,
    pitch_rad: f64,
}

/// The trailing bodies of one vehicle.
#[derive(Debug, Clone)]
pub(super) struct TrailingChain {
    shape: TrailingBodies,
    trail: Trail,
    /// Poses at the end of the last tick; empty before the first.
    poses: Vec<BodyPose>,
    /// Pose of the leading body at that time: place and heading.
    leading: (Point, f64),
    /// Its velocity then, world frame, m/s.
    leading_mps: Point,
}

impl TrailingChain {
    /// The trailing bodies of a vehicle; `None` if it has none and is not on rails.
    pub(super) fn new(shape: TrailingBodies) -> Option<Self> {
        (shape != TrailingBodies::None).then(|| Self {
            shape,
            trail: Trail::default(),
            poses: Vec::new(),
            leading: ([0.0; 2], 0.0),
            leading_mps: [0.0; 2],
        })
    }

    /// How many there are.
    pub(super) fn count(&self) -> usize {
        self.shape.count() as usize
    }

    /// The bodies are not in the message of a tick: they appear anew.
    pub(super) fn forget(&mut self) {
        self.poses.clear();
    }

    /// Moves the bodies to the end of a tick of `tick_s`, through which the leading body has moved as `leading` and `steps` say, and
    /// writes them into `out`, which has [`TrailingChain::count`] places. The leading body of a vehicle on rails is put onto them.
    pub(super) fn write_tick(
        &mut self,
        leading: &mut VehicleState,
        steps: &mut [SubStep],
        tick_s: f64,
        out: &mut [VehicleState],
    ) {
        let front = FrontOfBody::new(leading);
        let is_new = leading.flags & APPEARED != 0 || self.poses.is_empty() && self.count() > 0;
        let is_set = is_new || leading.flags & RESYNCHRONISED != 0;
        let before = std::mem::take(&mut self.poses);
        if is_new {
            self.place_behind(leading, &front);
        } else if is_set {
            self.poses = self.jumped(leading, &before);
        } else {
            self.follow(leading, &front, steps, &before);
            if let TrailingBodies::Carriages(carriages) = self.shape {
                self.put_on_rails(&carriages, &front, leading, steps, tick_s);
            }
        }
        self.leading = ([leading.x_m, leading.y_m], leading.yaw_rad);
        self.leading_mps = world_velocity(leading);
        self.trail
            .shorten(f64::from(leading.whole_length_m) + front.ahead_m.max(0.0) + TRAIL_STEP_M);
        for (number, (body, pose)) in out.iter_mut().zip(&self.poses).enumerate() {
            *body = self.state(leading, number, pose);
            let speed_mps = leading.velocity_body_mps[0];
            (body.velocity_body_mps, body.angular_rate_body_radps) = match before.get(number) {
                Some(from) if !is_set => pose.motion_since(from, tick_s),
                _ => ([speed_mps, 0.0, 0.0], [0.0; 3]),
            };
        }
    }

    /// Puts the leading body of a vehicle on rails onto the path that its front has driven, with both bogies, in every sub-step: the model
    /// keeps them there only where the path bends evenly. [`TrailingChain::follow`] has taken the path of the tick.
    fn put_on_rails(
        &mut self,
        carriages: &Carriages,
        front: &FrontOfBody,
        leading: &mut VehicleState,
        steps: &mut [SubStep],
        tick_s: f64,
    ) {
        let dt_s = tick_s / steps.len().max(1) as f64;
        // How far the front was behind its place of now.
        let fronts = steps.iter().map(|step| FrontOfBody::within(leading, step).place_m);
        let fronts: Vec<Point> = fronts.chain(steps.is_empty().then_some(front.place_m)).collect();
        let mut behind_m = vec![0.0; fronts.len()];
        for place in (1..fronts.len()).rev() {
            let way = from_to(fronts[place - 1], fronts[place]);
            behind_m[place - 1] = behind_m[place] + dot(way, way).sqrt();
        }
        let first_m = 0.5 * (carriages.length_m - carriages.bogies_m);
        let ways: Vec<RailPose> = behind_m
            .into_iter()
            .scan(
                (self.leading, self.leading_mps),
                |((place_m, yaw_rad), velocity_mps), behind_m| {
                    let [a, b] =
                        [0.0, carriages.bogies_m].map(|more_m| self.trail.at(behind_m + first_m + more_m).place_m);
                    let pose = RailPose::new([a, b], (*place_m, *yaw_rad), *velocity_mps, dt_s);
                    (*place_m, *yaw_rad, *velocity_mps) = (pose.place_m, pose.yaw_rad, pose.velocity_mps);
                    Some(pose)
                },
            )
            .collect();
        let Some(end) = ways.last() else { return };
        for (step, way) in steps.iter_mut().zip(&ways) {
            step.dx_m = (way.place_m[0] - end.place_m[0]) as f32;
            step.dy_m = (way.place_m[1] - end.place_m[1]) as f32;
            step.dyaw_rad = wrap_angle(way.yaw_rad - end.yaw_rad) as f32;
            [step.speed_mps, step.lateral_speed_mps] = way.in_body(way.velocity_mps);
            let [ahead, left] = way.in_body(way.accel_mps2);
            (step.accel_body_mps2[0], step.accel_body_mps2[1]) = (ahead, left);
            step.angular_rate_body_radps[2] = way.turn_radps as f32;
        }
        [leading.x_m, leading.y_m] = end.place_m;
        leading.yaw_rad = end.yaw_rad;
        let [[u, w], [ahead, left]] = [end.in_body(end.velocity_mps), end.in_body(end.accel_mps2)];
        (leading.velocity_body_mps[0], leading.velocity_body_mps[1]) = (u, w);
        (leading.accel_body_mps2[0], leading.accel_body_mps2[1]) = (ahead, left);
        leading.angular_rate_body_radps[2] = end.turn_radps as f32;
    }

    /// Places the bodies in a straight line behind a vehicle that appears.
    fn place_behind(&mut self, leading: &VehicleState, front: &FrontOfBody) {
        let far_m = f64::from(leading.whole_length_m) + front.ahead_m.abs();
        self.trail = Trail::straight(front, leading.z_m, libm::tan(leading.pitch_rad.into()), far_m);
        self.poses = match self.shape {
            TrailingBodies::None => Vec::new(),
            TrailingBodies::Trailer(body) => {
                let rod = DrawnRod {
                    length_m: body.hitch_to_axle_m,
                    front_m: front.at(body.hitch_ahead_m),
                    along: front.heading,
                };
                vec![self.trailer_pose(&body, front, &rod)]
            }
            TrailingBodies::Carriages(carriages) => self.carriage_poses(&carriages, front).collect(),
        };
    }

    /// The bodies of a vehicle that was set elsewhere: they move with it as if the joints were stiff.
    fn jumped(&mut self, leading: &VehicleState, before: &[BodyPose]) -> Vec<BodyPose> {
        let place = ([leading.x_m, leading.y_m], leading.yaw_rad);
        let (motion, rise_m) = (
            RigidMotion::new(self.leading, place),
            leading.z_m - self.trail.head.origin_z_m,
        );
        self.trail.moved(&motion, rise_m);
        let moved = before.iter().map(|pose| BodyPose {
            place_m: motion.of(pose.place_m),
            yaw_rad: wrap_angle(pose.yaw_rad + leading.yaw_rad - self.leading.1),
            z_m: pose.z_m + rise_m,
            ..*pose
        });
        moved.collect()
    }

    /// Moves the bodies behind the leading one, sub-step by sub-step.
    fn follow(&mut self, leading: &VehicleState, front: &FrontOfBody, steps: &[SubStep], before: &[BodyPose]) {
        let mut rod = match (&self.shape, before.first()) {
            (TrailingBodies::Trailer(body), Some(pose)) => Some((pose.rod(body.hitch_to_axle_m), body.hitch_ahead_m)),
            _ => None,
        };
        let ways = steps.iter().map(|step| FrontOfBody::within(leading, step));
        // The last sub-step is the end of the tick; without sub-steps the end is all there is.
        let end = steps.is_empty().then_some(*front);
        for way in ways.chain(end) {
            self.trail.advance(way.place_m, way.z_m);
            if let Some((rod, hitch_ahead_m)) = &mut rod {
                rod.draw(way.at(*hitch_ahead_m));
            }
        }
        self.poses = match self.shape {
            TrailingBodies::None => Vec::new(),
            TrailingBodies::Trailer(body) => rod
                .map(|(rod, _)| self.trailer_pose(&body, front, &rod))
                .into_iter()
                .collect(),
            TrailingBodies::Carriages(carriages) => self.carriage_poses(&carriages, front).collect(),
        };
    }

    fn trailer_pose(&self, body: &TrailerBody, front: &FrontOfBody, rod: &DrawnRod) -> BodyPose {
        // From the leading body's axle, which the road is known up to, to the trailer's.
        let apart_m = body.hitch_to_axle_m - body.hitch_ahead_m;
        let [ahead_z_m, z_m] = [front.ahead_m, front.ahead_m + apart_m].map(|behind_m| self.road_m(behind_m, front));
        BodyPose {
            place_m: rod.rear_m(),
            yaw_rad: libm::atan2(rod.along[1], rod.along[0]),
            z_m,
            pitch_rad: libm::atan2(ahead_z_m - z_m, apart_m),
        }
    }

    fn carriage_poses<'a>(
        &'a self,
        carriages: &'a Carriages,
        front: &'a FrontOfBody,
    ) -> impl Iterator<Item = BodyPose> + 'a {
        let Carriages {
            count,
            length_m,
            gap_m,
            bogies_m,
        } = *carriages;
        (1..=count).map(move |place| {
            let first_m = f64::from(place) * (length_m + gap_m) + 0.5 * (length_m - bogies_m);
            let bogies = [first_m, first_m + bogies_m];
            let [a, b] = bogies.map(|behind_m| self.trail.at(behind_m).place_m);
            let [z_a, z_b] = bogies.map(|behind_m| self.road_m(behind_m, front));
            BodyPose {
                place_m: [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])],
                yaw_rad: libm::atan2(a[1] - b[1], a[0] - b[0]),
                z_m: 0.5 * (z_a + z_b),
                pitch_rad: libm::atan2(z_a - z_b, bogies_m),
            }
        })
    }

    /// Height of the road `behind_m` behind the front, metres.
    fn road_m(&self, behind_m: f64, front: &FrontOfBody) -> f64 {
        self.trail.at((behind_m - front.ahead_m).max(0.0)).origin_z_m
    }

    /// The state of a body without its velocities.
    fn state(&self, leading: &VehicleState, number: usize, pose: &BodyPose) -> VehicleState {
        let (length_m, wheelbase_m, rear_overhang_m) = match self.shape {
            TrailingBodies::None => (0.0, 0.0, 0.0),
            TrailingBodies::Trailer(body) => (body.length_m, body.hitch_to_axle_m, body.rear_overhang_m),
            TrailingBodies::Carriages(body) => (body.length_m, 0.5 * body.bogies_m, 0.5 * body.length_m),
        };
        VehicleState {
            x_m: pose.place_m[0],
            y_m: pose.place_m[1],
            z_m: pose.z_m,
            yaw_rad: pose.yaw_rad,
            id_hash: leading.id_hash,
            // A fifth wheel and a joint carry the roll of the body ahead.
            roll_rad: leading.roll_rad,
            pitch_rad: pose.pitch_rad as f32,
            length_m: length_m as f32,
            width_m: leading.width_m,
            height_m: leading.height_m,
            wheelbase_m: wheelbase_m as f32,
            rear_overhang_m: rear_overhang_m as f32,
            whole_length_m: length_m as f32,
            signals: leading.signals,
            trailing: (self.shape.count() - number as u32 - 1) as u16,
            class: leading.class,
            vehicle: trailing_index(leading.vehicle, number as u32 + 1),
            kind: Kind::Trailing as u32,
            flags: leading.flags & (APPEARED | RESYNCHRONISED),
            ..VehicleState::default()
        }
    }
}

/// The leading body on rails at the end of a sub-step: pose, velocity (m/s) and acceleration (m/s²) in the world, and yaw rate (rad/s).
#[derive(Debug, Clone, Copy)]
struct RailPose {
    place_m: Point,
    yaw_rad: f64,
    velocity_mps: Point,
    accel_mps2: Point,
    turn_radps: f64,
}

impl RailPose {
    /// A body whose front and rear bogie are here, `dt_s` after it had the pose and the velocity of before.
    fn new([a, b]: [Point; 2], (from_m, from_rad): (Point, f64), from_mps: Point, dt_s: f64) -> Self {
        let place_m = [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])];
        let turn_rad = wrap_angle(libm::atan2(a[1] - b[1], a[0] - b[0]) - from_rad);
        let velocity_mps = from_to(from_m, place_m).map(|way_m| way_m / dt_s);
        Self {
            place_m,
            yaw_rad: wrap_angle(from_rad + turn_rad),
            velocity_mps,
            accel_mps2: from_to(from_mps, velocity_mps).map(|change| change / dt_s),
            turn_radps: turn_rad / dt_s,
        }
    }

    /// A vector of the world, forward and left.
    fn in_body(&self, [x, y]: Point) -> [f32; 2] {
        let (sin, cos) = libm::sincos(self.yaw_rad);
        [(cos * x + sin * y) as f32, (cos * y - sin * x) as f32]
    }
}

/// Velocity of the leading body's origin, world frame, m/s.
fn world_velocity(state: &VehicleState) -> Point {
    let (sin, cos) = libm::sincos(state.yaw_rad);
    let [ahead, left, _] = state.velocity_body_mps.map(f64::from);
    [cos * ahead - sin * left, sin * ahead + cos * left]
}

/// The leading body at one time.
#[derive(Debug, Clone, Copy)]
struct FrontOfBody {
    /// Its origin.
    origin_m: Point,
    z_m: f64,
    /// Cosine and sine of its heading.
    heading: Point,
    /// From its origin to its front, metres.
    ahead_m: f64,
    /// Its front.
    place_m: Point,
}

impl FrontOfBody {
    fn new(leading: &VehicleState) -> Self {
        Self::at_pose(leading, [leading.x_m, leading.y_m, leading.z_m], leading.yaw_rad)
    }

    /// At the end of a sub-step.
    fn within(leading: &VehicleState, step: &SubStep) -> Self {
        let [dx, dy, dz, dyaw] = [step.dx_m, step.dy_m, step.dz_m, step.dyaw_rad].map(f64::from);
        let place = [leading.x_m + dx, leading.y_m + dy, leading.z_m + dz];
        Self::at_pose(leading, place, leading.yaw_rad + dyaw)
    }

    fn at_pose(leading: &VehicleState, [x, y, z_m]: [f64; 3], yaw_rad: f64) -> Self {
        let (sin, cos) = libm::sincos(yaw_rad);
        let ahead_m = f64::from(leading.length_m - leading.rear_overhang_m);
        Self {
            origin_m: [x, y],
            z_m,
            heading: [cos, sin],
            ahead_m,
            place_m: [x + ahead_m * cos, y + ahead_m * sin],
        }
    }

    /// The point `ahead_m` ahead of its origin.
    fn at(&self, ahead_m: f64) -> Point {
        [0, 1].map(|axis: usize| self.origin_m[axis] + ahead_m * self.heading[axis])
    }
}

impl BodyPose {
    /// The rod of a trailer in this pose.
    fn rod(&self, length_m: f64) -> DrawnRod {
        let (sin, cos) = libm::sincos(self.yaw_rad);
        DrawnRod {
            length_m,
            front_m: [self.place_m[0] + length_m * cos, self.place_m[1] + length_m * sin],
            along: [cos, sin],
        }
    }

    /// Mean velocity (forward, left, up; m/s, in the axes of this pose) and angular rate (rad/s) since an earlier pose.
    fn motion_since(&self, before: &Self, dt_s: f64) -> ([f32; 3], [f32; 3]) {
        let rate = 1.0 / dt_s;
        let (sin, cos) = libm::sincos(self.yaw_rad);
        let [dx, dy] = [0, 1].map(|axis: usize| (self.place_m[axis] - before.place_m[axis]) * rate);
        let up = (self.z_m - before.z_m) * rate;
        let turn = wrap_angle(self.yaw_rad - before.yaw_rad) * rate;
        let velocity = [cos * dx + sin * dy, cos * dy - sin * dx, up];
        (velocity.map(|part| part as f32), [0.0, 0.0, turn as f32])
    }
}

#[cfg(test)]
mod tests;
