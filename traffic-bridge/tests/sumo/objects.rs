//! SUMO's vehicle objects hold what libsumo's getters return. In this process the objects are read, over TraCI the getters.

use std::{
    collections::BTreeSet,
    hash::{DefaultHasher, Hash as _, Hasher as _},
    net::TcpListener,
    path::Path,
};

use ipc_schema::run::ScenarioOptions;
use traffic_bridge::sumo::{
    Sumo,
    connected::ConnectedRule,
    engine::{Engine, TraciServer},
    frame::TrafficFrame,
    options::SumoOptions,
};

use crate::support::{Bench, run, sumo_home};

const STEP_S: f64 = 0.5;
const STEPS: usize = 160;

/// What a vehicle can do on the grid: stop, park, wait until SUMO teleports it, and change lanes at once with its siblings.
const ROUTES: &str = r#"<routes>
  <vType id="slow" maxSpeed="4" length="12"/>
  <vType id="fast" speedFactor="1.4"/>
  <route id="r" edges="A0B0 B0C0 C0C1 C1D1"/>
  <flow id="s" type="slow" route="r" begin="0" end="60" period="9" departLane="random"/>
  <flow id="f" type="fast" route="r" begin="0" end="60" period="4" departLane="random" departSpeed="max"/>
  <vehicle id="parks" depart="1" route="r"><stop lane="B0C0_1" endPos="50" duration="12" parking="true"/></vehicle>
  <vehicle id="stops" depart="3" route="r"><stop lane="B0C0_1" endPos="60" duration="70"/></vehicle>
  <vehicle id="blocks" depart="4" route="r"><stop lane="B0C0_2" endPos="60" duration="70"/></vehicle>
</routes>"#;

fn options(sumocfg: &Path, output: &Path) -> SumoOptions {
    let rule = ConnectedRule::Scenario {
        heroes: BTreeSet::new(),
        cav_share: 1.0,
        max_cavs: 5000,
    };
    // With another step of its own the scenario gets this one.
    let own = ScenarioOptions {
        step_s: 0.0,
        ..ScenarioOptions::default()
    };
    SumoOptions::scenario(&sumo_home(), sumocfg, &own, output, STEP_S, 23423, rule).unwrap()
}

/// A number for what the frame of each step says, and the number of vehicle-steps.
fn frames(options: SumoOptions) -> (Vec<u64>, usize) {
    let mut sumo = Sumo::start(options).unwrap();
    sumo.read_lanes().unwrap();
    sumo.read_positions();
    let (mut seen, mut vehicle_steps) = (Vec::new(), 0);
    run(&mut sumo, STEPS, |_, frame: &TrafficFrame| {
        let mut hasher = DefaultHasher::new();
        format!("{:?}", (&frame.states, &frame.places, &frame.positions, &frame.events)).hash(&mut hasher);
        seen.push(hasher.finish());
        vehicle_steps += frame.states.len();
    });
    sumo.close().unwrap();
    (seen, vehicle_steps)
}

fn over_traci(log: &Path) -> Engine {
    let listener = TcpListener::bind(("localhost", 0)).unwrap();
    Engine::Traci(TraciServer {
        program: sumo_home().join("bin/sumo"),
        port: listener.local_addr().unwrap().port(),
        clients: 1,
        log: log.into(),
    })
}

fn compare(bench: &Bench, name: &str, sumocfg: &Path) {
    let place = bench.folder.path().join(name);
    let (here, vehicle_steps) = frames(options(sumocfg, &place.join("here")));
    let there = options(sumocfg, &place.join("there")).with_engine(over_traci(&place.join("log")));
    let (there, _) = frames(there);
    assert!(vehicle_steps > 500, "{name}: {vehicle_steps} vehicle-steps");
    let first = here.iter().zip(&there).position(|(here, there)| here != there);
    assert_eq!(first, None, "{name}: the first step that differs");
}

#[test]
fn objects_and_getters_agree_on_scenarios_of_others() {
    let bench = Bench::new();
    let games = sumo_home().join("tools/game");
    // A motorway, a signalled square, and trains.
    for game in ["A10KW", "square", "rail"] {
        compare(&bench, game, &games.join(game).with_extension("sumocfg"));
    }
    // A town with slopes: its configuration is for SUMO's window, whose options `sumo` does not know.
    let [net, routes] = ["bs.net.xml", "bs3d.rou.xml"].map(|file| games.join("bs3d").join(file));
    let [net, routes] = [net.display(), routes.display()];
    let input = format!("<net-file value=\"{net}\"/><route-files value=\"{routes}\"/>");
    let sumocfg = bench.file(
        "slopes.sumocfg",
        &format!("<configuration><input>{input}</input></configuration>"),
    );
    compare(&bench, "slopes", &sumocfg);
}

#[test]
fn objects_and_getters_agree_on_vehicles_that_park_teleport_and_change_lanes() {
    let bench = Bench::new();
    bench.scenario(ROUTES);
    for (name, option) in [
        ("lanes", ""),
        ("sublanes", "<lateral-resolution value=\"0.4\"/>"),
        ("mesoscopic", "<mesosim value=\"true\"/>"),
        ("kept", "<keep-after-arrival value=\"20\"/>"),
    ] {
        let input = "<net-file value=\"grid.net.xml\"/><route-files value=\"a.rou.xml\"/>";
        let configuration = format!(
            "<configuration><input>{input}</input><processing><time-to-teleport value=\"15\"/>{option}</processing></configuration>"
        );
        let sumocfg = bench.file(&format!("{name}.sumocfg"), &configuration);
        compare(&bench, name, &sumocfg);
    }
}
