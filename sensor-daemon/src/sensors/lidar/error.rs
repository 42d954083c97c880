//! Errors that prevent a LIDAR from being built.

use std::path::PathBuf;

use ipc_schema::{
    failure::{Failure, FailureKind},
    props::PROPS,
};

/// The LIDAR of the configuration cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum LidarError {
    /// No such pattern.
    #[error("`lidar.pattern` = \"{name}\" is no known pattern")]
    Pattern {
        /// The configured name.
        name: String,
    },
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
    /// An entry of `scene.meshes` cannot be understood.
    #[error("`scene.meshes`: \"{text}\" is not \"file.obj x y\" or \"file.obj x y heading\" with plain numbers")]
    MeshEntry {
        /// The entry.
        text: String,
    },
    /// A mesh cannot be used.
    #[error("{path}: no usable mesh: {reason}")]
    Mesh {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// `lidar.interest_props` names a prop that does not exist.
    #[error("`lidar.interest_props`: \"{name}\" names no known prop")]
    Prop {
        /// The configured name.
        name: String,
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
    pub fn help(&self) -> String {
        match self {
            Self::Pattern { .. } => format!("the patterns are {}", ipc_schema::config::LidarConfig::PATTERNS.join(", ")),
            Self::Unreadable { .. } => "check the path and its permissions".into(),
            Self::Table { .. } | Self::NoRays { .. } => {
                "write a header `azimuth_deg,elevation_deg` and a line for each ray, for example `12.5,-3.0`".into()
            }
            Self::MeshEntry { .. } => {
                "write \"house.obj 120.5 80 90\": x and y in metres (world), heading in degrees counter-clockwise from east"
                    .into()
            }
            Self::Mesh { .. } => "give a Wavefront OBJ with faces, in metres, z up".into(),
            Self::Prop { .. } => {
                let names: Vec<_> = PROPS.iter().map(|prop| prop.name).collect();
                format!("the props are {}", names.join(", "))
            }
            Self::Rotation { .. } => "choose a whole number of rotations in a tick, or of ticks in a rotation".into(),
        }
    }
}

impl From<LidarError> for Failure {
    fn from(error: LidarError) -> Self {
        Self::from_error(FailureKind::Config, &error).with_help(error.help())
    }
}
