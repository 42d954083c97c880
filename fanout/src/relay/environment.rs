//! One environment of a run: empties its queues, publishes what is due, and publishes the rest when the run ends.

use std::time::{Duration, Instant};

use ipc_schema::{board::State, membership::RunMembership, ports::PortError, run::RunFile, services::Channel};

use crate::{
    error::FanoutError,
    network::{access, commands::CommandGateway, keys::RunKeys, keys::Topic, publisher::EnvironmentPublisher},
    relay::{
        learning::LearningCourse, mounted::MountedTopics, reporter::StatusReporter, slow::SlowTopics, ticks::TickTopics,
    },
    status::{self, FanoutCounters},
};

/// How long the last tick may take to arrive on all channels.
const LAST_TICK_LIMIT: Duration = Duration::from_millis(500);

/// Publishes one environment.
pub struct EnvironmentRelay {
    membership: RunMembership,
    started: Instant,
    ticks: TickTopics,
    slow: SlowTopics,
    mounted: MountedTopics,
    reporter: StatusReporter,
    learning: LearningCourse,
    publisher: EnvironmentPublisher,
    commands: CommandGateway,
    counters: FanoutCounters,
    /// When the last channel of the run ended, since `started`.
    ended_at: Option<Duration>,
    /// Everything is published; queries are still answered.
    is_finished: bool,
}

impl EnvironmentRelay {
    /// Opens the channels and declares the keys of environment `env_index`; `first_run` is the run of environment 0, whose directory
    /// has the course of training.
    ///
    /// # Errors
    /// A service of the run is missing, or zenoh refuses.
    pub fn open(
        mut membership: RunMembership,
        env_index: u32,
        zenoh: &zenoh::Session,
        first_run: &RunFile,
    ) -> Result<Self, FanoutError> {
        let run = &membership.run;
        let keys = RunKeys::new(&run.name, env_index);
        let publisher = EnvironmentPublisher::open(zenoh.clone(), &keys, &status::map_json(run, env_index)?)?;
        let commands = CommandGateway::open(zenoh, keys.control(), env_index, run.control_socket())?;
        Ok(Self {
            ticks: TickTopics::open(&mut membership)?,
            slow: SlowTopics::open(&mut membership)?,
            mounted: MountedTopics::open(&membership, &publisher)?,
            reporter: StatusReporter::open(&membership, env_index)?,
            learning: LearningCourse::new(first_run),
            membership,
            started: Instant::now(),
            publisher,
            commands,
            counters: FanoutCounters::default(),
            ended_at: None,
            is_finished: false,
        })
    }

    /// Attaches to the run and declares the liveliness token.
    ///
    /// # Errors
    /// zenoh refuses.
    pub fn announce(&mut self) -> Result<(), FanoutError> {
        let endpoint = &self.membership.run.config.fanout.listen;
        tracing::info!(%endpoint, env = self.reporter.env_index(), "viewers may attach");
        self.membership.attach();
        Ok(self.publisher.announce()?)
    }

    /// Publishes what is due, and finishes after the last tick; returns the length of the fullest queue, messages.
    ///
    /// # Errors
    /// A port or zenoh broke.
    pub fn publish_due(&mut self) -> Result<usize, FanoutError> {
        let most_queued = self.drain_queues()?;
        let now = self.started.elapsed();
        self.ticks.publish_due(now, &mut self.publisher, &mut self.counters)?;
        self.slow.publish_due(now, &mut self.publisher, &mut self.counters)?;
        self.mounted.publish_due(
            now,
            &mut self.membership,
            self.slow.directory(),
            &self.publisher,
            &mut self.counters,
        )?;
        if self.reporter.is_due(now) {
            self.publish_status(State::Running, now)?;
        }
        if self.last_tick_is_out(now) {
            self.finish()?;
        }
        Ok(most_queued)
    }

    /// Empties the queues; returns the length of the fullest one, messages.
    fn drain_queues(&mut self) -> Result<usize, PortError> {
        let changes = self.slow.drain_queues(&mut self.counters)?;
        Ok(self.ticks.drain_queues()?.max(changes))
    }

    /// Publishes the state of the run, and writes the fan-out's own health onto its board.
    fn publish_status(&mut self, state: State, now: Duration) -> Result<(), FanoutError> {
        let (ticks, missed) = (self.ticks.ticks(), self.ticks.missed());
        self.counters.missed_ticks = missed;
        self.counters.refused_samples = self.publisher.foreign_samples() + access::forged_samples();
        self.counters.refused_commands = self.commands.refused();
        self.counters.refused_connections = access::log_refusals();
        let newest = *self.ticks.newest();
        self.membership.report(|health| {
            health.state = if ticks > 0 { state as u32 } else { health.state };
            health.ticks = ticks;
            health.episode = newest.episode;
            health.sim_time_ns = newest.sim_time_ns;
            health.drops = missed;
        });
        let refused = self.ticks.refused() + self.mounted.refused() + self.slow.refused();
        let counters = FanoutCounters {
            refused_messages: self.counters.refused_messages + refused,
            ..self.counters.clone()
        };
        let status = self.reporter.status(&self.membership.run, now, &self.ticks, counters);
        let json = serde_json::to_vec(&status)?;
        self.publisher.publish(Topic::Status, json)?;
        if let Some((newest, whole)) = self.learning.read_new() {
            self.publisher
                .publish_part(Topic::Learning, newest.into(), Some(whole.into()))?;
        }
        Ok(())
    }

    /// True once the last tick of the run has been published, or [`LAST_TICK_LIMIT`] has passed since it was produced.
    fn last_tick_is_out(&mut self, now: Duration) -> bool {
        if !self.run_has_ended() {
            return false;
        }
        let ended_at = *self.ended_at.get_or_insert(now);
        now.saturating_sub(ended_at) > LAST_TICK_LIMIT || self.ticks.all_published()
    }

    /// True if the last tick arrived on the last channel of the run. Its producer's board says so too, in case the fan-out missed that
    /// tick.
    fn run_has_ended(&self) -> bool {
        let last = match self.membership.run.mode.has_trainer() {
            true => Channel::Observation,
            false => Channel::World,
        };
        self.ticks.has_ended(last) || self.reporter.is_done(last.producer())
    }

    /// Publishes what is left, whatever the rate, and the final status.
    ///
    /// # Errors
    /// A port or zenoh broke.
    pub fn finish(&mut self) -> Result<(), FanoutError> {
        self.drain_queues()?;
        let now = self.started.elapsed();
        self.ticks.publish_rest(now, &mut self.publisher, &mut self.counters)?;
        self.publish_status(State::Done, now)?;
        self.membership.report(|health| health.state = State::Done as u32);
        tracing::info!(env = self.reporter.env_index(), counters = ?self.counters, "done");
        self.is_finished = true;
        Ok(())
    }

    /// True once everything is published.
    #[must_use]
    pub fn is_finished(&self) -> bool {
        self.is_finished
    }

    /// True once the process has received a signal to stop.
    #[must_use]
    pub fn stop_requested(&self) -> bool {
        self.membership.stopped()
    }

    /// Waits for a wake-up, at most `timeout`.
    ///
    /// # Errors
    /// The wake-up is broken.
    pub fn wait(&self, timeout: Duration) -> Result<(), FanoutError> {
        Ok(self.membership.wait(timeout)?)
    }

    /// The publisher alone, which still answers queries.
    #[must_use]
    pub fn into_publisher(self) -> EnvironmentPublisher {
        self.publisher
    }
}
