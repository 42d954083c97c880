//! Classes of the ground, read from the net: carriageways, markings, stop lines, crossings, pavements, verges.
//!
//! They are painted once onto a grid of cells, of which only tiles with a road have memory. A pixel shows the class of its cell. A net
//! has no paint: markings are a plain reading of it, stated in docs/sensor-models.md.

use sim_core::scene::{
    RoadPiece, Scene, SurfaceKind,
    shape::{Bounds, Point, between, contains, distance, dot, from_to, share_along},
};

use super::labels::SemanticLabel;

/// Smallest cell, metres.
const CELL_M: f64 = 0.125;
/// Most cells that are painted: larger nets have larger cells.
const MOST_CELLS: f64 = 3.2e7;
/// Cells of a tile in a row and in a column.
const TILE: usize = 64;
/// Length of the rectangles along a piece, metres.
const BOX_M: f64 = 10.0;
/// Width of a line along a lane, metres.
const LINE_M: f64 = 0.12;
/// Dashes between two lanes and the gaps between them, metres (Germany's RMS-1, 1993, in towns).
const DASH_M: f64 = 3.0;
const GAP_M: f64 = 6.0;
/// Depth of a stop line and its distance from the end of the lane, metres (RMS-1).
const STOP_M: f64 = 0.5;
const STOP_BEFORE_M: f64 = 0.2;
/// Stripes of a crossing and the gaps between them, metres (RMS-1: 0.5 each).
const STRIPE_M: f64 = 0.5;

/// The classes of a map's ground.
#[derive(Debug, Clone)]
pub(super) struct GroundMap {
    min_m: Point,
    per_cell: f64,
    cell_m: f64,
    /// Tiles in a row and in a column.
    tiles: [usize; 2],
    /// Number of the memory of each tile; 0 = terrain.
    directory: Vec<u32>,
    cells: Vec<u8>,
}

impl GroundMap {
    pub(super) fn new(scene: &Scene) -> Self {
        let pieces = scene.road().pieces();
        let corners = pieces.iter().flat_map(|piece| piece.outline()).map(|[x, y, _]| [x, y]);
        let bounds = Bounds::of(corners);
        if pieces.is_empty() {
            return Self {
                min_m: [0.0; 2],
                per_cell: 1.0 / CELL_M,
                cell_m: CELL_M,
                tiles: [0; 2],
                directory: Vec::new(),
                cells: vec![SemanticLabel::Terrain as u8; TILE * TILE],
            };
        }
        let area_m2: f64 = pieces.iter().map(area_m2).sum();
        let size = from_to(bounds.min_m, bounds.max_m);
        // The directory has at most a quarter as many tiles as there may be cells.
        let by_size = (size[0] * size[1] / (0.25 * MOST_CELLS)).sqrt() / TILE as f64;
        let cell_m = CELL_M.max((area_m2 / MOST_CELLS).sqrt()).max(by_size);
        let tiles = size.map(|length_m| (length_m / (cell_m * TILE as f64)) as usize + 1);
        let mut map = Self {
            min_m: bounds.min_m,
            per_cell: 1.0 / cell_m,
            cell_m,
            tiles,
            directory: vec![0; tiles[0] * tiles[1]],
            cells: vec![SemanticLabel::Terrain as u8; TILE * TILE],
        };
        // What lies on top comes last.
        for kinds in [
            &[SurfaceKind::Verge][..],
            &[SurfaceKind::Track],
            &[SurfaceKind::Sidewalk, SurfaceKind::WalkingArea],
            &[SurfaceKind::Junction, SurfaceKind::Lane],
        ] {
            for piece in pieces.iter().filter(|piece| kinds.contains(&piece.surface)) {
                map.surface(piece);
            }
        }
        let ends = meeting_lanes(pieces);
        for (number, piece) in pieces.iter().enumerate() {
            match piece.surface {
                SurfaceKind::Crossing => map.crossing(piece),
                SurfaceKind::Lane if is_normal(piece) => map.markings(pieces, number, &ends),
                _ => {}
            }
        }
        map
    }

    /// Cell coordinates of a point of the world: (0, 0) is the corner of the first cell.
    #[inline(always)]
    pub(super) fn place(&self, [x, y]: Point) -> [f64; 2] {
        [(x - self.min_m[0]) * self.per_cell, (y - self.min_m[1]) * self.per_cell]
    }

    /// Cells in a metre.
    #[inline(always)]
    pub(super) fn cells_per_m(&self) -> f64 {
        self.per_cell
    }

    /// The class of a cell, a [`SemanticLabel`]; terrain beyond the net. Cells beyond it may have any number.
    #[inline(always)]
    pub(super) fn class(&self, column: u32, row: u32) -> u8 {
        let (column, row) = (column as usize, row as usize);
        let (tile_x, tile_y) = (column / TILE, row / TILE);
        if tile_x >= self.tiles[0] || tile_y >= self.tiles[1] {
            return SemanticLabel::Terrain as u8;
        }
        let tile = self.directory[tile_y * self.tiles[0] + tile_x] as usize;
        self.cells[(tile * TILE + row % TILE) * TILE + column % TILE]
    }

    fn paint(&mut self, column: usize, row: usize, class: u8) {
        let directory = &mut self.directory[row / TILE * self.tiles[0] + column / TILE];
        if *directory == 0 {
            *directory = (self.cells.len() / (TILE * TILE)) as u32;
            self.cells
                .resize(self.cells.len() + TILE * TILE, SemanticLabel::Terrain as u8);
        }
        self.cells[(*directory as usize * TILE + row % TILE) * TILE + column % TILE] = class;
    }

    /// Paints the cells within `bounds` whose centres are `wanted`.
    fn cells_in(&mut self, bounds: &Bounds, class: SemanticLabel, wanted: impl Fn(Point) -> bool) {
        let [low, high] = [bounds.min_m, bounds.max_m].map(|corner| self.place(corner));
        let most = self.tiles.map(|tiles| tiles * TILE);
        let span = |axis: usize| low[axis].max(0.0) as usize..((high[axis].max(0.0) as usize) + 1).min(most[axis]);
        for row in span(1) {
            for column in span(0) {
                let centre = [
                    self.min_m[0] + (column as f64 + 0.5) * self.cell_m,
                    self.min_m[1] + (row as f64 + 0.5) * self.cell_m,
                ];
                if wanted(centre) {
                    self.paint(column, row, class as u8);
                }
            }
        }
    }

    fn surface(&mut self, piece: &RoadPiece) {
        let class = match piece.surface {
            SurfaceKind::Lane | SurfaceKind::Junction | SurfaceKind::Crossing => SemanticLabel::Road,
            SurfaceKind::WalkingArea | SurfaceKind::Sidewalk => SemanticLabel::Sidewalk,
            SurfaceKind::Track => SemanticLabel::RailTrack,
            SurfaceKind::Verge => SemanticLabel::Terrain,
        };
        let Some(half_m) = piece.half_width_m else {
            let outline: Vec<Point> = piece.shape_m.iter().map(flat).collect();
            self.cells_in(&Bounds::of(outline.iter().copied()), class, |at| contains(&outline, at));
            return;
        };
        for ends in piece.shape_m.windows(2) {
            let [a, b] = [flat(&ends[0]), flat(&ends[1])];
            for bounds in boxes_along(a, b, half_m) {
                self.cells_in(&bounds, class, |at| {
                    distance(between(a, b, share_along(a, b, at).clamp(0.0, 1.0)), at) <= half_m
                });
            }
        }
    }

    /// The stripes of a crossing run along the road, across its own direction.
    fn crossing(&mut self, piece: &RoadPiece) {
        let Some(half_m) = piece.half_width_m else { return };
        let mut before_m = 0.0;
        for ends in piece.shape_m.windows(2) {
            let [a, b] = [flat(&ends[0]), flat(&ends[1])];
            let length_m = distance(a, b);
            self.strip([a, b], [-half_m, half_m], SemanticLabel::Crossing, |along_m| {
                (before_m + along_m) % (2.0 * STRIPE_M) >= STRIPE_M
            });
            before_m += length_m;
        }
    }

    /// Paints the part of a straight piece between two offsets to its left, where `wanted` holds of the distance along it.
    fn strip(&mut self, [a, b]: [Point; 2], left_m: [f64; 2], class: SemanticLabel, wanted: impl Fn(f64) -> bool) {
        let along = from_to(a, b);
        let length_m = dot(along, along).sqrt();
        if length_m == 0.0 {
            return;
        }
        let [x, y] = along.map(|part| part / length_m);
        let reach_m = left_m[0].abs().max(left_m[1].abs());
        for bounds in boxes_along(a, b, reach_m) {
            self.cells_in(&bounds, class, |at| {
                let off = from_to(a, at);
                let (ahead, left) = (off[0] * x + off[1] * y, off[1] * x - off[0] * y);
                (0.0..=length_m).contains(&ahead) && (left_m[0]..=left_m[1]).contains(&left) && wanted(ahead)
            });
        }
    }

    /// Lines on both sides of a lane, dashed towards a neighbour of the same edge, and a stop line where lanes of three edges meet.
    fn markings(&mut self, pieces: &[RoadPiece], number: usize, meeting: &[u32]) {
        let piece = &pieces[number];
        let Some(half_m) = piece.half_width_m else { return };
        let is_beside = |other: Option<&RoadPiece>| {
            other.is_some_and(|other| other.surface == SurfaceKind::Lane && edge_of(&other.id) == edge_of(&piece.id))
        };
        let (has_right, has_left) = (
            is_beside(number.checked_sub(1).and_then(|before| pieces.get(before))),
            is_beside(pieces.get(number + 1)),
        );
        let mut before_m = 0.0;
        for ends in piece.shape_m.windows(2) {
            let line = [flat(&ends[0]), flat(&ends[1])];
            let is_dash = |along_m: f64| (before_m + along_m) % (DASH_M + GAP_M) < DASH_M;
            let half_line_m = 0.5 * LINE_M;
            for (at_m, is_dashed) in [(-half_m, has_right), (half_m, has_left)] {
                // A line between two lanes lies on both; one at the edge lies within the lane.
                let inner_m = if is_dashed { 0.0 } else { half_line_m * at_m.signum() };
                let across = [at_m - inner_m - half_line_m, at_m - inner_m + half_line_m];
                self.strip(line, across, SemanticLabel::LaneMarking, |along_m| {
                    !is_dashed || is_dash(along_m)
                });
            }
            before_m += distance(line[0], line[1]);
        }
        let [.., a, b] = piece.shape_m.as_slice() else { return };
        let (a, b) = (flat(a), flat(b));
        let length_m = distance(a, b);
        let is_met = meeting
            .get(piece.junctions[1] as usize)
            .is_some_and(|edges| *edges >= 3);
        if is_met && length_m > STOP_M + STOP_BEFORE_M {
            self.strip([a, b], [-half_m, half_m], SemanticLabel::StopLine, |along_m| {
                (STOP_BEFORE_M..STOP_BEFORE_M + STOP_M).contains(&(length_m - along_m))
            });
        }
    }
}

/// Rectangles that cover a straight piece and what is within `reach_m` of it: short ones, because a slanted piece fills little of its own.
fn boxes_along(a: Point, b: Point, reach_m: f64) -> impl Iterator<Item = Bounds> {
    let count = (distance(a, b) / BOX_M).ceil().max(1.0) as u32;
    let at = move |part: u32| between(a, b, f64::from(part) / f64::from(count));
    (0..count).map(move |part| Bounds::of([at(part), at(part + 1)]).grown(reach_m))
}

fn flat([x, y, _]: &[f64; 3]) -> Point {
    [*x, *y]
}

/// True for a lane of an edge, false within a junction.
fn is_normal(piece: &RoadPiece) -> bool {
    !piece.id.starts_with(':')
}

/// The edge of a lane, from its id.
fn edge_of(lane: &str) -> &str {
    lane.rsplit_once('_').map_or(lane, |(edge, _)| edge)
}

/// Number of edges with road lanes that end at each junction.
fn meeting_lanes(pieces: &[RoadPiece]) -> Vec<u32> {
    let (mut edges, mut last) = (Vec::new(), "");
    let lanes = pieces
        .iter()
        .filter(|piece| piece.surface == SurfaceKind::Lane && is_normal(piece));
    for piece in lanes {
        let edge = edge_of(&piece.id);
        let junction = piece.junctions[1];
        if junction == sim_core::scene::NO_JUNCTION || edge == last {
            continue;
        }
        last = edge;
        if edges.len() <= junction as usize {
            edges.resize(junction as usize + 1, 0);
        }
        edges[junction as usize] += 1;
    }
    edges
}

fn area_m2(piece: &RoadPiece) -> f64 {
    let shape: Vec<Point> = piece.shape_m.iter().map(flat).collect();
    match piece.half_width_m {
        Some(half_m) => shape
            .windows(2)
            .map(|ends| distance(ends[0], ends[1]) * 2.0 * half_m)
            .sum(),
        None => sim_core::scene::shape::signed_area(&shape).abs(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sim_core::scene::Road;

    fn lane(id: &str, y: f64, surface: SurfaceKind) -> RoadPiece {
        RoadPiece {
            id: id.into(),
            surface,
            shape_m: vec![[0.0, y, 0.0], [100.0, y, 0.0]],
            half_width_m: Some(1.6),
            junctions: [0, 1],
        }
    }

    fn class(map: &GroundMap, x: f64, y: f64) -> u8 {
        let [column, row] = map.place([x, y]);
        map.class(column as u32, row as u32)
    }

    #[test]
    fn lanes_have_lines_dashes_and_pavements() {
        use SemanticLabel::{LaneMarking, Road as Carriageway, Sidewalk, StopLine, Terrain};
        let pieces = vec![
            lane("pavement_0", -3.2, SurfaceKind::Sidewalk),
            lane("road_0", 0.0, SurfaceKind::Lane),
            lane("road_1", 3.2, SurfaceKind::Lane),
            lane("north_0", 40.0, SurfaceKind::Lane),
            lane("south_0", -40.0, SurfaceKind::Lane),
        ];
        let map = GroundMap::new(&Scene::new(Road::new(pieces), Vec::new(), Vec::new()));
        for (x, y, expected) in [
            (50.0, 0.0, Carriageway),
            (50.0, -3.0, Sidewalk),
            (50.0, 20.0, Terrain),
            (1.5, 1.6, LaneMarking),
            (5.0, 1.6, Carriageway),
            (10.0, 1.6, LaneMarking),
            (51.0, -1.52, LaneMarking),
            (55.0, 4.72, LaneMarking),
            (99.5, 0.0, StopLine),
            (98.0, 0.0, Carriageway),
        ] {
            assert_eq!(class(&map, x, y), expected as u8, "({x}, {y})");
        }
        assert_eq!(map.class(u32::MAX, 7), Terrain as u8, "beyond the net");
    }

    #[test]
    fn a_net_of_half_a_continent_has_larger_cells() {
        let mut far = lane("far_0", 0.0, SurfaceKind::Lane);
        far.shape_m = (0..100)
            .map(|i| [f64::from(i) * 5000.0, f64::from(i % 7) * 9e3, 0.0])
            .collect();
        let map = GroundMap::new(&Scene::new(Road::new(vec![far]), Vec::new(), Vec::new()));
        assert!(map.cell_m > CELL_M);
        assert!(map.directory.len() < 20_000_000, "{}", map.directory.len());
    }
}
