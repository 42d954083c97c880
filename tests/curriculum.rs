//! A curriculum whose gates the learner passes: the same bytes for the same seed, whoever dies on the way, and from its log.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

mod common;

use std::time::{Duration, Instant};

use common::Workplace;
use ipc_schema::{ports::BoardReader, process::Process, run::RunFile, services};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Three steps of which the first goes on and on, a horizon that ends within lessons, gates of σ that some updates pass.
const SMALL: [&str; 15] = [
    "curriculum.steps=[{cavs=1,restart=false,until_std=0.66},{cavs=1,ticks=350,until_std=0.63,noise=2.0},{cavs=5,ticks=100,until_std=0.6}]",
    "episode.ticks=450",
    "episode.training_episodes=60",
    "episode.evaluation_interval=0",
    "episode.evaluation_ticks=80",
    "episode.final_evaluations=1",
    "trainer.horizon=500",
    "trainer.batch_size=100",
    "trainer.hidden=[32, 32]",
    "trainer.learning_rate=1e-3",
    "trainer.checkpoint_interval=2",
    "trainer.matmul_precision=float32",
    "run.window_ticks=16",
    "traffic.others=2",
    "fanout.enabled=false",
];

fn arguments<'a>(mode: &'a str, name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let settings = SMALL.iter().chain(more).flat_map(|setting| ["--set", setting]);
    [mode, "paper", "--name", name].into_iter().chain(settings).collect()
}

fn actions(workplace: &Workplace, name: &str) -> Vec<[u64; 3]> {
    let text = std::fs::read_to_string(workplace.path().join("runs").join(name).join("actions.jsonl")).unwrap();
    let number = |line: &Value, key: &str| line[key].as_u64().unwrap();
    let lines = text.lines().map(|line| serde_json::from_str(line).unwrap());
    lines
        .map(|line: Value| ["step", "lesson", "tick"].map(|key| number(&line, key)))
        .collect()
}

/// Kills the trainer once it has consumed `tick` ticks as incarnation `incarnation`.
fn kill_trainer(board: &BoardReader, incarnation: u32, tick: u64) {
    let deadline = Instant::now() + Duration::from_secs(120);
    loop {
        let progress = board.progress();
        if progress.incarnation == incarnation && progress.attached == 1 && progress.consumed_ticks >= tick {
            return kill_process(Pid::from_raw(board.health().pid).unwrap(), Signal::KILL).unwrap();
        }
        assert!(
            Instant::now() < deadline,
            "trainer {incarnation} never got to tick {tick}"
        );
        std::thread::park_timeout(Duration::from_millis(1));
    }
}

#[test]
fn the_learner_passes_the_gates_and_the_same_seed_gives_the_same_bytes() {
    let workplace = Workplace::new();
    workplace.succeed(&arguments("train", "whole", &[]));
    let report = workplace.report("whole");
    let passed = report["trainer"]["curriculum"]["passed"].as_array().unwrap().clone();
    assert_eq!(passed.len(), 3, "{report:#}");
    for (gate, limit) in passed.iter().zip([0.66, 0.63, 0.6]) {
        assert!(gate["policy_std"].as_f64().unwrap() <= limit, "{gate}");
    }
    let taken = actions(&workplace, "whole");
    assert_eq!(taken.iter().map(|[step, ..]| *step).collect::<Vec<_>>(), [0, 1, 2, 3]);
    // A step begins with the tick after the one that its predecessor's gate opened at.
    for (gate, [_, lesson, tick]) in passed.iter().zip(&taken[1..]) {
        assert_eq!(gate["tick"].as_u64().unwrap() + 1, *tick);
        assert_eq!(gate["lessons"].as_u64().unwrap(), *lesson);
    }
    let last = taken[3];
    assert_eq!(
        report["ticks"],
        last[2] + 80,
        "nothing but the evaluation follows the last gate"
    );
    // Lessons of one vehicle are 450 and 350 ticks, those of five 100.
    let lessons = |from: usize| taken[from + 1][1] - taken[from][1];
    assert_eq!(last[2], 450 * lessons(0) + 350 * lessons(1) + 100 * lessons(2));

    // Killed before the first checkpoint, in each of the steps, and while others wait for the word of the last lesson.
    let mut command = workplace.command(&arguments("train", "killed", &["run.window_ticks=5"]));
    let mut child = command.spawn().unwrap();
    let file = workplace.path().join("runs/killed/run.json");
    let run = loop {
        assert!(child.try_wait().unwrap().is_none(), "the run is over");
        if let Ok(run) = RunFile::read(&file)
            && let Ok(node) = services::node(&run.shared_memory)
            && let Ok(board) = BoardReader::open(&node, &run, 0, Process::Trainer)
        {
            break (node, board);
        }
        std::thread::park_timeout(Duration::from_millis(5));
    };
    let ticks = [200, taken[1][2] - 1, taken[2][2] + 120, last[2] - 1];
    for (incarnation, tick) in (0..).zip(ticks) {
        kill_trainer(&run.1, incarnation, tick);
    }
    drop(run);
    assert!(child.wait().unwrap().success());
    let killed = workplace.report("killed");
    assert_eq!(killed["observation_hash"], report["observation_hash"]);
    assert_eq!((&killed["lost_ticks"], &killed["restarts"]), (&0.into(), &4.into()));
    assert_eq!(actions(&workplace, "killed"), taken);
    assert_eq!(killed["trainer"]["curriculum"], report["trainer"]["curriculum"]);

    // The training part again without a learner.
    let log = workplace.path().join("runs/whole/actions.jsonl");
    let log = format!("curriculum.log={}", log.display());
    workplace.succeed(&arguments("simulate", "again", &[&log]));
    assert_eq!(
        workplace.report("again")["observation_hash"],
        report["observation_hash"]
    );
    workplace.assert_nothing_left();
}

#[test]
fn a_gate_that_is_never_passed_ends_with_the_training_episodes() {
    let workplace = Workplace::new();
    let steps = "curriculum.steps=[{cavs=2,until_lessons=1},{cavs=3,until_std=0.001}]";
    workplace.succeed(&arguments(
        "train",
        "stuck",
        &[steps, "episode.training_episodes=3", "episode.ticks=120"],
    ));
    let report = workplace.report("stuck");
    let curriculum = &report["trainer"]["curriculum"];
    assert_eq!(
        (&curriculum["lessons"], curriculum["passed"].as_array().unwrap().len()),
        (&3.into(), 1)
    );
    assert_eq!(report["ticks"], 3 * 120 + 80);
}
