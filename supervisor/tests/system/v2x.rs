//! Messages between vehicles in whole runs: real traffic, real shared memory.

use crate::common::Workplace;
use serde_json::Value;

/// What is around a packet on air: head of the frame, LLC and SNAP, checksum.
const AROUND_PACKET_BYTES: u64 = 38;

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
    let unit = "v2x.roadside=[{ id = \"middle\", x_m = 130.0, y_m = 126.0, height_m = 6.0, range_m = 80.0, services = [\"cam\", \"map\"] }]";
    let with = |name: &str, threads: &str| {
        let settings = [
            "v2x.share=1.0",
            "v2x.perception_range_m=50.0",
            "v2x.pcap=true",
            unit,
            threads,
        ];
        simulate(&workplace, name, &settings)
    };
    let capture = |name: &str, episode: u32| {
        let file = format!("runs/{name}/messages/episode-{episode}.pcap");
        std::fs::read(workplace.path().join(file)).unwrap()
    };
    let one = with("one", "v2x.threads=1");
    let v2x = &one["v2x"];
    let least_counts = [
        ("cams", 200),
        ("cpms", 200),
        ("received", 2000),
        ("ticks", 120),
        ("roadside_sent", 20),
        ("roadside_received", 20),
    ];
    for (what, least) in least_counts {
        assert!(v2x[what].as_u64().unwrap() >= least, "{what}: {v2x}");
    }
    assert!(v2x["mean_channel_load"].as_f64().unwrap() > 0.0);
    // What is observed does not depend on messages, and what is known not on threads.
    assert_eq!(one["observation_hash"], silent["observation_hash"]);
    for (name, threads) in [("two", "v2x.threads=2"), ("four", "v2x.threads=4")] {
        let other = with(name, threads);
        assert_eq!(other["v2x"]["neighbours_hash"], v2x["neighbours_hash"], "{name}");
        assert_eq!(other["observation_hash"], one["observation_hash"], "{name}");
        for episode in [0, 1] {
            assert_eq!(capture(name, episode), capture("one", episode), "{name}");
        }
    }
    // Every message on air is in the files: 16 bytes of head and 14 of frame around each, and 24 before the first. Their bytes are those
    // that the report counts, less what surrounds a packet on air.
    let captured: Vec<usize> = [0, 1].map(|episode| capture("one", episode).len() - 24).into();
    let messages: u64 = ["cams", "cpms"].iter().map(|what| v2x[*what].as_u64().unwrap()).sum();
    let bytes = v2x["bytes"].as_u64().unwrap() - messages * AROUND_PACKET_BYTES;
    assert_eq!(captured.iter().sum::<usize>() as u64, bytes + messages * (16 + 14));
    workplace.assert_nothing_left();
}

#[test]
fn a_roadside_unit_beside_the_map_is_refused_with_the_map() {
    let workplace = Workplace::new();
    let unit = "v2x.roadside=[{ id = \"far\", x_m = 9130.0, y_m = 126.0, height_m = 6.0 }]";
    let output = workplace.run(&["simulate", "--set", "v2x.share=1.0", "--set", unit]);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{error}");
    for part in [
        "\"far\" at 9130 m, 126 m stands beside the map",
        "choose `v2x.roadside.x_m` from",
    ] {
        assert!(error.contains(part), "{error}");
    }
}
