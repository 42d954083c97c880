//! A camera at one time: the world in its frame, and what of it lies in the image.

use std::sync::Arc;

use super::{
    optics::{CameraOptics, ImageBand},
    raster::{Canvas, Cylinder, DrawItem, DrawShape, LinearForm, TILE_ROWS, TileRange},
};
use crate::sensors::lidar::{sensor::SensorPose, simd::WIDTH};

/// Corners at least so far ahead are projected; a surface with a nearer one may be anywhere in the image, metres.
const NEAREST_M: f64 = 1e-3;

/// A camera at one time, and the rows of its image that it takes then.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraView<'a> {
    pub(super) optics: &'a CameraOptics,
    pub(super) band: &'a ImageBand,
    pub(super) pose: SensorPose,
}

/// The surfaces of an image, before they are drawn.
#[derive(Debug, Default)]
pub(super) struct DrawList {
    pub(super) items: Vec<DrawItem>,
    pub(super) edges: Vec<LinearForm>,
    pub(super) cylinders: Vec<Cylinder>,
    pub(super) order: Vec<u64>,
    /// Blocks of hilly ground: their tiles, an upper bound of their inverse depth, and their number.
    pub(super) blocks: Vec<(TileRange, f32, u32)>,
}

/// An upright cylinder about a body, in the world.
#[derive(Debug, Clone, Copy)]
pub(super) struct BodyBounds {
    pub(super) centre_m: [f64; 2],
    pub(super) radius_m: f64,
    pub(super) z_m: [f64; 2],
}

impl CameraView<'_> {
    /// A direction of the world in the camera's frame.
    #[inline(always)]
    pub(super) fn turned(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        let r = &self.pose.world_from_sensor;
        [0, 1, 2].map(|i: usize| r[0][i] * x + r[1][i] * y + r[2][i] * z)
    }

    /// A point of the world in the camera's frame.
    #[inline(always)]
    pub(super) fn seen(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        let o = &self.pose.position_m;
        self.turned([x - o[0], y - o[1], z - o[2]])
    }

    /// The two ends of a vertical line in the camera's frame.
    #[inline(always)]
    pub(super) fn upright(&self, [x, y]: [f64; 2], z_m: [f64; 2]) -> [[f64; 3]; 2] {
        let o = &self.pose.position_m;
        let foot = self.turned([x - o[0], y - o[1], 0.0]);
        let up = self.pose.world_from_sensor[2];
        z_m.map(|z| {
            let height = z - o[2];
            [0, 1, 2].map(|i: usize| foot[i] + height * up[i])
        })
    }

    /// Rays in world axes: the linear functions x, y and z of the image.
    pub(super) fn axes(&self) -> [LinearForm; 3] {
        self.pose
            .world_from_sensor
            .map(|row| LinearForm(row.map(|part| part as f32)))
    }

    /// Inverse depth of flat ground at height `ground_m`; `None` for a camera below it.
    pub(super) fn ground(&self, ground_m: f64) -> Option<LinearForm> {
        let height_m = self.pose.position_m[2] - ground_m;
        let up = self.pose.world_from_sensor[2];
        (height_m > 0.0).then(|| LinearForm(up.map(|part| (-part / height_m) as f32)))
    }

    /// True if a body may be in the rows of this view.
    #[inline(always)]
    pub(super) fn may_see(&self, body: &BodyBounds) -> bool {
        let middle_m = 0.5 * (body.z_m[0] + body.z_m[1]);
        let half_m = 0.5 * (body.z_m[1] - body.z_m[0]);
        let [x, y, z] = self.seen([body.centre_m[0], body.centre_m[1], middle_m]);
        let up = &self.pose.world_from_sensor[2];
        self.band.frustum.iter().all(|[nx, ny, nz]| {
            let rise = nx * up[0] + ny * up[1] + nz * up[2];
            let reach_m = half_m * rise.abs() + body.radius_m * (1.0 - rise * rise).max(0.0).sqrt();
            nx * x + ny * y + nz * z > -reach_m
        }) && x - half_m * up[0].abs() - body.radius_m < self.optics.range_m
    }

    /// The tiles that a convex body with these corners may cover, and an upper bound of its inverse depth; `None` if it is not in the
    /// image.
    #[inline(always)]
    fn tiles(&self, corners: &[[f64; 3]]) -> Option<(TileRange, f32)> {
        let optics = self.optics;
        let (mut near, mut far) = (f64::INFINITY, f64::NEG_INFINITY);
        for [x, ..] in corners {
            (near, far) = (near.min(*x), far.max(*x));
        }
        if far <= 0.0 || near >= optics.range_m {
            return None;
        }
        let most = if near > NEAREST_M {
            (1.0 / near) as f32 * 1.000_001
        } else {
            f32::INFINITY
        };
        let rows = &self.band.rows;
        let whole = [
            [0.0, optics.width as f64 - 1.0],
            [rows.start as f64, rows.end as f64 - 1.0],
        ];
        let mut pixels = whole;
        if near <= NEAREST_M {
            if let Some(lens) = &optics.lens {
                return Some((self.within_band(lens.rays.whole())?, most));
            }
        } else {
            let (mut a, mut b) = ([f64::INFINITY, f64::NEG_INFINITY], [f64::INFINITY, f64::NEG_INFINITY]);
            for [x, y, z] in corners {
                let inverse = 1.0 / x;
                let (y, z) = (y * inverse, z * inverse);
                (a, b) = ([a[0].min(y), a[1].max(y)], [b[0].min(z), b[1].max(z)]);
            }
            if let Some(lens) = &optics.lens {
                return Some((self.within_band(lens.rays.tiles(a, b)?)?, most));
            }
            let focal = optics.focal_px;
            let pixel =
                |[low, high]: [f64; 2], centre: f64| [centre - 0.51 - high * focal, centre - 0.49 - low * focal];
            pixels = [pixel(a, optics.centre_px[0]), pixel(b, optics.centre_px[1])];
        }
        for (pixels, whole) in pixels.iter_mut().zip(whole) {
            *pixels = [pixels[0].max(whole[0]), pixels[1].min(whole[1])];
            if pixels[0] > pixels[1] {
                return None;
            }
        }
        let tiles = |pixels: [f64; 2], size: usize| pixels.map(|pixel| (pixel as usize / size) as u16);
        let range = TileRange {
            x: tiles(pixels[0], WIDTH),
            y: tiles(pixels[1], TILE_ROWS),
        };
        Some((range, most))
    }

    /// The part of these tiles that lies in the rows of this view; `None` if there is none.
    fn within_band(&self, mut range: TileRange) -> Option<TileRange> {
        let rows = &self.band.tiles;
        range.y = [range.y[0].max(rows.start as u16), range.y[1].min(rows.end as u16 - 1)];
        (range.y[0] <= range.y[1]).then_some(range)
    }

    /// Adds a convex polygon, its corners counter-clockwise as seen from outside. `normal` points outwards; both in the camera's frame.
    #[inline(always)]
    pub(super) fn polygon(&self, list: &mut DrawList, corners: &[[f64; 3]], normal: [f64; 3], surface: u32) {
        let offset = normal[0] * corners[0][0] + normal[1] * corners[0][1] + normal[2] * corners[0][2];
        if offset >= 0.0 {
            return;
        }
        let Some((tiles, most)) = self.tiles(corners) else {
            return;
        };
        let inverse = LinearForm(normal.map(|part| (part / offset) as f32));
        let first = list.edges.len() as u32;
        let next = corners.iter().skip(1).chain(corners.first());
        list.edges.extend(
            corners
                .iter()
                .zip(next)
                .map(|(p, q)| LinearForm(cross(q, p).map(|part| part as f32))),
        );
        list.items.push(DrawItem {
            shape: DrawShape::Polygon(inverse, [first, list.edges.len() as u32]),
            tiles,
            most,
            surface,
        });
    }

    /// The tiles that a body within these bounds may cover, and an upper bound of its inverse depth; `None` if it is not in the image.
    #[inline(always)]
    pub(super) fn bounds_tiles(&self, body: &BodyBounds) -> Option<(TileRange, f32)> {
        let [[x0, y0], reach_m] = [body.centre_m, [body.radius_m; 2]];
        let square = [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]];
        let mut corners = [[0.0; 3]; 8];
        for (pair, [sx, sy]) in corners.chunks_exact_mut(2).zip(square) {
            pair.copy_from_slice(&self.upright([x0 + sx * reach_m[0], y0 + sy * reach_m[1]], body.z_m));
        }
        self.tiles(&corners)
    }

    /// Adds an upright cylinder.
    pub(super) fn cylinder(&self, list: &mut DrawList, body: &BodyBounds, surface: u32) {
        let [x0, y0] = body.centre_m;
        let Some((tiles, most)) = self.bounds_tiles(body) else {
            return;
        };
        let o = &self.pose.position_m;
        list.items.push(DrawItem {
            shape: DrawShape::Cylinder(list.cylinders.len() as u32),
            tiles,
            most,
            surface,
        });
        list.cylinders.push(Cylinder {
            centre_m: [(x0 - o[0]) as f32, (y0 - o[1]) as f32],
            radius_m: body.radius_m as f32,
            z_m: body.z_m.map(|z| (z - o[2]) as f32),
        });
    }
}

/// The cross product. `cross(q, p)` is `cross(p, q)` with the opposite sign, bit for bit.
#[inline(always)]
pub(super) fn cross([ax, ay, az]: &[f64; 3], [bx, by, bz]: &[f64; 3]) -> [f64; 3] {
    [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
}

impl DrawList {
    pub(super) fn clear(&mut self) {
        self.items.clear();
        self.edges.clear();
        self.cylinders.clear();
        self.blocks.clear();
    }

    /// Sorts the surfaces, nearest first.
    pub(super) fn sort(&mut self) {
        self.order.clear();
        let keys = (0_u64..).zip(&self.items);
        // The bits of positive floats are in the order of the floats.
        self.order
            .extend(keys.map(|(number, item)| u64::from(!item.most.to_bits()) << 32 | number));
        self.order.sort_unstable();
    }
}

impl Canvas {
    /// Room for the image of a camera.
    pub(super) fn room_for(&mut self, optics: &CameraOptics) {
        self.bent = optics.lens.as_ref().map(|lens| Arc::clone(&lens.rays));
        let room = (optics.width, optics.height, optics.focal_px);
        if self.room == room {
            return;
        }
        self.room = room;
        let slopes = |count: usize, centre: f64| -> Vec<f32> {
            let slope = |pixel: usize| ((centre - (pixel as f64 + 0.5)) / optics.focal_px) as f32;
            (0..count).map(slope).collect()
        };
        let a = slopes(optics.width, optics.centre_px[0]);
        let b = slopes(optics.height, optics.centre_px[1]);
        self.make_room(&a, &b);
    }
}
