//! A satellite constellation like that of GPS, as seen from one place on the ellipsoid.
//!
//! Thirty satellites in a Walker pattern 30/6/1 (J. Walker, "Satellite constellations", Journal of the British Interplanetary
//! Society 37, 1984): six planes inclined by 55°, five satellites in each, on circular orbits that take half a sidereal day, as
//! GPS's do (E. Kaplan and C. Hegarty, *Understanding GPS*, 2nd edition, section 3.2). Where the orbit is and how the earth turns
//! below it follows IS-GPS-200, table 20-IV, without eccentricity and perturbations. It is no almanac of a date: the pattern
//! repeats each sidereal day, and an episode begins somewhere in it.

use std::f64::consts::TAU;

use sim_core::geodesy::Geodetic;

/// The earth's rate of rotation, rad/s (IS-GPS-200, table 20-IV).
pub const EARTH_RATE_RADPS: f64 = 7.292_115_146_7e-5;
/// The earth's gravitational parameter, m³/s² (IS-GPS-200, table 20-IV).
pub const EARTH_GRAVITY_M3PS2: f64 = 3.986_005e14;
/// The time after which every satellite is above the same place again, seconds.
pub const SIDEREAL_DAY_S: f64 = TAU / EARTH_RATE_RADPS;
/// Two orbits in a sidereal day, rad/s.
const MEAN_MOTION_RADPS: f64 = 2.0 * EARTH_RATE_RADPS;
/// Inclination of the orbits, degrees.
const INCLINATION_DEG: f64 = 55.0;
const PLANES: u32 = 6;
const SATELLITES_IN_PLANE: u32 = 5;
/// All satellites.
pub const SATELLITES: u32 = PLANES * SATELLITES_IN_PLANE;
/// Walker's phasing: the next plane's satellites are ahead by this many 30ths of a circle.
const PHASING: u32 = 1;
/// Satellites lower than this above the horizon are not used, degrees (a usual setting of receivers: low ones have the worst errors).
pub const MASK_DEG: f64 = 10.0;

/// A satellite above the mask, as seen from the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Satellite {
    /// Unit vector towards it: east, north, up.
    pub line_of_sight: [f64; 3],
    /// Unit vector below it in the horizontal plane: east, north.
    pub heading: [f64; 2],
    /// Tangent of its elevation.
    pub tan_elevation: f64,
}

impl Satellite {
    /// A satellite in this direction (a unit vector, east, north, up), not at the zenith itself.
    #[must_use]
    pub fn towards(line_of_sight: [f64; 3]) -> Self {
        let [east, north, up] = line_of_sight;
        let level = libm::hypot(east, north).max(1e-12);
        Self {
            line_of_sight,
            heading: [east / level, north / level],
            tan_elevation: up / level,
        }
    }
}

/// Radius of the orbits, metres (Kepler's third law): 26 562 km.
#[must_use]
pub fn orbit_radius_m() -> f64 {
    libm::cbrt(EARTH_GRAVITY_M3PS2 / (MEAN_MOTION_RADPS * MEAN_MOTION_RADPS))
}

/// Earth-centred, earth-fixed position of satellite `number` (0 … 29) at `time_s`, metres (IS-GPS-200, table 20-IV).
#[must_use]
pub fn satellite_ecef_m(number: u32, time_s: f64) -> [f64; 3] {
    let (plane, place) = (number / SATELLITES_IN_PLANE, number % SATELLITES_IN_PLANE);
    let share = |part: u32, whole: u32| TAU * f64::from(part) / f64::from(whole);
    let along = share(place, SATELLITES_IN_PLANE) + share(PHASING * plane, SATELLITES) + MEAN_MOTION_RADPS * time_s;
    let node = share(plane, PLANES) - EARTH_RATE_RADPS * time_s;
    let ((sin_u, cos_u), (sin_node, cos_node)) = (libm::sincos(along), libm::sincos(node));
    let (sin_i, cos_i) = libm::sincos(INCLINATION_DEG.to_radians());
    let r = orbit_radius_m();
    [
        r * (cos_u * cos_node - sin_u * cos_i * sin_node),
        r * (cos_u * sin_node + sin_u * cos_i * cos_node),
        r * sin_u * sin_i,
    ]
}

/// A place on the WGS 84 ellipsoid with its local axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SkyObserver {
    ecef_m: [f64; 3],
    /// Unit vectors east, north and up, earth-fixed.
    axes: [[f64; 3]; 3],
}

impl SkyObserver {
    /// The place itself, at height zero (Kaplan and Hegarty, section 2.2.3).
    #[must_use]
    pub fn at(place: Geodetic) -> Self {
        const RADIUS_M: f64 = 6_378_137.0;
        const ECCENTRICITY2: f64 = 6.694_379_990_14e-3;
        let (sin_lat, cos_lat) = libm::sincos(place.latitude_deg.to_radians());
        let (sin_lon, cos_lon) = libm::sincos(place.longitude_deg.to_radians());
        let normal_m = RADIUS_M / libm::sqrt(1.0 - ECCENTRICITY2 * sin_lat * sin_lat);
        Self {
            ecef_m: [
                normal_m * cos_lat * cos_lon,
                normal_m * cos_lat * sin_lon,
                normal_m * (1.0 - ECCENTRICITY2) * sin_lat,
            ],
            axes: [
                [-sin_lon, cos_lon, 0.0],
                [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
                [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
            ],
        }
    }

    /// Unit vector east, north, up towards an earth-fixed position.
    #[must_use]
    pub fn line_of_sight(&self, ecef_m: [f64; 3]) -> [f64; 3] {
        let d = [0, 1, 2].map(|i: usize| ecef_m[i] - self.ecef_m[i]);
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let range_m = libm::sqrt(dot(d, d));
        self.axes.map(|axis| dot(axis, d) / range_m)
    }

    /// Satellites above the mask at `time_s`, in the order of their numbers.
    #[must_use]
    pub fn satellites(&self, time_s: f64) -> Vec<Satellite> {
        let sin_mask = libm::sin(MASK_DEG.to_radians());
        (0..SATELLITES)
            .map(|number| self.line_of_sight(satellite_ecef_m(number, time_s)))
            .filter(|line_of_sight| line_of_sight[2] >= sin_mask)
            .map(Satellite::towards)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(latitude_deg: f64, longitude_deg: f64) -> SkyObserver {
        SkyObserver::at(Geodetic {
            latitude_deg,
            longitude_deg,
        })
    }

    /// a = ∛(μ / n²) with n = 2 ω: 26 561.76 km. Half of 86 164.1 s is 11 h 58 min 2 s.
    #[test]
    fn an_orbit_takes_half_a_sidereal_day() {
        assert!((orbit_radius_m() - 26_561_764.0).abs() < 100.0, "{}", orbit_radius_m());
        assert!((0.5 * SIDEREAL_DAY_S - (11.0 * 3600.0 + 58.0 * 60.0 + 2.05)).abs() < 0.01);
        for number in 0..SATELLITES {
            let [a, b, c] = [0.0, 0.5 * SIDEREAL_DAY_S, SIDEREAL_DAY_S].map(|t| satellite_ecef_m(number, t));
            let apart = |p: [f64; 3], q: [f64; 3]| (p[0] - q[0]).hypot(p[1] - q[1]).hypot(p[2] - q[2]);
            assert!(apart(a, c) < 1e-3, "back after a day");
            // After one orbit the earth has turned by half: the same height and latitude, the longitude across.
            assert!(apart([-a[0], -a[1], a[2]], b) < 1e-3);
            assert!((apart(a, [0.0; 3]) - orbit_radius_m()).abs() < 1e-3);
        }
    }

    /// Satellite 0 starts above (0°, 0°). Seen from there it is at the zenith; from γ = 60° further east along the equator its
    /// elevation is atan((cos γ − R/r) / sin γ) = atan((0.5 − 0.240 125) / 0.866 025) = 16.7033°, due west.
    #[test]
    fn elevations_by_hand() {
        let start = satellite_ecef_m(0, 0.0);
        assert!((place(0.0, 0.0).line_of_sight(start)[2] - 1.0).abs() < 1e-12);
        let satellite = Satellite::towards(place(0.0, 60.0).line_of_sight(start));
        let elevation_deg = satellite.tan_elevation.atan().to_degrees();
        assert!((elevation_deg - 16.7033).abs() < 1e-3, "{elevation_deg}");
        assert!((satellite.heading[0] + 1.0).abs() < 1e-9 && satellite.heading[1].abs() < 1e-9);
        // A quarter of an orbit later it is as far north as the inclination says.
        let [x, y, z] = satellite_ecef_m(0, 0.125 * SIDEREAL_DAY_S);
        assert!((z.atan2(x.hypot(y)).to_degrees() - INCLINATION_DEG).abs() < 1e-9);
    }

    #[test]
    fn eight_to_twelve_satellites_are_usual_and_six_the_least() {
        for latitude_deg in [-35.0, 0.0, 25.0, 45.0, 52.0, 60.0] {
            let seen: Vec<usize> = (0..1436)
                .map(|minute| place(latitude_deg, 10.0).satellites(60.0 * f64::from(minute)).len())
                .collect();
            let usual = seen.iter().filter(|count| (8..=12).contains(*count)).count();
            assert!(
                usual * 10 > seen.len() * 7,
                "{usual} of {} at {latitude_deg}",
                seen.len()
            );
            assert!(
                seen.iter().all(|count| *count >= 6),
                "{:?} at {latitude_deg}",
                seen.iter().min()
            );
        }
    }
}
