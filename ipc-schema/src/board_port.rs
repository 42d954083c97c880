//! Writing and reading boards: one board for each incarnation of a process, and the roster that says which incarnation counts.

use std::cell::RefCell;

use iceoryx2::port::{reader, writer};

use crate::{
    activity::Activity,
    board::{Health, Progress, Roster, TrainingStatus},
    ports::{PortError, refused},
    process::Process,
    run::RunFile,
    services::{
        self, ACTIVITY_KEY, BoardSeries, BoardService, HEALTH_KEY, PROGRESS_KEY, ROSTER_KEY, RunNode, ServiceError,
        ServiceHolder, Shm, TRAINING_KEY,
    },
    storage::retry_on_full_disk,
};

/// The writing end of the board of one incarnation of a process.
pub struct BoardWriter {
    progress: writer::EntryHandleMut<Shm, u32, Progress>,
    health: writer::EntryHandleMut<Shm, u32, Health>,
    training: writer::EntryHandleMut<Shm, u32, TrainingStatus>,
    activity: writer::EntryHandleMut<Shm, u32, Activity>,
    /// Held as long as its entries: iceoryx2 forgets a killed port by a tag that goes with this, and without it never.
    _port: writer::Writer<Shm, u32>,
}

impl BoardWriter {
    pub(crate) fn create(service: &BoardService) -> Result<Self, PortError> {
        let writer = retry_on_full_disk(|| service.writer_builder().create())
            .map_err(|e| refused("board", "creation of the writer")(&e))?;
        Ok(Self {
            progress: writer
                .entry(&PROGRESS_KEY)
                .map_err(|e| refused("board", "opening of progress")(&e))?,
            health: writer
                .entry(&HEALTH_KEY)
                .map_err(|e| refused("board", "opening of health")(&e))?,
            training: writer
                .entry(&TRAINING_KEY)
                .map_err(|e| refused("board", "opening of the training status")(&e))?,
            activity: writer
                .entry(&ACTIVITY_KEY)
                .map_err(|e| refused("board", "opening of the activity")(&e))?,
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

    /// Replaces the activity.
    pub fn set_activity(&self, value: Activity) {
        self.activity.update_with_copy(value);
    }
}

/// The board of one incarnation.
struct OpenedBoard {
    incarnation: u32,
    progress: reader::EntryHandle<Shm, u32, Progress>,
    health: reader::EntryHandle<Shm, u32, Health>,
    training: reader::EntryHandle<Shm, u32, TrainingStatus>,
    activity: reader::EntryHandle<Shm, u32, Activity>,
    /// Held as long as its entries, as a writer is.
    _port: reader::Reader<Shm, u32>,
}

impl OpenedBoard {
    fn open(node: &RunNode, series: &BoardSeries, incarnation: u32) -> Result<Self, BoardError> {
        let service = series.open(node, incarnation)?;
        let reader = retry_on_full_disk(|| service.reader_builder().create())
            .map_err(|e| refused("board", "creation of the reader")(&e))?;
        Ok(Self {
            incarnation,
            progress: reader
                .entry(&PROGRESS_KEY)
                .map_err(|e| refused("board", "opening of progress")(&e))?,
            health: reader
                .entry(&HEALTH_KEY)
                .map_err(|e| refused("board", "opening of health")(&e))?,
            training: reader
                .entry(&TRAINING_KEY)
                .map_err(|e| refused("board", "opening of the training status")(&e))?,
            activity: reader
                .entry(&ACTIVITY_KEY)
                .map_err(|e| refused("board", "opening of the activity")(&e))?,
            _port: reader,
        })
    }
}

/// The board of another process: of the incarnation that counts.
pub struct BoardReader {
    process: usize,
    roster: reader::EntryHandle<Shm, u32, Roster>,
    /// Held as long as its entry, as a writer is.
    _roster_port: reader::Reader<Shm, u32>,
    node: RunNode,
    series: BoardSeries,
    board: RefCell<Box<OpenedBoard>>,
}

/// Attempts to open the board of the incarnation that counts: it is removed if the next two incarnations come between reading the
/// roster and opening the board.
const ATTEMPTS: usize = 5;

impl BoardReader {
    /// Reads the board of `process` in environment `env_index`.
    ///
    /// # Errors
    /// The services are not there, or all readers are taken.
    pub fn open(node: &RunNode, run: &RunFile, env_index: u32, process: Process) -> Result<Self, BoardError> {
        let service = services::open_roster(node, run, env_index)?;
        let roster_port = retry_on_full_disk(|| service.reader_builder().create())
            .map_err(|e| refused("roster", "creation of the reader")(&e))?;
        let roster: reader::EntryHandle<Shm, u32, Roster> = roster_port
            .entry(&ROSTER_KEY)
            .map_err(|e| refused("roster", "opening of the incarnations")(&e))?;
        let series = BoardSeries::new(run, env_index, process);
        let open = || OpenedBoard::open(node, &series, roster.get().incarnations[process.index()]);
        let mut board = open();
        for _ in 1..ATTEMPTS {
            board = board.or_else(|_| open());
        }
        Ok(Self {
            process: process.index(),
            roster,
            _roster_port: roster_port,
            node: RunNode::clone(node),
            board: RefCell::new(Box::new(board?)),
            series,
        })
    }

    /// Newest progress.
    #[must_use]
    pub fn progress(&self) -> Progress {
        self.follow_roster();
        *self.board.borrow().progress.get()
    }

    /// Newest health.
    #[must_use]
    pub fn health(&self) -> Health {
        self.follow_roster();
        *self.board.borrow().health.get()
    }

    /// Newest training status.
    #[must_use]
    pub fn training(&self) -> TrainingStatus {
        self.follow_roster();
        *self.board.borrow().training.get()
    }

    /// What the process does at present.
    #[must_use]
    pub fn activity(&self) -> Activity {
        self.follow_roster();
        *self.board.borrow().activity.get()
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

    /// Turns to the board of the incarnation that counts.
    fn follow_roster(&self) {
        let counts = self.roster.get().incarnations[self.process];
        if counts == self.board.borrow().incarnation {
            return;
        }
        match OpenedBoard::open(&self.node, &self.series, counts) {
            Ok(board) => drop(self.board.replace(Box::new(board))),
            // The old board still shows a process that does nothing. The next reading tries again.
            Err(error) => tracing::debug!(%error, "cannot read the board of incarnation {counts}"),
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
        let port = retry_on_full_disk(|| services.roster().writer_builder().create())
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

    /// From now on `incarnation` of `process` counts, whose board exists ([`ServiceHolder::add_board`]) and is empty until it has joined.
    pub fn set(&mut self, process: Process, incarnation: u32) {
        self.roster.incarnations[process.index()] = incarnation;
        self.entry.update_with_copy(self.roster);
    }

    /// Says whether a hand-over of `process` is under way.
    pub fn set_handing_over(&mut self, process: Process, under_way: bool) {
        self.roster.handing_over[process.index()] = u32::from(under_way);
        self.entry.update_with_copy(self.roster);
    }
}

#[cfg(test)]
#[path = "../tests/common/mod.rs"]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod common;

#[cfg(test)]
mod tests {
    use super::*;

    /// Incarnations of the test: far more than have places on any board.
    const MANY: u32 = 1_200;

    /// Files of the run in shared memory.
    fn shared_files(run: &RunFile) -> Vec<std::path::PathBuf> {
        let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
        let is_its_own = |path: &std::path::PathBuf| {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            name.starts_with(&run.shared_memory.prefix)
        };
        files.map(|entry| entry.path()).filter(is_its_own).collect()
    }

    #[test]
    fn more_than_a_thousand_incarnations_have_a_board_each_and_leave_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let run = common::run_in(directory.path(), "boards", common::town());
        let node = services::node(&run.shared_memory).unwrap();
        let mut holder = ServiceHolder::create(&node, &run, 0).unwrap();
        let mut roster = RosterWriter::create(&holder).unwrap();
        let reader = BoardReader::open(&node, &run, 0, Process::Trainer).unwrap();
        let series = BoardSeries::new(&run, 0, Process::Trainer);
        let mut files = 0;
        for incarnation in 0..MANY {
            if incarnation > 0 {
                holder.add_board(&node, &run, Process::Trainer, incarnation).unwrap();
                roster.set(Process::Trainer, incarnation);
            }
            assert_eq!(reader.progress(), Progress::default(), "empty until it has joined");
            let writer = BoardWriter::create(&series.open(&node, incarnation).unwrap()).unwrap();
            let written = Progress {
                consumed_ticks: u64::from(incarnation) + 7,
                incarnation,
                ..Progress::default()
            };
            writer.set_progress(written);
            assert_eq!(reader.progress(), written);
            drop(writer);
            if incarnation == 10 {
                files = shared_files(&run).len();
            }
        }
        assert_eq!(
            shared_files(&run).len(),
            files,
            "boards of earlier incarnations are gone"
        );
        // A reader that comes late finds the board of the incarnation that counts.
        let late = BoardReader::open(&node, &run, 0, Process::Trainer).unwrap();
        assert_eq!(late.progress().incarnation, MANY - 1);
        drop((late, reader, roster, holder, node));
        for file in shared_files(&run) {
            std::fs::remove_file(file).unwrap();
        }
    }
}
