//! What the geometry of the satellites makes of errors in the ranges: least squares for three coordinates and the receiver's clock.
//!
//! With `H` the rows `[−s, 1]` of the satellites (`s` unit vector towards each), `W` their weights and `δ` the errors of the ranges, the
//! error of the position and its covariance are `x = (HᵀWH)⁻¹ HᵀW δ` and `(HᵀWH)⁻¹ σ²` (Kaplan and Hegarty, *Understanding GPS*,
//! 2nd edition, section 7.3.1; P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*, 2nd edition,
//! sections 9.4.1 and 9.4.3). HDOP is the square root of the first two of its diagonal, east and north.

/// Sums over satellites: the upper triangle of `HᵀWH` and `HᵀW δ`, coordinates east, north, up, clock.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct NormalEquations {
    ee: f64,
    en: f64,
    eu: f64,
    ec: f64,
    nn: f64,
    nu: f64,
    nc: f64,
    uu: f64,
    uc: f64,
    cc: f64,
    right: [f64; 4],
}

/// What follows from them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionSolution {
    /// Variances east and north for range errors of variance 1.
    pub variance: [f64; 2],
    /// Error of the position by the range errors: east, north, up, metres.
    pub offset_m: [f64; 3],
}

impl PositionSolution {
    /// Horizontal dilution of precision.
    #[must_use]
    pub fn hdop(&self) -> f64 {
        (self.variance[0] + self.variance[1]).sqrt()
    }
}

impl NormalEquations {
    /// Adds a satellite: unit vector towards it (east, north, up), weight (1 = direct), error of its range, metres.
    pub fn add(&mut self, [e, n, u]: [f64; 3], weight: f64, error_m: f64) {
        let [we, wn, wu] = [weight * e, weight * n, weight * u];
        self.ee += we * e;
        self.en += we * n;
        self.eu += we * u;
        self.ec -= we;
        self.nn += wn * n;
        self.nu += wn * u;
        self.nc -= wn;
        self.uu += wu * u;
        self.uc -= wu;
        self.cc += weight;
        let right = [-we, -wn, -wu, weight];
        (0..4).for_each(|i| self.right[i] += right[i] * error_m);
    }

    /// Solves them, two coordinates eliminated at a time; `None` if the satellites leave a direction open.
    #[must_use]
    pub fn solve(&self) -> Option<PositionSolution> {
        // Up and clock, R = [[uu, uc], [uc, cc]], go first: R⁻¹ Qᵀ, with Q = [[eu, ec], [nu, nc]].
        let r_det = self.uu * self.cc - self.uc * self.uc;
        let scale = 1.0 / r_det;
        let r_solved = |u: f64, c: f64| [(self.cc * u - self.uc * c) * scale, (self.uu * c - self.uc * u) * scale];
        let (by_e, by_n) = (r_solved(self.eu, self.ec), r_solved(self.nu, self.nc));
        // What is left for east and north: S = P − Q R⁻¹ Qᵀ.
        let ee = self.ee - self.eu * by_e[0] - self.ec * by_e[1];
        let en = self.en - self.eu * by_n[0] - self.ec * by_n[1];
        let nn = self.nn - self.nu * by_n[0] - self.nc * by_n[1];
        let s_det = ee * nn - en * en;
        // Relative to the number of satellites; not-a-number fails too.
        let least = 1e-9 * self.cc * self.cc;
        if !(r_det > least && s_det > least) {
            return None;
        }
        let [b_e, b_n, b_u, b_c] = self.right;
        let left_e = b_e - by_e[0] * b_u - by_e[1] * b_c;
        let left_n = b_n - by_n[0] * b_u - by_n[1] * b_c;
        let (east, north) = ((nn * left_e - en * left_n) / s_det, (ee * left_n - en * left_e) / s_det);
        let up = r_solved(b_u, b_c)[0] - by_e[0] * east - by_n[0] * north;
        Some(PositionSolution {
            variance: [nn / s_det, ee / s_det],
            offset_m: [east, north, up],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sky(satellites: &[[f64; 3]], weight: impl Fn(usize) -> f64, error_m: impl Fn(usize) -> f64) -> NormalEquations {
        let mut equations = NormalEquations::default();
        for (i, satellite) in satellites.iter().enumerate() {
            equations.add(*satellite, weight(i), error_m(i));
        }
        equations
    }

    const ROOT: f64 = 0.866_025_403_784_438_6;
    /// One at the zenith, three on the horizon, 120° apart.
    const FOUR: [[f64; 3]; 4] = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-0.5, ROOT, 0.0], [-0.5, -ROOT, 0.0]];

    /// `HᵀH` is diag(3/2, 3/2) for east and north, apart from up and clock: HDOP = √(2/3 + 2/3) = 1.1547. One metre too much for the
    /// zenith: heights are measured against the mean of the three, so up is 1 m too low and nothing moves sideways.
    #[test]
    fn four_satellites_by_hand() {
        let solution = sky(&FOUR, |_| 1.0, |i| if i == 0 { 1.0 } else { 0.0 }).solve().unwrap();
        assert!((solution.hdop() - 1.154_700_538).abs() < 1e-9, "{solution:?}");
        let [e, n, u] = solution.offset_m;
        assert!(
            e.abs() < 1e-12 && n.abs() < 1e-12 && (u + 1.0).abs() < 1e-12,
            "{solution:?}"
        );
        // Three metres too much for the one in the east: its share of the mean clock is 1 m, east is (−2 − ½ − ½) · 2/3 = −2 m.
        let solution = sky(&FOUR, |_| 1.0, |i| if i == 1 { 3.0 } else { 0.0 }).solve().unwrap();
        assert!((solution.offset_m[0] + 2.0).abs() < 1e-12, "{solution:?}");
    }

    #[test]
    fn satellites_that_leave_a_direction_open_give_no_position() {
        assert_eq!(sky(&FOUR[..3], |_| 1.0, |_| 0.0).solve(), None);
        let cone = [0.0, 1.0, 2.0, 3.0, 4.0].map(|angle: f64| [0.6 * angle.cos(), 0.6 * angle.sin(), 0.8]);
        assert_eq!(
            sky(&cone, |_| 1.0, |_| 0.0).solve(),
            None,
            "all at one elevation: up is the clock"
        );
        assert_eq!(NormalEquations::default().solve(), None);
    }

    fn direction() -> impl Strategy<Value = [f64; 3]> {
        (0.0..std::f64::consts::TAU, 0.1_f64..1.0).prop_map(|(azimuth, up)| {
            let level = (1.0 - up * up).sqrt();
            [level * azimuth.cos(), level * azimuth.sin(), up]
        })
    }

    proptest! {
        /// Ranges that are all wrong as a displacement makes them wrong give that displacement; the clock takes what is common.
        #[test]
        fn a_displacement_is_found(
            satellites in prop::collection::vec(direction(), 6..12), moved in prop::array::uniform3(-50.0_f64..50.0),
            common in -100.0_f64..100.0,
        ) {
            let error = |i: usize| common - (0..3).map(|k| satellites[i][k] * moved[k]).sum::<f64>();
            let solution = sky(&satellites, |i| if i % 2 == 0 { 1.0 } else { 0.25 }, error).solve();
            prop_assume!(solution.is_some_and(|solution| solution.hdop() < 20.0));
            let offset_m = solution.unwrap().offset_m;
            prop_assert!((0..3).all(|k| (offset_m[k] - moved[k]).abs() < 1e-5), "{offset_m:?} is not {moved:?}");
        }

        /// Taking satellites away or trusting them less never helps.
        #[test]
        fn fewer_satellites_are_never_better(satellites in prop::collection::vec(direction(), 5..12), weight in 0.0_f64..1.0) {
            let all = sky(&satellites, |_| 1.0, |_| 0.0).solve();
            let less = sky(&satellites, |i| if i < 2 { weight } else { 1.0 }, |_| 0.0).solve();
            prop_assume!(all.is_some() && less.is_some());
            prop_assert!(less.unwrap().hdop() >= all.unwrap().hdop() * (1.0 - 1e-9));
        }
    }
}
