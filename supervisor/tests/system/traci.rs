//! SUMO in a process of its own: the same bytes as in `traffic-bridge`, and a TraCI script beside the run that changes them.

use std::{
    net::TcpListener,
    process::{Child, Command, Output, Stdio},
};

use crate::common::{Workplace, sumo_program, text, tool};
use caraware::install::Install;
use serde_json::Value;

/// Keeps every light in its first phase, as the loop of SUMO's tutorial on signals does until a vehicle comes.
const SCRIPT: &str = "
import sys
import traci

traci.init(int(sys.argv[1]), numRetries=60)
traci.setOrder(2)
steps = 0
try:
    while traci.simulation.getMinExpectedNumber() > 0:
        for light in traci.trafficlight.getIDList():
            traci.trafficlight.setPhase(light, 0)
        traci.simulationStep()
        steps += 1
    traci.close()
except traci.exceptions.FatalTraCIError:
    pass
print(steps)
";

/// A grid with signals, and cars that cross it.
fn scenario(workplace: &Workplace) {
    let grid = [
        "--grid",
        "--grid.number",
        "3",
        "--grid.length",
        "100",
        "-j",
        "traffic_light",
        "-o",
        "a.net.xml",
    ];
    tool(&sumo_program("netgenerate"), &grid, workplace.path());
    workplace.write(
        "a.rou.xml",
        "<routes><flow id=\"f\" begin=\"0\" end=\"20\" number=\"6\" from=\"A0A1\" to=\"B2C2\"/>\
         <flow id=\"g\" begin=\"0\" end=\"20\" number=\"6\" from=\"C0B0\" to=\"A1A2\"/></routes>",
    );
    workplace.write(
        "a.sumocfg",
        "<configuration><net-file value=\"a.net.xml\"/><route-files value=\"a.rou.xml\"/><tripinfo-output value=\"trips.xml\"/>\
         <step-length value=\"0.5\"/><end value=\"60\"/></configuration>",
    );
}

/// Simulates with `more` settings. Returns the report and SUMO's record of trips.
fn simulate(workplace: &Workplace, name: &str, more: &[String], script: Option<Child>) -> (Value, String) {
    let settings = [
        "map.origin_latitude_deg=52",
        "map.origin_longitude_deg=10",
        "fanout.enabled=false",
    ];
    let settings = settings.into_iter().chain(more.iter().map(String::as_str));
    let settings = settings.flat_map(|setting| ["--set", setting]);
    let arguments: Vec<&str> = ["simulate", "a.sumocfg", "--name", name]
        .into_iter()
        .chain(settings)
        .collect();
    workplace.succeed(&arguments);
    if let Some(script) = script {
        let output = script.wait_with_output().unwrap();
        let steps = String::from_utf8_lossy(&output.stdout);
        let steps: u32 = steps.lines().last().and_then(|line| line.parse().ok()).unwrap_or(0);
        assert!(steps > 20, "{}", text(&output));
    }
    let trips = workplace.path().join("runs").join(name).join("sumo/trips.xml");
    let trips = std::fs::read_to_string(trips).unwrap();
    (workplace.report(name), trips.split_once("-->").unwrap().1.to_owned())
}

/// Starts SUMO by itself, as a user does, listening for so many clients.
fn start_sumo(workplace: &Workplace, port: u16, clients: &str) -> Child {
    Command::new(sumo_program("sumo"))
        .args(["-c", "a.sumocfg", "--no-step-log", "--num-clients", clients])
        .args(["--remote-port", &port.to_string()])
        .current_dir(workplace.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Waits until SUMO has ended, and returns its record of trips.
fn finish_sumo(workplace: &Workplace, sumo: Child) -> String {
    let output = sumo.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let trips = std::fs::read_to_string(workplace.path().join("trips.xml")).unwrap();
    trips.split_once("-->").unwrap().1.to_owned()
}

/// What a command printed, without the line breaks and bars of a report.
fn said(output: &Output) -> String {
    let text = text(output).replace('\u{2502}', " ");
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn free_port() -> u16 {
    TcpListener::bind(("127.0.0.1", 0))
        .unwrap()
        .local_addr()
        .unwrap()
        .port()
}

/// The arguments of a run that attaches to the SUMO on `port`.
fn attached(port: u16, order: u32) -> Vec<String> {
    vec![
        "traffic.engine=traci".to_owned(),
        "traffic.traci_host=localhost".to_owned(),
        format!("traffic.traci_port={port}"),
        format!("traffic.traci_order={order}"),
    ]
}

/// Starts the user's script, a client of the SUMO at `port`.
fn start_script(workplace: &Workplace, port: u16) -> Child {
    let install = Install::find().unwrap();
    Command::new(&install.python)
        .arg(workplace.write("script.py", SCRIPT))
        .arg(port.to_string())
        .env("PYTHONPATH", install.sumo_home.join("tools"))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

#[test]
fn a_run_attaches_to_a_sumo_that_runs_already() {
    let workplace = Workplace::new();
    scenario(&workplace);
    let simulate_at = |name: &str, settings: &[String]| {
        let settings = settings.iter().flat_map(|setting| ["--set", setting]);
        let arguments: Vec<&str> = ["simulate", "a.sumocfg", "--name", name]
            .into_iter()
            .chain(crate::common::BARE_NET_SETTINGS)
            .chain(settings)
            .collect();
        workplace.run(&arguments)
    };
    let (inside, trips) = simulate(&workplace, "inside", &[], None);

    // Alone with it, the run has the bytes of libsumo.
    let port = free_port();
    let sumo = start_sumo(&workplace, port, "1");
    let output = simulate_at("alone", &attached(port, 1));
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(finish_sumo(&workplace, sumo), trips);
    let alone = workplace.report("alone");
    assert_eq!(alone["observation_hash"], inside["observation_hash"]);
    assert!(
        !workplace.path().join("runs/alone/sumo/trips.xml").exists(),
        "SUMO's outputs are the user's"
    );

    // A script is another client of the same SUMO.
    let port = free_port();
    let sumo = start_sumo(&workplace, port, "2");
    let script = start_script(&workplace, port);
    let output = simulate_at("both", &attached(port, 1));
    assert!(output.status.success(), "{}", text(&output));
    let steps = script.wait_with_output().unwrap();
    assert!(steps.status.success(), "{}", text(&steps));
    assert_ne!(finish_sumo(&workplace, sumo), trips, "the script changed nothing");
    let both = workplace.report("both");
    assert_ne!(both["observation_hash"], inside["observation_hash"]);

    // Another simulation than that of the run's .sumocfg is refused.
    let port = free_port();
    let sumo = start_sumo(&workplace, port, "1");
    let settings = [attached(port, 1), vec!["traffic.step_s=0.1".to_owned()]].concat();
    let output = simulate_at("other", &settings);
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
    assert!(
        said(&output).contains("its step is 0.5 s, and that of the run 0.1 s"),
        "{}",
        text(&output)
    );
    sumo.wait_with_output().unwrap();

    // What cannot be is refused before anything is started.
    for (setting, reason) in [
        ("traffic.engine=libsumo", "needs `traffic.engine`"),
        ("traffic.end_s=10", "is an option of SUMO"),
        ("run.envs=2", "is one environment"),
    ] {
        let settings = [attached(port, 1), vec![setting.to_owned()]].concat();
        let output = simulate_at("refused", &settings);
        assert_eq!(output.status.code(), Some(2), "{setting}: {}", text(&output));
        assert!(said(&output).contains(reason), "{setting}: {}", text(&output));
    }
    let output = simulate_at("nowhere", &attached(free_port(), 1));
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
    assert!(
        said(&output).contains("cannot attach to SUMO at localhost:"),
        "{}",
        text(&output)
    );
    workplace.assert_nothing_left();
}

#[test]
fn a_traci_script_runs_beside_a_run_and_changes_it() {
    let workplace = Workplace::new();
    scenario(&workplace);
    let port = free_port();
    let engine = |clients: u32| {
        let settings = [
            "traffic.engine=traci".to_owned(),
            format!("traffic.traci_port={port}"),
            format!("traffic.traci_clients={clients}"),
        ];
        settings.to_vec()
    };
    let (inside, trips) = simulate(&workplace, "inside", &[], None);
    let (alone, trips_alone) = simulate(&workplace, "alone", &engine(1), None);
    assert_eq!(alone["observation_hash"], inside["observation_hash"]);
    assert_eq!(trips_alone, trips);

    let script = start_script(&workplace, port);
    let (both, trips_both) = simulate(&workplace, "both", &engine(2), Some(script));
    assert_eq!(both["ticks"], inside["ticks"]);
    assert_ne!(both["observation_hash"], inside["observation_hash"]);
    assert_ne!(trips_both, trips, "the script changed nothing");

    // SUMO refuses its input with its own words, as inside.
    workplace.write(
        "a.rou.xml",
        "<routes><vehicle id=\"v\" depart=\"0\"><route edges=\"A0A1 nope\"/></vehicle></routes>",
    );
    let settings = engine(1);
    let mut arguments = vec![
        "simulate",
        "a.sumocfg",
        "--set",
        "map.origin_latitude_deg=52",
        "--set",
        "map.origin_longitude_deg=10",
    ];
    for setting in &settings {
        arguments.extend(["--set", setting]);
    }
    let output = workplace.run(&arguments);
    assert!(
        output.status.code() == Some(2) && text(&output).contains("nope"),
        "{}",
        text(&output)
    );
    workplace.assert_nothing_left();
}
