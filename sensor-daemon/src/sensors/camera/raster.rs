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

    /// Fills the image with flat ground, of inverse depth `ground`, and with sky, `far` being the inverse depth of the end of the range.
    #[inline(always)]
    pub(super) fn fill<S: Simd>(&mut self, ground: Option<LinearForm>, far: f32) {
        let [tiles_x, tiles_y] = self.tiles;
        self.least[..tiles_x * tiles_y].fill(far);
        let sky = S::splat(far);
        let LinearForm(plane) = ground.unwrap_or(LinearForm([0.0; 3]));
        let [ground_word, sky_word] = [GROUND_SURFACE, SKY_SURFACE].map(|word| S::floats(S::splat_words(word)));
        for row in 0..self.b.len() {
            let by_row = S::splat(self.b[row]) * S::splat(plane[2]);
            for tile in 0..tiles_x {
                let inverse = LinearForm(plane).along::<S>(S::load(&self.a[tile])) + by_row;
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
        for tile_y in 0..tiles_y {
            for tile_x in 0..tiles_x {
                let [low, _] = LinearForm(plane).bounds(self.a_bounds[tile_x], self.b_bounds[tile_y]);
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

    #[inline(always)]
    fn polygon<S: Simd>(&mut self, item: &DrawItem, inverse: LinearForm, edges: &[LinearForm]) {
        let (a_most, b_most) = (
            self.a_bounds[0][1].max(-self.a_bounds[self.tiles[0] - 1][0]),
            self.b_most(),
        );
        let rounding = inverse.rounding(a_most, b_most);
        let mut tested = [[S::splat(0.0); 2]; MOST_EDGES];
        for tile_y in usize::from(item.tiles.y[0])..=usize::from(item.tiles.y[1]) {
            'tiles: for tile_x in usize::from(item.tiles.x[0])..=usize::from(item.tiles.x[1]) {
                let (a_bounds, b_bounds) = (self.a_bounds[tile_x], self.b_bounds[tile_y]);
                let tile = tile_y * self.tiles[0] + tile_x;
                let [_, nearest] = inverse.bounds(a_bounds, b_bounds);
                if (nearest + rounding).min(item.most) <= self.least[tile] {
                    continue;
                }
                let a = S::load(&self.a[tile_x]);
                let mut count = 0;
                for edge in edges {
                    let [low, high] = edge.bounds(a_bounds, b_bounds);
                    let rounding = edge.rounding(a_most, b_most);
                    if high < -rounding {
                        continue 'tiles;
                    }
                    if low < rounding {
                        tested[count] = [edge.along::<S>(a), S::splat(edge.0[2])];
                        count += 1;
                    }
                }
                let plane = [inverse.along::<S>(a), S::splat(inverse.0[2])];
                self.least[tile] = self.tile::<S>([tile_x, tile_y], plane, &tested[..count], item.surface);
            }
        }
    }

    fn b_most(&self) -> f32 {
        self.b[0].abs().max(self.b[self.b.len() - 1].abs())
    }

    /// Draws a polygon into a tile and returns the tile's farthest pixel.
    #[inline(always)]
    fn tile<S: Simd>(
        &mut self,
        [tile_x, tile_y]: [usize; 2],
        plane: [S::F; 2],
        edges: &[[S::F; 2]],
        surface: u32,
    ) -> f32 {
        let zero = S::splat(0.0);
        let mut least = S::splat(f32::NEG_INFINITY);
        for row in tile_y * TILE_ROWS..(tile_y + 1) * TILE_ROWS {
            let b = S::splat(self.b[row]);
            let place = row * self.tiles[0] + tile_x;
            let (inverse, before) = (plane[0] + b * plane[1], S::load(&self.inverse[place]));
            let mut mask = S::lt(before, inverse);
            for [along, by_b] in edges {
                mask = S::both(mask, S::le(zero, *along + b * *by_b));
            }
            let now = S::select(mask, inverse, before);
            S::store(now, &mut self.inverse[place]);
            S::store_words_where(mask, surface, &mut self.surface[place]);
            least = S::max(least, zero - now);
        }
        -S::largest(least)
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
        let a = S::load(&self.a[tile_x]);
        let [along_x, along_y, along_z] = [axes[0].along::<S>(a), axes[1].along::<S>(a), axes[2].along::<S>(a)];
        let mut least = S::splat(f32::NEG_INFINITY);
        for row in tile_y * TILE_ROWS..(tile_y + 1) * TILE_ROWS {
            let b = S::splat(self.b[row]);
            let place = row * self.tiles[0] + tile_x;
            // The ray in world axes.
            let x = along_x + b * S::splat(axes[0].0[2]);
            let y = along_y + b * S::splat(axes[1].0[2]);
            let z = along_z + b * S::splat(axes[2].0[2]);
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
