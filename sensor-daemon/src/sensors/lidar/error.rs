//! Errors that prevent a LIDAR from being built.

use std::path::PathBuf;

use ipc_schema::failure::{Failure, FailureKind};

/// The LIDAR of the configuration cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum LidarError {
    /// The pattern is a table, and none is named.
    #[error("`lidar.pattern` = \"table\" without a table")]
    NoTable,
    /// A file cannot be read.
    #[error("cannot read {path}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// A line of the ray table cannot be used.
    #[error("{path}, line {line}: {reason}")]
    Table {
        /// The file.
        path: PathBuf,
        /// Line in it.
        line: u64,
        /// Why.
        reason: String,
    },
    /// The ray table has no rays.
    #[error("{path}: the ray table holds no rays")]
    NoRays {
        /// The file.
        path: PathBuf,
    },
    /// A mesh cannot be used.
    #[error("{path}: no usable mesh: {reason}")]
    Mesh {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// Neither rotation nor tick is a whole number of the other, or a tick has less than one column.
    #[error("`lidar.rotation_hz` = {rotation_hz} with a tick of {tick_s} s: neither is a whole number of the other")]
    Rotation {
        /// Rotations per second.
        rotation_hz: f64,
        /// Length of the tick, seconds.
        tick_s: f64,
    },
}

impl LidarError {
    /// The remedy to show to the user.
    #[must_use]
    pub fn help(&self) -> &'static str {
        match self {
            Self::NoTable => "name a CSV file in lidar.ray_table, or another pattern",
            Self::Unreadable { .. } => "check the path and its permissions",
            Self::Table { .. } | Self::NoRays { .. } => {
                "write a header `azimuth_deg,elevation_deg` and a line for each ray, for example `12.5,-3.0`"
            }
            Self::Mesh { .. } => "give a Wavefront OBJ with faces, in metres, z up",
            Self::Rotation { .. } => "choose a whole number of rotations in a tick, or of ticks in a rotation",
        }
    }
}

impl From<LidarError> for Failure {
    fn from(error: LidarError) -> Self {
        Self::from_error(FailureKind::Config, &error).with_help(error.help())
    }
}
