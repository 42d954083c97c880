//! Counter-based random numbers: a value depends on what it is for, never on when or in which order it is drawn.

/// Random stream of one sensor of one vehicle in one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stream {
    /// Seed of the episode.
    pub episode_seed: u64,
    /// Hash of the vehicle's SUMO id.
    pub id_hash: u64,
    /// Which sensor.
    pub sensor: Sensor,
}

/// Sensors with random streams of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Sensor {
    /// GNSS receiver.
    Gnss = 1,
    /// Accelerometer.
    Accelerometer = 2,
    /// Gyroscope and compass.
    Gyroscope = 3,
    /// Wheel speed and steering angle.
    SpeedSteering = 4,
}

impl Stream {
    /// Four independent standard normal numbers for the sensor's `sample`-th sample (Box–Muller transform; libm is used so that
    /// the bits do not depend on the C library).
    #[must_use]
    pub fn normals(&self, sample: u32) -> [f64; 4] {
        let [a, b, c, d] = self.uniform(sample);
        let (n0, n1) = box_muller(a, b);
        let (n2, n3) = box_muller(c, d);
        [n0, n1, n2, n3]
    }

    /// The first two of [`Stream::normals`], at half the cost.
    #[must_use]
    pub fn normal_pair(&self, sample: u32) -> [f64; 2] {
        let [a, b, ..] = self.uniform(sample);
        let (n0, n1) = box_muller(a, b);
        [n0, n1]
    }

    fn uniform(&self, sample: u32) -> [u32; 4] {
        let counter = [
            sample,
            self.sensor as u32,
            self.id_hash as u32,
            (self.id_hash >> 32) as u32,
        ];
        philox4x32(counter, [self.episode_seed as u32, (self.episode_seed >> 32) as u32])
    }
}

/// Philox4x32-10, the counter-based generator of Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
#[must_use]
pub fn philox4x32(counter: [u32; 4], key: [u32; 2]) -> [u32; 4] {
    const MULTIPLIERS: [u64; 2] = [0xD251_1F53, 0xCD9E_8D57];
    const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];
    let ([mut c0, mut c1, mut c2, mut c3], [mut k0, mut k1]) = (counter, key);
    for _ in 0..10 {
        let (p0, p1) = (MULTIPLIERS[0] * u64::from(c0), MULTIPLIERS[1] * u64::from(c2));
        (c0, c1, c2, c3) = (
            (p1 >> 32) as u32 ^ c1 ^ k0,
            p1 as u32,
            (p0 >> 32) as u32 ^ c3 ^ k1,
            p0 as u32,
        );
        (k0, k1) = (k0.wrapping_add(WEYL[0]), k1.wrapping_add(WEYL[1]));
    }
    [c0, c1, c2, c3]
}

/// Two independent standard normal numbers from two uniform 32-bit ones.
fn box_muller(a: u32, b: u32) -> (f64, f64) {
    const SCALE: f64 = 1.0 / 4_294_967_296.0;
    // In (0, 1]: the logarithm is finite.
    let radius = libm::sqrt(-2.0 * libm::log((f64::from(a) + 1.0) * SCALE));
    let (sine, cosine) = libm::sincos(std::f64::consts::TAU * (f64::from(b) * SCALE));
    (radius * cosine, radius * sine)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Known answers published with Random123 (kat_vectors, philox 4x32, 10 rounds).
    #[test]
    fn philox_gives_the_published_answers() {
        assert_eq!(
            philox4x32([0; 4], [0; 2]),
            [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]
        );
        assert_eq!(
            philox4x32([u32::MAX; 4], [u32::MAX; 2]),
            [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]
        );
        assert_eq!(
            philox4x32(
                [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344],
                [0xa409_3822, 0x299f_31d0]
            ),
            [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1]
        );
    }

    fn stream(id_hash: u64, sensor: Sensor) -> Stream {
        Stream {
            episode_seed: 42,
            id_hash,
            sensor,
        }
    }

    fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64, f64) {
        let n = values.clone().count() as f64;
        let mean = values.clone().sum::<f64>() / n;
        let variance = values.clone().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        let kurtosis = values.map(|v| (v - mean).powi(4)).sum::<f64>() / n / variance.powi(2);
        (mean, variance, kurtosis)
    }

    #[test]
    fn normals_are_standard_normal() {
        const N: u32 = 100_000;
        let stream = stream(7, Sensor::Gnss);
        for axis in 0..4 {
            let (mean, variance, kurtosis) = moments((0..N).map(|sample| stream.normals(sample)[axis]));
            // Five standard errors: 1/√N, √(2/N), √(24/N).
            let n = f64::from(N);
            assert!(mean.abs() < 5.0 / n.sqrt(), "mean {mean}");
            assert!((variance - 1.0).abs() < 5.0 * (2.0 / n).sqrt(), "variance {variance}");
            assert!((kurtosis - 3.0).abs() < 5.0 * (24.0 / n).sqrt(), "kurtosis {kurtosis}");
        }
    }

    #[test]
    fn a_pair_is_the_first_two() {
        let stream = stream(7, Sensor::Gnss);
        assert!((0..100).all(|sample| stream.normals(sample)[..2] == stream.normal_pair(sample)));
    }

    #[test]
    fn streams_of_vehicles_sensors_and_axes_are_independent() {
        const N: u32 = 100_000;
        let correlation =
            |a: &dyn Fn(u32) -> f64, b: &dyn Fn(u32) -> f64| (0..N).map(|s| a(s) * b(s)).sum::<f64>() / f64::from(N);
        let draw = |id_hash, sensor, axis: usize| move |sample: u32| stream(id_hash, sensor).normals(sample)[axis];
        let reference = draw(1, Sensor::Gnss, 0);
        let others: [&dyn Fn(u32) -> f64; 4] = [
            &draw(2, Sensor::Gnss, 0),
            &draw(1, Sensor::Gyroscope, 0),
            &draw(1, Sensor::Gnss, 1),
            &draw(1 << 32, Sensor::Gnss, 0),
        ];
        for other in others {
            let correlation = correlation(&reference, other);
            assert!(
                correlation.abs() < 5.0 / f64::from(N).sqrt(),
                "correlation {correlation}"
            );
        }
    }
}
