//! Reads a recording, up to where it is damaged.

use std::{
    collections::BTreeMap,
    fs::File,
    os::unix::fs::FileExt as _,
    path::{Path, PathBuf},
};

use ipc_schema::{SCHEMA_VERSION, channel::Channel, header::MessageHeader};
use mcap::{
    MAGIC,
    records::{Record, op},
};

use super::{
    CHUNK_TOPIC, END, PROFILE, RECORDING_VERSION, RecordingEnd, RecordingError, RecordingStart, START,
    place::{self, RECORD_HEAD, RecordPlace},
    writer::LineTopic,
};

/// Longest chunk that is decompressed, bytes.
const LONGEST_CHUNK: u64 = 1 << 30;
/// Bytes of a message header.
const HEADER_BYTES: usize = size_of::<MessageHeader>();

/// A recorded message. The payload lies on a boundary of 8 bytes.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelMessage {
    /// Its channel.
    pub channel: Channel,
    /// Its header.
    pub header: MessageHeader,
    words: Vec<u64>,
    len: usize,
}

impl ChannelMessage {
    fn new(channel: Channel, bytes: &[u8]) -> Option<Self> {
        let (header, payload) = bytes.split_at_checked(HEADER_BYTES)?;
        let mut words = vec![0_u64; payload.len().div_ceil(8)];
        bytemuck::cast_slice_mut(&mut words)[..payload.len()].copy_from_slice(payload);
        Some(Self {
            channel,
            header: bytemuck::pod_read_unaligned(header),
            words,
            len: payload.len(),
        })
    }

    /// The header as it lay in shared memory.
    #[must_use]
    pub fn header_bytes(&self) -> &[u8] {
        bytemuck::bytes_of(&self.header)
    }

    /// The payload as it lay in shared memory.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.len]
    }
}

/// A message of a recording.
#[derive(Debug, Clone, PartialEq)]
pub enum RecordedMessage {
    /// A message of a channel.
    Channel(ChannelMessage),
    /// A line of one of the run's logs.
    Line(LineTopic, String),
}

/// Where a recording stops to be readable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// The first byte that cannot be used.
    pub offset: u64,
    /// What is wrong there.
    pub reason: String,
}

/// What a topic of the file means.
#[derive(Debug, Clone, Copy)]
enum TopicMeaning {
    Messages(Channel),
    Lines(LineTopic),
    ChunkNumber,
}

/// An opened recording.
#[derive(Debug)]
pub struct RecordingReader {
    path: PathBuf,
    file: File,
    /// What it is of.
    pub start: RecordingStart,
    chunks: Vec<RecordPlace>,
    /// Name and content of the attachments.
    attachments: BTreeMap<String, Vec<u8>>,
    topics: BTreeMap<u16, TopicMeaning>,
    /// Where the structure of the file is damaged; chunks before are complete, though their content is only checked when it is read.
    damage: Option<Damage>,
}

impl RecordingReader {
    /// Opens a recording. One that was cut off or damaged opens up to there ([`RecordingReader::damage`]).
    ///
    /// # Errors
    /// The file cannot be read, is no recording, is damaged before its first message, or another version wrote it.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let failed = |source| RecordingError::Io {
            path: path.into(),
            source,
        };
        let foreign = |offset, reason: &str| RecordingError::Foreign {
            path: path.into(),
            offset,
            reason: reason.into(),
        };
        let file = File::open(path).map_err(failed)?;
        let len = file.metadata().map_err(failed)?.len();
        let mut magic = [0; MAGIC.len()];
        let begin = file.read_exact_at(&mut magic, 0);
        if begin.is_err() || magic != *MAGIC {
            return Err(foreign(0, "it does not begin as an MCAP file does"));
        }
        let mut scan = FileScan {
            file: &file,
            len,
            chunks: Vec::new(),
            attachments: BTreeMap::new(),
            profile: None,
        };
        let damage = scan.run(MAGIC.len() as u64);
        let FileScan {
            chunks,
            attachments,
            profile,
            ..
        } = scan;
        let damaged = |damage: &Damage| RecordingError::Damaged {
            path: path.into(),
            offset: damage.offset,
            reason: damage.reason.clone(),
        };
        match (profile, &damage) {
            (Some(profile), _) if profile == PROFILE => {}
            (None, Some(damage)) => return Err(damaged(damage)),
            _ => return Err(foreign(MAGIC.len() as u64, "its profile is not \"caraware\"")),
        }
        let start = match (attachments.get(START), &damage) {
            (Some(start), _) => read_start(path, start)?,
            (None, Some(damage)) => return Err(damaged(damage)),
            (None, None) => return Err(foreign(len, "it has no start.json")),
        };
        let mut reader = Self {
            path: path.into(),
            file,
            start,
            chunks,
            attachments,
            topics: BTreeMap::new(),
            damage,
        };
        reader.read_topics()?;
        Ok(reader)
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where the file stops to be readable, as far as that is known without reading all messages.
    #[must_use]
    pub fn damage(&self) -> Option<&Damage> {
        self.damage.as_ref()
    }

    /// Content of an attached file of the run, such as "run.json".
    #[must_use]
    pub fn attachment(&self, name: &str) -> Option<&[u8]> {
        self.attachments.get(name).map(Vec::as_slice)
    }

    /// Names of the attached files.
    pub fn attachment_names(&self) -> impl Iterator<Item = &str> {
        self.attachments.keys().map(String::as_str)
    }

    /// What the recording says at its end; `None` if it was not finished.
    #[must_use]
    pub fn end(&self) -> Option<RecordingEnd> {
        self.attachment(END).and_then(|end| serde_json::from_slice(end).ok())
    }

    /// Number of chunks.
    #[must_use]
    pub fn chunk_count(&self) -> usize {
        self.chunks.len()
    }

    /// Numbers of the topics, which are all in the first chunk.
    fn read_topics(&mut self) -> Result<(), RecordingError> {
        let Some(first) = self.chunks.first().copied() else {
            return match &self.damage {
                Some(damage) => Err(self.damaged(damage.offset, &damage.reason)),
                None => Err(self.damaged(0, "it has no chunk")),
            };
        };
        let chunk = self.read_chunk(first)?;
        for record in place::records(&chunk) {
            let (kind, body) = record.map_err(|reason| self.damaged(first.offset, &reason))?;
            if kind != op::CHANNEL {
                continue;
            }
            let parsed = place::parse(kind, body).map_err(|reason| self.damaged(first.offset, &reason))?;
            let Record::Channel(topic) = parsed else { continue };
            let channel = Channel::ALL.into_iter().find(|channel| channel.name() == topic.topic);
            let lines = LineTopic::ALL.into_iter().find(|lines| lines.name() == topic.topic);
            let meaning = match (channel, lines) {
                (Some(channel), _) => TopicMeaning::Messages(channel),
                (None, Some(lines)) => TopicMeaning::Lines(lines),
                (None, None) if topic.topic == CHUNK_TOPIC => TopicMeaning::ChunkNumber,
                (None, None) => continue,
            };
            self.topics.insert(topic.id, meaning);
        }
        Ok(())
    }

    fn damaged(&self, offset: u64, reason: &str) -> RecordingError {
        RecordingError::Damaged {
            path: self.path.clone(),
            offset,
            reason: reason.into(),
        }
    }

    fn read_chunk(&self, place: RecordPlace) -> Result<Vec<u8>, RecordingError> {
        let body = read_body(&self.file, place).map_err(|source| RecordingError::Io {
            path: self.path.clone(),
            source,
        })?;
        let damaged = |reason: String| self.damaged(place.offset, &reason);
        match place::parse(op::CHUNK, &body).map_err(damaged)? {
            Record::Chunk { header, data } => place::decompress(&header, &data, LONGEST_CHUNK).map_err(damaged),
            _ => Err(damaged("not a chunk".into())),
        }
    }

    /// The messages of chunk `index`, in the order in which they were recorded.
    ///
    /// # Errors
    /// The chunk is damaged.
    pub fn chunk(&self, index: usize) -> Result<Vec<RecordedMessage>, RecordingError> {
        let Some(place) = self.chunks.get(index).copied() else {
            return Ok(Vec::new());
        };
        let chunk = self.read_chunk(place)?;
        let damaged = |reason: &str| self.damaged(place.offset, reason);
        let mut messages = Vec::new();
        let mut number = None;
        for record in place::records(&chunk) {
            let (kind, body) = record.map_err(|reason| damaged(&reason))?;
            if kind != op::MESSAGE {
                continue;
            }
            let Record::Message { header, data } = place::parse(kind, body).map_err(|reason| damaged(&reason))? else {
                continue;
            };
            match self.topics.get(&header.channel_id) {
                Some(TopicMeaning::Messages(channel)) => {
                    let message = ChannelMessage::new(*channel, &data);
                    let message = message.ok_or_else(|| damaged("a message is shorter than its header"))?;
                    messages.push(RecordedMessage::Channel(message));
                }
                Some(TopicMeaning::Lines(topic)) => {
                    messages.push(RecordedMessage::Line(
                        *topic,
                        String::from_utf8_lossy(&data).into_owned(),
                    ));
                }
                Some(TopicMeaning::ChunkNumber) => number = data.first_chunk().copied().map(u64::from_le_bytes),
                None => return Err(damaged("a message has a topic that the file does not name")),
            }
        }
        if number != Some(index as u64) {
            return Err(damaged(&format!(
                "a chunk is missing: this one has number {number:?} and should have {index}"
            )));
        }
        Ok(messages)
    }

    /// All messages in order. The last item is an error if the recording is damaged.
    pub fn messages(&self) -> impl Iterator<Item = Result<RecordedMessage, RecordingError>> {
        let mut has_failed = false;
        let chunks = (0..self.chunks.len()).map_while(move |index| {
            let chunk = (!has_failed).then(|| self.chunk(index))?;
            has_failed = chunk.is_err();
            Some(chunk)
        });
        let messages = chunks.flat_map(|chunk| match chunk {
            Ok(messages) => messages.into_iter().map(Ok).collect::<Vec<_>>(),
            Err(error) => vec![Err(error)],
        });
        let rest = self
            .damage
            .iter()
            .map(|damage| Err(self.damaged(damage.offset, &damage.reason)));
        let mut is_over = false;
        messages.chain(rest).take_while(move |message| {
            let is_first_error = !is_over;
            is_over |= message.is_err();
            is_first_error
        })
    }

    /// All messages of channels in order, as far as the recording is undamaged.
    pub fn channel_messages(&self) -> impl Iterator<Item = Result<ChannelMessage, RecordingError>> {
        self.messages().filter_map(|message| match message {
            Ok(RecordedMessage::Channel(message)) => Some(Ok(message)),
            Ok(RecordedMessage::Line(..)) => None,
            Err(error) => Some(Err(error)),
        })
    }
}

/// Reads and checks the start of a recording.
fn read_start(path: &Path, start: &[u8]) -> Result<RecordingStart, RecordingError> {
    #[derive(serde::Deserialize)]
    struct Versions {
        recording_version: u32,
        schema_version: u32,
    }
    let foreign = |error: serde_json::Error| RecordingError::Foreign {
        path: path.into(),
        offset: 0,
        reason: format!("{START}: {error}"),
    };
    // The versions come first: a recording of another version may have other fields.
    let versions: Versions = serde_json::from_slice(start).map_err(foreign)?;
    let pairs = [
        ("recording", versions.recording_version, RECORDING_VERSION),
        ("schema", versions.schema_version, SCHEMA_VERSION),
    ];
    if let Some((what, found, ours)) = pairs.into_iter().find(|(_, found, ours)| found != ours) {
        return Err(RecordingError::Version {
            path: path.into(),
            what,
            found,
            ours,
        });
    }
    serde_json::from_slice(start).map_err(foreign)
}

fn read_body(file: &File, place: RecordPlace) -> std::io::Result<Vec<u8>> {
    let len = usize::try_from(place.body).map_err(std::io::Error::other)?;
    let mut body = vec![0; len];
    file.read_exact_at(&mut body, place.offset + RECORD_HEAD)?;
    Ok(body)
}

/// Finds the records of a file.
struct FileScan<'a> {
    file: &'a File,
    len: u64,
    chunks: Vec<RecordPlace>,
    attachments: BTreeMap<String, Vec<u8>>,
    profile: Option<String>,
}

impl FileScan<'_> {
    /// Walks from record to record up to the end of the data; returns where that is not possible.
    fn run(&mut self, mut offset: u64) -> Option<Damage> {
        loop {
            let damage = |reason: &str| {
                Some(Damage {
                    offset,
                    reason: reason.into(),
                })
            };
            let mut head = [0; RECORD_HEAD as usize];
            if self.file.read_exact_at(&mut head, offset).is_err() {
                return damage("the file ends before its index: it was not finished");
            }
            let Some(place) = RecordPlace::read(head, offset, self.len) else {
                return damage("a record goes beyond the end of the file: it was cut off");
            };
            match self.read_record(place) {
                Ok(true) => offset = place.end(),
                Ok(false) => return None,
                Err(reason) => return damage(&reason),
            }
        }
    }

    /// Takes in a record; false at the end of the data.
    fn read_record(&mut self, place: RecordPlace) -> Result<bool, String> {
        if place.kind == op::CHUNK {
            // Its content is checked when it is read.
            self.chunks.push(place);
            return Ok(true);
        }
        let body = read_body(self.file, place).map_err(|error| error.to_string())?;
        match place::parse(place.kind, &body)? {
            Record::Header(header) => self.profile = Some(header.profile),
            Record::Attachment { header, data, crc } if crc != 0 => {
                self.attachments.insert(header.name, data.into_owned());
            }
            Record::MessageIndex(index) => {
                let entries = index.records.len() as u64;
                if place.body != 2 + 4 + 16 * entries {
                    return Err("an index of messages has another length than it says".into());
                }
            }
            Record::DataEnd(_) => return Ok(false),
            _ => return Err(format!("a record of kind {:#04x} does not belong here", place.kind)),
        }
        Ok(true)
    }
}
