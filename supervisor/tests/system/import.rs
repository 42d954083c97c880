//! Scenarios from maps: the extract of OpenStreetMap in SUMO's wheel (the Spreewaldring, © OpenStreetMap contributors, ODbL), the same
//! extract as PBF (`supervisor/tests/data`), and the same roads as OpenDRIVE.

use std::{fs, path::Path, process::Stdio};

use crate::common::{Workplace, sumo_program, text, tool, until};
use caraware::install::Install;
use rustix::process::{Pid, Signal, kill_process};

const TRAFFIC: [&str; 4] = ["--duration-s", "60", "--demand", "20"];
/// The extract of SUMO's wheel, packed.
const PACKED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/spreewaldring.osm.pbf");
/// What an import makes of the map itself.
const MAP_FILES: [&str; 6] = [
    "city.net.xml",
    "city.poly.xml",
    "passenger.rou.xml",
    "bicycle.rou.xml",
    "pedestrian.rou.xml",
    "city.sumocfg",
];

#[test]
fn an_import_that_is_interrupted_leaves_nothing() {
    let workplace = Workplace::new();
    for (directory, is_there) in [("new", false), ("empty", true)] {
        let place = workplace.path().join(directory);
        if is_there {
            fs::create_dir(&place).unwrap();
        }
        let mut command = workplace.command(&["import", PACKED, directory]);
        let mut import = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        until(&mut import, "a file of the import", || {
            place.join("city.net.xml").exists().then_some(())
        });
        kill_process(Pid::from_child(&import), Signal::INT).unwrap();
        assert_eq!(import.wait().unwrap().code(), Some(130));
        let left =
            fs::read_dir(&place).map(|entries| entries.flatten().map(|entry| entry.file_name()).collect::<Vec<_>>());
        match is_there {
            true => assert!(left.unwrap().is_empty()),
            false => assert!(left.is_err(), "{left:?}"),
        }
    }
}

#[test]
fn a_quarter_of_openstreetmap_and_its_roads_in_opendrive_become_scenarios() {
    let workplace = Workplace::new();
    let map = Install::find()
        .unwrap()
        .sumo_home
        .join("tools/game/racing/spreewaldring.osm");
    let map = map.to_str().unwrap();
    let said = text(&workplace.succeed(&[&["import", map, "quarter"], &TRAFFIC[..]].concat()));
    for part in [
        "5.1 km of road",
        "3 buildings",
        "passenger",
        "bicycle",
        "pedestrian",
        "0 collisions",
        "5/5",
    ] {
        assert!(said.contains(part), "`{part}` is not in: {said}");
    }
    let command = said.lines().find_map(|line| line.strip_prefix("caraware ")).unwrap();
    assert_eq!(command, "simulate quarter/city.sumocfg --end 60");
    // The same map and seed make the same trips, in a directory of their own.
    let said = text(&workplace.run(&["import", map, "quarter"]));
    assert!(said.contains("is not empty"), "{said}");
    workplace.succeed(&[&["import", map, "again"], &TRAFFIC[..]].concat());
    let trips = |directory: &str| {
        let path = workplace.path().join(directory).join("passenger.rou.xml");
        let text = fs::read_to_string(path).unwrap();
        text.split_once("<routes ").unwrap().1.to_owned()
    };
    assert_eq!(trips("quarter"), trips("again"));

    let quiet = ["--set", "fanout.enabled=false"];
    // Viewers get the chart of the scene, so this run has its fan-out.
    workplace.succeed(&["simulate", "quarter/city.sumocfg", "--end", "20", "--name", "quarter"]);
    let report = workplace.report("quarter");
    assert!(report["vehicles"].as_u64() > Some(0), "{report:#}");
    let chart = fs::read_to_string(workplace.path().join("runs/quarter/map/chart.json")).unwrap();
    let chart: serde_json::Value = serde_json::from_str(&chart).unwrap();
    assert_eq!(
        chart["buildings"].as_array().unwrap().len(),
        3,
        "the buildings that viewers show"
    );
    let small = [
        "episode.training_episodes=1",
        "episode.ticks=150",
        "episode.evaluation_ticks=120",
        "episode.final_evaluations=1",
        "trainer.horizon=20",
        "trainer.batch_size=10",
        "trainer.supervised=false",
        "fanout.enabled=false",
    ];
    let small = small.iter().flat_map(|setting| ["--set", *setting]);
    let train: Vec<&str> = ["train", "quarter/city.sumocfg", "--name", "trained"]
        .into_iter()
        .chain(small)
        .collect();
    workplace.succeed(&train);
    assert!(workplace.report("trained")["trainer"]["updates"].as_u64() > Some(0));

    let export = ["-s", "quarter/city.net.xml", "--opendrive-output", "road.xodr"];
    tool(&sumo_program("netconvert"), &export, workplace.path());
    let said = text(&workplace.succeed(&[&["import", "road.xodr", "road"], &TRAFFIC[..]].concat()));
    assert!(said.contains("0 buildings") && said.contains("passenger"), "{said}");
    workplace.succeed(
        &[
            &["simulate", "road/city.sumocfg", "--end", "20", "--name", "road"],
            &quiet[..],
        ]
        .concat(),
    );
    assert!(workplace.report("road")["vehicles"].as_u64() > Some(0));
    workplace.assert_nothing_left();
}

#[test]
fn what_is_no_map_is_refused() {
    let workplace = Workplace::new();
    workplace.write("broken.osm", "<osm><node id=\"1\"");
    workplace.write("road.osm.pbf", "");
    workplace.write("road.net.xml", "<net/>");
    for (file, part) in [
        ("broken.osm", "netconvert failed"),
        ("road.osm.pbf", "road.osm.pbf is no PBF"),
        ("road.net.xml", ".osm.pbf"),
        ("none.osm", "No such file"),
        ("none.osm.pbf", "No such file"),
    ] {
        let output = workplace.run(&["import", file, "out"]);
        let said = text(&output);
        assert!(!output.status.success() && said.contains(part), "{file}: {said}");
    }
}

/// A file of the scenario without the comments of the tools that made it, which have the time and the paths.
fn without_comments(directory: &Path, file: &str) -> String {
    let mut text = fs::read_to_string(directory.join(file)).unwrap();
    while let Some((before, rest)) = text.split_once("<!--") {
        let (_, after) = rest.split_once("-->").unwrap();
        text = format!("{before}{after}");
    }
    text
}

#[test]
fn a_packed_map_becomes_the_same_scenario_as_its_xml() {
    let workplace = Workplace::new();
    let map = Install::find()
        .unwrap()
        .sumo_home
        .join("tools/game/racing/spreewaldring.osm");
    workplace.succeed(&[&["import", map.to_str().unwrap(), "plain"], &TRAFFIC[..]].concat());
    let said = text(&workplace.succeed(&[&["import", PACKED, "packed"], &TRAFFIC[..]].concat()));
    assert!(said.contains("1158 nodes, 46 ways, 7 relations"), "{said}");
    let world = ["--bbox", "-180,-90,180,90"];
    workplace.succeed(&[&["import", PACKED, "world"], &world[..], &TRAFFIC].concat());
    let [plain, packed, world] = ["plain", "packed", "world"].map(|name| workplace.path().join(name));
    for file in MAP_FILES {
        let expected = without_comments(&plain, file);
        assert!(expected.len() > 300, "{file}: {expected}");
        for directory in [&packed, &world] {
            assert!(
                without_comments(directory, file) == expected,
                "{file} of {}",
                directory.display()
            );
        }
    }
    // The XML between the two is not left.
    let names = |directory: &Path| {
        let entries = fs::read_dir(directory).unwrap();
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    };
    assert_eq!(names(&packed), names(&plain));
}

#[test]
fn a_part_of_a_packed_map_has_its_ways_whole() {
    let workplace = Workplace::new();
    let part = ["--bbox", "13.6875,51.995,13.6895,51.999"];
    let said = text(&workplace.succeed(&[&["import", PACKED, "part"], &part[..], &TRAFFIC].concat()));
    // Counted in the XML by a script of ten lines.
    assert!(said.contains("795 nodes, 24 ways, 2 relations"), "{said}");
    assert!(
        said.contains("3.3 km of road") && said.contains("1 buildings"),
        "{said}"
    );
    fs::copy(PACKED, workplace.path().join("map.osm.pbf")).unwrap();
    for (arguments, part) in [
        (["--bbox", "0,0,1,1"], "has no ways inside --bbox"),
        (["--bbox", "14,51,13,52"], "west must be less than east"),
        (["--bbox", "-200,51,13,52"], "-200 is not in"),
    ] {
        let output = workplace.run(&[&["import", "map.osm.pbf", "none"], &arguments[..]].concat());
        let said = text(&output);
        assert!(
            output.status.code() == Some(2) && said.contains(part),
            "{arguments:?}: {said}"
        );
    }
    workplace.write("road.xodr", "<OpenDRIVE/>");
    let output = workplace.run(&["import", "road.xodr", "none", "--bbox", "0,0,1,1"]);
    let said = text(&output);
    assert!(
        output.status.code() == Some(2) && said.contains("osmium extract"),
        "{said}"
    );
}

#[test]
fn a_damaged_packed_map_is_refused_and_leaves_nothing() {
    let workplace = Workplace::new();
    let packed = fs::read(PACKED).unwrap();
    let damaged = workplace.path().join("damaged.osm.pbf");
    let refused = |bytes: &[u8], what: &str| {
        fs::write(&damaged, bytes).unwrap();
        let output = workplace.run(&["import", "damaged.osm.pbf", "out"]);
        let said = text(&output);
        assert_eq!(output.status.code(), Some(2), "{what}: {said}");
        assert!(
            said.contains("damaged.osm.pbf") && said.contains("help: "),
            "{what}: {said}"
        );
        assert!(!said.contains("panicked"), "{what}: {said}");
        let left = fs::read_dir(workplace.path().join("out")).map_or(0, Iterator::count);
        assert_eq!(left, 0, "{what}");
    };
    let length = packed.len();
    for end in [
        0,
        1,
        3,
        4,
        20,
        100,
        length / 4,
        length / 2,
        length * 3 / 4,
        length - 200,
        length - 1,
    ] {
        refused(&packed[..end], &format!("the first {end} bytes"));
    }
    for at in [0, 3, 5, 8, 30, 100, length / 3, length / 2, length * 2 / 3, length - 1] {
        let mut flipped = packed.clone();
        flipped[at] ^= 4;
        refused(&flipped, &format!("bit 2 of byte {at}"));
    }
    refused(b"This is no map but a text, which has a wrong name.\n", "a text");
}
