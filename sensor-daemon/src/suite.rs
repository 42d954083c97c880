//! The suite of point sensors that every connected road user carries: it decides which sensors sample at a tick, and samples them.

use ipc_schema::{
    config::Config,
    sensor::{SENSORS, SensorCarriers, SensorInput, SensorKind},
    traffic::Kind,
    world::VehicleState,
};
use sim_core::geodesy::{GeodesyError, Projection};

use crate::{
    blackout::BlackoutSchedule,
    carrier::SensorCarrier,
    mounts::MountedSuites,
    noise::{DrawnNormals, NormalDraws, normals::NormalBlock},
    observation::fields::SensorReadings,
    sensors::{
        gnss::{GnssReceiver, SatelliteSky, SkyView},
        imu::{ImuModel, ImuMotion, ImuSample},
        speed_steering::SpeedSteeringModel,
    },
    tick::{TickMotion, TickTime},
    wide::VectorPath,
};

/// Sensors as configured.
pub struct SensorSuite {
    gnss: GnssReceiver,
    sky: Option<Box<dyn SatelliteSky>>,
    imu: ImuModel,
    speed_steering: SpeedSteeringModel,
    /// Those of the sensors that have blackouts.
    schedules: Vec<(SensorKind, BlackoutSchedule)>,
    /// Ticks between two samples of each sensor.
    periods: [u32; SensorKind::COUNT],
    /// Number of vehicles that carry each sensor of a section: those in the first slots.
    vehicles: [u32; SensorKind::COUNT],
    /// Suites of further sensors.
    mounted: MountedSuites,
    /// Bits of the sensors whose samples [`crate::surroundings`] takes.
    of_surroundings: u32,
    /// Readings of a carrier whose sensors have not sampled.
    unsensed: SensorReadings,
    tick_s: f64,
    sub_step_s: f64,
    path: VectorPath,
}

impl SensorSuite {
    /// Sensors on a map with these bounds (x_min, y_min, x_max, y_max, metres).
    ///
    /// # Errors
    /// The map is outside the domain of its projection.
    pub fn new(
        config: &Config,
        projection: &Projection,
        bounds_m: [f64; 4],
        tick_ns: u64,
    ) -> Result<Self, GeodesyError> {
        Ok(Self {
            gnss: GnssReceiver::new(&config.gnss, projection, bounds_m)?,
            sky: None,
            imu: ImuModel::new(&config.imu, config.imu_samples(), config.run.tick_s),
            speed_steering: SpeedSteeringModel::new(&config.speed_steering, config.vehicle.steering_ratio),
            schedules: schedules(config, tick_ns),
            periods: SENSORS.map(|spec| config.period_ticks(spec.kind)),
            vehicles: SENSORS.map(|spec| (spec.vehicles)(config)),
            mounted: MountedSuites::new(config),
            of_surroundings: SENSORS
                .iter()
                .filter(|spec| spec.input == SensorInput::Surroundings)
                .fold(0, |bits, spec| bits | spec.kind.bit()),
            unsensed: SensorReadings::unsensed(config),
            tick_s: config.run.tick_s,
            sub_step_s: config.run.tick_s / f64::from(config.run.sub_steps),
            path: VectorPath::widest(),
        })
    }

    /// Sets the sky of the GNSS receivers.
    pub fn set_sky(&mut self, sky: Box<dyn SatelliteSky>) {
        self.sky = Some(sky);
    }

    /// Takes the sky out again.
    pub fn take_sky(&mut self) -> Option<Box<dyn SatelliteSky>> {
        self.sky.take()
    }

    /// Begins an episode with this seed.
    pub fn begin_episode(&mut self, episode_seed: u64) {
        if let Some(sky) = &mut self.sky {
            sky.begin_episode(episode_seed);
        }
    }

    /// A new carrier in `slot` for a road user that begins a trajectory.
    #[must_use]
    pub fn begin(&self, state: &VehicleState, slot: usize, now: &TickTime) -> SensorCarrier {
        let is_person = state.kind == Kind::Person as u32;
        let carries = |kind: SensorKind| match kind.spec().carriers {
            SensorCarriers::Vehicles if is_person => false,
            _ => slot < self.vehicles[kind.index()] as usize,
        };
        let present = SensorKind::ALL.into_iter().filter(|kind| carries(*kind));
        let present = present.fold(0, |bits, kind| bits | kind.bit());
        let mut carrier = SensorCarrier::new(
            present,
            self.gnss.begin(is_person, now.episode_seed, state.id_hash),
            self.imu.begin(now.episode_seed, state.id_hash),
            self.speed_steering.begin(now.episode_seed, state.id_hash),
            self.unsensed.clone(),
        );
        if !is_person {
            carrier.suite = self.mounted.suite_of(state.flags, slot);
            carrier.present |= self.mounted.kinds(carrier.suite);
            carrier.arms = self.mounted.arms(carrier.suite);
        }
        // No road user appears in a blackout.
        for (kind, schedule) in self.schedules_of(carrier.present) {
            carrier.phases[kind.index()] = schedule.begin(now.episode_seed, state.id_hash, now.tick, now.time_ns);
        }
        carrier.phases_until_ns = self.next_end_ns(&carrier);
        carrier
    }

    /// Those of the sensors `present` that have blackouts.
    fn schedules_of(&self, present: u32) -> impl Iterator<Item = &(SensorKind, BlackoutSchedule)> {
        self.schedules.iter().filter(move |(kind, _)| kind.is_in(present))
    }

    /// Time at which the first gap or blackout of a carrier ends, nanoseconds; never without any.
    fn next_end_ns(&self, carrier: &SensorCarrier) -> u64 {
        let ends_ns = self
            .schedules_of(carrier.present)
            .map(|(kind, _)| carrier.phases[kind.index()].until_ns());
        ends_ns.min().unwrap_or(u64::MAX)
    }

    /// Advances the blackouts of a carrier's sensors to this tick.
    #[inline]
    pub fn advance(&self, carrier: &mut SensorCarrier, id_hash: u64, now: &TickTime) {
        if now.time_ns >= carrier.phases_until_ns {
            self.pass_ends(carrier, id_hash, now);
        }
    }

    /// Passes over the gaps and blackouts of a carrier's sensors that have ended.
    #[cold]
    fn pass_ends(&self, carrier: &mut SensorCarrier, id_hash: u64, now: &TickTime) {
        for (kind, schedule) in self.schedules_of(carrier.present) {
            let phase = &mut carrier.phases[kind.index()];
            schedule.advance(phase, now.episode_seed, id_hash, now.time_ns);
            let others = carrier.blacked_out & !kind.bit();
            carrier.blacked_out = others | if phase.is_dark() { kind.bit() } else { 0 };
        }
        carrier.phases_until_ns = self.next_end_ns(carrier);
    }

    /// Plans the random numbers that [`SensorSuite::sample`] takes at this tick, in the order in which it takes them.
    pub fn plan(&self, draws: &mut NormalDraws, now: &TickTime) {
        self.gnss.plan(draws, now.tick);
        self.speed_steering.plan(draws, now.tick);
        self.imu.plan(draws, now.tick);
    }

    /// The suites of further sensors.
    #[must_use]
    pub fn mounted(&self) -> &MountedSuites {
        &self.mounted
    }

    /// True if a sensor of this kind of the carrier samples at this step.
    #[inline]
    fn is_any_due(&self, carrier: &SensorCarrier, sensor: SensorKind, step: u32) -> bool {
        let is_own_due = sensor.is_in(carrier.own) && self.is_due(sensor, step);
        is_own_due || self.mounted.due(carrier.suite, sensor, step).next().is_some()
    }

    /// True if the sensor of a section samples at this step of its carrier; the first step samples everything.
    #[inline]
    #[must_use]
    pub fn is_due(&self, sensor: SensorKind, step: u32) -> bool {
        let period = self.periods[sensor.index()];
        period == 1 || step.is_multiple_of(period)
    }

    /// Samples the sensors that are due with the numbers drawn for their carrier, and writes the IMU's samples of the tick to `out`.
    /// Errors with a memory continue to evolve in a blackout, so its length does not show at its end.
    #[inline]
    pub fn sample(
        &self,
        carrier: &mut SensorCarrier,
        motion: &TickMotion,
        now: &TickTime,
        mut drawn: DrawnNormals,
        out: &mut [ImuSample],
    ) {
        let (step, awake) = (motion.step, carrier.awake());
        // The numbers of every sensor are taken, whether it is due or not.
        let [white, fresh] = self.gnss.take(&mut drawn);
        let odometer = self.speed_steering.take(&mut drawn);
        if self.is_due(SensorKind::Gnss, step) {
            self.sample_gnss(carrier, motion, now, SensorKind::Gnss.is_in(awake), [&white, &fresh]);
        }
        if self.is_due(SensorKind::SpeedSteering, step) && SensorKind::SpeedSteering.is_in(awake) {
            carrier.readings.speed_steering = self.speed_steering.sample(&carrier.scales, motion.state, &odometer);
            carrier.record(SensorKind::SpeedSteering, step);
        }
        self.sample_imu(carrier, motion, SensorKind::Imu.is_in(awake), drawn, out);
        // Those samples have been taken before.
        if awake & self.of_surroundings != 0 {
            for sensor in SensorKind::ALL {
                if sensor.is_in(awake & self.of_surroundings) && self.is_any_due(carrier, sensor, step) {
                    carrier.record(sensor, step);
                }
            }
        }
        carrier.update_ages(step, self.tick_s);
    }

    #[inline]
    fn sample_gnss(
        &self,
        carrier: &mut SensorCarrier,
        motion: &TickMotion,
        now: &TickTime,
        is_awake: bool,
        normals: [&NormalBlock; 2],
    ) {
        let view = |[x_m, y_m, z_m]: [f64; 3]| {
            let time_s = now.time_ns as f64 * 1e-9;
            let sky = self.sky.as_ref();
            sky.map_or_else(SkyView::default, |sky| sky.at(x_m, y_m, z_m, time_s))
        };
        let arm_m = carrier.arms.as_ref().map_or([0.0; 3], |arms| arms.antenna_m);
        let fix = self
            .gnss
            .sample(&mut carrier.gnss, motion, arm_m, is_awake, normals, view);
        if let Some(fix) = fix {
            carrier.readings.fix = fix;
            carrier.record(SensorKind::Gnss, motion.step);
        }
    }

    #[inline]
    fn sample_imu(
        &self,
        carrier: &mut SensorCarrier,
        motion: &TickMotion,
        is_awake: bool,
        drawn: DrawnNormals,
        out: &mut [ImuSample],
    ) {
        if self.is_due(SensorKind::Imu, motion.step) {
            let body = ImuMotion {
                yaw_rad: motion.state.yaw_rad,
                rows: match &mut carrier.arms {
                    Some(arms) => arms.felt(motion.rows, self.sub_step_s),
                    None => motion.rows,
                },
            };
            self.imu.sample(self.path, &body, drawn, &mut carrier.walk, out);
            if is_awake && let Some(newest) = out.last() {
                carrier.readings.imu = *newest;
                carrier.record(SensorKind::Imu, motion.step);
                return;
            }
        } else if let Some(arms) = &mut carrier.arms {
            arms.skip(motion.rows);
        }
        out.fill(carrier.readings.imu);
    }
}

fn schedules(config: &Config, tick_ns: u64) -> Vec<(SensorKind, BlackoutSchedule)> {
    let specs = SENSORS.iter().filter(|_| config.blackout.enabled);
    let schedules = specs.filter_map(|spec| {
        let schedule = BlackoutSchedule::new(spec.blackout_noise, (spec.blackouts)(config), tick_ns);
        Some((spec.kind, schedule?))
    });
    schedules.collect()
}
