//! Bridge decks: where a road of a net with elevation passes over another one.
//!
//! The ground has one height at each place, that of the lowest road there; a road above it lies on a deck. A deck reaches some metres
//! beyond the road below: sensors know the ground at the corners of a grid, and between them it has to come down to that road. It is cut
//! into slices with level tops.

use std::collections::BTreeMap;

use super::{
    road::{Road, RoadPiece},
    shape::{Point, between, distance, from_to, signed_area},
};

/// A road that is lower than another by this much passes below it, metres.
const CLEARANCE_M: f64 = 3.0;
/// How far a deck reaches beyond the road below, metres.
const ABUTMENT_M: f64 = 10.0;
/// Thickness of a deck, metres.
const THICKNESS_M: f64 = 0.8;
/// Distance of the places at which a road is compared with those below, metres.
const STEP_M: f64 = 2.0;
/// Largest rise and length of a slice, metres.
const RISE_M: f64 = 0.1;
const SLICE_M: f64 = 10.0;

/// A slice of a deck.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeckSlice {
    /// Corners, counter-clockwise, world, metres.
    pub outline_m: [Point; 4],
    /// Underside, and top: the mean height of the road there. Metres.
    pub z_m: [f64; 2],
}

/// Where the pieces of a road lie on decks: spans of the way along each, metres, in order and apart.
pub(super) type DeckSpans = BTreeMap<u32, Vec<[f64; 2]>>;

/// The spans of all pieces that pass over another.
pub(super) fn spans(road: &Road) -> DeckSpans {
    let pieces = (0_u32..).zip(road.pieces());
    let found = pieces.filter_map(|(number, piece)| Some((number, spans_of(road, piece)?)));
    found.collect()
}

/// The spans of a strip; `None` if nothing passes below it.
fn spans_of(road: &Road, piece: &RoadPiece) -> Option<Vec<[f64; 2]>> {
    let half_m = piece.half_width_m?;
    let (mut spans, mut begin_m): (Vec<[f64; 2]>, f64) = (Vec::new(), 0.0);
    for (part, ends) in piece.shape_m.windows(2).enumerate() {
        let [a, b] = [ends[0], ends[1]].map(|[x, y, _]| [x, y]);
        let length_m = distance(a, b);
        // Most roads have nothing below them anywhere near.
        if !road.is_any_below(&piece.part_bounds(part), ends[0][2].max(ends[1][2]) - CLEARANCE_M) {
            begin_m += length_m;
            continue;
        }
        let steps = (length_m / STEP_M).ceil().max(1.0) as u32;
        for step in 0..=steps {
            let share = f64::from(step) / f64::from(steps);
            let [left, right] = sides(piece, part, share, half_m);
            let height_m = ends[0][2] + share * (ends[1][2] - ends[0][2]);
            let is_over = |point: Point| road.under(point).any(|(_, below_m)| below_m < height_m - CLEARANCE_M);
            if [left, between(left, right, 0.5), right].into_iter().any(is_over) {
                let at_m = begin_m + share * length_m;
                let [from_m, to_m] = [at_m - ABUTMENT_M, at_m + ABUTMENT_M];
                match spans.last_mut() {
                    Some(last) if from_m <= last[1] => last[1] = to_m,
                    _ => spans.push([from_m.max(0.0), to_m]),
                }
            }
        }
        begin_m += length_m;
    }
    spans.iter_mut().for_each(|span| span[1] = span[1].min(begin_m));
    (!spans.is_empty()).then_some(spans)
}

/// The slices of the spans of a piece.
pub(super) fn slices(piece: &RoadPiece, spans: &[[f64; 2]]) -> Vec<DeckSlice> {
    let Some(half_m) = piece.half_width_m else {
        return Vec::new();
    };
    let (mut slices, mut begin_m) = (Vec::new(), 0.0);
    for (part, ends) in piece.shape_m.windows(2).enumerate() {
        let [a, b] = [ends[0], ends[1]].map(|[x, y, _]| [x, y]);
        let length_m = distance(a, b);
        for [from_m, to_m] in spans {
            let [from, to] = [from_m, to_m].map(|at_m| ((at_m - begin_m) / length_m).clamp(0.0, 1.0));
            let rise_m = (to - from) * (ends[1][2] - ends[0][2]).abs();
            if (to - from) * length_m > 1e-3 {
                let count = ((to - from) * length_m / SLICE_M).max(rise_m / RISE_M).ceil() as u32;
                let cut = |number: u32| from + (to - from) * f64::from(number) / f64::from(count);
                let cuts = (0..count).map(|number| [cut(number), cut(number + 1)]);
                slices.extend(cuts.filter_map(|shares| slice(piece, part, shares, half_m)));
            }
        }
        begin_m += length_m;
    }
    slices
}

/// The slice between two shares of a segment; `None` where a narrow bend leaves nothing of it.
fn slice(piece: &RoadPiece, part: usize, shares: [f64; 2], half_m: f64) -> Option<DeckSlice> {
    let [[left_a, right_a], [left_b, right_b]] = shares.map(|share| sides(piece, part, share, half_m));
    let outline_m = [right_a, right_b, left_b, left_a];
    let [low_m, high_m] = [piece.shape_m[part][2], piece.shape_m[part + 1][2]];
    let top_m = low_m + 0.5 * (shares[0] + shares[1]) * (high_m - low_m);
    (signed_area(&outline_m) > 0.0).then_some(DeckSlice {
        outline_m,
        z_m: [top_m - THICKNESS_M, top_m],
    })
}

/// Left and right edge at a share of a segment; at its ends the corners are mitred.
fn sides(piece: &RoadPiece, part: usize, share: f64, half_m: f64) -> [Point; 2] {
    let [a, b] = [piece.shape_m[part], piece.shape_m[part + 1]].map(|[x, y, _]| [x, y]);
    let offset = match share {
        0.0 => piece.mitre(part),
        1.0 => piece.mitre(part + 1),
        _ => {
            let [x, y] = from_to(a, b);
            let length_m = distance(a, b);
            [-y / length_m, x / length_m]
        }
    };
    let [x, y] = between(a, b, share);
    [half_m, -half_m].map(|side_m| [x + side_m * offset[0], y + side_m * offset[1]])
}

/// The parts of a segment from `begin_m` along its piece, `length_m` long, that lie on no deck: shares of it.
pub(super) fn off_decks(spans: &[[f64; 2]], begin_m: f64, length_m: f64) -> Vec<[f64; 2]> {
    let (mut parts, mut from) = (Vec::new(), 0.0);
    for [begin, end] in spans {
        let [begin, end] = [begin, end].map(|at_m| ((at_m - begin_m) / length_m).clamp(0.0, 1.0));
        if begin > from {
            parts.push([from, begin]);
        }
        from = end.max(from);
    }
    if from < 1.0 {
        parts.push([from, 1.0]);
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{NO_JUNCTION, Scene, SurfaceKind};

    fn lane(id: &str, shape_m: Vec<[f64; 3]>) -> RoadPiece {
        RoadPiece {
            id: id.into(),
            surface: SurfaceKind::Lane,
            shape_m,
            half_width_m: Some(2.0),
            junctions: [NO_JUNCTION; 2],
        }
    }

    /// A road at the height 1 m from west to east, and one over it that climbs from 6 m at y = −50 m to 7 m at y = 50 m.
    fn crossing() -> Scene {
        let below = lane("below_0", vec![[-80.0, 0.0, 1.0], [80.0, 0.0, 1.0]]);
        let above = lane("above_0", vec![[0.0, -50.0, 6.0], [0.0, 10.0, 6.6], [0.0, 50.0, 7.0]]);
        Scene::new(Road::new(vec![below, above]), Vec::new(), Vec::new())
    }

    #[test]
    fn a_deck_reaches_beyond_the_road_below_and_follows_its_own() {
        let scene = crossing();
        let decks = scene.decks();
        let (first, last) = (decks[0], decks[decks.len() - 1]);
        // Two metres on both sides of y = 0, found in steps of 2 m, and the abutments.
        assert!((-14.1..=-12.0).contains(&first.outline_m[0][1]), "{first:?}");
        assert!((12.0..=14.1).contains(&last.outline_m[1][1]), "{last:?}");
        let mut area_m2 = 0.0;
        for (number, slice) in decks.iter().enumerate() {
            area_m2 += signed_area(&slice.outline_m);
            assert!(slice.outline_m.iter().all(|[x, _]| x.abs() == 2.0));
            let middle_m = 0.5 * (slice.outline_m[0][1] + slice.outline_m[1][1]);
            assert!((slice.z_m[1] - (6.5 + 0.01 * middle_m)).abs() < 1e-9, "{slice:?}");
            assert!((slice.z_m[1] - slice.z_m[0] - 0.8).abs() < 1e-9);
            if let Some(next) = decks.get(number + 1) {
                assert_eq!(
                    (slice.outline_m[1], slice.outline_m[2]),
                    (next.outline_m[0], next.outline_m[3])
                );
                assert!((next.z_m[1] - slice.z_m[1]).abs() <= 0.1 + 1e-9);
            }
        }
        let length_m = last.outline_m[1][1] - first.outline_m[0][1];
        assert!((area_m2 - 4.0 * length_m).abs() < 1e-9, "{area_m2}");
    }

    #[test]
    fn under_a_deck_the_ground_is_that_of_the_road_below() {
        let scene = crossing();
        for (point, height_m) in [
            ([0.0, 0.0], 1.0),
            ([0.0, 5.0], 1.0),
            ([1.5, -6.0], 1.0),
            ([40.0, 30.0], 1.0),
            ([0.0, -40.0], 6.1),
            ([0.0, 30.0], 6.8),
            ([3.0, 45.0], 6.95),
        ] {
            let found_m = scene.ground_height_m(point[0], point[1]);
            assert!((found_m - height_m).abs() < 1e-9, "{point:?}: {found_m}");
        }
    }

    #[test]
    fn roads_at_one_level_and_close_ones_have_no_deck() {
        let crossing = |height_m: f64| {
            let below = lane("below_0", vec![[-80.0, 0.0, 1.0], [80.0, 0.0, 1.0]]);
            let above = lane("above_0", vec![[0.0, -50.0, height_m], [0.0, 50.0, height_m]]);
            Scene::new(Road::new(vec![below, above]), Vec::new(), Vec::new())
        };
        assert!(crossing(1.0).decks().is_empty());
        assert!(crossing(3.9).decks().is_empty());
        assert!(!crossing(4.1).decks().is_empty());
    }

    #[test]
    fn two_roads_below_have_one_deck_or_two() {
        let shape = vec![[0.0, -100.0, 8.0], [0.0, 100.0, 8.0]];
        let crossing = |apart_m: f64| {
            let below = |id: &str, y: f64| lane(id, vec![[-80.0, y, 1.0], [80.0, y, 1.0]]);
            let pieces = vec![below("a_0", 0.0), below("b_0", apart_m), lane("over_0", shape.clone())];
            let road = Road::new(pieces);
            spans(&road)[&2].len()
        };
        assert_eq!((crossing(20.0), crossing(40.0)), (1, 2));
    }

    #[test]
    fn slices_meet_in_a_bend() {
        let turn = |step: u32| {
            let (sin, cos) = libm::sincos(f64::from(step) * 0.05);
            [30.0 * sin, 30.0 - 30.0 * cos, 5.0]
        };
        let bend = lane("bend_0", (0..31).map(turn).collect());
        let slices = slices(&bend, &[[0.0, 45.0]]);
        assert_eq!(slices.len(), 30);
        for pair in slices.windows(2) {
            assert!(distance(pair[0].outline_m[1], pair[1].outline_m[0]) < 1e-9);
            assert!(distance(pair[0].outline_m[2], pair[1].outline_m[3]) < 1e-9);
        }
        let area_m2: f64 = slices.iter().map(|slice| signed_area(&slice.outline_m)).sum();
        assert!((area_m2 / (4.0 * 45.0) - 1.0).abs() < 0.01, "{area_m2}");
    }

    #[test]
    fn a_segment_without_its_decks() {
        assert_eq!(off_decks(&[], 0.0, 10.0), [[0.0, 1.0]]);
        assert_eq!(off_decks(&[[2.0, 4.0]], 0.0, 10.0), [[0.0, 0.2], [0.4, 1.0]]);
        assert_eq!(off_decks(&[[2.0, 14.0]], 10.0, 10.0), [[0.4, 1.0]]);
        assert_eq!(off_decks(&[[2.0, 14.0], [18.0, 30.0]], 10.0, 10.0), [[0.4, 0.8]]);
        assert!(off_decks(&[[0.0, 30.0]], 10.0, 10.0).is_empty());
    }
}
