//! The line that a hero should follow: centre lines of the lanes of its route, and of the links across junctions between them.
//!
//! On each edge the line uses the lane that needs the fewest lane changes on the whole route, counted from the lane on which the
//! hero departs. A lane change is spread over the middle of its edge.

use std::collections::BTreeMap;

use ipc_schema::traffic::{NO_SIGNAL, ON_EDGE, RIGHT_OF_WAY, RoutePoint, YIELDS};

use crate::sumo::{
    convention::single,
    libsumo::ffi::{RawLane, RawWay},
};

/// Points closer than this are one, metres.
const SAME_POINT_M: f64 = 0.01;
/// Points on an edge with a lane change.
const CHANGE_POINTS: u32 = 40;
/// Part of its edge over which a lane change is spread, from and to.
const CHANGE_PART: [f64; 2] = [0.2, 0.8];

/// Points of the route of the hero `vehicle`, which departs on lane `first_lane`. Where no lane continues, the line ends.
#[must_use]
pub fn line(vehicle: u32, first_lane: u32, lanes: &[RawLane], ways: &[RawWay]) -> Vec<RoutePoint> {
    let changes = lane_changes(lanes, ways);
    let mut line = RouteLine {
        vehicle,
        points: Vec::new(),
    };
    let edges = lanes.last().map_or(0, |lane| lane.edge + 1);
    let mut entry = first_lane;
    for edge in 0..edges {
        let on_edge = |number: u32| lanes.iter().find(|lane| lane.edge == edge && lane.lane == number);
        let Some(from) = on_edge(entry).or_else(|| lanes.iter().find(|lane| lane.edge == edge)) else {
            break;
        };
        let way = ways
            .iter()
            .filter(|way| way.edge == edge && on_edge(way.from_lane).is_some())
            .filter_map(|way| Some((cost(&changes, way, from.lane)?, way)))
            .min_by_key(|(cost, way)| (*cost, way.from_lane, way.to_lane))
            .map(|(_, way)| way);
        let to = way.and_then(|way| on_edge(way.from_lane)).unwrap_or(from);
        line.add_edge(edge, from, to);
        let Some(way) = way else { break };
        line.add_way(edge, way);
        entry = way.to_lane;
    }
    line.points
}

/// Fewest lane changes from the start of a lane (edge, number) to the end of the route; lanes that do not reach the end are left out.
fn lane_changes(lanes: &[RawLane], ways: &[RawWay]) -> BTreeMap<(u32, u32), u32> {
    let mut changes = BTreeMap::new();
    let last = lanes.last().map_or(0, |lane| lane.edge);
    for edge in (0..=last).rev() {
        for lane in lanes.iter().filter(|lane| lane.edge == edge) {
            let fewest = if edge == last {
                Some(0)
            } else {
                let onward = ways.iter().filter(|way| way.edge == edge);
                onward.filter_map(|way| cost(&changes, way, lane.lane)).min()
            };
            if let Some(fewest) = fewest {
                changes.insert((edge, lane.lane), fewest);
            }
        }
    }
    changes
}

/// Lane changes from the lane `from` of the edge that `way` leaves, by `way`, to the end of the route.
fn cost(changes: &BTreeMap<(u32, u32), u32>, way: &RawWay, from: u32) -> Option<u32> {
    changes
        .get(&(way.edge + 1, way.to_lane))
        .map(|after| after + from.abs_diff(way.from_lane))
}

struct RouteLine {
    vehicle: u32,
    points: Vec<RoutePoint>,
}

impl RouteLine {
    fn add_edge(&mut self, edge: u32, from: &RawLane, to: &RawLane) {
        if from.lane == to.lane {
            for [x_m, y_m] in pairs(&from.shape) {
                self.add(edge, [x_m, y_m], from.speed_limit, ON_EDGE);
            }
            return;
        }
        for number in 0..=CHANGE_POINTS {
            let share = f64::from(number) / f64::from(CHANGE_POINTS);
            let t = ((share - CHANGE_PART[0]) / (CHANGE_PART[1] - CHANGE_PART[0])).clamp(0.0, 1.0);
            let over = t * t * (3.0 - 2.0 * t);
            let (a, b) = (along(&from.shape, share), along(&to.shape, share));
            let point = [a[0] + over * (b[0] - a[0]), a[1] + over * (b[1] - a[1])];
            self.add(edge, point, from.speed_limit, ON_EDGE);
        }
    }

    fn add_way(&mut self, edge: u32, way: &RawWay) {
        if let (Some(stop_line), Ok(signal)) = (self.points.last_mut(), u32::try_from(way.signal)) {
            (stop_line.signal, stop_line.link) = (signal, way.link);
        }
        let precedence = if way.has_right_of_way { RIGHT_OF_WAY } else { YIELDS };
        for point in pairs(&way.shape) {
            self.add(edge, point, way.speed_limit, precedence);
        }
    }

    fn add(&mut self, edge: u32, [x_m, y_m]: [f64; 2], speed_limit_mps: f64, way: u32) {
        let speed_limit_mps = single(speed_limit_mps);
        if let Some(last) = self.points.last_mut()
            && (last.x_m - x_m).hypot(last.y_m - y_m) < SAME_POINT_M
        {
            last.speed_limit_mps = speed_limit_mps;
            last.way = way;
            return;
        }
        self.points.push(RoutePoint {
            x_m,
            y_m,
            speed_limit_mps,
            vehicle: self.vehicle,
            index: u32::try_from(self.points.len()).unwrap_or(u32::MAX),
            edge,
            signal: NO_SIGNAL,
            link: 0,
            way,
            reserved: 0,
        });
    }
}

fn pairs(shape: &[f64]) -> impl Iterator<Item = [f64; 2]> {
    shape.as_chunks::<2>().0.iter().copied()
}

/// The point at `share` (0 … 1) of the length of `shape`.
fn along(shape: &[f64], share: f64) -> [f64; 2] {
    let points: Vec<[f64; 2]> = pairs(shape).collect();
    let length = |pair: &[[f64; 2]]| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]);
    let mut left_m = share * points.windows(2).map(length).sum::<f64>();
    for pair in points.windows(2) {
        let length_m = length(pair);
        if left_m <= length_m && length_m > 0.0 {
            let t = left_m / length_m;
            return [
                pair[0][0] + t * (pair[1][0] - pair[0][0]),
                pair[0][1] + t * (pair[1][1] - pair[0][1]),
            ];
        }
        left_m -= length_m;
    }
    points.last().copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lane(edge: u32, lane: u32) -> RawLane {
        let (x, y) = (f64::from(edge) * 110.0, f64::from(lane) * 3.0);
        RawLane {
            edge,
            lane,
            speed_limit: 10.0,
            shape: vec![x, y, x + 100.0, y],
        }
    }

    fn way(edge: u32, from_lane: u32, to_lane: u32, signal: i32) -> RawWay {
        let (x, y) = (f64::from(edge) * 110.0 + 100.0, f64::from(from_lane) * 3.0);
        RawWay {
            edge,
            from_lane,
            to_lane,
            speed_limit: 5.0,
            shape: vec![x, y, x + 10.0, f64::from(to_lane) * 3.0],
            signal,
            link: 7,
            has_right_of_way: edge == 0,
        }
    }

    #[test]
    fn the_line_follows_lanes_and_ways_and_carries_the_stop_line() {
        let points = line(4, 0, &[lane(0, 0), lane(1, 0)], &[way(0, 0, 0, 2)]);
        let xs: Vec<f64> = points.iter().map(|point| point.x_m).collect();
        assert_eq!(xs, [0.0, 100.0, 110.0, 210.0]);
        assert_eq!(points.iter().map(|point| point.edge).collect::<Vec<_>>(), [0, 0, 0, 1]);
        let limits: Vec<f32> = points.iter().map(|point| point.speed_limit_mps).collect();
        assert_eq!(limits, [10.0, 5.0, 10.0, 10.0]);
        assert_eq!((points[1].signal, points[1].link), (2, 7));
        let ways: Vec<u32> = points.iter().map(|point| point.way).collect();
        assert_eq!(ways, [ON_EDGE, RIGHT_OF_WAY, ON_EDGE, ON_EDGE]);
        assert!(
            points
                .iter()
                .all(|point| point.vehicle == 4 && (point.index == 1) == (point.signal != NO_SIGNAL))
        );
    }

    #[test]
    fn a_lane_that_leads_nowhere_is_left_in_time() {
        let lanes = [lane(0, 0), lane(0, 1), lane(1, 0), lane(1, 1), lane(2, 0)];
        let ways = [way(0, 0, 0, -1), way(0, 1, 1, -1), way(1, 0, 0, -1)];
        let points = line(0, 1, &lanes, &ways);
        assert_eq!(points.last().map(|point| (point.x_m, point.y_m)), Some((320.0, 0.0)));
        let crossed: Vec<u32> = points
            .windows(2)
            .filter(|pair| pair[0].y_m != pair[1].y_m)
            .map(|pair| pair[0].edge)
            .collect();
        assert!(crossed.len() > 10, "the change is spread over its edge: {crossed:?}");
        assert!(points.windows(2).all(|pair| (pair[0].y_m - pair[1].y_m).abs() < 0.3));
    }

    #[test]
    fn a_route_without_a_way_ends_where_no_lane_leads_on() {
        let points = line(0, 0, &[lane(0, 0), lane(1, 0)], &[]);
        assert_eq!(points.last().map(|point| point.x_m), Some(100.0));
    }
}
