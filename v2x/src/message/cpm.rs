//! Collective perception message: ETSI TS 103 324 V2.1.1 (`CPM-PDU-Descriptions`, version 1.1.1), of a vehicle or a roadside unit.

use super::{
    GeodeticPoint, MessageError,
    its::{BYTE, CONFIDENCE, HEADING, read_header, read_position, write_header, write_position},
    uper::{BitReader, BitWriter},
};

const MESSAGE_ID: i64 = 14;
const TIMESTAMP: [i64; 2] = [0, 4_398_046_511_103];
const CONTAINERS: [i64; 2] = [1, 8];
const CONTAINER_ID: [i64; 2] = [1, 16];
const ORIGINATING_VEHICLE: i64 = 1;
const ORIGINATING_RSU: i64 = 2;
const SENSOR_INFORMATION: i64 = 3;
const PERCEIVED_OBJECTS: i64 = 5;
const SENSORS: [i64; 2] = [1, 128];
const SENSOR_KIND: [i64; 2] = [0, 31];
/// Two of the six alternatives of `Shape`.
const SHAPE: [i64; 2] = [0, 5];
const CIRCULAR: i64 = 1;
const RADIAL: i64 = 4;
const LENGTH_12B: [i64; 2] = [0, 4095];
const OBJECT_ID: [i64; 2] = [0, 65_535];
const DELTA_TIME: [i64; 2] = [-2048, 2047];
const COORDINATE: [i64; 2] = [-131_072, 131_071];
const COORDINATE_CONFIDENCE: [i64; 2] = [1, 4096];
const VELOCITY: [i64; 2] = [-16_383, 16_383];
const DIMENSION: [i64; 2] = [1, 256];
const DIMENSION_CONFIDENCE: [i64; 2] = [1, 32];
const QUALITY: [i64; 2] = [0, 15];
const CLASSES: [i64; 2] = [1, 8];
const CLASS: [i64; 2] = [0, 3];
const VRU_PROFILE: [i64; 2] = [0, 3];
const VRU_SUBPROFILE: [i64; 2] = [0, 15];
const CONFIDENCE_LEVEL: [i64; 2] = [1, 101];
/// Optional parts of a perceived object, the first in the highest of 14 bits: id, velocity, angles, y and x of its size, quality,
/// classification of a person.
const PARTS: u64 = 0b11_0100_0110_1000;
const PERSON_PART: u64 = 0b10;

/// A perceived object, relative to the reference position of the message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PerceivedObject {
    /// Number of the object at its station.
    pub object: u16,
    /// Time of measurement after the reference time, ms; −2048 … 2047.
    pub delta_ms: i16,
    /// East and north of the reference position, cm.
    pub position_cm: [i32; 2],
    /// Half of the interval that has each coordinate with 95 %, cm.
    pub position_confidence_cm: u16,
    /// East and north, cm/s.
    pub velocity_cmps: [i16; 2],
    /// Half of the interval that has each component with 95 %, cm/s.
    pub velocity_confidence: u8,
    /// 0.1° counter-clockwise from east.
    pub angle: u16,
    /// Along and across, 10 cm.
    pub size_10cm: [u16; 2],
    /// 0 … 15.
    pub quality: u8,
    /// The object is a person on foot.
    pub is_person: bool,
}

/// The station that perceives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CpmOrigin {
    /// A roadside unit.
    #[default]
    Roadside,
    /// A vehicle.
    Vehicle {
        /// Its orientation, 0.1° clockwise from north.
        heading: u16,
    },
}

/// Where the sensor of a station sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SensorRegion {
    /// Range, 10 cm.
    pub range_10cm: u16,
    /// First and last angle of a sector, 0.1° counter-clockwise from the station's x axis (a roadside unit's is east); none = all around.
    pub opening: Option<[u16; 2]>,
}

/// A message of a station that perceives.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Cpm {
    /// Station.
    pub station: u32,
    /// `TimestampIts` of the position and of the objects.
    pub reference_time_ms: u64,
    /// Reference position.
    pub position: GeodeticPoint,
    /// What perceives.
    pub origin: CpmOrigin,
    /// Where its sensor sees, with the sensor information container.
    pub sensor: Option<SensorRegion>,
    /// Objects that it perceives in all.
    pub perceived: u8,
    /// Included objects, at most 255.
    pub objects: Vec<PerceivedObject>,
}

impl Cpm {
    /// The bytes.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut out = BitWriter::default();
        write_header(&mut out, MESSAGE_ID, self.station);
        // CpmPayload: extension. ManagementContainer: extension, two optional parts.
        out.bits(0, 4);
        out.integer(self.reference_time_ms as i64, TIMESTAMP);
        write_position(&mut out, &self.position);
        let mut containers = vec![match self.origin {
            CpmOrigin::Vehicle { heading } => (ORIGINATING_VEHICLE, vehicle(heading)),
            CpmOrigin::Roadside => (ORIGINATING_RSU, roadside_unit()),
        }];
        if let Some(region) = self.sensor {
            containers.push((SENSOR_INFORMATION, sensor(region)));
        }
        if !self.objects.is_empty() {
            containers.push((PERCEIVED_OBJECTS, self.perceived_objects()));
        }
        out.flag(false);
        out.integer(containers.len() as i64, CONTAINERS);
        for (id, content) in containers {
            out.integer(id, CONTAINER_ID);
            out.open_type(content);
        }
        out.finish()
    }

    fn perceived_objects(&self) -> BitWriter {
        let mut out = BitWriter::default();
        out.flag(false);
        out.integer(self.perceived.into(), BYTE);
        out.flag(false);
        let objects = &self.objects[..self.objects.len().min(255)];
        out.integer(objects.len() as i64, BYTE);
        objects.iter().for_each(|object| object.write(&mut out));
        out
    }

    /// Reads a message.
    ///
    /// # Errors
    /// The bytes are no such message of a vehicle, or have parts that are not read.
    pub fn decode(bytes: &[u8]) -> Result<Self, MessageError> {
        let mut input = BitReader::new(bytes);
        let station = read_header(&mut input, MESSAGE_ID)?;
        let optional = input.bits(4)? as u32;
        if optional != 0 {
            return Err(MessageError::Unsupported {
                what: "optional parts of the management container",
                found: optional,
            });
        }
        let mut cpm = Self {
            station,
            reference_time_ms: input.integer("referenceTime", TIMESTAMP)? as u64,
            position: read_position(&mut input)?,
            ..Self::default()
        };
        input.no_extension("more containers")?;
        let containers = input.integer("cpmContainers", CONTAINERS)?;
        for _ in 0..containers {
            let id = input.integer("containerId", CONTAINER_ID)?;
            let mut content = input.open_type()?;
            match id {
                ORIGINATING_VEHICLE => {
                    let heading = read_vehicle(&mut content)?;
                    cpm.origin = CpmOrigin::Vehicle { heading };
                }
                ORIGINATING_RSU => {
                    if content.bits(2)? != 0 {
                        return Err(MessageError::Unsupported {
                            what: "reference to a map",
                            found: 1,
                        });
                    }
                    cpm.origin = CpmOrigin::Roadside;
                }
                SENSOR_INFORMATION => cpm.sensor = Some(read_sensor(&mut content)?),
                PERCEIVED_OBJECTS => (cpm.perceived, cpm.objects) = read_objects(&mut content)?,
                _ => {
                    return Err(MessageError::Unsupported {
                        what: "container",
                        found: id as u32,
                    });
                }
            }
            content.end()?;
        }
        input.end()?;
        Ok(cpm)
    }
}

fn vehicle(heading: u16) -> BitWriter {
    let mut out = BitWriter::default();
    // Extension, three optional parts.
    out.bits(0, 4);
    out.integer(heading.into(), HEADING);
    out.integer(127, CONFIDENCE);
    out
}

fn roadside_unit() -> BitWriter {
    let mut out = BitWriter::default();
    // Extension, no reference to a map.
    out.bits(0, 2);
    out
}

fn read_vehicle(input: &mut BitReader) -> Result<u16, MessageError> {
    if input.bits(4)? != 0 {
        return Err(MessageError::Unsupported {
            what: "optional parts of the vehicle's container",
            found: 1,
        });
    }
    let heading = input.integer("orientationAngle", HEADING)? as u16;
    input.integer("confidence", CONFIDENCE)?;
    Ok(heading)
}

/// One sensor: the aggregate of the station's.
fn sensor(region: SensorRegion) -> BitWriter {
    let mut out = BitWriter::default();
    out.flag(false);
    out.integer(1, SENSORS);
    // Extension; a shape, no confidence.
    out.bits(0b010, 3);
    out.integer(1, BYTE);
    // localAggregation.
    out.integer(12, SENSOR_KIND);
    // Shape: extension, alternative.
    out.flag(false);
    match region.opening {
        // Two optional parts.
        None => {
            out.integer(CIRCULAR, SHAPE);
            out.bits(0, 2);
            out.integer(region.range_10cm.into(), LENGTH_12B);
        }
        // Three optional parts.
        Some(opening) => {
            out.integer(RADIAL, SHAPE);
            out.bits(0, 3);
            out.integer(region.range_10cm.into(), LENGTH_12B);
            opening.iter().for_each(|angle| out.integer((*angle).into(), HEADING));
        }
    }
    // What stands behind an object is not seen.
    out.flag(true);
    out
}

fn read_sensor(input: &mut BitReader) -> Result<SensorRegion, MessageError> {
    let unsupported = |found| MessageError::Unsupported {
        what: "sensor information",
        found,
    };
    input.no_extension("more sensors")?;
    if input.integer("sensorInformation", SENSORS)? != 1 || input.bits(3)? != 0b010 {
        return Err(unsupported(1));
    }
    input.integer("sensorId", BYTE)?;
    input.integer("sensorType", SENSOR_KIND)?;
    input.no_extension("shape")?;
    let shape = input.integer("shape", SHAPE)?;
    let optional_parts = match shape {
        CIRCULAR => 2,
        RADIAL => 3,
        _ => return Err(unsupported(2)),
    };
    if input.bits(optional_parts)? != 0 {
        return Err(unsupported(3));
    }
    let range_10cm = input.integer("range", LENGTH_12B)? as u16;
    let mut angle = || {
        input
            .integer("horizontalOpeningAngle", HEADING)
            .map(|angle| angle as u16)
    };
    let opening = match shape {
        RADIAL => Some([angle()?, angle()?]),
        _ => None,
    };
    input.flag()?;
    Ok(SensorRegion { range_10cm, opening })
}

fn read_objects(input: &mut BitReader) -> Result<(u8, Vec<PerceivedObject>), MessageError> {
    input.no_extension("an extension of PerceivedObjectContainer")?;
    let perceived = input.integer("numberOfPerceivedObjects", BYTE)? as u8;
    input.no_extension("more objects")?;
    let count = input.integer("perceivedObjects", BYTE)?;
    let objects: Result<_, _> = (0..count).map(|_| PerceivedObject::read(input)).collect();
    Ok((perceived, objects?))
}

impl PerceivedObject {
    fn write(&self, out: &mut BitWriter) {
        out.flag(false);
        out.bits(PARTS | if self.is_person { PERSON_PART } else { 0 }, 14);
        out.integer(self.object.into(), OBJECT_ID);
        out.integer(self.delta_ms.into(), DELTA_TIME);
        // No height.
        out.flag(false);
        for coordinate in self.position_cm {
            out.integer(coordinate.into(), COORDINATE);
            out.integer(self.position_confidence_cm.into(), COORDINATE_CONFIDENCE);
        }
        // Cartesian, no vertical component.
        out.bits(0b10, 2);
        for component in self.velocity_cmps {
            out.integer(component.into(), VELOCITY);
            out.integer(self.velocity_confidence.into(), CONFIDENCE);
        }
        // Only the heading.
        out.bits(0, 2);
        out.integer(self.angle.into(), HEADING);
        out.integer(127, CONFIDENCE);
        let [along, across] = self.size_10cm;
        for dimension in [across, along] {
            out.integer(dimension.into(), DIMENSION);
            out.integer(32, DIMENSION_CONFIDENCE);
        }
        out.integer(self.quality.into(), QUALITY);
        if self.is_person {
            out.integer(1, CLASSES);
            // VRU, a pedestrian, an ordinary one; the confidence is unavailable.
            out.flag(false);
            out.integer(1, CLASS);
            out.flag(false);
            out.integer(0, VRU_PROFILE);
            out.integer(1, VRU_SUBPROFILE);
            out.integer(101, CONFIDENCE_LEVEL);
        }
    }

    fn read(input: &mut BitReader) -> Result<Self, MessageError> {
        input.no_extension("an extension of PerceivedObject")?;
        let parts = input.bits(14)?;
        let is_person = parts & PERSON_PART != 0;
        if parts & !PERSON_PART != PARTS {
            return Err(MessageError::Unsupported {
                what: "optional parts of a perceived object",
                found: parts as u32,
            });
        }
        let object = input.integer("objectId", OBJECT_ID)? as u16;
        let delta_ms = input.integer("measurementDeltaTime", DELTA_TIME)? as i16;
        input.no_extension("height of an object")?;
        let mut read = Self {
            object,
            delta_ms,
            is_person,
            ..Self::default()
        };
        for coordinate in &mut read.position_cm {
            *coordinate = input.integer("coordinate", COORDINATE)? as i32;
            read.position_confidence_cm = input.integer("confidence", COORDINATE_CONFIDENCE)? as u16;
        }
        if input.bits(2)? != 0b10 {
            return Err(MessageError::Unsupported {
                what: "polar or vertical velocity",
                found: 0,
            });
        }
        for component in &mut read.velocity_cmps {
            *component = input.integer("velocity", VELOCITY)? as i16;
            read.velocity_confidence = input.integer("confidence", CONFIDENCE)? as u8;
        }
        if input.bits(2)? != 0 {
            return Err(MessageError::Unsupported {
                what: "pitch or roll of an object",
                found: 0,
            });
        }
        read.angle = input.integer("zAngle", HEADING)? as u16;
        input.integer("confidence", CONFIDENCE)?;
        for place in [1, 0] {
            read.size_10cm[place] = input.integer("objectDimension", DIMENSION)? as u16;
            input.integer("confidence", DIMENSION_CONFIDENCE)?;
        }
        read.quality = input.integer("objectPerceptionQuality", QUALITY)? as u8;
        if is_person {
            read_person(input)?;
        }
        Ok(read)
    }
}

fn read_person(input: &mut BitReader) -> Result<(), MessageError> {
    let unsupported = MessageError::Unsupported {
        what: "classification of an object",
        found: 0,
    };
    if input.integer("classification", CLASSES)? != 1 {
        return Err(unsupported);
    }
    input.no_extension("objectClass")?;
    if input.integer("objectClass", CLASS)? != 1 {
        return Err(unsupported);
    }
    input.no_extension("vruSubClass")?;
    if input.integer("vruSubClass", VRU_PROFILE)? != 0 {
        return Err(unsupported);
    }
    input.integer("pedestrian", VRU_SUBPROFILE)?;
    input.integer("confidence", CONFIDENCE_LEVEL)?;
    Ok(())
}
