//! The suite of point sensors that every connected road user carries: it decides which sensors sample at a tick, and samples them.

use ipc_schema::{
    config::Config,
    sensor::{NoiseStream, SENSORS, SensorCarriers, SensorKind},
    traffic::Kind,
    world::{SubStep, VehicleState},
};
use sim_core::geodesy::{GeodesyError, Projection};

use crate::{
    blackout::BlackoutSchedule,
    carrier::SensorCarrier,
    gnss::{self, GnssReceiver, SatelliteSky, SkyView},
    imu::{self, ImuModel},
    noise::{DrawnNormals, NormalDraws, RandomStream},
    normals::NormalBlock,
    speed_steering::{self, SpeedSteeringScales},
    wide::VectorPath,
};

/// The time of a tick, as noise and blackouts use it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TickTime {
    /// Seed of the episode.
    pub episode_seed: u64,
    /// Ticks since the start of the episode: a vehicle that leaves and returns draws new noise.
    pub tick: u32,
    /// Time of the episode, nanoseconds.
    pub time_ns: u64,
}

/// One road user's motion over a tick.
#[derive(Debug, Clone, Copy)]
pub struct TickMotion<'a> {
    /// At the end of the tick.
    pub state: &'a VehicleState,
    /// Sub-steps, at least one.
    pub rows: &'a [SubStep],
    /// Ticks since the road user took its slot.
    pub step: u32,
}

/// Sensors as configured.
pub struct SensorSuite {
    receiver: GnssReceiver,
    sky: Option<Box<dyn SatelliteSky>>,
    unit: ImuModel,
    speed_steering: ipc_schema::config::SpeedSteering,
    speed_steering_noise: bool,
    steering_ratio: f64,
    schedules: [Option<BlackoutSchedule>; SensorKind::COUNT],
    /// Ticks between two samples of each sensor.
    periods: [u32; SensorKind::COUNT],
    imu_samples: u32,
    lidars: usize,
    lidar_range_m: f32,
    pedestrian_factor: f64,
    tick_s: f64,
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
        // Validated to be whole numbers of ticks.
        let ticks =
            |period_s: f64| ((period_s / config.run.tick_s).round() as i64).clamp(1, i64::from(u32::MAX)) as u32;
        let samples = config.imu_samples();
        Ok(Self {
            receiver: GnssReceiver::new(&config.gnss, projection, bounds_m)?,
            sky: None,
            unit: ImuModel::new(&config.imu, samples),
            speed_steering_noise: speed_steering::has_noise(&config.speed_steering),
            speed_steering: config.speed_steering.clone(),
            steering_ratio: config.vehicle.steering_ratio,
            schedules: schedules(config, tick_ns),
            periods: SENSORS.map(|spec| ticks((spec.period_s)(config))),
            imu_samples: u32::try_from(samples).unwrap_or(u32::MAX),
            lidars: config.lidar.vehicles as usize,
            lidar_range_m: config.lidar.range_m as f32,
            pedestrian_factor: config.gnss.pedestrian_noise_factor,
            tick_s: config.run.tick_s,
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
            _ => kind != SensorKind::Lidar || slot < self.lidars,
        };
        let present = SensorKind::ALL.into_iter().filter(|kind| carries(*kind));
        let present = present.fold(0, |bits, kind| bits | kind.bit());
        let factor = if is_person { self.pedestrian_factor } else { 1.0 };
        let stream = RandomStream {
            episode_seed: now.episode_seed,
            id_hash: state.id_hash,
            sensor: NoiseStream::Scale,
        };
        let scales = SpeedSteeringScales::new(&self.speed_steering, &stream.normals(0));
        let mut carrier = SensorCarrier::new(present, scales, factor, self.lidar_range_m);
        for (phase, schedule) in carrier.phases.iter_mut().zip(&self.schedules) {
            if let Some(schedule) = schedule {
                *phase = schedule.begin(now.episode_seed, state.id_hash, now.tick, now.time_ns);
            }
        }
        carrier
    }

    /// Advances the blackouts of a carrier's sensors to this tick.
    #[inline]
    pub fn advance(&self, carrier: &mut SensorCarrier, id_hash: u64, now: &TickTime) {
        for (phase, schedule) in carrier.phases.iter_mut().zip(&self.schedules) {
            if let Some(schedule) = schedule {
                schedule.advance(phase, now.episode_seed, id_hash, now.time_ns);
            }
        }
    }

    /// Plans the random numbers that [`SensorSuite::sample`] takes at this tick, in the order in which it takes them.
    pub fn plan(&self, draws: &mut NormalDraws, now: &TickTime) {
        if self.receiver.has_white_noise() {
            draws.plan(NoiseStream::Gnss, now.tick);
        }
        if self.receiver.has_correlated_noise() {
            draws.plan(NoiseStream::GnssCorrelated, now.tick);
        }
        if self.speed_steering_noise {
            draws.plan(NoiseStream::SpeedSteering, now.tick);
        }
        self.unit.plan(draws, now.tick.wrapping_mul(self.imu_samples));
    }

    /// True if the sensor samples at this step of its carrier; the first step samples everything.
    #[inline]
    fn is_due(&self, sensor: SensorKind, step: u32) -> bool {
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
        out: &mut [imu::ImuSample],
    ) {
        let (step, awake) = (motion.step, carrier.awake());
        let normals = [
            self.receiver.has_white_noise(),
            self.receiver.has_correlated_noise(),
            self.speed_steering_noise,
        ]
        .map(|is_planned| drawn.take(is_planned));
        if self.is_due(SensorKind::Gnss, step) {
            self.sample_gnss(
                carrier,
                motion,
                now,
                SensorKind::Gnss.is_in(awake),
                [&normals[0], &normals[1]],
            );
        }
        if self.is_due(SensorKind::SpeedSteering, step) && SensorKind::SpeedSteering.is_in(awake) {
            let (params, ratio) = (&self.speed_steering, self.steering_ratio);
            carrier.readings.speed_steering =
                speed_steering::sample(params, ratio, &carrier.scales, motion.state, &normals[2]);
            carrier.record(SensorKind::SpeedSteering, step);
        }
        self.sample_imu(carrier, motion, SensorKind::Imu.is_in(awake), drawn, out);
        if SensorKind::Lidar.is_in(awake) {
            carrier.record(SensorKind::Lidar, step);
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
        [white, fresh]: [&NormalBlock; 2],
    ) {
        carrier.correlated = if motion.step == 0 {
            [fresh[0], fresh[1], fresh[2]]
        } else {
            self.receiver.correlated(carrier.correlated, fresh)
        };
        if !is_awake {
            return;
        }
        let state = motion.state;
        let place_m = [state.x_m, state.y_m, state.z_m];
        let time_s = now.time_ns as f64 * 1e-9;
        let view = self.sky.as_ref().map_or_else(SkyView::default, |sky| {
            sky.at(place_m[0], place_m[1], place_m[2], time_s)
        });
        carrier.has_fix = view.has_fix;
        if view.has_fix {
            carrier.readings.fix = self.receiver.fix(
                place_m,
                &gnss::GnssErrors {
                    white,
                    correlated: &carrier.correlated,
                    view: &view,
                    factor: carrier.gnss_factor,
                },
            );
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
        out: &mut [imu::ImuSample],
    ) {
        if self.is_due(SensorKind::Imu, motion.step) {
            let body = imu::ImuMotion {
                yaw_rad: motion.state.yaw_rad,
                rows: motion.rows,
            };
            self.unit.sample(self.path, &body, drawn, &mut carrier.walk, out);
            if is_awake && let Some(newest) = out.last() {
                carrier.readings.imu = *newest;
                carrier.record(SensorKind::Imu, motion.step);
                return;
            }
        }
        out.fill(carrier.readings.imu);
    }
}

fn schedules(config: &Config, tick_ns: u64) -> [Option<BlackoutSchedule>; SensorKind::COUNT] {
    SENSORS.map(|spec| {
        let spans = (spec.blackouts)(config);
        let schedule = || BlackoutSchedule::new(spec.blackout_noise, spans, tick_ns);
        config.blackout.enabled.then(schedule).flatten()
    })
}
