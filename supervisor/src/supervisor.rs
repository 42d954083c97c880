//! The supervisor: owns a run, creates every channel, starts and watches the processes, and ends them all.

use std::{
    collections::BTreeMap,
    io::{BufRead as _, BufReader},
    os::unix::process::ExitStatusExt as _,
    path::PathBuf,
    process::ExitStatus,
    sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    time::{Duration, Instant},
};

use ipc_schema::{
    board::{INCARNATIONS, State},
    failure::{Failure, FailureKind},
    ports::{BoardReader, ControlClient},
    process::Process,
    run::RunFile,
    services::{self, RunNode},
};
use rustix::process::Signal;
use signal_hook::{
    consts::{SIGCHLD, SIGINT, SIGTERM},
    iterator::{Handle, Signals},
};

use crate::{
    config,
    control::Controls,
    cores,
    display::Display,
    environment::Environment,
    failure::Exit,
    install::Install,
    line,
    process_table::{OnExit, Row, Running, Scope, TABLE},
    registry::Claim,
    revival::{Revival, Verdict},
    succession::{self, Succession},
    swap::{self, Asked, Handover},
};

/// What the supervisor waits for.
#[derive(Debug)]
enum Event {
    /// A signal came.
    Signal(i32),
    /// `caraware swap` or `caraware control` asks for something.
    Asked(line::Asked),
    /// The successor of this incarnation is ready.
    Ready(u32),
}

/// Time between two looks at the processes when nothing happens.
const LOOK: Duration = Duration::from_millis(100);
/// The same while a successor opens its ports, which is timed, or somebody waits for an answer.
const SHORT_LOOK: Duration = Duration::from_millis(5);
/// Longest time from start to ready.
const READY_WITHIN: Duration = Duration::from_secs(120);
/// Longest time from SIGTERM to the end of a process, before SIGKILL.
const STOP_WITHIN: Duration = Duration::from_secs(30);
/// Most replacements of a trainer in a row without a new commit.
const MAX_VAIN_REPLACEMENTS: u32 = 5;

/// How a run ended, and what the supervisor saw.
#[derive(Debug)]
pub struct Outcome {
    /// True if Ctrl-C or `caraware stop` ended it.
    pub interrupted: bool,
    /// Wall seconds from everybody ready to the end.
    pub wall_s: f64,
    /// Restarts of all processes.
    pub restarts: u32,
    /// Planned swaps of the trainer.
    pub swaps: Vec<Handover>,
}

/// A run under supervision. Dropping it kills what is left and empties its shared memory.
pub struct Supervisor {
    succession: Option<Succession>,
    /// The trainer has been asked to leave: its end without a word is no failure.
    asked_to_leave: bool,
    // Dropped in this order: processes, services, node, shared memory.
    running: Vec<Running>,
    /// Environment 0 is the home of what belongs to the whole run.
    environments: Vec<Environment>,
    controls: Controls,
    node: RunNode,
    _claim: Claim,
    cores: Option<cores::Plan>,
    install: Install,
    events: Receiver<Event>,
    event_sender: Sender<Event>,
    signal_handle: Handle,
    restarts: u32,
    /// Deaths of processes that only watch.
    revivals: BTreeMap<Process, Revival>,
    swaps: Vec<Handover>,
    /// Replacements of the trainer since its last commit, and the ticks committed then.
    vain_replacements: u32,
    committed_ticks: u64,
    ready_at: Option<Instant>,
    /// The look before the present one: whatever is found ready now got ready after it.
    last_look: Instant,
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.signal_handle.close();
        self.succession = None;
        self.running.clear();
        services::forget_dead(&self.node);
    }
}

impl Supervisor {
    /// Creates the channels of `run`.
    ///
    /// # Errors
    /// The run directory is not writable, or iceoryx2 refuses.
    pub fn new(run: RunFile, install: Install, claim: Claim) -> Result<Self, Exit> {
        let (event_sender, events) = channel();
        let signal_handle = watch_signals(event_sender.clone())?;
        let sender = event_sender.clone();
        line::listen(&run, move |asked| sender.send(Event::Asked(asked)).is_ok())?;
        let node = services::node(&run.shared_memory)?;
        let envs = run.config.run.envs;
        let environments: Vec<_> = (0..envs)
            .map(|index| Environment::create(&node, &run, index))
            .collect::<Result<_, Exit>>()?;
        let clients = environments
            .iter()
            .map(|environment: &Environment| ControlClient::create(environment.control()));
        let controls = Controls::new(clients.collect::<Result<_, _>>()?);
        let cores = cores::plan(&cores::available(), envs as usize, run.mode.has_trainer());
        Ok(Self {
            succession: None,
            asked_to_leave: false,
            running: Vec::new(),
            environments,
            controls,
            node,
            _claim: claim,
            cores,
            install,
            events,
            event_sender,
            signal_handle,
            restarts: 0,
            revivals: BTreeMap::new(),
            swaps: Vec::new(),
            vain_replacements: 0,
            committed_ticks: 0,
            ready_at: None,
            last_look: Instant::now(),
        })
    }

    /// Runs all processes to their end.
    ///
    /// # Errors
    /// A required process failed, or one did not get ready in time.
    pub fn supervise(mut self, display: &mut Display) -> Result<Outcome, Exit> {
        let started = Instant::now();
        let mut interrupted = false;
        loop {
            self.start_what_can()?;
            self.reap()?;
            self.advance_swap();
            self.controls.advance()?;
            self.note_ready(started)?;
            display.update(&self.environments, self.ready_at);
            self.last_look = Instant::now();
            if self.finished() {
                break;
            }
            if self.wait_for_event() {
                interrupted = true;
                break;
            }
        }
        self.refuse_swap("the run is over", "");
        self.controls.end();
        let wall_s = self.ready_at.unwrap_or(started).elapsed().as_secs_f64();
        display.update(&self.environments, self.ready_at);
        display.finish();
        self.stop_all(interrupted);
        Ok(Outcome {
            interrupted,
            wall_s,
            restarts: self.restarts,
            swaps: std::mem::take(&mut self.swaps),
        })
    }

    /// The run, as environment 0 and whatever belongs to the whole run see it.
    fn run(&self) -> &RunFile {
        &self.environments[0].run
    }

    /// Every process that the run has: its row and its environment.
    fn wanted(&self) -> impl Iterator<Item = (&'static Row, &Environment)> {
        self.environments.iter().flat_map(|environment| {
            let run = &environment.run;
            let rows = TABLE.iter().filter(|row| row.is_in(run, run.env_index));
            rows.map(move |row| (row, environment))
        })
    }

    fn trainer(&self) -> &BoardReader {
        self.environments[0].board(Process::Trainer)
    }

    fn is_started(&self, row: &Row, env_index: u32) -> bool {
        self.running
            .iter()
            .any(|running| running.row.process == row.process && running.env_index == env_index)
    }

    /// What belongs to the whole run needs the processes of every environment, another only those of its own.
    fn may_start(&self, row: &Row, environment: &Environment) -> bool {
        let is_up = |environment: &Environment| {
            let mut needs = row.needs.iter();
            needs.all(|need| environment.state_of(*need) != State::Starting)
        };
        match row.scope {
            Scope::Run => self.environments.iter().all(is_up),
            Scope::Environment => is_up(environment),
        }
    }

    fn start_what_can(&mut self) -> Result<(), Exit> {
        let due: Vec<(&'static Row, u32)> = self
            .wanted()
            .filter(|(row, environment)| !self.is_started(row, environment.run.env_index))
            .filter(|(row, environment)| self.may_start(row, environment))
            .map(|(row, environment)| (row, environment.run.env_index))
            .collect();
        for (row, env_index) in due {
            let started = self.start(row, env_index, 0)?;
            self.running.push(started);
        }
        Ok(())
    }

    /// Starts the process of `row` in its environment, on the cores that are meant for it.
    fn start(&self, row: &'static Row, env_index: u32, incarnation: u32) -> Result<Running, Exit> {
        let environment = &self.environments[env_index as usize];
        cores::within(self.cores_of(row, env_index), || {
            Running::start(row, &self.install, &environment.run, &environment.run_file, incarnation)
        })
    }

    fn cores_of(&self, row: &Row, env_index: u32) -> Option<&[usize]> {
        let plan = self.cores.as_ref()?;
        match row.scope {
            Scope::Environment => plan.environments.get(env_index as usize).map(Vec::as_slice),
            Scope::Run => Some(&plan.rest),
        }
    }

    /// Looks for ended processes: a failure of a required one ends the run; watchers, and a trainer that died, are started again.
    fn reap(&mut self) -> Result<(), Exit> {
        for index in 0..self.running.len() {
            let Some(status) = self.running[index].poll() else {
                continue;
            };
            let row = self.running[index].row;
            let environment = &self.environments[self.running[index].env_index as usize];
            let done = environment.state_of(row.process) == State::Done;
            if status.success() && done {
                continue;
            }
            services::forget_dead(&self.node);
            let on_exit = row.on_exit(self.run());
            if on_exit == OnExit::Replace && self.take_over(index, done)? {
                continue;
            }
            match on_exit {
                OnExit::Restart => self.revive(index)?,
                // All that it had to do is on disk.
                OnExit::Replace if done => {}
                OnExit::Replace if status.signal().is_some() => self.replace(index, status)?,
                OnExit::Replace if self.asked_to_leave && status.success() => self.restart(index)?,
                OnExit::Required | OnExit::Replace => {
                    return Err(self.failure(index, status).into());
                }
            }
        }
        Ok(())
    }

    fn failure(&self, index: usize, status: ExitStatus) -> Failure {
        let running = &self.running[index];
        running.failure(&self.environments[running.env_index as usize].run, status)
    }

    /// Starts a process that only watches again, if that has a point. The run goes on without it.
    fn revive(&mut self, index: usize) -> Result<(), Exit> {
        let running = &self.running[index];
        let (process, next) = (running.row.process, running.incarnation + 1);
        let board = self.environments[running.env_index as usize].board(process);
        let worked = board.progress().attached == 1;
        let verdict = self
            .revivals
            .entry(process)
            .or_default()
            .verdict(worked, Instant::now());
        if verdict == Verdict::Start && next < INCARNATIONS {
            return self.restart(index);
        }
        Ok(())
    }

    /// Replaces a trainer that died, unless that has been in vain for too long.
    fn replace(&mut self, index: usize, status: ExitStatus) -> Result<(), Exit> {
        let process = self.running[index].row.process;
        let boards = self.environments.iter().map(|environment| environment.board(process));
        let committed = boards.map(|board| board.progress().committed_ticks).sum();
        if committed > self.committed_ticks {
            self.committed_ticks = committed;
            self.vain_replacements = 0;
        }
        self.vain_replacements += 1;
        if self.vain_replacements > MAX_VAIN_REPLACEMENTS {
            let mut failure = self.failure(index, status);
            failure.message = format!(
                "{}\n  replaced {MAX_VAIN_REPLACEMENTS} times in a row, and it never got to a new checkpoint",
                failure.message
            );
            return Err(failure.into());
        }
        eprintln!("{process} ended with {status}; a successor continues from the newest checkpoint");
        self.restart(index)
    }

    fn restart(&mut self, index: usize) -> Result<(), Exit> {
        let (row, env_index) = (self.running[index].row, self.running[index].env_index);
        let incarnation = self.running[index].incarnation + 1;
        if !self.counts(row, env_index, incarnation) {
            return Err(Exit::run(
                format!(
                    "{} has been replaced {} times: a run holds no more",
                    row.process,
                    incarnation - 1
                ),
                "find out from its log why it dies",
            ));
        }
        self.restarts += 1;
        self.asked_to_leave &= row.process != Process::Trainer;
        self.running[index] = self.start(row, env_index, incarnation)?;
        Ok(())
    }

    /// From now on this incarnation counts, wherever the process has a place. False if there are no more.
    #[must_use]
    fn counts(&mut self, row: &Row, env_index: u32, incarnation: u32) -> bool {
        let places = self.environments.iter_mut().filter(|environment| match row.scope {
            Scope::Run => true,
            Scope::Environment => environment.run.env_index == env_index,
        });
        let mut set = places.map(|environment| environment.roster.set(row.process, incarnation));
        set.all(|is_set| is_set)
    }

    /// Remembers when the last required process got ready; gives up if one does not.
    fn note_ready(&mut self, started: Instant) -> Result<(), Exit> {
        if self.ready_at.is_some() {
            return Ok(());
        }
        let late = self
            .wanted()
            .filter(|(row, _)| row.is_required())
            .find(|(row, environment)| self.is_starting(row, environment));
        match late {
            None => self.ready_at = Some(self.last_look),
            Some((row, environment)) if started.elapsed() > READY_WITHIN => {
                let log = environment
                    .run
                    .run_dir
                    .join("logs")
                    .join(format!("{}.log", row.process));
                let name = row.label(&environment.run);
                let message = format!("{name} was not ready within {} s", READY_WITHIN.as_secs());
                return Err(Failure::new(FailureKind::Run, message)
                    .with_help(format!("its log is {}", log.display()))
                    .into());
            }
            Some(_) => {}
        }
        Ok(())
    }

    /// What belongs to the whole run, and is needed, is ready when it is in every environment.
    fn is_starting(&self, row: &Row, environment: &Environment) -> bool {
        let starts = |environment: &Environment| environment.state_of(row.process) == State::Starting;
        match row.scope {
            Scope::Run => self.environments.iter().any(starts),
            Scope::Environment => starts(environment),
        }
    }

    fn finished(&mut self) -> bool {
        let wanted = self.wanted().filter(|(row, _)| row.is_required()).count();
        let required = self.running.iter_mut().filter(|running| running.row.is_required());
        required
            .map(|running| usize::from(running.poll().is_some()))
            .sum::<usize>()
            == wanted
    }

    /// Waits for something to happen, at most [`LOOK`]; true if it asks the run to end.
    fn wait_for_event(&mut self) -> bool {
        let taking = self.succession.as_ref().is_some_and(Succession::is_taking);
        let is_short = taking || self.controls.is_waiting();
        match self.events.recv_timeout(if is_short { SHORT_LOOK } else { LOOK }) {
            Ok(Event::Signal(signal)) => return signal != SIGCHLD,
            Ok(Event::Asked(line::Asked::Swap(asked))) => self.begin_swap(asked),
            Ok(Event::Asked(line::Asked::Control(command, env, line))) => self.controls.pass_on(&command, env, line),
            Ok(Event::Ready(incarnation)) => self.successor_ready(incarnation),
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
        }
        false
    }

    /// Starts a successor beside the trainer at work, or refuses.
    fn begin_swap(&mut self, asked: Asked) {
        let state = self.environments[0].state_of(Process::Trainer);
        let index = self
            .running
            .iter()
            .position(|running| running.row.on_exit == OnExit::Replace);
        let learns_alone = self.run().config.trainer.ranks == 1;
        let refusal = match (&self.succession, index, state) {
            (Some(_), ..) => "another swap is under way",
            _ if !learns_alone => "its trainer learns together with others: none of them can be replaced alone",
            (None, None, _) => "the run has no trainer",
            (None, Some(_), State::Starting) => "the trainer is only starting",
            (None, Some(_), State::Done) => "the trainer is done",
            (None, Some(index), State::Ready | State::Running) => {
                match self.start_successor(index, &asked) {
                    Ok((run, run_file, shadow)) => {
                        self.succession = Some(Succession::new(asked, run, run_file, shadow));
                    }
                    Err(Exit::Failure(failure)) => asked.refuse(failure),
                    Err(exit) => asked.refuse(Failure::new(FailureKind::Config, format!("{exit:?}"))),
                }
                return;
            }
        };
        asked.refuse(Failure::new(FailureKind::Run, refusal).with_help("`caraware ps` shows how far it is"));
    }

    fn start_successor(&self, index: usize, asked: &Asked) -> Result<(RunFile, PathBuf, Running), Exit> {
        let config = swap::changed(self.run(), &asked.request.set)?;
        let run = RunFile {
            config_hash: config::hash(&config),
            config,
            ..self.run().clone()
        };
        let run_file = succession::write_run(&run, "run.next.json")?;
        let (row, incarnation) = (self.running[index].row, self.running[index].incarnation + 1);
        let checkpoint = asked.request.checkpoint.as_ref();
        let (shadow, output) = cores::within(self.cores_of(row, 0), || {
            Running::start_shadow(row, &self.install, &run, &run_file, incarnation, checkpoint)
        })?;
        let sender = self.event_sender.clone();
        let wait = move || {
            let mut line = String::new();
            let read = output.map(|output| BufReader::new(output).read_line(&mut line));
            if matches!(read, Some(Ok(_))) && line == "ready\n" && sender.send(Event::Ready(incarnation)).is_err() {
                tracing::debug!("a successor is ready, but the run is over");
            }
        };
        std::thread::Builder::new()
            .name("successor".into())
            .spawn(wait)
            .map_err(|error| Exit::run(format!("cannot wait for the successor: {error}"), ""))?;
        Ok((run, run_file, shadow))
    }

    fn successor_ready(&mut self, incarnation: u32) {
        let Some(succession) = self.succession.take() else {
            return;
        };
        let (succession, leave) = succession.ready(incarnation);
        self.succession = Some(succession);
        if leave
            && let Some(trainer) = self
                .running
                .iter_mut()
                .find(|running| running.row.on_exit == OnExit::Replace)
        {
            for environment in &mut self.environments {
                environment.set_handing_over(true);
            }
            trainer.ask_to_leave();
            self.asked_to_leave = true;
        }
    }

    /// The successor is at work, or nothing comes of it.
    fn end_hand_over(&mut self) {
        for environment in &mut self.environments {
            environment.set_handing_over(false);
        }
    }

    /// The trainer has ended: true if a successor that waited for that takes its place.
    fn take_over(&mut self, index: usize, done: bool) -> Result<bool, Exit> {
        let Some(succession) = self.succession.take() else {
            return Ok(false);
        };
        if done || !succession.is_leaving() {
            self.succession = Some(succession);
            self.refuse_swap("the trainer ended meanwhile", "ask again if the run goes on");
            return Ok(false);
        }
        let (succession, taken) = succession.take();
        self.succession = Some(succession);
        let Some((mut successor, run)) = taken else {
            return Ok(false);
        };
        if !self.counts(successor.row, 0, successor.incarnation) {
            return Err(Exit::run("a run holds no more successors", "start another run"));
        }
        self.environments.iter().for_each(Environment::wake_sensing);
        succession::write_run(&run, "run.json")?;
        self.environments[0].run = run;
        self.asked_to_leave = false;
        successor.go();
        self.running[index] = successor;
        Ok(true)
    }

    /// Looks how a swap goes: a successor that failed is refused, one that has its first tick is at work.
    fn advance_swap(&mut self) {
        let Some(mut succession) = self.succession.take() else {
            return;
        };
        if let Some(failure) = succession.failure() {
            succession.refuse(failure);
            self.end_hand_over();
            return;
        }
        let progress = self.trainer().progress();
        if succession.is_taking() && progress.attached == 1 {
            self.end_hand_over();
            self.swaps.extend(succession.done(progress.committed_ticks));
        } else {
            self.succession = Some(succession);
        }
    }

    fn refuse_swap(&mut self, message: &str, help: &str) {
        if let Some(succession) = self.succession.take() {
            succession.refuse(Failure::new(FailureKind::Run, message).with_help(help));
            self.end_hand_over();
        }
    }

    /// Asks every process to end and waits; kills what does not, or everything at a second Ctrl-C.
    fn stop_all(&mut self, interrupted: bool) {
        if interrupted {
            eprintln!("stopping: the trainer writes a checkpoint (press Ctrl-C again to kill)");
        }
        self.running.iter_mut().for_each(|running| running.signal(Signal::TERM));
        let deadline = Instant::now() + STOP_WITHIN;
        while Instant::now() < deadline && self.running.iter_mut().any(|running| running.poll().is_none()) {
            if self.wait_for_event() {
                break;
            }
        }
        self.running.clear();
    }
}

/// Signals arrive in a channel, so that the supervisor can wait for them with a deadline.
fn watch_signals(sender: Sender<Event>) -> Result<Handle, Exit> {
    let failed = |error: &std::io::Error| Exit::run(format!("cannot watch signals: {error}"), "");
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGCHLD]).map_err(|error| failed(&error))?;
    let handle = signals.handle();
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            signals
                .forever()
                .take_while(|signal| sender.send(Event::Signal(*signal)).is_ok())
                .for_each(drop)
        })
        .map_err(|error| failed(&error))?;
    Ok(handle)
}
