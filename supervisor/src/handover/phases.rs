//! The phases of one handover: a successor gets ready beside the old trainer, the old trainer leaves, the successor opens its ports.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use ipc_schema::{
    failure::{Failure, FailureKind},
    run::RunFile,
};

use crate::{
    failure::Exit,
    running_process::RunningProcess,
    socket::{HandoverAnswer, HandoverReport, HandoverRequest, ReplySocket},
};

/// Longest time from the start of a successor to its readiness.
const READY_WITHIN: Duration = Duration::from_secs(120);
/// Name under which a successor writes its failure, beside the other logs.
const SUCCESSOR: &str = "successor";

/// Progress of a handover.
#[derive(Debug)]
enum HandoverPhase {
    /// The successor prepares; the old trainer works.
    GettingReady { successor: RunningProcess, since: Instant },
    /// The supervisor has asked the old trainer to leave.
    Leaving { successor: RunningProcess },
    /// The successor is the trainer, and opens its ports.
    Opening { left: Instant, incarnation: u32 },
}

/// One handover from its request to its answer. Dropping it kills a successor that is not yet the trainer.
#[derive(Debug)]
pub struct HandoverInProgress {
    request: HandoverRequest,
    reply: ReplySocket,
    /// The run with the successor's configuration.
    run: RunFile,
    /// The file from which the successor reads the run.
    run_file: PathBuf,
    phase: HandoverPhase,
}

impl HandoverInProgress {
    /// Begins a handover to a successor that has been started.
    #[must_use]
    pub fn new(
        request: HandoverRequest,
        reply: ReplySocket,
        run: RunFile,
        run_file: PathBuf,
        successor: RunningProcess,
    ) -> Self {
        let since = Instant::now();
        Self {
            request,
            reply,
            run,
            run_file,
            phase: HandoverPhase::GettingReady { successor, since },
        }
    }

    /// Notes that the successor is ready. True if the old trainer must leave now.
    #[must_use]
    pub fn successor_ready(self, incarnation: u32) -> (Self, bool) {
        match self.phase {
            HandoverPhase::GettingReady { successor, .. } if successor.incarnation == incarnation => {
                let phase = HandoverPhase::Leaving { successor };
                (Self { phase, ..self }, true)
            }
            phase => (Self { phase, ..self }, false),
        }
    }

    /// The reason of a failed handover: the successor ended, or was not ready in time.
    pub fn failure(&mut self) -> Option<Failure> {
        let (successor, since) = match &mut self.phase {
            HandoverPhase::GettingReady { successor, since } => (successor, Some(*since)),
            HandoverPhase::Leaving { successor } => (successor, None),
            HandoverPhase::Opening { .. } => return None,
        };
        if let Some(status) = successor.poll() {
            let mut failure =
                Failure::read(&self.run.run_dir, SUCCESSOR).unwrap_or_else(|| successor.failure(&self.run, status));
            failure.message = format!(
                "the successor is refused, the old trainer continues: {}",
                failure.message
            );
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
        matches!(self.phase, HandoverPhase::Leaving { .. })
    }

    /// The old trainer has left: returns the successor, which has not started its work, and the run as it is from now on.
    #[must_use]
    pub fn old_trainer_left(self) -> (Self, Option<(RunningProcess, RunFile)>) {
        match self.phase {
            HandoverPhase::Leaving { successor } => {
                let phase = HandoverPhase::Opening {
                    left: Instant::now(),
                    incarnation: successor.incarnation,
                };
                let run = self.run.clone();
                (Self { phase, ..self }, Some((successor, run)))
            }
            phase => (Self { phase, ..self }, None),
        }
    }

    /// True while the successor, which is the trainer now, opens its ports.
    #[must_use]
    pub fn is_opening(&self) -> bool {
        matches!(self.phase, HandoverPhase::Opening { .. })
    }

    /// The successor has received its first tick: sends the answer and returns the report.
    #[must_use]
    pub fn complete(self, first_tick: u64) -> Option<HandoverReport> {
        remove(&self.run_file);
        let HandoverPhase::Opening { left, incarnation } = self.phase else {
            return None;
        };
        let report = HandoverReport {
            incarnation,
            first_tick,
            pause_s: left.elapsed().as_secs_f64(),
            request: self.request,
        };
        self.reply.answer(&HandoverAnswer::Done(report.clone()));
        Some(report)
    }

    /// Ends the successor and answers that nothing has changed.
    pub fn refuse(self, failure: Failure) {
        let Self {
            reply,
            run,
            run_file,
            phase,
            ..
        } = self;
        drop(phase);
        remove(&run_file);
        remove(&Failure::path(&run.run_dir, SUCCESSOR));
        reply.answer(&HandoverAnswer::Refused(failure));
    }
}

/// Writes a run file to `run_dir/<name>` atomically, and returns its path.
///
/// # Errors
/// The run directory is not writable.
pub fn write_run(run: &RunFile, name: &str) -> Result<PathBuf, Exit> {
    let path = run.run_dir.join(name);
    let partial = run.run_dir.join(format!(".{name}.partial"));
    run.to_json()
        .map_err(std::io::Error::from)
        .and_then(|text| std::fs::write(&partial, text))
        .and_then(|()| std::fs::rename(&partial, &path))
        .map_err(|error| Exit::io("write", &path, &error))?;
    Ok(path)
}

fn remove(path: &Path) {
    if path.exists()
        && let Err(error) = std::fs::remove_file(path)
    {
        tracing::warn!(%error, path = %path.display(), "cannot remove");
    }
}
