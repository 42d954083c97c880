//! Noise of pixels: of the light itself, of reading it, and of apparent temperatures.
//!
//! The linear model of EMVA Standard 1288 (release 4.0, section 2): a pixel collects electrons, whose number has a Poisson distribution,
//! here a normal one with the same variance; reading it adds a normal error. Colours are shares of the full well.

use ipc_schema::sensor::NoiseStream;

use crate::sensors::lidar::{ScanKey, draw, simd::Simd};

/// Noise of the pixels of a camera.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PixelNoise {
    /// Electrons of a pixel as bright as can be shown; 0 = colours have no noise.
    pub full_well_e: f32,
    /// Standard deviation of the noise of reading a pixel, electrons.
    pub read_noise_e: f32,
    /// Standard deviation of apparent temperatures, kelvin.
    pub infrared_k: f32,
}

/// The noise of one image.
#[derive(Debug, Clone, Copy)]
pub struct ImageNoise {
    pixels: PixelNoise,
    key: ScanKey,
}

impl ImageNoise {
    /// A function of the episode, the carrier, the tick and the pixel; `None` if pixels have no noise.
    #[must_use]
    pub fn new(pixels: PixelNoise, episode_seed: u64, id_hash: u64, tick: u64) -> Option<Self> {
        let is_noisy = pixels.full_well_e > 0.0 || pixels.infrared_k > 0.0;
        is_noisy.then(|| Self {
            pixels,
            key: ScanKey::of(NoiseStream::Camera, episode_seed, id_hash, tick),
        })
    }

    /// Colours as they are read, from shares of the full well, of the sixteen pixels of a place of the canvas.
    #[inline(always)]
    pub(super) fn colours<S: Simd>(&self, place: usize, [red, green, blue]: [S::F; 3]) -> [S::F; 3] {
        if self.pixels.full_well_e <= 0.0 {
            return [red, green, blue];
        }
        let (first, second) = self.draws::<S>(place);
        let ([a, b], [c, _]) = (first, second);
        [
            self.read::<S>(red, a),
            self.read::<S>(green, b),
            self.read::<S>(blue, c),
        ]
    }

    /// Errors of sixteen apparent temperatures, hundredths of a kelvin.
    #[inline(always)]
    pub(super) fn temperatures<S: Simd>(&self, place: usize) -> S::F {
        let (_, [_, normal]) = self.draws::<S>(place);
        normal * S::splat(100.0 * self.pixels.infrared_k)
    }

    /// Four standard normal numbers of each of sixteen pixels.
    #[inline(always)]
    fn draws<S: Simd>(&self, place: usize) -> ([S::F; 2], [S::F; 2]) {
        let number = 2 * place as u32;
        (
            draw::<S>(&self.key, number).normal,
            draw::<S>(&self.key, number + 1).normal,
        )
    }

    #[inline(always)]
    fn read<S: Simd>(&self, share: S::F, normal: S::F) -> S::F {
        let PixelNoise {
            full_well_e,
            read_noise_e,
            ..
        } = self.pixels;
        let collected = S::max(share, S::splat(0.0)) * S::splat(full_well_e);
        let sigma = S::sqrt(collected + S::splat(read_noise_e * read_noise_e));
        share + normal * sigma * S::splat(1.0 / full_well_e)
    }
}
