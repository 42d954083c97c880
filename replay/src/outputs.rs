//! The channels that a trainer receives tick by tick, which one process sends here: in a run each has a process of its own.

use std::{cmp::Ordering, collections::VecDeque, time::Instant};

use ipc_schema::{
    activity::Awaited,
    channel::Channel,
    failure::Failure,
    header::MessageHeader,
    membership::{RunMembership, Wait},
    process::Process,
};
use sensor_daemon::delivery::tick_publisher::TickPublisher;

/// A message of a tick.
#[derive(Debug, Clone)]
pub struct TickMessage {
    /// Its header in this run.
    pub header: MessageHeader,
    /// Its payload.
    pub payload: Vec<u8>,
}

/// The publishers of both channels.
///
/// A trainer takes both messages of a tick together. In the recorded run one channel may have been a window of ticks ahead of the other;
/// here they are sent in pairs, or one would wait for credit that the trainer cannot give without the other. While the process waits, a
/// successor of the trainer receives what it lacks of both.
pub struct TickOutputs {
    /// `observation`.
    pub observations: TickPublisher,
    /// `neighbours`, in a run with messages between road users.
    neighbours: Option<TickPublisher>,
    /// Messages of each channel that wait for those of the same tick of the other.
    waiting: [VecDeque<TickMessage>; 2],
}

impl TickOutputs {
    /// Opens the channels that the run has.
    ///
    /// # Errors
    /// A service cannot be opened.
    pub fn open(membership: &RunMembership) -> Result<Self, Failure> {
        let has_messages = membership.run.config.v2x.is_on();
        let neighbours = has_messages.then(|| TickPublisher::open_further(membership, Channel::Neighbours));
        Ok(Self {
            observations: TickPublisher::open(membership, Channel::Observation)?,
            neighbours: neighbours.transpose()?,
            waiting: Default::default(),
        })
    }

    /// True if messages are sent in pairs: a trainer takes both of a tick.
    #[must_use]
    pub fn are_paired(&self) -> bool {
        self.neighbours.is_some() && self.observations.has_trainer()
    }

    /// Keeps a message of `channel` until that of the same tick of the other is there.
    pub fn keep(&mut self, channel: Channel, message: TickMessage) {
        self.waiting[usize::from(channel == Channel::Neighbours)].push_back(message);
    }

    /// The messages of the first tick that both channels have. What one of them begins with alone is left out.
    pub fn next_pair(&mut self) -> Option<[TickMessage; 2]> {
        let [observations, neighbours] = &mut self.waiting;
        loop {
            let [one, other] = [observations.front()?.header.tick, neighbours.front()?.header.tick];
            match one.cmp(&other) {
                Ordering::Less => drop(observations.pop_front()),
                Ordering::Greater => drop(neighbours.pop_front()),
                Ordering::Equal => return Some([observations.pop_front()?, neighbours.pop_front()?]),
            }
        }
    }

    /// Sends a message of `channel` once it may be sent or kept. One of `neighbours` is left out where the run has no messages.
    ///
    /// # Errors
    /// A port or the journal is broken.
    pub fn send(
        &mut self,
        membership: &mut RunMembership,
        channel: Channel,
        header: &MessageHeader,
        payload: &[u8],
    ) -> Result<Wait, Failure> {
        let since = Instant::now();
        let waited = self.wait_until(membership, |outputs| match (channel, &outputs.neighbours) {
            (Channel::Neighbours, None) => true,
            (Channel::Neighbours, Some(neighbours)) => neighbours.takes(header.tick, payload.len()),
            _ => outputs.observations.takes(header.tick, payload.len()),
        })?;
        let output = match (channel, &mut self.neighbours) {
            (Channel::Neighbours, None) => return Ok(waited),
            (Channel::Neighbours, Some(neighbours)) => neighbours,
            _ => &mut self.observations,
        };
        output.waited_since(since);
        if waited == Wait::Stopped {
            return Ok(Wait::Stopped);
        }
        let header = output.addressed(*header);
        let mut draft = output.port().loan_unwritten(header, payload.len())?;
        draft.payload_mut().copy_from_slice(payload);
        output.publish(&header, draft)?;
        Ok(Wait::Ready)
    }

    /// Waits until the trainer is done and the others have consumed all ticks below `ticks`.
    ///
    /// # Errors
    /// As [`TickOutputs::send`].
    pub fn wait_for_consumers_end(&mut self, membership: &mut RunMembership, ticks: u64) -> Result<Wait, Failure> {
        self.wait_until(membership, |outputs| {
            outputs.all().all(|output| output.has_ended(ticks))
        })
    }

    fn all(&self) -> impl Iterator<Item = &TickPublisher> {
        std::iter::once(&self.observations).chain(&self.neighbours)
    }

    /// Waits until `condition` holds; meanwhile a successor of the trainer receives what it lacks.
    fn wait_until(
        &mut self,
        membership: &mut RunMembership,
        condition: impl Fn(&Self) -> bool,
    ) -> Result<Wait, Failure> {
        loop {
            self.observations.catch_up(membership)?;
            if let Some(neighbours) = &mut self.neighbours {
                neighbours.catch_up(membership)?;
            }
            let waited = membership.wait_until_for(Awaited::Credit(Process::Trainer), || {
                self.all().any(TickPublisher::is_trainer_behind) || condition(self)
            })?;
            if waited == Wait::Stopped || condition(self) {
                return Ok(waited);
            }
        }
    }
}
