//! AVX2: sixteen numbers in two registers.

#![expect(unsafe_code, reason = "vector instructions: see the module above for why")]
// Their use is sound: these functions are inlined into code that is compiled for AVX2, and that code runs only on a processor on which
// `super::super::ScanPath` has detected AVX2.

use super::{Floats, LidarPoint, MULTIPLIERS, Simd, WEYL, WIDTH, Words, compact_rows};
use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Sub};

/// The AVX2 implementation.
#[derive(Clone, Copy)]
pub(in crate::sensors) struct Avx2;

/// Sixteen floats.
#[derive(Clone, Copy)]
pub(in crate::sensors) struct Avx2Floats([__m256; 2]);
/// Sixteen words.
#[derive(Clone, Copy)]
pub(in crate::sensors) struct Avx2Words([__m256i; 2]);

#[inline(always)]
fn two<A: Copy, R>(a: [A; 2], make: impl Fn(A) -> R) -> [R; 2] {
    [make(a[0]), make(a[1])]
}

#[inline(always)]
fn pair<A: Copy, R>(a: [A; 2], b: [A; 2], make: impl Fn(A, A) -> R) -> [R; 2] {
    [make(a[0], b[0]), make(a[1], b[1])]
}

macro_rules! operator {
    ($name:ident, $function:ident, $intrinsic:ident) => {
        impl $name for Avx2Floats {
            type Output = Self;
            #[inline(always)]
            fn $function(self, other: Self) -> Self {
                // SAFETY: AVX2 is available (see above).
                Self(unsafe {
                    [
                        $intrinsic(self.0[0], other.0[0]),
                        $intrinsic(self.0[1], other.0[1]),
                    ]
                })
            }
        }
    };
}
operator!(Add, add, _mm256_add_ps);
operator!(Sub, sub, _mm256_sub_ps);
operator!(Mul, mul, _mm256_mul_ps);
operator!(Div, div, _mm256_div_ps);

/// Largest of eight.
#[inline(always)]
pub(super) unsafe fn largest_of_8(value: __m256) -> f32 {
    // SAFETY: AVX2 is available (see above).
    unsafe {
        let four = _mm_max_ps(_mm256_castps256_ps128(value), _mm256_extractf128_ps::<1>(value));
        let two = _mm_max_ps(four, _mm_movehl_ps(four, four));
        _mm_cvtss_f32(_mm_max_ss(two, _mm_movehdup_ps(two)))
    }
}

/// High and low halves of the products of eight words with one.
#[inline(always)]
unsafe fn wide(a: __m256i, multiplier: u32) -> (__m256i, __m256i) {
    // SAFETY: AVX2 is available (see above).
    unsafe {
        let m = _mm256_set1_epi64x(i64::from(multiplier));
        let even = _mm256_mul_epu32(a, m);
        let odd = _mm256_mul_epu32(_mm256_srli_epi64::<32>(a), m);
        (
            _mm256_blend_epi32::<0xAA>(_mm256_srli_epi64::<32>(even), odd),
            _mm256_blend_epi32::<0xAA>(even, _mm256_slli_epi64::<32>(odd)),
        )
    }
}

impl Simd for Avx2 {
    type F = Avx2Floats;
    type U = Avx2Words;
    type M = [__m256; 2];

    #[inline(always)]
    fn splat(value: f32) -> Avx2Floats {
        // SAFETY: AVX2 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx2Floats(unsafe { [_mm256_set1_ps(value); 2] })
    }
    #[inline(always)]
    fn load(from: &Floats) -> Avx2Floats {
        let at = from.0.as_ptr();
        // SAFETY: AVX2 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx2Floats(unsafe { [_mm256_load_ps(at), _mm256_load_ps(at.add(8))] })
    }
    #[inline(always)]
    fn store(value: Avx2Floats, to: &mut Floats) {
        let at = to.0.as_mut_ptr();
        // SAFETY: AVX2 is available (see above); the pointer is that of a reference to as many aligned numbers.
        unsafe {
            _mm256_store_ps(at, value.0[0]);
            _mm256_store_ps(at.add(8), value.0[1]);
        }
    }
    #[inline(always)]
    fn sqrt(value: Avx2Floats) -> Avx2Floats {
        // SAFETY: AVX2 is available (see above).
        Avx2Floats(two(value.0, |a| unsafe { _mm256_sqrt_ps(a) }))
    }
    #[inline(always)]
    fn max(a: Avx2Floats, b: Avx2Floats) -> Avx2Floats {
        // SAFETY: AVX2 is available (see above).
        Avx2Floats(pair(a.0, b.0, |a, b| unsafe { _mm256_max_ps(a, b) }))
    }
    #[inline(always)]
    fn min(a: Avx2Floats, b: Avx2Floats) -> Avx2Floats {
        // SAFETY: AVX2 is available (see above).
        Avx2Floats(pair(a.0, b.0, |a, b| unsafe { _mm256_min_ps(a, b) }))
    }
    #[inline(always)]
    fn lt(a: Avx2Floats, b: Avx2Floats) -> [__m256; 2] {
        // SAFETY: AVX2 is available (see above).
        pair(a.0, b.0, |a, b| unsafe { _mm256_cmp_ps::<_CMP_LT_OQ>(a, b) })
    }
    #[inline(always)]
    fn le(a: Avx2Floats, b: Avx2Floats) -> [__m256; 2] {
        // SAFETY: AVX2 is available (see above).
        pair(a.0, b.0, |a, b| unsafe { _mm256_cmp_ps::<_CMP_LE_OQ>(a, b) })
    }
    #[inline(always)]
    fn both(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        // SAFETY: AVX2 is available (see above).
        pair(a, b, |a, b| unsafe { _mm256_and_ps(a, b) })
    }
    #[inline(always)]
    fn differ(a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
        // SAFETY: AVX2 is available (see above).
        pair(a, b, |a, b| unsafe { _mm256_xor_ps(a, b) })
    }
    #[inline(always)]
    fn bits(mask: [__m256; 2]) -> u32 {
        // SAFETY: AVX2 is available (see above).
        let [low, high] = two(mask, |a| unsafe { _mm256_movemask_ps(a) as u32 });
        low | high << 8
    }
    #[inline(always)]
    fn mask(bits: u32) -> [__m256; 2] {
        // SAFETY: AVX2 is available (see above).
        unsafe {
            let places = _mm256_set_epi32(128, 64, 32, 16, 8, 4, 2, 1);
            two([bits, bits >> 8], |bits| {
                let here = _mm256_and_si256(_mm256_set1_epi32(bits as i32), places);
                _mm256_castsi256_ps(_mm256_cmpeq_epi32(here, places))
            })
        }
    }
    #[inline(always)]
    fn select(mask: [__m256; 2], yes: Avx2Floats, no: Avx2Floats) -> Avx2Floats {
        // SAFETY: AVX2 is available (see above).
        Avx2Floats(unsafe {
            [
                _mm256_blendv_ps(no.0[0], yes.0[0], mask[0]),
                _mm256_blendv_ps(no.0[1], yes.0[1], mask[1]),
            ]
        })
    }
    #[inline(always)]
    fn store_where(mask: [__m256; 2], value: Avx2Floats, to: &mut Floats) {
        Self::store(Self::select(mask, value, Self::load(to)), to);
    }
    #[inline(always)]
    fn store_words_where(mask: [__m256; 2], value: u32, to: &mut Words) {
        let at: *mut f32 = to.0.as_mut_ptr().cast();
        // SAFETY: AVX2 is available (see above); the pointer is that of a reference to as many aligned numbers.
        unsafe {
            let value = _mm256_castsi256_ps(_mm256_set1_epi32(value as i32));
            _mm256_store_ps(at, _mm256_blendv_ps(_mm256_load_ps(at), value, mask[0]));
            let at = at.add(8);
            _mm256_store_ps(at, _mm256_blendv_ps(_mm256_load_ps(at), value, mask[1]));
        }
    }
    #[inline(always)]
    fn largest(value: Avx2Floats) -> f32 {
        // SAFETY: AVX2 is available (see above).
        unsafe { largest_of_8(_mm256_max_ps(value.0[0], value.0[1])) }
    }
    #[inline(always)]
    fn splat_words(value: u32) -> Avx2Words {
        // SAFETY: AVX2 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx2Words(unsafe { [_mm256_set1_epi32(value as i32); 2] })
    }
    #[inline(always)]
    fn load_words(from: &Words) -> Avx2Words {
        let at: *const __m256i = from.0.as_ptr().cast();
        // SAFETY: AVX2 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx2Words(unsafe { [_mm256_load_si256(at), _mm256_load_si256(at.add(1))] })
    }
    #[inline(always)]
    fn store_words(value: Avx2Words, to: &mut Words) {
        let at: *mut __m256i = to.0.as_mut_ptr().cast();
        // SAFETY: AVX2 is available (see above); the pointer is that of a reference to as many aligned numbers.
        unsafe {
            _mm256_store_si256(at, value.0[0]);
            _mm256_store_si256(at.add(1), value.0[1]);
        }
    }
    #[inline(always)]
    fn and(a: Avx2Words, b: Avx2Words) -> Avx2Words {
        // SAFETY: AVX2 is available (see above).
        Avx2Words(pair(a.0, b.0, |a, b| unsafe { _mm256_and_si256(a, b) }))
    }
    #[inline(always)]
    fn or(a: Avx2Words, b: Avx2Words) -> Avx2Words {
        // SAFETY: AVX2 is available (see above).
        Avx2Words(pair(a.0, b.0, |a, b| unsafe { _mm256_or_si256(a, b) }))
    }
    #[inline(always)]
    fn xor(a: Avx2Words, b: Avx2Words) -> Avx2Words {
        // SAFETY: AVX2 is available (see above).
        Avx2Words(pair(a.0, b.0, |a, b| unsafe { _mm256_xor_si256(a, b) }))
    }
    #[inline(always)]
    fn plus(a: Avx2Words, b: Avx2Words) -> Avx2Words {
        // SAFETY: AVX2 is available (see above).
        Avx2Words(pair(a.0, b.0, |a, b| unsafe { _mm256_add_epi32(a, b) }))
    }
    #[inline(always)]
    fn minus(a: Avx2Words, b: Avx2Words) -> Avx2Words {
        // SAFETY: AVX2 is available (see above).
        Avx2Words(pair(a.0, b.0, |a, b| unsafe { _mm256_sub_epi32(a, b) }))
    }
    #[inline(always)]
    fn left<const N: u32>(a: Avx2Words) -> Avx2Words {
        // SAFETY: AVX2 is available (see above).
        Avx2Words(two(a.0, |a| unsafe {
            _mm256_sll_epi32(a, _mm_cvtsi32_si128(N as i32))
        }))
    }
    #[inline(always)]
    fn right<const N: u32>(a: Avx2Words) -> Avx2Words {
        // SAFETY: AVX2 is available (see above).
        Avx2Words(two(a.0, |a| unsafe {
            _mm256_srl_epi32(a, _mm_cvtsi32_si128(N as i32))
        }))
    }
    #[inline(always)]
    fn equal(a: Avx2Words, b: Avx2Words) -> [__m256; 2] {
        // SAFETY: AVX2 is available (see above).
        pair(a.0, b.0, |a, b| unsafe {
            _mm256_castsi256_ps(_mm256_cmpeq_epi32(a, b))
        })
    }
    #[inline(always)]
    fn words(value: Avx2Floats) -> Avx2Words {
        // SAFETY: AVX2 is available (see above).
        Avx2Words(two(value.0, |a| unsafe { _mm256_castps_si256(a) }))
    }
    #[inline(always)]
    fn floats(value: Avx2Words) -> Avx2Floats {
        // SAFETY: AVX2 is available (see above).
        Avx2Floats(two(value.0, |a| unsafe { _mm256_castsi256_ps(a) }))
    }
    #[inline(always)]
    fn gather(from: &[f32], at: Avx2Words) -> Avx2Floats {
        assert!(!from.is_empty() && i32::try_from(from.len()).is_ok());
        // SAFETY: AVX2 is available (see above); every place is within the slice, and fits into 31 bits.
        Avx2Floats(two(at.0, |at| unsafe {
            let last = _mm256_set1_epi32((from.len() - 1) as i32);
            _mm256_i32gather_ps::<4>(from.as_ptr(), _mm256_min_epu32(at, last))
        }))
    }
    #[inline(always)]
    fn from_signed(value: Avx2Words) -> Avx2Floats {
        // SAFETY: AVX2 is available (see above).
        Avx2Floats(two(value.0, |a| unsafe { _mm256_cvtepi32_ps(a) }))
    }

    #[inline(always)]
    fn philox(first: u32, rest: [u32; 3], key: [u32; 2]) -> [Avx2Words; 4] {
        // SAFETY: AVX2 is available (see above).
        unsafe {
            let splat = |word: u32| _mm256_set1_epi32(word as i32);
            let step = _mm256_set_epi32(7, 6, 5, 4, 3, 2, 1, 0);
            let mut halves = [0, 8].map(|offset| {
                let counter = _mm256_add_epi32(splat(first.wrapping_add(offset)), step);
                [counter, splat(rest[0]), splat(rest[1]), splat(rest[2])]
            });
            let mut keys = key;
            for _ in 0..10 {
                let (k0, k1) = (splat(keys[0]), splat(keys[1]));
                for state in &mut halves {
                    let [c0, c1, c2, c3] = *state;
                    let (high0, low0) = wide(c0, MULTIPLIERS[0]);
                    let (high1, low1) = wide(c2, MULTIPLIERS[1]);
                    *state = [
                        _mm256_xor_si256(_mm256_xor_si256(high1, c1), k0),
                        low1,
                        _mm256_xor_si256(_mm256_xor_si256(high0, c3), k1),
                        low0,
                    ];
                }
                keys = [keys[0].wrapping_add(WEYL[0]), keys[1].wrapping_add(WEYL[1])];
            }
            std::array::from_fn(|word| Avx2Words([halves[0][word], halves[1][word]]))
        }
    }

    #[inline(always)]
    fn compact(words: [Avx2Words; 8], keep: u32, points: &mut [LidarPoint], cursor: usize) -> usize {
        if cursor + WIDTH > points.len() {
            let mut rows = [[0_u32; WIDTH]; 8];
            for (row, word) in rows.iter_mut().zip(words) {
                let at: *mut __m256i = row.as_mut_ptr().cast();
                // SAFETY: AVX2 is available (see above); a row has room for sixteen words.
                unsafe {
                    _mm256_storeu_si256(at, word.0[0]);
                    _mm256_storeu_si256(at.add(1), word.0[1]);
                }
            }
            return compact_rows(&rows, keep, points, cursor);
        }
        // SAFETY: AVX2 is available (see above); rows are written within `points`, whose end has been compared with `cursor`.
        unsafe {
            // Sixteen rows fit behind the cursor, which moves on by at most one after each of them.
            let mut at: *mut __m256i = points.as_mut_ptr().add(cursor).cast();
            let begin = at;
            let mut kept = keep as usize;
            for half in 0..2 {
                for row in transposed(std::array::from_fn(|word| words[word].0[half])) {
                    _mm256_storeu_si256(at, row);
                    at = at.add(kept & 1);
                    kept >>= 1;
                }
            }
            cursor + at.offset_from_unsigned(begin)
        }
    }
}

/// Eight words of eight elements as eight rows of eight words.
#[inline(always)]
unsafe fn transposed(w: [__m256i; 8]) -> [__m256i; 8] {
    // SAFETY: AVX2 is available (see above).
    unsafe {
        let quads = |a, b, c, d| {
            let (ab_low, ab_high) = (_mm256_unpacklo_epi32(a, b), _mm256_unpackhi_epi32(a, b));
            let (cd_low, cd_high) = (_mm256_unpacklo_epi32(c, d), _mm256_unpackhi_epi32(c, d));
            [
                _mm256_unpacklo_epi64(ab_low, cd_low),
                _mm256_unpackhi_epi64(ab_low, cd_low),
                _mm256_unpacklo_epi64(ab_high, cd_high),
                _mm256_unpackhi_epi64(ab_high, cd_high),
            ]
        };
        let (first, second) = (quads(w[0], w[1], w[2], w[3]), quads(w[4], w[5], w[6], w[7]));
        std::array::from_fn(|row| {
            let (a, b) = (first[row % 4], second[row % 4]);
            if row < 4 {
                _mm256_permute2x128_si256::<0x20>(a, b)
            } else {
                _mm256_permute2x128_si256::<0x31>(a, b)
            }
        })
    }
}
