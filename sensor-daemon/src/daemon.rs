//! The process: receives `world` messages and publishes one `observation` for each.

use std::{path::Path, time::Instant};

use ipc_schema::{
    activity::Awaited,
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
    delivery::Delivery,
    delivery::handover::HandoverFigures,
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
    drops: u64,
    lidar: Option<ScanTotals>,
    #[serde(flatten)]
    sight: SightTotals,
    /// Ticks that were sent again to a successor of the trainer.
    redelivered_ticks: u64,
    /// Largest size of the journal so far.
    journal_mib: usize,
    /// Planned handovers from one trainer to its successor.
    handovers: Vec<HandoverFigures>,
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
    while let Some(message) = daemon.next_world(&world)? {
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
        self.consumers.wake();
        Ok(())
    }
}

struct Daemon {
    membership: RunMembership,
    sensing: Sensing,
    surroundings: Surroundings,
    /// Commands that switch sensors on and off.
    switches: Subscriber,
    observations: Publisher,
    /// Delivery to `v2x`; `None` in a run without messages.
    measurements: Option<Measurements>,
    /// Delivery to the trainer, which must not miss an observation; `None` in a run without a trainer.
    consumer: Option<Delivery>,
    /// The other required consumers of observations. They receive every tick at least once.
    other_consumers: RequiredConsumers,
    digest: ObservationDigest,
    /// The first tick that the digest and the counts cover: the run's own, unless the run resumed without the state of its first part.
    counted_from: u64,
    /// One more than the newest tick made.
    ticks: u64,
    /// Ticks below this are in the checkpoint: they are simulated again but not sent.
    committed_ticks: u64,
    /// The oldest tick of the journal, as the board has it.
    journal_first: u64,
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
        let observations = membership.publisher(Channel::Observation)?;
        let switches = membership.subscriber(Channel::Switch)?;
        let consumer = match membership.run.mode.has_trainer() {
            true => Some(Delivery::open(&membership, Channel::Observation)?),
            false => None,
        };
        let measurements = match membership.run.config.v2x.is_on() {
            true => Some(Measurements::open(&membership)?),
            false => None,
        };
        let required = Channel::Observation.required(&membership.run);
        let others: Vec<Process> = required.filter(|process| *process != Process::Trainer).collect();
        let other_consumers = membership.consumers(others, Channel::Observation)?;
        membership.attach();
        let (ticks, committed_ticks) = (membership.run.first_tick(), membership.run.committed_ticks());
        Ok(Self {
            membership,
            sensing,
            surroundings,
            switches,
            observations,
            measurements,
            consumer,
            other_consumers,
            digest: state.digest,
            counted_from: state.first_tick,
            ticks,
            committed_ticks,
            journal_first: 0,
            vehicle_steps: state.sensing.observations(),
            cavs_max: state.cavs_max,
        })
    }

    /// Waits for the next `world` message; meanwhile it resends what a successor of the trainer lacks.
    fn next_world(&mut self, world: &Subscriber) -> Result<Option<Message>, Failure> {
        let mut received = Ok(None);
        loop {
            let waited = self.membership.wait_until_for(Awaited::Input(Process::SimCore), || {
                received = world.receive();
                !matches!(received, Ok(None)) || self.is_trainer_behind()
            })?;
            if let Some(message) = std::mem::replace(&mut received, Ok(None))? {
                return Ok(Some(message));
            }
            if waited == Wait::Stopped {
                return Ok(None);
            }
            self.catch_up()?;
        }
    }

    fn catch_up(&mut self) -> Result<(), Failure> {
        let Some(consumer) = &mut self.consumer else {
            return Ok(());
        };
        consumer.catch_up(&self.observations, &self.other_consumers)?;
        let journal_first = consumer.journal_first();
        if journal_first != self.journal_first {
            // The board has the number of ticks that the journal does not hold any more: a trainer reads there whether it can continue.
            self.membership.committed(journal_first);
            self.journal_first = journal_first;
        }
        Ok(())
    }

    /// Waits until `condition` holds; meanwhile it resends what a successor of the trainer lacks.
    fn wait_serving_trainer(&mut self, condition: impl Fn(&Self) -> bool) -> Result<Wait, Failure> {
        loop {
            self.catch_up()?;
            let waited = self.membership.wait_until_for(Awaited::Credit(Process::Trainer), || {
                self.is_trainer_behind() || condition(self)
            })?;
            if waited == Wait::Stopped || condition(self) {
                return Ok(waited);
            }
        }
    }

    fn is_trainer_behind(&self) -> bool {
        let consumer = self.consumer.as_ref();
        consumer.is_some_and(|consumer| consumer.is_behind(&self.other_consumers))
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
        let is_committed = world.tick < self.committed_ticks;
        // `v2x` receives committed ticks too: it makes its state again.
        if self.measurements.is_some()
            && self.wait_serving_trainer(|daemon| daemon.may_measure(daemon.ticks))? == Wait::Stopped
        {
            return Ok(Wait::Stopped);
        }
        if !is_committed && self.wait_for_credit(n)? == Wait::Stopped {
            return Ok(Wait::Stopped);
        }
        self.publish(world, &road_users, n)?;
        Ok(Wait::Ready)
    }

    /// Waits until the tick of `n` slots may be sent, or may be kept in the journal during a handover, and every other required
    /// consumer has credit for it.
    fn wait_for_credit(&mut self, n: usize) -> Result<Wait, Failure> {
        let len = ObservationLayout::new(n, self.sensing.width(), self.sensing.imu_samples()).len;
        let since = Instant::now();
        let waited = self.wait_serving_trainer(|daemon| {
            daemon.trainer_takes(len) && daemon.other_consumers.have_credit(daemon.ticks)
        })?;
        if let Some(consumer) = &mut self.consumer {
            consumer.update_handover(since);
        }
        Ok(waited)
    }

    /// True if `v2x` has credit for `tick`.
    fn may_measure(&self, tick: u64) -> bool {
        let measured = self.measurements.as_ref();
        measured.is_none_or(|measured| measured.consumers.have_credit(tick))
    }

    /// True if the next tick, `len` bytes long, may be sent to the trainer or kept for it. True in a run without a trainer.
    fn trainer_takes(&self, len: usize) -> bool {
        let trainer = self.consumer.as_ref();
        trainer.is_none_or(|trainer| trainer.may_send(&self.membership) || trainer.may_keep(len))
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
        let layout = ObservationLayout::new(n, self.sensing.width(), self.sensing.imu_samples());
        let ours = self.membership.header();
        let header = MessageHeader {
            run_id: ours.run_id,
            incarnation: ours.incarnation,
            shape: layout.shape,
            ..*world
        };
        let header = match &self.consumer {
            Some(consumer) => consumer.addressed(header),
            None => header,
        };
        let mut draft = self.observations.loan(header, layout.len)?;
        self.sensing
            .observe(&header, road_users, draft.payload_mut())
            .map_err(unreadable)?;
        self.digest.add(&header, draft.payload());
        // Stored before the tick is sent: a process that has received the last tick of an episode can rely on the state of the next one.
        if header.has(LAST_OF_EPISODE) {
            self.store_state(header.tick + 1)?;
        }
        if let Some(measurements) = &self.measurements {
            measurements.send(&header, draft.payload())?;
        }
        if self.keep(&header, draft.payload())? {
            draft.send()?;
        }
        if let Some(consumer) = &self.consumer {
            consumer.wake();
        }
        self.other_consumers.wake();
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

    /// Keeps the tick in the journal. Returns false if the trainer has no credit for it: the journal sends it later.
    fn keep(&mut self, header: &MessageHeader, payload: &[u8]) -> Result<bool, Failure> {
        if header.tick < self.committed_ticks {
            return Ok(false);
        }
        let Some(consumer) = &mut self.consumer else {
            return Ok(true);
        };
        let is_due = consumer.may_send(&self.membership);
        consumer.keep(*header, payload)?;
        if is_due {
            consumer.count_live();
        }
        Ok(is_due)
    }

    /// Publishes the counters of a tick on the board.
    fn report_tick(&mut self, header: &MessageHeader, road_users: usize) {
        let before = self.vehicle_steps;
        self.vehicle_steps = self.sensing.observations();
        let cavs = (self.vehicle_steps - before) as u32;
        self.cavs_max = self.cavs_max.max(cavs);
        self.ticks += 1;
        let (ticks, vehicle_steps, drops) = (self.ticks, self.vehicle_steps, self.observations.drops());
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

    /// Waits until every required consumer is done. Until then the trainer may die, and its successor needs everything since the last
    /// commit.
    fn wait_for_consumers_end(mut self) -> Result<(), Failure> {
        let waited = self.wait_serving_trainer(|daemon| {
            let is_trainer_done = daemon.consumer.as_ref().is_none_or(Delivery::is_done);
            let measured = daemon.measurements.as_ref();
            is_trainer_done
                && daemon.other_consumers.have_consumed(daemon.ticks)
                && measured.is_none_or(|measured| measured.consumers.have_consumed(daemon.ticks))
        })?;
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
            drops: self.observations.drops(),
            lidar: self.surroundings.lidar_totals(),
            sight: self.surroundings.sight_totals(),
            redelivered_ticks: self.consumer.as_ref().map_or(0, Delivery::redelivered),
            journal_mib: self.consumer.as_ref().map_or(0, Delivery::journal_mib),
            handovers: self.consumer.as_ref().map(Delivery::handovers).unwrap_or_default(),
        };
        self.membership.write_part(&part)
    }
}

/// The sections of a `world` message.
fn world_tick<'a>(message: &'a Message, header: &MessageHeader) -> Result<WorldTick<'a>, Failure> {
    let (payload, layout) = (message.payload(), WorldLayout::of(header));
    Ok(WorldTick {
        states: block::view(payload, layout.states).map_err(unreadable)?,
        sub_steps: block::view(payload, layout.sub_steps).map_err(unreadable)?,
        views: block::view(payload, layout.heroes).map_err(unreadable)?,
    })
}

fn unreadable(error: BlockError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}
