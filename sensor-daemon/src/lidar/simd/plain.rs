//! Arrays: what every processor can do, and what the other makes are held against.

use super::{Floats, LANES, LidarPoint, Simd, Words, compact_rows};
use crate::noise::philox4x32;
use std::array::from_fn;
use std::ops::{Add, Div, Mul, Sub};

/// The plain make.
#[derive(Clone, Copy)]
pub(in super::super) struct Plain;

/// Sixteen floats.
#[derive(Clone, Copy)]
pub(in super::super) struct F(pub [f32; LANES]);

macro_rules! operator {
    ($name:ident, $function:ident, $op:tt) => {
        impl $name for F {
            type Output = Self;
            #[inline(always)]
            fn $function(self, other: Self) -> Self {
                Self(from_fn(|i| self.0[i] $op other.0[i]))
            }
        }
    };
}
operator!(Add, add, +);
operator!(Sub, sub, -);
operator!(Mul, mul, *);
operator!(Div, div, /);

#[inline(always)]
fn gather(test: impl Fn(usize) -> bool) -> u32 {
    (0..LANES).fold(0, |bits, i| bits | u32::from(test(i)) << i)
}

impl Simd for Plain {
    type F = F;
    type U = [u32; LANES];
    type M = u32;

    #[inline(always)]
    fn splat(value: f32) -> F {
        F([value; LANES])
    }
    #[inline(always)]
    fn load(from: &Floats) -> F {
        F(from.0)
    }
    #[inline(always)]
    fn store(value: F, to: &mut Floats) {
        to.0 = value.0;
    }
    #[inline(always)]
    fn sqrt(value: F) -> F {
        F(value.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn max(a: F, b: F) -> F {
        F(from_fn(|i| if a.0[i] > b.0[i] { a.0[i] } else { b.0[i] }))
    }
    #[inline(always)]
    fn min(a: F, b: F) -> F {
        F(from_fn(|i| if a.0[i] < b.0[i] { a.0[i] } else { b.0[i] }))
    }
    #[inline(always)]
    fn lt(a: F, b: F) -> u32 {
        gather(|i| a.0[i] < b.0[i])
    }
    #[inline(always)]
    fn le(a: F, b: F) -> u32 {
        gather(|i| a.0[i] <= b.0[i])
    }
    #[inline(always)]
    fn both(a: u32, b: u32) -> u32 {
        a & b
    }
    #[inline(always)]
    fn differ(a: u32, b: u32) -> u32 {
        a ^ b
    }
    #[inline(always)]
    fn bits(mask: u32) -> u32 {
        mask
    }
    #[inline(always)]
    fn mask(bits: u32) -> u32 {
        bits & 0xFFFF
    }
    #[inline(always)]
    fn select(mask: u32, yes: F, no: F) -> F {
        F(from_fn(|i| if mask >> i & 1 == 1 { yes.0[i] } else { no.0[i] }))
    }
    #[inline(always)]
    fn store_where(mask: u32, value: F, to: &mut Floats) {
        (0..LANES)
            .filter(|i| mask >> i & 1 == 1)
            .for_each(|i| to.0[i] = value.0[i]);
    }
    #[inline(always)]
    fn store_words_where(mask: u32, value: u32, to: &mut Words) {
        (0..LANES).filter(|i| mask >> i & 1 == 1).for_each(|i| to.0[i] = value);
    }
    #[inline(always)]
    fn largest(value: F) -> f32 {
        value
            .0
            .iter()
            .fold(f32::NEG_INFINITY, |a, &b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn splat_words(value: u32) -> [u32; LANES] {
        [value; LANES]
    }
    #[inline(always)]
    fn load_words(from: &Words) -> [u32; LANES] {
        from.0
    }
    #[inline(always)]
    fn store_words(value: [u32; LANES], to: &mut Words) {
        to.0 = value;
    }
    #[inline(always)]
    fn and(a: [u32; LANES], b: [u32; LANES]) -> [u32; LANES] {
        from_fn(|i| a[i] & b[i])
    }
    #[inline(always)]
    fn or(a: [u32; LANES], b: [u32; LANES]) -> [u32; LANES] {
        from_fn(|i| a[i] | b[i])
    }
    #[inline(always)]
    fn xor(a: [u32; LANES], b: [u32; LANES]) -> [u32; LANES] {
        from_fn(|i| a[i] ^ b[i])
    }
    #[inline(always)]
    fn plus(a: [u32; LANES], b: [u32; LANES]) -> [u32; LANES] {
        from_fn(|i| a[i].wrapping_add(b[i]))
    }
    #[inline(always)]
    fn minus(a: [u32; LANES], b: [u32; LANES]) -> [u32; LANES] {
        from_fn(|i| a[i].wrapping_sub(b[i]))
    }
    #[inline(always)]
    fn left<const N: u32>(a: [u32; LANES]) -> [u32; LANES] {
        a.map(|word| word << N)
    }
    #[inline(always)]
    fn right<const N: u32>(a: [u32; LANES]) -> [u32; LANES] {
        a.map(|word| word >> N)
    }
    #[inline(always)]
    fn equal(a: [u32; LANES], b: [u32; LANES]) -> u32 {
        gather(|i| a[i] == b[i])
    }
    #[inline(always)]
    fn words(value: F) -> [u32; LANES] {
        value.0.map(f32::to_bits)
    }
    #[inline(always)]
    fn floats(value: [u32; LANES]) -> F {
        F(value.map(f32::from_bits))
    }
    #[inline(always)]
    fn from_signed(value: [u32; LANES]) -> F {
        F(value.map(|word| word as i32 as f32))
    }
    #[inline(always)]
    fn philox(first: u32, rest: [u32; 3], key: [u32; 2]) -> [[u32; LANES]; 4] {
        let drawn: [[u32; 4]; LANES] =
            from_fn(|i| philox4x32([first.wrapping_add(i as u32), rest[0], rest[1], rest[2]], key));
        from_fn(|word| from_fn(|lane| drawn[lane][word]))
    }
    #[inline(always)]
    fn compact(words: [[u32; LANES]; 8], keep: u32, points: &mut [LidarPoint], cursor: usize) -> usize {
        compact_rows(&words, keep, points, cursor)
    }
}
