//! Where a class of vehicles can drive without end: the largest part of the net in which every road leads to every other.

use std::collections::{BTreeMap, BTreeSet};

use rand_chacha::ChaCha8Rng;

use super::{
    graph::{cheapest_path, largest_component},
    vehicle_types::{below, unit},
};
use crate::sumo::{Sumo, called, error::SumoError, libsumo::ffi::RawLink};

/// Length that a first edge should have, metres: two cars.
const MIN_START_M: f64 = 10.0;
/// Draws of a first edge before any edge is accepted.
const ATTEMPTS: usize = 16;

/// A road.
#[derive(Debug, Clone, PartialEq)]
pub struct RoadEdge {
    /// SUMO's id.
    pub id: String,
    /// Metres.
    pub length_m: f64,
    /// Time to drive along it at its speed limit, milliseconds, at least 1.
    pub travel_time_ms: u64,
}

/// Roads and how one leads to another, by index; at least two roads.
#[derive(Debug, Clone, PartialEq)]
pub struct Roads {
    edges: Vec<RoadEdge>,
    successors: Vec<Vec<usize>>,
    /// Pairs of roads with a left turn from the first to the second.
    left_turns: BTreeSet<[usize; 2]>,
    travel_time_ms: Vec<u64>,
    total_length_m: f64,
}

impl Roads {
    /// Roads of `class` that all lead to each other.
    ///
    /// # Errors
    /// There are fewer than two.
    pub fn connected(sumo: &Sumo, class: &str) -> Result<Self, SumoError> {
        let edges = usable(sumo, class)?;
        let links = called("list links", sumo.simulation().links(class))?;
        let component = largest_component(&successors(&edges, &links).0);
        let edges = component.into_iter().map(|index| edges[index].clone()).collect();
        Self::new(sumo, class, edges, &links)
    }

    /// All roads that pedestrians may walk along; SUMO finds their paths across junctions.
    ///
    /// # Errors
    /// There are fewer than two.
    pub fn walkable(sumo: &Sumo) -> Result<Self, SumoError> {
        const CLASS: &str = "pedestrian";
        Self::new(sumo, CLASS, usable(sumo, CLASS)?, &[])
    }

    fn new(sumo: &Sumo, class: &str, edges: Vec<RoadEdge>, links: &[RawLink]) -> Result<Self, SumoError> {
        const NEEDED: usize = 2;
        if edges.len() < NEEDED {
            let net = sumo.files().main.clone();
            return Err(SumoError::NoRoads {
                net,
                class: class.to_owned(),
                needed: NEEDED,
                found: edges.len(),
            });
        }
        let (successors, left_turns) = successors(&edges, links);
        Ok(Self {
            successors,
            left_turns,
            travel_time_ms: edges.iter().map(|edge| edge.travel_time_ms).collect(),
            total_length_m: edges.iter().map(|edge| edge.length_m).sum(),
            edges,
        })
    }

    /// The road of an index that this net gave.
    #[must_use]
    pub fn edge(&self, index: usize) -> &RoadEdge {
        &self.edges[index]
    }

    /// Index of the road with SUMO's id `id`, if it is one of these.
    #[must_use]
    pub fn find(&self, id: &str) -> Option<usize> {
        self.edges.binary_search_by(|edge| edge.id.as_str().cmp(id)).ok()
    }

    /// SUMO's ids of the fastest route, both ends included.
    #[must_use]
    pub fn route(&self, from: usize, to: usize) -> Vec<String> {
        let path = self.path(from, to).into_iter();
        path.map(|index| self.edges[index].id.clone()).collect()
    }

    /// True if the fastest route turns left at a junction at which it could have turned elsewhere.
    #[must_use]
    pub fn turns_left(&self, from: usize, to: usize) -> bool {
        let path = self.path(from, to);
        let is_left = |pair: &[usize; 2]| self.left_turns.contains(pair) && self.successors[pair[0]].len() > 1;
        path.array_windows().any(is_left)
    }

    fn path(&self, from: usize, to: usize) -> Vec<usize> {
        cheapest_path(&self.successors, &self.travel_time_ms, from, to)
    }

    /// A random road, drawn in proportion to its length, with room for a vehicle if the draws find one.
    #[must_use]
    pub fn draw_start(&self, rng: &mut ChaCha8Rng) -> usize {
        let mut drawn = 0;
        for _ in 0..ATTEMPTS {
            let mut left_m = unit(rng) * self.total_length_m;
            let found = self.edges.iter().position(|edge| {
                left_m -= edge.length_m;
                left_m < 0.0
            });
            drawn = found.unwrap_or(self.edges.len() - 1);
            if self.edges[drawn].length_m >= MIN_START_M {
                break;
            }
        }
        drawn
    }

    /// A random road other than `index`.
    #[must_use]
    pub fn draw_other(&self, index: usize, rng: &mut ChaCha8Rng) -> usize {
        let drawn = below(self.edges.len() - 1, rng);
        if drawn >= index { drawn + 1 } else { drawn }
    }
}

/// Roads of `class` except the internal ones, sorted by id.
fn usable(sumo: &Sumo, class: &str) -> Result<Vec<RoadEdge>, SumoError> {
    let raw = called("list edges", sumo.simulation().edges(class))?;
    let mut edges: Vec<RoadEdge> = raw
        .into_iter()
        .map(|edge| {
            let travel_time_ms = milliseconds(edge.length / edge.speed_limit);
            RoadEdge {
                id: edge.id,
                length_m: edge.length,
                travel_time_ms,
            }
        })
        .collect();
    edges.sort_by(|a, b| a.id.cmp(&b.id));
    Ok(edges)
}

fn milliseconds(seconds: f64) -> u64 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "saturates; a time is not negative"
    )]
    let milliseconds = (seconds * 1e3) as u64;
    // An edge that takes an hour is as good as closed; the limit keeps sums far from overflow.
    milliseconds.clamp(1, 3_600_000)
}

/// The roads that each road leads to, and the pairs between which it turns left.
fn successors(edges: &[RoadEdge], links: &[RawLink]) -> (Vec<Vec<usize>>, BTreeSet<[usize; 2]>) {
    let index: BTreeMap<&str, usize> = edges
        .iter()
        .enumerate()
        .map(|(i, edge)| (edge.id.as_str(), i))
        .collect();
    let (mut successors, mut left_turns) = (vec![Vec::new(); edges.len()], BTreeSet::new());
    for link in links {
        let (Some(&from), Some(&to)) = (index.get(link.from.as_str()), index.get(link.to.as_str())) else {
            continue;
        };
        if !successors[from].contains(&to) {
            successors[from].push(to);
        }
        if link.is_left {
            left_turns.insert([from, to]);
        }
    }
    (successors, left_turns)
}
