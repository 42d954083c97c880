//! Publishes one message a tick to all required consumers of a channel: to the trainer through its journal, to the others at once.

use std::time::Instant;

use ipc_schema::{
    activity::Awaited,
    failure::Failure,
    header::MessageHeader,
    membership::{RequiredConsumers, RunMembership, Wait},
    ports::{Draft, Message, Publisher, Subscriber},
    process::Process,
    services::Channel,
};
use serde::Serialize;

use super::{Delivery, handover::HandoverFigures};

/// What a process reports of its deliveries to the trainer.
#[derive(Debug, Clone, Default, Serialize)]
pub struct DeliveryFigures {
    /// Messages that watchers missed.
    pub drops: u64,
    /// Ticks that were sent again to a successor of the trainer.
    pub redelivered_ticks: u64,
    /// Largest size of the journal so far, MiB.
    pub journal_mib: usize,
    /// Planned handovers from one trainer to its successor.
    pub handovers: Vec<HandoverFigures>,
}

/// The sending end of a channel with one message for each tick. While its process waits, it resends what a successor of the trainer
/// lacks.
pub struct TickPublisher {
    publisher: Publisher,
    /// `None` in a run without a trainer.
    trainer: Option<Delivery>,
    /// The other required consumers. They receive every tick at least once.
    others: RequiredConsumers,
    /// Ticks below this are in the checkpoint: they are made again but not sent.
    committed_ticks: u64,
    /// The oldest tick of the journal, as the board has it.
    journal_first: u64,
    /// The board has the oldest tick of this journal.
    is_on_board: bool,
}

impl TickPublisher {
    /// Opens `channel` and the boards of its required consumers.
    ///
    /// # Errors
    /// A service cannot be opened.
    pub fn open(membership: &RunMembership, channel: Channel) -> Result<Self, Failure> {
        let trainer = match membership.run.mode.has_trainer() {
            true => Some(Delivery::open(membership, channel)?),
            false => None,
        };
        let required = channel.required(&membership.run);
        let others: Vec<Process> = required.filter(|process| *process != Process::Trainer).collect();
        Ok(Self {
            publisher: membership.publisher(channel)?,
            trainer,
            others: membership.consumers(others, channel)?,
            committed_ticks: membership.run.committed_ticks(),
            journal_first: 0,
            is_on_board: true,
        })
    }

    /// Opens a further channel of a process that has one already: the process's board has the journal of that one.
    ///
    /// # Errors
    /// As [`TickPublisher::open`].
    pub fn open_further(membership: &RunMembership, channel: Channel) -> Result<Self, Failure> {
        Ok(Self {
            is_on_board: false,
            ..Self::open(membership, channel)?
        })
    }

    /// The port: for loans.
    #[must_use]
    pub fn port(&self) -> &Publisher {
        &self.publisher
    }

    /// `header`, addressed to the incarnation of the trainer that receives it.
    #[must_use]
    pub fn addressed(&self, header: MessageHeader) -> MessageHeader {
        match &self.trainer {
            Some(trainer) => trainer.addressed(header),
            None => header,
        }
    }

    /// The next message of `input`; meanwhile a successor of the trainer receives what it lacks. `None` once the process is asked to stop.
    ///
    /// # Errors
    /// A port is broken, or a successor asks for a tick that the journal does not hold.
    pub fn next(&mut self, membership: &mut RunMembership, input: &Subscriber) -> Result<Option<Message>, Failure> {
        let producer = Awaited::Input(input.channel().producer());
        let mut received = Ok(None);
        loop {
            let waited = membership.wait_until_for(producer, || {
                received = input.receive();
                !matches!(received, Ok(None)) || self.is_trainer_behind()
            })?;
            if let Some(message) = std::mem::replace(&mut received, Ok(None))? {
                return Ok(Some(message));
            }
            if waited == Wait::Stopped {
                return Ok(None);
            }
            self.catch_up(membership)?;
        }
    }

    /// Waits until `condition` holds; meanwhile a successor of the trainer receives what it lacks.
    ///
    /// # Errors
    /// As [`TickPublisher::next`].
    pub fn wait_until(
        &mut self,
        membership: &mut RunMembership,
        condition: impl Fn(&Self) -> bool,
    ) -> Result<Wait, Failure> {
        loop {
            self.catch_up(membership)?;
            let waited = membership.wait_until_for(Awaited::Credit(Process::Trainer), || {
                self.is_trainer_behind() || condition(self)
            })?;
            if waited == Wait::Stopped || condition(self) {
                return Ok(waited);
            }
        }
    }

    /// Waits until a message of `len` bytes for `tick` may be published: it may be sent to the trainer or kept for it in the journal,
    /// and every other required consumer has credit. A tick of the checkpoint is not sent, and waits for nothing.
    ///
    /// # Errors
    /// As [`TickPublisher::next`].
    pub fn wait_for_credit(&mut self, membership: &mut RunMembership, tick: u64, len: usize) -> Result<Wait, Failure> {
        if tick < self.committed_ticks {
            return Ok(Wait::Ready);
        }
        let since = Instant::now();
        let waited = self.wait_until(membership, |port| port.takes(tick, len))?;
        self.waited_since(since);
        Ok(waited)
    }

    /// True if a message of `len` bytes for `tick` may be published, as [`TickPublisher::wait_for_credit`] waits for.
    #[must_use]
    pub fn takes(&self, tick: u64, len: usize) -> bool {
        tick < self.committed_ticks || self.trainer_takes(len) && self.others.have_credit(tick)
    }

    /// Notes a wait for credit that is over, for the figures of handovers.
    pub fn waited_since(&mut self, since: Instant) {
        if let Some(trainer) = &mut self.trainer {
            trainer.update_handover(since);
        }
    }

    /// True once the trainer is done and the others have consumed all ticks below `ticks`.
    #[must_use]
    pub fn has_ended(&self, ticks: u64) -> bool {
        self.trainer.as_ref().is_none_or(Delivery::is_done) && self.others.have_consumed(ticks)
    }

    /// Keeps the message for the trainer, and sends it. If the trainer has no credit for it, the journal sends it later. A tick of the
    /// checkpoint is not sent.
    ///
    /// # Errors
    /// The journal's file cannot be written, or the port is broken.
    pub fn publish(&mut self, header: &MessageHeader, draft: Draft) -> Result<(), Failure> {
        if self.keep(header, draft.payload())? {
            draft.send()?;
            self.others.sent(header.tick);
        } else {
            self.others.wake();
        }
        if let Some(trainer) = &self.trainer {
            trainer.wake();
        }
        Ok(())
    }

    /// Waits until the trainer is done and the others have consumed all ticks below `ticks`, and `condition` holds. Until then the
    /// trainer may die, and its successor needs everything since the last commit.
    ///
    /// # Errors
    /// As [`TickPublisher::next`].
    pub fn wait_for_consumers_end(
        &mut self,
        membership: &mut RunMembership,
        ticks: u64,
        condition: impl Fn() -> bool,
    ) -> Result<Wait, Failure> {
        self.wait_until(membership, |port| port.has_ended(ticks) && condition())
    }

    /// True if a trainer receives the channel.
    #[must_use]
    pub fn has_trainer(&self) -> bool {
        self.trainer.is_some()
    }

    /// Figures so far.
    #[must_use]
    pub fn figures(&self) -> DeliveryFigures {
        let trainer = self.trainer.as_ref();
        DeliveryFigures {
            drops: self.publisher.drops(),
            redelivered_ticks: trainer.map_or(0, Delivery::redelivered),
            journal_mib: trainer.map_or(0, Delivery::journal_mib),
            handovers: trainer.map(Delivery::handovers).unwrap_or_default(),
        }
    }

    /// True if a successor of the trainer lacks ticks that it may have: [`TickPublisher::catch_up`] sends them.
    #[must_use]
    pub fn is_trainer_behind(&self) -> bool {
        let trainer = self.trainer.as_ref();
        trainer.is_some_and(|trainer| trainer.is_behind(&self.others))
    }

    /// Sends a successor of the trainer what it lacks and may have.
    ///
    /// # Errors
    /// As [`TickPublisher::next`].
    pub fn catch_up(&mut self, membership: &mut RunMembership) -> Result<(), Failure> {
        let Some(trainer) = &mut self.trainer else {
            return Ok(());
        };
        trainer.catch_up(&self.publisher, &self.others)?;
        let journal_first = trainer.journal_first();
        if self.is_on_board && journal_first != self.journal_first {
            // The board has the number of ticks that the journal does not hold any more: a trainer reads there whether it can continue.
            membership.committed(journal_first);
            self.journal_first = journal_first;
        }
        Ok(())
    }

    /// True if the next tick, `len` bytes long, may be sent to the trainer or kept for it. True in a run without a trainer.
    fn trainer_takes(&self, len: usize) -> bool {
        let trainer = self.trainer.as_ref();
        trainer.is_none_or(|trainer| trainer.may_send() || trainer.may_keep(len))
    }

    /// Keeps the tick in the journal. Returns false if it is not to be sent now.
    fn keep(&mut self, header: &MessageHeader, payload: &[u8]) -> Result<bool, Failure> {
        if header.tick < self.committed_ticks {
            return Ok(false);
        }
        let Some(trainer) = &mut self.trainer else {
            return Ok(true);
        };
        let is_due = trainer.may_send();
        trainer.keep(*header, payload)?;
        if is_due {
            trainer.count_live();
        }
        Ok(is_due)
    }
}
