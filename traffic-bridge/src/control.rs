//! Commands: taken between two steps, carried out at the first tick of the next, and logged.

use std::{
    collections::BTreeMap,
    collections::VecDeque,
    fs::{File, OpenOptions},
    io::Write as _,
    path::{Path, PathBuf},
};

use ipc_schema::{
    control::{
        Action, COMMAND_LOG, COMMAND_REPLAY, Command, Done, EVERY_VEHICLE, MAX_SWITCHES, Refusal, RefusalKind, Reply,
        SWITCHED_ON, SensorSwitch, Switch, actions,
    },
    failure::{Failure, FailureKind},
    traffic::{Kind, MetaEvent, VehicleMeta, id_hash},
};

use crate::{error::SumoError, placing::Outcome, population::Population, session::Session};

/// What a command is carried out on: the simulation between two steps.
pub(crate) struct Place<'a> {
    pub(crate) session: &'a mut Session,
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
    pub(crate) has_lidars: bool,
    /// The run follows a curriculum.
    pub(crate) has_lessons: bool,
    pub(crate) senses_persons: bool,
}

/// What commands have left to be done, and how they are remembered.
#[derive(Debug)]
pub(crate) struct Control {
    /// Ticks from this one on are not made.
    hold_at: Option<u64>,
    /// The step about to be made is the last of its episode, which then begins anew.
    resets: bool,
    switches: Vec<SensorSwitch>,
    /// Everybody on the road, by the hash of the id.
    present: BTreeMap<u64, u32>,
    log: Option<File>,
    log_path: PathBuf,
    replay: VecDeque<Action>,
    refused: u64,
}

impl Control {
    /// Commands for the run in `run_dir`, with the actions that it is to follow, if there are any.
    ///
    /// # Errors
    /// The actions are unreadable.
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

    /// True while the tick must not be made.
    pub(crate) fn holds(&self, tick: u64) -> bool {
        self.hold_at.is_some_and(|hold_at| tick >= hold_at)
    }

    /// True once if the episode is to begin anew after the step that has been made.
    pub(crate) fn take_reset(&mut self) -> bool {
        std::mem::take(&mut self.resets)
    }

    /// Sensors switched at the next tick.
    pub(crate) fn take_switches(&mut self) -> Vec<SensorSwitch> {
        std::mem::take(&mut self.switches)
    }

    /// A new episode: nobody is there yet.
    pub(crate) fn begin_episode(&mut self) {
        self.present.clear();
    }

    /// Takes note of who is there after a step.
    pub(crate) fn note(&mut self, events: &[VehicleMeta]) {
        for event in events {
            if event.event == MetaEvent::Departed as u32 {
                self.present.insert(event.id_hash, event.kind);
            } else if event.event == MetaEvent::Arrived as u32 {
                self.present.remove(&event.id_hash);
            }
        }
    }

    /// Carries out what the replayed log has for the next tick.
    ///
    /// # Errors
    /// The log does not belong to this run, SUMO fails, or the run's own log cannot be written.
    pub(crate) fn replay(&mut self, place: &mut Place) -> Result<(), Failure> {
        while let Some(action) = self.replay.pop_front_if(|action| action.tick <= place.tick) {
            let astray = |reason: &str| {
                Failure::new(
                    FailureKind::Config,
                    format!(
                        "the action log does not fit this run: {:?} at tick {}: {reason}",
                        action.control, action.tick
                    ),
                )
                .with_help("follow a log with the binary, configuration and seed that it was written with")
            };
            if action.tick < place.tick {
                return Err(astray("no SUMO step begins at that tick"));
            }
            let before = action.refused.is_some();
            match self.act(action.control.clone(), place)? {
                Reply::Done(_) if !before => {}
                Reply::Refused(_) if before => {}
                Reply::Done(_) => return Err(astray("SUMO refused it then, and takes it now")),
                Reply::Refused(refusal) => return Err(astray(&refusal.message)),
            }
        }
        Ok(())
    }

    /// Answers a command and does what it asks.
    ///
    /// # Errors
    /// SUMO fails, or the log cannot be written.
    pub(crate) fn answer(&mut self, command: Result<Command, Refusal>, place: &mut Place) -> Result<Reply, Failure> {
        let reply = match command {
            Ok(command) => self.act(command, place)?,
            Err(refusal) => Reply::Refused(refusal),
        };
        if let Reply::Refused(refusal) = &reply {
            self.refused += 1;
            tracing::info!("command {} refused: {refusal}", self.refused);
        }
        Ok(reply)
    }

    fn act(&mut self, command: Command, place: &mut Place) -> Result<Reply, Failure> {
        let outcome = self.carry_out(&command, place)?;
        let asked_sumo = |refusal: &Refusal| refusal.kind == RefusalKind::Sumo;
        if command.changes_content() && outcome.as_ref().err().is_none_or(asked_sumo) {
            self.write(&Action {
                tick: place.tick,
                episode: place.episode,
                control: command,
                refused: outcome.as_ref().err().map(|refusal| refusal.message.clone()),
            })?;
        }
        Ok(match outcome {
            Ok(message) => Reply::Done(Done {
                tick: place.tick,
                episode: place.episode,
                message,
            }),
            Err(refusal) => Reply::Refused(refusal),
        })
    }

    fn carry_out(&mut self, command: &Command, place: &mut Place) -> Result<Outcome, SumoError> {
        Ok(match command {
            Command::Pause {} => {
                self.hold_at = Some(place.tick);
                Ok(format!("paused: tick {} waits", place.tick))
            }
            Command::Resume {} => {
                self.hold_at = None;
                Ok(format!("goes on with tick {}", place.tick))
            }
            Command::Step { ticks } => {
                let ticks = ticks.div_ceil(place.ticks_per_step) * place.ticks_per_step;
                self.hold_at = Some(place.tick + ticks);
                Ok(format!("makes {ticks} ticks, then tick {} waits", place.tick + ticks))
            }
            Command::Reset {} if place.has_lessons => Err(Refusal::new(
                RefusalKind::Unsupported,
                "the run follows a curriculum, whose lessons are not repeated",
            )),
            Command::Reset {} => {
                self.resets = true;
                let next = place.tick + place.ticks_per_step;
                Ok(format!(
                    "episode {} ends, and begins anew with tick {next}",
                    place.episode
                ))
            }
            Command::Sensor { vehicle, sensor, state } => self
                .switchable(vehicle.as_deref(), sensor.bits(), place)
                .map(|switch| self.switch(switch, vehicle.as_deref(), *state)),
            Command::Start { vehicle, edge } => match &mut place.population {
                Some(population) => population.place_start(place.session, vehicle, edge, place.step)?,
                None => Err(Refusal::new(
                    RefusalKind::Unsupported,
                    "vehicles of a scenario start where its routes say",
                )),
            },
            Command::Destination { vehicle, edge } => match &mut place.population {
                Some(population) => population.place_destination(place.session, vehicle, edge),
                None => self.destination_in_scenario(place.session, vehicle, edge),
            },
        })
    }

    /// The switch of a vehicle's sensors, if there is such a vehicle.
    fn switchable(&self, vehicle: Option<&str>, sensors: u32, place: &Place) -> Result<SensorSwitch, Refusal> {
        if self.switches.len() >= MAX_SWITCHES {
            let message = format!("{MAX_SWITCHES} sensors have been switched for this tick: ask again");
            return Err(Refusal::new(RefusalKind::Busy, message));
        }
        if sensors == ipc_schema::observation::LIDAR && !place.has_lidars {
            let message = "no vehicle of this run has a LIDAR (`lidar.vehicles` = 0)";
            return Err(Refusal::new(RefusalKind::Unsupported, message));
        }
        let id_hash = vehicle.map_or(0, id_hash);
        if let Some(vehicle) = vehicle {
            let kind = self.kind(vehicle)?;
            if kind == Kind::Other as u32 || (kind == Kind::Person as u32 && !place.senses_persons) {
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

    fn destination_in_scenario(&self, session: &mut Session, vehicle: &str, edge: &str) -> Outcome {
        match self.kind(vehicle)? {
            kind if kind == Kind::Hero as u32 || kind == Kind::Person as u32 => Err(Refusal::new(
                RefusalKind::Unsupported,
                format!("{vehicle} goes where the scenario says: only vehicles that SUMO drives can be led elsewhere"),
            )),
            _ => match session.sumo_mut().set_destination(vehicle, edge) {
                Ok(_) => Ok(format!("{vehicle} goes to {edge}")),
                Err(error) => Err(Refusal::new(RefusalKind::Sumo, error.what().trim())),
            },
        }
    }

    fn kind(&self, vehicle: &str) -> Result<u32, Refusal> {
        let unknown = || Refusal::new(RefusalKind::UnknownVehicle, format!("{vehicle} is not on the road now"));
        self.present.get(&id_hash(vehicle)).copied().ok_or_else(unknown)
    }

    /// Writes a line and hands it to the system before the tick is made: a killed run has its whole log.
    fn write(&mut self, action: &Action) -> Result<(), Failure> {
        let failed = |error: std::io::Error| {
            Failure::new(
                FailureKind::Run,
                format!("cannot write {}: {error}", self.log_path.display()),
            )
            .with_help("check permissions and free space (`caraware doctor`)")
        };
        if self.log.is_none() {
            let file = OpenOptions::new().create(true).append(true).open(&self.log_path);
            self.log = Some(file.map_err(failed)?);
        }
        let line = serde_json::to_string(action).map_err(|error| failed(error.into()))?;
        match &mut self.log {
            Some(file) => writeln!(file, "{line}").map_err(failed),
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
        .with_help("give an commands.jsonl as a run has written it")
}
