//! Road users as solids, and whether two solids touch: exact for upright boxes, capsules and prisms.

use ipc_schema::{traffic::Kind, world::VehicleState};

use crate::{
    scene::shape::{OrientedBox, Point, between, contains, cross, dot, edges, from_to},
    trig::sin_cos_small,
};

/// A road user as a solid: vehicles are boxes, persons upright capsules.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CollisionBody {
    /// The box; of a person the one about the capsule.
    pub solid: OrientedBox,
    /// True for a person: both half sides are the radius.
    pub is_capsule: bool,
}

impl CollisionBody {
    /// The body of a road user where its state says.
    ///
    /// A vehicle reaches `rear_overhang_m` behind its origin and the rest of its length ahead. A person is a capsule about its origin,
    /// as thick as the larger of its width and length.
    #[must_use]
    #[inline]
    pub fn of(state: &VehicleState) -> Self {
        let [cos, sin] = direction(state.yaw_rad);
        let [length_m, width_m, height_m, rear_m] =
            [state.length_m, state.width_m, state.height_m, state.rear_overhang_m].map(f64::from);
        if state.kind == Kind::Person as u32 {
            let radius_m = 0.5 * length_m.max(width_m);
            let solid = OrientedBox {
                centre_m: [state.x_m, state.y_m],
                along: [cos, sin],
                half_m: [radius_m; 2],
                z_m: [state.z_m, state.z_m + height_m],
            };
            return Self {
                solid,
                is_capsule: true,
            };
        }
        let ahead_m = 0.5 * length_m - rear_m;
        // On a slope the box covers the heights of both ends; tan x ≈ x for roads.
        let slope = f64::from(state.pitch_rad);
        let middle_m = state.z_m + slope * ahead_m;
        let rise_m = 0.5 * length_m * slope.abs();
        let solid = OrientedBox {
            centre_m: [state.x_m + ahead_m * cos, state.y_m + ahead_m * sin],
            along: [cos, sin],
            half_m: [0.5 * length_m, 0.5 * width_m],
            z_m: [middle_m - rise_m, middle_m + rise_m + height_m],
        };
        Self {
            solid,
            is_capsule: false,
        }
    }

    /// Radius of the circle about the centre that holds the footprint, at most a third too large, metres.
    #[must_use]
    #[inline]
    pub fn reach_m(&self) -> f64 {
        let [l, w] = self.solid.half_m;
        if self.is_capsule { l } else { l.max(w) + 0.5 * l.min(w) }
    }

    /// True if the two share a point. Two capsules never do: contacts between persons are not detected.
    #[must_use]
    pub fn touches(&self, other: &Self) -> bool {
        match (self.is_capsule, other.is_capsule) {
            (false, false) => boxes_touch(&self.solid, &other.solid),
            (true, false) => capsule_touches_box(&self.solid, &other.solid),
            (false, true) => capsule_touches_box(&other.solid, &self.solid),
            (true, true) => false,
        }
    }

    /// The contact point of two bodies that touch, metres.
    #[must_use]
    pub fn contact_m(&self, other: &Self) -> [f64; 3] {
        let flat = match (self.is_capsule, other.is_capsule) {
            (true, false) => nearest_in_box(&other.solid, self.solid.centre_m),
            (_, true) => nearest_in_box(&self.solid, other.solid.centre_m),
            (false, false) => common_point(&self.solid, &other.solid.corners()),
        };
        let [x, y] = flat;
        [x, y, common_height(self.solid.z_m, other.solid.z_m)]
    }
}

/// Cosine and sine, error below 2e-9: a few nanometres at the corner of a lorry.
#[inline]
fn direction(yaw_rad: f64) -> Point {
    if yaw_rad.abs() > 4.0 {
        let (sin, cos) = libm::sincos(yaw_rad);
        return [cos, sin];
    }
    // Quarter turns, counted from -4 so that the conversion rounds to the nearest.
    let quarters = (yaw_rad * std::f64::consts::FRAC_2_PI + 4.5) as i32 - 4;
    let (sin, cos) = sin_cos_small(yaw_rad - f64::from(quarters) * std::f64::consts::FRAC_PI_2);
    match quarters & 3 {
        0 => [cos, sin],
        1 => [-sin, cos],
        2 => [-cos, -sin],
        _ => [sin, -cos],
    }
}

fn heights_meet(a: [f64; 2], b: [f64; 2]) -> bool {
    a[0] <= b[1] && b[0] <= a[1]
}

/// Middle of the heights that both have.
#[must_use]
pub(super) fn common_height(a: [f64; 2], b: [f64; 2]) -> f64 {
    0.5 * (a[0].max(b[0]) + a[1].min(b[1]))
}

/// Separating axes of two upright boxes (Gottschalk, Lin and Manocha, "OBBTree", SIGGRAPH 1996): the four sides and up.
#[must_use]
pub fn boxes_touch(a: &OrientedBox, b: &OrientedBox) -> bool {
    let d = from_to(a.centre_m, b.centre_m);
    let (cos, sin) = (dot(a.along, b.along).abs(), cross(a.along, b.along).abs());
    let ([al, aw], [bl, bw]) = (a.half_m, b.half_m);
    heights_meet(a.z_m, b.z_m)
        && dot(a.along, d).abs() <= al + bl * cos + bw * sin
        && cross(a.along, d).abs() <= aw + bl * sin + bw * cos
        && dot(b.along, d).abs() <= bl + al * cos + aw * sin
        && cross(b.along, d).abs() <= bw + al * sin + aw * cos
}

/// Distance from the capsule's axis to the box, against its radius: both are products of a flat shape and an interval.
fn capsule_touches_box(capsule: &OrientedBox, solid: &OrientedBox) -> bool {
    let radius_m = capsule.half_m[0];
    let [ahead, left] = solid.local_from_world(capsule.centre_m);
    let (dx, dy) = (
        (ahead.abs() - solid.half_m[0]).max(0.0),
        (left.abs() - solid.half_m[1]).max(0.0),
    );
    let middle = 0.5 * (capsule.z_m[0] + capsule.z_m[1]);
    let axis = [
        (capsule.z_m[0] + radius_m).min(middle),
        (capsule.z_m[1] - radius_m).max(middle),
    ];
    let dz = (axis[0] - solid.z_m[1]).max(solid.z_m[0] - axis[1]).max(0.0);
    dx * dx + dy * dy + dz * dz <= radius_m * radius_m
}

/// True if an upright box and an upright prism over a simple polygon share a point.
#[must_use]
pub fn box_touches_prism(solid: &OrientedBox, outline: &[Point], z_m: [f64; 2]) -> bool {
    heights_meet(solid.z_m, z_m)
        && (edges(outline).any(|(a, b)| segment_meets_box(solid, a, b)) || contains(outline, solid.centre_m))
}

/// Clips the segment by the four sides (Liang and Barsky, "A new concept and method for line clipping", 1984).
fn segment_meets_box(solid: &OrientedBox, a: Point, b: Point) -> bool {
    let (from, to) = (solid.local_from_world(a), solid.local_from_world(b));
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    for axis in 0..2 {
        let (start, way, half) = (from[axis], to[axis] - from[axis], solid.half_m[axis]);
        if way == 0.0 {
            if start.abs() > half {
                return false;
            }
            continue;
        }
        let (first, second) = ((-half - start) / way, (half - start) / way);
        enter = enter.max(first.min(second));
        leave = leave.min(first.max(second));
    }
    enter <= leave
}

fn nearest_in_box(solid: &OrientedBox, point: Point) -> Point {
    let local = solid.local_from_world(point);
    solid.world_from_local([0, 1].map(|axis: usize| local[axis].clamp(-solid.half_m[axis], solid.half_m[axis])))
}

/// Centroid of the area common to a box and a polygon, which is cut off at the four sides one after the other (Sutherland and
/// Hodgman, "Reentrant polygon clipping", 1974). If they touch in less than an area, the point of the box nearest to the polygon's corners.
#[must_use]
pub(super) fn common_point(solid: &OrientedBox, outline: &[Point]) -> Point {
    let mut cut: Vec<Point> = outline.iter().map(|corner| solid.local_from_world(*corner)).collect();
    for (axis, side) in [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)] {
        let beyond = |point: Point| side * point[axis] - solid.half_m[axis];
        let whole = std::mem::take(&mut cut);
        for (a, b) in edges(&whole) {
            let (from, to) = (beyond(a), beyond(b));
            if (from > 0.0) != (to > 0.0) {
                cut.push(between(a, b, from / (from - to)));
            }
            if to <= 0.0 {
                cut.push(b);
            }
        }
    }
    let origin = cut.first().copied().unwrap_or_default();
    let (mut sum, mut area) = ([0.0; 2], 0.0);
    for (a, b) in edges(&cut) {
        let (a, b) = (from_to(origin, a), from_to(origin, b));
        let part = cross(a, b);
        area += part;
        sum = [0, 1].map(|axis: usize| sum[axis] + part * (a[axis] + b[axis]) / 3.0);
    }
    if area.abs() > 1e-9 {
        return solid.world_from_local([origin[0] + sum[0] / area, origin[1] + sum[1] / area]);
    }
    let distance2 = |corner: &Point| {
        let d = from_to(nearest_in_box(solid, *corner), *corner);
        dot(d, d)
    };
    let nearest = outline.iter().min_by(|a, b| distance2(a).total_cmp(&distance2(b)));
    nearest.map_or(solid.centre_m, |corner| nearest_in_box(solid, *corner))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_direction_is_cosine_and_sine(yaw in -20.0_f64..20.0) {
            let [cos, sin] = direction(yaw);
            prop_assert!((cos - yaw.cos()).abs() < 2e-9 && (sin - yaw.sin()).abs() < 2e-9);
        }
    }

    #[test]
    fn the_box_lies_where_bumpers_and_sides_are() {
        let state = VehicleState {
            x_m: 10.0,
            y_m: 5.0,
            z_m: 2.0,
            yaw_rad: std::f64::consts::FRAC_PI_2,
            length_m: 4.5,
            width_m: 1.75,
            height_m: 1.5,
            rear_overhang_m: 1.0,
            ..VehicleState::default()
        };
        let body = CollisionBody::of(&state);
        // Facing north: front bumper 3.5 m ahead of the rear axle.
        let bounds = body.solid.bounds();
        let expected = [[10.0 - 0.875, 4.0], [10.0 + 0.875, 8.5]];
        for (got, wanted) in [bounds.min_m, bounds.max_m].iter().zip(expected) {
            assert!((0..2).all(|axis| (got[axis] - wanted[axis]).abs() < 1e-6), "{bounds:?}");
        }
        assert_eq!(body.solid.z_m, [2.0, 3.5]);
        let uphill = CollisionBody::of(&VehicleState {
            pitch_rad: 0.1,
            ..state
        });
        assert!(
            (uphill.solid.z_m[0] - (2.0 - 0.1)).abs() < 1e-6 && (uphill.solid.z_m[1] - (2.0 + 0.35 + 1.5)).abs() < 1e-6
        );
    }

    #[test]
    fn a_person_is_as_thick_as_its_larger_side() {
        let state = VehicleState {
            kind: Kind::Person as u32,
            length_m: 0.215,
            width_m: 0.478,
            height_m: 1.719,
            ..VehicleState::default()
        };
        let body = CollisionBody::of(&state);
        assert!(body.is_capsule && (body.solid.half_m[0] - 0.239).abs() < 1e-6);
    }

    #[test]
    fn the_contact_of_two_boxes_is_in_the_middle_of_what_they_share() {
        let at = |x: f64, z: f64| CollisionBody {
            solid: OrientedBox {
                centre_m: [x, 0.0],
                along: [1.0, 0.0],
                half_m: [2.0, 1.0],
                z_m: [z, z + 2.0],
            },
            is_capsule: false,
        };
        let [x, y, z] = at(0.0, 0.0).contact_m(&at(3.0, 1.0));
        assert!(
            (x - 1.5).abs() < 1e-12 && y.abs() < 1e-12 && (z - 1.5).abs() < 1e-12,
            "{x} {y} {z}"
        );
    }
}
