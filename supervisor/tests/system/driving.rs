//! The driving task with real SUMO traffic, real processes and real shared memory, in both directions.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
    time::{Duration, Instant},
};

use crate::common::{Workplace, sumo_program, text, tool};
use serde_json::Value;

const QUIET: [&str; 2] = ["--set", "fanout.enabled=false"];

/// `caraware train` with the scripted driver of `tests/drivers`.
fn driven(workplace: &Workplace, script: &str, arguments: &[&str]) -> Command {
    let drivers = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/drivers");
    let trainer = Path::new(env!("CARGO_MANIFEST_DIR")).join("../trainer/python");
    let mut command = workplace.command(&[&["train"], arguments, &QUIET].concat());
    command
        .env("PYTHONPATH", std::env::join_paths([drivers, trainer]).unwrap())
        .env("DRIVER_SCRIPT", script);
    command
}

fn succeed(mut command: Command) -> Output {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}\n{}", output.status, text(&output));
    output
}

/// Builds a net from nodes and edges, and a scenario on it that records the positions of all vehicles (`fcd.xml`).
fn scenario(workplace: &Workplace, nodes: &str, edges: &str, routes: &str, seconds: u32) {
    workplace.write("a.nod.xml", &format!("<nodes>{nodes}</nodes>"));
    workplace.write("a.edg.xml", &format!("<edges>{edges}</edges>"));
    workplace.write("a.rou.xml", &format!("<routes>{routes}</routes>"));
    tool(
        &sumo_program("netconvert"),
        &[
            "-n",
            "a.nod.xml",
            "-e",
            "a.edg.xml",
            "-o",
            "a.net.xml",
            "--no-turnarounds",
            "true",
        ],
        workplace.path(),
    );
    workplace.write(
        "a.sumocfg",
        &format!(
            "<configuration><input><net-file value=\"a.net.xml\"/><route-files value=\"a.rou.xml\"/></input>\
             <time><step-length value=\"0.1\"/><end value=\"{seconds}\"/></time>\
             <output><fcd-output value=\"fcd.xml\"/><collision-output value=\"collisions.xml\"/>\
             <tripinfo-output value=\"trips.xml\"/></output>\
             <processing><collision.mingap-factor value=\"0\"/><collision.check-junctions value=\"true\"/></processing>\
             </configuration>"
        ),
    );
}

const ORIGIN: [&str; 4] = [
    "--set",
    "map.origin_latitude_deg=52",
    "--set",
    "map.origin_longitude_deg=10",
];

/// Drives the vehicle `h` of the scenario for two episodes, of which the second is an evaluation. SUMO's files are those of the last.
fn drive(workplace: &Workplace, name: &str, script: &str) -> Value {
    let settings = [
        "a.sumocfg",
        "--name",
        name,
        "--set",
        "task.kind=driving",
        "--set",
        "traffic.hero_ids=[\"h\"]",
        "--set",
        "trainer.module=scripted",
        "--set",
        "observation.fields=driving",
        "--set",
        "episode.training_episodes=1",
        "--set",
        "episode.final_evaluations=1",
        "--set",
        "episode.evaluation_ticks=1000",
    ];
    succeed(driven(workplace, script, &[&settings[..], &ORIGIN].concat()));
    workplace.assert_nothing_left();
    workplace.report(name)
}

fn sumo_output(workplace: &Workplace, run: &str, file: &str) -> String {
    let path: PathBuf = workplace.path().join("runs").join(run).join("sumo").join(file);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path:?}: {error}"))
}

/// (tick, vehicle) → (x, y, speed) in SUMO's own record.
fn trace(fcd: &str) -> BTreeMap<(u32, String), (f64, f64, f64)> {
    let value = |line: &str, name: &str| {
        let rest = line.split_once(&format!(" {name}=\"")).unwrap().1;
        rest.split_once('"').unwrap().0.to_owned()
    };
    let number = |line: &str, name: &str| value(line, name).parse::<f64>().unwrap();
    let mut tick = 0;
    let mut all = BTreeMap::new();
    for line in fcd.lines() {
        if line.contains("<timestep ") {
            tick = (number(line, "time") * 10.0).round() as u32;
        } else if line.contains("<vehicle ") {
            let place = (number(line, "x"), number(line, "y"), number(line, "speed"));
            all.insert((tick, value(line, "id")), place);
        }
    }
    all
}

#[test]
fn a_hero_that_brakes_hard_makes_its_follower_brake() {
    let workplace = Workplace::new();
    scenario(
        &workplace,
        "<node id=\"a\" x=\"0\" y=\"0\"/><node id=\"b\" x=\"3000\" y=\"0\"/>",
        "<edge id=\"road\" from=\"a\" to=\"b\" numLanes=\"2\" speed=\"36.1\"/>",
        "<vType id=\"car\" length=\"5\" lcSpeedGain=\"0\" lcCooperative=\"0\" sigma=\"0\"/><route id=\"r\" edges=\"road\"/>\
         <vehicle id=\"h\" type=\"car\" route=\"r\" depart=\"0\" departPos=\"200\" departSpeed=\"30\" departLane=\"0\"/>\
         <vehicle id=\"f\" type=\"car\" route=\"r\" depart=\"0\" departPos=\"140\" departSpeed=\"30\" departLane=\"0\"/>",
        20,
    );
    let report = drive(&workplace, "motorway", r#"{"0": null, "4": [0, -1]}"#);
    let trace = trace(&sumo_output(&workplace, "motorway", "fcd.xml"));
    let speed = |tick: u32, id: &str| trace[&(tick, id.to_owned())].2;
    let gap = |tick: u32| trace[&(tick, "h".to_owned())].0 - 5.0 - trace[&(tick, "f".to_owned())].0;
    assert!(speed(38, "f") > 25.0, "before: {} m/s", speed(38, "f"));
    assert!(
        speed(199, "h") < 0.1 && speed(199, "f") < 1.0,
        "{} m/s",
        speed(199, "f")
    );
    // The hero stops in 30/9 s: far harder than SUMO's 4.5 m/s².
    assert!(speed(40 + 45, "h") < 0.1, "{}", speed(85, "h"));
    let least = (1..200).map(gap).fold(f64::INFINITY, f64::min);
    assert!(least > 0.5, "the follower came as near as {least} m");
    assert!(!sumo_output(&workplace, "motorway", "collisions.xml").contains("<collision "));
    assert_eq!(report["dynamics"]["heroes"]["collided"], 0);
}

#[test]
fn a_hero_that_stands_across_a_junction_makes_traffic_queue() {
    let workplace = Workplace::new();
    let arms = "<node id=\"c\" x=\"0\" y=\"0\" type=\"priority\"/><node id=\"w\" x=\"-200\" y=\"0\"/>\
        <node id=\"e\" x=\"200\" y=\"0\"/><node id=\"n\" x=\"0\" y=\"200\"/><node id=\"s\" x=\"0\" y=\"-200\"/>";
    let roads = "<edge id=\"wc\" from=\"w\" to=\"c\" priority=\"2\"/><edge id=\"ce\" from=\"c\" to=\"e\" priority=\"2\"/>\
        <edge id=\"nc\" from=\"n\" to=\"c\"/><edge id=\"cs\" from=\"c\" to=\"s\"/>";
    let routes = "<vType id=\"car\" length=\"5\"/>\
        <vehicle id=\"h\" type=\"car\" depart=\"0\" departPos=\"100\" departSpeed=\"8\"><route edges=\"wc ce\"/></vehicle>\
        <flow id=\"f\" type=\"car\" begin=\"0\" end=\"60\" period=\"6\" departSpeed=\"10\"><route edges=\"nc cs\"/></flow>";
    scenario(&workplace, arms, roads, routes, 60);
    // netconvert moves the origin to the corner: the junction's middle is at (200, 200).
    drive(&workplace, "junction", r#"{"0": null, "stop_x_m": 197}"#);
    let trace = trace(&sumo_output(&workplace, "junction", "fcd.xml"));
    let stood = trace[&(590, "h".to_owned())];
    assert!(
        stood.2 < 0.05 && (stood.0 - 200.5).abs() < 2.0,
        "the hero stands at {stood:?}"
    );
    let halting = |tick: u32| {
        let all = trace.iter().filter(|((at, id), _)| *at == tick && id.starts_with("f."));
        all.filter(|(_, (_, y, speed))| *speed < 0.1 && *y > 200.0).count()
    };
    assert!(halting(590) >= 5, "{} vehicles wait at the junction", halting(590));
    let passed = trace
        .iter()
        .filter(|((tick, id), (_, y, _))| *tick > 300 && id.starts_with("f.") && *y < 190.0 && *y > 100.0)
        .count();
    assert_eq!(passed, 0, "a vehicle drove through the hero");
    assert!(!sumo_output(&workplace, "junction", "collisions.xml").contains("<collision "));
}

#[test]
fn without_heroes_traffic_is_that_of_bare_sumo() {
    let workplace = Workplace::new();
    tool(
        &sumo_program("netgenerate"),
        &[
            "--grid",
            "--grid.number",
            "4",
            "--grid.length",
            "150",
            "-o",
            "a.net.xml",
        ],
        workplace.path(),
    );
    let flows: String = [("A0B0", "C3D3"), ("D3C3", "B0A0"), ("A3A2", "D1D0"), ("D0D1", "A2A3")]
        .iter()
        .enumerate()
        .map(|(i, (from, to))| {
            format!("<flow id=\"f{i}\" begin=\"0\" end=\"200\" probability=\"0.2\" from=\"{from}\" to=\"{to}\"/>")
        })
        .collect();
    workplace.write("a.rou.xml", &format!("<routes>{flows}</routes>"));
    workplace.write(
        "a.sumocfg",
        "<configuration><input><net-file value=\"a.net.xml\"/><route-files value=\"a.rou.xml\"/></input>\
         <time><step-length value=\"0.5\"/><end value=\"400\"/></time>\
         <output><tripinfo-output value=\"trips.xml\"/></output></configuration>",
    );
    workplace.succeed(&[&["simulate", "a.sumocfg", "--name", "ours"], &ORIGIN[..], &QUIET].concat());
    tool(
        &sumo_program("sumo"),
        &["-c", "a.sumocfg", "--no-step-log"],
        workplace.path(),
    );
    let trips = |file: &str| -> Vec<String> {
        file.lines()
            .filter(|line| line.contains("<tripinfo "))
            .map(str::to_owned)
            .collect()
    };
    let bare = trips(&std::fs::read_to_string(workplace.path().join("trips.xml")).unwrap());
    assert!(bare.len() > 100, "{} trips", bare.len());
    assert_eq!(trips(&sumo_output(&workplace, "ours", "trips.xml")), bare);
}

/// A town with one hero that starts at a given place, driven by script.
fn in_town(workplace: &Workplace, name: &str, script: &str, more: &[&str]) -> Command {
    let settings = [
        "lap",
        "--name",
        name,
        "--set",
        "trainer.module=scripted",
        "--set",
        "traffic.others=0",
        "--set",
        "traffic.pedestrians=0",
        "--set",
        "episode.evaluation_ticks=10",
    ];
    driven(workplace, script, &[&settings[..], more].concat())
}

/// The rows that the driver received: [episode, tick, slot, vehicle, valid, terminated, truncated, x, y, yaw, speed].
fn seen(report: &Value) -> Vec<Vec<Value>> {
    serde_json::from_value(report["trainer"]["seen"].clone()).unwrap()
}

#[test]
fn leaving_the_road_and_standing_terminate_and_the_time_limit_truncates() {
    let workplace = Workplace::new();
    let ends = |name: &str, script: &str, more: &[&str]| {
        let settings = ["--set", "episode.ticks=200", "--set", "task.time_limit_s=6"];
        succeed(in_town(&workplace, name, script, &[&settings, more].concat()));
        workplace.report(name)
    };
    // This hero drives straight out of the bend and over the kerb: it is beside the road long before the time limit.
    let off = ends("off", r#"{"0": [1, 1]}"#, &[]);
    let cut = ends("cut", r#"{"0": [0, -1]}"#, &[]);
    let stood = ends("stood", r#"{"0": [0, -1]}"#, &["--set", "task.blocked_s=1.5"]);
    for (report, key, column) in [(&off, "off_road", 5), (&cut, "time_limit", 6), (&stood, "blocked", 5)] {
        let heroes = &report["dynamics"]["heroes"];
        let count = heroes[key].as_u64().unwrap();
        assert!(count >= 2, "{heroes}");
        let of_all = ["off_road", "time_limit", "blocked"].map(|end| heroes[end].as_u64().unwrap());
        assert_eq!(of_all.iter().sum::<u64>(), count, "{heroes}");
        let rows: Vec<_> = seen(report).into_iter().filter(|row| row[0] == 0).collect();
        let flagged: Vec<usize> = (0..rows.len())
            .filter(|&at| rows[at][5] == true || rows[at][6] == true)
            .collect();
        assert!(flagged.len() >= 2, "{flagged:?}");
        for at in flagged {
            assert_eq!(
                (&rows[at][column], &rows[at][11 - column]),
                (&true.into(), &false.into())
            );
            assert_eq!(rows[at][4], false, "the slot is empty at the tick that says so");
            assert_eq!(rows[at - 1][4], true, "the last observation was delivered");
            // Another hero gets the slot.
            let next = rows[at..].iter().find(|row| row[4] == true);
            assert!(next.is_none_or(|row| row[3] != rows[at - 1][3]));
        }
    }
    // 60 ticks from the first to the last.
    let lived = seen(&cut)
        .iter()
        .take_while(|row| row[6] == false)
        .filter(|row| row[4] == true)
        .count();
    assert_eq!(lived, 60);
}

/// SUMO gives no slope to a vehicle that is beside the road.
#[test]
fn a_hero_that_leaves_a_road_uphill_ends_its_trip_and_not_the_run() {
    let workplace = Workplace::new();
    scenario(
        &workplace,
        "<node id=\"a\" x=\"0\" y=\"0\" z=\"0\"/><node id=\"b\" x=\"1000\" y=\"0\" z=\"80\"/>",
        "<edge id=\"road\" from=\"a\" to=\"b\" speed=\"20\"/>",
        "<route id=\"r\" edges=\"road\"/><vehicle id=\"h\" route=\"r\" depart=\"0\" departPos=\"100\" departSpeed=\"15\"/>",
        10,
    );
    let report = drive(&workplace, "uphill", r#"{"0": null, "2": [0.3, 0]}"#);
    assert_eq!(
        report["dynamics"]["heroes"]["off_road"], 2,
        "{:#}",
        report["dynamics"]["heroes"]
    );
}

#[test]
fn an_action_that_is_not_finite_or_out_of_range_is_refused_and_the_last_one_is_held() {
    let workplace = Workplace::new();
    let run = |name: &str, script: &str| {
        succeed(in_town(&workplace, name, script, &["--set", "episode.ticks=60"]));
        let log = workplace.path().join("runs").join(name).join("logs/sim-core.log");
        (workplace.report(name), std::fs::read_to_string(log).unwrap())
    };
    let (good, log) = run("good", r#"{"0": [0.1, 0.2]}"#);
    assert_eq!(good["dynamics"]["heroes"]["refused_actions"], 0);
    assert!(!log.contains("is held"), "{log}");
    let (bad, log) = run(
        "bad",
        r#"{"0": [0.1, 0.2], "1": [NaN, 0.5], "1.5": [0, 1.5], "2": [0, -Infinity], "3": [0.1, 0.2]}"#,
    );
    // 10 + 5 + 10 ticks; the evaluation is over before.
    assert_eq!(bad["dynamics"]["heroes"]["refused_actions"], 20);
    let warnings: Vec<&str> = log.lines().filter(|line| line.contains("is held")).collect();
    assert_eq!(warnings.len(), 1, "one warning for each hero: {log}");
    assert!(
        warnings[0].contains("hero hero.0, tick ") && warnings[0].contains("steering NaN"),
        "{}",
        warnings[0]
    );
    assert!(warnings[0].contains("[0.1, 0.2] is held"), "{}", warnings[0]);
    let poses = |report: &Value| -> Vec<Vec<Value>> { seen(report).into_iter().map(|row| row[7..].to_vec()).collect() };
    assert_eq!(
        poses(&good),
        poses(&bad),
        "a held action has the effect of one that was sent again"
    );
    assert_eq!(good["observation_hash"], bad["observation_hash"]);
}

#[test]
fn the_scripted_driver_drives_the_same_laps_for_the_same_seed() {
    let workplace = Workplace::new();
    let lap = |name: &str, more: &[&str]| {
        let settings = ["lap", "--name", name, "--set", "episode.evaluation_ticks=10"];
        let mut command = workplace.command(&[&["train"], &settings[..], more, &QUIET].concat());
        command.env(
            "PYTHONPATH",
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../trainer/python"),
        );
        succeed(command);
        workplace.report(name)
    };
    for model in ["kinematic", "dynamic", "rigid_body"] {
        let chosen = format!("vehicle.hero_model=\"{model}\"");
        let report = lap(model, &["--set", "episode.ticks=1600", "--set", &chosen]);
        let heroes = &report["dynamics"]["heroes"];
        assert!(heroes["arrived"].as_u64().unwrap() >= 1, "{model}: {heroes}");
        assert_eq!(
            (&heroes["off_road"], &heroes["collided"], &heroes["time_limit"]),
            (&0.into(), &0.into(), &0.into()),
            "{model}"
        );
        assert_eq!(heroes["refused_actions"], 0, "{model}");
    }
    let again = |name: &str, more: &[&str]| {
        lap(name, &[&["--set", "episode.ticks=300"], more].concat())["observation_hash"].clone()
    };
    let (a, b) = (again("a", &[]), again("b", &["--set", "run.window_ticks=2"]));
    assert_eq!(a, b, "same seed, same actions");
    assert_ne!(a, again("c", &["--set", "run.seed=2"]));
}

#[test]
fn a_run_whose_driver_sends_nothing_can_be_stopped_and_a_driver_that_leaves_ends_it() {
    let workplace = Workplace::new();
    let mut silent = in_town(&workplace, "silent", r#"{"0": [0, 0.1], "mute_s": 1.0}"#, &[]);
    let mut child = silent.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let deadline = Instant::now() + Duration::from_mins(2);
    loop {
        let table = workplace.run(&["ps"]);
        let ticks = |line: &str| line.split_whitespace().nth(4)?.parse::<u64>().ok();
        let text = String::from_utf8_lossy(&table.stdout).into_owned();
        if text
            .lines()
            .filter(|line| line.contains("sim-core"))
            .filter_map(ticks)
            .any(|ticks| ticks >= 10)
        {
            break;
        }
        assert!(Instant::now() < deadline, "{text}");
        std::thread::park_timeout(Duration::from_millis(50));
    }
    let stopped = workplace.run(&["stop"]);
    assert!(stopped.status.success(), "{}", text(&stopped));
    assert_eq!(child.wait().unwrap().code(), Some(130));
    workplace.assert_nothing_left();
    let output = in_town(&workplace, "left", r#"{"0": [0, 0.1], "quit_s": 1.0}"#, &[])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(
        text(&output).contains("trainer ended") && text(&output).contains("had enough"),
        "{}",
        text(&output)
    );
    workplace.assert_nothing_left();
}

#[test]
fn a_task_that_cannot_be_driven_is_refused_before_anything_starts() {
    let workplace = Workplace::new();
    let refused = |arguments: &[&str]| {
        let output = workplace.run(&[arguments, &QUIET].concat());
        assert_eq!(output.status.code(), Some(2), "{}", text(&output));
        text(&output)
            .replace(['│', '×'], " ")
            .split_whitespace()
            .collect::<Vec<_>>()
            .join(" ")
    };
    let said = refused(&["simulate", "driving"]);
    assert!(
        said.contains("the driving task needs a trainer") && said.contains("caraware train"),
        "{said}"
    );
    let said = refused(&["train", "driving", "--set", "traffic.hero_ids=[\"a\"]"]);
    assert!(said.contains("`traffic.hero_ids` must be empty"), "{said}");
    let said = refused(&["train", "town", "--set", "traffic.heroes=1"]);
    assert!(said.contains("`traffic.heroes` = 1 needs the driving task"), "{said}");
    assert!(!workplace.path().join("runs").exists());
    // The edges are known once SUMO has read the net.
    let said = refused(&[
        "train",
        "driving",
        "--set",
        "traffic.hero_route=[\"ring_west_1\", \"nowhere\"]",
    ]);
    assert!(
        said.contains("no hero can drive `traffic.hero_route`") && said.contains("nowhere"),
        "{said}"
    );
    workplace.assert_nothing_left();
}

/// Its mirrors are 1.5 s behind SUMO, and the trips end where the mirrors are.
#[test]
fn heroes_that_sumo_drives_arrive_with_a_view_of_the_road_ahead() {
    let workplace = Workplace::new();
    let settings = [
        "task.driver=sumo",
        "vehicle.preview_s=1.5",
        "trainer.module=caraware.driving.trips",
        "curriculum.maps=[\"avenue\"]",
        "traffic.heroes=10",
        "traffic.others=10",
        "episode.ticks=1",
        "episode.training_episodes=1",
        "episode.evaluation_ticks=700",
        "episode.final_evaluations=1",
        "fanout.enabled=false",
    ];
    let settings = settings.iter().flat_map(|setting| ["--set", setting]);
    let arguments: Vec<&str> = ["train", "driving", "--name", "watched"]
        .into_iter()
        .chain(settings)
        .collect();
    let mut command = workplace.command(&arguments);
    command.env("CARAWARE_DRIVER", "sumo");
    succeed(command);
    let report = workplace.report("watched");
    let heroes = &report["dynamics"]["heroes"];
    let [arrived, off_road] = ["arrived", "off_road"].map(|name| heroes[name].as_u64().unwrap());
    assert!(arrived >= 3 && off_road == 0, "{heroes}");
    let trips = report["trainer"]["trips"].as_array().unwrap();
    assert!(trips.iter().any(|trip| trip["end"] == "arrival"), "{trips:#?}");

    let scenario = [
        "map.origin_latitude_deg=52",
        "map.origin_longitude_deg=10",
        "vehicle.preview_s=1.5",
    ];
    let scenario = scenario.iter().flat_map(|setting| ["--set", setting]);
    let city = ["generate", "city", "--vehicles", "10", "--junctions", "3"];
    workplace.succeed(&city);
    let heroes = [
        "train",
        "city/city.sumocfg",
        "--set",
        "task.kind=driving",
        "--set",
        "task.driver=sumo",
    ];
    let more = [
        "--set",
        "traffic.hero_ids=[\"a\"]",
        "--set",
        "trainer.module=caraware.driving.trips",
    ];
    let refused = workplace.run(&heroes.into_iter().chain(more).chain(scenario).collect::<Vec<_>>());
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
    assert!(
        text(&refused).contains("would vanish before the end"),
        "{}",
        text(&refused)
    );
    workplace.assert_nothing_left();
}

/// The pupil's rows come from both worlds: one alone would not be enough for a first lesson.
#[test]
fn a_policy_is_taught_where_it_drives_in_two_worlds() {
    let workplace = Workplace::new();
    let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("../maps/town/driver.safetensors");
    let begin = format!("task.begin_from={}", policy.display());
    let settings = [
        "trainer.module=caraware.driving.dagger",
        &begin,
        "traffic.heroes=24",
        "traffic.others=8",
        "episode.ticks=600",
        "episode.training_episodes=1",
        "episode.evaluation_interval=0",
        "episode.final_evaluations=1",
        "episode.evaluation_ticks=20",
    ];
    let mut arguments = vec!["train", "driving", "--quiet", "--envs", "2", "--name", "taught"];
    arguments.extend(settings.iter().flat_map(|setting| ["--set", setting]));
    arguments.extend(QUIET);
    workplace.succeed(&arguments);
    let report = workplace.report("taught");
    let [rows, lessons] = ["env_steps", "lessons"].map(|name| report["trainer"][name].as_u64().unwrap());
    assert!(rows > 20_000 && rows <= 2 * 24 * 600, "{rows} rows");
    assert!(lessons > 10, "{lessons} lessons");
    assert!(workplace.path().join("runs/taught/taught.safetensors").is_file());
    workplace.assert_nothing_left();
}
