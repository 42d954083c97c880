//! All sensors of all connected road users: one tick of the world in, one observation block out.

use ipc_schema::{
    block::BlockError,
    config::{BlackoutPolicy, Config},
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::{CLIPPED, ObservationLayout, VALID},
    run::MapInfo,
    sensor::SensorKind,
    traffic::Kind,
    world::{ARRIVED, COLLIDED, HeroView, OFF_ROAD, SubStep, TIME_LIMIT, VehicleState},
};
use sim_core::geodesy::{GeodesyError, Projection};

use crate::{
    carrier::Carrier,
    fields::Normaliser,
    gnss::Sky,
    history::{First, History},
    noise::{Drawn, Draws},
    normals::LANES,
    region::Region,
    sections::Sections,
    slots::Slots,
    suite::{Motion, Now, Suite},
    switches::Switches,
};

/// Sums of the raw GNSS error over all fixes.
#[derive(Debug, Clone, Copy, Default)]
pub struct RawError {
    /// Sum of distances, metres.
    pub sum_m: f64,
    /// Number of vehicle-ticks with a receiver that delivers.
    pub count: u64,
}

/// One tick of the world, as `world` carries it.
#[derive(Debug, Clone, Copy, Default)]
pub struct World<'a> {
    /// Everybody at the end of the tick.
    pub states: &'a [VehicleState],
    /// As many sub-steps for each of them, one behind the other; none = what the states say.
    pub sub_steps: &'a [SubStep],
    /// What heroes see.
    pub views: &'a [HeroView],
}

/// The sensors of a stage of the curriculum on one of its maps.
struct Placed {
    /// Counted from 1; 0 is the base configuration.
    stage: usize,
    map: usize,
    suite: Suite,
}

/// Sensors of a run, with what they remember from tick to tick.
pub struct Sensing {
    /// The base configuration's on the run's own map, then one for each map of each stage of the curriculum.
    suites: Vec<Placed>,
    /// Which of them is at work.
    at: usize,
    /// By map; that of the map at hand is with its suite.
    skies: Vec<Option<Box<dyn Sky>>>,
    normaliser: Normaliser,
    history: History,
    policy: BlackoutPolicy,
    lidar_range_m: f32,
    imu_samples: usize,
    /// Length of a tick, nanoseconds.
    tick_ns: u64,
    slots: Slots,
    /// What commands have switched off.
    switches: Switches,
    /// Who gets a slot: heroes if they drive, else connected vehicles.
    agents: Kind,
    /// Persons get one too.
    pedestrians: bool,
    collision_ends: bool,
    /// Where they are sensed.
    region: Region,
    /// What each slot's sensors remember.
    carriers: Vec<Carrier>,
    /// Row in the world, by slot, for the tick at work.
    row_of_slot: Vec<Option<u32>>,
    draws: Draws,
    raw_error: RawError,
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

    /// Sensors as configured, on the maps of a curriculum, which all lie in `bounds_m` (x_min, y_min, x_max, y_max, metres).
    ///
    /// # Errors
    /// A map's projection is not understood, or the map is outside its domain.
    pub fn on_maps(config: &Config, bounds_m: [f64; 4], maps: &[MapInfo]) -> Result<Self, GeodesyError> {
        let tick_ns = ((config.run.tick_s * 1e9).round() as u64).max(1);
        let normaliser = Normaliser::new(config, bounds_m);
        let projections: Vec<Projection> = maps.iter().map(Projection::new).collect::<Result<_, _>>()?;
        let places = places(config).into_iter().filter(|(_, map)| *map < maps.len());
        let suites = places.map(|(stage, map)| {
            let suite = Suite::new(&config.in_stage(stage), &projections[map], maps[map].bounds_m, tick_ns)?;
            Ok(Placed { stage, map, suite })
        });
        Ok(Self {
            suites: suites.collect::<Result<_, _>>()?,
            at: 0,
            skies: maps.iter().map(|_| None).collect(),
            history: History::new(normaliser.width(), config.observation.history as usize),
            normaliser,
            policy: config.blackout.policy,
            lidar_range_m: config.lidar.range_m as f32,
            imu_samples: config.imu_samples(),
            tick_ns,
            slots: Slots::default(),
            switches: Switches::default(),
            agents: if config.drives() { Kind::Hero } else { Kind::Cav },
            pedestrians: config.gnss.pedestrians && !config.drives(),
            collision_ends: config.collision.ends_trajectory,
            region: Region::new(&config.region),
            carriers: Vec::new(),
            row_of_slot: Vec::new(),
            draws: Draws::default(),
            raw_error: RawError::default(),
            observations: 0,
        })
    }

    /// Puts satellites, and what hides them, into the sky of the run's own map; without, it is open.
    pub fn set_sky(&mut self, sky: Box<dyn Sky>) {
        self.set_sky_of(0, sky);
    }

    /// The same of another map.
    pub fn set_sky_of(&mut self, map: usize, sky: Box<dyn Sky>) {
        match self.suites[self.at].map == map {
            true => self.suites[self.at].suite.set_sky(sky),
            false => self.skies[map] = Some(sky),
        }
    }

    /// Uses the sensors of a stage of the curriculum from now on, under the sky of a map.
    fn enter(&mut self, stage: usize, map: usize) {
        let Placed { map: before, suite, .. } = &mut self.suites[self.at];
        self.skies[*before] = suite.take_sky();
        let found = self
            .suites
            .iter()
            .position(|placed| (placed.stage, placed.map) == (stage, map));
        self.at = found.unwrap_or(0);
        let Placed { map, suite, .. } = &mut self.suites[self.at];
        if let Some(sky) = self.skies[*map].take() {
            suite.set_sky(sky);
        }
    }

    fn suite(&self) -> &Suite {
        &self.suites[self.at].suite
    }

    /// Sensors that commands switch, to be filled before the tick at which they hold is assigned.
    pub fn switches_mut(&mut self) -> &mut Switches {
        &mut self.switches
    }

    /// Numbers in a row: fields times ticks.
    #[must_use]
    pub fn width(&self) -> usize {
        self.history.width()
    }

    /// IMU samples in a tick.
    #[must_use]
    pub fn imu_samples(&self) -> usize {
        self.imu_samples
    }

    /// Error of the raw GNSS so far.
    #[must_use]
    pub fn raw_error(&self) -> RawError {
        self.raw_error
    }

    /// Valid rows so far.
    #[must_use]
    pub fn observations(&self) -> u64 {
        self.observations
    }

    /// Gives every connected road user in `states` and in the region its slot; returns the number of slots, which is the observation's n.
    ///
    /// With `collision.ends_trajectory` a vehicle has no slot at the tick in which it collides, as if it had left: the slot it held
    /// says [`ipc_schema::observation::TERMINATED`], and from the next tick on it holds one anew, as a trajectory of its own.
    pub fn assign(&mut self, header: &MessageHeader, states: &[VehicleState]) -> usize {
        self.slots.begin(header.has(FIRST_OF_EPISODE));
        if header.has(FIRST_OF_EPISODE) {
            self.enter(header.stage(), header.map());
            self.suites[self.at].suite.begin_episode(header.episode_seed);
            self.switches.begin_episode();
        }
        self.switches.advance(header.tick);
        self.row_of_slot.fill(None);
        let now = self.now(header);
        for (row, state) in (0_u32..).zip(states) {
            if self.is_sensed(state) && !self.region.contains(state.x_m, state.y_m) {
                // It drives on where nobody looks: its trajectory is cut here, and another begins if it comes back.
                self.slots.cut_vehicle(state.vehicle);
            } else if self.is_sensed(state) {
                let slot = self.slots.occupy(state.vehicle);
                if is_cut(state) {
                    self.slots.cut(slot);
                }
                if slot >= self.row_of_slot.len() {
                    self.row_of_slot.resize(slot + 1, None);
                }
                self.row_of_slot[slot] = Some(row);
                self.carry(slot, state, &now);
            }
        }
        self.slots.end();
        self.slots.rows().len()
    }

    /// Takes the carrier in `slot` to this tick, a new one for a new trajectory.
    fn carry(&mut self, slot: usize, state: &VehicleState, now: &Now) {
        if self.slots.rows()[slot].step == 0 {
            let carrier = self.suite().begin(state, slot, now);
            match self.carriers.get_mut(slot) {
                Some(place) => *place = carrier,
                // Slots are lent in ascending order: this is the next one.
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
        // What a hero collides with ends its episode after the observation of that tick; SUMO lets it go.
        let collides = self.collision_ends && state.flags & COLLIDED != 0;
        let is_agent = state.kind == self.agents as u32 || (self.pedestrians && state.kind == Kind::Person as u32);
        is_agent && (self.agents == Kind::Hero || !collides)
    }

    fn now(&self, header: &MessageHeader) -> Now {
        Now {
            episode_seed: header.episode_seed,
            tick: (header.sim_time_ns / self.tick_ns) as u32,
            time_ns: header.sim_time_ns,
        }
    }

    /// Slot and row in the world of everybody whose LIDAR scans at the tick that [`Sensing::assign`] was called for.
    pub fn lidars(&self) -> impl Iterator<Item = (usize, usize)> {
        let slots = self.row_of_slot.iter().zip(&self.carriers).enumerate();
        slots.filter_map(|(slot, (row, carrier))| match row {
            Some(row) if SensorKind::Lidar.is_in(carrier.awake()) => Some((slot, *row as usize)),
            _ => None,
        })
    }

    /// What the LIDAR in `slot` sees nearest: points of four objects, forward and left of the rear axle (metres). What is not finite
    /// stands for no object. To be called between [`Sensing::assign`] and [`Sensing::observe`]; held until it is called again.
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

    /// Samples what is due and writes the observation of the tick that [`Sensing::assign`] was called for, into a payload of zeros.
    ///
    /// A row is [`VALID`] once every sensor of its road user has delivered; until then its observation and raw samples stay 0. A
    /// pedestrian has no speed and steering sensor: its bit is never set, speed and steering are the value 0, aged 0 s.
    ///
    /// # Errors
    /// The payload is too short.
    pub fn observe(&mut self, header: &MessageHeader, world: &World, payload: &mut [u8]) -> Result<(), BlockError> {
        let n = self.slots.rows().len();
        let layout = ObservationLayout::new(n, self.width(), self.imu_samples);
        let mut sections = Sections::split(payload, &layout)?;
        let now = self.now(header);
        let mut draws = std::mem::take(&mut self.draws);
        draws.clear();
        self.suite().plan(&mut draws, &now);
        for first in (0..n).step_by(LANES) {
            let ids = std::array::from_fn(|lane| self.id_hash(first + lane, world));
            draws.draw(now.episode_seed, &ids);
            for slot in first..n.min(first + LANES) {
                self.sense(slot, world, &now, draws.of(slot - first), &mut sections);
            }
        }
        self.draws = draws;
        Ok(())
    }

    /// Hash of the id of the road user in a slot; anything for an empty one.
    fn id_hash(&self, slot: usize, world: &World) -> u64 {
        match self.row_of_slot.get(slot) {
            Some(Some(row)) => world.states[*row as usize].id_hash,
            _ => 0,
        }
    }

    /// Samples and writes one slot with the numbers drawn for it.
    fn sense(&mut self, slot: usize, world: &World, now: &Now, drawn: Drawn, out: &mut Sections) {
        let lent = self.slots.rows()[slot];
        out.vehicle[slot] = lent.vehicle;
        out.flags[slot] = lent.ended;
        let Some(row) = self.row_of_slot[slot] else {
            return;
        };
        let row = row as usize;
        let state = &world.states[row];
        let alone;
        let per = world.sub_steps.len() / world.states.len();
        let rows = if per == 0 {
            alone = [sub_step(state)];
            &alone
        } else {
            &world.sub_steps[row * per..(row + 1) * per]
        };
        let motion = Motion {
            state,
            rows,
            step: lent.step,
        };
        let carrier = &mut self.carriers[slot];
        let samples = &mut out.imu[slot * self.imu_samples..(slot + 1) * self.imu_samples];
        self.suites[self.at].suite.sample(carrier, &motion, now, drawn, samples);
        // Both are in ascending order of the vehicle.
        if let Ok(place) = world.views.binary_search_by_key(&state.vehicle, |view| view.vehicle) {
            carrier.readings.route = world.views[place];
        }
        self.write(slot, state, lent.step, out);
    }

    /// Writes what a slot's sensors have delivered.
    #[inline]
    fn write(&mut self, slot: usize, state: &VehicleState, step: u32, out: &mut Sections) {
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
        out.age_s[slot] = readings.ages_s;
        write_raw(slot, carrier, out);
        if carrier.present & !carrier.known != 0 {
            return;
        }
        let dark = carrier.dark();
        let blank = if self.policy == BlackoutPolicy::Nan { dark } else { 0 };
        let (d, width) = (self.normaliser.width(), self.history.width());
        let row = &mut out.observation[slot * width..(slot + 1) * width];
        let clipped = self.normaliser.fill(readings, blank, &mut row[width - d..]);
        let first = if carrier.is_seen { First::No } else { First::Yes };
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

/// Stage and map of every suite that is needed: the base configuration on the run's own map, then the maps of each stage.
fn places(config: &Config) -> Vec<(usize, usize)> {
    let curriculum = &config.curriculum;
    let mut places = vec![(0, 0)];
    for (number, stage) in (1..).zip(&curriculum.stages) {
        let mut maps = curriculum.maps_of(stage);
        maps.sort_unstable();
        maps.dedup();
        places.extend(maps.into_iter().map(|map| (number, map)));
    }
    places
}

/// Writes the newest raw samples of a slot. While a sensor is dark they are its last: estimators that read them look at age and bit.
#[inline]
fn write_raw(slot: usize, carrier: &Carrier, out: &mut Sections) {
    let readings = &carrier.readings;
    let fix = &readings.fix;
    out.gnss_m[slot] = [fix.x_m as f32, fix.y_m as f32, fix.z_m as f32];
    out.gnss_geodetic[slot] = [fix.latitude_deg, fix.longitude_deg, fix.altitude_m];
    out.gnss_quality[slot] = [fix.accuracy_m as f32, fix.satellites as f32];
    let sample = &readings.speed_steering;
    out.speed_steering[slot] = [sample.speed_mps as f32, sample.steering_rad as f32];
}

/// The sub-step that a state alone tells of.
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

/// True if the trajectory of a hero is cut at this tick, and does not end by itself.
fn is_cut(state: &VehicleState) -> bool {
    state.flags & TIME_LIMIT != 0 && state.flags & (COLLIDED | OFF_ROAD | ARRIVED) == 0
}
