//! Recordings as files: what is written is read again, cut off and damaged ones up to there, and the first difference of two is found.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

use std::path::{Path, PathBuf};

use ipc_schema::{
    SCHEMA_VERSION, channel::Channel, config::ChunkCompression, header::MessageHeader, observation::ObservationLayout,
};
use recorder::{
    diff::{self, FieldDifference},
    file::{
        RECORDING_VERSION, RecordingError, RecordingStart,
        reader::{ChannelMessage, RecordedMessage, RecordingReader},
        writer::{ChunkOptions, LineTopic, RecordingWriter},
    },
};

const TICKS: u64 = 60;
/// Ticks in a chunk.
const CHUNK: u64 = 7;
const CHUNKS: ChunkOptions = ChunkOptions {
    compression: ChunkCompression::Zstd,
    compression_level: 1,
    chunk_mib: 4,
};

fn start(schema_version: u32) -> RecordingStart {
    RecordingStart {
        recording_version: RECORDING_VERSION,
        schema_version,
        program_version: "test".into(),
        run: "run".into(),
        env_index: 0,
        seed: 7,
        config_hash: "0".into(),
        tick_s: 0.1,
        is_lossless: true,
        channels: vec!["observation".into(), "event".into()],
    }
}

/// The observation of a tick with `slots` slots; `change` alters its payload.
fn observation(
    tick: u64,
    slots: usize,
    change: impl FnOnce(&mut [u8], &ObservationLayout),
) -> (MessageHeader, Vec<u8>) {
    let layout = ObservationLayout::new(slots, 9, 10);
    let header = MessageHeader {
        schema_version: SCHEMA_VERSION,
        run_id: 5,
        tick,
        sim_time_ns: tick * 100_000_000,
        shape: layout.shape,
        ..MessageHeader::default()
    };
    // Numbers that do not repeat, so that chunks are not tiny.
    let mut state = tick + 1;
    let mut payload = vec![0; layout.len];
    for word in payload.chunks_exact_mut(8) {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        word.copy_from_slice(&(state >> 20).to_le_bytes());
    }
    change(&mut payload, &layout);
    (header, payload)
}

/// Writes a recording of [`TICKS`] ticks in chunks of [`CHUNK`]; `change` alters the payload of a tick.
fn write(path: &Path, is_finished: bool, change: impl Fn(u64, &mut [u8], &ObservationLayout)) {
    write_packed(path, is_finished, CHUNKS, change);
}

fn write_packed(
    path: &Path,
    is_finished: bool,
    chunks: ChunkOptions,
    change: impl Fn(u64, &mut [u8], &ObservationLayout),
) {
    let attachments = [("run.json".to_owned(), b"{}".to_vec())];
    let mut writer = RecordingWriter::create(path, start(SCHEMA_VERSION), &attachments, chunks).unwrap();
    for tick in 0..TICKS {
        let (header, payload) = observation(tick, 3, |payload, layout| change(tick, payload, layout));
        writer.add(Channel::Observation, &header, &payload).unwrap();
        if tick % 10 == 3 {
            let header = MessageHeader {
                shape: [0; 4],
                ..header
            };
            writer.add(Channel::Event, &header, &[]).unwrap();
            writer
                .add_line(LineTopic::Commands, &format!("{{\"tick\":{tick}}}"))
                .unwrap();
        }
        // A channel that is not recorded adds nothing.
        writer.add(Channel::World, &header, &payload).unwrap();
        if tick % CHUNK == CHUNK - 1 {
            writer.close_chunk().unwrap();
        }
    }
    if is_finished {
        writer.finish(0).unwrap();
    }
}

/// Messages up to the end or the damage, and the damage.
fn read(path: &Path) -> (Vec<RecordedMessage>, Option<RecordingError>) {
    let recording = RecordingReader::open(path).unwrap();
    let mut messages = Vec::new();
    for message in recording.messages() {
        match message {
            Ok(message) => messages.push(message),
            Err(error) => return (messages, Some(error)),
        }
    }
    (messages, None)
}

fn place(directory: &tempfile::TempDir, name: &str) -> PathBuf {
    directory.path().join(name)
}

/// The end of each observation repeats its beginning, so that there is something to find.
fn repeat_beginning(_: u64, payload: &mut [u8], _: &ObservationLayout) {
    let (first, second) = payload.split_at_mut(payload.len() * 3 / 4);
    second.copy_from_slice(&first[..second.len()]);
}

#[test]
fn compression_and_level_change_the_size_of_a_recording_and_nothing_else() {
    let directory = tempfile::tempdir().unwrap();
    let packed = |compression: ChunkCompression, compression_level: i32| {
        let path = place(&directory, &format!("{compression:?}{compression_level}.mcap"));
        let chunks = ChunkOptions {
            compression,
            compression_level,
            ..CHUNKS
        };
        write_packed(&path, true, chunks, repeat_beginning);
        let (messages, damage) = read(&path);
        assert!(damage.is_none(), "{compression:?} {compression_level}: {damage:?}");
        let library = mcap::Summary::read(&std::fs::read(&path).unwrap()).unwrap().unwrap();
        let name = serde_json::to_value(compression).unwrap();
        for chunk in &library.chunk_indexes {
            let written = if chunk.compression.is_empty() {
                "none"
            } else {
                &chunk.compression
            };
            assert_eq!(name, *written);
        }
        (messages, path.metadata().unwrap().len())
    };
    let (whole, largest) = packed(ChunkCompression::None, 0);
    let levels = [-50, -3, 0, 1, 19].map(|level| packed(ChunkCompression::Zstd, level));
    assert!(levels.iter().all(|(messages, _)| *messages == whole));
    let [(_, fastest), .., (_, smallest)] = levels;
    assert!(
        largest > fastest && fastest > smallest,
        "{largest}, {fastest} and {smallest} bytes"
    );
}

#[test]
fn what_is_written_is_read_again_by_this_program_and_by_the_library() {
    let directory = tempfile::tempdir().unwrap();
    let path = place(&directory, "whole.mcap");
    write(&path, true, |_, _, _| {});
    let (messages, damage) = read(&path);
    assert!(damage.is_none(), "{damage:?}");
    let frames: Vec<&ChannelMessage> = messages
        .iter()
        .filter_map(|message| match message {
            RecordedMessage::Channel(frame) => Some(frame),
            RecordedMessage::Line(..) => None,
        })
        .collect();
    let of = |channel| frames.iter().filter(move |frame| frame.channel == channel);
    assert_eq!((of(Channel::Observation).count(), of(Channel::Event).count()), (60, 6));
    assert_eq!(messages.len() - frames.len(), 6, "lines");
    for (tick, frame) in (0..).zip(of(Channel::Observation)) {
        let (header, payload) = observation(tick, 3, |_, _| {});
        assert_eq!((frame.header, frame.payload()), (header, payload.as_slice()));
    }
    let recording = RecordingReader::open(&path).unwrap();
    assert_eq!(recording.attachment("run.json"), Some(&b"{}"[..]));
    assert_eq!(recording.end().unwrap().messages["observation"], TICKS);
    // The library knows nothing of this project.
    let bytes = std::fs::read(&path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert_eq!(summary.stats.unwrap().attachment_count, 3);
    let in_library = mcap::MessageStream::new(&bytes).unwrap();
    let observations = in_library
        .map(Result::unwrap)
        .filter(|message| message.channel.topic == "observation");
    for (message, frame) in observations.zip(of(Channel::Observation)) {
        assert_eq!(&message.data[96..], frame.payload());
        assert_eq!(message.log_time, frame.header.sim_time_ns);
        assert_eq!(message.channel.schema.as_ref().unwrap().name, "caraware.observation");
    }
}

#[test]
fn a_recording_that_a_kill_cut_off_lacks_at_most_its_newest_chunk() {
    let directory = tempfile::tempdir().unwrap();
    let path = place(&directory, "killed.mcap");
    write(&path, false, |_, _, _| {});
    let (messages, damage) = read(&path);
    let newest = messages.iter().rev().find_map(|message| match message {
        RecordedMessage::Channel(frame) => Some(frame.header.tick),
        RecordedMessage::Line(..) => None,
    });
    assert_eq!(newest, Some(TICKS / CHUNK * CHUNK - 1));
    let damage = damage.unwrap().to_string();
    assert!(damage.contains("was not finished"), "{damage}");
    assert!(RecordingReader::open(&path).unwrap().end().is_none());
}

/// For each compression forty truncations and forty flipped bits, spread over the whole file, and as many close to its beginning.
#[test]
fn a_damaged_recording_opens_up_to_the_damage_or_is_refused_with_the_place() {
    for compression in [ChunkCompression::None, ChunkCompression::Zstd] {
        damage_recording(compression);
    }
}

fn damage_recording(compression: ChunkCompression) {
    let directory = tempfile::tempdir().unwrap();
    let path = place(&directory, "whole.mcap");
    let chunks = ChunkOptions { compression, ..CHUNKS };
    write_packed(&path, true, chunks, repeat_beginning);
    let whole = std::fs::read(&path).unwrap();
    let (original, _) = read(&path);
    let damaged = place(&directory, "damaged.mcap");
    let (mut opened, mut refused, mut unharmed) = (0, 0, 0);
    let spread = |length: usize| (0..20).map(move |index| (index * 2 + 1) * length / 40);
    let places: Vec<usize> = spread(whole.len()).chain(spread(4000)).collect();
    for (number, &at) in places.iter().enumerate() {
        let mut flipped = whole.clone();
        flipped[at] ^= 1 << (number % 8);
        for bytes in [&whole[..at], &flipped[..]] {
            std::fs::write(&damaged, bytes).unwrap();
            let recording = match RecordingReader::open(&damaged) {
                Ok(recording) => recording,
                Err(error) => {
                    let said = error.to_string();
                    assert!(said.contains("byte") || said.contains("version"), "{said}");
                    refused += 1;
                    continue;
                }
            };
            let mut end = None;
            let mut read = 0;
            for message in recording.messages() {
                match message {
                    Ok(message) => {
                        assert_eq!(
                            message, original[read],
                            "{compression:?}, byte {at}: a message changed unnoticed"
                        );
                        read += 1;
                    }
                    Err(error) => end = Some(error),
                }
            }
            match end {
                Some(RecordingError::Damaged { offset, .. }) => {
                    assert!(offset <= at as u64, "byte {at}: damage is reported at {offset}");
                    opened += 1;
                }
                Some(other) => panic!("byte {at}: {other}"),
                // The index at the end is not needed, and an attachment may be one that nothing reads.
                None => {
                    assert_eq!(read, original.len(), "byte {at}: messages are missing without a word");
                    unharmed += 1;
                }
            }
        }
    }
    println!("{compression:?}: {opened} opened up to the damage, {refused} refused, {unharmed} unharmed");
    assert_eq!(opened + refused + unharmed, 80);
    assert!(
        opened >= 20 && refused >= 20,
        "{compression:?}: {opened} opened, {refused} refused"
    );
}

#[test]
fn a_chunk_that_is_missing_is_noticed() {
    let directory = tempfile::tempdir().unwrap();
    let path = place(&directory, "whole.mcap");
    write(&path, true, |_, _, _| {});
    let bytes = std::fs::read(&path).unwrap();
    let chunks = &mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
    let third = &chunks[3];
    let (begin, end) = (
        third.chunk_start_offset as usize,
        (third.chunk_start_offset + third.chunk_length) as usize,
    );
    std::fs::write(&path, [&bytes[..begin], &bytes[end..]].concat()).unwrap();
    let (_, damage) = read(&path);
    assert!(damage.unwrap().to_string().contains("a chunk is missing"));
}

#[test]
fn a_recording_of_another_schema_is_refused_with_both_versions() {
    let directory = tempfile::tempdir().unwrap();
    let path = place(&directory, "old.mcap");
    let old = SCHEMA_VERSION - 1;
    RecordingWriter::create(&path, start(old), &[], CHUNKS)
        .unwrap()
        .finish(0)
        .unwrap();
    let said = RecordingReader::open(&path).unwrap_err().to_string();
    assert!(
        said.contains(&format!("schema version {old}, this program reads {SCHEMA_VERSION}")),
        "{said}"
    );
    // A file that exists is not overwritten.
    assert!(RecordingWriter::create(&path, start(old), &[], CHUNKS).is_err() && path.exists());
}

#[test]
fn the_difference_names_tick_section_row_and_values() {
    let directory = tempfile::tempdir().unwrap();
    let (one, other) = (place(&directory, "one.mcap"), place(&directory, "other.mcap"));
    write(&one, true, |_, _, _| {});
    // One bit of the second slot's second IMU sample, angular rate y, in tick 31.
    write(&other, true, |tick, payload, layout| {
        if tick == 31 {
            payload[layout.imu.offset + ((10 + 1) * 7 + 4) * 4] ^= 1;
        }
    });
    let open = |path: &Path| RecordingReader::open(path).unwrap();
    let same = diff::compare(&open(&one), &open(&one), |_| true);
    assert_eq!((same.first, same.compared), (None, TICKS + 6));
    // Between two sections lies what an older message left there, which is no content.
    let gap = place(&directory, "gap.mcap");
    write(&gap, true, |_, payload, layout| {
        payload[layout.truth.offset + layout.truth.len] ^= 1
    });
    assert_eq!(diff::compare(&open(&one), &open(&gap), |_| true).first, None);
    let difference = diff::compare(&open(&one), &open(&other), |_| true).first.unwrap();
    assert_eq!((difference.channel, difference.tick), (Channel::Observation, 31));
    match &difference.field {
        FieldDifference::Value {
            section,
            row,
            member,
            values,
        } => {
            // The section has a row for each slot and sample.
            assert_eq!((*section, *row, member.as_str()), ("imu", 11, "[4]"), "{difference}");
            assert_ne!(values[0], values[1]);
        }
        FieldDifference::OnlyIn { .. } => panic!("{difference}"),
    }
    // A recording that began later differs only in what it lacks from then on.
    let late = place(&directory, "late.mcap");
    let mut writer = RecordingWriter::create(&late, start(SCHEMA_VERSION), &[], CHUNKS).unwrap();
    for tick in 20..TICKS {
        let (header, payload) = observation(tick, 3, |_, _| {});
        writer.add(Channel::Observation, &header, &payload).unwrap();
    }
    writer.finish(0).unwrap();
    let later = diff::compare(&open(&one), &open(&late), |_| true).first.unwrap();
    let only_in_first = FieldDifference::OnlyIn { is_first: true };
    assert_eq!(
        (later.channel, later.tick, later.field),
        (Channel::Event, 23, only_in_first)
    );
}
