//! Pedestrians on random walks for ever.

use std::{collections::BTreeMap, rc::Rc};

use ipc_schema::traffic::MetaEvent;
use rand_chacha::ChaCha8Rng;

use crate::{
    catalogue::{Entry, draw, unit},
    error::SumoError,
    frame::Frame,
    population::{Pace, stream},
    roads::Roads,
    session::{Session, called},
};

/// Ids of pedestrians start with this.
const PERSON_PREFIX: &str = "person.";
/// Random streams of pedestrians start here, those of vehicles at 0.
const FIRST_STREAM: u64 = 1 << 32;
/// Walks known in advance; the next is appended while the last goes on, so that nobody stops between two.
const WALKS_AHEAD: i32 = 2;
/// Draws of a goal that can be reached on foot.
const ATTEMPTS: usize = 16;

/// A place among the pedestrians, and who fills it now.
#[derive(Debug)]
struct Walker {
    id: String,
    person_type: String,
    roads: Rc<Roads>,
    rng: ChaCha8Rng,
    /// Where the last known walk ends.
    goal: Place,
    departed: bool,
}

/// A place on a sidewalk.
#[derive(Debug, Clone, Copy, Default)]
struct Place {
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
        session: &mut Session,
        count: u32,
        entries: &[Entry],
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
        let roads = Rc::new(Roads::walkable(session)?);
        for place in 0..count as usize {
            let mut rng = stream(episode_seed, FIRST_STREAM + place as u64);
            let person_type = draw(entries, &mut rng).id.clone();
            let (roads, id, goal) = (Rc::clone(&roads), String::new(), Place::default());
            pedestrians.walkers.push(Walker {
                id,
                person_type,
                roads,
                rng,
                goal,
                departed: false,
            });
            pedestrians.fill(session, place)?;
        }
        Ok(pedestrians)
    }

    pub(crate) fn after_step(&mut self, session: &mut Session, frame: &Frame, pace: Pace) -> Result<(), SumoError> {
        for event in &frame.events {
            let Some(&place) = self.place_of.get(&event.id_text()) else {
                continue;
            };
            if event.event == MetaEvent::Departed as u32 {
                self.walkers[place].departed = true;
            } else if event.event == MetaEvent::Arrived as u32 {
                self.fill(session, place)?;
            }
        }
        for (place, walker) in self.walkers.iter_mut().enumerate() {
            if walker.departed && pace.cares_for(place, frame.step) {
                walker.walk_on(session)?;
            }
        }
        Ok(())
    }

    /// Adds a new pedestrian for `place` with a first walk.
    fn fill(&mut self, session: &mut Session, place: usize) -> Result<(), SumoError> {
        let walker = &mut self.walkers[place];
        self.place_of.remove(&walker.id);
        walker.id = format!("{PERSON_PREFIX}{}", self.next_number);
        self.next_number += 1;
        self.place_of.insert(walker.id.clone(), place);
        walker.add(session)
    }
}

impl Walker {
    fn add(&mut self, session: &mut Session) -> Result<(), SumoError> {
        self.departed = false;
        let edge = self.roads.draw_start(&mut self.rng);
        self.goal = self.draw_place(edge);
        let (edge, position_m) = (&self.roads.edge(edge).id, self.goal.position_m);
        let added = session
            .sumo_mut()
            .add_person(&self.id, &self.person_type, edge, position_m);
        called("add a pedestrian", added)?;
        self.append_walk(session)
    }

    fn walk_on(&mut self, session: &mut Session) -> Result<(), SumoError> {
        match session.sumo().remaining_stages(&self.id) {
            Ok(stages) if stages < WALKS_AHEAD => self.append_walk(session),
            // Unknown: it has just arrived and will be replaced.
            _ => Ok(()),
        }
    }

    /// Appends a walk from the last goal to another; along the same edge if no other can be reached.
    fn append_walk(&mut self, session: &mut Session) -> Result<(), SumoError> {
        let start = self.goal;
        for _ in 0..ATTEMPTS {
            let edge = self.roads.draw_other(start.edge, &mut self.rng);
            let goal = self.draw_place(edge);
            let (from, to) = (&self.roads.edge(start.edge).id, &self.roads.edge(goal.edge).id);
            let walk = session.sumo().walk(from, start.position_m, to, goal.position_m);
            let walk = called("find a walk", walk)?;
            if !walk.is_empty() {
                return self.append(session, &walk, goal);
            }
        }
        let goal = self.draw_place(start.edge);
        let walk = [self.roads.edge(start.edge).id.clone()];
        self.append(session, &walk, goal)
    }

    fn append(&mut self, session: &mut Session, walk: &[String], goal: Place) -> Result<(), SumoError> {
        self.goal = goal;
        called(
            "append a walk",
            session.sumo_mut().append_walk(&self.id, walk, goal.position_m),
        )
    }

    fn draw_place(&mut self, edge: usize) -> Place {
        Place {
            edge,
            position_m: unit(&mut self.rng) * self.roads.edge(edge).length_m,
        }
    }
}
