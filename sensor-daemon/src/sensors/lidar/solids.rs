//! Static solids: buildings, props and slices of bridge decks as prisms, indexed by the cells of a grid.

use std::ops::Range;

use ipc_schema::{
    config,
    pointcloud::{GROUND, STATIC_OBJECT, Tag},
    props::{PROPS, PropClass, PropKind},
};
use sim_core::scene::{
    DeckSlice, Scene, Solid, SolidClass,
    shape::{Bounds, Point, distance, edges, from_to},
};

/// Size of a cell, metres.
const CELL_M: f64 = 64.0;
/// Most cells in a row or column.
const MOST_CELLS: f64 = 2048.0;
/// Bit in the word of an object that a LIDAR in interest mode keeps.
pub(in crate::sensors) const INTEREST: u32 = 1 << 15;
/// Word of a ray without a hit.
pub(in crate::sensors) const NOTHING: u32 = 0xFFFF;
/// Shorter walls are left out, metres.
const SHORTEST_M: f64 = 1e-6;

/// A prism: walls over an outline, a roof, an underside.
#[derive(Debug, Clone)]
pub(in crate::sensors) struct StillSolid {
    pub(in crate::sensors) object: u32,
    /// Tag, with [`INTEREST`] if the object is of interest.
    pub(in crate::sensors) word: u32,
    /// Lowest and highest point, metres.
    pub(in crate::sensors) z_m: [f64; 2],
    pub(in crate::sensors) walls: Range<u32>,
    pub(in crate::sensors) centre_m: Point,
    /// Radius of the circle about its outline, metres.
    pub(in crate::sensors) reach_m: f64,
}

/// A wall, from corner to corner counter-clockwise about its prism.
#[derive(Debug, Clone, Copy)]
pub(in crate::sensors) struct SolidWall {
    pub(in crate::sensors) p_m: Point,
    pub(in crate::sensors) q_m: Point,
    /// Outwards, length 1.
    pub(in crate::sensors) normal: Point,
}

/// All static solids of a scene.
#[derive(Debug, Clone, Default)]
pub(in crate::sensors) struct StillSolids {
    pub(in crate::sensors) stills: Vec<StillSolid>,
    pub(in crate::sensors) walls: Vec<SolidWall>,
    /// Centres and reaches of `stills`, for the test of distance.
    near: Vec<[f64; 3]>,
    min_m: Point,
    cell_m: f64,
    columns: usize,
    rows: usize,
    /// First of `stills` of each cell, and one past the last.
    starts: Vec<u32>,
    most_reach_m: f64,
}

/// A solid before it is indexed.
struct StillShape {
    object: u32,
    word: u32,
    outline_m: Vec<Point>,
    z_m: [f64; 2],
    bounds: Bounds,
}

impl StillShape {
    fn of_solid(number: u32, solid: &Solid<'_>, bounds: Bounds, interest: &[bool]) -> Self {
        let (outline_m, z_m, word) = match solid {
            Solid::Building(building) => (building.outline_m.clone(), building.z_m(), tag(building.class) as u32),
            Solid::Prop(prop) => {
                let kind = PROPS.iter().position(|kind| kind == prop.kind);
                let is_wanted = kind.is_some_and(|kind| interest[kind]);
                let word = prop_tag(prop.kind.class) as u32 | if is_wanted { INTEREST } else { 0 };
                (prop.body.corners().to_vec(), prop.body.z_m, word)
            }
        };
        Self {
            object: STATIC_OBJECT | number,
            word,
            outline_m,
            z_m,
            bounds,
        }
    }

    /// A deck is ground above ground.
    fn of_deck(deck: &DeckSlice) -> Self {
        Self {
            object: GROUND,
            word: Tag::Ground as u32,
            outline_m: deck.outline_m.to_vec(),
            z_m: deck.z_m,
            bounds: Bounds::of(deck.outline_m),
        }
    }
}

/// The wall between two corners; `None` if they coincide.
pub(in crate::sensors) fn wall(p_m: Point, q_m: Point) -> Option<SolidWall> {
    let length_m = distance(p_m, q_m);
    let [x, y] = from_to(p_m, q_m);
    (length_m > SHORTEST_M).then(|| SolidWall {
        p_m,
        q_m,
        normal: [y / length_m, -x / length_m],
    })
}

impl StillSolids {
    pub(in crate::sensors) fn new(lidar: &config::LidarConfig, scene: &Scene) -> Self {
        let interest = interest(lidar);
        let numbered = (0_u32..).zip(scene.bounds());
        let solids =
            numbered.map(|(number, bounds)| StillShape::of_solid(number, &scene.solid(number), bounds, &interest));
        let all: Vec<StillShape> = solids.chain(scene.decks().iter().map(StillShape::of_deck)).collect();
        let mut solids = Self::empty(&all);
        let mut order: Vec<(usize, usize)> = (0..all.len())
            .map(|i| (solids.cell(centre(&all[i].bounds)), i))
            .collect();
        order.sort_unstable();
        let mut starts = vec![0_u32; solids.columns * solids.rows + 1];
        for (cell, i) in order {
            starts[cell + 1] += 1;
            solids.add(&all[i]);
        }
        for cell in 1..starts.len() {
            starts[cell] += starts[cell - 1];
        }
        solids.starts = starts;
        solids
    }

    fn empty(all: &[StillShape]) -> Self {
        let whole = all.iter().fold(Bounds::EMPTY, |whole, one| {
            whole.with(one.bounds.min_m).with(one.bounds.max_m)
        });
        if all.is_empty() {
            return Self {
                cell_m: CELL_M,
                ..Self::default()
            };
        }
        let size = from_to(whole.min_m, whole.max_m);
        let cell_m = CELL_M.max(size[0].max(size[1]) / MOST_CELLS);
        let count = |length_m: f64| (length_m / cell_m) as usize + 1;
        Self {
            min_m: whole.min_m,
            cell_m,
            columns: count(size[0]),
            rows: count(size[1]),
            ..Self::default()
        }
    }

    fn place(&self, point: Point) -> [usize; 2] {
        let at = |axis: usize, count: usize| {
            (((point[axis] - self.min_m[axis]) / self.cell_m).max(0.0) as usize).min(count.saturating_sub(1))
        };
        [at(0, self.columns), at(1, self.rows)]
    }

    fn cell(&self, point: Point) -> usize {
        let [column, row] = self.place(point);
        row * self.columns + column
    }

    fn add(&mut self, shape: &StillShape) {
        let begin = self.walls.len() as u32;
        self.walls
            .extend(edges(&shape.outline_m).filter_map(|(p, q)| wall(p, q)));
        let centre_m = centre(&shape.bounds);
        let corners = shape.outline_m.iter();
        let reach_m = corners.map(|corner| distance(*corner, centre_m)).fold(0.0, f64::max);
        self.most_reach_m = self.most_reach_m.max(reach_m);
        self.near.push([centre_m[0], centre_m[1], reach_m]);
        self.stills.push(StillSolid {
            object: shape.object,
            word: shape.word,
            z_m: shape.z_m,
            walls: begin..self.walls.len() as u32,
            centre_m,
            reach_m,
        });
    }

    /// Calls `found` with the number and the distance of the centre of each solid that may be within `range_m` of `place`.
    #[inline(always)]
    pub(in crate::sensors) fn within(&self, place: Point, range_m: f64, mut found: impl FnMut(usize, f64)) {
        if self.stills.is_empty() {
            return;
        }
        let reach_m = range_m + self.most_reach_m;
        let [from, to] = [-reach_m, reach_m].map(|off_m| self.place([place[0] + off_m, place[1] + off_m]));
        for row in from[1]..=to[1] {
            let cells = row * self.columns + from[0]..row * self.columns + to[0] + 1;
            for number in self.starts[cells.start] as usize..self.starts[cells.end] as usize {
                let [x, y, reach_m] = self.near[number];
                let (x, y, far) = (x - place[0], y - place[1], range_m + reach_m);
                let square = x * x + y * y;
                if square < far * far {
                    found(number, square.sqrt());
                }
            }
        }
    }
}

fn centre(bounds: &Bounds) -> Point {
    [0, 1].map(|axis: usize| 0.5 * (bounds.min_m[axis] + bounds.max_m[axis]))
}

/// Whether each prop of the catalogue is of interest.
fn interest(lidar: &config::LidarConfig) -> Vec<bool> {
    let is_wanted = |prop: &PropKind| lidar.interest_props.iter().any(|wanted| wanted.0 == prop);
    PROPS.iter().map(is_wanted).collect()
}

fn tag(class: SolidClass) -> Tag {
    match class {
        SolidClass::Building => Tag::Building,
        SolidClass::Wall => Tag::Wall,
        SolidClass::Structure => Tag::Structure,
    }
}

fn prop_tag(class: PropClass) -> Tag {
    match class {
        PropClass::Barrier => Tag::Barrier,
        PropClass::Furniture => Tag::Furniture,
        PropClass::Pole => Tag::Pole,
        PropClass::Vegetation => Tag::Vegetation,
        PropClass::Vehicle => Tag::ParkedVehicle,
        PropClass::Load => Tag::Load,
    }
}
