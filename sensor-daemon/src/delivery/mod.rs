//! Sends the messages of a channel to the trainer, tick by tick, as far as it has credit: live ticks, and ticks of the journal to a
//! successor.
//! During a planned handover live ticks may stay in the journal, so that the simulation continues.

use std::time::Instant;

use ipc_schema::{
    board::{Progress, State},
    failure::{Failure, FailureKind},
    flow,
    header::MessageHeader,
    membership::{self, MembershipError, RequiredConsumers, RunMembership},
    ports::{BoardReader, Publisher, Waker},
    process::Process,
    services::Channel,
};

pub mod handover;
pub mod journal;
pub mod tick_publisher;

use handover::{HandoverFigures, RunningHandover};
use journal::{Journal, JournalError};

const MIB: usize = 1 << 20;

/// Delivery to the trainer, a required consumer of a channel with one message for each tick.
pub struct Delivery {
    board: BoardReader,
    waker: Waker,
    journal: Journal,
    /// Ticks under way while ticks are sent again.
    window: u64,
    /// Ticks under way otherwise.
    live_window: u64,
    own_incarnation: u32,
    /// Ticks that an earlier incarnation of this process has made.
    sensed_before: u64,
    /// The incarnation that receives observations; `None` before the first trainer is attached.
    incarnation: Option<u32>,
    /// The next tick to send to it.
    next: u64,
    /// One more than the newest tick that any incarnation has been sent.
    sent: u64,
    redelivered: u64,
    /// The planned handover under way, during which the simulation continues without credit.
    handover: Option<RunningHandover>,
    handovers: Vec<HandoverFigures>,
    /// False in the driving task: the world waits for every action, so no tick can be made in advance.
    makes_ahead: bool,
}

impl Delivery {
    /// Opens the trainer's board and wake-up, with an empty journal of `channel`.
    ///
    /// # Errors
    /// The trainer's board or wake-up cannot be opened.
    pub fn open(membership: &RunMembership, channel: Channel) -> Result<Self, MembershipError> {
        let run = &membership.run;
        let limit = run.config.run.journal_mib as usize * MIB;
        let (longest, committed) = (channel.max_payload(run), run.committed_ticks());
        let journal = Journal::new(&run.run_dir, limit, longest).beginning_at(committed);
        Ok(Self {
            board: membership.board_of(Process::Trainer)?,
            waker: membership.waker(Process::Trainer)?,
            journal,
            // Strict lock-step has one tick under way at a time, also when ticks are sent again.
            window: if run.config.drives() { 1 } else { run.window_ticks() },
            live_window: run.window_ticks(),
            own_incarnation: membership::incarnation(),
            sensed_before: run.restart.map_or(0, |restart| restart.sensed_ticks),
            incarnation: None,
            next: committed,
            sent: committed,
            redelivered: 0,
            handover: None,
            handovers: Vec::new(),
            makes_ahead: !run.config.drives(),
        })
    }

    /// True if ticks can be sent again, for which all of `others` have credit, or a new incarnation has attached.
    #[must_use]
    pub fn is_behind(&self, others: &RequiredConsumers) -> bool {
        let progress = self.board.progress();
        progress.attached == 1
            && !self.is_trainer_ahead(&progress)
            && (self.incarnation != Some(progress.incarnation)
                || self.next < self.journal.ticks()
                    && flow::has_credit(self.next, &progress, self.window)
                    && others.have_credit(self.next))
    }

    /// True if the trainer has received more ticks than have been made, or still reads what an earlier incarnation of this process has
    /// sent: the simulator processes were started again, and what the trainer has is made again and not sent.
    fn is_trainer_ahead(&self, progress: &Progress) -> bool {
        progress.attached == 1 && (!self.has_turned(progress) || progress.received_ticks > self.journal.ticks())
    }

    /// True if the trainer has read all that earlier incarnations of this process have sent.
    fn has_turned(&self, progress: &Progress) -> bool {
        progress.sender_incarnation == self.own_incarnation
    }

    /// True if the trainer has received all earlier ticks and has credit for the live one.
    #[must_use]
    pub fn may_send(&self) -> bool {
        let progress = self.board.progress();
        self.incarnation == Some(progress.incarnation)
            && self.next == self.journal.ticks()
            && flow::has_credit(self.next, &progress, self.live_window)
    }

    /// True if the live tick may be made and kept until the trainer has credit for it: the trainer has it already, or a planned handover
    /// is under way and the journal has room for `len` bytes without giving up an older tick.
    #[must_use]
    pub fn may_keep(&self, len: usize) -> bool {
        let progress = self.board.progress();
        if self.is_trainer_ahead(&progress) {
            let ticks = self.journal.ticks();
            // While the trainer still reads the old queue, what it has is unknown, but not more than was sensed.
            return ticks < self.sensed_before || self.has_turned(&progress) && ticks < progress.received_ticks;
        }
        self.makes_ahead
            && self.journal.has_room(len)
            && match &self.handover {
                // The successor itself is replaced before it has caught up.
                Some(before) if before.has_successor() && self.board.is_handing_over() => true,
                Some(handover) => handover.allows(&self.board.progress(), self.journal.ticks()),
                None => self.board.is_handing_over(),
            }
    }

    /// Updates the state of a planned handover; the simulation has waited for a trainer since `since`.
    pub fn update_handover(&mut self, since: Instant) {
        let under_way = self.makes_ahead && self.board.is_handing_over();
        if self.handover.is_none() && !under_way {
            return;
        }
        let (now, made, progress) = (Instant::now(), self.journal.ticks(), self.board.progress());
        // The next handover may begin while a successor still catches up.
        if under_way && let Some(before) = self.handover.take_if(|before| before.has_successor()) {
            self.handovers.push(before.figures(progress.incarnation));
        }
        let handover = self
            .handover
            .get_or_insert_with(|| RunningHandover::begin(now, progress.incarnation));
        handover.add_wait(since, now);
        handover.update(&progress, under_way, made);
        let is_level = self.incarnation == Some(progress.incarnation) && self.next == made;
        if handover.is_over(is_level) {
            self.handovers.push(handover.figures(progress.incarnation));
            self.handover = None;
        }
    }

    /// Planned handovers so far, including one whose successor still catches up.
    #[must_use]
    pub fn handovers(&self) -> Vec<HandoverFigures> {
        let newest = self.handover.as_ref().filter(|newest| newest.has_successor());
        let newest = newest.map(|newest| newest.figures(self.board.progress().incarnation));
        self.handovers.iter().copied().chain(newest).collect()
    }

    /// True once the trainer has finished the run.
    #[must_use]
    pub fn is_done(&self) -> bool {
        State::from_u32(self.board.health().state) == State::Done
    }

    /// Reads the trainer's commits and incarnation from the board, and resends what a successor lacks and has credit for. A tick that was
    /// kept during a handover is new for `others`, which need credit too.
    ///
    /// # Errors
    /// A successor asks for a tick that the journal does not hold, or the port fails.
    pub fn catch_up(&mut self, observations: &Publisher, others: &RequiredConsumers) -> Result<(), Failure> {
        loop {
            let progress = self.board.progress();
            self.follow_incarnation(&progress)
                .map_err(|error| journal_failure(&error))?;
            others.turn_to(self.incarnation.unwrap_or(0));
            if self.is_trainer_ahead(&progress)
                || self.next >= self.journal.ticks()
                || !flow::has_credit(self.next, &progress, self.window)
                || !others.have_credit(self.next)
            {
                return Ok(());
            }
            let tick = self.next;
            self.resend(observations)?;
            others.sent(tick);
        }
    }

    /// Frees what is committed; starts at the first tick that a new incarnation has not consumed.
    fn follow_incarnation(&mut self, progress: &Progress) -> Result<(), JournalError> {
        if progress.attached == 0 || self.is_trainer_ahead(progress) {
            return Ok(());
        }
        if self.incarnation != Some(progress.incarnation) {
            // A trainer that has received more than it has committed is not new: this process is.
            if progress.received_ticks == progress.committed_ticks {
                self.journal.restart(progress.received_ticks)?;
            }
            if progress.incarnation > 0 {
                tracing::info!(
                    "trainer {} continues at tick {} of {}",
                    progress.incarnation,
                    progress.received_ticks,
                    self.journal.ticks()
                );
            }
            self.next = progress.received_ticks;
            self.incarnation = Some(progress.incarnation);
        }
        self.journal.commit(progress.committed_ticks);
        Ok(())
    }

    fn resend(&mut self, observations: &Publisher) -> Result<(), Failure> {
        if let Some((header, len)) = self.journal.find(self.next) {
            let mut draft = observations.loan_unwritten(self.addressed(header), len)?;
            self.journal
                .read(self.next, draft.payload_mut())
                .map_err(|error| journal_failure(&error))?;
            draft.send()?;
            self.waker.wake();
            self.redelivered += u64::from(self.next < self.sent);
        }
        self.next += 1;
        self.sent = self.sent.max(self.next);
        Ok(())
    }

    /// `header`, addressed to the incarnation of the trainer that receives it.
    #[must_use]
    pub fn addressed(&self, header: MessageHeader) -> MessageHeader {
        MessageHeader {
            addressee: self.incarnation.unwrap_or(0),
            ..header
        }
    }

    /// Adds a live tick to the journal.
    ///
    /// # Errors
    /// The journal's file cannot be written.
    pub fn keep(&mut self, header: MessageHeader, payload: &[u8]) -> Result<(), Failure> {
        self.journal
            .push(header, payload)
            .map_err(|error| journal_failure(&error))?;
        if let Some(handover) = &mut self.handover {
            handover.count_tick(&self.board.progress());
        }
        Ok(())
    }

    /// Counts the live tick that was kept last as sent.
    pub fn count_live(&mut self) {
        self.next += 1;
        self.sent = self.sent.max(self.next);
    }

    /// Wakes the trainer after a tick has been sent.
    pub fn wake(&self) {
        self.waker.wake();
    }

    /// Ticks sent again so far.
    #[must_use]
    pub fn redelivered(&self) -> u64 {
        self.redelivered
    }

    /// The oldest tick that a trainer can continue at.
    #[must_use]
    pub fn journal_first(&self) -> u64 {
        self.journal.first()
    }

    /// Largest size of the journal so far, MiB.
    #[must_use]
    pub fn journal_mib(&self) -> usize {
        self.journal.most_bytes().div_ceil(MIB)
    }
}

fn journal_failure(error: &JournalError) -> Failure {
    let failure = Failure::from_error(FailureKind::Run, error);
    match error {
        JournalError::Io { .. } => failure.with_help("free space in the run directory, or lower `run.journal_mib`"),
        JournalError::Gone { .. } | JournalError::Future { .. } => failure,
    }
}
