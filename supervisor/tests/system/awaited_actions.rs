//! Our PPO in the tasks whose world waits for actions: whichever process is killed, replaced or stopped, the run learns the same.

use std::process::{Child, Stdio};

use crate::common::{ACTING, Workplace, text, until};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// A preset of such a task, and what its runs have.
struct WaitingWorld {
    preset: &'static str,
    /// Two small worlds, and an update every 300 samples.
    settings: &'static [&'static str],
    /// Simulators that die, in order, and the process that waits for actions.
    victims: [&'static str; 3],
    actor: &'static str,
    /// Key of the headline metric's mean.
    mean: &'static str,
    /// What the actions have led to, of a report.
    achieved: fn(&Value) -> Value,
}

/// Four heroes in each world: 300 samples are 38 ticks.
const DRIVING: WaitingWorld = WaitingWorld {
    preset: "driving",
    settings: &[
        "traffic.heroes=4",
        "task.time_limit_s=10",
        "trainer.network=mlp",
        "trainer.hidden=[16]",
        "observation.fields=driving",
    ],
    victims: ["/sim-core", "/traffic-bridge", "/sensor-daemon"],
    actor: "/sim-core",
    mean: "ppo_mean_progress_mps",
    achieved: |report| report["dynamics"]["heroes"].clone(),
};

/// Four stations in each world.
const MESSAGES: WaitingWorld = WaitingWorld {
    preset: "messages",
    settings: &["traffic.cavs=4", "trainer.hidden=[16]"],
    victims: ["/v2x", "/traffic-bridge", "/sensor-daemon"],
    actor: "/v2x",
    mean: "ppo_mean_awareness_percent",
    achieved: |report| {
        let [one, other] = [0, 1].map(|index: usize| &report["environments"][index]["v2x"]);
        let other = [&other["neighbours_hash"], &other["speech"]];
        serde_json::json!([one["neighbours_hash"], one["speech"], one["cpms"], other])
    },
};

fn arguments<'a>(world: &WaitingWorld, name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let settings = ["run.envs=2"].iter().chain(&ACTING).chain(world.settings).chain(more);
    ["train", world.preset, "--name", name]
        .into_iter()
        .chain(settings.flat_map(|setting| ["--set", setting]))
        .collect()
}

/// What was learnt: the newest checkpoint's name and the hash of its tensors.
fn learnt(workplace: &Workplace, name: &str) -> String {
    let checkpoints = workplace.path().join("runs").join(name).join("checkpoints");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let mut hasher = blake3::Hasher::new();
    for file in ["parameters", "optimiser", "memory"] {
        let file = checkpoints.join(newest.trim()).join(format!("{file}.safetensors"));
        hasher.update(&std::fs::read(file).unwrap());
    }
    format!("{} {}", newest.trim(), hasher.finalize().to_hex())
}

/// What a disturbed run has in common with one that was not: observations, what was achieved, samples, evaluations, parameters.
fn outcome(world: &WaitingWorld, workplace: &Workplace, name: &str) -> Value {
    let report = workplace.report(name);
    assert_eq!(report["result"], "completed", "{name}");
    let evaluations = report["trainer"]["evaluations"].as_array().unwrap();
    serde_json::json!({
        "learnt": learnt(workplace, name),
        "hash": report["observation_hash"],
        "env_steps": report["env_steps"],
        "lost": [report["lost_ticks"], report["duplicated_ticks"]],
        "achieved": (world.achieved)(&report),
        "evaluations": evaluations.iter().map(|each| each[world.mean].clone()).collect::<Vec<_>>(),
    })
}

fn start(workplace: &Workplace, arguments: &[&str], log: &str) -> Child {
    let log = std::fs::File::create(workplace.path().join(log)).unwrap();
    let command = workplace.command(arguments).stdout(Stdio::null()).stderr(log).spawn();
    command.unwrap()
}

/// Process ids of a run's processes whose command line has `word`.
fn processes(workplace: &Workplace, name: &str, word: &str) -> Vec<Pid> {
    let here = workplace.path().join("runs").join(name).to_string_lossy().into_owned();
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    let pids = entries.filter_map(|entry| {
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).into_owned();
        let pid: i32 = entry.file_name().to_str()?.parse().ok()?;
        (line.contains(word) && line.contains(&format!("{here}/")))
            .then(|| Pid::from_raw(pid))
            .flatten()
    });
    pids.collect()
}

fn wait_for_checkpoint(workplace: &Workplace, name: &str, updates: u32, run: &mut Child) {
    let checkpoints = workplace.path().join("runs").join(name).join("checkpoints");
    until(run, "a checkpoint", || {
        let newest = std::fs::read_to_string(checkpoints.join("latest")).ok()?;
        let number: u32 = newest.trim().rsplit('-').next()?.parse().ok()?;
        (number >= updates).then_some(())
    });
}

#[test]
fn heroes_drive_as_if_nothing_had_happened() {
    let (expected, played) = disturb(&DRIVING);
    assert!(expected["achieved"]["episodes"].as_u64().unwrap() >= 8, "{expected:#}");
    assert!(
        !played["trainer"]["trips"].as_object().unwrap().is_empty(),
        "{played:#}"
    );
}

/// `sim-core` sends the poses of so many heroes before it has computed what they see: it may be killed between the two.
#[test]
fn a_crowd_of_heroes_drives_as_if_nothing_had_happened() {
    let crowd = WaitingWorld {
        settings: &[
            "run.envs=1",
            "traffic.heroes=256",
            "traffic.max_road_users=320",
            "trainer.horizon=6000",
            "trainer.batch_size=3000",
            "trainer.network=mlp",
            "trainer.hidden=[16]",
            "observation.fields=driving",
            "episode.training_episodes=3",
        ],
        ..DRIVING
    };
    let workplace = Workplace::new();
    workplace.succeed(&arguments(&crowd, "whole", &[]));
    let expected = outcome(&crowd, &workplace, "whole");
    let steps = expected["env_steps"].as_u64().unwrap();
    assert!(
        steps > 330 * 128,
        "too few heroes were there at once: {steps} steps of 330 ticks"
    );
    let mut run = start(
        &workplace,
        &arguments(&crowd, "killed", &["run.real_time_factor=3"]),
        "killed.log",
    );
    for updates in [1, 3, 5] {
        wait_for_checkpoint(&workplace, "killed", updates, &mut run);
        let victim = until(&mut run, "a process", || {
            processes(&workplace, "killed", "/sim-core").pop()
        });
        kill_process(victim, Signal::KILL).unwrap();
    }
    let status = run.wait().unwrap();
    let said = std::fs::read_to_string(workplace.path().join("killed.log")).unwrap();
    assert!(status.success(), "{status}\n{said}");
    assert_eq!(
        said.matches("the simulation is made again from tick").count(),
        3,
        "{said}"
    );
    assert_eq!(outcome(&crowd, &workplace, "killed"), expected);
    workplace.assert_nothing_left();
}

#[test]
fn stations_speak_as_if_nothing_had_happened() {
    let (expected, played) = disturb(&MESSAGES);
    assert!(expected["achieved"][2].as_u64().unwrap() >= 100, "{expected:#}");
    assert!(
        expected["achieved"][1]["told_s"].as_f64().unwrap() > 0.0,
        "{expected:#}"
    );
    assert!(
        played["v2x"]["speech"]["station_ticks"].as_u64().unwrap() > 0,
        "{played:#}"
    );
    assert!(played["trainer"]["trips"].is_null(), "{played:#}");
}

/// Kills learners and simulators of a run, hands it over, stops and resumes it, and plays what it learnt. Each ends as if nothing had
/// happened. Returns the outcome and the report of the play.
fn disturb(world: &WaitingWorld) -> (Value, Value) {
    let workplace = Workplace::new();
    workplace.succeed(&arguments(world, "whole", &[]));
    let expected = outcome(world, &workplace, "whole");
    assert_eq!(expected["lost"], serde_json::json!([0, 0]));
    assert!(expected["evaluations"].as_array().unwrap().len() >= 2, "{expected:#}");

    // By SIGKILL: each simulator once, the learner alone, and in the end a simulator at the same time as the learner.
    let mut run = start(
        &workplace,
        &arguments(world, "killed", &["run.real_time_factor=6"]),
        "killed.log",
    );
    let [first, second, third] = world.victims;
    let victims: [(u32, &[&str]); 5] = [
        (1, &[first]),
        (2, &["caraware.train"]),
        (3, &[second]),
        (5, &[third]),
        (7, &[world.actor, "caraware.train"]),
    ];
    for (updates, words) in victims {
        wait_for_checkpoint(&workplace, "killed", updates, &mut run);
        for word in words {
            let victim = until(&mut run, "a process", || processes(&workplace, "killed", word).pop());
            kill_process(victim, Signal::KILL).unwrap();
        }
    }
    let status = run.wait().unwrap();
    let said = std::fs::read_to_string(workplace.path().join("killed.log")).unwrap();
    assert!(status.success(), "{status}\n{said}");
    assert!(said.contains("a successor continues"), "{said}");
    let again = said.matches("the simulation is made again from tick").count();
    assert_eq!(again, 4, "{said}");
    assert_eq!(outcome(world, &workplace, "killed"), expected);

    // A planned handover to a successor of the same kind.
    let mut run = start(
        &workplace,
        &arguments(world, "handed", &["run.real_time_factor=6"]),
        "handed.log",
    );
    wait_for_checkpoint(&workplace, "handed", 2, &mut run);
    workplace.succeed(&["handover", "handed"]);
    let status = run.wait().unwrap();
    assert!(
        status.success(),
        "{}",
        std::fs::read_to_string(workplace.path().join("handed.log")).unwrap()
    );
    assert_eq!(outcome(world, &workplace, "handed"), expected);

    // Stopped in its second half, then resumed.
    let mut run = start(
        &workplace,
        &arguments(world, "cut", &["run.real_time_factor=6"]),
        "cut.log",
    );
    wait_for_checkpoint(&workplace, "cut", 4, &mut run);
    kill_process(Pid::from_child(&run), Signal::INT).unwrap();
    assert_eq!(run.wait().unwrap().code(), Some(130));
    let output = workplace.succeed(&["train", "--resume", "cut", "--set", "run.real_time_factor=0"]);
    assert_eq!(workplace.report("cut")["result"], "completed", "{}", text(&output));
    let resumed = outcome(world, &workplace, "cut");
    for key in ["learnt", "env_steps", "lost", "evaluations"] {
        assert_eq!(resumed[key], expected[key], "{key}");
    }
    workplace.assert_nothing_left();

    // What was learnt is played, on other seeds.
    workplace.succeed(&["play", "whole", "--name", "played", "--episodes", "4"]);
    let played = workplace.report("played");
    assert!(played["trainer"][world.mean].is_number(), "{played:#}");

    // The same with simulators that die.
    let paced = ["--episodes", "4", "--set", "run.real_time_factor=4"];
    let mut run = start(
        &workplace,
        &[&["play", "whole", "--name", "replayed"], paced.as_slice()].concat(),
        "replayed.log",
    );
    let live = workplace.path().join("runs/replayed/live.json");
    for (episode, word) in (0..).zip(world.victims) {
        until(&mut run, "an episode", || {
            let live: Value = serde_json::from_str(&std::fs::read_to_string(&live).ok()?).ok()?;
            (live["table"]["episode"].as_u64()? >= episode).then_some(())
        });
        let victim = until(&mut run, "a process", || processes(&workplace, "replayed", word).pop());
        kill_process(victim, Signal::KILL).unwrap();
    }
    let status = run.wait().unwrap();
    let said = std::fs::read_to_string(workplace.path().join("replayed.log")).unwrap();
    assert!(status.success(), "{status}\n{said}");
    assert_eq!(said.matches("the simulation is made again").count(), 3, "{said}");
    let again = workplace.report("replayed");
    assert_eq!(again["observation_hash"], played["observation_hash"]);
    assert_eq!(again["trainer"]["trips"], played["trainer"]["trips"]);
    assert_eq!(again["trainer"]["episodes"], played["trainer"]["episodes"]);
    workplace.assert_nothing_left();
    (expected, played)
}
