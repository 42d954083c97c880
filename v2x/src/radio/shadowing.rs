//! Shadowing as a field over the positions of both stations, so that it needs no memory: near positions see the same shadows.
//!
//! A sum of waves with random directions, lengths and phases is normal, and its correlation is the Fourier transform of the distribution
//! of the wave vectors. Those here are drawn from the one of exp(−|Δ|/d) in the plane, for each station by itself, so the correlation of a
//! link that moves by Δ and Δ' at its ends is exp(−(|Δ| + |Δ'|)/d) (Wang, Tameh, Nix, "Joint shadowing process in urban peer-to-peer radio
//! channels", IEEE Trans. Veh. Technol. 2008; the exponential of Gudmundson 1991, which TR 37.885 takes).

use sensor_daemon::noise::normals::cos_sin;

use crate::random::{LinkKey, RadioDraw, RadioRandom};

/// Waves in the sum. The kurtosis is 3 − 1.5 / waves.
const WAVES: usize = 48;

#[derive(Debug, Clone, Copy)]
struct ShadowWave {
    /// Turns per decorrelation distance along x and y of the first and of the second station.
    turns: [f64; 4],
    /// Phase at the origin, turns.
    phase: f64,
}

/// The shadowing of an episode.
#[derive(Debug, Clone)]
pub struct ShadowingField {
    waves: Vec<ShadowWave>,
}

impl ShadowingField {
    /// The field of an episode.
    #[must_use]
    pub fn new(random: &RadioRandom) -> Self {
        let waves = (0..WAVES as u32).map(|wave| {
            let link = LinkKey {
                message: wave,
                ..LinkKey::default()
            };
            let [length_a, angle_a, length_b, angle_b] = random.uniforms(link, RadioDraw::Shadowing, 0);
            let [phase, ..] = random.uniforms(link, RadioDraw::Shadowing, 1);
            let [xa, ya] = wave_vector(length_a, angle_a);
            let [xb, yb] = wave_vector(length_b, angle_b);
            ShadowWave {
                turns: [xa, ya, xb, yb],
                phase,
            }
        });
        Self { waves: waves.collect() }
    }

    /// A standard normal number for a link between two positions, in metres; the same in both directions if `a` is always the same end.
    #[must_use]
    pub fn normal(&self, a: [f64; 2], b: [f64; 2], decorrelation_m: f64) -> f64 {
        let scale = 1.0 / decorrelation_m;
        let [xa, ya, xb, yb] = [a[0] * scale, a[1] * scale, b[0] * scale, b[1] * scale];
        let mut sum = 0.0;
        for wave in &self.waves {
            let [ka, la, kb, lb] = wave.turns;
            let turns = wave.phase + ka * xa + la * ya + kb * xb + lb * yb;
            // The fraction of a turn in 32 bits.
            let angle = ((turns - turns.floor()) * 4_294_967_296.0) as u32;
            sum += f64::from(cos_sin(angle).0);
        }
        sum * (2.0 / WAVES as f64).sqrt()
    }
}

/// A wave vector in turns per decorrelation distance. The spectrum of exp(−r) in the plane is (1 + k²)^(−3/2): the share of waves with
/// |k| below κ is 1 − 1/√(1 + κ²).
fn wave_vector(length: f64, angle: f64) -> [f64; 2] {
    let share = 1.0 - length;
    let wave_number = (1.0 / (share * share) - 1.0).sqrt() / std::f64::consts::TAU;
    let (sin, cos) = libm::sincos(std::f64::consts::TAU * angle);
    [wave_number * cos, wave_number * sin]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean of the products of a field at a link and at the same link moved, over `fields` fields.
    fn correlation(fields: u64, moved: [[f64; 2]; 2]) -> f64 {
        let (a, b) = ([1234.5, -77.0], [1500.0, 12.0]);
        let product = |seed| {
            let field = ShadowingField::new(&RadioRandom::new(seed));
            let there = [
                [a[0] + moved[0][0], a[1] + moved[0][1]],
                [b[0] + moved[1][0], b[1] + moved[1][1]],
            ];
            field.normal(a, b, 10.0) * field.normal(there[0], there[1], 10.0)
        };
        (0..fields).map(product).sum::<f64>() / fields as f64
    }

    #[test]
    fn shadowing_is_correlated_as_its_exponential() {
        const FIELDS: u64 = 4000;
        for moved in [
            [[0.0, 0.0], [0.0, 0.0]],
            [[5.0, 0.0], [0.0, 0.0]],
            [[0.0, 0.0], [6.0, -8.0]],
            [[0.0, 10.0], [10.0, 0.0]],
            [[100.0, 0.0], [0.0, 0.0]],
        ] {
            let apart: f64 = moved.iter().map(|[x, y]| libm::hypot(*x, *y)).sum();
            let expected = libm::exp(-apart / 10.0);
            // The product of two standard normal numbers of correlation ρ has the variance 1 + ρ².
            let error = 5.0 * ((1.0 + expected * expected) / FIELDS as f64).sqrt();
            let found = correlation(FIELDS, moved);
            assert!(
                (found - expected).abs() < error,
                "{apart} m: {found} for {expected} ± {error}"
            );
        }
    }

    #[test]
    fn shadowing_is_nearly_normal() {
        const FIELDS: u64 = 20_000;
        let values: Vec<f64> = (0..FIELDS)
            .map(|seed| ShadowingField::new(&RadioRandom::new(seed)).normal([10.0, 20.0], [30.0, 40.0], 10.0))
            .collect();
        let n = FIELDS as f64;
        let moment = |power| values.iter().map(|value| value.powi(power)).sum::<f64>() / n;
        assert!(moment(1).abs() < 5.0 / n.sqrt());
        assert!((moment(2) - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
        let kurtosis = 3.0 - 1.5 / WAVES as f64;
        assert!((moment(4) - kurtosis).abs() < 5.0 * (96.0 / n).sqrt(), "{}", moment(4));
    }
}
