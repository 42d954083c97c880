//! The road surface: lanes as strips, junctions and walking areas as polygons, each with its height.

use super::{
    SceneError,
    deck::{self, DeckSlice, DeckSpans},
    grid::Grid,
    shape::{Bounds, Point, between, contains, distance, dot, from_to, share_along},
    xml::{ElementPosition, XmlTag, attribute, for_each_tag, points},
};
use quick_xml::events::BytesStart;
use std::{collections::BTreeMap, path::Path};

/// SUMO's width of a lane that states none, metres.
const DEFAULT_WIDTH_M: f64 = 3.2;
/// Shapes are written to centimetres: strips that touch may gape by this, metres.
const SEAM_M: f64 = 0.05;
/// Size of a cell of the index, metres.
const CELL_M: f64 = 15.0;
/// Classes that do not drive on a road.
const OFF_ROAD_CLASSES: [&str; 12] = [
    "pedestrian",
    "wheelchair",
    "tram",
    "rail",
    "rail_urban",
    "rail_electric",
    "rail_fast",
    "subway",
    "cable_car",
    "ship",
    "aircraft",
    "drone",
];

/// The purpose of a piece of the surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SurfaceKind {
    /// A lane that road vehicles may use, also within a junction.
    Lane,
    /// The polygon of a junction.
    Junction,
    /// A pedestrian crossing; it lies on the road.
    Crossing,
    /// Where sidewalks and crossings meet.
    WalkingArea,
    /// A lane for pedestrians only.
    Sidewalk,
    /// Rails and waterways.
    Track,
    /// A lane that no class may use: a verge.
    Verge,
}

impl SurfaceKind {
    /// True if vehicles drive on it.
    #[must_use]
    pub fn is_road(self) -> bool {
        matches!(self, Self::Lane | Self::Junction | Self::Crossing)
    }

    fn of_lane(function: &str, element: &BytesStart<'_>) -> Self {
        match function {
            "crossing" => return Self::Crossing,
            "walkingarea" => return Self::WalkingArea,
            _ => {}
        }
        if attribute(element, "disallow").is_some_and(|list| list.trim() == "all") {
            return Self::Verge;
        }
        let Some(allowed) = attribute(element, "allow") else {
            return Self::Lane;
        };
        let mut classes = allowed.split_whitespace().peekable();
        if classes.peek().is_none() || classes.clone().any(|class| !OFF_ROAD_CLASSES.contains(&class)) {
            return Self::Lane;
        }
        if classes.all(|class| matches!(class, "pedestrian" | "wheelchair")) {
            Self::Sidewalk
        } else {
            Self::Track
        }
    }
}

/// One lane, junction, crossing or walking area.
#[derive(Debug, Clone, PartialEq)]
pub struct RoadPiece {
    /// SUMO's id.
    pub id: String,
    /// Its purpose.
    pub surface: SurfaceKind,
    /// Centre line of a strip, outline of a polygon (not closed), metres.
    pub shape_m: Vec<[f64; 3]>,
    /// Half the width of a strip; `None` for a polygon. Metres.
    pub half_width_m: Option<f64>,
    /// Numbers of the junctions it begins and ends at, of the one it lies in twice; [`NO_JUNCTION`] if the net names none.
    pub junctions: [u32; 2],
}

/// No junction, in [`RoadPiece::junctions`].
pub const NO_JUNCTION: u32 = u32::MAX;

impl RoadPiece {
    /// Its border as a closed polygon without the last point repeated, counter-clockwise for strips; corners are mitred.
    #[must_use]
    pub fn outline(&self) -> Vec<[f64; 3]> {
        let Some(half_m) = self.half_width_m else {
            return self.shape_m.clone();
        };
        let offset = |side_m: f64| {
            move |place: usize| {
                let [x, y, z] = self.shape_m[place];
                let [nx, ny] = self.mitre(place);
                [x + side_m * nx, y + side_m * ny, z]
            }
        };
        let count = self.shape_m.len();
        let right = (0..count).map(offset(-half_m));
        right.chain((0..count).rev().map(offset(half_m))).collect()
    }

    /// Offset to the left at a point of the centre line that keeps both neighbours one metre away; at most 2 m long.
    pub(super) fn mitre(&self, place: usize) -> Point {
        let count = self.shape_m.len();
        let normal = |a: usize, b: usize| {
            let d = from_to(flat(self.shape_m[a]), flat(self.shape_m[b]));
            let length = dot(d, d).sqrt();
            if length > 0.0 {
                Some([-d[1] / length, d[0] / length])
            } else {
                None
            }
        };
        let before = (place > 0).then(|| normal(place - 1, place)).flatten();
        let after = (place + 1 < count).then(|| normal(place, place + 1)).flatten();
        match (before, after) {
            (Some(a), Some(b)) => {
                let stretch = 1.0 / (1.0 + dot(a, b)).max(0.5);
                [(a[0] + b[0]) * stretch, (a[1] + b[1]) * stretch]
            }
            (Some(n), None) | (None, Some(n)) => n,
            (None, None) => [0.0; 2],
        }
    }

    /// Height at `point` if it lies on this part of the piece.
    fn height_at(&self, part: usize, point: Point) -> Option<f64> {
        match self.half_width_m {
            Some(half_m) => self.strip_height(part, half_m, point),
            None => {
                let outline = || self.shape_m.iter().copied().map(flat);
                // Even–odd as in `contains`, without copying the outline.
                let last = outline().next_back().into_iter();
                let mut inside = false;
                for (a, b) in last.chain(outline()).zip(outline()) {
                    if (a[1] > point[1]) != (b[1] > point[1]) {
                        inside ^= point[0] < a[0] + (point[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]);
                    }
                }
                inside.then(|| self.mean_height(point))
            }
        }
    }

    /// Between two points of the centre line: round at the joints, straight at both ends.
    fn strip_height(&self, part: usize, half_m: f64, point: Point) -> Option<f64> {
        let (from, to) = (self.shape_m[part], self.shape_m[part + 1]);
        let (a, b) = (flat(from), flat(to));
        let share = share_along(a, b, point);
        let length_m = distance(a, b);
        let beyond = (share < 0.0 && part == 0 && -share * length_m > SEAM_M)
            || (share > 1.0 && part + 2 == self.shape_m.len() && (share - 1.0) * length_m > SEAM_M);
        let share = share.clamp(0.0, 1.0);
        let near = distance(between(a, b, share), point) <= half_m + SEAM_M;
        (near && !beyond).then(|| from[2] + share * (to[2] - from[2]))
    }

    /// Mean height of the corners, weighted by one over the squared distance.
    fn mean_height(&self, point: Point) -> f64 {
        let (mut sum, mut weights) = (0.0, 0.0);
        for corner in &self.shape_m {
            let d = from_to(point, flat(*corner));
            let weight = 1.0 / (dot(d, d) + 1e-9);
            sum += weight * corner[2];
            weights += weight;
        }
        sum / weights
    }

    fn parts(&self) -> usize {
        self.half_width_m.map_or(1, |_| self.shape_m.len().saturating_sub(1))
    }

    pub(super) fn part_bounds(&self, part: usize) -> Bounds {
        match self.half_width_m {
            Some(half_m) => Bounds::of(self.shape_m[part..=part + 1].iter().copied().map(flat)).grown(half_m + SEAM_M),
            None => Bounds::of(self.shape_m.iter().copied().map(flat)),
        }
    }

    /// Distance from `point` to this part, 0 on it, and height of the part at the place nearest to it, metres. Of a strip only what lies
    /// between these shares of the segment counts.
    fn nearest(&self, part: usize, [first, last]: [f64; 2], point: Point) -> (f64, f64) {
        let nearest = |from: [f64; 3], to: [f64; 3], [first, last]: [f64; 2]| {
            let (a, b) = (flat(from), flat(to));
            let share = share_along(a, b, point).clamp(first, last);
            (
                distance(between(a, b, share), point),
                from[2] + share * (to[2] - from[2]),
            )
        };
        match self.half_width_m {
            Some(half_m) => {
                let (distance_m, height_m) = nearest(self.shape_m[part], self.shape_m[part + 1], [first, last]);
                ((distance_m - half_m).max(0.0), height_m)
            }
            None => {
                let outline: Vec<Point> = self.shape_m.iter().copied().map(flat).collect();
                if contains(&outline, point) {
                    return (0.0, self.mean_height(point));
                }
                let last = self.shape_m.last().copied().into_iter();
                let edges = last.chain(self.shape_m.iter().copied()).zip(&self.shape_m);
                edges
                    .map(|(from, to)| nearest(from, *to, WHOLE))
                    .min_by(|a, b| a.0.total_cmp(&b.0))
                    .unwrap_or((f64::INFINITY, 0.0))
            }
        }
    }
}

/// All of a segment, by shares.
const WHOLE: [f64; 2] = [0.0, 1.0];

fn flat([x, y, _]: [f64; 3]) -> Point {
    [x, y]
}

/// The whole surface, with an index over the parts of its pieces.
#[derive(Debug, Clone, Default)]
pub struct Road {
    pieces: Vec<RoadPiece>,
    /// Piece and part (segment of a strip) of each entry of the index.
    parts: Vec<(u32, u32)>,
    index: Grid,
    is_flat: bool,
    /// Where pieces pass over others.
    deck_spans: DeckSpans,
    decks: Vec<DeckSlice>,
}

impl Road {
    /// The surface of these pieces.
    #[must_use]
    pub fn new(pieces: Vec<RoadPiece>) -> Self {
        let mut parts = Vec::new();
        for (number, piece) in (0_u32..).zip(&pieces) {
            parts.extend((0..piece.parts() as u32).map(|part| (number, part)));
        }
        let bounds: Vec<Bounds> = parts
            .iter()
            .map(|&(piece, part)| pieces[piece as usize].part_bounds(part as usize))
            .collect();
        let is_flat = pieces
            .iter()
            .flat_map(|piece| &piece.shape_m)
            .all(|point| point[2] == 0.0);
        let mut road = Self {
            index: Grid::new(&bounds, CELL_M),
            pieces,
            parts,
            is_flat,
            deck_spans: DeckSpans::new(),
            decks: Vec::new(),
        };
        if !is_flat {
            road.deck_spans = deck::spans(&road);
            let of_pieces = road.deck_spans.iter();
            road.decks = of_pieces
                .flat_map(|(piece, spans)| deck::slices(&road.pieces[*piece as usize], spans))
                .collect();
        }
        road
    }

    /// Reads a net file.
    ///
    /// # Errors
    /// Unreadable, malformed, or a shape that is no list of points.
    pub(super) fn read(net_file: &Path, world_origin_m: Point) -> Result<Self, SceneError> {
        let mut pieces: Vec<RoadPiece> = Vec::new();
        let mut junctions = Junctions::default();
        let mut function = String::new();
        let mut ends = [NO_JUNCTION; 2];
        for_each_tag(net_file, |tag, place| {
            let XmlTag::Open(element) = tag else { return Ok(()) };
            let found = match element.local_name().as_ref() {
                "edge" => {
                    function = attribute(element, "function").unwrap_or_default();
                    ends = junctions.ends(element);
                    None
                }
                "lane" => lane(element, &function, place)?.map(|piece| (piece, ends)),
                "junction" => {
                    let number = junctions.number(&attribute(element, "id").unwrap_or_default());
                    junction(element, place)?.map(|piece| (piece, [number; 2]))
                }
                _ => None,
            };
            pieces.extend(found.map(|(piece, junctions)| RoadPiece { junctions, ..piece }));
            Ok(())
        })?;
        for point in pieces.iter_mut().flat_map(|piece| &mut piece.shape_m) {
            point[0] -= world_origin_m[0];
            point[1] -= world_origin_m[1];
        }
        Ok(Self::new(pieces))
    }

    /// Its pieces, in the order of the net file.
    #[must_use]
    pub fn pieces(&self) -> &[RoadPiece] {
        &self.pieces
    }

    /// Height of everything if the net has no elevation, metres.
    #[must_use]
    pub fn flat_height_m(&self) -> Option<f64> {
        self.is_flat.then_some(0.0)
    }

    /// Slices of the decks on which roads pass over others.
    #[must_use]
    pub fn decks(&self) -> &[DeckSlice] {
        &self.decks
    }

    /// True if a part that may be within `bounds` has a point below `height_m`.
    pub(super) fn is_any_below(&self, bounds: &Bounds, height_m: f64) -> bool {
        let is_below = |entry: &u32| {
            let (piece, part) = self.parts[*entry as usize];
            let piece = &self.pieces[piece as usize];
            let corners = match piece.half_width_m {
                Some(_) => &piece.shape_m[part as usize..=part as usize + 1],
                None => &piece.shape_m[..],
            };
            corners.iter().any(|corner| corner[2] < height_m)
        };
        let mut found = false;
        self.index
            .visit_near(bounds, |entries| found |= entries.iter().any(is_below));
        found
    }

    /// Height of the lowest road that `point` lies on, metres. Roads on decks do not count, here and in [`Road::nearest_ground_m`].
    pub(super) fn ground_under_m(&self, point: Point) -> Option<f64> {
        let heights = self.index.at(point).iter().filter_map(|&entry| {
            let (piece, part) = self.parts[entry as usize];
            let height_m = self.pieces[piece as usize].height_at(part as usize, point)?;
            (!self.is_deck(piece, part, point)).then_some(height_m)
        });
        heights.min_by(f64::total_cmp)
    }

    /// Height of the road nearest to `point` within `reach_m`, metres.
    pub(super) fn nearest_ground_m(&self, point: Point, reach_m: f64) -> Option<f64> {
        let nearest = self.nearest_of(point, reach_m, |piece, part, offer| match self.deck_spans.get(&piece) {
            None => offer(WHOLE),
            Some(spans) => {
                let (begin_m, [a, b]) = self.segment(piece, part);
                let off_decks = deck::off_decks(spans, begin_m, distance(a, b));
                off_decks.into_iter().for_each(offer);
            }
        });
        nearest.map(|(_, height_m)| height_m)
    }

    /// True if a point on this part is on a deck.
    fn is_deck(&self, piece: u32, part: u32, point: Point) -> bool {
        let Some(spans) = self.deck_spans.get(&piece) else {
            return false;
        };
        let (begin_m, [a, b]) = self.segment(piece, part);
        let at_m = begin_m + share_along(a, b, point).clamp(0.0, 1.0) * distance(a, b);
        spans.iter().any(|[from_m, to_m]| (*from_m..=*to_m).contains(&at_m))
    }

    /// A segment of a strip, and how far along the strip it begins, metres.
    fn segment(&self, piece: u32, part: u32) -> (f64, [Point; 2]) {
        let shape_m = &self.pieces[piece as usize].shape_m;
        let lengths = shape_m[..=part as usize].windows(2);
        let begin_m = lengths.map(|ends| distance(flat(ends[0]), flat(ends[1]))).sum();
        (begin_m, [part, part + 1].map(|place| flat(shape_m[place as usize])))
    }

    /// Pieces that `point` lies on, with the height there.
    pub fn under(&self, point: Point) -> impl Iterator<Item = (&RoadPiece, f64)> {
        self.parts_under(point).map(|(piece, _, height_m)| (piece, height_m))
    }

    /// Directions, of length one, of the lanes outside junctions that `point` lies on.
    pub fn lane_directions(&self, point: Point) -> impl Iterator<Item = Point> {
        self.parts_under(point).filter_map(|(piece, part, _)| {
            let is_on_edge = piece.surface == SurfaceKind::Lane && !piece.id.starts_with(':');
            let [from, to] = [piece.shape_m.get(part)?, piece.shape_m.get(part + 1)?].map(|end| flat(*end));
            let length_m = distance(from, to);
            (is_on_edge && length_m > 0.0).then(|| from_to(from, to).map(|d| d / length_m))
        })
    }

    /// As [`Road::under`], with the part of the piece.
    pub(super) fn parts_under(&self, point: Point) -> impl Iterator<Item = (&RoadPiece, usize, f64)> {
        self.index.at(point).iter().filter_map(move |&entry| {
            let (piece, part) = self.parts[entry as usize];
            let (piece, part) = (&self.pieces[piece as usize], part as usize);
            Some((piece, part, piece.height_at(part, point)?))
        })
    }

    /// The piece nearest to `point` within `reach_m`: its distance, and its height at the nearest place, metres.
    #[must_use]
    pub fn nearest(&self, point: Point, reach_m: f64, wanted: impl Fn(SurfaceKind) -> bool) -> Option<(f64, f64)> {
        self.nearest_of(point, reach_m, |piece, _, offer| {
            if wanted(self.pieces[piece as usize].surface) {
                offer(WHOLE);
            }
        })
    }

    /// The nearest of the shares of parts that `each` offers for each part within `reach_m`: its distance and its height there, metres.
    fn nearest_of(
        &self,
        point: Point,
        reach_m: f64,
        each: impl Fn(u32, u32, &mut dyn FnMut([f64; 2])),
    ) -> Option<(f64, f64)> {
        let mut found = Vec::new();
        self.index.near(&Bounds::about(point, reach_m), &mut found);
        let mut nearest: Option<(f64, f64)> = None;
        for entry in found {
            let (piece, part) = self.parts[entry as usize];
            each(piece, part, &mut |shares| {
                let (distance_m, height_m) = self.pieces[piece as usize].nearest(part as usize, shares, point);
                if distance_m <= reach_m && nearest.is_none_or(|(least, _)| distance_m < least) {
                    nearest = Some((distance_m, height_m));
                }
            });
        }
        nearest
    }
}

/// Numbers of junctions by id.
#[derive(Debug, Default)]
struct Junctions(BTreeMap<String, u32>);

impl Junctions {
    fn number(&mut self, id: &str) -> u32 {
        let next = self.0.len() as u32;
        *self.0.entry(id.to_owned()).or_insert(next)
    }

    /// Both ends of an edge; an edge within a junction is named ":JUNCTION_NUMBER".
    fn ends(&mut self, edge: &BytesStart<'_>) -> [u32; 2] {
        let id = attribute(edge, "id").unwrap_or_default();
        if let Some((junction, _)) = id.strip_prefix(':').and_then(|id| id.rsplit_once('_')) {
            return [self.number(junction); 2];
        }
        ["from", "to"].map(|end| attribute(edge, end).map_or(NO_JUNCTION, |id| self.number(&id)))
    }
}

fn lane(
    element: &BytesStart<'_>,
    function: &str,
    place: &ElementPosition<'_>,
) -> Result<Option<RoadPiece>, SceneError> {
    let width_m = match attribute(element, "width") {
        Some(text) => text
            .parse()
            .ok()
            .filter(|width: &f64| *width > 0.0)
            .ok_or_else(|| place.value("width", &text))?,
        None => DEFAULT_WIDTH_M,
    };
    let surface = SurfaceKind::of_lane(function, element);
    let half_width_m = (surface != SurfaceKind::WalkingArea).then_some(0.5 * width_m);
    piece(element, surface, half_width_m, place)
}

fn junction(element: &BytesStart<'_>, place: &ElementPosition<'_>) -> Result<Option<RoadPiece>, SceneError> {
    match attribute(element, "type").as_deref() {
        Some("internal" | "rail_signal" | "rail_crossing") => Ok(None),
        _ => piece(element, SurfaceKind::Junction, None, place),
    }
}

/// The piece of an element with a shape; `None` if it covers nothing.
fn piece(
    element: &BytesStart<'_>,
    surface: SurfaceKind,
    half_width_m: Option<f64>,
    place: &ElementPosition<'_>,
) -> Result<Option<RoadPiece>, SceneError> {
    let text = attribute(element, "shape").unwrap_or_default();
    let mut shape_m = points(&text, place)?;
    for point in &mut shape_m {
        point[2] = if point[2].is_nan() { 0.0 } else { point[2] };
    }
    if half_width_m.is_none() && shape_m.len() > 1 && shape_m.first() == shape_m.last() {
        shape_m.pop();
    }
    let least = if half_width_m.is_some() { 2 } else { 3 };
    Ok((shape_m.len() >= least).then(|| RoadPiece {
        id: attribute(element, "id").unwrap_or_default(),
        surface,
        shape_m,
        half_width_m,
        junctions: [NO_JUNCTION; 2],
    }))
}

/// Unit vector to the left of the segment a → b.
#[must_use]
pub(super) fn left_of(a: Point, b: Point) -> Point {
    let d = from_to(a, b);
    let length = dot(d, d).sqrt().max(f64::MIN_POSITIVE);
    [-d[1] / length, d[0] / length]
}
