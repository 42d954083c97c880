//! The radar equation, resolution, detection and errors. Sources: docs/sensor-models.md.

use std::f64::consts::PI;

use ipc_schema::config::RadarConfig;

/// Speed of light, m/s.
const LIGHT_MPS: f64 = 299_792_458.0;
/// Boltzmann's constant times the standard temperature of 290 K, W/Hz.
const BOLTZMANN_290_K: f64 = 1.380_649e-23 * 290.0;
/// A standard deviation is the resolution over this and over √(2 SNR) (D. Barton and H. Ward, *Handbook of Radar Measurement*, 1984).
const SLOPE: f64 = 1.6;

/// A waveform with its resolutions, and the receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RadarEquation {
    /// Resolution of the range, metres: c / 2B.
    pub range_resolution_m: f64,
    /// Resolution of the radial velocity, m/s: λ / 2NT.
    pub velocity_resolution_mps: f64,
    /// Velocities that differ by a multiple of this look the same, m/s: λ / 2T.
    pub velocity_ambiguity_mps: f64,
    /// Resolution of the azimuth, radians.
    pub azimuth_resolution_rad: f64,
    /// Chirps of a scan, which is the number of cells of the velocity.
    pub chirps: u32,
    /// Farthest range, metres.
    pub range_m: f64,
    /// Signal to noise ratio of 1 m² at 1 m in clear air, after the integration of a scan.
    snr_at_1m: f64,
    /// Threshold of the power over the noise's.
    threshold: f64,
    /// Specific attenuation by rain, dB/m one way.
    rain_db_per_m: f64,
}

impl RadarEquation {
    /// Of a radar in rain of this rate.
    #[must_use]
    pub fn new(radar: &RadarConfig, rain_mmph: f64) -> Self {
        let wavelength_m = LIGHT_MPS / (radar.frequency_ghz * 1e9);
        let (chirp_s, chirps) = (radar.chirp_us * 1e-6, f64::from(radar.chirps));
        let gain = from_db(radar.antenna_gain_dbi);
        let power_w = from_db(radar.transmit_dbm) * 1e-3;
        let noise_w_per_hz = BOLTZMANN_290_K * from_db(radar.noise_and_losses_db);
        // M. Skolnik, Introduction to Radar Systems, 3rd edition, equation 1.7 and section 2.10: energy of the whole scan over noise density.
        let energy_j = power_w * chirp_s * chirps;
        let spread = (4.0 * PI) * (4.0 * PI) * (4.0 * PI);
        Self {
            range_resolution_m: LIGHT_MPS / (2.0 * radar.bandwidth_mhz * 1e6),
            velocity_resolution_mps: wavelength_m / (2.0 * chirps * chirp_s),
            velocity_ambiguity_mps: wavelength_m / (2.0 * chirp_s),
            azimuth_resolution_rad: radar.azimuth_resolution_deg.to_radians(),
            chirps: radar.chirps,
            range_m: radar.range_m,
            snr_at_1m: energy_j * gain * gain * wavelength_m * wavelength_m / (spread * noise_w_per_hz),
            threshold: -libm::log(radar.false_alarm_probability),
            rain_db_per_m: rain_db_per_km(radar.frequency_ghz, rain_mmph) * 1e-3,
        }
    }

    /// Mean signal to noise ratio of a cross section at a range.
    #[must_use]
    pub fn snr(&self, rcs_m2: f64, range_m: f64) -> f64 {
        let square = range_m * range_m;
        let rain = from_db(-2.0 * self.rain_db_per_m * range_m);
        self.snr_at_1m * rcs_m2 * rain / (square * square)
    }

    /// The cross section that a signal to noise ratio stands for.
    #[must_use]
    pub fn rcs_m2(&self, snr: f64, range_m: f64) -> f64 {
        snr / self.snr(1.0, range_m)
    }

    /// Probability that a cell with a fluctuating target of this mean signal to noise ratio is detected. Swerling's case 1: power is
    /// exponentially distributed (P. Swerling, *Probability of Detection for Fluctuating Targets*, RAND RM-1217, 1954).
    #[must_use]
    pub fn detection_probability(&self, mean_snr: f64) -> f64 {
        libm::exp(-self.threshold / (1.0 + mean_snr))
    }

    /// Draws the power of a cell over the noise's with a uniform number in (0, 1): signal and noise together are exponentially distributed
    /// about `1 + mean_snr`. `None` below the threshold.
    #[must_use]
    pub fn detected_power(&self, mean_snr: f64, uniform: f64) -> Option<f64> {
        let power = -(1.0 + mean_snr) * libm::log(uniform);
        (power > self.threshold).then_some(power)
    }

    /// Power of noise that is detected, over the noise's mean, from a uniform number in (0, 1).
    #[must_use]
    pub fn false_alarm_power(&self, uniform: f64) -> f64 {
        self.threshold - libm::log(uniform)
    }

    /// Mean number of false alarms in a number of cells.
    #[must_use]
    pub fn false_alarms(&self, cells: f64) -> f64 {
        cells * libm::exp(-self.threshold)
    }

    /// Standard deviation of a quantity with this resolution.
    #[must_use]
    pub fn deviation(resolution: f64, snr: f64) -> f64 {
        resolution / (SLOPE * (2.0 * snr).sqrt())
    }

    /// A radial velocity as it looks: folded into ± half of the ambiguity.
    #[must_use]
    pub fn folded(&self, velocity_mps: f64) -> f64 {
        let turns = velocity_mps / self.velocity_ambiguity_mps;
        velocity_mps - self.velocity_ambiguity_mps * turns.round_ties_even()
    }
}

/// A ratio from decibels.
#[must_use]
pub fn from_db(decibels: f64) -> f64 {
    libm::pow(10.0, 0.1 * decibels)
}

/// Decibels of a ratio.
#[must_use]
pub fn to_db(ratio: f64) -> f64 {
    10.0 * libm::log10(ratio)
}

/// Terms of the fits of ITU-R P.838-3: a, b and c of each.
type Terms<const N: usize> = [[f64; 3]; N];
/// Table 1, coefficient `k` of horizontal polarisation; then its slope and offset.
const K: Terms<4> = [
    [-5.33980, -0.10008, 1.13098],
    [-0.35351, 1.26970, 0.45400],
    [-0.23789, 0.86036, 0.15354],
    [-0.94158, 0.64552, 0.16817],
];
const K_LINE: [f64; 2] = [-0.18961, 0.71147];
/// Table 3, coefficient `α` of horizontal polarisation; then its slope and offset.
const ALPHA: Terms<5> = [
    [-0.14318, 1.82442, -0.55187],
    [0.29591, 0.77564, 0.19822],
    [0.32177, 0.63773, 0.13164],
    [-5.37610, -0.96230, 1.47828],
    [16.1721, -3.29980, 3.43990],
];
const ALPHA_LINE: [f64; 2] = [0.67849, -1.95537];

fn fit<const N: usize>(terms: &Terms<N>, [slope, offset]: [f64; 2], log10_ghz: f64) -> f64 {
    let sum: f64 = terms
        .iter()
        .map(|[a, b, c]| {
            let off = (log10_ghz - b) / c;
            a * libm::exp(-off * off)
        })
        .sum();
    sum + slope * log10_ghz + offset
}

/// Specific attenuation by rain, one way, horizontal polarisation: `k R^α` (Recommendation ITU-R P.838-3, 1 to 1000 GHz), dB/km.
#[must_use]
pub fn rain_db_per_km(frequency_ghz: f64, rain_mmph: f64) -> f64 {
    if rain_mmph <= 0.0 {
        return 0.0;
    }
    let log10_ghz = libm::log10(frequency_ghz);
    let k = libm::pow(10.0, fit(&K, K_LINE, log10_ghz));
    k * libm::pow(rain_mmph, fit(&ALPHA, ALPHA_LINE, log10_ghz))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rain_attenuates_as_table_5_of_the_recommendation() {
        // Frequency, k and α of horizontal polarisation.
        for (ghz, k, alpha) in [(10.0, 0.01217, 1.2571), (24.0, 0.1425, 1.0101), (80.0, 1.1704, 0.7115)] {
            let one = rain_db_per_km(ghz, 1.0);
            let slope = libm::log10(rain_db_per_km(ghz, 10.0) / one);
            assert!((one / k - 1.0).abs() < 5e-3, "{ghz} GHz: {one}");
            assert!((slope - alpha).abs() < 5e-4, "{ghz} GHz: {slope}");
        }
    }
}
