//! Processor time of the fan-out: `cargo bench -p fanout`.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a measurement asserts by unwrapping"
)]

#[path = "../tests/harness/mod.rs"]
#[allow(dead_code, reason = "shared with the tests proper, which use the rest")]
mod harness;

use std::time::{Duration, Instant};

use fanout::{frame, network::keys::Topic};
use harness::{Run, ask, publisher, send_observation, send_prediction, send_world, until, watch};
use ipc_schema::{process::Process, run::Mode, services::Channel};

const MEASURED: Duration = Duration::from_secs(5);

/// Time that all threads of a process have spent on a core so far (proc(5), `schedstat`).
fn processor_time(pid: u32) -> Duration {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let on_core_ns = tasks.map(|task| {
        let stat = std::fs::read_to_string(task.unwrap().path().join("schedstat")).unwrap();
        stat.split_whitespace().next().unwrap().parse::<u64>().unwrap()
    });
    Duration::from_nanos(on_core_ns.sum())
}

/// Publishes ticks of `vehicles` at `ticks_per_s`, and prints the fan-out's share of a core.
fn measure(vehicles: usize, ticks_per_s: u32, viewers: usize) {
    let run = Run::at_rate("cost", Mode::Train, 10.0);
    let fanout = run.start_fanout();
    let sessions: Vec<_> = (0..viewers).map(|_| run.attach()).collect();
    let frames: Vec<_> = sessions.iter().map(|s| watch(s, run.key(Topic::World))).collect();
    let (sim, worlds) = publisher(&run, Channel::World);
    let (sensors, observations) = publisher(&run, Channel::Observation);
    let (trainer, predictions) = publisher(&run, Channel::Prediction);
    let board = sim.board_of(Process::Fanout).unwrap();
    until("attendance", || board.progress().attached == 1);

    let (begun, used) = (Instant::now(), processor_time(fanout.0.id()));
    let mut ticks = 0;
    let mut sent_at = Vec::new();
    let mut ages = Vec::new();
    while begun.elapsed() < MEASURED {
        sent_at.push(Instant::now());
        send_world(&sim, &worlds, ticks, 0, vehicles);
        send_observation(&sensors, &observations, ticks, 0, vehicles);
        send_prediction(&trainer, &predictions, ticks, vehicles);
        ticks += 1;
        let due = Duration::from_secs_f64(ticks as f64 / f64::from(ticks_per_s));
        while begun.elapsed() < due {
            let Some(frames) = frames.first() else {
                std::thread::park_timeout(Duration::from_millis(1));
                continue;
            };
            if let Some(sample) = frames.recv_timeout(Duration::from_millis(1)).unwrap() {
                let (header, _) = frame::decode(&sample.payload().to_bytes()).unwrap();
                ages.push(sent_at[usize::try_from(header.tick).unwrap()].elapsed());
            }
        }
    }
    ages.sort();
    let share = (processor_time(fanout.0.id()) - used).as_secs_f64() / begun.elapsed().as_secs_f64();
    let bytes = sessions
        .first()
        .and_then(|s| ask(s, &run.key(Topic::World)))
        .map_or(0, |f| f.len());
    println!(
        "{vehicles} vehicles, {ticks} ticks in {MEASURED:?}, {viewers} viewers: {:.2} % of a core, world frame {bytes} B, \
         {} received, median age {:?}, missed {}",
        100.0 * share,
        ages.len(),
        ages.get(ages.len() / 2).copied().unwrap_or_default(),
        board.health().drops,
    );
}

fn main() {
    for (vehicles, ticks_per_s, viewers) in [
        (40, 10, 0),
        (40, 300, 0),
        (40, 300, 1),
        (40, 2000, 1),
        (2000, 10, 1),
        (2000, 50, 1),
    ] {
        measure(vehicles, ticks_per_s, viewers);
    }
}
