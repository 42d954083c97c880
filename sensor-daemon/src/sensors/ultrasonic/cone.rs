//! The closest point of upright solids in a level elliptic cone, in closed form. The equations are in docs/sensor-models.md.
//!
//! Solids and cone are upright, so the closest point has the height of the solid that is nearest to the sensor's. The problem is flat:
//! at that height a section of the cone is bounded by two rays, or by one branch of a hyperbola. Along a wall, and along the side of a
//! cylinder that faces the sensor, the range grows in both directions from the nearest point. So the echo comes from that point if the
//! section holds it, else from the nearest crossing with the section's border.

use sim_core::scene::shape::{Point, between, contains, cross, dot, edges, from_to};

/// A flat surface returns an echo at angles of incidence of up to 60°: the squared range is at most this times the squared distance
/// of the sensor from the surface's plane, 1 / cos² 60°.
const MOST_OBLIQUE: f64 = 4.0;

/// Opening of a cone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConeOpening {
    /// 1 / tan² of the horizontal half angle.
    inverse_aside2: f64,
    /// 1 / tan² of the vertical half angle.
    inverse_up2: f64,
}

impl ConeOpening {
    /// A cone with these half angles, degrees.
    #[must_use]
    pub fn new(horizontal_half_angle_deg: f64, vertical_half_angle_deg: f64) -> Self {
        let inverse2 = |angle_deg: f64| {
            let tangent = libm::tan(angle_deg.to_radians());
            1.0 / (tangent * tangent)
        };
        Self {
            inverse_aside2: inverse2(horizontal_half_angle_deg),
            inverse_up2: inverse2(vertical_half_angle_deg),
        }
    }
}

/// Position of a sensor and direction of its axis, which is level.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorAxis {
    /// East and north, world, metres.
    pub place_m: Point,
    /// Height, world, metres.
    pub z_m: f64,
    /// Unit vector along the axis.
    pub ahead: Point,
}

/// The search for the first echo of one sensor.
#[derive(Debug, Clone, Copy)]
pub struct EchoSearch {
    opening: ConeOpening,
    axis: SensorAxis,
    /// Squared range of the nearest echo so far, at first that of the farthest one that is heard, m².
    limit_m2: f64,
    has_echo: bool,
}

/// Horizontal section of a cone, in its sensor's frame: x ahead, y left.
#[derive(Debug, Clone, Copy)]
struct ConeSection {
    inverse_aside2: f64,
    /// Squared distance of its vertex ahead of the sensor, m².
    vertex_m2: f64,
    /// Squared height above or below the sensor, m².
    height_m2: f64,
}

impl EchoSearch {
    /// Listens up to `range_m`.
    #[must_use]
    pub fn new(opening: ConeOpening, axis: SensorAxis, range_m: f64) -> Self {
        Self {
            opening,
            axis,
            limit_m2: range_m * range_m,
            has_echo: false,
        }
    }

    /// Range of the first echo, metres.
    #[must_use]
    pub fn range_m(&self) -> Option<f64> {
        self.has_echo.then(|| self.limit_m2.sqrt())
    }

    /// Adds a prism between two heights over an outline in counter-clockwise order.
    pub fn prism(&mut self, outline_m: &[Point], z_m: [f64; 2]) {
        let section = self.section(z_m);
        if section.height_m2 == 0.0 && contains(outline_m, self.axis.place_m) {
            return self.record(0.0);
        }
        for (from, to) in edges(outline_m) {
            let wall = section.wall(self.local(from), self.local(to), self.limit_m2);
            self.record_if_any(wall);
        }
    }

    /// Adds an upright cylinder between two heights.
    pub fn cylinder(&mut self, centre_m: Point, radius_m: f64, z_m: [f64; 2]) {
        let (section, centre) = (self.section(z_m), self.local(centre_m));
        if section.height_m2 == 0.0 && dot(centre, centre) <= radius_m * radius_m {
            return self.record(0.0);
        }
        self.record_if_any(section.cylinder(centre, radius_m, self.limit_m2));
    }

    fn record_if_any(&mut self, echo_m2: Option<f64>) {
        if let Some(echo_m2) = echo_m2 {
            self.record(echo_m2);
        }
    }

    fn record(&mut self, echo_m2: f64) {
        (self.limit_m2, self.has_echo) = (echo_m2, true);
    }

    /// A point of the world in the sensor's frame.
    fn local(&self, point_m: Point) -> Point {
        let offset = from_to(self.axis.place_m, point_m);
        [dot(self.axis.ahead, offset), cross(self.axis.ahead, offset)]
    }

    /// The section at the height of a solid that is nearest to the sensor's.
    fn section(&self, [low_m, high_m]: [f64; 2]) -> ConeSection {
        let height_m = (low_m - self.axis.z_m).max(0.0) + (high_m - self.axis.z_m).min(0.0);
        let height_m2 = height_m * height_m;
        ConeSection {
            inverse_aside2: self.opening.inverse_aside2,
            vertex_m2: height_m2 * self.opening.inverse_up2,
            height_m2,
        }
    }
}

impl ConeSection {
    fn holds(&self, [x, y]: Point) -> bool {
        x > 0.0 && x * x - self.inverse_aside2 * y * y >= self.vertex_m2
    }

    /// Squared range of the echo of a wall from `a` to `b`, counter-clockwise about its prism, if it is at most `limit_m2`.
    fn wall(&self, a: Point, b: Point, limit_m2: f64) -> Option<f64> {
        let along = from_to(a, b);
        let (length2, area) = (dot(along, along), cross(along, a));
        if area <= 0.0 {
            // The sensor is behind it.
            return None;
        }
        let distance_m2 = area * area / length2;
        let foot = -dot(a, along) / length2;
        let range_m2 = |share: f64| distance_m2 + (share - foot) * (share - foot) * length2 + self.height_m2;
        let limit_m2 = limit_m2.min(MOST_OBLIQUE * distance_m2);
        let nearest = foot.clamp(0.0, 1.0);
        if range_m2(nearest) > limit_m2 {
            return None;
        }
        let share = if self.holds(between(a, b, nearest)) {
            nearest
        } else {
            self.crossing(a, along, foot)?
        };
        Some(range_m2(share)).filter(|range_m2| *range_m2 <= limit_m2)
    }

    /// The share of the segment from `a` at which it crosses the border, nearest to `foot`.
    fn crossing(&self, a: Point, along: Point, foot: f64) -> Option<f64> {
        let k = self.inverse_aside2;
        let shares = quadratic_zeros([
            a[0] * a[0] - k * a[1] * a[1] - self.vertex_m2,
            2.0 * (a[0] * along[0] - k * a[1] * along[1]),
            along[0] * along[0] - k * along[1] * along[1],
        ]);
        let is_ahead = |share: f64| a[0] + share * along[0] > 0.0;
        let on_wall = shares
            .into_iter()
            .filter(|share| (0.0..=1.0).contains(share) && is_ahead(*share));
        on_wall.min_by(|p, q| (p - foot).abs().total_cmp(&(q - foot).abs()))
    }

    /// Squared range of the echo of a cylinder's side, if it is at most `limit_m2`. The sensor is outside.
    fn cylinder(&self, centre: Point, radius_m: f64, limit_m2: f64) -> Option<f64> {
        let distance_m = dot(centre, centre).sqrt();
        let gap_m = distance_m - radius_m;
        if gap_m <= 0.0 || gap_m * gap_m + self.height_m2 > limit_m2 {
            return None;
        }
        let back = centre.map(|part| -part / distance_m);
        let nearest = [0, 1].map(|axis: usize| centre[axis] + radius_m * back[axis]);
        if self.holds(nearest) {
            return Some(gap_m * gap_m + self.height_m2);
        }
        let u = self.round_crossing(centre, back, radius_m)?;
        // 1 − cos ψ = 2u² / (1 + u²) for the angle ψ from the nearest point.
        let range_m2 = gap_m * gap_m + 4.0 * radius_m * distance_m * u * u / (1.0 + u * u) + self.height_m2;
        Some(range_m2).filter(|range_m2| *range_m2 <= limit_m2)
    }

    /// Tangent of half the angle from the nearest point of a circle to the nearest crossing with the border, on the arc that faces the
    /// sensor. With this tangent u the circle is rational, and the crossings are zeros of a polynomial of degree 4.
    fn round_crossing(&self, centre: Point, back: Point, radius_m: f64) -> Option<f64> {
        let aside = [-back[1], back[0]];
        // (1 + u²) times x, and times y.
        let [x, y] = [0, 1].map(|axis: usize| {
            let (middle, reach) = (centre[axis], radius_m * back[axis]);
            [middle + reach, 2.0 * radius_m * aside[axis], middle - reach]
        });
        let vertex = [1.0, 0.0, 1.0].map(|one: f64| one * self.vertex_m2.sqrt());
        let ([x2, y2], v2) = ([x, y].map(squared), squared(vertex));
        let border = [0, 1, 2, 3, 4].map(|power: usize| x2[power] - self.inverse_aside2 * y2[power] - v2[power]);
        let cosine = radius_m / dot(centre, centre).sqrt();
        let end = ((1.0 - cosine) / (1.0 + cosine)).sqrt();
        let is_ahead = |u: f64| x[0] + u * (x[1] + u * x[2]) > 0.0;
        let crossings = quartic_zeros(border, end)
            .into_iter()
            .flatten()
            .filter(|u| is_ahead(*u));
        crossings.min_by(|p, q| p.abs().total_cmp(&q.abs()))
    }
}

/// Coefficients of the square of a quadratic polynomial, the constant first.
fn squared([a, b, c]: [f64; 3]) -> [f64; 5] {
    [a * a, 2.0 * a * b, b * b + 2.0 * a * c, 2.0 * b * c, c * c]
}

/// Zeros of `c[0] + c[1] t + c[2] t²`; one that does not exist is infinite or not a number.
fn quadratic_zeros([c0, c1, c2]: [f64; 3]) -> [f64; 2] {
    // Without cancellation: both terms have the same sign.
    let sum = -0.5 * (c1 + (c1 * c1 - 4.0 * c2 * c0).sqrt().copysign(c1));
    [sum / c2, c0 / sum]
}

/// Zeros of `c[0] + … + c[4] t⁴` from −`end` to `end`, ascending.
///
/// Between neighbouring zeros of its derivative a polynomial is monotone, so it has at most one zero there, which bisection finds to the
/// last bit. The zeros of its derivatives are found first, from the lowest degree up.
fn quartic_zeros(c: [f64; 5], end: f64) -> [Option<f64>; 4] {
    let derivatives = [
        [6.0 * c[3], 24.0 * c[4], 0.0, 0.0, 0.0],
        [2.0 * c[2], 6.0 * c[3], 12.0 * c[4], 0.0, 0.0],
        [c[1], 2.0 * c[2], 3.0 * c[3], 4.0 * c[4], 0.0],
        c,
    ];
    let mut zeros = [None; 4];
    for polynomial in derivatives {
        let before = zeros.into_iter().flatten();
        let mut low = -end;
        let mut found = [None; 4];
        for (high, zero) in before.chain([end]).zip(&mut found) {
            *zero = monotone_zero(&polynomial, low, high);
            low = high;
        }
        zeros = found;
    }
    zeros
}

/// The zero between `low` and `high`, where the polynomial is monotone.
fn monotone_zero(c: &[f64; 5], mut low: f64, mut high: f64) -> Option<f64> {
    let value = |t: f64| c.iter().rev().fold(0.0, |sum, coefficient| sum * t + coefficient);
    let is_rising = value(low) <= 0.0;
    if is_rising != (value(high) >= 0.0) {
        return None;
    }
    loop {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            return Some(middle);
        }
        if (value(middle) <= 0.0) == is_rising {
            low = middle;
        } else {
            high = middle;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const WIDE: [f64; 2] = [60.0, 30.0];
    /// A solid that reaches from below the sensor to above it.
    const TALL: [f64; 2] = [-1.0, 1.0];

    fn search(half_angles_deg: [f64; 2]) -> EchoSearch {
        let axis = SensorAxis {
            place_m: [0.0; 2],
            z_m: 0.0,
            ahead: [1.0, 0.0],
        };
        EchoSearch::new(ConeOpening::new(half_angles_deg[0], half_angles_deg[1]), axis, 5.0)
    }

    fn of_prism(half_angles_deg: [f64; 2], outline_m: &[Point], z_m: [f64; 2]) -> Option<f64> {
        let mut search = search(half_angles_deg);
        search.prism(outline_m, z_m);
        search.range_m()
    }

    fn of_cylinder(half_angles_deg: [f64; 2], centre_m: Point, radius_m: f64, z_m: [f64; 2]) -> Option<f64> {
        let mut search = search(half_angles_deg);
        search.cylinder(centre_m, radius_m, z_m);
        search.range_m()
    }

    fn rectangle([x0, y0]: Point, [x1, y1]: Point) -> [Point; 4] {
        [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]
    }

    fn assert_near(found: Option<f64>, expected: f64) {
        assert!(
            found.is_some_and(|range_m| (range_m - expected).abs() < 1e-9),
            "{found:?}"
        );
    }

    #[test]
    fn a_wall_ahead_is_heard_at_its_distance_and_one_behind_or_too_far_is_not() {
        assert_near(of_prism(WIDE, &rectangle([2.0, -1.0], [3.0, 1.0]), TALL), 2.0);
        assert_eq!(of_prism(WIDE, &rectangle([-3.0, -1.0], [-2.0, 1.0]), TALL), None);
        assert_eq!(of_prism(WIDE, &rectangle([5.01, -1.0], [6.0, 1.0]), TALL), None);
        assert_near(of_prism(WIDE, &rectangle([-1.0, -1.0], [1.0, 1.0]), TALL), 0.0);
    }

    /// The wall y = 1 enters the cone at x = 1 / tan 60°, at the range 1 / sin 60°.
    #[test]
    fn a_wall_beside_is_heard_where_it_enters_the_cone() {
        let beside = rectangle([-4.0, 1.0], [4.0, 2.0]);
        assert_near(of_prism(WIDE, &beside, TALL), 1.0 / 60_f64.to_radians().sin());
        let right = rectangle([-4.0, -2.0], [4.0, -1.0]);
        assert_near(of_prism(WIDE, &right, TALL), 1.0 / 60_f64.to_radians().sin());
    }

    /// A wall whose normal is θ off the axis is seen at θ − α or more in a cone of half angle α.
    #[test]
    fn a_wall_vanishes_at_more_than_60_degrees() {
        for (half_angle_deg, turn_deg) in [(5.0, 0.0), (5.0, 64.9), (5.0, 65.1), (20.0, 79.9), (20.0, 80.1)] {
            let (sin, cos) = f64::to_radians(turn_deg).sin_cos();
            let turned = rectangle([1.0, -50.0], [2.0, 50.0]).map(|[x, y]| [x * cos - y * sin, x * sin + y * cos]);
            let range_m = of_prism([half_angle_deg, 30.0], &turned, TALL);
            let incidence_deg = f64::max(turn_deg - half_angle_deg, 0.0);
            if incidence_deg > 60.0 {
                assert_eq!(range_m, None, "{turn_deg}");
            } else {
                assert_near(range_m, 1.0 / incidence_deg.to_radians().cos());
            }
        }
    }

    /// 0.4 m below the sensor a cone of ±30° begins 0.4 / tan 30° = 0.69 m ahead.
    #[test]
    fn a_low_solid_is_heard_at_its_upper_edge_once_it_is_in_the_cone() {
        let low = [-0.5, -0.4];
        assert_eq!(of_prism(WIDE, &rectangle([0.6, -0.1], [0.65, 0.1]), low), None);
        assert_near(
            of_prism(WIDE, &rectangle([1.0, -0.1], [2.0, 0.1]), low),
            1.16_f64.sqrt(),
        );
        assert_eq!(of_cylinder(WIDE, [0.6, 0.0], 0.05, low), None);
        assert_near(of_cylinder(WIDE, [1.2, 0.0], 0.2, low), 1.16_f64.sqrt());
        let high = [0.4, 2.0];
        assert_near(of_cylinder(WIDE, [1.2, 0.0], 0.2, high), 1.16_f64.sqrt());
    }

    /// The ray at 60° meets a circle of radius r about (0, 1.5) first at 1.5 sin 60° − √(r² − (1.5 cos 60°)²).
    #[test]
    fn a_cylinder_is_heard_at_its_nearest_point_or_where_it_enters_the_cone() {
        assert_near(of_cylinder(WIDE, [2.0, 0.0], 0.25, TALL), 1.75);
        assert_eq!(of_cylinder(WIDE, [0.0, 1.5], 0.5, TALL), None);
        let (middle, half) = (1.5 * 60_f64.to_radians().sin(), (1.0 - 0.75_f64 * 0.75).sqrt());
        assert_near(of_cylinder(WIDE, [0.0, 1.5], 1.0, TALL), middle - half);
        assert_near(of_cylinder(WIDE, [0.0, -1.5], 1.0, TALL), middle - half);
        assert_near(of_cylinder(WIDE, [0.1, 0.1], 1.0, TALL), 0.0);
    }

    /// Both rays of a cone of ±15° meet a wide cylinder whose nearest point is at 25°: the echo comes from the ray that is 10° off.
    #[test]
    fn of_two_crossings_with_a_cylinder_the_nearer_one_is_heard() {
        let (sin, cos) = f64::to_radians(25.0).sin_cos();
        let off = 10_f64.to_radians();
        let expected = 1.5 * off.cos() - (1.44 - (1.5 * off.sin()).powi(2)).sqrt();
        assert_near(of_cylinder([15.0, 30.0], [1.5 * cos, 1.5 * sin], 1.2, TALL), expected);
        assert_near(of_cylinder([15.0, 30.0], [1.5 * cos, -1.5 * sin], 1.2, TALL), expected);
    }

    #[test]
    fn the_first_echo_is_the_nearest() {
        let mut search = search(WIDE);
        search.cylinder([3.0, 0.0], 0.5, TALL);
        search.prism(&rectangle([1.5, -1.0], [1.6, 1.0]), TALL);
        search.cylinder([2.5, 0.5], 0.5, TALL);
        assert_near(search.range_m(), 1.5);
    }

    proptest! {
        #[test]
        fn the_zeros_of_a_quartic_are_its_factors(mut zeros in prop::array::uniform4(-2.0_f64..2.0)) {
            zeros.sort_by(f64::total_cmp);
            prop_assume!(zeros.windows(2).all(|pair| pair[1] - pair[0] > 1e-2));
            prop_assume!(zeros.iter().all(|zero| (zero.abs() - 1.0).abs() > 1e-6));
            let factor = |c: [f64; 5], zero: f64| [0, 1, 2, 3, 4].map(|power: usize| {
                (if power > 0 { c[power - 1] } else { 0.0 }) - zero * c[power]
            });
            let c = zeros.into_iter().fold([1.0, 0.0, 0.0, 0.0, 0.0], factor);
            let found: Vec<f64> = quartic_zeros(c, 2.0).into_iter().flatten().collect();
            prop_assert_eq!(found.len(), 4);
            prop_assert!(found.iter().zip(&zeros).all(|(found, zero)| (found - zero).abs() < 1e-6), "{:?}", found);
            let inside: Vec<f64> = quartic_zeros(c, 1.0).into_iter().flatten().collect();
            prop_assert_eq!(inside.len(), zeros.iter().filter(|zero| zero.abs() <= 1.0).count());
        }
    }
}
