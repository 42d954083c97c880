//! Planned handovers: the supervisor replaces the trainer of a live run by a successor while the simulation continues.

pub mod phases;
pub mod request;

use std::{
    io::{BufRead as _, BufReader},
    path::PathBuf,
};

use ipc_schema::{
    board::State,
    failure::{Failure, FailureKind},
    process::Process,
    run::RunFile,
};

use crate::{
    config,
    failure::Exit,
    handover::{
        phases::{HandoverInProgress, write_run},
        request::changed_config,
    },
    processes::RunProcesses,
    running_process::RunningProcess,
    socket::{HandoverAnswer, HandoverReport, HandoverRequest, ReplySocket},
};

/// The handovers of a run: at most one in progress, and the reports of those completed.
#[derive(Debug, Default)]
pub struct Handovers {
    current: Option<HandoverInProgress>,
    /// The supervisor has asked the trainer to leave: its end with success is no failure.
    is_trainer_leaving: bool,
    completed: Vec<HandoverReport>,
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
        if let Some(message) = self.obstacle(processes) {
            let failure = Failure::new(FailureKind::Run, message).with_help("`caraware ps` shows the state of the run");
            return reply.answer(&HandoverAnswer::Refused(failure));
        }
        match start_successor(processes, &request, report_ready) {
            Ok((run, run_file, successor)) => {
                self.current = Some(HandoverInProgress::new(request, reply, run, run_file, successor));
            }
            Err(Exit::Failure(failure)) => reply.answer(&HandoverAnswer::Refused(failure)),
            Err(exit) => {
                let failure = Failure::new(FailureKind::Config, format!("{exit:?}"));
                reply.answer(&HandoverAnswer::Refused(failure));
            }
        }
    }

    /// The reason why no handover can begin now, if there is one.
    fn obstacle(&self, processes: &RunProcesses) -> Option<&'static str> {
        let learns_alone = processes.run().config.trainer.ranks == 1;
        match processes.state_of(Process::Trainer) {
            _ if self.current.is_some() => Some("another handover is in progress"),
            _ if !learns_alone => {
                Some("the trainer learns together with other ranks, and one rank cannot be replaced alone")
            }
            _ if processes.replaceable().is_none() => Some("the run has no trainer"),
            State::Starting => Some("the trainer is still starting"),
            State::Done => Some("the trainer is done"),
            State::Ready | State::Running => None,
        }
    }

    /// Asks the old trainer to leave, because the successor of this incarnation is ready.
    pub fn successor_ready(&mut self, processes: &mut RunProcesses, incarnation: u32) {
        let Some(handover) = self.current.take() else {
            return;
        };
        let (handover, leave) = handover.successor_ready(incarnation);
        self.current = Some(handover);
        if leave && let Some(index) = processes.replaceable() {
            processes.set_handing_over(true);
            processes.ask_to_leave(index);
            self.is_trainer_leaving = true;
        }
    }

    /// Handles the end of the trainer: makes the waiting successor the trainer and returns true. Returns false if none waits.
    ///
    /// # Errors
    /// The run holds no more successors, or the run file cannot be written.
    pub fn trainer_ended(&mut self, processes: &mut RunProcesses, index: usize, is_done: bool) -> Result<bool, Exit> {
        let Some(handover) = self.current.take() else {
            return Ok(false);
        };
        if is_done || !handover.is_leaving() {
            self.current = Some(handover);
            self.refuse_current(
                processes,
                "the trainer ended during the handover",
                "ask again if the run continues",
            );
            return Ok(false);
        }
        let (handover, left) = handover.old_trainer_left();
        self.current = Some(handover);
        let Some((successor, run)) = left else {
            return Ok(false);
        };
        if !processes.set_incarnation(successor.row, 0, successor.incarnation) {
            return Err(Exit::run("a run holds no more successors", "start another run"));
        }
        processes.wake_sensing();
        write_run(&run, "run.json")?;
        self.is_trainer_leaving = false;
        processes.install_successor(index, successor, run);
        Ok(true)
    }

    /// Refuses a successor that failed, and completes the handover once the successor has opened its ports.
    pub fn advance(&mut self, processes: &mut RunProcesses) {
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
            self.completed.extend(handover.complete(progress.committed_ticks));
        } else {
            self.current = Some(handover);
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
) -> Result<(RunFile, PathBuf, RunningProcess), Exit> {
    let config = changed_config(processes.run(), &request.set)?;
    let run = RunFile {
        config_hash: config::hash(&config)?,
        config,
        ..processes.run().clone()
    };
    let run_file = write_run(&run, "run.next.json")?;
    let (successor, output) = processes.start_successor(&run, &run_file, request.checkpoint.as_ref())?;
    let incarnation = successor.incarnation;
    let wait = move || {
        let mut line = String::new();
        let read = output.map(|output| BufReader::new(output).read_line(&mut line));
        if matches!(read, Some(Ok(_))) && line == "ready\n" && !report_ready(incarnation) {
            tracing::debug!("a successor is ready, but the run is over");
        }
    };
    std::thread::Builder::new()
        .name("successor".into())
        .spawn(wait)
        .map_err(|error| Exit::run(format!("cannot wait for the successor: {error}"), ""))?;
    Ok((run, run_file, successor))
}
