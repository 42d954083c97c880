//! Observations to the trainer, each tick in order under its credits: live ones, and those of the journal again for a successor.

use ipc_schema::{
    board::{Progress, State},
    failure::{Failure, FailureKind},
    flow,
    header::MessageHeader,
    ports::{BoardReader, Publisher, Waker},
    process::Process,
    services::Channel,
    session::{Session, SessionError},
};

use crate::journal::{Journal, JournalError};

const MIB: usize = 1 << 20;

/// The way to the one consumer that must not miss an observation.
pub struct Delivery {
    board: BoardReader,
    waker: Waker,
    journal: Journal,
    window: u64,
    /// The incarnation that is being served; none before the first is attached.
    incarnation: Option<u32>,
    /// The next tick that it has not been sent.
    next: u64,
    redelivered: u64,
}

impl Delivery {
    /// Nothing sent, nothing kept.
    ///
    /// # Errors
    /// The trainer's board or wake-up cannot be opened.
    pub fn open(session: &Session) -> Result<Self, SessionError> {
        let run = &session.run;
        let limit = run.config.run.journal_mib as usize * MIB;
        let journal = Journal::new(&run.run_dir, limit, Channel::Observation.max_payload(run));
        Ok(Self {
            board: session.board_of(Process::Trainer)?,
            waker: session.waker(Process::Trainer)?,
            journal,
            // Strict lock-step has one tick on the way at a time, and so have its ticks when they are sent again.
            window: if run.config.drives() { 1 } else { run.window_ticks() },
            incarnation: None,
            next: 0,
            redelivered: 0,
        })
    }

    /// True if there is something to send again, or somebody new to turn to.
    #[must_use]
    pub fn is_behind(&self) -> bool {
        let progress = self.board.progress();
        progress.attached == 1
            && (self.incarnation != Some(progress.incarnation)
                || self.next < self.journal.ticks() && flow::has_credit(self.next, &progress, self.window))
    }

    /// True if the live tick that follows all others may be sent now.
    #[must_use]
    pub fn may_send(&self, session: &Session) -> bool {
        let progress = self.board.progress();
        self.incarnation == Some(progress.incarnation)
            && self.next == self.journal.ticks()
            && flow::has_credit(self.next, &progress, session.run.window_ticks())
    }

    /// True once the trainer has done all its work.
    #[must_use]
    pub fn is_done(&self) -> bool {
        State::from_u32(self.board.health().state) == State::Done
    }

    /// Notes what has been committed and who is attached, and sends again what a successor lacks and has credit for.
    ///
    /// # Errors
    /// A successor asks for what is not there, or the port fails.
    pub fn catch_up(&mut self, observations: &Publisher) -> Result<(), Failure> {
        loop {
            let progress = self.board.progress();
            self.turn_to(&progress).map_err(|error| lost(&error))?;
            if self.next >= self.journal.ticks() || !flow::has_credit(self.next, &progress, self.window) {
                return Ok(());
            }
            self.send_again(observations)?;
        }
    }

    fn turn_to(&mut self, progress: &Progress) -> Result<(), JournalError> {
        if progress.attached == 0 {
            return Ok(());
        }
        if self.incarnation != Some(progress.incarnation) {
            self.journal.restart(progress.consumed_ticks)?;
            if progress.incarnation > 0 {
                tracing::info!(
                    "trainer {} continues at tick {} of {}",
                    progress.incarnation,
                    progress.consumed_ticks,
                    self.journal.ticks()
                );
            }
            self.next = progress.consumed_ticks;
            self.incarnation = Some(progress.incarnation);
        }
        self.journal.commit(progress.committed_ticks);
        Ok(())
    }

    fn send_again(&mut self, observations: &Publisher) -> Result<(), Failure> {
        if let Some((header, len)) = self.journal.find(self.next) {
            let mut draft = observations.loan_unwritten(self.addressed(header), len)?;
            self.journal
                .read(self.next, draft.payload_mut())
                .map_err(|error| lost(&error))?;
            draft.send()?;
            self.waker.wake();
            self.redelivered += 1;
        }
        self.next += 1;
        Ok(())
    }

    /// `header` with the incarnation that it is meant for.
    #[must_use]
    pub fn addressed(&self, header: MessageHeader) -> MessageHeader {
        MessageHeader {
            incarnation: self.incarnation.unwrap_or(0),
            ..header
        }
    }

    /// Keeps a live tick, which is about to be sent.
    ///
    /// # Errors
    /// The journal's file cannot be written.
    pub fn keep(&mut self, header: MessageHeader, payload: &[u8]) -> Result<(), Failure> {
        self.journal.push(header, payload).map_err(|error| lost(&error))?;
        self.next += 1;
        Ok(())
    }

    /// Wakes the trainer: a tick has been sent.
    pub fn wake(&self) {
        self.waker.wake();
    }

    /// Ticks sent again so far.
    #[must_use]
    pub fn redelivered(&self) -> u64 {
        self.redelivered
    }

    /// Most of the journal in use at a time, MiB.
    #[must_use]
    pub fn journal_mib(&self) -> usize {
        self.journal.most_bytes().div_ceil(MIB)
    }
}

fn lost(error: &JournalError) -> Failure {
    let failure = Failure::from_error(FailureKind::Run, error);
    match error {
        JournalError::Io { .. } => failure.with_help("free space in the run directory, or lower `run.journal_mib`"),
        JournalError::Gone { .. } | JournalError::Future { .. } => failure,
    }
}
