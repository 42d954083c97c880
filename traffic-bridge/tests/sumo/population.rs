//! Population control with real SUMO.

use std::collections::BTreeSet;

use crate::support::{Bench, run, sumo_home};
use ipc_schema::traffic::{Kind, MetaEvent};
use traffic_bridge::{
    population::{HeroRoutes, Population, PopulationSize},
    sumo::{Sumo, error::SumoError, options::SumoOptions},
};

const SIZE: PopulationSize = PopulationSize {
    cavs: 24,
    others: 12,
    heroes: 0,
    pedestrians: 10,
};
const STEP_S: f64 = 0.1;

fn options(bench: &Bench, seed: u64) -> SumoOptions {
    SumoOptions::population(&sumo_home(), &bench.grid(), &[], STEP_S, seed).unwrap()
}

/// All bytes of all frames of an episode, and the first positions of connected vehicles.
fn episode(sumo: &mut Sumo, seed: u64, steps: usize) -> (Vec<u8>, Vec<(i64, i64)>) {
    let mut population = Population::start(sumo, SIZE, HeroRoutes::default(), seed).unwrap();
    let (mut bytes, mut places) = (Vec::new(), Vec::new());
    run(sumo, steps, |sumo, frame| {
        bytes.extend_from_slice(bytemuck::cast_slice(&frame.states));
        bytes.extend_from_slice(bytemuck::cast_slice(&frame.events));
        if frame.step == 2 {
            #[expect(clippy::cast_possible_truncation, reason = "centimetres")]
            let place = |x: f64| (x * 100.0) as i64;
            let cavs = frame.states.iter().filter(|state| state.kind == Kind::Cav as u32);
            places = cavs
                .map(|state| (place(state.front_x_m), place(state.front_y_m)))
                .collect();
        }
        population.after_step(sumo, frame).unwrap();
    });
    (bytes, places)
}

#[test]
fn an_episode_on_a_map_does_not_depend_on_the_map_before() {
    let bench = Bench::new();
    let (town_net, types) = bench.town();
    let town = |seed| SumoOptions::population(&sumo_home(), &town_net, &types, STEP_S, seed).unwrap();
    let mut sumo = Sumo::start(options(&bench, 7)).unwrap();
    let (grid_before, _) = episode(&mut sumo, 7, 300);
    sumo = sumo.reload(town(8)).unwrap();
    let (after_the_grid, _) = episode(&mut sumo, 8, 300);
    sumo = sumo.reload(options(&bench, 7)).unwrap();
    let (grid_after, _) = episode(&mut sumo, 7, 300);
    sumo.close().unwrap();
    let mut fresh = Sumo::start(town(8)).unwrap();
    let (alone, _) = episode(&mut fresh, 8, 300);
    assert!(after_the_grid == alone);
    assert!(grid_before == grid_after);
    assert!(alone != grid_before);
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_does_not() {
    let bench = Bench::new();
    let mut sumo = Sumo::start(options(&bench, 7)).unwrap();
    let (first, places) = episode(&mut sumo, 7, 600);
    sumo = sumo.reload(options(&bench, 8)).unwrap();
    let (other, other_places) = episode(&mut sumo, 8, 600);
    sumo = sumo.reload(options(&bench, 7)).unwrap();
    let (again, _) = episode(&mut sumo, 7, 600);
    sumo.close().unwrap();
    let mut fresh = Sumo::start(options(&bench, 7)).unwrap();
    let (restarted, _) = episode(&mut fresh, 7, 600);
    assert!(first == again, "an episode does not depend on those before it");
    assert!(first == restarted);
    assert!(first != other);
    let shared = places.iter().filter(|place| other_places.contains(place)).count();
    assert_eq!(shared, 0, "a new episode begins at new places");
}

#[test]
fn the_population_keeps_its_size() {
    let bench = Bench::new();
    let mut sumo = Sumo::start(options(&bench, 3)).unwrap();
    let mut population = Population::start(&mut sumo, SIZE, HeroRoutes::default(), 3).unwrap();
    let (mut arrived, mut edges_of_time) = (0, BTreeSet::new());
    run(&mut sumo, 6000, |sumo, frame| {
        let alive = |kind: Kind| frame.states.iter().filter(|state| state.kind == kind as u32).count();
        if frame.step >= 20 {
            assert_eq!(alive(Kind::Cav), 24, "at {} s", frame.time_s);
            assert_eq!(frame.cavs, 24);
            assert_eq!(alive(Kind::Other), 12, "at {} s", frame.time_s);
            assert_eq!(alive(Kind::Person), 10, "at {} s", frame.time_s);
        }
        arrived += frame
            .events
            .iter()
            .filter(|event| event.event == MetaEvent::Arrived as u32)
            .count();
        if frame.step % 500 == 0 {
            #[expect(clippy::cast_possible_truncation, reason = "blocks of the grid")]
            edges_of_time.extend(
                frame
                    .states
                    .iter()
                    .map(|s| ((s.front_x_m / 100.0) as i32, (s.front_y_m / 100.0) as i32)),
            );
        }
        population.after_step(sumo, frame).unwrap();
    });
    assert_eq!(arrived, 0, "routes are prolonged in time");
    assert!(
        edges_of_time.len() >= 20,
        "traffic covers the net: {}",
        edges_of_time.len()
    );
}

#[test]
fn a_vehicle_that_leaves_is_replaced() {
    let bench = Bench::new();
    let net = bench.grid();
    // On these edges SUMO ends the route of every vehicle.
    let text = "<additional><rerouter id=\"end\" edges=\"B1C1 C3B3 D2D1\"><interval begin=\"0\" end=\"1e6\">\
                <destProbReroute id=\"terminateRoute\"/></interval></rerouter></additional>";
    let additional = bench.file("end.add.xml", text);
    let options = SumoOptions::population(&sumo_home(), &net, &[additional], STEP_S, 3).unwrap();
    let mut sumo = Sumo::start(options).unwrap();
    let mut population = Population::start(&mut sumo, SIZE, HeroRoutes::default(), 3).unwrap();
    let (mut arrived, mut names) = (0, BTreeSet::new());
    run(&mut sumo, 3000, |sumo, frame| {
        arrived += frame
            .events
            .iter()
            .filter(|event| event.event == MetaEvent::Arrived as u32)
            .count();
        names.extend(frame.events.iter().map(|event| event.id_text()));
        // After each step at most a few vehicles have left whose replacements have not departed.
        assert!(
            frame.step < 20 || frame.cavs >= 20,
            "{} at {} s",
            frame.cavs,
            frame.time_s
        );
        population.after_step(sumo, frame).unwrap();
    });
    assert!(arrived >= 20, "{arrived}");
    assert!(names.contains("cav.24"), "a successor has a new name");
}

#[test]
fn a_crowd_finds_room() {
    let bench = Bench::new();
    let mut sumo = Sumo::start(options(&bench, 3)).unwrap();
    let crowd = PopulationSize {
        cavs: 400,
        others: 0,
        heroes: 0,
        pedestrians: 0,
    };
    let mut population = Population::start(&mut sumo, crowd, HeroRoutes::default(), 3).unwrap();
    let mut cavs = 0;
    // One vehicle to 20 m of lane: a vehicle that finds no room where it should start is added elsewhere.
    run(&mut sumo, 100, |sumo, frame| {
        population.after_step(sumo, frame).unwrap();
        cavs = frame.cavs;
    });
    assert!(cavs >= 396, "{cavs} of 400 after ten seconds");
}

#[test]
fn a_net_without_sidewalks_refuses_pedestrians() {
    let bench = Bench::new();
    let net = bench.file("road.net.xml", ONE_WAY);
    let start = |size| {
        let options = SumoOptions::population(&sumo_home(), &net, &[], STEP_S, 1).unwrap();
        let mut sumo = Sumo::start(options).unwrap();
        Population::start(&mut sumo, size, HeroRoutes::default(), 1).unwrap_err()
    };
    for (size, class) in [
        (
            PopulationSize {
                cavs: 1,
                others: 0,
                heroes: 0,
                pedestrians: 0,
            },
            "passenger",
        ),
        (
            PopulationSize {
                cavs: 0,
                others: 0,
                heroes: 0,
                pedestrians: 1,
            },
            "pedestrian",
        ),
    ] {
        let error = start(size);
        assert!(
            matches!(&error, SumoError::NoRoads { class: found, .. } if found == class),
            "{error}"
        );
        assert!(error.to_string().contains("road.net.xml"));
    }
}

/// One road from west to east, for cars only.
const ONE_WAY: &str = r#"<net version="1.20">
<location netOffset="0.00,0.00" convBoundary="0.00,0.00,100.00,0.00" origBoundary="0.00,0.00,100.00,0.00" projParameter="!"/>
<edge id="a" from="w" to="e" priority="-1"><lane id="a_0" index="0" disallow="pedestrian" speed="13.89" length="100.00" shape="0.00,-1.60 100.00,-1.60"/></edge>
<junction id="e" type="dead_end" x="100.00" y="0.00" incLanes="a_0" intLanes="" shape="100.00,-3.20 100.00,0.00"/>
<junction id="w" type="dead_end" x="0.00" y="0.00" incLanes="" intLanes="" shape="0.00,0.00 0.00,-3.20"/>
</net>"#;
