//! The checks of a reader (docs/fanout.md): refuses a sample that does not hold what its header or its key says.

use ipc_schema::{
    SCHEMA_VERSION,
    event::Collision,
    header::MessageHeader,
    image::ImageLayout,
    neighbours::NeighboursLayout,
    observation::ObservationLayout,
    pointcloud::PointcloudLayout,
    prediction::PredictionLayout,
    radar::RadarLayout,
    traffic::{RoutePoint, SignalMeta, VehicleMeta},
    world::VehicleState,
};

use crate::frame;

/// Why a sample is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SampleRefusal {
    /// Shorter than a header, or shorter than its header promises.
    #[error("{actual} bytes, but {promised} are promised")]
    Short {
        /// Length of the sample, bytes.
        actual: usize,
        /// Length that it must have, bytes.
        promised: usize,
    },
    /// Of another version of the schema.
    #[error("schema version {0}, but this reader knows {SCHEMA_VERSION}")]
    Version(u64),
    /// Of another run.
    #[error("a sample of another run, {0:#018x}")]
    Run(u64),
    /// JSON that does not parse, or does not name its schema version.
    #[error("not JSON with a schema version")]
    Json,
    /// A key of no known topic.
    #[error("a key of no known topic")]
    Unknown,
}

/// Checks a sample of `topic`, which is the part of its key after run and environment. Returns the header of a frame, and `None` for JSON.
///
/// # Errors
/// The sample must be refused.
pub fn check(topic: &str, bytes: &[u8], run_id: Option<u64>) -> Result<Option<MessageHeader>, SampleRefusal> {
    if matches!(topic, "map" | "status" | "learning") {
        return check_json(bytes).map(|()| None);
    }
    let short = |promised| SampleRefusal::Short {
        actual: bytes.len(),
        promised,
    };
    let (header, payload) = frame::decode(bytes).ok_or_else(|| short(frame::HEADER_BYTES))?;
    if header.schema_version != SCHEMA_VERSION {
        return Err(SampleRefusal::Version(header.schema_version.into()));
    }
    if run_id.is_some_and(|run_id| run_id != header.run_id) {
        return Err(SampleRefusal::Run(header.run_id));
    }
    let promised = promised(topic, &header).ok_or(SampleRefusal::Unknown)?;
    if payload.len() < promised {
        return Err(short(promised.saturating_add(frame::HEADER_BYTES)));
    }
    Ok(Some(header))
}

/// Checks that JSON names the schema version of this reader.
fn check_json(bytes: &[u8]) -> Result<(), SampleRefusal> {
    let value: serde_json::Value = serde_json::from_slice(bytes).map_err(|_| SampleRefusal::Json)?;
    match value["schema_version"].as_u64() {
        Some(version) if version == u64::from(SCHEMA_VERSION) => Ok(()),
        Some(version) => Err(SampleRefusal::Version(version)),
        None => Err(SampleRefusal::Json),
    }
}

/// Length of the payload that a header promises, bytes; the largest `usize` if it is more than any payload has.
fn promised(topic: &str, header: &MessageHeader) -> Option<usize> {
    let rows_of = |bytes: usize| header.rows().saturating_mul(bytes);
    Some(match topic {
        "world" => rows_of(size_of::<VehicleState>()),
        "vehicles" => rows_of(size_of::<VehicleMeta>()),
        "routes" => rows_of(size_of::<RoutePoint>()),
        "signals" => rows_of(size_of::<SignalMeta>()),
        "event" => rows_of(size_of::<Collision>()),
        "prediction" => PredictionLayout::of(header).len,
        "observation" => ObservationLayout::of(header).len,
        "neighbours" => NeighboursLayout::of(header).len,
        topic => {
            // The last section of what a mounted sensor sends.
            let last = match topic.split_once('/')?.0 {
                "pointcloud" => PointcloudLayout::of(header).points,
                "image" => ImageLayout::of(header).events,
                "radar" => RadarLayout::of(header).detections,
                _ => return None,
            };
            last.offset.saturating_add(last.len)
        }
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const TOPICS: [&str; 13] = [
        "map",
        "status",
        "vehicles",
        "signals",
        "world",
        "observation",
        "prediction",
        "neighbours",
        "event",
        "pointcloud/a",
        "image/a@front",
        "radar/a",
        "other",
    ];

    fn frame(version: u32, count: u32, payload: usize) -> Vec<u8> {
        let header = MessageHeader {
            schema_version: version,
            run_id: 7,
            shape: [count, 0, 0, 0],
            ..MessageHeader::default()
        };
        let mut bytes = bytemuck::bytes_of(&header).to_vec();
        bytes.resize(bytes.len() + payload, 0);
        bytes
    }

    #[test]
    fn whole_frames_pass_and_truncated_old_and_foreign_ones_do_not() {
        let whole = frame(SCHEMA_VERSION, 2, 2 * size_of::<VehicleState>());
        assert_eq!(check("world", &whole, Some(7)).unwrap().unwrap().rows(), 2);
        assert!(matches!(
            check("world", &whole[..whole.len() - 1], None),
            Err(SampleRefusal::Short { .. })
        ));
        assert!(matches!(
            check("world", &whole[..95], None),
            Err(SampleRefusal::Short { promised: 96, .. })
        ));
        assert_eq!(check("world", &whole, Some(8)), Err(SampleRefusal::Run(7)));
        assert_eq!(
            check("world", &frame(SCHEMA_VERSION + 1, 0, 0), None),
            Err(SampleRefusal::Version(u64::from(SCHEMA_VERSION) + 1))
        );
        assert_eq!(
            check("status", b"{\"schema_version\": 1}", None),
            Err(SampleRefusal::Version(1))
        );
        assert_eq!(check("status", b"{", None), Err(SampleRefusal::Json));
        assert_eq!(check("other", &whole, None), Err(SampleRefusal::Unknown));
        // An image ends with its events.
        let mut image = frame(SCHEMA_VERSION, 0, 40);
        image[std::mem::offset_of!(MessageHeader, shape) + 12] = 6;
        let Err(SampleRefusal::Short { promised, .. }) = check("image/a", &image, None) else {
            panic!("six events without room");
        };
        image.resize(promised, 0);
        assert!(check("image/a", &image, None).is_ok());
        assert!(promised >= frame::HEADER_BYTES + 6 * size_of::<ipc_schema::image::BrightnessEvent>());
    }

    proptest! {
        /// No bytes from the network make a reader panic or read beyond them.
        #[test]
        fn random_bytes_are_refused_without_a_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..300), ours in any::<bool>()) {
            if ours && bytes.len() >= 4 {
                bytes[..4].copy_from_slice(&SCHEMA_VERSION.to_le_bytes());
            }
            for topic in TOPICS {
                if let Ok(Some(header)) = check(topic, &bytes, None) {
                    prop_assert_eq!(header.schema_version, SCHEMA_VERSION);
                }
            }
        }
    }
}
