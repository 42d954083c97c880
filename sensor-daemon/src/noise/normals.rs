//! Standard normal numbers for a batch of sixteen vehicles: Philox, then the Box–Muller transform with polynomials in f32.
//!
//! Four numbers from one block of Philox: radius √(−2 ln u) and angle 2πv, twice. u has 31 bits, so that the largest number is
//! 6.66 (a normal number exceeds that once in 4·10¹⁰); v has 32. The polynomials are minimax fits over half an octave and a
//! quarter of a turn; a test compares them with libm.

use crate::wide::{VectorPath, VectorWork};

/// Vehicles in a batch: one AVX-512 register of 32-bit numbers.
pub const BATCH: usize = 16;

/// Four independent standard normal numbers.
pub type NormalBlock = [f32; 4];

/// One block for each vehicle of a batch.
pub type NormalBatch = [NormalBlock; BATCH];

/// Purpose of the numbers of a batch: the first two words of their counters (sample, noise stream).
pub type NormalPurpose = [u32; 2];

const MULTIPLIERS: [u64; 2] = [0xD251_1F53, 0xCD9E_8D57];
const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];
const LOW: u64 = 0xFFFF_FFFF;

/// Philox4x32-10, the counter-based generator of Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
#[must_use]
#[inline(always)]
pub fn philox4x32(counter: [u32; 4], key: [u32; 2]) -> [u32; 4] {
    // Words in 64 bits whose upper halves are ignored: the product of two lower halves is one instruction.
    let [mut c0, mut c1, mut c2, mut c3] = counter.map(u64::from);
    let [mut k0, mut k1] = key;
    for _ in 0..10 {
        let (p0, p1) = (MULTIPLIERS[0] * (c0 & LOW), MULTIPLIERS[1] * (c2 & LOW));
        (c0, c1, c2, c3) = ((p1 >> 32) ^ c1 ^ u64::from(k0), p1, (p0 >> 32) ^ c3 ^ u64::from(k1), p0);
        (k0, k1) = (k0.wrapping_add(WEYL[0]), k1.wrapping_add(WEYL[1]));
    }
    [c0 as u32, c1 as u32, c2 as u32, c3 as u32]
}

/// −2 ln u for u in (0, 1], relative error below 3e-7.
#[must_use]
#[inline(always)]
pub fn minus_two_ln(u: f32) -> f32 {
    const HALF_ROOT_BITS: u32 = std::f32::consts::FRAC_1_SQRT_2.to_bits();
    // u = m 2^e with m in [√½, √2): where u is close to 1 the logarithm of m is small and keeps its digits.
    let bits = u.to_bits().wrapping_sub(HALF_ROOT_BITS);
    let e = (bits as i32 >> 23) as f32;
    let f = f32::from_bits((bits & 0x007F_FFFF).wrapping_add(HALF_ROOT_BITS)) - 1.0;
    let square = f * f;
    let tail = 0.333_341_66
        + f * (-0.250_017
            + f * (0.199_548_74 + f * (-0.165_644_26 + f * (0.149_780_12 + f * (-0.143_790_04 + f * 0.086_721_19)))));
    -2.0 * (e * std::f32::consts::LN_2 + (f + square * (f * tail - 0.5)))
}

/// Cosine and sine of 2π · `turns` / 2³², error below 1.5e-7.
#[must_use]
#[inline(always)]
pub fn cos_sin(turns: u32) -> (f32, f32) {
    const RAD: f32 = (std::f64::consts::TAU / 4_294_967_296.0) as f32;
    // The nearest quarter turn and the remainder, at most an eighth of a turn.
    let quarter = turns.wrapping_add(1 << 29) >> 30;
    let x = turns.wrapping_sub(quarter << 30) as i32 as f32 * RAD;
    let q = x * x;
    let sin = x + x * q * (-0.166_666_51 + q * (0.008_331_979 + q * -0.000_194_956_01));
    let cos = 1.0 - 0.5 * q + q * q * (0.041_666_646 + q * (-0.001_388_736_8 + q * 2.443_841_4e-5));
    let odd = quarter & 1 != 0;
    let (c, s) = (if odd { sin } else { cos }, if odd { cos } else { sin });
    // The cosine is negative in quarters 1 and 2, the sine in 2 and 3.
    let sign_cos = (quarter ^ (quarter >> 1)) << 31;
    let sign_sin = (quarter >> 1) << 31;
    (
        f32::from_bits(c.to_bits() ^ sign_cos),
        f32::from_bits(s.to_bits() ^ sign_sin),
    )
}

/// Two independent standard normal numbers from two uniform words.
#[inline(always)]
fn box_muller(a: u32, b: u32) -> (f32, f32) {
    // In (0, 1]: the logarithm is finite.
    let u = ((a >> 1) as i32 as f32 + 0.5) * (1.0 / 2_147_483_648.0);
    let radius = minus_two_ln(u).max(0.0).sqrt();
    let (cos, sin) = cos_sin(b);
    (radius * cos, radius * sin)
}

/// The block at `counter`: the same bits as in [`Normals`].
#[must_use]
#[inline(always)]
pub fn block(counter: [u32; 4], key: [u32; 2]) -> NormalBlock {
    let [a, b, c, d] = philox4x32(counter, key);
    let ((n0, n1), (n2, n3)) = (box_muller(a, b), box_muller(c, d));
    [n0, n1, n2, n3]
}

/// Normal numbers for many purposes, for a batch of [`BATCH`] vehicles.
#[derive(Debug)]
struct Normals<'a> {
    key: [u32; 2],
    /// The last two words of each vehicle's counters.
    ids: [[u32; BATCH]; 2],
    purposes: &'a [NormalPurpose],
    blocks: &'a mut [NormalBatch],
}

impl VectorWork for Normals<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let [low, high] = self.ids;
        for ([sample, sensor], blocks) in self.purposes.iter().zip(self.blocks) {
            let mut words = [[0_u32; BATCH]; 4];
            for member in 0..BATCH {
                let word = philox4x32([*sample, *sensor, low[member], high[member]], self.key);
                for i in 0..4 {
                    words[i][member] = word[i];
                }
            }
            let mut numbers = [[0.0_f32; BATCH]; 4];
            for member in 0..BATCH {
                (numbers[0][member], numbers[1][member]) = box_muller(words[0][member], words[1][member]);
                (numbers[2][member], numbers[3][member]) = box_muller(words[2][member], words[3][member]);
            }
            for member in 0..BATCH {
                blocks[member] = [
                    numbers[0][member],
                    numbers[1][member],
                    numbers[2][member],
                    numbers[3][member],
                ];
            }
        }
    }
}

/// Fills `blocks`, one for each purpose, for the vehicles with these ids, with the instructions of `path`.
pub fn fill(
    path: VectorPath,
    key: [u32; 2],
    ids: &[u64; BATCH],
    purposes: &[NormalPurpose],
    blocks: &mut [NormalBatch],
) {
    path.run(Normals {
        key,
        ids: [ids.map(|id| id as u32), ids.map(|id| (id >> 32) as u32)],
        purposes,
        blocks,
    });
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

    #[test]
    fn the_logarithm_agrees_with_libm() {
        let mut worst = 0.0_f64;
        for i in 0..2_000_000_u32 {
            let u = ((i.wrapping_mul(2_654_435_761) >> 1) as f32 + 0.5) / 2_147_483_648.0;
            let near_one = 1.0 - i as f32 * f32::EPSILON / 2.0;
            let tiny = (i as f32 + 0.5) / 2_147_483_648.0;
            for u in [u, near_one, tiny] {
                let exact = -2.0 * libm::log(f64::from(u));
                let error = (f64::from(minus_two_ln(u)) - exact).abs() / exact.max(1e-8);
                worst = worst.max(error);
            }
        }
        assert!(worst < 3e-7, "{worst}");
        assert!(box_muller(0, 0).0 > 6.65 && box_muller(0, 0).0.is_finite());
        assert_eq!(box_muller(u32::MAX, 0).0, 0.0);
    }

    #[test]
    fn cosine_and_sine_agree_with_libm() {
        let mut worst = 0.0_f64;
        for i in 0..2_000_000_u32 {
            let turns = i.wrapping_mul(2_654_435_761);
            let (sin, cos) = libm::sincos(f64::from(turns) / 4_294_967_296.0 * std::f64::consts::TAU);
            let (c, s) = cos_sin(turns);
            worst = worst.max((f64::from(c) - cos).abs()).max((f64::from(s) - sin).abs());
        }
        assert!(worst < 1.5e-7, "{worst}");
        assert_eq!(
            [0, 1 << 30, 2 << 30, 3 << 30].map(cos_sin),
            [(1.0, 0.0), (-0.0, 1.0), (-1.0, -0.0), (0.0, -1.0)]
        );
    }

    #[test]
    fn every_path_gives_the_bits_of_a_block_alone() {
        const PURPOSES: usize = 500;
        let purposes: Vec<NormalPurpose> = (0..PURPOSES as u32)
            .map(|i| [i.wrapping_mul(0x9E37_79B9), i % 7])
            .collect();
        let ids: [u64; BATCH] = std::array::from_fn(|member| (member as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let key = [7, 0xDEAD_BEEF];
        for path in VectorPath::available() {
            let mut blocks = vec![[[0.0; 4]; BATCH]; PURPOSES];
            fill(path, key, &ids, &purposes, &mut blocks);
            for ([sample, sensor], batch) in purposes.iter().zip(&blocks) {
                for (id, numbers) in ids.iter().zip(batch) {
                    let alone = block([*sample, *sensor, *id as u32, (id >> 32) as u32], key);
                    assert_eq!(numbers.map(f32::to_bits), alone.map(f32::to_bits), "{path:?}");
                }
            }
        }
    }
}
