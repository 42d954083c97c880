//! Frames: a message as it is in shared memory, first the header, then the payload, little endian and without padding between the two. A decoder needs the layouts of `ipc-schema/layout.json` and nothing else.

use bytemuck::{bytes_of, pod_read_unaligned};
use ipc_schema::{
    block::{BlockError, Section, view},
    event::CollisionLayout,
    header::{DIMENSIONS, MessageHeader},
    observation::ObservationLayout,
    pointcloud::{LidarPoint, PointcloudLayout, Scan},
    prediction::PredictionLayout,
    services::Channel,
    world::{VehicleState, WorldLayout},
};

/// Length of the header of a frame, bytes.
pub const HEADER_BYTES: usize = size_of::<MessageHeader>();

/// Longest frame, bytes. zenoh queues 16 batches of 64 KiB for each priority and drops a message that does not fit. On loopback, a third
/// to a half of frames of 1.05 MB were lost, and none of 0.52 MB.
pub const MAX_FRAME_BYTES: usize = 900_000;
/// Longest frame of one scan, bytes: two fit into the queue.
pub const MAX_SCAN_BYTES: usize = 480_000;

/// A message cannot be framed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// The payload does not hold what its header promises.
    #[error(transparent)]
    Block(#[from] BlockError),
    /// Longer than [`MAX_FRAME_BYTES`], and no row may be left out.
    #[error("a frame of {0} bytes is longer than the {MAX_FRAME_BYTES} bytes that a viewer's queue holds")]
    TooLong(usize),
}

/// A message as bytes for the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedFrame {
    /// Header and payload.
    pub bytes: Vec<u8>,
    /// Rows left out so that the frame fits into a viewer's queue.
    pub left_out: usize,
}

/// Encodes a message of `channel` as a frame.
///
/// A frame of `world` has neither sub-steps nor views of heroes. If there are more road users or points than fit, it has every second (third, …)
/// of them. Observations and predictions are cut to their first slots.
///
/// # Errors
/// The payload is shorter than its header promises, or the frame is too long.
pub fn encode(channel: Channel, header: &MessageHeader, payload: &[u8]) -> Result<EncodedFrame, FrameError> {
    match channel {
        Channel::World => encode_world(header, payload),
        Channel::Observation => {
            let [_, fields, imu_samples] = dimensions(header);
            encode_slots(header, payload, |rows| {
                let layout = ObservationLayout::sized(rows, fields, imu_samples);
                (
                    layout.named().map(|(_, section)| section).to_vec(),
                    layout.shape,
                    layout.len,
                )
            })
        }
        Channel::Prediction => {
            let [_, numbers, estimates] = dimensions(header);
            encode_slots(header, payload, |rows| {
                // A filter that runs has an estimate for each slot, so that fewer slots have fewer of them.
                let layout = PredictionLayout::sized(rows, numbers, estimates.min(rows));
                (
                    layout.named().map(|(_, section)| section).to_vec(),
                    layout.shape,
                    layout.len,
                )
            })
        }
        Channel::Pointcloud => encode_scan(header, payload),
        _ => encode_collisions(header, payload),
    }
}

/// The header with another number of rows.
fn with_rows(header: &MessageHeader, rows: usize) -> MessageHeader {
    let mut header = *header;
    header.shape[0] = u32::try_from(rows).unwrap_or(u32::MAX);
    header
}

/// Sizes of the first three dimensions.
fn dimensions(header: &MessageHeader) -> [usize; 3] {
    let [first, second, third, _] = header.shape;
    [first as usize, second as usize, third as usize]
}

/// Encodes a block whose sections have a row for each slot, cut to the slots that fit. `layout_of` gives sections, shape and length of a
/// block with a number of slots.
fn encode_slots(
    header: &MessageHeader,
    payload: &[u8],
    layout_of: impl Fn(usize) -> (Vec<Section>, [u32; DIMENSIONS], usize),
) -> Result<EncodedFrame, FrameError> {
    let rows = header.rows();
    let (sections, _, len) = layout_of(rows);
    let bytes: &[u8] = view(payload, Section { offset: 0, len })?;
    if HEADER_BYTES + len <= MAX_FRAME_BYTES {
        return Ok(EncodedFrame {
            bytes: [bytes_of(header), bytes].concat(),
            left_out: 0,
        });
    }
    // Each section is padded to its alignment: leave room for that.
    let room = MAX_FRAME_BYTES.saturating_sub(HEADER_BYTES + 64 * sections.len());
    let kept = rows * room / len;
    let (shorter, shape, len) = layout_of(kept);
    let mut bytes = bytes_of(&MessageHeader { shape, ..*header }).to_vec();
    bytes.resize(HEADER_BYTES + len, 0);
    for (from, to) in sections.into_iter().zip(shorter) {
        let kept_rows = Section { len: to.len, ..from };
        let start = HEADER_BYTES + to.offset;
        bytes[start..start + to.len].copy_from_slice(view(payload, kept_rows)?);
    }
    if bytes.len() > MAX_FRAME_BYTES {
        return Err(FrameError::TooLong(bytes.len()));
    }
    Ok(EncodedFrame {
        bytes,
        left_out: rows - kept,
    })
}

/// Encodes contacts, which are all kept.
fn encode_collisions(header: &MessageHeader, payload: &[u8]) -> Result<EncodedFrame, FrameError> {
    let bytes: &[u8] = view(payload, CollisionLayout::of(header).collisions)?;
    let len = HEADER_BYTES + bytes.len();
    if len > MAX_FRAME_BYTES {
        return Err(FrameError::TooLong(len));
    }
    Ok(EncodedFrame {
        bytes: [bytes_of(header), bytes].concat(),
        left_out: 0,
    })
}

/// Encodes the states of road users, without sub-steps.
fn encode_world(header: &MessageHeader, payload: &[u8]) -> Result<EncodedFrame, FrameError> {
    let layout = WorldLayout::new(header.rows(), 0);
    let states: &[VehicleState] = view(payload, layout.states)?;
    let header = MessageHeader {
        shape: layout.shape,
        ..*header
    };
    Ok(thinned(&header, &[], states, MAX_FRAME_BYTES))
}

/// Encodes a scan: where the sensor was, and the points that fit.
fn encode_scan(header: &MessageHeader, payload: &[u8]) -> Result<EncodedFrame, FrameError> {
    let layout = PointcloudLayout::of(header);
    let scan: &[Scan] = view(payload, layout.scan)?;
    let points: &[LidarPoint] = view(payload, layout.points)?;
    let mut head = bytemuck::cast_slice(scan).to_vec();
    head.resize(layout.points.offset, 0);
    Ok(thinned(header, &head, points, MAX_SCAN_BYTES))
}

/// Header, `head`, and every row, or every second (third, …) so that the frame has at most `max_bytes`.
fn thinned<T: bytemuck::Pod>(header: &MessageHeader, head: &[u8], rows: &[T], max_bytes: usize) -> EncodedFrame {
    let max_rows = (max_bytes - HEADER_BYTES - head.len()) / size_of::<T>();
    let kept = rows.iter().step_by(rows.len().div_ceil(max_rows).max(1));
    let count = kept.len();
    let mut bytes = Vec::with_capacity(HEADER_BYTES + head.len() + count * size_of::<T>());
    bytes.extend_from_slice(bytes_of(&with_rows(header, count)));
    bytes.extend_from_slice(head);
    kept.for_each(|row| bytes.extend_from_slice(bytes_of(row)));
    EncodedFrame {
        bytes,
        left_out: rows.len() - count,
    }
}

/// A table as two frames: its next part from row `next_row` on, for subscribers, and the whole, for queries. Moves `next_row` to the end
/// of the part. `rows` are bytes, `row_bytes` for each row.
#[must_use]
pub fn table(header: &MessageHeader, rows: &[u8], row_bytes: usize, next_row: &mut usize) -> (Vec<u8>, Vec<u8>) {
    let count = rows.len() / row_bytes;
    let frame = |rows: &[u8]| {
        let header = MessageHeader {
            shape: [0; DIMENSIONS],
            meta_messages: 0,
            ..*header
        };
        [bytes_of(&with_rows(&header, rows.len() / row_bytes)), rows].concat()
    };
    let max_rows = (MAX_FRAME_BYTES - HEADER_BYTES) / row_bytes;
    let from = if *next_row < count { *next_row } else { 0 };
    let to = count.min(from + max_rows);
    *next_row = to;
    (frame(&rows[from * row_bytes..to * row_bytes]), frame(rows))
}

/// Splits a frame into header and payload; `None` if it is shorter than a header.
#[must_use]
pub fn decode(frame: &[u8]) -> Option<(MessageHeader, &[u8])> {
    let (header, payload) = frame.split_at_checked(HEADER_BYTES)?;
    Some((pod_read_unaligned(header), payload))
}

#[cfg(test)]
mod tests;
