//! Commands: received between two steps, executed at the first tick of the next step, and logged.

use std::{
    collections::BTreeMap,
    collections::VecDeque,
    fs::{File, OpenOptions},
    path::{Path, PathBuf},
};

use ipc_schema::{
    control::{
        Action, COMMAND_LOG, COMMAND_REPLAY, Command, Done, EVERY_VEHICLE, MAX_SWITCHES, Refusal, RefusalKind, Reply,
        SWITCHED_ON, SensorSwitch, Switch, actions,
    },
    failure::{FILE_HELP, Failure, FailureKind},
    sensor::SENSORS,
    storage,
    traffic::{Kind, MetaEvent, VehicleMeta, id_hash},
};

use crate::{
    population::{Population, placing::PlacementOutcome},
    sumo::{Sumo, error::SumoError},
};

/// What a command acts on: the simulation between two steps.
pub(crate) struct CommandContext<'a> {
    pub(crate) sumo: &'a mut Sumo,
    /// None in a user's scenario.
    pub(crate) population: Option<&'a mut Population>,
    /// First tick of the next step.
    pub(crate) tick: u64,
    /// Episode of that tick.
    pub(crate) episode: u64,
    /// Steps of the episode so far.
    pub(crate) step: u64,
    /// Ticks in a step.
    pub(crate) ticks_per_step: u64,
    /// Bits of the sensors that any road user of the run carries.
    pub(crate) fitted_sensors: u32,
    /// The run follows a curriculum.
    pub(crate) has_lessons: bool,
    pub(crate) senses_persons: bool,
}

/// Executes commands, logs them, and keeps what they ask of later steps.
#[derive(Debug)]
pub(crate) struct CommandExecutor {
    /// Ticks from this one on are not simulated.
    hold_at: Option<u64>,
    /// The next step is the last of its episode, which then begins again.
    resets: bool,
    switches: Vec<SensorSwitch>,
    /// Kinds of the road users on the road, by the hash of the id.
    present: BTreeMap<u64, u32>,
    log: Option<File>,
    log_path: PathBuf,
    replay: VecDeque<Action>,
    refused: u64,
}

impl CommandExecutor {
    /// Commands for the run in `run_dir`, with the log that it is to replay, if there is one.
    ///
    /// # Errors
    /// The log is unreadable.
    pub(crate) fn of_run(run_dir: &Path) -> Result<Self, Failure> {
        Ok(Self {
            hold_at: None,
            resets: false,
            switches: Vec::new(),
            present: BTreeMap::new(),
            log: None,
            log_path: run_dir.join(COMMAND_LOG),
            replay: replayed(&run_dir.join(COMMAND_REPLAY))?,
            refused: 0,
        })
    }

    /// True while the tick must not be simulated.
    pub(crate) fn holds(&self, tick: u64) -> bool {
        self.hold_at.is_some_and(|hold_at| tick >= hold_at)
    }

    /// True once if the episode begins again after the step that was simulated last.
    pub(crate) fn take_reset(&mut self) -> bool {
        std::mem::take(&mut self.resets)
    }

    /// Sensors switched at the next tick.
    pub(crate) fn take_switches(&mut self) -> Vec<SensorSwitch> {
        std::mem::take(&mut self.switches)
    }

    /// Starts a new episode: no road user is present.
    pub(crate) fn begin_episode(&mut self) {
        self.present.clear();
    }

    /// Tracks which road users are present after a step.
    pub(crate) fn track_presence(&mut self, events: &[VehicleMeta]) {
        for event in events {
            if event.event == MetaEvent::Departed as u32 {
                self.present.insert(event.id_hash, event.kind);
            } else if event.event == MetaEvent::Arrived as u32 {
                self.present.remove(&event.id_hash);
            }
        }
    }

    /// Executes the replayed log's commands for the next tick.
    ///
    /// # Errors
    /// The log does not belong to this run, SUMO fails, or the run's own log cannot be written.
    pub(crate) fn replay(&mut self, context: &mut CommandContext) -> Result<(), Failure> {
        while let Some(action) = self.replay.pop_front_if(|action| action.tick <= context.tick) {
            let astray = |reason: &str| {
                Failure::new(
                    FailureKind::Config,
                    format!(
                        "the command log does not fit this run: {:?} at tick {}: {reason}",
                        action.control, action.tick
                    ),
                )
                .with_help("replay a log with the binary, configuration and seed that wrote it")
            };
            if action.tick < context.tick {
                return Err(astray("no SUMO step begins at that tick"));
            }
            let before = action.refused.is_some();
            match self.act(action.control.clone(), context)? {
                Reply::Done(_) if !before => {}
                Reply::Refused(_) if before => {}
                Reply::Done(_) => return Err(astray("SUMO refused it then and accepts it now")),
                Reply::Refused(refusal) => return Err(astray(&refusal.message)),
            }
        }
        Ok(())
    }

    /// Executes a command and returns the reply.
    ///
    /// # Errors
    /// SUMO fails, or the log cannot be written.
    pub(crate) fn answer(
        &mut self,
        command: Result<Command, Refusal>,
        context: &mut CommandContext,
    ) -> Result<Reply, Failure> {
        let reply = match command {
            Ok(command) => self.act(command, context)?,
            Err(refusal) => Reply::Refused(refusal),
        };
        if let Reply::Refused(refusal) = &reply {
            self.refused += 1;
            tracing::info!("command {} refused: {refusal}", self.refused);
        }
        Ok(reply)
    }

    fn act(&mut self, command: Command, context: &mut CommandContext) -> Result<Reply, Failure> {
        let outcome = self.carry_out(&command, context)?;
        let asked_sumo = |refusal: &Refusal| refusal.kind == RefusalKind::Sumo;
        if command.changes_content() && outcome.as_ref().err().is_none_or(asked_sumo) {
            self.write(&Action {
                tick: context.tick,
                episode: context.episode,
                control: command,
                refused: outcome.as_ref().err().map(|refusal| refusal.message.clone()),
            })?;
        }
        Ok(match outcome {
            Ok(message) => Reply::Done(Done {
                tick: context.tick,
                episode: context.episode,
                message,
            }),
            Err(refusal) => Reply::Refused(refusal),
        })
    }

    fn carry_out(&mut self, command: &Command, context: &mut CommandContext) -> Result<PlacementOutcome, SumoError> {
        Ok(match command {
            Command::Pause {} => {
                self.hold_at = Some(context.tick);
                Ok(format!("paused: tick {} waits", context.tick))
            }
            Command::Resume {} => {
                self.hold_at = None;
                Ok(format!("resumes with tick {}", context.tick))
            }
            Command::Step { ticks } => {
                let ticks = ticks.div_ceil(context.ticks_per_step) * context.ticks_per_step;
                self.hold_at = Some(context.tick + ticks);
                Ok(format!("runs {ticks} ticks, then tick {} waits", context.tick + ticks))
            }
            Command::Reset {} if context.has_lessons => Err(Refusal::new(
                RefusalKind::Unsupported,
                "the run follows a curriculum, whose lessons are not repeated",
            )),
            Command::Reset {} => {
                self.resets = true;
                let next = context.tick + context.ticks_per_step;
                Ok(format!(
                    "episode {} ends and begins again with tick {next}",
                    context.episode
                ))
            }
            Command::Sensor { vehicle, sensor, state } => self
                .switchable(vehicle.as_deref(), sensor.bits(), context)
                .map(|switch| self.switch(switch, vehicle.as_deref(), *state)),
            Command::Start { vehicle, edge } => match &mut context.population {
                Some(population) => population.place_start(context.sumo, vehicle, edge, context.step)?,
                None => Err(Refusal::new(
                    RefusalKind::Unsupported,
                    "the routes of a scenario decide where its vehicles start",
                )),
            },
            Command::Destination { vehicle, edge } => match &mut context.population {
                Some(population) => population.place_destination(context.sumo, vehicle, edge),
                None => self.destination_in_scenario(context.sumo, vehicle, edge),
            },
        })
    }

    /// The switch of a vehicle's sensors, if there is such a vehicle.
    fn switchable(
        &self,
        vehicle: Option<&str>,
        sensors: u32,
        context: &CommandContext,
    ) -> Result<SensorSwitch, Refusal> {
        if self.switches.len() >= MAX_SWITCHES {
            let message = format!("{MAX_SWITCHES} sensors are already switched for this tick: send the command again");
            return Err(Refusal::new(RefusalKind::Busy, message));
        }
        if sensors & context.fitted_sensors == 0 {
            let missing = SENSORS.iter().find(|spec| spec.kind.is_in(sensors));
            let message = missing.map_or_else(String::new, |spec| {
                let name = spec.name;
                format!("no vehicle of this run carries the sensor `{name}` (`{name}.vehicles` = 0)")
            });
            return Err(Refusal::new(RefusalKind::Unsupported, message));
        }
        let id_hash = vehicle.map_or(0, id_hash);
        if let Some(vehicle) = vehicle {
            let kind = self.kind(vehicle)?;
            if kind == Kind::Other as u32 || (kind == Kind::Person as u32 && !context.senses_persons) {
                let message = format!("{vehicle} carries no sensors");
                return Err(Refusal::new(RefusalKind::Unsupported, message));
            }
        }
        Ok(SensorSwitch {
            id_hash,
            sensors,
            flags: if vehicle.is_none() { EVERY_VEHICLE } else { 0 },
        })
    }

    fn switch(&mut self, switch: SensorSwitch, vehicle: Option<&str>, state: Switch) -> String {
        let (bit, word) = match state {
            Switch::On => (SWITCHED_ON, "on"),
            Switch::Off => (0, "off"),
        };
        self.switches.push(SensorSwitch {
            flags: switch.flags | bit,
            ..switch
        });
        format!("sensors of {} are switched {word}", vehicle.unwrap_or("all vehicles"))
    }

    fn destination_in_scenario(&self, sumo: &mut Sumo, vehicle: &str, edge: &str) -> PlacementOutcome {
        match self.kind(vehicle)? {
            kind if kind == Kind::Hero as u32 || kind == Kind::Person as u32 => Err(Refusal::new(
                RefusalKind::Unsupported,
                format!(
                    "the scenario decides where {vehicle} goes: only vehicles that SUMO drives can get another destination"
                ),
            )),
            _ => match sumo.simulation_mut().set_destination(vehicle, edge) {
                Ok(_) => Ok(format!("{vehicle} goes to {edge}")),
                Err(error) => Err(Refusal::new(RefusalKind::Sumo, error.what().trim())),
            },
        }
    }

    fn kind(&self, vehicle: &str) -> Result<u32, Refusal> {
        let unknown = || Refusal::new(RefusalKind::UnknownVehicle, format!("{vehicle} is not on the road now"));
        self.present.get(&id_hash(vehicle)).copied().ok_or_else(unknown)
    }

    /// Writes a line to the file before the tick is simulated: a killed run has its complete log.
    fn write(&mut self, action: &Action) -> Result<(), Failure> {
        let failed = |error: std::io::Error| {
            Failure::new(
                FailureKind::Run,
                format!("cannot write {}: {error}", self.log_path.display()),
            )
            .with_help(FILE_HELP)
        };
        if self.log.is_none() {
            let file = OpenOptions::new().create(true).append(true).open(&self.log_path);
            self.log = Some(file.map_err(failed)?);
        }
        let line = serde_json::to_string(action).map_err(|error| failed(error.into()))?;
        match &mut self.log {
            Some(file) => storage::append_line(file, &self.log_path, &line).map_err(failed),
            None => Ok(()),
        }
    }
}

fn replayed(path: &Path) -> Result<VecDeque<Action>, Failure> {
    let text = match std::fs::read_to_string(path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(VecDeque::new()),
        Err(error) => return Err(broken(path, &error)),
    };
    match actions(&text) {
        Ok(actions) => Ok(actions.into()),
        Err((line, reason)) => Err(broken(path, &format!("line {line}: {reason}"))),
    }
}

fn broken(path: &Path, reason: &dyn std::fmt::Display) -> Failure {
    Failure::new(FailureKind::Config, format!("{}: {reason}", path.display()))
        .with_help("pass a commands.jsonl as a run has written it")
}
