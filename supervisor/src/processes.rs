//! The processes of a run and the environments they belong to: starts those that may start, on their cores, and finds those that ended.

use std::{
    collections::BTreeMap,
    path::Path,
    process::{ChildStdout, ExitStatus},
};

use ipc_schema::{
    board::State,
    failure::Failure,
    ports::{BoardReader, ControlClient},
    process::{OnExit, PROCESSES, Process, ProcessScope, ProcessSpec},
    reserve,
    run::RunFile,
    services::{self, RunNode},
};
use rustix::process::Signal;

use crate::{
    cores,
    environment::Environment,
    failure::Exit,
    install::Install,
    running_process::{LeaveTime, RunningProcess},
    socket::HandoverRequest,
    stall::{LifeSign, ProcessPlace},
};

/// The module that keeps the trainer's place for a process outside the run, which makes ticks when its user wants some.
const OUTSIDE_USER: &str = "caraware.envs.outside";

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
    /// Completed handovers of the trainer, without those that fell back.
    handovers: u32,
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
            handovers: 0,
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
            let mut needs = row
                .needs
                .iter()
                .filter(|need| (need.spec().is_wanted)(&environment.run));
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
            let (run, run_file) = (&environment.run, &environment.run_file);
            RunningProcess::start(row, &self.install, run, run_file, incarnation, self.handovers)
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
        request: &HandoverRequest,
    ) -> Result<(RunningProcess, Option<ChildStdout>), Exit> {
        let trainer = self.replaceable().map(|index| &self.running[index]);
        let trainer = trainer.ok_or_else(|| Exit::run("the run has no trainer", ""))?;
        let (row, incarnation) = (trainer.row, trainer.incarnation + 1);
        cores::within(self.cores_of(row, 0), || {
            let handovers = self.handovers + 1;
            RunningProcess::start_successor(row, &self.install, run, run_file, incarnation, handovers, request)
        })
    }

    /// Puts a successor in the place of the process `index`, and starts its work. `run` replaces the run of environment 0.
    pub fn install_successor(&mut self, index: usize, mut successor: RunningProcess, run: RunFile) {
        self.environments[0].run = run;
        self.handovers += 1;
        successor.begin_work();
        self.running[index] = successor;
    }

    /// Lets `run`, as it was before the last handover, be the run of environment 0: restarts of the trainer read it.
    pub fn return_to(&mut self, run: RunFile) {
        self.environments[0].run = run;
        self.handovers = self.handovers.saturating_sub(1);
    }

    /// The oldest tick that the journal of environment 0 holds.
    #[must_use]
    pub fn journal_first(&self) -> u64 {
        self.environments[0]
            .board(Process::SensorDaemon)
            .progress()
            .committed_ticks
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

    /// True if the process `index`, which has ended, has reported a failure.
    #[must_use]
    pub fn has_reported_failure(&self, index: usize) -> bool {
        let running = &self.running[index];
        running.has_reported_failure(&self.environments[running.env_index as usize].run)
    }

    /// Appends a line of the supervisor to the log of the process `index`.
    pub fn log(&self, index: usize, line: &str) {
        let running = &self.running[index];
        running.log(&self.environments[running.env_index as usize].run, line);
    }

    /// Index of the running process at `place`.
    #[must_use]
    pub fn index_of(&self, place: ProcessPlace) -> Option<usize> {
        let is_it = |running: &RunningProcess| (running.row.process, running.env_index) == place;
        self.running.iter().position(is_it)
    }

    /// Row, name in messages and state of the process `index`.
    #[must_use]
    pub fn describe(&self, index: usize) -> (&'static ProcessSpec, String, &'static str) {
        let running = &self.running[index];
        let label = running.row.label(&self.environments[running.env_index as usize].run);
        (running.row, label, running.kernel_state())
    }

    /// Name in messages of the process at `place`.
    #[must_use]
    pub fn label(&self, (process, env_index): ProcessPlace) -> String {
        process.spec().label(&self.environments[env_index as usize].run)
    }

    /// Names of the processes that have not ended.
    pub fn alive(&mut self) -> Vec<String> {
        let alive = self.running.iter_mut().filter_map(|running| {
            let place = (running.row.process, running.env_index);
            running.poll().is_none().then_some(place)
        });
        let places: Vec<ProcessPlace> = alive.collect();
        places.into_iter().map(|place| self.label(place)).collect()
    }

    /// Kills the process `index`; its end is found like any other.
    pub fn kill_one(&mut self, index: usize) {
        self.running[index].signal(Signal::KILL);
    }

    /// What the boards of all running processes say. A process of the whole run has a board in every environment: the newest note
    /// counts.
    pub fn life_signs(&mut self) -> Vec<LifeSign> {
        let (environments, running) = (&self.environments, &mut self.running);
        let alive = running.iter_mut().filter_map(|process| {
            let is_alive = process.poll().is_none();
            is_alive.then(|| (process.row, process.env_index, process.incarnation, process.queued()))
        });
        alive
            .map(|(row, env_index, incarnation, queued)| {
                let own = &environments[env_index as usize];
                let notes = environments
                    .iter()
                    .filter(|environment| row.scope == ProcessScope::Run || environment.run.env_index == env_index)
                    .map(|environment| environment.board(row.process).activity().noted_ns);
                let state = own.state_of(row.process);
                let keeps_a_place = row.process == Process::Trainer && own.run.config.trainer.module == OUTSIDE_USER;
                LifeSign {
                    place: (row.process, env_index),
                    incarnation,
                    noted_ns: notes.max().unwrap_or(0),
                    queued,
                    is_starting: state == State::Starting,
                    is_excused: state == State::Done || keeps_a_place,
                }
            })
            .collect()
    }

    /// True if the process `index` has opened its ports.
    #[must_use]
    pub fn is_attached(&self, index: usize) -> bool {
        let running = &self.running[index];
        let board = self.environments[running.env_index as usize].board(running.row.process);
        board.progress().attached == 1
    }

    /// Starts the process `index` again as its next incarnation.
    ///
    /// # Errors
    /// iceoryx2 refuses, or the program cannot be started.
    pub fn restart(&mut self, index: usize) -> Result<(), Exit> {
        let (row, env_index) = (self.running[index].row, self.running[index].env_index);
        let incarnation = self.running[index].incarnation + 1;
        self.set_incarnation(row, env_index, incarnation)?;
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
    /// A file cannot be read or written, or iceoryx2 refuses.
    pub fn restart_environment(&mut self, env_index: u32) -> Result<(u64, u64), Exit> {
        let is_of_environment =
            |running: &mut RunningProcess| running.env_index == env_index && running.row.is_simulator();
        let mut ended: Vec<RunningProcess> = self.running.extract_if(.., is_of_environment).collect();
        ended.iter_mut().for_each(RunningProcess::kill);
        self.forget_dead();
        let environment = &mut self.environments[env_index as usize];
        environment.note_progress();
        let sensed_ticks = environment.sensed_ticks();
        let first_tick = environment.prepare_restart()?;
        for before in &ended {
            let incarnation = before.incarnation + 1;
            self.set_incarnation(before.row, env_index, incarnation)?;
            self.incarnations.insert((before.row.process, env_index), incarnation);
        }
        self.restarts += 1;
        Ok((first_tick, sensed_ticks))
    }

    /// Makes this incarnation of a process the valid one in every environment that it belongs to.
    ///
    /// # Errors
    /// iceoryx2 refuses.
    pub fn set_incarnation(&mut self, row: &ProcessSpec, env_index: u32, incarnation: u32) -> Result<(), Exit> {
        let node = &self.node;
        let environments = self.environments.iter_mut().filter(|environment| match row.scope {
            ProcessScope::Run => true,
            ProcessScope::Environment => environment.run.env_index == env_index,
        });
        for environment in environments {
            environment.set_incarnation(node, row.process, incarnation)?;
        }
        Ok(())
    }

    /// The first required process that is not ready, with its environment.
    #[must_use]
    pub fn first_not_ready(&self) -> Option<(&'static ProcessSpec, &Environment)> {
        self.members()
            .filter(|(row, environment)| row.is_required(&environment.run))
            .find_map(|(row, environment)| Some((row, self.starting_in(row, environment)?)))
    }

    /// The environment in which the process is not ready; a process of the whole run must be ready in each.
    fn starting_in<'a>(&'a self, row: &ProcessSpec, environment: &'a Environment) -> Option<&'a Environment> {
        let starts = |environment: &&Environment| environment.state_of(row.process) == State::Starting;
        match row.scope {
            ProcessScope::Run => self.environments.iter().find(starts),
            ProcessScope::Environment => Some(environment).filter(starts),
        }
    }

    /// True once every required process has been started and has ended.
    pub fn have_finished(&mut self) -> bool {
        let members = self.members();
        let count = members
            .filter(|(row, environment)| row.is_required(&environment.run))
            .count();
        let run = &self.environments[0].run;
        let required = self.running.iter_mut().filter(|running| running.row.is_required(run));
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
    pub fn ask_to_leave(&mut self, index: usize, when: LeaveTime) {
        self.running[index].ask_to_leave(when);
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

    /// Removes the resources of dead processes from the services of the run, and reserves the memory that they had.
    pub fn forget_dead(&self) {
        services::forget_dead(&self.node);
        // At the end of a run no process follows.
        if !self.running.is_empty() {
            reserve::refill(self.run());
        }
    }
}
