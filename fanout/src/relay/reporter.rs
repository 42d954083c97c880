//! The `status` topic: reads the boards of all processes and puts the state of the run together.

use std::time::Duration;

use ipc_schema::{
    board::State,
    header::EVALUATION,
    membership::{MembershipError, RunMembership},
    ports::BoardReader,
    process::Process,
    run::RunFile,
};

use crate::{
    meter::TickRate,
    relay::{pace::RateBudget, ticks::TickTopics},
    status::{self, FanoutCounters, ProcessStatus, RunStatus},
};

/// Puts the status of one environment together.
pub struct StatusReporter {
    env_index: u32,
    boards: Vec<(Process, BoardReader)>,
    /// The trainer's board in environment 0: the trainer writes its progress there, whatever the environment.
    trainer_board: BoardReader,
    rate: TickRate,
    budget: RateBudget,
    /// Age of the run when the fan-out started, wall seconds.
    run_age_s: f64,
}

impl StatusReporter {
    /// Opens the boards.
    ///
    /// # Errors
    /// A board cannot be opened.
    pub fn open(membership: &RunMembership, env_index: u32) -> Result<Self, MembershipError> {
        let boards = Process::ALL
            .into_iter()
            .map(|process| Ok((process, membership.board_of(process)?)))
            .collect::<Result<_, MembershipError>>()?;
        Ok(Self {
            env_index,
            boards,
            trainer_board: membership.board_in(0, Process::Trainer)?,
            rate: TickRate::default(),
            budget: RateBudget::new(membership.run.config.fanout.status_hz),
            run_age_s: status::age_s(membership.run.supervisor_pid),
        })
    }

    /// Number of the environment.
    #[must_use]
    pub fn env_index(&self) -> u32 {
        self.env_index
    }

    /// True if a status is due at `now`; it then counts as published.
    pub fn is_due(&mut self, now: Duration) -> bool {
        let due = self.budget.allows(now);
        if due {
            self.budget.spend(0);
        }
        due
    }

    /// True if the board of `process` says that its work is done.
    #[must_use]
    pub fn is_done(&self, process: Process) -> bool {
        self.boards
            .iter()
            .any(|(of, board)| *of == process && board.health().state == State::Done as u32)
    }

    /// The state of the run at `now`.
    pub fn status(&mut self, run: &RunFile, now: Duration, ticks: &TickTopics, counters: FanoutCounters) -> RunStatus {
        self.rate.update(now, ticks.ticks());
        // The first process is traffic-bridge: its ticks are SUMO's.
        let sumo_ticks = self.boards.first().map_or(0, |(_, board)| board.health().ticks);
        let (newest, figures) = (ticks.newest(), ticks.figures());
        let tick_s = run.config.run.tick_s;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a tick is longer than a nanosecond"
        )]
        let tick_ns = (tick_s * 1e9).round().max(1.0) as u64;
        RunStatus {
            schema_version: run.schema_version,
            run: run.name.clone(),
            run_id: status::run_id_text(run),
            env: self.env_index,
            mode: run.mode,
            tick: newest.tick,
            episode: newest.episode,
            step: (newest.sim_time_ns / tick_ns).saturating_sub(1),
            sim_time_ns: newest.sim_time_ns,
            evaluation: newest.has(EVALUATION),
            run_age_s: self.run_age_s + now.as_secs_f64(),
            ticks_per_s: self.rate.per_s(),
            real_time_factor: self.rate.per_s() * tick_s,
            road_users: figures.road_users,
            sensors: figures.sensors,
            errors_m: figures.errors_m,
            processes: self
                .boards
                .iter()
                .map(|(process, board)| {
                    ProcessStatus::of(run, *process, &board.health(), &board.activity(), sumo_ticks)
                })
                .collect(),
            training: run.mode.has_trainer().then(|| self.trainer_board.training()),
            fanout: counters,
        }
    }
}
