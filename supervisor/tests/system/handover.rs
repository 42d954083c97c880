//! A learner that is killed or replaced during a run: no tick is lost or learnt twice, and the policy at the end is the same.

use std::{
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::OnceLock,
    time::{Duration, Instant},
};

use crate::common::{Workplace, text, until};
use ipc_schema::{
    board::{Health, Progress, State},
    ports::BoardReader,
    process::Process,
    run::RunFile,
    services::{self, RunNode},
};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Six vehicles, six training episodes with two evaluations in between: 1 400 ticks, 24 updates, a checkpoint for every second update.
/// Small networks, and no estimates that only viewers see.
const SMALL: [&str; 16] = [
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "episode.ticks=200",
    "episode.training_episodes=6",
    "episode.evaluation_interval=2",
    "episode.evaluation_ticks=50",
    "episode.final_evaluations=2",
    "trainer.horizon=300",
    "trainer.plots=false",
    "trainer.batch_size=150",
    "trainer.hidden=[32, 32]",
    "trainer.estimates=never",
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
        Self::spawn(workplace, name, workplace.command(&arguments))
    }

    fn spawn(workplace: &Workplace, name: &str, mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
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
    // At this pace the last kill has half a second before the end.
    let mut run = Run::start(&workplace, "killed", &["run.real_time_factor=20"]);
    // Before the first checkpoint (tick 100), in the middle, in the first evaluation (ticks 400 to 449), after it, in the last.
    for (incarnation, tick) in [(0, 15), (1, 75), (2, 235), (3, 410), (4, 617), (5, 1305)] {
        run.kill_trainer_at(incarnation, tick);
    }
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_undisturbed(&workplace, "killed", 6);
    let redelivered = workplace.report("killed")["redelivered_ticks"].as_u64().unwrap();
    assert!(redelivered > 0 && redelivered < 1400, "{redelivered} ticks sent again");
    assert_nothing_left(&workplace, "killed");
}

/// Process id of the trainer of the run in `directory`, also while it starts: its command line names the run file.
fn trainer_pid(directory: &Path) -> Option<Pid> {
    let run_file = directory.join("run.json").to_string_lossy().into_owned();
    let mut entries = std::fs::read_dir("/proc").unwrap().flatten();
    entries.find_map(|entry| {
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).into_owned();
        let is_trainer = line.contains("\0caraware.train\0") && line.contains(&run_file);
        let pid: i32 = entry.file_name().to_str()?.parse().ok()?;
        is_trainer.then(|| Pid::from_raw(pid)).flatten()
    })
}

#[test]
fn a_trainer_that_is_killed_while_it_starts_is_started_ever_later_but_always_again() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "killed", &[]);
    let mut killed = Vec::new();
    while killed.len() < 8 {
        let directory = run.directory.clone();
        let pid = until(&mut run.child, "a trainer that starts", || {
            trainer_pid(&directory).filter(|pid| !killed.contains(pid))
        });
        assert_eq!(run.trainer.progress().attached, 0, "the trainer has started already");
        kill_process(pid, Signal::KILL).unwrap();
        killed.push(pid);
    }
    let log = run.directory.join("logs/trainer.log");
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    let log = std::fs::read_to_string(log).unwrap();
    for text in [said, log] {
        assert_eq!(text.matches("it starts again in").count(), 7, "{text}");
        assert!(text.contains("it starts again in 5.0 s"), "{text}");
    }
    assert_undisturbed(&workplace, "killed", 8);
    assert_nothing_left(&workplace, "killed");
}

#[test]
fn a_damaged_newest_checkpoint_is_skipped() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "damaged", &[]);
    let pid = {
        run.until("the fourth checkpoint", |progress, _| progress.committed_ticks >= 400);
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
fn a_trainer_that_always_crashes_at_once_ends_the_run_with_the_end_of_its_log() {
    let workplace = Workplace::new();
    workplace.write(
        "suicide.py",
        "import os, sys\nprint('no room for me', file=sys.stderr, flush=True)\nos.abort()\n",
    );
    let python = std::env::var("PYTHONPATH").unwrap_or_default();
    let arguments = arguments("vain", &["trainer.module=suicide"]);
    let output = workplace
        .command(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
        .env("PYTHONPATH", format!("{}:{python}", workplace.path().display()))
        .output()
        .unwrap();
    // Messages are wrapped for the terminal.
    let said = text(&output).replace('│', " ");
    let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
    assert_eq!(output.status.code(), Some(1), "{said}");
    for words in [
        "signal: 6",
        "no room for me",
        "after 5 restarts in a row without a new checkpoint",
        "trainer.log",
    ] {
        assert!(said.contains(words), "\"{words}\" is missing:\n{said}");
    }
    assert_eq!(workplace.report("vain")["result"], "failed");
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
            "episode.ticks=800",
        ],
    );
    // A tick is about 1.3 kB: a mebibyte holds some 800 of them.
    run.kill_trainer_at(0, 1600);
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

/// A pace at which a successor gets ready during the run: 7 times real time, 20 s.
const PACED: &str = "run.real_time_factor=7";
/// A pace at which two do, one after the other, also beside other work: 2.8 times real time, 50 s.
const SLOW: &str = "run.real_time_factor=2.8";
const SLOW_TICKS_PER_S: f64 = 28.0;

#[test]
fn a_planned_handover_changes_nothing_but_the_process() {
    let workplace = Workplace::new();
    // With the estimates that viewers of a paced run see.
    let mut run = Run::start(&workplace, "replaced", &[SLOW, "trainer.estimates=paced"]);
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
        // The simulation continues while no trainer is attached, if there is time for a window of ticks.
        let figure = |key: &str| handover[key].as_f64().unwrap_or_else(|| panic!("{key}: {handovers:#}"));
        assert!(
            figure("ticks_without_trainer") > 0.0 || figure("pause_s") * SLOW_TICKS_PER_S < 8.0,
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
            "fusion.segment_ticks=50",
            "fusion.truncation_ticks=25",
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
    let models = std::fs::read_dir(workplace.path().join("runs/framework/sb3_takeover")).unwrap();
    assert_eq!(models.count(), 1, "the model of the newest commit, and no older one");
    assert_nothing_left(&workplace, "framework");
}

/// What `commits.json` says: which learner has learnt up to which tick.
fn commits(run: &Path) -> Vec<(String, u64)> {
    let log: Value = serde_json::from_slice(&std::fs::read(run.join("commits.json")).unwrap()).unwrap();
    let entry = |commit: &Value| {
        (
            commit["learner"].as_str().unwrap().to_owned(),
            commit["positions"][0]["ticks"].as_u64().unwrap(),
        )
    };
    log["commits"].as_array().unwrap().iter().map(entry).collect()
}

/// Hands the paused run over to `module`, and makes ticks until it has committed some of its own. The run stays paused.
/// The learner may be one step behind, as it consumes ticks by the dozen: a slow one would otherwise find the run at its end.
fn hand_to(workplace: &Workplace, run: &mut Run, name: &str, incarnation: u32, module: &str) {
    control(workplace, name, &["pause"]);
    let output = workplace.run(&["handover", name, "--set", &format!("trainer.module={module}")]);
    assert!(output.status.success(), "{module}: {}", text(&output));
    let run_file = run.directory.join("run.next.json");
    assert!(run_file.exists(), "the successor may read its run file at any time");
    let taken_over = run.trainer.progress().committed_ticks;
    let has_committed = |trainer: &BoardReader| {
        let progress = trainer.progress();
        progress.incarnation == incarnation && progress.committed_ticks > taken_over
    };
    while !has_committed(&run.trainer) {
        let before = run.sensing.health().ticks;
        control(workplace, name, &["step", "40"]);
        let Run {
            child,
            trainer,
            sensing,
            ..
        } = &mut *run;
        until(child, "a commit of its own", || {
            let follows = sensing.health().ticks >= before + 40 && trainer.progress().consumed_ticks >= before;
            (has_committed(trainer) || follows).then_some(())
        });
    }
}

fn control(workplace: &Workplace, name: &str, command: &[&str]) {
    let output = workplace.run(&[&["control"], command, &["--run", name]].concat());
    assert!(output.status.success(), "{command:?}: {}", text(&output));
}

#[test]
fn learners_take_turns_and_every_tick_is_in_one_commit() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "turns", &[PACED]);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    let modules = [
        "caraware.examples.sb3_takeover",
        "caraware.examples.minimal_learner",
        "caraware.fusion.train",
        "caraware.train",
    ];
    for (incarnation, module) in (1..).zip(modules) {
        hand_to(&workplace, &mut run, "turns", incarnation, module);
    }
    control(&workplace, "turns", &["resume"]);
    let directory = run.directory.clone();
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    let report = workplace.report("turns");
    assert_eq!(report["result"], "completed");
    assert_eq!(report["observation_hash"], undisturbed(&workplace).observation_hash);
    assert_eq!(
        (&report["lost_ticks"], &report["duplicated_ticks"]),
        (&0.into(), &0.into()),
        "{report:#}"
    );
    assert_eq!(report["trainer"]["received_ticks"], report["ticks"], "{report:#}");
    // Each learner began where the commits of the one before it end.
    let commits = commits(&directory);
    let learners: Vec<&str> = commits.iter().map(|(learner, _)| learner.as_str()).collect();
    assert_eq!(learners, ["ppo", modules[0], modules[1], "fusion", "ppo"]);
    let handovers = report["handovers"].as_array().unwrap();
    for ((_, ticks), handover) in commits.iter().zip(handovers) {
        assert_eq!(handover["first_tick"], *ticks, "{commits:?} {handovers:#?}");
    }
    assert!(commits.is_sorted_by(|a, b| a.1 < b.1), "{commits:?}");
    assert_nothing_left(&workplace, "turns");
}

/// Asks for a handover in the background, and waits until its successor is being started.
fn ask_for_handover(workplace: &Workplace, run: &mut Run, name: &str) -> Child {
    let mut command = workplace.command(&["handover", name]);
    let client = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let successor = run.directory.join("run.next.json");
    until(&mut run.child, "a successor", || successor.exists().then_some(()));
    client
}

#[test]
fn a_handover_waits_for_a_trainer_that_still_starts() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "early", &[PACED]);
    let directory = run.directory.clone();
    let pid = until(&mut run.child, "a trainer that starts", || trainer_pid(&directory));
    kill_process(pid, Signal::STOP).unwrap();
    assert_eq!(run.trainer.health().state, State::Starting as u32);
    let client = ask_for_handover(&workplace, &mut run, "early");
    // The successor gets ready long before the trainer that has been stopped.
    let log = run.directory.join("logs/trainer.log");
    until(&mut run.child, "a ready successor", || {
        let log = std::fs::read_to_string(&log).ok()?;
        log.contains("the successor is ready").then_some(())
    });
    kill_process(pid, Signal::CONT).unwrap();
    let output = client.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(run.trainer.progress().incarnation, 1);
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_undisturbed(&workplace, "early", 0);
    assert_nothing_left(&workplace, "early");
}

#[test]
fn a_successor_takes_over_from_a_trainer_that_is_killed_meanwhile() {
    let workplace = Workplace::new();
    let mut run = Run::start(&workplace, "orphaned", &[PACED]);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    let client = ask_for_handover(&workplace, &mut run, "orphaned");
    run.kill_trainer_at(0, 0);
    let output = client.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(run.trainer.progress().incarnation, 1);
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    // No trainer was started in the place of the one that was killed.
    assert_undisturbed(&workplace, "orphaned", 0);
    assert_eq!(workplace.report("orphaned")["handovers"].as_array().unwrap().len(), 1);
    assert_nothing_left(&workplace, "orphaned");
}

/// A module that gets ready, takes over, and ends by `end`; it always ends so.
fn ending_module(workplace: &Workplace, name: &str, end: &str) {
    let text = format!(
        "import os, signal, sys\n\
         from caraware.run.process import HandoverRole\n\
         role = HandoverRole.from_environment()\n\
         if role.gets_ready and not role.wait_for_turn():\n    sys.exit(0)\n\
         {end}\n"
    );
    workplace.write(&format!("{name}.py"), &text);
}

#[test]
fn a_successor_that_ends_after_the_go_is_replaced_by_the_learner_before_it() {
    let workplace = Workplace::new();
    let ends = [
        ("raises", "raise ValueError('not today')"),
        ("leaves", "sys.exit(0)"),
        ("dies", "os.kill(os.getpid(), signal.SIGKILL)"),
    ];
    let python = std::env::var("PYTHONPATH").unwrap_or_default();
    let arguments = arguments("returned", &[PACED]);
    let mut command = workplace.command(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    command.env("PYTHONPATH", format!("{}:{python}", workplace.path().display()));
    let mut run = Run::spawn(&workplace, "returned", command);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    for (name, end) in ends {
        ending_module(&workplace, name, end);
        let output = workplace.run(&["handover", "returned", "--set", &format!("trainer.module={name}")]);
        let said = text(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains("the learner before it"), "{said}");
        run.until("the learner before it", |progress, health| {
            progress.attached == 1 && health.ticks > progress.committed_ticks
        });
    }
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_eq!(Result::of(&workplace, "returned"), *undisturbed(&workplace));
    assert_nothing_left(&workplace, "returned");
}

/// A successor has `run.ready_s` to open its ports, once the old trainer has left.
#[test]
fn a_successor_that_hangs_after_the_go_is_replaced_by_the_learner_before_it() {
    let workplace = Workplace::new();
    let python = std::env::var("PYTHONPATH").unwrap_or_default();
    let arguments = arguments("awaited", &[PACED, "run.ready_s=30"]);
    let mut command = workplace.command(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    command.env("PYTHONPATH", format!("{}:{python}", workplace.path().display()));
    let mut run = Run::spawn(&workplace, "awaited", command);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    ending_module(&workplace, "sleeps", "import time; time.sleep(1e6)");
    let output = workplace.run(&["handover", "awaited", "--set", "trainer.module=sleeps"]);
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("the learner before it"), "{said}");
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    let is_late = |line: &&str| line.starts_with("trainer was not ready within 30 s");
    assert_eq!(said.lines().filter(is_late).count(), 1, "tried once: {said}");
    assert_eq!(Result::of(&workplace, "awaited"), *undisturbed(&workplace));
    assert_nothing_left(&workplace, "awaited");
}

#[test]
fn a_successor_that_does_not_fit_the_run_is_refused_with_the_difference() {
    let workplace = Workplace::new();
    let claims = [
        ("SuccessorClaims(observation_size=3)", "observations of size 3"),
        ("SuccessorClaims(task='driving')", "task driving"),
        ("SuccessorClaims(schema_version=1)", "schema version 1"),
        ("SuccessorClaims(environments=2)", "environments: 2"),
        (
            "SuccessorClaims(observation_fields=('speed',))",
            "takes the fields speed",
        ),
    ];
    let python = std::env::var("PYTHONPATH").unwrap_or_default();
    let arguments = arguments("misfit", &[PACED]);
    let mut command = workplace.command(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    command.env("PYTHONPATH", format!("{}:{python}", workplace.path().display()));
    let mut run = Run::spawn(&workplace, "misfit", command);
    run.until("a first checkpoint", |progress, _| progress.committed_ticks > 0);
    for (claim, words) in claims {
        let text_of = format!(
            "from caraware.run.process import HandoverRole, SuccessorClaims\n\
             HandoverRole.from_environment().wait_for_turn({claim})\n"
        );
        workplace.write("claims.py", &text_of);
        let output = workplace.run(&["handover", "misfit", "--set", "trainer.module=claims"]);
        let said = text(&output).replace('│', " ");
        let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(
            said.contains("the old trainer continues") && said.contains(words),
            "\"{words}\": {said}"
        );
    }
    assert_eq!(run.trainer.progress().incarnation, 0);
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert_undisturbed(&workplace, "misfit", 0);
}

#[test]
fn a_handover_now_does_not_wait_for_an_update_and_one_with_a_timeout_gives_up() {
    let workplace = Workplace::new();
    // The first update would come after all ticks.
    let settings = ["trainer.horizon=100000", "episode.evaluation_interval=0", PACED];
    let python = std::env::var("PYTHONPATH").unwrap_or_default();
    let arguments = arguments("now", &settings);
    let mut command = workplace.command(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    command.env("PYTHONPATH", format!("{}:{python}", workplace.path().display()));
    let mut run = Run::spawn(&workplace, "now", command);
    run.until("a tick", |progress, _| progress.consumed_ticks > 0);
    ending_module(&workplace, "idle", "import time; time.sleep(1000)");
    let module = "trainer.module=idle";
    let output = workplace.run(&["handover", "now", "--set", module, "--timeout-s", "3"]);
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(text(&output).contains("within 3 s"), "{}", text(&output));
    let output = workplace.run(&["handover", "now", "--now"]);
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(run.trainer.progress().committed_ticks, 0, "nothing had been learnt");
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    let report = workplace.report("now");
    assert_eq!(
        (&report["lost_ticks"], &report["duplicated_ticks"]),
        (&0.into(), &0.into())
    );
    assert_eq!(report["trainer"]["received_ticks"], report["ticks"]);
    assert_nothing_left(&workplace, "now");
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
        "episode.ticks=60",
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
