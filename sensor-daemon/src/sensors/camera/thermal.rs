//! The light of the thermal infrared: what a long-wave camera sees of surfaces, air and sky.
//!
//! A surface of temperature `T` and emissivity `ε` radiates `ε B(T)` and reflects `(1 − ε)` of what its surroundings radiate, where `B` is
//! Planck's law integrated from 8 to 14 µm. On the way the air takes a share of that and adds its own. A pixel is the temperature of the
//! black body that would radiate as much, as radiometric cameras report it. Temperatures are plausible, not measured.

use std::sync::LazyLock;

use ipc_schema::config::WeatherConfig;

use super::{labels::SemanticLabel, light::rain_extinction_per_m};

/// 0 °C, kelvin.
const ZERO_CELSIUS_K: f64 = 273.15;
/// Temperature of the skin, kelvin (33 °C).
const SKIN_K: f64 = 306.15;
/// The wavelengths of the camera, metres.
const BAND_M: [f64; 2] = [8e-6, 14e-6];
/// Planck's second radiation constant, m K.
const SECOND_RADIATION_M_K: f64 = 1.438_776_877e-2;
/// Temperatures that a pixel can show, kelvin.
const RANGE_K: [f64; 2] = [150.0, 450.0];
/// Steps of the table of temperatures.
const STEPS: usize = 4096;

/// Wavelengths at which Planck's law is taken, and their fifth powers in µm⁵: thousands of temperatures use them again.
static WAVELENGTHS: LazyLock<[(f64, f64); 33]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let wavelength_m = BAND_M[0] + (BAND_M[1] - BAND_M[0]) / 32.0 * i as f64;
        (wavelength_m, libm::pow(wavelength_m * 1e6, 5.0))
    })
});

/// Planck's law over the band, by Simpson's rule over 32 steps; without its constant factors.
fn planck(temperature_k: f64) -> f64 {
    let weighted = WAVELENGTHS.iter().enumerate().map(|(i, (wavelength_m, power))| {
        let weight = match i {
            0 | 32 => 1.0,
            _ if i % 2 == 1 => 4.0,
            _ => 2.0,
        };
        weight * (1.0 / (power * libm::expm1(SECOND_RADIATION_M_K / (wavelength_m * temperature_k))))
    });
    weighted.sum()
}

/// Radiance of a black body in the band, in units of that at 300 K.
fn black_body(temperature_k: f64) -> f64 {
    static AT_300_K: LazyLock<f64> = LazyLock::new(|| planck(300.0));
    planck(temperature_k) / *AT_300_K
}

/// Radiances of all that a thermal camera sees.
#[derive(Debug)]
pub(super) struct ThermalLight {
    /// Extinction of the air in the band, 1/m.
    pub(super) extinction_per_m: f32,
    air: f32,
    by_label: Box<[f32; 256]>,
    /// Temperature by radiance, kelvin, from the first to the last in equal steps.
    kelvin: Box<[f32]>,
    least: f32,
    steps_per_unit: f32,
}

impl ThermalLight {
    pub(super) fn new(weather: &WeatherConfig) -> Self {
        let air_k = weather.air_temperature_c + ZERO_CELSIUS_K;
        // W. C. Swinbank, "Long-wave radiation from clear skies", Quarterly Journal of the Royal Meteorological Society 89, 1963. An
        // overcast sky is as warm as the air.
        let clear_k = 0.0552 * libm::pow(air_k, 1.5);
        let air = black_body(air_k);
        let sky = weather.sunlight * black_body(clear_k.min(air_k)) + (1.0 - weather.sunlight) * air;
        let sun = weather.sunlight * libm::sin(weather.sun_elevation_deg.to_radians()).max(0.0);
        let mut by_label = Box::new([air as f32; 256]);
        for label in SemanticLabel::ALL {
            let (temperature_k, emissivity) = surface(label, air_k, sun);
            let around = 0.5 * (sky + air);
            by_label[label as usize] = (emissivity * black_body(temperature_k) + (1.0 - emissivity) * around) as f32;
        }
        by_label[SemanticLabel::Sky as usize] = sky as f32;
        let [least, most] = RANGE_K.map(black_body);
        Self {
            extinction_per_m: (fog_extinction_per_m(weather.visibility_m) + rain_extinction_per_m(weather.rain_mmph))
                as f32,
            air: air as f32,
            by_label,
            kelvin: temperatures(least, most),
            least: least as f32,
            steps_per_unit: (STEPS as f64 / (most - least)) as f32,
        }
    }

    /// Radiance of a class.
    #[inline(always)]
    pub(super) fn of(&self, label: u8) -> f32 {
        self.by_label[usize::from(label)]
    }

    /// A pixel, hundredths of a kelvin, of a surface of which the share `clear` of the light arrives, read with an `error`.
    #[inline(always)]
    pub(super) fn pixel(&self, surface: f32, clear: f32, error: f32) -> u16 {
        let radiance = self.air + clear * (surface - self.air);
        let place = ((radiance - self.least) * self.steps_per_unit).clamp(0.0, STEPS as f32);
        let step = (place as usize).min(STEPS - 1);
        let [low, high] = [self.kelvin[step], self.kelvin[step + 1]];
        let kelvin = low + (place - step as f32) * (high - low);
        (kelvin * 100.0 + error + 0.5) as u16
    }
}

/// Temperature by radiance in equal steps: `black_body` grows, so bisection inverts it.
fn temperatures(least: f64, most: f64) -> Box<[f32]> {
    let mut low_k = RANGE_K[0];
    (0..=STEPS)
        .map(|step| {
            let wanted = least + (most - least) * step as f64 / STEPS as f64;
            let mut high_k = (low_k + 40.0).min(RANGE_K[1]);
            for _ in 0..40 {
                let middle_k = 0.5 * (low_k + high_k);
                if black_body(middle_k) < wanted {
                    low_k = middle_k;
                } else {
                    high_k = middle_k;
                }
            }
            0.5 * (low_k + high_k)
        })
        .map(|kelvin| kelvin as f32)
        .collect()
}

/// Temperature (K) and emissivity of a class under the share `sun` of the sun's heat. Emissivities: M. Modest, *Radiative Heat
/// Transfer*, 3rd edition, appendix B (asphalt, concrete, brick, oil paint, skin).
fn surface(label: SemanticLabel, air_k: f64, sun: f64) -> (f64, f64) {
    use SemanticLabel as L;
    // Clothes are half-way between the skin and the air.
    let clothed_k = 0.5 * (SKIN_K + air_k);
    match label {
        L::Road => (air_k + 2.0 + 18.0 * sun, 0.93),
        L::LaneMarking | L::StopLine | L::Crossing => (air_k + 2.0 + 13.0 * sun, 0.92),
        L::Sidewalk => (air_k + 1.0 + 14.0 * sun, 0.94),
        L::RailTrack => (air_k + 1.0 + 16.0 * sun, 0.80),
        L::Building | L::Bridge | L::Wall => (air_k + 2.0 + 8.0 * sun, 0.93),
        L::Barrier | L::Pole | L::Static | L::Dynamic => (air_k + 8.0 * sun, 0.90),
        L::Vegetation => (air_k + 1.0 * sun, 0.97),
        L::Terrain => (air_k - 1.0 + 6.0 * sun, 0.96),
        L::Sky => (air_k, 1.0),
        L::Person => (clothed_k, 0.97),
        L::Bicycle => (0.7 * clothed_k + 0.3 * air_k, 0.95),
        L::Motorcycle => (0.5 * clothed_k + 0.5 * (air_k + 25.0), 0.94),
        L::Car => (air_k + 7.0 + 12.0 * sun, 0.92),
        L::Truck | L::Bus | L::Train => (air_k + 9.0 + 10.0 * sun, 0.92),
    }
}

/// Extinction by haze and fog, 1/m: Koschmieder's at 550 nm, less at 10 µm in the manner of Kruse, with the exponents of I. Kim,
/// B. McArthur and E. Korevaar, "Comparison of laser beam propagation at 785 nm and 1550 nm in fog and haze for optical wireless
/// communications", SPIE 4214, 2001. In dense fog the wavelength makes no difference.
fn fog_extinction_per_m(visibility_m: f64) -> f64 {
    let km = visibility_m.max(1.0) / 1000.0;
    let exponent = match km {
        _ if km > 50.0 => 1.6,
        _ if km > 6.0 => 1.3,
        _ if km > 1.0 => 0.16 * km + 0.34,
        _ if km > 0.5 => km - 0.5,
        _ => 0.0,
    };
    3.912 / (1000.0 * km) * libm::pow(10.0 / 0.55, -exponent)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn weather(visibility_m: f64) -> WeatherConfig {
        WeatherConfig {
            rain_mmph: 0.0,
            visibility_m,
            sun_elevation_deg: 45.0,
            sun_azimuth_deg: 180.0,
            sunlight: 0.0,
            air_temperature_c: 15.0,
        }
    }

    #[test]
    fn the_band_holds_its_share_of_all_radiation() {
        // The share of σT⁴ below a wavelength as a series (S. Chang and T. Rhee, "Blackbody radiation functions", International
        // Communications in Heat and Mass Transfer 11, 1984).
        let below = |wavelength_m: f64, temperature_k: f64| {
            let x = SECOND_RADIATION_M_K / (wavelength_m * temperature_k);
            let term =
                |n: f64| libm::exp(-n * x) / n * (x.powi(3) + 3.0 * x * x / n + 6.0 * x / (n * n) + 6.0 / n.powi(3));
            15.0 / std::f64::consts::PI.powi(4) * (1..60_u32).map(|n| term(f64::from(n))).sum::<f64>()
        };
        let band = |temperature_k: f64| {
            let share = below(BAND_M[1], temperature_k) - below(BAND_M[0], temperature_k);
            share * temperature_k.powi(4)
        };
        for temperature_k in [200.0, 250.0, 290.0, 350.0, 450.0] {
            let expected = band(temperature_k) / band(300.0);
            let found = black_body(temperature_k);
            assert!(
                (found / expected - 1.0).abs() < 1e-6,
                "{temperature_k}: {found} {expected}"
            );
        }
    }

    #[test]
    fn a_black_body_shows_its_own_temperature() {
        let light = ThermalLight::new(&weather(1e6));
        for temperature_k in [200.0, 273.15, 300.0, 306.15, 400.0] {
            let pixel = f64::from(light.pixel(black_body(temperature_k) as f32, 1.0, 0.0));
            assert!((pixel / 100.0 - temperature_k).abs() < 0.03, "{temperature_k} {pixel}");
        }
        // Nothing of it arrives: the air's.
        assert_eq!(light.pixel(black_body(400.0) as f32, 0.0, 0.0), 28_815);
        // Beyond the range: its end, and no wrap.
        assert_eq!(light.pixel(1e9, 1.0, 0.0), 45_000);
        assert_eq!(light.pixel(-1.0, 1.0, 0.0), 15_000);
    }

    #[test]
    fn fog_takes_less_of_the_infrared_than_of_the_light_unless_it_is_dense() {
        for visibility_m in [100.0, 400.0] {
            assert!((fog_extinction_per_m(visibility_m) * visibility_m - 3.912).abs() < 1e-12);
        }
        // Kim's exponent at 2 km: 0.66, and 18.18^−0.66 = 0.1474.
        let share = fog_extinction_per_m(2000.0) * 2000.0 / 3.912;
        assert!((share - 0.1474).abs() < 1e-4, "{share}");
    }
}
