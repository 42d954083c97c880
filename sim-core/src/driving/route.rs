//! The line that a hero should follow, by arc length ("station").

use ipc_schema::traffic::{NO_SIGNAL, ON_EDGE, RIGHT_OF_WAY, RoutePoint};

/// A traffic light on the route.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StopLine {
    /// Distance from the start of the route, metres.
    pub station_m: f64,
    /// Number of the traffic light.
    pub signal: u32,
    /// Its link.
    pub link: u32,
}

/// A way of the route across a junction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// Station at which it begins, metres.
    pub from_m: f64,
    /// Station at which it ends, metres.
    pub to_m: f64,
    /// No vehicle has precedence, where no traffic light decides.
    pub has_right_of_way: bool,
}

/// A position relative to the route.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RoutePosition {
    /// Station of the nearest point of the route, metres.
    pub station_m: f64,
    /// Distance from the route, positive to its left, metres.
    pub left_m: f64,
    /// Direction of the route there, of length one.
    pub direction: [f64; 2],
}

/// A polyline with speed limits and stop lines.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HeroRoute {
    points_m: Vec<[f64; 2]>,
    stations_m: Vec<f64>,
    speed_limits_mps: Vec<f32>,
    stop_lines: Vec<StopLine>,
    crossings: Vec<Crossing>,
    /// The newest point lies on a way across a junction.
    crosses: bool,
    first_edge_m: f64,
}

impl HeroRoute {
    /// Adds the next point.
    pub fn push(&mut self, point: &RoutePoint) {
        let here = [point.x_m, point.y_m];
        let station_m = match (self.points_m.last(), self.stations_m.last()) {
            (Some(last), Some(station_m)) => station_m + distance_m(*last, here),
            _ => 0.0,
        };
        self.points_m.push(here);
        self.stations_m.push(station_m);
        self.speed_limits_mps.push(point.speed_limit_mps);
        if point.edge == 0 {
            self.first_edge_m = station_m;
        }
        if let Some(crossing) = self.crossings.last_mut().filter(|_| self.crosses) {
            crossing.to_m = station_m;
        }
        let crosses = point.way != ON_EDGE;
        if crosses && !self.crosses {
            self.crossings.push(Crossing {
                from_m: station_m,
                to_m: station_m,
                has_right_of_way: point.way == RIGHT_OF_WAY,
            });
        }
        self.crosses = crosses;
        if point.signal != NO_SIGNAL {
            self.stop_lines.push(StopLine {
                station_m,
                signal: point.signal,
                link: point.link,
            });
        }
    }

    /// Metres from its first point to its last.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.stations_m.last().copied().unwrap_or(0.0)
    }

    /// Station at the end of its first edge, metres.
    #[must_use]
    pub fn first_edge_m(&self) -> f64 {
        self.first_edge_m
    }

    /// Stop lines in the order of the route.
    #[must_use]
    pub fn stop_lines(&self) -> &[StopLine] {
        &self.stop_lines
    }

    /// Ways across junctions in the order of the route.
    #[must_use]
    pub fn crossings(&self) -> &[Crossing] {
        &self.crossings
    }

    /// Speed limit at a station, m/s; 0 without points.
    #[must_use]
    pub fn speed_limit_mps(&self, station_m: f64) -> f32 {
        let place = self.stations_m.partition_point(|start| *start <= station_m);
        self.speed_limits_mps
            .get(place.saturating_sub(1))
            .copied()
            .unwrap_or(0.0)
    }

    /// The point at a station, straight on beyond the ends; `None` with fewer than two points.
    #[must_use]
    pub fn at(&self, station_m: f64) -> Option<[f64; 2]> {
        let last = self.points_m.len().checked_sub(2)?;
        let place = self.stations_m.partition_point(|start| *start <= station_m);
        let segment = place.saturating_sub(1).min(last);
        let ([ax, ay], [bx, by]) = (self.points_m[segment], self.points_m[segment + 1]);
        let (start, end) = (self.stations_m[segment], self.stations_m[segment + 1]);
        let t = (station_m - start) / (end - start);
        Some([ax + t * (bx - ax), ay + t * (by - ay)])
    }

    /// The position of `point` relative to the part of the route between two stations; `None` if no segment lies there.
    #[must_use]
    pub fn project(&self, point: [f64; 2], from_m: f64, to_m: f64) -> Option<RoutePosition> {
        let first = self.stations_m.partition_point(|end| *end < from_m).saturating_sub(1);
        let mut nearest: Option<(f64, RoutePosition)> = None;
        for segment in first..self.points_m.len().saturating_sub(1) {
            if self.stations_m[segment] > to_m {
                break;
            }
            let (square, place) = self.beside(segment, point);
            if nearest.is_none_or(|(least, _)| square < least) {
                nearest = Some((square, place));
            }
        }
        nearest.map(|(_, place)| place)
    }

    /// Square of the distance to a segment, and the position relative to it.
    fn beside(&self, segment: usize, [x, y]: [f64; 2]) -> (f64, RoutePosition) {
        let ([ax, ay], [bx, by]) = (self.points_m[segment], self.points_m[segment + 1]);
        let length_m = self.stations_m[segment + 1] - self.stations_m[segment];
        let [ux, uy] = [(bx - ax) / length_m, (by - ay) / length_m];
        let along_m = ((x - ax) * ux + (y - ay) * uy).clamp(0.0, length_m);
        let (dx, dy) = (x - ax - along_m * ux, y - ay - along_m * uy);
        let square = dx * dx + dy * dy;
        let side = if ux * dy - uy * dx < 0.0 { -1.0 } else { 1.0 };
        let place = RoutePosition {
            station_m: self.stations_m[segment] + along_m,
            left_m: side * square.sqrt(),
            direction: [ux, uy],
        };
        (square, place)
    }
}

fn distance_m([ax, ay]: [f64; 2], [bx, by]: [f64; 2]) -> f64 {
    libm::hypot(bx - ax, by - ay)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 100 m east, then 50 m north.
    fn corner() -> HeroRoute {
        let mut route = HeroRoute::default();
        for (index, (x_m, y_m)) in [(0.0, 0.0), (100.0, 0.0), (100.0, 50.0)].into_iter().enumerate() {
            route.push(&RoutePoint {
                x_m,
                y_m,
                speed_limit_mps: 10.0 + index as f32,
                edge: index as u32,
                signal: if index == 1 { 3 } else { NO_SIGNAL },
                way: if index == 1 { RIGHT_OF_WAY } else { ON_EDGE },
                ..RoutePoint::default()
            });
        }
        route
    }

    #[test]
    fn stations_points_and_limits() {
        let route = corner();
        assert_eq!(route.length_m(), 150.0);
        assert_eq!(route.at(120.0), Some([100.0, 20.0]));
        assert_eq!(route.at(160.0), Some([100.0, 60.0]));
        assert_eq!(
            (route.speed_limit_mps(99.0), route.speed_limit_mps(100.0)),
            (10.0, 11.0)
        );
        assert_eq!(route.stop_lines()[0].station_m, 100.0);
        let crossing = Crossing {
            from_m: 100.0,
            to_m: 150.0,
            has_right_of_way: true,
        };
        assert_eq!(route.crossings(), [crossing]);
        assert_eq!(HeroRoute::default().at(0.0), None);
    }

    #[test]
    fn left_is_positive_and_the_window_keeps_to_its_part() {
        let route = corner();
        let place = route.project([30.0, 2.0], 0.0, 50.0).unwrap();
        assert_eq!(
            (place.station_m, place.left_m, place.direction),
            (30.0, 2.0, [1.0, 0.0])
        );
        let place = route.project([101.0, 40.0], 90.0, 150.0).unwrap();
        assert_eq!((place.station_m, place.left_m), (140.0, -1.0));
        // The second segment begins beyond the window.
        assert_eq!(route.project([101.0, 40.0], 0.0, 99.0).unwrap().station_m, 100.0);
    }
}
