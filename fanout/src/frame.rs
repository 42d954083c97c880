//! Frames: a message as it is in shared memory, first the header, then the payload, little endian and without padding between the two. A decoder needs the layouts of `ipc-schema/layout.json` and nothing else.

use bytemuck::{bytes_of, pod_read_unaligned};
use ipc_schema::{
    block::{BlockError, Section, view},
    event::CollisionLayout,
    header::{DIMENSIONS, MessageHeader},
    neighbours::NeighboursLayout,
    observation::{EMPTY_SLOT, ObservationLayout},
    pointcloud::{LidarPoint, PointcloudLayout, Scan},
    prediction::PredictionLayout,
    radar::{RadarDetection, RadarLayout, RadarScan},
    services::Channel,
    traffic::Kind,
    world::{VehicleState, WorldLayout, road_users_of},
};

mod image;

/// Length of the header of a frame, bytes.
pub const HEADER_BYTES: usize = size_of::<MessageHeader>();

/// Longest frame, bytes. zenoh queues 16 batches of 64 KiB for each priority and drops a message that does not fit. On loopback, a third
/// to a half of frames of 1.05 MB were lost, and none of 0.52 MB.
pub const MAX_FRAME_BYTES: usize = 900_000;
/// Longest frame of one mounted sensor, bytes: two fit into the queue.
pub const MAX_SENSOR_BYTES: usize = 480_000;

/// A message cannot be framed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// The payload does not hold what its header promises.
    #[error(transparent)]
    Block(#[from] BlockError),
    /// Longer than [`MAX_FRAME_BYTES`], and no row may be left out.
    #[error("a frame of {0} bytes is longer than the {MAX_FRAME_BYTES} bytes that a viewer's queue holds")]
    TooLong(usize),
    /// The planes of an image do not have its size.
    #[error("the planes of an image do not have the size that it names")]
    Image,
}

/// A message as bytes for the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedFrame {
    /// Header and payload.
    pub bytes: Vec<u8>,
    /// Rows, or bytes of an image's planes, that were left out so that the frame fits into a viewer's queue.
    pub left_out: usize,
}

/// Encodes a message of `channel` as a frame.
///
/// A frame of `world` has neither sub-steps nor views of heroes. If there are more road users or slots of an observation than fit, it has
/// those that come first by [`sampling_order`], in every tick the same; of more points than fit, every second (third, …).
/// A prediction and what is known from messages have the slots of their observation ([`encode_prediction`], [`encode_neighbours`]); alone,
/// their first ones. An image that does not fit has one plane, with fewer pixels if need be.
///
/// # Errors
/// The payload is shorter than its header promises, or the frame is too long.
pub fn encode(channel: Channel, header: &MessageHeader, payload: &[u8]) -> Result<EncodedFrame, FrameError> {
    match channel {
        Channel::World => encode_world(header, payload),
        Channel::Observation => {
            let chosen = chosen_slots(header, payload)?;
            encode_slots(header, payload, chosen.as_deref(), observation_layout(header))
        }
        Channel::Prediction => encode_prediction(header, payload, None),
        Channel::Neighbours => encode_neighbours(header, payload, None),
        Channel::Pointcloud => {
            let layout = PointcloudLayout::of(header);
            encode_returns::<Scan, LidarPoint>(header, payload, layout.scan, layout.points)
        }
        Channel::Radar => {
            let layout = RadarLayout::of(header);
            encode_returns::<RadarScan, RadarDetection>(header, payload, layout.scan, layout.detections)
        }
        Channel::Image => image::encode_image(header, payload),
        _ => encode_collisions(header, payload),
    }
}

/// Where a road user stands in the order in which frames take road users when not all fit: a function of its id alone, so that the
/// same road users are shown in every tick.
#[must_use]
pub fn sampling_order(id_hash: u64) -> u64 {
    id_hash.wrapping_mul(0x9e37_79b9_7f4a_7c15)
}

/// Indices of the `count` rows with the lowest `order`, ascending.
fn first_by_order(order: impl Iterator<Item = u64>, count: usize) -> Vec<usize> {
    let mut rows: Vec<(u64, usize)> = order.zip(0..).collect();
    if count < rows.len() {
        rows.select_nth_unstable(count);
        rows.truncate(count);
    }
    let mut indices: Vec<usize> = rows.into_iter().map(|(_, index)| index).collect();
    indices.sort_unstable();
    indices
}

/// The slots that a frame of this observation keeps, ascending; `None` if all fit. Empty slots come last.
///
/// # Errors
/// The payload is shorter than its header promises.
pub fn chosen_slots(header: &MessageHeader, payload: &[u8]) -> Result<Option<Vec<usize>>, FrameError> {
    let layout = ObservationLayout::of(header);
    let whole: &[u8] = view(
        payload,
        Section {
            offset: 0,
            len: layout.len,
        },
    )?;
    if HEADER_BYTES + layout.len <= MAX_FRAME_BYTES {
        return Ok(None);
    }
    let ids: &[u64] = view(whole, layout.id_hash)?;
    let vehicles: &[u32] = view(whole, layout.vehicle)?;
    let order = ids
        .iter()
        .zip(vehicles)
        .map(|(id_hash, vehicle)| match *vehicle == EMPTY_SLOT {
            true => u64::MAX,
            false => sampling_order(*id_hash),
        });
    let kept = slots_that_fit(header.rows(), layout.len, layout.named().len());
    Ok(Some(first_by_order(order, kept)))
}

/// Encodes a prediction with the slots of its observation's frame, so that the rows of both stay pairs. Without `chosen` it has all
/// slots, or its first ones. The vehicles that actions are for are left out: the observation's frame has them.
///
/// # Errors
/// As [`encode`].
pub fn encode_prediction(
    header: &MessageHeader,
    payload: &[u8],
    chosen: Option<&[usize]>,
) -> Result<EncodedFrame, FrameError> {
    let [_, numbers, estimates] = dimensions(header);
    // What is left out comes last, so that the sections before it stay where they are.
    let layout_of = |rows: usize| {
        // A filter that runs has an estimate for each slot, so that fewer slots have fewer of them.
        let layout = PredictionLayout::sized(rows, numbers, estimates.min(rows), 0);
        (
            layout.named().map(|(_, section)| section).to_vec(),
            layout.shape,
            layout.len,
        )
    };
    let (_, shape, _) = layout_of(header.rows());
    encode_slots(&MessageHeader { shape, ..*header }, payload, chosen, layout_of)
}

/// Encodes what road users know from messages, with the slots of the observation's frame. What the policy of the messages task sees and what
/// messages have achieved are left out. Without `chosen` it has all slots, or its first ones.
///
/// # Errors
/// As [`encode`].
pub fn encode_neighbours(
    header: &MessageHeader,
    payload: &[u8],
    chosen: Option<&[usize]>,
) -> Result<EncodedFrame, FrameError> {
    let [_, nearest, _] = dimensions(header);
    // What is left out comes last, so that the sections before it stay where they are.
    let layout_of = |rows| {
        let layout = NeighboursLayout::sized(rows, nearest, 0, 0);
        (
            layout.named().map(|(_, section)| section).to_vec(),
            layout.shape,
            layout.len,
        )
    };
    let (_, shape, _) = layout_of(header.rows());
    encode_slots(&MessageHeader { shape, ..*header }, payload, chosen, layout_of)
}

/// Sections, shape and length of an observation with a number of slots. Its images, which are too large for a frame, are left out.
fn observation_layout(header: &MessageHeader) -> impl Fn(usize) -> (Vec<Section>, [u32; DIMENSIONS], usize) {
    let [_, fields, imu_samples] = dimensions(header);
    move |rows| {
        let layout = ObservationLayout::new(rows, fields, imu_samples);
        (
            layout.named().map(|(_, section)| section).to_vec(),
            layout.shape,
            layout.len,
        )
    }
}

/// Slots of `rows` that fit into a frame if all of them take `len` bytes in `sections` sections, each padded to its alignment.
fn slots_that_fit(rows: usize, len: usize, sections: usize) -> usize {
    rows * MAX_FRAME_BYTES.saturating_sub(HEADER_BYTES + 64 * sections) / len
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

/// Encodes a block whose sections have a row for each slot: the `chosen` slots; without a choice all, or as many of the first as fit.
/// `layout_of` gives sections, shape and length of a block with a number of slots.
fn encode_slots(
    header: &MessageHeader,
    payload: &[u8],
    chosen: Option<&[usize]>,
    layout_of: impl Fn(usize) -> (Vec<Section>, [u32; DIMENSIONS], usize),
) -> Result<EncodedFrame, FrameError> {
    let rows = header.rows();
    let (sections, _, len) = layout_of(rows);
    let bytes: &[u8] = view(payload, Section { offset: 0, len })?;
    if chosen.is_none() && HEADER_BYTES + len <= MAX_FRAME_BYTES {
        return Ok(EncodedFrame {
            bytes: [bytes_of(header), bytes].concat(),
            left_out: 0,
        });
    }
    let first: Vec<usize>;
    let chosen = match chosen {
        Some(chosen) => chosen,
        None => {
            first = (0..slots_that_fit(rows, len, sections.len())).collect();
            &first
        }
    };
    let kept = chosen.len();
    let (shorter, shape, len) = layout_of(kept);
    let mut bytes = bytes_of(&MessageHeader { shape, ..*header }).to_vec();
    bytes.resize(HEADER_BYTES + len, 0);
    for (from, to) in sections.into_iter().zip(shorter) {
        let row_bytes = to.len / kept.max(1);
        for (index, slot) in chosen.iter().enumerate().take(to.len / row_bytes.max(1)) {
            let row = Section {
                offset: from.offset + slot * row_bytes,
                len: row_bytes,
            };
            let start = HEADER_BYTES + to.offset + index * row_bytes;
            bytes[start..start + row_bytes].copy_from_slice(view(payload, row)?);
        }
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
    let layout = WorldLayout::of(header);
    let states: &[VehicleState] = view(payload, layout.states)?;
    let max_rows = (MAX_FRAME_BYTES - HEADER_BYTES) / size_of::<VehicleState>();
    if states.len() <= max_rows {
        return Ok(world_frame(header, states));
    }
    // Heroes are few, and a viewer follows them. The bodies of a vehicle have its hash: they are kept or left out together but for one.
    let order = states.iter().map(|state| match state.kind == Kind::Hero as u32 {
        true => 0,
        false => sampling_order(state.id_hash),
    });
    let kept: Vec<VehicleState> = first_by_order(order, max_rows).iter().map(|row| states[*row]).collect();
    Ok(EncodedFrame {
        left_out: states.len() - kept.len(),
        ..world_frame(header, &kept)
    })
}

/// Header and states: road users and, behind them, trailing bodies.
fn world_frame(header: &MessageHeader, states: &[VehicleState]) -> EncodedFrame {
    let road_users = road_users_of(states).len();
    let header = MessageHeader {
        shape: WorldLayout::with_heroes(road_users, 0, 0, states.len() - road_users).shape,
        ..*header
    };
    EncodedFrame {
        bytes: [bytes_of(&header), bytemuck::cast_slice(states)].concat(),
        left_out: 0,
    }
}

/// Encodes a scan: where the sensor was (`S`), and the returns (`R`) that fit.
fn encode_returns<S: bytemuck::Pod, R: bytemuck::Pod>(
    header: &MessageHeader,
    payload: &[u8],
    scan: Section,
    returns: Section,
) -> Result<EncodedFrame, FrameError> {
    let mut head = bytemuck::cast_slice(view::<S>(payload, scan)?).to_vec();
    head.resize(returns.offset, 0);
    Ok(thinned(header, &head, view::<R>(payload, returns)?, MAX_SENSOR_BYTES))
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
