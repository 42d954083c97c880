//! Times of a run and limits of its vehicles, as the mirror needs them.

use ipc_schema::{
    config::{self, PreviewFrames},
    header::{FIRST_OF_EPISODE, LAST_OF_EPISODE, LAST_OF_LESSON, LAST_OF_RUN, MessageHeader},
    run::RunFile,
    world::most_trailing,
};

use super::suites::SuiteRules;
use crate::models::{catalogue::ModelCatalogue, parameters::ParameterError};

/// Times of a run and limits of its vehicles.
#[derive(Debug, Clone)]
pub struct MirrorSettings {
    /// Models of the vehicles and their limits.
    pub vehicle: config::VehicleConfig,
    /// State of the road surface.
    pub surface: config::Surface,
    /// Length of a tick, seconds.
    pub tick_s: f64,
    /// Nano sub-steps in a tick.
    pub sub_steps: u32,
    /// Ticks in a SUMO step.
    pub ticks_per_step: u32,
    /// What moves the heroes.
    pub hero_driver: config::HeroDriver,
    /// The suites of sensors, if any, for [`ipc_schema::world::SUITES_SHIFT`].
    pub suites: Option<SuiteRules>,
    /// An odometer counts the turns of wheels that slip: the world says by how much.
    pub wheel_slip: bool,
    /// Trailing bodies that a message has room for.
    pub most_trailing: usize,
}

impl MirrorSettings {
    /// The models of these settings.
    ///
    /// # Errors
    /// A class is given a model that does not exist.
    pub fn catalogue(&self) -> Result<ModelCatalogue, ParameterError> {
        ModelCatalogue::new(&self.vehicle, self.surface, self.sub_step_s())
    }

    /// Length of a sub-step, seconds.
    #[must_use]
    pub fn sub_step_s(&self) -> f64 {
        self.tick_s / f64::from(self.sub_steps)
    }

    /// How road users see the path ahead.
    #[must_use]
    pub fn preview(&self) -> Option<PreviewFrames> {
        self.vehicle.preview(self.step_s())
    }

    /// Length of a SUMO step, seconds.
    #[must_use]
    pub fn step_s(&self) -> f64 {
        self.tick_s * f64::from(self.ticks_per_step)
    }

    /// The settings of a run.
    #[must_use]
    pub fn of_run(run: &RunFile) -> Self {
        Self {
            vehicle: run.config.vehicle.clone(),
            surface: run.config.surface(),
            tick_s: run.config.run.tick_s,
            sub_steps: run.config.run.sub_steps,
            ticks_per_step: u32::try_from(run.ticks_per_frame()).unwrap_or(u32::MAX),
            hero_driver: run.config.task.driver,
            suites: SuiteRules::of_run(run),
            wheel_slip: run.config.speed_steering.wheel_slip,
            most_trailing: most_trailing(run.config.traffic.max_road_users as usize),
        }
    }

    /// Header of tick `tick` (0-based within the SUMO step) from the header of the frame; its shape is still the frame's.
    ///
    /// The frame carries number and time of the last of its ticks. The first tick of the step keeps [`FIRST_OF_EPISODE`], the
    /// last [`LAST_OF_EPISODE`], [`LAST_OF_LESSON`] and [`LAST_OF_RUN`].
    #[must_use]
    pub fn tick_header(&self, frame: &MessageHeader, tick: u32) -> MessageHeader {
        let left = self.ticks_per_step.saturating_sub(tick + 1);
        let mut header = *frame;
        header.tick = frame.tick.saturating_sub(u64::from(left));
        header.sim_time_ns = frame
            .sim_time_ns
            .saturating_sub(u64::from(left) * libm::round(self.tick_s * 1e9) as u64);
        header.meta_messages = 0;
        if tick > 0 {
            header.flags &= !FIRST_OF_EPISODE;
        }
        if left > 0 {
            header.flags &= !(LAST_OF_EPISODE | LAST_OF_LESSON | LAST_OF_RUN);
        }
        header
    }
}
