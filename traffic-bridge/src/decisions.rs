//! Which step of the curriculum a lesson belongs to: told by the trainer, by the log of an earlier run, or, where nobody learns, counted.

use std::{
    fs::File,
    io::Write as _,
    path::{Path, PathBuf},
};

use ipc_schema::{
    board::Progress,
    config::Step,
    failure::{Failure, FailureKind},
    ports::BoardReader,
    process::Process,
    run::{Mode, STEP_LOG},
    session::{Session, Wait},
};
use serde::{Deserialize, Serialize};

/// A line of the log: from this lesson on, which begins with this tick, training is in this step, counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct Action {
    lesson: u64,
    tick: u64,
    step: usize,
}

/// Who decides.
enum Judge {
    Trainer(BoardReader),
    Log(Vec<Action>),
    Count(Vec<Step>),
}

/// The steps of all lessons so far.
pub(crate) struct Decisions {
    judge: Judge,
    /// Ticks that a checkpoint has learnt from, in a run that goes on, and what had been decided in them.
    committed_ticks: u64,
    stand: Vec<Action>,
    newest: Option<Action>,
    path: PathBuf,
    log: File,
}

impl Decisions {
    /// None taken yet.
    ///
    /// # Errors
    /// A log cannot be read or written, or the trainer's board cannot be opened.
    pub(crate) fn open(membership: &Session) -> Result<Self, Failure> {
        let run = &membership.run;
        let curriculum = &run.config.curriculum;
        let path = run.run_dir.join(STEP_LOG);
        let judge = match (run.mode, curriculum.log.as_str()) {
            (Mode::Train, _) => Judge::Trainer(membership.board_of(Process::Trainer)?),
            (Mode::Simulate | Mode::Play, "") => Judge::Count(curriculum.steps.clone()),
            (Mode::Simulate | Mode::Play, path) => Judge::Log(read(Path::new(path))?),
        };
        let mut stand = match run.beginning {
            Some(_) => read(&path)?,
            None => Vec::new(),
        };
        // What was decided behind the checkpoint, the trainer decides again. It has decided about a lesson that begins with the tick after.
        stand.retain(|action| action.tick <= run.committed_ticks());
        let log = begin_log(&path, &stand).map_err(|error| unwritten(&path, &error))?;
        Ok(Self {
            judge,
            committed_ticks: run.committed_ticks(),
            newest: stand.last().copied(),
            stand,
            path,
            log,
        })
    }

    /// The step, counted from 0, of `lesson`, which the checkpoint that the run goes on from has behind it.
    pub(crate) fn step_behind(&self, lesson: u64) -> usize {
        logged(&self.stand, lesson)
    }

    /// The step, counted from 0, of `lesson`, which would begin with `tick`; waits for the trainer's word. `None`: asked to stop.
    ///
    /// # Errors
    /// The wake-up is broken, or the log cannot be written.
    pub(crate) fn step_of(&mut self, membership: &Session, lesson: u64, tick: u64) -> Result<Option<usize>, Failure> {
        let step = match &self.judge {
            // SUMO must have taken its input before a trainer is started.
            Judge::Trainer(_) if lesson == 0 => 0,
            Judge::Trainer(_) if tick < self.committed_ticks => return Ok(Some(self.step_behind(lesson))),
            Judge::Trainer(board) => {
                let mut step = None;
                let waited = membership.wait_until(|| {
                    step = Progress::step_of(&board.progress(), lesson);
                    step.is_some()
                })?;
                if waited == Wait::Stopped {
                    return Ok(None);
                }
                step.unwrap_or(0) as usize
            }
            Judge::Log(actions) => logged(actions, lesson),
            Judge::Count(steps) => counted(steps, lesson),
        };
        // What a trainer with other settings says later does not lead back.
        let step = self.newest.map_or(step, |newest| newest.step.max(step));
        if self.newest.is_none_or(|newest| newest.step != step) {
            self.write(Action { lesson, tick, step })?;
        }
        Ok(Some(step))
    }

    fn write(&mut self, action: Action) -> Result<(), Failure> {
        self.newest = Some(action);
        let line = serde_json::to_string(&action).unwrap_or_default();
        writeln!(self.log, "{line}").map_err(|error| unwritten(&self.path, &error))
    }
}

/// The log with the decisions that stand, renamed into place, so that the one before is never half gone; open for those that follow.
fn begin_log(path: &Path, stand: &[Action]) -> std::io::Result<File> {
    let partial = path.with_extension("partial");
    let mut log = File::create(&partial)?;
    for action in stand {
        writeln!(log, "{}", serde_json::to_string(action)?)?;
    }
    std::fs::rename(&partial, path)?;
    Ok(log)
}

/// The step of `lesson` by a log.
fn logged(actions: &[Action], lesson: u64) -> usize {
    let before = actions.iter().take_while(|action| action.lesson <= lesson);
    before.last().map_or(0, |action| action.step)
}

/// The step of `lesson` if nothing but lessons count.
fn counted(steps: &[Step], lesson: u64) -> usize {
    let mut first = 0_u64;
    for (number, step) in steps.iter().enumerate() {
        let Some(lessons) = step.until_lessons else {
            return number;
        };
        first = first.saturating_add(lessons);
        if lesson < first {
            return number;
        }
    }
    steps.len()
}

fn read(path: &Path) -> Result<Vec<Action>, Failure> {
    let unread = |reason: &dyn std::fmt::Display| {
        Failure::new(FailureKind::Config, format!("cannot read {}: {reason}", path.display()))
            .with_help(format!("`curriculum.log` names the {STEP_LOG} in a run directory"))
    };
    let text = std::fs::read_to_string(path).map_err(|error| unread(&error))?;
    let lines = text.lines().map(serde_json::from_str);
    lines.collect::<Result<_, _>>().map_err(|error| unread(&error))
}

fn unwritten(path: &Path, error: &std::io::Error) -> Failure {
    Failure::new(FailureKind::Run, format!("cannot write {}: {error}", path.display()))
        .with_help("check permissions and free space (`caraware doctor`)")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lessons_are_counted_where_nobody_learns() {
        let step = |lessons: Option<u64>| -> Step {
            serde_json::from_value(serde_json::json!({"cavs": 1, "until_lessons": lessons})).unwrap()
        };
        let steps = [step(Some(2)), step(Some(1))];
        assert_eq!([0, 1, 2, 3].map(|lesson| counted(&steps, lesson)), [0, 0, 1, 2]);
        assert_eq!(
            counted(&[step(None), step(Some(1))], 99),
            0,
            "a gate that only a learner passes"
        );
    }

    #[test]
    fn a_log_is_followed() {
        let actions = [(0, 0), (3, 1), (4, 2)].map(|(lesson, step)| Action { lesson, tick: 0, step });
        assert_eq!([0, 2, 3, 4, 9].map(|lesson| logged(&actions, lesson)), [0, 0, 1, 2, 2]);
    }
}
