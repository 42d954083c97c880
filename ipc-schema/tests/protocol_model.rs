//! The protocol as a model: every order of steps, deaths and restarts of a small run, looked at exhaustively.
//!
//! One environment: `traffic-bridge`, `sim-core`, `sensor-daemon` with its journal, a trainer with its checkpoints, and the supervisor.
//! Each may die before and after each of its steps. docs/decisions/0029-the-protocol-as-a-model.md says what
//! the model leaves out. Credits are those of [`ipc_schema::flow`].

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

use std::collections::BTreeMap;

use ipc_schema::{board::Progress, flow::has_credit};

/// Ticks of the run.
const TICKS: u8 = 6;
/// Ticks of an episode.
const EPISODE: u8 = 2;
/// Ticks between two commits.
const HORIZON: u8 = 2;
/// Ticks that a producer may be ahead.
const WINDOW: u64 = 2;
/// Places in a queue: the window and two more.
const QUEUE: usize = WINDOW as usize + 2;

/// A guard of the protocol that a test takes away.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    /// All guards are in place.
    None,
    /// `sensor-daemon` sends without credit.
    NoCredit,
    /// `sensor-daemon` does not wait until the trainer has read what an earlier incarnation sent.
    NoTurn,
    /// The trainer accepts observations that are addressed to the trainer before it.
    StaleAddressee,
    /// The journal keeps only what the trainer has not consumed.
    JournalForgetsConsumed,
    /// The simulators start again at the episode of the newest tick instead of the first uncommitted one.
    RestartAtNewest,
    /// `sensor-daemon` leaves when everything is consumed instead of when the trainer is done.
    LeaveWhenConsumed,
    /// The trainer's progress is on the board before the checkpoint has its name.
    CommitBeforeRename,
}

/// An observation on its way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
struct Observation {
    tick: u8,
    sender: u8,
    addressee: u8,
}

/// The whole run at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
struct RunState {
    // The simulators, which start and end together.
    simulators_live: bool,
    simulators_left: bool,
    simulators: u8,
    bridge_sent: u8,
    core_sent: u8,
    sensed: u8,
    // The delivery of `sensor-daemon`.
    journal_first: u8,
    journal_end: u8,
    commits: [u8; 2],
    /// One more than the incarnation of the trainer that it sends to; 0: none yet.
    follows: u8,
    next: u8,
    /// What the run file says about the restart.
    restart_committed: u8,
    restart_sensed: u8,
    /// An observation that `sensor-daemon` has decided to send: the trainer may be replaced before it is sent.
    draft: Option<Observation>,
    // Shared memory: the trainer's queue and its board.
    queue: [Observation; QUEUE],
    queued: u8,
    attached: bool,
    board_consumed: u8,
    board_received: u8,
    board_committed: u8,
    board_sender: u8,
    // The trainer.
    trainer_lives: bool,
    trainer: u8,
    received: u8,
    consumed: u8,
    /// A bit for each tick that the parameters have learnt from.
    learnt: u8,
    done: bool,
    // The newest checkpoint.
    saved: u8,
    saved_learnt: u8,
    // The supervisor's notes.
    noted_committed: u8,
    noted_sensed: u8,
    // Deaths that may still come.
    simulator_deaths: u8,
    trainer_deaths: u8,
}

/// A step of a process, or a death.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    BridgeSends,
    CoreSends,
    SensorMakesTick,
    SensorFollowsTrainer,
    SensorSendsAgain,
    SensorPublishes,
    SensorLeaves,
    TrainerAttaches,
    TrainerReceives,
    TrainerTurns,
    TrainerLearns,
    TrainerRenamesCheckpoint,
    TrainerPublishesCommit,
    TrainerFinishes,
    SupervisorNotes,
    SimulatorsDie,
    SimulatorsStart,
    TrainerDies,
}

const STEPS: [Step; 18] = [
    Step::BridgeSends,
    Step::CoreSends,
    Step::SensorMakesTick,
    Step::SensorFollowsTrainer,
    Step::SensorSendsAgain,
    Step::SensorPublishes,
    Step::SensorLeaves,
    Step::TrainerAttaches,
    Step::TrainerReceives,
    Step::TrainerTurns,
    Step::TrainerLearns,
    Step::TrainerRenamesCheckpoint,
    Step::TrainerPublishesCommit,
    Step::TrainerFinishes,
    Step::SupervisorNotes,
    Step::SimulatorsDie,
    Step::SimulatorsStart,
    Step::TrainerDies,
];

/// The state after a step; `None` if the step is not possible; an error if it breaks a promise.
type Outcome = Result<Option<RunState>, String>;

impl RunState {
    fn begin(simulator_deaths: u8, trainer_deaths: u8) -> Self {
        Self {
            simulators_live: true,
            simulator_deaths,
            trainer_deaths,
            ..Self::default()
        }
    }

    /// The trainer's board as the credits read it.
    fn board(&self) -> Progress {
        Progress {
            consumed_ticks: self.board_consumed.into(),
            received_ticks: self.board_received.into(),
            committed_ticks: self.board_committed.into(),
            attached: self.attached.into(),
            ..Progress::default()
        }
    }

    /// Credit of a simulator that has consumed `consumed` ticks.
    fn simulator_credit(tick: u8, consumed: u8) -> bool {
        let progress = Progress {
            consumed_ticks: consumed.into(),
            attached: 1,
            ..Progress::default()
        };
        has_credit(tick.into(), &progress, WINDOW)
    }

    fn has_turned(&self, fault: Fault) -> bool {
        fault == Fault::NoTurn || self.board_sender == self.simulators
    }

    fn trainer_is_ahead(&self, fault: Fault) -> bool {
        self.attached && (!self.has_turned(fault) || self.board_received > self.journal_end)
    }

    fn has_credit(&self, fault: Fault) -> bool {
        self.attached && (fault == Fault::NoCredit || has_credit(self.next.into(), &self.board(), WINDOW))
    }

    fn may_send(&self, fault: Fault) -> bool {
        self.follows == self.trainer + 1 && self.next == self.journal_end && self.has_credit(fault)
    }

    fn may_keep(&self, fault: Fault) -> bool {
        self.trainer_is_ahead(fault)
            && (self.journal_end < self.restart_sensed
                || self.has_turned(fault) && self.journal_end < self.board_received)
    }

    fn send(&mut self, tick: u8) {
        self.draft = Some(Observation {
            tick,
            sender: self.simulators,
            addressee: self.follows.saturating_sub(1),
        });
    }

    fn sensor_publishes(&mut self) -> Result<bool, String> {
        let Some(observation) = self.draft.take() else {
            return Ok(false);
        };
        // Nothing receives what is sent while no trainer is attached.
        if self.attached {
            let place = self.queue.get_mut(usize::from(self.queued));
            *place.ok_or("the trainer's queue overflows")? = observation;
            self.queued += 1;
        }
        Ok(true)
    }

    fn take(&mut self) -> Observation {
        let first = self.queue[0];
        self.queue.rotate_left(1);
        self.queue[QUEUE - 1] = Observation::default();
        self.queued -= 1;
        first
    }

    fn after(mut self, step: Step, fault: Fault) -> Outcome {
        let simulates = self.simulators_live && !self.simulators_left;
        let trains = self.trainer_lives && !self.done;
        let is_possible = match step {
            Step::SensorMakesTick | Step::SensorFollowsTrainer | Step::SensorSendsAgain | Step::SensorLeaves => {
                simulates && self.draft.is_none()
            }
            Step::BridgeSends | Step::CoreSends | Step::SensorPublishes | Step::SimulatorsDie => simulates,
            Step::TrainerReceives | Step::TrainerTurns | Step::TrainerLearns | Step::TrainerRenamesCheckpoint => trains,
            Step::TrainerPublishesCommit | Step::TrainerFinishes | Step::TrainerDies => trains,
            Step::TrainerAttaches => !self.trainer_lives,
            Step::SimulatorsStart => !self.simulators_live,
            Step::SupervisorNotes => true,
        };
        if !is_possible {
            return Ok(None);
        }
        let happened = match step {
            Step::BridgeSends => self.bridge_sends(),
            Step::CoreSends => self.core_sends(),
            Step::SensorMakesTick => self.sensor_makes_tick(fault),
            Step::SensorFollowsTrainer => self.sensor_follows_trainer(fault)?,
            Step::SensorSendsAgain => self.sensor_sends_again(fault),
            Step::SensorPublishes => self.sensor_publishes()?,
            Step::SensorLeaves => self.sensor_leaves(fault),
            Step::TrainerAttaches => self.trainer_attaches(),
            Step::TrainerReceives => self.trainer_receives(fault)?,
            Step::TrainerTurns => self.trainer_turns(),
            Step::TrainerLearns => self.trainer_learns()?,
            Step::TrainerRenamesCheckpoint => self.trainer_renames(fault),
            Step::TrainerPublishesCommit => self.trainer_publishes(fault),
            Step::TrainerFinishes => self.trainer_finishes(),
            Step::SupervisorNotes => self.supervisor_notes(),
            Step::SimulatorsDie => self.simulators_die(),
            Step::SimulatorsStart => self.simulators_start(fault),
            Step::TrainerDies => self.trainer_dies(),
        };
        Ok(happened.then_some(self))
    }

    fn bridge_sends(&mut self) -> bool {
        let may = self.bridge_sent < TICKS && Self::simulator_credit(self.bridge_sent, self.core_sent);
        self.bridge_sent += u8::from(may);
        may
    }

    fn core_sends(&mut self) -> bool {
        let may = self.core_sent < self.bridge_sent && Self::simulator_credit(self.core_sent, self.sensed);
        self.core_sent += u8::from(may);
        may
    }

    fn sensor_makes_tick(&mut self, fault: Fault) -> bool {
        if self.sensed == self.core_sent {
            return false;
        }
        if self.sensed >= self.restart_committed {
            let is_due = self.may_send(fault);
            if !is_due && !self.may_keep(fault) {
                return false;
            }
            self.journal_end += 1;
            if is_due {
                self.send(self.sensed);
                self.next += 1;
            }
        }
        self.sensed += 1;
        true
    }

    fn sensor_follows_trainer(&mut self, fault: Fault) -> Result<bool, String> {
        let before = *self;
        if !self.attached || self.trainer_is_ahead(fault) {
            return Ok(false);
        }
        if self.follows != self.trainer + 1 {
            if self.board_received == self.board_committed {
                if self.board_received > self.journal_end || self.board_received < self.journal_first {
                    return Err(format!(
                        "the trainer continues at tick {}, the journal has {} to {}",
                        self.board_received, self.journal_first, self.journal_end
                    ));
                }
                self.commits = [self.board_received, self.commits[1].min(self.board_received)];
            }
            self.next = self.board_received;
            self.follows = self.trainer + 1;
        }
        // Chunks of the journal are freed up to the commit before the last.
        if self.board_committed > self.commits[0] {
            self.commits = [self.board_committed, self.commits[0]];
            self.journal_first = self.journal_first.max(self.commits[1]).min(self.journal_end);
        }
        if fault == Fault::JournalForgetsConsumed {
            self.journal_first = self.board_consumed.min(self.journal_end);
        }
        Ok(*self != before)
    }

    fn sensor_sends_again(&mut self, fault: Fault) -> bool {
        let follows = self.follows == self.trainer + 1 && !self.trainer_is_ahead(fault);
        if !follows || self.next >= self.journal_end || !self.has_credit(fault) {
            return false;
        }
        if self.next >= self.journal_first {
            self.send(self.next);
        }
        self.next += 1;
        true
    }

    fn sensor_leaves(&mut self, fault: Fault) -> bool {
        let consumed = fault == Fault::LeaveWhenConsumed && self.board_consumed == TICKS;
        self.simulators_left = self.sensed == TICKS && (self.done || consumed);
        self.simulators_left
    }

    fn trainer_attaches(&mut self) -> bool {
        (self.received, self.consumed, self.learnt) = (self.saved, self.saved, self.saved_learnt);
        (self.board_received, self.board_consumed, self.board_committed) = (self.saved, self.saved, self.saved);
        self.board_sender = 0;
        (self.trainer_lives, self.attached) = (true, true);
        true
    }

    fn trainer_receives(&mut self, fault: Fault) -> Result<bool, String> {
        if self.queued == 0 {
            return Ok(false);
        }
        let observation = self.take();
        let is_stale = observation.addressee < self.trainer && fault != Fault::StaleAddressee;
        let is_of_earlier = observation.sender < self.board_sender;
        let is_repeated = observation.sender > 0 && observation.tick < self.received;
        if is_stale || is_of_earlier || is_repeated {
            return Ok(true);
        }
        if observation.tick != self.received {
            return Err(format!(
                "tick {} arrives, tick {} is expected",
                observation.tick, self.received
            ));
        }
        self.received += 1;
        Ok(true)
    }

    fn trainer_turns(&mut self) -> bool {
        let may = self.queued == 0 && self.simulators_live && self.board_sender != self.simulators;
        if may {
            (self.board_sender, self.board_received) = (self.simulators, self.received);
        }
        may
    }

    fn trainer_learns(&mut self) -> Result<bool, String> {
        if self.consumed == self.received || self.is_due() {
            return Ok(false);
        }
        if self.learnt & 1 << self.consumed != 0 {
            return Err(format!("tick {} is learnt twice", self.consumed));
        }
        self.learnt |= 1 << self.consumed;
        self.consumed += 1;
        self.board_consumed = self.consumed;
        Ok(true)
    }

    /// True if the trainer has to commit before it learns more.
    fn is_due(&self) -> bool {
        self.consumed.is_multiple_of(HORIZON) && (self.consumed > self.saved || self.board_committed != self.saved)
    }

    fn trainer_renames(&mut self, fault: Fault) -> bool {
        let published = fault != Fault::CommitBeforeRename || self.board_committed == self.consumed;
        let may = self.consumed.is_multiple_of(HORIZON) && self.consumed > self.saved && published;
        if may {
            (self.saved, self.saved_learnt) = (self.consumed, self.learnt);
        }
        may
    }

    fn trainer_publishes(&mut self, fault: Fault) -> bool {
        let commit = match fault {
            Fault::CommitBeforeRename if self.consumed.is_multiple_of(HORIZON) => self.consumed,
            _ => self.saved,
        };
        let may = self.board_committed < commit;
        if may {
            self.board_committed = commit;
        }
        may
    }

    fn trainer_finishes(&mut self) -> bool {
        self.done = self.consumed == TICKS && self.saved == TICKS && self.board_committed == TICKS;
        self.done
    }

    fn supervisor_notes(&mut self) -> bool {
        let before = *self;
        if self.attached {
            self.noted_committed = self.noted_committed.max(self.board_committed);
        }
        self.noted_sensed = self.noted_sensed.max(self.sensed);
        *self != before
    }

    fn simulators_die(&mut self) -> bool {
        let may = self.simulator_deaths > 0;
        if may {
            self.simulator_deaths -= 1;
            self.simulators_live = false;
            self.draft = None;
        }
        may
    }

    fn simulators_start(&mut self, fault: Fault) -> bool {
        self.supervisor_notes();
        let committed = self.noted_committed;
        let from = match fault {
            Fault::RestartAtNewest => self.noted_sensed,
            _ => committed,
        };
        let first = from / EPISODE * EPISODE;
        (self.bridge_sent, self.core_sent, self.sensed) = (first, first, first);
        (self.restart_committed, self.restart_sensed) = (committed.max(first), self.noted_sensed);
        (self.journal_first, self.journal_end) = (self.restart_committed, self.restart_committed);
        (self.commits, self.next) = ([self.restart_committed; 2], self.restart_committed);
        self.follows = 0;
        self.simulators += 1;
        self.simulators_live = true;
        true
    }

    fn trainer_dies(&mut self) -> bool {
        if self.trainer_deaths == 0 {
            return false;
        }
        self.trainer_deaths -= 1;
        self.trainer += 1;
        (self.trainer_lives, self.attached) = (false, false);
        // Its queue goes with it. What is sent while no trainer is attached has no credit.
        (self.queue, self.queued) = ([Observation::default(); QUEUE], 0);
        (
            self.board_consumed,
            self.board_received,
            self.board_committed,
            self.board_sender,
        ) = (0, 0, 0, 0);
        (self.received, self.consumed, self.learnt) = (0, 0, 0);
        true
    }

    fn is_over(&self) -> bool {
        self.done && self.simulators_left
    }
}

/// How many states were looked at, or the steps that lead to a broken promise.
fn explore(begin: RunState, fault: Fault) -> Result<usize, String> {
    let mut numbers = BTreeMap::from([(begin, 0_usize)]);
    let mut states = vec![begin];
    let mut reached_by: Vec<Option<(usize, Step)>> = vec![None];
    let mut edges: Vec<(usize, usize)> = Vec::new();
    let mut number = 0;
    while let Some(state) = states.get(number).copied() {
        let mut continues = false;
        for step in STEPS {
            let after = state
                .after(step, fault)
                .map_err(|broken| format!("{broken}\n{}", history(&reached_by, number, Some(step))))?;
            let Some(after) = after else { continue };
            continues |= !matches!(step, Step::SimulatorsDie | Step::TrainerDies | Step::SupervisorNotes);
            let known = numbers.len();
            let next = *numbers.entry(after).or_insert(known);
            if next == known {
                states.push(after);
                reached_by.push(Some((number, step)));
            }
            edges.push((next, number));
        }
        if state.is_over() && state.saved_learnt != (1 << TICKS) - 1 {
            return Err(format!("ticks are lost\n{}", history(&reached_by, number, None)));
        }
        if !continues && !state.is_over() {
            return Err(format!("nothing can happen\n{}", history(&reached_by, number, None)));
        }
        number += 1;
    }
    match never_ending(&states, &mut edges) {
        None => Ok(states.len()),
        Some(state) => Err(format!(
            "the run can no longer end\n{}",
            history(&reached_by, state, None)
        )),
    }
}

/// A state from which no sequence of steps ends the run. `edges` lead from a state to one before it.
fn never_ending(states: &[RunState], edges: &mut [(usize, usize)]) -> Option<usize> {
    edges.sort_unstable();
    let mut ends: Vec<bool> = states.iter().map(RunState::is_over).collect();
    let mut open: Vec<usize> = (0..states.len()).filter(|number| ends[*number]).collect();
    while let Some(state) = open.pop() {
        let first = edges.partition_point(|(to, _)| *to < state);
        for (_, from) in edges[first..].iter().take_while(|(to, _)| *to == state) {
            if !ends[*from] {
                ends[*from] = true;
                open.push(*from);
            }
        }
    }
    ends.iter().position(|ends| !ends)
}

/// The steps from the beginning to state `number`, and the step after it.
fn history(reached_by: &[Option<(usize, Step)>], mut number: usize, last: Option<Step>) -> String {
    let mut steps: Vec<Step> = last.into_iter().collect();
    while let Some((before, step)) = reached_by[number] {
        steps.push(step);
        number = before;
    }
    let steps: Vec<String> = steps.iter().rev().map(|step| format!("{step:?}")).collect();
    steps.join(", ")
}

/// Each tick is learnt exactly once, no queue overflows, and from every state the run can end. `CARAWARE_MODEL_DEATHS` gives other
/// numbers of deaths, such as `3,3`, for a longer look.
#[test]
fn no_order_of_deaths_loses_a_tick_or_stops_the_run() {
    let deaths = std::env::var("CARAWARE_MODEL_DEATHS").unwrap_or_else(|_| "2,2".into());
    let (simulators, trainers) = deaths.split_once(',').unwrap();
    let begin = RunState::begin(simulators.parse().unwrap(), trainers.parse().unwrap());
    let states = explore(begin, Fault::None).unwrap_or_else(|broken| panic!("{broken}"));
    println!("{states} states with {deaths} deaths of the simulators and of the trainer");
    assert!(states > 10_000, "{states}");
}

/// A model that finds nothing proves nothing: without any one guard it shows the steps that break a promise.
#[test]
fn every_guard_is_needed() {
    for fault in [
        Fault::NoCredit,
        Fault::NoTurn,
        Fault::StaleAddressee,
        Fault::JournalForgetsConsumed,
        Fault::RestartAtNewest,
        Fault::LeaveWhenConsumed,
        Fault::CommitBeforeRename,
    ] {
        match explore(RunState::begin(2, 2), fault) {
            Err(broken) => println!("{fault:?}: {broken}\n"),
            Ok(states) => panic!("{fault:?} breaks nothing in {states} states"),
        }
    }
}
