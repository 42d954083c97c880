//! Everything that crosses a process border, and nothing else: payloads, the service table, flow control, the run file.
//!
//! | service       | payload (64-byte aligned bytes, little endian)                    | producer       | required consumer |
//! |---------------|-------------------------------------------------------------------|----------------|-------------------|
//! | `traffic`     | `[TrafficState]`                                                  | traffic-bridge | sim-core          |
//! | `traffic-meta`| [`traffic::TrafficMetaLayout`]: `[VehicleMeta]`, `[SignalMeta]`; or `[RoutePoint]` | traffic-bridge | sim-core          |
//! | `world`       | [`world::WorldLayout`]: `[VehicleState]`, `[SubStep]`, `[HeroView]` | sim-core       | sensor-daemon     |
//! | `observation` | [`observation::ObservationLayout`]: obs, truth, GNSS, slots       | sensor-daemon  | trainer           |
//! | `prediction`  | [`prediction::PredictionLayout`]: one row for each slot of the observation | trainer | none; sim-core when it drives |
//! | `ego-pose`    | `[EgoPose]`                                                       | sim-core       | traffic-bridge    |
//! | `event`       | `[Collision]`                                                     | sim-core       | none              |
//! | `census`      | as `traffic-meta`: everybody and every light, each simulated second | traffic-bridge | none              |
//! | `switch`      | `[SensorSwitch]`, from the tick in the header on                  | traffic-bridge | sensor-daemon     |
//! | `control`     | [`control::ControlRequest`] → [`control::ControlReply`]           | supervisor     | traffic-bridge    |
//! | `board`       | [`board::Progress`], [`board::Health`], [`board::TrainingStatus`] | every process  | none (newest wins)|
//! | `roster`      | [`board::Roster`]: the incarnation of each process that counts    | supervisor     | none (newest wins)|
//! | `wake`        | an event without content                                          | every peer     | its process       |
//!
//! Every message carries a [`header::MessageHeader`]. Services are created in [`services`] by the supervisor alone;
//! every other process opens them there. The layouts are written down in `layout.json` and asserted from Rust and Python.

pub mod block;
pub mod board;
mod board_port;
pub mod clock;
pub mod config;
pub mod control;
mod control_port;
pub mod ego;
pub mod event;
pub mod failure;
pub mod field;
pub mod flow;
pub mod header;
pub mod layout;
pub mod metric;
pub mod observation;
pub mod pointcloud;
pub mod ports;
pub mod prediction;
pub mod process;
pub mod props;
pub mod run;
pub mod schedule;
pub mod scheduling;
pub mod sensor;
pub mod services;
pub mod session;
pub mod traffic;
pub mod usage;
pub mod world;

/// Version of every payload and of the run file; raised when any of them changes.
pub const SCHEMA_VERSION: u32 = 13;
