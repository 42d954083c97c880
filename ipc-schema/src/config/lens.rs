//! Lens distortion: the model of D. C. Brown, "Close-range camera calibration", *Photogrammetric Engineering* 37, 1971, with the coefficients
//! and axes of OpenCV.

/// Most steps of the inversion.
const MOST_STEPS: usize = 50;

/// Where a lens puts the rays of a pinhole. Points of the image are slopes: pixels from the optical axis over the focal length, x to the
/// right and y down.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LensDistortion {
    /// Radial coefficients of r², r⁴ and r⁶.
    pub radial: [f64; 3],
    /// Tangential coefficients.
    pub tangential: [f64; 2],
}

impl LensDistortion {
    /// From coefficients in the order of OpenCV: k1, k2, p1, p2, k3.
    #[must_use]
    pub const fn new([k1, k2, p1, p2, k3]: [f64; 5]) -> Self {
        Self {
            radial: [k1, k2, k3],
            tangential: [p1, p2],
        }
    }

    /// Where the lens puts a ray of a pinhole.
    #[must_use]
    pub fn distorted(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let ([k1, k2, k3], [p1, p2]) = (self.radial, self.tangential);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// Derivatives of [`Self::distorted`]: by x, then by y.
    fn slopes(&self, [x, y]: [f64; 2]) -> [[f64; 2]; 2] {
        let ([k1, k2, k3], [p1, p2]) = (self.radial, self.tangential);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let growth = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3));
        let mixed = x * y * growth + 2.0 * p1 * x + 2.0 * p2 * y;
        [
            [radial + x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x, mixed],
            [mixed, radial + y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x],
        ]
    }

    /// The ray of a pinhole that the lens puts here; `None` where there is none: the model folds, and no ray from within the fold arrives.
    #[must_use]
    pub fn undistorted(&self, wanted: [f64; 2]) -> Option<[f64; 2]> {
        // From the axis outwards in steps, each solved by Newton's method: the way along which the image does not fold.
        let mut found = [0.0; 2];
        for step in 1..=8_u32 {
            let target = wanted.map(|part| part * f64::from(step) / 8.0);
            for _ in 0..MOST_STEPS {
                let [x, y] = self.distorted(found);
                let off = [target[0] - x, target[1] - y];
                let [[xx, yx], [xy, yy]] = self.slopes(found);
                let determinant = xx * yy - xy * yx;
                if determinant <= 0.0 || xx <= 0.0 {
                    return None;
                }
                found[0] += (yy * off[0] - xy * off[1]) / determinant;
                found[1] += (xx * off[1] - yx * off[0]) / determinant;
                if off[0].abs() + off[1].abs() < 1e-13 {
                    break;
                }
            }
        }
        let [x, y] = self.distorted(found);
        ((x - wanted[0]).abs() + (y - wanted[1]).abs() < 1e-9).then_some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wide lens: KITTI's camera 0 of its first recording day (calib_cam_to_cam.txt).
    const KITTI: [f64; 5] = [-0.372_88, 0.203_73, 0.002_219, 0.001_383, -0.072_33];

    #[test]
    fn no_coefficients_no_distortion() {
        let lens = LensDistortion::new([0.0; 5]);
        assert_eq!(lens.distorted([0.3, -1.2]), [0.3, -1.2]);
        assert_eq!(lens.undistorted([0.3, -1.2]), Some([0.3, -1.2]));
    }

    #[test]
    fn each_coefficient_does_what_opencv_says() {
        let at = |place: usize, point: [f64; 2]| {
            let mut coefficients = [0.0; 5];
            coefficients[place] = 0.1;
            LensDistortion::new(coefficients).distorted(point)
        };
        let (x, y) = (0.5_f64, 0.25_f64);
        let r2 = x * x + y * y;
        let expected = [
            [x * (1.0 + 0.1 * r2), y * (1.0 + 0.1 * r2)],
            [x * (1.0 + 0.1 * r2 * r2), y * (1.0 + 0.1 * r2 * r2)],
            [x + 0.2 * x * y, y + 0.1 * (r2 + 2.0 * y * y)],
            [x + 0.1 * (r2 + 2.0 * x * x), y + 0.2 * x * y],
            [x * (1.0 + 0.1 * r2.powi(3)), y * (1.0 + 0.1 * r2.powi(3))],
        ];
        for (place, expected) in expected.into_iter().enumerate() {
            let found = at(place, [x, y]);
            assert!(
                (0..2).all(|axis| (found[axis] - expected[axis]).abs() < 1e-15),
                "{place}"
            );
        }
    }

    #[test]
    fn the_inverse_finds_the_ray() {
        for coefficients in [KITTI, [0.2, -0.05, -0.01, 0.02, 0.0], [-0.3, 0.0, 0.0, 0.0, 0.0]] {
            let lens = LensDistortion::new(coefficients);
            for step in 0..400 {
                let ray = [f64::from(step % 20) * 0.05 - 0.475, f64::from(step / 20) * 0.04 - 0.38];
                let found = lens.undistorted(lens.distorted(ray)).unwrap();
                assert!(
                    (0..2).all(|axis| (found[axis] - ray[axis]).abs() < 1e-9),
                    "{coefficients:?} {ray:?}"
                );
            }
        }
    }

    #[test]
    fn no_ray_arrives_beyond_the_fold() {
        // r (1 − 0.3 r²) is largest at r² = 1/0.9: 0.7027.
        let lens = LensDistortion::new([-0.3, 0.0, 0.0, 0.0, 0.0]);
        assert!(lens.undistorted([0.70, 0.0]).is_some());
        assert_eq!(lens.undistorted([0.71, 0.0]), None);
        assert_eq!(lens.undistorted([-0.6, 0.6]), None);
    }
}
