//! Counter-based random numbers: a value depends on its purpose, never on when or in which order it is drawn.

use ipc_schema::sensor::NoiseStream;

use crate::wide::VectorPath;

pub mod normals;

pub use normals::philox4x32;
use normals::{BATCH, NormalBatch, NormalBlock, NormalPurpose};

/// Random numbers of one noise stream of one vehicle in one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RandomStream {
    /// Seed of the episode.
    pub episode_seed: u64,
    /// Hash of the vehicle's SUMO id.
    pub id_hash: u64,
    /// The sensor, or part of a sensor, that the numbers are for.
    pub sensor: NoiseStream,
}

/// The key of an episode's numbers.
fn key(episode_seed: u64) -> [u32; 2] {
    [episode_seed as u32, (episode_seed >> 32) as u32]
}

impl RandomStream {
    /// Four independent standard normal numbers for the sensor's `sample`-th sample.
    #[must_use]
    pub fn normals(&self, sample: u32) -> NormalBlock {
        normals::block(self.counter(sample, 0), key(self.episode_seed))
    }

    /// Two numbers uniform in [0, 1) for the `part`-th part of the sensor's `sample`-th sample; 24 bits of parts count.
    #[must_use]
    pub fn uniform_pair(&self, sample: u32, part: u32) -> [f64; 2] {
        let [a, b, c, d] = philox4x32(self.counter(sample, part), key(self.episode_seed));
        [[a, b], [c, d]]
            .map(|[high, low]| (f64::from(high >> 5) * 67_108_864.0 + f64::from(low >> 6)) / 9_007_199_254_740_992.0)
    }

    fn counter(&self, sample: u32, part: u32) -> [u32; 4] {
        [
            sample,
            self.sensor as u32 | (part << 8),
            self.id_hash as u32,
            (self.id_hash >> 32) as u32,
        ]
    }
}

/// Random numbers of [`BATCH`] vehicles at a time. All vehicles need the same numbers at a tick, so they are planned once and drawn
/// batch by batch.
#[derive(Debug)]
pub struct NormalDraws {
    path: VectorPath,
    plan: Vec<NormalPurpose>,
    blocks: Vec<NormalBatch>,
}

impl Default for NormalDraws {
    fn default() -> Self {
        Self::on(VectorPath::widest())
    }
}

impl NormalDraws {
    /// Draws with the instructions of `path`.
    #[must_use]
    pub fn on(path: VectorPath) -> Self {
        Self {
            path,
            plan: Vec::new(),
            blocks: Vec::new(),
        }
    }

    /// Clears the plan.
    pub fn clear(&mut self) {
        self.plan.clear();
    }

    /// Plans a block of numbers for a sample of a sensor.
    pub fn plan(&mut self, sensor: NoiseStream, sample: u32) {
        self.plan.push([sample, sensor as u32]);
    }

    /// Draws the planned numbers for the vehicles with these ids.
    pub fn draw(&mut self, episode_seed: u64, ids: &[u64; BATCH]) {
        self.blocks.resize(self.plan.len(), [[0.0; 4]; BATCH]);
        normals::fill(self.path, key(episode_seed), ids, &self.plan, &mut self.blocks);
    }

    /// The numbers of vehicle `member` of the batch, in the order of the plan.
    #[must_use]
    #[inline]
    pub fn of(&self, member: usize) -> DrawnNormals<'_> {
        DrawnNormals {
            blocks: &self.blocks,
            member: member % BATCH,
        }
    }
}

/// One vehicle's numbers of a batch.
#[derive(Debug, Clone, Copy, Default)]
pub struct DrawnNormals<'a> {
    blocks: &'a [NormalBatch],
    member: usize,
}

impl DrawnNormals<'_> {
    /// Takes the next block if one was planned, else zeros.
    #[inline]
    pub fn take(&mut self, is_planned: bool) -> NormalBlock {
        if is_planned { self.split(1).at(0) } else { [0.0; 4] }
    }

    /// Takes the next `count` blocks, or as many as there are.
    #[must_use]
    #[inline(always)]
    pub fn split(&mut self, count: usize) -> Self {
        let (blocks, rest) = self.blocks.split_at(count.min(self.blocks.len()));
        self.blocks = rest;
        Self { blocks, ..*self }
    }

    /// The block at an index; zeros after the last.
    #[must_use]
    #[inline(always)]
    pub fn at(&self, index: usize) -> NormalBlock {
        match self.blocks.get(index) {
            Some(batch) => batch[self.member % BATCH],
            None => [0.0; 4],
        }
    }

    /// Four blocks from an index on; zeros after the last.
    #[must_use]
    #[inline(always)]
    pub fn four(&self, index: usize) -> [f32; 16] {
        let member = self.member % BATCH;
        let four = match self.blocks.get(index..index + 4) {
            Some([a, b, c, d]) => [a[member], b[member], c[member], d[member]],
            _ => [0, 1, 2, 3].map(|i| self.at(index + i)),
        };
        bytemuck::must_cast(four)
    }

    /// Number of blocks.
    #[must_use]
    pub fn len(&self) -> usize {
        self.blocks.len()
    }

    /// True if there are no blocks.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.blocks.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stream(id_hash: u64, sensor: NoiseStream) -> RandomStream {
        RandomStream {
            episode_seed: 42,
            id_hash,
            sensor,
        }
    }

    /// Mean, variance, skewness, kurtosis.
    fn moments(values: &[f64]) -> [f64; 4] {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let central = |power| values.iter().map(|v| (v - mean).powi(power)).sum::<f64>() / n;
        let variance = central(2);
        [
            mean,
            variance,
            central(3) / variance.powf(1.5),
            central(4) / variance.powi(2),
        ]
    }

    #[test]
    fn normals_are_standard_normal() {
        const N: u32 = 1_000_000;
        let stream = stream(7, NoiseStream::Gnss);
        let blocks: Vec<NormalBlock> = (0..N).map(|sample| stream.normals(sample)).collect();
        for axis in 0..4 {
            let values: Vec<f64> = blocks.iter().map(|block| f64::from(block[axis])).collect();
            let [mean, variance, skewness, kurtosis] = moments(&values);
            // Five standard errors: 1/√N, √(2/N), √(6/N), √(24/N).
            let n = f64::from(N);
            assert!(mean.abs() < 5.0 / n.sqrt(), "mean {mean}");
            assert!((variance - 1.0).abs() < 5.0 * (2.0 / n).sqrt(), "variance {variance}");
            assert!(skewness.abs() < 5.0 * (6.0 / n).sqrt(), "skewness {skewness}");
            assert!((kurtosis - 3.0).abs() < 5.0 * (24.0 / n).sqrt(), "kurtosis {kurtosis}");
            // Shares beyond 1 to 4.5 σ: erfc(x/√2), five standard errors of a count.
            for beyond in [1.0, 2.0, 3.0, 4.0, 4.5] {
                let share = libm::erfc(beyond / std::f64::consts::SQRT_2);
                let count = values.iter().filter(|value| value.abs() > beyond).count() as f64;
                assert!(
                    (count - n * share).abs() < 5.0 * (n * share).sqrt(),
                    "{count} beyond {beyond} σ, {} expected",
                    n * share
                );
            }
        }
    }

    #[test]
    fn draws_are_the_streams_own_numbers() {
        let mut draws = NormalDraws::default();
        assert!(draws.of(3).is_empty());
        let mut ids = [9; BATCH];
        (ids[3], ids[15]) = (7, u64::MAX - 5);
        for round in 0..3_u32 {
            draws.clear();
            draws.plan(NoiseStream::Gnss, round);
            draws.plan(NoiseStream::ImuBack, u32::MAX);
            draws.draw(42, &ids);
            assert_eq!(draws.of(3).at(0), stream(7, NoiseStream::Gnss).normals(round));
            let back = stream(u64::MAX - 5, NoiseStream::ImuBack).normals(u32::MAX);
            let mut drawn = draws.of(15);
            let flat: [[f32; 4]; 4] = bytemuck::must_cast(drawn.four(1));
            assert_eq!(flat, [back, [0.0; 4], [0.0; 4], [0.0; 4]]);
            assert_eq!((drawn.len(), drawn.take(false)), (2, [0.0; 4]));
            let _ = drawn.take(true);
            assert_eq!((drawn.take(true), drawn.take(true)), (back, [0.0; 4]));
        }
    }

    #[test]
    fn uniform_pairs_are_uniform_and_parts_differ() {
        const N: u32 = 100_000;
        let stream = stream(7, NoiseStream::GnssBlackout);
        let pairs: Vec<[f64; 2]> = (0..N).map(|part| stream.uniform_pair(3, part)).collect();
        for axis in 0..2 {
            let mean = pairs.iter().map(|pair| pair[axis]).sum::<f64>() / f64::from(N);
            assert!((mean - 0.5).abs() < 5.0 / (12.0 * f64::from(N)).sqrt(), "{mean}");
            assert!(pairs.iter().all(|pair| (0.0..1.0).contains(&pair[axis])));
        }
    }

    #[test]
    fn streams_of_vehicles_sensors_axes_and_samples_are_independent() {
        const N: u32 = 100_000;
        let draw =
            |id_hash, sensor, axis: usize| move |sample: u32| f64::from(stream(id_hash, sensor).normals(sample)[axis]);
        let reference = draw(1, NoiseStream::Gnss, 0);
        let others: [&dyn Fn(u32) -> f64; 8] = [
            &draw(2, NoiseStream::Gnss, 0),
            &draw(1, NoiseStream::ImuFront, 0),
            &draw(1, NoiseStream::GnssCorrelated, 0),
            &draw(1, NoiseStream::Gnss, 1),
            &draw(1, NoiseStream::Gnss, 2),
            &draw(1 << 32, NoiseStream::Gnss, 0),
            &|sample| reference(sample + 1),
            &|sample| reference(sample + 16),
        ];
        for (number, other) in others.iter().enumerate() {
            let correlation = (0..N).map(|s| reference(s) * other(s)).sum::<f64>() / f64::from(N);
            assert!(
                correlation.abs() < 5.0 / f64::from(N).sqrt(),
                "correlation {correlation} with {number}"
            );
        }
    }
}
