//! Header of a WAVE short message: IEEE 1609.3-2016, version 3, with the provider service identifier of vehicles' basic safety messages.

use super::MessageError;

/// Version 3 without extensions, a service identifier follows, and that of vehicle-to-vehicle safety (0x20).
const HEAD: [u8; 3] = [0x03, 0x00, 0x20];
/// Largest length in two bytes.
const MOST_BYTES: usize = 0x3FFF;

/// A packet: the header, then `message`, of which 16 383 bytes count.
#[must_use]
pub fn encode(message: &[u8]) -> Vec<u8> {
    let message = &message[..message.len().min(MOST_BYTES)];
    let mut out = Vec::with_capacity(HEAD.len() + 2 + message.len());
    out.extend(HEAD);
    match message.len() {
        short @ 0..128 => out.push(short as u8),
        long => out.extend((0x8000 | long as u16).to_be_bytes()),
    }
    out.extend(message);
    out
}

/// The message of a packet.
///
/// # Errors
/// The bytes are no such packet.
pub fn decode(bytes: &[u8]) -> Result<&[u8], MessageError> {
    let short = MessageError::Short { bit: 8 * bytes.len() };
    let (head, rest) = bytes.split_at_checked(HEAD.len()).ok_or(short)?;
    if head != HEAD {
        return Err(MessageError::Unsupported {
            what: "head of a WAVE short message",
            found: head[0].into(),
        });
    }
    let (length, message) = match *rest {
        [length @ 0..128, ref message @ ..] => (usize::from(length), message),
        [high, low, ref message @ ..] => (usize::from(u16::from_be_bytes([high, low]) & 0x3FFF), message),
        _ => return Err(short),
    };
    match message.len() == length {
        true => Ok(message),
        false => Err(MessageError::Range {
            what: "length of a WAVE short message",
            found: length as i64,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_is_three_bytes_and_a_length() {
        assert_eq!(encode(&[0xAA, 0xBB]), [0x03, 0x00, 0x20, 0x02, 0xAA, 0xBB]);
        assert_eq!(encode(&[7; 300])[..5], [0x03, 0x00, 0x20, 0x81, 0x2C]);
        for length in [0, 1, 127, 128, 300] {
            let message = vec![9; length];
            assert_eq!(decode(&encode(&message)), Ok(&message[..]));
        }
        for wrong in [
            &[][..],
            &[3, 0, 0x20],
            &[3, 0, 0x20, 1],
            &[3, 0, 0x20, 0x80],
            &[2, 0, 0x20, 0],
            &[3, 0, 0x20, 0, 1],
        ] {
            assert!(decode(wrong).is_err(), "{wrong:?}");
        }
    }
}
