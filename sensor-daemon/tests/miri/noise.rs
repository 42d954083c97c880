//! The room of the noise generators.

#[path = "../../src/noise/normals.rs"]
pub mod normals;

pub use normals::philox4x32;
