//! The mirror on nets with netconvert's defaults: every vehicle class of SUMO from rest to its top speed and back, and a grid's corners.

use std::fmt::Write as _;

use crate::common::{Workplace, sumo_program, tool};
use ipc_schema::traffic::VEHICLE_CLASSES;

/// A straight road for each class: 8.5 km without a speed limit, then 600 m at walking pace.
fn write_scenario(workplace: &Workplace, step_s: f64) {
    let (mut nodes, mut edges, mut routes) = (String::new(), String::new(), String::new());
    let classes = VEHICLE_CLASSES.iter().filter(|class| **class != "pedestrian");
    for (road, class) in classes.clone().enumerate() {
        let y = 60 * road;
        for (place, x) in [0, 500, 8500, 9100].into_iter().enumerate() {
            writeln!(nodes, "<node id=\"n{road}_{place}\" x=\"{x}\" y=\"{y}\"/>").unwrap();
        }
        for (place, speed) in [100, 100, 2].into_iter().enumerate() {
            let ends = format!("from=\"n{road}_{place}\" to=\"n{road}_{}\"", place + 1);
            writeln!(
                edges,
                "<edge id=\"e{road}_{place}\" {ends} numLanes=\"1\" speed=\"{speed}\"/>"
            )
            .unwrap();
        }
        writeln!(routes, "<vType id=\"{class}\" vClass=\"{class}\"/>").unwrap();
    }
    for (road, class) in classes.enumerate() {
        let edges = format!("e{road}_0 e{road}_1 e{road}_2");
        writeln!(
            routes,
            "<vehicle id=\"{class}\" type=\"{class}\" depart=\"0\" departSpeed=\"0\"><route edges=\"{edges}\"/></vehicle>"
        )
        .unwrap();
    }
    workplace.write("n.nod.xml", &format!("<nodes>{nodes}</nodes>"));
    workplace.write("n.edg.xml", &format!("<edges>{edges}</edges>"));
    workplace.write("n.rou.xml", &format!("<routes>{routes}</routes>"));
    let arguments = ["-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"];
    tool(&sumo_program("netconvert"), &arguments, workplace.path());
    let input = "<net-file value=\"n.net.xml\"/><route-files value=\"n.rou.xml\"/>";
    let time = format!("<time><end value=\"700\"/><step-length value=\"{step_s}\"/></time>");
    workplace.write(
        "n.sumocfg",
        &format!("<configuration><input>{input}</input>{time}</configuration>"),
    );
}

/// One vehicle may be set onto SUMO, once: SUMO's motorcycle brakes at 10 m/s² from 55 m/s, which no tyre holds, and
/// the mirror does not see a slower road ahead.
#[test]
fn every_class_is_followed_from_rest_to_its_top_speed_and_back() {
    for step_s in [0.1, 1.0] {
        let workplace = Workplace::new();
        write_scenario(&workplace, step_s);
        let settings = [
            "fanout.enabled=false",
            "map.origin_latitude_deg=52",
            "map.origin_longitude_deg=10",
        ];
        let settings = settings.iter().flat_map(|setting| ["--set", *setting]);
        let arguments: Vec<&str> = ["simulate", "n.sumocfg", "--name", "classes"]
            .into_iter()
            .chain(settings)
            .collect();
        workplace.succeed(&arguments);
        let dynamics = &workplace.report("classes")["dynamics"];
        let set = dynamics["resynchronisations"].as_u64().unwrap();
        assert!(set <= 1, "steps of {step_s} s: {dynamics:#}");
        let usual_m = dynamics["tracking"]["longitudinal"]["p999_m"].as_f64().unwrap();
        assert!(usual_m <= 0.6, "steps of {step_s} s: {dynamics:#}");
        assert!(dynamics["tracking"]["samples"].as_u64().unwrap() > 33 * 2_000);
    }
}

/// The corners of a net that was not drawn for the mirror: without a preview it runs wide there and is set back.
#[test]
fn with_a_preview_no_vehicle_on_a_default_grid_is_set_onto_sumo() {
    let workplace = Workplace::new();
    let grid = [
        "--grid",
        "--grid.number",
        "4",
        "--no-turnarounds",
        "--seed",
        "3",
        "-o",
        "g.net.xml",
    ];
    tool(&sumo_program("netgenerate"), &grid, workplace.path());
    let routes = [
        "A0A1 A1B1 B1B2 B2C2 C2C3",
        "D3C3 C3C2 C2B2 B2B1 B1A1",
        "C0C1 C1B1 B1B2 B2A2",
        "A3B3 B3B2 B2C2 C2C1 C1D1",
    ];
    let vehicles: String = (0..60)
        .zip(routes.iter().cycle())
        .map(|(index, edges)| {
            let depart = 2 * index;
            format!(
                "<vehicle id=\"{index}\" depart=\"{depart}\" departSpeed=\"max\"><route edges=\"{edges}\"/></vehicle>"
            )
        })
        .collect();
    workplace.write("g.rou.xml", &format!("<routes>{vehicles}</routes>"));
    let input = "<net-file value=\"g.net.xml\"/><route-files value=\"g.rou.xml\"/>";
    let time = "<time><end value=\"180\"/><step-length value=\"0.1\"/></time>";
    workplace.write(
        "g.sumocfg",
        &format!("<configuration><input>{input}</input>{time}</configuration>"),
    );
    let run = |name: &str, more: &[&'static str]| {
        let settings = [
            "fanout.enabled=false",
            "collision.detect=true",
            "map.origin_latitude_deg=52",
            "map.origin_longitude_deg=10",
        ];
        let settings = settings.iter().chain(more).flat_map(|setting| ["--set", *setting]);
        let arguments: Vec<&str> = ["simulate", "g.sumocfg", "--name", name]
            .into_iter()
            .chain(settings)
            .collect();
        workplace.succeed(&arguments);
        workplace.report(name)["dynamics"].clone()
    };
    let without = run("without", &["vehicle.preview_s=0"]);
    // A scenario has a preview by default.
    let with = run("with", &[]);
    // Otherwise the net would show nothing.
    assert!(without["resynchronisations"].as_u64().unwrap() > 0, "{without:#}");
    // Each has its line, and is counted by class and cause.
    let lines = std::fs::read_to_string(workplace.path().join("runs/without/events/resynchronisations.jsonl")).unwrap();
    let mut counted = serde_json::Map::new();
    for line in lines.lines() {
        let line: serde_json::Value = serde_json::from_str(line).unwrap();
        assert_eq!(line["class"], "passenger", "{line}");
        assert!(line["jump_m"].as_f64().unwrap() > 1.0, "{line}");
        let count = counted.entry(line["cause"].as_str().unwrap()).or_insert(0.into());
        *count = (count.as_u64().unwrap() + 1).into();
    }
    assert_eq!(without["resynchronisations"], lines.lines().count(), "{without:#}");
    assert_eq!(
        without["resynchronisation_causes"]["passenger"],
        serde_json::Value::Object(counted)
    );
    // It brakes before the corners and stays in its lane: a reference that left it would meet oncoming traffic.
    let farthest_m =
        |dynamics: &serde_json::Value| dynamics["tracking"]["reference_from_sumo"]["max_m"].as_f64().unwrap();
    assert!(farthest_m(&without) > 3.0, "{without:#}");
    for dynamics in [&with, &run("slow", &["traffic.step_s=1"])] {
        assert_eq!(dynamics["resynchronisations"], 0, "{dynamics:#}");
        assert_eq!(dynamics["collisions"]["vehicle"], 0, "{dynamics:#}");
        assert!(farthest_m(dynamics) < 1.2, "{dynamics:#}");
    }
}

/// Netgenerate's defaults: vehicles turn back on 2 m, change lanes in standing queues, and drive on the left.
#[test]
fn with_a_preview_vehicles_are_led_where_they_cannot_drive() {
    let workplace = Workplace::new();
    let nets: [(&str, &[&str], &str); 2] = [
        ("turnarounds", &["--seed", "3"], "A0A1 A1A0 A0B0 B0B1 B1B0 B0A0 A0A1"),
        ("left", &["--lefthand", "-L", "2"], "C2C1 C1B1 B1B0 B0B1 B1C1 C1C2"),
    ];
    for (name, options, edges) in nets {
        let net = format!("{name}.net.xml");
        let grid = ["--grid", "--grid.number", "3", "-o", &net];
        tool(
            &sumo_program("netgenerate"),
            &[&grid[..], options].concat(),
            workplace.path(),
        );
        let flow = format!("<flow id=\"f\" begin=\"0\" end=\"90\" period=\"3\"><route edges=\"{edges}\"/></flow>");
        workplace.write("r.rou.xml", &format!("<routes>{flow}</routes>"));
        let input = format!("<net-file value=\"{net}\"/><route-files value=\"r.rou.xml\"/>");
        let time = "<time><end value=\"120\"/><step-length value=\"0.1\"/></time>";
        workplace.write(
            "s.sumocfg",
            &format!("<configuration><input>{input}</input>{time}</configuration>"),
        );
        let settings = [
            "fanout.enabled=false",
            "map.origin_latitude_deg=52",
            "map.origin_longitude_deg=10",
        ];
        let settings = settings.iter().flat_map(|setting| ["--set", *setting]);
        let arguments: Vec<&str> = ["simulate", "s.sumocfg", "--name", name]
            .into_iter()
            .chain(settings)
            .collect();
        workplace.succeed(&arguments);
        let dynamics = workplace.report(name)["dynamics"].clone();
        assert_eq!(dynamics["resynchronisations"], 0, "{name}: {dynamics:#}");
        let causes = &dynamics["guidance_causes"]["passenger"];
        assert!(causes["narrow_turn"].as_u64().unwrap() > 10, "{name}: {dynamics:#}");
        let lines = workplace.path().join("runs").join(name).join("events/guidances.jsonl");
        let lines = std::fs::read_to_string(lines).unwrap();
        let total: u64 = causes
            .as_object()
            .unwrap()
            .values()
            .map(|count| count.as_u64().unwrap())
            .sum();
        assert_eq!(total, lines.lines().count() as u64, "{name}");
        for axis in ["lateral", "longitudinal"] {
            let worst_m = dynamics["tracking"][axis]["max_m"].as_f64().unwrap();
            assert!(worst_m < 1.0, "{name}: {axis} {worst_m} m");
        }
    }
}

/// Trips between roads of a grid of `side` junctions that are drawn by a fixed rule, one every 0.6 s.
fn grid_trips(side: u32, count: u32) -> String {
    let name = |place: u32| {
        format!(
            "{}{}",
            char::from(b'A' + u8::try_from(place % side).unwrap()),
            place / side
        )
    };
    let roads: Vec<String> = (0..side * side)
        .flat_map(|place| {
            let east = (place % side + 1 < side).then_some(place + 1);
            let north = (place / side + 1 < side).then_some(place + side);
            [east, north].into_iter().flatten().map(move |next| (place, next))
        })
        .flat_map(|(a, b)| [format!("{}{}", name(a), name(b)), format!("{}{}", name(b), name(a))])
        .collect();
    let mut drawn = 1_u64;
    let mut draw = || {
        drawn = drawn
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        &roads[usize::try_from(drawn >> 33).unwrap() % roads.len()]
    };
    let mut trips = String::new();
    for trip in 0..count {
        let (from, to, depart) = (draw(), draw(), f64::from(trip) * 0.6);
        writeln!(
            trips,
            "<trip id=\"{trip}\" depart=\"{depart:.1}\" from=\"{from}\" to=\"{to}\"/>"
        )
        .unwrap();
    }
    trips
}

/// Corners, queues and turnarounds as netgenerate makes them. A mirror that cuts a corner touches who waits for a turnaround there.
#[test]
fn mirrors_do_not_touch_where_sumo_has_them_apart() {
    let workplace = Workplace::new();
    let grid = [
        "--grid",
        "--grid.number",
        "4",
        "--grid.length",
        "100",
        "-o",
        "d.net.xml",
    ];
    tool(&sumo_program("netgenerate"), &grid, workplace.path());
    workplace.write("d.rou.xml", &format!("<routes>{}</routes>", grid_trips(4, 300)));
    for (name, step_s) in [("tenths", 0.1), ("seconds", 1.0)] {
        let input = "<net-file value=\"d.net.xml\"/><route-files value=\"d.rou.xml\"/>";
        let time = format!("<time><end value=\"240\"/><step-length value=\"{step_s}\"/></time>");
        workplace.write(
            "d.sumocfg",
            &format!("<configuration><input>{input}</input>{time}</configuration>"),
        );
        let settings = [
            "fanout.enabled=false",
            "collision.detect=true",
            "map.origin_latitude_deg=52",
            "map.origin_longitude_deg=10",
        ];
        let settings = settings.iter().flat_map(|setting| ["--set", *setting]);
        let arguments: Vec<&str> = ["simulate", "d.sumocfg", "--name", name]
            .into_iter()
            .chain(settings)
            .collect();
        workplace.succeed(&arguments);
        let dynamics = &workplace.report(name)["dynamics"];
        assert!(dynamics["vehicle_steps"].as_u64().unwrap() > 80_000, "{dynamics:#}");
        assert_eq!(dynamics["resynchronisations"], 0, "{dynamics:#}");
        let contacts = &dynamics["collisions"];
        let own: u64 = contacts["own"]
            .as_object()
            .unwrap()
            .values()
            .map(|count| count.as_u64().unwrap())
            .sum();
        let of_sumo = contacts["vehicle_in_sumo"].as_u64().unwrap();
        assert_eq!(contacts["vehicle"], own + of_sumo, "{contacts:#}");
        assert_eq!(own, 0, "{contacts:#}");
    }
}
