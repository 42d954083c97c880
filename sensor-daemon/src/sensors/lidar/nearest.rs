//! The nearest objects of a scan, for the observation.

use ipc_schema::pointcloud::{LidarPoint, Tag};

use super::LidarModel;

/// Objects in the observation.
const OBJECTS: usize = 4;
/// Tags of road users and props.
const OF_INTEREST: u32 = 1 << Tag::Vehicle as u32
    | 1 << Tag::TwoWheeler as u32
    | 1 << Tag::Person as u32
    | 1 << Tag::Barrier as u32
    | 1 << Tag::Furniture as u32
    | 1 << Tag::Pole as u32
    | 1 << Tag::Vegetation as u32
    | 1 << Tag::ParkedVehicle as u32
    | 1 << Tag::Load as u32;

/// An object and its nearest point.
#[derive(Debug, Clone, Copy)]
struct Nearest {
    object: u32,
    square: f32,
    place_m: [f32; 2],
}

/// The nearest point of each of the four nearest road users and props in a scan of `lidar`, nearest first: forward and left of the
/// carrier's rear axle, metres, at the time each point was fired. `[range, range]` stands for no object.
#[must_use]
pub fn nearest_objects(points: &[LidarPoint], lidar: &LidarModel) -> [[f32; 2]; OBJECTS] {
    let none = Nearest {
        object: 0,
        square: f32::INFINITY,
        place_m: [lidar.range_m as f32; 2],
    };
    let mut nearest = [none; OBJECTS];
    for point in points {
        if OF_INTEREST >> (point.tag & 31) & 1 == 0 {
            continue;
        }
        let place_m = lidar.body_from_point(point);
        let square = place_m[0] * place_m[0] + place_m[1] * place_m[1];
        if square < nearest[OBJECTS - 1].square {
            insert(
                &mut nearest,
                Nearest {
                    object: point.object,
                    square,
                    place_m,
                },
            );
        }
    }
    nearest.map(|one| one.place_m)
}

/// Inserts a point that is nearer than the last one: it replaces the point of its own object, or the last one.
fn insert(nearest: &mut [Nearest; OBJECTS], new: Nearest) {
    let own = nearest
        .iter()
        .position(|one| one.square.is_finite() && one.object == new.object);
    let mut place = own.unwrap_or(OBJECTS - 1);
    if nearest[place].square <= new.square {
        return;
    }
    while place > 0 && nearest[place - 1].square > new.square {
        nearest[place] = nearest[place - 1];
        place -= 1;
    }
    nearest[place] = new;
}

impl LidarModel {
    /// Forward and left of the carrier's rear axle, metres.
    fn body_from_point(&self, point: &LidarPoint) -> [f32; 2] {
        let [x, y, z] = point.position_m.map(f64::from);
        let forward = if self.is_paper { [-y, x, -z] } else { [x, y, z] };
        let [ahead, left, _] = self.mount.body_from_point(forward);
        [ahead as f32, left as f32]
    }
}
