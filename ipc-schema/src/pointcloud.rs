//! `pointcloud`: the returns of one LIDAR in a tick.
//!
//! One message for each LIDAR and each tick. The payload is one [`Scan`], then the points.

use bytemuck::{Pod, Zeroable};

use crate::section::payload_layout;

/// Kind of the surface that a point lies on. Values are stable; new ones are added at the end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u16)]
pub enum Tag {
    /// The ground.
    Ground = 0,
    /// A building, or a part of one.
    Building = 1,
    /// A wall or fence.
    Wall = 2,
    /// Towers, silos, tanks.
    Structure = 3,
    /// A vehicle of the traffic, connected or not, and heroes.
    Vehicle = 4,
    /// A vehicle with two wheels.
    TwoWheeler = 5,
    /// A pedestrian.
    Person = 6,
    /// Cones, bollards, barriers.
    Barrier = 7,
    /// Benches, bins, boxes, shelters.
    Furniture = 8,
    /// Lamp posts and signs.
    Pole = 9,
    /// Trees.
    Vegetation = 10,
    /// A vehicle that never moves.
    ParkedVehicle = 11,
    /// Loads that fell off a lorry.
    Load = 12,
    /// A triangle mesh of `scene.meshes`, or ground that is not flat.
    Mesh = 13,
}

/// `object` of a point that belongs to no road user: its top bit is set, the rest is the number of the building, prop or mesh.
pub const STATIC_OBJECT: u32 = 1 << 31;
/// `object` of a point on the ground.
pub const GROUND: u32 = u32::MAX;

/// `vehicle` of a sensor beside the road: this bit, and the place of its carrier among `[[roadside]]`. Its `id_hash` is that of the
/// carrier's name.
pub const ROADSIDE_CARRIER: u32 = 1 << 30;

/// One return.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct LidarPoint {
    /// Position in the sensor's axes (`lidar.axes`) at the time of firing, metres, with range noise.
    pub position_m: [f32; 3],
    /// Intensity after attenuation, 0 … 1.
    pub intensity: f32,
    /// Dense index of the road user, or [`STATIC_OBJECT`] and a number, or [`GROUND`].
    pub object: u32,
    /// Cosine of the angle between the ray and the surface's normal, 0 … 1.
    pub incidence_cos: f32,
    /// A [`Tag`].
    pub tag: u16,
    /// Number of the laser; 0 is the lowest.
    pub channel: u16,
    /// Time from firing to the end of the tick, microseconds.
    pub age_us: u32,
}

/// Pose and parameters of one scan. The pose transforms its points into the world.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct Scan {
    /// Sensor at the end of the tick, world, metres.
    pub position_m: [f64; 3],
    /// Roll, pitch (nose up) and heading (counter-clockwise from east) of the sensor at the end of the tick, radians.
    pub attitude_rad: [f64; 3],
    /// Hash of the vehicle's SUMO id.
    pub id_hash: u64,
    /// First azimuth of the tick, radians counter-clockwise from the sensor's x axis, in [0, 2π).
    pub azimuth_rad: f32,
    /// Farthest return, metres.
    pub range_m: f32,
    /// Rays fired.
    pub rays: u32,
    /// 1 for the paper's axes, 0 for x forward.
    pub axes: u32,
    /// Dense index of the vehicle within the episode, or [`ROADSIDE_CARRIER`] and a number.
    pub vehicle: u32,
    /// Azimuths fired.
    pub azimuths: u32,
    /// Number of the LIDAR among those of the run ([`crate::config::SensorUnit`]).
    pub sensor: u32,
    /// Zero.
    pub reserved: u32,
}

payload_layout! {
    /// Layout of a `pointcloud` message.
    PointcloudLayout(point_count, scans) {
        /// `Scan [1]`.
        scan: Scan, [scans];
        /// `LidarPoint [count]`.
        points: LidarPoint, [point_count];
    }
}

impl PointcloudLayout {
    /// Layout for `count` points.
    #[must_use]
    pub fn new(count: usize) -> Self {
        Self::sized(count, 1)
    }
}
