//! Bad input is refused with its file, key or line, with the fix and with the right exit code, and nothing is left behind.

use std::{
    net::TcpListener,
    path::Path,
    process::{Command, Stdio},
};

use crate::common::{Workplace, sumo_program, text, tool, tree};
use serde_json::Value;

/// Runs a command that must be refused, and returns its output as one line.
fn refused(workplace: &Workplace, arguments: &[&str], exit_code: i32) -> String {
    let output = workplace.run(arguments);
    let said = text(&output);
    assert_eq!(output.status.code(), Some(exit_code), "{arguments:?}: {said}");
    workplace.assert_nothing_left();
    // miette wraps lines with a margin.
    said.replace(['│', '×', '╰', '─', '▶'], " ")
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
}

fn assert_says(said: &str, parts: &[&str]) {
    for part in parts {
        assert!(said.contains(part), "`{part}` is not in: {said}");
    }
}

/// The workspace's programs.
fn programs() -> Vec<String> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version=1", "--no-deps", "--locked", "--offline"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap().iter();
    let targets = packages.flat_map(|package| package["targets"].as_array().unwrap());
    let programs = targets.filter(|target| target["kind"][0] == "bin");
    programs
        .map(|target| target["name"].as_str().unwrap().to_owned())
        .collect()
}

/// Also those that people rarely start by hand.
#[test]
fn every_program_says_how_it_is_used() {
    let programs = programs();
    assert!(programs.iter().any(|program| program == "v2x-bench"), "{programs:?}");
    let directory = Path::new(env!("CARGO_BIN_EXE_caraware")).parent().unwrap();
    for program in programs {
        let output = Command::new(directory.join(&program)).arg("--help").output().unwrap();
        let said = text(&output);
        assert!(output.status.success(), "{program}: {said}");
        assert!(said.to_lowercase().contains("usage: "), "{program}: {said}");
        assert!(said.contains(program.trim_end_matches("-bench")), "{program}: {said}");
    }
}

#[test]
fn unknown_configuration_key() {
    let workplace = Workplace::new();
    workplace.write("my.toml", "[run]\nseed = 1\n\n[traffic]\ncav = 3\n");
    let said = refused(&workplace, &["train", "my.toml"], 2);
    assert_says(
        &said,
        &["my.toml:5: unknown key `traffic.cav`", "did you mean `traffic.cavs`?"],
    );
    assert!(!workplace.path().join("runs").exists());
}

#[test]
fn wrong_unit_and_wrong_range() {
    let workplace = Workplace::new();
    workplace.write("my.toml", "[gnss]\nnoise_deg = 5.0\n");
    assert_says(
        &refused(&workplace, &["train", "my.toml"], 2),
        &["my.toml:2: unknown key `gnss.noise_deg`", "`gnss.noise_std_deg`"],
    );
    let said = refused(&workplace, &["train", "--set", "gnss.noise_std_deg=5.0"], 2);
    assert_says(
        &said,
        &["`gnss.noise_std_deg` cannot be 5.0", "0 … 1, or one for all in deg"],
    );
    let said = refused(&workplace, &["train", "--set", "gnss.period_s=0.25"], 2);
    assert_says(&said, &["`gnss.period_s` = 0.25 s", "`run.tick_s` = 0.1 s"]);
}

#[test]
fn unknown_prop_as_obstacle() {
    let workplace = Workplace::new();
    workplace.write("my.toml", "[scene]\nobstacles = [\"cone 10 20\", \"conne 30 40 90\"]\n");
    let said = refused(&workplace, &["simulate", "my.toml"], 2);
    assert_says(
        &said,
        &[
            "my.toml:2",
            "`scene.obstacles`: \"conne 30 40 90\" names no known prop",
            "props: cone, bollard",
        ],
    );
    let said = refused(&workplace, &["simulate", "--set", "scene.obstacles=[\"cone here\"]"], 2);
    assert_says(&said, &["\"cone here\" is not", "its centre (m, world)"]);
    assert!(!workplace.path().join("runs").exists());
}

#[test]
fn vehicle_model_of_an_unknown_class() {
    let workplace = Workplace::new();
    workplace.write("my.toml", "[vehicle]\nclass_models = [\"truk=dynamic\"]\n");
    let said = refused(&workplace, &["simulate", "my.toml"], 2);
    assert_says(
        &said,
        &[
            "my.toml:2",
            "\"truk=dynamic\"",
            "no vehicle class",
            "passenger, private",
        ],
    );
}

#[test]
fn texts_that_cannot_be_read() {
    let workplace = Workplace::new();
    for (table, entry, says, allowed) in [
        (
            "scene",
            "meshes = [\"wall.obj 1 two\"]",
            "`scene.meshes`: \"wall.obj 1 two\" is not",
            "file.obj x y",
        ),
        (
            "lidar",
            "pattern = \"vlp17\"",
            "`lidar.pattern` cannot be \"vlp17\"",
            "\"vlp16\", \"hdl32e\"",
        ),
        (
            "lidar",
            "interest_props = [\"unicorn\"]",
            "`lidar.interest_props`: \"unicorn\" names no known prop",
            "cone, bollard",
        ),
        (
            "fanout",
            "listen = \"quic/127.0.0.1:7447\"",
            "`fanout.listen`: \"quic/127.0.0.1:7447\" is no endpoint",
            "tls/HOST:PORT",
        ),
        (
            "trainer",
            "network = \"mlpp\"",
            "`trainer.network`: \"mlpp\" is neither",
            "package.module:Class",
        ),
        (
            "trainer",
            "device = \"gpu\"",
            "`trainer.device` cannot be \"gpu\"",
            "\"cpu\", \"auto\"",
        ),
        (
            "trainer",
            "matmul_precision = \"float16\"",
            "`trainer.matmul_precision` cannot be \"float16\"",
            "\"float32\", \"bfloat16\"",
        ),
    ] {
        workplace.write("my.toml", &format!("[{table}]\n{entry}\n"));
        let said = refused(&workplace, &["simulate", "my.toml"], 2);
        assert_says(&said, &["my.toml:2", says, allowed]);
    }
    assert!(!workplace.path().join("runs").exists());
}

#[test]
fn unknown_preset() {
    let workplace = Workplace::new();
    assert_says(
        &refused(&workplace, &["train", "villlage"], 2),
        &["villlage", "neither a preset, a .toml nor a .sumocfg", "presets: town"],
    );
}

#[test]
fn preset_of_a_preset_and_of_nothing() {
    let workplace = Workplace::new();
    let said = refused(&workplace, &["train", "lap", "--preset", "driving"], 2);
    assert_says(
        &said,
        &["`--preset` is for a .toml or a .sumocfg", "CONFIG is lap", "leave one"],
    );
    let said = refused(&workplace, &["train", "--preset", "driving"], 2);
    assert_says(
        &said,
        &["required arguments were not provided", "--preset <NAME> <CONFIG>"],
    );
}

#[test]
fn missing_sumocfg() {
    let workplace = Workplace::new();
    assert_says(
        &refused(&workplace, &["simulate", "no/such.sumocfg"], 2),
        &["no/such.sumocfg", "cannot be read", "existing .sumocfg"],
    );
}

/// A small grid with the given routes; netgenerate gives it no projection.
fn scenario(workplace: &Workplace, routes: &str) {
    tool(
        &sumo_program("netgenerate"),
        &["--grid", "--grid.number", "3", "-o", "grid.net.xml"],
        workplace.path(),
    );
    workplace.write("grid.rou.xml", routes);
    workplace.write(
        "grid.sumocfg",
        "<configuration>\n  <input>\n    <net-file value=\"grid.net.xml\"/>\n    <route-files value=\"grid.rou.xml\"/>\n  </input>\n</configuration>\n",
    );
}

#[test]
fn net_without_projection() {
    let workplace = Workplace::new();
    scenario(&workplace, "<routes/>");
    let said = refused(&workplace, &["simulate", "grid.sumocfg"], 2);
    assert_says(
        &said,
        &["grid.net.xml", "no projection", "map.origin_latitude_deg=52.0"],
    );
}

#[test]
fn route_with_an_unknown_edge() {
    let workplace = Workplace::new();
    scenario(
        &workplace,
        "<routes>\n  <vehicle id=\"a\" depart=\"0\"><route edges=\"A0A1 nowhere\"/></vehicle>\n</routes>\n",
    );
    let origin = [
        "--set",
        "map.origin_latitude_deg=52",
        "--set",
        "map.origin_longitude_deg=10",
        "--set",
        "fanout.enabled=false",
    ];
    let said = refused(
        &workplace,
        &[&["simulate", "grid.sumocfg"], origin.as_slice()].concat(),
        2,
    );
    assert_says(
        &said,
        &[
            "traffic-bridge",
            "grid.rou.xml, line 2",
            "The edge 'nowhere'",
            "correct the file",
        ],
    );
}

#[test]
fn maps_beside_a_scenario() {
    let workplace = Workplace::new();
    scenario(&workplace, "<routes/>");
    for mode in ["simulate", "train"] {
        let said = refused(
            &workplace,
            &[mode, "grid.sumocfg", "--set", "curriculum.maps=[\"town\"]"],
            2,
        );
        assert_says(
            &said,
            &["`curriculum.maps`", "a .sumocfg has its own net", "leave it out"],
        );
    }
}

/// `grid.sumocfg` with another route file.
fn simulate(workplace: &Workplace, routes: &str, settings: &[&str]) -> String {
    workplace.write(
        "grid.sumocfg",
        &format!(
            "<configuration>\n  <input>\n    <net-file value=\"grid.net.xml\"/>\n    <route-files value=\"{routes}\"/>\n  </input>\n</configuration>\n"
        ),
    );
    let mut arguments = vec![
        "simulate",
        "grid.sumocfg",
        "--set",
        "map.origin_latitude_deg=52",
        "--set",
        "map.origin_longitude_deg=10",
        "--set",
        "fanout.enabled=false",
    ];
    arguments.extend(settings);
    refused(workplace, &arguments, 2)
}

#[test]
fn remote_port_is_refused_before_sumo_would_wait() {
    let workplace = Workplace::new();
    scenario(&workplace, "<routes/>");
    workplace.write(
        "grid.sumocfg",
        "<configuration>\n  <input>\n    <net-file value=\"grid.net.xml\"/>\n  </input>\n  <traci_server>\n    \
         <remote-port value=\"8813\"/>\n  </traci_server>\n</configuration>\n",
    );
    for mode in ["simulate", "train"] {
        let said = refused(&workplace, &[mode, "grid.sumocfg"], 2);
        assert_says(
            &said,
            &["grid.sumocfg", "line 6", "remote-port = \"8813\"", "remove remote-port"],
        );
    }
    assert!(!workplace.path().join("runs").exists());
}

/// The user may choose a runtime directory that holds other files: neither a run nor `doctor --clean` removes them.
#[test]
fn other_files_in_the_runtime_directory_stay() {
    let workplace = Workplace::new();
    let runtime = workplace.path().join("run");
    for directory in ["thesis/chapters", ".config", "0123abcd"] {
        std::fs::create_dir_all(runtime.join(directory)).unwrap();
        std::fs::write(runtime.join(directory).join("precious"), "years of work").unwrap();
    }
    // A directory that looks like a dead run: it has an unlocked lock file, but no marker of caraware.
    std::fs::write(runtime.join("0123abcd").join("lock"), "").unwrap();
    std::os::unix::fs::symlink(runtime.join("thesis"), runtime.join("89abcdef")).unwrap();
    let before = tree(&runtime);
    let short = ["--set", "run.real_time_factor=0", "--set", "fanout.enabled=false"];
    let episode = ["--set", "episode.training_episodes=1", "--set", "episode.ticks=20"];
    workplace.succeed(&[&["simulate", "town", "--name", "beside"], &short[..], &episode[..]].concat());
    let said = text(&workplace.succeed(&["doctor", "--clean"]));
    assert!(
        said.contains("thesis: not a run of caraware; it is not touched"),
        "{said}"
    );
    assert_eq!(tree(&runtime), before);
}

#[test]
fn damaged_gzip() {
    let workplace = Workplace::new();
    scenario(&workplace, "<routes/>");
    let whole = b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\x03\xb3\x29\xca\x2f\x2d\x49\x2d\xd6\xb7\x03\x00";
    for (name, bytes) in [("cut.rou.xml.gz", &whole[..14]), ("plain.rou.xml.gz", b"<routes/>")] {
        std::fs::write(workplace.path().join(name), bytes).unwrap();
        let said = simulate(&workplace, name, &[]);
        assert_says(
            &said,
            &[
                "grid.sumocfg",
                "line 4",
                "route-files",
                name,
                "cannot be unpacked",
                "gzip -t",
            ],
        );
    }
}

#[test]
fn no_vehicles() {
    let workplace = Workplace::new();
    scenario(&workplace, "<routes/>");
    let said = simulate(&workplace, "grid.rou.xml", &[]);
    assert_says(
        &said,
        &["traffic-bridge", "grid.sumocfg", "no road user departed", "route-files"],
    );
}

#[test]
fn more_vehicles_than_shared_memory_has_room_for() {
    let workplace = Workplace::new();
    // The two directions of all twelve roads of the grid, six vehicles on each.
    let roads: Vec<String> = [
        "A0A1", "A1A2", "B0B1", "B1B2", "C0C1", "C1C2", "A0B0", "B0C0", "A1B1", "B1C1", "A2B2", "B2C2",
    ]
    .iter()
    .flat_map(|road| [(*road).to_owned(), format!("{}{}", &road[2..], &road[..2])])
    .collect();
    let vehicles: String = (0..6 * roads.len())
        .map(|number| {
            let road = &roads[number % roads.len()];
            format!("  <vehicle id=\"{number}\" depart=\"0\" departPos=\"random_free\"><route edges=\"{road}\"/></vehicle>\n")
        })
        .collect();
    scenario(&workplace, &format!("<routes>\n{vehicles}</routes>\n"));
    let said = simulate(&workplace, "grid.rou.xml", &["--set", "traffic.max_road_users=52"]);
    assert_says(
        &said,
        &["traffic", "`traffic.max_road_users` (now 52)", "fewer road users"],
    );
}

#[test]
fn a_region_with_impossible_corners() {
    let workplace = Workplace::new();
    for (text, says) in [
        (
            "polygon_m = [\"0 0\", \"10 zero\", \"10 10\"]",
            "\"10 zero\" is no corner",
        ),
        ("polygon_m = [\"0 0\", \"10 0\"]", "has 2 corners"),
        (
            "polygon_m = [\"0 0\", \"10 0\", \"0 10\"]\nradius_m = 5.0",
            "are two regions",
        ),
    ] {
        workplace.write("my.toml", &format!("[region]\n{text}\n"));
        assert_says(&refused(&workplace, &["train", "my.toml"], 2), &["my.toml:2", says]);
    }
}

#[test]
fn missing_route_file() {
    let workplace = Workplace::new();
    scenario(&workplace, "<routes/>");
    std::fs::remove_file(workplace.path().join("grid.rou.xml")).unwrap();
    let said = refused(&workplace, &["simulate", "grid.sumocfg"], 2);
    assert_says(&said, &["grid.sumocfg", "line 4", "route-files", "grid.rou.xml"]);
}

#[test]
fn port_in_use() {
    let workplace = Workplace::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let listen = format!("fanout.listen=tcp/{}", taken.local_addr().unwrap());
    let said = refused(&workplace, &["train", "--set", &listen], 2);
    assert_says(&said, &["`fanout.listen`", "cannot be listened on", "choose another"]);
}

#[test]
fn run_name_in_use() {
    let workplace = Workplace::new();
    std::fs::create_dir_all(workplace.path().join("runs/mine")).unwrap();
    let said = refused(
        &workplace,
        &["train", "--name", "mine", "--set", "fanout.enabled=false"],
        2,
    );
    assert_says(&said, &["the run name `mine` is in use", "--name"]);
    let said = refused(
        &workplace,
        &["train", "--name", "no good", "--set", "fanout.enabled=false"],
        2,
    );
    assert_says(&said, &["the run name `no good` cannot be used"]);
}

#[test]
fn shared_memory_too_small() {
    let workplace = Workplace::new();
    let said = refused(
        &workplace,
        &[
            "train",
            "--set",
            "traffic.max_road_users=1000000",
            "--set",
            "run.window_ticks=256",
            "--set",
            "fanout.enabled=false",
        ],
        3,
    );
    assert_says(&said, &["/dev/shm has", "MiB free", "`traffic.max_road_users`"]);
    assert!(
        std::fs::read_dir(workplace.path().join("runs"))
            .unwrap()
            .next()
            .is_none(),
        "a run directory was left"
    );
}

#[test]
fn commands_to_a_run_that_is_not_alive() {
    let workplace = Workplace::new();
    assert_says(
        &refused(&workplace, &["stop"], 2),
        &["no run is alive", "caraware train"],
    );
    assert_says(
        &refused(&workplace, &["ps", "ghost"], 2),
        &["no run named `ghost` is alive"],
    );
}

#[test]
fn a_reader_that_closes_the_pipe_is_no_error() {
    let workplace = Workplace::new();
    for arguments in [&["ps"][..], &["keys"], &["doctor"], &["--help"]] {
        let (reader, writer) = std::io::pipe().unwrap();
        // As `caraware ps | head -0` does, but for certain before the first line.
        drop(reader);
        let output = workplace
            .command(arguments)
            .stdout(writer)
            .stderr(Stdio::piped())
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(
            output.status.code().is_some_and(|code| code < 2),
            "{arguments:?}: {:?} {said}",
            output.status
        );
        assert!(!said.contains("panicked"), "{arguments:?}: {said}");
    }
}

#[test]
fn missing_or_unusable_map_of_a_curriculum() {
    let workplace = Workplace::new();
    let steps = "curriculum.stages=[{cavs=1,until_lessons=1},{cavs=1,maps=[\"city\"]}]";
    let missing = "curriculum.maps=[\"town\",\"city.net.xml\"]";
    let said = refused(&workplace, &["simulate", "paper", "--set", missing, "--set", steps], 2);
    assert_says(
        &said,
        &[
            "`curriculum.maps` has \"city.net.xml\", but",
            "is not a file",
            "relative to the directory",
        ],
    );
    assert!(!workplace.path().join("runs").exists());

    let net = [
        "--grid",
        "--grid.number",
        "4",
        "--default.disallow",
        "pedestrian",
        "-o",
        "city.net.xml",
    ];
    tool(&sumo_program("netgenerate"), &net, workplace.path());
    let command = ["simulate", "paper", "--set", missing, "--set", steps];
    let said = refused(&workplace, &command, 2);
    assert_says(&said, &["city.net.xml", "has no projection", "map.origin_latitude_deg"]);
    // The city has no sidewalks. The first stage is on the town, but every map is checked before the run begins.
    let more = [
        "map.origin_latitude_deg=52.0",
        "map.origin_longitude_deg=10.0",
        "traffic.pedestrians=2",
        "episode.training_episodes=4",
    ];
    let more: Vec<&str> = more.into_iter().flat_map(|setting| ["--set", setting]).collect();
    let said = refused(&workplace, &[&command[..], &more].concat(), 2);
    assert_says(&said, &["city.net.xml has too few connected edges for pedestrian"]);
    workplace.write(
        "a.sumocfg",
        "<configuration><input><net-file value=\"city.net.xml\"/></input></configuration>",
    );
    let scenario = ["simulate", "a.sumocfg", "--set", "curriculum.stages=[{cavs=1}]"];
    let said = refused(&workplace, &scenario, 2);
    assert_says(
        &said,
        &["a .sumocfg has its own", "name the .sumocfg in curriculum.maps"],
    );
    // The number of vehicles is the scenario's own; the message names the keys that change their sensors.
    let said = refused(&workplace, &["simulate", "a.sumocfg", "--set", "traffic.cavs=8"], 2);
    assert_says(&said, &["a.sumocfg has its own road users", "traffic.max_cavs"]);
}
