//! A learner that is killed or replaced during a run: no tick is lost or learnt twice, and the policy at the end is the same.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

mod common;

use std::{
    path::{Path, PathBuf},
    process::{Child, Stdio},
    sync::OnceLock,
    time::{Duration, Instant},
};

use common::{Workplace, text, until};
use ipc_schema::{
    board::{Health, Progress},
    ports::BoardReader,
    process::Process,
    run::RunFile,
    services::{self, RunNode},
};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Six vehicles, six training episodes with two evaluations in between: 3 000 ticks, 24 updates, a checkpoint for every second update.
const SMALL: [&str; 12] = [
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "episode.ticks=400",
    "episode.training_episodes=6",
    "episode.evaluation_interval=2",
    "episode.evaluation_ticks=100",
    "trainer.horizon=600",
    "trainer.batch_size=300",
    "trainer.checkpoint_interval=2",
    "trainer.matmul_precision=float32",
    "fanout.enabled=false",
];

fn arguments(name: &str, more: &[&str]) -> Vec<String> {
    arguments_of("town", name, more)
}

fn arguments_of(preset: &str, name: &str, more: &[&str]) -> Vec<String> {
    let settings = SMALL.iter().chain(more).flat_map(|setting| ["--set", setting]);
    ["train", preset, "--name", name]
        .into_iter()
        .chain(settings)
        .map(str::to_owned)
        .collect()
}

/// A run in the background and its boards.
struct Run {
    child: Child,
    directory: PathBuf,
    trainer: BoardReader,
    sensing: BoardReader,
    _node: RunNode,
}

impl Run {
    fn start(workplace: &Workplace, name: &str, more: &[&str]) -> Self {
        Self::start_with(workplace, name, &arguments(name, more))
    }

    fn start_with(workplace: &Workplace, name: &str, arguments: &[String]) -> Self {
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let mut child = workplace
            .command(&arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let directory = workplace.path().join("runs").join(name);
        let (node, trainer, sensing) = until(&mut child, "boards", || {
            let run = RunFile::read(&directory.join("run.json")).ok()?;
            let node = services::node(&run.shared_memory).ok()?;
            let trainer = BoardReader::open(&node, &run, 0, Process::Trainer).ok()?;
            let sensing = BoardReader::open(&node, &run, 0, Process::SensorDaemon).ok()?;
            Some((node, trainer, sensing))
        });
        Self {
            child,
            directory,
            trainer,
            sensing,
            _node: node,
        }
    }

    /// Waits until the boards of the working trainer satisfy `condition`.
    fn until(&mut self, what: &str, condition: impl Fn(Progress, Health) -> bool) {
        let trainer = &self.trainer;
        until(&mut self.child, what, || {
            condition(trainer.progress(), trainer.health()).then_some(())
        });
    }

    /// Kills the trainer once it has consumed `tick` ticks as incarnation `incarnation`.
    fn kill_trainer_at(&mut self, incarnation: u32, tick: u64) {
        self.until("a trainer at work", |progress, _| {
            progress.incarnation == incarnation && progress.attached == 1 && progress.consumed_ticks >= tick
        });
        let pid = Pid::from_raw(self.trainer.health().pid).unwrap();
        kill_process(pid, Signal::KILL).unwrap();
    }

    /// Waits for the end; returns the exit code and the output.
    fn end(self) -> (Option<i32>, String) {
        let Self {
            child,
            trainer,
            sensing,
            _node,
            ..
        } = self;
        // Readers of shared memory are dropped before its owner ends.
        drop((trainer, sensing, _node));
        let output = child.wait_with_output().unwrap();
        (output.status.code(), text(&output))
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.directory.join("logs/trainer.log")).unwrap_or_default()
    }
}

/// Asserts that the run left nothing in shared memory, in the registry or as a process, and no partial file in its directory.
fn assert_nothing_left(workplace: &Workplace, name: &str) {
    workplace.assert_nothing_left();
    let directory = workplace.path().join("runs").join(name);
    let partial = |entry: &std::fs::DirEntry| entry.file_name().to_string_lossy().contains("partial");
    for place in [directory.clone(), directory.join("checkpoints")] {
        let files = std::fs::read_dir(place).into_iter().flatten().flatten();
        assert_eq!(files.filter(partial).count(), 0);
    }
    assert!(!directory.join("run.next.json").exists());
}

/// Hash of every tensor of the newest checkpoint: parameters, optimiser, generators.
fn learnt(run: &Path) -> String {
    let checkpoints = run.join("checkpoints");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let mut hasher = blake3::Hasher::new();
    for name in ["parameters", "optimiser", "random"] {
        let file = checkpoints.join(newest.trim()).join(format!("{name}.safetensors"));
        hasher.update(&std::fs::read(file).unwrap());
    }
    format!("{} {}", newest.trim(), hasher.finalize().to_hex())
}

/// The results of a run, which disturbances must not change.
#[derive(Debug, Clone, PartialEq)]
struct Result {
    observation_hash: String,
    learnt: String,
    /// Policy's mean error of each evaluation.
    evaluations: Vec<(u64, f64)>,
    env_steps: u64,
    ticks: u64,
}

impl Result {
    fn of(workplace: &Workplace, name: &str) -> Self {
        let report = workplace.report(name);
        assert_eq!(
            (&report["lost_ticks"], &report["duplicated_ticks"]),
            (&0.into(), &0.into()),
            "{report:#}"
        );
        assert_eq!(report["result"], "completed");
        let evaluations = report["trainer"]["evaluations"].as_array().unwrap();
        let evaluation = |value: &Value| {
            (
                value["policy_version"].as_u64().unwrap(),
                value["ppo_mean_error_m"].as_f64().unwrap(),
            )
        };
        Self {
            observation_hash: report["observation_hash"].as_str().unwrap().into(),
            learnt: learnt(&workplace.path().join("runs").join(name)),
            evaluations: evaluations.iter().map(evaluation).collect(),
            env_steps: report["env_steps"].as_u64().unwrap(),
            ticks: report["trainer"]["received_ticks"].as_u64().unwrap(),
        }
    }
}

/// The results of the undisturbed run, which is made once.
fn undisturbed(workplace: &Workplace) -> &'static Result {
    static RESULT: OnceLock<Result> = OnceLock::new();
    RESULT.get_or_init(|| {
        let arguments = arguments("undisturbed", &[]);
        workplace.succeed(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
        let report = workplace.report("undisturbed");
        assert_eq!(
            (&report["restarts"], &report["redelivered_ticks"]),
            (&0.into(), &0.into())
        );
        let result = Result::of(workplace, "undisturbed");
        assert_eq!(result.evaluations.len(), 3);
        assert_eq!(result.ticks, report["ticks"]);
        result
    })
}

fn assert_undisturbed(workplace: &Workplace, name: &str, restarts: u64) {
    let expected = undisturbed(workplace);
    let report = workplace.report(name);
    assert_eq!(report["restarts"], restarts);
    assert_eq!(Result::of(workplace, name), *expected);
}

#[test]
fn a_trainer_that_is_killed_again_and_again_learns_the_same_policy() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "killed", &[]);
    // Before the first checkpoint (tick 200), in the middle, in the first evaluation (ticks 800 to 899), after it, in the last.
    for (incarnation, tick) in [(0, 30), (1, 150), (2, 470), (3, 850), (4, 1234), (5, 2950)] {
        run.kill_trainer_at(incarnation, tick);
    }
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_undisturbed(&workplace, "killed", 6);
    let redelivered = workplace.report("killed")["redelivered_ticks"].as_u64().unwrap();
    assert!(redelivered > 0 && redelivered < 3000, "{redelivered} ticks sent again");
    assert_nothing_left(&workplace, "killed");
}

#[test]
fn a_damaged_newest_checkpoint_is_skipped() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "damaged", &[]);
    let pid = {
        run.until("the fourth checkpoint", |progress, _| progress.committed_ticks >= 800);
        Pid::from_raw(run.trainer.health().pid).unwrap()
    };
    // A stopped process cannot write another checkpoint while this one is damaged.
    kill_process(pid, Signal::STOP).unwrap();
    let checkpoints = run.directory.join("checkpoints");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let file = checkpoints.join(newest.trim()).join("parameters.safetensors");
    let mut bytes = std::fs::read(&file).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(&file, bytes).unwrap();
    kill_process(pid, Signal::KILL).unwrap();
    run.until("a successor", |progress, _| {
        progress.incarnation == 1 && progress.attached == 1
    });
    let log = run.log();
    assert!(
        log.contains("checkpoint refused") && log.contains("is damaged"),
        "{log}"
    );
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_undisturbed(&workplace, "damaged", 1);
}

#[test]
fn a_trainer_that_always_dies_at_once_ends_the_run_with_the_end_of_its_log() {
    let workplace = Workplace::new();
    workplace.write(
        "suicide.py",
        "import os, signal, sys\nprint('no room for me', file=sys.stderr, flush=True)\nos.kill(os.getpid(), signal.SIGKILL)\n",
    );
    let python = std::env::var("PYTHONPATH").unwrap_or_default();
    let arguments = arguments("vain", &["trainer.module=suicide"]);
    let output = workplace
        .command(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
        .env("PYTHONPATH", format!("{}:{python}", workplace.path().display()))
        .output()
        .unwrap();
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for words in [
        "signal: 9",
        "no room for me",
        "replaced 5 times in a row",
        "trainer.log",
    ] {
        assert!(said.contains(words), "\"{words}\" is missing:\n{said}");
    }
    assert_nothing_left(&workplace, "vain");
}

#[test]
fn a_journal_that_is_too_small_names_its_key() {
    let workplace = Workplace::new();
    let mut run = Run::start(
        &workplace,
        "small",
        &[
            "run.journal_mib=1",
            "trainer.checkpoint_interval=1000",
            "episode.ticks=4000",
        ],
    );
    // A tick is about 1.3 kB: a mebibyte holds some 800 of them.
    run.kill_trainer_at(0, 2500);
    let (code, said) = run.end();
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("`run.journal_mib` (now 1)"), "{said}");
    assert_nothing_left(&workplace, "small");
}

/// The longest time without a new tick, until `over`.
fn longest_pause(sensing: &BoardReader, mut over: impl FnMut() -> bool) -> Duration {
    let (mut ticks, mut since, mut longest) = (sensing.health().ticks, Instant::now(), Duration::ZERO);
    while !over() {
        std::thread::park_timeout(Duration::from_millis(1));
        let now = sensing.health().ticks;
        longest = longest.max(since.elapsed());
        if now != ticks {
            (ticks, since) = (now, Instant::now());
        }
    }
    longest
}

/// A pace at which a successor gets ready during the run: 20 times real time, 15 s.
const PACED: &str = "run.real_time_factor=20";
const PACED_TICKS_PER_S: f64 = 200.0;

#[test]
fn a_planned_handover_changes_nothing_but_the_process() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "replaced", &[PACED]);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    let old = run.trainer.health().pid;
    let mut handover = workplace
        .command(&["handover", "replaced"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let pause = longest_pause(&run.sensing, || handover.try_wait().unwrap().is_some());
    let output = handover.wait_with_output().unwrap();
    let said = text(&output);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("trainer 1 continues from tick"), "{said}");
    run.until("another process at work", |progress, health| {
        progress.incarnation == 1 && health.pid != old && health.ticks > progress.committed_ticks
    });
    // Another handover follows at once, while the successor may still have to catch up.
    let output = workplace.run(&["handover", "replaced"]);
    assert!(output.status.success(), "{}", text(&output));
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_undisturbed(&workplace, "replaced", 0);
    let handovers = workplace.report("replaced")["handovers"].clone();
    assert_eq!(handovers.as_array().unwrap().len(), 2);
    for (incarnation, handover) in (1..).zip(handovers.as_array().unwrap()) {
        assert_eq!(handover["incarnation"], incarnation);
        // The simulation continues while no trainer is attached: it waits for less than a window, and makes ticks meanwhile if there is time
        // for any.
        let figure = |key: &str| handover[key].as_f64().unwrap_or_else(|| panic!("{key}: {handovers:#}"));
        assert!(figure("stall_ticks") <= 8.0, "{handovers:#}");
        assert!(
            figure("ticks_without_trainer") > 0.0 || figure("pause_s") * PACED_TICKS_PER_S < 8.0,
            "{handovers:#}"
        );
    }
    println!("{handovers:#}\nno tick for {pause:?} at most");
    assert_nothing_left(&workplace, "replaced");
}

/// The learned estimator learns at the end of an episode, and leaves there.
#[test]
fn the_learned_estimator_is_handed_over_and_ends_in_the_same_parameters() {
    let fusion = |name: &str, more: &[&str]| {
        let sizes = [
            "episode.final_evaluations=1",
            "trainer.checkpoint_interval=1",
            "fusion.segment_ticks=100",
            "fusion.truncation_ticks=50",
        ];
        arguments_of("fusion", name, &[&sizes[..], more].concat())
    };
    let workplace = Workplace::new();
    let undisturbed = fusion("estimator", &[]);
    workplace.succeed(&undisturbed.iter().map(String::as_str).collect::<Vec<_>>());
    let mut run = Run::start_with(&workplace, "replaced", &fusion("replaced", &[PACED]));
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    let output = workplace.run(&["handover", "replaced"]);
    let said = text(&output);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("trainer 1 continues from tick"), "{said}");
    // The journal has what the successor had not learnt when it was killed.
    run.kill_trainer_at(1, run.trainer.progress().committed_ticks + 1);
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_eq!(Result::of(&workplace, "replaced"), Result::of(&workplace, "estimator"));
    let report = workplace.report("replaced");
    assert_eq!(
        (&report["restarts"], &report["handovers"][0]["incarnation"]),
        (&1.into(), &1.into())
    );
    assert_nothing_left(&workplace, "replaced");
}

#[test]
fn a_successor_in_another_framework_loses_no_observation() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "framework", &[PACED]);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    let module = "trainer.module=caraware.examples.sb3_takeover";
    let output = workplace.run(&["handover", "framework", "--set", module]);
    assert!(output.status.success(), "{}", text(&output));
    // It learns, saves and commits. After a kill it continues from its own commit.
    let taken_over = run.trainer.progress().committed_ticks;
    run.until("an update of its own", |progress, _| {
        progress.incarnation == 1 && progress.committed_ticks > taken_over
    });
    run.kill_trainer_at(1, run.trainer.progress().committed_ticks + 1);
    let log = run.directory.join("logs/trainer.log");
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    let report = workplace.report("framework");
    assert_eq!(report["observation_hash"], undisturbed(&workplace).observation_hash);
    assert_eq!(
        (&report["lost_ticks"], &report["duplicated_ticks"]),
        (&0.into(), &0.into())
    );
    assert_eq!(
        (&report["restarts"], &report["handovers"][0]["incarnation"]),
        (&1.into(), &1.into())
    );
    let log = std::fs::read_to_string(log).unwrap();
    let begun = format!("takes over at tick {}", report["handovers"][0]["first_tick"]);
    assert!(
        log.contains(&begun) && log.matches("takes over at tick").count() == 2,
        "{log}"
    );
    assert!(workplace.path().join("runs/framework/sb3_takeover.zip").exists());
    assert_nothing_left(&workplace, "framework");
}

#[test]
fn a_successor_learns_with_its_changed_settings() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "changed", &[PACED]);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    let output = workplace.run(&["handover", "--set", "trainer.learning_rate=0.0001"]);
    assert!(output.status.success(), "{}", text(&output));
    // A restart after the handover keeps the new settings.
    run.kill_trainer_at(1, run.trainer.progress().committed_ticks + 1);
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    let (expected, result) = (undisturbed(&workplace), Result::of(&workplace, "changed"));
    assert_eq!(result.observation_hash, expected.observation_hash);
    assert_eq!((result.env_steps, result.ticks), (expected.env_steps, expected.ticks));
    assert_ne!(result.learnt, expected.learnt);
    let config = RunFile::read(&workplace.path().join("runs/changed/run.json"))
        .unwrap()
        .config;
    assert!(format!("{:?}", config.trainer).contains("learning_rate: 0.0001"));
    let log = std::fs::read_to_string(workplace.path().join("runs/changed/logs/trainer.log")).unwrap();
    assert_eq!(log.matches("learning_rate=0.0001,").count(), 2, "{log}");
}

#[test]
fn an_impossible_handover_is_refused_and_the_old_trainer_continues() {
    let workplace = Workplace::new();
    let short = [
        "observation.fields=caraware",
        "episode.ticks=120",
        "episode.training_episodes=1",
    ];
    let wider = arguments("wider", &[&short[..], &["episode.final_evaluations=1"]].concat());
    workplace.succeed(&wider.iter().map(String::as_str).collect::<Vec<_>>());
    let mut run = Run::start(&workplace, "refused", &[PACED]);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    let refused = |arguments: &[&str], code: i32, words: &[&str]| {
        let output = workplace.run(&[&["handover", "refused"], arguments].concat());
        let said = text(&output);
        assert_eq!(output.status.code(), Some(code), "{said}");
        // Messages are wrapped for the terminal.
        let said = said.replace('│', " ").split_whitespace().collect::<Vec<_>>().join(" ");
        for word in words {
            assert!(said.contains(word), "\"{word}\" is missing:\n{said}");
        }
    };
    refused(
        &["--set", "trainer.lerning_rate=1"],
        2,
        &["trainer.lerning_rate", "trainer.learning_rate"],
    );
    refused(
        &["--set", "traffic.cavs=9"],
        2,
        &["`traffic.cavs` cannot change in a live run"],
    );
    refused(&["--checkpoint", "nowhere"], 2, &["nowhere is not a checkpoint"]);
    refused(
        &["--checkpoint", "runs/wider/checkpoints/update-000001"],
        1,
        &["the old trainer continues", "observation_size is 11, this run's is 9"],
    );
    assert_eq!(run.trainer.progress().incarnation, 0);
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_undisturbed(&workplace, "refused", 0);
    assert_nothing_left(&workplace, "refused");
}

#[test]
fn the_former_name_of_the_command_is_refused_with_the_new_one() {
    let workplace = Workplace::new();
    for arguments in [&["swap"][..], &["swap", "town-1", "--set", "trainer.learning_rate=0.1"]] {
        let output = workplace.run(arguments);
        assert_eq!(output.status.code(), Some(2), "{}", text(&output));
        assert!(
            text(&output).contains("renamed to `caraware handover`"),
            "{}",
            text(&output)
        );
    }
}
