//! `caraware ps` and `caraware stop`: lists and stops runs from another terminal.

use std::time::{Duration, Instant};

use ipc_schema::{
    activity::Activity,
    board::{Health, Progress, State},
    metric,
    ports::BoardReader,
    process::{PROCESSES, Process, ProcessScope},
    run::RunFile,
    services,
};
use rustix::process::{Pid, Signal, kill_process};

use crate::{failure::Exit, registry};

/// Time over which `ps` measures rates.
const MEASURING_TIME: Duration = Duration::from_millis(500);
/// Longest time that `stop` waits for the run to end.
const STOP_WITHIN: Duration = Duration::from_secs(60);

/// Prints the process table of every live run.
///
/// # Errors
/// The run named is not alive, or its shared memory cannot be opened.
pub fn ps(name: Option<&str>) -> Result<(), Exit> {
    let runs: Vec<RunFile> = match name {
        Some(name) => vec![registry::find(Some(name))?],
        None => registry::entries()
            .into_iter()
            .filter(|entry| entry.alive)
            .filter_map(|entry| entry.run)
            .collect(),
    };
    if runs.is_empty() {
        println!("no run is alive");
        return Ok(());
    }
    println!(
        "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9} {:>6} {:>7} {:>9} {:>9} WAITS FOR",
        "RUN", "PROCESS", "STATE", "PID", "TICK", "TICKS/S", "LAG", "DROPS", "RESTARTS", "MEMORY"
    );
    for run in &runs {
        print_run(run)?;
    }
    Ok(())
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
        match State::from_u32(self.health.state) {
            State::Ready | State::Running if self.activity.age_s() > run.config.run.stall_s => "stalled",
            state => state.name(),
        }
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

fn print_run(run: &RunFile) -> Result<(), Exit> {
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
    let supervisor = memory_mib(run.supervisor_pid);
    println!(
        "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9} {:>6} {:>7} {:>9} {:>5} MiB",
        run.name, "supervisor", "running", run.supervisor_pid, "", "", "", "", "", supervisor
    );
    for ((process, before), now) in boards.iter().zip(&first).zip(&second) {
        // The first process of an environment is its `traffic-bridge`, whose tick all others follow.
        let source = boards.iter().position(|other| other.env_index == process.env_index);
        let source_ticks = source.map_or(0, |source| second[source].health.ticks);
        #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
        let rate = now.health.ticks.saturating_sub(before.health.ticks) as f64 / MEASURING_TIME.as_secs_f64();
        println!(
            "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9.0} {:>6} {:>7} {:>9} {:>5} MiB {}",
            run.name,
            process.label,
            now.state(run),
            now.health.pid,
            now.health.ticks,
            rate,
            source_ticks.saturating_sub(now.health.ticks),
            now.health.drops,
            now.progress.incarnation,
            memory_mib(now.health.pid),
            now.activity.awaited()
        );
    }
    println!();
    print_environments(run, &boards, [&first, &second]);
    print_training(run, &boards);
    Ok(())
}

/// Prints a line for each environment: its episode and simulated time, its road users, and its rates.
fn print_environments(run: &RunFile, boards: &[ProcessBoard], [before, now]: [&[BoardReading]; 2]) {
    for env_index in 0..run.config.run.envs {
        let index_of = |process: Process| {
            let is_it = |other: &ProcessBoard| other.env_index == env_index && other.process == process;
            boards.iter().position(is_it)
        };
        let indices = [Process::TrafficBridge, Process::SimCore, Process::SensorDaemon].map(index_of);
        let [Some(bridge), Some(core), Some(daemon)] = indices else {
            continue;
        };
        let (traffic, world, sensing) = (now[bridge].health, now[core].health, now[daemon].health);
        let sensing_before = before[daemon].health;
        let per_second = |now: u64, before: u64| {
            #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
            let increase = now.saturating_sub(before) as f64;
            increase / MEASURING_TIME.as_secs_f64()
        };
        println!(
            "{:<16} environment {env_index}: episode {}, {:.1} s, {} of {} road users sensing, {} arrived, {:.0} steps/s, {:.1} × real time",
            run.name,
            sensing.episode,
            Duration::from_nanos(sensing.sim_time_ns).as_secs_f64(),
            sensing.cavs,
            world.road_users,
            traffic.arrived,
            per_second(sensing.vehicle_steps, sensing_before.vehicle_steps),
            per_second(sensing.ticks, sensing_before.ticks) * run.config.run.tick_s,
        );
    }
}

/// Prints a line for the trainer once it reports metrics: its updates, its metrics and its reward.
fn print_training(run: &RunFile, boards: &[ProcessBoard]) {
    let Some(trainer) = boards.iter().find(|board| board.process == Process::Trainer) else {
        return;
    };
    let training = trainer.board.training();
    let measured = metric::summary(&training.metrics);
    if !measured.is_empty() {
        println!(
            "{:<16} trainer: {} updates, {measured}, reward {:.3}",
            run.name, training.updates, training.reward
        );
    }
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
    match run.mode.has_trainer() {
        true => println!("stopping {}: the trainer writes a checkpoint", run.name),
        false => println!("stopping {}", run.name),
    }
    let deadline = Instant::now() + STOP_WITHIN;
    while Instant::now() < deadline {
        wait(Duration::from_millis(100));
        if !registry::is_alive(&run.run_dir) {
            println!("{} has stopped; its results are in {}", run.name, run.run_dir.display());
            return Ok(());
        }
    }
    Err(Exit::run(
        format!("{} has not stopped within {} s", run.name, STOP_WITHIN.as_secs()),
        format!("kill process {}", run.supervisor_pid),
    ))
}
