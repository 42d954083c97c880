//! A planned swap under way: a successor gets ready beside the old trainer, the old one leaves, the successor takes its place.

use std::{
    path::PathBuf,
    time::{Duration, Instant},
};

use ipc_schema::{
    failure::{Failure, FailureKind},
    run::RunFile,
};

use crate::{
    failure::Exit,
    process_table::Running,
    swap::{Answer, Asked, Handover},
};

/// Longest time from the start of a successor to its readiness.
const READY_WITHIN: Duration = Duration::from_secs(120);
/// How a successor tells of its failure, beside the other logs.
const SUCCESSOR: &str = "successor";

/// How far a swap is.
#[derive(Debug)]
enum Phase {
    /// The successor gets ready; the old trainer works.
    Preparing { shadow: Running, since: Instant },
    /// The old trainer has been asked to leave.
    Leaving { shadow: Running },
    /// The successor is the trainer, and opens its ports.
    Taking { left: Instant, incarnation: u32 },
}

/// One swap, from the request to the answer. Dropping it kills a successor that has not taken over.
#[derive(Debug)]
pub struct Succession {
    asked: Asked,
    /// The run as the successor sees it.
    run: RunFile,
    /// Where the successor reads it.
    run_file: PathBuf,
    phase: Phase,
}

impl Succession {
    /// A successor has been started.
    #[must_use]
    pub fn new(asked: Asked, run: RunFile, run_file: PathBuf, shadow: Running) -> Self {
        let since = Instant::now();
        Self {
            asked,
            run,
            run_file,
            phase: Phase::Preparing { shadow, since },
        }
    }

    /// The successor says that it is ready. True if it is now the old trainer's turn to leave.
    #[must_use]
    pub fn ready(self, incarnation: u32) -> (Self, bool) {
        match self.phase {
            Phase::Preparing { shadow, .. } if shadow.incarnation == incarnation => {
                let phase = Phase::Leaving { shadow };
                (Self { phase, ..self }, true)
            }
            phase => (Self { phase, ..self }, false),
        }
    }

    /// Why it came to nothing, if it did: the successor ended, or never got ready.
    pub fn failure(&mut self) -> Option<Failure> {
        let (shadow, since) = match &mut self.phase {
            Phase::Preparing { shadow, since } => (shadow, Some(*since)),
            Phase::Leaving { shadow } => (shadow, None),
            Phase::Taking { .. } => return None,
        };
        if let Some(status) = shadow.poll() {
            let mut failure =
                Failure::read(&self.run.run_dir, SUCCESSOR).unwrap_or_else(|| shadow.failure(&self.run, status));
            failure.message = format!("the successor is refused, the trainer goes on: {}", failure.message);
            return Some(failure);
        }
        since.filter(|since| since.elapsed() > READY_WITHIN).map(|_| {
            let message = format!("the successor was not ready within {} s", READY_WITHIN.as_secs());
            Failure::new(FailureKind::Run, message).with_help("its log is logs/trainer.log in the run directory")
        })
    }

    /// True while the old trainer is expected to end.
    #[must_use]
    pub fn is_leaving(&self) -> bool {
        matches!(self.phase, Phase::Leaving { .. })
    }

    /// The old trainer has left: the successor, to be told so, with the run as it is from now on.
    #[must_use]
    pub fn take(self) -> (Self, Option<(Running, RunFile)>) {
        match self.phase {
            Phase::Leaving { shadow } => {
                let phase = Phase::Taking {
                    left: Instant::now(),
                    incarnation: shadow.incarnation,
                };
                let run = self.run.clone();
                (Self { phase, ..self }, Some((shadow, run)))
            }
            phase => (Self { phase, ..self }, None),
        }
    }

    /// True while the successor, which is the trainer now, opens its ports.
    #[must_use]
    pub fn is_taking(&self) -> bool {
        matches!(self.phase, Phase::Taking { .. })
    }

    /// The successor has been given its first tick: answers, and returns what took place.
    #[must_use]
    pub fn done(self, first_tick: u64) -> Option<Handover> {
        self.remove_files();
        let Phase::Taking { left, incarnation } = self.phase else {
            return None;
        };
        let handover = Handover {
            incarnation,
            first_tick,
            pause_s: left.elapsed().as_secs_f64(),
            request: self.asked.request.clone(),
        };
        self.asked.answer(&Answer::Done(handover.clone()));
        Some(handover)
    }

    /// Nothing comes of it.
    pub fn refuse(self, failure: Failure) {
        let Self {
            asked,
            run,
            run_file,
            phase,
        } = self;
        drop(phase);
        remove(&run_file);
        remove(&Failure::path(&run.run_dir, SUCCESSOR));
        asked.refuse(failure);
    }

    fn remove_files(&self) {
        remove(&self.run_file);
    }
}

/// Writes a run file to `run_dir/<name>`, whole or not at all, and returns its path.
///
/// # Errors
/// Not writable.
pub fn write_run(run: &RunFile, name: &str) -> Result<PathBuf, Exit> {
    let path = run.run_dir.join(name);
    let partial = run.run_dir.join(format!(".{name}.partial"));
    let text = serde_json::to_string_pretty(run).unwrap_or_default();
    std::fs::write(&partial, text)
        .and_then(|()| std::fs::rename(&partial, &path))
        .map_err(|error| Exit::io("write", &path, &error))?;
    Ok(path)
}

fn remove(path: &std::path::Path) {
    if path.exists()
        && let Err(error) = std::fs::remove_file(path)
    {
        tracing::warn!(%error, path = %path.display(), "cannot remove");
    }
}
