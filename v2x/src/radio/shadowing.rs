//! Shadowing as a field over the positions of both stations, so that it needs no memory: near positions see the same shadows.
//!
//! A sum of waves with random directions, lengths and phases is normal, and its correlation is the Fourier transform of the distribution
//! of the wave vectors. Those here are drawn from the one of exp(−|Δ|/d) in the plane, for each station by itself, so the correlation of a
//! link that moves by Δ and Δ' at its ends is exp(−(|Δ| + |Δ'|)/d) (Wang, Tameh, Nix, "Joint shadowing process in urban peer-to-peer radio
//! channels", IEEE Trans. Veh. Technol. 2008; the exponential of Gudmundson 1991, which TR 37.885 takes).

use sensor_daemon::{
    noise::normals::cos_sin,
    wide::{VectorPath, VectorWork},
};

use crate::random::{LinkKey, RadioDraw, RadioRandom};

/// Waves in the sum, a multiple of [`LANES`]. The kurtosis is 3 − 1.5 / waves.
const WAVES: usize = 48;

/// Values of the waves that are added at once. The order of the sum is the same on every machine.
const LANES: usize = 8;

/// The waves at one end of a link.
#[derive(Debug, Clone)]
struct ShadowWaves {
    /// Turns per decorrelation distance along x and y.
    turns: [[f64; WAVES]; 2],
    /// Phase at the origin, turns: the first end has it.
    phase: [f64; WAVES],
}

/// The shadowing of an episode.
#[derive(Debug, Clone)]
pub struct ShadowingField {
    /// Of the first and of the second end.
    ends: [ShadowWaves; 2],
}

/// Cosine and sine of every wave at one end of a link. The phase of a wave at a link is the sum of its phases at both ends, so a link
/// needs no trigonometry of its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShadowingEnd {
    cos: [f32; WAVES],
    sin: [f32; WAVES],
}

impl Default for ShadowingEnd {
    fn default() -> Self {
        Self {
            cos: [0.0; WAVES],
            sin: [0.0; WAVES],
        }
    }
}

impl ShadowingField {
    /// The field of an episode.
    #[must_use]
    pub fn new(random: &RadioRandom) -> Self {
        let none = ShadowWaves {
            turns: [[0.0; WAVES]; 2],
            phase: [0.0; WAVES],
        };
        let mut ends = [none.clone(), none];
        for place in 0..WAVES {
            let link = LinkKey {
                message: place as u32,
                ..LinkKey::default()
            };
            let [length_a, angle_a, length_b, angle_b] = random.uniforms(link, RadioDraw::Shadowing, 0);
            let [phase, ..] = random.uniforms(link, RadioDraw::Shadowing, 1);
            ends[0].phase[place] = phase;
            for (end, wave) in ends
                .iter_mut()
                .zip([wave_vector(length_a, angle_a), wave_vector(length_b, angle_b)])
            {
                (end.turns[0][place], end.turns[1][place]) = (wave[0], wave[1]);
            }
        }
        Self { ends }
    }

    /// The waves at the first end of a link, at a position in metres.
    #[must_use]
    pub fn first_end(&self, position_m: [f64; 2], decorrelation_m: f64) -> ShadowingEnd {
        self.end(0, position_m, decorrelation_m)
    }

    /// The waves at the second end of a link, at a position in metres.
    #[must_use]
    pub fn second_end(&self, position_m: [f64; 2], decorrelation_m: f64) -> ShadowingEnd {
        self.end(1, position_m, decorrelation_m)
    }

    fn end(&self, end: usize, position_m: [f64; 2], decorrelation_m: f64) -> ShadowingEnd {
        VectorPath::widest().run(WavesAt {
            waves: &self.ends[end],
            position: position_m.map(|value| value / decorrelation_m),
        })
    }

    /// A standard normal number for a link between two positions, in metres; the same in both directions if `a` is always the same end.
    #[must_use]
    pub fn normal(&self, a: [f64; 2], b: [f64; 2], decorrelation_m: f64) -> f64 {
        self.first_end(a, decorrelation_m)
            .normal(&self.second_end(b, decorrelation_m))
    }
}

/// Cosine and sine of waves at a position in decorrelation distances.
struct WavesAt<'a> {
    waves: &'a ShadowWaves,
    position: [f64; 2],
}

impl VectorWork for WavesAt<'_> {
    type Output = ShadowingEnd;

    #[inline(always)]
    fn run(self) -> ShadowingEnd {
        let ShadowWaves { turns: [kx, ky], phase } = self.waves;
        let [x, y] = self.position;
        let mut angles = [0_u32; WAVES];
        for (place, angle) in angles.iter_mut().enumerate() {
            let turns = phase[place] + kx[place] * x + ky[place] * y;
            // The fraction of a turn in 32 bits.
            *angle = ((turns - turns.floor()) * 4_294_967_296.0) as u32;
        }
        let mut end = ShadowingEnd::default();
        for (place, angle) in angles.iter().enumerate() {
            (end.cos[place], end.sin[place]) = cos_sin(*angle);
        }
        end
    }
}

impl ShadowingEnd {
    /// A standard normal number for the link from this first end to a second one.
    #[must_use]
    #[inline(always)]
    pub fn normal(&self, second: &Self) -> f64 {
        let mut sums = [0.0_f32; LANES];
        for from in (0..WAVES).step_by(LANES) {
            for (lane, sum) in sums.iter_mut().enumerate() {
                let at = from + lane;
                // The cosine of the sum of both phases.
                *sum += self.cos[at] * second.cos[at] - self.sin[at] * second.sin[at];
            }
        }
        let mut sum = 0.0;
        for part in sums {
            sum += part;
        }
        f64::from(sum) * (2.0 / WAVES as f64).sqrt()
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
    fn the_ends_of_a_link_give_the_sum_of_its_waves() {
        let field = ShadowingField::new(&RadioRandom::new(3));
        for place in 0..200 {
            let place = f64::from(place);
            let (a, b) = ([17.3 * place, -400.0 + 3.1 * place], [5000.0 - 9.0 * place, 77.7]);
            let [first, second] = &field.ends;
            let turns = |wave: usize| {
                let of = |end: &ShadowWaves, at: [f64; 2]| end.turns[0][wave] * at[0] + end.turns[1][wave] * at[1];
                first.phase[wave] + (of(first, a) + of(second, b)) / 13.0
            };
            let waves = (0..WAVES).map(|wave| libm::cos(std::f64::consts::TAU * turns(wave)));
            let sum = waves.sum::<f64>() * (2.0 / WAVES as f64).sqrt();
            assert!((field.normal(a, b, 13.0) - sum).abs() < 1e-5);
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
