//! The kernel: finds the surface that each ray of a span meets first.
//!
//! Surfaces are rasterised one after the other, nearest first, into a buffer of distances. A surface is compared with sixteen columns
//! at a time (is it in their azimuth, and nearer than the distances so far?), and in the remaining columns with sixteen rays at a time. Positions are relative to the sensor: differences are taken in double
//! precision, the rest is single. Within a span every quantity of a surface is linear in time.
//!
//! There are two modes. An upright sensor with its lasers in one plane meets a wall at one horizontal distance in the whole column, and
//! `t` is that distance. Any other sensor has a direction for each ray, and `t` is the range. A corner is tested by the same expression
//! for both walls that share it, so that no ray slips through between them.

use super::{
    simd::{Floats, Simd, WIDTH, Words},
    solids::NOTHING,
};

/// Sixteen columns, four times.
pub(super) const CHUNKS: usize = super::firing::SPAN / WIDTH;

/// A value that is linear over the span: its value at the first column, and the difference at the last.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LinearValue(pub(super) f32, pub(super) f32);

impl LinearValue {
    /// From the values at both ends.
    #[inline(always)]
    pub(super) fn between(first: f64, last: f64) -> Self {
        Self(first as f32, (last - first) as f32)
    }

    #[inline(always)]
    pub(super) fn at<S: Simd>(self, share: S::F) -> S::F {
        S::splat(self.0) + share * S::splat(self.1)
    }
}

/// Two values at a share of the span. There is no closure over vectors here: the compiler does not always inline one, and then the
/// vectors go through memory.
#[inline(always)]
fn at2<S: Simd>(lines: &[LinearValue; 2], share: S::F) -> [S::F; 2] {
    [lines[0].at::<S>(share), lines[1].at::<S>(share)]
}

#[inline(always)]
pub(super) fn splat2<S: Simd>(values: [f32; 2]) -> [S::F; 2] {
    [S::splat(values[0]), S::splat(values[1])]
}

/// A wall as the sensor sees it during a span.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SpanWall {
    /// Corners, counter-clockwise about the solid, relative to the sensor.
    pub(super) p: [LinearValue; 2],
    pub(super) q: [LinearValue; 2],
    /// Outwards.
    pub(super) normal: [LinearValue; 2],
    /// `normal · p`: negative if the sensor is in front of the wall.
    pub(super) offset: LinearValue,
}

/// The object that a surface belongs to, and bounds of the surface.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SurfaceBody {
    pub(super) object: u32,
    pub(super) word: u32,
    /// Lowest and highest point relative to the sensor.
    pub(super) z: [LinearValue; 2],
    /// No part is nearer horizontally.
    pub(super) near: f32,
    /// First and last chunk of the span that may see it.
    pub(super) chunks: [usize; 2],
}

/// A wall in sixteen columns.
struct Columns {
    p: [Floats; 2],
    q: [Floats; 2],
    normal: [Floats; 2],
    offset: Floats,
    z: [Floats; 2],
}

/// Results of a span, and its columns.
#[derive(Debug, Default)]
pub(super) struct ScanCanvas {
    /// Groups in a column.
    pub(super) groups: usize,
    /// Columns.
    pub(super) count: usize,
    pub(super) columns: [ColumnChunk; CHUNKS],
    /// By column, then group: horizontal distance or range, cosine of incidence (in the upright way over the cosine of the
    /// elevation), object and word.
    pub(super) t: Vec<Floats>,
    pub(super) incidence: Vec<Floats>,
    pub(super) object: Vec<Words>,
    pub(super) word: Vec<Words>,
    /// Directions in world axes, for sensors that need one for each ray.
    pub(super) direction: [Vec<Floats>; 3],
    /// Tangents and cotangents of the elevations, by group, for the other sensors.
    pub(super) tan: Vec<Floats>,
    pub(super) cot: Vec<Floats>,
    crossings: Vec<(Floats, u32)>,
    /// Random numbers: standard normal, and in (0, 1).
    pub(super) normal: Vec<Floats>,
    pub(super) uniform: Vec<Floats>,
}

/// Sixteen columns.
#[derive(Debug, Clone, Copy)]
pub(super) struct ColumnChunk {
    /// Share of the span's time.
    pub(super) share: Floats,
    /// Horizontal directions: of the column, and such that all its rays lie between the rightmost and the leftmost.
    pub(super) ahead: [Floats; 2],
    pub(super) right: [Floats; 2],
    pub(super) left: [Floats; 2],
    /// The rays come no farther than this.
    pub(super) far: Floats,
    /// Sine and cosine of the azimuth in the sensor's frame.
    pub(super) azimuth: [Floats; 2],
    /// Before the end of the tick, microseconds.
    pub(super) age_us: Words,
    /// Axes in the world, of sensors that lean: ahead, left, up.
    pub(super) axes: [[Floats; 3]; 3],
}

impl Default for ColumnChunk {
    fn default() -> Self {
        let none = [Floats::ZERO; 2];
        Self {
            share: Floats::ZERO,
            ahead: none,
            right: none,
            left: none,
            far: Floats::ZERO,
            azimuth: none,
            age_us: Words::ZERO,
            axes: [[Floats::ZERO; 3]; 3],
        }
    }
}

/// z of the cross product.
#[inline(always)]
fn cross<S: Simd>(a: [S::F; 2], b: [S::F; 2]) -> S::F {
    a[0] * b[1] - a[1] * b[0]
}

#[inline(always)]
fn dot<S: Simd>(a: [S::F; 2], b: [S::F; 2]) -> S::F {
    a[0] * b[0] + a[1] * b[1]
}

#[inline(always)]
fn load2<S: Simd>(from: &[Floats; 2]) -> [S::F; 2] {
    [S::load(&from[0]), S::load(&from[1])]
}

#[inline(always)]
fn stored<S: Simd>(value: S::F) -> Floats {
    let mut to = Floats::ZERO;
    S::store(value, &mut to);
    to
}

#[inline(always)]
fn stored2<S: Simd>(value: [S::F; 2]) -> [Floats; 2] {
    [stored::<S>(value[0]), stored::<S>(value[1])]
}

/// Numbers of the bits that are set.
#[inline(always)]
pub(super) fn set(mut bits: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let element = bits.trailing_zeros() as usize;
        let is_any = bits != 0;
        bits &= bits.wrapping_sub(1);
        is_any.then_some(element)
    })
}

impl ScanCanvas {
    /// Room for the groups of `columns` columns.
    pub(super) fn make_room(&mut self, groups: usize) {
        let places = super::firing::SPAN * groups;
        self.groups = groups;
        if self.t.len() < places {
            self.t.resize(places, Floats::ZERO);
            self.normal.resize(places, Floats::ZERO);
            self.uniform.resize(places, Floats::ZERO);
            self.incidence.resize(places, Floats::ZERO);
            self.object.resize(places, Words::ZERO);
            self.word.resize(places, Words::ZERO);
            self.direction
                .iter_mut()
                .for_each(|axis| axis.resize(places, Floats::ZERO));
        }
    }

    /// Directions of the rays of a place.
    #[inline(always)]
    pub(super) fn ray<S: Simd>(&self, place: usize) -> [S::F; 3] {
        let [x, y, z] = &self.direction;
        [S::load(&x[place]), S::load(&y[place]), S::load(&z[place])]
    }

    /// Chunks of the span.
    #[inline(always)]
    pub(super) fn chunks(&self) -> usize {
        self.count.div_ceil(WIDTH)
    }

    /// Columns of a chunk that exist.
    #[inline(always)]
    pub(super) fn live(&self, chunk: usize) -> u32 {
        let count = self.count.saturating_sub(chunk * WIDTH).min(WIDTH);
        ((1_u64 << count) - 1) as u32
    }

    /// Sets the rays of a column to no hit within `range`. What else there is of a ray is read of hits alone.
    #[inline(always)]
    pub(super) fn clear<S: Simd>(&mut self, column: usize, range: S::F) {
        for place in column * self.groups..(column + 1) * self.groups {
            S::store(range, &mut self.t[place]);
            S::store_words(S::splat_words(NOTHING), &mut self.word[place]);
        }
    }

    /// Sets the rays of `mask` in a place, which reached `best` so far, to a hit on `body`, and returns how far they reach. The distance
    /// is stored without a mask: the next surface loads it, and a processor does not forward a masked store to a load.
    #[inline(always)]
    pub(super) fn put<S: Simd>(
        &mut self,
        place: usize,
        mask: S::M,
        (t, best): (S::F, S::F),
        incidence: S::F,
        body: &SurfaceBody,
    ) -> S::F {
        let now = S::select(mask, t, best);
        S::store(now, &mut self.t[place]);
        S::store_where(mask, incidence, &mut self.incidence[place]);
        S::store_words_where(mask, body.object, &mut self.object[place]);
        S::store_words_where(mask, body.word, &mut self.word[place]);
        now
    }

    /// Sets how far the rays of a column reach.
    #[inline(always)]
    fn limit<S: Simd>(&mut self, column: usize, far: S::F) {
        self.columns[column / WIDTH].far.0[column % WIDTH] = S::largest(far);
    }

    /// Draws a wall.
    #[inline(always)]
    pub(super) fn wall<S: Simd, const UPRIGHT: bool>(&mut self, wall: &SpanWall, body: &SurfaceBody) {
        for chunk in body.chunks[0]..=body.chunks[1] {
            let columns = &self.columns[chunk];
            let share = S::load(&columns.share);
            let far = S::load(&columns.far);
            let near = S::lt(S::splat(body.near), far);
            if S::bits(near) == 0 {
                continue;
            }
            let (p, q) = (at2::<S>(&wall.p, share), at2::<S>(&wall.q, share));
            let zero = S::splat(0.0);
            // The left corner is not right of all rays, the right one not left of all.
            let left = S::le(zero, cross::<S>(load2::<S>(&columns.right), p));
            let right = cross::<S>(load2::<S>(&columns.left), q);
            let right = if UPRIGHT {
                S::lt(right, zero)
            } else {
                S::le(right, zero)
            };
            let offset = wall.offset.at::<S>(share);
            let mut seen = S::both(S::both(left, right), S::both(near, S::lt(offset, zero)));
            let live = self.live(chunk);
            if S::bits(seen) & live == 0 {
                continue;
            }
            let normal = at2::<S>(&wall.normal, share);
            let z = at2::<S>(&body.z, share);
            if UPRIGHT {
                let facing = dot::<S>(normal, load2::<S>(&columns.ahead));
                let t = offset / facing;
                seen = S::both(seen, S::lt(t, far));
                let (t, incidence) = (stored::<S>(t), stored::<S>(facing));
                let z = [stored::<S>(z[0]), stored::<S>(z[1])];
                for element in set(S::bits(seen) & live) {
                    let z = [z[0].0[element], z[1].0[element]];
                    self.wall_upright::<S>(chunk * WIDTH + element, t.0[element], incidence.0[element], z, body);
                }
            } else {
                let columns = Columns {
                    p: stored2::<S>(p),
                    q: stored2::<S>(q),
                    normal: stored2::<S>(normal),
                    offset: stored::<S>(offset),
                    z: stored2::<S>(z),
                };
                for element in set(S::bits(seen) & live) {
                    self.wall_tilted::<S>(chunk * WIDTH + element, element, &columns, body);
                }
            }
        }
    }

    #[inline(always)]
    fn wall_upright<S: Simd>(&mut self, column: usize, t: f32, incidence: f32, z: [f32; 2], body: &SurfaceBody) {
        let t = S::splat(t);
        let [low, high] = splat2::<S>(z);
        let mut far = S::splat(0.0);
        for group in 0..self.groups {
            let place = column * self.groups + group;
            let height = t * S::load(&self.tan[group]);
            let best = S::load(&self.t[place]);
            let inside = S::both(S::le(low, height), S::le(height, high));
            let mask = S::both(inside, S::lt(t, best));
            far = S::max(far, self.put::<S>(place, mask, (t, best), S::splat(incidence), body));
        }
        self.limit::<S>(column, far);
    }

    #[inline(always)]
    fn wall_tilted<S: Simd>(&mut self, column: usize, element: usize, at: &Columns, body: &SurfaceBody) {
        let splat2 = |of: &[Floats; 2]| [S::splat(of[0].0[element]), S::splat(of[1].0[element])];
        let (p, q, normal) = (splat2(&at.p), splat2(&at.q), splat2(&at.normal));
        let [low, high] = splat2(&at.z);
        let offset = S::splat(at.offset.0[element]);
        let zero = S::splat(0.0);
        let mut far = S::splat(0.0);
        for group in 0..self.groups {
            let place = column * self.groups + group;
            let [x, y, z] = self.ray::<S>(place);
            let between = S::both(S::le(zero, cross::<S>([x, y], p)), S::lt(cross::<S>([x, y], q), zero));
            let facing = dot::<S>(normal, [x, y]);
            let t = offset / facing;
            let height = t * z;
            let inside = S::both(S::le(low, height), S::le(height, high));
            let best = S::load(&self.t[place]);
            let nearer = S::both(S::lt(t, best), S::lt(facing, zero));
            let mask = S::both(S::both(between, inside), nearer);
            far = S::max(far, self.put::<S>(place, mask, (t, best), facing, body));
        }
        self.limit::<S>(column, far);
    }

    /// Draws a roof or an underside at height `z`, over the outline of `walls`: a point is inside if the ray's line has crossed an odd
    /// number of walls before it.
    #[inline(always)]
    pub(super) fn cap<S: Simd, const UPRIGHT: bool>(&mut self, walls: &[SpanWall], z: LinearValue, body: &SurfaceBody) {
        for chunk in body.chunks[0]..=body.chunks[1] {
            let columns = self.columns[chunk];
            let near = S::bits(S::lt(S::splat(body.near), S::load(&columns.far))) & self.live(chunk);
            if near == 0 {
                continue;
            }
            let heights = stored::<S>(z.at::<S>(S::load(&columns.share)));
            if UPRIGHT {
                let crossed = self.cross::<S>(walls, &columns);
                for element in set(near & crossed) {
                    self.cap_upright::<S>(chunk * WIDTH + element, element, heights.0[element], body);
                }
            } else {
                for element in set(near) {
                    let share = columns.share.0[element];
                    self.cap_tilted::<S>(chunk * WIDTH + element, share, heights.0[element], walls, body);
                }
            }
        }
    }

    /// Computes where the columns of a chunk cross each wall, and returns the columns that cross any.
    #[inline(always)]
    fn cross<S: Simd>(&mut self, walls: &[SpanWall], columns: &ColumnChunk) -> u32 {
        let (share, ahead, zero) = (S::load(&columns.share), load2::<S>(&columns.ahead), S::splat(0.0));
        self.crossings.clear();
        let mut any = 0;
        for wall in walls {
            let (p, q) = (at2::<S>(&wall.p, share), at2::<S>(&wall.q, share));
            let crossed = S::differ(S::le(zero, cross::<S>(ahead, p)), S::le(zero, cross::<S>(ahead, q)));
            let facing = dot::<S>(at2::<S>(&wall.normal, share), ahead);
            let t = wall.offset.at::<S>(share) / facing;
            any |= S::bits(crossed);
            self.crossings.push((stored::<S>(t), S::bits(crossed)));
        }
        any
    }

    #[inline(always)]
    fn cap_upright<S: Simd>(&mut self, column: usize, element: usize, height: f32, body: &SurfaceBody) {
        let (height, zero) = (S::splat(height), S::splat(0.0));
        let mut far = S::splat(0.0);
        for group in 0..self.groups {
            let place = column * self.groups + group;
            let t = height * S::load(&self.cot[group]);
            let best = S::load(&self.t[place]);
            let nearer = S::both(S::lt(zero, t), S::lt(t, best));
            let mut inside = S::mask(0);
            for (crossing, crossed) in &self.crossings {
                if crossed >> element & 1 == 1 {
                    inside = S::differ(inside, S::lt(S::splat(crossing.0[element]), t));
                }
            }
            let mask = S::both(nearer, inside);
            let tan = S::load(&self.tan[group]);
            far = S::max(far, self.put::<S>(place, mask, (t, best), tan, body));
        }
        self.limit::<S>(column, far);
    }

    #[inline(always)]
    fn cap_tilted<S: Simd>(&mut self, column: usize, share: f32, height: f32, walls: &[SpanWall], body: &SurfaceBody) {
        let (height, zero, share) = (S::splat(height), S::splat(0.0), S::splat(share));
        let mut far = S::splat(0.0);
        for group in 0..self.groups {
            let place = column * self.groups + group;
            let [x, y, z] = self.ray::<S>(place);
            let t = height / z;
            let best = S::load(&self.t[place]);
            let nearer = S::both(S::lt(zero, t), S::lt(t, best));
            if S::bits(nearer) == 0 {
                far = S::max(far, best);
                continue;
            }
            let mut inside = S::mask(0);
            for wall in walls {
                let (p, q) = (at2::<S>(&wall.p, share), at2::<S>(&wall.q, share));
                let crossed = S::differ(S::le(zero, cross::<S>([x, y], p)), S::le(zero, cross::<S>([x, y], q)));
                let facing = dot::<S>(at2::<S>(&wall.normal, share), [x, y]);
                // offset / facing < t, without the division.
                let behind = S::lt(wall.offset.at::<S>(share), facing * t);
                let before = S::differ(behind, S::lt(facing, zero));
                inside = S::differ(inside, S::both(crossed, before));
            }
            let mask = S::both(nearer, inside);
            far = S::max(far, self.put::<S>(place, mask, (t, best), z, body));
        }
        self.limit::<S>(column, far);
    }

    /// Draws an upright cylinder: mantle and top.
    #[inline(always)]
    pub(super) fn cylinder<S: Simd, const UPRIGHT: bool>(
        &mut self,
        centre: [LinearValue; 2],
        radius: f32,
        body: &SurfaceBody,
    ) {
        for chunk in body.chunks[0]..=body.chunks[1] {
            let columns = self.columns[chunk];
            let share = S::load(&columns.share);
            let near = S::bits(S::lt(S::splat(body.near), S::load(&columns.far))) & self.live(chunk);
            if near == 0 {
                continue;
            }
            let at = at2::<S>(&centre, share);
            // The centre is within a radius of the columns' wedge.
            let reach = S::splat(-1.001 * radius);
            let left = S::le(reach, cross::<S>(load2::<S>(&columns.right), at));
            let right = S::le(reach, cross::<S>(at, load2::<S>(&columns.left)));
            let seen = S::bits(S::both(left, right)) & near;
            let at = stored2::<S>(at);
            let z = [
                stored::<S>(body.z[0].at::<S>(share)),
                stored::<S>(body.z[1].at::<S>(share)),
            ];
            for element in set(seen) {
                let centre = [at[0].0[element], at[1].0[element]];
                let ahead = [columns.ahead[0].0[element], columns.ahead[1].0[element]];
                let z = [z[0].0[element], z[1].0[element]];
                self.cylinder_column::<S, UPRIGHT>(chunk * WIDTH + element, centre, radius, ahead, z, body);
            }
        }
    }

    #[inline(always)]
    fn cylinder_column<S: Simd, const UPRIGHT: bool>(
        &mut self,
        column: usize,
        centre: [f32; 2],
        radius: f32,
        ahead: [f32; 2],
        z: [f32; 2],
        body: &SurfaceBody,
    ) {
        let (at, radius, zero) = (splat2::<S>(centre), S::splat(radius), S::splat(0.0));
        let [low, high] = splat2::<S>(z);
        let mut far = S::splat(0.0);
        for group in 0..self.groups {
            let place = column * self.groups + group;
            // Direction with the scale of `t`, and its horizontal part squared.
            let (flat, up, square) = if UPRIGHT {
                (splat2::<S>(ahead), S::load(&self.tan[group]), S::splat(1.0))
            } else {
                let [x, y, z] = self.ray::<S>(place);
                ([x, y], z, x * x + y * y)
            };
            let along = dot::<S>(flat, at);
            let off = cross::<S>(flat, at);
            let root2 = square * radius * radius - off * off;
            let root = S::sqrt(S::max(root2, zero));
            let best = S::load(&self.t[place]);
            let meets = S::lt(zero, root2);
            let t = (along - root) / square;
            let height = t * up;
            let inside = S::both(S::le(low, height), S::le(height, high));
            let mantle = S::both(S::both(meets, inside), S::both(S::lt(zero, t), S::lt(t, best)));
            let best = self.put::<S>(place, mantle, (t, best), root / radius, body);
            // The top, for a sensor above it.
            let t = high / up;
            let within = S::both(S::lt(along - root, t * square), S::lt(t * square, along + root));
            let below = S::both(S::lt(high, zero), S::lt(zero, t));
            let nearer = S::both(below, S::lt(t, best));
            let top = S::both(S::both(meets, within), nearer);
            far = S::max(far, self.put::<S>(place, top, (t, best), up, body));
        }
        self.limit::<S>(column, far);
    }
}
