//! Ground that is not flat: the triangles of the LIDAR's grid, drawn by blocks.

use sim_core::scene::Scene;

use super::{
    raster::{Canvas, GROUND_SURFACE},
    view::{BodyBounds, CameraView, DrawList, cross},
};
use crate::sensors::lidar::{GroundGrid, simd::Simd};

/// Cells of a block in a row and in a column.
const BLOCK: usize = 4;
/// Corners of a block in a row and in a column.
const CORNERS: usize = BLOCK + 1;

/// The ground of a map that is not flat.
#[derive(Debug)]
pub(super) struct Relief {
    grid: GroundGrid,
    /// Blocks in a row.
    columns: usize,
    blocks: Vec<BodyBounds>,
}

impl Relief {
    /// `None` for flat ground.
    pub(super) fn new(scene: &Scene) -> Option<Self> {
        let grid = GroundGrid::new(scene)?;
        let [columns, rows] = grid.corners.map(|corners| (corners - 1).div_ceil(BLOCK));
        let blocks = (0..columns * rows).map(|block| {
            let [x, y] = [block % columns * BLOCK, block / columns * BLOCK];
            let [x_end, y_end] = [
                (x + BLOCK).min(grid.corners[0] - 1),
                (y + BLOCK).min(grid.corners[1] - 1),
            ];
            let ([x0, y0, _], [x1, y1, _]) = (grid.corner(x, y), grid.corner(x_end, y_end));
            let mut z_m = [f64::INFINITY, f64::NEG_INFINITY];
            for row in y..=y_end {
                for column in x..=x_end {
                    let height_m = grid.corner(column, row)[2];
                    z_m = [z_m[0].min(height_m), z_m[1].max(height_m)];
                }
            }
            BodyBounds {
                centre_m: [0.5 * (x0 + x1), 0.5 * (y0 + y1)],
                radius_m: 0.5 * libm::hypot(x1 - x0, y1 - y0),
                z_m,
            }
        });
        let blocks = blocks.collect();
        Some(Self { grid, columns, blocks })
    }

    /// Draws the ground that a camera sees, after all other surfaces and nearest first: most of it lies behind them, and the triangles of
    /// a hidden block are not looked at. `list` is overwritten.
    #[inline(always)]
    pub(super) fn draw<S: Simd>(&self, view: &CameraView<'_>, canvas: &mut Canvas, list: &mut DrawList) {
        let reach = view.optics.reach_m / (self.grid.cell_m * BLOCK as f64);
        let rows = self.blocks.len() / self.columns;
        let span = |axis: usize, count: usize| {
            let at = (view.pose.position_m[axis] - self.grid.min_m[axis]) / (self.grid.cell_m * BLOCK as f64);
            let low = (at - reach).max(0.0) as usize;
            low..((at + reach).max(-1.0) as isize + 1).clamp(0, count as isize) as usize
        };
        list.clear();
        for row in span(1, rows) {
            for column in span(0, self.columns) {
                let block = row * self.columns + column;
                if view.may_see(&self.blocks[block])
                    && let Some((tiles, most)) = view.bounds_tiles(&self.blocks[block])
                {
                    list.blocks.push((tiles, most, block as u32));
                }
            }
        }
        let DrawList { blocks, order, .. } = list;
        order.clear();
        // The bits of positive floats are in the order of the floats.
        let keys = (0_u64..).zip(blocks.iter());
        order.extend(keys.map(|(number, (_, most, _))| u64::from(!most.to_bits()) << 32 | number));
        order.sort_unstable();
        for place in 0..list.order.len() {
            let (tiles, most, block) = list.blocks[list.order[place] as u32 as usize];
            if canvas.hides(&tiles, most) {
                continue;
            }
            list.items.clear();
            list.edges.clear();
            let block = block as usize;
            self.block(view, [block % self.columns * BLOCK, block / self.columns * BLOCK], list);
            for item in &list.items {
                canvas.item::<S>(item, &list.edges);
            }
        }
    }

    /// Adds the triangles of the block whose first corner is given.
    #[inline(always)]
    fn block(&self, view: &CameraView<'_>, [x, y]: [usize; 2], list: &mut DrawList) {
        let [columns, rows] = [
            (self.grid.corners[0] - x).min(CORNERS),
            (self.grid.corners[1] - y).min(CORNERS),
        ];
        let mut seen = [[[0.0; 3]; CORNERS]; CORNERS];
        for (row, seen) in seen.iter_mut().enumerate().take(rows) {
            for (column, seen) in seen.iter_mut().enumerate().take(columns) {
                *seen = view.seen(self.grid.corner(x + column, y + row));
            }
        }
        for row in 0..rows - 1 {
            for column in 0..columns - 1 {
                let (a, b) = (seen[row][column], seen[row][column + 1]);
                let (c, d) = (seen[row + 1][column], seen[row + 1][column + 1]);
                for corners in [[a, b, c], [b, d, c]] {
                    let [p, q, r] = &corners;
                    let along: [f64; 3] = std::array::from_fn(|i| q[i] - p[i]);
                    let across: [f64; 3] = std::array::from_fn(|i| r[i] - p[i]);
                    view.polygon(list, &corners, cross(&along, &across), GROUND_SURFACE);
                }
            }
        }
    }
}
