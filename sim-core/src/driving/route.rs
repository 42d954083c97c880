//! The line that a hero should follow, by arc length ("station").

use std::ops::Range;

use ipc_schema::traffic::{NO_SIGNAL, ON_EDGE, RIGHT_OF_WAY, RoutePoint};

/// Deceleration with which a driver is to approach a lower limit, as in a turn, m/s².
const BRAKING_MPS2: f64 = 2.0;

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
    /// Of each segment, of length one.
    directions: Vec<[f64; 2]>,
    /// Around each segment.
    boxes_m: Vec<Box2>,
    /// Of the segment that each point begins.
    speed_limits_mps: Vec<f32>,
    /// Highest speed at each point from which [`BRAKING_MPS2`] leads to all limits ahead.
    approach_speeds_mps: Vec<f64>,
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
        if let (Some([ax, ay]), Some(start_m)) = (self.points_m.last(), self.stations_m.last()) {
            let length_m = station_m - start_m;
            self.directions
                .push([(here[0] - ax) / length_m, (here[1] - ay) / length_m]);
            self.boxes_m.push(Box2::of(&[[*ax, *ay], here]));
        }
        self.points_m.push(here);
        self.stations_m.push(station_m);
        self.speed_limits_mps.push(point.speed_limit_mps);
        self.approach_speeds_mps.push(f64::from(point.speed_limit_mps));
        self.approach_newest_limit();
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

    /// Lowers the speeds before the newest point, as far as its limit asks for.
    fn approach_newest_limit(&mut self) {
        for ahead in (1..self.approach_speeds_mps.len()).rev() {
            let length_m = self.stations_m[ahead] - self.stations_m[ahead - 1];
            let approach_mps = approach_mps(self.approach_speeds_mps[ahead], length_m);
            if self.approach_speeds_mps[ahead - 1] <= approach_mps {
                return;
            }
            self.approach_speeds_mps[ahead - 1] = approach_mps;
        }
    }

    /// Metres from its first point to its last.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.stations_m.last().copied().unwrap_or(0.0)
    }

    /// Metres from a station to its end.
    #[must_use]
    pub fn left_m(&self, station_m: f64) -> f32 {
        (self.length_m() - station_m).max(0.0) as f32
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

    /// Highest speed at a station from which a braking of [`BRAKING_MPS2`] keeps this and all limits ahead, m/s; 0 without points.
    #[must_use]
    pub fn speed_limit_mps(&self, station_m: f64) -> f32 {
        let ahead = self.stations_m.partition_point(|start| *start <= station_m).max(1);
        let limit_mps = self.speed_limits_mps.get(ahead - 1).copied().unwrap_or(0.0);
        match (self.approach_speeds_mps.get(ahead), self.stations_m.get(ahead)) {
            (Some(then_mps), Some(end_m)) => limit_mps.min(approach_mps(*then_mps, end_m - station_m) as f32),
            _ => limit_mps,
        }
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
        self.nearest(self.segments(from_m, to_m), point)
    }

    /// The part of the route between two stations.
    #[must_use]
    pub fn window(&self, from_m: f64, to_m: f64) -> RouteWindow<'_> {
        self.window_of(self.segments(from_m, to_m))
    }

    fn window_of(&self, segments: Range<usize>) -> RouteWindow<'_> {
        let points = match segments.is_empty() {
            true => &[],
            false => &self.points_m[segments.start..=segments.end],
        };
        RouteWindow {
            route: self,
            bounds_m: Box2::of(points),
            segments,
        }
    }

    /// Segments between two stations.
    fn segments(&self, from_m: f64, to_m: f64) -> Range<usize> {
        let first = self.stations_m.partition_point(|end| *end < from_m).saturating_sub(1);
        let past = self.stations_m.partition_point(|start| *start <= to_m);
        first..past.min(self.points_m.len().saturating_sub(1)).max(first)
    }

    /// The position relative to the nearest of these segments, the first of equally near ones.
    fn nearest(&self, segments: impl Iterator<Item = usize>, point: [f64; 2]) -> Option<RoutePosition> {
        let mut nearest: Option<(f64, SegmentPosition)> = None;
        for segment in segments {
            let place = self.beside(segment, point);
            let [dx, dy] = place.offset_m;
            let square = dx * dx + dy * dy;
            if nearest.is_none_or(|(least, _)| square < least) {
                nearest = Some((square, place));
            }
        }
        let (square, place) = nearest?;
        let ([dx, dy], [ux, uy]) = (place.offset_m, self.directions[place.segment]);
        let side = if ux * dy - uy * dx < 0.0 { -1.0 } else { 1.0 };
        Some(RoutePosition {
            station_m: self.stations_m[place.segment] + place.along_m,
            left_m: side * square.sqrt(),
            direction: [ux, uy],
        })
    }

    /// The place on a segment that is nearest to a point.
    fn beside(&self, segment: usize, [x, y]: [f64; 2]) -> SegmentPosition {
        let [ax, ay] = self.points_m[segment];
        let length_m = self.stations_m[segment + 1] - self.stations_m[segment];
        let [ux, uy] = self.directions[segment];
        let along_m = ((x - ax) * ux + (y - ay) * uy).clamp(0.0, length_m);
        SegmentPosition {
            segment,
            along_m,
            offset_m: [x - ax - along_m * ux, y - ay - along_m * uy],
        }
    }
}

/// A position relative to one segment.
#[derive(Debug, Clone, Copy)]
struct SegmentPosition {
    segment: usize,
    /// From its beginning to the place nearest to the point, metres.
    along_m: f64,
    /// From there to the point, metres.
    offset_m: [f64; 2],
}

/// Room beside a rectangle that rounding does not use up, metres.
const ROUNDING_M: f64 = 1e-6;

/// A rectangle along the axes, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Box2 {
    min_m: [f64; 2],
    max_m: [f64; 2],
}

impl Box2 {
    /// Around some points.
    fn of(points_m: &[[f64; 2]]) -> Self {
        let none = Self {
            min_m: [f64::INFINITY; 2],
            max_m: [f64::NEG_INFINITY; 2],
        };
        points_m.iter().fold(none, |all, point| Self {
            min_m: [0, 1].map(|axis| all.min_m[axis].min(point[axis])),
            max_m: [0, 1].map(|axis| all.max_m[axis].max(point[axis])),
        })
    }

    /// False only if the point is farther than `within_m` from everything in the rectangle.
    fn may_be_within(&self, [x, y]: [f64; 2], within_m: f64) -> bool {
        let room_m = within_m + ROUNDING_M;
        x > self.min_m[0] - room_m
            && x < self.max_m[0] + room_m
            && y > self.min_m[1] - room_m
            && y < self.max_m[1] + room_m
    }
}

/// A part of a route, to which many points are compared: most of them are far from it.
#[derive(Debug, Clone)]
pub struct RouteWindow<'a> {
    route: &'a HeroRoute,
    segments: Range<usize>,
    bounds_m: Box2,
}

impl<'a> RouteWindow<'a> {
    /// The segments of this part that begin before a station, or less than [`ROUNDING_M`] behind it.
    #[must_use]
    pub fn before(&self, station_m: f64) -> Self {
        let stations_m = &self.route.stations_m[self.segments.clone()];
        let count = stations_m.partition_point(|start| *start <= station_m + ROUNDING_M);
        self.route.window_of(self.segments.start..self.segments.start + count)
    }

    /// False only if no point of this part is within `within_m` of `point`.
    #[must_use]
    pub fn may_be_within(&self, point: [f64; 2], within_m: f64) -> bool {
        self.bounds_m.may_be_within(point, within_m)
            && self
                .segments
                .clone()
                .any(|segment| self.is_near(segment, point, within_m))
    }

    /// As [`HeroRoute::project`], for a point that is less than `within_m` from this part; `None` for others.
    #[must_use]
    pub fn project_within(&self, point: [f64; 2], within_m: f64) -> Option<RoutePosition> {
        if !self.bounds_m.may_be_within(point, within_m) {
            return None;
        }
        // The segments that are left out are farther than `within_m`.
        let near = self
            .segments
            .clone()
            .filter(|segment| self.is_near(*segment, point, within_m));
        self.route
            .nearest(near, point)
            .filter(|place| place.left_m.abs() < within_m)
    }

    fn is_near(&self, segment: usize, point: [f64; 2], within_m: f64) -> bool {
        self.route.boxes_m[segment].may_be_within(point, within_m)
    }
}

/// Speed from which [`BRAKING_MPS2`] leads to `then_mps` within a distance.
fn approach_mps(then_mps: f64, distance_m: f64) -> f64 {
    (then_mps * then_mps + 2.0 * BRAKING_MPS2 * distance_m).sqrt()
}

fn distance_m([ax, ay]: [f64; 2], [bx, by]: [f64; 2]) -> f64 {
    libm::hypot(bx - ax, by - ay)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

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

    /// Limits of 14, 5 and 14 m/s from 0, 100 and 120 m on.
    #[test]
    fn a_lower_limit_is_approached_with_a_constant_deceleration() {
        let mut route = HeroRoute::default();
        for (x_m, speed_limit_mps) in [(0.0, 14.0), (60.0, 14.0), (100.0, 5.0), (120.0, 14.0), (200.0, 14.0)] {
            route.push(&RoutePoint {
                x_m,
                speed_limit_mps,
                ..RoutePoint::default()
            });
        }
        // 5² + 2 · 2 · d = 14² at d = 42.75 m.
        let at = |station_m| route.speed_limit_mps(station_m);
        assert_eq!((at(0.0), at(57.25)), (14.0, 14.0));
        assert_eq!((at(64.0), at(86.0)), (13.0, 9.0));
        assert_eq!((at(100.0), at(119.9), at(120.0), at(199.0)), (5.0, 5.0, 14.0, 14.0));
        // Before the beginning and behind the end of the route.
        assert_eq!((at(-1.0), at(300.0)), (14.0, 14.0));
    }

    proptest! {
        /// The speed at a station is the lowest of the limit there and of those from which braking leads to each limit ahead.
        #[test]
        fn no_limit_ahead_is_exceeded_and_no_speed_is_given_away(
            pieces in prop::collection::vec((0.5..40.0_f64, 1.0..30.0_f32), 2..12), share in 0.0..1.0_f64,
        ) {
            let mut route = HeroRoute::default();
            let mut x_m = 0.0;
            for (length_m, speed_limit_mps) in &pieces {
                route.push(&RoutePoint { x_m, speed_limit_mps: *speed_limit_mps, ..RoutePoint::default() });
                x_m += length_m;
            }
            let station_m = share * route.length_m();
            let begins_m = pieces.iter().scan(0.0, |sum_m, (length_m, _)| Some(std::mem::replace(sum_m, *sum_m + length_m)));
            let mut highest_mps = f64::INFINITY;
            for (begin_m, (_, limit_mps)) in begins_m.zip(&pieces) {
                let limit_mps = f64::from(*limit_mps);
                if begin_m > station_m {
                    highest_mps = highest_mps.min((limit_mps.powi(2) + 4.0 * (begin_m - station_m)).sqrt());
                } else {
                    highest_mps = limit_mps;
                }
            }
            prop_assert!((f64::from(route.speed_limit_mps(station_m)) - highest_mps).abs() < 1e-5);
        }

        /// What a window leaves out changes no answer.
        #[test]
        fn a_window_answers_as_a_search_of_all_its_segments(
            points in prop::collection::vec((-60.0..60.0_f64, -60.0..60.0_f64), 2..12),
            from_m in -10.0..200.0_f64, length_m in 0.0..150.0_f64,
            point in (-70.0..70.0_f64, -70.0..70.0_f64), within_m in 0.1..30.0_f64,
        ) {
            let mut route = HeroRoute::default();
            for (x_m, y_m) in points {
                route.push(&RoutePoint { x_m, y_m, ..RoutePoint::default() });
            }
            let (point, to_m) = ([point.0, point.1], from_m + length_m);
            let searched = route.project(point, from_m, to_m).filter(|place| place.left_m.abs() < within_m);
            let window = route.window(from_m, to_m);
            prop_assert_eq!(window.project_within(point, within_m), searched);
            prop_assert!(searched.is_none() || window.may_be_within(point, within_m));
            if let Some(place) = searched {
                prop_assert!(window.before(place.station_m).may_be_within(point, within_m));
            }
        }
    }
}
