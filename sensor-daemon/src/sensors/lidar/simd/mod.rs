//! Sixteen numbers at a time, in three implementations: AVX-512, AVX2, and arrays for any processor.
//!
//! Every operation is an IEEE operation rounded once (no fused multiply-add, no approximate reciprocals), so all three give the same
//! bits; the tests of [`super`] compare whole scans. Intrinsics are used instead of plain loops, because these kernels mix comparisons,
//! masks and 64-bit products, which the compiler turns into scalar code.

use std::ops::{Add, Div, Mul, Sub};

use ipc_schema::pointcloud::LidarPoint;

#[cfg(target_arch = "x86_64")]
pub(in crate::sensors) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(in crate::sensors) mod avx512;
pub(in crate::sensors) mod plain;

/// Numbers side by side.
pub(in crate::sensors) const WIDTH: usize = 16;

/// Sixteen numbers in memory, on a cache line of their own.
#[repr(C, align(64))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::sensors) struct Floats(pub(in crate::sensors) [f32; WIDTH]);

/// Sixteen whole numbers in memory.
#[repr(C, align(64))]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::sensors) struct Words(pub(in crate::sensors) [u32; WIDTH]);

impl Floats {
    pub(in crate::sensors) const ZERO: Self = Self([0.0; WIDTH]);
}

impl Words {
    pub(in crate::sensors) const ZERO: Self = Self([0; WIDTH]);
}

/// Multipliers and key steps of Philox4x32 (Salmon et al., SC 2011).
pub(in crate::sensors) const MULTIPLIERS: [u32; 2] = [0xD251_1F53, 0xCD9E_8D57];
pub(in crate::sensors) const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];

/// Operations of the kernels on sixteen numbers.
pub(in crate::sensors) trait Simd: Copy {
    /// Sixteen `f32`.
    type F: Copy + Add<Output = Self::F> + Sub<Output = Self::F> + Mul<Output = Self::F> + Div<Output = Self::F>;
    /// Sixteen `u32`.
    type U: Copy;
    /// Sixteen truth values.
    type M: Copy;

    fn splat(value: f32) -> Self::F;
    fn load(from: &Floats) -> Self::F;
    fn store(value: Self::F, to: &mut Floats);
    fn sqrt(value: Self::F) -> Self::F;
    /// `a > b ? a : b`
    fn max(a: Self::F, b: Self::F) -> Self::F;
    /// `a < b ? a : b`
    fn min(a: Self::F, b: Self::F) -> Self::F;
    fn lt(a: Self::F, b: Self::F) -> Self::M;
    fn le(a: Self::F, b: Self::F) -> Self::M;
    fn both(a: Self::M, b: Self::M) -> Self::M;
    fn differ(a: Self::M, b: Self::M) -> Self::M;
    fn bits(mask: Self::M) -> u32;
    fn mask(bits: u32) -> Self::M;
    /// `mask ? yes : no`
    fn select(mask: Self::M, yes: Self::F, no: Self::F) -> Self::F;
    /// Stores the elements of the mask.
    fn store_where(mask: Self::M, value: Self::F, to: &mut Floats);
    /// Stores `value` in the elements of the mask.
    fn store_words_where(mask: Self::M, value: u32, to: &mut Words);
    /// Largest of all elements.
    fn largest(value: Self::F) -> f32;

    fn splat_words(value: u32) -> Self::U;
    fn load_words(from: &Words) -> Self::U;
    fn store_words(value: Self::U, to: &mut Words);
    fn and(a: Self::U, b: Self::U) -> Self::U;
    fn or(a: Self::U, b: Self::U) -> Self::U;
    fn xor(a: Self::U, b: Self::U) -> Self::U;
    fn plus(a: Self::U, b: Self::U) -> Self::U;
    fn minus(a: Self::U, b: Self::U) -> Self::U;
    fn left<const N: u32>(a: Self::U) -> Self::U;
    fn right<const N: u32>(a: Self::U) -> Self::U;
    fn equal(a: Self::U, b: Self::U) -> Self::M;
    /// The bits of a float.
    fn words(value: Self::F) -> Self::U;
    /// The float of these bits.
    fn floats(value: Self::U) -> Self::F;
    /// The numbers at these places; a place beyond the end is the last one. `from` is not empty.
    fn gather(from: &[f32], at: Self::U) -> Self::F;
    /// Signed whole numbers as floats.
    fn from_signed(value: Self::U) -> Self::F;
    /// Philox4x32-10 of counters `[first + element, rest…]`.
    fn philox(first: u32, rest: [u32; 3], key: [u32; 2]) -> [Self::U; 4];
    /// Writes the points of the elements in `keep`, in order, from `cursor` on and returns the new cursor.
    fn compact(words: [Self::U; 8], keep: u32, points: &mut [LidarPoint], cursor: usize) -> usize;
}

/// Writes the rows of the elements in `keep` from memory: for any processor, and at the end of the buffer.
pub(in crate::sensors) fn compact_rows(
    words: &[[u32; WIDTH]; 8],
    keep: u32,
    points: &mut [LidarPoint],
    mut cursor: usize,
) -> usize {
    for element in (0..WIDTH).filter(|element| keep >> element & 1 == 1) {
        let Some(point) = points.get_mut(cursor) else {
            return cursor;
        };
        let row: [u32; 8] = std::array::from_fn(|word| words[word][element]);
        *point = bytemuck::must_cast(row);
        cursor += 1;
    }
    cursor
}
