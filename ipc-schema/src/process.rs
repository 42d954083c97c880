//! The processes of a run as a table: one row of [`PROCESSES`] for each. Boards, the roster, wake-ups, starting, restarting and the
//! status of a run derive from it (decision 23).

use serde::{Deserialize, Serialize};

use crate::{
    channel::Channel,
    config::{DeathAction, RecordManner},
    run::{Mode, RunFile},
};

/// A process that takes part in a run; its number is its place in [`PROCESSES`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Process {
    /// SUMO in-process.
    TrafficBridge = 0,
    /// Dynamics.
    SimCore = 1,
    /// Sensors and observations.
    SensorDaemon = 2,
    /// Messages between road users.
    V2x = 3,
    /// The learner.
    Trainer = 4,
    /// Shared memory → zenoh.
    Fanout = 5,
    /// Shared memory → a file.
    Recorder = 6,
}

/// What a process belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProcessScope {
    /// Every environment has its own.
    Environment,
    /// The whole run has one; it belongs to environment 0.
    Run,
}

/// What the end of a process means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnExit {
    /// The run needs the process: its end before its work is done ends the run.
    Required,
    /// The run needs the process, but loses nothing when it dies: the supervisor replaces it, unless it reported a failure.
    Replace,
    /// The process is a watcher: the supervisor restarts it.
    Restart,
}

/// The program of a process. Its one argument is the run file.
#[derive(Debug, Clone, Copy)]
pub enum Program {
    /// The program of this name, beside `caraware`.
    Binary(fn(&RunFile) -> &'static str),
    /// A Python module.
    PythonModule(fn(&RunFile) -> &str),
}

/// One row of [`PROCESSES`].
#[derive(Debug, Clone, Copy)]
pub struct ProcessSpec {
    /// The process.
    pub process: Process,
    /// Name in logs, services and the status of a run.
    pub name: &'static str,
    /// What it belongs to.
    pub scope: ProcessScope,
    /// Processes that must be ready before it is started.
    pub needs: &'static [Process],
    /// What its end means.
    pub on_exit: OnExit,
    /// Of the channels that name it as a required consumer, those of which a run lets it miss no message.
    pub must_receive: fn(&RunFile, Channel) -> bool,
    /// Whether a run has it.
    pub is_wanted: fn(&RunFile) -> bool,
    /// Whether a tick of a run waits for it.
    pub holds_up_ticks: fn(&RunFile) -> bool,
    /// What is started.
    pub program: Program,
}

/// The Python module in the trainer's place where nothing learns.
const PLAYER: &str = "caraware.play";

/// Every process, by [`Process`], in the order of the data and of starting. `traffic-bridge` comes first because a user's files can make
/// SUMO fail.
pub const PROCESSES: [ProcessSpec; 7] = [
    ProcessSpec {
        process: Process::TrafficBridge,
        name: "traffic-bridge",
        scope: ProcessScope::Environment,
        needs: &[],
        on_exit: OnExit::Required,
        must_receive: |_, _| true,
        is_wanted: |run| run.replay.is_none(),
        holds_up_ticks: |_| true,
        program: Program::Binary(|_| "traffic-bridge"),
    },
    ProcessSpec {
        process: Process::SimCore,
        name: "sim-core",
        scope: ProcessScope::Environment,
        needs: &[Process::TrafficBridge],
        on_exit: OnExit::Required,
        must_receive: |_, _| true,
        is_wanted: |run| run.replay.is_none(),
        holds_up_ticks: |_| true,
        program: Program::Binary(|_| "sim-core"),
    },
    ProcessSpec {
        process: Process::SensorDaemon,
        name: "sensor-daemon",
        scope: ProcessScope::Environment,
        needs: &[Process::TrafficBridge],
        on_exit: OnExit::Required,
        must_receive: |_, _| true,
        is_wanted: |_| true,
        holds_up_ticks: |_| true,
        // A recording takes the place of the simulators.
        program: Program::Binary(|run| match run.replay {
            None => "sensor-daemon",
            Some(_) => "replay",
        }),
    },
    ProcessSpec {
        process: Process::V2x,
        name: "v2x",
        scope: ProcessScope::Environment,
        needs: &[Process::TrafficBridge],
        on_exit: OnExit::Required,
        must_receive: |_, _| true,
        is_wanted: |run| run.replay.is_none() && run.config.v2x.is_on(),
        holds_up_ticks: |_| true,
        program: Program::Binary(|_| "v2x"),
    },
    ProcessSpec {
        process: Process::Trainer,
        name: "trainer",
        scope: ProcessScope::Run,
        // Python takes as long to import torch as SUMO to read a large net.
        needs: &[],
        on_exit: OnExit::Replace,
        must_receive: |_, _| true,
        is_wanted: |run| run.mode.has_trainer(),
        holds_up_ticks: |run| run.config.awaits_actions(),
        program: Program::PythonModule(|run| match run.mode {
            Mode::Play => PLAYER,
            Mode::Train | Mode::Simulate => &run.config.trainer.module,
        }),
    },
    ProcessSpec {
        process: Process::Fanout,
        name: "fanout",
        scope: ProcessScope::Run,
        // It shows the scene that sim-core has read.
        needs: &[Process::SimCore],
        on_exit: OnExit::Restart,
        must_receive: |_, _| true,
        is_wanted: |run| run.config.fanout.enabled,
        holds_up_ticks: |_| false,
        program: Program::Binary(|_| "fanout"),
    },
    ProcessSpec {
        process: Process::Recorder,
        name: "recorder",
        scope: ProcessScope::Environment,
        needs: &[],
        on_exit: OnExit::Restart,
        must_receive: |run, channel| run.config.record.needs_credit(channel),
        is_wanted: |run| run.config.record.is_on(),
        holds_up_ticks: |run| run.config.record.manner == RecordManner::Lossless,
        program: Program::Binary(|_| "recorder"),
    },
];

/// Each row stands at the place of its process.
const _: () = {
    let mut row = 0;
    while row < PROCESSES.len() {
        assert!(PROCESSES[row].process as usize == row);
        row += 1;
    }
};

impl ProcessSpec {
    /// True if `run` lasts until this process is done.
    #[must_use]
    pub fn is_required(&self, run: &RunFile) -> bool {
        self.on_exit != OnExit::Restart || self.process == Process::Recorder && (self.holds_up_ticks)(run)
    }

    /// What its end means in `run`: a run may be worth nothing without its recording.
    #[must_use]
    pub fn on_exit(&self, run: &RunFile) -> OnExit {
        match self.on_exit {
            OnExit::Restart
                if self.process == Process::Recorder && run.config.record.on_death == DeathAction::EndRun =>
            {
                OnExit::Required
            }
            on_exit => on_exit,
        }
    }

    /// True if it simulates an environment: it is started again with the others of its environment.
    #[must_use]
    pub fn is_simulator(&self) -> bool {
        self.scope == ProcessScope::Environment && self.on_exit == OnExit::Required
    }

    /// True if environment `env_index` of `run` has it.
    #[must_use]
    pub fn is_in(&self, run: &RunFile, env_index: u32) -> bool {
        (env_index == 0 || self.scope == ProcessScope::Environment) && (self.is_wanted)(run)
    }

    /// Its name in messages, with the number of its environment if the run has several.
    #[must_use]
    pub fn label(&self, run: &RunFile) -> String {
        match self.scope {
            ProcessScope::Environment if run.config.run.envs > 1 => format!("{}/{}", self.process, run.env_index),
            _ => self.process.to_string(),
        }
    }
}

impl Process {
    /// Number of processes.
    pub const COUNT: usize = PROCESSES.len();

    /// All processes, in the order of the data.
    pub const ALL: [Self; Self::COUNT] = {
        let mut processes = [PROCESSES[0].process; Self::COUNT];
        let mut row = 0;
        while row < Self::COUNT {
            processes[row] = PROCESSES[row].process;
            row += 1;
        }
        processes
    };

    /// Its row.
    #[must_use]
    pub const fn spec(self) -> &'static ProcessSpec {
        const ROWS: &[ProcessSpec] = &PROCESSES;
        &ROWS[self as usize]
    }

    /// Place in [`Process::ALL`].
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }

    /// Name as it stands in logs, services and the status of a run.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.spec().name
    }
}

impl std::fmt::Display for Process {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_has_the_name_of_its_row_in_files_too() {
        for spec in PROCESSES {
            let name = serde_json::to_value(spec.process).unwrap();
            assert_eq!(name, spec.name);
        }
    }

    #[test]
    fn a_process_starts_after_what_it_needs() {
        for spec in PROCESSES {
            assert!(spec.needs.iter().all(|need| *need < spec.process), "{}", spec.name);
        }
    }
}
