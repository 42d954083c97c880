//! Samples all sensors of all connected road users: one tick of the world in, one observation block out.

use ipc_schema::{
    block::BlockError,
    config::{BlackoutPolicy, Config},
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::{AGE_COLUMNS, CLIPPED, ObservationLayout, ObservationSections, VALID, end_bits},
    run::MapInfo,
    sensor::SensorKind,
    traffic::Kind,
    world::{COLLIDED, HERO_ENDS, HeroView, RESYNCHRONISED, SubStep, TIME_LIMIT, VehicleState},
};
use serde::{Deserialize, Serialize};
use sim_core::geodesy::{GeodesyError, Projection};

use crate::{
    carrier::SensorCarrier,
    mounts::DueUnit,
    noise::normals::BATCH,
    noise::{DrawnNormals, NormalDraws},
    observation::fields::{Normaliser, SensorReadings},
    observation::history::{FrameHistory, TrajectoryFrame},
    observation::slots::{Slot, Slots},
    region::SensedRegion,
    sensors::gnss::SatelliteSky,
    suite::SensorSuite,
    switches::SensorSwitches,
    tick::{TickMotion, TickTime},
};

/// Sum of the raw GNSS error over all fixes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct RawGnssError {
    /// Sum of distances, metres.
    pub sum_m: f64,
    /// Number of vehicle-ticks with a receiver that delivers.
    pub count: u64,
}

/// What the sensors of a run have counted at the end of an episode, and what the next one needs to know of it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SensingState {
    observations: u64,
    raw_error: RawGnssError,
    /// Which slots hold a vehicle.
    occupied: Vec<bool>,
}

impl SensingState {
    /// Observations so far.
    #[must_use]
    pub fn observations(&self) -> u64 {
        self.observations
    }
}

/// One tick of the world, as a `world` message carries it.
#[derive(Debug, Clone, Copy, Default)]
pub struct WorldTick<'a> {
    /// All road users at the end of the tick.
    pub states: &'a [VehicleState],
    /// The same, and the trailing bodies of articulated vehicles behind them: what sensors meet.
    pub bodies: &'a [VehicleState],
    /// The sub-steps of each road user, one after the other; empty = each state stands for one sub-step.
    pub sub_steps: &'a [SubStep],
    /// Route and traffic ahead of each hero.
    pub views: &'a [HeroView],
}

/// An episode is in a stage of the curriculum, or on a map, that the configuration does not have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("an episode is in stage {stage} of the curriculum on map {map}, which the configuration does not have")]
pub struct UnknownSuiteError {
    /// Counted from 1; 0 is the base configuration.
    pub stage: usize,
    /// Place among the run's maps.
    pub map: usize,
}

/// The sensors of a stage of the curriculum on one of its maps.
struct PlacedSuite {
    /// Counted from 1; 0 is the base configuration.
    stage: usize,
    map: usize,
    suite: SensorSuite,
}

/// Sensors of a run, with their state from tick to tick.
pub struct Sensing {
    /// The base configuration's suite on the run's own map, then one for each map of each stage of the curriculum.
    suites: Vec<PlacedSuite>,
    /// Index of the suite in use.
    at: usize,
    /// Sky of each map; the sky of the map in use is held by its suite.
    skies: Vec<Option<Box<dyn SatelliteSky>>>,
    normaliser: Normaliser,
    history: FrameHistory,
    policy: BlackoutPolicy,
    lidar_range_m: f32,
    imu_samples: usize,
    /// Length of a tick, nanoseconds.
    tick_ns: u64,
    slots: Slots,
    /// Sensors that commands have switched off.
    switches: SensorSwitches,
    /// Kind of road user that gets a slot: heroes in the driving task, else connected vehicles.
    agents: Kind,
    /// Persons get a slot too.
    pedestrians: bool,
    collision_ends: bool,
    /// Part of the map in which road users are sensed.
    region: SensedRegion,
    /// State of each slot's sensors.
    carriers: Vec<SensorCarrier>,
    /// Row in the world of each slot at the present tick.
    row_of_slot: Vec<Option<u32>>,
    draws: NormalDraws,
    raw_error: RawGnssError,
    observations: u64,
}

impl Sensing {
    /// Sensors as configured, on a map.
    ///
    /// # Errors
    /// The map's projection is not understood, or the map is outside its domain.
    pub fn new(config: &Config, map: &MapInfo) -> Result<Self, GeodesyError> {
        Self::on_maps(config, map.bounds_m, std::slice::from_ref(map))
    }

    /// Sensors as configured, on the maps of a curriculum, all within `bounds_m` (x_min, y_min, x_max, y_max, metres).
    ///
    /// # Errors
    /// A map's projection is not understood, or the map is outside its domain.
    pub fn on_maps(config: &Config, bounds_m: [f64; 4], maps: &[MapInfo]) -> Result<Self, GeodesyError> {
        let tick_ns = ((config.run.tick_s * 1e9).round() as u64).max(1);
        let normaliser = Normaliser::new(config, bounds_m);
        let projections: Vec<Projection> = maps.iter().map(Projection::new).collect::<Result<_, _>>()?;
        let stages = stages_and_maps(config).into_iter().filter(|(_, map)| *map < maps.len());
        let suites = stages.map(|(stage, map)| {
            let suite = SensorSuite::new(&config.in_stage(stage), &projections[map], maps[map].bounds_m, tick_ns)?;
            Ok(PlacedSuite { stage, map, suite })
        });
        Ok(Self {
            suites: suites.collect::<Result<_, _>>()?,
            at: 0,
            skies: maps.iter().map(|_| None).collect(),
            history: FrameHistory::new(normaliser.width(), config.observation.history as usize),
            normaliser,
            policy: config.blackout.policy,
            lidar_range_m: config.lidar.range_m as f32,
            imu_samples: config.imu_samples(),
            tick_ns,
            slots: Slots::default(),
            switches: SensorSwitches::default(),
            agents: if config.drives() { Kind::Hero } else { Kind::Cav },
            pedestrians: config.gnss.pedestrians && !config.drives(),
            collision_ends: config.collision.ends_trajectory,
            region: SensedRegion::new(&config.region),
            carriers: Vec::new(),
            row_of_slot: Vec::new(),
            draws: NormalDraws::default(),
            raw_error: RawGnssError::default(),
            observations: 0,
        })
    }

    /// Sets the sky of the run's own map; without one the sky is open.
    pub fn set_sky(&mut self, sky: Box<dyn SatelliteSky>) {
        self.set_sky_of(0, sky);
    }

    /// Sets the sky of another map.
    pub fn set_sky_of(&mut self, map: usize, sky: Box<dyn SatelliteSky>) {
        match self.suites[self.at].map == map {
            true => self.suites[self.at].suite.set_sky(sky),
            false => self.skies[map] = Some(sky),
        }
    }

    /// Switches to the sensors of a stage of the curriculum, under the sky of a map.
    fn enter_stage(&mut self, stage: usize, map: usize) -> Result<(), UnknownSuiteError> {
        let mut suites = self.suites.iter();
        let found = suites.position(|placed| (placed.stage, placed.map) == (stage, map));
        let found = found.ok_or(UnknownSuiteError { stage, map })?;
        let PlacedSuite { map: before, suite, .. } = &mut self.suites[self.at];
        self.skies[*before] = suite.take_sky();
        self.at = found;
        let PlacedSuite { map, suite, .. } = &mut self.suites[self.at];
        if let Some(sky) = self.skies[*map].take() {
            suite.set_sky(sky);
        }
        Ok(())
    }

    fn suite(&self) -> &SensorSuite {
        &self.suites[self.at].suite
    }

    /// Sensors that commands switch. Fill it before [`Sensing::assign`] is called for the tick of a command.
    pub fn switches_mut(&mut self) -> &mut SensorSwitches {
        &mut self.switches
    }

    /// Numbers in a row: fields times ticks of history.
    #[must_use]
    pub fn width(&self) -> usize {
        self.history.width()
    }

    /// IMU samples in a tick.
    #[must_use]
    pub fn imu_samples(&self) -> usize {
        self.imu_samples
    }

    /// Sum of the raw GNSS error so far.
    #[must_use]
    pub fn raw_error(&self) -> RawGnssError {
        self.raw_error
    }

    /// Valid rows so far.
    #[must_use]
    pub fn observations(&self) -> u64 {
        self.observations
    }

    /// The state at the end of an episode.
    #[must_use]
    pub fn state(&self) -> SensingState {
        SensingState {
            observations: self.observations,
            raw_error: self.raw_error,
            occupied: self.slots.occupied(),
        }
    }

    /// Continues from the end of an episode. The next tick must begin another one.
    pub fn restore(&mut self, state: &SensingState) {
        (self.observations, self.raw_error) = (state.observations, state.raw_error);
        self.slots = Slots::after_episode(&state.occupied);
        self.row_of_slot = vec![None; state.occupied.len()];
    }

    /// Gives every connected road user in `states` and in the region its slot. Returns the number of slots, the observation's n.
    ///
    /// A vehicle that is set onto SUMO's position keeps its slot and begins a new trajectory there.
    ///
    /// With `collision.ends_trajectory` a vehicle has no slot at the tick in which it collides, as if it had left: its slot is marked
    /// [`ipc_schema::observation::TERMINATED`], and from the next tick on the vehicle begins a new trajectory.
    ///
    /// # Errors
    /// An episode begins in a stage or on a map that the configuration does not have.
    pub fn assign(&mut self, header: &MessageHeader, states: &[VehicleState]) -> Result<usize, UnknownSuiteError> {
        self.slots.begin(header.has(FIRST_OF_EPISODE));
        if header.has(FIRST_OF_EPISODE) {
            self.enter_stage(header.stage.into(), header.map.into())?;
            self.suites[self.at].suite.begin_episode(header.episode_seed);
            self.switches.begin_episode();
        }
        self.switches.advance(header.tick);
        self.row_of_slot.fill(None);
        let now = self.now(header);
        for (row, state) in (0_u32..).zip(states) {
            if !self.is_sensed(state) {
                continue;
            }
            if !self.region.contains(state.x_m, state.y_m) {
                // It continues outside the sensed region: its trajectory is cut here, and a new one begins when it returns.
                self.slots.cut_vehicle(state.vehicle);
                continue;
            }
            let slot = self.slots.occupy(state.vehicle);
            if is_cut(state) {
                self.slots.cut(slot);
            }
            if self.agents == Kind::Hero {
                self.slots.note_end(slot, end_bits(state.flags & HERO_ENDS));
            }
            if state.flags & RESYNCHRONISED != 0 {
                self.slots.restart(slot);
            }
            if slot >= self.row_of_slot.len() {
                self.row_of_slot.resize(slot + 1, None);
            }
            self.row_of_slot[slot] = Some(row);
            self.update_carrier(slot, state, &now);
        }
        self.slots.end();
        Ok(self.slots.rows().len())
    }

    /// Advances the blackouts of the carrier in `slot` to this tick; a new trajectory begins with a new carrier.
    fn update_carrier(&mut self, slot: usize, state: &VehicleState, now: &TickTime) {
        if self.slots.rows()[slot].step == 0 {
            let carrier = self.suite().begin(state, slot, now);
            match self.carriers.get_mut(slot) {
                Some(place) => *place = carrier,
                // New slots are taken in ascending order: this is the next one.
                None => self.carriers.push(carrier),
            }
        } else {
            self.suites[self.at]
                .suite
                .advance(&mut self.carriers[slot], state.id_hash, now);
        }
        if self.switches.in_use() {
            self.carriers[slot].off = self.switches.off(state.id_hash);
        }
    }

    fn is_sensed(&self, state: &VehicleState) -> bool {
        // A hero's collision ends its episode after the observation of that tick; SUMO ignores the collision.
        let collides = self.collision_ends && state.flags & COLLIDED != 0;
        let is_agent = state.kind == self.agents as u32 || (self.pedestrians && state.kind == Kind::Person as u32);
        is_agent && (self.agents == Kind::Hero || !collides)
    }

    /// Time of the tick of `header`, as noise and blackouts use it.
    #[must_use]
    pub fn now(&self, header: &MessageHeader) -> TickTime {
        TickTime {
            episode_seed: header.episode_seed,
            tick: (header.sim_time_ns / self.tick_ns) as u32,
            time_ns: header.sim_time_ns,
        }
    }

    /// The sensors of this kind that sample at the tick of the last [`Sensing::assign`]: those of sections and of suites, slot by slot.
    pub fn units_due(&self, sensor: SensorKind, due: &mut Vec<DueUnit>) {
        due.clear();
        let suite = self.suite();
        for (slot, (row, carrier)) in self.row_of_slot.iter().zip(&self.carriers).enumerate() {
            let Some(row) = *row else { continue };
            if !sensor.is_in(carrier.awake()) {
                continue;
            }
            let (step, row, has_own) = (self.slots.rows()[slot].step, row as usize, sensor.is_in(carrier.own));
            if has_own && suite.is_due(sensor, step) {
                due.push(DueUnit::own(slot, row));
            }
            let mounted = suite.mounted().due(carrier.suite, sensor, step);
            due.extend(mounted.map(|(number, is_first)| DueUnit {
                slot: Some(slot),
                row,
                sensor: number,
                is_first: is_first && !has_own,
            }));
        }
    }

    /// Slot and row in the world of each road user whose `sensor`, that of a section, samples at the tick of the last
    /// [`Sensing::assign`].
    pub fn carriers_due(&self, sensor: SensorKind) -> impl Iterator<Item = (usize, usize)> {
        let slots = self.row_of_slot.iter().zip(&self.carriers).enumerate();
        slots.filter_map(move |(slot, (row, carrier))| match row {
            Some(row) if sensor.is_in(carrier.awake() & carrier.own) => {
                let is_due = self.suite().is_due(sensor, self.slots.rows()[slot].step);
                is_due.then_some((slot, *row as usize))
            }
            _ => None,
        })
    }

    /// The slots of the last [`Sensing::assign`].
    #[must_use]
    pub fn slots(&self) -> &[Slot] {
        self.slots.rows()
    }

    /// True if `sensor` of the carrier in `slot` delivered at the last [`Sensing::observe`].
    #[must_use]
    pub fn delivers(&self, slot: usize, sensor: SensorKind) -> bool {
        let carrier = self.carriers.get(slot);
        carrier.is_some_and(|carrier| sensor.is_in(carrier.readings.delivering))
    }

    /// The newest samples of the carrier in `slot`, for sensors of the surroundings. Call it between [`Sensing::assign`] and
    /// [`Sensing::observe`].
    pub fn readings_mut(&mut self, slot: usize) -> Option<&mut SensorReadings> {
        self.carriers.get_mut(slot).map(|carrier| &mut carrier.readings)
    }

    /// Sets the nearest points of four objects that the LIDAR in `slot` sees, forward and left of the rear axle (metres). A point that
    /// is not finite stands for no object. Call it between [`Sensing::assign`] and [`Sensing::observe`]; the points hold until the next
    /// call.
    pub fn set_objects(&mut self, slot: usize, objects_m: [[f32; 2]; 4]) {
        if let Some(carrier) = self.carriers.get_mut(slot) {
            carrier.readings.objects_m = objects_m.map(|[forward_m, left_m]| {
                if forward_m.is_finite() && left_m.is_finite() {
                    [forward_m, left_m]
                } else {
                    [self.lidar_range_m; 2]
                }
            });
        }
    }

    /// Samples the sensors that are due and writes the observation of the last [`Sensing::assign`] into a payload of zeros.
    ///
    /// A row is [`VALID`] once every sensor of its road user has delivered; until then its observation and raw samples stay 0. A
    /// pedestrian has no speed and steering sensor: its bit is never set, speed and steering are 0, aged 0 s.
    ///
    /// # Errors
    /// The payload is too short.
    pub fn observe(&mut self, header: &MessageHeader, world: &WorldTick, payload: &mut [u8]) -> Result<(), BlockError> {
        let n = self.slots.rows().len();
        let layout = ObservationLayout::new(n, self.width(), self.imu_samples);
        let mut sections = ObservationSections::split(payload, &layout)?;
        let now = self.now(header);
        let mut draws = std::mem::take(&mut self.draws);
        draws.clear();
        self.suite().plan(&mut draws, &now);
        let sub_steps = world.sub_steps.len().checked_div(world.states.len()).unwrap_or(0);
        for first in (0..n).step_by(BATCH) {
            let ids = std::array::from_fn(|member| self.id_hash(first + member, world));
            draws.draw(now.episode_seed, &ids);
            for slot in first..n.min(first + BATCH) {
                self.sense(slot, (world, sub_steps), &now, draws.of(slot - first), &mut sections);
            }
        }
        self.draws = draws;
        Ok(())
    }

    /// Hash of the id of the road user in a slot; 0 for an empty slot, which draws numbers that are not used.
    fn id_hash(&self, slot: usize, world: &WorldTick) -> u64 {
        match self.row_of_slot.get(slot) {
            Some(Some(row)) => world.states[*row as usize].id_hash,
            _ => 0,
        }
    }

    /// Samples and writes one slot, whose road user has `per` sub-steps in the world, with the numbers drawn for it.
    #[inline]
    fn sense(
        &mut self,
        slot: usize,
        (world, per): (&WorldTick, usize),
        now: &TickTime,
        drawn: DrawnNormals,
        out: &mut ObservationSections,
    ) {
        let lent = self.slots.rows()[slot];
        out.vehicle[slot] = lent.vehicle;
        out.flags[slot] = lent.ended;
        let Some(row) = self.row_of_slot[slot] else {
            return;
        };
        let row = row as usize;
        let state = &world.states[row];
        let alone;
        let rows = if per == 0 {
            alone = [sub_step(state)];
            &alone
        } else {
            &world.sub_steps[row * per..(row + 1) * per]
        };
        let motion = TickMotion {
            state,
            rows,
            step: lent.step,
        };
        let carrier = &mut self.carriers[slot];
        let samples = &mut out.imu[slot * self.imu_samples..(slot + 1) * self.imu_samples];
        self.suites[self.at].suite.sample(carrier, &motion, now, drawn, samples);
        // `views` are in ascending order of the vehicle.
        if let Ok(place) = world.views.binary_search_by_key(&state.vehicle, |view| view.vehicle) {
            carrier.readings.set_route(&world.views[place]);
        }
        self.write(slot, state, lent.step, out);
    }

    /// Writes the readings of a slot's sensors.
    #[inline]
    fn write(&mut self, slot: usize, state: &VehicleState, step: u32, out: &mut ObservationSections) {
        let carrier = &mut self.carriers[slot];
        let readings = &carrier.readings;
        out.truth[slot] = [
            state.x_m as f32,
            state.y_m as f32,
            state.yaw_rad as f32,
            state.velocity_body_mps[0],
        ];
        out.id_hash[slot] = state.id_hash;
        out.episode_step[slot] = step;
        out.sensors[slot] = readings.delivering;
        out.age_s[slot].copy_from_slice(&readings.ages_s[..AGE_COLUMNS]);
        write_raw(slot, carrier, out);
        if carrier.present & !carrier.known != 0 {
            return;
        }
        let dark = carrier.dark();
        let blank = if self.policy == BlackoutPolicy::Nan { dark } else { 0 };
        let (d, width) = (self.normaliser.width(), self.history.width());
        let row = &mut out.observation[slot * width..(slot + 1) * width];
        let clipped = self.normaliser.fill(readings, blank, &mut row[width - d..]);
        let first = if carrier.is_seen {
            TrajectoryFrame::Later
        } else {
            TrajectoryFrame::First
        };
        carrier.is_seen = true;
        self.history.stack(slot, first, row);
        out.flags[slot] |= if clipped { CLIPPED } else { 0 };
        if self.policy != BlackoutPolicy::Drop || dark & self.normaliser.needs() == 0 {
            out.flags[slot] |= VALID;
            self.observations += 1;
        }
        if SensorKind::Gnss.is_in(readings.delivering) {
            let fix = &readings.fix;
            let (x_m, y_m) = (fix.x_m - state.x_m, fix.y_m - state.y_m);
            self.raw_error.sum_m += (x_m * x_m + y_m * y_m).sqrt();
            self.raw_error.count += 1;
        }
    }
}

/// Stage and map of each suite: the base configuration on the run's own map, then the maps of each stage.
fn stages_and_maps(config: &Config) -> Vec<(usize, usize)> {
    let curriculum = &config.curriculum;
    let mut stages = vec![(0, 0)];
    for (number, stage) in (1..).zip(&curriculum.stages) {
        let mut maps = curriculum.maps_of(stage);
        maps.sort_unstable();
        maps.dedup();
        stages.extend(maps.into_iter().map(|map| (number, map)));
    }
    stages
}

/// Writes the newest raw samples of a slot. In a blackout these are the last ones: an estimator that reads them checks age and bit.
#[inline]
fn write_raw(slot: usize, carrier: &SensorCarrier, out: &mut ObservationSections) {
    let readings = &carrier.readings;
    let fix = &readings.fix;
    out.gnss_m[slot] = [fix.x_m as f32, fix.y_m as f32, fix.z_m as f32];
    out.gnss_geodetic[slot] = [fix.latitude_deg, fix.longitude_deg, fix.altitude_m];
    out.gnss_quality[slot] = [fix.accuracy_m as f32, fix.satellites as f32];
    let sample = &readings.speed_steering;
    out.speed_steering[slot] = [sample.speed_mps as f32, sample.steering_rad as f32];
}

/// The one sub-step that a state stands for.
fn sub_step(state: &VehicleState) -> SubStep {
    SubStep {
        roll_rad: state.roll_rad,
        pitch_rad: state.pitch_rad,
        speed_mps: state.velocity_body_mps[0],
        lateral_speed_mps: state.velocity_body_mps[1],
        accel_body_mps2: state.accel_body_mps2,
        angular_rate_body_radps: state.angular_rate_body_radps,
        road_wheel_angle_rad: state.road_wheel_angle_rad,
        ..SubStep::default()
    }
}

/// True if a time limit cuts a hero's trajectory at this tick, rather than an end of its own.
fn is_cut(state: &VehicleState) -> bool {
    state.flags & HERO_ENDS == TIME_LIMIT
}
