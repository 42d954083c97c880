//! The supervisor: creates the channels of a run, starts and watches its processes, and ends them.

use std::{
    collections::{BTreeMap, BTreeSet},
    os::unix::process::ExitStatusExt as _,
    path::Path,
    sync::{
        Arc,
        atomic::AtomicBool,
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    time::{Duration, Instant},
};

use ipc_schema::{
    config::StallAction,
    failure::{Failure, FailureKind},
    process::{OnExit, Process, ProcessSpec},
    run::RunFile,
    storage,
};
use signal_hook::{
    consts::{SIGCHLD, SIGHUP, SIGINT, SIGTERM},
    iterator::{Handle, Signals},
};

use crate::{
    control::ControlRelay,
    display::{self, ProgressDisplay},
    failure::Exit,
    handover::Handovers,
    install::Install,
    interruption::InterruptionWatch,
    memory_limit::MemoryGroups,
    processes::{EndedProcess, RunProcesses},
    registry::{self, RunClaim},
    restart::{EndCause, MAX_VAIN_FAULTS, RequiredRestarts, RestartVerdict, WatcherRestarts, lost_another},
    socket::{self, HandoverReport, ReceivedRequest},
    stall::{ProcessPlace, StallChange, StallWatch},
    status::last_work,
};

/// An event that wakes the supervisor.
#[derive(Debug)]
enum SupervisorEvent {
    /// A signal arrived.
    Signal(i32),
    /// `caraware handover` or `caraware control` sent a request.
    Request(ReceivedRequest),
    /// The successor of this incarnation is ready.
    SuccessorReady(u32),
}

/// Time between two checks of the processes without an event.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// The same while a command waits for its answer, or while a successor opens its ports: the report measures that time.
const SHORT_CHECK_INTERVAL: Duration = Duration::from_millis(5);
/// Longest time from SIGTERM to the end of a process, before SIGKILL.
const STOP_WITHIN: Duration = Duration::from_secs(30);

/// How a run ended.
#[derive(Debug)]
pub enum RunEnding {
    /// All its work is done.
    Completed,
    /// Ctrl-C, `caraware stop` or the end of the terminal ended it.
    Interrupted,
    /// A required process failed, or the run could not start.
    Failed(Exit),
}

/// How a run ended, and what the supervisor counted.
#[derive(Debug)]
pub struct RunOutcome {
    /// How it ended.
    pub ending: RunEnding,
    /// Wall seconds from the moment when all processes were ready to the end.
    pub wall_s: f64,
    /// Restarts of all processes.
    pub restarts: u32,
    /// Planned handovers of the trainer.
    pub handovers: Vec<HandoverReport>,
}

impl RunOutcome {
    /// The outcome of a run of which no process was started.
    #[must_use]
    pub fn not_started(exit: Exit) -> Self {
        Self {
            ending: RunEnding::Failed(exit),
            wall_s: 0.0,
            restarts: 0,
            handovers: Vec::new(),
        }
    }
}

/// A run under supervision. Dropping it kills the remaining processes and removes the run's shared memory.
pub struct Supervisor {
    handovers: Handovers,
    // Dropped in this order: clients of the control services, processes and services, shared memory.
    controls: ControlRelay,
    processes: RunProcesses,
    _claim: RunClaim,
    events: Receiver<SupervisorEvent>,
    event_sender: Sender<SupervisorEvent>,
    signal_handle: Handle,
    /// Restarts of watchers.
    watcher_restarts: BTreeMap<ProcessPlace, WatcherRestarts>,
    trainer_restarts: RequiredRestarts,
    /// Restarts of the simulator processes of each environment.
    environment_restarts: BTreeMap<u32, RequiredRestarts>,
    stalls: StallWatch,
    /// Processes that were killed because they hung or took too much memory, and have not been started again.
    killed_for_cause: BTreeSet<ProcessPlace>,
    /// What limits the memory of this run.
    memory: MemoryGroups,
    /// Processes that the kernel had ended because of such a limit at the last look.
    memory_kills: u64,
    /// The newest of these ends.
    memory_note: Option<String>,
    ready_at: Option<Instant>,
    /// The runtime directory was removed, and that was reported.
    is_runtime_dir_lost: bool,
    /// Time of the check before the present one. A process that is found ready now became ready after it.
    last_check: Instant,
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.signal_handle.close();
        self.handovers.abandon();
        self.processes.kill();
        self.processes.forget_dead();
    }
}

impl Supervisor {
    /// Creates the channels of `run`.
    ///
    /// # Errors
    /// The run directory is not writable, or iceoryx2 refuses.
    pub fn new(
        run: &RunFile,
        install: Install,
        claim: RunClaim,
        interruption: InterruptionWatch,
    ) -> Result<Self, Exit> {
        let (event_sender, events) = channel();
        let signal_handle = watch_signals(event_sender.clone())?;
        if interruption.finish() {
            // Nobody has ended the receiver yet.
            let _ = event_sender.send(SupervisorEvent::Signal(SIGINT));
        }
        let sender = event_sender.clone();
        socket::listen(run, move |request| {
            sender.send(SupervisorEvent::Request(request)).is_ok()
        })?;
        let processes = RunProcesses::create(run, install)?;
        let memory = MemoryGroups::own();
        Ok(Self {
            handovers: Handovers::default(),
            controls: ControlRelay::new(processes.control_clients()?),
            processes,
            _claim: claim,
            events,
            event_sender,
            signal_handle,
            watcher_restarts: BTreeMap::new(),
            trainer_restarts: RequiredRestarts::default(),
            environment_restarts: BTreeMap::new(),
            stalls: StallWatch::new(&run.config.run, Instant::now()),
            killed_for_cause: BTreeSet::new(),
            memory_kills: memory.kills(),
            memory,
            memory_note: None,
            ready_at: None,
            is_runtime_dir_lost: false,
            last_check: Instant::now(),
        })
    }

    /// Runs all processes to their end. Whatever ends the run, a trainer that has begun to learn may write a checkpoint.
    pub fn supervise(mut self, display: &mut ProgressDisplay) -> RunOutcome {
        let started = Instant::now();
        let ending = match self.run_until_over(started, display) {
            Ok(ending) => ending,
            Err(exit) => RunEnding::Failed(exit),
        };
        // The run is over: answer what still waits, then end what still runs.
        self.handovers
            .refuse_current(&mut self.processes, "the run is over", "");
        self.controls.end();
        let wall_s = self.ready_at.unwrap_or(started).elapsed().as_secs_f64();
        display.update(self.processes.environments(), self.ready_at, &[]);
        display.finish();
        self.stop_all(&ending);
        // What fails while a directory is being removed fails for want of it.
        let ending = match (ending, self.find_run_dir(), self.runtime_dir_removed()) {
            (RunEnding::Failed(_), Err(removed), _) => RunEnding::Failed(removed),
            (RunEnding::Failed(_), Ok(()), Some(directory)) => RunEnding::Failed(Exit::run(
                format!(
                    "the runtime directory {} was removed while the run was alive",
                    directory.display()
                ),
                "`caraware train --resume` continues the run; CARAWARE_RUNTIME_DIR names a directory that stays until its end",
            )),
            (ending, ..) => ending,
        };
        RunOutcome {
            ending,
            wall_s,
            restarts: self.processes.restarts(),
            handovers: self.handovers.take_reports(),
        }
    }

    /// Starts and watches processes until the work is done, a signal asks the run to end, or a required process has failed.
    fn run_until_over(&mut self, started: Instant, display: &mut ProgressDisplay) -> Result<RunEnding, Exit> {
        loop {
            self.processes.start_due()?;
            self.processes.note_progress();
            self.reap()?;
            self.handovers.advance(&mut self.processes);
            self.controls.advance()?;
            self.record_ready(started)?;
            self.find_run_dir()?;
            self.find_runtime_dir();
            self.watch_stalls();
            display.update(self.processes.environments(), self.ready_at, &self.notes());
            self.last_check = Instant::now();
            if self.processes.have_finished() {
                return Ok(RunEnding::Completed);
            }
            if self.wait_for_event() {
                return Ok(RunEnding::Interrupted);
            }
        }
    }

    /// Ends a run whose directory has been removed: nothing of it could be kept.
    fn find_run_dir(&self) -> Result<(), Exit> {
        let directory = &self.processes.run().run_dir;
        // A process may make the directory itself again, but not this file.
        if directory.join("run.json").is_file() {
            return Ok(());
        }
        Err(Exit::run(
            format!(
                "the run's directory {} was removed while the run was alive",
                directory.display()
            ),
            "its checkpoints and results are lost: start the run again, and remove directories of runs that have ended only",
        ))
    }

    /// Reports once that the runtime directory of a live run has been removed.
    fn find_runtime_dir(&mut self) {
        if self.is_runtime_dir_lost {
            return;
        }
        if let Some(directory) = self.runtime_dir_removed() {
            display::notice(&format!(
                "the runtime directory {} was removed: the run takes no commands, and ends with a checkpoint when an episode begins or a \
                 process dies",
                directory.display()
            ));
            self.is_runtime_dir_lost = true;
        }
    }

    /// The runtime directory of this run, if it has been removed: services cannot be opened any more.
    fn runtime_dir_removed(&self) -> Option<&Path> {
        let directory = self.processes.run().shared_memory.root.as_path();
        // A process that is started again makes the directory itself again, but not what marks it.
        (!registry::is_marked(directory)).then_some(directory)
    }

    /// Handles ended processes: a reported failure of a required one ends the run; others are started again.
    fn reap(&mut self) -> Result<(), Exit> {
        for index in 0..self.processes.started() {
            let Some(ended) = self.processes.ended(index) else {
                continue;
            };
            if ended.status.success() && ended.is_done {
                continue;
            }
            self.processes.forget_dead();
            self.note_memory_kill(index, &ended);
            if ended.row.on_exit == OnExit::Replace
                && self.handovers.trainer_ended(&mut self.processes, index, &ended)?
            {
                continue;
            }
            // A simulator that ends by itself was asked to, by a signal that was not the run's.
            let was_killed = ended.status.signal().is_some()
                || ended.row.is_simulator() && ended.status.success()
                || ended.row.process == Process::Trainer && lost_another(ended.status);
            let has_reported = self.processes.has_reported_failure(index);
            let left = self.handovers.is_trainer_leaving() && ended.status.success();
            match ended.on_exit {
                OnExit::Restart => self.restart_watcher(index, &ended)?,
                // The trainer has written all its results.
                OnExit::Replace if ended.is_done => {}
                OnExit::Replace if left => self.restart(index, &ended)?,
                // A successor that was killed because it did not open its ports would not do so again either.
                OnExit::Replace
                    if self.handovers.is_opening()
                        && self.killed_for_cause.contains(&(Process::Trainer, 0))
                        && self.handovers.fall_back(&mut self.processes, index, &ended)? =>
                {
                    self.killed_for_cause.remove(&(Process::Trainer, 0));
                }
                OnExit::Replace if was_killed => self.replace_trainer(index, &ended)?,
                OnExit::Replace if self.handovers.fall_back(&mut self.processes, index, &ended)? => {}
                // A reported failure would come again.
                OnExit::Replace if !has_reported => self.replace_trainer(index, &ended)?,
                // The processes of the environment change places: what else has ended is found at the next check.
                OnExit::Required if was_killed && self.may_simulate_again(ended.row) => {
                    if self.restart_environment(index, &ended)? {
                        return Ok(());
                    }
                }
                OnExit::Required | OnExit::Replace => {
                    return Err(self.processes.failure(index, ended.status).into());
                }
            }
        }
        Ok(())
    }

    /// True if the environment of a killed simulator process can be made again: simulation is a function of configuration, seed,
    /// commands and, in the driving task, logged actions.
    fn may_simulate_again(&self, row: &ProcessSpec) -> bool {
        row.is_simulator() && self.processes.run().replay.is_none()
    }

    /// Reports processes that hang, and kills those that are to be replaced: their ends are found like all others.
    fn watch_stalls(&mut self) {
        let mut signs = self.processes.life_signs();
        for sign in &mut signs {
            // The first start has a deadline of its own.
            sign.is_excused |= sign.is_starting && self.ready_at.is_none();
        }
        for change in self.stalls.check(Instant::now(), &signs) {
            match change {
                StallChange::Begins {
                    place,
                    silence,
                    is_starting,
                } => self.stall_begins(place, silence, is_starting),
                StallChange::Ends(place) => {
                    display::notice(&format!("{} continues", self.processes.label(place)));
                }
            }
        }
        self.end_hanging_handover();
    }

    /// Ends a handover for which a trainer that hangs, and is not to be killed, has been asked to leave.
    fn end_hanging_handover(&mut self) {
        let place = (Process::Trainer, 0);
        let silence = self.stalls.stalls().find(|(stalled, _)| *stalled == place);
        let Some((_, silence)) = silence else { return };
        if self.processes.run().config.run.on_stall == StallAction::Report && self.handovers.may_stay_with_trainer() {
            let message = format!(
                "the old trainer has made no progress for {:.0} s: it stays until it continues or is killed",
                silence.as_secs_f64()
            );
            let help = "kill its process, which `caraware ps` shows, and its successor continues from the newest checkpoint; with \
                        run.on_stall = \"replace\" the run does that itself";
            self.handovers.refuse_current(&mut self.processes, &message, help);
        }
    }

    fn stall_begins(&mut self, place: ProcessPlace, silence: Duration, is_starting: bool) {
        let Some(index) = self.processes.index_of(place) else {
            return;
        };
        let (row, label, state) = self.processes.describe(index);
        let what = match is_starting {
            true => format!(
                "{label} was not ready within {} s",
                self.processes.run().config.run.ready_s
            ),
            false => format!("{label} has made no progress for {:.0} s", silence.as_secs_f64()),
        };
        let run = self.processes.run();
        let may_replace = row.on_exit(run) != OnExit::Required || self.may_simulate_again(row);
        let is_killed = is_starting || may_replace && run.config.run.on_stall == StallAction::Replace;
        let end = if is_killed { "; it is killed" } else { "" };
        let note = format!("{what}: {state}{end}");
        display::notice(&note);
        self.processes.log(index, &note);
        if is_killed {
            self.killed_for_cause.insert(place);
            self.processes.kill_one(index);
        }
    }

    /// Notes that the kernel has killed a process because a limit on memory was reached.
    fn note_memory_kill(&mut self, index: usize, ended: &EndedProcess) {
        let place = (ended.row.process, ended.env_index);
        if ended.status.signal() != Some(signal_hook::consts::SIGKILL) || self.killed_for_cause.contains(&place) {
            return;
        }
        let kills = self.memory.kills();
        if kills <= self.memory_kills {
            return;
        }
        self.memory_kills = kills;
        self.killed_for_cause.insert(place);
        let limit = self.memory.tightest();
        let limit = limit.map_or_else(String::new, |limit| format!(" of {} MiB", limit.limit_bytes >> 20));
        let note = format!(
            "the kernel has ended {}: the limit on memory{limit} was reached",
            self.processes.label(place)
        );
        display::notice(&note);
        self.processes.log(index, &note);
        self.memory_note = Some(note);
    }

    /// A failure of a process that is given up, with a limit on memory if that was met.
    fn given_up(&self, index: usize, ended: &EndedProcess, reason: &str) -> Exit {
        let mut failure = self.processes.failure(index, ended.status);
        for line in std::iter::once(reason).chain(self.memory_note.as_deref()) {
            failure.message += "\n  ";
            failure.message += line;
        }
        failure.into()
    }

    /// Whose fault an end is: a process that was killed because it hung or took too much memory is to blame itself.
    fn cause_of(&self, ended: &EndedProcess) -> EndCause {
        match self.killed_for_cause.contains(&(ended.row.process, ended.env_index)) {
            true => EndCause::OwnFault,
            false if ended.row.is_simulator() && ended.status.success() => EndCause::Kill,
            false => EndCause::of(ended.status),
        }
    }

    /// Starts the simulator processes of an environment again, after a pause that grows while nothing new is sensed. Only ends of the
    /// program's own making (a crash, not SIGKILL) can make it give up.
    fn restart_environment(&mut self, index: usize, ended: &EndedProcess) -> Result<bool, Exit> {
        let env_index = ended.env_index;
        let sensed_ticks = self.processes.environments()[env_index as usize].sensed_ticks();
        let cause = self.cause_of(ended);
        let label = ended.row.label(&self.processes.environments()[env_index as usize].run);
        let restarts = self.environment_restarts.entry(env_index).or_default();
        match restarts.verdict(sensed_ticks, cause, Instant::now()) {
            RestartVerdict::Wait => return Ok(false),
            RestartVerdict::Postpone(pause) => {
                let reason = format!("{label} ended with {}", ended.status);
                self.note_pause(index, &reason, pause);
                return Ok(false);
            }
            RestartVerdict::GiveUp => {
                let reason = "it crashed again and again, or hung, without a new tick";
                return Err(self.given_up(index, ended, reason));
            }
            RestartVerdict::Start => {}
        }
        let (first_tick, sensed_ticks) = self.processes.restart_environment(env_index)?;
        let is_of_another = |(process, index): &ProcessPlace| *index != env_index || !process.spec().is_simulator();
        self.killed_for_cause.retain(is_of_another);
        display::notice(&format!(
            "{label} ended with {}; the simulation is made again from tick {first_tick} to {sensed_ticks}, and continues",
            ended.status
        ));
        Ok(true)
    }

    /// Restarts a watcher, unless it ended again and again by its own fault before it opened its ports. Then the run continues without it,
    /// or ends if it needs it.
    fn restart_watcher(&mut self, index: usize, ended: &EndedProcess) -> Result<(), Exit> {
        let place = (ended.row.process, ended.env_index);
        let cause = self.cause_of(ended);
        let restarts = self.watcher_restarts.entry(place).or_default();
        let verdict = restarts.verdict(self.processes.is_attached(index), cause, Instant::now());
        match verdict {
            RestartVerdict::Start => self.restart(index, ended),
            // The run would wait for ever for the credit of a process that never comes.
            RestartVerdict::GiveUp if ended.row.is_required(self.processes.run()) => {
                Err(self.processes.failure(index, ended.status).into())
            }
            RestartVerdict::GiveUp => {
                let label = self.processes.label(place);
                let note = format!("{label} ended again and again before it was ready: the run continues without it");
                display::notice(&note);
                self.processes.log(index, &note);
                Ok(())
            }
            RestartVerdict::Wait | RestartVerdict::Postpone(_) => Ok(()),
        }
    }

    /// Replaces a trainer that was killed or crashed, after a pause that grows while it reaches no new checkpoint. Only ends of its own
    /// fault can make it give up.
    fn replace_trainer(&mut self, index: usize, ended: &EndedProcess) -> Result<(), Exit> {
        let process = ended.row.process;
        let committed_ticks = self.processes.committed_ticks(process);
        let cause = self.cause_of(ended);
        let reason = format!("{process} ended with {}", ended.status);
        match self.trainer_restarts.verdict(committed_ticks, cause, Instant::now()) {
            RestartVerdict::Wait => return Ok(()),
            RestartVerdict::Postpone(pause) => {
                self.note_pause(index, &reason, pause);
                return Ok(());
            }
            RestartVerdict::GiveUp => {
                if self.handovers.fall_back(&mut self.processes, index, ended)? {
                    self.trainer_restarts = RequiredRestarts::default();
                    return Ok(());
                }
                let reason = format!(
                    "it ended by its own fault again, after {MAX_VAIN_FAULTS} restarts in a row without a new checkpoint"
                );
                return Err(self.given_up(index, ended, &reason));
            }
            RestartVerdict::Start => {}
        }
        if self.handovers.fails_its_trial() && self.handovers.fall_back(&mut self.processes, index, ended)? {
            self.trainer_restarts = RequiredRestarts::default();
            return Ok(());
        }
        display::notice(&format!("{reason}; a successor continues from the newest checkpoint"));
        self.restart(index, ended)
    }

    /// Reports, here and in the log of the process `index`, that its restart is postponed.
    fn note_pause(&self, index: usize, reason: &str, pause: Duration) {
        let note = format!("{reason}; it starts again in {:.1} s", pause.as_secs_f64());
        display::notice(&note);
        self.processes.log(index, &note);
    }

    /// What the progress line says besides the progress: the processes that hang, and the restarts that are postponed.
    fn notes(&self) -> Vec<String> {
        let now = Instant::now();
        let trainer = self.trainer_restarts.wait(now).map(|wait| ("trainer".to_owned(), wait));
        let environments = self.environment_restarts.iter().filter_map(|(env_index, restarts)| {
            let wait = restarts.wait(now)?;
            Some((format!("environment {env_index}"), wait))
        });
        let waits = trainer.into_iter().chain(environments);
        let waits = waits.map(|(what, wait)| format!("{what} starts again in {:.1} s", wait.as_secs_f64()));
        let stalls = self.stalls.stalls().map(|(place, lasts)| {
            let label = self.processes.label(place);
            format!("{label} has made no progress for {:.0} s", lasts.as_secs_f64())
        });
        stalls.chain(waits).collect()
    }

    fn restart(&mut self, index: usize, ended: &EndedProcess) -> Result<(), Exit> {
        self.processes.restart(index)?;
        self.killed_for_cause.remove(&(ended.row.process, ended.env_index));
        if ended.row.process == Process::Trainer {
            self.handovers.trainer_restarted();
        }
        Ok(())
    }

    /// Records the time at which the last required process became ready. Fails if one is not ready in time.
    fn record_ready(&mut self, started: Instant) -> Result<(), Exit> {
        if self.ready_at.is_some() {
            return Ok(());
        }
        match self.processes.first_not_ready() {
            None => self.ready_at = Some(self.last_check),
            // The supervisors of the other ranks have deadlines of their own.
            Some((row, environment)) if environment.waits_for_ranks(row.process) => {}
            Some((row, environment)) if started.elapsed().as_secs_f64() > environment.run.config.run.ready_s => {
                let log = environment
                    .run
                    .run_dir
                    .join("logs")
                    .join(format!("{}.log", row.process));
                let name = row.label(&environment.run);
                let message = format!("{name} was not ready within {} s", environment.run.config.run.ready_s);
                let help = match (row.process, environment.run.env_index) {
                    (Process::Trainer, index @ 1..) => format!(
                        "it took no place in environment {index}: a trainer takes one in each \
                         (`channel.in_environment(i)`, docs/learners.md); one that does not needs a run without --envs"
                    ),
                    _ => format!("its log is {}; a larger run.ready_s waits for longer", log.display()),
                };
                return Err(Failure::new(FailureKind::Run, message).with_help(help).into());
            }
            Some(_) => {}
        }
        Ok(())
    }

    /// Waits for an event, at most [`CHECK_INTERVAL`]; true if it asks the run to end.
    fn wait_for_event(&mut self) -> bool {
        let is_short = self.handovers.is_opening() || self.controls.is_waiting();
        let interval = if is_short { SHORT_CHECK_INTERVAL } else { CHECK_INTERVAL };
        match self.events.recv_timeout(interval) {
            Ok(SupervisorEvent::Signal(signal)) => return signal != SIGCHLD,
            Ok(SupervisorEvent::Request(ReceivedRequest::Handover(request, reply))) => {
                let sender = self.event_sender.clone();
                let report_ready = move |successor| sender.send(SupervisorEvent::SuccessorReady(successor)).is_ok();
                self.handovers.begin(&self.processes, request, reply, report_ready);
            }
            Ok(SupervisorEvent::Request(ReceivedRequest::Control(command, env, reply))) => {
                self.controls.forward(&command, env, reply);
            }
            Ok(SupervisorEvent::SuccessorReady(incarnation)) => {
                self.handovers.successor_ready(&mut self.processes, incarnation);
            }
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
        }
        false
    }

    /// Asks every process to end and waits; kills the rest after a time limit or a second Ctrl-C.
    fn stop_all(&mut self, ending: &RunEnding) {
        let what = last_work(self.processes.run().mode);
        match ending {
            RunEnding::Completed => {}
            RunEnding::Interrupted => display::notice(&format!("stopping{what} (press Ctrl-C again to kill)")),
            // Nothing has been simulated or learnt yet.
            RunEnding::Failed(_) if self.ready_at.is_none() => return self.processes.kill(),
            RunEnding::Failed(_) => display::notice(&format!("the run has failed{what} (press Ctrl-C to kill)")),
        }
        self.processes.terminate();
        let deadline = Instant::now() + STOP_WITHIN;
        while Instant::now() < deadline && self.processes.is_any_alive() {
            if self.wait_for_event() {
                break;
            }
        }
        if Instant::now() >= deadline {
            for label in self.processes.alive() {
                let within = STOP_WITHIN.as_secs();
                display::notice(&format!("{label} has not ended within {within} s: it is killed"));
            }
        }
        self.processes.kill();
    }
}

/// Forwards signals to a channel, so that the supervisor can wait for them with a deadline.
fn watch_signals(sender: Sender<SupervisorEvent>) -> Result<Handle, Exit> {
    let failed = |error: &std::io::Error| Exit::run(format!("cannot watch signals: {error}"), "");
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP, SIGCHLD]).map_err(|error| failed(&error))?;
    // While the disk is full the supervisor may wait in the middle of its work.
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).map_err(|error| failed(&error))?;
    }
    storage::stop_waiting_at(&stop);
    let handle = signals.handle();
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            signals
                .forever()
                .take_while(|signal| sender.send(SupervisorEvent::Signal(*signal)).is_ok())
                .for_each(drop)
        })
        .map_err(|error| failed(&error))?;
    Ok(handle)
}
