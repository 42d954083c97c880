//! Every scenario in SUMO's wheel: it runs with SUMO's own results and the same hash twice, `simulate` and `train`, or it is refused as
//! bare SUMO refuses it.
//!
//! `CARAWARE_WHEEL=all cargo test --release --locked --test system wheel::` trains on every scenario; without it on two of them.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::Command,
};

use crate::common::{BARE_NET_SETTINGS, Workplace, sumo_program, text};
use caraware::{install::Install, scenario};
use ipc_schema::run::VEHICLE_IDS;
use serde_json::Value;

/// What a scenario does.
enum Outcome {
    /// It runs to this time of SUMO.
    Runs(&'static str),
    /// Bare SUMO and caraware refuse it; the reason has these words.
    Refused(&'static str),
}

use Outcome::{Refused, Runs};

/// Every configuration in the wheel, with a time at which road users have departed.
const SCENARIOS: [(&str, Outcome); 23] = [
    ("tools/game/A10KW.sumocfg", Runs("12")),
    ("tools/game/DRT.sumocfg", Runs("8")),
    ("tools/game/DRT2.sumocfg", Runs("8")),
    ("tools/game/DRT_demo.sumocfg", Runs("8")),
    ("tools/game/bs3Dosm.sumocfg", Refused("osg-view")),
    ("tools/game/bs3d.sumocfg", Refused("osg-view")),
    ("tools/game/corridor.sumocfg", Runs("20")),
    ("tools/game/cross.sumocfg", Runs("8")),
    ("tools/game/cross_demo.sumocfg", Runs("0:0:8")),
    ("tools/game/fkk_in.sumocfg", Runs("8")),
    ("tools/game/fokr_bs_demo.sumocfg", Runs("15:0:8")),
    ("tools/game/grid6.sumocfg", Runs("8")),
    ("tools/game/hiking/hiking.sumocfg", Runs("20")),
    ("tools/game/racing/racing.sumocfg", Runs("8")),
    ("tools/game/rail.sumocfg", Runs("8")),
    ("tools/game/rail/test.sumocfg", Runs("8")),
    ("tools/game/rail_demo.sumocfg", Runs("8")),
    ("tools/game/ramp.sumocfg", Runs("8")),
    ("tools/game/square.sumocfg", Runs("8")),
    (RILSA[0], Refused("flows.rou.xml")),
    (RILSA[1], Refused("flows.rou.xml")),
    (RILSA[2], Refused("flows.rou.xml")),
    (RILSA[3], Refused("flows.rou.xml")),
];

const RILSA: [&str; 4] = [
    "tools/sumolib/scenario/scenarios/RealWorld/RiLSA_example1/run.sumo.cfg",
    "tools/sumolib/scenario/scenarios/RealWorld/RiLSA_example2/run.sumo.cfg",
    "tools/sumolib/scenario/scenarios/RealWorld/RiLSA_example3/run.sumo.cfg",
    "tools/sumolib/scenario/scenarios/RealWorld/RiLSA_example4/run.sumo.cfg",
];

/// Scenarios that the short test trains on, and simulates twice: one of clock times and a step of 0.05 s, one of several output files.
const TRAINED: [&str; 2] = ["tools/game/fokr_bs_demo.sumocfg", "tools/game/square.sumocfg"];

fn sumo_home() -> PathBuf {
    Install::find().unwrap().sumo_home
}

/// True for configurations of Python's packaging and of netconvert, which also end in `.cfg`.
fn is_of_another_tool(path: &Path) -> bool {
    path.ends_with("setup.cfg") || path.to_string_lossy().ends_with(".netc.cfg")
}

/// Configurations of SUMO below a directory.
fn configurations(directory: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(directory).unwrap().flatten() {
        let path = entry.path();
        if entry.file_type().unwrap().is_dir() {
            configurations(&path, found);
        } else if scenario::is_scenario(&path) && !is_of_another_tool(&path) {
            found.push(path);
        }
    }
}

/// Runs bare SUMO to `end`, with its outputs in `directory`.
fn run_bare(sumocfg: &Path, end: &str, directory: &Path, more: &[&str]) -> (bool, String) {
    std::fs::create_dir_all(directory).unwrap();
    let prefix = format!(
        "{}{}/",
        "../".repeat(64),
        directory.display().to_string().trim_start_matches('/')
    );
    let output = Command::new(sumo_program("sumo"))
        .arg("-c")
        .arg(sumocfg)
        .args(["--no-step-log", "--end", end, "--output-prefix", &prefix])
        .args(more)
        .output()
        .unwrap();
    (output.status.success(), text(&output))
}

/// Outputs by file name, without the comment that names time and command line.
fn outputs(directory: &Path) -> BTreeMap<String, String> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let text = String::from_utf8_lossy(&std::fs::read(entry.path()).unwrap()).into_owned();
        if name.ends_with(".xml") {
            let body = text.split_once("-->").map_or(text.clone(), |(_, body)| body.to_owned());
            found.insert(name, body);
        }
    }
    found
}

fn hash(report: &Value) -> &str {
    report["observation_hash"].as_str().unwrap()
}

/// Simulates the scenario, and compares everything that bare SUMO has made too. Returns the hash.
fn simulate(workplace: &Workplace, sumocfg: &Path, end: &str, name: &str) -> String {
    let sumocfg = sumocfg.to_str().unwrap();
    workplace.succeed(
        &[
            &["simulate", sumocfg, "--end", end, "--name", name],
            &BARE_NET_SETTINGS[..],
        ]
        .concat(),
    );
    let report = workplace.report(name);
    let bare = outputs(&workplace.path().join("bare"));
    let fcd = &outputs(&workplace.path().join("fcd"))["bare-fcd.xml"];
    let ours = outputs(&workplace.path().join("runs").join(name).join("sumo"));
    assert_eq!(
        ours.keys().collect::<Vec<_>>(),
        bare.keys().collect::<Vec<_>>(),
        "{sumocfg}: other files"
    );
    for (file, body) in &bare {
        assert_eq!(ours.get(file), Some(body), "{sumocfg}: {file} differs from bare SUMO's");
    }
    // Every vehicle and every person on foot that SUMO recorded was mirrored.
    let riding = fcd.matches(" vehicle=\"").count() - fcd.matches(" vehicle=\"\"").count();
    let seen = fcd.matches("<vehicle ").count() + fcd.matches("<person ").count() - riding;
    assert_eq!(report["traffic"]["vehicle_steps"], seen, "{sumocfg}: {report:#}");
    hash(&report).to_owned()
}

/// Trains a little.
fn train(workplace: &Workplace, sumocfg: &Path, end: &str) {
    let small = [
        "episode.training_episodes=1",
        "episode.ticks=40",
        "episode.evaluation_ticks=20",
        "episode.final_evaluations=1",
        "trainer.horizon=20",
        "trainer.batch_size=10",
        "trainer.hidden=[8]",
        "trainer.supervised=false",
    ];
    let small = small.iter().flat_map(|setting| ["--set", *setting]);
    let arguments: Vec<&str> = ["train", sumocfg.to_str().unwrap(), "--end", end, "--name", "trained"]
        .into_iter()
        .chain(small)
        .chain(BARE_NET_SETTINGS)
        .collect();
    workplace.succeed(&arguments);
    let report = workplace.report("trained");
    assert_eq!(
        (&report["result"], &report["lost_ticks"]),
        (&"completed".into(), &0.into()),
        "{report:#}"
    );
}

#[test]
fn every_scenario_of_the_wheel_runs_or_is_refused_as_bare_sumo_does_it() {
    let home = sumo_home();
    let mut found = Vec::new();
    configurations(&home, &mut found);
    let mut listed: Vec<PathBuf> = SCENARIOS.iter().map(|(name, _)| home.join(name)).collect();
    found.sort();
    listed.sort();
    assert_eq!(found, listed, "the table has every scenario of the wheel");
    let is_whole = std::env::var_os("CARAWARE_WHEEL").is_some();
    for (name, outcome) in &SCENARIOS {
        let workplace = Workplace::new();
        let sumocfg = home.join(name);
        match outcome {
            Refused(reason) => {
                let (succeeded, said) = run_bare(&sumocfg, "1", &workplace.path().join("bare"), &[]);
                assert!(!succeeded && said.contains(reason), "{name}: {said}");
                let output =
                    workplace.run(&[&["simulate", sumocfg.to_str().unwrap()], &BARE_NET_SETTINGS[..]].concat());
                let said = text(&output);
                assert_eq!(output.status.code(), Some(2), "{name}: {said}");
                assert!(said.contains(reason), "{name}: {said}");
            }
            Runs(end) => {
                // A record of all road users gives vehicles a device, which other outputs name: it comes from a run of its own.
                let recorded = [
                    "--fcd-output",
                    "/bare-fcd.xml",
                    "--fcd-output.attributes",
                    "x,y,vehicle",
                ];
                for (folder, more) in [("bare", &[][..]), ("fcd", &recorded[..])] {
                    let (succeeded, said) = run_bare(&sumocfg, end, &workplace.path().join(folder), more);
                    assert!(succeeded, "{name}: {said}");
                }
                let first = simulate(&workplace, &sumocfg, end, "first");
                if is_whole || TRAINED.contains(name) {
                    assert_eq!(
                        first,
                        simulate(&workplace, &sumocfg, end, "second"),
                        "{name}: another hash"
                    );
                    train(&workplace, &sumocfg, end);
                }
                let ids = std::fs::read_to_string(workplace.path().join("runs/first").join(VEHICLE_IDS)).unwrap();
                assert!(
                    ids.lines().all(|line| serde_json::from_str::<String>(line).is_ok()),
                    "{name}: {ids}"
                );
            }
        }
        workplace.assert_nothing_left();
    }
}
