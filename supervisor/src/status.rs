//! `caraware ps` and `caraware stop`: lists and stops runs from another terminal.

use std::{
    path::PathBuf,
    time::{Duration, Instant},
};

use ipc_schema::{
    activity::Activity,
    board::{Health, Progress, State},
    metric::{self, MetricValues},
    ports::BoardReader,
    process::{PROCESSES, Process, ProcessScope},
    run::{Mode, RunFile},
    services,
};
use rustix::process::{Pid, Signal, kill_process};
use serde::Serialize;

use crate::{failure::Exit, registry};

/// Time over which `ps` measures rates.
const MEASURING_TIME: Duration = Duration::from_millis(500);
/// Longest time that `stop` waits for the run to end.
const STOP_WITHIN: Duration = Duration::from_secs(60);

/// Prints the process table of every live run, or the same as JSON.
///
/// # Errors
/// The run named is not alive.
pub fn ps(name: Option<&str>, json: bool) -> Result<(), Exit> {
    let runs: Vec<RunFile> = match name {
        Some(name) => vec![registry::find(Some(name))?],
        None => registry::entries()
            .into_iter()
            .filter(|entry| entry.alive)
            .filter_map(|entry| entry.run)
            .collect(),
    };
    if json {
        // A run may begin or end at this moment.
        let measured: Vec<RunMeasurement> = runs.iter().filter_map(|run| RunMeasurement::take(run).ok()).collect();
        if let (Some(name), true) = (name, measured.is_empty()) {
            registry::find(Some(name))?;
        }
        let text = serde_json::to_string(&measured)
            .map_err(|error| Exit::run(format!("the table has no form in JSON: {error}"), ""))?;
        crate::say!("{text}");
        return Ok(());
    }
    if runs.is_empty() {
        crate::say!("no run is alive");
        return Ok(());
    }
    crate::say!(
        "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9} {:>6} {:>7} {:>9} {:>9} WAITS FOR",
        "RUN",
        "PROCESS",
        "STATE",
        "PID",
        "TICK",
        "TICKS/S",
        "LAG",
        "DROPS",
        "RESTARTS",
        "MEMORY"
    );
    for run in &runs {
        match RunMeasurement::take(run) {
            Ok(measured) => measured.print(),
            Err(reason) => {
                if let Some(name) = name {
                    registry::find(Some(name))?;
                }
                print_unreadable(run, &reason);
            }
        }
    }
    Ok(())
}

/// Prints the row of a live run whose shared memory is not there: the run has just begun, or is about to end.
fn print_unreadable(run: &RunFile, reason: &Exit) {
    if registry::is_alive(&run.run_dir) {
        crate::say!(
            "{:<16} {:<16} {:<9} {:>8} its processes cannot be seen: {}",
            run.name,
            "supervisor",
            "running",
            run.supervisor_pid,
            reason.summary().0
        );
    }
}

/// The processes of a run and their rates, as `caraware ps` shows them.
#[derive(Debug, Serialize)]
struct RunMeasurement {
    run: String,
    directory: PathBuf,
    mode: Mode,
    /// Where viewers connect; `None` without a fan-out.
    endpoint: Option<String>,
    /// True if a viewer must authenticate.
    needs_credentials: bool,
    supervisor_pid: i32,
    supervisor_memory_mib: u64,
    processes: Vec<ProcessRow>,
    environments: Vec<EnvironmentRow>,
    training: Option<TrainingRow>,
}

/// A process.
#[derive(Debug, Serialize)]
struct ProcessRow {
    process: String,
    state: &'static str,
    pid: i32,
    tick: u64,
    ticks_per_s: f64,
    /// Ticks behind the `traffic-bridge` of its environment.
    lag: u64,
    drops: u64,
    restarts: u32,
    memory_mib: u64,
    waits_for: String,
}

/// An environment: its episode, its road users and its rates.
#[derive(Debug, Serialize)]
struct EnvironmentRow {
    environment: u32,
    episode: u64,
    sim_time_s: f64,
    cavs: u32,
    road_users: u32,
    arrived: u64,
    steps_per_s: f64,
    real_time_factor: f64,
}

/// What the trainer has reported.
#[derive(Debug, Serialize)]
struct TrainingRow {
    updates: u64,
    env_steps: u64,
    env_steps_per_s: f64,
    metrics: String,
    #[serde(serialize_with = "metric::serialize_measured")]
    measured: MetricValues,
    reward: f64,
    policy_std: f64,
}

/// A process of a run with the reader of its board.
struct ProcessBoard {
    label: String,
    process: Process,
    env_index: u32,
    scope: ProcessScope,
    board: BoardReader,
}

/// One reading of a board.
struct BoardReading {
    health: Health,
    progress: Progress,
    activity: Activity,
}

impl BoardReading {
    /// The state of the process for people; a process of `run` without a sign of life for too long hangs.
    fn state(&self, run: &RunFile) -> &'static str {
        self.activity
            .state_name(State::from_u32(self.health.state), run.config.run.stall_s)
    }
}

fn read_boards(boards: &[ProcessBoard]) -> Vec<BoardReading> {
    boards
        .iter()
        .map(|process| BoardReading {
            health: process.board.health(),
            progress: process.board.progress(),
            activity: process.board.activity(),
        })
        .collect()
}

impl RunMeasurement {
    /// Reads the boards of a run twice, [`MEASURING_TIME`] apart.
    fn take(run: &RunFile) -> Result<Self, Exit> {
        let node = services::node(&run.shared_memory)?;
        let mut boards = Vec::new();
        for environment in (0..run.config.run.envs).map(|index| run.environment(index)) {
            for row in PROCESSES
                .iter()
                .filter(|row| row.is_in(&environment, environment.env_index))
            {
                let board = BoardReader::open(&node, run, environment.env_index, row.process)?;
                let label = row.label(&environment);
                boards.push(ProcessBoard {
                    label,
                    process: row.process,
                    env_index: environment.env_index,
                    scope: row.scope,
                    board,
                });
            }
        }
        // Processes of the whole run come last.
        boards.sort_by_key(|process| process.scope == ProcessScope::Run);
        // Rates are differences of two readings.
        let first = read_boards(&boards);
        wait(MEASURING_TIME);
        let second = read_boards(&boards);
        let fanout = &run.config.fanout;
        Ok(Self {
            run: run.name.clone(),
            directory: run.run_dir.clone(),
            mode: run.mode,
            endpoint: fanout.enabled.then(|| fanout.listen.on_this_machine().to_string()),
            needs_credentials: fanout.users.is_some() || fanout.tls_client_ca.is_some(),
            supervisor_pid: run.supervisor_pid,
            supervisor_memory_mib: memory_mib(run.supervisor_pid),
            processes: process_rows(run, &boards, [&first, &second]),
            environments: environment_rows(run, &boards, [&first, &second]),
            training: training_row(&boards),
        })
    }

    fn print(&self) {
        crate::say!(
            "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9} {:>6} {:>7} {:>9} {:>5} MiB",
            self.run,
            "supervisor",
            "running",
            self.supervisor_pid,
            "",
            "",
            "",
            "",
            "",
            self.supervisor_memory_mib
        );
        for row in &self.processes {
            crate::say!(
                "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9.0} {:>6} {:>7} {:>9} {:>5} MiB {}",
                self.run,
                row.process,
                row.state,
                row.pid,
                row.tick,
                row.ticks_per_s,
                row.lag,
                row.drops,
                row.restarts,
                row.memory_mib,
                row.waits_for
            );
        }
        crate::say!("");
        for row in &self.environments {
            crate::say!(
                "{:<16} environment {}: episode {}, {:.1} s, {} of {} road users sensing, {} arrived, {:.0} steps/s, {:.1} × real time",
                self.run,
                row.environment,
                row.episode,
                row.sim_time_s,
                row.cavs,
                row.road_users,
                row.arrived,
                row.steps_per_s,
                row.real_time_factor,
            );
        }
        if let Some(row) = &self.training {
            crate::say!(
                "{:<16} trainer: {} updates, {}, reward {:.3}",
                self.run,
                row.updates,
                row.metrics,
                row.reward
            );
        }
    }
}

/// Increase per second from one reading to the next.
fn per_second(now: u64, before: u64) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
    let increase = now.saturating_sub(before) as f64;
    increase / MEASURING_TIME.as_secs_f64()
}

fn process_rows(run: &RunFile, boards: &[ProcessBoard], [before, now]: [&[BoardReading]; 2]) -> Vec<ProcessRow> {
    let row = |((process, before), now_of_it): ((&ProcessBoard, &BoardReading), &BoardReading)| {
        // The first process of an environment is its `traffic-bridge`, whose tick all others follow.
        let source = boards.iter().position(|other| other.env_index == process.env_index);
        let source_ticks = source.map_or(0, |source| now[source].health.ticks);
        let health = now_of_it.health;
        ProcessRow {
            process: process.label.clone(),
            state: now_of_it.state(run),
            pid: health.pid,
            tick: health.ticks,
            ticks_per_s: per_second(health.ticks, before.health.ticks),
            lag: source_ticks.saturating_sub(health.ticks),
            drops: health.drops,
            restarts: now_of_it.progress.incarnation,
            memory_mib: memory_mib(health.pid),
            waits_for: now_of_it.activity.awaited().to_string(),
        }
    };
    boards.iter().zip(before).zip(now).map(row).collect()
}

/// A row for each environment: its episode and simulated time, its road users, and its rates.
fn environment_rows(
    run: &RunFile,
    boards: &[ProcessBoard],
    [before, now]: [&[BoardReading]; 2],
) -> Vec<EnvironmentRow> {
    let row = |env_index: u32| {
        let index_of = |process: Process| {
            let is_it = |other: &ProcessBoard| other.env_index == env_index && other.process == process;
            boards.iter().position(is_it)
        };
        let bridge = index_of(Process::TrafficBridge)?;
        let core = index_of(Process::SimCore)?;
        let daemon = index_of(Process::SensorDaemon)?;
        let (traffic, world, sensing) = (now[bridge].health, now[core].health, now[daemon].health);
        let sensing_before = before[daemon].health;
        Some(EnvironmentRow {
            environment: env_index,
            episode: sensing.episode,
            sim_time_s: Duration::from_nanos(sensing.sim_time_ns).as_secs_f64(),
            cavs: sensing.cavs,
            road_users: world.road_users,
            arrived: traffic.arrived,
            steps_per_s: per_second(sensing.vehicle_steps, sensing_before.vehicle_steps),
            real_time_factor: per_second(sensing.ticks, sensing_before.ticks) * run.config.run.tick_s,
        })
    };
    (0..run.config.run.envs).filter_map(row).collect()
}

/// The trainer's updates, metrics and reward, once it reports metrics.
fn training_row(boards: &[ProcessBoard]) -> Option<TrainingRow> {
    let trainer = boards.iter().find(|board| board.process == Process::Trainer)?;
    let training = trainer.board.training();
    let metrics = metric::summary(&training.metrics);
    (!metrics.is_empty()).then_some(TrainingRow {
        updates: training.updates,
        env_steps: training.env_steps,
        env_steps_per_s: training.env_steps_per_s,
        metrics,
        measured: training.metrics,
        reward: training.reward,
        policy_std: training.policy_std,
    })
}

/// Resident memory of a process, MiB.
fn memory_mib(pid: i32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|rest| rest.split_whitespace().next())
        .and_then(|kib| kib.parse::<u64>().ok())
        .unwrap_or(0)
        / 1024
}

fn wait(time: Duration) {
    std::thread::park_timeout(time);
}

/// What a run of this mode still does when it is asked to end, for messages.
#[must_use]
pub fn last_work(mode: Mode) -> &'static str {
    match mode {
        Mode::Train => ": the trainer writes a checkpoint",
        Mode::Simulate | Mode::Play => "",
    }
}

/// Asks the supervisor of a run to end the run, and waits until the run has left the registry.
///
/// # Errors
/// The run does not exist, or it does not end in time.
pub fn stop(name: Option<&str>) -> Result<(), Exit> {
    let run = registry::find(name)?;
    let pid = Pid::from_raw(run.supervisor_pid)
        .ok_or_else(|| Exit::run("the run has no supervisor", "`caraware doctor --clean`"))?;
    kill_process(pid, Signal::TERM)
        .map_err(|error| Exit::run(format!("cannot signal process {}: {error}", run.supervisor_pid), ""))?;
    crate::say!("stopping {}{}", run.name, last_work(run.mode));
    let deadline = Instant::now() + STOP_WITHIN;
    while Instant::now() < deadline {
        wait(Duration::from_millis(100));
        if !registry::is_alive(&run.run_dir) {
            crate::say!("{} has stopped; its results are in {}", run.name, run.run_dir.display());
            return Ok(());
        }
    }
    Err(Exit::run(
        format!("{} has not stopped within {} s", run.name, STOP_WITHIN.as_secs()),
        format!("kill process {}", run.supervisor_pid),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_run_that_learns_writes_a_checkpoint_at_its_end() {
        assert_eq!(last_work(Mode::Train), ": the trainer writes a checkpoint");
        assert_eq!([Mode::Simulate, Mode::Play].map(last_work), ["", ""]);
    }
}
