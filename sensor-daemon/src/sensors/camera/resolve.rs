//! From the surface that each pixel sees to the planes of the image, and the boxes of the road users in it.

use super::{
    flow::PixelMotion,
    ground::GroundMap,
    labels::SemanticLabel,
    light::Daylight,
    noise::ImageNoise,
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

    /// Adds the pixels of another part of the image.
    pub(super) fn add_all(&mut self, other: &Self) {
        self.pixels += other.pixels;
        let ([left, top, right, bottom], [l, t, r, b]) = (self.box_px, other.box_px);
        self.box_px = [left.min(l), top.min(t), right.max(r), bottom.max(b)];
    }

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
    pub(super) noise: Option<ImageNoise>,
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

/// The bits of sixteen pixels.
const ALL: u32 = (1 << WIDTH) - 1;

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
    /// All see the surface of the first.
    is_uniform: bool,
    /// Class of the pixels on the ground.
    label: [u8; WIDTH],
    /// Share of the light that reaches the camera.
    clear: Floats,
    /// Their place on the canvas.
    place: usize,
}

impl Resolver<'_> {
    /// Writes the rows of the view into the planes and counts the pixels of each road user into `counts`, one for each of the table's.
    #[inline(always)]
    pub(super) fn write<S: Simd>(&self, planes: &mut ImagePlanes<'_>, counts: &mut [PixelCount]) {
        let optics = self.view.optics;
        let axes = self.view.axes();
        for row in self.view.band.rows.clone() {
            let mut run = UserRun {
                user: NO_USER,
                first: 0,
            };
            for tile in 0..self.canvas.tiles[0] {
                let first = tile * WIDTH;
                let count = (optics.width - first).min(WIDTH);
                let pixels = self.sixteen::<S>(tile, row, &axes, planes);
                let at = row * optics.width + first;
                self.put::<S>(&pixels, at, count, planes);
                if let Some(infrared) = planes.infrared.get_mut(at..at + count) {
                    self.put_infrared::<S>(&pixels, infrared);
                }
                if let Some(flow_px) = planes.flow_px.get_mut(at..at + count) {
                    self.put_flow(&pixels, [tile, row], flow_px);
                }
                let is_same = |surface: u32| self.surfaces.surfaces[surface as usize].user == run.user;
                if pixels.is_uniform && is_same(pixels.surface.0[0]) {
                    continue;
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
            is_uniform: false,
            label: [SemanticLabel::Terrain as u8; WIDTH],
            clear: Floats::ZERO,
            place,
        };
        S::store(depth, &mut pixels.depth);
        let surface = S::load_words(&pixels.surface);
        pixels.is_uniform = S::bits(S::equal(surface, S::splat_words(pixels.surface.0[0]))) == ALL;
        let ground = S::equal(surface, S::splat_words(GROUND_SURFACE));
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

    /// Writes sixteen pixels, or fewer at the end of a row, into the planes of surfaces.
    #[inline(always)]
    fn put<S: Simd>(&self, pixels: &Pixels, at: usize, count: usize, planes: &mut ImagePlanes<'_>) {
        let table = &self.surfaces.surfaces;
        let first = &table[pixels.surface.0[0] as usize];
        if let Some(depth) = planes.depth_m.get_mut(at..at + count) {
            copy(&pixels.depth.0, depth);
        }
        if let Some(instance) = planes.instance.get_mut(at..at + count) {
            if pixels.is_uniform {
                copy(&[first.instance; WIDTH], instance);
            } else {
                copy(
                    &pixels.surface.0.map(|surface| table[surface as usize].instance),
                    instance,
                );
            }
        }
        if let Some(semantic) = planes.semantic.get_mut(at..at + count) {
            match (pixels.is_uniform, pixels.surface.0[0]) {
                (true, GROUND_SURFACE) => copy(&pixels.label, semantic),
                (true, _) => copy(&[first.label; WIDTH], semantic),
                (false, _) => copy(&std::array::from_fn(|element| self.label(pixels, element)), semantic),
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
        if planes.have_colours() {
            self.put_colours::<S>(pixels, at, count, planes);
        }
    }

    /// The class that a pixel sees.
    #[inline(always)]
    fn label(&self, pixels: &Pixels, element: usize) -> u8 {
        match pixels.surface.0[element] {
            GROUND_SURFACE => pixels.label[element],
            surface => self.surfaces.surfaces[surface as usize].label,
        }
    }

    #[inline(always)]
    fn put_colours<S: Simd>(&self, pixels: &Pixels, at: usize, count: usize, planes: &mut ImagePlanes<'_>) {
        let colour = |element: usize| match pixels.surface.0[element] {
            GROUND_SURFACE => &self.ground_colours[usize::from(pixels.label[element])],
            surface => &self.surfaces.surfaces[surface as usize].colour,
        };
        let mut parts = [Floats::ZERO; 3];
        if pixels.is_uniform && pixels.surface.0[0] != GROUND_SURFACE {
            let [red, green, blue] = colour(0);
            parts = [Floats([*red; WIDTH]), Floats([*green; WIDTH]), Floats([*blue; WIDTH])];
        } else {
            for element in 0..WIDTH {
                let [red, green, blue] = colour(element);
                (parts[0].0[element], parts[1].0[element], parts[2].0[element]) = (*red, *green, *blue);
            }
        }
        let (sky, clear) = (self.light.sky(), S::load(&pixels.clear));
        let red = S::splat(sky[0]) + clear * (S::load(&parts[0]) - S::splat(sky[0]));
        let green = S::splat(sky[1]) + clear * (S::load(&parts[1]) - S::splat(sky[1]));
        let blue = S::splat(sky[2]) + clear * (S::load(&parts[2]) - S::splat(sky[2]));
        if let Some(rgb) = planes.rgb.get_mut(at..at + count) {
            let [red, green, blue] = match &self.noise {
                Some(noise) => noise.colours::<S>(pixels.place, [red, green, blue]),
                None => [red, green, blue],
            };
            let (green, blue) = (S::left::<8>(byte::<S>(green)), S::left::<16>(byte::<S>(blue)));
            let mut words = Words::ZERO;
            S::store_words(S::or(S::or(byte::<S>(red), green), blue), &mut words);
            copy(
                &words.0.map(|word| [word as u8, (word >> 8) as u8, (word >> 16) as u8]),
                rgb,
            );
        }
        if let Some(brightness) = planes.brightness.get_mut(at..at + count) {
            // Rec. 709.
            let luminance = S::splat(0.2126) * red + S::splat(0.7152) * green + S::splat(0.0722) * blue;
            let mut to = Floats::ZERO;
            S::store(luminance, &mut to);
            copy(&to.0, brightness);
        }
    }

    /// Apparent temperatures of the pixels of a tile's row.
    #[inline(always)]
    fn put_infrared<S: Simd>(&self, pixels: &Pixels, infrared: &mut [u16]) {
        let mut clear = Floats::ZERO;
        let depths = S::load(&pixels.depth) * S::splat(self.thermal.extinction_per_m);
        S::store(crate::sensors::lidar::exp_minus::<S>(depths), &mut clear);
        let mut errors = Floats::ZERO;
        if let Some(noise) = &self.noise {
            S::store(noise.temperatures::<S>(pixels.place), &mut errors);
        }
        for (element, to) in infrared.iter_mut().enumerate() {
            let radiance = self.thermal.of(self.label(pixels, element));
            *to = self.thermal.pixel(radiance, clear.0[element], errors.0[element]);
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

/// The first of sixteen values; all of them without a call, which a copy of any length is.
#[inline(always)]
fn copy<T: Copy>(from: &[T; WIDTH], to: &mut [T]) {
    match to.first_chunk_mut::<WIDTH>() {
        Some(to) => *to = *from,
        None => to.copy_from_slice(&from[..to.len()]),
    }
}

/// Shares of 1 as whole numbers from 0 to 255, rounded to the nearest, halves up.
#[inline(always)]
fn byte<S: Simd>(share: S::F) -> S::U {
    let magic = S::splat(8_388_608.0);
    let value = share * S::splat(255.0) + S::splat(0.5);
    let value = S::min(S::max(value, S::splat(0.0)), S::splat(255.0));
    // The sum's mantissa holds the nearest whole number; one too many is taken off again.
    let nearest = (value + magic) - magic;
    let floor = S::select(S::lt(value, nearest), nearest - S::splat(1.0), nearest);
    S::minus(S::words(floor + magic), S::words(magic))
}

#[inline(always)]
fn end_run(run: UserRun, end: usize, row: usize, counts: &mut [PixelCount]) {
    if let Some(count) = counts.get_mut(usize::from(run.user))
        && end > run.first
    {
        count.add(run.first, end, row);
    }
}
