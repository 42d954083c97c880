//! The ground of a net with elevation, for sensors whose columns are planes.
//!
//! The plane of a column cuts the triangles of the ground in a line, which is followed from triangle to triangle, sixteen columns at a
//! time. The triangles are those of a lattice: across the edge from `R` to `L` lies the corner `R + (e.x + e.y, −e.x)` with `e = L − R`,
//! whatever the edge. Its side of the plane says which of its two edges the line crosses next. Sides belong to corners, so that neighbours
//! agree and the line never breaks.
//!
//! In the plane the line is a profile. A ray meets the first segment that comes above it, and the lasers of a column, from the lowest up,
//! meet it farther and farther out: one walk along the profile serves them all, as in the algorithms of the horizon over height fields.

use super::{
    mesh::GroundGrid,
    raster::{CHUNKS, ColumnChunk, LinearValue, ScanCanvas, set, splat2},
    sensor::SensorPose,
    simd::{Floats, Simd, WIDTH},
};

/// Least cosine of the lean of a sensor's axis: with more, the line might come back under the sensor.
const LEAST_UP: f64 = 0.5;
/// Corners around the place below the sensor, counter-clockwise.
const RING: [[f32; 2]; 8] = [
    [1.0, -1.0],
    [1.0, 0.0],
    [1.0, 1.0],
    [0.0, 1.0],
    [-1.0, 1.0],
    [-1.0, 0.0],
    [-1.0, -1.0],
    [0.0, -1.0],
];

/// Heights at the corners of the lattice. Beyond its edges the ground is as high as at the edge; nothing there is hit.
#[derive(Debug)]
pub(super) struct Terrain {
    grid: GroundGrid,
    /// Middle of all heights, metres.
    base_m: f64,
    /// Heights above `base_m`, row by row.
    heights: Vec<f32>,
}

/// The ground as a sensor sees it during a span.
#[derive(Debug, Clone, Copy)]
pub(super) struct TerrainView {
    /// Column and row of the corner nearest to the place below the sensor.
    centre: [i32; 2],
    /// That corner, with the height `base_m`, relative to the sensor.
    origin: [LinearValue; 3],
}

/// A segment of the profile of sixteen columns.
#[derive(Debug, Clone, Copy)]
pub(super) struct ProfileSegment {
    /// Tangent of the highest elevation at which the ground is seen as far as the end of the segment.
    tangent: Floats,
    /// Height of the triangle's plane above the sensor, metres, and its slopes along x and y.
    height: Floats,
    slope: [Floats; 2],
}

/// The profiles of a span.
#[derive(Debug, Default)]
pub(super) struct GroundProfile {
    /// From behind the sensor outwards; those of a chunk are [`CHUNKS`] apart.
    segments: Vec<[ProfileSegment; CHUNKS]>,
    /// Of each chunk: the first of its segments that are new, one past its last one, and how far they reach.
    from: [usize; CHUNKS],
    to: [usize; CHUNKS],
    reached: [f32; CHUNKS],
    edges: [WalkEdge; CHUNKS],
}

/// The edge that the line crosses last.
#[derive(Debug, Clone, Copy)]
struct WalkEdge {
    /// Left and right.
    corners: [WalkCorner; 2],
    tangent: Floats,
}

/// A corner in memory.
#[derive(Debug, Clone, Copy)]
struct WalkCorner([Floats; 6]);

impl ProfileSegment {
    const ZERO: Self = Self {
        tangent: Floats::ZERO,
        height: Floats::ZERO,
        slope: [Floats::ZERO; 2],
    };
}

impl Default for WalkEdge {
    fn default() -> Self {
        Self {
            corners: [WalkCorner([Floats::ZERO; 6]); 2],
            tangent: Floats::ZERO,
        }
    }
}

/// The planes that sixteen rays of a column meet: a ray that meets none has a level plane at the sensor's own height.
#[derive(Clone, Copy)]
pub(super) struct MetPlanes<S: Simd> {
    pub(super) height: S::F,
    pub(super) slope: [S::F; 2],
}

impl GroundProfile {
    /// Whether a chunk has new segments.
    #[inline(always)]
    pub(super) fn is_new(&self, chunk: usize) -> bool {
        self.from[chunk] < self.to[chunk]
    }

    /// The first new segment of a chunk.
    #[inline(always)]
    pub(super) fn first(&self, chunk: usize) -> usize {
        self.from[chunk]
    }

    /// The planes that the rays of these tangents meet in a column on segments from `next` on, `None` if there are none. `next` becomes the
    /// last segment that is looked at: the rays of the next group have larger tangents.
    #[inline(always)]
    pub(super) fn meet<S: Simd>(
        &self,
        (chunk, element): (usize, usize),
        next: &mut usize,
        tangent: S::F,
        live: u32,
    ) -> Option<MetPlanes<S>> {
        let zero = S::splat(0.0);
        let (mut height, mut x, mut y) = (zero, zero, zero);
        let horizon = |end: usize| match end.checked_sub(1) {
            Some(last) => self.segments[last][chunk].tangent.0[element],
            None => f32::NEG_INFINITY,
        };
        let unmet = S::lt(S::splat(horizon(self.from[chunk])), tangent);
        let meets = S::le(tangent, S::splat(horizon(self.to[chunk])));
        let mut open = S::both(S::mask(live), S::both(unmet, meets));
        if S::bits(open) == 0 {
            return None;
        }
        while S::bits(open) != 0 {
            let segment = &self.segments[*next][chunk];
            let met = S::both(S::le(tangent, S::splat(segment.tangent.0[element])), open);
            open = S::differ(open, met);
            height = S::select(met, S::splat(segment.height.0[element]), height);
            x = S::select(met, S::splat(segment.slope[0].0[element]), x);
            y = S::select(met, S::splat(segment.slope[1].0[element]), y);
            *next += 1;
        }
        *next = next.saturating_sub(1).max(self.from[chunk]);
        Some(MetPlanes { height, slope: [x, y] })
    }
}

/// A corner in sixteen columns: place in the lattice from the centre, height above the sensor, and its distance to the left of the
/// plane, ahead and up.
#[derive(Clone, Copy)]
struct Corner<S: Simd> {
    at: [S::F; 2],
    z: S::F,
    left: S::F,
    ahead: S::F,
    up: S::F,
}

impl Terrain {
    /// `None` if the ground has no triangle.
    pub(super) fn new(grid: GroundGrid) -> Option<Self> {
        let heights_m = grid.heights_m();
        if grid.corners.iter().any(|corners| *corners < 2) {
            return None;
        }
        let least_m = heights_m.iter().copied().fold(f64::INFINITY, f64::min);
        let most_m = heights_m.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let base_m = f64::midpoint(least_m, most_m);
        let heights = heights_m.iter().map(|height_m| (height_m - base_m) as f32).collect();
        Some(Self { grid, base_m, heights })
    }

    /// The ground around a sensor that has these poses at both ends of a span; `None` if the sensor leans too far.
    pub(super) fn view(&self, sensors: &[SensorPose; 2]) -> Option<TerrainView> {
        if sensors.iter().any(|sensor| sensor.world_from_sensor[2][2] < LEAST_UP) {
            return None;
        }
        let [first, last] = sensors;
        let below = self.below(first);
        let centre = [0, 1].map(|axis: usize| {
            let place = (below[axis] - self.grid.min_m[axis]) / self.grid.cell_m;
            // Far from the map, any corner serves: nothing is hit.
            place.round().clamp(-1e6, 1e6) as i32
        });
        let relative = |axis: usize| {
            let corner_m = match axis {
                2 => self.base_m,
                _ => self.grid.min_m[axis] + f64::from(centre[axis]) * self.grid.cell_m,
            };
            LinearValue::between(corner_m - first.position_m[axis], corner_m - last.position_m[axis])
        };
        Some(TerrainView {
            centre,
            origin: [0, 1, 2].map(relative),
        })
    }

    /// Where the sensor's own axis meets the ground.
    fn below(&self, sensor: &SensorPose) -> [f64; 2] {
        let [x, y, z] = sensor.position_m;
        let up = [0, 1, 2].map(|axis: usize| sensor.world_from_sensor[axis][2]);
        let mut below = [x, y];
        for _ in 0..4 {
            let [column, row] = [0, 1].map(|axis: usize| {
                let place = ((below[axis] - self.grid.min_m[axis]) / self.grid.cell_m).round();
                place.clamp(0.0, (self.grid.corners[axis] - 1) as f64) as usize
            });
            let along = (z - self.grid.corner(column, row)[2]) / up[2];
            below = [x - along * up[0], y - along * up[1]];
        }
        below
    }

    /// Heights of the ring about a corner.
    #[inline(always)]
    fn ring(&self, centre: [i32; 2]) -> [f32; RING.len()] {
        let within = |axis: usize, at: f32| {
            let place = centre[axis] + at as i32;
            place.clamp(0, self.grid.corners[axis] as i32 - 1) as usize
        };
        RING.map(|[x, y]| self.heights[within(1, y) * self.grid.corners[0] + within(0, x)])
    }

    /// Begins the profiles of the columns of a span behind the sensor.
    #[inline(always)]
    pub(super) fn enter<S: Simd>(&self, view: &TerrainView, canvas: &ScanCanvas, profile: &mut GroundProfile) {
        let ring = self.ring(view.centre);
        for (edge, columns) in profile.edges.iter_mut().zip(&canvas.columns[..canvas.chunks()]) {
            let (left, right) = Walk::<S>::new(self, view, columns).entry(&ring);
            left.store(&mut edge.corners[0]);
            right.store(&mut edge.corners[1]);
            edge.tangent = Floats([f32::NEG_INFINITY; WIDTH]);
        }
        (profile.from, profile.to) = ([0; CHUNKS], [0; CHUNKS]);
        profile.reached = [0.0; CHUNKS];
    }

    /// Continues the profiles, those of each chunk as far as its `reach`.
    #[inline(always)]
    pub(super) fn follow<S: Simd>(
        &self,
        view: &TerrainView,
        canvas: &ScanCanvas,
        reach: [f32; CHUNKS],
        profile: &mut GroundProfile,
    ) {
        profile.from = profile.to;
        // A straight line crosses 2 √2 edges a cell at most; where the plane leans, it winds a little.
        let farthest = reach.into_iter().fold(0.0_f32, f32::max);
        let most = (4.0 * f64::from(farthest) / self.grid.cell_m) as usize + 64;
        if profile.segments.len() < most {
            profile.segments.resize(most, [ProfileSegment::ZERO; CHUNKS]);
        }
        let mut walking = 0_u32;
        let chunks = profile.reached.iter_mut().zip(&reach).take(canvas.chunks());
        for (chunk, (reached, reach)) in chunks.enumerate() {
            walking |= u32::from(*reached < *reach) << chunk;
            *reached = reached.max(*reach);
        }
        let [first, second, third, fourth] = &canvas.columns;
        let walks: [Walk<'_, S>; CHUNKS] = [
            Walk::new(self, view, first),
            Walk::new(self, view, second),
            Walk::new(self, view, third),
            Walk::new(self, view, fourth),
        ];
        let live = [canvas.live(0), canvas.live(1), canvas.live(2), canvas.live(3)];
        // Chunk by chunk within a step: the corners of a chunk depend on each other, those of different chunks do not.
        while walking != 0 {
            for chunk in set(walking) {
                let segment = &mut profile.segments[profile.to[chunk]][chunk];
                let ahead = walks[chunk].step(&mut profile.edges[chunk], segment);
                profile.to[chunk] += 1;
                let is_short = S::bits(S::lt(ahead, S::splat(reach[chunk]))) & live[chunk] != 0;
                if !is_short || profile.to[chunk] == most {
                    walking &= !(1 << chunk);
                }
            }
        }
    }

    /// The lattice's ends along x and y, relative to the sensor at a share of the span. No closure: see `raster::at2`.
    #[inline(always)]
    pub(super) fn ends<S: Simd>(&self, view: &TerrainView, share: f32) -> [[S::F; 2]; 2] {
        [
            self.ends_along::<S>(0, view, share),
            self.ends_along::<S>(1, view, share),
        ]
    }

    #[inline(always)]
    fn ends_along<S: Simd>(&self, axis: usize, view: &TerrainView, share: f32) -> [S::F; 2] {
        let origin = view.origin[axis].0 + share * view.origin[axis].1;
        let low = origin - view.centre[axis] as f32 * self.grid.cell_m as f32;
        let high = low + (self.grid.corners[axis] - 1) as f32 * self.grid.cell_m as f32;
        [S::splat(low), S::splat(high)]
    }
}

/// Whether places are between these ends.
#[inline(always)]
pub(super) fn between<S: Simd>(ends: &[[S::F; 2]; 2], place: [S::F; 2]) -> S::M {
    let [[left, right], [low, high]] = *ends;
    S::both(
        S::both(S::le(left, place[0]), S::le(place[0], right)),
        S::both(S::le(low, place[1]), S::le(place[1], high)),
    )
}

impl<S: Simd> Corner<S> {
    #[inline(always)]
    fn load(from: &WalkCorner) -> Self {
        let [x, y, z, left, ahead, up] = &from.0;
        Self {
            at: [S::load(x), S::load(y)],
            z: S::load(z),
            left: S::load(left),
            ahead: S::load(ahead),
            up: S::load(up),
        }
    }

    #[inline(always)]
    fn store(&self, to: &mut WalkCorner) {
        let [x, y, z, left, ahead, up] = &mut to.0;
        S::store(self.at[0], x);
        S::store(self.at[1], y);
        S::store(self.z, z);
        S::store(self.left, left);
        S::store(self.ahead, ahead);
        S::store(self.up, up);
    }

    /// `mask ? yes : no`
    #[inline(always)]
    fn select(mask: S::M, yes: &Self, no: &Self) -> Self {
        Self {
            at: [
                S::select(mask, yes.at[0], no.at[0]),
                S::select(mask, yes.at[1], no.at[1]),
            ],
            z: S::select(mask, yes.z, no.z),
            left: S::select(mask, yes.left, no.left),
            ahead: S::select(mask, yes.ahead, no.ahead),
            up: S::select(mask, yes.up, no.up),
        }
    }
}

/// What sixteen columns share along the way.
struct Walk<'a, S: Simd> {
    heights: &'a [f32],
    /// Place of the centre relative to the sensor.
    origin: [S::F; 3],
    axes: [[S::F; 3]; 3],
    cell: S::F,
    per_cell: S::F,
    /// First and last column and row, from the centre.
    least: [S::F; 2],
    most: [S::F; 2],
    /// Corners in a row, and number of the centre among all corners, plus 2²³.
    stride: S::F,
    first: S::F,
}

#[inline(always)]
fn load3<S: Simd>(from: &[Floats; 3]) -> [S::F; 3] {
    [S::load(&from[0]), S::load(&from[1]), S::load(&from[2])]
}

impl<'a, S: Simd> Walk<'a, S> {
    #[inline(always)]
    fn new(terrain: &'a Terrain, view: &TerrainView, chunk: &ColumnChunk) -> Self {
        let share = S::load(&chunk.share);
        let ([x, y], [columns, rows]) = (view.centre, terrain.grid.corners);
        Self {
            heights: &terrain.heights,
            origin: [
                view.origin[0].at::<S>(share),
                view.origin[1].at::<S>(share),
                view.origin[2].at::<S>(share),
            ],
            axes: [
                load3::<S>(&chunk.axes[0]),
                load3::<S>(&chunk.axes[1]),
                load3::<S>(&chunk.axes[2]),
            ],
            cell: S::splat(terrain.grid.cell_m as f32),
            per_cell: S::splat((1.0 / terrain.grid.cell_m) as f32),
            least: [S::splat(-x as f32), S::splat(-y as f32)],
            most: [
                S::splat((columns as i32 - 1 - x) as f32),
                S::splat((rows as i32 - 1 - y) as f32),
            ],
            stride: S::splat(columns as f32),
            first: S::splat((y * columns as i32 + x) as f32 + 8_388_608.0),
        }
    }

    #[inline(always)]
    fn place(&self, at: [S::F; 2]) -> [S::F; 2] {
        [self.origin[0] + at[0] * self.cell, self.origin[1] + at[1] * self.cell]
    }

    #[inline(always)]
    fn corner(&self, at: [S::F; 2]) -> Corner<S> {
        let [column, row] = [
            S::min(S::max(at[0], self.least[0]), self.most[0]),
            S::min(S::max(at[1], self.least[1]), self.most[1]),
        ];
        // Numbers below 2²³ are exact in f32, and are the lowest bits of their sum with 2²³, which is in `first`.
        let number = row * self.stride + column + self.first;
        let number = S::and(S::words(number), S::splat_words(0x007F_FFFF));
        let z = self.origin[2] + S::gather(self.heights, number);
        self.seen(at, z)
    }

    #[inline(always)]
    fn seen(&self, at: [S::F; 2], z: S::F) -> Corner<S> {
        let [x, y] = self.place(at);
        let [ahead, left, up] = &self.axes;
        Corner {
            at,
            z,
            left: left[0] * x + left[1] * y + left[2] * z,
            ahead: ahead[0] * x + ahead[1] * y + ahead[2] * z,
            up: up[0] * x + up[1] * y + up[2] * z,
        }
    }

    /// Crosses the next triangle: fills its segment, and returns how far ahead the line has come.
    #[inline(always)]
    fn step(&self, edge: &mut WalkEdge, segment: &mut ProfileSegment) -> S::F {
        let [left, right] = [Corner::<S>::load(&edge.corners[0]), Corner::<S>::load(&edge.corners[1])];
        let [along_x, along_y] = [left.at[0] - right.at[0], left.at[1] - right.at[1]];
        let across = along_x + along_y;
        let next = self.corner([right.at[0] + across, right.at[1] - along_x]);
        // Slopes of the triangle from two of its edges, whose lattice vectors have the determinant −1.
        let (along, aside) = (left.z - right.z, next.z - right.z);
        let slope = [
            (along_y * aside + along_x * along) * self.per_cell,
            (across * along - along_x * aside) * self.per_cell,
        ];
        let [x, y] = self.place(right.at);
        let height = right.z - slope[0] * x - slope[1] * y;
        let zero = S::splat(0.0);
        let is_left = S::le(zero, next.left);
        let left = Corner::select(is_left, &next, &left);
        let right = Corner::select(is_left, &right, &next);
        let share = left.left / (left.left - right.left);
        let ahead = left.ahead + share * (right.ahead - left.ahead);
        let up = left.up + share * (right.up - left.up);
        let highest = S::load(&edge.tangent);
        let tangent = S::select(S::lt(zero, ahead), S::max(up / ahead, highest), highest);
        left.store(&mut edge.corners[0]);
        right.store(&mut edge.corners[1]);
        S::store(tangent, &mut edge.tangent);
        S::store(tangent, &mut segment.tangent);
        S::store(height, &mut segment.height);
        S::store(slope[0], &mut segment.slope[0]);
        S::store(slope[1], &mut segment.slope[1]);
        ahead
    }

    /// The edge of the ring by which the line comes in, behind the sensor: its left and its right corner.
    #[inline(always)]
    fn entry(&self, heights: &[f32; RING.len()]) -> (Corner<S>, Corner<S>) {
        let zero = S::splat(0.0);
        let last = RING.len() - 1;
        let mut before = self.seen(splat2::<S>(RING[last]), self.origin[2] + S::splat(heights[last]));
        let (mut left, mut right) = (before, before);
        for (place, height) in RING.into_iter().zip(heights) {
            let corner = self.seen(splat2::<S>(place), self.origin[2] + S::splat(*height));
            let enters = S::both(S::le(zero, before.left), S::lt(corner.left, zero));
            (left, right) = (
                Corner::select(enters, &before, &left),
                Corner::select(enters, &corner, &right),
            );
            before = corner;
        }
        (left, right)
    }
}
