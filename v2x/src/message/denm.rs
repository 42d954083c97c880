//! Decentralised environmental notification message: ETSI EN 302 637-3 V1.3.1 (`DENM-PDU-Descriptions`, version 2), of a vehicle that warns
//! of itself.

use super::{
    GeodeticPoint, MessageError, StationKind,
    its::{BYTE, CONFIDENCE, HEADING, SPEED, read_header, read_position, write_header, write_position},
    uper::{BitReader, BitWriter},
};

const MESSAGE_ID: i64 = 1;
const STATION: [i64; 2] = [0, 4_294_967_295];
const SEQUENCE: [i64; 2] = [0, 65_535];
const TIMESTAMP: [i64; 2] = [0, 4_398_046_511_103];
const TERMINATION: [i64; 2] = [0, 1];
const DISTANCE: [i64; 2] = [0, 7];
const TRAFFIC: [i64; 2] = [0, 3];
const VALIDITY_S: [i64; 2] = [0, 86_400];
const INTERVAL_MS: [i64; 2] = [1, 10_000];
const QUALITY: [i64; 2] = [0, 7];
const TRACES: [i64; 2] = [1, 7];
const PATH_POINTS: [i64; 2] = [0, 40];
/// Validity of a message that does not state one, seconds.
const DEFAULT_VALIDITY_S: u32 = 600;

/// Cause `dangerousSituation`.
pub const DANGEROUS_SITUATION: u8 = 99;
/// Its sub-cause `emergencyElectronicBrakeEngaged`.
pub const EMERGENCY_BRAKE_ENGAGED: u8 = 1;

/// What ends an event before its validity does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DenmTermination {
    /// Its own station says so.
    Cancellation = 0,
    /// Another station says so.
    Negation = 1,
}

/// What a message says of its event, with the place where the event was: containers `situation` and `location`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DenmEvent {
    /// Quality of the information, 1 (lowest) to 7; 0 = unavailable.
    pub quality: u8,
    /// Cause and sub-cause.
    pub cause: [u8; 2],
    /// Speed of the event, cm/s.
    pub speed_cmps: Option<u16>,
    /// Heading at the event, 0.1° clockwise from north.
    pub heading: Option<u16>,
}

/// A message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Denm {
    /// Station that sends.
    pub station: u32,
    /// Its type.
    pub kind: StationKind,
    /// Station of the action identifier: the one that detected the event.
    pub originator: u32,
    /// Number of the event at that station.
    pub sequence: u16,
    /// `TimestampIts` of the detection of the event, or of its update.
    pub detected_ms: u64,
    /// `TimestampIts` of the content.
    pub reference_ms: u64,
    /// The event has ended.
    pub termination: Option<DenmTermination>,
    /// Place of the event.
    pub position: GeodeticPoint,
    /// Distance for which it is relevant, `RelevanceDistance`: 0 (below 50 m), 1 (100 m), 2 (200 m), 3 (500 m) … 7.
    pub relevance: Option<u8>,
    /// Traffic for which it is relevant, `RelevanceTrafficDirection`: 0 = all, 1 = upstream, 2 = downstream, 3 = opposite.
    pub traffic: Option<u8>,
    /// Validity after the detection, seconds.
    pub validity_s: u32,
    /// Time between repetitions, ms.
    pub interval_ms: Option<u16>,
    /// The event; none in a cancellation.
    pub event: Option<DenmEvent>,
}

impl Denm {
    /// The bytes.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut out = BitWriter::default();
        write_header(&mut out, MESSAGE_ID, self.station);
        // Situation, location, à la carte.
        for is_there in [self.event.is_some(), self.event.is_some(), false] {
            out.flag(is_there);
        }
        self.write_management(&mut out);
        if let Some(event) = &self.event {
            event.write(&mut out);
        }
        out.finish()
    }

    fn write_management(&self, out: &mut BitWriter) {
        out.flag(false);
        let has_validity = self.validity_s != DEFAULT_VALIDITY_S;
        for is_there in [
            self.termination.is_some(),
            self.relevance.is_some(),
            self.traffic.is_some(),
            has_validity,
            self.interval_ms.is_some(),
        ] {
            out.flag(is_there);
        }
        out.integer(self.originator.into(), STATION);
        out.integer(self.sequence.into(), SEQUENCE);
        out.integer(self.detected_ms as i64, TIMESTAMP);
        out.integer(self.reference_ms as i64, TIMESTAMP);
        if let Some(termination) = self.termination {
            out.integer(termination as i64, TERMINATION);
        }
        write_position(out, &self.position);
        if let Some(relevance) = self.relevance {
            out.integer(relevance.into(), DISTANCE);
        }
        if let Some(traffic) = self.traffic {
            out.integer(traffic.into(), TRAFFIC);
        }
        if has_validity {
            out.integer(self.validity_s.into(), VALIDITY_S);
        }
        if let Some(interval_ms) = self.interval_ms {
            out.integer(interval_ms.into(), INTERVAL_MS);
        }
        out.integer(self.kind.0.into(), BYTE);
    }

    /// Reads a message.
    ///
    /// # Errors
    /// The bytes are no such message, or have parts that are not read.
    pub fn decode(bytes: &[u8]) -> Result<Self, MessageError> {
        let mut input = BitReader::new(bytes);
        let station = read_header(&mut input, MESSAGE_ID)?;
        let containers = input.bits(3)? as u32;
        if !matches!(containers, 0b000 | 0b110) {
            return Err(MessageError::Unsupported {
                what: "containers of a notification",
                found: containers,
            });
        }
        let mut denm = read_management(&mut input, station)?;
        if containers != 0 {
            denm.event = Some(DenmEvent::read(&mut input)?);
        }
        input.end()?;
        Ok(denm)
    }
}

fn read_management(input: &mut BitReader, station: u32) -> Result<Denm, MessageError> {
    input.no_extension("an extension of ManagementContainer")?;
    let mut flags = [false; 5];
    for flag in &mut flags {
        *flag = input.flag()?;
    }
    let [has_termination, has_relevance, has_traffic, has_validity, has_interval] = flags;
    let originator = input.integer("originatingStationID", STATION)? as u32;
    let sequence = input.integer("sequenceNumber", SEQUENCE)? as u16;
    let detected_ms = input.integer("detectionTime", TIMESTAMP)? as u64;
    let reference_ms = input.integer("referenceTime", TIMESTAMP)? as u64;
    let termination = match has_termination {
        true => Some(match input.integer("termination", TERMINATION)? {
            0 => DenmTermination::Cancellation,
            _ => DenmTermination::Negation,
        }),
        false => None,
    };
    let position = read_position(input)?;
    let mut optional = |is_there: bool, what, range| match is_there {
        true => input.integer(what, range).map(Some),
        false => Ok(None),
    };
    let relevance = optional(has_relevance, "relevanceDistance", DISTANCE)?.map(|value| value as u8);
    let traffic = optional(has_traffic, "relevanceTrafficDirection", TRAFFIC)?.map(|value| value as u8);
    let validity_s = optional(has_validity, "validityDuration", VALIDITY_S)?;
    let interval_ms = optional(has_interval, "transmissionInterval", INTERVAL_MS)?.map(|value| value as u16);
    Ok(Denm {
        station,
        kind: StationKind(input.integer("stationType", BYTE)? as u8),
        originator,
        sequence,
        detected_ms,
        reference_ms,
        termination,
        position,
        relevance,
        traffic,
        validity_s: validity_s.map_or(DEFAULT_VALIDITY_S, |value| value as u32),
        interval_ms,
        event: None,
    })
}

impl DenmEvent {
    fn write(&self, out: &mut BitWriter) {
        // Situation: extension, linked cause, history. The cause: extension.
        out.bits(0, 3);
        out.integer(self.quality.into(), QUALITY);
        out.flag(false);
        self.cause.iter().for_each(|cause| out.integer((*cause).into(), BYTE));
        // Location: extension, speed, heading, type of the road.
        out.flag(false);
        out.flag(self.speed_cmps.is_some());
        out.flag(self.heading.is_some());
        out.flag(false);
        // Their confidences are unavailable.
        if let Some(speed) = self.speed_cmps {
            out.integer(speed.into(), SPEED);
            out.integer(127, CONFIDENCE);
        }
        if let Some(heading) = self.heading {
            out.integer(heading.into(), HEADING);
            out.integer(127, CONFIDENCE);
        }
        // One trace, without points: the path driven is not kept.
        out.integer(1, TRACES);
        out.integer(0, PATH_POINTS);
    }

    fn read(input: &mut BitReader) -> Result<Self, MessageError> {
        let unsupported = |what| MessageError::Unsupported { what, found: 1 };
        if input.bits(3)? != 0 {
            return Err(unsupported("optional parts of SituationContainer"));
        }
        let quality = input.integer("informationQuality", QUALITY)? as u8;
        input.no_extension("an extension of CauseCode")?;
        let mut cause = [0; 2];
        for code in &mut cause {
            *code = input.integer("causeCode", BYTE)? as u8;
        }
        input.no_extension("an extension of LocationContainer")?;
        let (has_speed, has_heading) = (input.flag()?, input.flag()?);
        if input.flag()? {
            return Err(unsupported("roadType"));
        }
        let mut stated = |is_there: bool, what, range| -> Result<Option<u16>, MessageError> {
            if !is_there {
                return Ok(None);
            }
            let value = input.integer(what, range)? as u16;
            input.integer("confidence", CONFIDENCE)?;
            Ok(Some(value))
        };
        let speed_cmps = stated(has_speed, "speedValue", SPEED)?;
        let heading = stated(has_heading, "headingValue", HEADING)?;
        if input.integer("traces", TRACES)? != 1 || input.integer("trace", PATH_POINTS)? != 0 {
            return Err(unsupported("traces"));
        }
        Ok(Self {
            quality,
            cause,
            speed_cmps,
            heading,
        })
    }
}
