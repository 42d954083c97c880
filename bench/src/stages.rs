//! Processor time of a run by stage, from the reports of its processes.

use caraware::failure::Exit;

use super::sides::OurRun;

/// Processor time in the loop by stage, seconds, without loading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StageTimes {
    /// SUMO's own steps.
    pub sumo_s: f64,
    /// Reading every road user and every traffic light out of SUMO.
    pub getters_s: f64,
    /// The rest of the bridge: conversion, sending, waiting for credit.
    pub bridge_s: f64,
    /// Dynamics, contacts, tracking.
    pub dynamics_s: f64,
    /// Sensors, observation, hash, journal.
    pub sensors_s: f64,
    /// The consumer.
    pub consumer_s: f64,
    /// Loading, all processes.
    pub start_s: f64,
    /// Sensed vehicle-steps.
    pub vehicle_steps: f64,
}

impl StageTimes {
    /// Reads the times of a finished run.
    ///
    /// # Errors
    /// The run's report lacks a number.
    pub fn of(ours: &OurRun) -> Result<Self, Exit> {
        let used = |process: &str, what: &str| ours.number(&format!("/processes/{process}/{what}"));
        let in_loop = |process| used(process, "loop_cpu_s");
        let processes = ["traffic-bridge", "sim-core", "sensor-daemon", "trainer"];
        let sumo_s = ours.number("/traffic/sumo_step_s")?;
        let getters_s = ours.number("/traffic/getters_s")? + ours.number("/traffic/signals_s")?;
        let mut start_s = 0.0;
        for name in processes {
            start_s += used(name, "cpu_s")? - in_loop(name)?;
        }
        Ok(Self {
            sumo_s,
            getters_s,
            bridge_s: (in_loop("traffic-bridge")? - sumo_s - getters_s).max(0.0),
            dynamics_s: in_loop("sim-core")?,
            sensors_s: in_loop("sensor-daemon")?,
            consumer_s: in_loop("trainer")?,
            start_s,
            vehicle_steps: ours.number("/vehicle_steps")?,
        })
    }

    /// The stages with their names.
    #[must_use]
    pub fn named(&self) -> [(&'static str, f64); 6] {
        [
            ("SUMO's own step", self.sumo_s),
            ("reading road users out of SUMO", self.getters_s),
            ("conversion and sending", self.bridge_s),
            ("dynamics at 100 Hz", self.dynamics_s),
            ("sensors, observation, hash", self.sensors_s),
            ("consumer's tensor", self.consumer_s),
        ]
    }

    /// All stages together, seconds.
    #[must_use]
    pub fn sum_s(&self) -> f64 {
        self.named().iter().map(|(_, seconds)| seconds).sum()
    }

    /// All stages but SUMO's own step, seconds.
    #[must_use]
    pub fn outside_s(&self) -> f64 {
        self.sum_s() - self.sumo_s
    }

    /// The share of one sensed vehicle-step in `seconds`, microseconds.
    #[must_use]
    pub fn per_step_us(&self, seconds: f64) -> f64 {
        1e6 * seconds / self.vehicle_steps.max(1.0)
    }
}
