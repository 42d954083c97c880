//! What a stage of a driver's curriculum changes in SUMO: left turns, traffic lights, speed limits.

use std::collections::BTreeMap;

use crate::support::{Bench, run, sumo_home};
use ipc_schema::{
    config::{HeroDriver, HeroTurns},
    traffic::{Kind, ON_EDGE, RoutePoint},
};
use traffic_bridge::{
    heroes,
    population::{HeroRoutes, Population, PopulationSize},
    sumo::{Sumo, options::SumoOptions},
};

const SIZE: PopulationSize = PopulationSize {
    cavs: 0,
    others: 10,
    heroes: 20,
    pedestrians: 0,
};
const STEP_S: f64 = 0.1;

fn options(bench: &Bench) -> SumoOptions {
    SumoOptions::population(&sumo_home(), &bench.signalled_grid(4), &[], STEP_S, 1).unwrap()
}

/// Routes of all heroes that depart within six seconds.
fn routes(sumo: &mut Sumo, turns: HeroTurns) -> BTreeMap<u32, Vec<RoutePoint>> {
    let heroes = HeroRoutes {
        turns,
        ..HeroRoutes::default()
    };
    let mut population = Population::start(sumo, SIZE, heroes, 5).unwrap();
    let mut routes: BTreeMap<u32, Vec<RoutePoint>> = BTreeMap::new();
    run(sumo, 60, |sumo, frame| {
        for point in heroes::take_over(sumo, frame, HeroDriver::Sumo, false).unwrap() {
            routes.entry(point.vehicle).or_default().push(point);
        }
        population.after_step(sumo, frame).unwrap();
    });
    routes
}

/// Angles by which a route turns from one street to the next, to the left, radians.
fn turns(route: &[RoutePoint]) -> Vec<f64> {
    let on_edges = route.windows(2).filter(|pair| pair[0].way == ON_EDGE);
    let headings: Vec<f64> = on_edges
        .map(|pair| (pair[1].y_m - pair[0].y_m).atan2(pair[1].x_m - pair[0].x_m))
        .collect();
    let changes = headings.windows(2).map(|pair| pair[1] - pair[0]);
    changes.map(|change| change.sin().atan2(change.cos())).collect()
}

#[test]
fn heroes_that_are_to_turn_left_do() {
    let bench = Bench::new();
    let mut sumo = Sumo::start(options(&bench)).unwrap();
    let any = routes(&mut sumo, HeroTurns::Any);
    let mut sumo = sumo.reload(options(&bench)).unwrap();
    let left = routes(&mut sumo, HeroTurns::Left);
    sumo.close().unwrap();
    let turns_left = |route: &Vec<RoutePoint>| turns(route).into_iter().any(|angle| angle > 0.8);
    let share = |routes: &BTreeMap<u32, Vec<RoutePoint>>| {
        let count = routes.values().filter(|route| turns_left(route)).count();
        (count, routes.len())
    };
    let ((of_any, anys), (of_left, lefts)) = (share(&any), share(&left));
    assert!(anys >= 20 && lefts >= 20, "{anys} and {lefts} heroes");
    assert_eq!(of_left, lefts, "every route turns left");
    assert!(of_any < anys, "{of_any} of {anys} without the rule");
}

#[test]
fn lights_that_are_off_stay_off() {
    let bench = Bench::new();
    let mut letters = Vec::new();
    let mut sumo = Sumo::start(options(&bench).with_traffic_lights(false)).unwrap();
    let mut population = Population::start(&mut sumo, SIZE, HeroRoutes::default(), 5).unwrap();
    run(&mut sumo, 300, |sumo, frame| {
        for signal in &frame.signals {
            letters.extend_from_slice(&signal.state[..signal.links as usize]);
        }
        population.after_step(sumo, frame).unwrap();
    });
    let mut sumo = sumo.reload(options(&bench).with_traffic_lights(true)).unwrap();
    let mut lit = Vec::new();
    run(&mut sumo, 10, |_, frame| {
        lit.extend(frame.signals.iter().map(|signal| signal.state[0]));
    });
    sumo.close().unwrap();
    assert!(letters.len() > 50, "{} links", letters.len());
    assert!(letters.iter().all(|letter| matches!(letter, b'o' | b'O')));
    assert!(lit.iter().any(|letter| matches!(letter, b'r' | b'G' | b'g')), "{lit:?}");
}

#[test]
fn speed_limits_are_those_of_the_net_times_the_factor() {
    let bench = Bench::new();
    let mut sumo = Sumo::start(options(&bench)).unwrap();
    let mut fastest_mps = Vec::new();
    for factor in [1.0, 0.5, 1.0] {
        sumo.scale_speed_limits(factor).unwrap();
        let limits = routes(&mut sumo, HeroTurns::Any);
        let mut fastest = 0.0_f32;
        run(&mut sumo, 300, |_, frame| {
            let vehicles = frame.states.iter().filter(|state| state.kind != Kind::Person as u32);
            fastest = vehicles.map(|state| state.speed_mps).fold(fastest, f32::max);
        });
        let limit = limits
            .values()
            .flatten()
            .map(|point| point.speed_limit_mps)
            .fold(0.0, f32::max);
        assert!((limit - 13.89 * factor as f32).abs() < 0.1, "{limit} m/s with {factor}");
        fastest_mps.push(fastest);
        sumo = sumo.reload(options(&bench)).unwrap();
    }
    sumo.close().unwrap();
    // Drivers exceed the limit by a few percent.
    assert!(fastest_mps[1] < 0.65 * 13.89, "{fastest_mps:?}");
    assert!(
        fastest_mps[0] > 0.7 * 13.89 && fastest_mps[0] == fastest_mps[2],
        "{fastest_mps:?}"
    );
}
