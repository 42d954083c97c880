//! Whole runs with an obstacle on the road: contacts reach the report and the run directory, and end trajectories if configured.

use std::collections::BTreeSet;

use crate::common::Workplace;
use serde_json::Value;

/// A run of 4 episodes of two minutes over the crossroads of Main Street and Market Street, where a crate lies.
fn simulate(workplace: &Workplace, name: &str, more: &[&str]) -> Value {
    let small = [
        "simulate",
        "town",
        "--name",
        name,
        "--set",
        "fanout.enabled=false",
        "--set",
        "traffic.cavs=16",
        "--set",
        "traffic.others=8",
        "--set",
        "traffic.pedestrians=4",
        "--set",
        "episode.ticks=1200",
        "--set",
        "episode.training_episodes=4",
        "--set",
        "scene.obstacles=[\"crate 129 126 45\"]",
        "--set",
        "scene.random_props=20",
    ];
    workplace.succeed(&[&small[..], more].concat());
    workplace.report(name)
}

fn lines(workplace: &Workplace, name: &str) -> Vec<Value> {
    let path = workplace.path().join("runs").join(name).join("events/collisions.jsonl");
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn contacts_with_an_obstacle_are_reported_and_end_trajectories_if_configured() {
    let workplace = Workplace::new();
    let report = simulate(&workplace, "watched", &[]);
    let contacts = lines(&workplace, "watched");
    let counts = &report["dynamics"]["collisions"];
    assert_eq!(counts["total"], contacts.len());
    assert_eq!(
        (&report["dynamics"]["buildings"], &report["dynamics"]["props"]),
        (&62.into(), &21.into())
    );
    let crates: Vec<&Value> = contacts.iter().filter(|line| line["other"] == "crate").collect();
    assert!(crates.len() >= 10, "16 vehicles, 8 minutes: {} times", crates.len());
    assert_eq!(
        counts["obstacle"],
        crates.len(),
        "random props are never on the road: {contacts:#?}"
    );
    assert_eq!(counts["building"], 0);
    for line in crates {
        let at = |axis: usize| line["position_m"][axis].as_f64().unwrap();
        // The diagonal of a crate is 1.44 m.
        assert!((at(0) - 129.0).hypot(at(1) - 126.0) < 0.75 && at(2) > 0.0, "{line}");
        assert!(line["vehicle"].as_str().unwrap().starts_with("cav."), "{line}");
        assert!(
            (0.0..14.5).contains(&line["relative_speed_mps"].as_f64().unwrap()),
            "{line}"
        );
    }
    assert!(contacts.is_sorted_by_key(|line| line["tick"].as_u64().unwrap()));

    // Detection changes nothing but the report.
    let blind = simulate(&workplace, "blind", &["--set", "collision.detect=false"]);
    assert_eq!(blind["observation_hash"], report["observation_hash"]);
    assert_eq!(blind["dynamics"]["collisions"], Value::Null);
    assert!(!workplace.path().join("runs/blind/events/collisions.jsonl").exists());

    // Where a trajectory ends, the observation at the tick of the contact is left out. Traffic stays the same.
    let ended = simulate(&workplace, "ended", &["--set", "collision.ends_trajectory=true"]);
    assert_eq!(lines(&workplace, "ended"), contacts);
    let mut left_out = BTreeSet::new();
    for line in &contacts {
        for party in ["vehicle", "other"] {
            let name = line[party].as_str().unwrap();
            if name.starts_with("cav.") {
                left_out.insert((line["tick"].as_u64().unwrap(), name.to_owned()));
            }
        }
    }
    let steps = |report: &Value| report["vehicle_steps"].as_u64().unwrap();
    assert_eq!(steps(&ended), steps(&report) - left_out.len() as u64);
    assert_ne!(ended["observation_hash"], report["observation_hash"]);
    workplace.assert_nothing_left();
}
