//! Flat geometry: polygons, segments, boxes, and the crossings between them. Metres, x east, y north.

/// A point or vector, metres.
pub type Point = [f64; 2];

/// An upright rectangle with sides along the axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Lower left corner, metres.
    pub min_m: Point,
    /// Upper right corner, metres.
    pub max_m: Point,
}

impl Bounds {
    /// Nothing: every point enlarges it.
    pub const EMPTY: Self = Self {
        min_m: [f64::INFINITY; 2],
        max_m: [f64::NEG_INFINITY; 2],
    };

    /// The smallest that holds `points`.
    pub fn of(points: impl IntoIterator<Item = Point>) -> Self {
        points.into_iter().fold(Self::EMPTY, |bounds, point| bounds.with(point))
    }

    /// A square about `centre`.
    #[must_use]
    pub fn about(centre: Point, reach_m: f64) -> Self {
        Self {
            min_m: centre.map(|value| value - reach_m),
            max_m: centre.map(|value| value + reach_m),
        }
    }

    /// Enlarged to hold `point`.
    #[must_use]
    pub fn with(self, point: Point) -> Self {
        Self {
            min_m: [0, 1].map(|axis: usize| self.min_m[axis].min(point[axis])),
            max_m: [0, 1].map(|axis: usize| self.max_m[axis].max(point[axis])),
        }
    }

    /// Enlarged by `margin_m` on every side.
    #[must_use]
    pub fn grown(self, margin_m: f64) -> Self {
        Self {
            min_m: self.min_m.map(|value| value - margin_m),
            max_m: self.max_m.map(|value| value + margin_m),
        }
    }

    /// True if they share a point.
    #[must_use]
    pub fn meets(&self, other: &Self) -> bool {
        (0..2).all(|axis| self.min_m[axis] <= other.max_m[axis] && other.min_m[axis] <= self.max_m[axis])
    }

    /// True if `point` is within or on the border.
    #[must_use]
    pub fn holds(&self, point: Point) -> bool {
        (0..2).all(|axis| self.min_m[axis] <= point[axis] && point[axis] <= self.max_m[axis])
    }
}

/// b − a.
#[must_use]
pub fn from_to(a: Point, b: Point) -> Point {
    [b[0] - a[0], b[1] - a[1]]
}

/// z of the cross product: positive if `b` is to the left of `a`.
#[must_use]
pub fn cross(a: Point, b: Point) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

/// Scalar product.
#[must_use]
pub fn dot(a: Point, b: Point) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

/// Distance between two points, metres.
#[must_use]
pub fn distance(a: Point, b: Point) -> f64 {
    let d = from_to(a, b);
    dot(d, d).sqrt()
}

/// Projection of `point` onto the segment a → b, as a share of it (not limited to 0 … 1); 0 for a segment without length.
#[must_use]
pub fn share_along(a: Point, b: Point, point: Point) -> f64 {
    let along = from_to(a, b);
    let length2 = dot(along, along);
    if length2 > 0.0 {
        dot(along, from_to(a, point)) / length2
    } else {
        0.0
    }
}

/// The point at `share` of the segment.
#[must_use]
pub fn between(a: Point, b: Point, share: f64) -> Point {
    [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]
}

/// The point of the segment nearest to `point`.
#[must_use]
pub fn nearest_on_segment(a: Point, b: Point, point: Point) -> Point {
    between(a, b, share_along(a, b, point).clamp(0.0, 1.0))
}

/// Edges of a closed outline.
pub fn edges(outline: &[Point]) -> impl Iterator<Item = (Point, Point)> + '_ {
    let last = outline.last().copied().into_iter();
    last.chain(outline.iter().copied()).zip(outline.iter().copied())
}

/// Area, positive for a counter-clockwise outline, m².
#[must_use]
pub fn signed_area(outline: &[Point]) -> f64 {
    // About the first corner: net coordinates may be thousands of kilometres.
    let origin = outline.first().copied().unwrap_or_default();
    let twice: f64 = edges(outline)
        .map(|(a, b)| cross(from_to(origin, a), from_to(origin, b)))
        .sum();
    0.5 * twice
}

/// True if `point` is inside (even–odd rule; points on the border may fall on either side).
#[must_use]
pub fn contains(outline: &[Point], point: Point) -> bool {
    let mut inside = false;
    for (a, b) in edges(outline) {
        if (a[1] > point[1]) != (b[1] > point[1]) {
            let x = a[0] + (point[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]);
            inside ^= point[0] < x;
        }
    }
    inside
}

/// The point where two segments cross, if they cross or touch in one point.
#[must_use]
pub fn crossing(a: Point, b: Point, c: Point, d: Point) -> Option<Point> {
    let (first, second) = (from_to(a, b), from_to(c, d));
    let area = cross(first, second);
    if area == 0.0 {
        return None;
    }
    let offset = from_to(a, c);
    let (s, t) = (cross(offset, second) / area, cross(offset, first) / area);
    ((0.0..=1.0).contains(&s) && (0.0..=1.0).contains(&t)).then(|| between(a, b, s))
}

/// True if no two edges cross: an outline without loops.
#[must_use]
pub fn is_simple(outline: &[Point]) -> bool {
    let count = outline.len();
    let edge = |place: usize| (outline[place], outline[(place + 1) % count]);
    (0..count).all(|first| {
        (first + 2..count).all(|second| {
            let neighbours = first == 0 && second + 1 == count;
            let ((a, b), (c, d)) = (edge(first), edge(second));
            neighbours || crossing(a, b, c, d).is_none()
        })
    })
}

/// Convex hull, counter-clockwise (Andrew's monotone chain).
#[must_use]
pub fn hull(points: &[Point]) -> Vec<Point> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    sorted.dedup();
    let chain = |ordered: &mut dyn Iterator<Item = &Point>| {
        let mut chain: Vec<Point> = Vec::new();
        for &point in ordered {
            while let [.., a, b] = chain[..]
                && cross(from_to(a, b), from_to(b, point)) <= 0.0
            {
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut lower = chain(&mut sorted.iter());
    lower.extend(chain(&mut sorted.iter().rev()));
    lower
}

/// A box that stands upright on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedBox {
    /// Centre, metres.
    pub centre_m: Point,
    /// Unit vector along its length.
    pub along: Point,
    /// Half its length and half its width, metres.
    pub half_m: [f64; 2],
    /// Lowest and highest point, metres.
    pub z_m: [f64; 2],
}

impl OrientedBox {
    /// Corners, counter-clockwise from the front left.
    #[must_use]
    pub fn corners(&self) -> [Point; 4] {
        let [l, w] = self.half_m;
        [[l, w], [-l, w], [-l, -w], [l, -w]].map(|local| self.world_from_local(local))
    }

    /// A point given along and to the left of the box, in the world.
    #[must_use]
    pub fn world_from_local(&self, [ahead_m, left_m]: Point) -> Point {
        let [cos, sin] = self.along;
        [
            self.centre_m[0] + ahead_m * cos - left_m * sin,
            self.centre_m[1] + ahead_m * sin + left_m * cos,
        ]
    }

    /// A point of the world, along and to the left of the box.
    #[must_use]
    pub fn local_from_world(&self, point: Point) -> Point {
        let d = from_to(self.centre_m, point);
        [dot(self.along, d), cross(self.along, d)]
    }

    /// The upright rectangle about it.
    #[must_use]
    pub fn bounds(&self) -> Bounds {
        let [cos, sin] = self.along.map(f64::abs);
        let [l, w] = self.half_m;
        let reach = [l * cos + w * sin, l * sin + w * cos];
        Bounds {
            min_m: [0, 1].map(|axis: usize| self.centre_m[axis] - reach[axis]),
            max_m: [0, 1].map(|axis: usize| self.centre_m[axis] + reach[axis]),
        }
    }
}

/// The smallest rectangle about a polygon, of any heading: one of its sides lies on a side of the convex hull (Freeman and
/// Shapira, "Determining the minimum-area encasing rectangle for an arbitrary closed curve", 1975).
#[must_use]
pub fn smallest_rectangle(outline: &[Point], z_m: [f64; 2]) -> OrientedBox {
    let hull = hull(outline);
    let about = |along: Point| {
        let local = Bounds::of(hull.iter().map(|point| [dot(along, *point), cross(along, *point)]));
        let half_m = [0, 1].map(|axis: usize| 0.5 * (local.max_m[axis] - local.min_m[axis]));
        let [ahead, left] = [0, 1].map(|axis: usize| 0.5 * (local.max_m[axis] + local.min_m[axis]));
        OrientedBox {
            centre_m: [ahead * along[0] - left * along[1], ahead * along[1] + left * along[0]],
            along,
            half_m,
            z_m,
        }
    };
    let area = |solid: &OrientedBox| solid.half_m[0] * solid.half_m[1];
    edges(&hull)
        .filter(|(a, b)| a != b)
        .map(|(a, b)| about(from_to(a, b).map(|part| part / distance(a, b))))
        .min_by(|a, b| area(a).total_cmp(&area(b)))
        .unwrap_or_else(|| about([1.0, 0.0]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const L: [Point; 6] = [[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]];

    #[test]
    fn an_l_has_its_area_its_inside_and_its_hull() {
        assert_eq!(signed_area(&L), 6.0);
        assert!(contains(&L, [0.5, 2.5]) && contains(&L, [3.5, 0.5]));
        assert!(!contains(&L, [2.0, 2.0]) && !contains(&L, [-0.1, 0.5]));
        assert!(is_simple(&L));
        assert_eq!(hull(&L).len(), 5);
        let reversed: Vec<Point> = L.iter().rev().copied().collect();
        assert_eq!(signed_area(&reversed), -6.0);
    }

    #[test]
    fn a_bow_tie_is_not_simple() {
        let bow = [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]];
        assert!(!is_simple(&bow));
        assert!((signed_area(&hull(&bow)) - 1.0).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn the_smallest_rectangle_holds_every_corner_and_is_tight(
            points in prop::collection::vec(prop::array::uniform2(-9.0_f64..9.0), 3..20), angle in -3.2_f64..3.2,
        ) {
            let rectangle = smallest_rectangle(&points, [0.0, 1.0]);
            for point in &points {
                let [ahead, left] = rectangle.local_from_world(*point);
                prop_assert!(ahead.abs() < rectangle.half_m[0] + 1e-9 && left.abs() < rectangle.half_m[1] + 1e-9);
            }
            let turned = OrientedBox { centre_m: points[0], along: [angle.cos(), angle.sin()], half_m: [4.0, 1.5], z_m: [0.0; 2] };
            let [l, w] = smallest_rectangle(&turned.corners(), [0.0; 2]).half_m;
            prop_assert!((l * w - 6.0).abs() < 1e-9 && (l.max(w) - 4.0).abs() < 1e-9);
        }

        #[test]
        fn a_box_holds_what_its_own_frame_says(
            angle in -3.2_f64..3.2, x in -9.0_f64..9.0, y in -9.0_f64..9.0, l in 0.1_f64..5.0, w in 0.1_f64..5.0,
        ) {
            let body = OrientedBox { centre_m: [1.0, -2.0], along: [angle.cos(), angle.sin()], half_m: [l, w], z_m: [0.0, 1.0] };
            let [ahead, left] = body.local_from_world([x, y]);
            let back = body.world_from_local([ahead, left]);
            prop_assert!(distance(back, [x, y]) < 1e-12);
            prop_assume!((ahead.abs() - l).abs() > 1e-9 && (left.abs() - w).abs() > 1e-9);
            prop_assert_eq!(contains(&body.corners(), [x, y]), ahead.abs() < l && left.abs() < w);
            prop_assert!(body.corners().iter().all(|corner| body.bounds().grown(1e-9).holds(*corner)));
            prop_assert!(signed_area(&body.corners()) > 0.0);
        }

        #[test]
        fn a_hull_is_convex_and_holds_every_point(points in prop::collection::vec(prop::array::uniform2(-9.0_f64..9.0), 3..30)) {
            let hull = hull(&points);
            prop_assume!(hull.len() > 2);
            for point in points {
                prop_assert!(edges(&hull).all(|(a, b)| cross(from_to(a, b), from_to(a, point)) > -1e-9));
            }
        }
    }
}
