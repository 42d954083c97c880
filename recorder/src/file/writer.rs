//! Writes a recording. The file has whole chunks at any moment: a chunk is complete in memory before its first byte is written.

use std::{
    collections::BTreeMap,
    fs::{File, OpenOptions},
    io::{Cursor, Seek, SeekFrom, Write},
    num::NonZero,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use ipc_schema::{
    channel::Channel,
    config::{ChunkCompression, RecordConfig},
    digest::ObservationDigest,
    header::MessageHeader,
    layout,
};
use mcap::{Attachment, Compression, WriteOptions, Writer, records::MessageHeader as McapMessageHeader};

use super::{
    CHUNK_TOPIC, END, MESSAGE_ENCODING, PROFILE, RecordingEnd, RecordingError, RecordingStart, SCHEMA_ENCODING, START,
    pages::WrittenPages,
};

/// Longest time that a message waits for its chunk to be full.
const CHUNK_WITHIN: Duration = Duration::from_secs(2);
/// Bytes of a message header.
const HEADER_BYTES: usize = size_of::<MessageHeader>();

/// Threads of zstd that compress while the next messages are taken in: two where enough cores are there for a run beside them. On fewer cores
/// producers that wait for the recorder get one. A recorder that no process waits for compresses by itself, which costs least.
fn compression_threads(is_lossless: bool) -> u32 {
    match std::thread::available_parallelism().map_or(1, NonZero::get) {
        0..6 => u32::from(is_lossless),
        _ => 2,
    }
}

/// What the MCAP writer has written and the file does not have yet. A chunk is compressed into it, and then gets its header at its beginning.
#[derive(Debug, Clone, Default)]
struct PendingBytes(Arc<Mutex<Pending>>);

#[derive(Debug, Default)]
struct Pending {
    /// Bytes before these.
    before: u64,
    bytes: Cursor<Vec<u8>>,
}

impl PendingBytes {
    fn lock(&self) -> MutexGuard<'_, Pending> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Moves the bytes behind those of `unwritten`. Both keep their memory: without it each chunk would ask the system for new pages.
    fn move_to(&self, unwritten: &mut Vec<u8>) {
        let mut pending = self.lock();
        let bytes = pending.bytes.get_mut();
        let moved = bytes.len() as u64;
        match unwritten.is_empty() {
            true => std::mem::swap(unwritten, bytes),
            false => unwritten.append(bytes),
        }
        pending.before += moved;
        pending.bytes.set_position(0);
    }
}

impl Write for PendingBytes {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.lock().bytes.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Seek for PendingBytes {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        let mut pending = self.lock();
        let before = pending.before;
        let to = match to {
            SeekFrom::Start(position) => SeekFrom::Start(position.checked_sub(before).ok_or_else(is_written)?),
            to => to,
        };
        Ok(before + pending.bytes.seek(to)?)
    }
}

fn is_written() -> std::io::Error {
    std::io::Error::new(std::io::ErrorKind::InvalidInput, "these bytes are in the file already")
}

/// A topic whose messages are lines of JSON.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum LineTopic {
    /// Commands to the simulation (`commands.jsonl`).
    Commands,
    /// Stages of the curriculum (`curriculum.jsonl`).
    Curriculum,
}

impl LineTopic {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Commands, Self::Curriculum];

    /// Its name in the file.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Commands => "commands",
            Self::Curriculum => "curriculum",
        }
    }
}

/// How messages are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChunkOptions {
    /// How chunks are compressed.
    pub compression: ChunkCompression,
    /// Level of zstd. Those below 0 are faster, and 0 is zstd's own default.
    pub compression_level: i32,
    /// Size of a chunk before compression, MiB.
    pub chunk_mib: u32,
}

impl From<&RecordConfig> for ChunkOptions {
    fn from(record: &RecordConfig) -> Self {
        Self {
            compression: record.compression,
            compression_level: record.compression_level,
            chunk_mib: record.chunk_mib,
        }
    }
}

/// A recording that is being written.
pub struct RecordingWriter {
    path: PathBuf,
    file: File,
    pages: WrittenPages,
    /// Bytes of the file that are complete.
    len: u64,
    /// Bytes of the file without what was written last.
    len_before: u64,
    /// Complete bytes that are not in the file yet.
    unwritten: Vec<u8>,
    pending: PendingBytes,
    mcap: Writer<PendingBytes>,
    start: RecordingStart,
    /// Numbers of the recorded channels in the file, by [`Channel`].
    channels: [Option<u16>; Channel::COUNT],
    lines: [u16; LineTopic::ALL.len()],
    chunk_topic: u16,
    /// Chunks begun.
    chunks: u64,
    /// Bytes of messages in the chunk that is being filled, and when it was begun.
    filling: Option<(usize, Instant)>,
    chunk_bytes: usize,
    encoded: Vec<u8>,
    digest: ObservationDigest,
    messages: [u64; Channel::COUNT],
    message_bytes: u64,
    newest_ns: u64,
}

impl RecordingWriter {
    /// Creates the recording `path`, which must not exist, with the files of `attachments` at its beginning.
    ///
    /// # Errors
    /// The file exists or cannot be created.
    pub fn create(
        path: &Path,
        start: RecordingStart,
        attachments: &[(String, Vec<u8>)],
        chunks: ChunkOptions,
    ) -> Result<Self, RecordingError> {
        let created = OpenOptions::new().write(true).create_new(true).open(path);
        let file = created.map_err(|source| RecordingError::Io {
            path: path.into(),
            source,
        })?;
        let writer = Self::begin(path, file, start, attachments, chunks);
        if writer.is_err()
            && let Err(error) = std::fs::remove_file(path)
        {
            tracing::debug!(%error, "cannot remove what was begun");
        }
        writer
    }

    fn begin(
        path: &Path,
        file: File,
        start: RecordingStart,
        attachments: &[(String, Vec<u8>)],
        chunks: ChunkOptions,
    ) -> Result<Self, RecordingError> {
        let pending = PendingBytes::default();
        let options = WriteOptions::new()
            .profile(PROFILE)
            .library(concat!("caraware ", env!("CARGO_PKG_VERSION")))
            .compression(match chunks.compression {
                ChunkCompression::None => None,
                ChunkCompression::Zstd => Some(Compression::Zstd),
            })
            // The library passes the level on as a signed number.
            .compression_level(chunks.compression_level.cast_unsigned())
            .compression_threads(compression_threads(start.is_lossless))
            .chunk_size(None);
        let format = |error: mcap::McapError| format_error(path, &error);
        let mut mcap = options.create(pending.clone()).map_err(format)?;
        let json = |value: serde_json::Result<Vec<u8>>| value.map_err(|error| format_error(path, &error));
        let mut attach = |name: &str, data: &[u8]| {
            mcap.attach(&Attachment {
                log_time: 0,
                create_time: 0,
                name: name.into(),
                media_type: media_type(name).into(),
                data: data.into(),
            })
        };
        attach(START, &json(serde_json::to_vec_pretty(&start))?).map_err(format)?;
        for (name, data) in attachments {
            attach(name, data).map_err(format)?;
        }
        // All topics are in the first chunk, so that a reader of any other needs that one alone.
        let schema = layout::json().map_err(|error| format_error(path, &error))?;
        let mut channels = [None; Channel::COUNT];
        for channel in Channel::ALL {
            if start.channels.iter().any(|name| name == channel.name()) {
                let name = format!("caraware.{}", channel.name());
                let schema = mcap
                    .add_schema(&name, SCHEMA_ENCODING, schema.as_bytes())
                    .map_err(format)?;
                let id = mcap.add_channel(schema, channel.name(), MESSAGE_ENCODING, &BTreeMap::new());
                channels[channel as usize] = Some(id.map_err(format)?);
            }
        }
        let mut plain = |topic: &str, encoding: &str| mcap.add_channel(0, topic, encoding, &BTreeMap::new());
        let chunk_topic = plain(CHUNK_TOPIC, "u64").map_err(format)?;
        let [commands, curriculum] = LineTopic::ALL;
        let lines = [
            plain(commands.name(), "json").map_err(format)?,
            plain(curriculum.name(), "json").map_err(format)?,
        ];
        let pages = WrittenPages::of(&file).map_err(|source| RecordingError::Io {
            path: path.into(),
            source,
        })?;
        let mut writer = Self {
            path: path.into(),
            file,
            pages,
            len: 0,
            len_before: 0,
            unwritten: Vec::new(),
            pending,
            mcap,
            start,
            channels,
            lines,
            chunk_topic,
            chunks: 0,
            filling: None,
            chunk_bytes: (chunks.chunk_mib as usize) << 20,
            encoded: Vec::new(),
            digest: ObservationDigest::default(),
            messages: [0; Channel::COUNT],
            message_bytes: 0,
            newest_ns: 0,
        };
        writer.begin_chunk()?;
        writer.close_chunk()?;
        Ok(writer)
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes of the file.
    #[must_use]
    pub fn file_bytes(&self) -> u64 {
        self.len
    }

    /// Bytes of the recorded messages.
    #[must_use]
    pub fn message_bytes(&self) -> u64 {
        self.message_bytes
    }

    /// Recorded messages, by name of their channel.
    #[must_use]
    pub fn messages(&self) -> BTreeMap<String, u64> {
        let counts = Channel::ALL.into_iter().zip(self.messages);
        let counts = counts.filter(|(channel, _)| self.channels[*channel as usize].is_some());
        counts
            .map(|(channel, count)| (channel.name().to_owned(), count))
            .collect()
    }

    /// Adds a message to the chunk that is being filled. A channel that is not recorded is left out.
    ///
    /// # Errors
    /// The message does not fit the format.
    pub fn add(&mut self, channel: Channel, header: &MessageHeader, payload: &[u8]) -> Result<(), RecordingError> {
        let Some(id) = self.channels[channel as usize] else {
            return Ok(());
        };
        self.encoded.clear();
        self.encoded.reserve(HEADER_BYTES + payload.len());
        self.encoded.extend_from_slice(bytemuck::bytes_of(header));
        self.encoded.extend_from_slice(payload);
        let encoded = std::mem::take(&mut self.encoded);
        #[expect(clippy::cast_possible_truncation, reason = "a sequence number may wrap")]
        let sequence = header.tick as u32;
        self.newest_ns = self.newest_ns.max(self.start.time_ns(header.tick));
        let added = self.add_bytes(id, sequence, self.start.time_ns(header.tick), &encoded);
        self.encoded = encoded;
        added?;
        if channel == Channel::Observation {
            self.digest.add(header, payload);
        }
        self.messages[channel as usize] += 1;
        Ok(())
    }

    /// Adds a line of one of the run's logs.
    ///
    /// # Errors
    /// The message does not fit the format.
    pub fn add_line(&mut self, topic: LineTopic, line: &str) -> Result<(), RecordingError> {
        self.add_bytes(self.lines[topic as usize], 0, self.newest_ns, line.as_bytes())
    }

    fn add_bytes(&mut self, id: u16, sequence: u32, time_ns: u64, bytes: &[u8]) -> Result<(), RecordingError> {
        if self.filling.is_none() {
            self.begin_chunk()?;
        }
        self.write_message(id, sequence, time_ns, bytes)?;
        self.message_bytes += bytes.len() as u64;
        if let Some((filled, _)) = &mut self.filling {
            *filled += bytes.len();
        }
        Ok(())
    }

    fn begin_chunk(&mut self) -> Result<(), RecordingError> {
        self.filling = Some((0, Instant::now()));
        let number = self.chunks;
        self.chunks += 1;
        self.write_message(self.chunk_topic, 0, self.newest_ns, &number.to_le_bytes())
    }

    fn write_message(&mut self, id: u16, sequence: u32, time_ns: u64, bytes: &[u8]) -> Result<(), RecordingError> {
        let header = McapMessageHeader {
            channel_id: id,
            sequence,
            log_time: time_ns,
            publish_time: time_ns,
        };
        let written = self.mcap.write_to_known_channel(&header, bytes);
        written.map_err(|error| format_error(&self.path, &error))
    }

    /// True if the chunk is full, or its first message has waited long enough.
    #[must_use]
    pub fn is_chunk_due(&self) -> bool {
        let is_due = |(filled, begun): (usize, Instant)| filled >= self.chunk_bytes || begun.elapsed() >= CHUNK_WITHIN;
        self.filling.is_some_and(is_due)
    }

    /// Completes the chunk and writes it. After an error for want of space [`RecordingWriter::write_rest`] tries again.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn close_chunk(&mut self) -> Result<(), RecordingError> {
        self.filling = None;
        self.mcap.flush().map_err(|error| format_error(&self.path, &error))?;
        self.write_rest()
    }

    /// Writes what is complete. If that fails, the file has its old length.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write_rest(&mut self) -> Result<(), RecordingError> {
        self.pending.move_to(&mut self.unwritten);
        let written = self.file.write_all(&self.unwritten);
        if let Err(source) = written {
            let cut = self.file.set_len(self.len);
            let _ = cut.and_then(|()| self.file.seek(SeekFrom::Start(self.len)));
            return Err(RecordingError::Io {
                path: self.path.clone(),
                source,
            });
        }
        if !self.unwritten.is_empty() {
            self.len_before = self.len;
        }
        self.len += self.unwritten.len() as u64;
        self.unwritten.clear();
        self.pages.drop_until(self.len);
        Ok(())
    }

    /// Gives the space of the newest chunk back to a run that continues on a full disk without its recording.
    ///
    /// # Errors
    /// The file cannot be shortened.
    pub fn make_room(&mut self) -> Result<(), RecordingError> {
        self.file
            .set_len(self.len_before)
            .map_err(|source| RecordingError::Io {
                path: self.path.clone(),
                source,
            })?;
        self.len = self.len_before;
        Ok(())
    }

    /// Adds a file of the run between two chunks.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn attach(&mut self, name: &str, data: &[u8]) -> Result<(), RecordingError> {
        self.filling = None;
        let attached = self.mcap.attach(&Attachment {
            log_time: self.newest_ns,
            create_time: 0,
            name: name.into(),
            media_type: media_type(name).into(),
            data: data.into(),
        });
        attached.map_err(|error| format_error(&self.path, &error))?;
        self.write_rest()
    }

    /// The observation hash over the recorded observations.
    #[must_use]
    pub fn observation_hash(&self) -> String {
        self.digest.hex()
    }

    /// Adds the end of the recording and the index. After an error for want of space [`RecordingWriter::write_rest`] tries again.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(&mut self, missed_ticks: u64) -> Result<(), RecordingError> {
        let end = RecordingEnd {
            observation_hash: self.digest.hex(),
            missed_ticks,
            messages: self.messages(),
        };
        let end = serde_json::to_vec_pretty(&end).map_err(|error| format_error(&self.path, &error))?;
        self.filling = None;
        self.mcap.flush().map_err(|error| format_error(&self.path, &error))?;
        let attached = self.mcap.attach(&Attachment {
            log_time: self.newest_ns,
            create_time: 0,
            name: END.into(),
            media_type: media_type(END).into(),
            data: end.into(),
        });
        attached.map_err(|error| format_error(&self.path, &error))?;
        self.mcap.finish().map_err(|error| format_error(&self.path, &error))?;
        self.write_rest()
    }
}

fn media_type(name: &str) -> &'static str {
    if name.ends_with(".json") {
        "application/json"
    } else {
        "text/plain"
    }
}

fn format_error(path: &Path, error: &dyn std::fmt::Display) -> RecordingError {
    RecordingError::Format {
        path: path.into(),
        reason: error.to_string(),
    }
}
