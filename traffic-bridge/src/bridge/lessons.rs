//! Lessons of a curriculum: their maps and road users, decided while training runs.

use std::collections::BTreeMap;

use ipc_schema::{
    failure::Failure,
    header::{LAST_OF_EPISODE, LAST_OF_LESSON},
    membership::Wait,
    schedule::{CurriculumPlan, DueWork, Episode, Lesson},
};

use super::{
    Bridge,
    decisions::StageDecisions,
    episode::{EpisodeEnd, EpisodeSegment, RunningEpisode, StageMap},
};

/// What a map was used for.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub(super) struct MapUsage {
    name: String,
    /// Lessons that ran to their end.
    lessons: u64,
    ticks: u64,
}

impl MapUsage {
    /// A map without lessons so far.
    pub(super) fn new(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            lessons: 0,
            ticks: 0,
        }
    }
}

impl Bridge {
    /// Runs the lessons and evaluations of `plan`, in the stages that are decided on the way.
    pub(super) fn run_curriculum(&mut self, mut plan: CurriculumPlan) -> Result<Wait, Failure> {
        let mut decisions = StageDecisions::open(&self.membership)?;
        let mut running = self.try_maps()?;
        // Episodes before this one are in the checkpoint and are not simulated again.
        let first = self.membership.run.start().episode;
        let mut is_behind = first > 0;
        loop {
            // Determine the next part: an evaluation, or a lesson with its stage and map.
            let (begins, place, segment) = match plan.due() {
                DueWork::Nothing => return Ok(Wait::Ready),
                DueWork::Evaluation { episode, is_last } => {
                    let segment = EpisodeSegment {
                        is_last,
                        ..EpisodeSegment::default()
                    };
                    (Some(episode), StageMap::default(), segment)
                }
                DueWork::Lesson(number) => {
                    let stage = match is_behind {
                        true => Some(decisions.stage_in_checkpoint(number)),
                        false => decisions.stage_of(&self.membership, number, self.totals.ticks)?,
                    };
                    let Some(stage) = stage else {
                        return Ok(Wait::Stopped);
                    };
                    let Some(lesson) = plan.enter(stage) else {
                        continue;
                    };
                    let Lesson { stage, map, begins } = lesson;
                    let past = match begins {
                        Some(_) => 0,
                        None => running.as_ref().map_or(0, |now| now.frame.step * self.ticks_per_step),
                    };
                    let place = StageMap { stage: stage + 1, map };
                    (begins, place, self.lesson_segment(place, past))
                }
            };

            // Skip what the checkpoint has.
            is_behind &= begins.is_none_or(|episode| episode.index < first);
            if is_behind {
                continue;
            }

            // Begin an episode, or resume the one that is running.
            let mut now = match (begins, running.take()) {
                (Some(episode), before) => self.begin_episode(before, &episode, place)?,
                (None, Some(now)) => now.resume()?,
                (None, None) => return Ok(Wait::Ready),
            };
            self.announce_length(&now.sumo);

            // Run the segment, and count the lesson for its map.
            let before = self.totals.ticks;
            let end = self.run_segment(&mut now, segment)?;
            if place.stage > 0 {
                let usage = &mut self.map_usage[place.map];
                usage.lessons += u64::from(end != EpisodeEnd::Stopped);
                usage.ticks += self.totals.ticks - before;
            }
            if end == EpisodeEnd::Stopped {
                return Ok(Wait::Stopped);
            }
            running = Some(now);
        }
    }

    /// The segment of the next lesson, in an episode that has run for `past` ticks.
    fn lesson_segment(&self, StageMap { stage, map }: StageMap, past: u64) -> EpisodeSegment {
        let config = &self.membership.run.config;
        let kind = &config.curriculum.stages[stage - 1];
        let ticks = kind.ticks.unwrap_or(config.episode.ticks);
        let ticks = ticks.next_multiple_of(self.ticks_per_step);
        #[expect(
            clippy::cast_possible_truncation,
            reason = "validated: at most 255 stages and 256 maps"
        )]
        let (stage, map) = (stage as u16, map as u16);
        EpisodeSegment {
            ticks: Some(past + ticks),
            stage,
            map,
            last_flags: match kind.restart {
                true => LAST_OF_LESSON | LAST_OF_EPISODE,
                false => LAST_OF_LESSON,
            },
            is_last: false,
        }
    }

    /// Of several maps, starts each that a stage names with the road users of that stage: a map that does not serve is found
    /// before the first tick, not in the last stage.
    fn try_maps(&mut self) -> Result<Option<RunningEpisode>, Failure> {
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
        // Evaluations are on the first map, in the base configuration.
        let mut stages = BTreeMap::from([(0, 0)]);
        for (number, stage) in (1..).zip(&curriculum.stages) {
            stages.extend(curriculum.maps_of(stage).into_iter().map(|map| (map, number)));
        }
        for (map, stage) in stages {
            tried = Some(self.begin_episode(tried, &episode, StageMap { stage, map })?);
        }
        Ok(tried)
    }
}
