//! Population control: a fixed number of road users on random ways for ever, the same for the same seed.
//!
//! Every place in the population has its own random stream, so what one road user does never depends on the order in
//! which others are looked at. Vehicles get their routes prolonged before they reach the end; whoever leaves all the
//! same is replaced under a new name.

use std::{collections::BTreeMap, rc::Rc};

use ipc_schema::{
    config::Traffic,
    traffic::{MetaEvent, VehicleMeta},
};
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

use crate::{
    catalogue::{Catalogue, Entry, draw},
    error::SumoError,
    fleet::{CAV_PREFIX, HERO_PREFIX},
    frame::Frame,
    pedestrians::Pedestrians,
    roads::Roads,
    session::{Session, called},
    trips::Trips,
};

/// Ids of vehicles without sensors start with this.
const OTHER_PREFIX: &str = "other.";
/// Each road user is looked after once in this time, seconds.
const CARE_S: f64 = 1.0;
/// A vehicle that found no room for this long tries elsewhere, seconds.
const PATIENCE_S: f64 = 1.5;
/// Heroes are of this class where the catalogue has it.
const HERO_CLASS: &str = "passenger";
/// Routes are prolonged when fewer edges than this are left: enough for early lane changes, and for a second on short edges.
const EDGES_AHEAD: usize = 4;
/// Draws of a goal before one that is not allowed will do: with a tenth of all trips allowed, one in 10¹¹ is wrong.
const DRAWS_OF_A_TRIP: usize = 256;
/// How many road users to keep alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// Connected vehicles.
    pub cavs: u32,
    /// Other vehicles.
    pub others: u32,
    /// Heroes.
    pub heroes: u32,
    /// Pedestrians.
    pub pedestrians: u32,
}

impl From<&Traffic> for Size {
    fn from(traffic: &Traffic) -> Self {
        Self {
            cavs: traffic.cavs,
            others: traffic.others,
            heroes: traffic.heroes,
            pedestrians: traffic.pedestrians,
        }
    }
}

/// Where a driver goes.
#[derive(Debug, Clone)]
enum Way {
    /// From one random place to the next, for ever.
    Forever,
    /// To one random place.
    Once,
    /// Along these edges.
    Given(Rc<[String]>),
}

/// Roads that a command has given to whoever fills the place next.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Placed {
    pub(crate) start: Option<usize>,
    pub(crate) goal: Option<usize>,
}

/// A place in the population, and who fills it now.
#[derive(Debug)]
pub(crate) struct Driver {
    prefix: &'static str,
    pub(crate) id: String,
    vehicle_type: String,
    pub(crate) roads: Rc<Roads>,
    way: Way,
    trips: Trips,
    rng: ChaCha8Rng,
    /// Last edge of the route.
    pub(crate) goal: usize,
    pub(crate) route_edges: usize,
    pub(crate) placed: Placed,
    added_step: u64,
    departed: bool,
}

/// The road users of one episode.
#[derive(Debug)]
pub struct Population {
    pub(crate) drivers: Vec<Driver>,
    pub(crate) place_of: BTreeMap<String, usize>,
    next_number: BTreeMap<&'static str, u32>,
    pedestrians: Pedestrians,
    pace: Pace,
}

/// Steps in the times above.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pace {
    pub(crate) care: u64,
    patience: u64,
}

impl Pace {
    fn new(step_s: f64) -> Self {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a few steps, positive"
        )]
        let steps = |seconds: f64| ((seconds / step_s).round() as u64).max(1);
        Self {
            care: steps(CARE_S),
            patience: steps(PATIENCE_S),
        }
    }

    /// True once in a while for each place, for different places at different steps.
    pub(crate) fn cares_for(self, place: usize, step: u64) -> bool {
        (step + place as u64).is_multiple_of(self.care)
    }
}

/// The random stream of one place: a function of the episode's seed and the place alone.
pub(crate) fn stream(episode_seed: u64, place: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(episode_seed);
    rng.set_stream(place);
    rng
}

impl Population {
    /// Puts everybody at a random place of the freshly started `session`; they depart within the first two seconds.
    ///
    /// # Errors
    /// The net has no connected roads for a vehicle class in use, or no sidewalks for pedestrians, or no way along
    /// `hero_route` (the edges of every hero's route; none = at random).
    pub fn start(
        session: &mut Session,
        size: Size,
        hero_route: &[String],
        episode_seed: u64,
    ) -> Result<Self, SumoError> {
        Self::start_on(session, size, hero_route, Trips::ANY, episode_seed)
    }

    /// [`Self::start`] where vehicles make these trips only, as far as chance finds them.
    ///
    /// # Errors
    /// As there.
    pub fn start_on(
        session: &mut Session,
        size: Size,
        hero_route: &[String],
        trips: Trips,
        episode_seed: u64,
    ) -> Result<Self, SumoError> {
        let catalogue = Catalogue::read(session)?;
        let pedestrians = Pedestrians::start(session, size.pedestrians, &catalogue.pedestrians, episode_seed)?;
        let pace = Pace::new(session.step_s());
        let (place_of, next_number) = (BTreeMap::new(), BTreeMap::new());
        let drivers = drivers(session, size, hero_route, trips, &catalogue, episode_seed)?;
        let mut population = Self {
            drivers,
            place_of,
            next_number,
            pedestrians,
            pace,
        };
        for place in 0..population.drivers.len() {
            population.fill(session, place, 0)?;
        }
        Ok(population)
    }

    /// Looks after the population once a step: replaces who left and prolongs the ways of some of the others.
    ///
    /// # Errors
    /// SUMO refuses a new road user.
    pub fn after_step(&mut self, session: &mut Session, frame: &Frame) -> Result<(), SumoError> {
        for event in &frame.events {
            self.note(session, event, frame.step)?;
        }
        for place in 0..self.drivers.len() {
            if self.pace.cares_for(place, frame.step) {
                self.care(session, place, frame.step)?;
            }
        }
        self.pedestrians.after_step(session, frame, self.pace)
    }

    fn note(&mut self, session: &mut Session, event: &VehicleMeta, step: u64) -> Result<(), SumoError> {
        let Some(&place) = self.place_of.get(&event.id_text()) else {
            return Ok(());
        };
        if event.event == MetaEvent::Departed as u32 {
            self.drivers[place].departed = true;
        } else if event.event == MetaEvent::Arrived as u32 {
            self.fill(session, place, step)?;
        }
        Ok(())
    }

    fn care(&mut self, session: &mut Session, place: usize, step: u64) -> Result<(), SumoError> {
        let driver = &self.drivers[place];
        if driver.departed {
            self.drivers[place].prolong(session);
        } else if step - driver.added_step >= self.pace.patience {
            called(
                "remove a waiting vehicle",
                session.sumo_mut().remove_vehicle(&driver.id),
            )?;
            self.fill(session, place, step)?;
        }
        Ok(())
    }

    /// Adds a new vehicle for `place`, of the type that belongs to the place, with a random route.
    pub(crate) fn fill(&mut self, session: &mut Session, place: usize, step: u64) -> Result<(), SumoError> {
        let driver = &mut self.drivers[place];
        self.place_of.remove(&driver.id);
        let number = self.next_number.entry(driver.prefix).or_insert(0);
        driver.id = format!("{}{number}", driver.prefix);
        *number += 1;
        self.place_of.insert(driver.id.clone(), place);
        driver.add(session, step)
    }
}

impl Driver {
    pub(crate) fn is_on_a_given_way(&self) -> bool {
        matches!(self.way, Way::Given(_))
    }

    fn add(&mut self, session: &mut Session, step: u64) -> Result<(), SumoError> {
        if let Way::Given(route) = &self.way {
            (self.route_edges, self.added_step, self.departed) = (route.len(), step, false);
            let added = session
                .sumo_mut()
                .add_vehicle_at_start(&self.id, &self.vehicle_type, route);
            return added.map_err(|error| SumoError::HeroRoute {
                reason: error.what().trim().to_owned(),
            });
        }
        let placed = std::mem::take(&mut self.placed);
        let start = placed.start.unwrap_or_else(|| self.roads.draw_start(&mut self.rng));
        self.goal = match placed.goal {
            Some(goal) if goal != start => goal,
            _ => self.draw_goal(start),
        };
        let route = self.roads.route(start, self.goal);
        (self.route_edges, self.added_step, self.departed) = (route.len(), step, false);
        called(
            "add a vehicle",
            session.sumo_mut().add_vehicle(&self.id, &self.vehicle_type, &route),
        )
    }

    /// A random road to go to, on an allowed trip; any if none comes up.
    fn draw_goal(&mut self, from: usize) -> usize {
        let mut goal = from;
        for _ in 0..DRAWS_OF_A_TRIP {
            goal = self.roads.draw_other(from, &mut self.rng);
            if self.trips.allow(&self.roads.edge(from).id, &self.roads.edge(goal).id) {
                break;
            }
        }
        goal
    }

    /// Leads the vehicle on to another random edge when its route gets short. A refusal does no harm: it is tried
    /// again, and whoever arrives in the meantime is replaced.
    fn prolong(&mut self, session: &mut Session) {
        if !matches!(self.way, Way::Forever) {
            return;
        }
        let passed = session
            .sumo()
            .route_index(&self.id)
            .map_or(0, |index| usize::try_from(index).unwrap_or(0));
        if self.route_edges > passed + EDGES_AHEAD {
            return;
        }
        let goal = self.draw_goal(self.goal);
        let more = self.roads.route(self.goal, goal);
        match session.sumo_mut().extend_route(&self.id, &more) {
            Ok(()) => (self.route_edges, self.goal) = (self.route_edges + more.len() - 1, goal),
            Err(error) => tracing::debug!(id = self.id, %error, "route not prolonged"),
        }
    }
}

/// The places of the population, still empty: heroes last, so that they do not change what the others draw.
fn drivers(
    session: &Session,
    size: Size,
    hero_route: &[String],
    trips: Trips,
    catalogue: &Catalogue,
    episode_seed: u64,
) -> Result<Vec<Driver>, SumoError> {
    let hero_way = match hero_route {
        [] => Way::Once,
        edges => Way::Given(edges.into()),
    };
    let hero_types: Vec<Entry> = catalogue
        .vehicles
        .iter()
        .filter(|entry| entry.class == HERO_CLASS)
        .cloned()
        .collect();
    let hero_types = if hero_types.is_empty() {
        &catalogue.vehicles
    } else {
        &hero_types
    };
    let all = [
        (CAV_PREFIX, size.cavs, Way::Forever, &catalogue.vehicles),
        (OTHER_PREFIX, size.others, Way::Forever, &catalogue.vehicles),
        (HERO_PREFIX, size.heroes, hero_way, hero_types),
    ];
    let places = all
        .into_iter()
        .flat_map(|(prefix, count, way, types)| std::iter::repeat_n((prefix, way, types), count as usize));
    let mut roads: BTreeMap<String, Rc<Roads>> = BTreeMap::new();
    let mut drivers = Vec::new();
    for (place, (prefix, way, types)) in places.enumerate() {
        let mut rng = stream(episode_seed, place as u64);
        let entry = draw(types, &mut rng);
        if !roads.contains_key(&entry.class) {
            roads.insert(entry.class.clone(), Rc::new(Roads::connected(session, &entry.class)?));
        }
        drivers.push(Driver {
            prefix,
            id: String::new(),
            vehicle_type: entry.id.clone(),
            roads: Rc::clone(&roads[&entry.class]),
            way,
            trips,
            rng,
            goal: 0,
            route_edges: 0,
            placed: Placed::default(),
            added_step: 0,
            departed: false,
        });
    }
    Ok(drivers)
}

#[cfg(test)]
mod tests {
    use super::stream;
    use crate::catalogue::unit;

    #[test]
    fn neighbouring_places_draw_independently() {
        let low = (0..10_000).filter(|&place| unit(&mut stream(5, place)) < 0.3).count();
        // Binomial: 5 standard deviations are 229.
        assert!((2_771..=3_229).contains(&low), "{low}");
    }
}
