//! Vulnerable road user awareness message: ETSI TS 103 300-3 V2.1.1 (`VAM-PDU-Descriptions`, version 1), of a person on foot without a
//! cluster.

use super::{
    GeodeticPoint, MessageError, StationKind,
    its::{BYTE, CONFIDENCE, HEADING, SPEED, read_header, read_position, write_header, write_position},
    uper::{BitReader, BitWriter},
};

const MESSAGE_ID: i64 = 14;
const DELTA_TIME: [i64; 2] = [0, 65_535];
const ACCELERATION: [i64; 2] = [-160, 161];
const ACCELERATION_CONFIDENCE: [i64; 2] = [0, 102];
/// `pedestrian` among the four alternatives of `VruProfileAndSubprofile`.
const PROFILE: [i64; 2] = [0, 3];
/// Places among the five values of `VruSubProfilePedestrian` and of `VruSizeClass`.
const FIVE_VALUES: [i64; 2] = [0, 4];
/// Optional parts of the two containers in the order of the message, and the bits that are theirs.
const HIGH_FREQUENCY_PARTS: u32 = 11;
/// Profile and size class of a low-frequency container, without lights.
const LOW_FREQUENCY_PARTS: u64 = 0b101;

/// The low-frequency container of a person on foot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VamProfile {
    /// 0 = unavailable, 1 = ordinary pedestrian, 2 = road worker, 3 = first responder.
    pub subprofile: u8,
    /// `VruSizeClass`: 0 = unavailable, 1 = low, 2 = medium, 3 = high.
    pub size_class: u8,
}

/// A person's message. Values that are `None` are unavailable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Vam {
    /// Station.
    pub station: u32,
    /// Its type.
    pub kind: StationKind,
    /// Time of the position, milliseconds modulo 65 536.
    pub generation_delta_ms: u16,
    /// Middle of the person, on the ground.
    pub position: GeodeticPoint,
    /// 0.1° clockwise from north.
    pub heading: Option<u16>,
    /// Half of the interval that has the heading with 95 %, 0.1°.
    pub heading_confidence: Option<u8>,
    /// cm/s.
    pub speed_cmps: Option<u16>,
    /// Half of the interval that has the speed with 95 %, cm/s.
    pub speed_confidence: Option<u8>,
    /// Longitudinal acceleration, 0.1 m/s².
    pub acceleration: Option<i16>,
    /// The low-frequency container.
    pub profile: Option<VamProfile>,
}

impl Vam {
    /// The bytes.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut out = BitWriter::default();
        write_header(&mut out, MESSAGE_ID, self.station);
        out.integer(self.generation_delta_ms.into(), DELTA_TIME);
        // VamParameters: extension; high- and low-frequency container, three that are of clusters and predictions.
        out.flag(false);
        out.flag(true);
        out.flag(self.profile.is_some());
        out.bits(0, 3);
        // BasicContainer: extension.
        out.flag(false);
        out.integer(self.kind.0.into(), BYTE);
        write_position(&mut out, &self.position);
        out.flag(false);
        out.bits(0, HIGH_FREQUENCY_PARTS);
        out.integer(self.heading.map_or(3601, i64::from), HEADING);
        out.integer(confidence(self.heading_confidence), CONFIDENCE);
        out.integer(
            self.speed_cmps.map_or(16_383, |speed| i64::from(speed.min(16_382))),
            SPEED,
        );
        out.integer(confidence(self.speed_confidence), CONFIDENCE);
        out.integer(
            self.acceleration.map_or(161, |value| i64::from(value).min(160)),
            ACCELERATION,
        );
        out.integer(102, ACCELERATION_CONFIDENCE);
        if let Some(profile) = &self.profile {
            out.flag(false);
            out.bits(LOW_FREQUENCY_PARTS, 3);
            // The choice: extension, alternative.
            out.flag(false);
            out.integer(0, PROFILE);
            out.integer(profile.subprofile.into(), FIVE_VALUES);
            out.integer(profile.size_class.into(), FIVE_VALUES);
        }
        out.finish()
    }

    /// Reads a message.
    ///
    /// # Errors
    /// The bytes are no such message of a person on foot, or have parts that are not read.
    pub fn decode(bytes: &[u8]) -> Result<Self, MessageError> {
        let mut input = BitReader::new(bytes);
        let station = read_header(&mut input, MESSAGE_ID)?;
        let generation_delta_ms = input.integer("generationDeltaTime", DELTA_TIME)? as u16;
        input.no_extension("an extension of VamParameters")?;
        let has_motion = input.flag()?;
        let has_profile = input.flag()?;
        if !has_motion || input.bits(3)? != 0 {
            return Err(unsupported("containers of a VAM"));
        }
        input.no_extension("an extension of BasicContainer")?;
        let kind = StationKind(input.integer("stationType", BYTE)? as u8);
        let position = read_position(&mut input)?;
        input.no_extension("an extension of VruHighFrequencyContainer")?;
        if input.bits(HIGH_FREQUENCY_PARTS)? != 0 {
            return Err(unsupported("optional parts of VruHighFrequencyContainer"));
        }
        let heading = input.integer("headingValue", HEADING)?;
        let heading_confidence = input.integer("headingConfidence", CONFIDENCE)?;
        let speed = input.integer("speedValue", SPEED)?;
        let speed_confidence = input.integer("speedConfidence", CONFIDENCE)?;
        let acceleration = input.integer("longitudinalAccelerationValue", ACCELERATION)?;
        input.integer("longitudinalAccelerationConfidence", ACCELERATION_CONFIDENCE)?;
        let profile = match has_profile {
            true => Some(VamProfile::read(&mut input)?),
            false => None,
        };
        input.end()?;
        Ok(Self {
            station,
            kind,
            generation_delta_ms,
            position,
            heading: (heading != 3601).then_some(heading as u16),
            heading_confidence: (heading_confidence != 127).then_some(heading_confidence as u8),
            speed_cmps: (speed != 16_383).then_some(speed as u16),
            speed_confidence: (speed_confidence != 127).then_some(speed_confidence as u8),
            acceleration: (acceleration != 161).then_some(acceleration as i16),
            profile,
        })
    }
}

/// A confidence whose half interval is `value` in its unit: 1 … 125, 126 = more, 127 = unavailable.
fn confidence(value: Option<u8>) -> i64 {
    value.map_or(127, |value| i64::from(value).clamp(1, 126))
}

fn unsupported(what: &'static str) -> MessageError {
    MessageError::Unsupported { what, found: 1 }
}

impl VamProfile {
    fn read(input: &mut BitReader) -> Result<Self, MessageError> {
        input.no_extension("an extension of VruLowFrequencyContainer")?;
        if input.bits(3)? != LOW_FREQUENCY_PARTS {
            return Err(unsupported("parts of VruLowFrequencyContainer"));
        }
        input.no_extension("profileAndSubprofile")?;
        if input.integer("profileAndSubprofile", PROFILE)? != 0 {
            return Err(unsupported("another profile than a pedestrian"));
        }
        Ok(Self {
            subprofile: input.integer("pedestrian", FIVE_VALUES)? as u8,
            size_class: input.integer("sizeClass", FIVE_VALUES)? as u8,
        })
    }
}
