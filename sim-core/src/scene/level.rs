//! Levels of a net without elevation: where two roads cross and no junction joins them, one passes over the other.

use super::{
    road::{NO_JUNCTION, Road, RoadPiece},
    shape::{OrientedBox, Point, cross, distance, from_to},
};

/// Roads that cross at a smaller angle run side by side; a road user is on the lanes that it follows within this angle: sine of 20°.
const SIDE_BY_SIDE: f64 = 0.342;

impl Road {
    /// True if two road users that seem to touch are on roads that cross without a junction that joins them: one of them is on a bridge.
    /// Only nets without elevation need this; elsewhere the heights decide.
    #[must_use]
    pub fn are_levels_apart(&self, [a, b]: [&OrientedBox; 2]) -> bool {
        if self.flat_height_m().is_none() || cross(a.along, b.along).abs() < SIDE_BY_SIDE {
            return false;
        }
        let (on_a, on_b) = (self.junctions_of(a), self.junctions_of(b));
        match (on_a, on_b) {
            (Some(on_a), Some(on_b)) => !on_a.iter().any(|junction| on_b.contains(junction)),
            _ => false,
        }
    }

    /// Junctions of the pieces that a road user follows with its front, middle or rear; `None` if it follows none.
    fn junctions_of(&self, solid: &OrientedBox) -> Option<Vec<u32>> {
        let ahead_m = solid.half_m[0];
        let mut found = Vec::new();
        for offset_m in [0.0, ahead_m, -ahead_m] {
            let point = solid.world_from_local([offset_m, 0.0]);
            // Along the lane or against it: pedestrians walk both ways.
            let follows = |way: Point| cross(solid.along, way).abs() < SIDE_BY_SIDE;
            let followed = self
                .parts_under(point)
                .filter(|(piece, part, _)| direction(piece, *part).is_some_and(follows));
            found.extend(followed.flat_map(|(piece, ..)| piece.junctions));
        }
        found.retain(|junction| *junction != NO_JUNCTION);
        (!found.is_empty()).then_some(found)
    }
}

/// Unit vector along a segment of a strip; a polygon has none.
fn direction(piece: &RoadPiece, part: usize) -> Option<Point> {
    piece.half_width_m?;
    let [a, b] = [piece.shape_m[part], piece.shape_m[part + 1]].map(|[x, y, _]| [x, y]);
    let length_m = distance(a, b);
    (length_m > 0.0).then(|| from_to(a, b).map(|d| d / length_m))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::SurfaceKind;

    fn lane(id: &str, shape: [Point; 2], junctions: [u32; 2]) -> RoadPiece {
        RoadPiece {
            id: id.into(),
            surface: SurfaceKind::Lane,
            shape_m: shape.map(|[x, y]| [x, y, 0.0]).to_vec(),
            half_width_m: Some(1.6),
            junctions,
        }
    }

    fn car(x: f64, y: f64, along: Point) -> OrientedBox {
        OrientedBox {
            centre_m: [x, y],
            along,
            half_m: [2.0, 0.9],
            z_m: [0.0, 1.5],
        }
    }

    const EAST: Point = [1.0, 0.0];
    const NORTH: Point = [0.0, 1.0];

    fn crossing(second: [u32; 2]) -> Road {
        Road::new(vec![
            lane("a_0", [[-50.0, 0.0], [50.0, 0.0]], [0, 1]),
            lane("b_0", [[0.0, -50.0], [0.0, 50.0]], second),
        ])
    }

    #[test]
    fn roads_that_cross_without_a_junction_are_levels_apart() {
        let road = crossing([2, 3]);
        assert!(road.are_levels_apart([&car(0.0, 0.0, EAST), &car(0.5, 1.0, NORTH)]));
        assert!(
            !road.are_levels_apart([&car(0.0, 0.0, EAST), &car(1.0, 0.5, EAST)]),
            "one road"
        );
        let skewed = [0.96, 0.28];
        assert!(
            !road.are_levels_apart([&car(0.0, 0.0, EAST), &car(1.0, 0.5, skewed)]),
            "no crossing course"
        );
    }

    #[test]
    fn roads_that_a_junction_joins_are_not() {
        assert!(!crossing([1, 3]).are_levels_apart([&car(0.0, 0.0, EAST), &car(0.5, 1.0, NORTH)]));
    }

    #[test]
    fn a_road_user_on_no_road_may_touch_any_other() {
        let road = crossing([2, 3]);
        assert!(
            !road.are_levels_apart([&car(20.0, 0.0, EAST), &car(20.0, 2.0, NORTH)]),
            "across the lane"
        );
        assert!(!Road::default().are_levels_apart([&car(0.0, 0.0, EAST), &car(0.0, 0.0, NORTH)]));
    }

    #[test]
    fn heights_decide_in_a_net_with_elevation() {
        let mut high = lane("b_0", [[0.0, -50.0], [0.0, 50.0]], [2, 3]);
        high.shape_m[0][2] = 8.0;
        let road = Road::new(vec![lane("a_0", [[-50.0, 0.0], [50.0, 0.0]], [0, 1]), high]);
        assert!(!road.are_levels_apart([&car(0.0, 0.0, EAST), &car(0.5, 1.0, NORTH)]));
    }
}
