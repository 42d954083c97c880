//! Population control: a fixed number of road users on random routes without end, the same for the same seed.
//!
//! Every place in the population has its own random stream, so what one road user does never depends on the order in which
//! others are updated. The population extends a vehicle's route before the vehicle reaches its end, and replaces a road user that
//! leaves by one with a new name.

mod graph;
mod pedestrians;
mod places;
pub(crate) mod placing;
pub mod roads;
pub mod trips;
pub mod vehicle_types;

use std::{collections::BTreeMap, rc::Rc};

use ipc_schema::{
    config::{HeroTurns, TrafficConfig},
    traffic::{MetaEvent, VehicleMeta},
};
use rand_chacha::ChaCha8Rng;

use crate::sumo::{
    Sumo, called,
    connected::{CAV_PREFIX, HERO_PREFIX},
    error::SumoError,
    frame::TrafficFrame,
};
use pedestrians::Pedestrians;
use places::{CareSchedule, stream};
use roads::Roads;
use trips::TripSelection;
use vehicle_types::{TypeCatalogue, WeightedType, draw};

/// Ids of vehicles without sensors start with this prefix.
const OTHER_PREFIX: &str = "other.";
/// Heroes are of this class where the catalogue has it.
const HERO_CLASS: &str = "passenger";
/// Routes are extended when fewer edges than this are left: enough for early lane changes, and for a second on short edges.
const EDGES_AHEAD: usize = 4;
/// Draws of a goal before a goal that is not allowed is accepted: with a tenth of all trips allowed, one in 10¹¹ is wrong.
const DRAWS_OF_A_TRIP: usize = 256;

/// How many road users to keep alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PopulationSize {
    /// Connected vehicles.
    pub cavs: u32,
    /// Other vehicles.
    pub others: u32,
    /// Heroes.
    pub heroes: u32,
    /// Pedestrians.
    pub pedestrians: u32,
}

impl From<&TrafficConfig> for PopulationSize {
    fn from(traffic: &TrafficConfig) -> Self {
        Self {
            cavs: traffic.cavs,
            others: traffic.others,
            heroes: traffic.heroes,
            pedestrians: traffic.pedestrians,
        }
    }
}

/// The trips that a driver makes.
#[derive(Debug, Clone)]
enum DriverTrips {
    /// From one random road to the next, without end.
    Forever,
    /// To one random road, by such a route.
    Once(HeroTurns),
    /// Along these edges.
    Given(Rc<[String]>),
}

/// Roads that a command has assigned to the next vehicle of a place.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct CommandedRoads {
    pub(crate) start: Option<usize>,
    pub(crate) goal: Option<usize>,
}

/// A place in the population, and the vehicle that fills it now.
#[derive(Debug)]
pub(crate) struct Driver {
    prefix: &'static str,
    pub(crate) id: String,
    vehicle_type: String,
    pub(crate) roads: Rc<Roads>,
    way: DriverTrips,
    trips: TripSelection,
    rng: ChaCha8Rng,
    /// Last edge of the route.
    pub(crate) goal: usize,
    pub(crate) route_edges: usize,
    pub(crate) placed: CommandedRoads,
    added_step: u64,
    departed: bool,
    /// SUMO drives it beyond the end of its route.
    goes_on: bool,
}

/// Where heroes drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct HeroRoutes<'a> {
    /// The edges of every hero's route; none = at random.
    pub edges: &'a [String],
    /// Which routes are drawn.
    pub turns: HeroTurns,
    /// SUMO drives them beyond the ends of their routes: their mirrors, which are behind SUMO, arrive there later.
    pub go_on: bool,
}

impl<'a> From<&'a TrafficConfig> for HeroRoutes<'a> {
    fn from(traffic: &'a TrafficConfig) -> Self {
        Self {
            edges: &traffic.hero_route,
            turns: traffic.hero_turns,
            go_on: false,
        }
    }
}

/// The road users of one episode.
#[derive(Debug)]
pub struct Population {
    pub(crate) drivers: Vec<Driver>,
    pub(crate) place_of: BTreeMap<String, usize>,
    next_number: BTreeMap<&'static str, u32>,
    pedestrians: Pedestrians,
    pace: CareSchedule,
}

impl Population {
    /// Adds all road users at random positions of a `sumo` that has just started; they depart within the first two seconds.
    ///
    /// # Errors
    /// The net has no connected roads for a vehicle class in use, or no sidewalks for pedestrians, or no route along those of `heroes`.
    pub fn start(
        sumo: &mut Sumo,
        size: PopulationSize,
        heroes: HeroRoutes<'_>,
        episode_seed: u64,
    ) -> Result<Self, SumoError> {
        Self::start_on(sumo, size, heroes, TripSelection::ANY, episode_seed)
    }

    /// [`Self::start`] with vehicles that make only these trips, as far as random draws find them.
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn start_on(
        sumo: &mut Sumo,
        size: PopulationSize,
        heroes: HeroRoutes<'_>,
        trips: TripSelection,
        episode_seed: u64,
    ) -> Result<Self, SumoError> {
        let catalogue = TypeCatalogue::read(sumo)?;
        let pedestrians = Pedestrians::start(sumo, size.pedestrians, &catalogue.pedestrians, episode_seed)?;
        let pace = CareSchedule::new(sumo.step_s());
        let (place_of, next_number) = (BTreeMap::new(), BTreeMap::new());
        let drivers = drivers(sumo, size, heroes, trips, &catalogue, episode_seed)?;
        let mut population = Self {
            drivers,
            place_of,
            next_number,
            pedestrians,
            pace,
        };
        for place in 0..population.drivers.len() {
            population.fill(sumo, place, 0)?;
        }
        Ok(population)
    }

    /// Updates the population once a step: replaces road users that left and extends the routes of some of the others.
    ///
    /// # Errors
    /// SUMO refuses a new road user.
    pub fn after_step(&mut self, sumo: &mut Sumo, frame: &TrafficFrame) -> Result<(), SumoError> {
        for event in &frame.events {
            self.track_event(sumo, event, frame.step)?;
        }
        for place in 0..self.drivers.len() {
            if self.pace.is_due(place, frame.step) {
                self.update_place(sumo, place, frame.step)?;
            }
        }
        self.pedestrians.after_step(sumo, frame, self.pace)
    }

    fn track_event(&mut self, sumo: &mut Sumo, event: &VehicleMeta, step: u64) -> Result<(), SumoError> {
        let Some(&place) = self.place_of.get(&event.id_text()) else {
            return Ok(());
        };
        if event.event == MetaEvent::Departed as u32 {
            self.drivers[place].departed = true;
            if self.drivers[place].goes_on {
                self.drivers[place].add_to_route(sumo);
            }
        } else if event.event == MetaEvent::Arrived as u32 {
            self.fill(sumo, place, step)?;
        }
        Ok(())
    }

    fn update_place(&mut self, sumo: &mut Sumo, place: usize, step: u64) -> Result<(), SumoError> {
        let driver = &self.drivers[place];
        if driver.departed {
            self.drivers[place].extend_route(sumo);
        } else if step - driver.added_step >= self.pace.patience {
            called(
                "remove a waiting vehicle",
                sumo.simulation_mut().remove_vehicle(&driver.id),
            )?;
            self.fill(sumo, place, step)?;
        }
        Ok(())
    }

    /// Adds a new vehicle for `place`, of the type that belongs to the place, with a random route.
    pub(crate) fn fill(&mut self, sumo: &mut Sumo, place: usize, step: u64) -> Result<(), SumoError> {
        let driver = &mut self.drivers[place];
        self.place_of.remove(&driver.id);
        let number = self.next_number.entry(driver.prefix).or_insert(0);
        driver.id = format!("{}{number}", driver.prefix);
        *number += 1;
        self.place_of.insert(driver.id.clone(), place);
        driver.add(sumo, step)
    }
}

impl Driver {
    pub(crate) fn has_given_route(&self) -> bool {
        matches!(self.way, DriverTrips::Given(_))
    }

    fn add(&mut self, sumo: &mut Sumo, step: u64) -> Result<(), SumoError> {
        if let DriverTrips::Given(route) = &self.way {
            (self.route_edges, self.added_step, self.departed) = (route.len(), step, false);
            self.goal = route.last().and_then(|edge| self.roads.find(edge)).unwrap_or(self.goal);
            let added = sumo
                .simulation_mut()
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
            sumo.simulation_mut().add_vehicle(&self.id, &self.vehicle_type, &route),
        )
    }

    /// A random destination on an allowed trip; any road if the draws find none.
    fn draw_goal(&mut self, from: usize) -> usize {
        let turns_left = matches!(self.way, DriverTrips::Once(HeroTurns::Left));
        let mut goal = from;
        for _ in 0..DRAWS_OF_A_TRIP {
            goal = self.roads.draw_other(from, &mut self.rng);
            let is_allowed = self.trips.allow(&self.roads.edge(from).id, &self.roads.edge(goal).id);
            if is_allowed && (!turns_left || self.roads.turns_left(from, goal)) {
                break;
            }
        }
        goal
    }

    /// Extends the vehicle's route to another random edge when few edges are left. A refusal does no harm: the population tries
    /// again, and replaces a vehicle that arrives in the meantime.
    fn extend_route(&mut self, sumo: &mut Sumo) {
        if !matches!(self.way, DriverTrips::Forever) {
            return;
        }
        let passed = sumo
            .simulation()
            .route_index(&self.id)
            .map_or(0, |index| usize::try_from(index).unwrap_or(0));
        if self.route_edges <= passed + EDGES_AHEAD {
            self.add_to_route(sumo);
        }
    }

    /// Adds the way to another random edge.
    fn add_to_route(&mut self, sumo: &mut Sumo) {
        let goal = self.draw_goal(self.goal);
        let more = self.roads.route(self.goal, goal);
        match sumo.simulation_mut().extend_route(&self.id, &more) {
            Ok(()) => (self.route_edges, self.goal) = (self.route_edges + more.len() - 1, goal),
            Err(error) => tracing::debug!(id = self.id, %error, "route not extended"),
        }
    }
}

/// The places of the population, still empty. Heroes come last, so that they do not change what the others draw.
fn drivers(
    sumo: &Sumo,
    size: PopulationSize,
    heroes: HeroRoutes<'_>,
    trips: TripSelection,
    catalogue: &TypeCatalogue,
    episode_seed: u64,
) -> Result<Vec<Driver>, SumoError> {
    let hero_way = match heroes.edges {
        [] => DriverTrips::Once(heroes.turns),
        edges => DriverTrips::Given(edges.into()),
    };
    let hero_types: Vec<WeightedType> = catalogue
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
        (CAV_PREFIX, size.cavs, DriverTrips::Forever, &catalogue.vehicles),
        (OTHER_PREFIX, size.others, DriverTrips::Forever, &catalogue.vehicles),
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
            roads.insert(entry.class.clone(), Rc::new(Roads::connected(sumo, &entry.class)?));
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
            placed: CommandedRoads::default(),
            added_step: 0,
            departed: false,
            goes_on: prefix == HERO_PREFIX && heroes.go_on,
        });
    }
    Ok(drivers)
}
