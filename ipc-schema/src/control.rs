//! Commands to a running simulation, their answers, and the form of both in JSON and in shared memory.
//!
//! In JSON (`caraware control`, zenoh) a request is `{"schema_version": N, "control": {"command": "pause"}}`, and an answer
//! `{"done": {…}}` or `{"refused": {…}}`. Between the supervisor and `traffic-bridge` both are records of the service `control`.

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;
use serde::{Deserialize, Serialize};

use crate::{SCHEMA_VERSION, section::payload_layout, sensor::SensorSelection};

/// Longest id of a vehicle or an edge in a command, bytes.
pub const ID_BYTES: usize = 128;
/// Longest message of an answer, bytes; longer ones are cut.
pub const ANSWER_BYTES: usize = 256;
/// Longest request in JSON, bytes.
pub const MAX_REQUEST_BYTES: usize = 4096;
/// Most sensor switches that take effect at one SUMO step.
pub const MAX_SWITCHES: usize = 64;
/// Most ticks in one `step`.
pub const MAX_STEP_TICKS: u64 = 1_000_000_000;

/// A command to a running simulation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "command", rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// Stop making ticks.
    Pause {},
    /// Continue making ticks.
    Resume {},
    /// Make this many ticks, in whole SUMO steps, and pause.
    Step {
        /// Number of ticks, at least 1.
        ticks: u64,
    },
    /// Start the episode again, with its own seed.
    Reset {},
    /// Switch a sensor until the episode ends.
    Sensor {
        /// SUMO's id of the vehicle; `None` stands for all vehicles.
        vehicle: Option<String>,
        /// The sensor, or all of them.
        sensor: SensorSelection,
        /// The new state.
        state: Switch,
    },
    /// Start the vehicle again from an edge.
    Start {
        /// SUMO's id of the vehicle.
        vehicle: String,
        /// SUMO's id of the edge.
        edge: String,
    },
    /// Send the vehicle to an edge.
    Destination {
        /// SUMO's id of the vehicle.
        vehicle: String,
        /// SUMO's id of the edge.
        edge: String,
    },
}

/// State of a switched sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Switch {
    /// The sensor delivers nothing.
    Off,
    /// The sensor delivers samples.
    On,
}

impl Command {
    /// True if the command changes the content of ticks; false if it only changes when they are made.
    #[must_use]
    pub fn changes_content(&self) -> bool {
        !matches!(self, Self::Pause {} | Self::Resume {} | Self::Step { .. })
    }

    /// Checks what can be checked without the simulation.
    ///
    /// # Errors
    /// A number out of range, or an id that is empty or too long.
    pub fn check(&self) -> Result<(), Refusal> {
        let malformed = |message: String| Err(Refusal::new(RefusalKind::Malformed, message));
        if let Self::Step { ticks } = self
            && !(1..=MAX_STEP_TICKS).contains(ticks)
        {
            return malformed(format!("a step has 1 to {MAX_STEP_TICKS} ticks, not {ticks}"));
        }
        let (vehicle, edge) = self.ids();
        for (what, id) in [("vehicle", vehicle), ("edge", edge)] {
            if let Some(id) = id
                && !(1..=ID_BYTES).contains(&id.len())
            {
                return malformed(format!(
                    "the id of a {what} has 1 to {ID_BYTES} bytes, not {}",
                    id.len()
                ));
            }
        }
        Ok(())
    }

    /// The vehicle and the edge that the command names.
    fn ids(&self) -> (Option<&str>, Option<&str>) {
        match self {
            Self::Pause {} | Self::Resume {} | Self::Step { .. } | Self::Reset {} => (None, None),
            Self::Sensor { vehicle, .. } => (vehicle.as_deref(), None),
            Self::Start { vehicle, edge } | Self::Destination { vehicle, edge } => (Some(vehicle), Some(edge)),
        }
    }

    /// The request as JSON.
    ///
    /// # Errors
    /// Never: a command holds words and numbers alone.
    pub fn to_json(&self) -> Result<String, serde_json::Error> {
        serde_json::to_string(&Request {
            schema_version: SCHEMA_VERSION,
            control: self.clone(),
        })
    }

    /// Reads and checks a request in JSON, which may come from any client.
    ///
    /// # Errors
    /// The request is too long, is not a request in JSON, has another schema version, or holds a value out of range.
    pub fn from_json(bytes: &[u8]) -> Result<Self, Refusal> {
        if bytes.len() > MAX_REQUEST_BYTES {
            let message = format!(
                "a request has at most {MAX_REQUEST_BYTES} bytes, this one {}",
                bytes.len()
            );
            return Err(Refusal::new(RefusalKind::Malformed, message));
        }
        let malformed =
            |error: serde_json::Error| Refusal::new(RefusalKind::Malformed, format!("not a request: {error}"));
        let version: Version = serde_json::from_slice(bytes).map_err(malformed)?;
        if version.schema_version != SCHEMA_VERSION {
            return Err(Refusal::schema(version.schema_version));
        }
        let request: Request = serde_json::from_slice(bytes).map_err(malformed)?;
        request.control.check()?;
        Ok(request.control)
    }
}

/// The part of a request that is the same in every version.
#[derive(Deserialize)]
struct Version {
    schema_version: u32,
}

/// A request in JSON.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Request {
    schema_version: u32,
    control: Command,
}

/// The answer to a command.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reply {
    /// The command takes effect.
    Done(Done),
    /// The command changes nothing.
    Refused(Refusal),
}

/// A command that takes effect.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Done {
    /// First tick with its effect.
    pub tick: u64,
    /// Episode of that tick.
    pub episode: u64,
    /// Its effect as a sentence.
    pub message: String,
}

/// A refused command with its reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[error("{message}")]
pub struct Refusal {
    /// The reason.
    pub kind: RefusalKind,
    /// The reason as a sentence.
    pub message: String,
}

/// Reasons to refuse a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
pub enum RefusalKind {
    /// It is not a request, it is too long, or a value is out of range.
    Malformed = 1,
    /// It has another schema version.
    Schema = 2,
    /// The vehicle is not in the simulation now.
    UnknownVehicle = 3,
    /// The edge does not exist, or the vehicle may not use it.
    UnknownEdge = 4,
    /// This run or this vehicle does not support the command.
    Unsupported = 5,
    /// Too many commands are under way: send it again.
    Busy = 6,
    /// SUMO refuses.
    Sumo = 7,
    /// The simulation does not answer, or the run is over.
    Unanswered = 8,
}

impl RefusalKind {
    const ALL: [Self; 8] = [
        Self::Malformed,
        Self::Schema,
        Self::UnknownVehicle,
        Self::UnknownEdge,
        Self::Unsupported,
        Self::Busy,
        Self::Sumo,
        Self::Unanswered,
    ];
}

impl Refusal {
    /// A refusal for this reason.
    #[must_use]
    pub fn new(kind: RefusalKind, message: impl Into<String>) -> Self {
        Self {
            kind,
            message: message.into(),
        }
    }

    fn schema(found: u32) -> Self {
        let message = format!("the request has schema version {found}, this run has {SCHEMA_VERSION}");
        Self::new(RefusalKind::Schema, message)
    }
}

/// One line of a log of commands: a command and the tick at which it took effect.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Action {
    /// First tick with its effect.
    pub tick: u64,
    /// Episode of that tick.
    pub episode: u64,
    /// The command.
    pub control: Command,
    /// SUMO's message if SUMO refused the command, which is logged all the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

/// Name of the log of commands in the run directory.
pub const COMMAND_LOG: &str = "commands.jsonl";
/// Name of the log that the run repeats, in the run directory.
pub const COMMAND_REPLAY: &str = "commands.replay.jsonl";

/// Reads the lines of a log of commands, in order.
///
/// # Errors
/// A line is wrong. The error has the number of the first such line, and the reason.
pub fn actions(text: &str) -> Result<Vec<Action>, (usize, String)> {
    let mut actions: Vec<Action> = Vec::new();
    for (number, line) in (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty()) {
        let action: Action = serde_json::from_str(line).map_err(|error| (number, error.to_string()))?;
        action.control.check().map_err(|refusal| (number, refusal.message))?;
        if !action.control.changes_content() {
            return Err((number, "pause, resume and step are never logged".into()));
        }
        if actions.last().is_some_and(|before| before.tick > action.tick) {
            return Err((number, "its tick is before that of the line above".into()));
        }
        actions.push(action);
    }
    Ok(actions)
}

/// The first `N` bytes of a text, cut at a character, with their number.
fn text_bytes<const N: usize>(text: &str) -> ([u8; N], u32) {
    let mut len = text.len().min(N);
    while !text.is_char_boundary(len) {
        len -= 1;
    }
    let mut bytes = [0; N];
    bytes[..len].copy_from_slice(&text.as_bytes()[..len]);
    (bytes, u32::try_from(len).unwrap_or(0))
}

/// Length that stands for no text.
const NONE: u32 = u32::MAX;

fn text_of(bytes: &[u8], len: u32) -> Option<String> {
    let bytes = bytes.get(..usize::try_from(len).ok()?)?;
    String::from_utf8(bytes.to_vec()).ok()
}

/// A command on the way from the supervisor to `traffic-bridge`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[type_name("caraware::ControlRequest")]
pub struct ControlRequest {
    /// [`SCHEMA_VERSION`] of the sender.
    pub schema_version: u32,
    /// Position of the command in [`Command`].
    pub command: u32,
    /// Sensors that are switched, bits.
    pub sensors: u32,
    /// 1 = on, 0 = off.
    pub is_on: u32,
    /// Ticks of a step.
    pub ticks: u64,
    /// Bytes of `vehicle` in use; all bits set means no vehicle.
    pub vehicle_len: u32,
    /// Bytes of `edge` in use; all bits set means no edge.
    pub edge_len: u32,
    /// SUMO's id, UTF-8.
    pub vehicle: [u8; ID_BYTES],
    /// SUMO's id, UTF-8.
    pub edge: [u8; ID_BYTES],
}

impl From<&Command> for ControlRequest {
    fn from(command: &Command) -> Self {
        let (vehicle, edge) = command.ids();
        let bytes = |text: Option<&str>| text.map_or(([0; ID_BYTES], NONE), text_bytes);
        let ((vehicle, vehicle_len), (edge, edge_len)) = (bytes(vehicle), bytes(edge));
        let (number, ticks, sensors, is_on) = match command {
            Command::Pause {} => (0, 0, 0, 0),
            Command::Resume {} => (1, 0, 0, 0),
            Command::Step { ticks } => (2, *ticks, 0, 0),
            Command::Reset {} => (3, 0, 0, 0),
            Command::Sensor { sensor, state, .. } => (4, 0, sensor.bits(), u32::from(*state == Switch::On)),
            Command::Start { .. } => (5, 0, 0, 0),
            Command::Destination { .. } => (6, 0, 0, 0),
        };
        Self {
            schema_version: SCHEMA_VERSION,
            command: number,
            sensors,
            is_on,
            ticks,
            vehicle_len,
            edge_len,
            vehicle,
            edge,
        }
    }
}

impl TryFrom<&ControlRequest> for Command {
    type Error = Refusal;

    fn try_from(request: &ControlRequest) -> Result<Self, Refusal> {
        if request.schema_version != SCHEMA_VERSION {
            return Err(Refusal::schema(request.schema_version));
        }
        let malformed = || Refusal::new(RefusalKind::Malformed, "not a request");
        let vehicle = text_of(&request.vehicle, request.vehicle_len);
        let edge = text_of(&request.edge, request.edge_len);
        let command = match request.command {
            0 => Self::Pause {},
            1 => Self::Resume {},
            2 => Self::Step { ticks: request.ticks },
            3 => Self::Reset {},
            4 => Self::Sensor {
                vehicle: match request.vehicle_len {
                    NONE => None,
                    _ => Some(vehicle.ok_or_else(malformed)?),
                },
                sensor: SensorSelection::from_bits(request.sensors).ok_or_else(malformed)?,
                state: if request.is_on == 0 { Switch::Off } else { Switch::On },
            },
            5 | 6 => {
                let (vehicle, edge) = vehicle.zip(edge).ok_or_else(malformed)?;
                match request.command {
                    5 => Self::Start { vehicle, edge },
                    _ => Self::Destination { vehicle, edge },
                }
            }
            _ => return Err(malformed()),
        };
        command.check()?;
        Ok(command)
    }
}

/// An answer on the way from `traffic-bridge` to the supervisor.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable, ZeroCopySend)]
#[type_name("caraware::ControlReply")]
pub struct ControlReply {
    /// [`SCHEMA_VERSION`] of the sender.
    pub schema_version: u32,
    /// 0 = done, else a [`RefusalKind`].
    pub outcome: u32,
    /// First tick with the command's effect.
    pub tick: u64,
    /// Episode of that tick.
    pub episode: u64,
    /// Bytes of `text` in use.
    pub text_len: u32,
    /// Zero.
    pub reserved: u32,
    /// The effect, or the reason of a refusal, UTF-8.
    pub text: [u8; ANSWER_BYTES],
}

impl From<&Reply> for ControlReply {
    fn from(reply: &Reply) -> Self {
        let (outcome, tick, episode, message) = match reply {
            Reply::Done(done) => (0, done.tick, done.episode, &done.message),
            Reply::Refused(refusal) => (refusal.kind as u32, 0, 0, &refusal.message),
        };
        let (text, text_len) = text_bytes(message);
        Self {
            schema_version: SCHEMA_VERSION,
            outcome,
            tick,
            episode,
            text_len,
            reserved: 0,
            text,
        }
    }
}

impl From<&ControlReply> for Reply {
    fn from(reply: &ControlReply) -> Self {
        let refusal = RefusalKind::ALL.into_iter().find(|kind| *kind as u32 == reply.outcome);
        match (text_of(&reply.text, reply.text_len), reply.outcome, refusal) {
            (Some(message), 0, _) => Self::Done(Done {
                tick: reply.tick,
                episode: reply.episode,
                message,
            }),
            (Some(message), _, Some(kind)) => Self::Refused(Refusal::new(kind, message)),
            _ => {
                let message = "the answer of traffic-bridge cannot be read";
                Self::Refused(Refusal::new(RefusalKind::Unanswered, message))
            }
        }
    }
}

/// A sensor switched at the tick in the header: payload of the service `switch`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
pub struct SensorSwitch {
    /// Hash of the vehicle's id; unused with [`EVERY_VEHICLE`].
    pub id_hash: u64,
    /// Sensors, bits.
    pub sensors: u32,
    /// Bits: [`SWITCHED_ON`], [`EVERY_VEHICLE`].
    pub flags: u32,
}

payload_layout! {
    /// Where the array of a `switch` message lies.
    SensorSwitchLayout(commanded) {
        /// `SensorSwitch [commanded]`.
        switches: SensorSwitch, [commanded];
    }
}

/// The sensors deliver from this tick on; without this bit they stop.
pub const SWITCHED_ON: u32 = 1;
/// The switch applies to all vehicles, including later ones.
pub const EVERY_VEHICLE: u32 = 1 << 1;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn commands() -> impl Strategy<Value = Command> {
        let id = "[a-zäß€ .#]{1,40}";
        let sensor = prop::sample::select(SensorSelection::every().collect::<Vec<_>>());
        let switched =
            (prop::option::of(id), sensor, any::<bool>()).prop_map(|(vehicle, sensor, on)| Command::Sensor {
                vehicle,
                sensor,
                state: if on { Switch::On } else { Switch::Off },
            });
        prop_oneof![
            Just(Command::Pause {}),
            Just(Command::Resume {}),
            Just(Command::Reset {}),
            (1..=MAX_STEP_TICKS).prop_map(|ticks| Command::Step { ticks }),
            switched,
            (id, id).prop_map(|(vehicle, edge)| Command::Start { vehicle, edge }),
            (id, id).prop_map(|(vehicle, edge)| Command::Destination { vehicle, edge }),
        ]
    }

    proptest! {
        #[test]
        fn a_command_survives_json_and_the_record(command in commands()) {
            prop_assert_eq!(Command::from_json(command.to_json().unwrap().as_bytes()).unwrap(), command.clone());
            prop_assert_eq!(Command::try_from(&ControlRequest::from(&command)).unwrap(), command);
        }

        #[test]
        fn garbage_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert_eq!(Command::from_json(&bytes).unwrap_err().kind, RefusalKind::Malformed);
        }

        #[test]
        fn any_record_is_a_command_or_a_refusal(bytes in prop::collection::vec(any::<u8>(), size_of::<ControlRequest>()), number in 0_u32..9) {
            let mut record: ControlRequest = bytemuck::pod_read_unaligned(&bytes);
            let _ = Command::try_from(&record);
            (record.schema_version, record.command) = (SCHEMA_VERSION, number);
            if let Ok(command) = Command::try_from(&record) {
                prop_assert!(command.check().is_ok());
            }
        }
    }

    #[test]
    fn wrong_requests_are_refused_with_their_reason() {
        let kind = |text: &str| Command::from_json(text.as_bytes()).unwrap_err().kind;
        let version = SCHEMA_VERSION;
        assert_eq!(
            kind(r#"{"schema_version": 0, "control": {"command": "pause"}}"#),
            RefusalKind::Schema
        );
        for control in [
            r#"{"command": "explode"}"#,
            r#"{"command": "step", "ticks": 0}"#,
            r#"{"command": "step", "ticks": -1}"#,
            r#"{"command": "pause", "more": 1}"#,
            r#"{"command": "sensor", "vehicle": "cav.0", "sensor": "nose", "state": "off"}"#,
            r#"{"command": "start", "vehicle": "", "edge": "a"}"#,
        ] {
            let text = format!(r#"{{"schema_version": {version}, "control": {control}}}"#);
            assert_eq!(kind(&text), RefusalKind::Malformed, "{control}");
        }
        let long = Command::Start {
            vehicle: "v".repeat(ID_BYTES + 1),
            edge: "e".into(),
        };
        assert_eq!(kind(&long.to_json().unwrap()), RefusalKind::Malformed);
        assert_eq!(kind(&" ".repeat(MAX_REQUEST_BYTES + 1)), RefusalKind::Malformed);
    }

    #[test]
    fn answers_survive_the_record_and_long_ones_are_cut_at_a_character() {
        let done = Reply::Done(Done {
            tick: 7,
            episode: 2,
            message: "€".repeat(100),
        });
        let Reply::Done(back) = Reply::from(&ControlReply::from(&done)) else {
            panic!("refused");
        };
        assert_eq!((back.tick, back.episode, back.message), (7, 2, "€".repeat(85)));
        for kind in RefusalKind::ALL {
            let refused = Reply::Refused(Refusal::new(kind, "no"));
            assert_eq!(Reply::from(&ControlReply::from(&refused)), refused);
        }
    }

    #[test]
    fn a_log_of_commands_is_read_line_by_line() {
        let reset = r#"{"tick":5,"episode":0,"control":{"command":"reset"}}"#;
        assert_eq!(actions(&format!("{reset}\n\n{reset}\n")).unwrap().len(), 2);
        let early = r#"{"tick":4,"episode":0,"control":{"command":"reset"}}"#;
        assert_eq!(actions(&format!("{reset}\n{early}")).unwrap_err().0, 2);
        let pause = r#"{"tick":4,"episode":0,"control":{"command":"pause"}}"#;
        assert_eq!(actions(pause).unwrap_err().0, 1);
        assert_eq!(actions("{}").unwrap_err().0, 1);
    }
}
