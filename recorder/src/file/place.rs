//! Records of an MCAP file at a place: what lies there, checked before it is used.

use mcap::records::{ChunkHeader, Record};

/// Bytes before the body of a record: its kind and the length of the body.
pub(super) const RECORD_HEAD: u64 = 9;

/// A record's kind and the place of its body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RecordPlace {
    pub(super) kind: u8,
    /// First byte of the record.
    pub(super) offset: u64,
    /// Bytes of its body.
    pub(super) body: u64,
}

impl RecordPlace {
    /// The record that these bytes at `offset` begin; `None` if `end` comes before its end.
    pub(super) fn read(head: [u8; RECORD_HEAD as usize], offset: u64, end: u64) -> Option<Self> {
        let [kind, length @ ..] = head;
        let body = u64::from_le_bytes(length);
        let fits = (offset + RECORD_HEAD).checked_add(body).is_some_and(|last| last <= end);
        fits.then_some(Self { kind, offset, body })
    }

    pub(super) fn end(self) -> u64 {
        self.offset + RECORD_HEAD + self.body
    }
}

/// The record of `kind` with this body. The library reads beyond the end of an attachment that is too short, so that is checked here.
pub(super) fn parse(kind: u8, body: &[u8]) -> Result<Record<'_>, String> {
    if kind == mcap::records::op::ATTACHMENT && !holds_attachment(body) {
        return Err("an attachment is shorter than its own head".into());
    }
    mcap::parse_record(kind, body).map_err(|error| error.to_string())
}

/// True if the head of an attachment and its checksum fit into `body`.
fn holds_attachment(body: &[u8]) -> bool {
    let length_at = |at: usize| {
        let bytes = body.get(at..at.checked_add(4)?)?;
        usize::try_from(u32::from_le_bytes(bytes.try_into().ok()?)).ok()
    };
    let ends = || {
        let name = 16_usize.checked_add(4)?.checked_add(length_at(16)?)?;
        let media_type = name.checked_add(4)?.checked_add(length_at(name)?)?;
        media_type.checked_add(8 + 4)
    };
    ends().is_some_and(|end| end <= body.len())
}

/// The messages of a chunk, decompressed and checked against its checksum.
pub(super) fn decompress(header: &ChunkHeader, data: &[u8], limit: u64) -> Result<Vec<u8>, String> {
    if header.uncompressed_size > limit {
        return Err(format!("a chunk of {} bytes is too long", header.uncompressed_size));
    }
    let size = usize::try_from(header.uncompressed_size).map_err(|error| error.to_string())?;
    let bytes = match header.compression.as_str() {
        "zstd" => {
            zstd::bulk::decompress(data, size).map_err(|error| format!("a chunk does not decompress: {error}"))?
        }
        "" => data.to_vec(),
        other => return Err(format!("a chunk has the unknown compression \"{other}\"")),
    };
    let sum = crc32fast::hash(&bytes);
    if bytes.len() != size || header.uncompressed_crc == 0 || sum != header.uncompressed_crc {
        return Err("a chunk is not what its checksum says".into());
    }
    Ok(bytes)
}

/// The records in a decompressed chunk, in order; an error where one does not fit.
pub(super) fn records(chunk: &[u8]) -> impl Iterator<Item = Result<(u8, &[u8]), String>> {
    let mut at = 0;
    std::iter::from_fn(move || {
        let rest = chunk.get(at..).filter(|rest| !rest.is_empty())?;
        let record = rest
            .first_chunk()
            .and_then(|head| RecordPlace::read(*head, 0, rest.len() as u64));
        let Some(record) = record else {
            at = chunk.len();
            return Some(Err("a record goes beyond the end of its chunk".into()));
        };
        #[expect(clippy::cast_possible_truncation, reason = "within the chunk")]
        let (begin, end) = (RECORD_HEAD as usize, record.end() as usize);
        at += end;
        Some(Ok((record.kind, &rest[begin..end])))
    })
}
