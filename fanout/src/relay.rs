//! The loop: look at shared memory, publish the newest of what belongs together, report, leave with the run.

use std::time::{Duration, Instant};

use ipc_schema::{
    board::State,
    failure::Failure,
    header::{EVALUATION, MessageHeader},
    ports::{BoardReader, PortError},
    process::Process,
    run::Mode,
    services::Channel,
    session::{Session, SessionError},
};

use crate::{
    feed::{Feed, newest_common},
    frame,
    keys::{Keys, Topic},
    outlet::{Outlet, OutletError},
    pace::{Budget, Patience},
    status::{Counters, Map, ProcessStatus, Status},
};

/// Time between two states of the run.
const STATUS_INTERVAL: Duration = Duration::from_millis(500);
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

/// A fan-out at work.
pub struct Relay {
    session: Session,
    feeds: Vec<(Topic, Feed)>,
    boards: Vec<(Process, BoardReader)>,
    outlet: Outlet,
    budget: Budget,
    patience: Patience,
    started: Instant,
    counters: Counters,
    newest: MessageHeader,
    apart_since: Option<Duration>,
    ended_at: Option<Duration>,
    next_status: Duration,
}

impl Relay {
    /// Opens everything.
    ///
    /// # Errors
    /// A service of the run is not there, or the endpoint cannot be listened on.
    pub fn open(mut session: Session, env_index: u32) -> Result<Self, RelayError> {
        let run = &session.run;
        let map = serde_json::to_string(&Map::of(run)).unwrap_or_default();
        let outlet = Outlet::open(&run.config.fanout.listen, &Keys::new(&run.name, env_index), &map)?;
        let queue_length = Channel::World.queue_length(run);
        let budget = Budget::new(run.config.fanout.rate_hz);
        let feeds = CHANNELS
            .into_iter()
            .map(|(channel, topic)| Ok((topic, Feed::open(&mut session, channel)?)))
            .collect::<Result<_, SessionError>>()?;
        let boards = Process::ALL
            .into_iter()
            .map(|process| Ok((process, session.board_of(process)?)))
            .collect::<Result<_, SessionError>>()?;
        Ok(Self {
            session,
            feeds,
            boards,
            outlet,
            budget,
            patience: Patience::new(queue_length),
            started: Instant::now(),
            counters: Counters::default(),
            newest: MessageHeader::default(),
            apart_since: None,
            ended_at: None,
            next_status: Duration::ZERO,
        })
    }

    /// Works until the last tick of the run is out, or the process is asked to stop.
    ///
    /// # Errors
    /// A port or zenoh broke.
    pub fn run(mut self) -> Result<(), RelayError> {
        tracing::info!(endpoint = %self.session.run.config.fanout.listen, "viewers may attach");
        self.session.attach();
        while !self.session.stopped() {
            let came = self.look()?;
            let now = self.started.elapsed();
            self.publish_if_due(now)?;
            self.tell_if_due(now)?;
            if self.finished(now) {
                break;
            }
            self.rest(came)?;
        }
        self.leave()
    }

    /// Leaves shared memory alone for a while.
    fn rest(&mut self, came: usize) -> Result<(), SessionError> {
        self.session.wait(self.patience.next(came))
    }

    /// Empties the queues; returns the most messages that one of them held.
    fn look(&mut self) -> Result<usize, PortError> {
        self.feeds
            .iter_mut()
            .try_fold(0, |most, (_, feed)| Ok(feed.drain()?.max(most)))
    }

    fn publish_if_due(&mut self, now: Duration) -> Result<(), RelayError> {
        if !self.budget.allows(now) {
            return Ok(());
        }
        let ticks = match self.common_tick() {
            Some(tick) => vec![Some(tick); self.feeds.len()],
            None if self.apart_too_long(now) => self.newest_ticks(),
            None => return Ok(()),
        };
        self.apart_since = None;
        self.publish_set(&ticks)
    }

    /// The newest tick that every channel in use holds.
    fn common_tick(&self) -> Option<u64> {
        let in_use = self.feeds.iter().filter(|(_, feed)| feed.tally().ticks > 0);
        let ticks: Vec<Vec<u64>> = in_use.map(|(_, feed)| feed.fresh_ticks().collect()).collect();
        newest_common(&ticks)
    }

    fn newest_ticks(&self) -> Vec<Option<u64>> {
        self.feeds.iter().map(|(_, feed)| feed.fresh_ticks().next()).collect()
    }

    /// True if there is something to publish that has waited too long for its counterparts.
    fn apart_too_long(&mut self, now: Duration) -> bool {
        if self.newest_ticks().iter().all(Option::is_none) {
            self.apart_since = None;
            return false;
        }
        now.saturating_sub(*self.apart_since.get_or_insert(now)) > MEETING_LIMIT
    }

    /// Publishes a tick of each channel, if there is one.
    fn publish_set(&mut self, ticks: &[Option<u64>]) -> Result<(), RelayError> {
        let mut longest = 0;
        for ((topic, feed), tick) in self.feeds.iter_mut().zip(ticks) {
            let Some(tick) = *tick else { continue };
            let Some(message) = feed.fresh(tick) else { continue };
            let header = *message.header();
            let framed = frame::encode(feed.channel(), &header, message.payload());
            feed.release(tick);
            if header.tick >= self.newest.tick {
                self.newest = header;
            }
            match framed {
                Ok(frame) => {
                    longest = longest.max(frame.bytes.len());
                    self.counters.frames += 1;
                    self.counters.thinned_rows += frame.thinned_rows as u64;
                    self.outlet.publish(*topic, frame.bytes)?;
                }
                Err(error) => count_refusal(&mut self.counters, *topic, &error),
            }
        }
        if self.budget.spend(longest) {
            self.counters.slowed_sets += 1;
        }
        Ok(())
    }

    fn tell_if_due(&mut self, now: Duration) -> Result<(), RelayError> {
        if now < self.next_status {
            return Ok(());
        }
        self.next_status = now + STATUS_INTERVAL;
        self.tell(State::Running)
    }

    /// Publishes the state of the run and puts this process's own on its board.
    fn tell(&mut self, state: State) -> Result<(), RelayError> {
        let ticks = self.feeds.iter().map(|(_, feed)| feed.tally().ticks).max().unwrap_or(0);
        let missed = self.feeds.iter().map(|(_, feed)| feed.tally().missed).sum();
        self.counters.missed_ticks = missed;
        let newest = self.newest;
        self.session.report(|health| {
            health.state = if ticks > 0 { state as u32 } else { health.state };
            health.ticks = ticks;
            health.episode = newest.episode;
            health.sim_time_ns = newest.sim_time_ns;
            health.drops = missed;
        });
        let json = serde_json::to_vec(&self.status()).unwrap_or_default();
        Ok(self.outlet.publish(Topic::Status, json)?)
    }

    fn status(&self) -> Status {
        let refused: u64 = self.feeds.iter().map(|(_, feed)| feed.refused()).sum();
        let trainer = self.boards.iter().find(|(process, _)| *process == Process::Trainer);
        Status {
            tick: self.newest.tick,
            episode: self.newest.episode,
            sim_time_ns: self.newest.sim_time_ns,
            evaluation: self.newest.has(EVALUATION),
            processes: self
                .boards
                .iter()
                .map(|(process, board)| ProcessStatus::of(*process, &board.health()))
                .collect(),
            training: trainer
                .filter(|_| self.session.run.mode == Mode::Train)
                .map(|(_, board)| board.training().into()),
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
        let last = match self.session.run.mode {
            Mode::Train => Channel::Observation,
            Mode::Simulate => Channel::World,
        };
        let came = self.feeds.iter().any(|(_, f)| f.channel() == last && f.tally().ended);
        let done = |(process, board): &(Process, BoardReader)| {
            *process == last.producer() && board.health().state == State::Done as u32
        };
        came || self.boards.iter().any(done)
    }

    fn all_published(&self) -> bool {
        let mut in_use = self.feeds.iter().map(|(_, feed)| feed).filter(|f| f.tally().ticks > 0);
        let newest = self.feeds.iter().map(|(_, feed)| feed.tally().ticks).max();
        in_use.all(|feed| Some(feed.tally().ticks) == newest && feed.fresh_ticks().next().is_none())
    }

    /// Publishes what is left, whatever the rate, and closes.
    fn leave(mut self) -> Result<(), RelayError> {
        self.look()?;
        let ticks = match self.common_tick() {
            Some(tick) => vec![Some(tick); self.feeds.len()],
            None => self.newest_ticks(),
        };
        self.publish_set(&ticks)?;
        self.tell(State::Done)?;
        self.session.report(|health| health.state = State::Done as u32);
        tracing::info!(counters = ?self.counters, "done");
        self.outlet.close();
        Ok(())
    }
}

fn count_refusal(counters: &mut Counters, topic: Topic, error: &frame::FrameError) {
    let counter = match error {
        frame::FrameError::Block(_) => &mut counters.refused_messages,
        frame::FrameError::TooLong(_) => &mut counters.oversize_frames,
    };
    *counter += 1;
    if *counter == 1 {
        tracing::warn!(topic = topic.name(), %error, "not published; later ones are only counted");
    }
}
