//! The image of a camera: its size, its field of view, its lens, its mounting.

use std::{ops::Range, sync::Arc};

use ipc_schema::config::{CameraConfig, LensDistortion};

use super::raster::{BentRays, TILE_ROWS};
use crate::sensors::lidar::{sensor::SensorMount, simd::WIDTH};

/// A pinhole camera with square pixels, as configured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraParams {
    /// Columns of the image.
    pub width: usize,
    /// Rows of the image.
    pub height: usize,
    /// Horizontal field of view, degrees.
    pub horizontal_fov_deg: f64,
    /// Depth at which the image ends, metres: what is farther is sky.
    pub range_m: f64,
    /// Lens distortion: k1, k2, p1, p2, k3; zeros = a pinhole.
    pub distortion: [f64; 5],
    /// Where it is mounted: x, y, z from the centre of the rear axle on the ground (metres), then roll, pitch (nose up), yaw (radians).
    pub mount: [f64; 6],
    /// `None`: all rows show the end of the tick (global shutter).
    pub shutter: Option<RollingShutter>,
}

/// A shutter that reads the rows of an image one after the other, the last of them at the end of the tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RollingShutter {
    /// From the readout of the first row to that of the last one, seconds; at most a tick.
    pub readout_s: f64,
    /// Length of a tick, seconds.
    pub tick_s: f64,
}

impl CameraParams {
    /// As configured, in a run whose ticks take `tick_s`.
    #[must_use]
    pub fn new(camera: &CameraConfig, tick_s: f64) -> Self {
        Self {
            width: camera.width as usize,
            height: camera.height as usize,
            horizontal_fov_deg: camera.horizontal_fov_deg,
            range_m: camera.range_m,
            distortion: camera.distortion,
            mount: camera.mount,
            shutter: (camera.readout_s > 0.0).then_some(RollingShutter {
                readout_s: camera.readout_s,
                tick_s,
            }),
        }
    }
}

/// Rows of an image that show the world at one time.
#[derive(Debug, Clone)]
pub(super) struct ImageBand {
    /// Its rows of tiles and of pixels.
    pub(super) tiles: Range<usize>,
    pub(super) rows: Range<usize>,
    /// How long before the end of the tick it is read, seconds.
    pub(super) before_end_s: f64,
    /// Planes through the pinhole, their normals of length 1 into the band: ahead, right, left, top, bottom.
    pub(super) frustum: [[f64; 3]; 5],
}

impl ImageBand {
    /// Of these rows of tiles. The slopes of its rays are at most `a` to both sides, and those upwards lie between `low` and `high`.
    fn new(tiles: Range<usize>, height: usize, a: f64, [low, high]: [f64; 2]) -> Self {
        let [by_a, by_low, by_high] = [a, low, high].map(|slope| 1.0 / (1.0 + slope * slope).sqrt());
        Self {
            rows: tiles.start * TILE_ROWS..(tiles.end * TILE_ROWS).min(height),
            tiles,
            before_end_s: 0.0,
            frustum: [
                [1.0, 0.0, 0.0],
                [a * by_a, by_a, 0.0],
                [a * by_a, -by_a, 0.0],
                [high * by_high, 0.0, -by_high],
                [-low * by_low, 0.0, by_low],
            ],
        }
    }
}

/// A lens that bends rays.
#[derive(Debug, Clone)]
pub(super) struct CameraLens {
    distortion: LensDistortion,
    /// Slopes (left, up) of the ray of each pixel of the image's tiles.
    pub(super) rays: Arc<BentRays>,
    /// Square of the largest slope in the image: beyond it the model may fold.
    most2: f64,
}

impl CameraLens {
    fn new(distortion: LensDistortion, [width, height]: [usize; 2], focal_px: f64) -> Self {
        let tiles = [width.div_ceil(WIDTH), height.div_ceil(TILE_ROWS)];
        let slope = |u: usize, v: usize| {
            // Pixels beyond the edges are those at the edges: none of them is in the image.
            let (u, v) = (u.min(width - 1), v.min(height - 1));
            let x = (u as f64 + 0.5 - 0.5 * width as f64) / focal_px;
            let y = (v as f64 + 0.5 - 0.5 * height as f64) / focal_px;
            // Validated: a ray arrives at every pixel.
            let [x, y] = distortion.undistorted([x, y]).unwrap_or([x, y]);
            [-x, -y]
        };
        let mut most2 = 0.0_f64;
        for v in 0..height {
            for u in 0..width {
                let [a, b] = slope(u, v);
                most2 = most2.max(a * a + b * b);
            }
        }
        Self {
            distortion,
            rays: Arc::new(BentRays::new(tiles, |u, v| slope(u, v).map(|part| part as f32))),
            most2,
        }
    }

    /// Slopes of a point as the lens shows it. Points outside the image move outwards along their direction, so that boxes end there.
    pub(super) fn bent(&self, [a, b]: [f64; 2]) -> [f64; 2] {
        let slope2 = a * a + b * b;
        let shrink = if slope2 > self.most2 {
            (self.most2 / slope2).sqrt()
        } else {
            1.0
        };
        let [x, y] = self.distortion.distorted([-a * shrink, -b * shrink]);
        [-x / shrink, -y / shrink]
    }
}

/// A camera's parameters in the form that the kernel uses.
#[derive(Debug, Clone)]
pub(super) struct CameraOptics {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Distance of the pinhole from the image, pixels.
    pub(super) focal_px: f64,
    /// The optical axis in the image, from the upper left corner, pixels.
    pub(super) centre_px: [f64; 2],
    pub(super) range_m: f64,
    /// Longest ray, metres.
    pub(super) reach_m: f64,
    pub(super) mount: SensorMount,
    /// The lens; `None` of a pinhole.
    pub(super) lens: Option<CameraLens>,
    /// All rows.
    pub(super) whole: ImageBand,
    pub(super) shutter: Option<RollingShutter>,
    /// The rows of tiles of a rolling shutter, from the top; empty without one.
    pub(super) bands: Vec<ImageBand>,
}

impl CameraOptics {
    pub(super) fn new(params: &CameraParams) -> Self {
        let (width, height) = (params.width.max(1), params.height.max(1));
        let (sin, cos) = libm::sincos(0.5 * params.horizontal_fov_deg.to_radians());
        let focal_px = 0.5 * width as f64 * cos / sin;
        let centre_px = [0.5 * width as f64, 0.5 * height as f64];
        let lens = (params.distortion != [0.0; 5])
            .then(|| CameraLens::new(LensDistortion::new(params.distortion), [width, height], focal_px));
        let [a, b] = match &lens {
            None => centre_px.map(|half| half / focal_px),
            Some(lens) => lens.rays.most().map(f64::from),
        };
        let tile_rows = height.div_ceil(TILE_ROWS);
        let bands = (0..tile_rows).filter_map(|tile| {
            let shutter = params.shutter.as_ref()?;
            let rows = [tile * TILE_ROWS, ((tile + 1) * TILE_ROWS).min(height)];
            let slopes = match &lens {
                None => rows.map(|row| (centre_px[1] - row as f64) / focal_px),
                Some(lens) => {
                    let [low, high] = lens.rays.row_bounds[tile].map(f64::from);
                    [high, low]
                }
            };
            let mut band = ImageBand::new(tile..tile + 1, height, a, [slopes[1], slopes[0]]);
            let middle = 0.5 * (rows[0] + rows[1] - 1) as f64;
            let last = (height - 1) as f64;
            band.before_end_s = shutter.readout_s * (last - middle) / last.max(1.0);
            Some(band)
        });
        let bands = bands.collect();
        Self {
            width,
            height,
            focal_px,
            centre_px,
            range_m: params.range_m,
            reach_m: params.range_m * (1.0 + a * a + b * b).sqrt(),
            mount: SensorMount::new(params.mount),
            lens,
            whole: ImageBand::new(0..tile_rows, height, a, [-b, b]),
            shutter: params.shutter,
            bands,
        }
    }
}
