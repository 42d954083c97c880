//! One environment of a run in the supervisor: its directory, its services and its boards.

use std::{path::PathBuf, time::Duration};

use ipc_schema::{
    activity::Awaited,
    board::State,
    episode_state,
    ports::{BoardReader, RosterWriter, Waker},
    process::Process,
    run::{RestartPoint, RunFile, Start},
    services::{ControlService, RunNode, ServiceHolder},
};

use crate::{failure::Exit, preparation_mark, resume};

/// The processes that simulate an environment, those of them that a run has.
pub const SIMULATORS: [Process; 4] = [
    Process::TrafficBridge,
    Process::SimCore,
    Process::SensorDaemon,
    Process::V2x,
];

/// Age of a note below which the process that made it waits still: it notes every look.
const FRESH_S: f64 = 1.0;

/// The episode that a stored state belongs to.
#[derive(Debug, Default, serde::Deserialize)]
struct EpisodePlace {
    episode: u64,
    resets: u64,
}

/// An environment. Its services live as long as this does.
pub struct Environment {
    /// The run file of this environment's processes.
    pub run: RunFile,
    /// Path of that file.
    pub run_file: PathBuf,
    /// Publishes the valid incarnation of each process.
    roster: RosterWriter,
    /// Largest number of ticks that a trainer has committed, or that were sensed in a run without one.
    committed_ticks: u64,
    /// Largest number of ticks that any incarnation of `sensor-daemon` has made.
    sensed_ticks: u64,
    boards: Vec<BoardReader>,
    /// Wakes `sensor-daemon`, which then reads the state of a handover.
    sensing: Waker,
    services: ServiceHolder,
}

impl Environment {
    /// Creates the directory, run file and services of environment `env_index`. `run` is the run file of environment 0.
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
        preparation_mark::remove_mark(&run.run_dir).map_err(|error| Exit::io("write", &run.run_dir, &error))?;
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
            committed_ticks: 0,
            sensed_ticks: 0,
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

    /// The board of a process. The trainer has a board in each environment.
    #[must_use]
    pub fn board(&self, process: Process) -> &BoardReader {
        &self.boards[process.index()]
    }

    /// Remembers how far the learning has come: a trainer's death empties its board.
    pub fn note_progress(&mut self) {
        self.sensed_ticks = self.sensed_ticks.max(self.board(Process::SensorDaemon).health().ticks);
        let ticks = match self.run.mode.has_trainer() {
            true => self.board(Process::Trainer).progress().committed_ticks,
            false => self.sensed_ticks,
        };
        self.committed_ticks = self.committed_ticks.max(ticks);
    }

    /// Most ticks that any incarnation of `sensor-daemon` has made.
    #[must_use]
    pub fn sensed_ticks(&self) -> u64 {
        self.sensed_ticks
    }

    /// Prepares the run file and the command log for simulator processes that are started again: they begin with the episode of the
    /// first tick that is not committed. Returns that episode's first tick.
    ///
    /// # Errors
    /// A file cannot be read or written.
    pub fn prepare_restart(&mut self) -> Result<u64, Exit> {
        let run = &self.run;
        let present = SIMULATORS.into_iter().filter(|process| (process.spec().is_wanted)(run));
        let stored: Vec<Vec<u64>> = present
            .map(|process| episode_state::stored_ticks(&run.run_dir, process))
            .collect();
        let in_all = |tick: &&u64| stored.iter().all(|ticks| ticks.contains(tick));
        let begins = stored
            .iter()
            .take(1)
            .flatten()
            .rev()
            .filter(|tick| **tick <= self.committed_ticks)
            .find(in_all);
        let start = match begins {
            None => run
                .beginning
                .as_ref()
                .map(|beginning| beginning.start)
                .unwrap_or_default(),
            Some(tick) => {
                let place: Option<EpisodePlace> = episode_state::load(run, Process::TrafficBridge, *tick)?;
                let EpisodePlace { episode, resets } = place.unwrap_or_default();
                Start {
                    committed_ticks: self.committed_ticks,
                    episode,
                    episode_tick: *tick,
                    resets,
                }
            }
        };
        let start = Start {
            committed_ticks: start.committed_ticks.max(self.committed_ticks),
            resets: resume::repeat_commands(&run.run_dir, &run.run_dir, start.episode_tick, Duration::MAX)?,
            ..start
        };
        self.run.restart = Some(RestartPoint {
            start,
            sensed_ticks: self.sensed_ticks,
        });
        self.run.rewrite()?;
        Ok(start.episode_tick)
    }

    /// Makes this incarnation of a process the valid one. Its board is empty until it has joined.
    ///
    /// # Errors
    /// iceoryx2 refuses.
    pub fn set_incarnation(&mut self, node: &RunNode, process: Process, incarnation: u32) -> Result<(), Exit> {
        self.services.add_board(node, &self.run, process, incarnation)?;
        self.roster.set(process, incarnation);
        Ok(())
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

    /// True while a process gives signs of life and waits for the trainers of other ranks.
    #[must_use]
    pub fn waits_for_ranks(&self, process: Process) -> bool {
        let activity = self.board(process).activity();
        activity.awaited() == Awaited::Ranks && activity.age_s() < FRESH_S
    }

    /// State of a process.
    #[must_use]
    pub fn state_of(&self, process: Process) -> State {
        State::from_u32(self.board(process).health().state)
    }
}
