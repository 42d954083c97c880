//! Optical flow: how far what a pixel shows has moved in the image since an earlier time.
//!
//! With the ray `r = (1, a, b)` of a pixel and its inverse depth `i`, the point that it shows lies at `r / i` in the camera's frame. At
//! the earlier time the same point of the same body lay at `(M r + t i) / i`, where `M` and `t` follow from the poses of camera and body
//! at both times. So the earlier pixel is that of `M r + t i`: one linear function for each body, the sky included (`i` = 0).

use super::optics::CameraOptics;
use crate::sensors::lidar::{
    Targets,
    sensor::{Rotation, SensorPose, turned},
    targets::{Pose, TickMoment},
};

/// Where road users were at an earlier time.
#[derive(Debug, Clone, Default)]
pub struct PastPoses {
    /// Dense index and row, in the order of the indices.
    rows: Vec<(u32, u32)>,
    targets: Targets,
}

impl PastPoses {
    /// Replaces the poses by those of the tick of `targets`.
    pub fn record(&mut self, targets: &Targets) {
        self.targets.copy_from(targets);
        self.rows.clear();
        let road_users = (0..).zip(&targets.movers[..targets.road_users]);
        self.rows.extend(road_users.map(|(row, mover)| (mover.object, row)));
        self.rows.sort_unstable();
    }

    /// Pose of a road user at a moment of the tick, `None` being its end.
    pub(in crate::sensors) fn of(&self, vehicle: u32, moment: Option<&TickMoment>) -> Option<Pose> {
        let place = self.rows.binary_search_by_key(&vehicle, |(known, _)| *known).ok()?;
        let row = self.rows[place].1 as usize;
        Some(match moment {
            None => self.targets.movers[row].end,
            Some(moment) => self.targets.pose_at(row, moment),
        })
    }
}

/// From a pixel to its place at the earlier time.
#[derive(Debug, Clone, Copy)]
pub(super) struct PixelMotion {
    /// `M`, by rows.
    matrix: [[f32; 3]; 3],
    /// `t`, metres.
    shift_m: [f32; 3],
}

impl PixelMotion {
    /// Of what stands still, between two poses of the camera.
    pub(super) fn of_still(now: &SensorPose, past: &SensorPose) -> Self {
        let off_m = std::array::from_fn(|i| now.position_m[i] - past.position_m[i]);
        Self::new(&now.world_from_sensor, past, off_m)
    }

    /// Of a body that has moved from `body_past` to `body_now`. Bodies stay upright, as cameras draw them.
    pub(super) fn of_body(
        now: &SensorPose,
        past: &SensorPose,
        body_now: &Pose,
        body_past: &Pose,
        is_round: bool,
    ) -> Self {
        // A cylinder shows no turn about its own axis.
        let turn = if is_round {
            0.0
        } else {
            body_past.attitude_rad[2] - body_now.attitude_rad[2]
        };
        let (sin, cos) = libm::sincos(turn);
        let turned_back = |[x, y, z]: [f64; 3]| [cos * x - sin * y, sin * x + cos * y, z];
        let [x, y, z] = &now.world_from_sensor;
        let rows: Rotation = [
            std::array::from_fn(|i| cos * x[i] - sin * y[i]),
            std::array::from_fn(|i| sin * x[i] + cos * y[i]),
            *z,
        ];
        let arm_m = turned_back(std::array::from_fn(|i| now.position_m[i] - body_now.position_m[i]));
        let off_m = std::array::from_fn(|i| arm_m[i] + body_past.position_m[i] - past.position_m[i]);
        Self::new(&rows, past, off_m)
    }

    /// From the camera's axes in the world, moved as the body has moved, and its place beside the earlier camera.
    fn new(axes: &Rotation, past: &SensorPose, off_m: [f64; 3]) -> Self {
        let back = &past.world_from_sensor;
        let transposed: Rotation = std::array::from_fn(|i| std::array::from_fn(|j| back[j][i]));
        let columns: Rotation = std::array::from_fn(|j| turned(&transposed, std::array::from_fn(|i| axes[i][j])));
        Self {
            matrix: std::array::from_fn(|i| std::array::from_fn(|j| columns[j][i] as f32)),
            shift_m: turned(&transposed, off_m).map(|part| part as f32),
        }
    }

    /// Flow of the pixel with the ray (1, `a`, `b`) and this inverse depth, pixels to the right and down; not a number if the point was
    /// not in front of the camera.
    #[inline(always)]
    pub(super) fn flow_px(&self, [a, b]: [f32; 2], inverse: f32, optics: &CameraOptics) -> [f32; 2] {
        let [x, y, z] = [0, 1, 2].map(|i: usize| {
            let row = &self.matrix[i];
            row[0] + row[1] * a + row[2] * b + self.shift_m[i] * inverse
        });
        if x <= 0.0 {
            return [f32::NAN; 2];
        }
        let focal_px = optics.focal_px as f32;
        match &optics.lens {
            None => [focal_px * (y / x - a), focal_px * (z / x - b)],
            Some(lens) => {
                let [before, now] = [[y / x, z / x], [a, b]].map(|slopes| lens.bent(slopes.map(f64::from)));
                std::array::from_fn(|i| focal_px * (before[i] - now[i]) as f32)
            }
        }
    }
}
