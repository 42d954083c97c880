//! The table of the surfaces of an image: what a pixel that sees a surface shows.

use super::{
    labels::SemanticLabel,
    light::Daylight,
    raster::{GROUND_SURFACE, SKY_SURFACE},
};
use ipc_schema::{image::SKY_INSTANCE, pointcloud::GROUND};

/// No road user.
pub(super) const NO_USER: u16 = u16::MAX;

/// A body.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenBody {
    /// Dense index of the road user, or `STATIC_OBJECT` and a number.
    pub(super) instance: u32,
    /// A [`SemanticLabel`].
    pub(super) label: u8,
    /// White in the binary image.
    pub(super) is_interesting: bool,
}

/// A surface of a body.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenSurface {
    pub(super) instance: u32,
    /// Place among the road users of the image.
    pub(super) user: u16,
    pub(super) label: u8,
    pub(super) is_interesting: bool,
    /// Red, green, blue in clear air.
    pub(super) colour: [f32; 3],
}

/// All surfaces that may be in an image.
#[derive(Debug, Default)]
pub(super) struct SurfaceTable {
    pub(super) surfaces: Vec<SeenSurface>,
    bodies: Vec<(SeenBody, u16)>,
    /// Row of each road user that may be in the image.
    pub(super) users: Vec<u32>,
    light: Option<Daylight>,
}

impl SurfaceTable {
    /// Empties the table; with `light`, surfaces get colours.
    pub(super) fn begin(&mut self, light: Option<Daylight>) {
        self.surfaces.clear();
        self.bodies.clear();
        self.users.clear();
        self.light = light;
        let ground = SeenSurface {
            instance: GROUND,
            user: NO_USER,
            label: SemanticLabel::Terrain as u8,
            is_interesting: false,
            colour: [0.0; 3],
        };
        let sky = SeenSurface {
            instance: SKY_INSTANCE,
            label: SemanticLabel::Sky as u8,
            colour: light.map_or([0.0; 3], |light| light.sky()),
            ..ground
        };
        const _: () = assert!(GROUND_SURFACE == 0 && SKY_SURFACE == 1);
        self.surfaces.extend([ground, sky]);
    }

    /// A body; surfaces name it by the returned number.
    #[inline(always)]
    pub(super) fn body(&mut self, body: SeenBody) -> u32 {
        self.bodies.push((body, NO_USER));
        self.bodies.len() as u32 - 1
    }

    /// Marks a body as the road user in `row`. Beyond 65 534 of them an image has no boxes.
    #[inline(always)]
    pub(super) fn road_user(&mut self, body: u32, row: u32) {
        if self.users.len() < usize::from(NO_USER) {
            self.bodies[body as usize].1 = self.users.len() as u16;
            self.users.push(row);
        }
    }

    /// A surface of a body with this outward normal in the world. Returns its number.
    #[inline(always)]
    pub(super) fn surface(&mut self, body: u32, normal: [f64; 3]) -> u32 {
        let (body, user) = self.bodies[body as usize];
        let colour = match &self.light {
            Some(light) => light.on_body(body.instance, body.label, normal),
            None => [0.0; 3],
        };
        self.surfaces.push(SeenSurface {
            instance: body.instance,
            user,
            label: body.label,
            is_interesting: body.is_interesting,
            colour,
        });
        self.surfaces.len() as u32 - 1
    }
}
