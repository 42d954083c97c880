//! Trigonometry for small angles without calls into the C library: same bits on every machine, and it costs a few
//! multiplications where `libm` costs tens of nanoseconds per sub-step.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Sine and cosine of `x`, error below 1e-15 for |x| ≤ 0.1 rad and below 2e-11 for |x| ≤ 0.5 rad (Taylor series).
#[must_use]
#[inline(always)]
pub fn sin_cos_small(x: f64) -> (f64, f64) {
    let q = x * x;
    let sin = x * (1.0 + q * (-1.0 / 6.0 + q * (1.0 / 120.0 + q * (-1.0 / 5_040.0 + q * (1.0 / 362_880.0)))));
    let cos = 1.0 + q * (-0.5 + q * (1.0 / 24.0 + q * (-1.0 / 720.0 + q * (1.0 / 40_320.0 - q * (1.0 / 3_628_800.0)))));
    (sin, cos)
}

/// Tangent of `x`, relative error below 1e-9 for |x| ≤ 1 rad (seventh convergent of Lambert's continued fraction).
#[must_use]
#[inline(always)]
pub fn tan_wheel(x: f64) -> f64 {
    let q = x * x;
    let numerator = x * (135_135.0 + q * (-17_325.0 + q * (378.0 - q)));
    let denominator = 135_135.0 + q * (-62_370.0 + q * (3_150.0 - 28.0 * q));
    numerator / denominator
}

/// Arc tangent of `z`, error below 1.2e-5 rad everywhere (Abramowitz and Stegun 4.4.47): for demands that feedback corrects.
#[must_use]
#[inline(always)]
pub fn atan_demand(z: f64) -> f64 {
    let size = z.abs();
    let steep = size > 1.0;
    let w = pick(steep, 1.0 / size, size);
    let q = w * w;
    let angle = w * (0.999_866_0 + q * (-0.330_299_5 + q * (0.180_141_0 + q * (-0.085_133_0 + q * 0.020_835_1))));
    pick(steep, FRAC_PI_2 - angle, angle).copysign(z)
}

/// `value` held between two bounds. Comparisons instead of `f64::clamp`: one instruction each.
#[must_use]
#[inline(always)]
pub fn bound(value: f64, least: f64, most: f64) -> f64 {
    smaller(larger(value, least), most)
}

/// The larger number (the second if one is not a number).
#[must_use]
#[inline(always)]
pub fn larger(a: f64, b: f64) -> f64 {
    pick(a > b, a, b)
}

/// The smaller number (the second if one is not a number).
#[must_use]
#[inline(always)]
pub fn smaller(a: f64, b: f64) -> f64 {
    pick(a < b, a, b)
}

/// One of two numbers, both computed: a branch would keep the compiler from vectorising [`crate::mirror::batch`].
#[must_use]
#[inline(always)]
pub fn pick(condition: bool, yes: f64, no: f64) -> f64 {
    std::hint::select_unpredictable(condition, yes, no)
}

/// The same angle in (-π, π].
#[must_use]
#[inline]
pub fn wrap_angle(angle_rad: f64) -> f64 {
    if angle_rad > -PI && angle_rad <= PI {
        return angle_rad;
    }
    unwind(angle_rad)
}

/// Takes whole turns from an angle: few angles have one.
#[cold]
fn unwind(angle_rad: f64) -> f64 {
    let wrapped = angle_rad - TAU * libm::ceil((angle_rad - PI) / TAU);
    wrapped.clamp(-PI, PI)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn small_sine_and_cosine(x in -0.5_f64..0.5) {
            let (sin, cos) = sin_cos_small(x);
            let limit = if x.abs() <= 0.1 { 1e-15 } else { 2e-11 };
            prop_assert!((sin - x.sin()).abs() < limit && (cos - x.cos()).abs() < limit);
        }

        #[test]
        fn tangent(x in -1.0_f64..1.0) {
            prop_assert!((tan_wheel(x) - x.tan()).abs() <= 1e-9 * x.tan().abs());
        }

        #[test]
        fn arc_tangent(z in -50.0_f64..50.0) {
            prop_assert!((atan_demand(z) - z.atan()).abs() < 1.2e-5);
        }

        #[test]
        fn wrapped_angles_are_the_same_direction(angle in -1e4_f64..1e4) {
            let wrapped = wrap_angle(angle);
            prop_assert!(wrapped > -PI - 1e-9 && wrapped <= PI);
            prop_assert!((wrapped.sin() - angle.sin()).abs() < 1e-9 && (wrapped.cos() - angle.cos()).abs() < 1e-9);
        }
    }
}
