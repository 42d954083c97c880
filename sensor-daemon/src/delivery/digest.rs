//! The observation hash: BLAKE3 over every observation of a run, in order.

use ipc_schema::header::MessageHeader;

/// Computes the hash. Run id and incarnation are left out: they are not observed.
#[derive(Debug, Clone, Default)]
pub struct ObservationDigest(blake3::Hasher);

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
            self.0.update(&number.to_le_bytes());
        }
        self.0.update(payload);
    }

    /// The hash so far, 64 hexadecimal digits.
    #[must_use]
    pub fn hex(&self) -> String {
        self.0.finalize().to_hex().to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
                    ..header
                },
                &[1, 2]
            )
        );
        assert_ne!(reference, hash(MessageHeader { tick: 4, ..header }, &[1, 2]));
        assert_ne!(reference, hash(header, &[1, 3]));
    }
}
