//! Vehicles of SUMO's that wait for a hero in a junction.

use std::collections::BTreeMap;

use crate::support::{Bench, state_of, straight_on};
use ipc_schema::config::HeroDriver;
use traffic_bridge::{
    heroes::{apply, around::AroundHeroes, take_over},
    sumo::frame::TrafficFrame,
};

/// The hero comes from the south, where the main street crosses another at a traffic light. The other turns left out of the west, into
/// the street that the hero is heading for.
const VEHICLES: [(&str, f64, &str); 2] = [("hero", 20.0, "market_2 market_3"), ("other", 10.0, "main_3 market_3")];
/// Where the junction begins behind the hero's stop line, and where the other has left it: to the north, metres.
const LINE_Y_M: f64 = 109.6;
const BEHIND_Y_M: f64 = 133.0;
const HERO_MPS: f64 = 4.0;

/// When the other has left the junction, if it does within three minutes. The hero stands from `stands_y_m` on.
fn leaves_at_s(stands_y_m: f64, is_passed: bool) -> Option<f64> {
    let bench = Bench::new();
    let mut sumo = bench.town_with(&VEHICLES, std::iter::once("hero"));
    let (mut frame, mut ids) = (TrafficFrame::default(), BTreeMap::new());
    let mut around = AroundHeroes::default();
    let mut left_s = None;
    while left_s.is_none() && frame.time_s < 180.0 {
        let pose = state_of(&frame, &ids, "hero").map(|hero| {
            let speed_mps = if hero.front_y_m < stands_y_m { HERO_MPS } else { 0.0 };
            straight_on(hero, speed_mps)
        });
        apply(&mut sumo, &frame, pose.as_slice(), HeroDriver::Actions).unwrap();
        sumo.step(&mut frame).unwrap();
        ids.extend(frame.events.iter().map(|event| (event.vehicle, event.id_text())));
        take_over(&mut sumo, &frame, HeroDriver::Actions, false).unwrap();
        if is_passed {
            around.update(&mut sumo, &frame).unwrap();
        }
        let other = state_of(&frame, &ids, "other").unwrap();
        left_s = (other.front_y_m > BEHIND_Y_M).then_some(frame.time_s);
    }
    sumo.close().unwrap();
    left_s
}

#[test]
fn a_hero_that_stands_behind_its_line_is_passed_and_without_that_waited_for() {
    let stands_y_m = LINE_Y_M + 1.5;
    assert_eq!(leaves_at_s(stands_y_m, false), None, "SUMO's vehicle waits for ever");
    let passes_s = leaves_at_s(stands_y_m, true);
    assert!(passes_s.is_some(), "its way is free");
}

#[test]
fn a_hero_whose_body_is_in_the_way_is_waited_for() {
    assert_eq!(leaves_at_s(LINE_Y_M + 18.0, true), None);
}
