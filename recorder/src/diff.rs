//! The first tick and field in which two recordings differ.

use std::collections::VecDeque;

use ipc_schema::{
    block::ALIGNMENT,
    channel::Channel,
    header::MessageHeader,
    layout::{self, TypeLayout},
};

use crate::file::{
    RecordingError,
    reader::{ChannelMessage, RecordingReader},
};

/// A difference between two recordings.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    /// The channel.
    pub channel: Channel,
    /// The tick, counted over the run.
    pub tick: u64,
    /// The episode.
    pub episode: u64,
    /// What differs, with both values.
    pub field: FieldDifference,
}

/// What differs in a tick.
#[derive(Debug, Clone, PartialEq)]
pub enum FieldDifference {
    /// Only the first recording (`true`) or only the second has the message.
    OnlyIn {
        /// True for the first.
        is_first: bool,
    },
    /// A value differs.
    Value {
        /// "header", or the section.
        section: &'static str,
        /// Row, counted from 0.
        row: usize,
        /// Member of the record, and place in the element: "velocity_body_mps[1]".
        member: String,
        /// The values in the first and in the second recording.
        values: [String; 2],
    },
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "tick {} (episode {}), {}: ",
            self.tick,
            self.episode,
            self.channel.name()
        )?;
        match &self.field {
            FieldDifference::OnlyIn { is_first: true } => f.write_str("only the first recording has this message"),
            FieldDifference::OnlyIn { is_first: false } => f.write_str("only the second recording has this message"),
            FieldDifference::Value {
                section,
                row,
                member,
                values: [first, second],
            } => {
                let member = if member.is_empty() {
                    String::new()
                } else {
                    format!(", {member}")
                };
                write!(f, "{section}, row {row}{member}: {first} and {second}")
            }
        }
    }
}

/// What a comparison found.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Comparison {
    /// The difference at the earliest tick.
    pub first: Option<Difference>,
    /// Messages that were compared.
    pub compared: u64,
    /// Why the comparison ended before the end of a recording.
    pub damage: Option<String>,
}

/// Messages of a recording, channel by channel, that have not been compared yet.
struct Side<'a> {
    messages: Box<dyn Iterator<Item = Result<ChannelMessage, RecordingError>> + 'a>,
    waiting: [VecDeque<ChannelMessage>; Channel::COUNT],
    /// Channels that are compared.
    channels: &'a [Channel],
    is_over: bool,
    damage: Option<String>,
    newest_tick: u64,
}

/// Tick of the first message, which other channels may begin some ticks after.
fn first_tick(recording: &RecordingReader) -> u64 {
    let first = recording.channel_messages().next().and_then(Result::ok);
    first.map_or(0, |message| message.header.tick)
}

impl<'a> Side<'a> {
    /// The messages of `recording` on `channels` from tick `begin` on.
    fn new(recording: &'a RecordingReader, begin: u64, channels: &'a [Channel]) -> Self {
        let is_early = move |message: &Result<ChannelMessage, _>| {
            message.as_ref().is_ok_and(|message| message.header.tick < begin)
        };
        Self {
            messages: Box::new(recording.channel_messages().filter(move |message| !is_early(message))),
            waiting: std::array::from_fn(|_| VecDeque::new()),
            channels,
            is_over: false,
            damage: None,
            newest_tick: 0,
        }
    }

    fn read_one(&mut self) {
        match self.messages.next() {
            Some(Ok(message)) => {
                self.newest_tick = self.newest_tick.max(message.header.tick);
                if self.channels.contains(&message.channel) {
                    self.waiting[message.channel as usize].push_back(message);
                }
            }
            Some(Err(error)) => {
                self.damage = Some(error.to_string());
                self.is_over = true;
            }
            None => self.is_over = true,
        }
    }
}

/// Ticks beyond a difference within which an earlier one on another channel may still follow.
const LATEST_TICKS: u64 = 4096;

/// Compares the channels that both recordings have and that are wanted. Where one began later, the comparison begins with its first
/// message of each channel.
#[must_use]
pub fn compare(first: &RecordingReader, second: &RecordingReader, is_wanted: impl Fn(Channel) -> bool) -> Comparison {
    let types = layout::table();
    let is_common = |channel: &Channel| {
        let has = |recording: &RecordingReader| recording.start.channels.iter().any(|name| name == channel.name());
        is_wanted(*channel) && has(first) && has(second)
    };
    let channels: Vec<Channel> = Channel::ALL.into_iter().filter(is_common).collect();
    let begin = first_tick(first).max(first_tick(second));
    let mut sides = [Side::new(first, begin, &channels), Side::new(second, begin, &channels)];
    let mut has_begun = [false; Channel::COUNT];
    let mut found = Comparison::default();
    loop {
        sides.iter_mut().filter(|side| !side.is_over).for_each(Side::read_one);
        for channel in &channels {
            compare_waiting(*channel, &mut sides, &mut has_begun, &mut found, &types);
        }
        let is_late = |side: &Side<'_>, tick: u64| side.is_over || side.newest_tick > tick + LATEST_TICKS;
        let is_final = found
            .first
            .as_ref()
            .is_some_and(|difference| sides.iter().all(|side| is_late(side, difference.tick)));
        if is_final || sides.iter().all(|side| side.is_over) {
            break;
        }
    }
    // What a damaged recording lacks is no difference.
    if sides.iter().all(|side| side.damage.is_none()) {
        for channel in channels.iter().copied() {
            for (side, is_first) in sides.iter().zip([true, false]) {
                if let Some(message) = side.waiting[channel as usize].front() {
                    found.note(channel, &message.header, FieldDifference::OnlyIn { is_first });
                }
            }
        }
    }
    let [first, second] = sides;
    found.damage = first.damage.or(second.damage);
    found
}

impl Comparison {
    fn note(&mut self, channel: Channel, header: &MessageHeader, field: FieldDifference) {
        if self.first.as_ref().is_none_or(|first| header.tick < first.tick) {
            self.first = Some(Difference {
                channel,
                tick: header.tick,
                episode: header.episode,
                field,
            });
        }
    }
}

/// Compares the messages of `channel` that both sides have.
fn compare_waiting(
    channel: Channel,
    [first, second]: &mut [Side<'_>; 2],
    has_begun: &mut [bool; Channel::COUNT],
    found: &mut Comparison,
    types: &[TypeLayout],
) {
    let place = channel as usize;
    while let (Some(one), Some(other)) = (first.waiting[place].front(), second.waiting[place].front()) {
        let (header, other_header) = (one.header, other.header);
        if header.tick == other_header.tick {
            has_begun[place] = true;
            found.compared += 1;
            if let Some(field) = message_difference(one, other, types) {
                found.note(channel, &header, field);
            }
            first.waiting[place].pop_front();
            second.waiting[place].pop_front();
            continue;
        }
        // Before the first tick that both have, one recording only began later.
        let is_first = header.tick < other_header.tick;
        let (side, header) = match is_first {
            true => (&mut *first, header),
            false => (&mut *second, other_header),
        };
        side.waiting[place].pop_front();
        if has_begun[place] {
            found.note(channel, &header, FieldDifference::OnlyIn { is_first });
        }
    }
}

/// The header as far as it belongs to the content of a run: not its identity, and not which of its processes sent it, which each number
/// their announcements anew.
fn content(header: &MessageHeader) -> MessageHeader {
    MessageHeader {
        run_id: 0,
        incarnation: 0,
        addressee: 0,
        meta_messages: 0,
        ..*header
    }
}

/// The first field in which two messages of a channel differ.
#[must_use]
pub fn message_difference(
    one: &ChannelMessage,
    other: &ChannelMessage,
    types: &[TypeLayout],
) -> Option<FieldDifference> {
    let headers = [content(&one.header), content(&other.header)];
    if headers[0] != headers[1] {
        let bytes = [bytemuck::bytes_of(&headers[0]), bytemuck::bytes_of(&headers[1])];
        return value_difference("header", "MessageHeader", &[], bytes, types);
    }
    if one.payload() == other.payload() {
        return None;
    }
    let lengths = [one.payload().len(), other.payload().len()];
    if lengths[0] != lengths[1] {
        return Some(FieldDifference::Value {
            section: "payload",
            row: 0,
            member: "bytes".into(),
            values: lengths.map(|length| length.to_string()),
        });
    }
    let spec = one.channel.spec();
    let size = |dimension: &str| {
        let place = spec.dimensions.iter().position(|name| *name == dimension);
        place.map_or(0, |place| one.header.shape[place] as usize)
    };
    let mut offset = 0;
    for section in spec.sections {
        let (scalar, shape) = (section.element)();
        let rows: usize = section.dimensions.iter().map(|dimension| size(dimension)).product();
        let len = rows * shape.iter().product::<usize>() * scalar_bytes(&scalar, types);
        let range = offset..offset + len;
        offset = (offset + len).next_multiple_of(ALIGNMENT);
        let (Some(first), Some(second)) = (one.payload().get(range.clone()), other.payload().get(range)) else {
            break;
        };
        if first != second {
            return value_difference(section.name, &scalar, &shape, [first, second], types);
        }
    }
    // Between two sections lies what an older message left there.
    None
}

/// Bytes of a scalar as numpy writes it, or of a record.
fn scalar_bytes(scalar: &str, types: &[TypeLayout]) -> usize {
    let record = types.iter().find(|record| record.name == scalar);
    record.map_or_else(
        || {
            scalar
                .trim_start_matches(|c: char| !c.is_ascii_digit())
                .parse()
                .unwrap_or(1)
        },
        |record| record.size,
    )
}

/// The first value of a section in which its bytes differ.
fn value_difference(
    section: &'static str,
    scalar: &str,
    shape: &[usize],
    [first, second]: [&[u8]; 2],
    types: &[TypeLayout],
) -> Option<FieldDifference> {
    let at = first.iter().zip(second).position(|(one, other)| one != other)?;
    let scalar_len = scalar_bytes(scalar, types).max(1);
    let row_len = (scalar_len * shape.iter().product::<usize>()).max(1);
    let (row, in_row) = (at / row_len, at % row_len);
    let (index, in_scalar) = (in_row / scalar_len, in_row % scalar_len);
    let begin = row * row_len + index * scalar_len;
    let mut member = if shape.is_empty() {
        String::new()
    } else {
        format!("[{index}]")
    };
    let (mut kind, mut range) = (scalar.to_owned(), begin..begin + scalar_len);
    if let Some(record) = types.iter().find(|record| record.name == scalar) {
        let field = record.fields.iter().rev().find(|(_, offset, ..)| *offset <= in_scalar);
        if let Some((name, offset, field_scalar, field_shape)) = field {
            let bytes = scalar_bytes(field_scalar, types).max(1);
            let place = (in_scalar - offset) / bytes;
            member += name;
            if !field_shape.is_empty() {
                member += &format!("[{place}]");
            }
            let begin = begin + offset + place * bytes;
            (kind, range) = (field_scalar.clone(), begin..begin + bytes);
        }
    }
    let value = |bytes: &[u8]| shown(&kind, bytes.get(range.clone()).unwrap_or_default());
    Some(FieldDifference::Value {
        section,
        row,
        member,
        values: [value(first), value(second)],
    })
}

/// A value for people: numbers with all their digits, texts without trailing zeros.
fn shown(kind: &str, bytes: &[u8]) -> String {
    macro_rules! number {
        ($type:ty) => {
            bytes
                .try_into()
                .map(|bytes| <$type>::from_le_bytes(bytes).to_string())
                .unwrap_or_default()
        };
    }
    match kind {
        "<f4" => number!(f32),
        "<f8" => number!(f64),
        "<u2" => number!(u16),
        "<u4" => number!(u32),
        "<u8" => number!(u64),
        "<i4" => number!(i32),
        "|u1" => number!(u8),
        _ => format!("\"{}\"", String::from_utf8_lossy(bytes).trim_end_matches('\0')),
    }
}
