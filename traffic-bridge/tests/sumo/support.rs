//! Shared parts of the tests with real SUMO: nets built by the wheel's own tools, and one simulation at a time.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::Command,
    sync::{Mutex, MutexGuard, PoisonError},
};

use ipc_schema::{
    ego::EgoPose,
    run::{ScenarioOptions, Source},
    traffic::TrafficState,
};
use tempfile::TempDir;
use traffic_bridge::sumo::{
    Sumo,
    connected::ConnectedRule,
    frame::TrafficFrame,
    inputs::{attribute, for_each_element},
    options::SumoOptions,
};

/// Tests run as threads of one process, and a process has one SUMO: the tests take turns.
static TURN: Mutex<()> = Mutex::new(());

/// A folder with nets, and the turn to run SUMO.
pub struct Bench {
    pub folder: TempDir,
    _turn: MutexGuard<'static, ()>,
}

/// The directory of the wheel.
pub fn sumo_home() -> PathBuf {
    PathBuf::from(env!("CARAWARE_BUILD_SUMO_HOME"))
}

/// The pose of a hero where SUMO has it, which drives straight on.
pub fn straight_on(state: &TrafficState, speed_mps: f64) -> EgoPose {
    EgoPose {
        front_x_m: state.front_x_m,
        front_y_m: state.front_y_m,
        yaw_rad: f64::from(state.yaw_rad),
        speed_mps,
        accel_mps2: 0.0,
        vehicle: state.vehicle,
        flags: 0,
    }
}

/// The state of the road user with this id; `ids` has those of all that have departed.
pub fn state_of<'a>(frame: &'a TrafficFrame, ids: &BTreeMap<u32, String>, id: &str) -> Option<&'a TrafficState> {
    frame.states.iter().find(|state| ids[&state.vehicle] == id)
}

impl Bench {
    pub fn new() -> Self {
        let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        Self {
            folder: tempfile::tempdir().unwrap(),
            _turn,
        }
    }

    /// A grid of 5 × 5 junctions, 100 m apart, with signals, sidewalks and crossings.
    pub fn grid(&self) -> PathBuf {
        let net = self.folder.path().join("grid.net.xml");
        let options = [
            "--grid",
            "--grid.number",
            "5",
            "--grid.length",
            "100",
            "--sidewalks.guess",
            "--crossings.guess",
        ];
        let status = tool("netgenerate")
            .args(options)
            .args([
                "--default.lanenumber",
                "2",
                "--tls.guess",
                "--no-turnarounds.tls",
                "--output-file",
            ])
            .arg(&net)
            .output()
            .unwrap();
        assert!(status.status.success(), "{}", String::from_utf8_lossy(&status.stderr));
        net
    }

    /// SUMO with the town and these vehicles, all of them heroes: id, where it departs (metres), and the edges of its route.
    pub fn town_of_heroes(&self, heroes: &[(&str, f64, &str)]) -> Sumo {
        self.town_with(heroes, heroes.iter().map(|(id, ..)| *id))
    }

    /// SUMO with the town and these vehicles, some of them heroes.
    pub fn town_with<'a>(&self, vehicles: &[(&str, f64, &str)], heroes: impl Iterator<Item = &'a str>) -> Sumo {
        let vehicle = |(id, at_m, edges): &(&str, f64, &str)| {
            format!("<vehicle id=\"{id}\" depart=\"0\" departPos=\"{at_m}\"><route edges=\"{edges}\"/></vehicle>")
        };
        self.town_of(&vehicles.iter().map(vehicle).collect::<String>(), heroes)
    }

    /// SUMO with the town and the road users of these elements.
    pub fn town_of<'a>(&self, road_users: &str, heroes: impl Iterator<Item = &'a str>) -> Sumo {
        let (net, _) = self.town();
        self.file("a.rou.xml", &format!("<routes>{road_users}</routes>"));
        let scenario = self.file(
            "a.sumocfg",
            "<configuration><input><net-file value=\"town.net.xml\"/><route-files value=\"a.rou.xml\"/></input></configuration>",
        );
        let options = SumoOptions::scenario(
            &sumo_home(),
            &scenario,
            &own_options(&net, &["a.rou.xml"]),
            &self.folder.path().join("sumo"),
            0.1,
            23423,
            ConnectedRule::Scenario {
                heroes: heroes.map(str::to_owned).collect(),
                cav_share: 0.0,
                max_cavs: 0,
            },
        );
        Sumo::start(options.unwrap()).unwrap()
    }

    /// The project's own town, built from its sources, and its additional files.
    pub fn town(&self) -> (PathBuf, Vec<PathBuf>) {
        let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("../maps/town");
        let net = self.folder.path().join("town.net.xml");
        let output = tool("netconvert")
            .arg("-c")
            .arg(sources.join("town.netccfg"))
            .arg("-o")
            .arg(&net)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        (net, vec![sources.join("town.vtypes.add.xml")])
    }

    /// A grid of `number` × `number` junctions, each with signals.
    pub fn signalled_grid(&self, number: u32) -> PathBuf {
        let net = self.folder.path().join("signals.net.xml");
        let number = number.to_string();
        let options = ["--grid", "--grid.number", &number, "--grid.length", "60"];
        let output = tool("netgenerate")
            .args(options)
            .args(["--default-junction-type", "traffic_light", "--output-file"])
            .arg(&net)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        net
    }

    /// A grid of 4 × 4 junctions with one lane in each direction, by netgenerate's defaults.
    pub fn default_grid(&self) -> PathBuf {
        let net = self.folder.path().join("default.net.xml");
        let options = [
            "--grid",
            "--grid.number",
            "4",
            "--no-turnarounds",
            "--seed",
            "3",
            "--output-file",
        ];
        let output = tool("netgenerate").args(options).arg(&net).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        net
    }

    /// Vehicles that cross the default grid with many turns.
    pub fn crossing_scenario(&self, net: &Path) -> PathBuf {
        let routes = [
            "A0A1 A1B1 B1B2 B2C2 C2C3",
            "D3C3 C3C2 C2B2 B2B1 B1A1",
            "C0C1 C1B1 B1B2 B2A2",
            "A3B3 B3B2 B2C2 C2C1 C1D1",
        ];
        let vehicle = |(index, edges): (u32, &&str)| {
            let depart = 2 * index;
            format!("<vehicle id=\"{index}\" depart=\"{depart}\"><route edges=\"{edges}\"/></vehicle>")
        };
        let vehicles: String = (0..60).zip(routes.iter().cycle()).map(vehicle).collect();
        self.file("crossing.rou.xml", &format!("<routes>{vehicles}</routes>"));
        let net = net.display();
        let input = format!("<net-file value=\"{net}\"/><route-files value=\"crossing.rou.xml\"/>");
        self.file(
            "crossing.sumocfg",
            &format!("<configuration><input>{input}</input></configuration>"),
        )
    }

    /// Ids of a net's traffic lights, sorted.
    pub fn lights_of(&self, net: &Path) -> Vec<String> {
        let mut ids = Vec::new();
        for_each_element(net, |element| {
            if element.name().as_ref() == "tlLogic" {
                ids.extend(attribute(element, "id"));
            }
        })
        .unwrap();
        ids.sort();
        ids.dedup();
        ids
    }

    /// Writes a file.
    pub fn file(&self, name: &str, text: &str) -> PathBuf {
        let path = self.folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    /// A scenario over the grid with these routes.
    pub fn scenario(&self, routes: &str) -> PathBuf {
        self.grid();
        self.file("a.rou.xml", routes);
        self.file(
            "a.sumocfg",
            "<configuration><input><net-file value=\"grid.net.xml\"/><route-files value=\"a.rou.xml\"/></input></configuration>",
        )
    }

    /// The source of traffic that such a scenario is.
    pub fn source(&self, sumocfg: PathBuf) -> Source {
        let own = own_options(&self.folder.path().join("grid.net.xml"), &["a.rou.xml"]);
        Source::Scenario { sumocfg, own }
    }

    /// Options for a scenario whose outputs go to `sumo/`.
    pub fn scenario_options(&self, sumocfg: &Path, step_s: f64) -> SumoOptions {
        SumoOptions::scenario(
            &sumo_home(),
            sumocfg,
            &own_options(&self.folder.path().join("grid.net.xml"), &["a.rou.xml"]),
            &self.folder.path().join("sumo"),
            step_s,
            23423,
            ConnectedRule::connected(0.5),
        )
        .unwrap()
    }
}

/// What the supervisor has read in a scenario of this net and the files `others` beside it.
pub fn own_options(net: &Path, others: &[&str]) -> ScenarioOptions {
    let beside = others.iter().map(|name| net.with_file_name(name));
    ScenarioOptions {
        inputs: std::iter::once(net.to_owned()).chain(beside).collect(),
        ..ScenarioOptions::default()
    }
}

fn tool(name: &str) -> Command {
    let mut command = Command::new(sumo_home().join("bin").join(name));
    command
        .env("SUMO_HOME", sumo_home())
        .env("PROJ_DATA", sumo_home().join("data/proj"));
    command
}

/// Runs `steps` steps and calls `see` after each.
pub fn run(sumo: &mut Sumo, steps: usize, mut see: impl FnMut(&mut Sumo, &TrafficFrame)) {
    let mut frame = TrafficFrame::default();
    for _ in 0..steps {
        sumo.step(&mut frame).unwrap();
        see(sumo, &frame);
    }
}
