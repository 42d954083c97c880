//! The paper's own conversions (section III.C, equations 1 to 4): a sphere, no altitude. They serve
//! comparisons with published results; everything else uses [`sim_core::geodesy`], which is exact.
//!
//! The paper's text names the origin `λ = lat_o, φ = long_o`; these functions follow the formulas with that reading.
//! Equation 1 gives no z, so equation 2's z is the sphere's `R sin(lat)`. A sphere in place of the ellipsoid causes errors of up to 0.7 %: 25 km north-east of an
//! origin at 52° north east comes out 53 m and north 10 m off (`tests/data/geodesy.csv`).
//!
//! Equation 4 turns and does not mirror. The axes of the paper's figure 3 (x left, y backward) and those of a window (x right, y down)
//! have opposite orientations seen from above, so points in those axes change the sign of x first.

use sim_core::geodesy::Geodetic;

/// Radius of the sphere: the equatorial radius of WGS 84, metres.
pub const EARTH_RADIUS_M: f64 = 6_378_137.0;

/// Earth-centred, earth-fixed position on the sphere, metres (equation 1, with the z that equation 2 needs).
#[must_use]
pub fn ecef_from_geodetic(position: Geodetic) -> [f64; 3] {
    let (sin_lat, cos_lat) = libm::sincos(position.latitude_deg.to_radians());
    let (sin_lon, cos_lon) = libm::sincos(position.longitude_deg.to_radians());
    [
        EARTH_RADIUS_M * cos_lat * cos_lon,
        EARTH_RADIUS_M * cos_lat * sin_lon,
        EARTH_RADIUS_M * sin_lat,
    ]
}

/// East and north of `position` in the plane that touches the sphere at `origin`, metres (equations 1 and 2).
#[must_use]
pub fn east_north_from_geodetic(origin: Geodetic, position: Geodetic) -> [f64; 2] {
    let [x, y, z] = ecef_from_geodetic(position);
    let [x_o, y_o, z_o] = ecef_from_geodetic(origin);
    let (sin_lambda, cos_lambda) = libm::sincos(origin.latitude_deg.to_radians());
    let (sin_phi, cos_phi) = libm::sincos(origin.longitude_deg.to_radians());
    let east = -sin_phi * (x - x_o) + cos_phi * (y - y_o);
    let north = -cos_phi * sin_lambda * (x - x_o) - sin_lambda * sin_phi * (y - y_o) + cos_lambda * (z - z_o);
    [east, north]
}

/// Pixel of a position in the top view (equation 3): `scale · pixels per metre · (position − offset)`.
#[must_use]
pub fn top_view_from_east_north(scale: f64, pixels_per_m: f64, offset_m: [f64; 2], position_m: [f64; 2]) -> [f64; 2] {
    [
        scale * pixels_per_m * (position_m[0] - offset_m[0]),
        scale * pixels_per_m * (position_m[1] - offset_m[1]),
    ]
}

/// Point in the top-view plane of a point in the LIDAR's plane rotated by `angle_rad` against it (equation 4).
#[must_use]
pub fn top_view_from_lidar(angle_rad: f64, point: [f64; 2]) -> [f64; 2] {
    let (sin, cos) = libm::sincos(angle_rad);
    [cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_6;

    fn close(actual: &[f64], expected: &[f64], tolerance: f64) {
        for (a, e) in actual.iter().zip(expected) {
            assert!((a - e).abs() < tolerance, "{actual:?} is not {expected:?}");
        }
    }

    /// cos 60° = 1/2, cos 30° = √3/2: x = R/2 · √3/2, y = R/2 · 1/2, z = R √3/2.
    #[test]
    fn equation_1_by_hand() {
        let ecef = ecef_from_geodetic(Geodetic {
            latitude_deg: 60.0,
            longitude_deg: 30.0,
        });
        close(&ecef, &[2_761_814.335_4, 1_594_534.25, 5_523_628.670_8], 1e-3);
    }

    /// At the origin (0, 0): east = R cos(lat) sin(lon), north = R sin(lat). For 0.001°: R · 1.745 329 25e-5 = 111.319 49 m.
    #[test]
    fn equation_2_by_hand() {
        let origin = Geodetic {
            latitude_deg: 0.0,
            longitude_deg: 0.0,
        };
        let near = Geodetic {
            latitude_deg: 0.001,
            longitude_deg: 0.001,
        };
        close(
            &east_north_from_geodetic(origin, near),
            &[111.319_491, 111.319_491],
            1e-5,
        );
        // At 60° north a degree of longitude is half as long: 55.659 75 m.
        let origin = Geodetic {
            latitude_deg: 60.0,
            longitude_deg: 30.0,
        };
        let east = Geodetic {
            latitude_deg: 60.0,
            longitude_deg: 30.001,
        };
        close(&east_north_from_geodetic(origin, east), &[55.659_745, 0.000_421], 1e-5);
    }

    /// At the origin (0°, 90°): φ = 90° and λ = 0°, so east = −(x − x_o) and north = z. A degree north and a degree further east:
    /// east = R cos 1° sin 1° = 111 296.89 m, north = R sin 1° = 111 313.84 m.
    #[test]
    fn equation_2_takes_lambda_for_the_latitude_and_phi_for_the_longitude() {
        let place = |latitude_deg, longitude_deg| Geodetic {
            latitude_deg,
            longitude_deg,
        };
        close(
            &east_north_from_geodetic(place(0.0, 90.0), place(1.0, 91.0)),
            &[111_296.886, 111_313.839],
            1e-3,
        );
        close(&ecef_from_geodetic(place(0.0, 90.0)), &[0.0, EARTH_RADIUS_M, 0.0], 1e-6);
        close(&ecef_from_geodetic(place(90.0, 0.0)), &[0.0, 0.0, EARTH_RADIUS_M], 1e-6);
    }

    #[test]
    fn equation_3_is_zero_at_the_offset_and_linear() {
        let pixel = |position| top_view_from_east_north(2.0, 3.0, [7.0, -4.0], position);
        close(&pixel([7.0, -4.0]), &[0.0, 0.0], 1e-12);
        close(&pixel([8.0, -2.0]), &[6.0, 12.0], 1e-12);
    }

    /// Lengths stay, angles add up, and a quarter turn takes x to y.
    #[test]
    fn equation_4_is_a_rotation() {
        let point = [3.0, -1.5];
        for i in -6..=6 {
            let angle = 0.7 * f64::from(i);
            let turned = top_view_from_lidar(angle, point);
            assert!((libm::hypot(turned[0], turned[1]) - libm::hypot(point[0], point[1])).abs() < 1e-12);
            close(
                &top_view_from_lidar(0.4, turned),
                &top_view_from_lidar(angle + 0.4, point),
                1e-12,
            );
            close(&top_view_from_lidar(-angle, turned), &point, 1e-12);
        }
        close(
            &top_view_from_lidar(std::f64::consts::FRAC_PI_2, [1.0, 0.0]),
            &[0.0, 1.0],
            1e-12,
        );
    }

    #[test]
    fn equations_3_and_4_by_hand() {
        close(
            &top_view_from_east_north(0.5, 12.0, [10.0, -5.0], [20.0, 5.0]),
            &[60.0, 60.0],
            1e-12,
        );
        close(
            &top_view_from_lidar(FRAC_PI_6, [2.0, 0.0]),
            &[1.732_050_807_57, 1.0],
            1e-10,
        );
        close(
            &top_view_from_lidar(FRAC_PI_6, [0.0, 2.0]),
            &[-1.0, 1.732_050_807_57],
            1e-10,
        );
    }
}
