//! All sensors of all connected vehicles: one tick of the world in, one observation block out.

use ipc_schema::{
    block::{self, BlockError},
    config::Config,
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::{CLIPPED, GNSS_COLUMNS, ObservationLayout, SENSORS, TRUTH_COLUMNS, VALID},
    run::MapInfo,
    traffic::Kind,
    world::{ARRIVED, COLLIDED, HeroView, OFF_ROAD, TIME_LIMIT, VehicleState},
};
use sim_core::{
    displacement::DisplacementMap,
    geodesy::{GeodesyError, Projection},
};

use crate::{
    fields::{Normaliser, Readings},
    gnss, imu,
    noise::{Sensor, Stream},
    slots::Slots,
    speed_steering,
};

/// Ticks between two samples of each sensor.
#[derive(Debug, Clone, Copy)]
struct Periods {
    gnss: u32,
    imu: u32,
    speed_steering: u32,
}

impl Periods {
    fn new(config: &Config) -> Self {
        // Validated to be whole numbers of ticks.
        let ticks =
            |period_s: f64| ((period_s / config.run.tick_s).round() as i64).clamp(1, i64::from(u32::MAX)) as u32;
        Self {
            gnss: ticks(config.gnss.period_s),
            imu: ticks(config.imu.period_s),
            speed_steering: ticks(config.speed_steering.period_s),
        }
    }
}

/// Sums of the raw GNSS error over all fixes.
#[derive(Debug, Clone, Copy, Default)]
pub struct RawError {
    /// Sum of distances, metres.
    pub sum_m: f64,
    /// Number of vehicle-ticks.
    pub count: u64,
}

/// Sensors of a run, with what they remember from tick to tick.
#[derive(Debug)]
pub struct Sensing {
    config: Config,
    map: DisplacementMap,
    normaliser: Normaliser,
    periods: Periods,
    /// Length of a tick, nanoseconds.
    tick_ns: u64,
    slots: Slots,
    /// Who gets a slot: heroes if they drive, else connected vehicles.
    agents: Kind,
    /// Newest readings by slot.
    readings: Vec<Readings>,
    /// Row in the world, by slot, for the tick at work.
    row_of_slot: Vec<Option<u32>>,
    raw_error: RawError,
}

impl Sensing {
    /// Sensors as configured, on a map.
    ///
    /// # Errors
    /// The map's projection is not understood, or the map is outside its domain.
    pub fn new(config: &Config, map: &MapInfo) -> Result<Self, GeodesyError> {
        Ok(Self {
            map: DisplacementMap::new(&Projection::new(map)?, map.bounds_m)?,
            normaliser: Normaliser::new(&config.observation, map.bounds_m),
            periods: Periods::new(config),
            tick_ns: ((config.run.tick_s * 1e9).round() as u64).max(1),
            slots: Slots::default(),
            agents: if config.drives() { Kind::Hero } else { Kind::Cav },
            readings: Vec::new(),
            row_of_slot: Vec::new(),
            raw_error: RawError::default(),
            config: config.clone(),
        })
    }

    /// Fields in a row.
    #[must_use]
    pub fn width(&self) -> usize {
        self.normaliser.width()
    }

    /// IMU samples in a tick.
    #[must_use]
    pub fn imu_samples(&self) -> usize {
        self.config.imu_samples()
    }

    /// Error of the raw GNSS so far.
    #[must_use]
    pub fn raw_error(&self) -> RawError {
        self.raw_error
    }

    /// Gives every connected vehicle in `states` its slot; returns the number of slots, which is the observation's n.
    ///
    /// With `collision.ends_trajectory` a vehicle has no slot at the tick in which it collides, as if it had left: the slot it held
    /// says [`ipc_schema::observation::TERMINATED`], and from the next tick on it holds one anew, as a trajectory of its own.
    pub fn assign(&mut self, header: &MessageHeader, states: &[VehicleState]) -> usize {
        self.slots.begin(header.has(FIRST_OF_EPISODE));
        self.row_of_slot.fill(None);
        for (row, state) in (0_u32..).zip(states) {
            if self.is_sensed(state) {
                let slot = self.slots.occupy(state.vehicle);
                if is_cut(state) {
                    self.slots.cut(slot);
                }
                if slot >= self.row_of_slot.len() {
                    self.row_of_slot.resize(slot + 1, None);
                    self.readings.resize(slot + 1, Readings::default());
                }
                self.row_of_slot[slot] = Some(row);
            }
        }
        self.slots.end();
        self.slots.rows().len()
    }

    fn is_sensed(&self, state: &VehicleState) -> bool {
        // What a hero collides with ends its episode after the observation of that tick; SUMO lets it go.
        let collides = self.config.collision.ends_trajectory && state.flags & COLLIDED != 0;
        state.kind == self.agents as u32 && (self.agents == Kind::Hero || !collides)
    }

    /// Samples what is due and writes the observation of the tick that [`Sensing::assign`] was called for.
    ///
    /// # Errors
    /// The payload is too short.
    pub fn observe(
        &mut self,
        header: &MessageHeader,
        states: &[VehicleState],
        views: &[HeroView],
        payload: &mut [u8],
    ) -> Result<(), BlockError> {
        let (n, d) = (self.slots.rows().len(), self.width());
        let layout = ObservationLayout::new(n, d, self.imu_samples());
        let sections = layout.named().map(|(_, section)| section);
        let [
            observation,
            truth,
            gnss_m,
            _gnss_geodetic,
            _gnss_quality,
            _imu,
            _speed_steering,
            id_hash,
            vehicle,
            flags,
            _sensors,
            episode_step,
            age_s,
        ] = block::split_mut(payload, &sections)?;
        let observation: &mut [f32] = bytemuck::cast_slice_mut(observation);
        let truth: &mut [[f32; TRUTH_COLUMNS]] = bytemuck::cast_slice_mut(truth);
        let gnss_m: &mut [[f32; GNSS_COLUMNS]] = bytemuck::cast_slice_mut(gnss_m);
        let id_hash: &mut [u64] = bytemuck::cast_slice_mut(id_hash);
        let vehicle: &mut [u32] = bytemuck::cast_slice_mut(vehicle);
        let flags: &mut [u32] = bytemuck::cast_slice_mut(flags);
        let episode_step: &mut [u32] = bytemuck::cast_slice_mut(episode_step);
        let age_s: &mut [[f32; SENSORS]] = bytemuck::cast_slice_mut(age_s);
        for slot in 0..n {
            let lent = self.slots.rows()[slot];
            vehicle[slot] = lent.vehicle;
            flags[slot] = lent.ended;
            let Some(row) = self.row_of_slot[slot] else { continue };
            let state = &states[row as usize];
            self.sample(header, state, slot, lent.step);
            // Both are in ascending order of the vehicle.
            if let Ok(place) = views.binary_search_by_key(&state.vehicle, |view| view.vehicle) {
                self.readings[slot].route = views[place];
            }
            let readings = &self.readings[slot];
            let clipped = self
                .normaliser
                .fill(readings, &mut observation[slot * d..(slot + 1) * d]);
            flags[slot] |= VALID | if clipped { CLIPPED } else { 0 };
            truth[slot] = [
                state.x_m as f32,
                state.y_m as f32,
                state.yaw_rad as f32,
                state.velocity_body_mps[0],
            ];
            gnss_m[slot] = [readings.fix.x_m as f32, readings.fix.y_m as f32, 0.0];
            id_hash[slot] = state.id_hash;
            episode_step[slot] = lent.step;
            age_s[slot] = self.ages_s(lent.step);
            self.raw_error.sum_m += libm::hypot(readings.fix.x_m - state.x_m, readings.fix.y_m - state.y_m);
            self.raw_error.count += 1;
        }
        Ok(())
    }

    /// Takes the samples that are due at the vehicle's `step`; the first tick of a vehicle samples everything.
    fn sample(&mut self, header: &MessageHeader, state: &VehicleState, slot: usize, step: u32) {
        let seed = header.episode_seed;
        // Counted from the start of the episode: a vehicle that leaves and returns does not meet its old noise again.
        let index = (header.sim_time_ns / self.tick_ns) as u32;
        let readings = &mut self.readings[slot];
        if step.is_multiple_of(self.periods.gnss) {
            let stream = Stream {
                episode_seed: seed,
                id_hash: state.id_hash,
                sensor: Sensor::Gnss,
            };
            readings.fix = gnss::sample(&self.config.gnss, &self.map, state.x_m, state.y_m, stream, index);
        }
        if step.is_multiple_of(self.periods.imu) {
            readings.imu = imu::sample(&self.config.imu, state, seed, index);
        }
        if step.is_multiple_of(self.periods.speed_steering) {
            let ratio = self.config.vehicle.steering_ratio;
            readings.speed_steering = speed_steering::sample(&self.config.speed_steering, ratio, state, seed, index);
        }
    }

    /// Ages of the newest samples at the vehicle's `step`, seconds.
    fn ages_s(&self, step: u32) -> [f32; SENSORS] {
        [self.periods.gnss, self.periods.imu, self.periods.speed_steering, 1]
            .map(|period| (f64::from(step % period) * self.config.run.tick_s) as f32)
    }
}

/// True if the trajectory of a hero is cut at this tick, and does not end by itself.
fn is_cut(state: &VehicleState) -> bool {
    state.flags & TIME_LIMIT != 0 && state.flags & (COLLIDED | OFF_ROAD | ARRIVED) == 0
}
