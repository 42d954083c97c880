//! Bits of the unaligned packed encoding rules.

use super::MessageError;

/// Writes bits, the most significant first.
#[derive(Debug, Clone, Default)]
pub struct BitWriter {
    bytes: Vec<u8>,
    /// Bits that do not fill a byte yet, in the low end; what is above them does not count.
    rest: u64,
    /// How many they are, below 8.
    held: u32,
}

impl BitWriter {
    /// The low `count` bits of `value`, at most 64.
    pub fn bits(&mut self, value: u64, count: u32) {
        if count > 32 {
            self.bits(value >> 32, count - 32);
            return self.bits(value, 32);
        }
        self.rest = self.rest << count | value & ((1 << count) - 1);
        self.held += count;
        while self.held >= 8 {
            self.held -= 8;
            self.bytes.push((self.rest >> self.held) as u8);
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
        if self.held > 0 {
            self.bits(0, 8 - self.held);
        }
        if self.bytes.is_empty() {
            self.bytes.push(0);
        }
        self.bytes
    }

    /// An open type: the length of `content` in bytes, then the bytes.
    pub fn open_type(&mut self, content: Self) {
        let bytes = content.finish();
        self.length(bytes.len());
        let (words, last) = bytes.as_chunks::<4>();
        words
            .iter()
            .for_each(|word| self.bits(u32::from_be_bytes(*word).into(), 32));
        last.iter().for_each(|byte| self.bits((*byte).into(), 8));
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

/// Reads bits of a message, or of an open type within it.
#[derive(Debug, Clone)]
pub struct BitReader<'a> {
    bytes: &'a [u8],
    /// Next bit, and one past the last, of `bytes`.
    bit: usize,
    end: usize,
    /// Bits that there are.
    length: usize,
}

impl<'a> BitReader<'a> {
    /// Reads `bytes` from the first bit.
    pub fn new(bytes: &'a [u8]) -> Self {
        let length = 8 * bytes.len();
        Self {
            bytes,
            bit: 0,
            end: length,
            length,
        }
    }

    /// The next `count` bits, at most 57.
    pub fn bits(&mut self, count: u32) -> Result<u64, MessageError> {
        if count as usize > self.end - self.bit {
            return Err(MessageError::Short { bit: self.length });
        }
        if count == 0 {
            return Ok(0);
        }
        // The eight bytes from the one that has the next bit; zeros behind the last.
        let first = self.bit / 8;
        let word = match self.bytes.get(first..).and_then(<[u8]>::first_chunk) {
            Some(eight) => u64::from_be_bytes(*eight),
            None => {
                let mut eight = [0; 8];
                let rest = &self.bytes[first..];
                eight[..rest.len()].copy_from_slice(rest);
                u64::from_be_bytes(eight)
            }
        };
        let value = word << (self.bit % 8) >> (64 - count);
        self.bit += count as usize;
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

    /// The content of an open type.
    pub fn open_type(&mut self) -> Result<Self, MessageError> {
        let length = 8 * self.length()?;
        if length > self.end - self.bit {
            return Err(MessageError::Short { bit: self.length });
        }
        let (bit, end) = (self.bit, self.bit + length);
        self.bit = end;
        Ok(Self {
            bytes: self.bytes,
            bit,
            end,
            length,
        })
    }

    /// Nothing but the filling of the last byte follows.
    pub fn end(&self) -> Result<(), MessageError> {
        match (self.end - self.bit) / 8 {
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

    /// Bits one after the other: the first in the highest bit of the first byte.
    fn one_by_one(values: &[(u64, u32)]) -> Vec<u8> {
        let bits: Vec<bool> = values
            .iter()
            .flat_map(|(value, count)| (0..*count).rev().map(move |place| value >> place & 1 == 1))
            .collect();
        let mut bytes = vec![0; bits.len().div_ceil(8).max(1)];
        for (place, _) in bits.iter().enumerate().filter(|(_, bit)| **bit) {
            bytes[place / 8] |= 0x80 >> (place % 8);
        }
        bytes
    }

    proptest! {
        #[test]
        fn words_are_written_and_read_as_bits_one_by_one(
            values in prop::collection::vec((any::<u64>(), 0_u32..58), 0..40),
            content in prop::collection::vec(any::<u8>(), 1..200),
        ) {
            let mut writer = BitWriter::default();
            values.iter().for_each(|(value, count)| writer.bits(*value, *count));
            let mut inner = BitWriter::default();
            content.iter().for_each(|byte| inner.bits((*byte).into(), 8));
            writer.open_type(inner);
            let length = match content.len() {
                short @ 0..128 => (short as u64, 8),
                long => (0x8000 | long as u64, 16),
            };
            let content = content.iter().map(|byte| (u64::from(*byte), 8));
            let all: Vec<(u64, u32)> = values.iter().copied().chain([length]).chain(content).collect();
            let bytes = writer.finish();
            prop_assert_eq!(&bytes, &one_by_one(&all));
            let mut reader = BitReader::new(&bytes);
            for (value, count) in &values {
                prop_assert_eq!(reader.bits(*count), Ok(value & ((1 << count) - 1)));
            }
            let mut inner = reader.open_type().unwrap();
            for (value, count) in &all[values.len() + 1..] {
                prop_assert_eq!(inner.bits(*count), Ok(*value));
            }
            prop_assert_eq!((inner.end(), reader.end()), (Ok(()), Ok(())));
            prop_assert_eq!(inner.bits(1), Err(MessageError::Short { bit: inner.length }));
        }

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
