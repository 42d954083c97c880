//! The rays of a span: directions of its columns, and the ground below.

use ipc_schema::pointcloud::{GROUND, Tag};

use super::{
    raster::{CHUNKS, ColumnChunk, LinearValue, ScanCanvas, SurfaceBody},
    scan::SpanScan,
    sensor::{Rotation, turned},
    simd::{Floats, Simd, WIDTH},
    solids::NOTHING,
    terrain::{GroundProfile, Terrain, TerrainView, between},
};

/// How far the ground is drawn before all surfaces, metres: the lower lasers end there, and far surfaces are only looked at for rays
/// that may reach them.
const NEAR_M: f32 = 40.0;
/// The ground as a body: its bounds are not used.
const GROUND_BODY: SurfaceBody = SurfaceBody {
    object: GROUND,
    word: Tag::Ground as u32,
    z: [LinearValue(0.0, 0.0); 2],
    near: 0.0,
    chunks: [0; 2],
};

/// Vectors of length 1 from vectors of nearly that, by a step of Newton's.
#[inline(always)]
fn unit(of: &[[f64; WIDTH]; 3], to: &mut [Floats; 3]) {
    let [x, y, z] = of;
    let scale: [f64; WIDTH] = std::array::from_fn(|i| 1.5 - 0.5 * (x[i] * x[i] + y[i] * y[i] + z[i] * z[i]));
    for (from, to) in of.iter().zip(to) {
        to.0 = std::array::from_fn(|i| (from[i] * scale[i]) as f32);
    }
}

impl SpanScan<'_> {
    /// The sun in the sensor's frame.
    pub(super) fn sun(&self) -> [f32; 3] {
        let r = &self.sensors[0].world_from_sensor;
        let back: Rotation = std::array::from_fn(|row| std::array::from_fn(|i| r[i][row]));
        turned(&back, self.order.lidar.receiver.air.sun).map(|part| part as f32)
    }

    /// Directions of the columns and their rays, ages, and flat ground.
    #[inline(always)]
    pub(super) fn start<S: Simd, const UPRIGHT: bool>(&self, canvas: &mut ScanCanvas) {
        canvas.count = self.span.count;
        for chunk in 0..self.span.count.div_ceil(WIDTH) {
            self.aim_columns::<UPRIGHT>(&mut canvas.columns[chunk], chunk * WIDTH);
            canvas.columns[chunk].far = Floats([self.order.lidar.range_m as f32; WIDTH]);
            if !UPRIGHT && !self.order.lidar.pattern.is_table {
                self.fan::<S>(&mut canvas.columns[chunk]);
            }
        }
        if UPRIGHT {
            return self.ground_upright::<S>(canvas);
        }
        let is_flat = self.order.lidar.ground_m.is_some();
        for column in 0..self.span.count {
            self.aim::<S>(canvas, column);
            if is_flat {
                self.ground_tilted::<S>(canvas, column);
            } else {
                canvas.clear::<S>(column, S::splat(self.order.lidar.range_m as f32));
            }
        }
    }

    /// The ground of a net with elevation that is near, before any surface: what it hides is not drawn.
    #[inline(always)]
    pub(super) fn near_relief<S: Simd>(
        &self,
        canvas: &mut ScanCanvas,
        (terrain, view): (&Terrain, &TerrainView),
        profile: &mut GroundProfile,
    ) {
        terrain.enter::<S>(view, canvas, profile);
        let reach = NEAR_M.min(self.order.lidar.range_m as f32);
        terrain.follow::<S>(view, canvas, [reach; CHUNKS], profile);
        self.draw_relief::<S>(canvas, (terrain, view), profile);
    }

    /// The rest of the ground, after all surfaces: no farther than any ray still reaches.
    #[inline(always)]
    pub(super) fn far_relief<S: Simd>(
        &self,
        canvas: &mut ScanCanvas,
        (terrain, view): (&Terrain, &TerrainView),
        profile: &mut GroundProfile,
    ) {
        let mut reach = [0.0; CHUNKS];
        for (chunk, reach) in reach.iter_mut().enumerate().take(canvas.chunks()) {
            let far = S::load(&canvas.columns[chunk].far);
            *reach = S::largest(S::select(S::mask(canvas.live(chunk)), far, S::splat(0.0)));
        }
        terrain.follow::<S>(view, canvas, reach, profile);
        self.draw_relief::<S>(canvas, (terrain, view), profile);
    }

    /// Draws the new segments of the profiles.
    #[inline(always)]
    fn draw_relief<S: Simd>(
        &self,
        canvas: &mut ScanCanvas,
        (terrain, view): (&Terrain, &TerrainView),
        profile: &GroundProfile,
    ) {
        let zero = S::splat(0.0);
        for column in 0..canvas.count {
            let at @ (chunk, element) = (column / WIDTH, column % WIDTH);
            if !profile.is_new(chunk) {
                continue;
            }
            let ends = terrain.ends::<S>(view, canvas.columns[chunk].share.0[element]);
            let mut next = profile.first(chunk);
            for (group, rays) in self.order.lidar.pattern.groups.iter().enumerate() {
                let place = column * canvas.groups + group;
                let Some(met) = profile.meet::<S>(at, &mut next, S::load(&rays.tan), rays.live) else {
                    continue;
                };
                let [x, y, z] = canvas.ray::<S>(place);
                let facing = z - met.slope[0] * x - met.slope[1] * y;
                let t = met.height / facing;
                let best = S::load(&canvas.t[place]);
                let seen = S::both(S::lt(facing, zero), S::both(S::lt(zero, t), S::lt(t, best)));
                let is_hit = S::both(seen, between::<S>(&ends, [t * x, t * y]));
                let length = S::sqrt(S::splat(1.0) + met.slope[0] * met.slope[0] + met.slope[1] * met.slope[1]);
                canvas.put::<S>(place, is_hit, (t, best), facing / length, &GROUND_BODY);
            }
        }
    }

    /// Axes, azimuths and ages of sixteen columns; values of columns beyond the end of the span are not used.
    #[inline(always)]
    fn aim_columns<const UPRIGHT: bool>(&self, chunk: &mut ColumnChunk, first: usize) {
        let lidar = self.order.lidar;
        let [from, to] = self.sensors.map(|sensor| sensor.world_from_sensor);
        let inv = 1.0 / (self.span.count - 1).max(1) as f64;
        let at = self.column(0) + first;
        let sines: &[f64; WIDTH] = row(&lidar.firing.sines, at);
        let cosines: &[f64; WIDTH] = row(&lidar.firing.cosines, at);
        let shares: [f64; WIDTH] = std::array::from_fn(|i| (first + i) as f64 * inv);
        let age_s = (1.0 - self.span.at[0]) * lidar.tick_s;
        let shorter_s = (self.span.at[1] - self.span.at[0]) * lidar.tick_s;
        for i in 0..WIDTH {
            chunk.share.0[i] = shares[i] as f32;
            chunk.azimuth[0].0[i] = sines[i] as f32;
            chunk.azimuth[1].0[i] = cosines[i] as f32;
            chunk.age_us.0[i] = ((age_s - shorter_s * shares[i]) * 1e6 + 0.5).max(0.0) as i32 as u32;
        }
        let mut axes = [[[0.0_f64; WIDTH]; 3]; 3];
        let [ahead, left, up] = &mut axes;
        for part in 0..3 {
            let change = [0, 1, 2].map(|i: usize| to[part][i] - from[part][i]);
            for i in 0..WIDTH {
                let x = from[part][0] + shares[i] * change[0];
                let y = from[part][1] + shares[i] * change[1];
                ahead[part][i] = x * cosines[i] + y * sines[i];
                left[part][i] = y * cosines[i] - x * sines[i];
                up[part][i] = from[part][2] + shares[i] * change[2];
            }
        }
        let wanted = if UPRIGHT { 1 } else { 3 };
        for (axis, to) in axes.iter_mut().zip(&mut chunk.axes).take(wanted) {
            unit(axis, to);
        }
        let [x, y, _] = chunk.axes[0];
        chunk.ahead = [x, y];
        if UPRIGHT {
            (chunk.right, chunk.left) = (chunk.ahead, chunk.ahead);
        }
    }

    /// Bounds of the directions of sixteen columns. The rays of a column lie in a plane, between its lowest and its highest ray. Seen
    /// from above they must spread by less than a right angle.
    #[inline(always)]
    fn fan<S: Simd>(&self, chunk: &mut ColumnChunk) {
        let [lowest, highest] = self.order.lidar.pattern.ends;
        let axis = |of: usize, part: usize| S::load(&chunk.axes[of][part]);
        let ray =
            |[alpha, gamma]: [f32; 2], part: usize| axis(0, part) * S::splat(alpha) + axis(2, part) * S::splat(gamma);
        let (ax, ay) = (ray(lowest, 0), ray(lowest, 1));
        let (bx, by) = (ray(highest, 0), ray(highest, 1));
        let (aside, along) = (ax * by - ay * bx, ax * bx + ay * by);
        let zero = S::splat(0.0);
        let is_left = S::le(zero, aside);
        let near = S::lt(S::splat(1e-3), along);
        let (more, flat) = (S::splat(1e-6), |x: S::F| S::select(near, x, zero));
        let (rx, ry) = (S::select(is_left, ax, bx), S::select(is_left, ay, by));
        let (lx, ly) = (S::select(is_left, bx, ax), S::select(is_left, by, ay));
        S::store(flat(rx + more * ry), &mut chunk.right[0]);
        S::store(flat(ry - more * rx), &mut chunk.right[1]);
        S::store(flat(lx - more * ly), &mut chunk.left[0]);
        S::store(flat(ly + more * lx), &mut chunk.left[1]);
    }

    /// Directions of the rays of a column.
    #[inline(always)]
    fn aim<S: Simd>(&self, canvas: &mut ScanCanvas, column: usize) {
        let is_table = self.order.lidar.pattern.is_table;
        let (chunk, element) = (column / WIDTH, column % WIDTH);
        let part =
            |canvas: &ScanCanvas, axis: usize, part: usize| S::splat(canvas.columns[chunk].axes[axis][part].0[element]);
        for (group, rays) in self.groups(column).iter().enumerate() {
            let place = column * canvas.groups + group;
            let (alpha, beta, gamma) = (S::load(&rays.alpha), S::load(&rays.beta), S::load(&rays.gamma));
            for axis in 0..3 {
                let mut direction = alpha * part(canvas, 0, axis) + gamma * part(canvas, 2, axis);
                if is_table {
                    direction = direction + beta * part(canvas, 1, axis);
                }
                S::store(direction, &mut canvas.direction[axis][place]);
            }
        }
        if is_table {
            let edges = wedge(canvas, column, self.groups(column)[0].live.count_ones() as usize);
            let of_chunk = &mut canvas.columns[chunk];
            let [right, left] = edges;
            for (axis, (right, left)) in right.into_iter().zip(left).enumerate() {
                of_chunk.right[axis].0[element] = right;
                of_chunk.left[axis].0[element] = left;
            }
        }
    }

    /// Height of the sensor above flat ground at both ends of the span; 0 if the ground is not flat.
    #[inline(always)]
    fn heights_above_ground(&self) -> [f32; 2] {
        let ground_m = self.order.lidar.ground_m;
        ground_m.map_or([0.0; 2], |ground_m| {
            self.sensors.map(|sensor| (sensor.position_m[2] - ground_m) as f32)
        })
    }

    /// Fills all rays with the ground within range, or with no hit: the same in every column at the same height.
    #[inline(always)]
    fn ground_upright<S: Simd>(&self, canvas: &mut ScanCanvas) {
        let range = S::splat(self.order.lidar.range_m as f32);
        let [first, last] = self.heights_above_ground();
        for group in 0..canvas.groups {
            let rays = &self.order.lidar.pattern.groups[group];
            let (limit, cot, tan) = (range * S::load(&rays.alpha), S::load(&rays.cot), S::load(&rays.tan));
            for column in 0..canvas.count {
                let height = if first == last {
                    first
                } else {
                    at_share(canvas, column, first, last)
                };
                let t = S::splat(-height) * cot;
                self.lay::<S>(canvas, column * canvas.groups + group, height, (t, limit), tan);
            }
        }
    }

    #[inline(always)]
    fn ground_tilted<S: Simd>(&self, canvas: &mut ScanCanvas, column: usize) {
        let limit = S::splat(self.order.lidar.range_m as f32);
        let [first, last] = self.heights_above_ground();
        let height = at_share(canvas, column, first, last);
        for group in 0..canvas.groups {
            let place = column * canvas.groups + group;
            let z = S::load(&canvas.direction[2][place]);
            self.lay::<S>(canvas, place, height, (S::splat(-height) / z, limit), z);
        }
    }

    #[inline(always)]
    fn lay<S: Simd>(
        &self,
        canvas: &mut ScanCanvas,
        place: usize,
        height: f32,
        (t, limit): (S::F, S::F),
        incidence: S::F,
    ) {
        let is_hit = S::both(S::lt(S::splat(0.0), t), S::lt(t, limit));
        let is_hit = if height > 0.0 { is_hit } else { S::mask(0) };
        S::store(S::select(is_hit, t, limit), &mut canvas.t[place]);
        S::store(incidence, &mut canvas.incidence[place]);
        S::store_words(S::splat_words(GROUND), &mut canvas.object[place]);
        let word = S::select(
            is_hit,
            S::floats(S::splat_words(Tag::Ground as u32)),
            S::floats(S::splat_words(NOTHING)),
        );
        S::store_words(S::words(word), &mut canvas.word[place]);
    }
}

/// Sixteen numbers from `at` on.
#[inline(always)]
fn row(of: &[f64], at: usize) -> &[f64; WIDTH] {
    // A span and its last chunk reach no further than `SPAN` beyond a rotation: the table is that much longer.
    of[at..].first_chunk().unwrap_or(&[0.0; WIDTH])
}

/// A value between those at both ends of the span.
#[inline(always)]
fn at_share(canvas: &ScanCanvas, column: usize, first: f32, last: f32) -> f32 {
    first + canvas.columns[column / WIDTH].share.0[column % WIDTH] * (last - first)
}

/// Horizontal directions right and left of the first `count` rays of a column of one group; zeros where they spread too far.
fn wedge(canvas: &ScanCanvas, column: usize, count: usize) -> [[f32; 2]; 2] {
    let direction = |ray: usize| [0, 1].map(|axis: usize| canvas.direction[axis][column].0[ray]);
    let [a, b] = direction(0);
    let (mut least, mut most) = (0.0_f32, 0.0_f32);
    for ray in 0..count {
        let [x, y] = direction(ray);
        let (along, aside) = (a * x + b * y, a * y - b * x);
        if along < 1e-3 {
            return [[0.0; 2]; 2];
        }
        let slope = aside / along;
        (least, most) = (least.min(slope), most.max(slope));
    }
    let turned = |slope: f32| [a - slope * b, b + slope * a];
    [turned(least - 1e-6), turned(most + 1e-6)]
}
