//! `caraware swap`: replaces the trainer of a live run.

use std::path::{Path, PathBuf};

use ipc_schema::{
    config::Config,
    failure::Failure,
    run::{Mode, RunFile},
};
use serde::{Deserialize, Serialize};

use crate::{
    cli::SwapArgs,
    config::{self, Settings},
    failure::Exit,
    line::{self, Asking, Line},
    registry,
};

/// The only settings that may change in a live run.
const CHANGEABLE: &str = "trainer.";

/// What the command asks of the supervisor: one line of JSON.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Request {
    /// Assignments, as after `--set`.
    pub set: Vec<String>,
    /// A checkpoint directory to take parameters from, instead of the newest of the run.
    pub checkpoint: Option<PathBuf>,
}

/// What the supervisor answers: one line of JSON.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Answer {
    /// The successor is at work.
    Done(Handover),
    /// Everything is as before.
    Refused(Failure),
}

/// A swap that has taken place.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Handover {
    /// Which trainer of the run this is; the first is 0.
    pub incarnation: u32,
    /// The first tick that it was given.
    pub first_tick: u64,
    /// Wall seconds from the end of the old trainer to the first tick of the new.
    pub pause_s: f64,
    /// What was asked for.
    pub request: Request,
}

/// A request and the way back.
#[derive(Debug)]
pub struct Asked {
    /// What is asked.
    pub request: Request,
    line: Line,
}

impl Asked {
    /// A request that came over `line`.
    #[must_use]
    pub fn new(request: Request, line: Line) -> Self {
        Self { request, line }
    }

    /// Answers; a command that has gone meanwhile is not missed.
    pub fn answer(self, answer: &Answer) {
        self.line.answer(answer);
    }

    /// Answers that nothing has changed.
    pub fn refuse(self, failure: Failure) {
        self.answer(&Answer::Refused(failure));
    }
}

/// The configuration of `run` with other settings of the trainer.
///
/// # Errors
/// A key or value is wrong, or does not belong to the trainer.
pub fn changed(run: &RunFile, set: &[String]) -> Result<Config, Exit> {
    for assignment in set {
        let key = assignment.split('=').next().unwrap_or_default().trim();
        if config::keys::KEYS.iter().any(|known| known.path == key) && !key.starts_with(CHANGEABLE) {
            return Err(Exit::config(
                format!("`{key}` cannot change in a live run"),
                "a swap replaces the trainer: only keys of `trainer` may differ",
            ));
        }
    }
    Ok(Settings::of(&run.config)?.with_assignments(set)?.validate()?)
}

/// The checkpoint directory that the user named.
fn checkpoint(path: &Path) -> Result<PathBuf, Exit> {
    let path = std::path::absolute(path).map_err(|error| Exit::io("resolve", path, &error))?;
    if path.join("manifest.json").is_file() {
        return Ok(path);
    }
    Err(Exit::config(
        format!("{} is not a checkpoint: it has no manifest.json", path.display()),
        "give a directory like runs/NAME/checkpoints/update-000100",
    ))
}

/// Asks the supervisor of a run for another trainer and waits for its answer.
///
/// # Errors
/// The request is wrong or refused, or no such run is alive.
pub fn swap(args: &SwapArgs) -> Result<(), Exit> {
    let run = registry::find(args.run.as_deref())?;
    if run.mode != Mode::Train {
        return Err(Exit::config(
            format!("{} has no trainer", run.name),
            "`caraware simulate` only simulates; `caraware train` learns",
        ));
    }
    changed(&run, &args.set)?;
    let request = Request {
        set: args.set.clone(),
        checkpoint: args.checkpoint.as_deref().map(checkpoint).transpose()?,
    };
    match line::ask(&run, &Asking::Swap(request))? {
        Answer::Done(handover) => {
            println!(
                "{}: trainer {} has taken over at tick {}; the hand-over took {:.2} s",
                run.name, handover.incarnation, handover.first_tick, handover.pause_s
            );
            Ok(())
        }
        Answer::Refused(failure) => Err(failure.into()),
    }
}
