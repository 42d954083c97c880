//! Who has right of way on a hero's route, where no traffic light decides.

use std::collections::{BTreeMap, BTreeSet};

use crate::support::Bench;
use ipc_schema::{
    config::HeroDriver,
    traffic::{Kind, ON_EDGE, RIGHT_OF_WAY, YIELDS},
};
use traffic_bridge::{heroes::take_over, sumo::frame::TrafficFrame};

/// Two edges of the town and the way between them. All of these ways lead over zebra crossings, which SUMO counts as foes.
const WAYS: [(&str, u32); 6] = [
    // Along the ring, past a side street; and off it to the right.
    ("ring_west_3 ring_north_1", RIGHT_OF_WAY),
    ("ring_west_2 mill", RIGHT_OF_WAY),
    // Off the ring to the left, before what comes towards it; and out of a side street.
    ("-ring_west_3 mill", YIELDS),
    ("school -ring_north_2", YIELDS),
    // Right before left: to the right nobody comes from the right; straight on, baker street does.
    ("church_1 baker", RIGHT_OF_WAY),
    ("church_1 church_2", YIELDS),
];

#[test]
fn a_way_that_gives_way_to_people_alone_has_right_of_way_among_vehicles() {
    let bench = Bench::new();
    let names: Vec<String> = (0..WAYS.len()).map(|number| number.to_string()).collect();
    let heroes: Vec<(&str, f64, &str)> = names
        .iter()
        .zip(WAYS)
        .map(|(id, (edges, _))| (id.as_str(), 0.0, edges))
        .collect();
    let mut sumo = bench.town_of_heroes(&heroes);
    let (mut frame, mut ids) = (TrafficFrame::default(), BTreeMap::new());
    let mut found: BTreeMap<String, BTreeSet<u32>> = BTreeMap::new();
    while found.len() < WAYS.len() {
        assert!(sumo.time_s().unwrap() < 60.0, "all depart: {found:?}");
        sumo.step(&mut frame).unwrap();
        for event in frame.events.iter().filter(|event| event.kind == Kind::Hero as u32) {
            ids.insert(event.vehicle, event.id_text());
        }
        for point in take_over(&mut sumo, &frame, HeroDriver::Sumo, false).unwrap() {
            found.entry(ids[&point.vehicle].clone()).or_default().insert(point.way);
        }
    }
    for (number, (edges, way)) in WAYS.iter().enumerate() {
        assert_eq!(found[&number.to_string()], BTreeSet::from([ON_EDGE, *way]), "{edges}");
    }
    sumo.close().unwrap();
}
