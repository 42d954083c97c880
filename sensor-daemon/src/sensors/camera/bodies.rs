//! Bodies around a camera as polygons and cylinders: buildings, props, road users.

use std::ops::Range;

use ipc_schema::{
    config::LidarConfig,
    pointcloud::{GROUND, Tag},
};
use sim_core::scene::{
    Scene,
    shape::{Point, cross, from_to},
};

use super::{
    flow::{PastPoses, PixelMotion},
    labels::SemanticLabel,
    raster::{GROUND_SURFACE, MOST_EDGES},
    surfaces::{SeenBody, SurfaceTable},
    view::{BodyBounds, CameraView, DrawList},
};
use crate::sensors::lidar::{
    Targets,
    sensor::SensorPose,
    solids::{INTEREST, StillSolid, StillSolids},
    targets::{MovingTarget, Pose, TickMoment},
};

/// Most boxes of a road user.
const MOST_BOXES: usize = 2;

/// The static bodies of a map.
#[derive(Debug)]
pub(super) struct StillBodies {
    solids: StillSolids,
    /// Roof of each solid as convex pieces: places among the corners of its outline.
    roofs: Vec<Range<u32>>,
    pieces: Vec<Vec<u32>>,
}

/// An upright box.
#[derive(Debug, Clone, Copy, Default)]
struct BodyBox {
    /// Corners, counter-clockwise from the front left.
    corners_m: [Point; 4],
    /// Unit vector ahead.
    along: Point,
    z_m: [f64; 2],
}

/// A road user at one time.
#[derive(Debug, Clone, Copy)]
pub(super) struct RoadUserBody {
    boxes: [BodyBox; MOST_BOXES],
    box_count: usize,
    /// It is a cylinder, which `bounds` describes.
    is_round: bool,
    bounds: BodyBounds,
    pub(super) body: SeenBody,
    pose: Pose,
}

/// The road users of a tick as cameras see them: one value serves all cameras.
#[derive(Debug, Clone, Default)]
pub struct CameraTargets {
    users: Vec<RoadUserBody>,
}

/// Shares of a car: height of its bonnet, and where its cabin ends and begins, from its rear.
const BONNET_SHARE: f64 = 0.55;
const CABIN_SHARES: [f64; 2] = [0.08, 0.72];
/// Shares of a lorry: where its cab begins, from its rear, and height of the cab.
const CAB_SHARE: f64 = 0.78;
const CAB_HEIGHT_SHARE: f64 = 0.85;

impl CameraTargets {
    /// Replaces the road users by those at the end of the tick of `targets`.
    pub fn update(&mut self, targets: &Targets) {
        self.users.clear();
        let road_users = &targets.movers[..targets.road_users];
        self.users
            .extend(road_users.iter().map(|mover| RoadUserBody::new(mover, mover.end)));
    }

    /// Replaces the road users by those at the end of a sub-step of the tick of `targets`.
    pub fn update_within(&mut self, targets: &Targets, sub_step: usize) {
        self.users.clear();
        let road_users = targets.movers[..targets.road_users].iter().enumerate();
        self.users
            .extend(road_users.map(|(row, mover)| RoadUserBody::new(mover, targets.pose(row, sub_step, 1.0, 0.0))));
    }

    /// The motion of a road user in the image since a moment of an earlier tick; `None` if it was not there.
    pub(super) fn motion(
        &self,
        row: usize,
        now: &SensorPose,
        past: &SensorPose,
        (poses, moment): (&PastPoses, Option<&TickMoment>),
    ) -> Option<PixelMotion> {
        let user = &self.users[row];
        let before = poses.of(user.body.instance, moment)?;
        Some(PixelMotion::of_body(now, past, &user.pose, &before, user.is_round))
    }

    /// Removes all road users.
    pub(super) fn clear(&mut self) {
        self.users.clear();
    }

    /// Adds a road user.
    pub(super) fn add(&mut self, user: RoadUserBody) {
        self.users.push(user);
    }

    /// Number of road users.
    #[must_use]
    pub fn len(&self) -> usize {
        self.users.len()
    }

    /// True without road users.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.users.is_empty()
    }
}

impl RoadUserBody {
    pub(super) fn new(mover: &MovingTarget, pose: Pose) -> Self {
        let (sin, cos) = libm::sincos(pose.attitude_rad[2]);
        let [x, y, z] = pose.position_m;
        let middle_m = 0.5 * (mover.rear_m + mover.front_m);
        let length_m = mover.front_m - mover.rear_m;
        let is_two_wheeler = mover.word & 0xFF == Tag::TwoWheeler as u32;
        let label = match mover.is_person {
            true => SemanticLabel::Person,
            false => SemanticLabel::of_vehicle(mover.class, is_two_wheeler, length_m, mover.height_m),
        };
        let part = |from: f64, to: f64, low: f64, high: f64| {
            let (rear, front) = (mover.rear_m + from * length_m, mover.rear_m + to * length_m);
            let half = mover.half_width_m;
            BodyBox {
                corners_m: [[front, half], [rear, half], [rear, -half], [front, -half]]
                    .map(|[ahead, left]| [x + ahead * cos - left * sin, y + ahead * sin + left * cos]),
                along: [cos, sin],
                z_m: [z + low * mover.height_m, z + high * mover.height_m],
            }
        };
        let (boxes, box_count) = match label {
            SemanticLabel::Car => {
                let [rear, front] = CABIN_SHARES;
                (
                    [part(0.0, 1.0, 0.0, BONNET_SHARE), part(rear, front, BONNET_SHARE, 1.0)],
                    2,
                )
            }
            SemanticLabel::Truck => (
                [
                    part(0.0, CAB_SHARE, 0.0, 1.0),
                    part(CAB_SHARE, 1.0, 0.0, CAB_HEIGHT_SHARE),
                ],
                2,
            ),
            _ => ([part(0.0, 1.0, 0.0, 1.0), BodyBox::default()], 1),
        };
        let middle_m = if mover.is_person { 0.0 } else { middle_m };
        Self {
            boxes,
            box_count,
            is_round: mover.is_person,
            bounds: BodyBounds {
                centre_m: [x + middle_m * cos, y + middle_m * sin],
                radius_m: mover.radius_m,
                z_m: [z, z + mover.height_m],
            },
            body: SeenBody {
                instance: mover.object,
                label: label as u8,
                is_interesting: true,
            },
            pose,
        }
    }

    /// Corners of its parts in the camera's frame, for the box about all of it.
    pub(super) fn corners(&self, view: &CameraView<'_>, mut found: impl FnMut([f64; 3])) {
        if self.is_round {
            let BodyBounds {
                centre_m: [x, y],
                radius_m: r,
                z_m,
            } = self.bounds;
            // The box about a cylinder: eight corners of an octagon about it.
            for turn in 0..16_u32 {
                let (sin, cos) = libm::sincos(std::f64::consts::TAU * f64::from(turn) / 16.0);
                view.upright([x + r * cos, y + r * sin], z_m)
                    .into_iter()
                    .for_each(&mut found);
            }
        }
        for part in self.boxes[..self.box_count].iter().filter(|_| !self.is_round) {
            for corner in part.corners_m {
                view.upright(corner, part.z_m).into_iter().for_each(&mut found);
            }
        }
    }
}

impl StillBodies {
    pub(super) fn new(lidar: &LidarConfig, scene: &Scene) -> Self {
        let solids = StillSolids::new(lidar, scene);
        let (mut roofs, mut pieces) = (Vec::with_capacity(solids.stills.len()), Vec::new());
        for still in &solids.stills {
            let first = pieces.len() as u32;
            let outline: Vec<Point> = solids.walls[range(still)].iter().map(|wall| wall.p_m).collect();
            pieces.extend(convex_pieces(&outline));
            roofs.push(first..pieces.len() as u32);
        }
        Self { solids, roofs, pieces }
    }

    /// Replaces `near` by the bodies that may be within `reach_m` of a place.
    pub(super) fn near(&self, place_m: Point, reach_m: f64, near: &mut Vec<u32>) {
        near.clear();
        self.solids
            .within(place_m, reach_m, |number, _| near.push(number as u32));
    }

    /// The cylinder about a body.
    #[inline(always)]
    pub(super) fn bounds(&self, number: u32) -> BodyBounds {
        let still = &self.solids.stills[number as usize];
        BodyBounds {
            centre_m: still.centre_m,
            radius_m: still.reach_m,
            z_m: still.z_m,
        }
    }

    /// Adds those of these bodies that a camera may see.
    #[inline(always)]
    pub(super) fn gather(&self, view: &CameraView<'_>, near: &[u32], list: &mut DrawList, surfaces: &mut SurfaceTable) {
        let [x, y, z] = view.pose.position_m;
        for number in near {
            if !view.may_see(&self.bounds(*number)) {
                continue;
            }
            let number = *number as usize;
            let still = &self.solids.stills[number];
            let is_deck = still.object == GROUND;
            let body = surfaces.body(SeenBody {
                instance: still.object,
                label: SemanticLabel::of_tag(still.word) as u8,
                is_interesting: still.word & INTEREST != 0,
            });
            let walls = &self.solids.walls[range(still)];
            for wall in walls {
                if wall.normal[0] * (wall.p_m[0] - x) + wall.normal[1] * (wall.p_m[1] - y) >= 0.0 {
                    continue;
                }
                let [p0, p1] = view.upright(wall.p_m, still.z_m);
                let [q0, q1] = view.upright(wall.q_m, still.z_m);
                let normal = [wall.normal[0], wall.normal[1], 0.0];
                let surface = surfaces.surface(body, normal);
                view.polygon(list, &[p0, q0, q1, p1], view.turned(normal), surface);
            }
            let (above, below) = (z > still.z_m[1], z < still.z_m[0]);
            if !above && !below {
                continue;
            }
            let surface = match is_deck && above {
                // The road is painted on it.
                true => GROUND_SURFACE,
                false => surfaces.surface(body, [0.0, 0.0, if above { 1.0 } else { -1.0 }]),
            };
            for piece in &self.pieces[self.roofs[number].start as usize..self.roofs[number].end as usize] {
                let corner = |place: u32| walls[place as usize].p_m;
                cap(
                    view,
                    list,
                    piece.iter().map(|place| corner(*place)),
                    still.z_m,
                    above,
                    surface,
                );
            }
        }
    }
}

fn range(still: &StillSolid) -> Range<usize> {
    still.walls.start as usize..still.walls.end as usize
}

/// Adds a horizontal convex polygon with these corners, counter-clockwise from above: the roof of a body that the camera is above, or
/// the underside of one that it is below.
#[inline(always)]
fn cap(
    view: &CameraView<'_>,
    list: &mut DrawList,
    corners_m: impl DoubleEndedIterator<Item = Point>,
    [low_m, high_m]: [f64; 2],
    is_above: bool,
    surface: u32,
) {
    let mut corners = [[0.0; 3]; MOST_EDGES];
    let mut count = 0;
    for corner in corners_m {
        let [low, high] = view.upright(corner, [low_m, high_m]);
        corners[count] = if is_above { high } else { low };
        count += 1;
    }
    let corners = &mut corners[..count];
    if !is_above {
        corners.reverse();
    }
    let normal = view.turned([0.0, 0.0, if is_above { 1.0 } else { -1.0 }]);
    view.polygon(list, corners, normal, surface);
}

impl CameraTargets {
    /// Adds the road users that a camera may see, without the one in row `carrier`.
    #[inline(always)]
    pub(super) fn gather(
        &self,
        view: &CameraView<'_>,
        carrier: Option<usize>,
        list: &mut DrawList,
        surfaces: &mut SurfaceTable,
    ) {
        for (row, user) in self.users.iter().enumerate() {
            if Some(row) == carrier || !view.may_see(&user.bounds) {
                continue;
            }
            let body = surfaces.body(user.body);
            surfaces.road_user(body, row as u32);
            if user.is_round {
                // The light on a cylinder is that on a wall towards the camera, and on its top.
                let [x, y, _] = view.pose.position_m;
                let [dx, dy] = from_to(user.bounds.centre_m, [x, y]);
                let length_m = (dx * dx + dy * dy).sqrt().max(1e-9);
                let mantle = surfaces.surface(body, [dx / length_m, dy / length_m, 0.0]);
                let _top = surfaces.surface(body, [0.0, 0.0, 1.0]);
                view.cylinder(list, &user.bounds, mantle);
                continue;
            }
            for part in &user.boxes[..user.box_count] {
                box_polygons(view, part, body, list, surfaces);
            }
        }
    }

    /// A road user.
    pub(super) fn user(&self, row: usize) -> &RoadUserBody {
        &self.users[row]
    }
}

#[inline(always)]
fn box_polygons(view: &CameraView<'_>, part: &BodyBox, body: u32, list: &mut DrawList, surfaces: &mut SurfaceTable) {
    let [x, y, z] = view.pose.position_m;
    let [cos, sin] = part.along;
    let corners = part.corners_m.map(|corner| view.upright(corner, part.z_m));
    // Left, rear, right, front: from a corner to the next one.
    let normals = [[-sin, cos], [-cos, -sin], [sin, -cos], [cos, sin]];
    for (side, normal) in normals.into_iter().enumerate() {
        let p = part.corners_m[side];
        if normal[0] * (p[0] - x) + normal[1] * (p[1] - y) >= 0.0 {
            continue;
        }
        let ([p0, p1], [q0, q1]) = (corners[side], corners[(side + 1) % 4]);
        let normal = [normal[0], normal[1], 0.0];
        let surface = surfaces.surface(body, normal);
        view.polygon(list, &[p0, q0, q1, p1], view.turned(normal), surface);
    }
    if z > part.z_m[1] {
        let surface = surfaces.surface(body, [0.0, 0.0, 1.0]);
        cap(view, list, part.corners_m.into_iter(), part.z_m, true, surface);
    }
    if z < part.z_m[0] {
        let surface = surfaces.surface(body, [0.0, 0.0, -1.0]);
        cap(view, list, part.corners_m.into_iter(), part.z_m, false, surface);
    }
}

/// A simple outline, counter-clockwise, as convex pieces: itself, or triangles from the cutting of ears.
fn convex_pieces(outline: &[Point]) -> Vec<Vec<u32>> {
    let count = outline.len();
    let turn = |a: usize, b: usize, c: usize| cross(from_to(outline[a], outline[b]), from_to(outline[b], outline[c]));
    let all: Vec<usize> = (0..count).collect();
    let is_convex = (0..count).all(|i| turn(i, (i + 1) % count, (i + 2) % count) >= 0.0);
    if count <= MOST_EDGES && is_convex {
        return vec![(0..count as u32).collect()];
    }
    let (mut left, mut pieces) = (all, Vec::new());
    while left.len() > 3 {
        let n = left.len();
        let at = |place: usize| left[place % n];
        let is_ear = |i: usize| {
            let [a, b, c] = [at(i + n - 1), at(i), at(i + 1)];
            let holds = |p: usize| turn(a, b, p) >= 0.0 && turn(b, c, p) >= 0.0 && turn(c, a, p) >= 0.0;
            let apart = |p: usize| outline[p] != outline[a] && outline[p] != outline[b] && outline[p] != outline[c];
            turn(a, b, c) > 0.0 && left.iter().all(|&p| !apart(p) || !holds(p))
        };
        // An outline without an ear has corners in a line: cutting one of them loses nothing.
        let ear = (0..n).find(|i| is_ear(*i)).unwrap_or_else(|| {
            let flat = |i: &usize| turn(at(i + n - 1), at(*i), at(i + 1)).abs();
            (0..n).min_by(|i, j| flat(i).total_cmp(&flat(j))).unwrap_or(0)
        });
        pieces.push(
            [at(ear + n - 1), at(ear), at(ear + 1)]
                .map(|corner| corner as u32)
                .to_vec(),
        );
        left.remove(ear);
    }
    pieces.push(left.into_iter().map(|corner| corner as u32).collect());
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;
    use sim_core::scene::shape::signed_area;

    #[test]
    fn pieces_are_convex_and_cover_the_outline() {
        let outlines: [Vec<Point>; 4] = [
            vec![[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]],
            vec![[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]],
            vec![[0.0, 0.0], [2.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 4.0]],
            (0..12)
                .map(|i| libm::sincos(f64::from(i) * std::f64::consts::TAU / 12.0))
                .map(|(s, c)| [c, s])
                .collect(),
        ];
        for outline in outlines {
            let pieces = convex_pieces(&outline);
            let area = |piece: &Vec<u32>| signed_area(&piece.iter().map(|i| outline[*i as usize]).collect::<Vec<_>>());
            assert!(
                pieces
                    .iter()
                    .all(|piece| piece.len() <= MOST_EDGES && area(piece) >= 0.0)
            );
            let sum: f64 = pieces.iter().map(area).sum();
            assert!((sum - signed_area(&outline)).abs() < 1e-12, "{pieces:?}");
        }
    }
}
