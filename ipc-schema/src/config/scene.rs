//! The surface of the road, and the objects beside it.

use std::{fmt, path::PathBuf, str::FromStr};

use serde::{Deserialize, Serialize};

use super::text::{finite_numbers, serde_as_text};
use crate::props::Obstacle;

/// Surface of the road.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Surface {
    /// Dry asphalt.
    Dry,
    /// Wet asphalt.
    Wet,
    /// Snow.
    Snow,
}

/// The road.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoadConfig {
    /// The surface, which decides the friction.
    pub surface: Surface,
}

/// Objects beside the road and on it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneConfig {
    /// Obstacles.
    pub obstacles: Vec<Obstacle>,
    /// Props placed at random beside the road, the same for the same `run.seed`.
    pub random_props: u32,
    /// Height of a building whose polygon and type state none, metres.
    pub building_height_m: f64,
    /// Triangle meshes. LIDARs see them; traffic and collisions do not.
    pub meshes: Vec<MeshPlacement>,
}

/// A triangle mesh and its place. Configurations and run files write it as "file x y heading"; the heading may be left out.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshPlacement {
    /// A Wavefront OBJ.
    pub file: PathBuf,
    /// x and y of its origin, which stands on the ground, metres, world.
    pub origin_m: [f64; 2],
    /// Heading, counter-clockwise from east, degrees.
    pub heading_deg: f64,
}

/// The text is not a mesh with its position.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is not \"file.obj x y\" or \"file.obj x y heading\" with plain numbers")]
pub struct MeshPlacementError(pub String);

serde_as_text!(MeshPlacement);

impl FromStr for MeshPlacement {
    type Err = MeshPlacementError;

    fn from_str(text: &str) -> Result<Self, MeshPlacementError> {
        let malformed = || MeshPlacementError(text.to_owned());
        let mut words = text.split_whitespace();
        let file = words.next().ok_or_else(malformed)?;
        let (origin_m, heading_deg) = match finite_numbers(words).as_deref() {
            Some([x_m, y_m]) => ([*x_m, *y_m], 0.0),
            Some([x_m, y_m, heading_deg]) => ([*x_m, *y_m], *heading_deg),
            _ => return Err(malformed()),
        };
        Ok(Self {
            file: file.into(),
            origin_m,
            heading_deg,
        })
    }
}

impl fmt::Display for MeshPlacement {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (file, [x_m, y_m], heading_deg) = (self.file.display(), self.origin_m, self.heading_deg);
        write!(formatter, "{file} {x_m} {y_m} {heading_deg}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mesh_is_a_file_with_its_place_and_comes_back_from_json() {
        let mesh: MeshPlacement = serde_json::from_str("\" a/house.obj  5 -2e1\"").unwrap();
        assert_eq!((mesh.origin_m, mesh.heading_deg), ([5.0, -20.0], 0.0));
        let text = serde_json::to_string(&mesh).unwrap();
        assert_eq!(text, "\"a/house.obj 5 -20 0\"");
        assert_eq!(serde_json::from_str::<MeshPlacement>(&text).unwrap(), mesh);
        for text in [
            "",
            "house.obj",
            "house.obj 1",
            "house.obj 1 x",
            "house.obj 1 2 3 4",
            "house.obj NaN 2",
        ] {
            assert_eq!(text.parse::<MeshPlacement>(), Err(MeshPlacementError(text.to_owned())));
        }
    }
}
