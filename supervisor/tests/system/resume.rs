//! A stopped run resumes from a checkpoint, and ends with the same results as a run that was never stopped.

use std::{
    path::{Path, PathBuf},
    process::{Child, Output, Stdio},
    sync::OnceLock,
};

use crate::common::{CURRICULUM, SMALL, Workplace, text, until};
use ipc_schema::{ports::BoardReader, process::Process, run::RunFile, services};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

fn arguments<'a>(name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    // A checkpoint for every update is kept.
    let kept = ["trainer.checkpoint_keep_every=1"];
    let settings = SMALL
        .iter()
        .chain(&kept)
        .chain(more)
        .flat_map(|setting| ["--set", setting]);
    ["train", "town", "--name", name].into_iter().chain(settings).collect()
}

fn run_dir(workplace: &Workplace, name: &str) -> PathBuf {
    workplace.path().join("runs").join(name)
}

/// The results of a run: the hash of every tensor of the newest checkpoint, every evaluation, and the number of samples.
type Outcome = (String, Vec<(u64, f64, f64)>, Value);

fn outcome(workplace: &Workplace, name: &str) -> Outcome {
    let report = workplace.report(name);
    assert_eq!(report["result"], "completed");
    assert_eq!(
        (&report["lost_ticks"], &report["duplicated_ticks"]),
        (&0.into(), &0.into()),
        "{report:#}"
    );
    let evaluation = |value: &Value| {
        (
            value["policy_version"].as_u64().unwrap(),
            value["ppo_mean_error_m"].as_f64().unwrap(),
            value["ekf_mean_error_m"].as_f64().unwrap(),
        )
    };
    let evaluations = report["trainer"]["evaluations"].as_array().unwrap();
    let learnt = (report["trainer"]["received_ticks"].clone(), report["env_steps"].clone());
    (
        tensors(&run_dir(workplace, name)),
        evaluations.iter().map(evaluation).collect(),
        serde_json::json!(learnt),
    )
}

/// The results of a run with the small settings that was never stopped, from the first such run.
static NEVER_STOPPED: OnceLock<Outcome> = OnceLock::new();

fn never_stopped(workplace: &Workplace) -> &'static Outcome {
    NEVER_STOPPED.get_or_init(|| {
        workplace.succeed(&arguments("never-stopped", &[]));
        outcome(workplace, "never-stopped")
    })
}

fn tensors(run: &Path) -> String {
    let checkpoints = run.join("checkpoints");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let mut hasher = blake3::Hasher::new();
    for name in ["parameters", "optimiser", "random"] {
        let file = checkpoints.join(newest.trim()).join(format!("{name}.safetensors"));
        hasher.update(&std::fs::read(file).unwrap());
    }
    format!("{} {}", newest.trim(), hasher.finalize().to_hex())
}

fn refused(output: &Output, code: i32, words: &[&str]) {
    let said = text(output);
    assert_eq!(output.status.code(), Some(code), "{said}");
    // Messages are wrapped for the terminal.
    let said = said.replace('│', " ").split_whitespace().collect::<Vec<_>>().join(" ");
    for word in words {
        assert!(said.contains(word), "\"{word}\" is missing:\n{said}");
    }
}

#[test]
fn a_resumed_run_ends_with_the_results_of_one_that_was_never_stopped() {
    let workplace = Workplace::new();
    workplace.succeed(&arguments("whole", &[]));
    let expected = NEVER_STOPPED.get_or_init(|| outcome(&workplace, "whole")).clone();
    assert_eq!(outcome(&workplace, "whole"), expected);
    assert_eq!(expected.1.len(), 2, "an evaluation between and one at the end");

    // The run is stopped in its second half. Its newest checkpoint is damaged, so it resumes from the one before.
    let mut run = workplace
        .command(&arguments("cut", &["run.real_time_factor=6"]))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let checkpoints = run_dir(&workplace, "cut").join("checkpoints");
    until(&mut run, "a checkpoint", || {
        checkpoints.join("update-000006").exists().then_some(())
    });
    refused(
        &workplace.run(&["train", "--resume", "cut"]),
        2,
        &["the run cut is alive", "caraware stop cut"],
    );
    kill_process(Pid::from_child(&run), Signal::INT).unwrap();
    assert_eq!(run.wait().unwrap().code(), Some(130));
    assert_eq!(workplace.report("cut")["result"], "interrupted");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let file = checkpoints.join(newest.trim()).join("optimiser.safetensors");
    let mut bytes = std::fs::read(&file).unwrap();
    bytes[1000] ^= 8;
    std::fs::write(&file, bytes).unwrap();
    let output = workplace.succeed(&["train", "--resume", "cut", "--set", "run.real_time_factor=0"]);
    assert!(
        text(&output).contains("optimiser.safetensors: is damaged"),
        "{}",
        text(&output)
    );
    let resumed = workplace.report("cut");
    let beginning = resumed["beginning"].clone();
    assert!(beginning["episode"].as_u64().unwrap() > 0, "{beginning}");
    // Its rates are those of what it has made itself, its counts those of the whole run.
    let figure = |key: &str| resumed[key].as_f64().unwrap();
    let made_s = figure("real_time_factor") * figure("wall_s");
    let earlier_s = 0.1 * beginning["episode_tick"].as_f64().unwrap();
    assert!(
        (made_s - (figure("simulated_s") - earlier_s)).abs() < 0.1,
        "{made_s}: {resumed:#}"
    );
    assert!(beginning["committed_ticks"].as_u64().unwrap() > beginning["episode_tick"].as_u64().unwrap());
    assert_eq!(outcome(&workplace, "cut"), expected);
    // What counts from the start of the program is kept beside that.
    let earlier = resumed["earlier_starts"].as_array().unwrap();
    assert_eq!(earlier.len(), 1, "{resumed:#}");
    assert_eq!(earlier[0]["result"], "interrupted");
    assert_eq!(
        (&earlier[0]["restarts"], &earlier[0]["handovers"]),
        (&0.into(), &Value::Array(vec![]))
    );
    assert!(earlier[0]["wall_s"].as_f64().unwrap() > 0.0, "{resumed:#}");

    // A new run may begin at any checkpoint, and leaves the old run as it is.
    let before = crate::common::tree(&run_dir(&workplace, "whole"));
    for (kept, name) in [("update-000002", "from-2"), ("update-000005", "from-5")] {
        let checkpoint = format!("runs/whole/checkpoints/{kept}");
        workplace.succeed(&["train", "--resume", &checkpoint, "--name", name]);
        assert_eq!(outcome(&workplace, name), expected, "{kept}");
    }
    assert_eq!(crate::common::tree(&run_dir(&workplace, "whole")), before);
    // The first new run begins with the first episode, so its hash covers the observations of the whole run.
    let hash = |name: &str| workplace.report(name)["observation_hash"].clone();
    assert_eq!(workplace.report("from-2")["beginning"]["episode_tick"], 0);
    assert_eq!(hash("from-2"), hash("whole"));
    assert_ne!(hash("from-5"), hash("whole"));
    workplace.assert_nothing_left();

    let cavs = ["train", "--resume", "whole", "--set", "traffic.cavs=7"];
    refused(&workplace.run(&cavs), 2, &["`traffic.cavs` cannot change", "trainer."]);
    let wide = ["train", "--resume", "whole", "--set", "trainer.hidden=[64]"];
    refused(&workplace.run(&wide), 2, &["hidden layers [32, 32]", "[64]"]);
    refused(
        &workplace.run(&["train", "--resume", "unknown"]),
        2,
        &["`unknown` is neither a run"],
    );
    refused(
        &workplace.run(&["train", "town", "--resume", "whole"]),
        2,
        &["cannot be used with"],
    );
}

/// Resumes a new run from each checkpoint of `kept`: its results and its `log` equal those of the run `whole`.
fn assert_same_end_from_every_checkpoint(workplace: &Workplace, log: &str, kept: &[&str]) {
    let expected = outcome(workplace, "whole");
    let log = |name: &str| std::fs::read_to_string(run_dir(workplace, name).join(log)).unwrap();
    for kept in kept {
        let checkpoint = format!("runs/whole/checkpoints/{kept}");
        workplace.succeed(&["train", "--resume", &checkpoint, "--name", kept]);
        assert_eq!(outcome(workplace, kept), expected, "{kept}");
        assert_eq!(log(kept), log("whole"), "{kept}");
    }
}

/// Starts `arguments` at a slow pace, stops the run after the checkpoint `kept`, and resumes it in its directory.
fn stop_and_resume(workplace: &Workplace, name: &str, arguments: &[&str], kept: &str) {
    let pace = [arguments, &["--set", "run.real_time_factor=20"]].concat();
    let mut command = workplace.command(&pace);
    let mut run = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let checkpoint = run_dir(workplace, name).join("checkpoints").join(kept);
    until(&mut run, kept, || checkpoint.exists().then_some(()));
    kill_process(Pid::from_child(&run), Signal::INT).unwrap();
    assert_eq!(run.wait().unwrap().code(), Some(130));
    workplace.succeed(&["train", "--resume", name, "--set", "run.real_time_factor=0"]);
}

#[test]
fn every_environment_resumes_at_its_own_tick() {
    let workplace = Workplace::new();
    let two = ["run.envs=2", "trainer.horizon=600"];
    workplace.succeed(&arguments("whole", &two));
    let expected = outcome(&workplace, "whole");
    stop_and_resume(&workplace, "cut", &arguments("cut", &two), "update-000005");
    assert_eq!(outcome(&workplace, "cut"), expected);
    let beginning = workplace.report("cut")["beginning"].clone();
    let second = &beginning["others"][0];
    assert!(second["episode"].as_u64().unwrap() > 0, "{beginning}");
    let [learnt, made] = ["committed_ticks", "episode_tick"].map(|key| second[key].as_u64().unwrap());
    assert!(learnt > made && made > 0, "{beginning}");

    let checkpoint = "runs/whole/checkpoints/update-000003";
    workplace.succeed(&["train", "--resume", checkpoint, "--name", "from-3"]);
    assert_eq!(outcome(&workplace, "from-3"), expected);
    workplace.assert_nothing_left();
}

#[test]
fn a_curriculum_resumes_within_its_stages() {
    let workplace = Workplace::new();
    let more = [
        "episode.evaluation_interval=4",
        "trainer.supervised=false",
        "trainer.checkpoint_interval=1",
        "trainer.checkpoint_keep_every=1",
    ];
    let settings = CURRICULUM.iter().chain(&more).flat_map(|setting| ["--set", setting]);
    let settings: Vec<&str> = settings.collect();
    let arguments = |name| [&["train", "paper", "--name", name][..], &settings].concat();
    workplace.succeed(&arguments("whole"));
    let log = |name: &str| std::fs::read_to_string(run_dir(&workplace, name).join("curriculum.jsonl")).unwrap();
    assert_eq!(log("whole").lines().count(), 4, "{}", log("whole"));
    // In the first stage, which is one episode, in the second, and in the third.
    let kept = ["update-000002", "update-000005", "update-000007"];
    assert_same_end_from_every_checkpoint(&workplace, "curriculum.jsonl", &kept);
    let begins = kept.map(|name| workplace.report(name)["beginning"]["episode_tick"].as_u64().unwrap());
    assert!(
        begins[0] == 0 && begins.is_sorted() && begins[2] > begins[1],
        "{begins:?}"
    );
    stop_and_resume(&workplace, "cut", &arguments("cut"), "update-000004");
    assert_eq!(outcome(&workplace, "cut"), outcome(&workplace, "whole"));
    assert_eq!(log("cut"), log("whole"));
    workplace.assert_nothing_left();
}

/// Commands in the first episode, which is reset at tick 75, in episodes after it, of which one is reset at tick 310, and in the one after
/// that.
const COMMANDS: &str = r#"{"tick":50,"episode":0,"control":{"command":"sensor","vehicle":"cav.1","sensor":"gnss","state":"off"}}
{"tick":75,"episode":0,"control":{"command":"reset"}}
{"tick":100,"episode":1,"control":{"command":"destination","vehicle":"cav.1","edge":"ring_west_2"}}
{"tick":310,"episode":2,"control":{"command":"reset"}}
{"tick":350,"episode":3,"control":{"command":"sensor","vehicle":null,"sensor":"imu","state":"off"}}
{"tick":380,"episode":3,"control":{"command":"start","vehicle":"cav.3","edge":"ring_north_1"}}
"#;

/// Crates on the lanes of Main Street and Market Street.
const CRATES: &str = r#"scene.obstacles=["crate 129 126 45", "crate 92.7 125.3", "crate 93.1 121.8", "crate 148.3 127.2",
    "crate 137.9 124.7", "crate 167.7 93.6", "crate 171.2 93.5", "crate 170 147.3", "crate 173.5 147.2", "crate 175.2 201.5",
    "crate 207.6 112.8", "crate 209.7 116"]"#;

/// Ticks of the contacts in the log of a run.
fn contact_ticks(contacts: &str) -> Vec<u64> {
    let line = |line| serde_json::from_str::<Value>(line).unwrap();
    contacts
        .lines()
        .map(|text| line(text)["tick"].as_u64().unwrap())
        .collect()
}

/// The log of contacts keeps those of the earlier part, and has each of the others once.
#[test]
fn commands_after_the_checkpoint_are_carried_out_again_and_contacts_are_kept() {
    let workplace = Workplace::new();
    let file = workplace.write("commands.jsonl", COMMANDS);
    let commanded = |name| [&arguments(name, &[CRATES])[..], &["--commands", file.to_str().unwrap()]].concat();
    workplace.succeed(&commanded("whole"));
    assert_same_end_from_every_checkpoint(&workplace, "commands.jsonl", &["update-000002", "update-000008"]);
    let beginning = |name: &str| workplace.report(name)["beginning"].clone();
    assert_eq!(beginning("update-000002")["resets"], 1);
    assert_eq!(beginning("update-000008")["resets"], 2);
    stop_and_resume(&workplace, "cut", &commanded("cut"), "update-000004");
    assert_eq!(outcome(&workplace, "cut"), outcome(&workplace, "whole"));
    let contacts =
        |name: &str| std::fs::read_to_string(run_dir(&workplace, name).join("events/collisions.jsonl")).unwrap();
    let resumed_at = beginning("cut")["episode_tick"].as_u64().unwrap();
    let (earlier, later): (Vec<u64>, Vec<u64>) = contact_ticks(&contacts("whole"))
        .into_iter()
        .partition(|tick| *tick < resumed_at);
    assert!(
        !earlier.is_empty() && !later.is_empty(),
        "{earlier:?}, {resumed_at}, {later:?}"
    );
    assert_eq!(contacts("cut"), contacts("whole"));
    workplace.assert_nothing_left();
}

/// A pace at which the supervisor can be killed at a given tick: 16 s for the run.
const SLOW: &str = "run.real_time_factor=4";

/// The supervisor of the run `name` that is none of `before`.
fn supervisor(workplace: &Workplace, name: &str, run: &mut Child, before: &[Pid]) -> Pid {
    let run_file = run_dir(workplace, name).join("run.json");
    until(run, "a supervisor", || {
        let run = RunFile::read(&run_file).ok()?;
        Pid::from_raw(run.supervisor_pid).filter(|pid| !before.contains(pid))
    })
}

/// Waits until the run under the supervisor `pid` has sensed `ticks` ticks.
///
/// Returns the trainer, which would write a checkpoint when its supervisor dies.
fn until_sensed(workplace: &Workplace, name: &str, run: &mut Child, pid: Pid, ticks: u64) -> Pid {
    let run_file = run_dir(workplace, name).join("run.json");
    let (_node, board, trainer) = until(run, "boards", || {
        let run = RunFile::read(&run_file).ok()?;
        let node = services::node(&run.shared_memory).ok()?;
        let board = BoardReader::open(&node, &run, 0, Process::SensorDaemon).ok()?;
        let trainer = BoardReader::open(&node, &run, 0, Process::Trainer).ok()?;
        (run.supervisor_pid == pid.as_raw_nonzero().get()).then_some((node, board, trainer))
    });
    until(run, "ticks", || (board.health().ticks >= ticks).then_some(()));
    Pid::from_raw(trainer.health().pid).unwrap()
}

#[test]
fn a_run_that_is_killed_before_its_first_checkpoint_resumes_from_its_beginning() {
    let workplace = Workplace::new();
    let late = ["trainer.horizon=1200"];
    workplace.succeed(&arguments("whole", &late));
    let expected = outcome(&workplace, "whole");
    let mut command = arguments("cut", &[late[0], SLOW]);
    // While the processes start, and twice while the first horizon fills, which is 200 ticks long.
    for ticks in [0, 15, 50] {
        let mut spawned = workplace.command(&command);
        let mut run = spawned.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let pid = Pid::from_child(&run);
        until(&mut run, "the run file", || {
            let run = RunFile::read(&run_dir(&workplace, "cut").join("run.json")).ok()?;
            (run.supervisor_pid == pid.as_raw_nonzero().get()).then_some(())
        });
        let trainer = (ticks > 0).then(|| until_sensed(&workplace, "cut", &mut run, pid, ticks));
        if let Some(trainer) = trainer {
            kill_process(trainer, Signal::STOP).unwrap();
        }
        kill_process(pid, Signal::KILL).unwrap();
        if let Some(trainer) = trainer {
            kill_process(trainer, Signal::KILL).unwrap();
        }
        assert_eq!(run.wait().unwrap().code(), None);
        command = vec!["train", "--resume", "cut"];
    }
    let named = workplace.run(&["train", "--resume", "cut", "--name", "other"]);
    refused(&named, 2, &["has no checkpoint", "leave --name out"]);
    workplace.succeed(&["train", "--resume", "cut", "--set", "run.real_time_factor=0"]);
    assert!(workplace.report("cut")["beginning"].is_null());
    assert_eq!(outcome(&workplace, "cut"), expected);
    let hash = |name: &str| workplace.report(name)["observation_hash"].clone();
    assert_eq!(hash("cut"), hash("whole"));
    workplace.assert_nothing_left();
}

#[test]
fn a_run_with_restart_resumes_by_itself_until_it_is_asked_to_stop() {
    let workplace = Workplace::new();
    let command = [&arguments("cut", &[SLOW])[..], &["--restart"]].concat();
    let log = std::fs::File::create(workplace.path().join("said")).unwrap();
    let mut spawned = workplace.command(&command);
    let mut run = spawned.stdout(Stdio::null()).stderr(log).spawn().unwrap();
    // While the processes start, before the first checkpoint (tick 50), and after it.
    let mut killed = Vec::new();
    for ticks in [0, 20, 175] {
        let pid = supervisor(&workplace, "cut", &mut run, &killed);
        if ticks > 0 {
            until_sensed(&workplace, "cut", &mut run, pid, ticks);
        }
        kill_process(pid, Signal::KILL).unwrap();
        killed.push(pid);
    }
    let status = run.wait().unwrap();
    let said = std::fs::read_to_string(workplace.path().join("said")).unwrap();
    assert!(status.success(), "{status}\n{said}");
    assert_eq!(
        said.matches("the supervisor ended with signal 9; the run resumes")
            .count(),
        3,
        "{said}"
    );
    assert_eq!(outcome(&workplace, "cut"), *never_stopped(&workplace));
    workplace.assert_nothing_left();

    // A stop on request is final, and a wrong configuration is no death.
    let command = [&arguments("stopped", &[SLOW])[..], &["--restart"]].concat();
    let mut spawned = workplace.command(&command);
    let mut run = spawned.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let pid = supervisor(&workplace, "stopped", &mut run, &[]);
    until_sensed(&workplace, "stopped", &mut run, pid, 10);
    kill_process(Pid::from_child(&run), Signal::TERM).unwrap();
    assert_eq!(run.wait().unwrap().code(), Some(130));
    assert_eq!(workplace.report("stopped")["result"], "interrupted");
    let wrong = workplace.run(&["train", "town", "--restart", "--set", "traffic.cavs=-1"]);
    refused(&wrong, 2, &["traffic.cavs"]);
    workplace.assert_nothing_left();
}
