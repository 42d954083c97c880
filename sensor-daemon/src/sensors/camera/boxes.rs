//! Boxes of the road users in an image, with the fields of KITTI's labels (A. Geiger, P. Lenz and R. Urtasun, *Are we ready for
//! Autonomous Driving? The KITTI Vision Benchmark Suite*, CVPR 2012).

use ipc_schema::image::SeenObject;

use super::{bodies::CameraTargets, resolve::PixelCount, view::CameraView};

/// Nearest depth at which a corner is projected, metres.
const NEAREST_M: f64 = 0.05;

/// The entry of the road user in `row`.
pub(super) fn seen_object(
    view: &CameraView<'_>,
    targets: &CameraTargets,
    row: usize,
    (object, label): (u32, u8),
    count: &PixelCount,
) -> SeenObject {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let mut depth_m = [f64::INFINITY, f64::NEG_INFINITY];
    let optics = view.optics;
    targets.corners(view, row, |[x, y, z]| {
        depth_m = [depth_m[0].min(x), depth_m[1].max(x)];
        let inverse = 1.0 / x.max(NEAREST_M);
        let slopes = [y * inverse, z * inverse];
        let [a, b] = optics.lens.as_ref().map_or(slopes, |lens| lens.bent(slopes));
        let pixel = [
            optics.centre_px[0] - a * optics.focal_px,
            optics.centre_px[1] - b * optics.focal_px,
        ];
        for axis in 0..2 {
            (low[axis], high[axis]) = (low[axis].min(pixel[axis]), high[axis].max(pixel[axis]));
        }
    });
    let size = [optics.width as f64, optics.height as f64];
    let inside = |axis: usize| (high[axis].min(size[axis]) - low[axis].max(0.0)).max(0.0);
    let area = (high[0] - low[0]) * (high[1] - low[1]);
    SeenObject {
        object,
        label: label.into(),
        visible_px: count.pixels,
        visible_box_px: count.box_px,
        full_box_px: [low[0], low[1], high[0], high[1]].map(|pixel| pixel as f32),
        truncated: (1.0 - inside(0) * inside(1) / area.max(1e-9)).clamp(0.0, 1.0) as f32,
        depth_m: depth_m.map(|part| part as f32),
    }
}
