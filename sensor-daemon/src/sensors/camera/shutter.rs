//! Rolling shutters: an image whose rows show different times of a tick.
//!
//! The image is drawn in bands of eight rows, the rows of tiles of the kernel. Each band shows the camera and the road users at the time
//! at which its middle is read, so a row is at most three and a half rows early or late. What may be in the image at any of these times is found
//! once; each band looks at these bodies only.

use super::{
    BandShot, CameraShot,
    bodies::{CameraTargets, RoadUserBody, StillBodies},
    flow::PastPoses,
    optics::{CameraOptics, ImageBand, RollingShutter},
    resolve::PixelCount,
    view::{BodyBounds, CameraView},
};
use crate::sensors::lidar::{
    Targets,
    sensor::SensorPose,
    targets::{MovingTarget, TickMoment},
};

/// The tick during which a rolling shutter reads the rows of an image.
pub(super) struct RollingTick<'a> {
    pub(super) shutter: &'a RollingShutter,
    pub(super) targets: &'a Targets,
    /// Row of the carrier.
    pub(super) row: usize,
}

impl RollingTick<'_> {
    /// The camera that is at `now` at this moment of the tick, at the same moment of an earlier one; `None` if it was not there.
    pub(super) fn past_pose(
        &self,
        optics: &CameraOptics,
        now: &SensorPose,
        poses: &PastPoses,
        moment: &TickMoment,
    ) -> Option<SensorPose> {
        if self.row >= self.targets.road_users {
            // It stands beside the road.
            return Some(*now);
        }
        let pose = poses.of(self.targets.movers[self.row].object, Some(moment))?;
        Some(optics.mount.sensor(&pose))
    }
}

/// An image while a rolling shutter takes it: empty at first, then kept.
#[derive(Debug, Default)]
pub(super) struct RolledImage {
    /// Moment and camera of each band.
    pub(super) moments: Vec<TickMoment>,
    pub(super) poses: Vec<SensorPose>,
    /// Road users that may be in the image, in the order of their rows.
    pub(super) users: Vec<RolledUser>,
    /// Those that may be in the band, at its time, and the place of each in `users`.
    within: CameraTargets,
    places: Vec<u32>,
}

/// A road user that may be in an image.
#[derive(Debug)]
pub(super) struct RolledUser {
    pub(super) row: usize,
    /// A cylinder that it does not leave during the tick.
    reach: BodyBounds,
    /// Its pixels in the bands so far.
    pub(super) count: PixelCount,
}

/// How far a camera moves and turns during a tick, seen from its end.
struct CameraSway {
    shift_m: f64,
    /// Upper bound of the distance by which its turn moves a point, as a share of the distance of that point.
    turn: f64,
}

impl CameraSway {
    fn new(end: &SensorPose, poses: &[SensorPose]) -> Self {
        let shift = |pose: &SensorPose| -> f64 {
            let parts = pose.position_m.iter().zip(&end.position_m);
            parts.map(|(now, end)| (now - end) * (now - end)).sum()
        };
        // The Frobenius norm of a matrix is at least its largest stretch.
        let turn = |pose: &SensorPose| -> f64 {
            let parts = pose.world_from_sensor.as_flattened().iter();
            let parts = parts.zip(end.world_from_sensor.as_flattened());
            parts.map(|(now, end)| (now - end) * (now - end)).sum()
        };
        let most = |of: &dyn Fn(&SensorPose) -> f64| poses.iter().map(of).fold(0.0, f64::max).sqrt();
        Self {
            shift_m: most(&shift),
            turn: most(&turn),
        }
    }

    /// The bounds of a body, widened by what the camera's motion may change of its place.
    fn widened(&self, body: &BodyBounds, end: &SensorPose) -> BodyBounds {
        let [x, y, z] = end.position_m;
        let flat_m = libm::hypot(body.centre_m[0] - x, body.centre_m[1] - y) + body.radius_m;
        let height_m = (body.z_m[0] - z).abs().max((body.z_m[1] - z).abs());
        let slack_m = self.shift_m + self.turn * (flat_m + height_m + self.shift_m);
        BodyBounds {
            centre_m: body.centre_m,
            radius_m: body.radius_m + slack_m,
            z_m: [body.z_m[0] - slack_m, body.z_m[1] + slack_m],
        }
    }
}

impl RolledUser {
    fn new(row: usize, mover: &MovingTarget, shift_m: f64) -> Self {
        let [x, y, z] = mover.end.position_m;
        // About the origin, whatever the heading is.
        let half_m = libm::hypot(mover.front_m.max(-mover.rear_m), mover.half_width_m);
        Self {
            row,
            reach: BodyBounds {
                centre_m: [x, y],
                radius_m: half_m + shift_m,
                z_m: [z - shift_m, z + mover.height_m + shift_m],
            },
            count: PixelCount::NONE,
        }
    }
}

impl RolledImage {
    /// Begins an image. Replaces `near` by the bodies of the map that may be in it.
    pub(super) fn begin(
        &mut self,
        optics: &CameraOptics,
        tick: &RollingTick<'_>,
        bodies: &StillBodies,
        near: &mut Vec<u32>,
    ) {
        let RollingTick { shutter, targets, row } = *tick;
        let moments = optics
            .bands
            .iter()
            .map(|band| targets.moment(band.before_end_s, shutter.tick_s));
        self.moments.clear();
        self.moments.extend(moments);
        self.poses.clear();
        let carriers = self.moments.iter().map(|moment| targets.pose_at(row, moment));
        self.poses.extend(carriers.map(|carrier| optics.mount.sensor(&carrier)));
        let end = optics.mount.sensor(&targets.movers[row].end);
        let sway = CameraSway::new(&end, &self.poses);
        let view = CameraView {
            optics,
            band: &optics.whole,
            pose: end,
        };
        bodies.near(
            [end.position_m[0], end.position_m[1]],
            optics.reach_m + sway.shift_m,
            near,
        );
        near.retain(|number| view.may_see(&sway.widened(&bodies.bounds(*number), &end)));
        self.users.clear();
        for (user, mover) in targets.movers[..targets.road_users].iter().enumerate() {
            if user == row {
                continue;
            }
            let user = RolledUser::new(user, mover, targets.most_shift_m(user, shutter.tick_s));
            if view.may_see(&sway.widened(&user.reach, &end)) {
                self.users.push(user);
            }
        }
    }

    /// What a band is taken of: makes `within` the road users that may be in it.
    pub(super) fn band_shot<'a>(
        &'a mut self,
        (optics, band): (&'a CameraOptics, usize),
        tick: &RollingTick<'a>,
        shot: &CameraShot<'a>,
    ) -> BandShot<'a> {
        let (pose, moment) = (self.poses[band], self.moments[band]);
        let view = CameraView {
            optics,
            band: &optics.bands[band],
            pose,
        };
        self.within.clear();
        self.places.clear();
        for (place, user) in (0..).zip(&self.users) {
            if view.may_see(&user.reach) {
                let pose = tick.targets.pose_at(user.row, &moment);
                self.within.add(RoadUserBody::new(&tick.targets.movers[user.row], pose));
                self.places.push(place);
            }
        }
        let past = shot.past.and_then(|(_, poses)| {
            let past = tick.past_pose(optics, &pose, poses, &moment)?;
            Some((past, poses, Some(moment)))
        });
        BandShot {
            view,
            targets: &self.within,
            carrier: None,
            past,
            noise: shot.noise,
        }
    }

    /// Adds the pixels of a band: rows of `within`, and the pixels of each.
    pub(super) fn end_band(&mut self, rows: &[u32], counts: &[PixelCount]) {
        for (row, count) in rows.iter().zip(counts) {
            let place = self.places[*row as usize] as usize;
            self.users[place].count.add_all(count);
        }
    }
}

/// The band that reads a row of pixels, or the nearest one.
pub(super) fn band_of(bands: &[ImageBand], row_px: f64) -> usize {
    let is_below = |band: &&ImageBand| row_px >= band.rows.end as f64;
    bands.iter().take_while(is_below).count().min(bands.len() - 1)
}
