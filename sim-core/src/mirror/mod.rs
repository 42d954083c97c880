//! The mirror: every road user of an episode, moved tick by tick between SUMO's states.
//!
//! A SUMO state that arrives is the *end* of a SUMO step. The mirror then moves through the `m` ticks of that step, the last
//! of which ends at SUMO's own time: with `m = 1` a tick follows from each frame at once, with more the mirror knows both
//! ends of the step it moves through. Within the step vehicles follow SUMO's smoothed positions, which puts them half a SUMO step
//! behind (see [`reference`]). A road user exists from the tick at which SUMO first has it.

use std::collections::BTreeMap;

use ipc_schema::{
    block::{self, BlockError},
    header::MessageHeader,
    traffic::{MetaEvent, TrafficState, VehicleMeta},
    world::{BODY_SHIFT, GUIDED, SubStep, VehicleState, WorldLayout},
};

mod articulation;
pub mod batch;
pub mod curve;
pub mod departure;
pub mod governor;
pub mod guidance;
pub mod hero;
pub mod pace;
pub mod person;
pub mod prefetch;
pub mod preview;
pub mod reference;
pub mod resynchronisation;
pub mod road_user;
pub mod settings;
pub mod statistics;
pub mod suites;
pub mod tracking;
pub mod window;

use crate::{
    models::{
        catalogue::{ModelCatalogue, MotionModel},
        dynamic::DynamicParams,
        kinematic::KinematicParams,
        parameters::ParameterError,
        state::ControlInput,
    },
    scene::shape::OrientedBox,
};
use articulation::TrailingChain;
use batch::{BATCH, BatchModel, DYNAMIC, KINEMATIC, VehicleBatch, path_limits};
use departure::{ContactCause, Departure};
use pace::PathLimits;
use prefetch::PrefetchRange;
use preview::PathAhead;
use resynchronisation::{Guidance, Resynchronisation};
use road_user::RoadUser;
pub use settings::MirrorSettings;
use statistics::TrackingStatistics;

/// A message of `traffic-bridge` cannot be mirrored.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum MirrorError {
    /// A road user was never announced in `traffic-meta`.
    #[error("tick {tick}: road user {vehicle} was never announced")]
    Unannounced {
        /// Dense index.
        vehicle: u32,
        /// Tick of the frame.
        tick: u64,
    },
    /// A position, speed or heading is not a number.
    #[error("tick {tick}: road user {vehicle} has a position, heading or speed that is not a finite number")]
    NotFinite {
        /// Dense index.
        vehicle: u32,
        /// Tick of the frame.
        tick: u64,
    },
    /// A road user is in a frame twice.
    #[error("tick {tick}: road user {vehicle} is in the frame twice")]
    Twice {
        /// Dense index.
        vehicle: u32,
        /// Tick of the frame.
        tick: u64,
    },
    /// The dense index of a road user is out of range.
    #[error("road user {vehicle}: more than {MAX_ANNOUNCED} road users in one episode")]
    TooMany {
        /// Dense index.
        vehicle: u32,
    },
    /// The payload is too short or misaligned.
    #[error(transparent)]
    Block(#[from] BlockError),
}

/// Not in the slab.
const NOWHERE: u32 = u32::MAX;
/// Most road users announced in one episode: four bytes are kept for each, and the bits above number the bodies of a vehicle.
const MAX_ANNOUNCED: u32 = 1 << BODY_SHIFT;

/// Rows between the road user at hand and one whose path is prefetched; one that is prefetched itself is twice as far away.
const PATHS_AHEAD: usize = 4;

/// All road users of the current episode.
#[derive(Debug)]
pub struct Mirror {
    settings: MirrorSettings,
    episode: Option<u64>,
    /// Position in `slab` of each road user by dense index, or [`NOWHERE`].
    places: Vec<u32>,
    slab: Vec<RoadUser>,
    /// The path ahead of each road user of the slab; empty without a preview.
    paths: Vec<PathAhead>,
    /// What the vehicles of each model can drive, by its index in the catalogue; empty without a preview.
    limits: Vec<PathLimits>,
    free: Vec<u32>,
    /// The trailing bodies of articulated vehicles, by dense index.
    chains: BTreeMap<u32, TrailingChain>,
    /// Road users of the current frame: dense index and place, in ascending order of the index.
    present: Vec<(u32, u32)>,
    /// How many of them have a state in all ticks of the step.
    in_whole_step: usize,
    frame: u64,
    catalogue: ModelCatalogue,
    kinematic: ModelBatch<KinematicParams, KINEMATIC>,
    dynamic: ModelBatch<DynamicParams, DYNAMIC>,
    tracking: TrackingStatistics,
    resynchronisations: u64,
    /// Those of the last tick.
    resynchronised: Vec<Resynchronisation>,
    /// The guidances that began in the last tick.
    guidances: Vec<Guidance>,
}

/// A batch of one model, and where the states of its members belong.
#[derive(Debug)]
struct ModelBatch<P, const N: usize> {
    batch: VehicleBatch<P, N>,
    /// Position in the slab and row in the message of each member.
    loaded: Vec<(u32, usize)>,
}

impl Mirror {
    /// An empty mirror.
    ///
    /// # Errors
    /// A class is given a model that does not exist.
    pub fn new(settings: MirrorSettings) -> Result<Self, ParameterError> {
        let sub_steps = settings.sub_steps as usize;
        Ok(Self {
            catalogue: settings.catalogue()?,
            settings,
            episode: None,
            places: Vec::new(),
            slab: Vec::new(),
            paths: Vec::new(),
            limits: Vec::new(),
            free: Vec::new(),
            chains: BTreeMap::new(),
            present: Vec::new(),
            in_whole_step: 0,
            frame: 0,
            kinematic: ModelBatch::new(sub_steps),
            dynamic: ModelBatch::new(sub_steps),
            tracking: TrackingStatistics::default(),
            resynchronisations: 0,
            resynchronised: Vec::new(),
            guidances: Vec::new(),
        })
    }

    /// Tracking statistics of the run.
    #[must_use]
    pub fn tracking(&self) -> &TrackingStatistics {
        &self.tracking
    }

    /// Name of the parameter set that unknown classes get.
    #[must_use]
    pub fn default_set(&self) -> &str {
        self.catalogue.default_set()
    }

    /// Vehicle classes seen since the last call that no parameter set lists. Each is returned once in a run.
    pub fn take_unknown_classes(&mut self) -> Vec<String> {
        self.catalogue.take_unknown()
    }

    /// Times and limits.
    #[must_use]
    pub fn settings(&self) -> &MirrorSettings {
        &self.settings
    }

    /// Mirrors that were set onto SUMO because no motion leads there, over the run; entering the network does not count.
    #[must_use]
    pub fn resynchronisations(&self) -> u64 {
        self.resynchronisations
    }

    /// The road users that the last tick set onto SUMO.
    #[must_use]
    pub fn resynchronised(&self) -> &[Resynchronisation] {
        &self.resynchronised
    }

    /// The guidances that began in the last tick.
    #[must_use]
    pub fn guidances(&self) -> &[Guidance] {
        &self.guidances
    }

    /// What explains that two mirrors touch, as their states of the last tick describe them, where SUMO has them apart.
    #[must_use]
    pub fn contact_cause(&self, states: [&VehicleState; 2]) -> ContactCause {
        let [a, b] = states.map(|state| self.departure(state).cause());
        a.min(b)
    }

    fn departure(&self, state: &VehicleState) -> Departure {
        let place = self.place(state.vehicle).map_or(usize::MAX, |place| place as usize);
        let road_user = self.slab.get(place);
        road_user.map_or_else(Departure::default, |road_user| {
            road_user.departure(self.paths.get(place), state)
        })
    }

    /// The boxes in which SUMO has a road user at the mirror's time, a frame more or less, newest first; empty if it is not known.
    #[must_use]
    pub fn sumo_boxes(&self, vehicle: u32) -> Vec<OrientedBox> {
        let place = self.place(vehicle).map_or(usize::MAX, |place| place as usize);
        let road_user = self.slab.get(place);
        road_user.map_or_else(Vec::new, |road_user| road_user.sumo_boxes(self.paths.get(place)))
    }

    /// Continues counting from statistics of earlier episodes.
    pub fn restore_counts(&mut self, tracking: TrackingStatistics, resynchronisations: u64) {
        (self.tracking, self.resynchronisations) = (tracking, resynchronisations);
    }

    /// Takes announcements: departures make road users known, arrivals let them go.
    ///
    /// # Errors
    /// More road users in one episode than there are places for.
    pub fn apply_meta(&mut self, header: &MessageHeader, metas: &[VehicleMeta]) -> Result<(), MirrorError> {
        self.enter_episode(header.episode);
        for meta in metas {
            if meta.event == MetaEvent::Departed as u32 {
                self.announce(meta)?;
            } else if meta.event == MetaEvent::Arrived as u32 {
                self.dismiss(meta.vehicle);
            }
        }
        Ok(())
    }

    fn announce(&mut self, meta: &VehicleMeta) -> Result<(), MirrorError> {
        let vehicle = meta.vehicle;
        if vehicle >= MAX_ANNOUNCED {
            return Err(MirrorError::TooMany { vehicle });
        }
        self.dismiss(vehicle);
        let road_user = RoadUser::new(meta, &mut self.catalogue, &self.settings);
        if self.settings.preview().is_some() {
            let known = self.limits.len() as u32;
            let more = (known..=road_user.model()).map(|model| path_limits(self.catalogue.at(model)));
            self.limits.extend(more);
        }
        let place = match self.free.pop() {
            Some(place) => {
                self.slab[place as usize] = road_user;
                place
            }
            None => {
                self.slab.push(road_user);
                self.paths.extend(self.settings.preview().map(PathAhead::new));
                self.slab.len() as u32 - 1
            }
        };
        if self.places.len() <= vehicle as usize {
            self.places.resize(vehicle as usize + 1, NOWHERE);
        }
        self.places[vehicle as usize] = place;
        let trailing = self.catalogue.at(self.slab[place as usize].model()).trailing;
        if let Some(chain) = TrailingChain::new(trailing) {
            self.chains.insert(vehicle, chain);
        }
        Ok(())
    }

    fn dismiss(&mut self, vehicle: u32) {
        if let Some(place) = self.places.get_mut(vehicle as usize)
            && *place != NOWHERE
        {
            self.free.push(std::mem::replace(place, NOWHERE));
            self.chains.remove(&vehicle);
        }
    }

    fn place(&self, vehicle: u32) -> Option<u32> {
        self.places
            .get(vehicle as usize)
            .copied()
            .filter(|&place| place != NOWHERE)
    }

    /// Forgets everything when a new episode begins.
    fn enter_episode(&mut self, episode: u64) {
        if self.episode != Some(episode) {
            self.episode = Some(episode);
            self.places.clear();
            self.slab.clear();
            self.paths.clear();
            self.free.clear();
            self.chains.clear();
            self.present.clear();
            self.in_whole_step = 0;
            self.frame = 0;
        }
    }

    /// Prefetches road users, and their paths if there is a preview, some rows behind `index`: each road user would wait for its own, and
    /// a path is spread over memory.
    #[inline(never)]
    fn prefetch(&self, states: &[TrafficState], index: usize) {
        let place = |rows: usize| {
            let later = states.get(index + rows)?;
            self.places.get(later.vehicle as usize).map(|place| *place as usize)
        };
        if let Some(place) = place(2 * PATHS_AHEAD) {
            PrefetchRange::new(&self.slab, place, 1).fetch_all();
            PrefetchRange::new(&self.paths, place, 1).fetch_all();
        }
        if let Some(path) = place(PATHS_AHEAD).and_then(|place| self.paths.get(place)) {
            path.prefetch();
        }
    }

    /// Takes the state of all road users at the end of a SUMO step. Their ticks are written by [`Mirror::write_tick`].
    ///
    /// # Errors
    /// A road user was not announced, is in the frame twice, or has values that are not finite numbers.
    pub fn accept(&mut self, header: &MessageHeader, states: &[TrafficState]) -> Result<(), MirrorError> {
        self.enter_episode(header.episode);
        self.frame += 1;
        self.present.clear();
        self.in_whole_step = 0;
        let tick = header.tick;
        for (index, now) in states.iter().enumerate() {
            self.prefetch(states, index);
            let vehicle = now.vehicle;
            let place = self.place(vehicle).ok_or(MirrorError::Unannounced { vehicle, tick })?;
            if !is_finite(now) {
                return Err(MirrorError::NotFinite { vehicle, tick });
            }
            let road_user = &mut self.slab[place as usize];
            let path = self.paths.get_mut(place as usize);
            let ahead = path.zip(self.limits.get(road_user.model() as usize));
            road_user.accept(now, self.frame, ahead, &self.settings);
            if !road_user.is_hidden() {
                self.in_whole_step += usize::from(road_user.is_in_whole_step());
                self.present.push((vehicle, place));
            }
        }
        self.present.sort_unstable();
        match self.present.windows(2).find(|pair| pair[0].0 == pair[1].0) {
            Some(pair) => Err(MirrorError::Twice {
                vehicle: pair[0].0,
                tick,
            }),
            None => Ok(()),
        }
    }

    /// Sets the control input of the hero `vehicle` from now on.
    pub fn set_input(&mut self, vehicle: u32, input: ControlInput) {
        if let Some(place) = self.place(vehicle) {
            self.slab[place as usize].set_input(input);
        }
    }

    /// Number of road users in tick `tick` (0-based within the SUMO step), without trailing bodies.
    #[must_use]
    pub fn count(&self, tick: u32) -> usize {
        if self.is_last(tick) {
            self.present.len()
        } else {
            self.in_whole_step
        }
    }

    /// Number of heroes in tick `tick`.
    #[must_use]
    pub fn hero_count(&self, tick: u32) -> usize {
        let last = self.is_last(tick);
        let present = self.present.iter().map(|(_, place)| &self.slab[*place as usize]);
        let heroes = present.filter(|road_user| road_user.is_hero());
        heroes.filter(|hero| last || hero.is_in_whole_step()).count()
    }

    /// Number of trailing bodies in tick `tick`: of the vehicles with the lowest indices, as many as a message has room for.
    #[must_use]
    pub fn trailing_count(&self, tick: u32) -> usize {
        self.chains_of(tick).map(|(_, count)| count).sum()
    }

    /// The articulated vehicles of a tick whose bodies are in its message, and their numbers of bodies.
    fn chains_of(&self, tick: u32) -> impl Iterator<Item = (u32, usize)> + '_ {
        let last = self.is_last(tick);
        let present = self.chains.iter().filter(move |(vehicle, _)| {
            let place = self.present.binary_search_by_key(vehicle, |(vehicle, _)| vehicle);
            place.is_ok_and(|place| last || self.slab[self.present[place].1 as usize].is_in_whole_step())
        });
        let mut room = self.settings.most_trailing;
        present.map_while(move |(vehicle, chain)| {
            room = room.checked_sub(chain.count())?;
            Some((*vehicle, chain.count()))
        })
    }

    fn is_last(&self, tick: u32) -> bool {
        tick + 1 >= self.settings.ticks_per_step
    }

    /// The layout of the message of tick `tick`.
    #[must_use]
    pub fn layout(&self, tick: u32) -> WorldLayout {
        let sub_steps = self.settings.sub_steps as usize;
        WorldLayout::with_heroes(self.count(tick), sub_steps, 0, self.trailing_count(tick))
    }

    /// Moves all road users through tick `tick` and writes them into `payload`, laid out by [`Mirror::layout`], in ascending
    /// order of their index. Call once for each tick of the step, in order. Every byte of both arrays is written.
    ///
    /// # Errors
    /// The payload is too short or misaligned.
    pub fn write_tick(&mut self, tick: u32, payload: &mut [u8]) -> Result<(), MirrorError> {
        let layout = self.layout(tick);
        let last = self.is_last(tick);
        let per_tick = self.settings.sub_steps as usize;
        let [states, rows] = block::split_mut(payload, &[layout.states, layout.sub_steps])?;
        let states: &mut [VehicleState] = cast(states, layout.states.offset)?;
        let rows: &mut [SubStep] = cast(rows, layout.sub_steps.offset)?;
        let (states, trailing) = states.split_at_mut(self.count(tick));
        let mut place_in_message = 0;
        self.resynchronised.clear();
        self.guidances.clear();
        for index in 0..self.present.len() {
            let (_, place) = self.present[index];
            let road_user = &mut self.slab[place as usize];
            if !last && !road_user.is_in_whole_step() {
                continue;
            }
            let row = place_in_message;
            place_in_message += 1;
            if road_user.moves(tick, &self.settings) {
                self.load(tick, place, row, states, rows);
            } else {
                let sub_steps = &mut rows[row * per_tick..(row + 1) * per_tick];
                let models = self.catalogue.with_body(road_user.model());
                let set = road_user.write_unmoved(tick, &self.settings, models, &mut states[row], sub_steps);
                self.resynchronised.extend(set);
                if states[row].flags & GUIDED != 0 {
                    self.tracking.add(&states[row]);
                }
            }
        }
        let mut context = BatchContext {
            settings: &self.settings,
            slab: &mut self.slab,
            tracking: &mut self.tracking,
            resynchronised: &mut self.resynchronised,
            guidances: &mut self.guidances,
        };
        self.kinematic.advance(tick, &mut context, states, rows);
        self.dynamic.advance(tick, &mut context, states, rows);
        self.resynchronisations += self.resynchronised.len() as u64;
        self.write_trailing(tick, states, rows, trailing);
        Ok(())
    }

    /// Moves the trailing bodies behind the road users of a finished tick, and puts vehicles on rails onto them.
    fn write_trailing(
        &mut self,
        tick: u32,
        states: &mut [VehicleState],
        rows: &mut [SubStep],
        mut trailing: &mut [VehicleState],
    ) {
        let (per_tick, tick_s) = (self.settings.sub_steps as usize, self.settings.tick_s);
        if self.chains.is_empty() {
            return;
        }
        let written: BTreeMap<u32, usize> = self.chains_of(tick).collect();
        for (vehicle, chain) in &mut self.chains {
            let row = states.binary_search_by_key(vehicle, |state| state.vehicle);
            let (Ok(row), Some(&count)) = (row, written.get(vehicle)) else {
                chain.forget();
                continue;
            };
            let (bodies, rest) = std::mem::take(&mut trailing).split_at_mut(count);
            states[row].trailing = count as u16;
            let steps = &mut rows[row * per_tick..(row + 1) * per_tick];
            chain.write_tick(&mut states[row], steps, tick_s, bodies);
            trailing = rest;
        }
    }

    /// Loads a vehicle into the batch of its model, and advances the batch if it is full.
    fn load(&mut self, tick: u32, place: u32, row: usize, states: &mut [VehicleState], rows: &mut [SubStep]) {
        let Self {
            settings,
            slab,
            catalogue,
            kinematic,
            dynamic,
            tracking,
            resynchronised,
            guidances,
            ..
        } = self;
        let built = catalogue.at(slab[place as usize].model());
        let mut context = BatchContext {
            settings,
            slab,
            tracking,
            resynchronised,
            guidances,
        };
        match &built.model {
            MotionModel::Kinematic(params) => {
                if kinematic.load(tick, params, &mut context, (place, row)) {
                    kinematic.advance(tick, &mut context, states, rows);
                }
            }
            MotionModel::Dynamic(params) => {
                if dynamic.load(tick, params, &mut context, (place, row)) {
                    dynamic.advance(tick, &mut context, states, rows);
                }
            }
        }
    }
}

/// The parts of the mirror that a batch needs.
struct BatchContext<'a> {
    settings: &'a MirrorSettings,
    slab: &'a mut [RoadUser],
    tracking: &'a mut TrackingStatistics,
    resynchronised: &'a mut Vec<Resynchronisation>,
    guidances: &'a mut Vec<Guidance>,
}

impl<P: BatchModel<N>, const N: usize> ModelBatch<P, N> {
    fn new(sub_steps: usize) -> Self {
        Self {
            batch: VehicleBatch::new(sub_steps),
            loaded: Vec::with_capacity(BATCH),
        }
    }

    /// Loads the road user at a position of the slab, whose tick belongs to a row of the message. True if the batch is full.
    fn load(&mut self, tick: u32, params: &P, context: &mut BatchContext<'_>, (place, row): (u32, usize)) -> bool {
        let member = self.loaded.len();
        context.slab[place as usize].load(tick, context.settings, params, &mut self.batch, member);
        self.loaded.push((place, row));
        self.loaded.len() == BATCH
    }

    /// Moves the members through the tick and writes them.
    fn advance(
        &mut self,
        tick: u32,
        context: &mut BatchContext<'_>,
        states: &mut [VehicleState],
        rows: &mut [SubStep],
    ) {
        let Some(&(place, row)) = self.loaded.last() else {
            return;
        };
        let per_tick = context.settings.sub_steps as usize;
        let next = (
            PrefetchRange::new(context.slab, place as usize + 1, BATCH),
            PrefetchRange::new(rows, (row + 1) * per_tick, BATCH * per_tick),
            PrefetchRange::new(states, row + 1, BATCH),
        );
        self.batch.advance(context.settings.sub_step_s(), &|sub_step| {
            next.0.fetch(sub_step, per_tick);
            next.1.fetch(sub_step, per_tick);
            next.2.fetch(sub_step, per_tick);
        });
        self.batch
            .write_all(self.loaded.iter().map(|(_, row)| row * per_tick), rows);
        for (member, (place, row)) in self.loaded.drain(..).enumerate() {
            let sub_steps = &mut rows[row * per_tick..(row + 1) * per_tick];
            let (road_user, out) = (&mut context.slab[place as usize], &mut states[row]);
            let set = road_user.store(tick, context.settings, &self.batch, member, out, sub_steps);
            if let Some(set) = set {
                context.resynchronised.push(set);
            }
            if let Some(guidance) = road_user.guidance(out) {
                context.guidances.push(guidance);
            }
            context.tracking.add(out);
        }
    }
}

fn is_finite(state: &TrafficState) -> bool {
    [state.front_x_m, state.front_y_m, state.front_z_m]
        .iter()
        .all(|v| v.is_finite())
        && [state.yaw_rad, state.pitch_rad, state.speed_mps]
            .iter()
            .all(|v| v.is_finite())
}

fn cast<T: bytemuck::Pod>(bytes: &mut [u8], offset: usize) -> Result<&mut [T], BlockError> {
    let (actual, len) = (bytes.len(), bytes.len());
    bytemuck::try_cast_slice_mut(bytes).map_err(|_| BlockError {
        actual,
        offset,
        len,
        element: size_of::<T>(),
    })
}
