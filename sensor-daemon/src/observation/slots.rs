//! Slots: rows of the observation, each held by one vehicle until that vehicle leaves.

use std::collections::BTreeSet;

use ipc_schema::observation::{EMPTY_SLOT, RESYNCHRONISED, TERMINATED, TRUNCATED};

/// One row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Slot {
    /// Dense index of its vehicle, or [`EMPTY_SLOT`].
    pub vehicle: u32,
    /// Ticks since the vehicle took the slot.
    pub step: u32,
    /// [`TERMINATED`], [`TRUNCATED`]: the trajectory that held this slot at the previous tick ended there. [`RESYNCHRONISED`]: because its
    /// vehicle, which keeps the slot, was set elsewhere.
    pub ended: u32,
    seen: bool,
    /// The trajectory of its vehicle was cut at the last tick, rather than ended.
    cut: bool,
    /// Bits that say why its trajectory ends, once its vehicle has gone.
    why: u32,
}

const EMPTY: Slot = Slot {
    vehicle: EMPTY_SLOT,
    step: 0,
    ended: 0,
    seen: false,
    cut: false,
    why: 0,
};

/// All slots of a run. The number of slots never shrinks.
#[derive(Debug, Clone, Default)]
pub struct Slots {
    slots: Vec<Slot>,
    free: BTreeSet<u32>,
    /// Slot of each dense vehicle index, [`EMPTY_SLOT`] where it has none.
    of_vehicle: Vec<u32>,
    /// Slots that become free at the next tick.
    leaving: Vec<u32>,
}

impl Slots {
    /// Begins a tick; `new_episode` cuts every trajectory and empties all slots.
    pub fn begin(&mut self, new_episode: bool) {
        self.free.extend(self.leaving.drain(..));
        for (number, slot) in (0_u32..).zip(&mut self.slots) {
            let occupied = slot.vehicle != EMPTY_SLOT;
            slot.ended = 0;
            slot.seen = false;
            if new_episode {
                *slot = Slot {
                    ended: if occupied { TRUNCATED } else { 0 },
                    ..EMPTY
                };
                self.free.insert(number);
            }
        }
        if new_episode {
            self.of_vehicle.clear();
        }
    }

    /// The slot of `vehicle` at this tick: its own, or the lowest free one.
    #[inline]
    pub fn occupy(&mut self, vehicle: u32) -> usize {
        let index = vehicle as usize;
        if index >= self.of_vehicle.len() {
            self.of_vehicle.resize(index + 1, EMPTY_SLOT);
        }
        if self.of_vehicle[index] == EMPTY_SLOT {
            self.of_vehicle[index] = self.take_free(vehicle);
        } else {
            self.slots[self.of_vehicle[index] as usize].step += 1;
        }
        let number = self.of_vehicle[index] as usize;
        self.slots[number].seen = true;
        number
    }

    /// Cuts the trajectory in slot `number` at this tick: when its vehicle has gone, the slot reports [`TRUNCATED`].
    pub fn cut(&mut self, number: usize) {
        self.slots[number].cut = true;
    }

    /// Notes why the trajectory in slot `number` ends at this tick: the slot reports these bits when its vehicle has gone.
    pub fn note_end(&mut self, number: usize, bits: u32) {
        self.slots[number].why = bits;
    }

    /// Applies [`Slots::cut`] to the slot of `vehicle`, if it holds one.
    pub fn cut_vehicle(&mut self, vehicle: u32) {
        if let Some(&number) = self.of_vehicle.get(vehicle as usize)
            && number != EMPTY_SLOT
        {
            self.cut(number as usize);
        }
    }

    /// Cuts the trajectory in slot `number` at the previous tick and begins another of the same vehicle, which was set elsewhere. A vehicle
    /// that has just taken its slot has no trajectory to cut.
    pub fn restart(&mut self, number: usize) {
        let slot = &mut self.slots[number];
        if slot.step > 0 {
            slot.step = 0;
            slot.ended |= TRUNCATED | RESYNCHRONISED;
        }
    }

    fn take_free(&mut self, vehicle: u32) -> u32 {
        let number = self.free.pop_first().unwrap_or_else(|| {
            self.slots.push(EMPTY);
            self.slots.len() as u32 - 1
        });
        let slot = &mut self.slots[number as usize];
        *slot = Slot {
            vehicle,
            step: 0,
            cut: false,
            why: 0,
            ..*slot
        };
        number
    }

    /// Ends a tick: a vehicle that did not occupy its slot has left, and the slot is free from the next tick on.
    pub fn end(&mut self) {
        for (number, slot) in (0_u32..).zip(&mut self.slots) {
            if slot.vehicle != EMPTY_SLOT && !slot.seen {
                self.of_vehicle[slot.vehicle as usize] = EMPTY_SLOT;
                *slot = Slot {
                    ended: slot.ended | slot.why | if slot.cut { TRUNCATED } else { TERMINATED },
                    ..EMPTY
                };
                self.leaving.push(number);
            }
        }
    }

    /// Which slots hold a vehicle: all that an episode needs to know of the one before it.
    #[must_use]
    pub fn occupied(&self) -> Vec<bool> {
        self.slots.iter().map(|slot| slot.vehicle != EMPTY_SLOT).collect()
    }

    /// Slots as they were at the end of an episode. The next tick must begin another one.
    #[must_use]
    pub fn after_episode(occupied: &[bool]) -> Self {
        let held = Slot { vehicle: 0, ..EMPTY };
        Self {
            slots: occupied
                .iter()
                .map(|is_held| if *is_held { held } else { EMPTY })
                .collect(),
            ..Self::default()
        }
    }

    /// All rows.
    #[must_use]
    pub fn rows(&self) -> &[Slot] {
        &self.slots
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    #[test]
    fn an_episode_begins_as_if_the_one_before_had_not_been_stored() {
        let mut slots = Slots::default();
        tick(&mut slots, true, &[3, 4, 5]);
        tick(&mut slots, false, &[3, 5]);
        let mut stored = Slots::after_episode(&slots.occupied());
        for vehicles in [&[0, 1][..], &[0, 1, 2, 3]] {
            let is_first = vehicles.len() == 2;
            assert_eq!(
                tick(&mut slots, is_first, vehicles),
                tick(&mut stored, is_first, vehicles)
            );
            assert_eq!(slots.rows(), stored.rows());
        }
        assert_eq!(slots.rows().len(), 4);
    }

    fn tick(slots: &mut Slots, new_episode: bool, vehicles: &[u32]) -> Vec<usize> {
        slots.begin(new_episode);
        let numbers = vehicles.iter().map(|vehicle| slots.occupy(*vehicle)).collect();
        slots.end();
        numbers
    }

    #[test]
    fn a_slot_is_kept_freed_and_reused() {
        let mut slots = Slots::default();
        assert_eq!(tick(&mut slots, true, &[0, 1, 2]), [0, 1, 2]);
        assert_eq!(
            tick(&mut slots, false, &[0, 2, 3]),
            [0, 2, 3],
            "a slot is not reused at the tick at which it becomes free"
        );
        assert_eq!(
            (slots.rows()[1].vehicle, slots.rows()[1].ended),
            (EMPTY_SLOT, TERMINATED)
        );
        assert_eq!(tick(&mut slots, false, &[0, 2, 3, 4]), [0, 2, 3, 1]);
        assert_eq!(
            (slots.rows()[1].ended, slots.rows()[1].step, slots.rows()[0].step),
            (0, 0, 2)
        );
    }

    #[test]
    fn a_trajectory_that_is_cut_is_truncated_and_the_next_in_its_slot_is_not() {
        let mut slots = Slots::default();
        tick(&mut slots, true, &[0, 1]);
        slots.begin(false);
        [0, 1].into_iter().for_each(|vehicle| {
            let number = slots.occupy(vehicle);
            if vehicle == 1 {
                slots.cut(number);
            }
        });
        slots.end();
        tick(&mut slots, false, &[]);
        assert_eq!((slots.rows()[0].ended, slots.rows()[1].ended), (TERMINATED, TRUNCATED));
        tick(&mut slots, false, &[2, 3]);
        tick(&mut slots, false, &[]);
        assert_eq!((slots.rows()[0].ended, slots.rows()[1].ended), (TERMINATED, TERMINATED));
    }

    #[test]
    fn a_vehicle_that_is_left_out_for_a_tick_begins_anew() {
        let mut slots = Slots::default();
        tick(&mut slots, true, &[0, 1]);
        tick(&mut slots, false, &[0, 1]);
        assert_eq!(tick(&mut slots, false, &[1]), [1]);
        assert_eq!(slots.rows()[0].ended, TERMINATED);
        assert_eq!(tick(&mut slots, false, &[0, 1, 2]), [0, 1, 2]);
        let row = slots.rows()[0];
        assert_eq!((row.vehicle, row.step, row.ended), (0, 0, 0));
        assert_eq!(slots.rows()[1].step, 3);
    }

    #[test]
    fn a_vehicle_that_leaves_the_region_is_truncated_and_begins_anew() {
        let mut slots = Slots::default();
        tick(&mut slots, true, &[0, 1]);
        slots.begin(false);
        slots.occupy(0);
        slots.cut_vehicle(1);
        slots.cut_vehicle(7);
        slots.end();
        assert_eq!((slots.rows()[1].ended, slots.rows()[0].ended), (TRUNCATED, 0));
        assert_eq!(tick(&mut slots, false, &[0, 1]), [0, 1]);
        assert_eq!((slots.rows()[1].step, slots.rows()[1].ended), (0, 0));
    }

    #[test]
    fn a_vehicle_that_is_set_elsewhere_keeps_its_slot_and_begins_anew() {
        let mut slots = Slots::default();
        tick(&mut slots, true, &[0, 1]);
        tick(&mut slots, false, &[0, 1]);
        slots.begin(false);
        for vehicle in [0, 1, 2] {
            let number = slots.occupy(vehicle);
            if vehicle > 0 {
                slots.restart(number);
            }
        }
        slots.end();
        let rows: Vec<(u32, u32, u32)> = slots
            .rows()
            .iter()
            .map(|row| (row.vehicle, row.step, row.ended))
            .collect();
        assert_eq!(rows, [(0, 2, 0), (1, 0, TRUNCATED | RESYNCHRONISED), (2, 0, 0)]);
        tick(&mut slots, false, &[0, 1, 2]);
        assert_eq!((slots.rows()[1].step, slots.rows()[1].ended), (1, 0));
    }

    #[test]
    fn a_new_episode_truncates_all_trajectories() {
        let mut slots = Slots::default();
        tick(&mut slots, true, &[0, 1]);
        assert_eq!(tick(&mut slots, true, &[0]), [0]);
        assert_eq!(
            slots.rows().iter().map(|slot| slot.ended).collect::<Vec<_>>(),
            [TRUNCATED, TRUNCATED]
        );
        assert_eq!((slots.rows()[0].step, slots.rows()[1].vehicle), (0, EMPTY_SLOT));
    }

    proptest! {
        /// For any sequence of vehicles: each slot has one vehicle, a vehicle keeps its slot, the number of slots never shrinks.
        #[test]
        fn slots_are_stable(presence in prop::collection::vec(prop::collection::btree_set(0_u32..20, 0..12), 1..40)) {
            let mut slots = Slots::default();
            let mut held: BTreeMap<u32, usize> = BTreeMap::new();
            let mut count = 0;
            for vehicles in presence {
                let vehicles: Vec<u32> = vehicles.into_iter().collect();
                let numbers = tick(&mut slots, false, &vehicles);
                let now: BTreeMap<u32, usize> = vehicles.iter().copied().zip(numbers).collect();
                let distinct: BTreeSet<usize> = now.values().copied().collect();
                prop_assert_eq!(distinct.len(), now.len());
                for (vehicle, number) in &now {
                    prop_assert_eq!(slots.rows()[*number].vehicle, *vehicle);
                    if let Some(before) = held.get(vehicle) {
                        prop_assert_eq!(before, number);
                    }
                }
                prop_assert!(slots.rows().len() >= count);
                count = slots.rows().len();
                held = now;
            }
        }
    }
}
