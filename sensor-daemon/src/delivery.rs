//! Observations to the trainer, each tick in order under its credits: live ones, and those of the journal again for a successor.
//! During a planned hand-over live ones may be kept for later, so that the simulation goes on.

use std::time::Instant;

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

use crate::{
    hand_over::{Account, HandOver},
    journal::{Journal, JournalError},
};

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
    /// One more than the newest tick that anybody has been sent.
    sent: u64,
    redelivered: u64,
    /// A planned hand-over under way, during which the simulation goes on without credit.
    hand_over: Option<HandOver>,
    hand_overs: Vec<Account>,
    /// In the driving task the world waits for every action: nothing can be made in advance.
    goes_on: bool,
}

impl Delivery {
    /// Nothing sent, nothing kept.
    ///
    /// # Errors
    /// The trainer's board or wake-up cannot be opened.
    pub fn open(session: &Session) -> Result<Self, SessionError> {
        let run = &session.run;
        let limit = run.config.run.journal_mib as usize * MIB;
        let (longest, committed) = (Channel::Observation.max_payload(run), run.committed_ticks());
        let journal = Journal::new(&run.run_dir, limit, longest).beginning_at(committed);
        Ok(Self {
            board: session.board_of(Process::Trainer)?,
            waker: session.waker(Process::Trainer)?,
            journal,
            // Strict lock-step has one tick on the way at a time, and so have its ticks when they are sent again.
            window: if run.config.drives() { 1 } else { run.window_ticks() },
            incarnation: None,
            next: committed,
            sent: committed,
            redelivered: 0,
            hand_over: None,
            hand_overs: Vec::new(),
            goes_on: !run.config.drives(),
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

    /// True if the live tick that follows all others may be made and kept, to be sent when there is credit: a planned hand-over is
    /// under way, and the journal has room for `len` bytes beside everything that is not committed.
    #[must_use]
    pub fn may_keep(&self, len: usize) -> bool {
        self.goes_on
            && self.journal.has_room(len)
            && match &self.hand_over {
                // The successor of that one leaves in its turn, before it has caught up.
                Some(before) if before.has_successor() && self.board.is_handing_over() => true,
                Some(hand_over) => hand_over.allows(&self.board.progress(), self.journal.ticks()),
                None => self.board.is_handing_over(),
            }
    }

    /// Looks how a planned hand-over goes; the simulation has waited for a trainer since `since`.
    pub fn attend_hand_over(&mut self, since: Instant) {
        let under_way = self.goes_on && self.board.is_handing_over();
        if self.hand_over.is_none() && !under_way {
            return;
        }
        let (now, made, progress) = (Instant::now(), self.journal.ticks(), self.board.progress());
        // The next one may begin while a successor still catches up.
        if under_way && let Some(before) = self.hand_over.take_if(|before| before.has_successor()) {
            self.hand_overs.push(before.account(progress.incarnation));
        }
        let hand_over = self
            .hand_over
            .get_or_insert_with(|| HandOver::begin(now, progress.incarnation));
        hand_over.waited(since, now);
        hand_over.note(&progress, under_way, made);
        let is_level = self.incarnation == Some(progress.incarnation) && self.next == made;
        if hand_over.is_over(is_level) {
            self.hand_overs.push(hand_over.account(progress.incarnation));
            self.hand_over = None;
        }
    }

    /// Planned hand-overs so far, that of a successor that still catches up included.
    #[must_use]
    pub fn hand_overs(&self) -> Vec<Account> {
        let newest = self.hand_over.as_ref().filter(|newest| newest.has_successor());
        let newest = newest.map(|newest| newest.account(self.board.progress().incarnation));
        self.hand_overs.iter().copied().chain(newest).collect()
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
            self.redelivered += u64::from(self.next < self.sent);
        }
        self.next += 1;
        self.sent = self.sent.max(self.next);
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

    /// Keeps a live tick.
    ///
    /// # Errors
    /// The journal's file cannot be written.
    pub fn keep(&mut self, header: MessageHeader, payload: &[u8]) -> Result<(), Failure> {
        self.journal.push(header, payload).map_err(|error| lost(&error))?;
        if let Some(hand_over) = &mut self.hand_over {
            hand_over.made_one(&self.board.progress());
        }
        Ok(())
    }

    /// The live tick that was kept last is being sent.
    pub fn sends_live(&mut self) {
        self.next += 1;
        self.sent = self.sent.max(self.next);
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
