//! People who come to a hero that stands in their way.

use std::collections::BTreeMap;

use crate::support::{Bench, state_of, straight_on};
use ipc_schema::{config::HeroDriver, traffic::TrafficState};
use traffic_bridge::{
    heroes::{apply, around::AroundHeroes, take_over},
    sumo::frame::TrafficFrame,
};

/// The hero comes from the south. A person comes to the crossing at its stop line from the west, and wants to the east.
const ROAD_USERS: &str = "\
    <vehicle id=\"hero\" depart=\"0\" departPos=\"20\"><route edges=\"market_2 market_3\"/></vehicle>\
    <person id=\"walker\" depart=\"0\" departPos=\"20\"><walk edges=\"main_3 main_4\"/></person>";
/// The hero stops before the crossing, which is from 110 m to 113 m, until the person is on it; and then with its rear on it.
const STOPS_Y_M: [f64; 2] = [108.0, 114.5];
const ON_IT_X_M: f64 = 167.5;
const HERO_MPS: f64 = 4.0;
/// The hero's length and width, metres: SUMO's defaults.
const HERO_M: [f64; 2] = [5.0, 1.8];
/// The hero drives on after this time, seconds.
const DRIVES_ON_S: f64 = 120.0;
/// Where the person has crossed, metres.
const ACROSS_X_M: f64 = 173.5;

/// How near the person's middle comes to the standing hero's outline, metres, and when it has crossed.
fn walks(is_careful: bool) -> (f64, Option<f64>) {
    let bench = Bench::new();
    let mut sumo = bench.town_of(ROAD_USERS, std::iter::once("hero"));
    let (mut frame, mut ids) = (TrafficFrame::default(), BTreeMap::new());
    let mut around = AroundHeroes::default();
    let (mut nearest_m, mut across_s) = (f64::INFINITY, None);
    while across_s.is_none() && frame.time_s < 240.0 {
        let person = state_of(&frame, &ids, "walker");
        let stops_y_m = STOPS_Y_M[usize::from(person.is_some_and(|person| person.front_x_m > ON_IT_X_M))];
        let pose = state_of(&frame, &ids, "hero").map(|hero| {
            let drives = hero.front_y_m < stops_y_m || frame.time_s > DRIVES_ON_S;
            straight_on(hero, if drives { HERO_MPS } else { 0.0 })
        });
        apply(&mut sumo, &frame, pose.as_slice(), HeroDriver::Actions).unwrap();
        sumo.step(&mut frame).unwrap();
        ids.extend(frame.events.iter().map(|event| (event.vehicle, event.id_text())));
        take_over(&mut sumo, &frame, HeroDriver::Actions, false).unwrap();
        if is_careful {
            around.update(&mut sumo, &frame).unwrap();
        }
        let Some(person) = state_of(&frame, &ids, "walker") else {
            break;
        };
        if let Some(hero) = state_of(&frame, &ids, "hero").filter(|hero| hero.speed_mps < 0.1) {
            nearest_m = nearest_m.min(outside_m(person, hero));
        }
        across_s = (person.front_x_m > ACROSS_X_M).then_some(frame.time_s);
    }
    sumo.close().unwrap();
    (nearest_m, across_s)
}

/// From the outline of a hero to a person's middle.
fn outside_m(person: &TrafficState, hero: &TrafficState) -> f64 {
    let (sin, cos) = f64::from(hero.yaw_rad).sin_cos();
    let (dx, dy) = (person.front_x_m - hero.front_x_m, person.front_y_m - hero.front_y_m);
    let (ahead, left) = (dx * cos + dy * sin, dy * cos - dx * sin);
    let beyond = [ahead.max(-HERO_M[0] - ahead), left.abs() - 0.5 * HERO_M[1]];
    f64::hypot(beyond[0].max(0.0), beyond[1].max(0.0))
}

#[test]
fn people_wait_beside_a_hero_that_stands_and_without_that_walk_through_it() {
    let (nearest_m, across_s) = walks(false);
    assert_eq!(nearest_m, 0.0, "SUMO's person walks through the hero");
    assert!(across_s.is_some_and(|across_s| across_s < DRIVES_ON_S));
    let (nearest_m, across_s) = walks(true);
    assert!(nearest_m > 0.3, "{nearest_m} m");
    assert!(
        across_s.is_some_and(|across_s| across_s > DRIVES_ON_S),
        "it crosses once the hero has gone"
    );
}
