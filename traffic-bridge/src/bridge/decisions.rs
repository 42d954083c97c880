//! Which stage of the curriculum a lesson belongs to. The trainer decides; without a trainer the log of an earlier run does, or
//! the number of lessons. That number also decides with several trainers or environments.

use std::{
    fs::File,
    io::Write as _,
    path::{Path, PathBuf},
};

use ipc_schema::{
    config::StageConfig,
    failure::{FILE_HELP, Failure, FailureKind},
    membership::{RunMembership, Wait},
    ports::BoardReader,
    process::Process,
    run::{CURRICULUM_LOG, FORMER_CURRICULUM_LOG, Mode},
    storage,
};
use serde::{Deserialize, Serialize};

/// A line of the log: from this lesson on, which begins with this tick, training is in this stage, counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct StageDecision {
    lesson: u64,
    tick: u64,
    stage: usize,
}

/// Where decisions come from.
enum StageSource {
    Trainer(BoardReader),
    Log(Vec<StageDecision>),
    Count(Vec<StageConfig>),
}

/// The stages of all lessons so far.
pub(crate) struct StageDecisions {
    source: StageSource,
    /// Ticks in the checkpoint of a resumed run, and the decisions that were taken in them.
    committed_ticks: u64,
    kept: Vec<StageDecision>,
    /// The trainer lives: this process was started again, and makes lessons again whose decisions stand in the log.
    is_restart: bool,
    newest: Option<StageDecision>,
    path: PathBuf,
    log: File,
}

impl StageDecisions {
    /// Opens the source of decisions and begins the log.
    ///
    /// # Errors
    /// A log cannot be read or written, or the trainer's board cannot be opened.
    pub(crate) fn open(membership: &RunMembership) -> Result<Self, Failure> {
        let run = &membership.run;
        let curriculum = &run.config.curriculum;
        let path = run.run_dir.join(CURRICULUM_LOG);
        let source = match (run.mode, &curriculum.log) {
            (Mode::Train, _) if run.config.trainer_decides_lessons() => {
                StageSource::Trainer(membership.board_of(Process::Trainer)?)
            }
            (Mode::Train, _) | (Mode::Simulate | Mode::Play, None) => StageSource::Count(curriculum.stages.clone()),
            (Mode::Simulate | Mode::Play, Some(path)) => StageSource::Log(read(path)?),
        };
        let is_restart = run.restart.is_some();
        // Where lessons are counted, nothing has to be known of those before.
        let is_needed = run.beginning.is_some() && !matches!(source, StageSource::Count(_));
        let mut kept = match is_needed || is_restart && path.exists() {
            true => read(&path)?,
            false => Vec::new(),
        };
        // The trainer repeats decisions that are later than the checkpoint. A lesson that begins with the tick after the checkpoint
        // was already decided.
        kept.retain(|decision| is_restart || decision.tick <= run.committed_ticks());
        let log = begin_log(&path, &kept).map_err(|error| unwritten(&path, &error))?;
        Ok(Self {
            source,
            committed_ticks: run.committed_ticks(),
            newest: kept.last().copied(),
            kept,
            is_restart,
            path,
            log,
        })
    }

    /// The stage, counted from 0, of `lesson`, which is in the checkpoint that the run resumes from.
    pub(crate) fn stage_in_checkpoint(&self, lesson: u64) -> usize {
        match &self.source {
            StageSource::Count(stages) => counted(stages, lesson),
            StageSource::Trainer(_) | StageSource::Log(_) => logged(&self.kept, lesson),
        }
    }

    /// The stage, counted from 0, of `lesson`, which would begin with `tick`; waits for the trainer's decision. `None`: the process
    /// was asked to stop.
    ///
    /// # Errors
    /// The wake-up is broken, or the log cannot be written.
    pub(crate) fn stage_of(
        &mut self,
        membership: &RunMembership,
        lesson: u64,
        tick: u64,
    ) -> Result<Option<usize>, Failure> {
        // A lesson that was begun before this process was started again has its stage in the log.
        if self.is_restart && self.kept.last().is_some_and(|newest| lesson <= newest.lesson) {
            return Ok(Some(self.stage_in_checkpoint(lesson)));
        }
        let stage = match &self.source {
            // The trainer starts only after SUMO has accepted its input, so the first lesson cannot wait for it.
            StageSource::Trainer(_) if lesson == 0 => 0,
            StageSource::Trainer(_) if tick < self.committed_ticks => {
                return Ok(Some(self.stage_in_checkpoint(lesson)));
            }
            StageSource::Trainer(board) => {
                let mut decided = None;
                let waited = membership.wait_until(|| {
                    let progress = board.progress();
                    // The board answers for the newest two lessons. Since an earlier one the stage has not changed.
                    decided = match self.is_restart && lesson + 1 < progress.since_lesson {
                        true => u32::try_from(logged(&self.kept, lesson)).ok(),
                        false => progress.stage_of(lesson),
                    };
                    decided.is_some()
                })?;
                match decided {
                    Some(stage) if waited == Wait::Ready => stage as usize,
                    _ => return Ok(None),
                }
            }
            StageSource::Log(decisions) => logged(decisions, lesson),
            StageSource::Count(stages) => counted(stages, lesson),
        };
        // Stages never go back, not even when a trainer with other settings decides.
        let stage = self.newest.map_or(stage, |newest| newest.stage.max(stage));
        if self.newest.is_none_or(|newest| newest.stage != stage) {
            self.write(StageDecision { lesson, tick, stage })?;
        }
        Ok(Some(stage))
    }

    fn write(&mut self, decision: StageDecision) -> Result<(), Failure> {
        self.newest = Some(decision);
        let line = serde_json::to_string(&decision).map_err(std::io::Error::from);
        line.and_then(|line| storage::append_line(&mut self.log, &self.path, &line))
            .map_err(|error| unwritten(&self.path, &error))
    }
}

/// Writes a log with the decisions that are kept and renames it into place, so that the log is complete at any time; it stays open
/// for later decisions.
fn begin_log(path: &Path, kept: &[StageDecision]) -> std::io::Result<File> {
    let partial = path.with_extension("partial");
    let mut log = File::create(&partial)?;
    for decision in kept {
        writeln!(log, "{}", serde_json::to_string(decision)?)?;
    }
    log.sync_all()?;
    std::fs::rename(&partial, path)?;
    Ok(log)
}

/// The stage of `lesson` by a log.
fn logged(decisions: &[StageDecision], lesson: u64) -> usize {
    let before = decisions.iter().take_while(|decision| decision.lesson <= lesson);
    before.last().map_or(0, |decision| decision.stage)
}

/// The stage of `lesson` if only the number of lessons opens gates.
fn counted(stages: &[StageConfig], lesson: u64) -> usize {
    let mut first = 0_u64;
    for (number, stage) in stages.iter().enumerate() {
        let Some(lessons) = stage.until_lessons else {
            return number;
        };
        first = first.saturating_add(lessons);
        if lesson < first {
            return number;
        }
    }
    stages.len()
}

fn read(path: &Path) -> Result<Vec<StageDecision>, Failure> {
    if path.file_name().is_some_and(|name| name == FORMER_CURRICULUM_LOG) {
        return Err(Failure::new(
            FailureKind::Config,
            format!(
                "{} is the name that another version gave to {CURRICULUM_LOG}",
                path.display()
            ),
        )
        .with_help(format!(
            "name the {CURRICULUM_LOG} of a run of this version in `curriculum.log`"
        )));
    }
    let unread = |reason: &dyn std::fmt::Display| {
        Failure::new(FailureKind::Config, format!("cannot read {}: {reason}", path.display())).with_help(format!(
            "`curriculum.log` names the {CURRICULUM_LOG} in a run directory"
        ))
    };
    let text = std::fs::read_to_string(path).map_err(|error| unread(&error))?;
    let lines = text.lines().map(serde_json::from_str);
    lines.collect::<Result<_, _>>().map_err(|error| unread(&error))
}

fn unwritten(path: &Path, error: &std::io::Error) -> Failure {
    Failure::new(FailureKind::Run, format!("cannot write {}: {error}", path.display())).with_help(FILE_HELP)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lessons_are_counted_without_a_learner() {
        let stage = |lessons: Option<u64>| -> StageConfig {
            serde_json::from_value(serde_json::json!({"cavs": 1, "until_lessons": lessons})).unwrap()
        };
        let stages = [stage(Some(2)), stage(Some(1))];
        assert_eq!([0, 1, 2, 3].map(|lesson| counted(&stages, lesson)), [0, 0, 1, 2]);
        assert_eq!(
            counted(&[stage(None), stage(Some(1))], 99),
            0,
            "a gate that only a learner can pass"
        );
    }

    #[test]
    fn a_log_is_followed() {
        let decisions = [(0, 0), (3, 1), (4, 2)].map(|(lesson, stage)| StageDecision { lesson, tick: 0, stage });
        assert_eq!(
            [0, 2, 3, 4, 9].map(|lesson| logged(&decisions, lesson)),
            [0, 0, 1, 2, 2]
        );
    }
}
