//! Cooperative awareness message: ETSI EN 302 637-2 V1.4.1 (`CAM-PDU-Descriptions`, version 2).

use super::{
    GeodeticPoint, MessageError, StationKind,
    its::{BYTE, CONFIDENCE, HEADING, SPEED, read_header, read_position, write_header, write_position},
    uper::{BitReader, BitWriter},
};

/// `messageID` of a cooperative awareness message.
pub(super) const MESSAGE_ID: i64 = 2;
/// Range of `GenerationDeltaTime`.
pub(super) const DELTA_TIME: [i64; 2] = [0, 65_535];
const DIRECTION: [i64; 2] = [0, 2];
const LENGTH: [i64; 2] = [1, 1023];
const TRAILER: [i64; 2] = [0, 4];
/// `trailerPresentWithKnownLength`; 0 is `noTrailerPresent`.
const TRAILER_OF_KNOWN_LENGTH: i64 = 1;
const WIDTH: [i64; 2] = [1, 62];
const ACCELERATION: [i64; 2] = [-160, 161];
const ACCELERATION_CONFIDENCE: [i64; 2] = [0, 102];
const CURVATURE: [i64; 2] = [-1023, 1023];
const CURVATURE_CONFIDENCE: [i64; 2] = [0, 7];
const CURVATURE_MODE: [i64; 2] = [0, 2];
const YAW_RATE: [i64; 2] = [-32_766, 32_767];
const YAW_RATE_CONFIDENCE: [i64; 2] = [0, 8];
const ROLE: [i64; 2] = [0, 15];
const PATH_POINTS: [i64; 2] = [0, 40];
const DELTA_DEGREE: [i64; 2] = [-131_071, 131_072];
const DELTA_ALTITUDE: [i64; 2] = [-12_700, 12_800];
const PATH_TIME: [i64; 2] = [1, 65_535];

/// A point of the path that the vehicle has driven, relative to its position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PathPoint {
    /// 0.1 microdegrees.
    pub delta_latitude: i32,
    /// 0.1 microdegrees.
    pub delta_longitude: i32,
    /// Time since the point before, 10 ms.
    pub time_10ms: Option<u16>,
}

/// A vehicle's message. Values that are `None` are unavailable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cam {
    /// Station.
    pub station: u32,
    /// Its type.
    pub kind: StationKind,
    /// Time of the position, milliseconds modulo 65 536.
    pub generation_delta_ms: u16,
    /// Reference point of the vehicle: the middle of its front.
    pub position: GeodeticPoint,
    /// 0.1° clockwise from north.
    pub heading: Option<u16>,
    /// Half of the interval that has the heading with 95 %, 0.1°.
    pub heading_confidence: Option<u8>,
    /// cm/s.
    pub speed_cmps: Option<u16>,
    /// Half of the interval that has the speed with 95 %, cm/s.
    pub speed_confidence: Option<u8>,
    /// Front to rear, trailing bodies included, 10 cm.
    pub length_10cm: u16,
    /// A trailer is present, and the length includes it.
    pub has_trailer: bool,
    /// 10 cm.
    pub width_10cm: u8,
    /// Longitudinal acceleration, 0.1 m/s².
    pub acceleration: Option<i16>,
    /// Yaw rate, 0.01°/s, positive to the left.
    pub yaw_rate: Option<i16>,
    /// The low-frequency container: the path driven, the newest point first.
    pub path: Option<Vec<PathPoint>>,
}

/// A confidence whose half interval is `value` in its unit: 1 … 125, 126 = more, 127 = unavailable.
fn confidence(value: Option<u8>) -> i64 {
    value.map_or(127, |value| i64::from(value).clamp(1, 126))
}

fn known<T>(value: i64, unavailable: i64, convert: impl Fn(i64) -> T) -> Option<T> {
    (value != unavailable).then(|| convert(value))
}

impl Cam {
    /// The bytes.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut out = BitWriter::default();
        write_header(&mut out, MESSAGE_ID, self.station);
        out.integer(self.generation_delta_ms.into(), DELTA_TIME);
        // CamParameters: extension, low-frequency container, special vehicle container.
        out.flag(false);
        out.flag(self.path.is_some());
        out.flag(false);
        out.flag(false);
        out.integer(self.kind.0.into(), BYTE);
        write_position(&mut out, &self.position);
        // HighFrequencyContainer: extension, the first of two alternatives.
        out.flag(false);
        out.flag(false);
        self.write_high_frequency(&mut out);
        if let Some(path) = &self.path {
            out.flag(false);
            write_low_frequency(&mut out, path);
        }
        out.finish()
    }

    fn write_high_frequency(&self, out: &mut BitWriter) {
        // Seven optional parts, none of them.
        out.bits(0, 7);
        out.integer(self.heading.map_or(3601, i64::from), HEADING);
        out.integer(confidence(self.heading_confidence), CONFIDENCE);
        out.integer(
            self.speed_cmps.map_or(16_383, |speed| i64::from(speed.min(16_382))),
            SPEED,
        );
        out.integer(confidence(self.speed_confidence), CONFIDENCE);
        // Forward.
        out.integer(0, DIRECTION);
        out.integer(self.length_10cm.into(), LENGTH);
        let trailer = if self.has_trailer { TRAILER_OF_KNOWN_LENGTH } else { 0 };
        out.integer(trailer, TRAILER);
        out.integer(self.width_10cm.into(), WIDTH);
        out.integer(
            self.acceleration.map_or(161, |value| i64::from(value).min(160)),
            ACCELERATION,
        );
        out.integer(102, ACCELERATION_CONFIDENCE);
        // Curvature and its mode are unavailable.
        out.integer(1023, CURVATURE);
        out.integer(7, CURVATURE_CONFIDENCE);
        out.flag(false);
        out.integer(2, CURVATURE_MODE);
        out.integer(
            self.yaw_rate
                .map_or(32_767, |rate| i64::from(rate).clamp(-32_766, 32_766)),
            YAW_RATE,
        );
        out.integer(8, YAW_RATE_CONFIDENCE);
    }

    /// Reads a message.
    ///
    /// # Errors
    /// The bytes are no such message of a vehicle, or have parts that are not read.
    pub fn decode(bytes: &[u8]) -> Result<Self, MessageError> {
        let mut input = BitReader::new(bytes);
        let station = read_header(&mut input, MESSAGE_ID)?;
        let generation_delta_ms = input.integer("generationDeltaTime", DELTA_TIME)? as u16;
        input.no_extension("an extension of CamParameters")?;
        let has_low_frequency = input.flag()?;
        input.no_extension("a special vehicle container")?;
        input.no_extension("an extension of BasicContainer")?;
        let kind = StationKind(input.integer("stationType", BYTE)? as u8);
        let position = read_position(&mut input)?;
        input.no_extension("a high-frequency container of another kind")?;
        input.no_extension("the container of a roadside unit")?;
        let mut cam = read_high_frequency(&mut input)?;
        if has_low_frequency {
            input.no_extension("a low-frequency container of another kind")?;
            cam.path = Some(read_low_frequency(&mut input)?);
        }
        input.end()?;
        Ok(Self {
            station,
            kind,
            generation_delta_ms,
            position,
            ..cam
        })
    }
}

fn read_high_frequency(input: &mut BitReader) -> Result<Cam, MessageError> {
    let optional = input.bits(7)? as u32;
    if optional != 0 {
        return Err(MessageError::Unsupported {
            what: "optional parts of the high-frequency container",
            found: optional,
        });
    }
    let heading = input.integer("headingValue", HEADING)?;
    let heading_confidence = input.integer("headingConfidence", CONFIDENCE)?;
    let speed = input.integer("speedValue", SPEED)?;
    let speed_confidence = input.integer("speedConfidence", CONFIDENCE)?;
    input.integer("driveDirection", DIRECTION)?;
    let length_10cm = input.integer("vehicleLengthValue", LENGTH)? as u16;
    let trailer = input.integer("vehicleLengthConfidenceIndication", TRAILER)?;
    let width_10cm = input.integer("vehicleWidth", WIDTH)? as u8;
    let acceleration = input.integer("longitudinalAccelerationValue", ACCELERATION)?;
    input.integer("longitudinalAccelerationConfidence", ACCELERATION_CONFIDENCE)?;
    input.integer("curvatureValue", CURVATURE)?;
    input.integer("curvatureConfidence", CURVATURE_CONFIDENCE)?;
    input.no_extension("curvatureCalculationMode")?;
    input.integer("curvatureCalculationMode", CURVATURE_MODE)?;
    let yaw_rate = input.integer("yawRateValue", YAW_RATE)?;
    input.integer("yawRateConfidence", YAW_RATE_CONFIDENCE)?;
    Ok(Cam {
        station: 0,
        kind: StationKind(0),
        generation_delta_ms: 0,
        position: GeodeticPoint::default(),
        heading: known(heading, 3601, |value| value as u16),
        heading_confidence: known(heading_confidence, 127, |value| value as u8),
        speed_cmps: known(speed, 16_383, |value| value as u16),
        speed_confidence: known(speed_confidence, 127, |value| value as u8),
        length_10cm,
        has_trailer: trailer == TRAILER_OF_KNOWN_LENGTH,
        width_10cm,
        acceleration: known(acceleration, 161, |value| value as i16),
        yaw_rate: known(yaw_rate, 32_767, |value| value as i16),
        path: None,
    })
}

fn write_low_frequency(out: &mut BitWriter, path: &[PathPoint]) {
    out.integer(0, ROLE);
    // Lights: none known to be on.
    out.bits(0, 8);
    let points = path.len().min(PATH_POINTS[1] as usize);
    out.integer(points as i64, PATH_POINTS);
    for point in &path[..points] {
        out.flag(point.time_10ms.is_some());
        out.integer(point.delta_latitude.into(), DELTA_DEGREE);
        out.integer(point.delta_longitude.into(), DELTA_DEGREE);
        out.integer(12_800, DELTA_ALTITUDE);
        if let Some(time) = point.time_10ms {
            out.flag(false);
            out.integer(time.into(), PATH_TIME);
        }
    }
}

fn read_low_frequency(input: &mut BitReader) -> Result<Vec<PathPoint>, MessageError> {
    input.integer("vehicleRole", ROLE)?;
    input.bits(8)?;
    let points = input.integer("pathHistory", PATH_POINTS)?;
    let point = |_| {
        let has_time = input.flag()?;
        let delta_latitude = input.integer("deltaLatitude", DELTA_DEGREE)? as i32;
        let delta_longitude = input.integer("deltaLongitude", DELTA_DEGREE)? as i32;
        input.integer("deltaAltitude", DELTA_ALTITUDE)?;
        let time_10ms = match has_time {
            true => {
                input.no_extension("pathDeltaTime")?;
                Some(input.integer("pathDeltaTime", PATH_TIME)? as u16)
            }
            false => None,
        };
        Ok(PathPoint {
            delta_latitude,
            delta_longitude,
            time_10ms,
        })
    };
    (0..points).map(point).collect()
}
