//! Data elements that several messages have: ETSI TS 102 894-2.

use super::{
    MessageError,
    uper::{BitReader, BitWriter},
};

/// Type of a station (`StationType`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StationKind(pub u8);

/// A vehicle of a class that vehicles of any size have is a lorry if it is longer, metres.
const TRUCK_LENGTH_M: f64 = 7.0;

impl StationKind {
    /// None of the other kinds, such as a ship.
    pub const UNKNOWN: Self = Self(0);
    /// A person on foot or in a wheelchair.
    pub const PEDESTRIAN: Self = Self(1);
    /// A bicycle.
    pub const CYCLIST: Self = Self(2);
    /// A moped.
    pub const MOPED: Self = Self(3);
    /// A motorcycle.
    pub const MOTORCYCLE: Self = Self(4);
    /// A car.
    pub const PASSENGER_CAR: Self = Self(5);
    /// A bus.
    pub const BUS: Self = Self(6);
    /// A van.
    pub const LIGHT_TRUCK: Self = Self(7);
    /// A lorry, with its trailers.
    pub const HEAVY_TRUCK: Self = Self(8);
    /// A vehicle with a task of its own, such as an ambulance.
    pub const SPECIAL_VEHICLE: Self = Self(10);
    /// A tram or a train.
    pub const TRAM: Self = Self(11);
    /// An electric scooter.
    pub const LIGHT_VRU_VEHICLE: Self = Self(12);
    /// A roadside unit.
    pub const ROADSIDE_UNIT: Self = Self(15);

    /// The kind of a vehicle of this class of SUMO's and this length, metres.
    #[must_use]
    pub fn of_vehicle(class: &str, length_m: f64) -> Self {
        match class {
            "bus" | "coach" => Self::BUS,
            "delivery" => Self::LIGHT_TRUCK,
            "truck" | "trailer" => Self::HEAVY_TRUCK,
            "emergency" => Self::SPECIAL_VEHICLE,
            "tram" | "rail_urban" | "rail" | "rail_electric" | "rail_fast" | "subway" => Self::TRAM,
            "motorcycle" => Self::MOTORCYCLE,
            "moped" => Self::MOPED,
            "bicycle" => Self::CYCLIST,
            "scooter" => Self::LIGHT_VRU_VEHICLE,
            "pedestrian" | "wheelchair" => Self::PEDESTRIAN,
            "ship" | "container" | "cable_car" | "aircraft" | "drone" => Self::UNKNOWN,
            _ if length_m > TRUCK_LENGTH_M => Self::HEAVY_TRUCK,
            _ => Self::PASSENGER_CAR,
        }
    }
}

/// Latitude and longitude in 0.1 microdegrees, altitude in centimetres; `None` = unavailable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GeodeticPoint {
    /// 0.1 microdegrees north.
    pub latitude: i32,
    /// 0.1 microdegrees east.
    pub longitude: i32,
    /// Half axis of the area that has the position with 95 %, along and across, centimetres.
    pub accuracy_cm: Option<u16>,
    /// Centimetres above the ellipsoid.
    pub altitude_cm: Option<i32>,
}

const LATITUDE: [i64; 2] = [-900_000_000, 900_000_001];
const LONGITUDE: [i64; 2] = [-1_800_000_000, 1_800_000_001];
const SEMI_AXIS: [i64; 2] = [0, 4095];
/// Range of headings; 3601 = unavailable.
pub const HEADING: [i64; 2] = [0, 3601];
const ALTITUDE: [i64; 2] = [-100_000, 800_001];
/// `AltitudeConfidence`: unavailable.
const ALTITUDE_CONFIDENCE: [i64; 2] = [0, 15];
/// Range of speeds, cm/s; 16 383 = unavailable.
pub const SPEED: [i64; 2] = [0, 16_383];
/// Range of the confidences of speed, heading and angle; 126 = out of range, 127 = unavailable.
pub const CONFIDENCE: [i64; 2] = [1, 127];
/// Range of a byte.
pub const BYTE: [i64; 2] = [0, 255];
const STATION: [i64; 2] = [0, 4_294_967_295];

/// Milliseconds since the epoch of ITS, 2004-01-01 UTC, at the start of an episode. The year of the simulation is not known, so this is
/// a constant: 2024-01-01, with the five leap seconds since 2004.
const EPISODE_START_MS: u64 = 631_152_005_000;

/// The same in seconds of Unix time.
pub const EPISODE_START_UNIX_S: u64 = 1_704_067_200;

/// `TimestampIts` of a time of the simulation, milliseconds.
#[must_use]
pub fn its_time_ms(sim_time_ns: u64) -> u64 {
    EPISODE_START_MS + sim_time_ns / 1_000_000
}

/// `GenerationDeltaTime` of a time: its low 16 bits.
#[must_use]
pub fn generation_delta_ms(its_time_ms: u64) -> u16 {
    (its_time_ms % 65_536) as u16
}

/// Heading in 0.1° clockwise from north of an angle counter-clockwise from east.
#[must_use]
pub fn heading_from_yaw(yaw_rad: f64) -> u16 {
    let tenths = ((90.0 - yaw_rad.to_degrees()) * 10.0).round();
    tenths.rem_euclid(3600.0) as u16
}

/// Angle counter-clockwise from east, in (−π, π], radians, of a heading in 0.1° clockwise from north.
#[must_use]
pub fn yaw_from_heading(heading: u16) -> f64 {
    let yaw = (90.0 - f64::from(heading) / 10.0).to_radians();
    if yaw <= -std::f64::consts::PI {
        yaw + std::f64::consts::TAU
    } else {
        yaw
    }
}

/// Writes `ItsPduHeader`.
pub(super) fn write_header(out: &mut BitWriter, message: i64, station: u32) {
    out.integer(2, BYTE);
    out.integer(message, BYTE);
    out.integer(station.into(), STATION);
}

/// Reads `ItsPduHeader` of a message of protocol version 2. Returns the station.
pub(super) fn read_header(input: &mut BitReader, message: i64) -> Result<u32, MessageError> {
    let version = input.integer("protocolVersion", BYTE)?;
    if version != 2 {
        return Err(MessageError::Unsupported {
            what: "protocol version",
            found: version as u32,
        });
    }
    let found = input.integer("messageID", BYTE)?;
    if found != message {
        return Err(MessageError::Unsupported {
            what: "message",
            found: found as u32,
        });
    }
    Ok(input.integer("stationID", STATION)? as u32)
}

/// Writes `ReferencePosition`.
pub(super) fn write_position(out: &mut BitWriter, point: &GeodeticPoint) {
    out.integer(point.latitude.into(), LATITUDE);
    out.integer(point.longitude.into(), LONGITUDE);
    let (axis, orientation) = match point.accuracy_cm {
        Some(accuracy) => (i64::from(accuracy.min(4094)), 0),
        None => (4095, 3601),
    };
    out.integer(axis, SEMI_AXIS);
    out.integer(axis, SEMI_AXIS);
    out.integer(orientation, HEADING);
    out.integer(point.altitude_cm.map_or(800_001, i64::from), ALTITUDE);
    out.integer(15, ALTITUDE_CONFIDENCE);
}

/// Reads `ReferencePosition`; one without latitude or longitude is refused.
pub(super) fn read_position(input: &mut BitReader) -> Result<GeodeticPoint, MessageError> {
    let latitude = input.integer("latitude", [LATITUDE[0], LATITUDE[1]])?;
    let longitude = input.integer("longitude", LONGITUDE)?;
    for (what, found, most) in [
        ("latitude", latitude, LATITUDE[1] - 1),
        ("longitude", longitude, LONGITUDE[1] - 1),
    ] {
        if found > most {
            return Err(MessageError::Range { what, found });
        }
    }
    let major = input.integer("semiMajorConfidence", SEMI_AXIS)?;
    input.integer("semiMinorConfidence", SEMI_AXIS)?;
    input.integer("semiMajorOrientation", HEADING)?;
    let altitude = input.integer("altitudeValue", ALTITUDE)?;
    input.integer("altitudeConfidence", ALTITUDE_CONFIDENCE)?;
    Ok(GeodeticPoint {
        latitude: latitude as i32,
        longitude: longitude as i32,
        accuracy_cm: (major != 4095).then_some(major as u16),
        altitude_cm: (altitude != 800_001).then_some(altitude as i32),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headings_are_clockwise_from_north() {
        use std::f64::consts::{FRAC_PI_2, PI};
        for (yaw_rad, heading) in [(FRAC_PI_2, 0), (0.0, 900), (-FRAC_PI_2, 1800), (PI, 2700)] {
            assert_eq!(heading_from_yaw(yaw_rad), heading);
            assert!((yaw_from_heading(heading) - yaw_rad).abs() < 1e-12, "{heading}");
        }
        assert_eq!(heading_from_yaw(FRAC_PI_2 - 1e-9), 0);
    }

    #[test]
    fn the_time_of_a_message_counts_from_2004() {
        // 2004-01-01 to 2024-01-01: 7305 days and five leap seconds.
        assert_eq!(its_time_ms(0), 7305 * 86_400_000 + 5000);
        // 1970-01-01 to 2024-01-01, in a time without leap seconds: 19 723 days.
        assert_eq!(EPISODE_START_UNIX_S, 19_723 * 86_400);
        assert_eq!(generation_delta_ms(65_536 + 7), 7);
    }
}
