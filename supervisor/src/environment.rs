//! One environment of a run as the supervisor sees it: its directory, its services, its boards.

use std::path::PathBuf;

use ipc_schema::{
    board::State,
    ports::{BoardReader, RosterWriter, Waker},
    process::Process,
    run::RunFile,
    services::{ControlService, RunNode, ServiceHolder},
};

use crate::failure::Exit;

/// An environment. Its services live as long as this does.
pub struct Environment {
    /// The run as the processes of this environment see it.
    pub run: RunFile,
    /// Where they read it.
    pub run_file: PathBuf,
    /// Which incarnation of each process counts.
    pub roster: RosterWriter,
    boards: Vec<BoardReader>,
    /// Wakes `sensor-daemon`, which then reads the state of a handover.
    sensing: Waker,
    services: ServiceHolder,
}

impl Environment {
    /// Creates directory, run file and services of environment `env_index` of `run`, which is environment 0's.
    ///
    /// # Errors
    /// The run directory is not writable, or iceoryx2 refuses.
    pub fn create(node: &RunNode, run: &RunFile, env_index: u32) -> Result<Self, Exit> {
        let run = run.environment(env_index);
        for part in ["logs", "parts"] {
            let path = run.run_dir.join(part);
            std::fs::create_dir_all(&path).map_err(|error| Exit::io("create", &path, &error))?;
        }
        let run_file = run.write()?;
        let services = ServiceHolder::create(node, &run, env_index)?;
        let boards = Process::ALL
            .into_iter()
            .map(|process| Ok(BoardReader::open(node, &run, env_index, process)?))
            .collect::<Result<_, Exit>>()?;
        let sensing = Waker::open(node, &run, env_index, Process::SensorDaemon)?;
        Ok(Self {
            run,
            run_file,
            roster: RosterWriter::create(&services)?,
            sensing,
            boards,
            services,
        })
    }

    /// The service that takes commands.
    #[must_use]
    pub fn control(&self) -> &ControlService {
        self.services.control()
    }

    /// The board of a process; for the trainer, what it says of this environment.
    #[must_use]
    pub fn board(&self, process: Process) -> &BoardReader {
        &self.boards[process.index()]
    }

    /// Publishes whether a handover is in progress.
    pub fn set_handing_over(&mut self, is_in_progress: bool) {
        self.roster.set_handing_over(Process::Trainer, is_in_progress);
        self.wake_sensing();
    }

    /// Wakes `sensor-daemon`, which then reads the valid incarnation.
    pub fn wake_sensing(&self) {
        self.sensing.wake();
    }

    /// State of a process.
    #[must_use]
    pub fn state_of(&self, process: Process) -> State {
        State::from_u32(self.board(process).health().state)
    }
}
