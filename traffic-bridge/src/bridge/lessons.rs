//! Lessons of a curriculum: which map and which road users each has, decided while training goes on.

use std::collections::BTreeMap;

use ipc_schema::{
    failure::Failure,
    header::{LAST_OF_EPISODE, LAST_OF_LESSON, map_flags, step_flags},
    schedule::{Course, Due, Episode, Lesson},
    session::Wait,
};

use super::{Bridge, End, Setting, Stretch, Underway};
use crate::decisions::Decisions;

/// What a map was used for.
#[derive(Debug, Clone, serde::Serialize)]
pub(super) struct Taught {
    pub(super) name: String,
    /// Those that have been given to their end.
    pub(super) lessons: u64,
    pub(super) ticks: u64,
}

impl Bridge {
    /// Runs lessons and evaluations as `course` has them, in the steps that are decided on the way.
    pub(super) fn follow(&mut self, mut course: Course) -> Result<Wait, Failure> {
        let mut decisions = Decisions::open(&self.membership)?;
        let mut underway = self.try_maps()?;
        // What a checkpoint has learnt from, up to the episode that it goes on with, is not made again.
        let first = self.membership.run.start().episode;
        let mut is_behind = first > 0;
        loop {
            let (begins, setting, stretch) = match course.due() {
                Due::Nothing => return Ok(Wait::Ready),
                Due::Evaluation { episode, is_last } => {
                    let stretch = Stretch {
                        is_last,
                        ..Stretch::default()
                    };
                    (Some(episode), Setting::default(), stretch)
                }
                Due::Lesson(number) => {
                    let step = match is_behind {
                        true => Some(decisions.step_behind(number)),
                        false => decisions.step_of(&self.membership, number, self.ticks)?,
                    };
                    let Some(step) = step else {
                        return Ok(Wait::Stopped);
                    };
                    let Some(lesson) = course.enter(step) else {
                        continue;
                    };
                    let Lesson { step, map, begins } = lesson;
                    let past = match begins {
                        Some(_) => 0,
                        None => underway.as_ref().map_or(0, |now| now.frame.step * self.ticks_per_step),
                    };
                    let setting = Setting { step: step + 1, map };
                    (begins, setting, self.lesson(setting, past))
                }
            };
            is_behind &= begins.is_none_or(|episode| episode.index < first);
            if is_behind {
                continue;
            }
            let mut now = match (begins, underway.take()) {
                (Some(episode), before) => self.begin(before, &episode, setting)?,
                (None, Some(now)) => now.go_on()?,
                (None, None) => return Ok(Wait::Ready),
            };
            self.announce(&now.session);
            let before = self.ticks;
            let end = self.run(&mut now, stretch)?;
            if setting.step > 0 {
                let taught = &mut self.taught[setting.map];
                taught.lessons += u64::from(end != End::Stopped);
                taught.ticks += self.ticks - before;
            }
            if end == End::Stopped {
                return Ok(Wait::Stopped);
            }
            underway = Some(now);
        }
    }

    /// The stretch of the lesson that follows, in an episode that has `past` ticks behind it.
    fn lesson(&self, Setting { step, map }: Setting, past: u64) -> Stretch {
        let config = &self.membership.run.config;
        let kind = &config.curriculum.steps[step - 1];
        let ticks = kind.ticks.unwrap_or(config.episode.ticks);
        let ticks = ticks.next_multiple_of(self.ticks_per_step);
        #[expect(
            clippy::cast_possible_truncation,
            reason = "validated: at most 255 steps and 256 maps"
        )]
        let flags = step_flags(step as u8) | map_flags(map as u8);
        Stretch {
            ticks: Some(past + ticks),
            flags,
            last_flags: match kind.restart {
                true => LAST_OF_LESSON | LAST_OF_EPISODE,
                false => LAST_OF_LESSON,
            },
            is_last: false,
        }
    }

    /// Of several maps, each that a step names is tried with that step's road users: one that does not serve is found before the first
    /// tick, not in the last step.
    fn try_maps(&mut self) -> Result<Option<Underway>, Failure> {
        let mut tried = None;
        let run = &self.membership.run;
        if run.maps.is_empty() {
            return Ok(tried);
        }
        let episode = Episode {
            index: 0,
            evaluation: false,
            seed: run.config.run.seed,
            ticks: None,
        };
        let curriculum = run.config.curriculum.clone();
        // Evaluations are on the first, in the base configuration.
        let mut settings = BTreeMap::from([(0, 0)]);
        for (number, step) in (1..).zip(&curriculum.steps) {
            settings.extend(curriculum.maps_of(step).into_iter().map(|map| (map, number)));
        }
        for (map, step) in settings {
            tried = Some(self.begin(tried, &episode, Setting { step, map })?);
        }
        Ok(tried)
    }
}
