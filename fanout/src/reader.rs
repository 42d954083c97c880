//! What a reader must refuse (docs/fanout.md): a sample that is not what it says it is.

use ipc_schema::{
    SCHEMA_VERSION,
    event::Collision,
    header::MessageHeader,
    observation::{IMU_COLUMNS, ObservationLayout},
    pointcloud::PointcloudLayout,
    prediction::PredictionLayout,
    traffic::{SignalMeta, VehicleMeta},
    world::VehicleState,
};

use crate::frame;

/// Why a sample is of no use.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// Shorter than a header, or than its header promises.
    #[error("{actual} bytes, its header promises {promised}")]
    Short {
        /// Bytes there.
        actual: usize,
        /// Bytes promised.
        promised: usize,
    },
    /// Of another version of the schema.
    #[error("schema version {0}, this reader speaks {SCHEMA_VERSION}")]
    Version(u64),
    /// Of another run.
    #[error("of run {0:#018x}")]
    Run(u64),
    /// No JSON that tells its schema version.
    #[error("no JSON of ours")]
    Json,
    /// A key that is not of the table.
    #[error("an unknown key")]
    Unknown,
}

/// Checks a sample of `topic`, the part of its key after run and environment. The header, if it is a frame.
///
/// # Errors
/// It is to be refused.
pub fn check(topic: &str, bytes: &[u8], run_id: Option<u64>) -> Result<Option<MessageHeader>, Refusal> {
    if matches!(topic, "map" | "status") {
        return json(bytes).map(|()| None);
    }
    let short = |promised| Refusal::Short {
        actual: bytes.len(),
        promised,
    };
    let (header, payload) = frame::decode(bytes).ok_or_else(|| short(frame::HEADER_BYTES))?;
    if header.schema_version != SCHEMA_VERSION {
        return Err(Refusal::Version(header.schema_version.into()));
    }
    if run_id.is_some_and(|run_id| run_id != header.run_id) {
        return Err(Refusal::Run(header.run_id));
    }
    let promised = promised(topic, &header, payload.len()).ok_or(Refusal::Unknown)?;
    if payload.len() < promised {
        return Err(short(promised.saturating_add(frame::HEADER_BYTES)));
    }
    Ok(Some(header))
}

fn json(bytes: &[u8]) -> Result<(), Refusal> {
    let value: serde_json::Value = serde_json::from_slice(bytes).map_err(|_| Refusal::Json)?;
    match value["schema_version"].as_u64() {
        Some(version) if version == u64::from(SCHEMA_VERSION) => Ok(()),
        Some(version) => Err(Refusal::Version(version)),
        None => Err(Refusal::Json),
    }
}

/// Bytes of payload that a header promises; more than `there` without computing further if it promises too much.
fn promised(topic: &str, header: &MessageHeader, there: usize) -> Option<usize> {
    let (rows, columns) = (header.count as usize, header.columns as usize);
    let rows_of = |bytes: usize| rows.saturating_mul(bytes);
    let least = |columns: usize| rows.saturating_mul(columns).saturating_mul(size_of::<f32>());
    Some(match topic {
        "world" => rows_of(size_of::<VehicleState>()),
        "vehicles" => rows_of(size_of::<VehicleMeta>()),
        "signals" => rows_of(size_of::<SignalMeta>()),
        "event" => rows_of(size_of::<Collision>()),
        "prediction" => match least(columns.max(1)) {
            bytes if bytes > there => bytes,
            _ => PredictionLayout::of(header).len,
        },
        "observation" => {
            let samples = usize::try_from(header.sequence).unwrap_or(usize::MAX);
            match least(columns.max(samples.saturating_mul(IMU_COLUMNS)).max(1)) {
                bytes if bytes > there => bytes,
                _ => ObservationLayout::of(header).len,
            }
        }
        topic if topic.starts_with("pointcloud/") => {
            let layout = PointcloudLayout::new(rows);
            layout.points.offset + layout.points.len
        }
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const TOPICS: [&str; 10] = [
        "map",
        "status",
        "vehicles",
        "signals",
        "world",
        "observation",
        "prediction",
        "event",
        "pointcloud/a",
        "other",
    ];

    fn frame(version: u32, count: u32, payload: usize) -> Vec<u8> {
        let header = MessageHeader {
            schema_version: version,
            run_id: 7,
            count,
            columns: 2,
            ..MessageHeader::default()
        };
        let mut bytes = bytemuck::bytes_of(&header).to_vec();
        bytes.resize(bytes.len() + payload, 0);
        bytes
    }

    #[test]
    fn whole_frames_pass_and_truncated_old_and_foreign_ones_do_not() {
        let whole = frame(SCHEMA_VERSION, 2, 2 * size_of::<VehicleState>());
        assert_eq!(check("world", &whole, Some(7)).unwrap().unwrap().count, 2);
        assert!(matches!(
            check("world", &whole[..whole.len() - 1], None),
            Err(Refusal::Short { .. })
        ));
        assert!(matches!(
            check("world", &whole[..71], None),
            Err(Refusal::Short { promised: 72, .. })
        ));
        assert_eq!(check("world", &whole, Some(8)), Err(Refusal::Run(7)));
        assert_eq!(
            check("world", &frame(SCHEMA_VERSION + 1, 0, 0), None),
            Err(Refusal::Version(u64::from(SCHEMA_VERSION) + 1))
        );
        assert_eq!(
            check("status", b"{\"schema_version\": 1}", None),
            Err(Refusal::Version(1))
        );
        assert_eq!(check("status", b"{", None), Err(Refusal::Json));
        assert_eq!(check("other", &whole, None), Err(Refusal::Unknown));
    }

    proptest! {
        /// Nothing that comes over the network makes a reader panic or compute with what is not there.
        #[test]
        fn nonsense_is_refused_and_no_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..300), ours in any::<bool>()) {
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
