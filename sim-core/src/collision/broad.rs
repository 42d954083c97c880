//! Broad phase: pairs of road users whose surrounding rectangles meet, by a hashed grid that is built again every tick.
//!
//! Cells are as wide as the largest body, so partners are in the same or a neighbouring cell. The hash is linear in the column,
//! so three neighbouring cells of a row are one range of memory; two ranges cover half the neighbourhood, and each pair is
//! seen from one side. Nothing is allocated once the buffers have grown.

use super::body::CollisionBody;
use crate::scene::shape::Point;

/// Bodies that reach farther than this (trains) are compared with all others instead of widening the cells, metres.
pub(super) const LARGE_M: f64 = 12.0;
/// Fixed point of the rectangles: parts of a metre.
const PER_METRE: f64 = 512.0;
/// Row stride of the hash. Its last bits keep the ranges of two rows apart for every table size.
const STRIDE: u32 = 0x9E37_79B1;
/// Least size of the table.
const LEAST_BUCKETS: usize = 64;

/// The rectangle about a body, rounded outward.
#[derive(Debug, Clone, Copy, Default)]
struct BodyRectangle {
    min: [i32; 2],
    max: [i32; 2],
    /// Row in the world.
    row: u32,
    /// 1 if its contacts matter by themselves.
    watched: u32,
}

impl BodyRectangle {
    #[inline]
    fn meets(&self, other: &Self) -> bool {
        // `&` instead of `&&`: four comparisons cost less than a missed branch.
        (self.min[0] <= other.max[0])
            & (other.min[0] <= self.max[0])
            & (self.min[1] <= other.max[1])
            & (other.min[1] <= self.max[1])
            & (self.watched | other.watched != 0)
    }
}

/// Buffers of the broad phase.
#[derive(Debug, Default)]
pub(super) struct BroadPhase {
    entries: Vec<BodyRectangle>,
    buckets: Vec<u32>,
    /// First of `sorted` by bucket, one past the last.
    starts: Vec<u32>,
    sorted: Vec<BodyRectangle>,
    large: Vec<BodyRectangle>,
    pairs: Vec<(u32, u32)>,
}

impl BroadPhase {
    /// Pairs of rows whose rectangles meet, of which at least one is watched; the lower row first, some pairs twice. No body but
    /// the large reaches farther than `reach_m`.
    pub(super) fn pairs(&mut self, bodies: &[CollisionBody], watched: &[bool], reach_m: f64) -> &[(u32, u32)] {
        self.pairs.clear();
        self.fill(bodies, watched, reach_m);
        self.sort();
        self.neighbours();
        for (place, large) in self.large.iter().enumerate() {
            let others = self.sorted.iter().chain(&self.large[place + 1..]);
            others
                .filter(|other| large.meets(other))
                .for_each(|other| self.pairs.push(ordered(large.row, other.row)));
        }
        &self.pairs
    }

    /// Rectangles and buckets of all road users.
    fn fill(&mut self, bodies: &[CollisionBody], watched: &[bool], reach_m: f64) {
        let origin = bodies.first().map_or([0.0; 2], |body| body.solid.centre_m);
        let cells_per_m = 0.5 / reach_m.max(0.5);
        let size = bodies.len().next_power_of_two().max(LEAST_BUCKETS);
        let mask = size as u32 - 1;
        self.entries.clear();
        self.buckets.clear();
        self.large.clear();
        self.starts.clear();
        self.starts.resize(size + 1, 0);
        for ((row, body), watched) in (0_u32..).zip(bodies).zip(watched) {
            let centre = body.solid.centre_m;
            let entry = entry(body, origin, row, u32::from(*watched));
            if body.reach_m() > LARGE_M {
                self.large.push(entry);
                continue;
            }
            let [column, row] = [0, 1].map(|axis: usize| cell((centre[axis] - origin[axis]) * cells_per_m));
            let bucket = column.wrapping_add(row.wrapping_mul(STRIDE)) & mask;
            self.entries.push(entry);
            self.buckets.push(bucket);
            self.starts[bucket as usize + 1] += 1;
        }
    }

    /// Counting sort by bucket; entries of a bucket stay in order.
    fn sort(&mut self) {
        // From counts to starts, one place late: placing moves each start to its end, which is the start of the next.
        let mut sum = 0;
        for start in &mut self.starts[1..] {
            sum += std::mem::replace(start, sum);
        }
        self.sorted.clear();
        self.sorted.resize(self.entries.len(), BodyRectangle::default());
        for (entry, bucket) in self.entries.iter().zip(&self.buckets) {
            let next = &mut self.starts[*bucket as usize + 1];
            self.sorted[*next as usize] = *entry;
            *next += 1;
        }
    }

    /// Compares every entry with the rest of its cell, the cell to the right, and the three above.
    fn neighbours(&mut self) {
        let mask = (self.starts.len() - 2) as u32;
        for bucket in 0..=mask {
            let (from, to) = (self.starts[bucket as usize], self.starts[bucket as usize + 1]);
            if from == to {
                continue;
            }
            let right = bucket.wrapping_add(1) & mask;
            let right = self.range(right, right);
            let above = bucket.wrapping_add(STRIDE);
            let (low, high) = (above.wrapping_sub(1) & mask, above.wrapping_add(1) & mask);
            let above = if low <= high {
                [self.range(low, high), (0, 0)]
            } else {
                [self.range(low, mask), self.range(0, high)]
            };
            for place in from as usize..to as usize {
                let one = self.sorted[place];
                let rest = (place + 1, to as usize);
                for (from, to) in [rest, right, above[0], above[1]] {
                    for other in &self.sorted[from..to] {
                        if one.meets(other) {
                            self.pairs.push(ordered(one.row, other.row));
                        }
                    }
                }
            }
        }
    }

    fn range(&self, low: u32, high: u32) -> (usize, usize) {
        (
            self.starts[low as usize] as usize,
            self.starts[high as usize + 1] as usize,
        )
    }
}

fn ordered(a: u32, b: u32) -> (u32, u32) {
    (a.min(b), a.max(b))
}

/// Number of a cell, rounded down; far away from zero, so that truncation does it.
fn cell(value: f64) -> u32 {
    (value + f64::from(1_u32 << 30)) as u32
}

fn entry(body: &CollisionBody, origin: Point, row: u32, watched: u32) -> BodyRectangle {
    let [cos, sin] = body.solid.along.map(f64::abs);
    let [l, w] = body.solid.half_m;
    let reach = [l * cos + w * sin, l * sin + w * cos];
    let centre = [0, 1].map(|axis: usize| body.solid.centre_m[axis] - origin[axis]);
    BodyRectangle {
        min: [0, 1].map(|axis: usize| ((centre[axis] - reach[axis]) * PER_METRE) as i32 - 1),
        max: [0, 1].map(|axis: usize| ((centre[axis] + reach[axis]) * PER_METRE) as i32 + 1),
        row,
        watched,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::shape::OrientedBox;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    proptest! {
        /// Exactly the pairs that comparing all with all gives.
        #[test]
        fn no_pair_is_missed(
            bodies in prop::collection::vec((prop::array::uniform2(-120.0_f64..120.0), -3.1_f64..3.1, 0.2_f64..9.0, any::<bool>()), 0..120),
            shift in -5e6_f64..5e6, long in 12.0_f64..80.0,
        ) {
            let mut watched: Vec<bool> = bodies.iter().map(|body| body.3).collect();
            let mut bodies: Vec<CollisionBody> = bodies.iter().map(|([x, y], yaw, half, _)| CollisionBody {
                solid: OrientedBox { centre_m: [x + shift, *y], along: [yaw.cos(), yaw.sin()], half_m: [*half, 1.0], z_m: [0.0, 1.0] },
                is_capsule: false,
            }).collect();
            if bodies.len() > 2 {
                bodies[1].solid.half_m[0] = long;
                watched[1] = true;
            }
            let mut broad = BroadPhase::default();
            let reach_m = bodies.iter().map(CollisionBody::reach_m).filter(|reach_m| *reach_m <= LARGE_M).fold(0.0, f64::max);
            // Twice: buffers must not remember.
            broad.pairs(&bodies[..bodies.len() / 2], &watched, reach_m);
            let found: BTreeSet<(u32, u32)> = broad.pairs(&bodies, &watched, reach_m).iter().copied().collect();
            for a in 0..bodies.len() {
                for b in a + 1..bodies.len() {
                    let meets = bodies[a].solid.bounds().meets(&bodies[b].solid.bounds()) && (watched[a] || watched[b]);
                    let has = found.contains(&(a as u32, b as u32));
                    prop_assert!(has || !meets, "{a} {b}");
                    prop_assert!(!has || bodies[a].solid.bounds().grown(0.01).meets(&bodies[b].solid.bounds()));
                }
            }
        }
    }
}
