//! The vector kernels of LIDAR against the plain ones, bit by bit.

#[cfg(not(miri))]
use super::simd::avx512::Avx512;
use super::simd::{Floats, Simd, WIDTH, Words, avx2::Avx2, plain::Plain};
use crate::pointcloud::LidarPoint;

/// Numbers that comparisons and roundings may trip over.
const ODD: [f32; WIDTH] = [
    0.0,
    -0.0,
    1.0,
    -1.5,
    f32::MIN_POSITIVE,
    1e-42,
    f32::MAX,
    -f32::MAX,
    f32::INFINITY,
    f32::NEG_INFINITY,
    3.999_999_8,
    0.1,
    -2.0,
    1e20,
    7.0,
    16_777_216.0,
];

/// Results of every operation of a kernel, as bits.
fn all_operations<S: Simd>() -> Vec<u32> {
    let mut bits = Vec::new();
    let mut floats = |value: S::F| {
        let mut out = Floats::ZERO;
        S::store(value, &mut out);
        bits.extend(out.0.map(f32::to_bits));
    };
    let mut turned = ODD;
    turned.rotate_left(5);
    let (a, b) = (S::load(&Floats(ODD)), S::load(&Floats(turned)));
    [a + b, a - b, a * b, a / b, S::max(a, b), S::min(a, b)].map(&mut floats);
    floats(S::splat(2.5));
    floats(S::sqrt(S::load(&Floats(ODD.map(f32::abs)))));
    floats(S::select(S::lt(a, b), a, b));
    let mut part = Floats(turned);
    S::store_where(S::mask(0b1010_0110_1111_0001), a, &mut part);
    floats(S::load(&part));
    let masks = [
        S::lt(a, b),
        S::le(a, b),
        S::both(S::lt(a, b), S::le(b, a)),
        S::differ(S::lt(a, b), S::mask(0xFF0F)),
    ];
    bits.extend(masks.map(S::bits));
    bits.push(S::largest(S::load(&Floats(ODD))).to_bits());

    let words = Words(std::array::from_fn(|i| 0x9E37_79B9_u32.wrapping_mul(i as u32 + 1)));
    let (c, d) = (S::load_words(&words), S::splat_words(0x8000_00FF));
    let results = [
        S::and(c, d),
        S::or(c, d),
        S::xor(c, d),
        S::plus(c, d),
        S::minus(c, d),
        S::left::<7>(c),
        S::right::<9>(c),
        S::words(a),
        S::words(S::floats(c)),
        S::words(S::from_signed(c)),
    ];
    for value in results.into_iter().chain(S::philox(u32::MAX - 3, [1, 2, 3], [4, 5])) {
        let mut out = Words::ZERO;
        S::store_words(value, &mut out);
        bits.extend(out.0);
    }
    bits.push(S::bits(S::equal(c, S::load_words(&words))));
    let mut some = Words::ZERO;
    S::store_words_where(S::mask(0x8421), 9, &mut some);
    bits.extend(some.0);
    // The last places are beyond the end.
    let places = Words(std::array::from_fn(|i| if i < 13 { 5 * i as u32 % 16 } else { u32::MAX >> (15 - i) }));
    let mut out = Floats::ZERO;
    S::store(S::gather(&ODD, S::load_words(&places)), &mut out);
    bits.extend(out.0.map(f32::to_bits));
    bits
}

/// Points that are kept of sixteen, in buffers that end anywhere behind the cursor.
fn compacted<S: Simd>() -> Vec<(usize, Vec<LidarPoint>)> {
    let row = |word: u32| S::load_words(&Words(std::array::from_fn(|element| word << 16 | element as u32)));
    let mut results = Vec::new();
    for room in [0, 1, 15, 16, 17, 20] {
        for (keep, cursor) in [(0xFFFF, 0), (0, 0), (0x8001, 0), (0b1011_0101, 3), (0xFFFF, 4)] {
            let mut points = vec![LidarPoint::default(); room];
            let words = std::array::from_fn(|word| row(word as u32));
            let end = S::compact(words, keep, &mut points, cursor.min(room));
            points.truncate(end);
            results.push((end, points));
        }
    }
    results
}

#[test]
fn avx2_kernels_do_what_the_plain_ones_do() {
    assert!(is_x86_feature_detected!("avx2"), "compile with -Ctarget-feature=+avx2");
    assert_eq!(all_operations::<Avx2>(), all_operations::<Plain>());
    assert_eq!(compacted::<Avx2>(), compacted::<Plain>());
}

/// Miri knows few instructions of AVX-512: this one runs on a processor that has them.
#[cfg(not(miri))]
#[test]
fn avx512_kernels_do_what_the_plain_ones_do() {
    if is_x86_feature_detected!("avx512f") {
        assert_eq!(all_operations::<Avx512>(), all_operations::<Plain>());
        assert_eq!(compacted::<Avx512>(), compacted::<Plain>());
    }
}
