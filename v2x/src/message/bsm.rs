//! Core of the basic safety message: SAE J2735 (2016 and later), `BSMcoreData`, in a `MessageFrame` without part II.

use super::{
    MessageError,
    uper::{BitReader, BitWriter},
};

/// `basicSafetyMessage` among the numbers of `DSRCmsgID`.
const MESSAGE_ID: i64 = 20;
const FRAME_ID: [i64; 2] = [0, 32_767];
const COUNT: [i64; 2] = [0, 127];
const SECOND_MARK: [i64; 2] = [0, 65_535];
const LATITUDE: [i64; 2] = [-900_000_000, 900_000_001];
const LONGITUDE: [i64; 2] = [-1_799_999_999, 1_800_000_001];
const ELEVATION: [i64; 2] = [-4096, 61_439];
const SEMI_AXIS: [i64; 2] = [0, 255];
const ORIENTATION: [i64; 2] = [0, 65_535];
const TRANSMISSION: [i64; 2] = [0, 7];
const SPEED: [i64; 2] = [0, 8191];
const HEADING: [i64; 2] = [0, 28_800];
const STEERING: [i64; 2] = [-126, 127];
const ACCELERATION: [i64; 2] = [-2000, 2001];
const VERTICAL: [i64; 2] = [-127, 127];
const YAW_RATE: [i64; 2] = [-32_767, 32_767];
const WIDTH: [i64; 2] = [0, 1023];
const LENGTH: [i64; 2] = [0, 4095];

/// What every basic safety message says of its vehicle. Values that are `None` are unavailable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BsmCore {
    /// Number of the message, modulo 128.
    pub count: u8,
    /// Temporary identifier.
    pub id: u32,
    /// Milliseconds within the minute, 0 to 60 999.
    pub second_mark_ms: Option<u16>,
    /// 0.1 microdegrees north.
    pub latitude: Option<i32>,
    /// 0.1 microdegrees east.
    pub longitude: Option<i32>,
    /// 10 cm above the ellipsoid.
    pub elevation_10cm: Option<i32>,
    /// Half axes of the position's ellipse at one standard deviation, 5 cm; 254 = more.
    pub accuracy_5cm: Option<[u8; 2]>,
    /// Gear: 0 neutral, 1 park, 2 forward, 3 reverse, 7 unavailable.
    pub transmission: u8,
    /// 0.02 m/s.
    pub speed: Option<u16>,
    /// 0.0125° clockwise from north.
    pub heading: Option<u16>,
    /// Steering wheel, 1.5°, positive to the right.
    pub steering_wheel: Option<i8>,
    /// Along the vehicle and to its right, 0.01 m/s².
    pub acceleration: [Option<i16>; 2],
    /// 0.01°/s, positive to the right.
    pub yaw_rate: i16,
    /// Brakes applied: left front and rear, right front and rear.
    pub wheel_brakes: Option<[bool; 4]>,
    /// Width, cm; 0 = unavailable.
    pub width_cm: u16,
    /// Bumper to bumper, cm; 0 = unavailable.
    pub length_cm: u16,
}

impl BsmCore {
    /// The bytes of a message frame with this message.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut message = BitWriter::default();
        // BasicSafetyMessage: extension, part II, regional.
        message.bits(0, 3);
        self.write(&mut message);
        let mut out = BitWriter::default();
        // MessageFrame: extension.
        out.flag(false);
        out.integer(MESSAGE_ID, FRAME_ID);
        out.open_type(message);
        out.finish()
    }

    fn write(&self, out: &mut BitWriter) {
        out.integer(self.count.into(), COUNT);
        out.bits(self.id.into(), 32);
        out.integer(self.second_mark_ms.map_or(65_535, i64::from), SECOND_MARK);
        out.integer(self.latitude.map_or(900_000_001, i64::from), LATITUDE);
        out.integer(self.longitude.map_or(1_800_000_001, i64::from), LONGITUDE);
        out.integer(self.elevation_10cm.map_or(-4096, i64::from), ELEVATION);
        let axes = self
            .accuracy_5cm
            .map_or([255; 2], |axes| axes.map(|axis| axis.min(254)));
        axes.iter().for_each(|axis| out.integer((*axis).into(), SEMI_AXIS));
        // The orientation of the ellipse is not stated.
        out.integer(65_535, ORIENTATION);
        out.integer(self.transmission.into(), TRANSMISSION);
        out.integer(self.speed.map_or(8191, |speed| i64::from(speed.min(8190))), SPEED);
        out.integer(self.heading.map_or(28_800, i64::from), HEADING);
        out.integer(self.steering_wheel.map_or(127, i64::from), STEERING);
        for acceleration in self.acceleration {
            out.integer(
                acceleration.map_or(2001, |value| i64::from(value).min(2000)),
                ACCELERATION,
            );
        }
        // The vertical acceleration is unavailable.
        out.integer(-127, VERTICAL);
        out.integer(self.yaw_rate.into(), YAW_RATE);
        // The first bit says that the others are unavailable.
        out.flag(self.wheel_brakes.is_none());
        self.wheel_brakes
            .unwrap_or_default()
            .iter()
            .for_each(|brake| out.flag(*brake));
        // Traction and stability control, antilock brakes, brake boost, auxiliary brakes: unavailable.
        out.bits(0, 10);
        out.integer(self.width_cm.into(), WIDTH);
        out.integer(self.length_cm.into(), LENGTH);
    }

    /// Reads a message frame.
    ///
    /// # Errors
    /// The bytes are no frame with a basic safety message, or have parts that are not read.
    pub fn decode(bytes: &[u8]) -> Result<Self, MessageError> {
        let mut input = BitReader::new(bytes);
        input.no_extension("an extension of MessageFrame")?;
        let found = input.integer("messageId", FRAME_ID)?;
        if found != MESSAGE_ID {
            return Err(MessageError::Unsupported {
                what: "message",
                found: found as u32,
            });
        }
        let mut message = input.open_type()?;
        input.end()?;
        let parts = message.bits(3)? as u32;
        if parts != 0 {
            return Err(MessageError::Unsupported {
                what: "optional parts of BasicSafetyMessage",
                found: parts,
            });
        }
        let core = Self::read(&mut message)?;
        message.end()?;
        Ok(core)
    }

    fn read(input: &mut BitReader) -> Result<Self, MessageError> {
        let count = input.integer("msgCnt", COUNT)? as u8;
        let id = input.bits(32)? as u32;
        let second_mark = input.integer("secMark", SECOND_MARK)?;
        let latitude = input.integer("lat", LATITUDE)?;
        let longitude = input.integer("long", LONGITUDE)?;
        let elevation = input.integer("elev", ELEVATION)?;
        let axes = [
            input.integer("semiMajor", SEMI_AXIS)?,
            input.integer("semiMinor", SEMI_AXIS)?,
        ];
        input.integer("orientation", ORIENTATION)?;
        let transmission = input.integer("transmission", TRANSMISSION)? as u8;
        let speed = input.integer("speed", SPEED)?;
        let heading = input.integer("heading", HEADING)?;
        let steering = input.integer("angle", STEERING)?;
        let acceleration = [
            input.integer("long", ACCELERATION)?,
            input.integer("lat", ACCELERATION)?,
        ];
        input.integer("vert", VERTICAL)?;
        let yaw_rate = input.integer("yaw", YAW_RATE)? as i16;
        let is_unknown = input.flag()?;
        let mut wheels = [false; 4];
        for wheel in &mut wheels {
            *wheel = input.flag()?;
        }
        input.bits(10)?;
        Ok(Self {
            count,
            id,
            second_mark_ms: (second_mark != 65_535).then_some(second_mark as u16),
            latitude: (latitude <= 900_000_000).then_some(latitude as i32),
            longitude: (longitude <= 1_800_000_000).then_some(longitude as i32),
            elevation_10cm: (elevation != -4096).then_some(elevation as i32),
            accuracy_5cm: (axes != [255; 2]).then(|| axes.map(|axis| axis.min(254) as u8)),
            transmission,
            speed: (speed != 8191).then_some(speed as u16),
            heading: (heading != 28_800).then_some(heading as u16),
            steering_wheel: (steering != 127).then_some(steering as i8),
            acceleration: acceleration.map(|value| (value != 2001).then_some(value as i16)),
            yaw_rate,
            wheel_brakes: (!is_unknown).then_some(wheels),
            width_cm: input.integer("width", WIDTH)? as u16,
            length_cm: input.integer("length", LENGTH)? as u16,
        })
    }
}
