//! Messages between vehicles in whole runs: real traffic, real shared memory.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

mod common;

use common::Workplace;
use serde_json::Value;

/// The report of a short run of the town with these settings.
fn simulate(workplace: &Workplace, name: &str, settings: &[&str]) -> Value {
    let always = [
        "episode.training_episodes=2",
        "episode.ticks=60",
        "traffic.cavs=20",
        "fanout.enabled=false",
    ];
    let mut arguments = vec!["simulate", "--name", name];
    for setting in always.iter().chain(settings) {
        arguments.extend(["--set", setting]);
    }
    workplace.succeed(&arguments);
    workplace.report(name)
}

#[test]
fn vehicles_hear_each_other_and_threads_change_nothing() {
    let workplace = Workplace::new();
    let silent = simulate(&workplace, "silent", &[]);
    assert!(silent["v2x"].is_null(), "{}", silent["v2x"]);
    let with = |name: &str, threads: &str| {
        let settings = ["v2x.share=1.0", "v2x.perception_range_m=50.0", threads];
        simulate(&workplace, name, &settings)
    };
    let one = with("one", "v2x.threads=1");
    let v2x = &one["v2x"];
    for (what, least) in [("cams", 200), ("cpms", 200), ("received", 2000), ("ticks", 120)] {
        assert!(v2x[what].as_u64().unwrap() >= least, "{what}: {v2x}");
    }
    assert!(v2x["mean_channel_load"].as_f64().unwrap() > 0.0);
    // What is observed does not depend on messages, and what is known not on threads.
    assert_eq!(one["observation_hash"], silent["observation_hash"]);
    for (name, threads) in [("two", "v2x.threads=2"), ("four", "v2x.threads=4")] {
        let other = with(name, threads);
        assert_eq!(other["v2x"]["neighbours_hash"], v2x["neighbours_hash"], "{name}");
        assert_eq!(other["observation_hash"], one["observation_hash"], "{name}");
    }
    workplace.assert_nothing_left();
}
