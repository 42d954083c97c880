//! Messages beside those that independent encoders made of the same values (`data/messages.py`), and bytes that are no messages.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests assert by unwrapping")]

use serde_json::Value;
use v2x::message::{
    GeodeticPoint, StationKind,
    bsm::BsmCore,
    cam::{Cam, PathPoint},
    cpm::{Cpm, CpmOrigin, PerceivedObject, SensorRegion},
    denm::{Denm, DenmEvent, DenmTermination},
    geonetworking::{self, BtpPort, PacketHead},
    roadside_cam::RoadsideCam,
    vam::{Vam, VamProfile},
};

fn vectors() -> Value {
    serde_json::from_str(include_str!("data/messages.json")).unwrap()
}

fn bytes(hex: &Value) -> Vec<u8> {
    let hex = hex.as_str().unwrap();
    (0..hex.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap())
        .collect()
}

/// A number, `None` for null.
fn optional<T: TryFrom<i64>>(value: &Value) -> Option<T> {
    value.as_i64().and_then(|number| T::try_from(number).ok())
}

fn number<T: TryFrom<i64>>(value: &Value) -> T {
    optional(value).unwrap_or_else(|| panic!("{value}"))
}

fn position(of: &Value) -> GeodeticPoint {
    GeodeticPoint {
        latitude: number(&of["latitude"]),
        longitude: number(&of["longitude"]),
        accuracy_cm: optional(&of["accuracy_cm"]),
        altitude_cm: optional(&of["altitude_cm"]),
    }
}

fn cam(of: &Value) -> Cam {
    let point = |point: &Value| PathPoint {
        delta_latitude: number(&point["delta_latitude"]),
        delta_longitude: number(&point["delta_longitude"]),
        time_10ms: optional(&point["time_10ms"]),
    };
    Cam {
        station: number(&of["station"]),
        kind: StationKind(number(&of["kind"])),
        generation_delta_ms: number(&of["generation_delta_ms"]),
        position: position(&of["position"]),
        heading: optional(&of["heading"]),
        heading_confidence: optional(&of["heading_confidence"]),
        speed_cmps: optional(&of["speed_cmps"]),
        speed_confidence: optional(&of["speed_confidence"]),
        length_10cm: number(&of["length_10cm"]),
        has_trailer: of["has_trailer"].as_bool().unwrap_or(false),
        width_10cm: number(&of["width_10cm"]),
        acceleration: optional(&of["acceleration"]),
        yaw_rate: optional(&of["yaw_rate"]),
        path: of["path"].as_array().map(|path| path.iter().map(point).collect()),
    }
}

fn cpm(of: &Value) -> Cpm {
    let object = |of: &Value| PerceivedObject {
        object: number(&of["object"]),
        delta_ms: number(&of["delta_ms"]),
        position_cm: [0, 1].map(|axis| number(&of["position_cm"][axis])),
        position_confidence_cm: number(&of["position_confidence_cm"]),
        velocity_cmps: [0, 1].map(|axis| number(&of["velocity_cmps"][axis])),
        velocity_confidence: number(&of["velocity_confidence"]),
        angle: number(&of["angle"]),
        size_10cm: [0, 1].map(|axis| number(&of["size_10cm"][axis])),
        quality: number(&of["quality"]),
        is_person: of["is_person"].as_bool().unwrap(),
    };
    Cpm {
        station: number(&of["station"]),
        reference_time_ms: number(&of["reference_time_ms"]),
        position: position(&of["position"]),
        // A roadside unit has no orientation.
        origin: optional(&of["heading"]).map_or(CpmOrigin::Roadside, |heading| CpmOrigin::Vehicle { heading }),
        sensor: optional(&of["sensor_range_10cm"]).map(|range_10cm| SensorRegion {
            range_10cm,
            opening: of["opening"]
                .as_array()
                .map(|angles| [0, 1].map(|place: usize| number(&angles[place]))),
        }),
        perceived: number(&of["perceived"]),
        objects: of["objects"].as_array().unwrap().iter().map(object).collect(),
    }
}

fn roadside_cam(of: &Value) -> RoadsideCam {
    RoadsideCam {
        station: number(&of["station"]),
        generation_delta_ms: number(&of["generation_delta_ms"]),
        position: position(&of["position"]),
    }
}

fn denm(of: &Value) -> Denm {
    let event = |event: &Value| DenmEvent {
        quality: number(&event["quality"]),
        cause: [0, 1].map(|place| number(&event["cause"][place])),
        speed_cmps: optional(&event["speed_cmps"]),
        heading: optional(&event["heading"]),
    };
    Denm {
        station: number(&of["station"]),
        kind: StationKind(number(&of["kind"])),
        originator: number(&of["originator"]),
        sequence: number(&of["sequence"]),
        detected_ms: number(&of["detected_ms"]),
        reference_ms: number(&of["reference_ms"]),
        termination: of["termination"].as_i64().map(|termination| match termination {
            0 => DenmTermination::Cancellation,
            _ => DenmTermination::Negation,
        }),
        position: position(&of["position"]),
        relevance: optional(&of["relevance"]),
        traffic: optional(&of["traffic"]),
        validity_s: number(&of["validity_s"]),
        interval_ms: optional(&of["interval_ms"]),
        event: Some(&of["event"]).filter(|value| !value.is_null()).map(event),
    }
}

fn vam(of: &Value) -> Vam {
    let profile = |profile: &Value| VamProfile {
        subprofile: number(&profile["subprofile"]),
        size_class: number(&profile["size_class"]),
    };
    Vam {
        station: number(&of["station"]),
        kind: StationKind(number(&of["kind"])),
        generation_delta_ms: number(&of["generation_delta_ms"]),
        position: position(&of["position"]),
        heading: optional(&of["heading"]),
        heading_confidence: optional(&of["heading_confidence"]),
        speed_cmps: optional(&of["speed_cmps"]),
        speed_confidence: optional(&of["speed_confidence"]),
        acceleration: optional(&of["acceleration"]),
        profile: Some(&of["profile"]).filter(|value| !value.is_null()).map(profile),
    }
}

fn bsm(of: &Value) -> BsmCore {
    let axes = of["accuracy_5cm"].as_array();
    let brakes = of["wheel_brakes"].as_array();
    BsmCore {
        count: number(&of["count"]),
        id: number(&of["id"]),
        second_mark_ms: optional(&of["second_mark_ms"]),
        latitude: optional(&of["latitude"]),
        longitude: optional(&of["longitude"]),
        elevation_10cm: optional(&of["elevation_10cm"]),
        accuracy_5cm: axes.map(|axes| [0, 1].map(|place: usize| number(&axes[place]))),
        transmission: number(&of["transmission"]),
        speed: optional(&of["speed"]),
        heading: optional(&of["heading"]),
        steering_wheel: optional(&of["steering_wheel"]),
        acceleration: [0, 1].map(|place| optional(&of["acceleration"][place])),
        yaw_rate: number(&of["yaw_rate"]),
        wheel_brakes: brakes.map(|brakes| [0, 1, 2, 3].map(|place: usize| brakes[place].as_bool().unwrap())),
        width_cm: number(&of["width_cm"]),
        length_cm: number(&of["length_cm"]),
    }
}

#[test]
fn cams_are_bit_for_bit_those_of_asn1tools_and_pycrate() {
    let vectors = vectors();
    for vector in vectors["cam"].as_array().unwrap() {
        let (ours, theirs) = (cam(&vector["values"]), bytes(&vector["hex"]));
        assert_eq!(ours.encode(), theirs, "{ours:?}");
        assert_eq!(Cam::decode(&theirs).unwrap(), ours);
    }
}

#[test]
fn cpms_are_bit_for_bit_those_of_asn1tools_and_pycrate() {
    let vectors = vectors();
    let of = |kind: &str| vectors[kind].as_array().unwrap().clone();
    for vector in of("cpm").iter().chain(&of("roadside_cpm")) {
        let (ours, theirs) = (cpm(&vector["values"]), bytes(&vector["hex"]));
        assert_eq!(ours.encode(), theirs, "{ours:?}");
        assert_eq!(Cpm::decode(&theirs).unwrap(), ours);
    }
}

#[test]
fn cams_of_roadside_units_are_bit_for_bit_those_of_asn1tools_and_pycrate() {
    for vector in vectors()["roadside_cam"].as_array().unwrap() {
        let (ours, theirs) = (roadside_cam(&vector["values"]), bytes(&vector["hex"]));
        assert_eq!(ours.encode(), theirs, "{ours:?}");
        assert_eq!(RoadsideCam::decode(&theirs).unwrap(), ours);
        // A vehicle's message is another one.
        assert!(Cam::decode(&theirs).is_err());
    }
}

#[test]
fn denms_are_bit_for_bit_those_of_asn1tools_and_pycrate() {
    for vector in vectors()["denm"].as_array().unwrap() {
        let (ours, theirs) = (denm(&vector["values"]), bytes(&vector["hex"]));
        assert_eq!(ours.encode(), theirs, "{ours:?}");
        assert_eq!(Denm::decode(&theirs).unwrap(), ours);
    }
}

#[test]
fn vams_are_bit_for_bit_those_of_asn1tools_and_pycrate() {
    for vector in vectors()["vam"].as_array().unwrap() {
        let (ours, theirs) = (vam(&vector["values"]), bytes(&vector["hex"]));
        assert_eq!(ours.encode(), theirs, "{ours:?}");
        assert_eq!(Vam::decode(&theirs).unwrap(), ours);
    }
}

#[test]
fn bsms_are_bit_for_bit_those_of_asn1tools_and_pycrate() {
    for vector in vectors()["bsm"].as_array().unwrap() {
        let (ours, theirs) = (bsm(&vector["values"]), bytes(&vector["hex"]));
        assert_eq!(ours.encode(), theirs, "{ours:?}");
        assert_eq!(BsmCore::decode(&theirs).unwrap(), ours);
    }
}

/// A packet with every header field, checked by hand against EN 302 636-4-1, tables 2 to 9.
#[test]
fn the_headers_are_those_of_a_single_hop_broadcast() {
    let head = PacketHead {
        port: BtpPort::Cam,
        station: 0x0102_0304,
        kind: 5,
        time_ms: 0x1122_3344,
        latitude: 525_200_000,
        longitude: -134_000_000,
        speed_cmps: -300,
        heading: 2715,
    };
    let packet = geonetworking::encode(&head, &[0xAA, 0xBB]);
    let expected: [&[u8]; 6] = [
        // Basic header: version 1, common header next; reserved; lifetime 20 × 50 ms; one hop.
        &[0x11, 0x00, 0x50, 0x01],
        // Common header: BTP-B; TSB, single hop; class 2; mobile; 6 bytes; one hop; reserved.
        &[0x20, 0x50, 0x02, 0x80, 0x00, 0x06, 0x01, 0x00],
        // Address: manual, passenger car; MAC address; time stamp.
        &[0x94, 0x00, 0x02, 0x00, 0x01, 0x02, 0x03, 0x04, 0x11, 0x22, 0x33, 0x44],
        // Latitude, longitude, accurate with −300 cm/s in 15 bits, heading.
        &[0x1F, 0x4D, 0xEA, 0x80, 0xF8, 0x03, 0x52, 0x80, 0xFE, 0xD4, 0x0A, 0x9B],
        // Media-dependent data; port 2001, no information.
        &[0x00, 0x00, 0x00, 0x00, 0x07, 0xD1, 0x00, 0x00],
        &[0xAA, 0xBB],
    ];
    assert_eq!(packet, expected.concat());
    assert_eq!(geonetworking::decode(&packet), Ok((head, &[0xAA, 0xBB][..])));
}

/// Xorshift: any bytes that repeat.
struct Mutations(u64);

impl Mutations {
    fn next(&mut self, below: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as usize % below
    }

    /// Flips bits, cuts, lengthens or overwrites.
    fn mutate(&mut self, bytes: &mut Vec<u8>) {
        for _ in 0..=self.next(4) {
            match self.next(4) {
                0 if !bytes.is_empty() => bytes.truncate(self.next(bytes.len())),
                1 => bytes.extend([self.next(256) as u8; 3]),
                2 if !bytes.is_empty() => {
                    let place = self.next(bytes.len());
                    bytes[place] = self.next(256) as u8;
                }
                _ if !bytes.is_empty() => {
                    let place = self.next(bytes.len());
                    bytes[place] ^= 1 << self.next(8);
                }
                _ => {}
            }
        }
    }
}

fn variable(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap())
}

/// Whatever is read of mutated bytes is a message that is written and read again as the same; nothing panics. A third of the frames are
/// whole packets, mutated anywhere. `CARAWARE_FUZZ_FRAMES` and `CARAWARE_FUZZ_SEED` choose more frames, and others.
#[test]
fn a_million_mutated_messages_and_packets_are_refused_or_read_without_a_panic() {
    let vectors = vectors();
    let of = |kind: &str| {
        vectors[kind]
            .as_array()
            .unwrap()
            .iter()
            .map(|vector| bytes(&vector["hex"]))
            .collect::<Vec<_>>()
    };
    // A BSM has no port: here its bytes come in the packets of CAMs.
    let messages = [
        ("cam", BtpPort::Cam),
        ("cpm", BtpPort::Cpm),
        ("denm", BtpPort::Denm),
        ("vam", BtpPort::Vam),
        ("bsm", BtpPort::Cam),
        ("roadside_cam", BtpPort::Cam),
        ("roadside_cpm", BtpPort::Cpm),
    ]
    .map(|(kind, port)| (kind, port, of(kind)));
    let frames = variable("CARAWARE_FUZZ_FRAMES", 1_000_000);
    let seed = variable("CARAWARE_FUZZ_SEED", 1);
    let mut mutations = Mutations(0x9E37_79B9_7F4A_7C15_u64.wrapping_mul(2 * seed + 1));
    // Messages and packets that were read, and both that were not.
    let (mut read, mut unpacked, mut refused) = (0_u64, 0_u64, 0_u64);
    for _ in 0..frames {
        let (kind, port, examples) = &messages[mutations.next(messages.len())];
        let mut message = examples[mutations.next(examples.len())].clone();
        if mutations.next(3) == 0 {
            let head = PacketHead {
                port: *port,
                station: 7,
                kind: 5,
                time_ms: 1,
                latitude: 525_200_000,
                longitude: -134_000_000,
                speed_cmps: -300,
                heading: 2715,
            };
            let mut packet = geonetworking::encode(&head, &message);
            mutations.mutate(&mut packet);
            match geonetworking::decode(&packet) {
                Ok((_, content)) => message = content.to_vec(),
                Err(_) => {
                    refused += 1;
                    continue;
                }
            }
            unpacked += 1;
        } else {
            mutations.mutate(&mut message);
        }
        let is_read = match *kind {
            "cam" => Cam::decode(&message)
                .map(|cam| assert_eq!(Cam::decode(&cam.encode()).unwrap(), cam))
                .is_ok(),
            "roadside_cam" => RoadsideCam::decode(&message)
                .map(|cam| assert_eq!(RoadsideCam::decode(&cam.encode()).unwrap(), cam))
                .is_ok(),
            "cpm" | "roadside_cpm" => Cpm::decode(&message)
                .map(|cpm| assert_eq!(Cpm::decode(&cpm.encode()).unwrap(), cpm))
                .is_ok(),
            "denm" => Denm::decode(&message)
                .map(|denm| assert_eq!(Denm::decode(&denm.encode()).unwrap(), denm))
                .is_ok(),
            "vam" => Vam::decode(&message)
                .map(|vam| assert_eq!(Vam::decode(&vam.encode()).unwrap(), vam))
                .is_ok(),
            _ => BsmCore::decode(&message)
                .map(|bsm| assert_eq!(BsmCore::decode(&bsm.encode()).unwrap(), bsm))
                .is_ok(),
        };
        *(if is_read { &mut read } else { &mut refused }) += 1;
    }
    // Many mutations only change a value; most break the message.
    assert!(
        read > frames / 100 && unpacked > frames / 100 && refused > frames / 10,
        "{read} read, {unpacked} unpacked, {refused} refused"
    );
}
