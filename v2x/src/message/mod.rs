//! Messages as bytes: unaligned packed encoding rules (UPER, ITU-T X.691) behind GeoNetworking and BTP headers.
//!
//! Only what is sent here is written; what is read may also have optional parts of the same version that are skipped. Bytes that are no
//! such message are an error, never a panic.

pub mod bsm;
pub mod cam;
pub mod cpm;
pub mod denm;
pub mod geonetworking;
mod its;
pub mod roadside_cam;
mod uper;
pub mod vam;
pub mod wsmp;

pub use its::{
    EPISODE_START_UNIX_S, GeodeticPoint, StationKind, generation_delta_ms, heading_from_yaw, its_time_ms,
    yaw_from_heading,
};

/// Bytes are not a message that this program reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    /// They end within a value.
    #[error("the message ends at bit {bit}, within a value")]
    Short {
        /// Number of bits there are.
        bit: usize,
    },
    /// A value is outside its range.
    #[error("{what}: a value of {found} is outside its range")]
    Range {
        /// The value.
        what: &'static str,
        /// As read.
        found: i64,
    },
    /// The message has a part that this program does not read.
    #[error("{what} {found} is not read")]
    Unsupported {
        /// The part.
        what: &'static str,
        /// Its number.
        found: u32,
    },
    /// Bytes follow the message.
    #[error("{bytes} bytes follow the message")]
    Trailing {
        /// How many.
        bytes: usize,
    },
}
