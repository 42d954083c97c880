//! The main loop: reads shared memory, publishes what is due, reports, and ends with the run.
//!
//! [`environment`] is the loop's body for one environment. Its topics come in three groups: [`ticks`] belong to one tick and
//! are published together, [`slow`] ones change seldom, and those of
//! [`mounted`] sensors are published on demand.

pub mod environment;
pub mod learning;
pub mod mounted;
pub mod pace;
pub mod reporter;
pub mod slow;
pub mod ticks;

use ipc_schema::{membership::RunMembership, services::Channel};

use crate::{
    error::FanoutError,
    network::endpoint::Endpoint,
    relay::{environment::EnvironmentRelay, pace::PollInterval},
};

/// The fan-out of a run: a relay for each environment, all behind one endpoint.
pub struct RunRelay {
    endpoint: Endpoint,
    /// By the number of the environment.
    environments: Vec<EnvironmentRelay>,
    poll_interval: PollInterval,
}

impl RunRelay {
    /// Opens every channel and key; `membership` is of environment 0.
    ///
    /// # Errors
    /// A service of the run is missing, or the endpoint cannot be listened on.
    pub fn open(membership: RunMembership) -> Result<Self, FanoutError> {
        let endpoint = Endpoint::open(&membership.run)?;
        let poll_interval = PollInterval::new(Channel::World.queue_length(&membership.run));
        let first_run = membership.run.clone();
        let others: Vec<RunMembership> = (1..membership.run.config.run.envs)
            .map(|env_index| membership.in_environment(env_index))
            .collect::<Result<_, _>>()?;
        let environments = std::iter::once(membership)
            .chain(others)
            .zip(0..)
            .map(|(membership, env_index)| EnvironmentRelay::open(membership, env_index, &endpoint.session, &first_run))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            endpoint,
            environments,
            poll_interval,
        })
    }

    /// Publishes until the last tick of every environment is out, or the process receives a signal to stop.
    ///
    /// # Errors
    /// A port or zenoh broke.
    pub fn run(mut self) -> Result<(), FanoutError> {
        for environment in &mut self.environments {
            environment.announce()?;
        }
        // The environments share one wake-up: waiting in the first unfinished one serves all.
        let mut most_queued = 0;
        while let Some(environment) = self.environments.iter().find(|environment| !environment.is_finished())
            && !environment.stop_requested()
        {
            environment.wait(self.poll_interval.next(most_queued))?;
            most_queued = 0;
            for environment in self
                .environments
                .iter_mut()
                .filter(|environment| !environment.is_finished())
            {
                most_queued = environment.publish_due()?.max(most_queued);
            }
        }
        // After a signal, every environment still publishes its newest tick.
        for environment in self
            .environments
            .iter_mut()
            .filter(|environment| !environment.is_finished())
        {
            environment.finish()?;
        }
        let publishers = self
            .environments
            .into_iter()
            .map(EnvironmentRelay::into_publisher)
            .collect();
        self.endpoint.close(publishers);
        Ok(())
    }
}
