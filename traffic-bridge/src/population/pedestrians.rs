//! Pedestrians on random walks without end.

use std::{collections::BTreeMap, rc::Rc};

use ipc_schema::traffic::MetaEvent;
use rand_chacha::ChaCha8Rng;

use super::{
    places::{CareSchedule, stream},
    roads::Roads,
    vehicle_types::{WeightedType, draw, unit},
};
use crate::sumo::{Sumo, called, error::SumoError, frame::TrafficFrame};

/// Ids of pedestrians start with this prefix.
const PERSON_PREFIX: &str = "person.";
/// Random streams of pedestrians start here, those of vehicles at 0.
const FIRST_STREAM: u64 = 1 << 32;
/// Walks known in advance: the next is appended while the last is under way, so that no pedestrian stops between two.
const WALKS_AHEAD: i32 = 2;
/// Draws of a goal that can be reached on foot.
const ATTEMPTS: usize = 16;

/// A place among the pedestrians, and the pedestrian that fills it now.
#[derive(Debug)]
struct Walker {
    id: String,
    person_type: String,
    roads: Rc<Roads>,
    rng: ChaCha8Rng,
    /// Where the last known walk ends.
    goal: SidewalkPosition,
    departed: bool,
}

/// A position on a sidewalk.
#[derive(Debug, Clone, Copy, Default)]
struct SidewalkPosition {
    edge: usize,
    position_m: f64,
}

/// The pedestrians of one episode.
#[derive(Debug)]
pub(crate) struct Pedestrians {
    walkers: Vec<Walker>,
    place_of: BTreeMap<String, usize>,
    next_number: u32,
}

impl Pedestrians {
    pub(crate) fn start(
        sumo: &mut Sumo,
        count: u32,
        entries: &[WeightedType],
        episode_seed: u64,
    ) -> Result<Self, SumoError> {
        let mut pedestrians = Self {
            walkers: Vec::new(),
            place_of: BTreeMap::new(),
            next_number: 0,
        };
        if count == 0 {
            return Ok(pedestrians);
        }
        let roads = Rc::new(Roads::walkable(sumo)?);
        for place in 0..count as usize {
            let mut rng = stream(episode_seed, FIRST_STREAM + place as u64);
            let person_type = draw(entries, &mut rng).id.clone();
            let (roads, id, goal) = (Rc::clone(&roads), String::new(), SidewalkPosition::default());
            pedestrians.walkers.push(Walker {
                id,
                person_type,
                roads,
                rng,
                goal,
                departed: false,
            });
            pedestrians.fill(sumo, place)?;
        }
        Ok(pedestrians)
    }

    pub(crate) fn after_step(
        &mut self,
        sumo: &mut Sumo,
        frame: &TrafficFrame,
        pace: CareSchedule,
    ) -> Result<(), SumoError> {
        for event in &frame.events {
            let Some(&place) = self.place_of.get(&event.id_text()) else {
                continue;
            };
            if event.event == MetaEvent::Departed as u32 {
                self.walkers[place].departed = true;
            } else if event.event == MetaEvent::Arrived as u32 {
                self.fill(sumo, place)?;
            }
        }
        for (place, walker) in self.walkers.iter_mut().enumerate() {
            if walker.departed && pace.is_due(place, frame.step) {
                walker.walk_on(sumo)?;
            }
        }
        Ok(())
    }

    /// Adds a new pedestrian for `place` with a first walk.
    fn fill(&mut self, sumo: &mut Sumo, place: usize) -> Result<(), SumoError> {
        let walker = &mut self.walkers[place];
        self.place_of.remove(&walker.id);
        walker.id = format!("{PERSON_PREFIX}{}", self.next_number);
        self.next_number += 1;
        self.place_of.insert(walker.id.clone(), place);
        walker.add(sumo)
    }
}

impl Walker {
    fn add(&mut self, sumo: &mut Sumo) -> Result<(), SumoError> {
        self.departed = false;
        let edge = self.roads.draw_start(&mut self.rng);
        self.goal = self.draw_place(edge);
        let (edge, position_m) = (&self.roads.edge(edge).id, self.goal.position_m);
        let added = sumo
            .simulation_mut()
            .add_person(&self.id, &self.person_type, edge, position_m);
        called("add a pedestrian", added)?;
        self.append_walk(sumo)
    }

    fn walk_on(&mut self, sumo: &mut Sumo) -> Result<(), SumoError> {
        match sumo.simulation().remaining_stages(&self.id) {
            Ok(stages) if stages < WALKS_AHEAD => self.append_walk(sumo),
            // SUMO does not know the pedestrian: it has just arrived and will be replaced.
            _ => Ok(()),
        }
    }

    /// Appends a walk from the last goal to another; along the same edge if no other can be reached.
    fn append_walk(&mut self, sumo: &mut Sumo) -> Result<(), SumoError> {
        let start = self.goal;
        for _ in 0..ATTEMPTS {
            let edge = self.roads.draw_other(start.edge, &mut self.rng);
            let goal = self.draw_place(edge);
            let (from, to) = (&self.roads.edge(start.edge).id, &self.roads.edge(goal.edge).id);
            let walk = sumo.simulation().walk(from, start.position_m, to, goal.position_m);
            let walk = called("find a walk", walk)?;
            if !walk.is_empty() {
                return self.append(sumo, &walk, goal);
            }
        }
        let goal = self.draw_place(start.edge);
        let walk = [self.roads.edge(start.edge).id.clone()];
        self.append(sumo, &walk, goal)
    }

    fn append(&mut self, sumo: &mut Sumo, walk: &[String], goal: SidewalkPosition) -> Result<(), SumoError> {
        self.goal = goal;
        called(
            "append a walk",
            sumo.simulation_mut().append_walk(&self.id, walk, goal.position_m),
        )
    }

    fn draw_place(&mut self, edge: usize) -> SidewalkPosition {
        SidewalkPosition {
            edge,
            position_m: unit(&mut self.rng) * self.roads.edge(edge).length_m,
        }
    }
}
