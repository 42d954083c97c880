//! Random numbers and elementary functions, sixteen at a time.
//!
//! A number depends on (seed of the episode, vehicle, tick, ray) alone. Philox draws a key for each scan from the first three; one
//! further draw serves two rays.

use ipc_schema::sensor::NoiseStream;

use super::simd::{Floats, Simd};
use crate::noise::philox4x32;

/// Random numbers of one scan.
#[derive(Debug, Clone, Copy)]
pub(in crate::sensors) struct ScanKey {
    key: [u32; 2],
    rest: [u32; 3],
}

impl ScanKey {
    pub(super) fn new(episode_seed: u64, id_hash: u64, tick: u64) -> Self {
        Self::of(NoiseStream::Lidar, episode_seed, id_hash, tick)
    }

    /// The key of a sample of another sensor.
    pub(in crate::sensors) fn of(stream: NoiseStream, episode_seed: u64, id_hash: u64, tick: u64) -> Self {
        let stream = stream as u32;
        let counter = [
            tick as u32,
            stream | ((tick >> 32) as u32) << 8,
            id_hash as u32,
            (id_hash >> 32) as u32,
        ];
        let seed = [episode_seed as u32, (episode_seed >> 32) as u32];
        let [a, b, c, d] = philox4x32(counter, seed);
        Self {
            key: [a, b],
            rest: [stream, c, d],
        }
    }
}

/// Random numbers of two groups of rays.
pub(in crate::sensors) struct RayRandoms<S: Simd> {
    /// Standard normal.
    pub(in crate::sensors) normal: [S::F; 2],
    /// In (0, 1).
    pub(super) uniform: [S::F; 2],
}

/// A word's upper 24 bits in (0, 1).
#[inline(always)]
fn uniform<S: Simd>(word: S::U) -> S::F {
    let centre = S::splat(0.5);
    (S::from_signed(S::right::<8>(word)) + centre) * S::splat(1.0 / 16_777_216.0)
}

/// Random numbers of consecutive groups, two to a draw, from draw `first` on. This is a separate loop: a draw is a long chain of
/// operations, and the processor can overlap two draws but not a draw with the work on its returns.
#[inline(always)]
pub(super) fn fill<S: Simd>(key: &ScanKey, first: u32, groups: usize, normal: &mut [Floats], uniform: &mut [Floats]) {
    let (normals, uniforms) = (normal[..groups].chunks_mut(2), uniform[..groups].chunks_mut(2));
    for (number, (normal, uniform)) in (first..).zip(normals.zip(uniforms)) {
        let drawn = draw::<S>(key, number);
        S::store(drawn.normal[0], &mut normal[0]);
        S::store(drawn.uniform[0], &mut uniform[0]);
        if let ([_, normal], [_, uniform]) = (normal, uniform) {
            S::store(drawn.normal[1], normal);
            S::store(drawn.uniform[1], uniform);
        }
    }
}

/// Random numbers of two groups of a scan.
#[inline(always)]
pub(in crate::sensors) fn draw<S: Simd>(key: &ScanKey, number: u32) -> RayRandoms<S> {
    let [a, b, c, d] = S::philox(number.wrapping_mul(16), key.rest, key.key);
    // Box and Muller.
    let radius = S::sqrt(S::splat(-2.0) * ln::<S>(uniform::<S>(a)));
    let [sine, cosine] = sin_cos_turns::<S>(b);
    RayRandoms {
        normal: [radius * cosine, radius * sine],
        uniform: [uniform::<S>(c), uniform::<S>(d)],
    }
}

#[inline(always)]
fn horner<S: Simd, const N: usize>(x: S::F, coefficients: [f32; N]) -> S::F {
    let mut sum = S::splat(coefficients[0]);
    for coefficient in &coefficients[1..] {
        sum = sum * x + S::splat(*coefficient);
    }
    sum
}

/// Natural logarithm of normal numbers: exponent and a polynomial over √½ … √2 (Cephes, `logf`).
#[inline(always)]
pub(super) fn ln<S: Simd>(x: S::F) -> S::F {
    let bits = S::words(x);
    // The mantissa is taken from an interval that begins at √½.
    let shifted = S::minus(bits, S::splat_words(0x3F35_04F3));
    let exponent = S::from_signed(sign_shift::<S>(shifted));
    let mantissa = S::plus(
        S::and(shifted, S::splat_words(0x007F_FFFF)),
        S::splat_words(0x3F35_04F3),
    );
    let f = S::floats(mantissa) - S::splat(1.0);
    let square = f * f;
    // Cephes' nine coefficients, summed in pairs: half as long a chain of dependent operations.
    let pair = |high: f32, low: f32| S::splat(high) * f + S::splat(low);
    let fourth = square * square;
    let low = pair(-0.249_999_94, 0.333_333_3) + square * pair(-1.666_805_8e-1, 2.000_071_5e-1);
    let high = pair(-1.242_014_1e-1, 1.424_932_3e-1) + square * pair(-1.151_461e-1, 1.167_699_9e-1);
    let tail = low + fourth * (high + fourth * S::splat(7.037_683_6e-2));
    let small = f * square * tail - square * S::splat(0.5) + f;
    small + exponent * S::splat(std::f32::consts::LN_2)
}

/// Words as signed numbers over 2²³, towards minus infinity: by way of the unsigned shift.
#[inline(always)]
fn sign_shift<S: Simd>(word: S::U) -> S::U {
    let raised = S::right::<23>(S::plus(word, S::splat_words(0x8000_0000)));
    S::minus(raised, S::splat_words(256))
}

/// Sine and cosine of a word as a share of a full turn: a quadrant and polynomials over ±π/4 (Cephes, `sinf`, `cosf`).
#[inline(always)]
pub(super) fn sin_cos_turns<S: Simd>(word: S::U) -> [S::F; 2] {
    let quadrant = S::right::<30>(S::plus(word, S::splat_words(1 << 29)));
    let rest = S::minus(word, S::left::<30>(quadrant));
    let x = S::from_signed(rest) * S::splat((std::f64::consts::TAU / 4_294_967_296.0) as f32);
    let square = x * x;
    let sine = x + x * square * horner::<S, 3>(square, [-1.951_529_6e-4, 8.332_161e-3, -1.666_665_5e-1]);
    let cosine = S::splat(1.0) - square * S::splat(0.5)
        + square * square * horner::<S, 3>(square, [2.443_315_7e-5, -1.388_731_6e-3, 4.166_664_6e-2]);
    let one = S::splat_words(1);
    let swapped = S::equal(S::and(quadrant, one), one);
    let sine_sign = S::left::<30>(S::and(quadrant, S::splat_words(2)));
    let cosine_sign = S::left::<30>(S::and(S::plus(quadrant, one), S::splat_words(2)));
    let signed = |value: S::F, sign: S::U| S::floats(S::xor(S::words(value), sign));
    [
        signed(S::select(swapped, cosine, sine), sine_sign),
        signed(S::select(swapped, sine, cosine), cosine_sign),
    ]
}

/// exp(−x) for x ≥ 0: 2^(whole part) by the exponent, the rest by a polynomial (Cephes, `expf`).
#[inline(always)]
pub(in crate::sensors) fn exp_minus<S: Simd>(x: S::F) -> S::F {
    let x = S::min(x, S::splat(80.0));
    let scaled = x * S::splat(-std::f32::consts::LOG2_E);
    // Adding and taking away 1.5 · 2²³ rounds to a whole number, whose bits stand in the mantissa meanwhile.
    let magic = S::splat(12_582_912.0);
    let raised = scaled + magic;
    let whole = raised - magic;
    let rest = S::splat(0.0) - x - whole * S::splat(0.693_359_4) + whole * S::splat(2.121_944_4e-4);
    let tail = horner::<S, 6>(
        rest,
        [
            1.987_569_1e-4,
            1.398_199_9e-3,
            8.333_452e-3,
            4.166_579_6e-2,
            1.666_666_5e-1,
            0.5,
        ],
    );
    let mantissa = tail * rest * rest + rest + S::splat(1.0);
    S::floats(S::plus(S::words(mantissa), S::left::<23>(S::words(raised))))
}

#[cfg(test)]
mod tests {
    use super::{super::simd::plain::Plain, *};

    fn element(value: <Plain as Simd>::F) -> f64 {
        f64::from(value.0[0])
    }

    /// Single precision: two units in the last place, and the absolute error where the result is near zero.
    #[test]
    fn the_functions_are_as_good_as_their_precision() {
        for i in 1..200_000_u32 {
            let x = f64::from(i as f32 / 200_000.0);
            let error = (element(ln::<Plain>(Plain::splat(x as f32))) - x.ln()).abs();
            assert!(error < 2.5e-7 * x.ln().abs().max(1.0), "ln {x}: {error}");
            let y = f64::from((x * 30.0) as f32);
            let error = (element(exp_minus::<Plain>(Plain::splat(y as f32))) / (-y).exp() - 1.0).abs();
            assert!(error < 3e-7, "exp −{y}: {error}");
            let word = i.wrapping_mul(21_474);
            let [sine, cosine] = sin_cos_turns::<Plain>(Plain::splat_words(word));
            let angle = f64::from(word) / 4_294_967_296.0 * std::f64::consts::TAU;
            assert!((element(sine) - angle.sin()).abs() < 2e-7 && (element(cosine) - angle.cos()).abs() < 2e-7);
        }
    }

    #[test]
    fn normals_are_standard_normal_and_uniforms_uniform() {
        const N: u32 = 10_000;
        let key = ScanKey::new(42, 7, 3);
        let (mut normals, mut uniforms) = (Vec::new(), Vec::new());
        for number in 0..N {
            let drawn = draw::<Plain>(&key, number);
            drawn.normal.iter().for_each(|n| normals.extend(n.0.map(f64::from)));
            drawn.uniform.iter().for_each(|u| uniforms.extend(u.0.map(f64::from)));
        }
        let n = normals.len() as f64;
        let mean = |values: &[f64], power: i32| values.iter().map(|v| v.powi(power)).sum::<f64>() / n;
        // Five standard errors: 1/√n, √(2/n), √(96/n) of the fourth moment; 1/√(12 n), √(4/45/n).
        assert!(mean(&normals, 1).abs() < 5.0 / n.sqrt());
        assert!((mean(&normals, 2) - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
        assert!((mean(&normals, 4) - 3.0).abs() < 5.0 * (96.0 / n).sqrt());
        assert!((mean(&uniforms, 1) - 0.5).abs() < 5.0 / (12.0 * n).sqrt());
        assert!((mean(&uniforms, 2) - 1.0 / 3.0).abs() < 5.0 * (4.0 / 45.0 / n).sqrt());
    }

    #[test]
    fn keys_differ_by_episode_vehicle_and_tick() {
        let first = |key: ScanKey| {
            let [words, ..] = Plain::philox(0, key.rest, key.key);
            words[0]
        };
        let all = [
            (1, 1, 1),
            (2, 1, 1),
            (1, 2, 1),
            (1, 1, 2),
            (1 << 32, 1, 1),
            (1, 1 << 32, 1),
            (1, 1, 1 << 32),
        ];
        let mut drawn = all.map(|(seed, id, tick)| first(ScanKey::new(seed, id, tick)));
        drawn.sort_unstable();
        assert!(drawn.windows(2).all(|two| two[0] != two[1]));
    }

    /// The vector makes of every operation that is not a plain IEEE one, against arrays.
    #[cfg(target_arch = "x86_64")]
    #[test]
    fn draws_are_the_same_bits_on_every_make() {
        #[target_feature(enable = "avx2")]
        fn avx2(key: &ScanKey, number: u32) -> [Floats; 4] {
            stored::<super::super::simd::avx2::Avx2>(key, number)
        }
        #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl")]
        fn avx512(key: &ScanKey, number: u32) -> [Floats; 4] {
            stored::<super::super::simd::avx512::Avx512>(key, number)
        }
        #[inline(always)]
        fn stored<S: Simd>(key: &ScanKey, number: u32) -> [Floats; 4] {
            let drawn = draw::<S>(key, number);
            let mut out = [Floats::ZERO; 4];
            let values = [drawn.normal[0], drawn.normal[1], drawn.uniform[0], drawn.uniform[1]];
            for (to, value) in out.iter_mut().zip(values) {
                S::store(value, to);
            }
            out
        }
        let key = ScanKey::new(1, 2, 3);
        for number in 0..1000 {
            let expected = stored::<Plain>(&key, number);
            #[expect(
                unsafe_code,
                reason = "calls of functions compiled for more than the baseline processor"
            )]
            if is_x86_feature_detected!("avx2") {
                // SAFETY: the processor has been asked.
                assert_eq!(unsafe { avx2(&key, number) }, expected);
            }
            #[expect(unsafe_code, reason = "as above")]
            if is_x86_feature_detected!("avx512dq") && is_x86_feature_detected!("avx512vl") {
                // SAFETY: as above.
                assert_eq!(unsafe { avx512(&key, number) }, expected);
            }
        }
    }
}
