//! The image of a camera: its size, its field of view, its mounting.

use ipc_schema::config::CameraConfig;

use crate::sensors::lidar::sensor::SensorMount;

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
    /// Where it is mounted: x, y, z from the centre of the rear axle on the ground (metres), then roll, pitch (nose up), yaw (radians).
    pub mount: [f64; 6],
}

impl From<&CameraConfig> for CameraParams {
    fn from(camera: &CameraConfig) -> Self {
        Self {
            width: camera.width as usize,
            height: camera.height as usize,
            horizontal_fov_deg: camera.horizontal_fov_deg,
            range_m: camera.range_m,
            mount: camera.mount,
        }
    }
}

/// A camera's parameters in the form that the kernel uses.
#[derive(Debug, Clone, Copy)]
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
    /// Planes through the pinhole, their normals of length 1 into the image: ahead, right, left, top, bottom.
    pub(super) frustum: [[f64; 3]; 5],
}

impl CameraOptics {
    pub(super) fn new(params: &CameraParams) -> Self {
        let (width, height) = (params.width.max(1), params.height.max(1));
        let (sin, cos) = libm::sincos(0.5 * params.horizontal_fov_deg.to_radians());
        let focal_px = 0.5 * width as f64 * cos / sin;
        let centre_px = [0.5 * width as f64, 0.5 * height as f64];
        let [a, b] = centre_px.map(|half| half / focal_px);
        let [by_a, by_b] = [a, b].map(|slope| 1.0 / (1.0 + slope * slope).sqrt());
        Self {
            width,
            height,
            focal_px,
            centre_px,
            range_m: params.range_m,
            reach_m: params.range_m * (1.0 + a * a + b * b).sqrt(),
            mount: SensorMount::new(params.mount),
            frustum: [
                [1.0, 0.0, 0.0],
                [a * by_a, by_a, 0.0],
                [a * by_a, -by_a, 0.0],
                [b * by_b, 0.0, -by_b],
                [b * by_b, 0.0, by_b],
            ],
        }
    }
}
