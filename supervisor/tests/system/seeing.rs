//! A learner that sees, in whole runs: real traffic, real images, learners and sensors that are killed.

use std::process::{Child, Stdio};

use crate::common::{Workplace, until};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};

/// Six vehicles with images of 24 × 24, and an update every 240 samples.
const SMALL: [&str; 19] = [
    "traffic.cavs=6",
    "traffic.others=2",
    "episode.ticks=110",
    "episode.training_episodes=6",
    "episode.evaluation_interval=3",
    "episode.evaluation_ticks=40",
    "episode.final_evaluations=1",
    "camera.vehicles=6",
    "camera.width=24",
    "camera.height=24",
    "trainer.frames=3",
    "trainer.hidden=[16]",
    "trainer.horizon=480",
    "trainer.plots=false",
    "trainer.batch_size=240",
    "trainer.checkpoint_interval=2",
    "trainer.matmul_precision=float32",
    "trainer.epochs=1",
    "fanout.enabled=false",
];

fn arguments<'a>(name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let settings = SMALL.iter().chain(more).flat_map(|setting| ["--set", setting]);
    ["train", "camera", "--name", name]
        .into_iter()
        .chain(settings)
        .collect()
}

/// Observations, samples, evaluations, and the hash of the final parameters, of the regression and of the newest images.
fn outcome(workplace: &Workplace, name: &str) -> Value {
    let report = workplace.report(name);
    assert_eq!(report["result"], "completed", "{name}");
    let checkpoints = workplace.path().join("runs").join(name).join("checkpoints");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let mut hasher = blake3::Hasher::new();
    for file in ["parameters", "optimiser", "memory", "supervised"] {
        let file = checkpoints.join(newest.trim()).join(format!("{file}.safetensors"));
        hasher.update(&std::fs::read(file).unwrap());
    }
    json!({
        "learnt": format!("{} {}", newest.trim(), hasher.finalize().to_hex()),
        "hash": report["observation_hash"],
        "images": report["camera"],
        "env_steps": report["env_steps"],
        "lost": [report["lost_ticks"], report["duplicated_ticks"]],
        "evaluations": report["trainer"]["evaluations"],
    })
}

fn pid_of(workplace: &Workplace, name: &str, word: &str) -> Option<Pid> {
    let here = workplace.path().join("runs").join(name).to_string_lossy().into_owned();
    std::fs::read_dir("/proc").unwrap().flatten().find_map(|entry| {
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).into_owned();
        let pid: i32 = entry.file_name().to_str()?.parse().ok()?;
        (line.contains(word) && line.contains(&format!("{here}/")))
            .then(|| Pid::from_raw(pid))
            .flatten()
    })
}

fn kill_after(workplace: &Workplace, name: &str, updates: u32, word: &str, run: &mut Child) {
    let checkpoints = workplace.path().join("runs").join(name).join("checkpoints");
    until(run, "a checkpoint", || {
        let newest = std::fs::read_to_string(checkpoints.join("latest")).ok()?;
        let number: u32 = newest.trim().rsplit('-').next()?.parse().ok()?;
        (number >= updates).then_some(())
    });
    let victim = until(run, word, || pid_of(workplace, name, word));
    kill_process(victim, Signal::KILL).unwrap();
}

#[test]
fn a_killed_learner_that_sees_and_killed_cameras_change_nothing_that_is_seen_or_learnt() {
    let workplace = Workplace::new();
    workplace.succeed(&arguments("whole", &[]));
    let expected = outcome(&workplace, "whole");
    assert_eq!(expected["lost"], json!([0, 0]));
    let evaluations = expected["evaluations"].as_array().unwrap();
    assert_eq!(evaluations.len(), 2, "{expected:#}");
    for key in [
        "ppo_mean_lateral_error_m",
        "supervised_mean_lateral_error_m",
        "raw_gnss_mean_lateral_error_m",
        "ppo_mean_wrong_lane_percent",
        "raw_gnss_mean_wrong_lane_percent",
    ] {
        assert!(
            evaluations[1][key].as_f64().is_some_and(f64::is_finite),
            "{key}: {expected:#}"
        );
    }

    let command = workplace
        .command(&arguments("killed", &["run.real_time_factor=8"]))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    let mut run = command.unwrap();
    kill_after(&workplace, "killed", 2, "caraware.train", &mut run);
    kill_after(&workplace, "killed", 4, "/sensor-daemon", &mut run);
    kill_after(&workplace, "killed", 6, "caraware.train", &mut run);
    assert!(run.wait().unwrap().success());
    assert_eq!(outcome(&workplace, "killed"), expected);
    workplace.assert_nothing_left();
}

#[test]
fn images_stand_under_the_hash_of_the_observations_only_if_asked_for() {
    let workplace = Workplace::new();
    let hash = |name: &str, more: &[&str]| {
        let always = [
            "traffic.cavs=4",
            "episode.training_episodes=1",
            "episode.ticks=40",
            "camera.vehicles=2",
        ];
        let settings = always.iter().chain(&["fanout.enabled=false"]).chain(more);
        let settings: Vec<&str> = settings.flat_map(|setting| ["--set", setting]).collect();
        workplace.succeed(&[&["simulate", "--name", name], &settings[..]].concat());
        workplace.report(name)["observation_hash"].clone()
    };
    let without = hash("without", &[]);
    assert_eq!(hash("range", &["camera.range_m=20"]), without);
    let [semantic, near] = [("semantic", "150"), ("near", "20")]
        .map(|(name, range)| hash(name, &["camera.observed=semantic", &format!("camera.range_m={range}")]));
    assert!(semantic != without && near != semantic && near != without);
    workplace.assert_nothing_left();
}
