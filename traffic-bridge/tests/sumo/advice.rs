//! What SUMO's own driver would do with a hero that actions drive.

use std::collections::BTreeMap;

use crate::support::{Bench, straight_on};
use ipc_schema::{
    config::HeroDriver,
    ego::EgoPose,
    traffic::{HeroAdvice, Kind, TrafficState},
};
use traffic_bridge::{
    heroes::{advice, apply, take_over},
    sumo::frame::TrafficFrame,
};

/// Heroes on an edge of the town, whose end is straight, and where they depart, metres. The one ahead stands.
const HEROES: [(&str, f64); 2] = [("ahead", 95.0), ("behind", 60.0)];

/// What SUMO's driver would have done with the hero behind, moved straight ahead at this speed, by its gap to the one ahead: m and m/s².
fn advised(speed_mps: f64, is_alone: bool) -> Vec<(f64, f64)> {
    let bench = Bench::new();
    let heroes = HEROES.map(|(id, at_m)| (id, at_m, "ring_west_1 ring_west_2"));
    let mut sumo = bench.town_of_heroes(&heroes[usize::from(is_alone)..]);
    let (mut frame, mut ids) = (TrafficFrame::default(), BTreeMap::new());
    let mut seen = Vec::new();
    while seen.len() < 50 {
        let speed_of = |state: &TrafficState| match ids.get(&state.vehicle).map(String::as_str) {
            Some("behind") => speed_mps,
            _ => 0.0,
        };
        let poses: Vec<EgoPose> = frame
            .states
            .iter()
            .map(|state| straight_on(state, speed_of(state)))
            .collect();
        apply(&mut sumo, &frame, &poses, HeroDriver::Actions).unwrap();
        sumo.step(&mut frame).unwrap();
        let advice = advice(&sumo, &frame, &poses).unwrap();
        assert_eq!(advice.len(), poses.len(), "each hero that was moved is advised");
        for event in frame.events.iter().filter(|event| event.kind == Kind::Hero as u32) {
            ids.insert(event.vehicle, event.id_text());
        }
        take_over(&mut sumo, &frame, HeroDriver::Actions, true).unwrap();
        let place = |id: &str| {
            frame
                .states
                .iter()
                .find(|state| ids.get(&state.vehicle).is_some_and(|it| it == id))
        };
        let of_behind = |advice: &&HeroAdvice| ids.get(&advice.vehicle).is_some_and(|id| id == "behind");
        if let (Some(behind), Some(advice)) = (place("behind"), advice.iter().find(of_behind)) {
            let ahead = place("ahead").unwrap_or(behind);
            let gap_m = (ahead.front_x_m - behind.front_x_m).hypot(ahead.front_y_m - behind.front_y_m) - 5.0;
            seen.push((gap_m, f64::from(advice.accel_mps2)));
        }
    }
    sumo.close().unwrap();
    seen
}

#[test]
fn a_hero_that_comes_too_near_is_advised_to_brake() {
    let seen = advised(8.0, false);
    let [far, near] = [(20.0, 60.0), (2.0, 8.0)].map(|(from_m, to_m)| {
        let within = seen.iter().filter(|(gap_m, _)| (from_m..to_m).contains(gap_m));
        let accels: Vec<f64> = within.map(|(_, accel)| *accel).collect();
        assert!(!accels.is_empty(), "{from_m} … {to_m} m: {seen:?}");
        accels
    });
    assert!(far[0] > -0.5, "far away it may go on: {seen:?}");
    assert!(near.iter().all(|accel| *accel < -3.0), "{seen:?}");
}

#[test]
fn a_hero_is_advised_to_keep_the_speed_limit() {
    let slow = advised(4.0, true);
    assert!(slow[0].1 > 1.0, "below the limit it may accelerate: {slow:?}");
    let fast = advised(25.0, true);
    assert!(fast[0].1 < -3.0, "above the limit it brakes: {fast:?}");
}
