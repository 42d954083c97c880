//! The loop: look at shared memory, publish the newest of what belongs together, report, leave with the run.

use std::time::{Duration, Instant};

use ipc_schema::{
    board::State,
    failure::Failure,
    header::{EVALUATION, MessageHeader},
    ports::{BoardReader, PortError},
    process::Process,
    services::Channel,
    session::{Session, SessionError},
};

use crate::{
    access,
    commands::Commands,
    endpoint,
    facts::Facts,
    feed::{Feed, newest_common},
    frame,
    keys::{Keys, Topic},
    meter::{Delivering, Errors, Observed, Rate, RoadUsers},
    outlet::{self, Outlet, OutletError},
    pace::{Budget, Patience},
    scans::Scans,
    status::{self, Counters, ProcessStatus, Status},
};

/// How long messages of different ticks wait for one another before they go out as they are.
const MEETING_LIMIT: Duration = Duration::from_millis(500);
/// How long the last tick may take to come through all channels.
const LINGER: Duration = Duration::from_millis(500);

/// What is fanned out, in the order in which it arises.
const CHANNELS: [(Channel, Topic); 3] = [
    (Channel::World, Topic::World),
    (Channel::Observation, Topic::Observation),
    (Channel::Prediction, Topic::Prediction),
];

/// The fan-out cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum RelayError {
    /// Shared memory.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// zenoh.
    #[error(transparent)]
    Outlet(#[from] OutletError),
}

impl From<PortError> for RelayError {
    fn from(error: PortError) -> Self {
        Self::Session(error.into())
    }
}

impl From<RelayError> for Failure {
    fn from(error: RelayError) -> Self {
        match error {
            RelayError::Session(error) => error.into(),
            RelayError::Outlet(error) => error.into(),
        }
    }
}

/// A fan-out at work: a relay for each environment of the run, all behind one endpoint.
pub struct Relays {
    zenoh: zenoh::Session,
    /// By environment.
    relays: Vec<Relay>,
    patience: Patience,
}

impl Relays {
    /// Opens everything; `session` is of environment 0.
    ///
    /// # Errors
    /// A service of the run is not there, or the endpoint cannot be listened on.
    pub fn open(session: Session) -> Result<Self, RelayError> {
        let zenoh = endpoint::listen(&session.run.config.fanout)?;
        let patience = Patience::new(Channel::World.queue_length(&session.run));
        let others: Vec<Session> = (1..session.run.config.run.envs)
            .map(|env_index| session.in_environment(env_index))
            .collect::<Result<_, _>>()?;
        let relays = std::iter::once(session)
            .chain(others)
            .zip(0..)
            .map(|(session, env_index)| Relay::open(session, env_index, &zenoh))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            zenoh,
            relays,
            patience,
        })
    }

    /// Works until the last tick of every environment is out, or the process is asked to stop.
    ///
    /// # Errors
    /// A port or zenoh broke.
    pub fn run(mut self) -> Result<(), RelayError> {
        for relay in &mut self.relays {
            relay.begin()?;
        }
        let mut came = 0;
        while let Some(relay) = self.relays.iter().find(|relay| !relay.has_left)
            && !relay.session.stopped()
        {
            relay.session.wait(self.patience.next(came))?;
            came = 0;
            for relay in self.relays.iter_mut().filter(|relay| !relay.has_left) {
                came = relay.turn()?.max(came);
            }
        }
        for relay in self.relays.iter_mut().filter(|relay| !relay.has_left) {
            relay.leave()?;
        }
        let outlets = self.relays.into_iter().map(|relay| relay.outlet).collect();
        outlet::close(outlets, &self.zenoh);
        Ok(())
    }
}

/// What shows one environment.
struct Relay {
    session: Session,
    env_index: u32,
    feeds: Vec<Stream>,
    facts: Facts,
    scans: Option<Scans>,
    boards: Vec<(Process, BoardReader)>,
    /// The trainer's in environment 0, where it tells how learning goes.
    learning: BoardReader,
    outlet: Outlet,
    commands: Commands,
    started: Instant,
    run_age_s: f64,
    counters: Counters,
    newest: MessageHeader,
    rate: Rate,
    road_users: RoadUsers,
    sensors: Delivering,
    errors_m: Errors,
    apart_since: Option<Duration>,
    ended_at: Option<Duration>,
    /// Everything is out; questions are still answered.
    has_left: bool,
    status_budget: Budget,
}

/// A channel with a message for each tick, and how often it goes out.
struct Stream {
    topic: Topic,
    feed: Feed,
    budget: Budget,
}

impl Relay {
    fn open(mut session: Session, env_index: u32, zenoh: &zenoh::Session) -> Result<Self, RelayError> {
        let run = &session.run;
        let settings = run.config.fanout.clone();
        let keys = Keys::new(&run.name, env_index);
        let outlet = Outlet::open(zenoh.clone(), &keys, &status::map(run, env_index))?;
        let commands = Commands::open(zenoh, keys.control(), env_index, run.control_socket())?;
        let rates_hz = [settings.world_hz, settings.observation_hz, settings.prediction_hz];
        let feeds = CHANNELS
            .into_iter()
            .zip(rates_hz)
            .map(|((channel, topic), rate_hz)| {
                let (feed, budget) = (Feed::open(&mut session, channel)?, Budget::new(rate_hz));
                Ok(Stream { topic, feed, budget })
            })
            .collect::<Result<_, SessionError>>()?;
        let boards = Process::ALL
            .into_iter()
            .map(|process| Ok((process, session.board_of(process)?)))
            .collect::<Result<_, SessionError>>()?;
        Ok(Self {
            facts: Facts::open(&mut session)?,
            scans: Scans::open(&mut session)?,
            run_age_s: status::age_s(session.run.supervisor_pid),
            learning: session.board_in(0, Process::Trainer)?,
            session,
            env_index,
            feeds,
            boards,
            outlet,
            commands,
            started: Instant::now(),
            counters: Counters::default(),
            newest: MessageHeader::default(),
            rate: Rate::default(),
            road_users: RoadUsers::default(),
            sensors: Delivering::default(),
            errors_m: Errors::default(),
            apart_since: None,
            ended_at: None,
            has_left: false,
            status_budget: Budget::new(settings.status_hz),
        })
    }

    fn begin(&mut self) -> Result<(), RelayError> {
        let endpoint = &self.session.run.config.fanout.listen;
        tracing::info!(%endpoint, env = self.env_index, "viewers may attach");
        self.session.attach();
        Ok(self.outlet.announce()?)
    }

    /// Shows what is due, and leaves after the last tick; returns the most messages that waited in a queue.
    fn turn(&mut self) -> Result<usize, RelayError> {
        let came = self.look()?;
        let now = self.started.elapsed();
        self.publish_if_due(now)?;
        self.facts.relay(now, &mut self.outlet, &mut self.counters)?;
        if let Some(scans) = &mut self.scans {
            scans.relay(now, self.facts.directory(), &self.outlet, &mut self.counters)?;
        }
        if self.status_budget.allows(now) {
            self.status_budget.spend(0);
            self.tell(State::Running, now)?;
        }
        if self.finished(now) {
            self.leave()?;
        }
        Ok(came)
    }

    /// Empties the queues; returns the most messages that one of them held.
    fn look(&mut self) -> Result<usize, PortError> {
        let changes = self.facts.look(&mut self.counters)?;
        self.feeds
            .iter_mut()
            .try_fold(changes, |most, stream| Ok(stream.feed.drain()?.max(most)))
    }

    fn publish_if_due(&mut self, now: Duration) -> Result<(), RelayError> {
        let mut due = false;
        for stream in &mut self.feeds {
            due |= stream.budget.allows(now);
        }
        if !due {
            return Ok(());
        }
        let ticks = match self.common_tick() {
            Some(tick) => vec![Some(tick); self.feeds.len()],
            None if self.apart_too_long(now) => self.newest_ticks(),
            None => return Ok(()),
        };
        self.apart_since = None;
        self.publish_set(now, &ticks)
    }

    /// The newest tick that every channel in use holds.
    fn common_tick(&self) -> Option<u64> {
        let in_use = self.feeds().filter(|feed| feed.tally().ticks > 0);
        let ticks: Vec<Vec<u64>> = in_use.map(|feed| feed.fresh_ticks().collect()).collect();
        newest_common(&ticks)
    }

    fn newest_ticks(&self) -> Vec<Option<u64>> {
        self.feeds().map(|feed| feed.fresh_ticks().next()).collect()
    }

    /// True if there is something to publish that has waited too long for its counterparts.
    fn apart_too_long(&mut self, now: Duration) -> bool {
        if self.newest_ticks().iter().all(Option::is_none) {
            self.apart_since = None;
            return false;
        }
        now.saturating_sub(*self.apart_since.get_or_insert(now)) > MEETING_LIMIT
    }

    fn feeds(&self) -> impl Iterator<Item = &Feed> {
        self.feeds.iter().map(|stream| &stream.feed)
    }

    /// Publishes a tick of each channel that is due, if there is one.
    fn publish_set(&mut self, now: Duration, ticks: &[Option<u64>]) -> Result<(), RelayError> {
        self.measure(ticks);
        let mut longest = 0;
        let mut out = Vec::new();
        for (stream, tick) in self.feeds.iter_mut().zip(ticks) {
            let Some(tick) = *tick else { continue };
            let Some(message) = stream.feed.fresh(tick) else {
                continue;
            };
            let header = *message.header();
            let is_due = stream.budget.allows(now);
            let framed = is_due.then(|| frame::encode(stream.feed.channel(), &header, message.payload()));
            stream.feed.release(tick);
            if header.tick >= self.newest.tick {
                self.newest = header;
            }
            match framed {
                Some(Ok(frame)) => {
                    longest = longest.max(frame.bytes.len());
                    out.push((stream.topic, frame));
                }
                Some(Err(error)) => self.counters.refuse(stream.topic.name(), &error),
                None => {}
            }
        }
        let mut slowed = false;
        for stream in &mut self.feeds {
            if out.iter().any(|(topic, _)| *topic == stream.topic) {
                slowed |= stream.budget.spend(longest);
            }
        }
        self.counters.slowed_sets += u64::from(slowed);
        for (topic, frame) in out {
            self.counters.frames += 1;
            *self.counters.left_out(topic) += frame.left_out as u64;
            self.outlet.publish(topic, frame.bytes)?;
        }
        Ok(())
    }

    /// Reads off the ticks that are about to go out what the status tells of them.
    fn measure(&mut self, ticks: &[Option<u64>]) {
        let message = |place: usize| {
            let message = self.feeds.get(place)?.feed.fresh((*ticks.get(place)?)?)?;
            Some((message.header(), message.payload()))
        };
        if let Some(road_users) = message(0).and_then(|(header, payload)| RoadUsers::of(header, payload)) {
            self.road_users = road_users;
        }
        if let Some(observed) = message(1).and_then(|(header, payload)| Observed::of(header, payload)) {
            let positions = !self.session.run.config.drives();
            let prediction = message(2).filter(|_| positions);
            self.sensors = observed.delivering();
            self.errors_m = observed.errors(prediction);
        }
    }

    /// Publishes the state of the run and puts this process's own on its board.
    fn tell(&mut self, state: State, now: Duration) -> Result<(), RelayError> {
        let ticks = self.feeds().map(|feed| feed.tally().ticks).max().unwrap_or(0);
        let missed = self.feeds().map(|feed| feed.tally().missed).sum();
        self.rate.note(now, ticks);
        self.counters.missed_ticks = missed;
        self.counters.refused_samples = self.outlet.foreign_samples() + access::forged_samples();
        self.counters.refused_commands = self.commands.refused();
        self.counters.refused_connections = access::tell_refusals();
        let newest = self.newest;
        self.session.report(|health| {
            health.state = if ticks > 0 { state as u32 } else { health.state };
            health.ticks = ticks;
            health.episode = newest.episode;
            health.sim_time_ns = newest.sim_time_ns;
            health.drops = missed;
        });
        let json = serde_json::to_vec(&self.status(now)).unwrap_or_default();
        Ok(self.outlet.publish(Topic::Status, json)?)
    }

    fn status(&self, now: Duration) -> Status {
        let scans = self.scans.as_ref().map_or(0, Scans::refused);
        let refused: u64 = self.feeds().map(Feed::refused).sum::<u64>() + scans + self.facts.refused();
        let health: Vec<_> = self
            .boards
            .iter()
            .map(|(process, board)| (*process, board.health()))
            .collect();
        let sumo = health.first().map_or(0, |(_, health)| health.ticks);
        let run = &self.session.run;
        let tick_s = run.config.run.tick_s;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a tick is longer than a nanosecond"
        )]
        let tick_ns = (tick_s * 1e9).round().max(1.0) as u64;
        Status {
            schema_version: run.schema_version,
            run: run.name.clone(),
            run_id: status::run_id(run),
            env: self.env_index,
            mode: run.mode,
            tick: self.newest.tick,
            episode: self.newest.episode,
            step: (self.newest.sim_time_ns / tick_ns).saturating_sub(1),
            sim_time_ns: self.newest.sim_time_ns,
            evaluation: self.newest.has(EVALUATION),
            run_age_s: self.run_age_s + now.as_secs_f64(),
            ticks_per_s: self.rate.per_s(),
            real_time_factor: self.rate.per_s() * tick_s,
            road_users: self.road_users,
            sensors: self.sensors,
            errors_m: self.errors_m,
            processes: health
                .iter()
                .map(|(process, health)| ProcessStatus::of(*process, health, sumo))
                .collect(),
            training: run.mode.has_trainer().then(|| self.learning.training().into()),
            fanout: Counters {
                refused_messages: self.counters.refused_messages + refused,
                ..self.counters.clone()
            },
        }
    }

    /// True once the last tick of the run has come through all channels in use, or had the time to.
    fn finished(&mut self, now: Duration) -> bool {
        if !self.run_ended() {
            return false;
        }
        let ended_at = *self.ended_at.get_or_insert(now);
        now.saturating_sub(ended_at) > LINGER || self.all_published()
    }

    /// True if the last channel of the run has had its last tick; its producer says so too, should that tick be missed.
    fn run_ended(&self) -> bool {
        let last = match self.session.run.mode.has_trainer() {
            true => Channel::Observation,
            false => Channel::World,
        };
        let came = self.feeds().any(|feed| feed.channel() == last && feed.tally().ended);
        let done = |(process, board): &(Process, BoardReader)| {
            *process == last.producer() && board.health().state == State::Done as u32
        };
        came || self.boards.iter().any(done)
    }

    fn all_published(&self) -> bool {
        let mut in_use = self.feeds().filter(|feed| feed.tally().ticks > 0);
        let newest = self.feeds().map(|feed| feed.tally().ticks).max();
        in_use.all(|feed| Some(feed.tally().ticks) == newest && feed.fresh_ticks().next().is_none())
    }

    /// Publishes what is left, whatever the rate.
    fn leave(&mut self) -> Result<(), RelayError> {
        self.look()?;
        let now = self.started.elapsed();
        let ticks = match self.common_tick() {
            Some(tick) => vec![Some(tick); self.feeds.len()],
            None => self.newest_ticks(),
        };
        self.feeds.iter_mut().for_each(|stream| stream.budget.refill());
        self.publish_set(now, &ticks)?;
        self.tell(State::Done, now)?;
        self.session.report(|health| health.state = State::Done as u32);
        tracing::info!(env = self.env_index, counters = ?self.counters, "done");
        self.has_left = true;
        Ok(())
    }
}
