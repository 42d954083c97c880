//! Turns the hit of a ray into a return: range error, intensity, loss, and the point.

use ipc_schema::{
    config::{Config, LidarAxes, LidarMode},
    pointcloud::LidarPoint,
};

use super::{
    pattern::RayGroup,
    random::{ScanKey, exp_minus, fill},
    raster::ScanCanvas,
    simd::{Simd, WIDTH},
    solids::{INTEREST, NOTHING},
    weather::WeatherEffects,
};

/// Errors and losses of returns.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReturnModel {
    min_range_m: f32,
    range_m: f32,
    noise_std_m: f32,
    attenuation_per_m: f32,
    dropoff: f32,
    /// 1 / `lidar.dropoff_intensity`; 0 = no return is lost because it is weak.
    inv_weak: f32,
    dropoff_zero: f32,
    is_random: bool,
    /// Bit that a word must have.
    wanted: u32,
    is_paper: bool,
    pub(super) air: WeatherEffects,
    is_clear: bool,
}

/// Values that the rays of a column share.
struct Shot {
    /// Sine and cosine of the azimuth in the sensor's frame.
    azimuth: [f32; 2],
    age_us: u32,
    sun: [f32; 3],
}

impl ReturnModel {
    pub(super) fn new(config: &Config) -> Self {
        let lidar = &config.lidar;
        let air = WeatherEffects::new(&config.weather);
        // Intensity of a return from the end of the range: no other is weaker.
        let weakest = libm::exp(-(lidar.attenuation_per_m + 2.0 * air.extinction_per_m) * lidar.range_m);
        let weak = lidar.dropoff_zero_intensity > 0.0 && weakest < lidar.dropoff_intensity;
        let noisy = lidar.range_noise_std_m > 0.0 || air.range_share > 0.0 || air.sun_std_m > 0.0;
        Self {
            min_range_m: lidar.min_range_m as f32,
            range_m: lidar.range_m as f32,
            noise_std_m: lidar.range_noise_std_m as f32,
            attenuation_per_m: (lidar.attenuation_per_m + 2.0 * air.extinction_per_m) as f32,
            dropoff: lidar.dropoff as f32,
            inv_weak: if weak {
                (1.0 / lidar.dropoff_intensity) as f32
            } else {
                0.0
            },
            dropoff_zero: lidar.dropoff_zero_intensity as f32,
            is_random: noisy || weak || lidar.dropoff > 0.0,
            wanted: if lidar.mode == LidarMode::Interest { INTEREST } else { 0 },
            is_paper: lidar.axes == LidarAxes::Paper,
            is_clear: air.is_clear(),
            air,
        }
    }

    /// Writes the returns of a span from `cursor` on and returns the new cursor. `groups(column)` are the rays of a column, `sun` is
    /// the direction to the sun in the sensor's frame.
    #[inline(always)]
    pub(super) fn write<'a, S: Simd, const UPRIGHT: bool>(
        &self,
        canvas: &mut ScanCanvas,
        groups: impl Fn(usize) -> &'a [RayGroup],
        sun: [f32; 3],
        (key, first): (&ScanKey, u32),
        points: &mut [LidarPoint],
        mut cursor: usize,
    ) -> usize {
        if self.is_random {
            let count = canvas.count * canvas.groups;
            fill::<S>(key, first, count, &mut canvas.normal, &mut canvas.uniform);
        }
        for column in 0..canvas.count {
            let (chunk, element) = (&canvas.columns[column / WIDTH], column % WIDTH);
            let shot = Shot {
                azimuth: [chunk.azimuth[0].0[element], chunk.azimuth[1].0[element]],
                age_us: chunk.age_us.0[element],
                sun,
            };
            for (group, rays) in groups(column).iter().enumerate() {
                let place = column * canvas.groups + group;
                cursor = self.group::<S, UPRIGHT>(canvas, place, rays, &shot, points, cursor);
            }
        }
        cursor
    }

    /// Points at `range` along the rays, in the sensor's axes.
    #[inline(always)]
    fn position<S: Simd, const UPRIGHT: bool>(&self, range: S::F, rays: &RayGroup, shot: &Shot) -> [S::F; 3] {
        let (sine, cosine) = (S::splat(shot.azimuth[0]), S::splat(shot.azimuth[1]));
        let (ahead, up) = (range * S::load(&rays.alpha), range * S::load(&rays.gamma));
        let (x, y) = if UPRIGHT {
            (ahead * cosine, ahead * sine)
        } else {
            let beside = range * S::load(&rays.beta);
            (ahead * cosine - beside * sine, ahead * sine + beside * cosine)
        };
        let zero = S::splat(0.0);
        if self.is_paper {
            [y, zero - x, zero - up]
        } else {
            [x, y, up]
        }
    }

    #[inline(always)]
    fn group<S: Simd, const UPRIGHT: bool>(
        &self,
        canvas: &ScanCanvas,
        place: usize,
        rays: &RayGroup,
        shot: &Shot,
        points: &mut [LidarPoint],
        cursor: usize,
    ) -> usize {
        let word = S::load_words(&canvas.word[place]);
        let (mut range, mut incidence) = (S::load(&canvas.t[place]), S::load(&canvas.incidence[place]));
        let alpha = S::load(&rays.alpha);
        if UPRIGHT {
            range = range * S::load(&rays.inv_cos);
            incidence = incidence * alpha;
        }
        let incidence = S::max(incidence, S::splat(0.0) - incidence);
        let met = !S::bits(S::equal(word, S::splat_words(NOTHING)));
        let wanted = S::splat_words(self.wanted);
        let of_interest = S::bits(S::equal(S::and(word, wanted), wanted));
        let far_enough = S::bits(S::le(S::splat(self.min_range_m), range));
        let mut keep = rays.live & met & of_interest & far_enough;
        let mut intensity = exp_minus::<S>(range * S::splat(self.attenuation_per_m));
        let mut sigma = S::splat(self.noise_std_m);
        if !self.is_clear {
            let (seen, weather_sigma) = self.weather::<S>(range, rays, shot);
            keep &= seen;
            sigma = weather_sigma;
        }
        if self.is_random {
            let one = S::splat(1.0);
            let weak = S::splat(self.dropoff_zero) * S::max(one - intensity * S::splat(self.inv_weak), S::splat(0.0));
            let weak = if self.inv_weak > 0.0 { weak } else { S::splat(0.0) };
            let lost = S::splat(self.dropoff) + S::splat(1.0 - self.dropoff) * weak;
            keep &= S::bits(S::le(lost, S::load(&canvas.uniform[place])));
            range = S::max(range + S::load(&canvas.normal[place]) * sigma, S::splat(0.0));
        }
        if keep == 0 {
            return cursor;
        }
        intensity = S::min(intensity, S::splat(1.0));
        let [x, y, z] = self.position::<S, UPRIGHT>(range, rays, shot);
        let tag = S::or(S::and(word, S::splat_words(0xFF)), S::load_words(&rays.channel));
        let words = [
            S::words(x),
            S::words(y),
            S::words(z),
            S::words(intensity),
            S::load_words(&canvas.object[place]),
            S::words(S::min(incidence, S::splat(1.0))),
            tag,
            S::splat_words(shot.age_us),
        ];
        S::compact(words, keep, points, cursor)
    }

    /// Bits of the returns that the weather lets through, and the standard deviation of the range.
    #[inline(always)]
    fn weather<S: Simd>(&self, range: S::F, rays: &RayGroup, shot: &Shot) -> (u32, S::F) {
        let air = &self.air;
        let (one, zero) = (S::splat(1.0), S::splat(0.0));
        let loss = exp_minus::<S>(range * S::splat((2.0 * air.extinction_per_m) as f32));
        let farther = S::splat(self.range_m);
        let seen = if air.extinction_per_m > 0.0 {
            S::bits(S::le(range * range, loss * (farther * farther)))
        } else {
            u32::MAX
        };
        let rain = range * S::splat(air.range_share as f32);
        // The sun in the axes of the column.
        let ([x, y, up], [sine, cosine]) = (shot.sun, shot.azimuth);
        let (ahead, left) = (S::splat(x * cosine + y * sine), S::splat(y * cosine - x * sine));
        let up = S::splat(up);
        let towards = S::load(&rays.alpha) * ahead + S::load(&rays.beta) * left + S::load(&rays.gamma) * up;
        let towards = S::min(S::max(towards, zero), one);
        let sun = towards * towards * S::splat(air.sun_std_m as f32);
        let own = S::splat(self.noise_std_m);
        (seen, S::sqrt(own * own + rain * rain + sun * sun))
    }
}
