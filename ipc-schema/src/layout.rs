//! The committed layout table: size, alignment and field offsets of every record on the wire.

use std::mem::{align_of, offset_of, size_of};

use serde::Serialize;

use crate::{
    SCHEMA_VERSION,
    activity::Activity,
    block::ALIGNMENT,
    board::{Health, Progress, Roster, TrainingStatus},
    channel::CHANNELS,
    config::TaskKind,
    control::{ControlReply, ControlRequest, SensorSwitch},
    ego::EgoPose,
    event::Collision,
    field::FIELDS,
    header::MessageHeader,
    image::{BrightnessEvent, ImageHead, ImagePlane, SeenObject},
    lane_position::LanePosition,
    pointcloud::{LidarPoint, Scan},
    radar::{RadarDetection, RadarScan},
    section::{SectionSpec, WireElement, numpy_type},
    sensor::{SENSORS, SensorKind},
    traffic::{HeroAdvice, RoutePoint, SignalMeta, TrafficState, VEHICLE_CLASSES, VehicleMeta},
    world::{HeroView, SubStep, VehicleState},
};

/// Layout of one payload type.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct TypeLayout {
    /// Name of the type.
    pub name: &'static str,
    /// Bytes.
    pub size: usize,
    /// Bytes.
    pub alignment: usize,
    /// Each field, in order.
    pub fields: Vec<MemberLayout>,
}

/// Name, offset in bytes, scalar and shape of a field of a record, as numpy takes them.
pub type MemberLayout = (&'static str, usize, String, Vec<usize>);

/// Scalar and shape of the field that `member` returns.
fn member_type<R, T: WireElement>(_: fn(&R) -> &T) -> (String, Vec<usize>) {
    numpy_type::<T>()
}

macro_rules! layout {
    ($type:ident { $($field:ident),+ $(,)? }) => {
        TypeLayout {
            name: stringify!($type),
            size: size_of::<$type>(),
            alignment: align_of::<$type>(),
            fields: vec![$({
                let (scalar, shape) = member_type(|record: &$type| &record.$field);
                (stringify!($field), offset_of!($type, $field), scalar, shape)
            }),+],
        }
    };
}

/// Layout of every payload type.
#[must_use]
pub fn table() -> Vec<TypeLayout> {
    vec![
        layout!(MessageHeader {
            schema_version,
            env_index,
            run_id,
            incarnation,
            addressee,
            flags,
            stage,
            map,
            episode,
            episode_seed,
            tick,
            sim_time_ns,
            shape,
            policy_version,
            meta_messages
        }),
        layout!(TrafficState {
            front_x_m,
            front_y_m,
            front_z_m,
            yaw_rad,
            pitch_rad,
            speed_mps,
            accel_mps2,
            vehicle,
            kind,
            signals,
            flags
        }),
        layout!(VehicleMeta {
            id_hash,
            vehicle,
            event,
            kind,
            type_index,
            length_m,
            width_m,
            height_m,
            id_len,
            id,
            vehicle_class,
            type_id,
            type_accel_mps2,
            type_decel_mps2,
            type_speed_mps,
            reserved
        }),
        layout!(SignalMeta {
            id_hash,
            signal,
            id_len,
            id,
            links,
            reserved,
            state
        }),
        layout!(VehicleState {
            x_m,
            y_m,
            z_m,
            yaw_rad,
            id_hash,
            roll_rad,
            pitch_rad,
            velocity_body_mps,
            accel_body_mps2,
            angular_rate_body_radps,
            road_wheel_angle_rad,
            tracking_lateral_m,
            tracking_longitudinal_m,
            length_m,
            width_m,
            height_m,
            wheelbase_m,
            rear_overhang_m,
            whole_length_m,
            trailing,
            class,
            vehicle,
            kind,
            signals,
            flags,
            reference_offset_m,
            steering_ratio,
            rear_wheel_slip
        }),
        layout!(SubStep {
            dx_m,
            dy_m,
            dz_m,
            dyaw_rad,
            roll_rad,
            pitch_rad,
            speed_mps,
            lateral_speed_mps,
            accel_body_mps2,
            angular_rate_body_radps,
            road_wheel_angle_rad,
            reserved
        }),
        layout!(HeroAdvice { vehicle, accel_mps2 }),
        layout!(RoutePoint {
            x_m,
            y_m,
            speed_limit_mps,
            vehicle,
            index,
            edge,
            signal,
            link,
            way,
            reserved
        }),
        layout!(HeroView {
            route_m,
            speed_limit_mps,
            route_offset_m,
            route_left_m,
            leader_gap_m,
            leader_speed_mps,
            signal_gap_m,
            advised_accel_mps2,
            vehicle,
            around
        }),
        layout!(EgoPose {
            front_x_m,
            front_y_m,
            yaw_rad,
            speed_mps,
            accel_mps2,
            vehicle,
            flags
        }),
        layout!(Collision {
            position_m,
            id_hash,
            other_id_hash,
            vehicle,
            other,
            other_class,
            relative_speed_mps
        }),
        layout!(LidarPoint {
            position_m,
            intensity,
            object,
            incidence_cos,
            tag,
            channel,
            age_us
        }),
        layout!(Scan {
            position_m,
            attitude_rad,
            id_hash,
            azimuth_rad,
            range_m,
            rays,
            axes,
            vehicle,
            azimuths,
            sensor,
            reserved
        }),
        layout!(LanePosition {
            id_hash,
            lane_position_m,
            odometer_m,
            vehicle,
            lane,
            edge,
            route_edge,
            carrier,
            reserved
        }),
        layout!(ImageHead {
            position_m,
            attitude_rad,
            id_hash,
            vehicle,
            width,
            height,
            planes,
            focal_px,
            range_m,
            sensor,
            lost_events,
            distortion,
            readout_s
        }),
        layout!(BrightnessEvent {
            time_us,
            x,
            y,
            polarity
        }),
        layout!(SeenObject {
            object,
            label,
            visible_px,
            visible_box_px,
            full_box_px,
            truncated,
            depth_m
        }),
        layout!(RadarScan {
            position_m,
            attitude_rad,
            id_hash,
            vehicle,
            range_m,
            range_resolution_m,
            velocity_resolution_mps,
            velocity_ambiguity_mps,
            azimuth_resolution_rad,
            sensor,
            reserved
        }),
        layout!(RadarDetection {
            object_id,
            existence_probability,
            distance_m,
            azimuth_rad,
            elevation_rad,
            position_rmse,
            radial_velocity_mps,
            radial_velocity_rmse_mps,
            rcs_dbsm,
            snr_db
        }),
        layout!(Progress {
            consumed_ticks,
            received_ticks,
            committed_ticks,
            incarnation,
            attached,
            decided_lessons,
            since_lesson,
            stage,
            sender_incarnation,
            recorded_ticks,
            recorded_senders,
            recorded_addressees
        }),
        layout!(Health {
            state,
            pid,
            ticks,
            episode,
            sim_time_ns,
            road_users,
            cavs,
            drops,
            vehicle_steps,
            arrived,
            resynchronisations,
            total_ticks,
            written_ns
        }),
        layout!(Activity {
            noted_ns,
            awaited,
            process
        }),
        layout!(Roster {
            incarnations,
            handing_over
        }),
        layout!(ControlRequest {
            schema_version,
            command,
            sensors,
            is_on,
            ticks,
            vehicle_len,
            edge_len,
            vehicle,
            edge
        }),
        layout!(ControlReply {
            schema_version,
            outcome,
            tick,
            episode,
            text_len,
            reserved,
            text
        }),
        layout!(SensorSwitch {
            id_hash,
            sensors,
            flags
        }),
        layout!(TrainingStatus {
            episode,
            env_steps,
            updates,
            env_steps_per_s,
            policy_std,
            reward,
            best_reward,
            metrics
        }),
    ]
}

/// Names a record by which sections and members refer to it.
macro_rules! records {
    ($($record:ident),+ $(,)?) => {
        $(impl WireElement for $record {
            const SCALAR: &'static str = stringify!($record);
        })+
    };
}

records!(
    ImageHead,
    SeenObject,
    BrightnessEvent,
    RadarScan,
    RadarDetection,
    Collision,
    EgoPose,
    HeroAdvice,
    HeroView,
    LanePosition,
    LidarPoint,
    RoutePoint,
    Scan,
    SensorSwitch,
    SignalMeta,
    SubStep,
    TrafficState,
    VehicleMeta,
    VehicleState
);

/// A section of a payload for readers in other languages.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SectionLayout {
    /// Its name.
    pub name: &'static str,
    /// The scalar as numpy writes it, or the name of a record.
    pub scalar: String,
    /// Names of the first dimensions of its shape.
    pub dimensions: &'static [&'static str],
    /// The remaining dimensions, which are constant.
    pub shape: Vec<usize>,
}

/// The payload of a channel: its sections, each on a boundary of [`ALIGNMENT`] bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PayloadLayout {
    /// Name of the channel.
    pub name: &'static str,
    /// Names of the dimensions, in the order of the header's shape.
    pub dimensions: &'static [&'static str],
    /// Its sections, in order.
    pub sections: Vec<SectionLayout>,
}

/// The payload of every channel.
#[must_use]
pub fn payloads() -> Vec<PayloadLayout> {
    let section = |spec: &SectionSpec| {
        let (scalar, shape) = (spec.element)();
        SectionLayout {
            name: spec.name,
            scalar,
            dimensions: spec.dimensions,
            shape,
        }
    };
    let rows = CHANNELS.iter().map(|channel| PayloadLayout {
        name: channel.name,
        dimensions: channel.dimensions,
        sections: channel.sections.iter().map(section).collect(),
    });
    rows.collect()
}

/// A sensor for readers in other languages.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SensorLayout {
    /// Name in commands and keys.
    pub name: &'static str,
    /// Name in the HUD.
    pub label: &'static str,
    /// Bit in an observation's `sensors`.
    pub bit: u32,
}

/// Every sensor, in the order of an observation's ages.
#[must_use]
pub fn sensors() -> Vec<SensorLayout> {
    let rows = SENSORS.iter().map(|spec| SensorLayout {
        name: spec.name,
        label: spec.label,
        bit: spec.kind.bit(),
    });
    rows.collect()
}

/// An observation field for readers in other languages. Its range in a run is in the run file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FieldLayout {
    /// Name in `observation.fields`.
    pub name: &'static str,
    /// SI unit, or "".
    pub unit: &'static str,
    /// The sensor that it needs.
    pub sensor: Option<&'static str>,
    /// The task that it needs.
    pub task: Option<TaskKind>,
}

/// Every observation field.
#[must_use]
pub fn fields() -> Vec<FieldLayout> {
    let rows = FIELDS.iter().map(|spec| FieldLayout {
        name: spec.name,
        unit: spec.unit,
        sensor: spec.source.sensor().map(SensorKind::name),
        task: spec.source.task(),
    });
    rows.collect()
}

/// A plane of an image for readers in other languages.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PlaneLayout {
    /// Name in Python.
    pub name: &'static str,
    /// Its bit in `ImageHead.planes`.
    pub bit: u32,
    /// Numpy's name of a pixel's scalar.
    pub scalar: &'static str,
    /// Shape of a pixel.
    pub shape: Vec<usize>,
}

/// Every plane of an image, in the order in which a message has them.
#[must_use]
pub fn image_planes() -> Vec<PlaneLayout> {
    let rows = ImagePlane::ALL.into_iter().map(|plane| {
        let (scalar, count) = plane.pixel();
        PlaneLayout {
            name: plane.name(),
            bit: plane.bit(),
            scalar,
            shape: (count > 1).then_some(count).into_iter().collect(),
        }
    });
    rows.collect()
}

/// A list in JSON with one line for each of its rows.
fn lines<T: Serialize>(rows: &[T]) -> Result<String, serde_json::Error> {
    let rows: Result<Vec<String>, _> = rows.iter().map(serde_json::to_string).collect();
    Ok(format!("[\n    {}\n  ]", rows?.join(",\n    ")))
}

/// The tables as committed in `ipc-schema/layout.json`.
///
/// # Errors
/// A row has no form in JSON.
pub fn json() -> Result<String, serde_json::Error> {
    Ok(format!(
        "{{\n  \"schema_version\": {SCHEMA_VERSION},\n  \"alignment\": {ALIGNMENT},\n  \"types\": {},\n  \"payloads\": {},\n  \"sensors\": {},\n  \"fields\": {},\n  \"image_planes\": {},\n  \"vehicle_classes\": {}\n}}\n",
        lines(&table())?,
        lines(&payloads())?,
        lines(&sensors())?,
        lines(&fields())?,
        lines(&image_planes())?,
        lines(&VEHICLE_CLASSES)?
    ))
}

#[cfg(test)]
mod tests {
    /// `CARAWARE_BLESS=1 cargo test -p ipc-schema layout` rewrites the table after a deliberate change
    /// (raise `SCHEMA_VERSION` with it).
    /// A field that is not listed would leave a gap, and readers in other languages without it.
    #[test]
    fn the_fields_of_a_type_are_all_of_its_bytes() {
        let types: serde_json::Value = serde_json::from_str(&super::json().unwrap()).unwrap();
        for of in types["types"].as_array().unwrap() {
            let mut end = 0;
            for field in of["fields"].as_array().unwrap() {
                let scalar = field[2].as_str().unwrap();
                let digits = scalar.trim_start_matches(|c: char| !c.is_ascii_digit());
                let shape = field[3].as_array().unwrap().iter().map(|size| size.as_u64().unwrap());
                assert_eq!(field[1].as_u64(), Some(end), "{} before {}", of["name"], field[0]);
                end += digits.parse::<u64>().unwrap() * shape.product::<u64>();
            }
            assert_eq!(of["size"].as_u64(), Some(end), "{}", of["name"]);
        }
    }

    #[test]
    fn the_committed_layout_table_is_current() {
        let json = super::json().unwrap();
        // The viewer is installed without this tree and has a copy.
        for path in ["/layout.json", "/../viewer/src/caraware_viewer/layout.json"] {
            let path = format!("{}{path}", env!("CARGO_MANIFEST_DIR"));
            if std::env::var_os("CARAWARE_BLESS").is_some() {
                std::fs::write(&path, &json).unwrap();
            }
            let committed = std::fs::read_to_string(&path).unwrap();
            assert!(
                committed == json,
                "{path} is not what the program has: CARAWARE_BLESS=1 writes it"
            );
        }
    }
}
