//! The light of shaded images. It is a plain model: a sky that lights everything alike, a sun with Lambert's cosine, no shadows.

use ipc_schema::config::WeatherConfig;

use super::labels::SemanticLabel;

/// Height of the sun at which civil twilight ends and the night begins, degrees.
const TWILIGHT_DEG: f64 = -6.0;
/// Light of a night in a lit street as a share of that of a day.
const NIGHT_SHARE: f64 = 0.06;
/// Extinction of light at the visibility `V`: `3.912 / V` (H. Koschmieder, *Theorie der horizontalen Sichtweite*, 1924).
const KOSCHMIEDER: f64 = 3.912;

/// The light of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Daylight {
    /// Towards the sun: east, north, up.
    sun: [f64; 3],
    ambient: f64,
    direct: f64,
    /// Light of the sky as a share of that of a day.
    daylight: f64,
    /// Extinction by fog and rain, 1/m.
    pub(super) extinction_per_m: f32,
    sunlight: f64,
}

/// Extinction by rain, 1/m, as for the LIDAR (Goodin et al. 2019). Drops are large against all wavelengths of cameras.
pub(super) fn rain_extinction_per_m(rain_mmph: f64) -> f64 {
    if rain_mmph > 0.0 {
        0.01 * libm::pow(rain_mmph, 0.6)
    } else {
        0.0
    }
}

impl Daylight {
    pub(super) fn new(weather: &WeatherConfig) -> Self {
        let (sin_up, cos_up) = libm::sincos(weather.sun_elevation_deg.to_radians());
        let (sin_az, cos_az) = libm::sincos(weather.sun_azimuth_deg.to_radians());
        let daylight = ((weather.sun_elevation_deg - TWILIGHT_DEG) / -TWILIGHT_DEG).clamp(0.0, 1.0);
        let daylight = NIGHT_SHARE + (1.0 - NIGHT_SHARE) * daylight;
        let sunlight = if sin_up > 0.0 {
            weather.sunlight.clamp(0.0, 1.0)
        } else {
            0.0
        };
        let fog_per_m = KOSCHMIEDER / weather.visibility_m.max(1.0);
        Self {
            sun: [cos_up * sin_az, cos_up * cos_az, sin_up],
            ambient: daylight * (0.8 - 0.3 * sunlight),
            direct: 0.7 * sunlight,
            daylight,
            extinction_per_m: (fog_per_m + rain_extinction_per_m(weather.rain_mmph)) as f32,
            sunlight,
        }
    }

    /// Colour of the sky, and of fog: grey without sun.
    pub(super) fn sky(&self) -> [f32; 3] {
        let [blue, grey] = [SemanticLabel::Sky.albedo(), [0.75; 3]];
        std::array::from_fn(|i| {
            let sunlight = self.sunlight as f32;
            self.daylight as f32 * (sunlight * blue[i] + (1.0 - sunlight) * grey[i])
        })
    }

    fn on(&self, normal: [f64; 3]) -> f32 {
        let lambert: f64 = (0..3).map(|i| normal[i] * self.sun[i]).sum();
        (self.ambient + self.direct * lambert.max(0.0)) as f32
    }

    /// Colour of a surface of a body; each body has its own tint.
    pub(super) fn on_body(&self, instance: u32, label: u8, normal: [f64; 3]) -> [f32; 3] {
        let label = SemanticLabel::ALL.into_iter().find(|known| *known as u8 == label);
        let albedo = label.unwrap_or(SemanticLabel::Static).albedo();
        // Three bytes of a multiplicative hash (D. Knuth, The Art of Computer Programming, volume 3, section 6.4).
        let hash = instance.wrapping_mul(2_654_435_769);
        let light = self.on(normal);
        std::array::from_fn(|i| {
            let byte = (hash >> (8 + 8 * i)) & 0xFF;
            light * albedo[i] * (0.7 + 0.6 * byte as f32 / 255.0)
        })
    }

    /// Colour of the ground of a class.
    pub(super) fn on_ground(&self, label: SemanticLabel) -> [f32; 3] {
        label.albedo().map(|part| part * self.on([0.0, 0.0, 1.0]))
    }
}
