//! The processes of a run and the environments they belong to: starts those that may start, on their cores, and finds those that ended.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::{ChildStdout, ExitStatus},
};

use ipc_schema::{
    board::State,
    failure::Failure,
    ports::{BoardReader, ControlClient},
    process::{OnExit, PROCESSES, Process, ProcessScope, ProcessSpec},
    run::RunFile,
    services::{self, RunNode},
};
use rustix::process::Signal;

use crate::{cores, environment::Environment, failure::Exit, install::Install, running_process::RunningProcess};

/// A process that has ended.
#[derive(Debug, Clone, Copy)]
pub struct EndedProcess {
    /// Its row.
    pub row: &'static ProcessSpec,
    /// Its exit status.
    pub status: ExitStatus,
    /// True if its board says that its work is done.
    pub is_done: bool,
    /// What its end means in this run.
    pub on_exit: OnExit,
    /// Its environment.
    pub env_index: u32,
}

/// All processes of a run.
pub struct RunProcesses {
    // Dropped in this order: processes, services, node.
    running: Vec<RunningProcess>,
    /// Environment 0 also holds what belongs to the whole run.
    environments: Vec<Environment>,
    node: RunNode,
    cores: Option<cores::CorePlan>,
    install: Install,
    restarts: u32,
    /// Incarnations of processes that are to be started again, by process and environment.
    incarnations: BTreeMap<(Process, u32), u32>,
}

impl RunProcesses {
    /// Creates the channels of every environment of `run`; starts no process.
    ///
    /// # Errors
    /// The run directory is not writable, or iceoryx2 refuses.
    pub fn create(run: &RunFile, install: Install) -> Result<Self, Exit> {
        let node = services::node(&run.shared_memory)?;
        let envs = run.config.run.envs;
        let environments = (0..envs)
            .map(|index| Environment::create(&node, run, index))
            .collect::<Result<_, Exit>>()?;
        Ok(Self {
            running: Vec::new(),
            environments,
            node,
            cores: cores::plan(&cores::available(), envs as usize, run.mode.has_trainer()),
            install,
            restarts: 0,
            incarnations: BTreeMap::new(),
        })
    }

    /// A client for the commands to each environment.
    ///
    /// # Errors
    /// iceoryx2 refuses.
    pub fn control_clients(&self) -> Result<Vec<ControlClient>, Exit> {
        let clients = self.environments.iter();
        clients
            .map(|environment| Ok(ControlClient::create(environment.control())?))
            .collect()
    }

    /// The run file of environment 0 and of the processes of the whole run.
    #[must_use]
    pub fn run(&self) -> &RunFile {
        &self.environments[0].run
    }

    /// All environments.
    #[must_use]
    pub fn environments(&self) -> &[Environment] {
        &self.environments
    }

    /// The board of the trainer.
    #[must_use]
    pub fn trainer(&self) -> &BoardReader {
        self.environments[0].board(Process::Trainer)
    }

    /// State of a process that belongs to the whole run.
    #[must_use]
    pub fn state_of(&self, process: Process) -> State {
        self.environments[0].state_of(process)
    }

    /// Ticks that `process` has committed in all environments.
    #[must_use]
    pub fn committed_ticks(&self, process: Process) -> u64 {
        let boards = self.environments.iter().map(|environment| environment.board(process));
        boards.map(|board| board.progress().committed_ticks).sum()
    }

    /// Restarts of all processes so far.
    #[must_use]
    pub fn restarts(&self) -> u32 {
        self.restarts
    }

    /// Number of started processes, including those that have ended.
    #[must_use]
    pub fn started(&self) -> usize {
        self.running.len()
    }

    /// Index of the process that a successor may replace.
    #[must_use]
    pub fn replaceable(&self) -> Option<usize> {
        let is_replaceable = |process: &RunningProcess| process.row.on_exit == OnExit::Replace;
        self.running.iter().position(is_replaceable)
    }

    /// Every process that the run needs: its row and its environment.
    fn members(&self) -> impl Iterator<Item = (&'static ProcessSpec, &Environment)> {
        self.environments.iter().flat_map(|environment| {
            let run = &environment.run;
            let rows = PROCESSES.iter().filter(|row| row.is_in(run, run.env_index));
            rows.map(move |row| (row, environment))
        })
    }

    fn is_started(&self, row: &ProcessSpec, env_index: u32) -> bool {
        self.running
            .iter()
            .any(|running| running.row.process == row.process && running.env_index == env_index)
    }

    /// True if every process that `row` needs is ready: in all environments for a process of the whole run, else in its own.
    fn may_start(&self, row: &ProcessSpec, environment: &Environment) -> bool {
        let is_up = |environment: &Environment| {
            let mut needs = row.needs.iter();
            needs.all(|need| environment.state_of(*need) != State::Starting)
        };
        match row.scope {
            ProcessScope::Run => self.environments.iter().all(is_up),
            ProcessScope::Environment => is_up(environment),
        }
    }

    /// Starts every process whose needs are ready.
    ///
    /// # Errors
    /// A program is missing or cannot be started.
    pub fn start_due(&mut self) -> Result<(), Exit> {
        let due: Vec<(&'static ProcessSpec, u32)> = self
            .members()
            .filter(|(row, environment)| !self.is_started(row, environment.run.env_index))
            .filter(|(row, environment)| self.may_start(row, environment))
            .map(|(row, environment)| (row, environment.run.env_index))
            .collect();
        for (row, env_index) in due {
            let incarnation = self.incarnations.get(&(row.process, env_index)).copied().unwrap_or(0);
            let started = self.start(row, env_index, incarnation)?;
            self.running.push(started);
        }
        Ok(())
    }

    /// Starts the process of `row` in its environment, on the cores that are planned for it.
    fn start(&self, row: &'static ProcessSpec, env_index: u32, incarnation: u32) -> Result<RunningProcess, Exit> {
        let environment = &self.environments[env_index as usize];
        cores::within(self.cores_of(row, env_index), || {
            RunningProcess::start(row, &self.install, &environment.run, &environment.run_file, incarnation)
        })
    }

    /// Starts a successor beside the working trainer; returns it with its standard output.
    ///
    /// # Errors
    /// There is no trainer, or the program cannot be started.
    pub fn start_successor(
        &self,
        run: &RunFile,
        run_file: &Path,
        checkpoint: Option<&PathBuf>,
    ) -> Result<(RunningProcess, Option<ChildStdout>), Exit> {
        let trainer = self.replaceable().map(|index| &self.running[index]);
        let trainer = trainer.ok_or_else(|| Exit::run("the run has no trainer", ""))?;
        let (row, incarnation) = (trainer.row, trainer.incarnation + 1);
        cores::within(self.cores_of(row, 0), || {
            RunningProcess::start_successor(row, &self.install, run, run_file, incarnation, checkpoint)
        })
    }

    /// Puts a successor in the place of the process `index`, and starts its work. `run` replaces the run of environment 0.
    pub fn install_successor(&mut self, index: usize, mut successor: RunningProcess, run: RunFile) {
        self.environments[0].run = run;
        successor.begin_work();
        self.running[index] = successor;
    }

    fn cores_of(&self, row: &ProcessSpec, env_index: u32) -> Option<&[usize]> {
        let plan = self.cores.as_ref()?;
        match row.scope {
            ProcessScope::Environment => plan.environments.get(env_index as usize).map(Vec::as_slice),
            ProcessScope::Run => Some(&plan.rest),
        }
    }

    /// The process `index`, if it has ended.
    pub fn ended(&mut self, index: usize) -> Option<EndedProcess> {
        let status = self.running[index].poll()?;
        let row = self.running[index].row;
        let environment = &self.environments[self.running[index].env_index as usize];
        Some(EndedProcess {
            row,
            status,
            is_done: environment.state_of(row.process) == State::Done,
            on_exit: row.on_exit(self.run()),
            env_index: self.running[index].env_index,
        })
    }

    /// The failure of the process `index`, which ended with `status`.
    #[must_use]
    pub fn failure(&self, index: usize, status: ExitStatus) -> Failure {
        let running = &self.running[index];
        running.failure(&self.environments[running.env_index as usize].run, status)
    }

    /// True if the process `index` has opened its ports.
    #[must_use]
    pub fn is_attached(&self, index: usize) -> bool {
        let running = &self.running[index];
        let board = self.environments[running.env_index as usize].board(running.row.process);
        board.progress().attached == 1
    }

    /// The incarnation that a restart of the process `index` would have.
    #[must_use]
    pub fn next_incarnation(&self, index: usize) -> u32 {
        self.running[index].incarnation + 1
    }

    /// Starts the process `index` again as its next incarnation.
    ///
    /// # Errors
    /// The run allows no more incarnations, or the program cannot be started.
    pub fn restart(&mut self, index: usize) -> Result<(), Exit> {
        let (row, env_index) = (self.running[index].row, self.running[index].env_index);
        let incarnation = self.next_incarnation(index);
        if !self.set_incarnation(row, env_index, incarnation) {
            return Err(no_more_incarnations(row, incarnation));
        }
        self.restarts += 1;
        self.running[index] = self.start(row, env_index, incarnation)?;
        Ok(())
    }

    /// Remembers how far the learning of every environment has come.
    pub fn note_progress(&mut self) {
        self.environments.iter_mut().for_each(Environment::note_progress);
    }

    /// Ends what is left of the simulator processes of environment `env_index` and has them started again, at the episode of the first
    /// tick that is not committed. Returns the first tick of that episode, and the ticks that have been sensed.
    ///
    /// # Errors
    /// A file cannot be read or written, or the run holds no more incarnations.
    pub fn restart_environment(&mut self, env_index: u32) -> Result<(u64, u64), Exit> {
        let (mut ended, others) = std::mem::take(&mut self.running)
            .into_iter()
            .partition(|running| running.env_index == env_index && running.row.scope == ProcessScope::Environment);
        self.running = others;
        let ended: &mut Vec<RunningProcess> = &mut ended;
        ended.iter_mut().for_each(RunningProcess::kill);
        self.forget_dead();
        let environment = &mut self.environments[env_index as usize];
        environment.note_progress();
        let sensed_ticks = environment.sensed_ticks();
        let first_tick = environment.prepare_restart()?;
        for before in ended.iter() {
            let incarnation = before.incarnation + 1;
            if !self.set_incarnation(before.row, env_index, incarnation) {
                return Err(no_more_incarnations(before.row, incarnation));
            }
            self.incarnations.insert((before.row.process, env_index), incarnation);
        }
        self.restarts += 1;
        Ok((first_tick, sensed_ticks))
    }

    /// Makes this incarnation of a process the valid one in every environment that it belongs to. False if the run allows no more.
    #[must_use]
    pub fn set_incarnation(&mut self, row: &ProcessSpec, env_index: u32, incarnation: u32) -> bool {
        let environments = self.environments.iter_mut().filter(|environment| match row.scope {
            ProcessScope::Run => true,
            ProcessScope::Environment => environment.run.env_index == env_index,
        });
        let mut set = environments.map(|environment| environment.roster.set(row.process, incarnation));
        set.all(|is_set| is_set)
    }

    /// The first required process that is not ready, with its environment.
    #[must_use]
    pub fn first_not_ready(&self) -> Option<(&'static ProcessSpec, &Environment)> {
        self.members()
            .filter(|(row, _)| row.is_required())
            .find(|(row, environment)| self.is_starting(row, environment))
    }

    /// True if the process is not ready; a process of the whole run must be ready in every environment.
    fn is_starting(&self, row: &ProcessSpec, environment: &Environment) -> bool {
        let starts = |environment: &Environment| environment.state_of(row.process) == State::Starting;
        match row.scope {
            ProcessScope::Run => self.environments.iter().any(starts),
            ProcessScope::Environment => starts(environment),
        }
    }

    /// True once every required process has been started and has ended.
    pub fn have_finished(&mut self) -> bool {
        let count = self.members().filter(|(row, _)| row.is_required()).count();
        let required = self.running.iter_mut().filter(|running| running.row.is_required());
        required
            .map(|running| usize::from(running.poll().is_some()))
            .sum::<usize>()
            == count
    }

    /// True while a started process has not ended.
    pub fn is_any_alive(&mut self) -> bool {
        self.running.iter_mut().any(|running| running.poll().is_none())
    }

    /// Asks every process to end.
    pub fn terminate(&mut self) {
        self.running.iter_mut().for_each(|running| running.signal(Signal::TERM));
    }

    /// Asks the process `index` to leave for its successor.
    pub fn ask_to_leave(&mut self, index: usize) {
        self.running[index].ask_to_leave();
    }

    /// Kills every process that is left.
    pub fn kill(&mut self) {
        self.running.clear();
    }

    /// Publishes whether a handover is in progress.
    pub fn set_handing_over(&mut self, is_in_progress: bool) {
        for environment in &mut self.environments {
            environment.set_handing_over(is_in_progress);
        }
    }

    /// Wakes `sensor-daemon` in every environment: the valid incarnation has changed.
    pub fn wake_sensing(&self) {
        self.environments.iter().for_each(Environment::wake_sensing);
    }

    /// Removes the resources of dead processes from the services of the run.
    pub fn forget_dead(&self) {
        services::forget_dead(&self.node);
    }
}

fn no_more_incarnations(row: &ProcessSpec, incarnation: u32) -> Exit {
    Exit::run(
        format!(
            "{} has been replaced {} times, the most that a run allows",
            row.process,
            incarnation - 1
        ),
        "its log in the run directory shows why it ends",
    )
}
