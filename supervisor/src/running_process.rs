//! A started process of a run: its output, its exit status, its failure, and its end.

use std::{
    fs::{File, OpenOptions},
    io::Write as _,
    os::unix::process::{CommandExt as _, ExitStatusExt as _},
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, ExitStatus, Stdio},
    time::Duration,
};

use ipc_schema::{
    failure::{Failure, FailureKind},
    process::{Process, ProcessSpec, Program},
    reserve::{self, SHARED_MEMORY},
    run::RunFile,
};
use rustix::process::{Pid, Signal, kill_process, kill_process_group};

use crate::{failure::Exit, install::Install, socket::HandoverRequest};

/// Settings of glibc's allocator for `fanout`, which makes and drops long frames of changing lengths. By default the allocator soon keeps
/// blocks of that size in its heaps, one for each thread of zenoh, where they leave holes: memory grew by megabytes an hour.
const FANOUT_ALLOCATOR: [(&str, &str); 2] = [("MALLOC_MMAP_THRESHOLD_", "65536"), ("MALLOC_ARENA_MAX", "2")];

/// Environment variable: completed handovers of the run, without those that fell back. Trainers that learn together compare it.
const HANDOVERS: &str = "CARAWARE_HANDOVERS";

/// The command that starts the process of a row.
///
/// # Errors
/// The program has not been built.
fn command(row: &ProcessSpec, install: &Install, run: &RunFile) -> Result<Command, Exit> {
    match row.program {
        Program::Binary(name) => install.binary(name(run)).map(Command::new),
        Program::PythonModule(module) => {
            let mut command = Command::new(&install.python);
            command.args(["-m", module(run)]).env("PYTHONUNBUFFERED", "1");
            Ok(command)
        }
    }
}

/// Opens the log of a row, to append to it.
fn open_log(row: &ProcessSpec, run: &RunFile) -> Result<(File, PathBuf), Exit> {
    let path = run.run_dir.join("logs").join(format!("{}.log", row.process));
    let log = OpenOptions::new().create(true).append(true).open(&path);
    log.map(|log| (log, path.clone()))
        .map_err(|error| Exit::io("open", &path, &error))
}

/// When a trainer leaves for its successor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeaveTime {
    /// After its next update: nothing is learnt again.
    NextUpdate,
    /// At the next tick: what it has not learnt from comes again to the successor.
    NextTick,
}

impl LeaveTime {
    /// The signal that asks for it.
    fn signal(self) -> Signal {
        match self {
            Self::NextUpdate => Signal::USR1,
            Self::NextTick => Signal::USR2,
        }
    }
}

/// A started process. Dropping it kills its process group.
#[derive(Debug)]
pub struct RunningProcess {
    /// Its row.
    pub row: &'static ProcessSpec,
    /// Its environment.
    pub env_index: u32,
    /// Number of starts before this one.
    pub incarnation: u32,
    child: Child,
    exit: Option<ExitStatus>,
}

impl RunningProcess {
    /// Starts a row in its own process group, after so many completed handovers of the trainer. Its output goes to `logs/<process>.log`.
    ///
    /// # Errors
    /// The program is missing or cannot be started.
    pub fn start(
        row: &'static ProcessSpec,
        install: &Install,
        run: &RunFile,
        run_file: &Path,
        incarnation: u32,
        handovers: u32,
    ) -> Result<Self, Exit> {
        Self::spawn(row, install, run, run_file, incarnation, |command| {
            command.env(HANDOVERS, handovers.to_string());
        })
    }

    /// Starts a successor beside the working process of `row`. It reports on the returned standard output that it is ready, and waits
    /// for [`RunningProcess::begin_work`]. `request` says from which checkpoint it loads its parameters, `handovers` how many the run has
    /// had when it works.
    ///
    /// # Errors
    /// As [`RunningProcess::start`].
    pub fn start_successor(
        row: &'static ProcessSpec,
        install: &Install,
        run: &RunFile,
        run_file: &Path,
        incarnation: u32,
        handovers: u32,
        request: &HandoverRequest,
    ) -> Result<(Self, Option<ChildStdout>), Exit> {
        let mut successor = Self::spawn(row, install, run, run_file, incarnation, |command| {
            command
                .env("CARAWARE_SUCCESSOR", "1")
                .envs(request.checkpoint.iter().map(|path| ("CARAWARE_CHECKPOINT", path)))
                .env(HANDOVERS, handovers.to_string())
                .stdin(Stdio::piped())
                .stdout(Stdio::piped());
        })?;
        let output = successor.child.stdout.take();
        Ok((successor, output))
    }

    /// Starts the work of a ready successor, after the old process has ended.
    pub fn begin_work(&mut self) {
        if let Some(mut input) = self.child.stdin.take()
            && let Err(error) = input.write_all(b"go\n")
        {
            tracing::warn!(%error, process = %self.row.process, "the successor ended before it became the trainer");
        }
    }

    fn spawn(
        row: &'static ProcessSpec,
        install: &Install,
        run: &RunFile,
        run_file: &Path,
        incarnation: u32,
        change: impl FnOnce(&mut Command),
    ) -> Result<Self, Exit> {
        let (log, log_path) = open_log(row, run)?;
        let errors = log.try_clone().map_err(|error| Exit::io("open", &log_path, &error))?;
        let mut command = command(row, install, run)?;
        command
            .arg(run_file)
            .env(ipc_schema::membership::INCARNATION, incarnation.to_string())
            .stdin(Stdio::null())
            .stdout(log)
            .stderr(errors)
            .process_group(0);
        if row.process == Process::Fanout {
            command.envs(FANOUT_ALLOCATOR);
        }
        change(&mut command);
        let program = command.get_program().to_string_lossy().into_owned();
        let child = command.spawn().map_err(|error| {
            Exit::missing(
                format!("cannot start {program}: {error}"),
                "run `make build`, then `caraware doctor`",
            )
        })?;
        Ok(Self {
            row,
            env_index: run.env_index,
            incarnation,
            child,
            exit: None,
        })
    }

    /// Its exit status, if it has ended.
    pub fn poll(&mut self) -> Option<ExitStatus> {
        if self.exit.is_none() {
            self.exit = self.child.try_wait().ok().flatten();
        }
        self.exit
    }

    /// What the kernel says of it, for messages.
    #[must_use]
    pub fn kernel_state(&self) -> &'static str {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id())).unwrap_or_default();
        let state = stat.rsplit_once(") ").and_then(|(_, rest)| rest.chars().next());
        match state {
            Some('T' | 't') => "a signal or a debugger has stopped it",
            Some('R') => "it computes",
            Some('D') => "it waits for a device",
            Some('S') => "it sleeps",
            _ => "it is gone",
        }
    }

    /// Time that its main thread has waited for a core: the kernel's second figure in `schedstat`, nanoseconds.
    #[must_use]
    pub fn queued(&self) -> Duration {
        let figures = std::fs::read_to_string(format!("/proc/{}/schedstat", self.child.id())).unwrap_or_default();
        let queued_ns = figures.split_whitespace().nth(1).and_then(|figure| figure.parse().ok());
        Duration::from_nanos(queued_ns.unwrap_or(0))
    }

    /// Sends `signal` to its process group, unless it has ended.
    pub fn signal(&mut self, signal: Signal) {
        if self.poll().is_some() {
            return;
        }
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw)
            && let Err(error) = kill_process_group(pid, signal)
        {
            tracing::debug!(%error, process = %self.row.process, "cannot signal");
        }
    }

    /// Kills it with its group and waits for its end.
    pub fn kill(&mut self) {
        self.signal(Signal::KILL);
        if self.exit.is_none() {
            self.exit = self.child.wait().ok();
        }
    }

    /// Asks it to leave for its successor. Unlike [`RunningProcess::signal`], the signal goes to the process alone, not to its group.
    pub fn ask_to_leave(&mut self, when: LeaveTime) {
        if self.poll().is_none()
            && let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw)
            && let Err(error) = kill_process(pid, when.signal())
        {
            tracing::debug!(%error, process = %self.row.process, "cannot signal");
        }
    }

    /// True if it has reported a failure.
    #[must_use]
    pub fn has_reported_failure(&self, run: &RunFile) -> bool {
        Failure::read(&run.run_dir, self.row.process.name()).is_some()
    }

    /// Appends a line of the supervisor to its log.
    pub fn log(&self, run: &RunFile, line: &str) {
        let written = open_log(self.row, run).and_then(|(mut log, path)| {
            writeln!(log, "caraware: {line}").map_err(|error| Exit::io("write", &path, &error))
        });
        if let Err(exit) = written {
            tracing::debug!(?exit, "cannot write a note");
        }
    }

    /// The failure that it reported, or the end of its log.
    #[must_use]
    pub fn failure(&self, run: &RunFile, status: ExitStatus) -> Failure {
        let name = self.row.process.name();
        if let Some(mut failure) = Failure::read(&run.run_dir, name) {
            failure.message = format!("{}: {}", self.row.label(run), failure.message);
            return failure;
        }
        if status.signal() == Some(signal_hook::consts::SIGBUS) {
            return Failure::new(
                FailureKind::Missing,
                format!(
                    "{} needed more shared memory: {SHARED_MEMORY} has {} MiB free, and the run's reserve is used up",
                    self.row.label(run),
                    reserve::free_bytes() >> 20
                ),
            )
            .with_help(format!(
                "free space in {SHARED_MEMORY}, or enlarge it (Docker: --shm-size)"
            ));
        }
        let log = run.run_dir.join("logs").join(format!("{name}.log"));
        let text = std::fs::read_to_string(&log).unwrap_or_default();
        let tail: Vec<&str> = text.lines().rev().take(5).collect();
        let tail = tail.into_iter().rev().collect::<Vec<_>>().join("\n  ");
        Failure::new(
            FailureKind::Run,
            format!("{} ended with {status}\n  {tail}", self.row.label(run)),
        )
        .with_help(format!("its log is {}", log.display()))
    }
}

impl Drop for RunningProcess {
    fn drop(&mut self) {
        self.kill();
    }
}
