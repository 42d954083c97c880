//! The blocks of a PBF file: a length, a header and a blob each.

use std::{
    fs::File,
    io::{BufReader, Read},
    path::Path,
};

use flate2::read::ZlibDecoder;
use prost::{Message, bytes::Bytes};

use super::{
    PbfError,
    message::{Blob, BlobHeader, HeaderBlock, PrimitiveBlock},
};

/// Most bytes of a blob's header and of an unpacked blob, by the format.
const MOST_HEADER_BYTES: usize = 64 * 1024;
const MOST_BLOB_BYTES: usize = 32 * 1024 * 1024;
/// What a reader must know, and what this one knows.
const KNOWN_FEATURES: [&str; 2] = ["OsmSchema-V0.6", "DenseNodes"];
/// An optional feature that a reader must know nevertheless: nodes without tags are left out, because ways have their coordinates.
const LOCATIONS_ON_WAYS: &str = "LocationsOnWays";

/// Reads the blocks of a file in their order.
pub(super) struct PbfBlocks<R> {
    input: R,
    /// Where the next block begins, bytes.
    offset: u64,
}

impl PbfBlocks<BufReader<File>> {
    /// Opens a file.
    ///
    /// # Errors
    /// It cannot be opened, or it is not PBF.
    pub(super) fn open(path: &Path) -> Result<Self, PbfError> {
        Self::new(BufReader::new(File::open(path).map_err(PbfError::Read)?))
    }
}

impl<R: Read> PbfBlocks<R> {
    /// Reads the header.
    ///
    /// # Errors
    /// The input is not PBF, or needs a feature that this reader does not know.
    pub(super) fn new(input: R) -> Result<Self, PbfError> {
        let mut blocks = Self { input, offset: 0 };
        match blocks.header()? {
            Some(header) if header.kind.as_deref() == Some("OSMHeader") => blocks.features(0, &header)?,
            _ => return Err(PbfError::NotPbf),
        }
        Ok(blocks)
    }

    /// Where the next block begins, bytes.
    pub(super) fn offset(&self) -> u64 {
        self.offset
    }

    /// The next block of elements; `None` at the end of the file.
    ///
    /// # Errors
    /// The file is damaged or ends within the block.
    pub(super) fn next(&mut self) -> Result<Option<PrimitiveBlock>, PbfError> {
        loop {
            let begin = self.offset;
            let Some(header) = self.header()? else {
                return Ok(None);
            };
            match header.kind.as_deref() {
                Some("OSMData") => {
                    let block = self.blob(begin, &header)?;
                    let block = PrimitiveBlock::decode(block).map_err(|_| damaged(begin, "its elements"))?;
                    return Ok(Some(block));
                }
                // Two files, one after the other, are a file too.
                Some("OSMHeader") => self.features(begin, &header)?,
                // The format lets a reader skip other kinds. No program writes any, so it is a damaged name, and its elements would be lost.
                _ => return Err(damaged(begin, "its kind")),
            }
        }
    }

    /// The header of the next blob; `None` at the end of the file.
    fn header(&mut self) -> Result<Option<BlobHeader>, PbfError> {
        let begin = self.offset;
        let length = self.bytes(4)?;
        if length.is_empty() {
            return Ok(None);
        }
        // Whatever is wrong with the first header, the file is something else.
        let wrong = || match begin {
            0 => PbfError::NotPbf,
            _ => damaged(begin, "its header"),
        };
        let length: [u8; 4] = length[..].try_into().map_err(|_| match begin {
            0 => PbfError::NotPbf,
            _ => PbfError::Truncated { offset: begin },
        })?;
        let length = usize::try_from(u32::from_be_bytes(length)).unwrap_or(usize::MAX);
        if length == 0 || length > MOST_HEADER_BYTES {
            return Err(wrong());
        }
        let bytes = self.bytes(length)?;
        if bytes.len() < length {
            return Err(PbfError::Truncated { offset: begin });
        }
        let header = BlobHeader::decode(bytes).map_err(|_| wrong())?;
        Ok(Some(header))
    }

    /// The blob after a header, unpacked.
    fn blob(&mut self, begin: u64, header: &BlobHeader) -> Result<Bytes, PbfError> {
        let length = header.size.and_then(|size| usize::try_from(size).ok());
        let length = length.filter(|length| (1..=MOST_BLOB_BYTES).contains(length));
        let length = length.ok_or_else(|| damaged(begin, "its length"))?;
        let bytes = self.bytes(length)?;
        if bytes.len() < length {
            return Err(PbfError::Truncated { offset: begin });
        }
        let blob = Blob::decode(bytes).map_err(|_| damaged(begin, "its blob"))?;
        for (packed, packing) in [
            (&blob.lzma, "LZMA"),
            (&blob.bzip2, "bzip2"),
            (&blob.lz4, "LZ4"),
            (&blob.zstd, "Zstandard"),
        ] {
            if packed.is_some() {
                return Err(PbfError::Packing { packing });
            }
        }
        match (blob.raw, blob.zlib) {
            (Some(raw), None) if raw.len() <= MOST_BLOB_BYTES => Ok(raw),
            (None, Some(packed)) => {
                let length = blob.unpacked_size.and_then(|size| usize::try_from(size).ok());
                let length = length.filter(|length| *length <= MOST_BLOB_BYTES);
                let length = length.ok_or_else(|| damaged(begin, "its length"))?;
                unpack(&packed, length).ok_or_else(|| damaged(begin, "its checksum"))
            }
            _ => Err(damaged(begin, "its blob")),
        }
    }

    /// Refuses a file that needs what this reader does not know.
    fn features(&mut self, begin: u64, header: &BlobHeader) -> Result<(), PbfError> {
        let block = self.blob(begin, header)?;
        let block = HeaderBlock::decode(block).map_err(|_| damaged(begin, "its features"))?;
        let required = block.required_features.into_iter();
        let mut unknown = required.filter(|feature| !KNOWN_FEATURES.contains(&feature.as_str()));
        let optional = block.optional_features.into_iter();
        let mut incomplete = optional.filter(|feature| feature == LOCATIONS_ON_WAYS);
        match unknown.next().or_else(|| incomplete.next()) {
            Some(feature) => Err(PbfError::Feature { feature }),
            None => Ok(()),
        }
    }

    /// The next `length` bytes, or fewer where the file ends.
    fn bytes(&mut self, length: usize) -> Result<Bytes, PbfError> {
        let mut bytes = Vec::with_capacity(length);
        let limit = u64::try_from(length).unwrap_or(u64::MAX);
        let count = self.input.by_ref().take(limit).read_to_end(&mut bytes);
        self.offset += u64::try_from(count.map_err(PbfError::Read)?).unwrap_or(0);
        Ok(bytes.into())
    }
}

/// Unpacks a blob that has `length` bytes then, and compares its checksum; `None` if either is wrong.
fn unpack(packed: &[u8], length: usize) -> Option<Bytes> {
    let mut unpacked = Vec::with_capacity(length);
    let limit = u64::try_from(length).ok()?.checked_add(1)?;
    // One byte more than there should be: the checksum is compared at the end.
    ZlibDecoder::new(packed).take(limit).read_to_end(&mut unpacked).ok()?;
    (unpacked.len() == length).then(|| unpacked.into())
}

fn damaged(offset: u64, what: &'static str) -> PbfError {
    PbfError::Damaged { offset, what }
}
