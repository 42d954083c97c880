//! Frames of `image`: the whole message if it fits; else one plane without events, and of that one pixel of each block of k × k.

use bytemuck::bytes_of;
use ipc_schema::{
    block::{Section, view},
    header::MessageHeader,
    image::{ImageHead, ImageLayout, ImagePlane, SeenObject},
};

use super::{EncodedFrame, FrameError, HEADER_BYTES, MAX_SENSOR_BYTES};

/// A frame that cannot have every plane has the first of these that the image has, else the first of [`ImagePlane::ALL`].
const PREFERRED: [ImagePlane; 5] = [
    ImagePlane::Rgb,
    ImagePlane::Semantic,
    ImagePlane::Infrared,
    ImagePlane::Depth,
    ImagePlane::Binary,
];

/// Encodes an image; `left_out` of the frame is the number of bytes of planes that it does not have.
///
/// # Errors
/// The payload is shorter than its header promises, or its planes do not have the image's size.
pub(super) fn encode_image(header: &MessageHeader, payload: &[u8]) -> Result<EncodedFrame, FrameError> {
    let layout = ImageLayout::of(header);
    let heads: &[ImageHead] = view(payload, layout.head)?;
    let planes: &[u8] = view(payload, layout.planes)?;
    let objects: &[SeenObject] = view(payload, layout.objects)?;
    let [head] = heads else {
        return Err(FrameError::Image);
    };
    let pixels = (head.width as usize).saturating_mul(head.height as usize);
    let promised: usize = planes_of(head)
        .map(|plane| pixels.saturating_mul(plane.pixel_bytes()))
        .fold(0, usize::saturating_add);
    if promised != planes.len() {
        return Err(FrameError::Image);
    }
    if HEADER_BYTES + layout.len <= MAX_SENSOR_BYTES {
        let whole = view::<u8>(
            payload,
            Section {
                offset: 0,
                len: layout.len,
            },
        )?;
        return Ok(EncodedFrame {
            bytes: [bytes_of(header), whole].concat(),
            left_out: 0,
        });
    }
    let Some(plane) = PREFERRED
        .into_iter()
        .chain(ImagePlane::ALL)
        .find(|plane| head.planes & plane.bit() != 0)
    else {
        return Err(FrameError::TooLong(HEADER_BYTES + layout.len));
    };
    let before: usize = planes_of(head)
        .take_while(|earlier| *earlier != plane)
        .map(|earlier| pixels * earlier.pixel_bytes())
        .sum();
    let of_plane = &planes[before..before + pixels * plane.pixel_bytes()];
    let factor = smallest_factor(head, plane, objects.len());
    let kept = pixels_of_blocks(of_plane, head, plane, factor);
    Ok(EncodedFrame {
        left_out: planes.len() - kept.len(),
        bytes: reduced(header, head, plane, factor, &kept, objects),
    })
}

/// The planes that an image has, in the order of its message.
fn planes_of(head: &ImageHead) -> impl Iterator<Item = ImagePlane> {
    let planes = head.planes;
    ImagePlane::ALL
        .into_iter()
        .filter(move |plane| plane.bit() & planes != 0)
}

/// Columns and rows of an image with one pixel for each block of `factor` × `factor`.
fn reduced_size(head: &ImageHead, factor: u32) -> [u32; 2] {
    [head.width, head.height].map(|size| (size / factor).max(1))
}

/// The smallest factor by which an image of this plane and `objects` road users fits into a frame.
fn smallest_factor(head: &ImageHead, plane: ImagePlane, objects: usize) -> u32 {
    let fits = |factor: &u32| {
        let [width, height] = reduced_size(head, *factor).map(|size| size as usize);
        HEADER_BYTES + ImageLayout::new(objects, width * height * plane.pixel_bytes(), 0).len <= MAX_SENSOR_BYTES
    };
    let most = head.width.max(head.height).max(1);
    (1..most).find(fits).unwrap_or(most)
}

/// The pixel amid each block of `factor` × `factor` pixels, row by row.
fn pixels_of_blocks(pixels: &[u8], head: &ImageHead, plane: ImagePlane, factor: u32) -> Vec<u8> {
    let [width, height] = reduced_size(head, factor);
    let amid = |block: u32, size: u32| (block * factor + factor / 2).min(size - 1) as usize;
    let mut kept = Vec::with_capacity(width as usize * height as usize * plane.pixel_bytes());
    for row in 0..height {
        let first = amid(row, head.height) * head.width as usize;
        for column in 0..width {
            let start = (first + amid(column, head.width)) * plane.pixel_bytes();
            kept.extend_from_slice(&pixels[start..start + plane.pixel_bytes()]);
        }
    }
    kept
}

/// The frame of an image that has one plane and a `factor`-th of the columns and rows; everything in pixels is in pixels of that image.
fn reduced(
    header: &MessageHeader,
    head: &ImageHead,
    plane: ImagePlane,
    factor: u32,
    pixels: &[u8],
    objects: &[SeenObject],
) -> Vec<u8> {
    let [width, height] = reduced_size(head, factor);
    let head = ImageHead {
        width,
        height,
        planes: plane.bit(),
        focal_px: head.focal_px / factor as f32,
        ..*head
    };
    let objects: Vec<SeenObject> = objects.iter().map(|object| in_blocks(object, factor)).collect();
    let layout = ImageLayout::new(objects.len(), pixels.len(), 0);
    let header = MessageHeader {
        shape: layout.shape,
        ..*header
    };
    let mut bytes = bytes_of(&header).to_vec();
    bytes.resize(HEADER_BYTES + layout.len, 0);
    for (section, content) in [
        (layout.head, bytes_of(&head)),
        (layout.planes, pixels),
        (layout.objects, bytemuck::cast_slice(&objects)),
    ] {
        let start = HEADER_BYTES + section.offset;
        bytes[start..start + section.len].copy_from_slice(content);
    }
    bytes
}

/// A road user with its boxes and its size in blocks of `factor` × `factor` pixels.
fn in_blocks(object: &SeenObject, factor: u32) -> SeenObject {
    let of_edge = |edge: u16| u16::try_from(u32::from(edge) / factor).unwrap_or(u16::MAX);
    SeenObject {
        visible_px: object.visible_px.div_ceil(factor.saturating_mul(factor)),
        visible_box_px: object.visible_box_px.map(of_edge),
        full_box_px: object.full_box_px.map(|edge| edge / factor as f32),
        ..*object
    }
}
