//! Effects of rain, fog and sun on a return.
//!
//! Rain: Goodin, Carruth, Doude and Hudson, "Predicting the Influence of Rain on LIDAR in ADAS", Electronics 8 (2019) 89: attenuation
//! `α = 0.01 R^0.6` 1/m with R in mm/h, both ways; a return is lost when less comes back than of the same surface at the end of the
//! range in clear air; the range gains an error of standard deviation `0.02 d (1 − exp(−R))²`. Fog: Kruse's form of Koschmieder's law,
//! `α = 3.912 / V · (λ / 550 nm)^−q`, at 905 nm, less what clear air (50 km) has, for which `lidar.attenuation_per_m` stands. Sun: a
//! model of this project, without a source: a further error of the range of up to 5 cm towards the sun, falling with the squared cosine.

use ipc_schema::config::WeatherConfig;

/// Wavelength over that of Koschmieder's law: 905 nm to 550 nm.
const WAVELENGTHS: f64 = 905.0 / 550.0;
/// Visibility of clear air, metres.
const CLEAR_M: f64 = 50_000.0;
/// Standard deviation of the range when looking into the sun, metres.
const SUN_STD_M: f64 = 0.05;

/// Effects of the weather on returns.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct WeatherEffects {
    /// Attenuation one way, 1/m.
    pub(super) extinction_per_m: f64,
    /// Standard deviation of the range as a share of it.
    pub(super) range_share: f64,
    /// Towards the sun: east, north, up.
    pub(super) sun: [f64; 3],
    /// Standard deviation of the range when looking into the sun, metres.
    pub(super) sun_std_m: f64,
}

impl WeatherEffects {
    pub(super) fn new(weather: &WeatherConfig) -> Self {
        let (sin_up, cos_up) = libm::sincos(weather.sun_elevation_deg.to_radians());
        let (sin_az, cos_az) = libm::sincos(weather.sun_azimuth_deg.to_radians());
        let rain = weather.rain_mmph;
        let rain_per_m = if rain > 0.0 { 0.01 * libm::pow(rain, 0.6) } else { 0.0 };
        let fog_per_m = (fog_per_m(weather.visibility_m) - fog_per_m(CLEAR_M)).max(0.0);
        let shines = sin_up > 0.0;
        Self {
            extinction_per_m: rain_per_m + fog_per_m,
            range_share: 0.02 * (1.0 - libm::exp(-rain)) * (1.0 - libm::exp(-rain)),
            sun: [cos_up * sin_az, cos_up * cos_az, sin_up],
            sun_std_m: if shines { SUN_STD_M * weather.sunlight } else { 0.0 },
        }
    }

    /// True in dry, clear air without sun.
    pub(super) fn is_clear(&self) -> bool {
        self.extinction_per_m == 0.0 && self.range_share == 0.0 && self.sun_std_m == 0.0
    }
}

/// Extinction at 905 nm, 1/m (Kruse, McGlauchlin, McQuistan, "Elements of Infrared Technology", 1962).
fn fog_per_m(visibility_m: f64) -> f64 {
    let km = visibility_m / 1000.0;
    let q = if km > 50.0 {
        1.6
    } else if km > 6.0 {
        1.3
    } else {
        0.585 * libm::cbrt(km)
    };
    3.912 / visibility_m.max(1.0) * libm::pow(WAVELENGTHS, -q)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn weather(rain_mmph: f64, visibility_m: f64, sunlight: f64) -> WeatherConfig {
        WeatherConfig {
            rain_mmph,
            visibility_m,
            sun_elevation_deg: 30.0,
            sun_azimuth_deg: 180.0,
            sunlight,
            air_temperature_c: 15.0,
        }
    }

    #[test]
    fn clear_air_does_nothing() {
        assert!(WeatherEffects::new(&weather(0.0, CLEAR_M, 0.0)).is_clear());
        assert!(WeatherEffects::new(&weather(0.0, 80_000.0, 0.0)).is_clear());
    }

    /// 0.01 · 10^0.6 = 0.039 81; 0.02 (1 − e^−1)² = 0.007 992.
    #[test]
    fn rain_by_hand() {
        let air = WeatherEffects::new(&weather(10.0, CLEAR_M, 0.0));
        assert!((air.extinction_per_m - 0.039_81).abs() < 1e-5);
        assert!((WeatherEffects::new(&weather(1.0, CLEAR_M, 0.0)).range_share - 0.007_992).abs() < 1e-5);
    }

    /// V = 200 m: q = 0.585 · 0.2^(1/3) = 0.342; 3.912 / 200 · 1.6455^−0.342 = 0.016 50 1/m.
    #[test]
    fn fog_by_hand() {
        let air = WeatherEffects::new(&weather(0.0, 200.0, 0.0));
        assert!((air.extinction_per_m - 0.016_50).abs() < 1e-4, "{air:?}");
    }

    #[test]
    fn the_sun_of_noon_is_in_the_south() {
        let air = WeatherEffects::new(&weather(0.0, CLEAR_M, 1.0));
        assert!(air.sun[0].abs() < 1e-12 && air.sun[1] < -0.8 && (air.sun[2] - 0.5).abs() < 1e-12);
        assert!(!air.is_clear());
    }
}
