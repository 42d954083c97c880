//! The phases of one handover: a successor gets ready beside the old trainer, the old trainer leaves, the successor opens its ports.

use std::{
    path::{Path, PathBuf},
    sync::mpsc::Receiver,
    time::{Duration, Instant},
};

use ipc_schema::{
    failure::{Failure, FailureKind},
    run::RunFile,
    storage,
};

use crate::{
    failure::Exit,
    handover::claims::SuccessorClaims,
    running_process::{LeaveTime, RunningProcess},
    socket::{HandoverAnswer, HandoverReport, HandoverRequest, Permission, ReplySocket},
};

/// Name under which a successor writes its failure, beside the other logs.
const SUCCESSOR: &str = "successor";

/// Progress of a handover.
#[derive(Debug)]
enum HandoverPhase {
    /// The successor prepares; the old trainer works, or has been killed meanwhile.
    GettingReady { successor: RunningProcess },
    /// The successor is ready; the old trainer still starts, or the successors of other ranks are not ready.
    Waiting { successor: RunningProcess },
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
    /// The line with which the successor says that it is ready.
    ready_line: Receiver<String>,
    since: Instant,
    /// The old trainer may be asked to leave.
    is_permitted: bool,
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
        ready_line: Receiver<String>,
    ) -> Self {
        Self {
            is_permitted: !request.together,
            request,
            reply,
            run,
            run_file,
            ready_line,
            since: Instant::now(),
            phase: HandoverPhase::GettingReady { successor },
        }
    }

    /// The reason why the successor does not fit the run, whose journal begins at `journal_first`, if it is ready and says so.
    #[must_use]
    pub fn misfit(&self, journal_first: u64) -> Option<String> {
        let line = self.ready_line.try_recv().ok()?;
        match SuccessorClaims::of_line(&line)? {
            Ok(claims) => claims.check(&self.run.config, journal_first).err(),
            Err(error) => Some(format!("it reports what cannot be read: {error}")),
        }
    }

    /// When the old trainer has to leave; `None` if it is killed.
    ///
    /// Of trainers that learn together one may wait for the others' gradients while these wait for a tick: they cannot all leave at the
    /// next tick. So they die, and their successors begin at the newest checkpoint that all have.
    #[must_use]
    pub fn leave_time(&self) -> Option<LeaveTime> {
        match (self.request.now, self.request.together) {
            (false, _) => Some(LeaveTime::NextUpdate),
            (true, false) => Some(LeaveTime::NextTick),
            (true, true) => None,
        }
    }

    /// Notes that the successor is ready.
    #[must_use]
    pub fn successor_ready(mut self, incarnation: u32) -> Self {
        let phase = match self.phase {
            HandoverPhase::GettingReady { successor } if successor.incarnation == incarnation => {
                if !self.is_permitted {
                    self.reply.announce(&HandoverAnswer::Ready);
                }
                HandoverPhase::Waiting { successor }
            }
            phase => phase,
        };
        Self { phase, ..self }
    }

    /// Notes that the old trainer has been asked to leave.
    #[must_use]
    pub fn trainer_asked(self) -> Self {
        let phase = match self.phase {
            HandoverPhase::Waiting { successor } => HandoverPhase::Leaving { successor },
            phase => phase,
        };
        Self { phase, ..self }
    }

    /// The reason of a failed handover: the successor ended, or it was not ready or the old trainer had not left in time.
    ///
    /// A trainer that hangs is found by the watch on stalls, also one that opens its ports.
    pub fn failure(&mut self) -> Option<Failure> {
        let asked = self.request.timeout_s.map(Duration::from_secs_f64);
        let (successor, limit, what) = match &mut self.phase {
            HandoverPhase::GettingReady { successor } => (
                successor,
                Some(asked.unwrap_or_else(|| Duration::from_secs_f64(self.run.config.run.ready_s))),
                "the successor was not ready",
            ),
            // A trainer that does not get ready is killed, and the successor takes over.
            HandoverPhase::Waiting { successor } => (successor, asked, "the old trainer was not ready"),
            // Ranks leave together: one that gave up alone would end the others' steps.
            HandoverPhase::Leaving { successor } if self.request.together => (successor, None, ""),
            HandoverPhase::Leaving { successor } => (successor, asked, "the old trainer had not left"),
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
        if self.look_for_permission() == Permission::Withdrawn {
            let message = "the handover was withdrawn: the old trainer continues";
            return Some(Failure::new(FailureKind::Run, message));
        }
        limit.filter(|limit| self.since.elapsed() > *limit).map(|limit| {
            let message = format!("{what} within {} s: the old trainer continues", limit.as_secs_f64());
            Failure::new(FailureKind::Run, message).with_help(
                "logs/trainer.log in the run directory says what both do; `--now` does not wait for an update",
            )
        })
    }

    /// Notes whether the old trainer may be asked to leave by now.
    fn look_for_permission(&mut self) -> Permission {
        if self.is_permitted {
            return Permission::Given;
        }
        let permission = self.reply.permission();
        self.is_permitted = permission == Permission::Given;
        permission
    }

    /// True if the successors of all ranks are ready and replace trainers that are killed: the end of the old one, whatever ended it, is
    /// what the successor waits for. It may end before it is killed, because it sees that another rank's has been replaced.
    pub fn follows_any_end(&mut self) -> bool {
        self.leave_time().is_none()
            && matches!(self.phase, HandoverPhase::Waiting { .. })
            && self.look_for_permission() == Permission::Given
    }

    /// True if the trainers of other ranks are replaced with this one.
    #[must_use]
    pub fn is_together(&self) -> bool {
        self.request.together
    }

    /// True while the successor prepares.
    #[must_use]
    pub fn is_getting_ready(&self) -> bool {
        matches!(self.phase, HandoverPhase::GettingReady { .. })
    }

    /// True while the old trainer, which has been asked to leave, has not left.
    #[must_use]
    pub fn is_leaving(&self) -> bool {
        matches!(self.phase, HandoverPhase::Leaving { .. })
    }

    /// True while the old trainer of a ready successor may be asked to leave.
    #[must_use]
    pub fn may_ask(&self) -> bool {
        matches!(self.phase, HandoverPhase::Waiting { .. }) && self.is_permitted
    }

    /// The old trainer has left or was killed: returns the ready successor, which has not started its work, and the run as it is from now
    /// on.
    #[must_use]
    pub fn old_trainer_left(self) -> (Self, Option<(RunningProcess, RunFile)>) {
        match self.phase {
            HandoverPhase::Waiting { successor } | HandoverPhase::Leaving { successor } => {
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

/// The run file that a successor is started with. It stays until the run ends: a learner may read it at any time.
pub const SUCCESSOR_RUN_FILE: &str = "run.next.json";

/// Removes the run file of the last successor of a run that has ended.
pub fn remove_successor_run_file(run: &RunFile) {
    remove(&run.run_dir.join(SUCCESSOR_RUN_FILE));
}

/// Writes the run file that a successor is started with atomically, and returns its path.
///
/// # Errors
/// The run directory is not writable, or the disk is full.
pub fn write_successor_run_file(run: &RunFile) -> Result<PathBuf, Exit> {
    let path = run.run_dir.join(SUCCESSOR_RUN_FILE);
    run.to_json()
        .map_err(std::io::Error::from)
        .and_then(|text| storage::write_whole(&path, text))
        .map_err(|error| Exit::io("write", &path, &error))?;
    Ok(path)
}

/// Removes a file, if it is there; an error is only logged.
pub fn remove(path: &Path) {
    if path.exists()
        && let Err(error) = std::fs::remove_file(path)
    {
        tracing::warn!(%error, path = %path.display(), "cannot remove");
    }
}
