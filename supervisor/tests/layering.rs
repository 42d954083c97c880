//! The table of dependencies between crates (ARCHITECTURE.md): one direction, heavy dependencies each in one process only.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

use std::{collections::BTreeMap, process::Command};

use serde_json::Value;

/// Crate, the project's own crates it may depend on, heavy dependencies that only the crates which list them may have.
const TABLE: [(&str, &[&str], &[&str]); 8] = [
    ("ipc-schema", &[], &["iceoryx2"]),
    ("caraware", &["ipc-schema"], &["clap", "indicatif"]),
    ("traffic-bridge", &["ipc-schema"], &["cxx"]),
    ("sim-core", &["ipc-schema"], &["rapier3d-f64", "nalgebra"]),
    ("sensor-daemon", &["ipc-schema", "sim-core"], &["parry3d-f64"]),
    ("fanout", &["ipc-schema"], &["zenoh"]),
    ("caraware-native", &["ipc-schema"], &["pyo3"]),
    ("caraware-bench", &["caraware", "ipc-schema"], &["clap"]),
];

/// Crate name → names of its normal dependencies.
fn dependencies() -> BTreeMap<String, Vec<String>> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version=1", "--no-deps", "--locked", "--offline"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
    let name = |value: &Value| value["name"].as_str().unwrap().to_owned();
    let normal = |package: &Value| {
        let all = package["dependencies"].as_array().unwrap().iter();
        all.filter(|dependency| dependency["kind"].is_null())
            .map(name)
            .collect()
    };
    metadata["packages"]
        .as_array()
        .unwrap()
        .iter()
        .map(|package| (name(package), normal(package)))
        .collect()
}

#[test]
fn every_crate_is_in_the_table_and_the_other_way_round() {
    let mut expected: Vec<_> = TABLE.iter().map(|(name, ..)| (*name).to_owned()).collect();
    expected.sort();
    assert_eq!(dependencies().into_keys().collect::<Vec<_>>(), expected);
}

#[test]
fn crates_depend_in_one_direction_only() {
    let dependencies = dependencies();
    for (name, allowed, _) in TABLE {
        let ours = dependencies[name]
            .iter()
            .filter(|dependency| dependencies.contains_key(*dependency));
        for dependency in ours {
            assert!(
                allowed.contains(&dependency.as_str()),
                "{name} must not depend on {dependency}"
            );
        }
    }
}

#[test]
fn heavy_dependencies_stay_in_their_process() {
    let dependencies = dependencies();
    let all_heavy = TABLE.iter().flat_map(|(_, _, heavy)| heavy.iter());
    for dependency in all_heavy {
        let owners = TABLE.iter().filter(|(_, _, heavy)| heavy.contains(dependency));
        let owners: Vec<&str> = owners.map(|(owner, ..)| *owner).collect();
        for (name, theirs) in &dependencies {
            assert!(
                owners.contains(&name.as_str()) || !theirs.iter().any(|their| their == dependency),
                "{name} must not depend on {dependency}: only {owners:?} may"
            );
        }
    }
}

#[test]
fn the_architecture_shows_this_table() {
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../ARCHITECTURE.md")).unwrap();
    for (name, ..) in TABLE {
        assert!(
            text.contains(&format!("`{name}`")),
            "ARCHITECTURE.md does not mention `{name}`"
        );
    }
}
