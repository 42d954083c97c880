//! The room of the sensors: the kernels are visible within it.

#[cfg(test)]
mod kernels;
#[path = "../../src/sensors/lidar/simd/mod.rs"]
pub mod simd;
