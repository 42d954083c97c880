//! Boxes of the road users in an image, with the fields of KITTI's labels (A. Geiger, P. Lenz and R. Urtasun, *Are we ready for
//! Autonomous Driving? The KITTI Vision Benchmark Suite*, CVPR 2012).

use std::ops::Range;

use ipc_schema::image::SeenObject;

use super::{
    bodies::RoadUserBody,
    optics::CameraOptics,
    resolve::PixelCount,
    shutter::{RolledImage, RolledUser, band_of},
    surfaces::SeenBody,
    view::CameraView,
};
use crate::sensors::lidar::Targets;

/// Nearest depth at which a corner is projected, metres.
const NEAREST_M: f64 = 0.05;
/// Most times that the band of a corner is looked for.
const MOST_LOOKS: usize = 4;

/// Bounds of the corners of a body in the image.
struct CornerBounds {
    low_px: [f64; 2],
    high_px: [f64; 2],
    depth_m: [f64; 2],
}

/// A corner in the image: column and row from the upper left, pixels, and its depth, metres.
type SeenCorner = [f64; 3];

fn seen_corner([x, y, z]: [f64; 3], optics: &CameraOptics) -> SeenCorner {
    let inverse = 1.0 / x.max(NEAREST_M);
    let slopes = [y * inverse, z * inverse];
    let [a, b] = optics.lens.as_ref().map_or(slopes, |lens| lens.bent(slopes));
    [
        optics.centre_px[0] - a * optics.focal_px,
        optics.centre_px[1] - b * optics.focal_px,
        x,
    ]
}

impl CornerBounds {
    const NONE: Self = Self {
        low_px: [f64::INFINITY; 2],
        high_px: [f64::NEG_INFINITY; 2],
        depth_m: [f64::INFINITY, f64::NEG_INFINITY],
    };

    fn add(&mut self, [u, v, depth_m]: SeenCorner) {
        self.depth_m = [self.depth_m[0].min(depth_m), self.depth_m[1].max(depth_m)];
        for (axis, pixel) in [u, v].into_iter().enumerate() {
            self.low_px[axis] = self.low_px[axis].min(pixel);
            self.high_px[axis] = self.high_px[axis].max(pixel);
        }
    }

    fn entry(&self, body: &SeenBody, count: &PixelCount, optics: &CameraOptics) -> SeenObject {
        let (low, high) = (self.low_px, self.high_px);
        let size = [optics.width as f64, optics.height as f64];
        let inside = |axis: usize| (high[axis].min(size[axis]) - low[axis].max(0.0)).max(0.0);
        let area = (high[0] - low[0]) * (high[1] - low[1]);
        SeenObject {
            object: body.instance,
            label: body.label.into(),
            visible_px: count.pixels,
            visible_box_px: count.box_px,
            full_box_px: [low[0], low[1], high[0], high[1]].map(|pixel| pixel as f32),
            truncated: (1.0 - inside(0) * inside(1) / area.max(1e-9)).clamp(0.0, 1.0) as f32,
            depth_m: self.depth_m.map(|part| part as f32),
        }
    }
}

/// The entry of a road user.
pub(super) fn seen_object(view: &CameraView<'_>, user: &RoadUserBody, count: &PixelCount) -> SeenObject {
    let mut bounds = CornerBounds::NONE;
    user.corners(view, |corner| bounds.add(seen_corner(corner, view.optics)));
    bounds.entry(&user.body, count, view.optics)
}

/// Corners of a road user at the times of the bands of a rolling shutter: empty at first, then kept.
#[derive(Debug, Default)]
pub(super) struct RolledCorners {
    /// The bands that have been asked for, and the place of the first corner of each.
    bands: Vec<(usize, usize)>,
    corners: Vec<SeenCorner>,
}

impl RolledCorners {
    fn clear(&mut self) {
        self.bands.clear();
        self.corners.clear();
    }

    /// Places of the corners at the time of a band. `find` appends them if they are not known.
    fn of(&mut self, band: usize, find: impl FnOnce(&mut Vec<SeenCorner>)) -> Range<usize> {
        let each = self.bands.get(1).map_or(self.corners.len(), |(_, second)| *second);
        if let Some((_, first)) = self.bands.iter().find(|(known, _)| *known == band) {
            return *first..first + each;
        }
        let first = self.corners.len();
        find(&mut self.corners);
        self.bands.push((band, first));
        first..self.corners.len()
    }
}

/// The entry of a road user in an image of a rolling shutter: each corner is at the place where the shutter sees it, if nothing hides it.
pub(super) fn rolled_object(
    optics: &CameraOptics,
    image: &RolledImage,
    user: &RolledUser,
    targets: &Targets,
    corners: &mut RolledCorners,
) -> SeenObject {
    let mover = &targets.movers[user.row];
    let body = |band: usize| RoadUserBody::new(mover, targets.pose_at(user.row, &image.moments[band]));
    let find = |band: usize| {
        move |found: &mut Vec<SeenCorner>| {
            let view = CameraView {
                optics,
                band: &optics.bands[band],
                pose: image.poses[band],
            };
            body(band).corners(&view, |corner| found.push(seen_corner(corner, optics)));
        }
    };
    let [_, top, _, bottom] = user.count.box_px.map(f64::from);
    let middle = band_of(&optics.bands, 0.5 * (top + bottom));
    corners.clear();
    let mut bounds = CornerBounds::NONE;
    for corner in 0..corners.of(middle, find(middle)).len() {
        let mut band = middle;
        let mut seen = corners.corners[corner];
        // The time at which a corner is read is that of its row, which depends on the time.
        for _ in 0..MOST_LOOKS {
            let next = band_of(&optics.bands, seen[1]);
            if next == band {
                break;
            }
            band = next;
            let places = corners.of(band, find(band));
            seen = corners.corners[places.start + corner];
        }
        bounds.add(seen);
    }
    bounds.entry(&body(middle).body, &user.count, optics)
}
