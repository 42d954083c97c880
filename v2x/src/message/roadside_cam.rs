//! Cooperative awareness message of a roadside unit: ETSI EN 302 637-2 V1.4.1, with `rsuContainerHighFrequency`.

use super::{
    GeodeticPoint, MessageError, StationKind,
    cam::{DELTA_TIME, MESSAGE_ID},
    its::{BYTE, read_header, read_position, write_header, write_position},
    uper::{BitReader, BitWriter},
};

/// A roadside unit's message: where it stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RoadsideCam {
    /// Station.
    pub station: u32,
    /// Time of the message, milliseconds modulo 65 536.
    pub generation_delta_ms: u16,
    /// Place of the antenna.
    pub position: GeodeticPoint,
}

impl RoadsideCam {
    /// The bytes.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut out = BitWriter::default();
        write_header(&mut out, MESSAGE_ID, self.station);
        out.integer(self.generation_delta_ms.into(), DELTA_TIME);
        // CamParameters: extension, low-frequency container, special vehicle container. BasicContainer: extension.
        out.bits(0, 4);
        out.integer(StationKind::ROADSIDE_UNIT.0.into(), BYTE);
        write_position(&mut out, &self.position);
        // HighFrequencyContainer: extension, the second of two alternatives. It: extension, no protected zones.
        out.bits(0b0100, 4);
        out.finish()
    }

    /// Reads a message.
    ///
    /// # Errors
    /// The bytes are no such message of a roadside unit, or have parts that are not read.
    pub fn decode(bytes: &[u8]) -> Result<Self, MessageError> {
        let mut input = BitReader::new(bytes);
        let station = read_header(&mut input, MESSAGE_ID)?;
        let generation_delta_ms = input.integer("generationDeltaTime", DELTA_TIME)? as u16;
        let unsupported = |what, found| Err(MessageError::Unsupported { what, found });
        match input.bits(4)? as u32 {
            0 => {}
            found => return unsupported("optional containers of a roadside unit", found),
        }
        match input.integer("stationType", BYTE)? as u8 {
            kind if kind == StationKind::ROADSIDE_UNIT.0 => {}
            kind => return unsupported("type of a roadside unit", kind.into()),
        }
        let position = read_position(&mut input)?;
        match input.bits(4)? as u32 {
            0b0100 => {}
            found => return unsupported("high-frequency container of a roadside unit", found),
        }
        input.end()?;
        Ok(Self {
            station,
            generation_delta_ms,
            position,
        })
    }
}
