//! The observation hash: BLAKE3 over every observation of a run, in order.

use crate::header::MessageHeader;
use blake3::{
    Hasher,
    hazmat::{ChainingValue, HasherExt as _, Mode, merge_subtrees_non_root, merge_subtrees_root},
};
use serde::{Deserialize, Serialize};

/// Bytes that are hashed together: 16 of BLAKE3's chunks, which fill the widest vectors.
const GROUP_BYTES: usize = 16 * blake3::CHUNK_LEN;

/// Computes the hash. Run id and incarnation are left out: they are not observed.
///
/// It can be stored and continued: `blake3::Hasher` cannot, so this keeps the chaining values of BLAKE3's tree itself (section 2.1 of
/// the BLAKE3 paper).
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObservationDigest {
    /// Complete subtrees from left to right, each larger than the next.
    subtrees: Vec<ChainingValue>,
    /// Groups in these subtrees.
    groups: u64,
    /// The bytes behind them: at most a group, and never empty once anything has been added, because the last group may be the root.
    #[serde(with = "hexadecimal")]
    pending: Vec<u8>,
}

impl ObservationDigest {
    /// Adds one message.
    pub fn add(&mut self, header: &MessageHeader, payload: &[u8]) {
        let [slots, fields, ..] = header.shape;
        let numbers = [
            header.episode,
            header.episode_seed,
            header.tick,
            header.sim_time_ns,
            slots.into(),
            fields.into(),
            // Flags, stage and map count as one number, which older runs stored as one field.
            u64::from(header.flags | u32::from(header.stage) << 16 | u32::from(header.map) << 24),
        ];
        for number in numbers {
            self.update(&number.to_le_bytes());
        }
        self.update(payload);
    }

    fn update(&mut self, mut bytes: &[u8]) {
        // A group is closed only when a byte follows it.
        if !self.pending.is_empty() && self.pending.len() + bytes.len() > GROUP_BYTES {
            let (rest, later) = bytes.split_at(GROUP_BYTES - self.pending.len());
            let mut group = std::mem::take(&mut self.pending);
            group.extend_from_slice(rest);
            self.close_group(&group);
            group.clear();
            self.pending = group;
            bytes = later;
        }
        while bytes.len() > GROUP_BYTES {
            let (group, later) = bytes.split_at(GROUP_BYTES);
            self.close_group(group);
            bytes = later;
        }
        self.pending.extend_from_slice(bytes);
    }

    /// Makes `group`, which has more behind it, the next subtree, and merges subtrees of the same size.
    fn close_group(&mut self, group: &[u8]) {
        let mut subtree = self.value(group);
        self.groups += 1;
        let mut size = self.groups;
        while size.is_multiple_of(2)
            && let Some(left) = self.subtrees.pop()
        {
            subtree = merge_subtrees_non_root(&left, &subtree, Mode::Hash);
            size /= 2;
        }
        self.subtrees.push(subtree);
    }

    /// Chaining value of `group`, the next one, which is not the root.
    fn value(&self, group: &[u8]) -> ChainingValue {
        let mut hasher = Hasher::new();
        hasher.set_input_offset(self.groups * GROUP_BYTES as u64);
        hasher.update(group).finalize_non_root()
    }

    /// The hash so far, 64 hexadecimal digits.
    #[must_use]
    pub fn hex(&self) -> String {
        let Some((first, rest)) = self.subtrees.split_first() else {
            return blake3::hash(&self.pending).to_hex().to_string();
        };
        let merge = |right: ChainingValue, left: &ChainingValue| merge_subtrees_non_root(left, &right, Mode::Hash);
        let right = rest.iter().rev().fold(self.value(&self.pending), merge);
        merge_subtrees_root(first, &right, Mode::Hash).to_hex().to_string()
    }
}

/// Bytes as hexadecimal digits: a quarter of the length that JSON gives a list of numbers.
mod hexadecimal {
    use serde::{Deserialize as _, Deserializer, Serializer, de::Error as _};

    pub fn serialize<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&Digits(bytes))
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<u8>, D::Error> {
        let text = String::deserialize(deserializer)?;
        let digit = |at: usize| text.get(at..at + 2).and_then(|pair| u8::from_str_radix(pair, 16).ok());
        (0..text.len())
            .step_by(2)
            .map(|at| digit(at).ok_or_else(|| D::Error::custom("not pairs of hexadecimal digits")))
            .collect()
    }

    struct Digits<'a>(&'a [u8]);

    impl std::fmt::Display for Digits<'_> {
        fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_byte_and_the_time_count_but_not_the_run() {
        let hash = |header: MessageHeader, payload: &[u8]| {
            let mut digest = ObservationDigest::default();
            digest.add(&header, payload);
            digest.hex()
        };
        let header = MessageHeader {
            tick: 3,
            ..MessageHeader::default()
        };
        let reference = hash(header, &[1, 2]);
        assert_eq!(
            reference,
            hash(
                MessageHeader {
                    run_id: 9,
                    incarnation: 2,
                    addressee: 3,
                    ..header
                },
                &[1, 2]
            )
        );
        for other in [
            MessageHeader { tick: 4, ..header },
            MessageHeader { stage: 1, ..header },
            MessageHeader { map: 1, ..header },
        ] {
            assert_ne!(reference, hash(other, &[1, 2]));
        }
        assert_ne!(reference, hash(header, &[1, 3]));
    }

    proptest! {
        /// It is BLAKE3, whatever the lengths, and also if it is stored and read again at any place.
        #[test]
        fn it_is_blake3_and_continues_where_it_was_stored(
            groups in 0_usize..20,
            rest in prop_oneof![Just(0_usize), Just(1), Just(GROUP_BYTES - 1), 0..GROUP_BYTES],
            step in 1_usize..5 * GROUP_BYTES,
            stored_at in any::<prop::sample::Index>(),
        ) {
            let bytes: Vec<u8> = (0..groups * GROUP_BYTES + rest).map(|i| (i * i % 251) as u8).collect();
            let parts: Vec<&[u8]> = bytes.chunks(step).collect();
            let stored_at = if parts.is_empty() { 0 } else { stored_at.index(parts.len()) };
            let mut digest = ObservationDigest::default();
            for (number, part) in parts.into_iter().enumerate() {
                if number == stored_at {
                    let text = serde_json::to_string(&digest).unwrap();
                    digest = serde_json::from_str(&text).unwrap();
                }
                digest.update(part);
            }
            prop_assert_eq!(digest.hex(), blake3::hash(&bytes).to_hex().to_string());
        }
    }
}
