//! The processes of a run, found by their command lines, because a process may be killed before it has published its process id.

use std::{fs, path::Path};

use rustix::process::{Pid, Signal, kill_process};

/// A process that can be disturbed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Target {
    TrafficBridge,
    SimCore,
    SensorDaemon,
    V2x,
    Trainer,
    Fanout,
    Recorder,
    Supervisor,
}

impl Target {
    /// Every target.
    pub const ALL: [Self; 8] = [
        Self::TrafficBridge,
        Self::SimCore,
        Self::SensorDaemon,
        Self::V2x,
        Self::Trainer,
        Self::Fanout,
        Self::Recorder,
        Self::Supervisor,
    ];

    /// Its name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::TrafficBridge => "traffic-bridge",
            Self::SimCore => "sim-core",
            Self::SensorDaemon => "sensor-daemon",
            Self::V2x => "v2x",
            Self::Trainer => "trainer",
            Self::Fanout => "fanout",
            Self::Recorder => "recorder",
            Self::Supervisor => "supervisor",
        }
    }

    /// True if it belongs to one environment.
    #[must_use]
    pub const fn is_simulator(self) -> bool {
        matches!(
            self,
            Self::TrafficBridge | Self::SimCore | Self::SensorDaemon | Self::V2x
        )
    }

    /// Live processes of this kind that belong to the run in `directory`. The supervisor is a child of this program and not found here.
    #[must_use]
    pub fn processes(self, directory: &Path) -> Vec<Pid> {
        let matches = |line: &[String]| match self {
            Self::Trainer => line.iter().any(|argument| argument == "caraware.train"),
            _ => line.first().is_some_and(|program| program.ends_with(self.name())),
        };
        processes_of(directory)
            .into_iter()
            .filter(|(_, line)| matches(line))
            .map(|(pid, _)| pid)
            .collect()
    }
}

/// Processes whose command lines name a path in `directory`, with their arguments. A process that has ended has no arguments.
#[must_use]
pub fn processes_of(directory: &Path) -> Vec<(Pid, Vec<String>)> {
    let prefix = format!("{}/", directory.display());
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let described = entries.filter_map(|entry| {
        let pid = Pid::from_raw(entry.file_name().to_str()?.parse().ok()?)?;
        let line = fs::read(entry.path().join("cmdline")).ok()?;
        let arguments = line.split(|byte| *byte == 0);
        let arguments: Vec<String> = arguments
            .map(|argument| String::from_utf8_lossy(argument).into_owned())
            .collect();
        Some((pid, arguments))
    });
    described
        .filter(|(_, line)| line.iter().any(|argument| argument.contains(&prefix)))
        .collect()
}

/// Sends a signal; false if the process has ended.
pub fn signal(pid: Pid, signal: Signal) -> bool {
    kill_process(pid, signal).is_ok()
}

/// Memory of a process that is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CountedMemory {
    /// All that is resident.
    Resident,
    /// What is resident and belongs to the process alone: neither shared memory, whose pages count once they have been touched, nor files.
    Private,
}

/// Memory (MiB) and open handles of a process; `None` if it has ended.
#[must_use]
pub fn resources(pid: Pid, memory: CountedMemory) -> Option<(f64, f64)> {
    let key = match memory {
        CountedMemory::Resident => "VmRSS:",
        CountedMemory::Private => "RssAnon:",
    };
    let directory = format!("/proc/{}", pid.as_raw_nonzero());
    let status = fs::read_to_string(format!("{directory}/status")).ok()?;
    let counted = status.lines().find_map(|line| line.strip_prefix(key))?;
    let counted_kib: f64 = counted.trim().trim_end_matches("kB").trim().parse().ok()?;
    let handles = fs::read_dir(format!("{directory}/fd")).ok()?.count();
    Some((counted_kib / 1024.0, handles as f64))
}
