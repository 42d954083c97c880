//! Compares the table of dependencies between crates (ARCHITECTURE.md) with the crates: one direction, heavy dependencies in one crate.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
    process::Command,
};

use serde_json::Value;

/// A row of ARCHITECTURE's table that is a crate.
struct CrateRow {
    name: String,
    directory: String,
    /// The project's own crates it depends on.
    depends_on: BTreeSet<String>,
    /// Heavy dependencies that only the crates which list them may have.
    heavy: BTreeSet<String>,
}

/// Dependencies that only the crates which list them in their last cell may have.
const HEAVY: [&str; 10] = [
    "clap",
    "cxx",
    "iceoryx2",
    "indicatif",
    "mcap",
    "nalgebra",
    "parry3d-f64",
    "pyo3",
    "rapier3d-f64",
    "zenoh",
];

/// The rows of ARCHITECTURE's table whose first cell is a crate; Python packages have rows too, which begin with "Python".
fn rows() -> Vec<CrateRow> {
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../ARCHITECTURE.md")).unwrap();
    let head = "| crate or package | directory | what it is for | depends on | heavy dependencies it alone has |";
    let (_, table) = text.split_once(head).unwrap();
    let lines = table.lines().skip(2).take_while(|line| line.starts_with('|'));
    let cells = lines.map(|line| line.trim_matches('|').split('|').map(str::trim).collect::<Vec<_>>());
    let crates = cells.filter(|cells| cells[0].starts_with('`'));
    let list = |cell: &str| {
        let names = cell.split(',').map(|name| name.trim().trim_matches('`').to_owned());
        names.filter(|name| name != "–").collect()
    };
    crates
        .map(|cells| CrateRow {
            name: cells[0].trim_matches('`').to_owned(),
            directory: cells[1].trim_matches('`').to_owned(),
            depends_on: list(cells[3]),
            heavy: list(cells[4]),
        })
        .collect()
}

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
fn the_architecture_has_a_row_for_every_crate_and_its_directory() {
    let rows = rows();
    let names: BTreeSet<String> = rows.iter().map(|row| row.name.clone()).collect();
    assert_eq!(dependencies().into_keys().collect::<BTreeSet<_>>(), names);
    assert_eq!(rows.len(), names.len(), "a crate has two rows");
    for row in rows {
        let directory = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).join(&row.directory);
        assert!(directory.is_dir(), "{}: no directory {}", row.name, row.directory);
    }
}

#[test]
fn every_crate_depends_on_what_its_cell_says() {
    let dependencies = dependencies();
    for row in rows() {
        let ours = dependencies[&row.name]
            .iter()
            .filter(|dependency| dependencies.contains_key(*dependency));
        assert_eq!(
            ours.cloned().collect::<BTreeSet<_>>(),
            row.depends_on,
            "{}: Cargo.toml beside the cell of ARCHITECTURE.md",
            row.name
        );
    }
}

#[test]
fn a_crate_has_the_heavy_dependencies_of_its_cell_and_no_other() {
    let dependencies = dependencies();
    for row in rows() {
        let heavy = dependencies[&row.name]
            .iter()
            .filter(|dependency| HEAVY.contains(&dependency.as_str()));
        assert_eq!(
            heavy.cloned().collect::<BTreeSet<_>>(),
            row.heavy,
            "{}: Cargo.toml beside the cell of ARCHITECTURE.md",
            row.name
        );
    }
}

/// Every third-party crate with its features that the dependencies of these kinds ask for.
fn features(kinds: &str) -> BTreeSet<String> {
    let output = Command::new(env!("CARGO"))
        .args(["tree", "--workspace", "--locked", "--offline", "--prefix=none"])
        .args(["--no-dedupe", "--format={p} [{f}]", "--edges", kinds])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout)
        .unwrap()
        .lines()
        .map(ToOwned::to_owned)
        .collect()
}

/// `make train` compiles the programs, `make test` the programs and their tests.
#[test]
fn tests_do_not_compile_a_third_party_crate_a_second_time() {
    let [programs, tests] = ["normal,build", "normal,build,dev"].map(features);
    assert!(tests.iter().any(|line| line.starts_with("proptest ")), "{tests:?}");
    let again: Vec<_> = programs.difference(&tests).collect();
    assert!(
        again.is_empty(),
        "the tests ask for other features of these crates, so that they and all that use them are compiled again: {again:?}; name \
         the features in a crate's dependencies, as fanout/Cargo.toml does"
    );
}
