//! The supervisor: owns a run, creates every channel, starts and watches the processes, and ends them all.

use std::{
    os::unix::process::ExitStatusExt as _,
    path::PathBuf,
    process::ExitStatus,
    sync::mpsc::{Receiver, RecvTimeoutError, channel},
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
    display::Display,
    failure::Exit,
    install::Install,
    process_table::{OnExit, Row, Running, TABLE},
    registry::Claim,
};

/// Time between two looks at the processes when nothing happens.
const LOOK: Duration = Duration::from_millis(100);
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
}

/// A run under supervision. Dropping it kills what is left and empties its shared memory.
pub struct Supervisor {
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
    signals: Receiver<i32>,
    signal_handle: Handle,
    restarts: u32,
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
        let (signals, signal_handle) = watch_signals()?;
        let node = services::node(&run.shared_memory)?;
        let holder = ServiceHolder::create(&node, &run, 0)?;
        let roster = RosterWriter::create(&holder)?;
        let boards = Process::ALL
            .into_iter()
            .map(|process| Ok((process, BoardReader::open(&node, &run, 0, process)?)))
            .collect::<Result<_, Exit>>()?;
        Ok(Self {
            running: Vec::new(),
            boards,
            roster,
            _services: holder,
            node,
            _claim: claim,
            run,
            run_file,
            install,
            signals,
            signal_handle,
            restarts: 0,
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
            self.note_ready(started)?;
            display.update(&self.run, &self.boards, self.ready_at);
            self.last_look = Instant::now();
            if self.finished() {
                break;
            }
            if self.interrupted() {
                interrupted = true;
                break;
            }
        }
        let wall_s = self.ready_at.unwrap_or(started).elapsed().as_secs_f64();
        display.update(&self.run, &self.boards, self.ready_at);
        display.finish();
        self.stop_all(interrupted);
        Ok(Outcome {
            interrupted,
            wall_s,
            restarts: self.restarts,
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
            match row.on_exit {
                OnExit::Restart if self.running[index].incarnation < MAX_RESTARTS => self.restart(index)?,
                OnExit::Restart => {}
                // All that it had to do is on disk.
                OnExit::Replace if done => {}
                OnExit::Replace if status.signal().is_some() => self.replace(index, status)?,
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

    /// Waits for a signal, at most [`LOOK`]; true if it asks the run to end.
    fn interrupted(&self) -> bool {
        match self.signals.recv_timeout(LOOK) {
            Ok(signal) => signal != SIGCHLD,
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => false,
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
            if self.interrupted() {
                break;
            }
        }
        self.running.clear();
    }
}

/// Signals arrive in a channel, so that the supervisor can wait for them with a deadline.
fn watch_signals() -> Result<(Receiver<i32>, Handle), Exit> {
    let failed = |error: &std::io::Error| Exit::run(format!("cannot watch signals: {error}"), "");
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGCHLD]).map_err(|error| failed(&error))?;
    let handle = signals.handle();
    let (sender, receiver) = channel();
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            signals
                .forever()
                .take_while(|signal| sender.send(*signal).is_ok())
                .for_each(drop)
        })
        .map_err(|error| failed(&error))?;
    Ok((receiver, handle))
}
