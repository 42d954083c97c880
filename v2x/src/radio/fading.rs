//! Fast fading of a received message: Nakagami's distribution of the amplitude.

use crate::random::{LinkKey, RadioDraw, RadioRandom};

/// Twice the shape m of the distribution by distance: 3 up to 50 m, 1.5 up to 150 m, 1 (Rayleigh's) beyond (Cheng et al., "Mobile
/// vehicle-to-vehicle narrow-band channel measurement and characterization of the 5.9 GHz DSRC frequency band", JSAC 2007, in the steps of
/// Torrent-Moreno et al., MSWiM 2006).
#[must_use]
pub fn twice_shape(distance_m: f64) -> u32 {
    match distance_m {
        d if d < 50.0 => 6,
        d if d < 150.0 => 3,
        _ => 2,
    }
}

/// Most values of [`twice_shape`].
const MOST_HALVES: u32 = 6;

/// Power of a message at a receiver as a share of its mean. The square of Nakagami's amplitude has a gamma distribution of shape m and
/// mean 1: a sum of 2m squared normal numbers.
#[must_use]
pub fn power_gain(random: &RadioRandom, link: LinkKey, twice_shape: u32) -> f64 {
    let halves = twice_shape.clamp(1, MOST_HALVES);
    let [a, b, c, d] = random.uniforms(link, RadioDraw::Fading, 0);
    // Two squared normal numbers are an exponential one: −2 ln u.
    let pairs = (halves / 2) as usize;
    let product: f64 = [a, b, c].iter().take(pairs).product();
    let mut sum = -2.0 * libm::log(product);
    if halves % 2 == 1 {
        // The one that is left, by the Box–Muller transform. Pairs below three use neither `c` nor `d`.
        let cos = libm::cos(std::f64::consts::TAU * d);
        sum += -2.0 * libm::log(if pairs < 3 { c } else { 1.0 }) * cos * cos;
    }
    sum / f64::from(halves)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_power_has_the_moments_of_its_gamma_distribution() {
        const N: u32 = 200_000;
        let random = RadioRandom::new(5);
        for halves in [1, 2, 3, 5, 6] {
            let draw = |message| {
                let link = LinkKey {
                    sender: 1,
                    receiver: 2,
                    message,
                };
                power_gain(&random, link, halves)
            };
            let (n, shape) = (f64::from(N), f64::from(halves) / 2.0);
            let mean = (0..N).map(draw).sum::<f64>() / n;
            let variance = (0..N).map(|i| (draw(i) - mean).powi(2)).sum::<f64>() / n;
            // Five standard errors: variance 1/m; fourth central moment 3/m² + 6/m³.
            assert!((mean - 1.0).abs() < 5.0 / (n * shape).sqrt(), "m {shape}: mean {mean}");
            let spread = ((2.0 / shape.powi(2) + 6.0 / shape.powi(3)) / n).sqrt();
            assert!(
                (variance - 1.0 / shape).abs() < 5.0 * spread,
                "m {shape}: variance {variance}"
            );
        }
    }

    #[test]
    fn beyond_150_m_the_power_is_exponential() {
        const N: u32 = 100_000;
        let random = RadioRandom::new(6);
        for threshold in [0.1, 0.5, 1.0, 2.0, 5.0] {
            let above = (0..N).filter(|message| {
                let link = LinkKey {
                    sender: 3,
                    receiver: 4,
                    message: *message,
                };
                power_gain(&random, link, twice_shape(200.0)) > threshold
            });
            let (share, n) = (libm::exp(-threshold), f64::from(N));
            let found = above.count() as f64 / n;
            assert!(
                (found - share).abs() < 5.0 * (share * (1.0 - share) / n).sqrt(),
                "{found} for {share}"
            );
        }
    }
}
