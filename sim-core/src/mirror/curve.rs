//! The reference of one tick: a cubic in time for where the front bumper should be.

use bytemuck::{Pod, Zeroable};

/// Position and motion that the front bumper should have.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReferencePoint {
    /// World frame, metres.
    pub position_m: [f64; 2],
    /// World frame, m/s.
    pub velocity_mps: [f64; 2],
    /// Feed-forward acceleration along the path, m/s².
    pub accel_mps2: f64,
    /// Derivative of the velocity, world frame, m/s².
    pub bend_mps2: [f64; 2],
}

/// A cubic curve in the plane: `start + a t + b t² + c t³`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct ReferenceCurve {
    /// Metres.
    pub start_m: [f64; 2],
    /// Coefficients a, b, c: metres per power of a second.
    pub cubic: [[f64; 2]; 3],
    /// Acceleration along the path, m/s².
    pub accel_mps2: f64,
}

impl ReferenceCurve {
    /// A straight line.
    #[must_use]
    pub fn straight(start_m: [f64; 2], velocity_mps: [f64; 2]) -> Self {
        Self {
            start_m,
            cubic: [velocity_mps, [0.0; 2], [0.0; 2]],
            accel_mps2: 0.0,
        }
    }

    /// The Hermite curve over `duration_s` from `start_m` by `moved_m`, with these velocities at its ends.
    #[must_use]
    pub fn hermite(start_m: [f64; 2], moved_m: [f64; 2], velocities_mps: [[f64; 2]; 2], duration_s: f64) -> Self {
        let rate = 1.0 / duration_s;
        let mut curve = Self::straight(start_m, velocities_mps[0]);
        for axis in 0..2 {
            let (u0, u1, mean) = (velocities_mps[0][axis], velocities_mps[1][axis], moved_m[axis] * rate);
            curve.cubic[1][axis] = (3.0 * mean - 2.0 * u0 - u1) * rate;
            curve.cubic[2][axis] = (u0 + u1 - 2.0 * mean) * rate * rate;
        }
        curve
    }

    /// The reference of the front bumper after `t_s`.
    #[must_use]
    #[inline(always)]
    pub fn at(&self, t_s: f64) -> ReferencePoint {
        let [a, b, c] = &self.cubic;
        let position = |i: usize| self.start_m[i] + t_s * (a[i] + t_s * (b[i] + t_s * c[i]));
        let velocity = |i: usize| a[i] + t_s * (2.0 * b[i] + 3.0 * t_s * c[i]);
        ReferencePoint {
            position_m: [position(0), position(1)],
            velocity_mps: [velocity(0), velocity(1)],
            accel_mps2: self.accel_mps2,
            bend_mps2: [0, 1].map(|i: usize| 2.0 * b[i] + 6.0 * t_s * c[i]),
        }
    }

    /// The same curve with its time counted from `t_s` on.
    #[must_use]
    pub fn from_time(&self, t_s: f64) -> Self {
        if t_s == 0.0 {
            return *self;
        }
        let target = self.at(t_s);
        let mut later = Self::straight(target.position_m, target.velocity_mps);
        for axis in 0..2 {
            later.cubic[1][axis] = self.cubic[1][axis] + 3.0 * t_s * self.cubic[2][axis];
            later.cubic[2][axis] = self.cubic[2][axis];
        }
        later.accel_mps2 = self.accel_mps2;
        later
    }

    /// The sum of two curves; the acceleration along the path stays this one's.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        let mut sum = *self;
        for axis in 0..2 {
            sum.start_m[axis] += other.start_m[axis];
            for (mine, theirs) in sum.cubic.iter_mut().zip(&other.cubic) {
                mine[axis] += theirs[axis];
            }
        }
        sum
    }
}

/// The road under the front bumper over one tick: height and slope, each `start + a t + b t²`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct RoadRise {
    /// Height above that at the start, metres per power of a second; the first is zero.
    pub height_m: [f64; 3],
    /// Slope, positive uphill, radians per power of a second.
    pub slope_rad: [f64; 3],
}

impl RoadRise {
    /// The same road with its time and its height counted from `t_s` on.
    #[must_use]
    pub fn from_time(&self, t_s: f64) -> Self {
        let later = |[a, b, c]: [f64; 3]| [a + t_s * (b + t_s * c), b + 2.0 * t_s * c, c];
        let [_, b, c] = later(self.height_m);
        Self {
            height_m: [0.0, b, c],
            slope_rad: later(self.slope_rad),
        }
    }

    /// Height above that at the start, its rate, slope and its rate after `t_s`.
    #[must_use]
    #[inline(always)]
    pub fn at(&self, t_s: f64) -> [f64; 4] {
        let [_, b, c] = self.height_m;
        let [p, q, r] = self.slope_rad;
        [
            t_s * (b + t_s * c),
            b + 2.0 * t_s * c,
            p + t_s * (q + t_s * r),
            q + 2.0 * t_s * r,
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn pair() -> impl Strategy<Value = [f64; 2]> {
        prop::array::uniform2(-20.0_f64..20.0)
    }

    fn close(a: [f64; 2], b: [f64; 2]) -> bool {
        (a[0] - b[0]).abs() < 1e-9 && (a[1] - b[1]).abs() < 1e-9
    }

    proptest! {
        #[test]
        fn hermite_meets_both_ends(start in pair(), moved in pair(), u0 in pair(), u1 in pair(), t in 0.1_f64..1.0) {
            let curve = ReferenceCurve::hermite(start, moved, [u0, u1], t);
            prop_assert!(close(curve.at(0.0).position_m, start) && close(curve.at(0.0).velocity_mps, u0));
            let end = curve.at(t);
            prop_assert!(close(end.position_m, [start[0] + moved[0], start[1] + moved[1]]));
            prop_assert!(close(end.velocity_mps, u1));
        }

        #[test]
        fn counting_from_later_is_the_same_curve(a in pair(), b in pair(), u in pair(), s in 0.0_f64..1.0, t in 0.0_f64..1.0) {
            let curve = ReferenceCurve::hermite(a, b, [u, a], 1.0);
            let (later, direct) = (curve.from_time(s).at(t), curve.at(s + t));
            prop_assert!(close(later.position_m, direct.position_m) && close(later.velocity_mps, direct.velocity_mps));
        }
    }
}
