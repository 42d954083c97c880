//! From the surface that each pixel sees to the planes of the image, and the boxes of the road users in it.

use super::{
    flow::PixelMotion,
    ground::GroundMap,
    labels::SemanticLabel,
    light::Daylight,
    raster::{Canvas, GROUND_SURFACE, LinearForm, SKY_SURFACE},
    surfaces::{NO_USER, SurfaceTable},
    thermal::ThermalLight,
    view::CameraView,
};
use crate::sensors::lidar::simd::{Floats, Simd, WIDTH, Words};

/// The planes of an image, row by row from the upper left corner. A plane that is empty is not wanted.
#[derive(Debug, Default)]
pub struct ImagePlanes<'a> {
    /// Distance along the optical axis, metres; the camera's range where it sees the sky.
    pub depth_m: &'a mut [f32],
    /// Dense index of the road user; `STATIC_OBJECT` and the number of a building or prop; `GROUND`; or `SKY_INSTANCE`.
    pub instance: &'a mut [u32],
    /// A `SemanticLabel`.
    pub semantic: &'a mut [u8],
    /// Red, green, blue.
    pub rgb: &'a mut [[u8; 3]],
    /// 255 on road users and props of interest, else 0.
    pub binary: &'a mut [u8],
    /// Apparent temperature, hundredths of a kelvin.
    pub infrared: &'a mut [u16],
    /// Optical flow, pixels to the right and down.
    pub flow_px: &'a mut [[f32; 2]],
    /// Relative luminance of the colours, linear: what a dynamic vision sensor samples.
    pub brightness: &'a mut [f32],
}

impl ImagePlanes<'_> {
    /// True if a plane shows light.
    pub(super) fn have_colours(&self) -> bool {
        !self.rgb.is_empty() || !self.brightness.is_empty()
    }
}

/// Pixels of a road user that are in the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PixelCount {
    pub(super) pixels: u32,
    /// Left, top, right and bottom pixel.
    pub(super) box_px: [u16; 4],
}

impl PixelCount {
    pub(super) const NONE: Self = Self {
        pixels: 0,
        box_px: [u16::MAX, u16::MAX, 0, 0],
    };

    /// Adds a run of pixels in a row.
    fn add(&mut self, first: usize, end: usize, row: usize) {
        self.pixels += (end - first) as u32;
        let [left, top, right, bottom] = &mut self.box_px;
        (*left, *right) = ((*left).min(first as u16), (*right).max(end as u16 - 1));
        (*top, *bottom) = ((*top).min(row as u16), (*bottom).max(row as u16));
    }
}

/// What the planes of an image are made of.
pub(super) struct Resolver<'a> {
    pub(super) canvas: &'a Canvas,
    pub(super) view: CameraView<'a>,
    pub(super) surfaces: &'a SurfaceTable,
    pub(super) ground: &'a GroundMap,
    pub(super) light: &'a Daylight,
    /// Colours of the ground, by class.
    pub(super) ground_colours: &'a [[f32; 3]; 256],
    pub(super) thermal: &'a ThermalLight,
    pub(super) motions: &'a ImageMotions,
}

/// The motion of all that an image shows since an earlier time; `None` of what was not there.
#[derive(Debug, Default)]
pub(super) struct ImageMotions {
    pub(super) still: Option<PixelMotion>,
    /// One for each road user of the surface table.
    pub(super) users: Vec<Option<PixelMotion>>,
}

impl ImageMotions {
    fn of(&self, user: u16) -> Option<&PixelMotion> {
        match user {
            NO_USER => self.still.as_ref(),
            user => self.users.get(usize::from(user))?.as_ref(),
        }
    }
}

/// A run of pixels of one road user.
#[derive(Clone, Copy)]
struct UserRun {
    user: u16,
    first: usize,
}

/// Sixteen pixels.
struct Pixels {
    depth: Floats,
    surface: Words,
    /// Class of the pixels on the ground.
    label: [u8; WIDTH],
    /// Share of the light that reaches the camera.
    clear: Floats,
}

impl Resolver<'_> {
    /// Writes the planes and counts the pixels of each road user into `counts`, one for each of the table's.
    #[inline(always)]
    pub(super) fn write<S: Simd>(&self, planes: &mut ImagePlanes<'_>, counts: &mut [PixelCount]) {
        let optics = self.view.optics;
        let axes = self.view.axes();
        for row in 0..optics.height {
            let mut run = UserRun {
                user: NO_USER,
                first: 0,
            };
            for tile in 0..self.canvas.tiles[0] {
                let first = tile * WIDTH;
                let count = (optics.width - first).min(WIDTH);
                let pixels = self.sixteen::<S>(tile, row, &axes, planes);
                let at = row * optics.width + first;
                self.put(&pixels, at, count, planes);
                if let Some(infrared) = planes.infrared.get_mut(at..at + count) {
                    self.put_infrared::<S>(&pixels, infrared);
                }
                if let Some(flow_px) = planes.flow_px.get_mut(at..at + count) {
                    self.put_flow(&pixels, [tile, row], flow_px);
                }
                for (element, surface) in pixels.surface.0[..count].iter().enumerate() {
                    let user = self.surfaces.surfaces[*surface as usize].user;
                    if user != run.user {
                        end_run(run, first + element, row, counts);
                        run = UserRun {
                            user,
                            first: first + element,
                        };
                    }
                }
            }
            end_run(run, optics.width, row, counts);
        }
    }

    #[inline(always)]
    fn sixteen<S: Simd>(&self, tile: usize, row: usize, axes: &[LinearForm; 3], planes: &ImagePlanes<'_>) -> Pixels {
        let place = row * self.canvas.tiles[0] + tile;
        let depth = S::splat(1.0) / S::load(&self.canvas.inverse[place]);
        let mut pixels = Pixels {
            depth: Floats::ZERO,
            surface: self.canvas.surface[place],
            label: [SemanticLabel::Terrain as u8; WIDTH],
            clear: Floats::ZERO,
        };
        S::store(depth, &mut pixels.depth);
        let ground = S::equal(S::load_words(&pixels.surface), S::splat_words(GROUND_SURFACE));
        let needs_class = !planes.semantic.is_empty() || !planes.infrared.is_empty() || planes.have_colours();
        if needs_class && S::bits(ground) != 0 {
            self.classes::<S>(depth, tile, row, axes, S::bits(ground), &mut pixels.label);
        }
        if planes.have_colours() {
            let clear = crate::sensors::lidar::exp_minus::<S>(depth * S::splat(self.light.extinction_per_m));
            S::store(clear, &mut pixels.clear);
        }
        pixels
    }

    /// Classes of the ground that the pixels in `ground` see.
    #[inline(always)]
    fn classes<S: Simd>(
        &self,
        depth: S::F,
        tile: usize,
        row: usize,
        axes: &[LinearForm; 3],
        ground: u32,
        label: &mut [u8; WIDTH],
    ) {
        let [x_m, y_m, _] = self.view.pose.position_m;
        let origin = self.ground.place([x_m, y_m]);
        let per_m = S::splat(self.ground.cells_per_m() as f32);
        let [a, b] = self.canvas.rays::<S>(tile, row);
        let mut cells = [Words::ZERO; 2];
        for (axis, cells) in cells.iter_mut().enumerate() {
            let ray = axes[axis].along::<S>(a) + b * S::splat(axes[axis].0[2]);
            // Whole cells by adding 2²³: the sum's mantissa holds the nearest whole number. Half a cell makes that the cell's own number.
            let magic = S::splat(8_388_608.0);
            let cell = S::max(
                S::splat((origin[axis] - 0.5) as f32) + ray * depth * per_m,
                S::splat(0.0),
            );
            let cell = S::min(cell, S::splat(8_388_607.0)) + magic;
            S::store_words(S::minus(S::words(cell), S::splat_words(0x4B00_0000)), cells);
        }
        for (element, label) in label.iter_mut().enumerate() {
            if ground >> element & 1 == 1 {
                *label = self.ground.class(cells[0].0[element], cells[1].0[element]);
            }
        }
    }

    #[inline(always)]
    fn put(&self, pixels: &Pixels, at: usize, count: usize, planes: &mut ImagePlanes<'_>) {
        let table = &self.surfaces.surfaces;
        if let Some(depth) = planes.depth_m.get_mut(at..at + count) {
            depth.copy_from_slice(&pixels.depth.0[..count]);
        }
        if let Some(instance) = planes.instance.get_mut(at..at + count) {
            for (to, surface) in instance.iter_mut().zip(&pixels.surface.0) {
                *to = table[*surface as usize].instance;
            }
        }
        if let Some(semantic) = planes.semantic.get_mut(at..at + count) {
            for (element, to) in semantic.iter_mut().enumerate() {
                let surface = pixels.surface.0[element];
                *to = match surface {
                    GROUND_SURFACE => pixels.label[element],
                    _ => table[surface as usize].label,
                };
            }
        }
        if let Some(binary) = planes.binary.get_mut(at..at + count) {
            for (to, surface) in binary.iter_mut().zip(&pixels.surface.0) {
                *to = if table[*surface as usize].is_interesting {
                    255
                } else {
                    0
                };
            }
        }
        if !planes.have_colours() {
            return;
        }
        let sky = self.light.sky();
        let colour = |element: usize| {
            let surface = pixels.surface.0[element];
            let colour = match surface {
                GROUND_SURFACE => &self.ground_colours[usize::from(pixels.label[element])],
                _ => &table[surface as usize].colour,
            };
            let clear = pixels.clear.0[element];
            [0, 1, 2].map(|i: usize| sky[i] + clear * (colour[i] - sky[i]))
        };
        if let Some(rgb) = planes.rgb.get_mut(at..at + count) {
            for (element, to) in rgb.iter_mut().enumerate() {
                *to = colour(element).map(|part| (part * 255.0 + 0.5).clamp(0.0, 255.0) as u8);
            }
        }
        if let Some(brightness) = planes.brightness.get_mut(at..at + count) {
            for (element, to) in brightness.iter_mut().enumerate() {
                // Rec. 709.
                let [red, green, blue] = colour(element);
                *to = 0.2126 * red + 0.7152 * green + 0.0722 * blue;
            }
        }
    }

    /// Apparent temperatures of the pixels of a tile's row.
    #[inline(always)]
    fn put_infrared<S: Simd>(&self, pixels: &Pixels, infrared: &mut [u16]) {
        let mut clear = Floats::ZERO;
        let depths = S::load(&pixels.depth) * S::splat(self.thermal.extinction_per_m);
        S::store(crate::sensors::lidar::exp_minus::<S>(depths), &mut clear);
        for (element, to) in infrared.iter_mut().enumerate() {
            let radiance = match pixels.surface.0[element] {
                GROUND_SURFACE => self.thermal.of(pixels.label[element]),
                surface => self.thermal.of(self.surfaces.surfaces[surface as usize].label),
            };
            *to = self.thermal.pixel(radiance, clear.0[element]);
        }
    }

    /// Optical flow of the pixels of a tile's row.
    #[inline(always)]
    fn put_flow(&self, pixels: &Pixels, [tile, row]: [usize; 2], flow_px: &mut [[f32; 2]]) {
        let optics = self.view.optics;
        let inverses = &self.canvas.inverse[row * self.canvas.tiles[0] + tile];
        for (element, to) in flow_px.iter_mut().enumerate() {
            let surface = pixels.surface.0[element];
            let seen = &self.surfaces.surfaces[surface as usize];
            // The sky is infinitely far away.
            let inverse = if surface == SKY_SURFACE {
                0.0
            } else {
                inverses.0[element]
            };
            *to = match self.motions.of(seen.user) {
                Some(motion) => motion.flow_px(self.canvas.ray(tile, row, element), inverse, optics),
                None => [f32::NAN; 2],
            };
        }
    }
}

#[inline(always)]
fn end_run(run: UserRun, end: usize, row: usize, counts: &mut [PixelCount]) {
    if let Some(count) = counts.get_mut(usize::from(run.user))
        && end > run.first
    {
        count.add(run.first, end, row);
    }
}
