//! `caraware play`: the policy of a checkpoint predicts beside a Kalman filter, without learning.

use std::process::{Output, Stdio};

use crate::common::{Spectator, Workplace, caught, text, until};
use ipc_schema::{process::Process, services::Channel};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

const SMALL: [&str; 13] = [
    "traffic.cavs=4",
    "traffic.others=2",
    "traffic.pedestrians=0",
    "episode.ticks=80",
    "episode.training_episodes=1",
    "episode.evaluation_ticks=40",
    "episode.final_evaluations=1",
    "trainer.horizon=150",
    "trainer.plots=false",
    "trainer.batch_size=75",
    "trainer.hidden=[32, 32]",
    // In bfloat16, which "auto" takes where there is AMX, answers to one row and to several differ by more than the last bits.
    "trainer.matmul_precision=float32",
    "fanout.enabled=false",
];

fn train(workplace: &Workplace) {
    let settings = SMALL.iter().flat_map(|setting| ["--set", setting]);
    let arguments: Vec<&str> = ["train", "town", "--name", "learnt"]
        .into_iter()
        .chain(settings)
        .collect();
    workplace.succeed(&arguments);
}

fn refused(output: &Output, words: &[&str]) {
    let said = text(output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    // Messages are wrapped for the terminal.
    let said = said.replace('│', " ").split_whitespace().collect::<Vec<_>>().join(" ");
    for word in words {
        assert!(said.contains(word), "\"{word}\" is missing:\n{said}");
    }
}

#[test]
fn a_checkpoint_plays_until_it_is_stopped_and_learns_nothing() {
    let workplace = Workplace::new();
    train(&workplace);
    let learnt = workplace.path().join("runs/learnt");
    let before = crate::common::tree(&learnt);

    // A limited number of episodes.
    let output = workplace.succeed(&["play", "learnt", "--episodes", "2", "--name", "twice"]);
    let report = workplace.report("twice");
    assert_eq!(
        (&report["mode"], &report["result"]),
        (&"play".into(), &"completed".into())
    );
    assert_eq!(
        (&report["ticks"], &report["evaluation_seeds"]),
        (&160.into(), &2.into())
    );
    let error_m = |key: &str| report[key].as_f64().unwrap();
    assert!(error_m("ekf_mean_error_m") < error_m("raw_gnss_mean_error_m"));
    assert!(error_m("ppo_mean_error_m") > 0.0 && error_m("ppo_ci95_m") > 0.0);
    assert!(text(&output).contains("EKF"), "{}", text(&output));
    let twice = workplace.path().join("runs/twice");
    assert!(!twice.join("checkpoints").exists(), "nothing is learnt");
    let live: Value = serde_json::from_str(&std::fs::read_to_string(twice.join("live.json")).unwrap()).unwrap();
    let vehicles = live["table"]["vehicles"].as_array().unwrap();
    assert_eq!(vehicles.len(), 4);
    for vehicle in vehicles {
        assert!(vehicle["vehicle"].as_str().unwrap().starts_with("cav."));
        assert!(vehicle["now"]["ppo"].as_f64().unwrap() > 0.0);
        assert!(vehicle["mean"]["ekf"].as_f64().unwrap() > 0.0);
    }

    // Without a limit, from a checkpoint's directory: predictions are published, and Ctrl-C ends the run with a report.
    let checkpoint = learnt.join("checkpoints/update-000002");
    let mut run = workplace
        .command(&[
            "play",
            checkpoint.to_str().unwrap(),
            "--name",
            "on",
            "--set",
            "episode.ticks=50",
        ])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let spectator = Spectator::join(&workplace.path().join("runs/on/run.json"), &mut run);
    let predictions = spectator.subscribe(Channel::Prediction);
    let message = caught(&mut run, "a prediction", || predictions.receive().unwrap());
    assert_eq!(
        (message.header().shape[1], message.header().policy_version),
        (2, 2),
        "policy version 2"
    );
    drop((message, predictions, spectator));
    let file = workplace.path().join("runs/on/live.json");
    let episode = || {
        let live: Value = serde_json::from_str(&std::fs::read_to_string(&file).ok()?).ok()?;
        live["table"]["episode"].as_u64()
    };
    until(&mut run, "the sixth episode", || {
        episode().filter(|episode| *episode >= 5)
    });
    kill_process(Pid::from_child(&run), Signal::INT).unwrap();
    assert_eq!(run.wait().unwrap().code(), Some(130));
    let report = workplace.report("on");
    assert_eq!(
        (&report["mode"], &report["result"]),
        (&"play".into(), &"interrupted".into())
    );
    assert!(report["evaluation_seeds"].as_u64().unwrap() >= 5);
    assert_eq!(
        crate::common::tree(&learnt),
        before,
        "the run of the checkpoint is unchanged"
    );
    workplace.assert_nothing_left();

    let fields = ["play", "learnt", "--set", "observation.fields=caraware"];
    refused(
        &workplace.run(&fields),
        &[
            "observation has 9 numbers, the configuration's 11",
            "observation.fields",
        ],
    );
    let hidden = ["play", "learnt", "--set", "trainer.hidden=[16]"];
    refused(
        &workplace.run(&hidden),
        &["hidden layers [32, 32], the configuration's [16]"],
    );
    refused(&workplace.run(&["play", "unknown"]), &["`unknown` is neither a run"]);
    let help = text(&workplace.run(&["play", "--help"]));
    for words in ["RUN|CHECKPOINT", "--episodes", "Kalman", "Examples"] {
        assert!(help.contains(words), "{help}");
    }
}

/// Simulators of a playing run die at moments of which none is between two episodes.
#[test]
fn simulators_that_die_change_nothing_that_a_player_counts() {
    let workplace = Workplace::new();
    train(&workplace);
    workplace.succeed(&["play", "learnt", "--episodes", "4", "--name", "whole"]);
    let log = std::fs::File::create(workplace.path().join("said")).unwrap();
    let paced = ["--episodes", "4", "--set", "run.real_time_factor=2.5"];
    let mut run = workplace
        .command(&[&["play", "learnt", "--name", "killed"], paced.as_slice()].concat())
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .unwrap();
    let spectator = Spectator::join(&workplace.path().join("runs/killed/run.json"), &mut run);
    for (ticks, process) in [
        (20, Process::SimCore),
        (90, Process::TrafficBridge),
        (150, Process::SensorDaemon),
        (210, Process::SimCore),
    ] {
        let (player, victim) = (spectator.board(Process::Trainer), spectator.board(process));
        until(&mut run, "ticks", || {
            (player.progress().consumed_ticks >= ticks).then_some(())
        });
        let pid = until(&mut run, "a process", || Pid::from_raw(victim.health().pid));
        kill_process(pid, Signal::KILL).unwrap();
    }
    drop(spectator);
    let status = run.wait().unwrap();
    let said = std::fs::read_to_string(workplace.path().join("said")).unwrap();
    assert!(status.success(), "{status}\n{said}");
    assert_eq!(
        said.matches("the simulation is made again from tick").count(),
        4,
        "{said}"
    );
    let [whole, killed] = ["whole", "killed"].map(|name| workplace.report(name));
    for key in [
        "result",
        "observation_hash",
        "ticks",
        "vehicle_steps",
        "evaluation_seeds",
    ] {
        assert_eq!(whole[key], killed[key], "{key}");
    }
    for key in ["ekf_mean_error_m", "raw_gnss_mean_error_m", "vehicles"] {
        assert!(!whole["trainer"][key].is_null(), "{key}");
        assert_eq!(whole["trainer"][key], killed["trainer"][key], "{key}");
    }
    // The last bits of a network's answer depend on how many ticks were waiting when it was asked.
    let policy_m = |report: &Value| {
        let episodes = report["trainer"]["episodes"].as_array().unwrap().iter();
        episodes
            .map(|episode| (episode["ppo"].as_f64().unwrap() * 1e4).round())
            .collect::<Vec<f64>>()
    };
    assert_eq!(policy_m(&whole), policy_m(&killed));
    workplace.assert_nothing_left();
}
