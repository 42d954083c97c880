//! The kernel: finds the surface that each pixel sees first.
//!
//! Every surface is a convex polygon or an upright cylinder, in the camera's frame: x along the optical axis, y left, z up. The ray of a
//! pixel is `(1, a, b)`, so its parameter is the depth. For a polygon with the corners `P`, the half-planes `(P[i+1] × P[i]) · ray ≥ 0`
//! and the inverse depth `n · ray / n · P` are linear in `a` and `b`, and hold for corners behind the camera too (M. Olano and T. Greer,
//! *Triangle Scan Conversion using 2D Homogeneous Coordinates*, Graphics Hardware 1997): nothing is clipped, and the depth of a pixel
//! costs no division. Two polygons test their common edge by the same numbers with opposite sign, so no ray slips through between them.
//!
//! The image is a grid of tiles of sixteen columns and eight rows. Surfaces come nearest first, and a tile remembers its farthest pixel:
//! most hidden surfaces are refused tile by tile (N. Greene, M. Kass and G. Miller, *Hierarchical Z-Buffer Visibility*, SIGGRAPH 1993).

use std::{ops::Range, sync::Arc};

use crate::sensors::lidar::simd::{Floats, Simd, WIDTH, Words};

/// Rows of a tile.
pub(super) const TILE_ROWS: usize = 8;
/// Surface of a pixel that sees the ground.
pub(super) const GROUND_SURFACE: u32 = 0;
/// Surface of a pixel that sees the sky.
pub(super) const SKY_SURFACE: u32 = 1;
/// Rounding of the linear functions, relative to the sum of the sizes of their terms.
const ROUNDING: f32 = 1e-6;

/// A function that is linear over the image: its value is `of[0] + a · of[1] + b · of[2]`.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LinearForm(pub(super) [f32; 3]);

/// A part of the image, in tiles: first and last column, first and last row.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TileRange {
    pub(super) x: [u16; 2],
    pub(super) y: [u16; 2],
}

/// A surface to draw.
#[derive(Debug, Clone, Copy)]
pub(super) struct DrawItem {
    pub(super) shape: DrawShape,
    pub(super) tiles: TileRange,
    /// Upper bound of its inverse depth, 1/m.
    pub(super) most: f32,
    /// Number in the table of surfaces.
    pub(super) surface: u32,
}

/// Shape of a surface.
#[derive(Debug, Clone, Copy)]
pub(super) enum DrawShape {
    /// Inverse depth, and the first and one past the last of its edges.
    Polygon(LinearForm, [u32; 2]),
    /// An upright cylinder, by its number.
    Cylinder(u32),
}

/// An upright cylinder relative to the camera, in world axes. Mantle and top have a surface each: the top's number is the next one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cylinder {
    pub(super) centre_m: [f32; 2],
    pub(super) radius_m: f32,
    /// Lowest and highest point.
    pub(super) z_m: [f32; 2],
}

/// An image while it is drawn.
#[derive(Debug, Default)]
pub(super) struct Canvas {
    /// Tiles in a row and in a column.
    pub(super) tiles: [usize; 2],
    /// Inverse depth, 1/m, and number of the surface: by row of pixels, then sixteen columns each.
    pub(super) inverse: Vec<Floats>,
    pub(super) surface: Vec<Words>,
    /// Farthest pixel of each tile.
    least: Vec<f32>,
    /// `a` of the columns, by sixteen, and its bounds.
    pub(super) a: Vec<Floats>,
    a_bounds: Vec<[f32; 2]>,
    /// `b` of the rows, and its bounds in each row of tiles.
    pub(super) b: Vec<f32>,
    b_bounds: Vec<[f32; 2]>,
    /// Columns, rows and focal length that it has room for.
    pub(super) room: (usize, usize, f64),
    /// The rays of a lens that bends them, in place of `a` and `b`.
    pub(super) bent: Option<Arc<BentRays>>,
}

/// The rays of an image with lens distortion: a pair of slopes for each pixel. Surfaces are linear in these as in those of a pinhole, so
/// the kernel finds what each ray hits, not what a pinhole's pixel nearby shows.
#[derive(Debug)]
pub(super) struct BentRays {
    /// `a` and `b` by row of pixels, then sixteen columns each.
    slopes: Vec<[Floats; 2]>,
    /// Least and largest `a` and `b` of each tile.
    bounds: Vec<[[f32; 2]; 2]>,
    /// Those of each column of tiles and of each row of tiles.
    column_bounds: Vec<[f32; 2]>,
    pub(super) row_bounds: Vec<[f32; 2]>,
}

impl BentRays {
    /// From the slopes of each pixel, by column and row.
    pub(super) fn new([tiles_x, tiles_y]: [usize; 2], slope: impl Fn(usize, usize) -> [f32; 2]) -> Self {
        let none = [f32::INFINITY, f32::NEG_INFINITY];
        let mut rays = Self {
            slopes: vec![[Floats::ZERO; 2]; tiles_x * tiles_y * TILE_ROWS],
            bounds: vec![[none; 2]; tiles_x * tiles_y],
            column_bounds: vec![none; tiles_x],
            row_bounds: vec![none; tiles_y],
        };
        let widen = |[low, high]: &mut [f32; 2], value: f32| (*low, *high) = (low.min(value), high.max(value));
        for v in 0..tiles_y * TILE_ROWS {
            for u in 0..tiles_x * WIDTH {
                let (tile_x, tile_y) = (u / WIDTH, v / TILE_ROWS);
                let [a, b] = slope(u, v);
                let [to_a, to_b] = &mut rays.slopes[v * tiles_x + tile_x];
                (to_a.0[u % WIDTH], to_b.0[u % WIDTH]) = (a, b);
                let [a_bounds, b_bounds] = &mut rays.bounds[tile_y * tiles_x + tile_x];
                widen(a_bounds, a);
                widen(b_bounds, b);
                widen(&mut rays.column_bounds[tile_x], a);
                widen(&mut rays.row_bounds[tile_y], b);
            }
        }
        rays
    }

    /// Largest size of `a` and of `b`.
    pub(super) fn most(&self) -> [f32; 2] {
        [&self.column_bounds, &self.row_bounds].map(|bounds| {
            let sizes = bounds.iter().map(|[low, high]| low.abs().max(high.abs()));
            sizes.fold(0.0, f32::max)
        })
    }

    /// The tiles in which `a` and `b` may lie within these bounds; `None` if there are none.
    pub(super) fn tiles(&self, a: [f64; 2], b: [f64; 2]) -> Option<TileRange> {
        let among = |bounds: &[[f32; 2]], [low, high]: [f64; 2]| {
            let overlaps = |of: &[f32; 2]| f64::from(of[1]) >= low - 1e-6 && f64::from(of[0]) <= high + 1e-6;
            let first = bounds.iter().position(overlaps)?;
            Some([first as u16, bounds.iter().rposition(overlaps)? as u16])
        };
        Some(TileRange {
            x: among(&self.column_bounds, a)?,
            y: among(&self.row_bounds, b)?,
        })
    }

    /// All tiles.
    pub(super) fn whole(&self) -> TileRange {
        TileRange {
            x: [0, self.column_bounds.len() as u16 - 1],
            y: [0, self.row_bounds.len() as u16 - 1],
        }
    }
}

impl LinearForm {
    /// Largest and smallest value over a rectangle of `a` and `b`.
    #[inline(always)]
    fn bounds(&self, [a0, a1]: [f32; 2], [b0, b1]: [f32; 2]) -> [f32; 2] {
        let [c, by_a, by_b] = self.0;
        let (p, q, r, s) = (by_a * a0, by_a * a1, by_b * b0, by_b * b1);
        [c + p.min(q) + r.min(s), c + p.max(q) + r.max(s)]
    }

    /// Bound of its rounding over a rectangle.
    #[inline(always)]
    fn rounding(&self, a: f32, b: f32) -> f32 {
        let [c, by_a, by_b] = self.0;
        ROUNDING * (c.abs() + by_a.abs() * a + by_b.abs() * b)
    }

    /// Its values in the columns `a` at `b` = 0.
    #[inline(always)]
    pub(super) fn along<S: Simd>(&self, a: S::F) -> S::F {
        S::splat(self.0[0]) + S::splat(self.0[1]) * a
    }
}

impl Canvas {
    /// Room for an image whose columns have these `a` and whose rows have these `b`, both descending.
    pub(super) fn make_room(&mut self, a: &[f32], b: &[f32]) {
        let tiles = [a.len().div_ceil(WIDTH), b.len().div_ceil(TILE_ROWS)];
        // Pixels beyond the edges are those of a larger image.
        let beyond = |of: &[f32], place: usize| {
            let last = of.len() - 1;
            let step = if last > 0 { of[last] - of[last - 1] } else { -1.0 };
            of.get(place)
                .copied()
                .unwrap_or(of[last] + step * (place - last) as f32)
        };
        self.tiles = tiles;
        self.a = (0..tiles[0])
            .map(|tile| Floats(std::array::from_fn(|i| beyond(a, tile * WIDTH + i))))
            .collect();
        self.a_bounds = self.a.iter().map(|a| [a.0[WIDTH - 1], a.0[0]]).collect();
        self.b = (0..tiles[1] * TILE_ROWS).map(|row| beyond(b, row)).collect();
        self.b_bounds = self
            .b
            .chunks_exact(TILE_ROWS)
            .map(|b| [b[TILE_ROWS - 1], b[0]])
            .collect();
        self.inverse.resize(self.b.len() * tiles[0], Floats::ZERO);
        self.surface.resize(self.b.len() * tiles[0], Words::ZERO);
        self.least.resize(tiles[0] * tiles[1], 0.0);
    }

    /// `a` and `b` of sixteen pixels of a row.
    #[inline(always)]
    pub(super) fn rays<S: Simd>(&self, tile_x: usize, row: usize) -> [S::F; 2] {
        match &self.bent {
            None => [S::load(&self.a[tile_x]), S::splat(self.b[row])],
            Some(rays) => rays.slopes[row * self.tiles[0] + tile_x].each_ref().map(S::load),
        }
    }

    /// `a` and `b` of a pixel of a tile.
    #[inline(always)]
    pub(super) fn ray(&self, tile_x: usize, row: usize, element: usize) -> [f32; 2] {
        match &self.bent {
            None => [self.a[tile_x].0[element], self.b[row]],
            Some(rays) => rays.slopes[row * self.tiles[0] + tile_x]
                .each_ref()
                .map(|slopes| slopes.0[element]),
        }
    }

    /// Bounds of `a` and `b` in a tile.
    #[inline(always)]
    fn bounds(&self, [tile_x, tile_y]: [usize; 2]) -> [[f32; 2]; 2] {
        match &self.bent {
            None => [self.a_bounds[tile_x], self.b_bounds[tile_y]],
            Some(rays) => rays.bounds[tile_y * self.tiles[0] + tile_x],
        }
    }

    /// Largest size of `a` and of `b`.
    fn most(&self) -> [f32; 2] {
        match &self.bent {
            None => [
                self.a_bounds[0][1].max(-self.a_bounds[self.tiles[0] - 1][0]),
                self.b[0].abs().max(self.b[self.b.len() - 1].abs()),
            ],
            Some(rays) => rays.most(),
        }
    }

    /// Fills these rows of tiles with flat ground, of inverse depth `ground`, and with sky, `far` being the inverse depth of the end of
    /// the range.
    #[inline(always)]
    pub(super) fn fill<S: Simd>(&mut self, tile_rows: &Range<usize>, ground: Option<LinearForm>, far: f32) {
        let tiles_x = self.tiles[0];
        self.least[tile_rows.start * tiles_x..tile_rows.end * tiles_x].fill(far);
        let sky = S::splat(far);
        let LinearForm(plane) = ground.unwrap_or(LinearForm([0.0; 3]));
        let [ground_word, sky_word] = [GROUND_SURFACE, SKY_SURFACE].map(|word| S::floats(S::splat_words(word)));
        for row in tile_rows.start * TILE_ROWS..tile_rows.end * TILE_ROWS {
            let by_row = S::splat(self.b[row]) * S::splat(plane[2]);
            for tile in 0..tiles_x {
                let inverse = match self.bent {
                    None => LinearForm(plane).along::<S>(S::load(&self.a[tile])) + by_row,
                    Some(_) => {
                        let [a, b] = self.rays::<S>(tile, row);
                        LinearForm(plane).along::<S>(a) + b * S::splat(plane[2])
                    }
                };
                let is_ground = S::lt(sky, inverse);
                let place = row * tiles_x + tile;
                S::store(S::select(is_ground, inverse, sky), &mut self.inverse[place]);
                let word = S::select(is_ground, ground_word, sky_word);
                S::store_words(S::words(word), &mut self.surface[place]);
            }
        }
        if ground.is_none() {
            return;
        }
        for tile_y in tile_rows.clone() {
            for tile_x in 0..tiles_x {
                let [a, b] = self.bounds([tile_x, tile_y]);
                let [low, _] = LinearForm(plane).bounds(a, b);
                let low = low - LinearForm(plane).rounding(1.0, 1.0);
                self.least[tile_y * tiles_x + tile_x] = low.max(far);
            }
        }
    }

    /// Draws the surfaces in their order.
    #[inline(always)]
    pub(super) fn draw<S: Simd>(
        &mut self,
        items: &[DrawItem],
        order: &[u64],
        edges: &[LinearForm],
        cylinders: &[Cylinder],
        axes: &[LinearForm; 3],
    ) {
        for key in order {
            let item = &items[*key as u32 as usize];
            match item.shape {
                DrawShape::Polygon(inverse, [first, end]) => {
                    self.polygon::<S>(item, inverse, &edges[first as usize..end as usize]);
                }
                DrawShape::Cylinder(number) => self.cylinder::<S>(item, &cylinders[number as usize], axes),
            }
        }
    }

    /// Draws a polygon of the list with these edges.
    #[inline(always)]
    pub(super) fn item<S: Simd>(&mut self, item: &DrawItem, edges: &[LinearForm]) {
        if let DrawShape::Polygon(inverse, [first, end]) = item.shape {
            self.polygon::<S>(item, inverse, &edges[first as usize..end as usize]);
        }
    }

    /// True if every pixel of these tiles already sees something whose inverse depth is `most` or more.
    #[inline(always)]
    pub(super) fn hides(&self, tiles: &TileRange, most: f32) -> bool {
        let [columns, rows] = [tiles.x, tiles.y].map(|[first, last]| usize::from(first)..=usize::from(last));
        rows.into_iter().all(|row| {
            let least = &self.least[row * self.tiles[0]..][..self.tiles[0]];
            least[columns.clone()].iter().all(|least| *least >= most)
        })
    }

    #[inline(always)]
    fn polygon<S: Simd>(&mut self, item: &DrawItem, inverse: LinearForm, edges: &[LinearForm]) {
        let [a_most, b_most] = self.most();
        let rounding = inverse.rounding(a_most, b_most);
        let mut tested = [LinearForm::default(); MOST_EDGES];
        for tile_y in usize::from(item.tiles.y[0])..=usize::from(item.tiles.y[1]) {
            'tiles: for tile_x in usize::from(item.tiles.x[0])..=usize::from(item.tiles.x[1]) {
                let [a_bounds, b_bounds] = self.bounds([tile_x, tile_y]);
                let tile = tile_y * self.tiles[0] + tile_x;
                let [_, nearest] = inverse.bounds(a_bounds, b_bounds);
                if (nearest + rounding).min(item.most) <= self.least[tile] {
                    continue;
                }
                let mut count = 0;
                for edge in edges {
                    let [low, high] = edge.bounds(a_bounds, b_bounds);
                    let rounding = edge.rounding(a_most, b_most);
                    if high < -rounding {
                        continue 'tiles;
                    }
                    if low < rounding {
                        tested[count] = *edge;
                        count += 1;
                    }
                }
                let (place, edges) = ([tile_x, tile_y], &tested[..count]);
                self.least[tile] = match self.bent {
                    None => self.tile::<S>(place, inverse, edges, item.surface),
                    Some(_) => self.bent_tile::<S>(place, inverse, edges, item.surface),
                };
            }
        }
    }

    /// Draws a polygon into a tile and returns the tile's farthest pixel.
    #[inline(always)]
    fn tile<S: Simd>(
        &mut self,
        [tile_x, tile_y]: [usize; 2],
        inverse: LinearForm,
        edges: &[LinearForm],
        surface: u32,
    ) -> f32 {
        let zero = S::splat(0.0);
        // The part that all rows of the tile share.
        let a = S::load(&self.a[tile_x]);
        let mut shared = [[zero; 2]; MOST_EDGES];
        for (shared, edge) in shared.iter_mut().zip(edges) {
            *shared = [edge.along::<S>(a), S::splat(edge.0[2])];
        }
        let plane = [inverse.along::<S>(a), S::splat(inverse.0[2])];
        let mut least = S::splat(f32::NEG_INFINITY);
        for row in tile_y * TILE_ROWS..(tile_y + 1) * TILE_ROWS {
            let b = S::splat(self.b[row]);
            let place = row * self.tiles[0] + tile_x;
            let (inverse, before) = (plane[0] + b * plane[1], S::load(&self.inverse[place]));
            let mut mask = S::lt(before, inverse);
            for [along, by_b] in &shared[..edges.len()] {
                mask = S::both(mask, S::le(zero, *along + b * *by_b));
            }
            least = S::max(least, zero - self.nearer::<S>(place, mask, inverse, before, surface));
        }
        -S::largest(least)
    }

    /// As [`Canvas::tile`], with the rays of a lens.
    #[inline(always)]
    fn bent_tile<S: Simd>(
        &mut self,
        [tile_x, tile_y]: [usize; 2],
        inverse: LinearForm,
        edges: &[LinearForm],
        surface: u32,
    ) -> f32 {
        let zero = S::splat(0.0);
        let mut least = S::splat(f32::NEG_INFINITY);
        for row in tile_y * TILE_ROWS..(tile_y + 1) * TILE_ROWS {
            let [a, b] = self.rays::<S>(tile_x, row);
            let place = row * self.tiles[0] + tile_x;
            let at = |form: &LinearForm| form.along::<S>(a) + b * S::splat(form.0[2]);
            let (inverse, before) = (at(&inverse), S::load(&self.inverse[place]));
            let mut mask = S::lt(before, inverse);
            for edge in edges {
                mask = S::both(mask, S::le(zero, at(edge)));
            }
            least = S::max(least, zero - self.nearer::<S>(place, mask, inverse, before, surface));
        }
        -S::largest(least)
    }

    /// Sixteen pixels see a surface where `mask` says so. Returns their inverse depths.
    #[inline(always)]
    fn nearer<S: Simd>(&mut self, place: usize, mask: S::M, inverse: S::F, before: S::F, surface: u32) -> S::F {
        let now = S::select(mask, inverse, before);
        S::store(now, &mut self.inverse[place]);
        S::store_words_where(mask, surface, &mut self.surface[place]);
        now
    }

    #[inline(always)]
    fn cylinder<S: Simd>(&mut self, item: &DrawItem, cylinder: &Cylinder, axes: &[LinearForm; 3]) {
        for tile_y in usize::from(item.tiles.y[0])..=usize::from(item.tiles.y[1]) {
            for tile_x in usize::from(item.tiles.x[0])..=usize::from(item.tiles.x[1]) {
                let tile = tile_y * self.tiles[0] + tile_x;
                if self.least[tile] < item.most {
                    self.least[tile] = self.cylinder_tile::<S>([tile_x, tile_y], cylinder, axes, item.surface);
                }
            }
        }
    }

    #[inline(always)]
    fn cylinder_tile<S: Simd>(
        &mut self,
        [tile_x, tile_y]: [usize; 2],
        cylinder: &Cylinder,
        axes: &[LinearForm; 3],
        surface: u32,
    ) -> f32 {
        let (zero, one) = (S::splat(0.0), S::splat(1.0));
        let (cx, cy) = (S::splat(cylinder.centre_m[0]), S::splat(cylinder.centre_m[1]));
        let [low, high] = [S::splat(cylinder.z_m[0]), S::splat(cylinder.z_m[1])];
        let square_m2 = S::splat(cylinder.radius_m * cylinder.radius_m);
        let mut least = S::splat(f32::NEG_INFINITY);
        for row in tile_y * TILE_ROWS..(tile_y + 1) * TILE_ROWS {
            let [a, b] = self.rays::<S>(tile_x, row);
            let place = row * self.tiles[0] + tile_x;
            // The ray in world axes.
            let [x, y, z] = [0, 1, 2].map(|i: usize| axes[i].along::<S>(a) + b * S::splat(axes[i].0[2]));
            let square = x * x + y * y;
            let (along, off) = (x * cx + y * cy, x * cy - y * cx);
            let root2 = square * square_m2 - off * off;
            let root = S::sqrt(S::max(root2, zero));
            let meets = S::lt(zero, root2);
            let t = (along - root) / square;
            let height = t * z;
            let inside = S::both(S::le(low, height), S::le(height, high));
            let before = S::load(&self.inverse[place]);
            let inverse = one / t;
            let mantle = S::both(S::both(meets, inside), S::both(S::lt(zero, t), S::lt(before, inverse)));
            let now = S::select(mantle, inverse, before);
            S::store_words_where(mantle, surface, &mut self.surface[place]);
            // The top, for a camera above it.
            let t = high / z;
            let within = S::both(S::lt(along - root, t * square), S::lt(t * square, along + root));
            let below = S::both(S::lt(high, zero), S::lt(zero, t));
            let inverse = one / t;
            let top = S::both(S::both(meets, within), S::both(below, S::lt(now, inverse)));
            let now = S::select(top, inverse, now);
            S::store_words_where(top, surface + 1, &mut self.surface[place]);
            S::store(now, &mut self.inverse[place]);
            least = S::max(least, zero - now);
        }
        -S::largest(least)
    }
}

/// Most edges of a polygon; outlines with more corners are cut into triangles.
pub(super) const MOST_EDGES: usize = 8;
