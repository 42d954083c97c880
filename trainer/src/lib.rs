//! Python extension `caraware._native`: attaches a trainer to a run, with observations as read-only views over shared memory.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError, atomic::AtomicBool},
    time::{Duration, Instant},
};

use ipc_schema::{
    activity::Awaited,
    block,
    board::{State, TrainingStatus},
    clock::monotonic_ns,
    header::{self, MessageHeader},
    membership::{MembershipError, RunMembership},
    metric::{self, METRICS},
    neighbours::NeighboursLayout,
    observation::ObservationLayout,
    ports::{BoardReader, Message, PortError, Publisher, Subscriber, Waker},
    prediction::PredictionLayout,
    process::Process,
    run::RunFile,
    services::Channel as Service,
};
use pyo3::{
    exceptions::{PyRuntimeError, PyValueError},
    prelude::*,
    types::PyTuple,
};

mod lease;
mod metrics;
mod recording;
mod scans;
mod sights;
mod view;
use lease::Lease;
use metrics::Metric;
use scans::PointCloud;
use sights::SightMessage;
use view::{ArrayTable, SectionView};

/// Longest time between two checks of Python's signals.
const SIGNAL_CHECK_INTERVAL: Duration = Duration::from_millis(50);
/// Polls for a message between two readings of the clock.
const POLLS: usize = 100;

fn failed(error: &dyn std::error::Error) -> PyErr {
    PyRuntimeError::new_err(
        ipc_schema::failure::Failure::from_error(ipc_schema::failure::FailureKind::Run, error).message,
    )
}

fn membership_failed(error: MembershipError) -> PyErr {
    failed(&error)
}

/// The messages that wait in the queue of a sensor's channel, which the first call opens.
fn sights(
    py: Python<'_>,
    queue: &mut Option<Subscriber>,
    membership: &mut RunMembership,
    channel: Service,
) -> PyResult<Vec<SightMessage>> {
    if queue.is_none() {
        *queue = Some(membership.subscriber(channel).map_err(membership_failed)?);
    }
    let mut messages = Vec::new();
    while let Some(subscriber) = &queue
        && let Some(message) = subscriber.receive().map_err(|error| failed(&error))?
    {
        messages.push(SightMessage::new(py, channel, &message)?);
    }
    Ok(messages)
}

struct Attached {
    membership: RunMembership,
    observations: Subscriber,
    /// What `v2x` adds to each observation, in a run with messages.
    neighbours: Option<Subscriber>,
    /// An observation whose neighbours have not arrived.
    unpaired: Option<Message>,
    /// Opened by the first call of `scans`.
    scans: Option<Subscriber>,
    /// Opened by the first call of `images`.
    images: Option<Subscriber>,
    /// Opened by the first call of `detections`.
    radar: Option<Subscriber>,
    /// Opened by the first call of `lane_positions`.
    lanes: Option<Subscriber>,
    /// In a run with `trainer.road_users`.
    world: Option<Subscriber>,
    predictions: Publisher,
    /// Wakes the process that waits for actions.
    actor: Option<Waker>,
    /// Board of that process.
    actor_board: Option<BoardReader>,
    /// Wakes `traffic-bridge`, which waits for the stage of the next lesson.
    traffic_bridge: Waker,
    training: TrainingStatus,
    /// Board of `traffic-bridge`; opened by the first call of `lag_ticks`.
    traffic: Option<BoardReader>,
    consumed_ticks: u64,
    /// Board of `sensor-daemon`: which incarnation sends observations.
    sensor_daemon: BoardReader,
    /// The incarnation of `sensor-daemon` whose observations are received.
    sender: u32,
    /// One more than the newest tick that Python has been given.
    received_ticks: u64,
    /// Episode of the newest tick that `receive` has returned, which lent ticks do not change; `None` before the first.
    episode: Option<u64>,
    ended: bool,
    /// True if the supervisor did not start this process. Then it does not end with the supervisor.
    outside: bool,
}

/// The place in a run of a trainer that has no ports yet: it has a board, so that the supervisor knows that it lives.
#[pyclass(frozen, module = "caraware._native")]
struct Place {
    /// `None` once an attachment has it.
    membership: Mutex<Option<RunMembership>>,
    run_json: String,
}

#[pymethods]
impl Place {
    /// Joins the run that `run_file` describes. No producer sends before an `Attachment` takes this place.
    #[new]
    fn new(run_file: &str) -> PyResult<Self> {
        let (run, run_json) = read_run(run_file)?;
        let stop = Arc::new(AtomicBool::new(false));
        let membership = RunMembership::join_with(run, Process::Trainer, 0, stop).map_err(membership_failed)?;
        Ok(Self {
            membership: Mutex::new(Some(membership)),
            run_json,
        })
    }

    /// Notes that this trainer lives, and waits for the trainers of other ranks.
    fn note_waiting_for_ranks(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| self.note(Awaited::Ranks))
    }

    /// Notes that this trainer works.
    fn note_working(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| self.note(Awaited::Nothing))
    }
}

impl Place {
    fn lock(&self) -> PyResult<MutexGuard<'_, Option<RunMembership>>> {
        self.membership
            .lock()
            .map_err(|_| PyRuntimeError::new_err("an earlier call failed"))
    }

    fn note(&self, awaited: Awaited) -> PyResult<()> {
        if let Some(membership) = &*self.lock()? {
            membership.note(awaited);
        }
        Ok(())
    }

    fn take(&self) -> PyResult<RunMembership> {
        let membership = self.lock()?.take();
        membership.ok_or_else(|| PyRuntimeError::new_err("this place has been taken"))
    }
}

/// The run file, read, and its text.
fn read_run(run_file: &str) -> PyResult<(RunFile, String)> {
    let run = RunFile::read(Path::new(run_file)).map_err(|error| failed(&error))?;
    Ok((run, std::fs::read_to_string(run_file)?))
}

/// The attachment of a trainer to a run. A process that the supervisor started has one; other processes may have any number.
#[pyclass(frozen, module = "caraware._native")]
struct Attachment {
    inner: Mutex<Attached>,
    #[pyo3(get)]
    run_json: String,
}

#[pymethods]
impl Attachment {
    /// Joins the run that `run_file` describes and opens its ports. Producers may send from now on, beginning with `first_tick`: all
    /// ticks before it are in the checkpoint from which this trainer continues.
    ///
    /// `outside` is for a process that the supervisor did not start. It does not end with the supervisor; `receive` raises instead.
    ///
    /// With `place` the trainer has joined the run before, and opens its ports there.
    #[new]
    #[pyo3(signature = (run_file, first_tick=0, *, outside=false, place=None))]
    fn new(run_file: &str, first_tick: u64, outside: bool, place: Option<&Place>) -> PyResult<Self> {
        if let Some(place) = place {
            return Self::attach(place.take()?, place.run_json.clone(), first_tick, outside);
        }
        let (run, run_json) = read_run(run_file)?;
        let stop = Arc::new(AtomicBool::new(false));
        let join = if outside {
            RunMembership::join_from_outside
        } else {
            RunMembership::join_with
        };
        let membership = join(run, Process::Trainer, 0, stop).map_err(membership_failed)?;
        Self::attach(membership, run_json, first_tick, outside)
    }

    /// Attaches this trainer to another environment of the run. Producers there may send from now on, beginning with `first_tick`.
    fn in_environment(&self, env_index: u32, first_tick: u64) -> PyResult<Self> {
        let inner = self.lock()?;
        let membership = inner.membership.in_environment(env_index).map_err(membership_failed)?;
        Self::attach(membership, self.run_json.clone(), first_tick, inner.outside)
    }

    /// Waits for an event in any environment, at most `timeout_s` seconds. Call `receive` before and after.
    fn wait_for_any(&self, py: Python<'_>, timeout_s: f64) -> PyResult<()> {
        let timeout =
            Duration::try_from_secs_f64(timeout_s).map_err(|error| PyValueError::new_err(error.to_string()))?;
        py.detach(|| self.wait(timeout.min(SIGNAL_CHECK_INTERVAL)))?;
        py.check_signals()
    }

    /// Returns all waiting blocks, at least one, or an empty list after `timeout_s` seconds. Releases the GIL while it waits.
    ///
    /// With `busy` it polls instead of sleeping: it uses its core, but reacts within a microsecond instead of a wake-up.
    #[pyo3(signature = (timeout_s, *, busy=false))]
    fn receive(&self, py: Python<'_>, timeout_s: f64, busy: bool) -> PyResult<Vec<ObservationBlock>> {
        let deadline = Instant::now()
            + Duration::try_from_secs_f64(timeout_s).map_err(|error| PyValueError::new_err(error.to_string()))?;
        loop {
            let blocks = py.detach(|| if busy { self.poll(deadline) } else { self.take_waiting() })?;
            if !blocks.is_empty() {
                return Ok(blocks);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(blocks);
            }
            if !busy {
                py.detach(|| self.wait(left.min(SIGNAL_CHECK_INTERVAL)))?;
            }
            py.check_signals()?;
        }
    }

    /// LIDAR scans since the last call; only the newest, if there were more than the queue holds. The first call returns none from before it.
    fn scans(&self, py: Python<'_>) -> PyResult<Vec<PointCloud>> {
        let mut inner = self.lock()?;
        if inner.scans.is_none() {
            inner.scans = Some(
                inner
                    .membership
                    .subscriber(Service::Pointcloud)
                    .map_err(membership_failed)?,
            );
        }
        let mut scans = Vec::new();
        while let Some(subscriber) = &inner.scans
            && let Some(message) = subscriber.receive().map_err(|error| failed(&error))?
        {
            scans.push(PointCloud::new(py, &message)?);
        }
        Ok(scans)
    }

    /// Images since the last call; only the newest, if there were more than the queue holds. The first call returns none from before it.
    fn images(&self, py: Python<'_>) -> PyResult<Vec<SightMessage>> {
        let mut inner = self.lock()?;
        let Attached { images, membership, .. } = &mut *inner;
        sights(py, images, membership, Service::Image)
    }

    /// Radar scans since the last call; only the newest, if there were more than the queue holds. The first call returns none from before
    /// it.
    fn detections(&self, py: Python<'_>) -> PyResult<Vec<SightMessage>> {
        let mut inner = self.lock()?;
        let Attached { radar, membership, .. } = &mut *inner;
        sights(py, radar, membership, Service::Radar)
    }

    /// Messages of `lane-position` since the last call; only the newest, if there were more than the queue holds. The first call returns none
    /// from before it.
    fn lane_positions(&self, py: Python<'_>) -> PyResult<Vec<SightMessage>> {
        let mut inner = self.lock()?;
        let Attached { lanes, membership, .. } = &mut *inner;
        sights(py, lanes, membership, Service::LanePosition)
    }

    /// Messages of `world` since the last call; only the oldest, if there were more than the queue holds.
    fn road_users(&self, py: Python<'_>) -> PyResult<Vec<SightMessage>> {
        let mut inner = self.lock()?;
        let Attached { world, membership, .. } = &mut *inner;
        if !membership.run.config.trainer.road_users {
            return Err(PyRuntimeError::new_err(
                "the run was started without `trainer.road_users`: set it to true, for instance with --set trainer.road_users=true",
            ));
        }
        sights(py, world, membership, Service::World)
    }

    /// Number of ticks that `traffic-bridge` is ahead of the newest tick consumed here.
    fn lag_ticks(&self) -> PyResult<u64> {
        let mut inner = self.lock()?;
        if inner.traffic.is_none() {
            let board = inner.membership.board_of(Process::TrafficBridge);
            inner.traffic = Some(board.map_err(membership_failed)?);
        }
        let ahead = inner.traffic.as_ref().map_or(0, |board| board.health().ticks);
        Ok(ahead.saturating_sub(inner.consumed_ticks))
    }

    /// Ticks that the process that waits for actions has finished beyond the newest one consumed.
    fn actor_lag_ticks(&self) -> PyResult<u64> {
        let inner = self.lock()?;
        let ahead = inner.actor_board.as_ref().map_or(0, |board| board.health().ticks);
        Ok(ahead.saturating_sub(inner.consumed_ticks))
    }

    /// Number of refused messages: those of other runs and of replaced incarnations.
    #[getter]
    fn refused(&self) -> PyResult<u64> {
        Ok(self.lock()?.observations.refused())
    }

    /// True once the last block of the run has been received.
    #[getter]
    fn ended(&self) -> PyResult<bool> {
        Ok(self.lock()?.ended)
    }

    /// Gives the producer credit for all ticks up to and including `tick`.
    fn consumed(&self, tick: u64) -> PyResult<()> {
        let mut inner = self.lock()?;
        inner.consumed_ticks = tick + 1;
        inner.membership.consumed(tick + 1);
        inner.membership.report(|health| {
            health.ticks = tick + 1;
            health.state = State::Running as u32;
        });
        Ok(())
    }

    /// Commits all ticks up to and including `tick`: they are in a checkpoint that has its final name.
    fn committed(&self, tick: u64) -> PyResult<()> {
        self.lock()?.membership.committed(tick + 1);
        Ok(())
    }

    /// Publishes that the stages of all lessons below `lessons` are decided: lessons from `since` on are in `stage`, counted from 0.
    /// `traffic-bridge` waits for this decision before each lesson.
    fn decided(&self, lessons: u64, since: u64, stage: u32) -> PyResult<()> {
        let mut inner = self.lock()?;
        inner.membership.decided(lessons, since, stage);
        inner.traffic_bridge.wake();
        Ok(())
    }

    /// Notes that this trainer lives, and waits for the trainers of other ranks.
    fn note_waiting_for_ranks(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| self.note(Awaited::Ranks))
    }

    /// Notes that this trainer works.
    fn note_working(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| self.note(Awaited::Nothing))
    }

    /// Publishes that all work of this trainer is done.
    fn done(&self) -> PyResult<()> {
        self.lock()?.membership.done();
        Ok(())
    }

    /// Publishes the predictions for `block`: `rows` is f32 `[n, columns]` in C order. In the driving task these are actions, which
    /// `sim-core` waits for, and the vehicles of the slots go with them. `estimates` is f32 `[n, 2]`, the estimates of the filter.
    #[pyo3(signature = (block, rows, columns, policy_version, estimates=None))]
    fn publish_predictions(
        &self,
        block: &ObservationBlock,
        rows: &[u8],
        columns: u32,
        policy_version: u64,
        estimates: Option<&[u8]>,
    ) -> PyResult<()> {
        let slots = block.header.rows();
        let inner = self.lock()?;
        let drives = inner.membership.run.config.drives();
        let layout = match drives {
            true => PredictionLayout::of_actions(slots, columns as usize),
            false => PredictionLayout::new(slots, columns as usize, estimates.is_some()),
        };
        let expected = layout.prediction.len;
        if rows.len() != expected {
            return Err(PyValueError::new_err(format!(
                "predictions have {} bytes, but [n, columns] of f32 needs {expected}",
                rows.len()
            )));
        }
        let header = MessageHeader {
            shape: layout.shape,
            policy_version,
            ..prediction_header(inner.membership.header(), &block.header)
        };
        if let Some(estimates) = estimates
            && estimates.len() != layout.estimate_m.len
        {
            return Err(PyValueError::new_err(format!(
                "estimates have {} bytes, but [n, 2] of f32 needs {}",
                estimates.len(),
                layout.estimate_m.len
            )));
        }
        let mut draft = inner
            .predictions
            .loan(header, layout.len)
            .map_err(|error| failed(&error))?;
        let question = block.message.lock().unwrap_or_else(PoisonError::into_inner);
        let vehicles: &[u8] = match drives {
            true => block::view(question.payload(), block.layout.vehicle).map_err(|error| failed(&error))?,
            false => &[],
        };
        let payload = draft.payload_mut();
        for (section, rows) in [
            (layout.prediction, rows),
            (layout.estimate_m, estimates.unwrap_or_default()),
            (layout.vehicle, vehicles),
        ] {
            payload[section.offset..section.offset + section.len].copy_from_slice(rows);
        }
        draft.send().map_err(|error| failed(&error))?;
        if let Some(waker) = &inner.actor {
            waker.wake();
        }
        Ok(())
    }

    /// Publishes figures of the training on the board. A figure that is left out keeps its last value. `metrics` maps names of `METRICS` to
    /// values.
    #[pyo3(signature = (*, episode=None, env_steps=None, updates=None, env_steps_per_s=None, policy_std=None, reward=None, metrics=None))]
    #[expect(
        clippy::too_many_arguments,
        reason = "keyword arguments of a Python method, one for each number of the status"
    )]
    fn report(
        &self,
        episode: Option<u64>,
        env_steps: Option<u64>,
        updates: Option<u64>,
        env_steps_per_s: Option<f64>,
        policy_std: Option<f64>,
        reward: Option<f64>,
        metrics: Option<BTreeMap<String, f64>>,
    ) -> PyResult<()> {
        let mut inner = self.lock()?;
        let old = inner.training;
        let mut values = old.metrics;
        for (name, value) in metrics.into_iter().flatten() {
            let place = metric::place_of(&name).ok_or_else(|| unknown_metric(&name))?;
            values[place] = value;
        }
        inner.training = TrainingStatus {
            episode: episode.unwrap_or(old.episode),
            env_steps: env_steps.unwrap_or(old.env_steps),
            updates: updates.unwrap_or(old.updates),
            env_steps_per_s: env_steps_per_s.unwrap_or(old.env_steps_per_s),
            policy_std: policy_std.unwrap_or(old.policy_std),
            reward: reward.unwrap_or(old.reward),
            best_reward: match reward {
                Some(reward) if old.best_reward == 0.0 || reward > old.best_reward => reward,
                _ => old.best_reward,
            },
            metrics: values,
        };
        inner.membership.board().set_training(inner.training);
        Ok(())
    }
}

/// What a trainer receives of one tick.
struct TickMessages {
    observation: Message,
    /// In a run with messages between road users.
    neighbours: Option<Message>,
}

/// The neighbours of the tick of `header`, if they have arrived; those of earlier ticks are repeated, and skipped.
fn neighbours_of(subscriber: &Subscriber, header: &MessageHeader) -> PyResult<Option<Message>> {
    while let Some(message) = subscriber.receive().map_err(|error| failed(&error))? {
        let received = message.header().tick;
        if received == header.tick {
            return Ok(Some(message));
        }
        if received > header.tick {
            return Err(failed(&PortError::Gap {
                channel: subscriber.channel().name(),
                expected: header.tick,
                received,
            }));
        }
    }
    Ok(None)
}

impl Attached {
    /// Turns to the `sensor-daemon` that counts, once all that an earlier one sent has been received: it sends from there on.
    fn follow_sender(&mut self) {
        let sender = self.sensor_daemon.current_incarnation();
        if sender != self.sender {
            self.sender = sender;
            self.observations.refuse_senders_before(sender);
            if let Some(neighbours) = &self.neighbours {
                neighbours.refuse_senders_before(sender);
            }
            // Its neighbours died with its sender: the new one sends both again.
            self.unpaired = None;
            self.membership.turn_to_sender(sender, self.received_ticks);
        }
    }

    /// The next observation, if one is waiting; if none is, call `follow_sender` before long.
    ///
    /// A `sensor-daemon` that was started again sends what it cannot know to have arrived: what has been received before is skipped.
    fn next_message(&mut self) -> PyResult<Option<TickMessages>> {
        loop {
            // Polls call this, and nearly always nothing waits: a look is cheaper than moving a message that is not there.
            let observation = match self.unpaired.is_some() {
                true => self.unpaired.take(),
                false => self.observations.receive().map_err(|error| failed(&error))?,
            };
            let Some(observation) = observation else {
                return Ok(None);
            };
            let header = *observation.header();
            let is_repeated = header.incarnation > 0 && header.tick < self.received_ticks;
            if is_repeated {
                self.ended |= header.has(header::LAST_OF_RUN);
                continue;
            }
            let neighbours = match &self.neighbours {
                None => None,
                Some(subscriber) => match neighbours_of(subscriber, &header)? {
                    Some(neighbours) => Some(neighbours),
                    None => {
                        self.unpaired = Some(observation);
                        return Ok(None);
                    }
                },
            };
            self.ended |= header.has(header::LAST_OF_RUN);
            self.received_ticks = header.tick + 1;
            return Ok(Some(TickMessages {
                observation,
                neighbours,
            }));
        }
    }

    /// All observations that are waiting.
    fn waiting_blocks(&mut self) -> PyResult<Vec<ObservationBlock>> {
        let mut blocks = Vec::new();
        while let Some(messages) = self.next_message()? {
            let image_shape = self.membership.run.config.camera.observed_shape();
            let header = messages.observation.header();
            let is_first = self.episode.replace(header.episode) != Some(header.episode);
            let bounds_episode = is_first || header.has(header::LAST_OF_EPISODE);
            blocks.push(ObservationBlock::new(messages, image_shape, bounds_episode)?);
        }
        Ok(blocks)
    }
}

impl Attachment {
    /// Opens the ports of an attachment.
    fn attach(mut membership: RunMembership, run_json: String, first_tick: u64, outside: bool) -> PyResult<Self> {
        let observations = membership.subscriber(Service::Observation).map_err(membership_failed)?;
        let neighbours = match membership.run.config.v2x.is_on() {
            true => Some(membership.subscriber(Service::Neighbours).map_err(membership_failed)?),
            false => None,
        };
        // Before the simulation may send, so that only what it has made without a trainer is missed.
        let world = match membership.run.config.trainer.road_users {
            true => Some(membership.subscriber(Service::World).map_err(membership_failed)?),
            false => None,
        };
        let predictions = membership.publisher(Service::Prediction).map_err(membership_failed)?;
        let actor = membership.run.config.actor();
        let actor_board = actor.map(|process| membership.board_of(process)).transpose();
        let actor_board = actor_board.map_err(membership_failed)?;
        let actor = actor.map(|process| membership.waker(process)).transpose();
        let actor = actor.map_err(membership_failed)?;
        let traffic_bridge = membership.waker(Process::TrafficBridge).map_err(membership_failed)?;
        let sensor_daemon = membership.board_of(Process::SensorDaemon).map_err(membership_failed)?;
        let journal_first = sensor_daemon.progress().committed_ticks;
        if first_tick < journal_first {
            return Err(gone(first_tick, journal_first, membership.run.config.run.journal_mib));
        }
        // Nothing of an earlier sender is in the new queue: this trainer turns to the present one before it asks for ticks, so that
        // they come without a poll.
        let sender = sensor_daemon.current_incarnation();
        observations.refuse_senders_before(sender);
        neighbours
            .iter()
            .for_each(|neighbours| neighbours.refuse_senders_before(sender));
        membership.turn_to_sender(sender, first_tick);
        membership.attach_from(first_tick);
        let attached = Attached {
            membership,
            observations,
            neighbours,
            unpaired: None,
            scans: None,
            images: None,
            radar: None,
            lanes: None,
            world,
            predictions,
            actor,
            actor_board,
            traffic_bridge,
            training: TrainingStatus::default(),
            traffic: None,
            consumed_ticks: first_tick,
            sensor_daemon,
            sender,
            received_ticks: first_tick,
            episode: None,
            ended: false,
            outside,
        };
        Ok(Self {
            inner: Mutex::new(attached),
            run_json,
        })
    }

    fn lock(&self) -> PyResult<MutexGuard<'_, Attached>> {
        self.inner
            .lock()
            .map_err(|_| PyRuntimeError::new_err("an earlier call failed: attach again"))
    }

    /// Notes on the board what this trainer waits for.
    fn note(&self, awaited: Awaited) -> PyResult<()> {
        self.lock()?.membership.note(awaited);
        Ok(())
    }

    fn wait(&self, timeout: Duration) -> PyResult<()> {
        let inner = self.lock()?;
        if inner.outside && !inner.membership.supervisor_lives() {
            let pid = inner.membership.run.supervisor_pid;
            return Err(membership_failed(MembershipError::Orphaned { pid }));
        }
        inner.membership.wait(timeout).map_err(membership_failed)
    }

    /// Polls until a block arrives, the deadline has passed, or Python's signals must be checked.
    fn poll(&self, deadline: Instant) -> PyResult<Vec<ObservationBlock>> {
        let until = deadline.min(Instant::now() + SIGNAL_CHECK_INTERVAL);
        loop {
            for _ in 0..POLLS {
                let blocks = self.lock()?.waiting_blocks()?;
                if !blocks.is_empty() {
                    return Ok(blocks);
                }
                std::hint::spin_loop();
            }
            self.lock()?.follow_sender();
            if Instant::now() >= until {
                return self.wait(Duration::ZERO).map(|()| Vec::new());
            }
        }
    }

    /// The blocks that are waiting, which may be none.
    fn take_waiting(&self) -> PyResult<Vec<ObservationBlock>> {
        let mut inner = self.lock()?;
        let blocks = inner.waiting_blocks()?;
        if blocks.is_empty() {
            inner.follow_sender();
        }
        Ok(blocks)
    }
}

/// The error of a trainer whose first tick the journal does not hold any more.
fn gone(first_tick: u64, journal_first: u64, journal_mib: u32) -> PyErr {
    PyRuntimeError::new_err(format!(
        "the trainer continues at tick {first_tick}, the journal begins at tick {journal_first}: raise `run.journal_mib` (now \
         {journal_mib}), or commit more often (`trainer.checkpoint_interval`)"
    ))
}

fn unknown_metric(name: &str) -> PyErr {
    let known: Vec<&str> = METRICS.iter().map(|metric| metric.name).collect();
    PyValueError::new_err(format!("unknown metric {name:?}; the metrics are {}", known.join(", ")))
}

/// The header of the prediction for an observation: the identity is the trainer's; episode, stage, map, tick and time are the
/// observation's.
fn prediction_header(trainer: MessageHeader, observation: &MessageHeader) -> MessageHeader {
    MessageHeader {
        flags: observation.flags,
        stage: observation.stage,
        map: observation.map,
        episode: observation.episode,
        episode_seed: observation.episode_seed,
        tick: observation.tick,
        sim_time_ns: observation.sim_time_ns,
        ..trainer
    }
}

/// The layout of a message, which must be long enough for it.
fn checked_layout(message: &Message) -> PyResult<ObservationLayout> {
    let header = message.header();
    let layout = ObservationLayout::of(header);
    if layout.len > message.payload().len() {
        let [slots, fields, ..] = header.shape;
        return Err(PyValueError::new_err(format!(
            "tick {}: {slots} slots of {fields} fields need {} bytes, but the message has {}",
            header.tick,
            layout.len,
            message.payload().len()
        )));
    }
    Ok(layout)
}

/// One tick's observations in shared memory; the memory stays valid while this object or a view of it lives.
#[pyclass(frozen, module = "caraware._native")]
struct ObservationBlock {
    /// Time at which it was taken, on the system's monotonic clock, nanoseconds.
    #[pyo3(get)]
    received_ns: u64,
    header: MessageHeader,
    layout: ObservationLayout,
    /// Address of the payload; valid as long as `message` lives.
    payload_address: usize,
    /// Keeps the payload from being overwritten. Behind a lock because a message is Send but not Sync, and Python wants both.
    message: Mutex<Message>,
    neighbours: Option<NeighboursBlock>,
    /// Rows, columns and bytes of a pixel of the images in an observation.
    image_shape: Option<[usize; 3]>,
    /// True for the first and the last tick of an episode, of those that `receive` returns.
    #[pyo3(get)]
    bounds_episode: bool,
}

/// The neighbours of a tick in shared memory.
struct NeighboursBlock {
    layout: NeighboursLayout,
    shape: [u32; header::DIMENSIONS],
    /// Address of the payload; valid as long as `_message` lives.
    payload_address: usize,
    /// Keeps the payload from being overwritten.
    _message: Mutex<Message>,
}

impl NeighboursBlock {
    fn new(message: Message) -> PyResult<Self> {
        let header = *message.header();
        let layout = NeighboursLayout::of(&header);
        if layout.len > message.payload().len() {
            return Err(PyValueError::new_err(format!(
                "tick {}: the neighbours need {} bytes, but the message has {}",
                header.tick,
                layout.len,
                message.payload().len()
            )));
        }
        Ok(Self {
            layout,
            shape: header.shape,
            payload_address: message.payload().as_ptr().expose_provenance(),
            _message: Mutex::new(message),
        })
    }
}

/// The arrays of an observation.
static OBSERVATION_ARRAYS: LazyLock<ArrayTable> =
    LazyLock::new(|| ArrayTable::new(ObservationLayout::SECTIONS, ObservationLayout::DIMENSIONS));
/// The arrays of its neighbours.
static NEIGHBOURS_ARRAYS: LazyLock<ArrayTable> =
    LazyLock::new(|| ArrayTable::new(NeighboursLayout::SECTIONS, NeighboursLayout::DIMENSIONS));

impl ObservationBlock {
    fn new(messages: TickMessages, image_shape: Option<[usize; 3]>, bounds_episode: bool) -> PyResult<Self> {
        let received_ns = monotonic_ns();
        let TickMessages {
            observation: message,
            neighbours,
        } = messages;
        let header = *message.header();
        let payload_address = message.payload().as_ptr().expose_provenance();
        let layout = checked_layout(&message)?;
        Ok(Self {
            received_ns,
            header,
            layout,
            payload_address,
            message: Mutex::new(message),
            neighbours: neighbours.map(NeighboursBlock::new).transpose()?,
            image_shape,
            bounds_episode,
        })
    }
}

#[pymethods]
impl ObservationBlock {
    /// Tick number, 0-based over the run.
    #[getter]
    fn tick(&self) -> u64 {
        self.header.tick
    }

    /// Episode number, 0-based over the run.
    #[getter]
    fn episode(&self) -> u64 {
        self.header.episode
    }

    /// Simulated time since the start of the episode, nanoseconds.
    #[getter]
    fn sim_time_ns(&self) -> u64 {
        self.header.sim_time_ns
    }

    /// Number of slots n.
    #[getter]
    fn slots(&self) -> u32 {
        self.header.shape[0]
    }

    /// Number of fields d.
    #[getter]
    fn fields(&self) -> u32 {
        self.header.shape[1]
    }

    /// Number of IMU samples k.
    #[getter]
    fn imu_samples(&self) -> u32 {
        self.header.shape[2]
    }

    /// Rows, columns and bytes of a pixel of the images in the section "images"; `None` in a run whose observations hold none.
    #[getter]
    fn image_shape(&self) -> Option<(usize, usize, usize)> {
        self.image_shape.map(|[rows, columns, bytes]| (rows, columns, bytes))
    }

    /// True in an evaluation episode.
    #[getter]
    fn evaluation(&self) -> bool {
        self.header.has(header::EVALUATION)
    }

    /// True for the last tick of its episode.
    #[getter]
    fn episode_last(&self) -> bool {
        self.header.has(header::LAST_OF_EPISODE)
    }

    /// True for the last tick of a lesson. Before the next lesson `traffic-bridge` waits for `Attachment.decided`.
    #[getter]
    fn lesson_last(&self) -> bool {
        self.header.has(header::LAST_OF_LESSON)
    }

    /// Stage of the curriculum, counted from 1; 0 without a curriculum and in evaluations.
    #[getter]
    fn stage(&self) -> u16 {
        self.header.stage
    }

    /// True for the last tick of the run.
    #[getter]
    fn last(&self) -> bool {
        self.header.has(header::LAST_OF_RUN)
    }

    /// Address of the payload; tests compare it to prove that nothing was copied.
    #[getter]
    fn address(&self) -> usize {
        self.payload_address
    }

    /// One array ("observation", "truth", "gnss_m", …: `ipc_schema::observation::ObservationLayout`) as a read-only buffer over shared
    /// memory.
    fn section(slf: Bound<'_, Self>, name: &str) -> PyResult<SectionView> {
        let block = slf.get();
        let (sections, sizes, address) = (block.layout.named(), block.header.shape, block.payload_address);
        OBSERVATION_ARRAYS.view(name, slf.unbind(), address, sections, sizes)
    }

    /// One array of the neighbours of this tick ("objects", "ids", …: `ipc_schema::neighbours::NeighboursLayout`); `None` in a run without
    /// messages between road users (`v2x.share`).
    fn neighbours(slf: Bound<'_, Self>, name: &str) -> PyResult<Option<SectionView>> {
        let Some(neighbours) = &slf.get().neighbours else {
            return Ok(None);
        };
        let (sections, sizes, address) = (neighbours.layout.named(), neighbours.shape, neighbours.payload_address);
        NEIGHBOURS_ARRAYS
            .view(name, slf.unbind(), address, sections, sizes)
            .map(Some)
    }
}

/// Hash of a SUMO id, as in `id_hash` of an observation.
#[pyfunction]
fn id_hash(id: &str) -> u64 {
    ipc_schema::traffic::id_hash(id)
}

/// Numbers in a row that a policy sees in the run that `run_file` describes.
#[pyfunction]
fn observation_size(run_file: &str) -> PyResult<usize> {
    let run = RunFile::read(Path::new(run_file)).map_err(|error| failed(&error))?;
    Ok(run.config.policy_width())
}

/// Gives two paths each other's names, from one moment to the next.
#[pyfunction]
fn exchange(one: PathBuf, other: PathBuf) -> PyResult<()> {
    Ok(ipc_schema::storage::exchange(&one, &other)?)
}

/// The module.
#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Place>()?;
    module.add_class::<Attachment>()?;
    module.add_class::<ObservationBlock>()?;
    module.add_class::<Lease>()?;
    module.add_class::<SectionView>()?;
    module.add_class::<PointCloud>()?;
    module.add_class::<SightMessage>()?;
    module.add_class::<Metric>()?;
    module.add_class::<recording::RecordingFile>()?;
    module.add_function(wrap_pyfunction!(id_hash, module)?)?;
    module.add_function(wrap_pyfunction!(observation_size, module)?)?;
    module.add_function(wrap_pyfunction!(exchange, module)?)?;
    module.add("SPEAKER_COLUMNS", ipc_schema::neighbours::SPEAKER_COLUMNS)?;
    module.add("CANDIDATE_COLUMNS", ipc_schema::neighbours::CANDIDATE_COLUMNS)?;
    module.add("METRICS", PyTuple::new(module.py(), METRICS.iter().map(Metric::of))?)?;
    module.add("SCHEMA_VERSION", ipc_schema::SCHEMA_VERSION)?;
    module.add("LAYOUT_VERSION", ipc_schema::run::LAYOUT_VERSION)?;
    let layout = ipc_schema::layout::json().map_err(|error| failed(&error))?;
    module.add("LAYOUT_JSON", layout)?;
    module.add("VALID", ipc_schema::observation::VALID)?;
    module.add("TERMINATED", ipc_schema::observation::TERMINATED)?;
    module.add("TRUNCATED", ipc_schema::observation::TRUNCATED)?;
    module.add("ENDED_BY_COLLISION", ipc_schema::observation::ENDED_BY_COLLISION)?;
    module.add("ENDED_OFF_ROAD", ipc_schema::observation::ENDED_OFF_ROAD)?;
    module.add("ENDED_BY_ARRIVAL", ipc_schema::observation::ENDED_BY_ARRIVAL)?;
    module.add("ENDED_AT_RED", ipc_schema::observation::ENDED_AT_RED)?;
    module.add("ENDED_AGAINST_TRAFFIC", ipc_schema::observation::ENDED_AGAINST_TRAFFIC)?;
    module.add("ENDED_BLOCKED", ipc_schema::observation::ENDED_BLOCKED)?;
    module.add("ENDED_BY_TIME", ipc_schema::observation::ENDED_BY_TIME)?;
    module.add("CLIPPED", ipc_schema::observation::CLIPPED)?;
    module.add("RESYNCHRONISED", ipc_schema::observation::RESYNCHRONISED)?;
    module.add("EMPTY_SLOT", ipc_schema::observation::EMPTY_SLOT)?;
    module.add("GNSS_COLUMNS", ipc_schema::observation::GNSS_COLUMNS)?;
    module.add("IMU_COLUMNS", ipc_schema::observation::IMU_COLUMNS)?;
    module.add("TRUTH_COLUMNS", ipc_schema::observation::TRUTH_COLUMNS)
}
