//! `image`: one image of one camera.
//!
//! One message for each camera and each image. The payload is one [`ImageHead`], the planes
//! that the configuration wants, and the road users in the image.

use bytemuck::{Pod, Zeroable};

use crate::{config::CameraConfig, section::payload_layout};

/// `instance` of a pixel that sees the sky.
pub const SKY_INSTANCE: u32 = u32::MAX - 1;
/// Most road users that an image lists: the first of them.
pub const MOST_SEEN: usize = 512;

/// A plane of an image: one value for each pixel, row by row from the upper left corner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum ImagePlane {
    /// `f32`: distance along the optical axis, metres; `range_m` where the camera sees the sky.
    Depth = 0,
    /// `u32`: dense index of the road user; [`crate::pointcloud::STATIC_OBJECT`] and a number; [`crate::pointcloud::GROUND`]; or
    /// [`SKY_INSTANCE`].
    Instance = 1,
    /// `u8`: class, the label ids of the CityScapes data set and more (docs/camera.md).
    Semantic = 2,
    /// `u8 [3]`: red, green, blue.
    Rgb = 3,
    /// `u8`: 255 on road users and props of interest, else 0.
    Binary = 4,
}

impl ImagePlane {
    /// Every plane, in the order in which a message has them.
    pub const ALL: [Self; 5] = [Self::Depth, Self::Instance, Self::Semantic, Self::Rgb, Self::Binary];

    /// Bit in [`ImageHead::planes`].
    #[must_use]
    pub const fn bit(self) -> u32 {
        1 << self as u32
    }

    /// Bytes of a pixel.
    #[must_use]
    pub const fn pixel_bytes(self) -> usize {
        match self {
            Self::Depth | Self::Instance => 4,
            Self::Semantic | Self::Binary => 1,
            Self::Rgb => 3,
        }
    }

    /// Bits of the planes that a configuration wants.
    #[must_use]
    pub fn wanted(camera: &CameraConfig) -> u32 {
        let wants = [
            camera.depth,
            camera.instance,
            camera.semantic,
            camera.rgb,
            camera.binary,
        ];
        let wanted = Self::ALL.into_iter().zip(wants).filter(|(_, is_wanted)| *is_wanted);
        wanted.fold(0, |bits, (plane, _)| bits | plane.bit())
    }

    /// Bytes of all planes of an image.
    #[must_use]
    pub fn bytes(camera: &CameraConfig) -> usize {
        let wanted = Self::wanted(camera);
        let of_pixel = Self::ALL.into_iter().filter(|plane| plane.bit() & wanted != 0);
        of_pixel.map(Self::pixel_bytes).sum::<usize>() * camera.pixels()
    }
}

/// Pose and parameters of an image.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct ImageHead {
    /// Camera at the end of the tick, world, metres.
    pub position_m: [f64; 3],
    /// Roll, pitch (nose up) and heading (counter-clockwise from east) of the optical axis, radians.
    pub attitude_rad: [f64; 3],
    /// Hash of the vehicle's SUMO id.
    pub id_hash: u64,
    /// Dense index of the vehicle within the episode, or [`crate::pointcloud::ROADSIDE_CARRIER`] and a number.
    pub vehicle: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bits of the planes in the message: [`ImagePlane::bit`].
    pub planes: u32,
    /// Distance of the pinhole from the image, pixels.
    pub focal_px: f32,
    /// Depth at which the image ends, metres.
    pub range_m: f32,
    /// Number of the camera among those of the run ([`crate::config::SensorUnit`]).
    pub sensor: u32,
    /// Zero.
    pub reserved: u32,
}

/// A road user of which an image shows a pixel at least, with the fields of KITTI's labels.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct SeenObject {
    /// Dense index of the road user.
    pub object: u32,
    /// Its class, as in the plane of classes.
    pub label: u32,
    /// Pixels that show it.
    pub visible_px: u32,
    /// Left, top, right and bottom pixel that show it.
    pub visible_box_px: [u16; 4],
    /// Left, top, right and bottom of the whole of it, hidden parts and parts beyond the image included, pixels from the upper left corner.
    pub full_box_px: [f32; 4],
    /// Share of the full box that is beyond the image.
    pub truncated: f32,
    /// Least and largest depth of its corners, metres.
    pub depth_m: [f32; 2],
}

payload_layout! {
    /// Layout of an `image` message.
    ImageLayout(object_count, images, plane_bytes) {
        /// `ImageHead [1]`.
        head: ImageHead, [images];
        /// The planes, one after the other.
        planes: u8, [plane_bytes];
        /// `SeenObject [count]`.
        objects: SeenObject, [object_count];
    }
}

impl ImageLayout {
    /// Layout for `objects` road users and `plane_bytes` bytes of planes.
    #[must_use]
    pub fn new(objects: usize, plane_bytes: usize) -> Self {
        Self::sized(objects, 1, plane_bytes)
    }
}
