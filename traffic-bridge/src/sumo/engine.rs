//! Where SUMO runs: in this process, or in one of its own that TraCI scripts connect to as well.

#![expect(unsafe_code, reason = "the child's parent-death signal is set between fork and exec")]

use std::{
    fs::File,
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};

use super::error::SumoError;

/// Longest time that SUMO may take to end by itself, once the connection is closed.
const END_WITHIN: Duration = Duration::from_secs(10);
/// Longest time that a SUMO that runs already may take to listen: it reads its files first.
pub(super) const LISTENS_WITHIN: Duration = Duration::from_secs(20);
/// Time between two looks.
const LOOK: Duration = Duration::from_millis(20);

/// Where SUMO runs.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Engine {
    /// libsumo, in this process.
    #[default]
    InProcess,
    /// A process of its own, over TraCI.
    Traci(TraciServer),
    /// A SUMO that runs already, over TraCI.
    Attached(RunningServer),
}

/// A SUMO that the user has started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunningServer {
    /// Its host.
    pub host: String,
    /// The port that it listens on.
    pub port: u16,
    /// Place of this process among its clients.
    pub order: u32,
}

impl std::fmt::Display for RunningServer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{}", self.host, self.port)
    }
}

/// A SUMO that listens for TraCI clients.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TraciServer {
    /// The program: `sumo` or `sumo-gui`.
    pub program: PathBuf,
    /// The port that it listens on.
    pub port: u16,
    /// Clients that it waits for, with this process.
    pub clients: u32,
    /// File for what SUMO writes.
    pub log: PathBuf,
}

/// The process of a [`TraciServer`]; dropping it ends the process.
#[derive(Debug)]
pub(super) struct ServerProcess {
    child: Child,
    log: PathBuf,
}

impl ServerProcess {
    /// Starts SUMO with its options.
    pub(super) fn start(server: &TraciServer, arguments: &[String], sumo_home: &Path) -> Result<Self, SumoError> {
        let failed = |source| SumoError::Server {
            program: server.program.clone(),
            source,
        };
        if let Some(folder) = server.log.parent() {
            std::fs::create_dir_all(folder).map_err(failed)?;
        }
        let log = File::create(&server.log).map_err(failed)?;
        let mut command = Command::new(&server.program);
        command
            .args(arguments)
            .args(["--remote-port", &server.port.to_string()])
            .args(["--num-clients", &server.clients.to_string()])
            .env("SUMO_HOME", sumo_home)
            .stdin(Stdio::null())
            .stdout(log.try_clone().map_err(failed)?)
            .stderr(log);
        if server.program.ends_with("sumo-gui") {
            command.args(["--start", "--quit-on-end"]);
        }
        // SAFETY: the closure makes one system call, which is async-signal-safe, and touches no memory of this process.
        unsafe {
            command.pre_exec(|| Ok(set_parent_process_death_signal(Some(Signal::KILL))?));
        }
        let child = command.spawn().map_err(failed)?;
        Ok(Self {
            child,
            log: server.log.clone(),
        })
    }

    /// True while SUMO runs.
    pub(super) fn is_alive(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Waits a moment.
    pub(super) fn wait_a_moment() {
        std::thread::park_timeout(LOOK);
    }

    /// What SUMO has written.
    pub(super) fn messages(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Waits until SUMO has completed its outputs. A client that is still connected keeps it alive: then SUMO is asked to end.
    fn end(&mut self) {
        for signal in [None, Some(Signal::TERM), Some(Signal::KILL)] {
            if let (Some(signal), Some(pid)) = (signal, Pid::from_raw(self.child.id().cast_signed()))
                && let Err(error) = kill_process(pid, signal)
            {
                tracing::debug!(%error, "SUMO has ended");
            }
            let since = Instant::now();
            while self.is_alive() && since.elapsed() < END_WITHIN {
                Self::wait_a_moment();
            }
            if !self.is_alive() {
                return;
            }
        }
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        self.end();
    }
}
