//! Scenarios from maps: the extract of OpenStreetMap in SUMO's wheel (the Spreewaldring, © OpenStreetMap contributors, ODbL), and the same
//! roads as OpenDRIVE.

use crate::common::{Workplace, sumo_program, text, tool};
use caraware::install::Install;

const TRAFFIC: [&str; 4] = ["--duration-s", "60", "--demand", "20"];

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
        let text = std::fs::read_to_string(path).unwrap();
        text.split_once("<routes ").unwrap().1.to_owned()
    };
    assert_eq!(trips("quarter"), trips("again"));

    let quiet = ["--set", "fanout.enabled=false"];
    // Viewers get the chart of the scene, so this run has its fan-out.
    workplace.succeed(&["simulate", "quarter/city.sumocfg", "--end", "20", "--name", "quarter"]);
    let report = workplace.report("quarter");
    assert!(report["vehicles"].as_u64() > Some(0), "{report:#}");
    let chart = std::fs::read_to_string(workplace.path().join("runs/quarter/map/chart.json")).unwrap();
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
    for (file, part) in [
        ("broken.osm", "netconvert failed"),
        ("road.osm.pbf", "osmium cat"),
        ("none.osm", "No such file"),
    ] {
        let output = workplace.run(&["import", file, "out"]);
        let said = text(&output);
        assert!(!output.status.success() && said.contains(part), "{file}: {said}");
    }
}
