//! AVX-512 (F, DQ, BW, VL): sixteen numbers in one register.

#![expect(unsafe_code, reason = "vector instructions: see the module above for why")]
// Their use is sound: these functions are inlined into code that is compiled for AVX-512 F, DQ, BW and VL, and that code runs only on a
// processor on which `super::super::ScanPath` has detected them.

use super::{Floats, LidarPoint, MULTIPLIERS, Simd, WEYL, WIDTH, Words, compact_rows};
use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Sub};

/// The AVX-512 implementation.
#[derive(Clone, Copy)]
pub(in crate::sensors) struct Avx512;

/// Sixteen floats.
#[derive(Clone, Copy)]
pub(in crate::sensors) struct Avx512Floats(__m512);
/// Sixteen words.
#[derive(Clone, Copy)]
pub(in crate::sensors) struct Avx512Words(__m512i);

macro_rules! operator {
    ($name:ident, $function:ident, $intrinsic:ident) => {
        impl $name for Avx512Floats {
            type Output = Self;
            #[inline(always)]
            fn $function(self, other: Self) -> Self {
                // SAFETY: AVX-512 is available (see above).
                Self(unsafe { $intrinsic(self.0, other.0) })
            }
        }
    };
}
operator!(Add, add, _mm512_add_ps);
operator!(Sub, sub, _mm512_sub_ps);
operator!(Mul, mul, _mm512_mul_ps);
operator!(Div, div, _mm512_div_ps);

/// Words 0 … 7 of both halves of a Philox word.
#[inline(always)]
fn joined(even: __m512i, odd: __m512i) -> Avx512Words {
    // SAFETY: AVX-512 is available (see above).
    Avx512Words(unsafe {
        _mm512_inserti64x4::<1>(
            _mm512_castsi256_si512(_mm512_cvtepi64_epi32(even)),
            _mm512_cvtepi64_epi32(odd),
        )
    })
}

impl Simd for Avx512 {
    type F = Avx512Floats;
    type U = Avx512Words;
    type M = u16;

    #[inline(always)]
    fn splat(value: f32) -> Avx512Floats {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx512Floats(unsafe { _mm512_set1_ps(value) })
    }
    #[inline(always)]
    fn load(from: &Floats) -> Avx512Floats {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx512Floats(unsafe { _mm512_load_ps(from.0.as_ptr()) })
    }
    #[inline(always)]
    fn store(value: Avx512Floats, to: &mut Floats) {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        unsafe { _mm512_store_ps(to.0.as_mut_ptr(), value.0) }
    }
    #[inline(always)]
    fn sqrt(value: Avx512Floats) -> Avx512Floats {
        // SAFETY: AVX-512 is available (see above).
        Avx512Floats(unsafe { _mm512_sqrt_ps(value.0) })
    }
    #[inline(always)]
    fn max(a: Avx512Floats, b: Avx512Floats) -> Avx512Floats {
        // SAFETY: AVX-512 is available (see above).
        Avx512Floats(unsafe { _mm512_max_ps(a.0, b.0) })
    }
    #[inline(always)]
    fn min(a: Avx512Floats, b: Avx512Floats) -> Avx512Floats {
        // SAFETY: AVX-512 is available (see above).
        Avx512Floats(unsafe { _mm512_min_ps(a.0, b.0) })
    }
    #[inline(always)]
    fn lt(a: Avx512Floats, b: Avx512Floats) -> u16 {
        // SAFETY: AVX-512 is available (see above).
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a.0, b.0) }
    }
    #[inline(always)]
    fn le(a: Avx512Floats, b: Avx512Floats) -> u16 {
        // SAFETY: AVX-512 is available (see above).
        unsafe { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(a.0, b.0) }
    }
    #[inline(always)]
    fn both(a: u16, b: u16) -> u16 {
        a & b
    }
    #[inline(always)]
    fn differ(a: u16, b: u16) -> u16 {
        a ^ b
    }
    #[inline(always)]
    fn bits(mask: u16) -> u32 {
        u32::from(mask)
    }
    #[inline(always)]
    fn mask(bits: u32) -> u16 {
        bits as u16
    }
    #[inline(always)]
    fn select(mask: u16, yes: Avx512Floats, no: Avx512Floats) -> Avx512Floats {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx512Floats(unsafe { _mm512_mask_blend_ps(mask, no.0, yes.0) })
    }
    #[inline(always)]
    fn store_where(mask: u16, value: Avx512Floats, to: &mut Floats) {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        unsafe { _mm512_mask_store_ps(to.0.as_mut_ptr(), mask, value.0) }
    }
    #[inline(always)]
    fn store_words_where(mask: u16, value: u32, to: &mut Words) {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        unsafe { _mm512_mask_store_epi32(to.0.as_mut_ptr().cast(), mask, _mm512_set1_epi32(value as i32)) }
    }
    #[inline(always)]
    fn largest(value: Avx512Floats) -> f32 {
        // SAFETY: AVX-512 is available (see above).
        unsafe {
            let half = _mm256_max_ps(_mm512_castps512_ps256(value.0), _mm512_extractf32x8_ps::<1>(value.0));
            super::avx2::largest_of_8(half)
        }
    }
    #[inline(always)]
    fn splat_words(value: u32) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx512Words(unsafe { _mm512_set1_epi32(value as i32) })
    }
    #[inline(always)]
    fn load_words(from: &Words) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        Avx512Words(unsafe { _mm512_load_si512(from.0.as_ptr().cast()) })
    }
    #[inline(always)]
    fn store_words(value: Avx512Words, to: &mut Words) {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        unsafe { _mm512_store_si512(to.0.as_mut_ptr().cast(), value.0) }
    }
    #[inline(always)]
    fn and(a: Avx512Words, b: Avx512Words) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above).
        Avx512Words(unsafe { _mm512_and_si512(a.0, b.0) })
    }
    #[inline(always)]
    fn or(a: Avx512Words, b: Avx512Words) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above).
        Avx512Words(unsafe { _mm512_or_si512(a.0, b.0) })
    }
    #[inline(always)]
    fn xor(a: Avx512Words, b: Avx512Words) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above).
        Avx512Words(unsafe { _mm512_xor_si512(a.0, b.0) })
    }
    #[inline(always)]
    fn plus(a: Avx512Words, b: Avx512Words) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above).
        Avx512Words(unsafe { _mm512_add_epi32(a.0, b.0) })
    }
    #[inline(always)]
    fn minus(a: Avx512Words, b: Avx512Words) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above).
        Avx512Words(unsafe { _mm512_sub_epi32(a.0, b.0) })
    }
    #[inline(always)]
    fn left<const N: u32>(a: Avx512Words) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above).
        Avx512Words(unsafe { _mm512_slli_epi32::<N>(a.0) })
    }
    #[inline(always)]
    fn right<const N: u32>(a: Avx512Words) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above).
        Avx512Words(unsafe { _mm512_srli_epi32::<N>(a.0) })
    }
    #[inline(always)]
    fn equal(a: Avx512Words, b: Avx512Words) -> u16 {
        // SAFETY: AVX-512 is available (see above).
        unsafe { _mm512_cmpeq_epi32_mask(a.0, b.0) }
    }
    #[inline(always)]
    fn words(value: Avx512Floats) -> Avx512Words {
        // SAFETY: AVX-512 is available (see above).
        Avx512Words(unsafe { _mm512_castps_si512(value.0) })
    }
    #[inline(always)]
    fn floats(value: Avx512Words) -> Avx512Floats {
        // SAFETY: AVX-512 is available (see above).
        Avx512Floats(unsafe { _mm512_castsi512_ps(value.0) })
    }
    #[inline(always)]
    fn gather(from: &[f32], at: Avx512Words) -> Avx512Floats {
        assert!(!from.is_empty() && i32::try_from(from.len()).is_ok());
        // One by one: the instruction that gathers takes longer on AMD's processors, and on Intel's since it must not leak.
        // SAFETY: AVX-512 is available (see above); every place is within the slice.
        Avx512Floats(unsafe {
            let last = _mm512_set1_epi32((from.len() - 1) as i32);
            let mut places = Words::ZERO;
            _mm512_store_si512(places.0.as_mut_ptr().cast(), _mm512_min_epu32(at.0, last));
            let four = |first: usize| {
                let value = |i: usize| *from.get_unchecked(places.0[first + i] as usize);
                _mm_setr_ps(value(0), value(1), value(2), value(3))
            };
            let low = _mm256_set_m128(four(4), four(0));
            let high = _mm256_set_m128(four(12), four(8));
            _mm512_insertf32x8::<1>(_mm512_castps256_ps512(low), high)
        })
    }
    #[inline(always)]
    fn from_signed(value: Avx512Words) -> Avx512Floats {
        // SAFETY: AVX-512 is available (see above).
        Avx512Floats(unsafe { _mm512_cvtepi32_ps(value.0) })
    }

    /// Eight counters in each register, a word in the lower half of 64 bits: products need no shuffling, and what stands in the upper
    /// halves never matters.
    #[inline(always)]
    fn philox(first: u32, rest: [u32; 3], key: [u32; 2]) -> [Avx512Words; 4] {
        // SAFETY: AVX-512 is available (see above); the pointer is that of a reference to as many aligned numbers.
        unsafe {
            let splat = |word: u32| _mm512_set1_epi64(i64::from(word));
            let step = _mm512_set_epi64(7, 6, 5, 4, 3, 2, 1, 0);
            let multipliers = [splat(MULTIPLIERS[0]), splat(MULTIPLIERS[1])];
            // Lower halves add and wrap on their own: a carry into the upper half is not looked at.
            let mut low = [
                _mm512_add_epi64(splat(first), step),
                splat(rest[0]),
                splat(rest[1]),
                splat(rest[2]),
            ];
            let mut high = low;
            high[0] = _mm512_add_epi64(splat(first.wrapping_add(8)), step);
            let mut keys = key;
            for _ in 0..10 {
                let (k0, k1) = (splat(keys[0]), splat(keys[1]));
                for state in [&mut low, &mut high] {
                    let [c0, c1, c2, c3] = *state;
                    let p0 = _mm512_mul_epu32(c0, multipliers[0]);
                    let p1 = _mm512_mul_epu32(c2, multipliers[1]);
                    *state = [
                        _mm512_xor_si512(_mm512_xor_si512(_mm512_srli_epi64::<32>(p1), c1), k0),
                        p1,
                        _mm512_xor_si512(_mm512_xor_si512(_mm512_srli_epi64::<32>(p0), c3), k1),
                        p0,
                    ];
                }
                keys = [keys[0].wrapping_add(WEYL[0]), keys[1].wrapping_add(WEYL[1])];
            }
            [
                joined(low[0], high[0]),
                joined(low[1], high[1]),
                joined(low[2], high[2]),
                joined(low[3], high[3]),
            ]
        }
    }

    #[inline(always)]
    fn compact(words: [Avx512Words; 8], keep: u32, points: &mut [LidarPoint], cursor: usize) -> usize {
        if cursor + WIDTH > points.len() {
            let mut rows = [[0_u32; WIDTH]; 8];
            for (row, word) in rows.iter_mut().zip(words) {
                // SAFETY: AVX-512 is available (see above); a row has room for sixteen words.
                unsafe { _mm512_storeu_si512(row.as_mut_ptr().cast(), word.0) };
            }
            return compact_rows(&rows, keep, points, cursor);
        }
        // SAFETY: AVX-512 is available (see above); rows are written within `points`, whose end has been compared with `cursor`.
        unsafe {
            // Sixteen rows fit behind the cursor, which moves on by at most one after each of them.
            let [first, second] = [
                transposed([words[0], words[1], words[2], words[3]]),
                transposed([words[4], words[5], words[6], words[7]]),
            ];
            let low = _mm512_set_epi64(11, 10, 3, 2, 9, 8, 1, 0);
            let high = _mm512_set_epi64(15, 14, 7, 6, 13, 12, 5, 4);
            // Rows 0 … 3 with 4 … 7, then 8 … 11 with 12 … 15.
            let pair = |order, k: usize| _mm512_permutex2var_epi64(first[k], order, second[k]);
            let mut at: *mut __m256i = points.as_mut_ptr().add(cursor).cast();
            let begin = at;
            let mut kept = keep as usize;
            for order in [low, high] {
                let rows: [__m512i; 4] = [pair(order, 0), pair(order, 1), pair(order, 2), pair(order, 3)];
                for row in rows {
                    _mm256_storeu_si256(at, _mm512_castsi512_si256(row));
                    at = at.add(kept & 1);
                    kept >>= 1;
                }
                for row in rows {
                    _mm256_storeu_si256(at, _mm512_extracti64x4_epi64::<1>(row));
                    at = at.add(kept & 1);
                    kept >>= 1;
                }
            }
            cursor + at.offset_from_unsigned(begin)
        }
    }
}

/// Four words of sixteen elements as rows of four: part `p` of result `k` is element `4 p + k`.
#[inline(always)]
unsafe fn transposed(words: [Avx512Words; 4]) -> [__m512i; 4] {
    // SAFETY: AVX-512 is available (see above).
    unsafe {
        let [Avx512Words(a), Avx512Words(b), Avx512Words(c), Avx512Words(d)] = words;
        let (ab_low, ab_high) = (_mm512_unpacklo_epi32(a, b), _mm512_unpackhi_epi32(a, b));
        let (cd_low, cd_high) = (_mm512_unpacklo_epi32(c, d), _mm512_unpackhi_epi32(c, d));
        [
            _mm512_unpacklo_epi64(ab_low, cd_low),
            _mm512_unpackhi_epi64(ab_low, cd_low),
            _mm512_unpacklo_epi64(ab_high, cd_high),
            _mm512_unpackhi_epi64(ab_high, cd_high),
        ]
    }
}
