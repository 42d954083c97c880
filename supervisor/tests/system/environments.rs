//! Several environments in one run: each makes the same observations as alone, and one trainer learns from all.

use std::{
    collections::BTreeMap,
    path::Path,
    process::{Child, Stdio},
};

use crate::common::{Workplace, text, until};
use ipc_schema::{
    ports::BoardReader,
    process::Process,
    run::RunFile,
    services::{self, RunNode},
};
use rustix::process::{Pid, Signal, kill_process};

/// Four vehicles, three training episodes, one evaluation in between and one at the end: 400 ticks, 8 updates with two environments.
const SMALL: [&str; 14] = [
    "traffic.cavs=4",
    "traffic.others=2",
    "traffic.pedestrians=2",
    "episode.ticks=100",
    "episode.training_episodes=3",
    "episode.evaluation_interval=2",
    "episode.evaluation_ticks=50",
    "episode.final_evaluations=1",
    "trainer.horizon=256",
    "trainer.plots=false",
    "trainer.batch_size=128",
    "trainer.hidden=[32, 32]",
    "trainer.checkpoint_interval=2",
    "fanout.enabled=false",
];

fn arguments(command: &str, name: &str, more: &[&str]) -> Vec<String> {
    let settings = SMALL.into_iter().flat_map(|setting| ["--set", setting]);
    [command, "town", "--name", name]
        .into_iter()
        .chain(settings)
        .chain(more.iter().copied())
        .map(str::to_owned)
        .collect()
}

fn succeed(workplace: &Workplace, command: &str, name: &str, more: &[&str]) -> String {
    let arguments = arguments(command, name, more);
    text(&workplace.succeed(&arguments.iter().map(String::as_str).collect::<Vec<_>>()))
}

/// A run in the background, with access to its shared memory.
struct Live {
    child: Child,
    node: RunNode,
    file: RunFile,
}

impl Live {
    fn start(workplace: &Workplace, command: &str, name: &str, more: &[&str]) -> Self {
        let arguments = arguments(command, name, more);
        let mut child = workplace
            .command(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let path = workplace.path().join("runs").join(name).join("run.json");
        let (node, file) = until(&mut child, "boards", || {
            let file = RunFile::read(&path).ok()?;
            let node = services::node(&file.shared_memory).ok()?;
            BoardReader::open(&node, &file, file.config.run.envs - 1, Process::Trainer).ok()?;
            Some((node, file))
        });
        Self { child, node, file }
    }

    /// Waits until a process has consumed or made `ticks` of an environment; returns its board.
    fn reach(&mut self, process: Process, environment: u32, ticks: u64) -> BoardReader {
        let board = BoardReader::open(&self.node, &self.file, environment, process).unwrap();
        until(&mut self.child, "ticks", || {
            (board.health().ticks >= ticks).then_some(())
        });
        board
    }

    /// Kills a process once its environment has consumed or made `ticks`.
    fn kill(&mut self, process: Process, environment: u32, ticks: u64) {
        let board = self.reach(process, environment, ticks);
        kill_process(Pid::from_raw(board.health().pid).unwrap(), Signal::KILL).unwrap();
    }

    /// Waits for the end; returns the exit code and the output.
    fn end(self) -> (Option<i32>, String) {
        drop(self.node);
        let output = self.child.wait_with_output().unwrap();
        (output.status.code(), text(&output))
    }
}

/// Hash of the parameters, moments and generators of the newest checkpoint.
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

#[test]
fn an_environment_makes_the_same_observations_beside_others_as_alone() {
    let workplace = Workplace::new();
    succeed(&workplace, "simulate", "alone", &[]);
    succeed(&workplace, "simulate", "second", &["--set", "run.first_env=1"]);
    let said = succeed(&workplace, "simulate", "both", &["--envs", "2"]);
    let (alone, second, both) = (
        workplace.report("alone"),
        workplace.report("second"),
        workplace.report("both"),
    );
    let environments = both["environments"].as_array().unwrap();
    for (environment, single) in environments.iter().zip([&alone, &second]) {
        assert_eq!(environment["observation_hash"], single["observation_hash"]);
        assert_eq!(environment["seed"], single["seed"]);
        assert_eq!(environment["vehicle_steps"], single["vehicle_steps"]);
        let hash = environment["observation_hash"].as_str().unwrap();
        assert!(said.contains(hash), "{said}");
    }
    assert_ne!(alone["observation_hash"], second["observation_hash"]);
    let sum = |key: &str| alone[key].as_u64().unwrap() + second[key].as_u64().unwrap();
    for key in ["vehicle_steps", "ticks", "vehicles"] {
        assert_eq!(both[key], sum(key), "{key}");
    }
    let run = workplace.path().join("runs/both");
    for file in ["logs/sim-core.log", "env-1/logs/sim-core.log", "env-1/run.json"] {
        assert!(run.join(file).is_file(), "{file} is missing");
    }
    workplace.assert_nothing_left();
}

#[test]
fn a_restarted_trainer_receives_the_uncommitted_ticks_of_every_environment() {
    let workplace = Workplace::new();
    succeed(&workplace, "train", "undisturbed", &["--envs", "2"]);
    let mut live = Live::start(&workplace, "train", "killed", &["--envs", "2"]);
    live.kill(Process::Trainer, 1, 75);
    let (code, said) = live.end();
    assert_eq!(code, Some(0), "{said}");
    let (expected, found) = (workplace.report("undisturbed"), workplace.report("killed"));
    let learnt = |name: &str| learnt(&workplace.path().join("runs").join(name));
    assert_eq!(learnt("killed"), learnt("undisturbed"));
    assert_eq!(found["restarts"], 1);
    for (found, expected) in [(&found, 1), (&expected, 0)].map(|(report, restarts)| (report, restarts)) {
        assert_eq!(found["restarts"], expected);
        assert_eq!(
            (&found["lost_ticks"], &found["duplicated_ticks"]),
            (&0.into(), &0.into())
        );
        assert_eq!(found["trainer"]["received_ticks"], found["ticks"]);
        assert_eq!(found["trainer"]["updates"], 9, "{found:#}");
    }
    for (one, other) in [0, 1].map(|index| (&found["environments"][index], &expected["environments"][index])) {
        assert_eq!(one["observation_hash"], other["observation_hash"]);
        assert!(one["redelivered_ticks"].as_u64().unwrap() > 0, "{one:#}");
    }
    workplace.assert_nothing_left();
}

/// `caraware.study.recording` commits an episode when its file is written, in every environment.
#[test]
fn ticks_that_are_written_down_are_the_same_after_a_kill_and_a_handover() {
    let workplace = Workplace::new();
    let recording = ["--envs", "2", "--set", "trainer.module=caraware.study.recording"];
    succeed(&workplace, "train", "whole", &recording);
    let files = |run: &str| -> BTreeMap<String, Vec<u8>> {
        let run = workplace.path().join("runs").join(run);
        let mut files = BTreeMap::new();
        for folder in ["recording", "env-1/recording"] {
            for entry in std::fs::read_dir(run.join(folder)).unwrap().map(Result::unwrap) {
                let name = format!("{folder}/{}", entry.file_name().display());
                files.insert(name, std::fs::read(entry.path()).unwrap());
            }
        }
        files
    };
    let whole = files("whole");
    assert_eq!(whole.len(), 10, "{:?}", whole.keys());
    // A run lasts 40 s at the pace of real time, and a busy machine takes ten for a successor to start.
    for (name, pace) in [
        ("killed", "run.real_time_factor=20"),
        ("replaced", "run.real_time_factor=1"),
    ] {
        let paced = [&recording[..], &["--set", pace]].concat();
        let mut live = Live::start(&workplace, "train", name, &paced);
        if name == "killed" {
            live.kill(Process::Trainer, 1, 150);
        } else {
            live.reach(Process::Trainer, 1, 30);
            workplace.succeed(&["handover", name]);
        }
        let (code, said) = live.end();
        assert_eq!(code, Some(0), "{said}");
        let found = files(name);
        assert!(found.keys().eq(whole.keys()), "{name}: {:?}", found.keys());
        let differing: Vec<&String> = whole.keys().filter(|file| found[*file] != whole[*file]).collect();
        assert!(differing.is_empty(), "{name}: {differing:?}");
        let report = workplace.report(name);
        let handovers = report["handovers"].as_array().map_or(0, Vec::len);
        let counts = if name == "killed" { (1, 0) } else { (0, 1) };
        assert_eq!((report["restarts"].as_u64().unwrap(), handovers), counts, "{report:#}");
        assert_eq!(report["trainer"]["recorded_episodes"], 10, "{report:#}");
    }
    workplace.assert_nothing_left();
}

#[test]
fn a_trainer_without_a_place_in_every_environment_is_refused_with_the_reason() {
    let workplace = Workplace::new();
    let settings = [
        "--envs",
        "2",
        "--set",
        "trainer.module=caraware.consumer",
        "--set",
        "run.ready_s=15",
    ];
    let arguments = arguments("train", "one", &settings);
    let output = workplace.run(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for part in [
        "trainer was not ready within 15 s",
        "no place in environment 1",
        "without --envs",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    workplace.assert_nothing_left();
}

#[test]
fn a_simulator_that_is_killed_is_named_with_its_environment_which_is_made_again() {
    let workplace = Workplace::new();
    succeed(&workplace, "simulate", "whole", &["--envs", "3"]);
    // At this pace the kill has more than a second before the end.
    let paced = ["--envs", "3", "--set", "run.real_time_factor=20"];
    let mut live = Live::start(&workplace, "simulate", "broken", &paced);
    live.kill(Process::SimCore, 2, 20);
    let (code, said) = live.end();
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("sim-core/2 ended with signal: 9"), "{said}");
    assert!(said.contains("the simulation is made again from tick 0"), "{said}");
    let [whole, broken] = ["whole", "broken"].map(|name| workplace.report(name));
    let hashes = |report: &serde_json::Value| -> Vec<String> {
        let environments = report["environments"].as_array().unwrap().iter();
        environments.map(|one| one["observation_hash"].to_string()).collect()
    };
    assert_eq!(hashes(&whole), hashes(&broken));
    workplace.assert_nothing_left();
}

#[test]
fn the_need_of_shared_memory_grows_with_the_number_of_environments() {
    let workplace = Workplace::new();
    // One such environment needs half a gibibyte; sixty-four need more than the /dev/shm of any test machine.
    let asked = ["--envs", "64", "--set", "traffic.max_road_users=100000"];
    let arguments = arguments("simulate", "many", &asked);
    let output = workplace.run(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    let said = text(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains("`run.envs` (now 64)"), "{said}");
}
