//! `caraware train --restart`: starts the run in a process of its own, and resumes it when that process, the supervisor, is killed.

use std::{
    ffi::OsString,
    os::unix::process::{CommandExt as _, ExitStatusExt as _},
    path::{Path, PathBuf},
    process::{Child, Command, ExitCode, ExitStatus},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, RecvTimeoutError, channel},
    },
    time::{Duration, Instant},
};

use ipc_schema::run::RunFile;
use rustix::process::{Pid, Signal, kill_process};
use signal_hook::{
    consts::{SIGCHLD, SIGHUP, SIGINT, SIGTERM},
    iterator::Signals,
};

use crate::{
    cli::{RunArgs, TrainArgs, ViewerKind},
    display::notice,
    failure::Exit,
    housekeeping::is_disk_full,
    preparation_mark, registry,
    restart::{EndCause, RequiredRestarts, RestartVerdict},
};

/// Longest wait between two looks at the supervisor, should a signal be lost.
const LOOK: Duration = Duration::from_secs(1);

/// Starts and resumes the run until its supervisor ends by itself. Returns the exit code of the run.
///
/// # Errors
/// The program cannot be started, or the supervisor crashes again and again without a new checkpoint.
pub fn train(args: &TrainArgs) -> Result<ExitCode, Exit> {
    let signals = watch_signals()?;
    let mut run = RelaunchedRun::new(args)?;
    let mut restarts = RequiredRestarts::default();
    loop {
        let status = run.run_once(&signals)?;
        let Some(signal) = status.signal() else {
            return Ok(ExitCode::from(u8::try_from(status.code().unwrap_or(1)).unwrap_or(1)));
        };
        run.find_directory();
        let what = format!("the supervisor ended with signal {signal}");
        // A stop on request ends the restarts, too.
        if run.is_stopped.load(Ordering::Relaxed) {
            return Err(Exit::run(what, "`caraware train --resume` continues the run"));
        }
        let checkpoints = run.count_checkpoint();
        let pause = match restarts.verdict(checkpoints, EndCause::of(status), Instant::now()) {
            RestartVerdict::GiveUp => {
                let message = format!("{what}, again and again without a new checkpoint");
                return Err(Exit::run(message, "`caraware train --resume` continues the run"));
            }
            RestartVerdict::Postpone(pause) => pause,
            RestartVerdict::Start | RestartVerdict::Wait => Duration::ZERO,
        };
        notice(&format!("{what}; the run resumes in {:.1} s", pause.as_secs_f64()));
        let due = Instant::now() + pause;
        let mut has_said = false;
        while Instant::now() < due || run.is_without_space() {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() && !std::mem::replace(&mut has_said, true) {
                notice("the disk is full: the run resumes once there is space");
            }
            if run.wait_for_signal(&signals, if left.is_zero() { LOOK } else { left }) {
                return Err(Exit::Interrupted);
            }
        }
        restarts.start_now();
    }
}

/// A run and the supervisor that it has at present.
struct RelaunchedRun {
    program: PathBuf,
    args: TrainArgs,
    /// The directory of the run, once it is known.
    directory: Option<PathBuf>,
    /// The directory of the name that the user gave, if it did not exist before the run.
    claimed: Option<PathBuf>,
    supervisor_pid: i32,
    is_stopped: Arc<AtomicBool>,
    /// The newest checkpoint, and the number of those that were the newest at a restart.
    newest: (String, u64),
}

impl RelaunchedRun {
    fn new(args: &TrainArgs) -> Result<Self, Exit> {
        let program = std::env::current_exe()
            .map_err(|error| Exit::missing(format!("cannot find the program caraware: {error}"), "run `make build`"))?;
        let named = args.run.name.as_ref().map(|name| args.run.runs.join(name));
        Ok(Self {
            program,
            args: args.clone(),
            directory: None,
            claimed: named.filter(|directory| !directory.exists()),
            supervisor_pid: 0,
            is_stopped: Arc::default(),
            newest: (String::new(), 0),
        })
    }

    /// Starts a supervisor, forwards signals to it, and waits for its end.
    fn run_once(&mut self, signals: &Receiver<i32>) -> Result<ExitStatus, Exit> {
        let mut command = Command::new(&self.program);
        match &self.directory {
            Some(directory) => command.args(resume_arguments(&self.args.run, directory)),
            None => command.args(std::env::args_os().skip(1).filter(|argument| argument != "--restart")),
        };
        // In a process group of its own it gets the Ctrl-C of a terminal once, from here.
        let mut child: Child = command
            .process_group(0)
            .spawn()
            .map_err(|error| Exit::io("start", &self.program, &error))?;
        self.supervisor_pid = i32::try_from(child.id()).unwrap_or(0);
        loop {
            if let Some(status) = child
                .try_wait()
                .map_err(|error| Exit::io("wait for", &self.program, &error))?
            {
                return Ok(status);
            }
            self.wait_for_signal(signals, LOOK);
        }
    }

    /// Waits for a signal, at most `time`, and forwards it to the supervisor. True if it asks the run to end.
    fn wait_for_signal(&self, signals: &Receiver<i32>, time: Duration) -> bool {
        let signal = match signals.recv_timeout(time) {
            Ok(SIGINT) => Signal::INT,
            Ok(SIGTERM) => Signal::TERM,
            Ok(SIGHUP) => Signal::HUP,
            Ok(_) | Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => return false,
        };
        self.is_stopped.store(true, Ordering::Relaxed);
        if let Some(pid) = Pid::from_raw(self.supervisor_pid)
            && let Err(error) = kill_process(pid, signal)
        {
            tracing::debug!(%error, "the supervisor has ended");
        }
        true
    }

    /// Finds the directory of the run that the dead supervisor had. A directory that it prepared, and that has no run file yet, is
    /// removed: the run starts again under the same name.
    fn find_directory(&mut self) {
        let runs = || {
            let entries = std::fs::read_dir(&self.args.run.runs).into_iter().flatten().flatten();
            entries.map(|entry| entry.path())
        };
        let named = self.args.resume.iter().map(PathBuf::from);
        let mut candidates = runs().chain(named);
        let is_its_own = |directory: &PathBuf| {
            let run = RunFile::read(&directory.join("run.json"));
            run.is_ok_and(|run| run.supervisor_pid == self.supervisor_pid)
        };
        if let Some(found) = candidates.find(is_its_own) {
            self.directory = Some(found);
        }
        if self.directory.is_some() {
            return;
        }
        // Without a name from the user it is the marked one.
        let marked = runs().find(|directory| preparation_mark::is_prepared_by(directory, self.supervisor_pid));
        if let Some(prepared) = self.claimed.clone().or(marked)
            && prepared.is_dir()
            && !prepared.join("run.json").exists()
            && let Err(error) = preparation_mark::remove_prepared(&prepared, self.supervisor_pid)
        {
            notice(&format!("cannot remove {}: {error}", prepared.display()));
        }
    }

    /// True if the disk of the run, or that of iceoryx2's files, is full: a resume would be refused.
    fn is_without_space(&self) -> bool {
        let directory = self.directory.as_ref().unwrap_or(&self.args.run.runs);
        is_disk_full(directory) || is_disk_full(&registry::base())
    }

    /// Number of restarts before which there was a checkpoint that the restart before did not have.
    fn count_checkpoint(&mut self) -> u64 {
        let latest = self
            .directory
            .as_ref()
            .map(|directory| directory.join("checkpoints/latest"));
        let newest = latest
            .and_then(|path| std::fs::read_to_string(path).ok())
            .unwrap_or_default();
        if newest != self.newest.0 {
            self.newest = (newest, self.newest.1 + 1);
        }
        self.newest.1
    }
}

/// The command line that resumes the run in `directory`: its configuration is in its run file.
fn resume_arguments(args: &RunArgs, directory: &Path) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = vec!["train".into(), "--resume".into(), directory.into()];
    arguments.extend(args.quiet.then(|| "--quiet".into()));
    arguments.extend(args.viewer.map(|viewer| match viewer {
        ViewerKind::Window => "--viewer=window".into(),
        ViewerKind::Web => "--viewer=web".into(),
    }));
    let credentials = &args.credentials;
    let files = [
        ("--password-file", &credentials.password_file),
        ("--ca", &credentials.ca),
        ("--certificate", &credentials.certificate),
        ("--key", &credentials.key),
    ];
    for (option, file) in files {
        arguments.extend(file.iter().flat_map(|file| [option.into(), file.into()]));
    }
    let user = credentials.user.iter();
    arguments.extend(user.flat_map(|user| ["--user".into(), user.into()]));
    arguments
}

/// Forwards signals to a channel: those that end a run, and that a child has ended.
fn watch_signals() -> Result<Receiver<i32>, Exit> {
    let failed = |error: &std::io::Error| Exit::run(format!("cannot watch signals: {error}"), "");
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP, SIGCHLD]).map_err(|error| failed(&error))?;
    let (sender, receiver) = channel();
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            signals
                .forever()
                .take_while(|signal| sender.send(*signal).is_ok())
                .for_each(drop);
        })
        .map_err(|error| failed(&error))?;
    Ok(receiver)
}
