//! Frames: a message as it stands in shared memory, header first, then the payload, little endian and without padding
//! between the two. A decoder needs the layouts of `ipc-schema/layout.json` and nothing else.

use bytemuck::{bytes_of, pod_read_unaligned};
use ipc_schema::{
    block::{BlockError, Section, view},
    header::MessageHeader,
    observation::ObservationLayout,
    services::Channel,
    world::{VehicleState, WorldLayout},
};

/// Bytes of the header in front of every payload.
pub const HEADER_BYTES: usize = size_of::<MessageHeader>();

/// Longest frame, bytes. zenoh queues 16 batches of 64 KiB for each priority and drops a message that does not fit: of
/// frames of 1.05 MB a third to a half were lost on loopback, of 0.52 MB none.
pub const MAX_FRAME_BYTES: usize = 900_000;

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
    /// Rows left out to stay below [`MAX_FRAME_BYTES`].
    pub thinned_rows: usize,
}

/// Frames a message of `channel`.
///
/// `world` loses its sub-steps (`columns` = 0) and, above [`MAX_FRAME_BYTES`], all road users but every second (third, …).
///
/// # Errors
/// The payload is too short for its header, or the frame too long.
pub fn encode(channel: Channel, header: &MessageHeader, payload: &[u8]) -> Result<Frame, FrameError> {
    match channel {
        Channel::World => world(header, payload),
        Channel::Observation => {
            plausible(header, payload)?;
            let layout = ObservationLayout::of(header);
            whole(header, payload, layout.len)
        }
        _ => {
            plausible(header, payload)?;
            whole(header, payload, values(header) * size_of::<f32>())
        }
    }
}

/// Values in the first section of a payload with rows and columns.
fn values(header: &MessageHeader) -> usize {
    (header.count as usize).saturating_mul(header.columns as usize)
}

/// Refuses sizes that no payload of this length holds, before anything is computed from them.
fn plausible(header: &MessageHeader, payload: &[u8]) -> Result<(), BlockError> {
    let len = values(header)
        .max(header.count as usize)
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

fn whole(header: &MessageHeader, payload: &[u8], len: usize) -> Result<Frame, FrameError> {
    let total = HEADER_BYTES + len;
    if total > MAX_FRAME_BYTES {
        return Err(FrameError::TooLong(total));
    }
    let bytes: &[u8] = view(payload, Section { offset: 0, len })?;
    Ok(Frame {
        bytes: [bytes_of(header), bytes].concat(),
        thinned_rows: 0,
    })
}

fn world(header: &MessageHeader, payload: &[u8]) -> Result<Frame, FrameError> {
    let rows = header.count as usize;
    let states: &[VehicleState] = view(payload, WorldLayout::new(rows, 0).states)?;
    let most = (MAX_FRAME_BYTES - HEADER_BYTES) / size_of::<VehicleState>();
    let kept = states.iter().step_by(rows.div_ceil(most).max(1));
    let count = kept.len();
    let header = MessageHeader {
        count: u32::try_from(count).unwrap_or(u32::MAX),
        columns: 0,
        ..*header
    };
    let mut bytes = Vec::with_capacity(HEADER_BYTES + count * size_of::<VehicleState>());
    bytes.extend_from_slice(bytes_of(&header));
    kept.for_each(|state| bytes.extend_from_slice(bytes_of(state)));
    Ok(Frame {
        bytes,
        thinned_rows: rows - count,
    })
}

/// Takes a frame apart; `None` if it is shorter than a header.
#[must_use]
pub fn decode(frame: &[u8]) -> Option<(MessageHeader, &[u8])> {
    let (header, payload) = frame.split_at_checked(HEADER_BYTES)?;
    Some((pod_read_unaligned(header), payload))
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::cast_slice;
    use proptest::prelude::*;

    fn header(count: usize, columns: u32) -> MessageHeader {
        MessageHeader {
            schema_version: ipc_schema::SCHEMA_VERSION,
            run_id: 7,
            tick: 11,
            count: u32::try_from(count).unwrap(),
            columns,
            ..MessageHeader::default()
        }
    }

    fn states(count: usize) -> Vec<VehicleState> {
        (0..count)
            .map(|i| VehicleState {
                x_m: i as f64,
                vehicle: u32::try_from(i).unwrap(),
                ..VehicleState::default()
            })
            .collect()
    }

    /// Words, so that sections are aligned as in shared memory.
    fn payload(len: usize) -> Vec<u64> {
        (0..len.div_ceil(8) as u64).collect()
    }

    #[test]
    fn world_keeps_every_state_and_no_sub_step() {
        let layout = WorldLayout::new(3, 10);
        let mut words = payload(layout.len);
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
        bytes[..layout.states.len].copy_from_slice(cast_slice(&states(3)));
        let frame = encode(Channel::World, &header(3, 10), bytes).unwrap();
        let (head, body) = decode(&frame.bytes).unwrap();
        assert_eq!(head, header(3, 0));
        assert_eq!(body, cast_slice::<_, u8>(&states(3)));
        assert_eq!(frame.thinned_rows, 0);
    }

    #[test]
    fn a_crowd_is_thinned_evenly_and_counted() {
        let crowd = states(20_000);
        let frame = encode(Channel::World, &header(20_000, 0), cast_slice(&crowd)).unwrap();
        let (head, body) = decode(&frame.bytes).unwrap();
        assert!(frame.bytes.len() <= MAX_FRAME_BYTES);
        assert_eq!((head.count, frame.thinned_rows), (5_000, 15_000));
        let second: VehicleState = pod_read_unaligned(&body[136..272]);
        assert_eq!(second.vehicle, 4);
    }

    #[test]
    fn observations_are_never_cut() {
        let layout = ObservationLayout::new(20_000, 9, 0);
        let words = payload(layout.len);
        let error = encode(Channel::Observation, &header(20_000, 9), cast_slice(&words)).unwrap_err();
        assert_eq!(error, FrameError::TooLong(layout.len + HEADER_BYTES));
    }

    #[test]
    fn a_header_that_promises_too_much_is_refused() {
        for channel in [Channel::World, Channel::Observation, Channel::Prediction] {
            let error = encode(channel, &header(100, 9), &[0; 64]).unwrap_err();
            assert!(matches!(error, FrameError::Block(_)), "{error}");
            assert!(encode(channel, &header(u32::MAX as usize, u32::MAX), &[0; 64]).is_err());
        }
        assert!(decode(&[0; HEADER_BYTES - 1]).is_none());
    }

    proptest! {
        #[test]
        fn frames_come_back_as_they_were(n in 0_usize..200, d in 1_u32..12) {
            let layout = ObservationLayout::new(n, d as usize, 0);
            for (channel, len) in [(Channel::Observation, layout.len), (Channel::Prediction, n * d as usize * 4)] {
                let words = payload(len);
                let bytes = &cast_slice::<_, u8>(&words)[..len];
                let frame = encode(channel, &header(n, d), bytes).unwrap();
                prop_assert_eq!(decode(&frame.bytes).unwrap(), (header(n, d), bytes));
            }
        }
    }
}
