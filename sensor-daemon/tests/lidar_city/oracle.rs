//! The same rays cast by parry3d, in double precision: buildings as one triangle mesh, vehicles as cuboids, persons as cylinders, each
//! in its pose at the time of the ray.

use ipc_schema::{
    config::Config,
    pointcloud::{GROUND, LidarPoint, STATIC_OBJECT},
    traffic::Kind,
    world::{SubStep, VehicleState},
};
use parry3d_f64::{
    math::{Pose, Rotation, Vector},
    query::{Ray, RayCast},
    shape::{Cuboid, Cylinder, TriMesh},
};
use sim_core::scene::Scene;

use super::TICK_S;

/// No hit.
pub const NOTHING: u32 = u32::MAX - 1;

/// The hit of a ray.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    pub range_m: f64,
    pub object: u32,
}

/// A ray: where it starts, its direction in the world and in the sensor's frame, its laser.
#[derive(Debug, Clone, Copy)]
pub struct OneRay {
    pub origin_m: [f64; 3],
    pub direction: [f64; 3],
    pub in_sensor: [f64; 3],
    pub channel: u16,
    pub at: f64,
}

/// x, y, z, heading, roll, pitch at share `at` of the tick.
pub fn pose(state: &VehicleState, steps: &[SubStep], at: f64) -> [f64; 6] {
    let end = [state.x_m, state.y_m, state.z_m, state.yaw_rad];
    let k = steps.len();
    if k == 0 {
        let lean = [state.roll_rad, state.pitch_rad].map(f64::from);
        return [end[0], end[1], end[2], end[3], lean[0], lean[1]];
    }
    let knot = |i: usize| {
        let s = &steps[i];
        let d = [s.dx_m, s.dy_m, s.dz_m, s.dyaw_rad].map(f64::from);
        [
            end[0] + d[0],
            end[1] + d[1],
            end[2] + d[2],
            end[3] + d[3],
            f64::from(s.roll_rad),
            f64::from(s.pitch_rad),
        ]
    };
    let place = (at * k as f64).max(1e-12);
    let i = (place - 1e-9).floor().max(0.0) as usize;
    let share = place - i as f64;
    let after = knot(i);
    let before = if i > 0 {
        knot(i - 1)
    } else {
        let s = &steps[0];
        let dt = TICK_S / k as f64;
        let (v, w) = (f64::from(s.speed_mps), f64::from(s.lateral_speed_mps));
        let (sin, cos) = after[3].sin_cos();
        let [p, q, r] = s.angular_rate_body_radps.map(f64::from);
        [
            after[0] - dt * (v * cos - w * sin),
            after[1] - dt * (v * sin + w * cos),
            after[2],
            after[3] - dt * r,
            after[4] - dt * p,
            after[5] + dt * q,
        ]
    };
    std::array::from_fn(|n| before[n] + share * (after[n] - before[n]))
}

fn rotation(roll: f64, pitch: f64, yaw: f64) -> [[f64; 3]; 3] {
    let turn = |axis: usize, angle: f64| {
        let (s, c) = angle.sin_cos();
        match axis {
            0 => [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]],
            1 => [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]],
            _ => [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]],
        }
    };
    times(&times(&turn(2, yaw), &turn(1, -pitch)), &turn(0, roll))
}

fn times(a: &[[f64; 3]; 3], b: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|r| std::array::from_fn(|c| (0..3).map(|i| a[r][i] * b[i][c]).sum()))
}

fn turned(m: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|r| (0..3).map(|i| m[r][i] * v[i]).sum())
}

/// All rays of a scan of pattern "uniform", one rotation in a tick, in the order in which they are fired.
pub fn rays(config: &Config, state: &VehicleState, steps: &[SubStep]) -> Vec<OneRay> {
    let lidar = &config.lidar;
    let columns = (lidar.points_per_second as f64 / f64::from(lidar.channels) / lidar.rotation_hz).round() as usize;
    let [mx, my, mz, mroll, mpitch, myaw] = lidar.mount;
    let mut rays = Vec::new();
    for column in 0..columns {
        let at = if lidar.rolling_shutter {
            (column + 1) as f64 / columns as f64
        } else {
            1.0
        };
        let [x, y, z, yaw, roll, pitch] = if lidar.rolling_shutter {
            pose(state, steps, at)
        } else {
            pose(state, &[], 1.0)
        };
        let body = rotation(roll, pitch, yaw);
        let arm = turned(&body, [mx, my, mz]);
        let sensor = times(&body, &rotation(mroll, mpitch, myaw));
        let azimuth = std::f64::consts::TAU * column as f64 / columns as f64;
        for channel in 0..lidar.channels {
            let span = lidar.upper_fov_deg - lidar.lower_fov_deg;
            let elevation =
                (lidar.lower_fov_deg + span * f64::from(channel) / f64::from(lidar.channels - 1)).to_radians();
            let in_sensor = [
                elevation.cos() * azimuth.cos(),
                elevation.cos() * azimuth.sin(),
                elevation.sin(),
            ];
            rays.push(OneRay {
                origin_m: [x + arm[0], y + arm[1], z + arm[2]],
                direction: turned(&sensor, in_sensor),
                in_sensor,
                channel: channel as u16,
                at,
            });
        }
    }
    rays
}

/// The world of a tick.
pub struct WorldTick<'a> {
    /// `None` without buildings.
    buildings: Option<TriMesh>,
    /// Object of each triangle.
    objects: Vec<u32>,
    /// Ground that is not flat.
    ground: Option<TriMesh>,
    states: &'a [VehicleState],
    steps: &'a [SubStep],
    is_rolling: bool,
    range_m: f64,
}

/// Triangles of all buildings and of the slices of decks: walls, roofs (ears cut off) and undersides, and the object of each.
pub fn triangles(scene: &Scene) -> (Vec<[f64; 3]>, Vec<[u32; 3]>, Vec<u32>) {
    let (mut vertices, mut faces, mut objects) = (Vec::new(), Vec::new(), Vec::new());
    let buildings = (STATIC_OBJECT..).zip(scene.buildings());
    let buildings = buildings.map(|(object, building)| (object, building.outline_m.clone(), building.z_m()));
    let decks = scene.decks().iter();
    for (object, outline_m, z_m) in buildings.chain(decks.map(|deck| (GROUND, deck.outline_m.to_vec(), deck.z_m))) {
        let n = outline_m.len() as u32;
        let first = vertices.len() as u32;
        for z in z_m {
            vertices.extend(outline_m.iter().map(|[x, y]| [*x, *y, z]));
        }
        for i in 0..n {
            let (a, b) = (first + i, first + (i + 1) % n);
            faces.extend([[a, b, b + n], [a, b + n, a + n]]);
        }
        for ear in ears(&outline_m) {
            faces.push(ear.map(|corner| first + n + corner));
            faces.push([ear[0], ear[2], ear[1]].map(|corner| first + corner));
        }
        objects.resize(faces.len(), object);
    }
    (vertices, faces, objects)
}

/// The ground as docs/lidar.md has it: cells of 5 m, larger where there would be more than 250 000, 100 m beyond the outermost road, two triangles each.
pub fn relief(scene: &Scene) -> TriMesh {
    let places: Vec<_> = scene.road().pieces().iter().flat_map(|piece| &piece.shape_m).collect();
    let low = [0, 1].map(|axis: usize| places.iter().map(|place| place[axis]).fold(f64::INFINITY, f64::min) - 100.0);
    let high = [0, 1].map(|axis: usize| places.iter().map(|place| place[axis]).fold(0.0, f64::max) + 100.0);
    let size = [0, 1].map(|axis: usize| high[axis] - low[axis]);
    let cell_m = (size[0] * size[1] / 250_000.0).sqrt().max(5.0);
    let [columns, rows] = size.map(|length_m| (length_m / cell_m).ceil() as u32 + 1);
    let corners = (0..columns * rows).map(|corner| {
        let (x, y) = (
            low[0] + cell_m * f64::from(corner % columns),
            low[1] + cell_m * f64::from(corner / columns),
        );
        Vector::new(x, y, scene.ground_height_m(x, y))
    });
    let mut faces = Vec::new();
    for row in 0..rows - 1 {
        for at in row * columns..(row + 1) * columns - 1 {
            faces.extend([[at, at + 1, at + columns], [at + 1, at + columns + 1, at + columns]]);
        }
    }
    TriMesh::new(corners.collect(), faces).unwrap()
}

/// A simple polygon, counter-clockwise, as triangles.
fn ears(outline: &[[f64; 2]]) -> Vec<[u32; 3]> {
    let mut left: Vec<u32> = (0..outline.len() as u32).collect();
    let cross = |a: u32, b: u32, c: u32| {
        let [a, b, c] = [a, b, c].map(|i| outline[i as usize]);
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    };
    let mut ears = Vec::new();
    while left.len() > 3 {
        let n = left.len();
        let ear = (0..n).find(|i| {
            let [a, b, c] = [left[(i + n - 1) % n], left[*i], left[(i + 1) % n]];
            let holds = |p: u32| cross(a, b, p) >= 0.0 && cross(b, c, p) >= 0.0 && cross(c, a, p) >= 0.0;
            cross(a, b, c) > 0.0 && left.iter().all(|&p| p == a || p == b || p == c || !holds(p))
        });
        let i = ear.unwrap();
        ears.push([left[(i + n - 1) % n], left[i], left[(i + 1) % n]]);
        left.remove(i);
    }
    ears.push([left[0], left[1], left[2]]);
    ears
}

impl<'a> WorldTick<'a> {
    pub fn new(config: &Config, scene: &Scene, states: &'a [VehicleState], steps: &'a [SubStep]) -> Self {
        let (vertices, faces, objects) = triangles(scene);
        let vertices = vertices.iter().map(|[x, y, z]| Vector::new(*x, *y, *z)).collect();
        Self {
            buildings: TriMesh::new(vertices, faces).ok(),
            objects,
            ground: (!scene.road().pieces().is_empty()).then(|| relief(scene)),
            states,
            steps,
            is_rolling: config.lidar.rolling_shutter,
            range_m: config.lidar.range_m,
        }
    }

    /// The nearest hit of a ray of the carrier in `row`.
    pub fn cast(&self, ray: &OneRay, row: usize) -> Hit {
        let mut hit = Hit {
            range_m: self.range_m,
            object: NOTHING,
        };
        let mut offer = |range_m: f64, object: u32| {
            if range_m < hit.range_m {
                hit = Hit { range_m, object };
            }
        };
        let vector = |[x, y, z]: [f64; 3]| Vector::new(x, y, z);
        let cast = Ray::new(vector(ray.origin_m), vector(ray.direction));
        if let Some(ground) = &self.ground {
            if let Some(range_m) = ground.cast_local_ray(&cast, self.range_m, false) {
                offer(range_m, GROUND);
            }
        } else if ray.direction[2] < 0.0 {
            offer(-ray.origin_m[2] / ray.direction[2], GROUND);
        }
        let met = self.buildings.as_ref();
        if let Some(met) = met.and_then(|met| met.cast_local_ray_and_get_normal(&cast, self.range_m, false)) {
            let face = met.subshape as usize % self.objects.len();
            offer(met.time_of_impact, self.objects[face]);
        }
        let k = self.steps.len() / self.states.len();
        for (number, state) in self.states.iter().enumerate() {
            let (dx, dy) = (state.x_m - ray.origin_m[0], state.y_m - ray.origin_m[1]);
            // Twenty metres hold the longest vehicle and its way in a tick; then, on which side the ray points.
            let ahead = dx * ray.direction[0] + dy * ray.direction[1];
            let aside = dx * ray.direction[1] - dy * ray.direction[0];
            let flat = ray.direction[0].hypot(ray.direction[1]);
            if number == row || dx.hypot(dy) > self.range_m + 20.0 || ahead < -20.0 || aside.abs() > 20.0 * flat {
                continue;
            }
            let steps = if self.is_rolling {
                &self.steps[number * k..(number + 1) * k]
            } else {
                &[]
            };
            if let Some(range_m) = self.road_user(state, pose(state, steps, ray.at), &cast) {
                offer(range_m, state.vehicle);
            }
        }
        hit
    }

    fn road_user(&self, state: &VehicleState, [x, y, z, yaw, ..]: [f64; 6], ray: &Ray) -> Option<f64> {
        let [length, width, height, rear] =
            [state.length_m, state.width_m, state.height_m, state.rear_overhang_m].map(f64::from);
        if state.kind == Kind::Person as u32 {
            // Parry's cylinders stand along y.
            let upright = Rotation::from_rotation_x(std::f64::consts::FRAC_PI_2);
            let pose = Pose::from_parts(Vector::new(x, y, z + 0.5 * height), upright);
            return Cylinder::new(0.5 * height, 0.5 * width.max(length)).cast_ray(&pose, ray, self.range_m, false);
        }
        let ahead = 0.5 * length - rear;
        // Walls are seen from outside only: two vehicles of random traffic may overlap, and a sensor may be inside another's box.
        let (dx, dy) = (ray.origin.x - x, ray.origin.y - y);
        let (along, left) = (dx * yaw.cos() + dy * yaw.sin() - ahead, dy * yaw.cos() - dx * yaw.sin());
        if along.abs() < 0.5 * length && left.abs() < 0.5 * width && (z..z + height).contains(&ray.origin.z) {
            return None;
        }
        let centre = Vector::new(x + ahead * yaw.cos(), y + ahead * yaw.sin(), z + 0.5 * height);
        let pose = Pose::from_parts(centre, Rotation::from_rotation_z(yaw));
        Cuboid::new(Vector::new(0.5 * length, 0.5 * width, 0.5 * height)).cast_ray(&pose, ray, self.range_m, false)
    }
}

/// Counts of the comparison of scans with the oracle.
#[derive(Debug, Clone, Copy, Default)]
pub struct ScanTotals {
    pub rays: usize,
    pub hits: usize,
    /// Same object (or nothing) and range within 1 mm.
    pub same: usize,
    /// Of the others, those that the oracle itself sees differently when the ray is moved by a few millimetres.
    pub grazing: usize,
    pub range_sum_m: f64,
    printed: usize,
}

impl ScanTotals {
    pub fn add(&mut self, other: &Self) {
        self.rays += other.rays;
        self.hits += other.hits;
        self.same += other.same;
        self.grazing += other.grazing;
        self.range_sum_m += other.range_sum_m;
    }
}

fn is_same(range_m: f64, object: u32, hit: &Hit) -> bool {
    object == hit.object && (object == NOTHING || (range_m - hit.range_m).abs() < 1e-3)
}

/// Compares a scan without noise with the oracle, ray by ray.
pub fn compare(world: &WorldTick<'_>, rays: &[OneRay], row: usize, points: &[LidarPoint]) -> ScanTotals {
    let mut tally = ScanTotals {
        rays: rays.len(),
        ..ScanTotals::default()
    };
    let mut rest = points.iter().peekable();
    for ray in rays {
        let ours = rest.next_if(|point| {
            let p = point.position_m.map(f64::from);
            let range_m = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
            let off: f64 = (0..3).map(|axis| (p[axis] - range_m * ray.in_sensor[axis]).abs()).sum();
            point.channel == ray.channel && off < 1e-5 * range_m.max(1.0)
        });
        let (range_m, object) = ours.map_or((0.0, NOTHING), |point| {
            let p = point.position_m.map(f64::from);
            ((p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt(), point.object)
        });
        let hit = world.cast(ray, row);
        tally.hits += usize::from(object != NOTHING);
        tally.range_sum_m += range_m;
        if is_same(range_m, object, &hit) {
            tally.same += 1;
        } else if is_grazing(world, ray, row, range_m, object) {
            tally.grazing += 1;
        } else if tally.printed < 5 {
            tally.printed += 1;
            eprintln!(
                "sensor-daemon {object:x} at {range_m}, parry {:x} at {}: {ray:?}",
                hit.object, hit.range_m
            );
        }
    }
    assert!(rest.peek().is_none(), "a point belongs to no ray");
    tally
}

/// True if a ray shifted by 3 mm at the place of the hit gives our result, within the effect of such a shift.
fn is_grazing(world: &WorldTick<'_>, ray: &OneRay, row: usize, range_m: f64, object: u32) -> bool {
    let reach_m = if object == NOTHING {
        world.range_m
    } else {
        range_m.max(1.0)
    };
    let [x, y, z] = ray.direction;
    let flat = x.hypot(y).max(1e-9);
    let (side, up) = ([-y / flat, x / flat, 0.0], [-x * z / flat, -y * z / flat, flat]);
    [
        (-1.0, 0.0),
        (1.0, 0.0),
        (0.0, -1.0),
        (0.0, 1.0),
        (-0.7, 0.7),
        (0.7, 0.7),
        (-0.7, -0.7),
        (0.7, -0.7),
    ]
    .into_iter()
    .any(|(a, b)| {
        let off = 3e-3 / reach_m;
        let moved = std::array::from_fn(|i| ray.direction[i] + off * (a * side[i] + b * up[i]));
        let hit = world.cast(
            &OneRay {
                direction: moved,
                ..*ray
            },
            row,
        );
        // The ground is before and behind every edge of its own.
        hit.object == object && (object != GROUND || (hit.range_m - range_m).abs() < 0.02 * range_m + 0.1)
    })
}
