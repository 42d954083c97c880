//! Fast fading of a received message: Nakagami's distribution of the amplitude.

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

/// Power of a message at a receiver as a share of its mean, from four numbers uniform in (0, 1), of which it leaves the last one. The
/// square of Nakagami's amplitude has a gamma distribution of shape m and mean 1: a sum of 2m squared normal numbers.
#[must_use]
pub fn power_gain([a, b, c, _]: [f64; 4], twice_shape: u32) -> f64 {
    // Two squared normal numbers are an exponential one: −2 ln u. One is that times a squared cosine, by the Box–Muller transform.
    match twice_shape {
        6 => -libm::log(a * b * c) / 3.0,
        3 => {
            let cos = libm::cos(std::f64::consts::TAU * c);
            -2.0 * (libm::log(a) + libm::log(b) * cos * cos) / 3.0
        }
        _ => -libm::log(a),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{LinkKey, RadioDraw, RadioRandom};

    fn gain(random: &RadioRandom, message: u32, twice_shape: u32) -> f64 {
        let link = LinkKey {
            sender: 1,
            receiver: 2,
            message,
        };
        power_gain(random.uniforms(link, RadioDraw::Reception, 0), twice_shape)
    }

    #[test]
    fn the_power_has_the_moments_of_its_gamma_distribution() {
        const N: u32 = 200_000;
        let random = RadioRandom::new(5);
        for halves in [2, 3, 6] {
            let draw = |message| gain(&random, message, halves);
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
            let above = (0..N).filter(|message| gain(&random, *message, twice_shape(200.0)) > threshold);
            let (share, n) = (libm::exp(-threshold), f64::from(N));
            let found = above.count() as f64 / n;
            assert!(
                (found - share).abs() < 5.0 * (share * (1.0 - share) / n).sqrt(),
                "{found} for {share}"
            );
        }
    }
}
