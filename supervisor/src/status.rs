//! `caraware ps` and `caraware stop`: runs seen from another terminal.

use std::time::{Duration, Instant};

use ipc_schema::{
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
const RATE_OVER: Duration = Duration::from_millis(500);
/// Longest wait of `stop`.
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
        "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9} {:>6} {:>7} {:>9} {:>9}",
        "RUN", "PROCESS", "STATE", "PID", "TICK", "TICKS/S", "LAG", "DROPS", "RESTARTS", "MEMORY"
    );
    for run in &runs {
        print_run(run)?;
    }
    Ok(())
}

/// A process of a run.
struct ProcessBoard {
    label: String,
    process: Process,
    env_index: u32,
    scope: ProcessScope,
    board: BoardReader,
}

struct BoardReading {
    health: Health,
    progress: Progress,
}

fn look(boards: &[ProcessBoard]) -> Vec<BoardReading> {
    boards
        .iter()
        .map(|seat| BoardReading {
            health: seat.board.health(),
            progress: seat.board.progress(),
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
    boards.sort_by_key(|seat| seat.scope == ProcessScope::Run);
    let first = look(&boards);
    wait(RATE_OVER);
    let second = look(&boards);
    let supervisor = memory_mib(run.supervisor_pid);
    println!(
        "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9} {:>6} {:>7} {:>9} {:>5} MiB",
        run.name, "supervisor", "running", run.supervisor_pid, "", "", "", "", "", supervisor
    );
    for ((seat, before), now) in boards.iter().zip(&first).zip(&second) {
        // The first process of an environment is its SUMO.
        let source = boards.iter().position(|other| other.env_index == seat.env_index);
        let source_ticks = source.map_or(0, |source| second[source].health.ticks);
        #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
        let rate = now.health.ticks.saturating_sub(before.health.ticks) as f64 / RATE_OVER.as_secs_f64();
        println!(
            "{:<16} {:<16} {:<9} {:>8} {:>10} {:>9.0} {:>6} {:>7} {:>9} {:>5} MiB",
            run.name,
            seat.label,
            State::from_u32(now.health.state).name(),
            now.health.pid,
            now.health.ticks,
            rate,
            source_ticks.saturating_sub(now.health.ticks),
            now.health.drops,
            now.progress.incarnation,
            memory_mib(now.health.pid)
        );
    }
    println!();
    print_environments(run, &boards, [&first, &second]);
    print_training(run, &boards);
    Ok(())
}

/// A line for each environment: where it stands, how fast it goes, and who is there.
fn print_environments(run: &RunFile, boards: &[ProcessBoard], [before, now]: [&[BoardReading]; 2]) {
    for env_index in 0..run.config.run.envs {
        let seat_of = |process: Process| {
            let is_it = |seat: &ProcessBoard| seat.env_index == env_index && seat.process == process;
            boards.iter().position(is_it)
        };
        let seats = [Process::TrafficBridge, Process::SimCore, Process::SensorDaemon].map(seat_of);
        let [Some(source), Some(moving), Some(sensing)] = seats else {
            continue;
        };
        let (traffic, moved, sensed) = (now[source].health, now[moving].health, now[sensing].health);
        let since = before[sensing].health;
        let each_second = |now: u64, before: u64| {
            #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
            let more = now.saturating_sub(before) as f64;
            more / RATE_OVER.as_secs_f64()
        };
        println!(
            "{:<16} environment {env_index}: episode {}, {:.1} s, {} of {} road users sensing, {} arrived, {:.0} steps/s, {:.1} × real time",
            run.name,
            sensed.episode,
            Duration::from_nanos(sensed.sim_time_ns).as_secs_f64(),
            sensed.cavs,
            moved.road_users,
            traffic.arrived,
            each_second(sensed.vehicle_steps, since.vehicle_steps),
            each_second(sensed.ticks, since.ticks) * run.config.run.tick_s,
        );
    }
}

/// A line for the trainer once it reports metrics: how many updates it has made, and what it measures.
fn print_training(run: &RunFile, boards: &[ProcessBoard]) {
    let Some(trainer) = boards.iter().find(|seat| seat.process == Process::Trainer) else {
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

/// Asks the supervisor of a run to end it, and waits until nothing of it is left.
///
/// # Errors
/// No such run, or it does not end in time.
pub fn stop(name: Option<&str>) -> Result<(), Exit> {
    let run = registry::find(name)?;
    let pid = Pid::from_raw(run.supervisor_pid)
        .ok_or_else(|| Exit::run("the run has no supervisor", "`caraware doctor --clean`"))?;
    kill_process(pid, Signal::TERM)
        .map_err(|error| Exit::run(format!("cannot signal process {}: {error}", run.supervisor_pid), ""))?;
    println!("stopping {}: the trainer writes a checkpoint", run.name);
    let deadline = Instant::now() + STOP_WITHIN;
    while Instant::now() < deadline {
        wait(Duration::from_millis(100));
        if registry::find(Some(&run.name)).is_err() {
            println!("{} has stopped; its results are in {}", run.name, run.run_dir.display());
            return Ok(());
        }
    }
    Err(Exit::run(
        format!("{} has not stopped within {} s", run.name, STOP_WITHIN.as_secs()),
        format!("kill process {}", run.supervisor_pid),
    ))
}
