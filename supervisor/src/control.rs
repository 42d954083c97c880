//! `caraware control`: sends a command to a live simulation. The supervisor forwards the command and returns the answer.

use std::time::{Duration, Instant};

use ipc_schema::{
    control::{Command, Refusal, RefusalKind, Reply, Switch},
    failure::{Failure, FailureKind},
    ports::{ControlClient, Pending, PortError},
};

use crate::{
    cli::{ControlAction, ControlArgs, SwitchState},
    failure::Exit,
    registry,
    socket::{ReplySocket, SentRequest, SupervisorRequest},
};

/// Longest time that the supervisor waits for an answer. `traffic-bridge` takes commands between two SUMO steps, also while it waits
/// for the learner.
const ANSWER_WITHIN: Duration = Duration::from_secs(10);

/// Forwards commands from the supervisor's socket to the environments, and their answers back.
pub struct ControlRelay {
    /// One for each environment.
    clients: Vec<ControlClient>,
    waiting: Vec<PendingCommand>,
}

/// A command that at least one environment has not answered yet.
struct PendingCommand {
    /// Environments that have not answered.
    unanswered: Vec<Pending>,
    replies: Vec<Reply>,
    reply: ReplySocket,
    since: Instant,
}

impl PendingCommand {
    /// Collects the answers that have arrived. True once every environment has answered.
    fn collect_replies(&mut self) -> Result<bool, PortError> {
        for pending in std::mem::take(&mut self.unanswered) {
            match pending.reply()? {
                Some(reply) => self.replies.push(reply),
                None => self.unanswered.push(pending),
            }
        }
        Ok(self.unanswered.is_empty())
    }

    /// Sends the answer: the first refusal if an environment refused, else the first reply.
    fn answer(mut self) {
        let refused = self.replies.iter().position(|reply| matches!(reply, Reply::Refused(_)));
        if !self.replies.is_empty() {
            self.reply.answer(&self.replies.swap_remove(refused.unwrap_or(0)));
        }
    }
}

impl ControlRelay {
    /// Creates a relay to the environments of `clients`.
    #[must_use]
    pub fn new(clients: Vec<ControlClient>) -> Self {
        Self {
            clients,
            waiting: Vec::new(),
        }
    }

    /// Forwards a command to one environment, or to all if `env_index` is `None`. The answer goes back over `reply`.
    pub fn forward(&mut self, command: &Command, env_index: Option<u32>, reply: ReplySocket) {
        let index = env_index.map(|index| index as usize);
        let clients = match index {
            None => self.clients.as_slice(),
            Some(index) => self.clients.get(index..=index).unwrap_or_default(),
        };
        if clients.is_empty() {
            let message = format!("the run has {} environments, numbered from 0", self.clients.len());
            return reply.refuse(Refusal::new(RefusalKind::Unsupported, message));
        }
        let mut waiting = PendingCommand {
            unanswered: Vec::new(),
            replies: Vec::new(),
            reply,
            since: Instant::now(),
        };
        for client in clients {
            match client.send(command) {
                Ok(pending) => waiting.unanswered.push(pending),
                Err(refusal) => waiting.replies.push(Reply::Refused(refusal)),
            }
        }
        self.waiting.push(waiting);
    }

    /// Sends the answers that are complete, and refuses commands that were not answered in time.
    ///
    /// # Errors
    /// The port is broken.
    pub fn advance(&mut self) -> Result<(), PortError> {
        for mut waiting in std::mem::take(&mut self.waiting) {
            if waiting.collect_replies()? {
                waiting.answer();
            } else if waiting.since.elapsed() > ANSWER_WITHIN {
                waiting.reply.refuse(Refusal::new(
                    RefusalKind::Unanswered,
                    format!("the simulation has not answered within {} s", ANSWER_WITHIN.as_secs()),
                ));
            } else {
                self.waiting.push(waiting);
            }
        }
        Ok(())
    }

    /// True while an answer is expected.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Refuses all commands that still wait, because the run is over.
    pub fn end(&mut self) {
        for waiting in self.waiting.drain(..) {
            let refusal = Refusal::new(RefusalKind::Unanswered, "the run is over");
            waiting.reply.refuse(refusal);
        }
    }
}

/// Sends a command to a live run and prints the answer.
///
/// # Errors
/// No such run is alive, or the command is refused.
pub fn control(args: &ControlArgs) -> Result<(), Exit> {
    let command = command(&args.action);
    let refused = |refusal: Refusal| {
        let kind = match refusal.kind {
            RefusalKind::Busy | RefusalKind::Sumo | RefusalKind::Unanswered => FailureKind::Run,
            _ => FailureKind::Config,
        };
        let help = match refusal.kind {
            RefusalKind::UnknownVehicle => "the viewer and runs/NAME/events show the ids of all vehicles",
            RefusalKind::UnknownEdge => "`netedit` shows the edges of the net and their ids",
            RefusalKind::Busy => "send the command again",
            RefusalKind::Unanswered => "`caraware ps` shows the state of the run",
            _ => "`caraware control --help` lists the commands",
        };
        Exit::Failure(Failure::new(kind, format!("refused: {refusal}")).with_help(help))
    };
    command.check().map_err(refused)?;
    let run = registry::find(args.run.as_deref())?;
    let request = SupervisorRequest::Control {
        env: args.env,
        request: command
            .to_json()
            .map_err(|error| Exit::run(format!("the command has no form in JSON: {error}"), ""))?,
    };
    match SentRequest::new(&run, &request)?.answer()? {
        Reply::Done(done) => {
            crate::say!("{}: tick {}: {}", run.name, done.tick, done.message);
            Ok(())
        }
        Reply::Refused(refusal) => Err(refused(refusal)),
    }
}

fn command(action: &ControlAction) -> Command {
    match action.clone() {
        ControlAction::Pause => Command::Pause {},
        ControlAction::Resume => Command::Resume {},
        ControlAction::Step { ticks } => Command::Step { ticks },
        ControlAction::Reset => Command::Reset {},
        ControlAction::Sensor { vehicle, sensor, state } => Command::Sensor {
            vehicle: (vehicle != ALL_VEHICLES).then_some(vehicle),
            sensor,
            state: match state {
                SwitchState::On => Switch::On,
                SwitchState::Off => Switch::Off,
            },
        },
        ControlAction::Start { vehicle, edge } => Command::Start { vehicle, edge },
        ControlAction::Destination { vehicle, edge } => Command::Destination { vehicle, edge },
    }
}

/// The word that stands for all vehicles.
const ALL_VEHICLES: &str = "all";
