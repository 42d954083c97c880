//! Cameras. How they work: docs/camera.md.

use serde::{Deserialize, Serialize};

use super::LensDistortion;
use crate::image::ImagePlane;

/// The camera of a vehicle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(clippy::struct_excessive_bools, reason = "the planes of an image, each by itself")]
pub struct CameraConfig {
    /// Vehicles that carry one: those in the first so many slots.
    pub vehicles: u32,
    /// Time between images, seconds.
    pub period_s: f64,
    /// Columns of an image.
    pub width: u32,
    /// Rows of an image.
    pub height: u32,
    /// Horizontal field of view, degrees.
    pub horizontal_fov_deg: f64,
    /// Depth at which an image ends, metres: what is farther is sky.
    pub range_m: f64,
    /// Lens distortion: k1, k2, p1, p2, k3 of Brown's model, as in OpenCV; zeros = a pinhole.
    pub distortion: [f64; 5],
    /// From the readout of the first row to that of the last one, which is the end of the tick, seconds; 0 = global shutter.
    pub readout_s: f64,
    /// Where it is mounted: x, y, z from the centre of the rear axle on the ground (metres), then roll, pitch (nose up), yaw (radians).
    pub mount: [f64; 6],
    /// Images have depths.
    pub depth: bool,
    /// Images have instances.
    pub instance: bool,
    /// Images have classes.
    pub semantic: bool,
    /// Images have colours.
    pub rgb: bool,
    /// Images have what is of interest in white.
    pub binary: bool,
    /// Images have apparent temperatures.
    pub infrared: bool,
    /// Images have the optical flow.
    pub flow: bool,
    /// Images have the events of a dynamic vision sensor.
    pub events: bool,
    /// Change of the logarithm of the brightness of a pixel that is an event.
    pub event_threshold: f64,
    /// Electrons of a pixel as bright as can be shown, whose number is random (shot noise); 0 = colours have no noise.
    pub full_well_e: f64,
    /// Standard deviation of the noise of reading a pixel, electrons.
    pub read_noise_e: f64,
    /// Standard deviation of the noise of apparent temperatures, kelvin.
    pub infrared_noise_k: f64,
    /// The plane that observations have of each image.
    pub observed: ObservedPlane,
    /// Length of a blackout, shortest and longest, seconds; [0, 0] = none.
    pub blackout_length_s: [f64; 2],
    /// Time between two blackouts, shortest and longest, seconds.
    pub blackout_gap_s: [f64; 2],
}

/// The plane of the newest image that stands in the observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ObservedPlane {
    /// None: observations hold no images.
    #[default]
    None,
    /// Classes.
    Semantic,
    /// Colours.
    Rgb,
    /// What is of interest in white.
    Binary,
}

impl ObservedPlane {
    /// The plane of an image; `None` where observations hold no images.
    #[must_use]
    pub const fn plane(self) -> Option<ImagePlane> {
        match self {
            Self::None => None,
            Self::Semantic => Some(ImagePlane::Semantic),
            Self::Rgb => Some(ImagePlane::Rgb),
            Self::Binary => Some(ImagePlane::Binary),
        }
    }
}

impl CameraConfig {
    /// Noise times `factor`: shot noise falls with the square root of the electrons.
    pub(crate) fn scale_noise(&mut self, factor: f64) {
        if factor > 0.0 {
            self.full_well_e /= factor * factor;
            // Of a pixel's full scale, as the electrons become fewer or more.
            self.read_noise_e /= factor;
        } else {
            self.full_well_e = 0.0;
        }
        self.infrared_noise_k *= factor;
    }

    /// Bytes of the image of one slot in an observation.
    #[must_use]
    pub fn observed_bytes(&self) -> usize {
        self.observed.plane().map_or(0, ImagePlane::pixel_bytes) * self.pixels()
    }

    /// Rows, columns and bytes of a pixel of the images in observations; `None` where they hold none.
    #[must_use]
    pub fn observed_shape(&self) -> Option<[usize; 3]> {
        let plane = self.observed.plane().filter(|_| self.vehicles > 0)?;
        Some([self.height as usize, self.width as usize, plane.pixel_bytes()])
    }

    /// Distance of the pinhole from the image, pixels: the field of view is that without distortion.
    #[must_use]
    pub fn focal_px(&self) -> f64 {
        0.5 * f64::from(self.width) / (0.5 * self.horizontal_fov_deg.to_radians()).tan()
    }

    /// A pixel of which the lens shows nothing, column and row: its model folds there. `None` if there is none.
    #[must_use]
    pub fn folded_pixel(&self) -> Option<[u32; 2]> {
        let lens = LensDistortion::new(self.distortion);
        let focal_px = self.focal_px();
        let is_folded = |[u, v]: &[u32; 2]| {
            let x = (f64::from(*u) + 0.5 - 0.5 * f64::from(self.width)) / focal_px;
            let y = (f64::from(*v) + 0.5 - 0.5 * f64::from(self.height)) / focal_px;
            lens.undistorted([x, y]).is_none()
        };
        let (right, bottom) = (self.width.saturating_sub(1), self.height.saturating_sub(1));
        // A fold lies about the axis, so it reaches an edge first.
        let columns = (0..self.width).flat_map(|u| [[u, 0], [u, bottom]]);
        let rows = (0..self.height).flat_map(|v| [[0, v], [right, v]]);
        columns.chain(rows).find(is_folded)
    }

    /// Pixels of an image.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}
