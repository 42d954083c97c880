//! Heroes that stand, and how large they and the others are.

use std::collections::BTreeMap;

use ipc_schema::traffic::{Kind, MetaEvent, TrafficState};

use crate::sumo::frame::TrafficFrame;

/// A road user that is slower stands, m/s.
pub const STANDS_MPS: f32 = 0.1;

/// Length and width, metres.
pub type Size = [f64; 2];

/// The heroes that stand, and the sizes of all vehicles, in one episode.
#[derive(Debug, Default)]
pub struct StandingHeroes {
    /// Of all vehicles that are there, by their dense indices.
    sizes: BTreeMap<u32, Size>,
    /// Steps for which each hero has stood.
    steps: BTreeMap<u32, u64>,
}

impl StandingHeroes {
    /// Looks at the heroes of a step.
    pub fn update(&mut self, frame: &TrafficFrame) {
        for event in &frame.events {
            if event.event == MetaEvent::Arrived as u32 {
                self.sizes.remove(&event.vehicle);
            } else if event.event == MetaEvent::Departed as u32 && event.kind != Kind::Person as u32 {
                let size = [event.length_m, event.width_m].map(f64::from);
                self.sizes.insert(event.vehicle, size);
            }
        }
        let before = std::mem::take(&mut self.steps);
        self.steps = heroes_of(frame)
            .filter(|hero| hero.speed_mps < STANDS_MPS)
            .map(|hero| (hero.vehicle, before.get(&hero.vehicle).map_or(1, |steps| steps + 1)))
            .collect();
    }

    /// Whether a hero stands.
    #[must_use]
    pub fn has(&self, hero: u32) -> bool {
        self.steps.contains_key(&hero)
    }

    /// Each hero that stands, and for how many steps.
    pub fn steps(&self) -> impl Iterator<Item = (u32, u64)> {
        self.steps.iter().map(|(hero, steps)| (*hero, *steps))
    }

    /// The size of a vehicle that is there.
    #[must_use]
    pub fn size(&self, vehicle: u32) -> Option<Size> {
        self.sizes.get(&vehicle).copied()
    }
}

/// States of the heroes.
pub fn heroes_of(frame: &TrafficFrame) -> impl Iterator<Item = &TrafficState> {
    frame.states.iter().filter(|state| state.kind == Kind::Hero as u32)
}

/// The state of a road user. States are in the order of their dense indices.
#[must_use]
pub fn state_of(frame: &TrafficFrame, vehicle: u32) -> Option<&TrafficState> {
    let place = frame.states.binary_search_by_key(&vehicle, |state| state.vehicle);
    place.ok().map(|place| &frame.states[place])
}
