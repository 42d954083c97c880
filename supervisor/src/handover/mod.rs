//! Planned handovers: the supervisor replaces the trainer of a live run by a successor while the simulation continues.

pub mod claims;
pub mod phases;
pub mod request;

use std::{
    io::{BufRead as _, BufReader},
    os::unix::process::ExitStatusExt as _,
    path::PathBuf,
    sync::mpsc::{Receiver, channel},
};

use ipc_schema::{
    board::State,
    config::Config,
    failure::{Failure, FailureKind},
    process::Process,
    run::RunFile,
};

use crate::{
    config, display,
    failure::Exit,
    handover::{
        claims::SuccessorClaims,
        phases::{HandoverInProgress, write_successor_run_file},
        request::changed_config,
    },
    processes::{EndedProcess, RunProcesses},
    running_process::RunningProcess,
    socket::{HandoverAnswer, HandoverReport, HandoverRequest, ReplySocket},
};

/// Restarts that a killed successor gets before its first commit.
const MAX_TRIAL_RESTARTS: u32 = 3;

/// The handovers of a run: at most one in progress, and the reports of those completed.
#[derive(Debug, Default)]
pub struct Handovers {
    current: Option<HandoverInProgress>,
    /// The supervisor has asked the trainer to leave: its end with success is no failure.
    is_trainer_leaving: bool,
    completed: Vec<HandoverReport>,
    /// The learners before those that have not committed anything yet: they return if these fail. The oldest first.
    before: Vec<LearnerSettings>,
    /// Restarts of a successor that has committed nothing.
    trial_restarts: u32,
    /// Ticks that were committed when the newest successor attached.
    taken_over_at: Option<u64>,
}

/// The settings with which a learner is started.
#[derive(Debug)]
struct LearnerSettings {
    config: Config,
    config_hash: String,
}

impl Handovers {
    /// Starts a successor beside the working trainer, or refuses the request.
    ///
    /// `report_ready` is called with the successor's incarnation, on another thread, once the successor is ready; it returns false if
    /// the run is over.
    pub fn begin(
        &mut self,
        processes: &RunProcesses,
        request: HandoverRequest,
        reply: ReplySocket,
        report_ready: impl FnOnce(u32) -> bool + Send + 'static,
    ) {
        if let Some(message) = self.obstacle(processes, &request) {
            let failure = Failure::new(FailureKind::Run, message).with_help("`caraware ps` shows the state of the run");
            return reply.answer(&HandoverAnswer::Refused(failure));
        }
        match start_successor(processes, &request, report_ready) {
            Ok((run, run_file, successor, ready_line)) => {
                let handover = HandoverInProgress::new(request, reply, run, run_file, successor, ready_line);
                self.current = Some(handover);
            }
            Err(Exit::Failure(failure)) => reply.answer(&HandoverAnswer::Refused(failure)),
            Err(exit) => {
                let failure = Failure::new(FailureKind::Config, format!("{exit:?}"));
                reply.answer(&HandoverAnswer::Refused(failure));
            }
        }
    }

    /// The reason why no handover can begin now, if there is one.
    fn obstacle(&self, processes: &RunProcesses, request: &HandoverRequest) -> Option<&'static str> {
        let learns_alone = processes.run().config.trainer.ranks == 1;
        match processes.state_of(Process::Trainer) {
            _ if self.current.is_some() => Some("another handover is in progress"),
            _ if !learns_alone && !request.together => {
                Some("the trainer learns together with other ranks, and one rank cannot be replaced alone")
            }
            _ if processes.replaceable().is_none() => Some("the run has no trainer"),
            State::Done => Some("the trainer is done"),
            // A trainer that starts is asked once it is ready.
            State::Starting | State::Ready | State::Running => None,
        }
    }

    /// Lets the successor of this incarnation, which is ready, take over as soon as the old trainer has left; refuses one that does not
    /// fit the run.
    pub fn successor_ready(&mut self, processes: &mut RunProcesses, incarnation: u32) {
        let Some(handover) = self.current.take() else {
            return;
        };
        if let Some(reason) = handover.misfit(processes.journal_first()) {
            let message = format!("the successor is refused, the old trainer continues: {reason}");
            let help = "start it with settings that fit the run, or start another run for it";
            return handover.refuse(Failure::new(FailureKind::Run, message).with_help(help));
        }
        self.current = Some(handover.successor_ready(incarnation));
        self.ask_trainer_to_leave(processes);
    }

    /// Asks the old trainer to leave, if a ready successor waits for that and the trainer can be asked.
    fn ask_trainer_to_leave(&mut self, processes: &mut RunProcesses) {
        let is_working = matches!(processes.state_of(Process::Trainer), State::Ready | State::Running);
        let can_leave =
            |handover: &mut HandoverInProgress| handover.may_ask() && (is_working || handover.leave_time().is_none());
        if let Some(handover) = self.current.take_if(can_leave)
            && let Some(index) = processes.replaceable()
        {
            processes.set_handing_over(true);
            match handover.leave_time() {
                Some(when) => processes.ask_to_leave(index, when),
                None => processes.kill_one(index),
            }
            self.is_trainer_leaving = true;
            self.current = Some(handover.trainer_asked());
        }
    }

    /// Handles the end of the trainer: makes a ready successor the trainer. Returns true if a successor takes over, also one that is
    /// still getting ready; until then the trainer is not started again.
    ///
    /// # Errors
    /// iceoryx2 refuses, or the run file cannot be written. A full disk is waited for.
    pub fn trainer_ended(
        &mut self,
        processes: &mut RunProcesses,
        index: usize,
        ended: &EndedProcess,
    ) -> Result<bool, Exit> {
        let Some(mut handover) = self.current.take() else {
            return Ok(false);
        };
        if handover.is_opening() && !ended.is_done {
            // It is the successor that has ended: it, or the learner before it, is started again.
            self.current = Some(handover);
            return Ok(false);
        }
        // The trainers of other ranks are still at work: the killed one is started again, and all of them meet.
        let was_killed = ended.status.signal().is_some() && !handover.is_together();
        let may_follow = was_killed || self.is_trainer_leaving || handover.follows_any_end();
        if ended.is_done || !may_follow {
            self.current = Some(handover);
            self.refuse_current(
                processes,
                "the trainer ended during the handover",
                "ask again if the run continues",
            );
            return Ok(false);
        }
        if handover.is_getting_ready() {
            self.current = Some(handover);
            return Ok(true);
        }
        let (handover, left) = handover.old_trainer_left();
        self.current = Some(handover);
        let Some((successor, run)) = left else {
            return Ok(false);
        };
        processes.set_handing_over(true);
        processes.set_incarnation(successor.row, 0, successor.incarnation)?;
        processes.wake_sensing();
        run.rewrite()?;
        let RunFile {
            config, config_hash, ..
        } = processes.run().clone();
        self.before.push(LearnerSettings { config, config_hash });
        self.trial_restarts = 0;
        self.taken_over_at = None;
        self.is_trainer_leaving = false;
        processes.install_successor(index, successor, run);
        Ok(true)
    }

    /// Starts the learner before a successor again that has ended before its first commit. Returns false if there is none.
    ///
    /// # Errors
    /// The run file cannot be written, or the learner cannot be started. A full disk is waited for.
    pub fn fall_back(
        &mut self,
        processes: &mut RunProcesses,
        index: usize,
        ended: &EndedProcess,
    ) -> Result<bool, Exit> {
        let Some(LearnerSettings { config, config_hash }) = self.before.pop() else {
            return Ok(false);
        };
        let mut failure = processes.failure(index, ended.status);
        failure.message = format!(
            "the successor is refused, the learner before it returns: {}",
            failure.message
        );
        display::notice(&failure.message);
        let run = RunFile {
            config,
            config_hash,
            ..processes.run().clone()
        };
        run.rewrite()?;
        phases::remove(&Failure::path(&run.run_dir, ended.row.process.name()));
        processes.return_to(run);
        if let Some(handover) = self.current.take() {
            handover.refuse(failure);
        }
        processes.set_handing_over(false);
        self.trial_restarts = 0;
        self.taken_over_at = None;
        self.is_trainer_leaving = false;
        processes.restart(index)?;
        Ok(true)
    }

    /// Counts a restart of a successor that has committed nothing. True if there were too many: whatever kills it, the learner before it
    /// worked.
    pub fn fails_its_trial(&mut self) -> bool {
        self.trial_restarts += u32::from(!self.before.is_empty());
        self.trial_restarts > MAX_TRIAL_RESTARTS
    }

    /// Forgets the learners before one that has committed ticks of its own.
    fn note_commits(&mut self, processes: &RunProcesses) {
        let progress = processes.trainer().progress();
        if self.before.is_empty() || self.is_opening() || progress.attached == 0 {
            return;
        }
        let taken_over_at = *self.taken_over_at.get_or_insert(progress.committed_ticks);
        if progress.committed_ticks > taken_over_at {
            self.before.clear();
        }
    }

    /// Refuses a successor that failed, and completes the handover once the successor has opened its ports.
    pub fn advance(&mut self, processes: &mut RunProcesses) {
        self.note_commits(processes);
        let Some(mut handover) = self.current.take() else {
            return;
        };
        if let Some(failure) = handover.failure() {
            handover.refuse(failure);
            processes.set_handing_over(false);
            return;
        }
        let progress = processes.trainer().progress();
        if handover.is_opening() && progress.attached == 1 {
            processes.set_handing_over(false);
            self.taken_over_at = Some(progress.committed_ticks);
            self.completed.extend(handover.complete(progress.committed_ticks));
        } else {
            self.current = Some(handover);
            self.ask_trainer_to_leave(processes);
        }
    }

    /// Refuses the handover in progress, if there is one.
    pub fn refuse_current(&mut self, processes: &mut RunProcesses, message: &str, help: &str) {
        if let Some(handover) = self.current.take() {
            handover.refuse(Failure::new(FailureKind::Run, message).with_help(help));
            processes.set_handing_over(false);
        }
    }

    /// Drops the handover in progress, which kills its successor.
    pub fn abandon(&mut self) {
        self.current = None;
    }

    /// True while a successor opens its ports.
    #[must_use]
    pub fn is_opening(&self) -> bool {
        self.current.as_ref().is_some_and(HandoverInProgress::is_opening)
    }

    /// True while the old trainer is asked to leave, and a handover may be refused: of trainers that learn together one cannot stay alone.
    #[must_use]
    pub fn may_stay_with_trainer(&self) -> bool {
        let current = self.current.as_ref();
        current.is_some_and(|handover| handover.is_leaving() && !handover.is_together())
    }

    /// True if the end of the trainer is expected.
    #[must_use]
    pub fn is_trainer_leaving(&self) -> bool {
        self.is_trainer_leaving
    }

    /// Forgets the request to leave, which went to the incarnation before this restart.
    pub fn trainer_restarted(&mut self) {
        self.is_trainer_leaving = false;
    }

    /// Takes the reports of the completed handovers.
    pub fn take_reports(&mut self) -> Vec<HandoverReport> {
        std::mem::take(&mut self.completed)
    }
}

/// Starts a successor with the requested changes, and a thread that waits until it reports that it is ready.
fn start_successor(
    processes: &RunProcesses,
    request: &HandoverRequest,
    report_ready: impl FnOnce(u32) -> bool + Send + 'static,
) -> Result<(RunFile, PathBuf, RunningProcess, Receiver<String>), Exit> {
    let config = changed_config(processes.run(), &request.set)?;
    let run = RunFile {
        config_hash: config::hash(&config)?,
        config,
        ..processes.run().clone()
    };
    let run_file = write_successor_run_file(&run)?;
    let (successor, output) = processes.start_successor(&run, &run_file, request)?;
    let incarnation = successor.incarnation;
    let (sender, ready_line) = channel();
    let wait = move || {
        let mut line = String::new();
        let read = output.map(|output| BufReader::new(output).read_line(&mut line));
        let is_ready = matches!(read, Some(Ok(_))) && SuccessorClaims::of_line(&line).is_some();
        if is_ready && (sender.send(line).is_err() || !report_ready(incarnation)) {
            tracing::debug!("a successor is ready, but the run is over");
        }
    };
    std::thread::Builder::new()
        .name("successor".into())
        .spawn(wait)
        .map_err(|error| Exit::run(format!("cannot wait for the successor: {error}"), ""))?;
    Ok((run, run_file, successor, ready_line))
}
