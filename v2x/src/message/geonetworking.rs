//! GeoNetworking and BTP headers of a single-hop broadcast: ETSI EN 302 636-4-1 V1.4.1, EN 302 636-5-1 V2.2.1, without security.

use super::{MessageError, StationKind};

/// Basic, common and single-hop broadcast header.
const GEONETWORKING_BYTES: usize = 4 + 8 + 28;
/// All headers before a message.
pub const HEADER_BYTES: usize = GEONETWORKING_BYTES + 4;

/// BTP port of a service (EN 302 636-5-1, TS 103 248).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
pub enum BtpPort {
    /// Cooperative awareness.
    Cam = 2001,
    /// Decentralised notification.
    Denm = 2002,
    /// Collective perception.
    Cpm = 2009,
    /// Vulnerable road users.
    Vam = 2018,
}

/// What the headers say of the sender.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PacketHead {
    /// Port of the service.
    pub port: BtpPort,
    /// Station, the last four bytes of its address.
    pub station: u32,
    /// Type of the station, in its address.
    pub kind: u8,
    /// `TimestampIts` modulo 2³².
    pub time_ms: u32,
    /// 0.1 microdegrees north.
    pub latitude: i32,
    /// 0.1 microdegrees east.
    pub longitude: i32,
    /// cm/s.
    pub speed_cmps: i16,
    /// 0.1° clockwise from north.
    pub heading: u16,
}

/// A packet: the headers, then `message`.
#[must_use]
pub fn encode(head: &PacketHead, message: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(HEADER_BYTES + message.len());
    // Basic header: version 1, a common header follows; lifetime 1 s (20 × 50 ms: multiplier 20 in units of 50 ms); one hop.
    out.extend([0x11, 0, 20 << 2, 1]);
    let length = (message.len() + 4) as u16;
    // Common header: BTP-B follows; single-hop broadcast; traffic class 1 for warnings and 2 for all else; mobile or not; length of what
    // follows; one hop.
    let traffic_class = if head.port == BtpPort::Denm { 1 } else { 2 };
    let flags = if head.kind == StationKind::ROADSIDE_UNIT.0 {
        0
    } else {
        0x80
    };
    out.extend([0x20, 0x50, traffic_class, flags]);
    out.extend(length.to_be_bytes());
    out.extend([1, 0]);
    // Long position vector of the sender. Address: set by hand, the type of the station, a local MAC address.
    out.extend([0x80 | (head.kind & 0x1F) << 2, 0, 0x02, 0]);
    out.extend(head.station.to_be_bytes());
    out.extend(head.time_ms.to_be_bytes());
    out.extend(head.latitude.to_be_bytes());
    out.extend(head.longitude.to_be_bytes());
    // The position is accurate; 15 bits of speed.
    out.extend((0x8000 | head.speed_cmps as u16 & 0x7FFF).to_be_bytes());
    out.extend(head.heading.to_be_bytes());
    // Congestion control of the medium: none carried.
    out.extend([0; 4]);
    out.extend((head.port as u16).to_be_bytes());
    out.extend([0; 2]);
    out.extend(message);
    out
}

/// The headers of a packet, and its message.
///
/// # Errors
/// The bytes are no single-hop broadcast of a service known here.
pub fn decode(bytes: &[u8]) -> Result<(PacketHead, &[u8]), MessageError> {
    let (head, message) = bytes
        .split_at_checked(HEADER_BYTES)
        .ok_or(MessageError::Short { bit: bytes.len() * 8 })?;
    let unsupported = |what, found: u8| MessageError::Unsupported {
        what,
        found: found.into(),
    };
    for (what, place, mask, wanted) in [
        ("version and next header of GeoNetworking", 0, 0xFF, 0x11),
        ("next header", 4, 0xF0, 0x20),
        ("header type", 5, 0xFF, 0x50),
    ] {
        if head[place] & mask != wanted {
            return Err(unsupported(what, head[place]));
        }
    }
    let half = |place: usize| u16::from_be_bytes([head[place], head[place + 1]]);
    let word = |place: usize| u32::from_be_bytes([head[place], head[place + 1], head[place + 2], head[place + 3]]);
    if usize::from(half(8)) != message.len() + 4 {
        return Err(MessageError::Range {
            what: "payload length",
            found: half(8).into(),
        });
    }
    let port = half(GEONETWORKING_BYTES);
    let port = [BtpPort::Cam, BtpPort::Denm, BtpPort::Cpm, BtpPort::Vam]
        .into_iter()
        .find(|known| *known as u16 == port)
        .ok_or(MessageError::Unsupported {
            what: "BTP port",
            found: port.into(),
        })?;
    // 15 bits, sign extended.
    let speed_cmps = (half(32) << 1) as i16 >> 1;
    let head = PacketHead {
        port,
        station: word(16),
        kind: head[12] >> 2 & 0x1F,
        time_ms: word(20),
        latitude: word(24) as i32,
        longitude: word(28) as i32,
        speed_cmps,
        heading: half(34),
    };
    Ok((head, message))
}
