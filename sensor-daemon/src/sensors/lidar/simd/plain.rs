//! Arrays: the implementation for any processor, and the reference for the others.

use super::{Floats, LidarPoint, Simd, WIDTH, Words, compact_rows};
use crate::noise::philox4x32;
use std::array::from_fn;
use std::ops::{Add, Div, Mul, Sub};

/// The array implementation.
#[derive(Clone, Copy)]
pub(in crate::sensors) struct Plain;

/// Sixteen floats.
#[derive(Clone, Copy)]
pub(in crate::sensors) struct PlainFloats(pub [f32; WIDTH]);

macro_rules! operator {
    ($name:ident, $function:ident, $op:tt) => {
        impl $name for PlainFloats {
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
fn bits_of(test: impl Fn(usize) -> bool) -> u32 {
    (0..WIDTH).fold(0, |bits, i| bits | u32::from(test(i)) << i)
}

impl Simd for Plain {
    type F = PlainFloats;
    type U = [u32; WIDTH];
    type M = u32;

    #[inline(always)]
    fn splat(value: f32) -> PlainFloats {
        PlainFloats([value; WIDTH])
    }
    #[inline(always)]
    fn load(from: &Floats) -> PlainFloats {
        PlainFloats(from.0)
    }
    #[inline(always)]
    fn store(value: PlainFloats, to: &mut Floats) {
        to.0 = value.0;
    }
    #[inline(always)]
    fn sqrt(value: PlainFloats) -> PlainFloats {
        PlainFloats(value.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn max(a: PlainFloats, b: PlainFloats) -> PlainFloats {
        PlainFloats(from_fn(|i| if a.0[i] > b.0[i] { a.0[i] } else { b.0[i] }))
    }
    #[inline(always)]
    fn min(a: PlainFloats, b: PlainFloats) -> PlainFloats {
        PlainFloats(from_fn(|i| if a.0[i] < b.0[i] { a.0[i] } else { b.0[i] }))
    }
    #[inline(always)]
    fn lt(a: PlainFloats, b: PlainFloats) -> u32 {
        bits_of(|i| a.0[i] < b.0[i])
    }
    #[inline(always)]
    fn le(a: PlainFloats, b: PlainFloats) -> u32 {
        bits_of(|i| a.0[i] <= b.0[i])
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
    fn select(mask: u32, yes: PlainFloats, no: PlainFloats) -> PlainFloats {
        PlainFloats(from_fn(|i| if mask >> i & 1 == 1 { yes.0[i] } else { no.0[i] }))
    }
    #[inline(always)]
    fn store_where(mask: u32, value: PlainFloats, to: &mut Floats) {
        (0..WIDTH)
            .filter(|i| mask >> i & 1 == 1)
            .for_each(|i| to.0[i] = value.0[i]);
    }
    #[inline(always)]
    fn store_words_where(mask: u32, value: u32, to: &mut Words) {
        (0..WIDTH).filter(|i| mask >> i & 1 == 1).for_each(|i| to.0[i] = value);
    }
    #[inline(always)]
    fn largest(value: PlainFloats) -> f32 {
        value
            .0
            .iter()
            .fold(f32::NEG_INFINITY, |a, &b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn splat_words(value: u32) -> [u32; WIDTH] {
        [value; WIDTH]
    }
    #[inline(always)]
    fn load_words(from: &Words) -> [u32; WIDTH] {
        from.0
    }
    #[inline(always)]
    fn store_words(value: [u32; WIDTH], to: &mut Words) {
        to.0 = value;
    }
    #[inline(always)]
    fn and(a: [u32; WIDTH], b: [u32; WIDTH]) -> [u32; WIDTH] {
        from_fn(|i| a[i] & b[i])
    }
    #[inline(always)]
    fn or(a: [u32; WIDTH], b: [u32; WIDTH]) -> [u32; WIDTH] {
        from_fn(|i| a[i] | b[i])
    }
    #[inline(always)]
    fn xor(a: [u32; WIDTH], b: [u32; WIDTH]) -> [u32; WIDTH] {
        from_fn(|i| a[i] ^ b[i])
    }
    #[inline(always)]
    fn plus(a: [u32; WIDTH], b: [u32; WIDTH]) -> [u32; WIDTH] {
        from_fn(|i| a[i].wrapping_add(b[i]))
    }
    #[inline(always)]
    fn minus(a: [u32; WIDTH], b: [u32; WIDTH]) -> [u32; WIDTH] {
        from_fn(|i| a[i].wrapping_sub(b[i]))
    }
    #[inline(always)]
    fn left<const N: u32>(a: [u32; WIDTH]) -> [u32; WIDTH] {
        a.map(|word| word << N)
    }
    #[inline(always)]
    fn right<const N: u32>(a: [u32; WIDTH]) -> [u32; WIDTH] {
        a.map(|word| word >> N)
    }
    #[inline(always)]
    fn equal(a: [u32; WIDTH], b: [u32; WIDTH]) -> u32 {
        bits_of(|i| a[i] == b[i])
    }
    #[inline(always)]
    fn words(value: PlainFloats) -> [u32; WIDTH] {
        value.0.map(f32::to_bits)
    }
    #[inline(always)]
    fn floats(value: [u32; WIDTH]) -> PlainFloats {
        PlainFloats(value.map(f32::from_bits))
    }
    #[inline(always)]
    fn gather(from: &[f32], at: [u32; WIDTH]) -> PlainFloats {
        let last = from.len() - 1;
        PlainFloats(at.map(|place| from[(place as usize).min(last)]))
    }
    #[inline(always)]
    fn from_signed(value: [u32; WIDTH]) -> PlainFloats {
        PlainFloats(value.map(|word| word as i32 as f32))
    }
    #[inline(always)]
    fn philox(first: u32, rest: [u32; 3], key: [u32; 2]) -> [[u32; WIDTH]; 4] {
        let drawn: [[u32; 4]; WIDTH] =
            from_fn(|i| philox4x32([first.wrapping_add(i as u32), rest[0], rest[1], rest[2]], key));
        from_fn(|word| from_fn(|element| drawn[element][word]))
    }
    #[inline(always)]
    fn compact(words: [[u32; WIDTH]; 8], keep: u32, points: &mut [LidarPoint], cursor: usize) -> usize {
        compact_rows(&words, keep, points, cursor)
    }
}
