//! Generated cities, SUMO's own options and results, and the benchmarks of large runs, each at the smallest meaningful size.

use crate::common::{Workplace, sumo_program, text, tool};
use serde_json::Value;

const QUIET: [&str; 2] = ["--set", "fanout.enabled=false"];
/// The consumer as the trainer, on the unchanged scenario.
const CONSUMED: [&str; 4] = [
    "--set",
    "trainer.module=caraware.consumer",
    "--set",
    "episode.whole_scenario=true",
];

#[test]
fn the_bench_compares_the_result_files_of_bare_sumo_and_of_a_run() {
    let workplace = Workplace::new();
    workplace.succeed(&["bench", "overhead", "--quick", "--json", "overhead.json"]);
    let text = std::fs::read_to_string(workplace.path().join("overhead.json")).unwrap();
    let report: Value = serde_json::from_str(&text).unwrap();
    let figures = &report["figures"];
    assert_eq!(figures["result files compared"], 2.0, "{report:#}");
    for figure in [
        "ratio of wall times",
        "ratio of wall times, same allocator",
        "SUMO's own step, µs per vehicle-step",
    ] {
        assert!(figures[figure].as_f64().unwrap() > 0.0, "{figure}: {report:#}");
    }
    workplace.assert_nothing_left();
}

#[test]
fn every_peer_has_its_ratio_or_the_reason_why_not() {
    let workplace = Workplace::new();
    workplace.succeed(&["bench", "peers", "--quick", "--json", "peers.json"]);
    let text = std::fs::read_to_string(workplace.path().join("peers.json")).unwrap();
    let report: Value = serde_json::from_str(&text).unwrap();
    let ratio = &report["figures"]["ratio to TraCI, Python loop"];
    assert!(ratio.as_f64().unwrap() > 0.0, "{report:#}");
    let rows = report["tables"].as_array().unwrap().iter();
    let rows: Vec<&Value> = rows.flat_map(|table| table["rows"].as_array().unwrap()).collect();
    for peer in ["TraCI", "libsumo", "MetaDrive", "SMARTS"] {
        let of_peer = |row: &&&Value| row[0].as_str().unwrap().starts_with(peer);
        let row = rows
            .iter()
            .find(of_peer)
            .unwrap_or_else(|| panic!("{peer}: {report:#}"));
        let cell = row[1].as_str().unwrap();
        assert!(
            cell.parse::<f64>().is_ok_and(|rate| rate > 0.0) || cell.starts_with("not installed: "),
            "{peer}: {cell}"
        );
    }
    workplace.assert_nothing_left();
}

#[test]
fn cameras_and_radars_have_their_rates() {
    let workplace = Workplace::new();
    for (part, cases) in [("camera", 36), ("radar", 9)] {
        let file = format!("{part}.json");
        workplace.succeed(&["bench", part, "--quick", "--json", &file]);
        let text = std::fs::read_to_string(workplace.path().join(file)).unwrap();
        let report: Value = serde_json::from_str(&text).unwrap();
        let figures = report["figures"].as_object().unwrap();
        assert_eq!(figures.len(), cases, "{report:#}");
        assert!(figures.values().all(|rate| rate.as_f64().unwrap() > 1.0), "{report:#}");
    }
    workplace.assert_nothing_left();
}

#[test]
fn neither_the_window_nor_a_consumer_changes_observations_at_long_steps() {
    let workplace = Workplace::new();
    let city = ["--vehicles", "60", "--duration-s", "12", "--step-s", "1"];
    workplace.succeed(&[&["generate", "city"], &city[..]].concat());
    let run = |mode: &str, name: &str, settings: &[&str]| {
        let arguments = [&[mode, "city/city.sumocfg", "--name", name], settings, &QUIET].concat();
        workplace.succeed(&arguments);
        workplace.report(name)
    };
    let narrow = run("simulate", "narrow", &["--set", "run.window_ticks=1"]);
    let wide = run("simulate", "wide", &["--set", "run.window_ticks=64"]);
    let consumed = run("train", "consumed", &CONSUMED);
    assert_eq!((&narrow["ticks"], &narrow["vehicles"]), (&120.into(), &60.into()));
    assert_eq!(narrow["observation_hash"], wide["observation_hash"]);
    assert_eq!(narrow["observation_hash"], consumed["observation_hash"]);
    assert_eq!(consumed["trainer"]["received_ticks"], 120);
    assert_eq!(consumed["env_steps"], consumed["vehicle_steps"]);
    for process in ["traffic-bridge", "sim-core", "sensor-daemon", "trainer"] {
        assert!(
            consumed["processes"][process]["cpu_s"].as_f64().unwrap() > 0.0,
            "{consumed:#}"
        );
    }
    workplace.assert_nothing_left();
}

/// A grid where the first vehicle departs after two seconds, as SUMO's `grid6` and `corridor` begin: its first ticks are empty.
#[test]
fn training_begins_on_a_scenario_whose_first_ticks_have_no_vehicle() {
    let workplace = Workplace::new();
    tool(
        &sumo_program("netgenerate"),
        &["--grid", "--grid.number", "3", "-o", "a.net.xml"],
        workplace.path(),
    );
    let vehicles: String = (2..20)
        .map(|second| {
            format!("<vehicle id=\"{second}\" depart=\"{second}\"><route edges=\"A0A1 A1A2 A2B2\"/></vehicle>")
        })
        .collect();
    workplace.write("a.rou.xml", &format!("<routes>{vehicles}</routes>"));
    workplace.write(
        "a.sumocfg",
        "<configuration><input><net-file value=\"a.net.xml\"/><route-files value=\"a.rou.xml\"/></input>\
         <time><step-length value=\"0.1\"/></time></configuration>",
    );
    let settings = [
        "episode.training_episodes=2",
        "episode.ticks=120",
        "episode.evaluation_ticks=40",
        "episode.final_evaluations=1",
        "trainer.hidden=[32, 32]",
        "trainer.horizon=200",
        "trainer.batch_size=100",
        "map.origin_latitude_deg=52",
        "map.origin_longitude_deg=10",
        "fanout.enabled=false",
    ];
    let settings = settings.iter().flat_map(|setting| ["--set", *setting]);
    let arguments: Vec<&str> = ["train", "a.sumocfg", "--name", "late"]
        .into_iter()
        .chain(settings)
        .collect();
    workplace.succeed(&arguments);
    let report = workplace.report("late");
    assert_eq!(report["trainer"]["lost_ticks"], 0, "{report:#}");
    assert!(report["trainer"]["updates"].as_u64().unwrap() > 0, "{report:#}");
    workplace.assert_nothing_left();
}

#[test]
fn the_printed_command_runs_the_generated_city() {
    let workplace = Workplace::new();
    let city = [
        "--vehicles",
        "12",
        "--duration-s",
        "2",
        "--block-m",
        "500",
        "--speed-kmh",
        "100",
    ];
    let said = text(&workplace.succeed(&[&["generate", "country"], &city[..]].concat()));
    let command = said.lines().find_map(|line| line.strip_prefix("caraware ")).unwrap();
    let arguments: Vec<&str> = command.split_whitespace().chain(["--name", "said"]).collect();
    workplace.succeed(&arguments);
    // All vehicles of the scenario sense: the preset's number does not count.
    assert_eq!(workplace.report("said")["vehicles"], 12);
    let five = [
        "simulate",
        "country/city.sumocfg",
        "--name",
        "five",
        "--set",
        "traffic.max_cavs=5",
    ];
    workplace.succeed(&[&five[..], &QUIET].concat());
    assert_eq!(workplace.report("five")["vehicles"], 5);
}

/// Vehicles of every kind that roads and rails carry, and a person.
const CLASSES: [&str; 12] = [
    "passenger",
    "taxi",
    "bus",
    "coach",
    "delivery",
    "truck",
    "trailer",
    "emergency",
    "motorcycle",
    "bicycle",
    "tram",
    "rail",
];

/// A grid whose lanes every class may use, one vehicle of each class, and options of SUMO that users set.
fn scenario(workplace: &Workplace) {
    let grid = [
        "--grid",
        "--grid.number",
        "4",
        "--grid.length",
        "300",
        "--sidewalks.guess",
        "--output-file",
        "a.net.xml",
    ];
    tool(&sumo_program("netgenerate"), &grid, workplace.path());
    let mut routes = String::from("<routes>\n");
    for class in CLASSES {
        routes += &format!("<vType id=\"{class}\" vClass=\"{class}\"/>\n");
    }
    for (number, class) in CLASSES.iter().enumerate() {
        let (depart, column) = (100 + number / 3, ["A", "B", "C", "D"][number / 3]);
        let edges = format!("{column}0{column}1 {column}1{column}2 {column}2{column}3");
        routes += &format!(
            "<vehicle id=\"{class}\" type=\"{class}\" depart=\"{depart}\" departPos=\"random_free\"><route edges=\"{edges}\"/></vehicle>\n"
        );
    }
    routes += "<person id=\"walker\" depart=\"104\"><walk edges=\"A0B0 B0C0\"/></person>\n</routes>\n";
    workplace.write("a.rou.xml", &routes);
    workplace.write(
        "a.add.xml",
        "<additional><inductionLoop id=\"d\" lane=\"A1A2_1\" pos=\"10\" period=\"10\" file=\"loops.xml\"/></additional>",
    );
    workplace.write(
        "a.sumocfg",
        "<configuration>
            <input><net-file value=\"a.net.xml\"/><route-files value=\"a.rou.xml\"/><additional-files value=\"a.add.xml\"/></input>
            <output><fcd-output value=\"fcd.xml\"/><tripinfo-output value=\"tripinfo.xml\"/></output>
            <time><begin value=\"100\"/><end value=\"130\"/><step-length value=\"0.5\"/></time>
            <random_number><seed value=\"77\"/></random_number>
        </configuration>",
    );
}

const ORIGIN: [&str; 4] = [
    "--set",
    "map.origin_latitude_deg=52.0",
    "--set",
    "map.origin_longitude_deg=10.0",
];

#[test]
fn a_scenario_keeps_its_own_options_and_all_its_road_users() {
    let workplace = Workplace::new();
    scenario(&workplace);
    workplace.succeed(&[&["simulate", "a.sumocfg", "--name", "ours"], &ORIGIN[..], &QUIET].concat());
    let report = workplace.report("ours");
    assert_eq!(
        (&report["seed"], &report["ticks"]),
        (&77.into(), &300.into()),
        "{report:#}"
    );
    assert_eq!(report["vehicles"], CLASSES.len(), "{report:#}");
    std::fs::create_dir(workplace.path().join("bare")).unwrap();
    for file in ["a.net.xml", "a.rou.xml", "a.add.xml", "a.sumocfg"] {
        std::fs::copy(workplace.path().join(file), workplace.path().join("bare").join(file)).unwrap();
    }
    tool(
        &sumo_program("sumo"),
        &["-c", "bare/a.sumocfg", "--no-step-log"],
        workplace.path(),
    );
    let body = |folder: &str, file: &str| {
        let text = std::fs::read_to_string(workplace.path().join(folder).join(file)).unwrap();
        text.split_once("-->").unwrap().1.to_owned()
    };
    for file in ["fcd.xml", "tripinfo.xml", "loops.xml"] {
        assert_eq!(body("bare", file), body("runs/ours/sumo", file), "{file}");
        assert!(
            !workplace.path().join(file).exists(),
            "{file} was written beside the scenario"
        );
    }
    // Every road user that SUMO recorded at the end of a step was mirrored, including the person.
    let fcd = body("bare", "fcd.xml");
    let seen = fcd.matches("<vehicle ").count() + fcd.matches("<person ").count();
    assert_eq!(report["traffic"]["vehicle_steps"], seen, "{report:#}");
    assert!(fcd.contains("<person "), "no person walked");
    let log = std::fs::read_to_string(workplace.path().join("runs/ours/logs/sim-core.log")).unwrap();
    assert!(!log.contains("no parameter set"), "{log}");
}

#[test]
fn step_demand_and_share_of_connected_vehicles_may_be_set() {
    let workplace = Workplace::new();
    scenario(&workplace);
    let settings = [
        "--set",
        "traffic.step_s=1.0",
        "--set",
        "traffic.cav_share=0.5",
        "--set",
        "traffic.scale=2.0",
    ];
    workplace.succeed(
        &[
            &["simulate", "a.sumocfg", "--name", "other"],
            &settings[..],
            &ORIGIN,
            &QUIET,
        ]
        .concat(),
    );
    let report = workplace.report("other");
    assert_eq!(report["ticks"], 300, "{report:#}");
    let fcd = std::fs::read_to_string(workplace.path().join("runs/other/sumo/fcd.xml")).unwrap();
    assert_eq!(fcd.matches("<timestep ").count(), 30);
    let trucks = fcd.matches("id=\"truck").count() as f64 / fcd.matches("id=\"truck\"").count() as f64;
    assert!(trucks > 1.5, "twice the demand: {trucks}");
    let cavs = report["vehicles"].as_u64().unwrap();
    assert!((4..=20).contains(&cavs), "half of 24 vehicles: {cavs}");
}
