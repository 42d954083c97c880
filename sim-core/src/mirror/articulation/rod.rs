//! A rod that is drawn by its front end: a trailer between pivot and axle.

use crate::scene::shape::{Point, cross, dot, from_to};

/// A rod whose front end is drawn.
#[derive(Debug, Clone, Copy)]
pub(super) struct DrawnRod {
    pub(super) length_m: f64,
    pub(super) front_m: Point,
    /// Unit vector from its rear to its front end.
    pub(super) along: Point,
}

impl DrawnRod {
    /// Draws its front end straight to a point: the tangent of half the angle between rod and way falls by `e^(−way / length)`, exactly.
    pub(super) fn draw(&mut self, to_m: Point) {
        let way = from_to(self.front_m, to_m);
        self.front_m = to_m;
        let way_m = dot(way, way).sqrt();
        if way_m <= 0.0 {
            return;
        }
        let way = [way[0] / way_m, way[1] / way_m];
        let (cosine, sine) = (dot(way, self.along), cross(way, self.along));
        // A rod that is pushed straight back stays straight.
        if cosine <= -1.0 {
            return;
        }
        let half = sine / (1.0 + cosine) * libm::exp(-way_m / self.length_m);
        let square = half * half;
        let [cosine, sine] = [(1.0 - square) / (1.0 + square), 2.0 * half / (1.0 + square)];
        self.along = [way[0] * cosine - way[1] * sine, way[1] * cosine + way[0] * sine];
    }

    /// Its rear end.
    pub(super) fn rear_m(&self) -> Point {
        [0, 1].map(|axis: usize| self.front_m[axis] - self.length_m * self.along[axis])
    }
}
