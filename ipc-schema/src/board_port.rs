//! Writing and reading boards: one set of entries for each incarnation of a process, and the roster that says which one counts.

use std::cell::{Cell, RefCell};

use iceoryx2::{
    node::Node,
    port::{reader, writer},
};

use crate::{
    board::{Health, INCARNATIONS, Progress, Roster, TrainingStatus},
    ports::{PortError, refused},
    process::Process,
    run::RunFile,
    services::{
        self, BoardService, ROSTER_KEY, ServiceError, ServiceHolder, Shm, health_key, progress_key, training_key,
    },
};

/// The writing end of the board of one incarnation of a process.
pub struct BoardWriter {
    progress: writer::EntryHandleMut<Shm, u32, Progress>,
    health: writer::EntryHandleMut<Shm, u32, Health>,
    training: writer::EntryHandleMut<Shm, u32, TrainingStatus>,
    /// Held as long as its entries: iceoryx2 forgets a killed port by a tag that goes with this, and without it never.
    _port: writer::Writer<Shm, u32>,
}

impl BoardWriter {
    pub(crate) fn create(service: &BoardService, incarnation: u32) -> Result<Self, PortError> {
        let writer = service
            .writer_builder()
            .create()
            .map_err(|e| refused("board", "creation of the writer")(&e))?;
        Ok(Self {
            progress: writer
                .entry(&progress_key(incarnation))
                .map_err(|e| refused("board", "opening of progress")(&e))?,
            health: writer
                .entry(&health_key(incarnation))
                .map_err(|e| refused("board", "opening of health")(&e))?,
            training: writer
                .entry(&training_key(incarnation))
                .map_err(|e| refused("board", "opening of the training status")(&e))?,
            _port: writer,
        })
    }

    /// Replaces the progress.
    pub fn set_progress(&self, value: Progress) {
        self.progress.update_with_copy(value);
    }

    /// Replaces the health.
    pub fn set_health(&self, value: Health) {
        self.health.update_with_copy(value);
    }

    /// Replaces the training status.
    pub fn set_training(&self, value: TrainingStatus) {
        self.training.update_with_copy(value);
    }
}

/// The entries of one incarnation.
struct Entries {
    progress: reader::EntryHandle<Shm, u32, Progress>,
    health: reader::EntryHandle<Shm, u32, Health>,
    training: reader::EntryHandle<Shm, u32, TrainingStatus>,
}

impl Entries {
    fn open(reader: &reader::Reader<Shm, u32>, incarnation: u32) -> Result<Self, PortError> {
        Ok(Self {
            progress: reader
                .entry(&progress_key(incarnation))
                .map_err(|e| refused("board", "opening of progress")(&e))?,
            health: reader
                .entry(&health_key(incarnation))
                .map_err(|e| refused("board", "opening of health")(&e))?,
            training: reader
                .entry(&training_key(incarnation))
                .map_err(|e| refused("board", "opening of the training status")(&e))?,
        })
    }
}

/// The board of another process: of the incarnation that counts.
pub struct BoardReader {
    process: usize,
    roster: reader::EntryHandle<Shm, u32, Roster>,
    /// Held as long as its entry, as a writer is.
    _roster_port: reader::Reader<Shm, u32>,
    reader: reader::Reader<Shm, u32>,
    incarnation: Cell<u32>,
    entries: RefCell<Entries>,
}

impl BoardReader {
    /// Reads the board of `process` in environment `env_index`.
    ///
    /// # Errors
    /// The services are not there, or all readers are taken.
    pub fn open(node: &Node<Shm>, run: &RunFile, env_index: u32, process: Process) -> Result<Self, BoardError> {
        let roster_port = services::open_roster(node, run, env_index)?
            .reader_builder()
            .create()
            .map_err(|e| refused("roster", "creation of the reader")(&e))?;
        let roster = roster_port
            .entry(&ROSTER_KEY)
            .map_err(|e| refused("roster", "opening of the incarnations")(&e))?;
        let reader = services::open_board(node, run, env_index, process)?
            .reader_builder()
            .create()
            .map_err(|e| refused("board", "creation of the reader")(&e))?;
        let entries = RefCell::new(Entries::open(&reader, 0)?);
        Ok(Self {
            process: process.index(),
            roster,
            _roster_port: roster_port,
            reader,
            incarnation: Cell::new(0),
            entries,
        })
    }

    /// Newest progress.
    #[must_use]
    pub fn progress(&self) -> Progress {
        self.follow_roster();
        *self.entries.borrow().progress.get()
    }

    /// Newest health.
    #[must_use]
    pub fn health(&self) -> Health {
        self.follow_roster();
        *self.entries.borrow().health.get()
    }

    /// Newest training status.
    #[must_use]
    pub fn training(&self) -> TrainingStatus {
        self.follow_roster();
        *self.entries.borrow().training.get()
    }

    /// The incarnation of the process that counts.
    #[must_use]
    pub fn current_incarnation(&self) -> u32 {
        self.roster.get().incarnations[self.process]
    }

    /// True while a successor that is ready waits for the incarnation that counts to leave, or opens its ports.
    #[must_use]
    pub fn is_handing_over(&self) -> bool {
        self.roster.get().handing_over[self.process] != 0
    }

    /// Turns to the entries of the incarnation that counts.
    fn follow_roster(&self) {
        let counts = self.roster.get().incarnations[self.process];
        if counts == self.incarnation.get() {
            return;
        }
        match Entries::open(&self.reader, counts) {
            Ok(entries) => {
                self.entries.replace(entries);
                self.incarnation.set(counts);
            }
            // The old entries go on to show a process that does nothing.
            Err(error) => tracing::error!(%error, "cannot read the board of incarnation {counts}"),
        }
    }
}

/// A board cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum BoardError {
    /// It cannot be opened.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// No reader can be created.
    #[error(transparent)]
    Port(#[from] PortError),
}

/// The roster, for the supervisor to write.
pub struct RosterWriter {
    entry: writer::EntryHandleMut<Shm, u32, Roster>,
    _port: writer::Writer<Shm, u32>,
    roster: Roster,
}

impl RosterWriter {
    /// The writing end of the roster.
    ///
    /// # Errors
    /// The roster has a writer already.
    pub fn create(services: &ServiceHolder) -> Result<Self, PortError> {
        let port = services
            .roster()
            .writer_builder()
            .create()
            .map_err(|e| refused("roster", "creation of the writer")(&e))?;
        let entry = port
            .entry(&ROSTER_KEY)
            .map_err(|e| refused("roster", "opening of the incarnations")(&e))?;
        Ok(Self {
            entry,
            _port: port,
            roster: Roster::default(),
        })
    }

    /// From now on `incarnation` of `process` counts, whose board is empty until it has joined. False if there are no more.
    #[must_use]
    pub fn set(&mut self, process: Process, incarnation: u32) -> bool {
        if incarnation >= INCARNATIONS {
            return false;
        }
        self.roster.incarnations[process.index()] = incarnation;
        self.entry.update_with_copy(self.roster);
        true
    }

    /// Says whether a hand-over of `process` is under way.
    pub fn set_handing_over(&mut self, process: Process, under_way: bool) {
        self.roster.handing_over[process.index()] = u32::from(under_way);
        self.entry.update_with_copy(self.roster);
    }
}
