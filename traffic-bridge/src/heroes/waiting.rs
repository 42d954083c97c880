//! People wait beside a hero that stands in their way, until it has gone.
//!
//! SUMO's people let a vehicle pass that comes to a crossing, but once on it, they wait for ten seconds at most and then walk through
//! whatever stands there. A person would not walk into a car that stands. One ahead of the hero goes on: the hero waits for it.

use std::collections::BTreeMap;

use ipc_schema::traffic::{Kind, TrafficState};

use super::standing::{Size, StandingHeroes, heroes_of, state_of};
use crate::sumo::{Sumo, called, error::SumoError, frame::TrafficFrame};

/// What a person looks at of its way, metres: about a second of it.
const LOOKS_M: f64 = 1.5;
/// Distance between the places on it, metres.
const SPACING_M: f64 = 0.25;
/// Nearer to a hero's outline than this a place is in the hero, metres: half a person, and room.
const ROOM_M: f64 = 0.35;
/// A person that waits has this limit of its speed, m/s. By none at all SUMO would divide.
const WAITS_MPS: f64 = 0.01;

/// The people that wait, in one episode.
#[derive(Debug, Default)]
pub struct WaitingPeople {
    /// By their dense indices.
    waiting: BTreeMap<u32, Waiting>,
}

#[derive(Debug, Clone, Copy)]
struct Waiting {
    hero: u32,
    /// The limit of its speed before it waited, m/s.
    limit_mps: f64,
}

impl WaitingPeople {
    /// From the next step on, people with a hero that stands in their way wait, and those walk that have none any more.
    ///
    /// # Errors
    /// SUMO refuses.
    pub fn update(
        &mut self,
        sumo: &mut Sumo,
        frame: &TrafficFrame,
        standing: &StandingHeroes,
    ) -> Result<(), SumoError> {
        let is_in_the_way = |person: &TrafficState, hero: u32| {
            let there = state_of(frame, hero).zip(standing.size(hero));
            there.is_some_and(|(hero, size)| walks_into(person, hero, size))
        };
        let before = std::mem::take(&mut self.waiting);
        for (person, waiting) in before {
            let Some(state) = state_of(frame, person) else { continue };
            if is_in_the_way(state, waiting.hero) {
                self.waiting.insert(person, waiting);
            } else {
                limit(sumo, person, waiting.limit_mps)?;
            }
        }
        let is_person = |state: &&TrafficState| state.kind == Kind::Person as u32;
        let people: Vec<&TrafficState> = frame.states.iter().filter(is_person).collect();
        for hero in heroes_of(frame).filter(|hero| standing.has(hero.vehicle)) {
            for person in people.iter().filter(|person| is_in_the_way(person, hero.vehicle)) {
                if self.waiting.contains_key(&person.vehicle) {
                    continue;
                }
                let limit_mps = called(
                    "report a person's speed limit",
                    sumo.simulation().person_limit(person.vehicle),
                )?;
                let waiting = Waiting {
                    hero: hero.vehicle,
                    limit_mps,
                };
                self.waiting.insert(person.vehicle, waiting);
                limit(sumo, person.vehicle, WAITS_MPS)?;
            }
        }
        Ok(())
    }
}

fn limit(sumo: &mut Sumo, person: u32, limit_mps: f64) -> Result<(), SumoError> {
    let done = sumo.simulation_mut().limit_person(person, limit_mps);
    called("let a person wait for a hero", done)
}

/// True if a person beside or behind a hero walks into it, straight on.
fn walks_into(person: &TrafficState, hero: &TrafficState, [length_m, width_m]: Size) -> bool {
    let (dx, dy) = (person.front_x_m - hero.front_x_m, person.front_y_m - hero.front_y_m);
    let reach_m = LOOKS_M + ROOM_M;
    if dx.abs().max(dy.abs()) > length_m + width_m + reach_m {
        return false;
    }
    let (sin, cos) = f64::from(hero.yaw_rad).sin_cos();
    // From the middle of the hero's front, forward and to the left.
    let place = [dx * cos + dy * sin, dy * cos - dx * sin];
    if place[0] > 0.0 || place[0] < -length_m - reach_m || place[1].abs() > 0.5 * width_m + reach_m {
        return false;
    }
    let turned = f64::from(person.yaw_rad) - f64::from(hero.yaw_rad);
    let distance_m = |walked_m: f64| {
        let ahead = place[0] + walked_m * turned.cos();
        let left = place[1] + walked_m * turned.sin();
        let beyond = [ahead.max(-length_m - ahead), left.abs() - 0.5 * width_m];
        f64::hypot(beyond[0].max(0.0), beyond[1].max(0.0))
    };
    // One that has come too near may walk away.
    let steps = (LOOKS_M / SPACING_M) as u32;
    let mut places = (1..=steps).map(|step| distance_m(SPACING_M * f64::from(step)));
    let now_m = distance_m(0.0);
    places.any(|then_m| then_m < ROOM_M && then_m < now_m)
}

#[cfg(test)]
mod tests {
    use std::f32::consts::{FRAC_PI_2, PI};

    use super::*;

    fn at(front_x_m: f64, front_y_m: f64, yaw_rad: f32) -> TrafficState {
        TrafficState {
            front_x_m,
            front_y_m,
            yaw_rad,
            ..TrafficState::default()
        }
    }

    #[test]
    fn a_person_that_would_walk_into_the_side_waits_and_one_that_passes_it_does_not() {
        // 4.5 m long to the west of its front, 1.8 m wide.
        let walks = |x: f64, y: f64, yaw_rad: f32| walks_into(&at(x, y, yaw_rad), &at(10.0, 5.0, 0.0), [4.5, 1.8]);
        let (north, south, east) = (FRAC_PI_2, -FRAC_PI_2, 0.0);
        assert!(walks(8.0, 3.0, north) && walks(8.0, 7.0, south), "from both sides");
        assert!(!walks(8.0, 2.0, north), "too far away to stop yet");
        assert!(
            !walks(8.0, 3.0, east) && !walks(8.0, 3.0, south),
            "along it, and away from it"
        );
        assert!(walks(4.0, 5.0, east), "from behind");
        assert!(!walks(5.0, 3.2, PI), "past its rear");
        assert!(!walks(10.2, 3.0, north), "ahead of it: the hero waits");
        assert!(!walks(8.0, 3.9, south), "too near, but away");
    }

    #[test]
    fn the_hero_may_head_anywhere() {
        // To the north-west of its front's place, the person west of it walks east.
        let hero = at(0.0, 0.0, 0.75 * PI);
        let beside = [
            -0.5_f64.sqrt() * -2.0 - 0.5_f64.sqrt() * 2.0,
            0.5_f64.sqrt() * -2.0 - 0.5_f64.sqrt() * 2.0,
        ];
        assert!(walks_into(
            &at(beside[0], beside[1], 0.75 * PI - FRAC_PI_2),
            &hero,
            [4.5, 1.8]
        ));
        assert!(!walks_into(
            &at(beside[0], beside[1], 0.75 * PI + FRAC_PI_2),
            &hero,
            [4.5, 1.8]
        ));
    }
}
