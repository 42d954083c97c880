//! The rays of a LIDAR.

use serde::{Deserialize, Serialize};

/// Rays of a LIDAR.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LidarPattern {
    /// `lidar.channels` lasers, evenly between two elevations.
    Uniform,
    /// Velodyne VLP-16.
    Vlp16,
    /// Velodyne HDL-32E.
    Hdl32e,
    /// Velodyne HDL-64E.
    Hdl64e,
    /// Hesai Pandar40P.
    Pandar40p,
    /// Ouster OS1 with 32 lasers.
    Os1_32,
    /// Ouster OS1 with 64 lasers.
    Os1_64,
    /// Ouster OS1 with 128 lasers.
    Os1_128,
    /// Velodyne VLS-128.
    Vls128,
    /// The rays of the file `lidar.ray_table`.
    Table,
}

impl LidarPattern {
    /// Every pattern's name in `lidar.pattern`.
    pub const NAMES: [&str; 10] = [
        "uniform",
        "vlp16",
        "hdl32e",
        "hdl64e",
        "pandar40p",
        "os1_32",
        "os1_64",
        "os1_128",
        "vls128",
        "table",
    ];

    /// Lasers that fire together, of a unit by name; `None`: the configuration or the table says how many.
    #[must_use]
    pub fn lasers(self) -> Option<u32> {
        match self {
            Self::Vlp16 => Some(16),
            Self::Hdl32e | Self::Os1_32 => Some(32),
            Self::Pandar40p => Some(40),
            Self::Hdl64e | Self::Os1_64 => Some(64),
            Self::Os1_128 | Self::Vls128 => Some(128),
            Self::Uniform | Self::Table => None,
        }
    }
}
