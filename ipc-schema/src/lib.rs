//! Everything that crosses a process boundary, and nothing else: payloads, the table of services, flow control, the run file.
//!
//! | service | payload (64-byte aligned bytes, little endian) | producer | required consumers |
//! |---|---|---|---|
//! | `traffic` | `[TrafficState]`, `[HeroAdvice]` | traffic-bridge | sim-core, recorder |
//! | `traffic-meta` | `[VehicleMeta]`, `[SignalMeta]`; or `[RoutePoint]` | traffic-bridge | sim-core |
//! | `census` | as `traffic-meta`: every road user and every light | traffic-bridge | none |
//! | `world` | `[VehicleState]`, `[SubStep]`, `[HeroView]` | sim-core | sensor-daemon, v2x, recorder |
//! | `observation` | observations, truth, newest samples, slots | sensor-daemon | trainer, recorder |
//! | `measurement` | as `observation`, for every tick made | sensor-daemon | v2x, recorder |
//! | `neighbours` | objects known from messages, radios | v2x | trainer, recorder |
//! | `prediction` | positions or actions, estimates of the filter, vehicles | trainer | none |
//! | `ego-pose` | `[EgoPose]` | sim-core | traffic-bridge |
//! | `event` | `[Collision]` | sim-core | none |
//! | `pointcloud` | `Scan`, `[LidarPoint]`: one message for each LIDAR and tick | sensor-daemon | none |
//! | `switch` | `[SensorSwitch]`, from the tick in the header on | traffic-bridge | none |
//! | `image` | `ImageHead`, planes, `[SeenObject]`, `[BrightnessEvent]`: one message for each camera and image | sensor-daemon | none |
//! | `radar` | `RadarScan`, `[RadarDetection]`: one message for each radar and scan | sensor-daemon | none |
//! | `lane-position` | SUMO's time, `[LanePosition]` | traffic-bridge | none |
//! | `control` | [`control::ControlRequest`] → [`control::ControlReply`] | supervisor | traffic-bridge |
//! | `board` | [`board::Progress`], [`board::Health`], [`board::TrainingStatus`], [`activity::Activity`] | every process | none (newest wins) |
//! | `roster` | [`board::Roster`]: the current incarnation of each process | supervisor | none (newest wins) |
//! | `wake` | an event without content | every peer | its process |
//!
//! The first fifteen are [`channel::CHANNELS`]. `recorder` is a required consumer where a run records without loss. In the driving task
//! sim-core waits for each `prediction`.
//!
//! Every message has a [`header::MessageHeader`]. The supervisor alone creates the services, in [`services`]; all other processes
//! open them. `layout.json` holds the layouts, and tests in Rust and Python compare it with the programs.

pub mod activity;
pub mod block;
pub mod board;
mod board_port;
pub mod channel;
pub mod clock;
pub mod config;
pub mod control;
mod control_port;
pub mod digest;
pub mod ego;
pub mod episode_state;
pub mod event;
pub mod failure;
pub mod field;
pub mod flow;
pub mod header;
pub mod image;
pub mod lane_position;
pub mod layout;
pub mod membership;
pub mod metric;
pub mod neighbours;
pub mod observation;
pub mod pointcloud;
pub mod ports;
pub mod prediction;
pub mod process;
pub mod process_main;
pub mod props;
pub mod radar;
mod required_consumers;
pub mod reserve;
pub mod run;
pub mod schedule;
pub mod scheduling;
pub mod section;
pub mod sensor;
pub mod services;
pub mod storage;
pub mod traffic;
pub mod usage;
pub mod world;

// What the tests of this crate share names it as other crates do.
#[cfg(test)]
extern crate self as ipc_schema;

/// Version of every payload and of the run file; raised when any of them changes.
pub const SCHEMA_VERSION: u32 = 30;
