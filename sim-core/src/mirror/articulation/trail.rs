//! The path that the front of a vehicle has driven.

use std::collections::VecDeque;

use super::FrontOfBody;
use crate::scene::shape::Point;

/// Distance between two points of a trail, metres.
pub(super) const TRAIL_STEP_M: f64 = 0.25;

/// The path of a vehicle's front, from its tail to its newest point.
#[derive(Debug, Clone, Default)]
pub(super) struct Trail {
    points: VecDeque<TrailPoint>,
    /// Where the front is now.
    pub(super) head: TrailPoint,
}

/// A point of the path of a vehicle's front.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TrailPoint {
    /// Distance driven, metres.
    station_m: f64,
    pub(super) place_m: Point,
    /// Height of the vehicle's origin at that time, metres.
    pub(super) origin_z_m: f64,
}

impl Trail {
    /// A straight way of `length_m` on a slope (its tangent) that ends at the front of a body whose origin has this height.
    pub(super) fn straight(front: &FrontOfBody, origin_z_m: f64, slope: f64, length_m: f64) -> Self {
        let [cos, sin] = front.heading;
        let point = |behind_m: f64| TrailPoint {
            station_m: -behind_m,
            place_m: [front.place_m[0] - behind_m * cos, front.place_m[1] - behind_m * sin],
            origin_z_m: origin_z_m - behind_m * slope,
        };
        Self {
            points: VecDeque::from([point(length_m), point(0.0)]),
            head: point(0.0),
        }
    }

    /// Takes the front's next place.
    pub(super) fn advance(&mut self, place_m: Point, origin_z_m: f64) {
        let way = [place_m[0] - self.head.place_m[0], place_m[1] - self.head.place_m[1]];
        let station_m = self.head.station_m + (way[0] * way[0] + way[1] * way[1]).sqrt();
        self.head = TrailPoint {
            station_m,
            place_m,
            origin_z_m,
        };
        let last_m = self.points.back().map_or(f64::NEG_INFINITY, |point| point.station_m);
        if station_m - last_m >= TRAIL_STEP_M {
            self.points.push_back(self.head);
        }
    }

    /// Forgets what is more than `length_m` behind the front.
    pub(super) fn shorten(&mut self, length_m: f64) {
        let needed_m = self.head.station_m - length_m;
        while self.points.len() > 2 && self.points[1].station_m < needed_m {
            self.points.pop_front();
        }
    }

    /// The point `behind_m` behind the front along the path: on the cubic through two points with the directions that their neighbours
    /// give (Catmull and Rom), so that what moves along the path turns without jumps. A trail that is too short continues straight on.
    pub(super) fn at(&self, behind_m: f64) -> TrailPoint {
        let station_m = self.head.station_m - behind_m;
        let next = self.points.partition_point(|point| point.station_m < station_m).max(1);
        let (from, to) = (self.point(next - 1), self.point(next));
        let length_m = to.station_m - from.station_m;
        if length_m <= 0.0 {
            return from;
        }
        let share = (station_m - from.station_m) / length_m;
        let [before, after] = [next.saturating_sub(2), next + 1].map(|place| self.point(place));
        let slope = |a: &TrailPoint, b: &TrailPoint, axis: usize| {
            let apart_m = b.station_m - a.station_m;
            let way = if apart_m > 0.0 {
                (b.place_m[axis] - a.place_m[axis]) / apart_m
            } else {
                0.0
            };
            way * length_m
        };
        let [square, cube] = [share * share, share * share * share];
        let place = |axis: usize| {
            let [p, q] = [from.place_m[axis], to.place_m[axis]];
            // Beyond its ends the path is straight.
            if !(0.0..=1.0).contains(&share) {
                return p + share * (q - p);
            }
            let [m, n] = [slope(&before, &to, axis), slope(&from, &after, axis)];
            p + (3.0 * square - 2.0 * cube) * (q - p) + (cube - 2.0 * square + share) * m + (cube - square) * n
        };
        TrailPoint {
            station_m,
            place_m: [place(0), place(1)],
            origin_z_m: from.origin_z_m + share * (to.origin_z_m - from.origin_z_m),
        }
    }

    /// A point by its number; behind the last one the front.
    fn point(&self, number: usize) -> TrailPoint {
        self.points.get(number).copied().unwrap_or(self.head)
    }

    /// Moves every point by a motion, and up.
    pub(super) fn moved(&mut self, motion: &RigidMotion, rise_m: f64) {
        for point in self.points.iter_mut().chain(std::iter::once(&mut self.head)) {
            point.place_m = motion.of(point.place_m);
            point.origin_z_m += rise_m;
        }
    }
}

/// A motion of the plane that keeps distances.
pub(super) struct RigidMotion {
    from_m: Point,
    to_m: Point,
    turn: Point,
}

impl RigidMotion {
    pub(super) fn new((from_m, from_rad): (Point, f64), (to_m, to_rad): (Point, f64)) -> Self {
        let (sin, cos) = libm::sincos(to_rad - from_rad);
        Self {
            from_m,
            to_m,
            turn: [cos, sin],
        }
    }

    pub(super) fn of(&self, point: Point) -> Point {
        let ([cos, sin], [x, y]) = (self.turn, [point[0] - self.from_m[0], point[1] - self.from_m[1]]);
        [self.to_m[0] + cos * x - sin * y, self.to_m[1] + sin * x + cos * y]
    }
}
