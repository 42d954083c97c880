//! SUMO's vehicles pass a hero that stands in a junction, once it has stood for some seconds and their way is free.
//!
//! A vehicle of SUMO's waits for one that is in a junction before it and has precedence, since that will soon be gone. A hero need not be:
//! its driver may have stopped for a person behind its line, or for the very vehicle that waits for it. Then both wait for ever, and with
//! them all behind them. A person in that vehicle would see that the way ahead is free, and drive on.

use std::collections::{BTreeMap, BTreeSet};

use ipc_schema::traffic::{Kind, TrafficState};

use super::standing::{STANDS_MPS, Size, StandingHeroes, state_of};
use crate::sumo::{Sumo, called, convention::world_from_net, error::SumoError, frame::TrafficFrame};

/// For how long a hero has stood in a junction when others pass it, seconds.
const PATIENCE_S: f64 = 5.0;
/// Time between two looks at the vehicles that may pass a hero, seconds.
const LOOKS_EVERY_S: f64 = 1.0;
/// A vehicle that is farther from a hero does not wait for it, metres.
const NEAR_M: f64 = 30.0;
/// Room between a vehicle that passes and the hero, metres.
const ROOM_M: f64 = 0.3;
/// Largest distance between two places of an outline that are looked at, metres.
const SPACING_M: f64 = 0.8;

/// The vehicles that pass heroes that stand, in one episode.
#[derive(Debug, Default)]
pub struct HeroPassing {
    /// The heroes that a vehicle passes, by the vehicle's dense index.
    passed: BTreeMap<u32, BTreeSet<u32>>,
}

impl HeroPassing {
    /// From the next step on, SUMO's vehicles that may pass the heroes that stand do not wait.
    ///
    /// # Errors
    /// SUMO refuses.
    pub fn update(
        &mut self,
        sumo: &mut Sumo,
        frame: &TrafficFrame,
        standing: &StandingHeroes,
    ) -> Result<(), SumoError> {
        self.forget_moved(sumo, frame, standing)?;
        let steps = |seconds: f64| (seconds / sumo.step_s()).ceil().max(1.0) as u64;
        let (patience, interval) = (steps(PATIENCE_S), steps(LOOKS_EVERY_S));
        let is_looked_at = |steps: u64| steps >= patience && (steps - patience).is_multiple_of(interval);
        for (hero, _) in standing.steps().filter(|(_, steps)| is_looked_at(*steps)) {
            self.let_pass(sumo, frame, standing, hero)?;
        }
        Ok(())
    }

    /// What moves again is waited for again, and vehicles that have left are forgotten.
    fn forget_moved(
        &mut self,
        sumo: &mut Sumo,
        frame: &TrafficFrame,
        standing: &StandingHeroes,
    ) -> Result<(), SumoError> {
        for (vehicle, heroes) in &mut self.passed {
            let before = heroes.len();
            heroes.retain(|hero| standing.has(*hero));
            if heroes.len() < before && state_of(frame, *vehicle).is_some() {
                ignore(sumo, *vehicle, heroes)?;
            }
        }
        self.passed.retain(|_, heroes| !heroes.is_empty());
        Ok(())
    }

    /// Lets the vehicles pass that stand because of this hero and have room to.
    fn let_pass(
        &mut self,
        sumo: &mut Sumo,
        frame: &TrafficFrame,
        standing: &StandingHeroes,
        hero: u32,
    ) -> Result<(), SumoError> {
        let (Some(state), Some(size)) = (state_of(frame, hero), standing.size(hero)) else {
            return Ok(());
        };
        let outline = outline_m(state, size);
        let waits = |other: &&TrafficState| {
            let is_vehicle = [Kind::Cav as u32, Kind::Other as u32].contains(&other.kind);
            let distance_m = (other.front_x_m - state.front_x_m).hypot(other.front_y_m - state.front_y_m);
            is_vehicle && other.speed_mps < STANDS_MPS && distance_m < NEAR_M
        };
        for other in frame.states.iter().filter(waits) {
            let passed = self.passed.entry(other.vehicle).or_default();
            if passed.contains(&hero) {
                continue;
            }
            let way = called(
                "report a vehicle's way past a hero",
                sumo.simulation().way_past(other.vehicle, hero),
            )?;
            let way: Vec<[f64; 2]> = way
                .chunks_exact(2)
                .map(|point| world_from_net([point[0], point[1]], sumo.world_origin_m()))
                .collect();
            let width_m = standing.size(other.vehicle).map_or(2.5, |size| size[1]);
            let ahead = ahead_of(&way, [other.front_x_m, other.front_y_m]);
            if ahead.len() > 1 && is_free(&ahead, &outline, width_m / 2.0 + ROOM_M) {
                passed.insert(hero);
                ignore(sumo, other.vehicle, passed)?;
            }
        }
        self.passed.retain(|_, heroes| !heroes.is_empty());
        Ok(())
    }
}

fn ignore(sumo: &mut Sumo, vehicle: u32, heroes: &BTreeSet<u32>) -> Result<(), SumoError> {
    let heroes: Vec<u32> = heroes.iter().copied().collect();
    let done = sumo.simulation_mut().ignore_in_junctions(vehicle, &heroes);
    called("let a vehicle pass a hero", done)
}

/// Places around a vehicle, close to each other.
fn outline_m(state: &TrafficState, [length_m, width_m]: Size) -> Vec<[f64; 2]> {
    let (sin, cos) = f64::from(state.yaw_rad).sin_cos();
    let along = (length_m / SPACING_M).ceil().max(1.0) as u32;
    let across = (width_m / SPACING_M).ceil().max(1.0) as u32;
    let mut places = Vec::new();
    for i in 0..=along {
        for j in 0..=across {
            let back_m = length_m * f64::from(i) / f64::from(along);
            let left_m = width_m * (f64::from(j) / f64::from(across) - 0.5);
            places.push([
                state.front_x_m - back_m * cos - left_m * sin,
                state.front_y_m - back_m * sin + left_m * cos,
            ]);
        }
    }
    places
}

/// The part of a line from the place on it that is nearest to `from`.
fn ahead_of(line: &[[f64; 2]], from: [f64; 2]) -> Vec<[f64; 2]> {
    let nearest = line
        .windows(2)
        .map(|ends| nearest_on(ends[0], ends[1], from))
        .enumerate()
        .min_by(|(_, a), (_, b)| distance_m(*a, from).total_cmp(&distance_m(*b, from)));
    nearest.map_or(Vec::new(), |(segment, place)| {
        std::iter::once(place)
            .chain(line[segment + 1..].iter().copied())
            .collect()
    })
}

/// True if no place is nearer to the line than `room_m`.
fn is_free(line: &[[f64; 2]], places: &[[f64; 2]], room_m: f64) -> bool {
    line.windows(2).all(|ends| {
        places
            .iter()
            .all(|place| distance_m(nearest_on(ends[0], ends[1], *place), *place) >= room_m)
    })
}

fn nearest_on(a: [f64; 2], b: [f64; 2], place: [f64; 2]) -> [f64; 2] {
    let along = [b[0] - a[0], b[1] - a[1]];
    let square = along[0] * along[0] + along[1] * along[1];
    let share = ((place[0] - a[0]) * along[0] + (place[1] - a[1]) * along[1]) / square.max(1e-12);
    let share = share.clamp(0.0, 1.0);
    [a[0] + share * along[0], a[1] + share * along[1]]
}

fn distance_m(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_way_is_free_if_a_body_and_its_room_are_beside_it() {
        let line = [[0.0, 0.0], [10.0, 0.0], [20.0, 10.0]];
        let hero = |front_x_m: f64, front_y_m: f64| TrafficState {
            front_x_m,
            front_y_m,
            yaw_rad: std::f32::consts::FRAC_PI_2,
            ..TrafficState::default()
        };
        // 4.5 m long to the south of its front, 1.8 m wide; the other is 2 m wide.
        let is_past = |x: f64, y: f64| is_free(&line, &outline_m(&hero(x, y), [4.5, 1.8]), 1.0 + ROOM_M);
        assert!(is_past(5.0, -1.4) && !is_past(5.0, -1.2));
        assert!(!is_past(5.0, 2.0), "the line goes through it");
        assert!(is_past(5.0, 5.9) && !is_past(5.0, 5.7));
        assert!(!is_past(16.0, 8.0), "after the bend");
        assert!(is_past(-2.3, 2.0), "what is behind is not in the way");
    }

    #[test]
    fn the_way_ahead_begins_at_the_front() {
        let line = [[0.0, 0.0], [10.0, 0.0], [20.0, 10.0]];
        assert_eq!(ahead_of(&line, [4.0, 0.5]), [[4.0, 0.0], [10.0, 0.0], [20.0, 10.0]]);
        assert_eq!(ahead_of(&line, [16.0, 6.0]), [[16.0, 6.0], [20.0, 10.0]]);
        assert!(ahead_of(&[], [0.0, 0.0]).is_empty());
    }
}
