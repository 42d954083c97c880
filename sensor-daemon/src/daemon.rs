//! The process: receives `world` messages and publishes one `observation` for each.

use std::path::Path;

use ipc_schema::{
    block::{self, BlockError},
    board::State,
    digest::ObservationDigest,
    failure::{Failure, FailureKind},
    header::{LAST_OF_EPISODE, LAST_OF_RUN, MessageHeader},
    membership::{RequiredConsumers, RunMembership, Wait},
    observation::ObservationLayout,
    ports::{Message, PortError, Publisher, Subscriber},
    process::Process,
    run::MapInfo,
    services::Channel,
    world::WorldLayout,
};
use serde::{Deserialize, Serialize};

use crate::{
    delivery::tick_publisher::{DeliveryFigures, TickPublisher},
    scanning::ScanTotals,
    sensing::{Sensing, SensingState, WorldTick},
    surroundings::{SightTotals, Surroundings, projection_failure},
};

/// What this process has counted when an episode begins.
#[derive(Debug, Default, Serialize, Deserialize)]
struct SensorDaemonState {
    digest: ObservationDigest,
    /// The first tick that the digest covers.
    first_tick: u64,
    cavs_max: u32,
    sensing: SensingState,
    lidar: Option<ScanTotals>,
    sight: SightTotals,
}

/// The part of the run's report that this process writes.
#[derive(Debug, Serialize)]
struct SensorDaemonReport {
    observation_hash: String,
    /// The first tick that the hash and the counts cover.
    first_tick: u64,
    observations: u64,
    ticks: u64,
    cavs_max: u32,
    raw_gnss_mean_error_m: Option<f64>,
    lidar: Option<ScanTotals>,
    #[serde(flatten)]
    sight: SightTotals,
    #[serde(flatten)]
    delivery: DeliveryFigures,
}

/// Makes observations until the last tick of the run, or until the supervisor stops the process.
///
/// # Errors
/// The map's projection is not understood, the scene or a LIDAR's ray table cannot be read, or a port fails.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let mut membership = RunMembership::join(run_file, Process::SensorDaemon)?;
    let (config, maps) = (&membership.run.config, membership.run.every_map());
    let maps: Vec<MapInfo> = maps.into_iter().map(|map| map.info).collect();
    let mut sensing = Sensing::on_maps(config, membership.run.map.bounds_m, &maps).map_err(projection_failure)?;
    let surroundings = Surroundings::open(&mut membership, &mut sensing)?;
    let world = membership.subscriber(Channel::World)?;
    let mut daemon = Daemon::open(membership, sensing, surroundings)?;
    while let Some(message) = daemon.observations.next(&mut daemon.membership, &world)? {
        let header = *message.header();
        if daemon.tick(&message)? == Wait::Stopped {
            break;
        }
        drop(message);
        daemon.membership.consumed(header.tick + 1);
        if header.has(LAST_OF_RUN) {
            return daemon.wait_for_consumers_end();
        }
    }
    daemon.write_part()
}

/// Delivery to `v2x`: the blocks of observations, each tick once, whatever the trainer has.
struct Measurements {
    publisher: Publisher,
    consumers: RequiredConsumers,
}

impl Measurements {
    fn open(membership: &RunMembership) -> Result<Self, Failure> {
        Ok(Self {
            publisher: membership.publisher(Channel::Measurement)?,
            consumers: membership.required_consumers(Channel::Measurement)?,
        })
    }

    fn send(&self, header: &MessageHeader, payload: &[u8]) -> Result<(), Failure> {
        // For any incarnation of its receiver.
        let header = MessageHeader {
            addressee: 0,
            ..*header
        };
        let mut draft = self.publisher.loan_unwritten(header, payload.len())?;
        draft.payload_mut().copy_from_slice(payload);
        draft.send()?;
        self.consumers.sent(header.tick);
        Ok(())
    }
}

struct Daemon {
    membership: RunMembership,
    sensing: Sensing,
    surroundings: Surroundings,
    /// Commands that switch sensors on and off.
    switches: Subscriber,
    observations: TickPublisher,
    /// Delivery to `v2x`; `None` in a run without messages.
    measurements: Option<Measurements>,
    digest: ObservationDigest,
    /// The first tick that the digest and the counts cover: the run's own, unless the run resumed without the state of its first part.
    counted_from: u64,
    /// One more than the newest tick made.
    ticks: u64,
    vehicle_steps: u64,
    cavs_max: u32,
}

impl Daemon {
    fn open(
        mut membership: RunMembership,
        mut sensing: Sensing,
        mut surroundings: Surroundings,
    ) -> Result<Self, Failure> {
        // Continue where the part of the run before this one stood when the episode began.
        let first_tick = membership.run.first_tick();
        let state = membership.stored_episode_state()?.unwrap_or(SensorDaemonState {
            first_tick,
            ..SensorDaemonState::default()
        });
        sensing.restore(&state.sensing);
        surroundings.set_lidar_totals(state.lidar);
        surroundings.set_sight_totals(state.sight);
        let observations = TickPublisher::open(&membership, Channel::Observation)?;
        let switches = membership.subscriber(Channel::Switch)?;
        let measurements = match membership.run.config.v2x.is_on() {
            true => Some(Measurements::open(&membership)?),
            false => None,
        };
        membership.attach();
        let ticks = membership.run.first_tick();
        Ok(Self {
            membership,
            sensing,
            surroundings,
            switches,
            observations,
            measurements,
            digest: state.digest,
            counted_from: state.first_tick,
            ticks,
            vehicle_steps: state.sensing.observations(),
            cavs_max: state.cavs_max,
        })
    }

    /// One tick: assigns slots, scans, waits for credit, samples and publishes.
    fn tick(&mut self, message: &Message) -> Result<Wait, Failure> {
        let world = message.header();
        if world.tick != self.ticks {
            return Err(PortError::Gap {
                channel: "world",
                expected: self.ticks,
                received: world.tick,
            }
            .into());
        }
        let road_users = world_tick(message, world)?;
        self.sensing
            .switches_mut()
            .receive(&self.switches)?
            .map_err(unreadable)?;
        let n = self
            .sensing
            .assign(world, road_users.states)
            .map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
        self.scan(world, &road_users)?;
        // `v2x` receives committed ticks too: it makes its state again.
        if let Some(measurements) = &self.measurements {
            let may_measure = |_: &TickPublisher| measurements.consumers.have_credit(world.tick);
            if self.observations.wait_until(&mut self.membership, may_measure)? == Wait::Stopped {
                return Ok(Wait::Stopped);
            }
        }
        let len = ObservationLayout::of_run(n, &self.membership.run.config).len;
        let waited = self
            .observations
            .wait_for_credit(&mut self.membership, world.tick, len)?;
        if waited == Wait::Stopped {
            return Ok(Wait::Stopped);
        }
        self.publish(world, &road_users, n)?;
        Ok(Wait::Ready)
    }

    /// Samples the sensors of the surroundings. It runs before the observation is made, because the observation shows their samples.
    fn scan(&mut self, world: &MessageHeader, road_users: &WorldTick) -> Result<(), Failure> {
        let ours = self.membership.header();
        let header = MessageHeader {
            run_id: ours.run_id,
            incarnation: ours.incarnation,
            ..*world
        };
        self.surroundings.sample(&header, road_users, &mut self.sensing)
    }

    /// Samples the sensors into a block of shared memory, adds it to the hash, and sends it or keeps it in the journal.
    fn publish(&mut self, world: &MessageHeader, road_users: &WorldTick, n: usize) -> Result<(), Failure> {
        let layout = ObservationLayout::of_run(n, &self.membership.run.config);
        let ours = self.membership.header();
        let header = MessageHeader {
            run_id: ours.run_id,
            incarnation: ours.incarnation,
            shape: layout.shape,
            ..*world
        };
        let header = self.observations.addressed(header);
        let mut draft = self.observations.port().loan(header, layout.len)?;
        self.sensing
            .observe(&header, road_users, draft.payload_mut())
            .map_err(unreadable)?;
        if layout.images.len > 0 {
            let images = block::view_mut(draft.payload_mut(), layout.images).map_err(unreadable)?;
            self.surroundings.write_images(&self.sensing, images);
        }
        self.digest.add(&header, draft.payload());
        // Stored before the tick is sent: a process that has received the last tick of an episode can rely on the state of the next one.
        if header.has(LAST_OF_EPISODE) {
            self.store_state(header.tick + 1)?;
        }
        if let Some(measurements) = &self.measurements {
            measurements.send(&header, draft.payload())?;
        }
        self.observations.publish(&header, draft)?;
        self.report_tick(&header, road_users.states.len());
        Ok(())
    }

    /// Stores what has been counted before `tick`, the first one of an episode.
    fn store_state(&self, tick: u64) -> Result<(), Failure> {
        let sensing = self.sensing.state();
        let cavs = (sensing.observations() - self.vehicle_steps) as u32;
        let state = SensorDaemonState {
            digest: self.digest.clone(),
            first_tick: self.counted_from,
            cavs_max: self.cavs_max.max(cavs),
            sensing,
            lidar: self.surroundings.lidar_totals(),
            sight: self.surroundings.sight_totals(),
        };
        self.membership.store_episode_state(tick, &state)
    }

    /// Publishes the counters of a tick on the board.
    fn report_tick(&mut self, header: &MessageHeader, road_users: usize) {
        let before = self.vehicle_steps;
        self.vehicle_steps = self.sensing.observations();
        let cavs = (self.vehicle_steps - before) as u32;
        self.cavs_max = self.cavs_max.max(cavs);
        self.ticks += 1;
        let (ticks, vehicle_steps, drops) = (self.ticks, self.vehicle_steps, self.observations.port().drops());
        self.membership.report(|health| {
            health.state = State::Running as u32;
            health.ticks = ticks;
            health.episode = header.episode;
            health.sim_time_ns = header.sim_time_ns;
            health.road_users = road_users as u32;
            health.cavs = cavs;
            health.vehicle_steps = vehicle_steps;
            health.drops = drops;
        });
    }

    /// Waits until every required consumer is done.
    fn wait_for_consumers_end(mut self) -> Result<(), Failure> {
        let (ticks, measurements) = (self.ticks, self.measurements.as_ref());
        let has_measured = || measurements.is_none_or(|measurements| measurements.consumers.have_consumed(ticks));
        let waited = self
            .observations
            .wait_for_consumers_end(&mut self.membership, ticks, has_measured)?;
        self.write_part()?;
        if waited == Wait::Stopped {
            return Ok(());
        }
        self.membership.report(|health| health.state = State::Done as u32);
        Ok(())
    }

    fn write_part(&self) -> Result<(), Failure> {
        let raw = self.sensing.raw_error();
        #[expect(clippy::cast_precision_loss, reason = "a mean in a report")]
        let part = SensorDaemonReport {
            observation_hash: self.digest.hex(),
            observations: self.vehicle_steps,
            first_tick: self.counted_from,
            ticks: self.ticks - self.counted_from,
            cavs_max: self.cavs_max,
            raw_gnss_mean_error_m: (raw.count > 0).then(|| raw.sum_m / raw.count as f64),
            lidar: self.surroundings.lidar_totals(),
            sight: self.surroundings.sight_totals(),
            delivery: self.observations.figures(),
        };
        self.membership.write_part(&part)
    }
}

/// The sections of a `world` message.
fn world_tick<'a>(message: &'a Message, header: &MessageHeader) -> Result<WorldTick<'a>, Failure> {
    let (payload, layout) = (message.payload(), WorldLayout::of(header));
    Ok(WorldTick {
        states: block::view(payload, layout.road_users()).map_err(unreadable)?,
        bodies: block::view(payload, layout.states).map_err(unreadable)?,
        sub_steps: block::view(payload, layout.sub_steps).map_err(unreadable)?,
        views: block::view(payload, layout.heroes).map_err(unreadable)?,
    })
}

fn unreadable(error: BlockError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}
