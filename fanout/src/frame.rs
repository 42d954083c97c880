//! Frames: a message as it stands in shared memory, header first, then the payload, little endian and without padding
//! between the two. A decoder needs the layouts of `ipc-schema/layout.json` and nothing else.

use bytemuck::{bytes_of, pod_read_unaligned};
use ipc_schema::{
    block::{BlockError, Section, view},
    event::Collision,
    header::MessageHeader,
    observation::{IMU_COLUMNS, ObservationLayout},
    pointcloud::{LidarPoint, PointcloudLayout, Scan},
    prediction::PredictionLayout,
    services::Channel,
    world::{VehicleState, WorldLayout},
};

/// Bytes of the header in front of every payload.
pub const HEADER_BYTES: usize = size_of::<MessageHeader>();

/// Longest frame, bytes. zenoh queues 16 batches of 64 KiB for each priority and drops a message that does not fit: of
/// frames of 1.05 MB a third to a half were lost on loopback, of 0.52 MB none.
pub const MAX_FRAME_BYTES: usize = 900_000;
/// Longest frame of one scan, bytes: two fit the queue.
pub const MAX_SCAN_BYTES: usize = 480_000;

/// A message cannot be framed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// The payload does not hold what its header promises.
    #[error(transparent)]
    Block(#[from] BlockError),
    /// Longer than [`MAX_FRAME_BYTES`], and rows belong together.
    #[error("a frame of {0} bytes is over the {MAX_FRAME_BYTES} that a viewer's queue holds")]
    TooLong(usize),
}

/// A message framed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Header and payload.
    pub bytes: Vec<u8>,
    /// Rows left out so that a viewer's queue holds it.
    pub left_out: usize,
}

/// Frames a message of `channel`.
///
/// Of `world` the sub-steps stay behind (`columns` = 0) and, of more road users or points than fit, all but every second (third, …).
/// Observations and predictions are cut to their first slots.
///
/// # Errors
/// The payload is too short for its header, or the frame too long.
pub fn encode(channel: Channel, header: &MessageHeader, payload: &[u8]) -> Result<Frame, FrameError> {
    let columns = header.columns as usize;
    match channel {
        Channel::World => world(header, payload),
        Channel::Observation => {
            let samples = usize::try_from(header.sequence).unwrap_or(usize::MAX);
            plausible(header, columns.max(samples.saturating_mul(IMU_COLUMNS)), payload)?;
            slots(header, payload, |header| {
                let layout = ObservationLayout::of(header);
                (layout.named().map(|(_, section)| section).to_vec(), layout.len)
            })
        }
        Channel::Prediction => {
            plausible(header, columns, payload)?;
            slots(header, payload, |header| {
                let layout = PredictionLayout::of(header);
                (vec![layout.prediction, layout.estimate_m], layout.len)
            })
        }
        Channel::Pointcloud => scan(header, payload),
        _ => collisions(header, payload),
    }
}

/// Refuses sizes that no payload of this length holds, before anything is computed from them.
fn plausible(header: &MessageHeader, columns: usize, payload: &[u8]) -> Result<(), BlockError> {
    let len = (header.count as usize)
        .saturating_mul(columns.max(1))
        .saturating_mul(size_of::<f32>());
    if len <= payload.len() {
        return Ok(());
    }
    Err(BlockError {
        actual: payload.len(),
        offset: 0,
        len,
        element: size_of::<f32>(),
    })
}

fn with_count(header: &MessageHeader, count: usize) -> MessageHeader {
    MessageHeader {
        count: u32::try_from(count).unwrap_or(u32::MAX),
        ..*header
    }
}

/// A block whose sections have a row for each slot, cut to the slots that fit.
fn slots(
    header: &MessageHeader,
    payload: &[u8],
    parts: impl Fn(&MessageHeader) -> (Vec<Section>, usize),
) -> Result<Frame, FrameError> {
    let rows = header.count as usize;
    let (sections, len) = parts(header);
    if HEADER_BYTES + len <= MAX_FRAME_BYTES {
        let bytes: &[u8] = view(payload, Section { offset: 0, len })?;
        return Ok(Frame {
            bytes: [bytes_of(header), bytes].concat(),
            left_out: 0,
        });
    }
    // Sections are padded to a border each: room for that is left.
    let room = MAX_FRAME_BYTES.saturating_sub(HEADER_BYTES + 64 * sections.len());
    let kept = rows * room / len;
    let header = with_count(header, kept);
    let (shorter, len) = parts(&header);
    let mut bytes = bytes_of(&header).to_vec();
    bytes.resize(HEADER_BYTES + len, 0);
    for (from, to) in sections.into_iter().zip(shorter) {
        let part = Section { len: to.len, ..from };
        let start = HEADER_BYTES + to.offset;
        bytes[start..start + to.len].copy_from_slice(view(payload, part)?);
    }
    if bytes.len() > MAX_FRAME_BYTES {
        return Err(FrameError::TooLong(bytes.len()));
    }
    Ok(Frame {
        bytes,
        left_out: rows - kept,
    })
}

fn collisions(header: &MessageHeader, payload: &[u8]) -> Result<Frame, FrameError> {
    let len = (header.count as usize).saturating_mul(size_of::<Collision>());
    let bytes: &[u8] = view(payload, Section { offset: 0, len })?;
    if HEADER_BYTES + len > MAX_FRAME_BYTES {
        return Err(FrameError::TooLong(HEADER_BYTES + len));
    }
    Ok(Frame {
        bytes: [bytes_of(header), bytes].concat(),
        left_out: 0,
    })
}

fn world(header: &MessageHeader, payload: &[u8]) -> Result<Frame, FrameError> {
    let states: &[VehicleState] = view(payload, WorldLayout::new(header.count as usize, 0).states)?;
    let header = MessageHeader { columns: 0, ..*header };
    Ok(thinned(&header, &[], states, MAX_FRAME_BYTES))
}

fn scan(header: &MessageHeader, payload: &[u8]) -> Result<Frame, FrameError> {
    let layout = PointcloudLayout::new(header.count as usize);
    let scan: &[Scan] = view(payload, layout.scan)?;
    let points: &[LidarPoint] = view(payload, layout.points)?;
    let mut head = bytemuck::cast_slice(scan).to_vec();
    head.resize(layout.points.offset, 0);
    Ok(thinned(header, &head, points, MAX_SCAN_BYTES))
}

/// Header, `head`, and as many of `rows` as `most_bytes` hold, evenly.
fn thinned<T: bytemuck::Pod>(header: &MessageHeader, head: &[u8], rows: &[T], most_bytes: usize) -> Frame {
    let most = (most_bytes - HEADER_BYTES - head.len()) / size_of::<T>();
    let kept = rows.iter().step_by(rows.len().div_ceil(most).max(1));
    let count = kept.len();
    let mut bytes = Vec::with_capacity(HEADER_BYTES + head.len() + count * size_of::<T>());
    bytes.extend_from_slice(bytes_of(&with_count(header, count)));
    bytes.extend_from_slice(head);
    kept.for_each(|row| bytes.extend_from_slice(bytes_of(row)));
    Frame {
        bytes,
        left_out: rows.len() - count,
    }
}

/// A whole table as one frame, for those who ask; and its next part for those who listen, from row `place` on, which it moves.
/// `rows` are bytes, `row_bytes` each.
#[must_use]
pub fn table(header: &MessageHeader, rows: &[u8], row_bytes: usize, place: &mut usize) -> (Vec<u8>, Vec<u8>) {
    let count = rows.len() / row_bytes;
    let frame = |rows: &[u8]| {
        let header = MessageHeader {
            columns: 0,
            sequence: 0,
            ..with_count(header, rows.len() / row_bytes)
        };
        [bytes_of(&header), rows].concat()
    };
    let most = (MAX_FRAME_BYTES - HEADER_BYTES) / row_bytes;
    let from = if *place < count { *place } else { 0 };
    let to = count.min(from + most);
    *place = to;
    (frame(&rows[from * row_bytes..to * row_bytes]), frame(rows))
}

/// Takes a frame apart; `None` if it is shorter than a header.
#[must_use]
pub fn decode(frame: &[u8]) -> Option<(MessageHeader, &[u8])> {
    let (header, payload) = frame.split_at_checked(HEADER_BYTES)?;
    Some((pod_read_unaligned(header), payload))
}

#[cfg(test)]
mod tests;
