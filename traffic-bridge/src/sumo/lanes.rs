//! The lanes of a net as a graph: the way that a vehicle took between two of SUMO's steps.

use serde::Serialize;

use super::libsumo::ffi::RawNetLane;

/// Most lanes on the way of one step: junctions of short lanes have a few each.
const MOST_LANES: usize = 32;
/// Most lanes that the search for a way looks at.
const MOST_LOOKED_AT: usize = 512;
/// A vehicle that is behind its last position by less than this has not moved, metres.
const STANDING_M: f64 = 0.01;

/// Where a vehicle's front bumper is: a lane and the position on it, in metres of the lane's own length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LanePlace {
    /// Place among [`LaneGraph`]'s lanes.
    pub lane: u32,
    /// Metres from the lane's beginning.
    pub position_m: f64,
}

/// A point of a lane's centre line and the direction there, a unit vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinePoint {
    /// World frame, metres.
    pub position_m: [f64; 3],
    /// World frame, horizontal.
    pub direction: [f64; 2],
}

/// The centre line of a lane.
#[derive(Debug, Clone, PartialEq)]
struct CentreLine {
    points_m: Vec<[f64; 3]>,
    /// Horizontal distance of each point from the first one along the line, metres.
    stations_m: Vec<f64>,
}

impl CentreLine {
    fn new(coordinates: &[f64]) -> Self {
        let mut line = Self {
            points_m: Vec::with_capacity(coordinates.len() / 3),
            stations_m: Vec::with_capacity(coordinates.len() / 3),
        };
        for point in coordinates.chunks_exact(3) {
            let point = [point[0], point[1], point[2]];
            let station = match (line.points_m.last(), line.stations_m.last()) {
                (Some(last), Some(station)) => {
                    let length_m = libm::hypot(point[0] - last[0], point[1] - last[1]);
                    if length_m <= 0.0 {
                        continue;
                    }
                    station + length_m
                }
                _ => 0.0,
            };
            line.points_m.push(point);
            line.stations_m.push(station);
        }
        line
    }

    fn length_m(&self) -> f64 {
        self.stations_m.last().copied().unwrap_or(0.0)
    }

    /// The point at a distance from the beginning; before and behind the line it continues straight. `None`: the line is a point.
    fn at(&self, station_m: f64) -> Option<LinePoint> {
        let last = self.points_m.len().checked_sub(2)?;
        let segment = self.stations_m.partition_point(|&end| end <= station_m);
        let segment = segment.saturating_sub(1).min(last);
        let (from, to) = (self.points_m[segment], self.points_m[segment + 1]);
        let length_m = self.stations_m[segment + 1] - self.stations_m[segment];
        let share = (station_m - self.stations_m[segment]) / length_m;
        Some(LinePoint {
            position_m: [0, 1, 2].map(|axis: usize| from[axis] + share * (to[axis] - from[axis])),
            direction: [0, 1].map(|axis: usize| (to[axis] - from[axis]) / length_m),
        })
    }
}

#[derive(Debug, Clone, PartialEq)]
struct Lane {
    id: String,
    edge: u32,
    /// On a junction: its edge is in no route.
    is_internal: bool,
    /// What positions refer to; the centre line may be longer or shorter.
    length_m: f64,
    line: CentreLine,
    next: Vec<u32>,
}

impl Lane {
    /// The distance along the centre line of a position on the lane, as SUMO scales it.
    fn station_m(&self, position_m: f64) -> f64 {
        match self.length_m > 0.0 {
            true => position_m * self.line.length_m() / self.length_m,
            false => 0.0,
        }
    }

    /// The position on the lane of a distance along the centre line: the inverse of [`Lane::station_m`].
    fn position_m(&self, station_m: f64) -> f64 {
        match self.line.length_m() > 0.0 {
            true => station_m * self.length_m / self.line.length_m(),
            false => 0.0,
        }
    }
}

/// A place on a way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WayPlace {
    /// The lane and the position on it.
    pub place: LanePlace,
    /// Edges of the vehicle's route that it has entered since the beginning of the way.
    pub entered_edges: u32,
}

/// Ids of a net's lanes and edges by their indices.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LaneIds {
    /// Of each lane, by its index: its id.
    pub lanes: Vec<String>,
    /// Of each lane, by its index: the index of its edge.
    pub edge_of_lane: Vec<u32>,
    /// Of each edge, by its index: its id.
    pub edges: Vec<String>,
}

/// A change of lanes within a step, which SUMO makes at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LaneSwitch {
    /// The way leads from where the vehicle was to where it is.
    None,
    /// The way begins beside the place where the vehicle was.
    AtStart,
    /// The way ends beside the place where the vehicle is.
    AtEnd,
}

/// The lanes that a vehicle drove along in a step.
#[derive(Debug, Clone, PartialEq)]
pub struct LaneWay {
    /// Places of the lanes, in order.
    lanes: Vec<u32>,
    /// On the centre line of the first lane, metres.
    start_m: f64,
    /// Along the centre lines, metres.
    length_m: f64,
    switch: LaneSwitch,
}

impl LaneWay {
    /// Metres along the centre lines.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.length_m
    }

    /// True if it leads from one lane onto others.
    #[must_use]
    pub fn leaves_lane(&self) -> bool {
        self.lanes.len() > 1
    }

    /// The change of lanes.
    #[must_use]
    pub fn switch(&self) -> LaneSwitch {
        self.switch
    }
}

/// All lanes of a net.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LaneGraph {
    lanes: Vec<Lane>,
    /// Lanes of each edge.
    edges: Vec<Vec<u32>>,
    edge_ids: Vec<String>,
}

impl LaneGraph {
    pub(crate) fn new(raw: Vec<RawNetLane>) -> Self {
        let mut graph = Self::default();
        for (place, lane) in (0..).zip(raw) {
            let edge = lane.edge as usize;
            if graph.edges.len() <= edge {
                graph.edges.resize(edge + 1, Vec::new());
                graph.edge_ids.resize(edge + 1, String::new());
            }
            graph.edges[edge].push(place);
            graph.edge_ids[edge].clone_from(&lane.edge_id);
            graph.lanes.push(Lane {
                is_internal: lane.id.starts_with(':'),
                id: lane.id,
                edge: lane.edge,
                length_m: lane.length,
                line: CentreLine::new(&lane.shape),
                next: lane.next,
            });
        }
        graph
    }

    /// The way from one place to another, at most `most_m` long: the shortest. `None` if no lanes lead there.
    #[must_use]
    pub fn way(&self, from: LanePlace, to: LanePlace, most_m: f64) -> Option<LaneWay> {
        let beside = |place: LanePlace| self.beside(place.lane).map(move |lane| LanePlace { lane, ..place });
        self.along(from, to, most_m)
            .map(|way| (way, LaneSwitch::None))
            .or_else(|| {
                let ways = beside(from).filter_map(|from| self.along(from, to, most_m));
                ways.min_by(shorter).map(|way| (way, LaneSwitch::AtStart))
            })
            .or_else(|| {
                let ways = beside(to).filter_map(|to| self.along(from, to, most_m));
                ways.min_by(shorter).map(|way| (way, LaneSwitch::AtEnd))
            })
            .map(|(way, switch)| LaneWay { switch, ..way })
    }

    /// The other lanes of a lane's edge.
    fn beside(&self, lane: u32) -> impl Iterator<Item = u32> {
        let edge = self.lanes[lane as usize].edge;
        let lanes = self.edges[edge as usize].iter().copied();
        lanes.filter(move |&other| other != lane)
    }

    /// The shortest way from lane to lane without a change of lanes.
    fn along(&self, from: LanePlace, to: LanePlace, most_m: f64) -> Option<LaneWay> {
        let (first, last) = (&self.lanes[from.lane as usize], &self.lanes[to.lane as usize]);
        let (start_m, end_m) = (first.station_m(from.position_m), last.station_m(to.position_m));
        let way = |lanes: Vec<u32>, length_m: f64| LaneWay {
            lanes,
            start_m,
            length_m: length_m.max(0.0),
            switch: LaneSwitch::None,
        };
        if from.lane == to.lane && end_m > start_m - STANDING_M {
            return Some(way(vec![from.lane], end_m - start_m));
        }
        let mut best: Option<LaneWay> = None;
        let mut lanes = vec![from.lane];
        // For each lane of `lanes` the distance from the start to its end, and how many of its successors were tried.
        let mut trail = vec![((first.line.length_m() - start_m).max(0.0), 0)];
        let mut looked_at = 0;
        while let Some((reached_m, tried)) = trail.last_mut() {
            let here = lanes.last().copied().unwrap_or(from.lane);
            let next = self.lanes[here as usize].next.get(*tried).copied();
            *tried += 1;
            let reached_m = *reached_m;
            let shortest_m = best.as_ref().map_or(most_m, |best| best.length_m);
            let Some(next) = next.filter(|_| reached_m <= shortest_m && looked_at < MOST_LOOKED_AT) else {
                trail.pop();
                lanes.pop();
                continue;
            };
            looked_at += 1;
            if next == to.lane && reached_m + end_m <= shortest_m {
                best = Some(way([&lanes[..], &[next]].concat(), reached_m + end_m));
            } else if lanes.len() < MOST_LANES {
                trail.push((reached_m + self.lanes[next as usize].line.length_m(), 0));
                lanes.push(next);
            }
        }
        best
    }

    /// The point of the centre lines at a distance from the beginning of a way.
    #[must_use]
    pub fn at(&self, way: &LaneWay, travelled_m: f64) -> Option<LinePoint> {
        let mut station_m = way.start_m + travelled_m;
        let mut point = None;
        for (number, &lane) in way.lanes.iter().enumerate() {
            let line = &self.lanes[lane as usize].line;
            let is_last = number + 1 == way.lanes.len();
            // A lane without length has no direction: the way continues on the next.
            if let Some(found) = line.at(station_m) {
                point = Some(found);
                if is_last || station_m < line.length_m() {
                    break;
                }
            }
            station_m -= line.length_m();
        }
        point
    }

    /// The place at a distance from the beginning of a way; `None` if the way has no lane.
    #[must_use]
    pub fn place(&self, way: &LaneWay, travelled_m: f64) -> Option<WayPlace> {
        let mut station_m = way.start_m + travelled_m;
        let mut entered_edges = 0;
        let mut found = None;
        for (number, &lane) in way.lanes.iter().enumerate() {
            let Lane { is_internal, line, .. } = &self.lanes[lane as usize];
            entered_edges += u32::from(number > 0 && !is_internal);
            found = Some(WayPlace {
                place: LanePlace {
                    lane,
                    position_m: self.lanes[lane as usize].position_m(station_m),
                },
                entered_edges,
            });
            if station_m < line.length_m() {
                break;
            }
            station_m -= line.length_m();
        }
        // Behind the last lane the way has ended.
        found
    }

    /// Index of a lane's edge.
    #[must_use]
    pub fn edge(&self, lane: u32) -> u32 {
        self.lanes[lane as usize].edge
    }

    /// Ids of all lanes and edges.
    #[must_use]
    pub fn ids(&self) -> LaneIds {
        LaneIds {
            lanes: self.lanes.iter().map(|lane| lane.id.clone()).collect(),
            edge_of_lane: self.lanes.iter().map(|lane| lane.edge).collect(),
            edges: self.edge_ids.clone(),
        }
    }

    /// The rest of a lane behind a place, metres along the centre line.
    #[must_use]
    pub fn rest_m(&self, place: LanePlace) -> f64 {
        let lane = &self.lanes[place.lane as usize];
        lane.line.length_m() - lane.station_m(place.position_m)
    }

    /// The way along the lane of a place to its end.
    #[must_use]
    pub fn rest(&self, place: LanePlace) -> LaneWay {
        LaneWay {
            lanes: vec![place.lane],
            start_m: self.lanes[place.lane as usize].station_m(place.position_m),
            length_m: self.rest_m(place),
            switch: LaneSwitch::None,
        }
    }
}

fn shorter(a: &LaneWay, b: &LaneWay) -> std::cmp::Ordering {
    a.length_m.total_cmp(&b.length_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lane(edge: u32, length: f64, shape: &[[f64; 2]], next: &[u32]) -> RawNetLane {
        RawNetLane {
            id: format!("lane {edge}"),
            edge_id: format!("edge {edge}"),
            edge,
            length,
            shape: shape.iter().flat_map(|[x, y]| [*x, *y, 1.0]).collect(),
            next: next.to_vec(),
        }
    }

    /// A road of two lanes to the east (0 to the right, 1), a left turn from its left lane (2), and a road to the north (3).
    fn corner() -> LaneGraph {
        LaneGraph::new(vec![
            lane(0, 50.0, &[[0.0, 0.0], [100.0, 0.0]], &[]),
            lane(0, 50.0, &[[0.0, 3.0], [100.0, 3.0]], &[2]),
            lane(1, 10.0, &[[100.0, 3.0], [105.0, 3.0], [105.0, 8.0]], &[3]),
            lane(2, 92.0, &[[105.0, 8.0], [105.0, 100.0]], &[]),
        ])
    }

    fn place(lane: u32, position_m: f64) -> LanePlace {
        LanePlace { lane, position_m }
    }

    #[test]
    fn a_way_leads_through_a_junction_along_the_centre_lines() {
        let graph = corner();
        // Positions on the first road count half of the centre line's metres.
        let way = graph.way(place(1, 45.0), place(3, 12.0), 40.0).unwrap();
        assert_eq!((way.length_m(), way.switch()), (32.0, LaneSwitch::None));
        let at = |driven_m: f64| graph.at(&way, driven_m).unwrap();
        assert_eq!(at(0.0).position_m, [90.0, 3.0, 1.0]);
        assert_eq!(at(12.0).position_m, [102.0, 3.0, 1.0]);
        assert_eq!(at(18.0).position_m, [105.0, 6.0, 1.0]);
        assert_eq!(
            (at(32.0).position_m, at(32.0).direction),
            ([105.0, 20.0, 1.0], [0.0, 1.0])
        );
    }

    #[test]
    fn a_change_of_lanes_is_at_the_end_of_the_way_where_it_was_made() {
        let graph = corner();
        let before_the_turn = graph.way(place(0, 45.0), place(3, 12.0), 40.0).unwrap();
        assert_eq!(before_the_turn.switch(), LaneSwitch::AtStart);
        let on_one_road = graph.way(place(0, 10.0), place(1, 15.0), 40.0).unwrap();
        assert_eq!(
            (on_one_road.length_m(), on_one_road.switch()),
            (10.0, LaneSwitch::AtStart)
        );
    }

    #[test]
    fn where_no_lanes_lead_there_is_no_way() {
        let graph = corner();
        for (from, to, most_m) in [
            (place(3, 10.0), place(1, 10.0), 1e3),
            (place(1, 45.0), place(3, 12.0), 31.0),
            (place(1, 20.0), place(1, 10.0), 1e3),
        ] {
            assert_eq!(graph.way(from, to, most_m), None, "{from:?} {to:?}");
        }
    }

    #[test]
    fn a_ring_of_short_lanes_ends_the_search() {
        let point = [[0.0, 0.0], [0.0, 0.0]];
        let graph = LaneGraph::new(vec![
            lane(0, 0.1, &point, &[1]),
            lane(1, 0.1, &point, &[0]),
            lane(2, 10.0, &[[0.0, 0.0], [10.0, 0.0]], &[]),
        ]);
        assert_eq!(graph.way(place(0, 0.0), place(2, 5.0), 1e3), None);
        assert!(graph.way(place(0, 0.05), place(1, 0.0), 1e3).is_some());
        assert_eq!(graph.rest_m(place(2, 4.0)), 6.0);
    }
}
