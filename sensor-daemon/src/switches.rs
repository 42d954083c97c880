//! Sensors that commands have switched off. A switch holds from its tick to the end of the episode.

use std::collections::{BTreeMap, VecDeque};

use ipc_schema::{
    block::{self, BlockError},
    control::{EVERY_VEHICLE, SWITCHED_ON, SensorSwitch, SensorSwitchLayout},
    ports::{PortError, Subscriber},
};

/// Switches that wait for their tick, and those in force.
#[derive(Debug, Clone, Default)]
pub struct SensorSwitches {
    waiting: VecDeque<(u64, SensorSwitch)>,
    /// Sensors that are off for every vehicle without an entry of its own.
    off: u32,
    /// Sensors that are off, for each vehicle that has been switched individually.
    off_for: BTreeMap<u64, u32>,
    /// A switch has come into force in this episode.
    in_use: bool,
}

impl SensorSwitches {
    /// Receives all switches in the queue: those of a tick are sent before the tick itself.
    ///
    /// # Errors
    /// The port is broken.
    pub fn receive(&mut self, port: &Subscriber) -> Result<Result<(), BlockError>, PortError> {
        while let Some(message) = port.receive()? {
            let header = message.header();
            match block::view::<SensorSwitch>(message.payload(), SensorSwitchLayout::of(header).switches) {
                Ok(switches) => self
                    .waiting
                    .extend(switches.iter().map(|switch| (header.tick, *switch))),
                Err(error) => return Ok(Err(error)),
            }
        }
        Ok(Ok(()))
    }

    /// Adds a switch at `tick`, not before the last one.
    pub fn push(&mut self, tick: u64, switch: SensorSwitch) {
        self.waiting.push_back((tick, switch));
    }

    /// Begins an episode: all sensors are on.
    pub fn begin_episode(&mut self) {
        (self.off, self.in_use) = (0, false);
        self.off_for.clear();
    }

    /// Applies the switches up to `tick`.
    pub fn advance(&mut self, tick: u64) {
        while let Some((_, switch)) = self.waiting.pop_front_if(|(at, _)| *at <= tick) {
            self.switch(&switch);
        }
    }

    fn switch(&mut self, switch: &SensorSwitch) {
        self.in_use = true;
        let set = |bits: &mut u32| match switch.flags & SWITCHED_ON {
            0 => *bits |= switch.sensors,
            _ => *bits &= !switch.sensors,
        };
        if switch.flags & EVERY_VEHICLE == 0 {
            let off = self.off;
            set(self.off_for.entry(switch.id_hash).or_insert(off));
        } else {
            set(&mut self.off);
            self.off_for.values_mut().for_each(set);
        }
    }

    /// True if a switch has come into force in this episode.
    #[must_use]
    #[inline]
    pub fn in_use(&self) -> bool {
        self.in_use
    }

    /// Sensors of the vehicle that are off.
    #[must_use]
    pub fn off(&self, id_hash: u64) -> u32 {
        self.off_for.get(&id_hash).copied().unwrap_or(self.off)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_schema::sensor::SensorKind;

    const GNSS: u32 = SensorKind::Gnss.bit();
    const IMU: u32 = SensorKind::Imu.bit();

    fn switch(id_hash: u64, sensors: u32, flags: u32) -> SensorSwitch {
        SensorSwitch {
            id_hash,
            sensors,
            flags,
        }
    }

    #[test]
    fn a_switch_holds_from_its_tick_to_the_end_of_the_episode() {
        let mut switches = SensorSwitches::default();
        switches.push(3, switch(7, GNSS, 0));
        switches.push(5, switch(7, GNSS, SWITCHED_ON));
        switches.push(6, switch(7, IMU, 0));
        switches.advance(2);
        assert!(!switches.in_use());
        switches.advance(3);
        assert_eq!((switches.off(7), switches.off(8)), (GNSS, 0));
        switches.advance(5);
        assert_eq!(switches.off(7), 0);
        switches.advance(6);
        assert_eq!(switches.off(7), IMU);
        switches.begin_episode();
        assert_eq!((switches.off(7), switches.in_use()), (0, false));
    }

    #[test]
    fn the_last_switch_holds_for_one_vehicle_and_for_all() {
        let mut switches = SensorSwitches::default();
        switches.push(0, switch(0, GNSS | IMU, EVERY_VEHICLE));
        switches.push(0, switch(7, GNSS, SWITCHED_ON));
        switches.advance(0);
        assert_eq!((switches.off(7), switches.off(8)), (IMU, GNSS | IMU));
        switches.push(1, switch(0, IMU, EVERY_VEHICLE | SWITCHED_ON));
        switches.advance(1);
        assert_eq!((switches.off(7), switches.off(8)), (0, GNSS));
    }
}
