//! The supervisor: owns a run, creates every channel, starts and watches the processes, and ends them all.

use std::{
    io::{BufRead as _, BufReader},
    os::unix::process::ExitStatusExt as _,
    path::PathBuf,
    process::ExitStatus,
    sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    time::{Duration, Instant},
};

use ipc_schema::{
    board::State,
    failure::{Failure, FailureKind},
    ports::{BoardReader, RosterWriter},
    process::Process,
    run::RunFile,
    services::{self, RunNode, ServiceHolder},
};
use rustix::process::Signal;
use signal_hook::{
    consts::{SIGCHLD, SIGINT, SIGTERM},
    iterator::{Handle, Signals},
};

use crate::{
    config,
    display::Display,
    failure::Exit,
    install::Install,
    process_table::{OnExit, Row, Running, TABLE},
    registry::Claim,
    succession::{self, Succession},
    swap::{self, Asked, Handover},
};

/// What the supervisor waits for.
#[derive(Debug)]
enum Event {
    /// A signal came.
    Signal(i32),
    /// `caraware swap` asks for another trainer.
    Swap(Asked),
    /// The successor of this incarnation is ready.
    Ready(u32),
}

/// Time between two looks at the processes when nothing happens.
const LOOK: Duration = Duration::from_millis(100);
/// The same while a successor opens its ports: how long that takes is told.
const HAND_OVER_LOOK: Duration = Duration::from_millis(5);
/// Longest time from start to ready.
const READY_WITHIN: Duration = Duration::from_secs(120);
/// Longest time from SIGTERM to the end of a process, before SIGKILL.
const STOP_WITHIN: Duration = Duration::from_secs(30);
/// Most restarts of a process that only watches.
const MAX_RESTARTS: u32 = 20;
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
    boards: Vec<(Process, BoardReader)>,
    roster: RosterWriter,
    _services: ServiceHolder,
    node: RunNode,
    _claim: Claim,
    run: RunFile,
    run_file: PathBuf,
    install: Install,
    events: Receiver<Event>,
    event_sender: Sender<Event>,
    signal_handle: Handle,
    restarts: u32,
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
        let run_file = run.write()?;
        let (event_sender, events) = channel();
        let signal_handle = watch_signals(event_sender.clone())?;
        let sender = event_sender.clone();
        swap::listen(&run, move |asked| sender.send(Event::Swap(asked)).is_ok())?;
        let node = services::node(&run.shared_memory)?;
        let holder = ServiceHolder::create(&node, &run, 0)?;
        let roster = RosterWriter::create(&holder)?;
        let boards = Process::ALL
            .into_iter()
            .map(|process| Ok((process, BoardReader::open(&node, &run, 0, process)?)))
            .collect::<Result<_, Exit>>()?;
        Ok(Self {
            succession: None,
            asked_to_leave: false,
            running: Vec::new(),
            boards,
            roster,
            _services: holder,
            node,
            _claim: claim,
            run,
            run_file,
            install,
            events,
            event_sender,
            signal_handle,
            restarts: 0,
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
            self.note_ready(started)?;
            display.update(&self.run, &self.boards, self.ready_at);
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
        let wall_s = self.ready_at.unwrap_or(started).elapsed().as_secs_f64();
        display.update(&self.run, &self.boards, self.ready_at);
        display.finish();
        self.stop_all(interrupted);
        Ok(Outcome {
            interrupted,
            wall_s,
            restarts: self.restarts,
            swaps: std::mem::take(&mut self.swaps),
        })
    }

    fn wanted(&self) -> impl Iterator<Item = &'static Row> + use<'_> {
        TABLE.iter().filter(|row| (row.wanted)(&self.run))
    }

    fn board(&self, process: Process) -> Option<&BoardReader> {
        self.boards
            .iter()
            .find(|(known, _)| *known == process)
            .map(|(_, board)| board)
    }

    fn state_of(&self, process: Process) -> State {
        self.board(process)
            .map_or(State::Starting, |board| State::from_u32(board.health().state))
    }

    fn is_started(&self, process: Process) -> bool {
        self.running.iter().any(|running| running.row.process == process)
    }

    fn start_what_can(&mut self) -> Result<(), Exit> {
        let due: Vec<&'static Row> = self
            .wanted()
            .filter(|row| !self.is_started(row.process))
            .filter(|row| row.needs.iter().all(|need| self.state_of(*need) != State::Starting))
            .collect();
        for row in due {
            self.running
                .push(Running::start(row, &self.install, &self.run, &self.run_file, 0)?);
        }
        Ok(())
    }

    /// Looks for ended processes: a failure of a required one ends the run; watchers, and a trainer that died, are started again.
    fn reap(&mut self) -> Result<(), Exit> {
        for index in 0..self.running.len() {
            let Some(status) = self.running[index].poll() else {
                continue;
            };
            let row = self.running[index].row;
            let done = self.state_of(row.process) == State::Done;
            if status.success() && done {
                continue;
            }
            services::forget_dead(&self.node);
            if row.on_exit == OnExit::Replace && self.take_over(index, done)? {
                continue;
            }
            match row.on_exit {
                OnExit::Restart if self.running[index].incarnation < MAX_RESTARTS => self.restart(index)?,
                OnExit::Restart => {}
                // All that it had to do is on disk.
                OnExit::Replace if done => {}
                OnExit::Replace if status.signal().is_some() => self.replace(index, status)?,
                OnExit::Replace if self.asked_to_leave && status.success() => self.restart(index)?,
                OnExit::Required | OnExit::Replace => {
                    return Err(self.running[index].failure(&self.run, status).into());
                }
            }
        }
        Ok(())
    }

    /// Replaces a trainer that died, unless that has been in vain for too long.
    fn replace(&mut self, index: usize, status: ExitStatus) -> Result<(), Exit> {
        let process = self.running[index].row.process;
        let committed = self.board(process).map_or(0, |board| board.progress().committed_ticks);
        if committed > self.committed_ticks {
            self.committed_ticks = committed;
            self.vain_replacements = 0;
        }
        self.vain_replacements += 1;
        if self.vain_replacements > MAX_VAIN_REPLACEMENTS {
            let mut failure = self.running[index].failure(&self.run, status);
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
        let incarnation = self.running[index].incarnation + 1;
        let process = self.running[index].row.process;
        if !self.roster.set(process, incarnation) {
            return Err(Exit::run(
                format!(
                    "{process} has been replaced {} times: a run holds no more",
                    incarnation - 1
                ),
                "find out from its log why it dies",
            ));
        }
        self.restarts += 1;
        self.asked_to_leave &= process != Process::Trainer;
        self.running[index] = Running::start(
            self.running[index].row,
            &self.install,
            &self.run,
            &self.run_file,
            incarnation,
        )?;
        Ok(())
    }

    /// Remembers when the last required process got ready; gives up if one does not.
    fn note_ready(&mut self, started: Instant) -> Result<(), Exit> {
        if self.ready_at.is_some() {
            return Ok(());
        }
        let late = self
            .wanted()
            .filter(|row| row.is_required())
            .find(|row| self.state_of(row.process) == State::Starting);
        match late {
            None => self.ready_at = Some(self.last_look),
            Some(row) if started.elapsed() > READY_WITHIN => {
                let log = self.run.run_dir.join("logs").join(format!("{}.log", row.process));
                let message = format!("{} was not ready within {} s", row.process, READY_WITHIN.as_secs());
                return Err(Failure::new(FailureKind::Run, message)
                    .with_help(format!("its log is {}", log.display()))
                    .into());
            }
            Some(_) => {}
        }
        Ok(())
    }

    fn finished(&mut self) -> bool {
        let wanted = self.wanted().filter(|row| row.is_required()).count();
        let required = self.running.iter_mut().filter(|running| running.row.is_required());
        required
            .map(|running| usize::from(running.poll().is_some()))
            .sum::<usize>()
            == wanted
    }

    /// Waits for something to happen, at most [`LOOK`]; true if it asks the run to end.
    fn wait_for_event(&mut self) -> bool {
        let taking = self.succession.as_ref().is_some_and(Succession::is_taking);
        match self.events.recv_timeout(if taking { HAND_OVER_LOOK } else { LOOK }) {
            Ok(Event::Signal(signal)) => return signal != SIGCHLD,
            Ok(Event::Swap(asked)) => self.begin_swap(asked),
            Ok(Event::Ready(incarnation)) => self.successor_ready(incarnation),
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
        }
        false
    }

    /// Starts a successor beside the trainer at work, or refuses.
    fn begin_swap(&mut self, asked: Asked) {
        let state = self.state_of(Process::Trainer);
        let index = self
            .running
            .iter()
            .position(|running| running.row.on_exit == OnExit::Replace);
        let refusal = match (&self.succession, index, state) {
            (Some(_), ..) => "another swap is under way",
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
        let config = swap::changed(&self.run, &asked.request.set)?;
        let run = RunFile {
            config_hash: config::hash(&config),
            config,
            ..self.run.clone()
        };
        let run_file = succession::write_run(&run, "run.next.json")?;
        let (row, incarnation) = (self.running[index].row, self.running[index].incarnation + 1);
        let checkpoint = asked.request.checkpoint.as_ref();
        let (shadow, output) = Running::start_shadow(row, &self.install, &run, &run_file, incarnation, checkpoint)?;
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
            trainer.ask_to_leave();
            self.asked_to_leave = true;
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
        if !self.roster.set(Process::Trainer, successor.incarnation) {
            return Err(Exit::run("a run holds no more successors", "start another run"));
        }
        succession::write_run(&run, "run.json")?;
        self.run = run;
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
            return;
        }
        let progress = self
            .board(Process::Trainer)
            .map(BoardReader::progress)
            .unwrap_or_default();
        if succession.is_taking() && progress.attached == 1 {
            self.swaps.extend(succession.done(progress.committed_ticks));
        } else {
            self.succession = Some(succession);
        }
    }

    fn refuse_swap(&mut self, message: &str, help: &str) {
        if let Some(succession) = self.succession.take() {
            succession.refuse(Failure::new(FailureKind::Run, message).with_help(help));
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
