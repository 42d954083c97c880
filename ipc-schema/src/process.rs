//! The processes of a run, by name.

use serde::{Deserialize, Serialize};

/// A process that takes part in a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Process {
    /// SUMO in-process.
    TrafficBridge,
    /// Dynamics.
    SimCore,
    /// Sensors and observations.
    SensorDaemon,
    /// The learner.
    Trainer,
    /// Shared memory → zenoh.
    Fanout,
}

impl Process {
    /// Number of processes.
    pub const COUNT: usize = Self::ALL.len();

    /// All processes, in the order of the data.
    pub const ALL: [Self; 5] = [
        Self::TrafficBridge,
        Self::SimCore,
        Self::SensorDaemon,
        Self::Trainer,
        Self::Fanout,
    ];

    /// Place in [`Process::ALL`].
    #[must_use]
    pub fn index(self) -> usize {
        self as usize
    }

    /// Name as it stands in logs, services and the process table.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::TrafficBridge => "traffic-bridge",
            Self::SimCore => "sim-core",
            Self::SensorDaemon => "sensor-daemon",
            Self::Trainer => "trainer",
            Self::Fanout => "fanout",
        }
    }
}

impl std::fmt::Display for Process {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}
