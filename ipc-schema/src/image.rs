//! `image`: one image of one camera.
//!
//! One message for each camera and each image. The payload is one [`ImageHead`], the planes
//! that the configuration wants, the road users in the image, and the events of a dynamic vision sensor.

use bytemuck::{Pod, Zeroable};

use crate::{config::CameraConfig, section::payload_layout};

/// `instance` of a pixel that sees the sky.
pub const SKY_INSTANCE: u32 = u32::MAX - 1;
/// Most road users that an image lists: the first of them.
pub const MOST_SEEN: usize = 512;
/// Most events of an image for each of its pixels: the first of them.
pub const EVENTS_PER_PIXEL: usize = 2;

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
    /// `u16`: apparent temperature in the thermal infrared (8 to 14 µm), hundredths of a kelvin.
    Infrared = 5,
    /// `f32 [2]`: optical flow, pixels to the right and down: how far what the pixel shows has moved in the image within
    /// `camera.period_s`. Not a number where it was not in front of the camera then.
    Flow = 6,
}

impl ImagePlane {
    /// Every plane, in the order in which a message has them: those with the widest numbers come first, so that all are aligned.
    pub const ALL: [Self; 7] = [
        Self::Depth,
        Self::Instance,
        Self::Flow,
        Self::Infrared,
        Self::Semantic,
        Self::Rgb,
        Self::Binary,
    ];

    /// Bit in [`ImageHead::planes`].
    #[must_use]
    pub const fn bit(self) -> u32 {
        1 << self as u32
    }

    /// Name for readers in other languages.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Depth => "depth_m",
            Self::Instance => "instance",
            Self::Semantic => "semantic",
            Self::Rgb => "rgb",
            Self::Binary => "binary",
            Self::Infrared => "infrared",
            Self::Flow => "flow_px",
        }
    }

    /// Numpy's name of the scalar, and how many of them a pixel has.
    #[must_use]
    pub const fn pixel(self) -> (&'static str, usize) {
        match self {
            Self::Depth => ("<f4", 1),
            Self::Instance => ("<u4", 1),
            Self::Semantic | Self::Binary => ("|u1", 1),
            Self::Rgb => ("|u1", 3),
            Self::Infrared => ("<u2", 1),
            Self::Flow => ("<f4", 2),
        }
    }

    /// Bytes of a pixel.
    #[must_use]
    pub const fn pixel_bytes(self) -> usize {
        let (scalar, count) = self.pixel();
        // The name ends with the bytes of the scalar.
        (scalar.as_bytes()[2] - b'0') as usize * count
    }

    /// True if a configuration wants it.
    #[must_use]
    pub const fn is_wanted(self, camera: &CameraConfig) -> bool {
        match self {
            Self::Depth => camera.depth,
            Self::Instance => camera.instance,
            Self::Semantic => camera.semantic,
            Self::Rgb => camera.rgb,
            Self::Binary => camera.binary,
            Self::Infrared => camera.infrared,
            Self::Flow => camera.flow,
        }
    }

    /// Bits of the planes that a configuration wants.
    #[must_use]
    pub fn wanted(camera: &CameraConfig) -> u32 {
        let wanted = Self::ALL.into_iter().filter(|plane| plane.is_wanted(camera));
        wanted.fold(0, |bits, plane| bits | plane.bit())
    }

    /// Bytes of all planes of an image.
    #[must_use]
    pub fn bytes(camera: &CameraConfig) -> usize {
        let wanted = Self::wanted(camera);
        let of_pixel = Self::ALL.into_iter().filter(|plane| plane.bit() & wanted != 0);
        of_pixel.map(Self::pixel_bytes).sum::<usize>() * camera.pixels()
    }
}

/// Most events of an image of this camera.
#[must_use]
pub fn most_events(camera: &CameraConfig) -> usize {
    if camera.events {
        EVENTS_PER_PIXEL * camera.pixels()
    } else {
        0
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
    /// Events that the message has no room for: the last of the tick.
    pub lost_events: u32,
    /// Lens distortion: k1, k2, p1, p2, k3 of Brown's model, as in OpenCV; zeros of a pinhole.
    pub distortion: [f32; 5],
    /// From the readout of the first row to that of the last one, which is the end of the tick, seconds; 0 of a global shutter.
    pub readout_s: f32,
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

/// An event of a dynamic vision sensor: the brightness of a pixel has changed by `camera.event_threshold`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
pub struct BrightnessEvent {
    /// Since the begin of the tick, microseconds.
    pub time_us: u32,
    /// Column.
    pub x: u16,
    /// Row.
    pub y: u16,
    /// 1 brighter, −1 darker.
    pub polarity: i32,
}

payload_layout! {
    /// Layout of an `image` message.
    ImageLayout(object_count, images, plane_bytes, event_count) {
        /// `ImageHead [1]`.
        head: ImageHead, [images];
        /// The planes, one after the other.
        planes: u8, [plane_bytes];
        /// `SeenObject [count]`.
        objects: SeenObject, [object_count];
        /// `BrightnessEvent [count]`, in the order of time, row and column.
        events: BrightnessEvent, [event_count];
    }
}

impl ImageLayout {
    /// Layout for `objects` road users, `plane_bytes` bytes of planes and `events` events.
    #[must_use]
    pub fn new(objects: usize, plane_bytes: usize, events: usize) -> Self {
        Self::sized(objects, 1, plane_bytes, events)
    }
}
