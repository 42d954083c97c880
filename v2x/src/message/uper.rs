//! Bits of the unaligned packed encoding rules.

use super::MessageError;

/// Writes bits, the most significant first.
#[derive(Debug, Clone, Default)]
pub struct BitWriter {
    bytes: Vec<u8>,
    /// Bits used of the last byte; 0 = all.
    used: u32,
}

impl BitWriter {
    /// The low `count` bits of `value`.
    pub fn bits(&mut self, value: u64, count: u32) {
        for place in (0..count).rev() {
            if self.used == 0 {
                self.bytes.push(0);
            }
            let bit = (value >> place & 1) as u8;
            if let Some(last) = self.bytes.last_mut() {
                *last |= bit << (7 - self.used);
            }
            self.used = (self.used + 1) % 8;
        }
    }

    /// One bit.
    pub fn flag(&mut self, value: bool) {
        self.bits(value.into(), 1);
    }

    /// A whole number from `range`, which limits it.
    pub fn integer(&mut self, value: i64, range: [i64; 2]) {
        let offset = (value.clamp(range[0], range[1]) - range[0]) as u64;
        self.bits(offset, width(range));
    }

    /// The bytes, the last one filled with zeros; at least one, as an open type needs.
    pub fn finish(mut self) -> Vec<u8> {
        if self.bytes.is_empty() {
            self.bytes.push(0);
        }
        self.bytes
    }

    /// An open type: the length of `content` in bytes, then the bytes.
    pub fn open_type(&mut self, content: Self) {
        let bytes = content.finish();
        self.length(bytes.len());
        bytes.iter().for_each(|byte| self.bits((*byte).into(), 8));
    }

    /// A length without a range below 16 384 (X.691, 11.9.3.6 and 11.9.3.7).
    pub fn length(&mut self, length: usize) {
        match length {
            0..128 => self.bits(length as u64, 8),
            _ => self.bits(0x8000 | (length as u64 & 0x3FFF), 16),
        }
    }
}

/// Bits of a whole number of a range.
const fn width(range: [i64; 2]) -> u32 {
    let span = (range[1] - range[0]) as u64;
    64 - span.leading_zeros()
}

/// Reads bits.
#[derive(Debug, Clone)]
pub struct BitReader<'a> {
    bytes: &'a [u8],
    bit: usize,
}

impl<'a> BitReader<'a> {
    /// Reads `bytes` from the first bit.
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, bit: 0 }
    }

    /// The next `count` bits, at most 64.
    pub fn bits(&mut self, count: u32) -> Result<u64, MessageError> {
        let end = self.bit + count as usize;
        if end > self.bytes.len() * 8 {
            return Err(MessageError::Short {
                bit: self.bytes.len() * 8,
            });
        }
        let mut value = 0;
        for bit in self.bit..end {
            value = value << 1 | u64::from(self.bytes[bit / 8] >> (7 - bit % 8) & 1);
        }
        self.bit = end;
        Ok(value)
    }

    /// One bit.
    pub fn flag(&mut self) -> Result<bool, MessageError> {
        Ok(self.bits(1)? == 1)
    }

    /// A whole number from `range`.
    pub fn integer(&mut self, what: &'static str, range: [i64; 2]) -> Result<i64, MessageError> {
        let found = range[0] + self.bits(width(range))? as i64;
        if found > range[1] {
            return Err(MessageError::Range { what, found });
        }
        Ok(found)
    }

    /// An extension bit that must not be set.
    pub fn no_extension(&mut self, what: &'static str) -> Result<(), MessageError> {
        match self.flag()? {
            false => Ok(()),
            true => Err(MessageError::Unsupported { what, found: 1 }),
        }
    }

    /// A length without a range below 16 384.
    pub fn length(&mut self) -> Result<usize, MessageError> {
        if !self.flag()? {
            return Ok(self.bits(7)? as usize);
        }
        match self.flag()? {
            false => Ok(self.bits(14)? as usize),
            true => Err(MessageError::Unsupported {
                what: "a fragmented length",
                found: 0,
            }),
        }
    }

    /// The bytes of an open type.
    pub fn open_type(&mut self) -> Result<Vec<u8>, MessageError> {
        let length = self.length()?;
        if self.bit + 8 * length > 8 * self.bytes.len() {
            return Err(MessageError::Short {
                bit: self.bytes.len() * 8,
            });
        }
        (0..length).map(|_| Ok(self.bits(8)? as u8)).collect()
    }

    /// Nothing but the filling of the last byte follows.
    pub fn end(&self) -> Result<(), MessageError> {
        match self.bytes.len() - self.bit.div_ceil(8) {
            0 => Ok(()),
            bytes => Err(MessageError::Trailing { bytes }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn widths_are_those_of_their_ranges() {
        let widths = [[0, 0], [0, 1], [0, 3601], [1, 127], [-160, 161], [0, 4_294_967_295]].map(width);
        assert_eq!(widths, [0, 1, 12, 7, 9, 32]);
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(values in prop::collection::vec((any::<i32>(), 0_u32..40), 0..40)) {
            let mut writer = BitWriter::default();
            for (value, more) in &values {
                let range = [i64::from(i32::MIN), i64::from(i32::MAX) + (1 << more)];
                writer.integer((*value).into(), range);
                writer.length(*more as usize * 300);
            }
            let bytes = writer.finish();
            let mut reader = BitReader::new(&bytes);
            for (value, more) in &values {
                let range = [i64::from(i32::MIN), i64::from(i32::MAX) + (1 << more)];
                prop_assert_eq!(reader.integer("value", range), Ok((*value).into()));
                prop_assert_eq!(reader.length(), Ok(*more as usize * 300));
            }
            prop_assert_eq!(reader.end(), if values.is_empty() { Err(MessageError::Trailing { bytes: 1 }) } else { Ok(()) });
        }
    }
}
