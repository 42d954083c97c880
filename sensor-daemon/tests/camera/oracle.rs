//! Every pixel against parry3d: the same object, the same range to a millimetre.

use parry3d_f64::{
    math::{Pose, Rotation, Vector},
    query::{Ray, RayCast},
    shape::{Cuboid, Cylinder, TriMesh},
};
use sensor_daemon::sensors::camera::SKY_INSTANCE;

use crate::{
    CameraModel, CameraParams, CameraPose, CameraScratch, GROUND, Kind, Scene, VehicleState, config, lidar_city,
    lidar_city::{Moves, Random, scene, traffic},
    params, take,
};

struct World<'a> {
    buildings: TriMesh,
    /// Object of each triangle.
    objects: Vec<u32>,
    /// Ground that is not flat.
    ground: Option<TriMesh>,
    states: &'a [VehicleState],
    range_m: f64,
}

impl<'a> World<'a> {
    fn new(scene: &Scene, states: &'a [VehicleState], range_m: f64) -> Self {
        let (vertices, faces, objects) = lidar_city::oracle::triangles(scene);
        let vertices = vertices.iter().map(|[x, y, z]| Vector::new(*x, *y, *z)).collect();
        Self {
            buildings: TriMesh::new(vertices, faces).unwrap(),
            objects,
            ground: (!scene.road().pieces().is_empty()).then(|| lidar_city::oracle::relief(scene)),
            states,
            range_m,
        }
    }

    /// Object and range of the first hit; `ray` has length 1.
    fn cast(&self, origin: [f64; 3], ray: [f64; 3], row: usize, most_m: f64) -> (u32, f64) {
        let mut hit = (SKY_INSTANCE, most_m);
        let mut offer = |range_m: f64, object: u32| {
            if range_m < hit.1 {
                hit = (object, range_m);
            }
        };
        let cast = Ray::new(
            Vector::new(origin[0], origin[1], origin[2]),
            Vector::new(ray[0], ray[1], ray[2]),
        );
        if let Some(ground) = &self.ground {
            if let Some(range_m) = ground.cast_local_ray(&cast, most_m, false) {
                offer(range_m, GROUND);
            }
        } else if ray[2] < 0.0 {
            offer(-origin[2] / ray[2], GROUND);
        }
        if let Some(met) = self.buildings.cast_local_ray_and_get_normal(&cast, most_m, false) {
            let face = met.subshape as usize % self.objects.len();
            offer(met.time_of_impact, self.objects[face]);
        }
        for (number, state) in self.states.iter().enumerate() {
            let (dx, dy) = (state.x_m - origin[0], state.y_m - origin[1]);
            let (ahead, aside) = (dx * ray[0] + dy * ray[1], dx * ray[1] - dy * ray[0]);
            let flat = ray[0].hypot(ray[1]);
            if number == row || dx.hypot(dy) > self.range_m * 1.5 + 20.0 || ahead < -20.0 || aside.abs() > 20.0 * flat {
                continue;
            }
            if let Some(range_m) = road_user(state, &cast, most_m) {
                offer(range_m, state.vehicle);
            }
        }
        hit
    }
}

fn road_user(state: &VehicleState, ray: &Ray, most_m: f64) -> Option<f64> {
    let [length, width, height, rear] =
        [state.length_m, state.width_m, state.height_m, state.rear_overhang_m].map(f64::from);
    let (x, y, z, yaw) = (state.x_m, state.y_m, state.z_m, state.yaw_rad);
    if state.kind == Kind::Person as u32 {
        // Parry's cylinders stand along y.
        let upright = Rotation::from_rotation_x(std::f64::consts::FRAC_PI_2);
        let pose = Pose::from_parts(Vector::new(x, y, z + 0.5 * height), upright);
        return Cylinder::new(0.5 * height, 0.5 * width.max(length)).cast_ray(&pose, ray, most_m, false);
    }
    let nearest = lidar_city::parts(state)
        .into_iter()
        .filter_map(|[from, to, low, high]| {
            let ahead = 0.5 * (from + to) * length - rear;
            let half = [0.5 * (to - from) * length, 0.5 * width, 0.5 * (high - low) * height];
            // A camera within a box sees through it.
            let (dx, dy, dz) = (
                ray.origin.x - x,
                ray.origin.y - y,
                ray.origin.z - z - 0.5 * (low + high) * height,
            );
            let (along, left) = (dx * yaw.cos() + dy * yaw.sin() - ahead, dy * yaw.cos() - dx * yaw.sin());
            if along.abs() < half[0] && left.abs() < half[1] && dz.abs() < half[2] {
                return None;
            }
            let centre = Vector::new(
                x + ahead * yaw.cos(),
                y + ahead * yaw.sin(),
                z + 0.5 * (low + high) * height,
            );
            let pose = Pose::from_parts(centre, Rotation::from_rotation_z(yaw));
            Cuboid::new(Vector::new(half[0], half[1], half[2])).cast_ray(&pose, ray, most_m, false)
        });
    nearest.min_by(f64::total_cmp)
}

#[derive(Debug, Default)]
struct Agreement {
    rays: usize,
    same: usize,
    grazing: usize,
    bodies: usize,
}

/// World from camera, built here without the code under test.
fn axes(pose: &CameraPose) -> [[f64; 3]; 3] {
    let [roll, pitch, yaw] = pose.attitude_rad();
    let rotation = Rotation::from_rotation_z(yaw) * Rotation::from_rotation_y(-pitch) * Rotation::from_rotation_x(roll);
    [Vector::X, Vector::Y, Vector::Z].map(|axis| {
        let turned = rotation * axis;
        [turned.x, turned.y, turned.z]
    })
}

/// Slopes of the ray that a lens puts at these slopes, by repeated substitution as in OpenCV's `undistortPoints`; x to the right, y down.
fn undistorted([k1, k2, p1, p2, k3]: [f64; 5], [x_d, y_d]: [f64; 2]) -> [f64; 2] {
    let (mut x, mut y) = (x_d, y_d);
    for _ in 0..200 {
        let r2 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2 + k3 * r2 * r2 * r2;
        let (dx, dy) = (
            2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        (x, y) = ((x_d - dx) / radial, (y_d - dy) / radial);
    }
    [x, y]
}

fn compare(
    scene: &Scene,
    moves: Moves,
    images: impl IntoIterator<Item = usize>,
    size: [usize; 2],
    seed: u64,
) -> Agreement {
    compare_through([0.0; 5], scene, moves, images, size, seed)
}

/// Compares images of a camera whose lens has this distortion.
fn compare_through(
    distortion: [f64; 5],
    scene: &Scene,
    moves: Moves,
    images: impl IntoIterator<Item = usize>,
    size: [usize; 2],
    seed: u64,
) -> Agreement {
    let (mut states, _) = traffic(200, 60, moves, 0, seed);
    lidar_city::stand_on(scene, &mut states);
    let mut random = Random(seed);
    let mut agreement = Agreement::default();
    let mut scratch = CameraScratch::default();
    for row in images {
        let lean = if moves == Moves::Wildly { 0.15 } else { 0.0 };
        let turned = [0.0; 2].map(|_: f64| random.between(-lean, lean));
        let mount = [
            1.5,
            0.1,
            random.between(1.2, 2.2),
            turned[0],
            turned[1],
            random.between(-3.0, 3.0),
        ];
        let params = CameraParams {
            distortion,
            ..params(size[0], size[1], mount)
        };
        let camera = CameraModel::new(&params, &config(), scene);
        let (taken, pose) = take(&camera, &states, row, &mut scratch);
        let world = World::new(scene, &states, params.range_m);
        let [ahead, left, up] = axes(&pose);
        let origin = pose.position_m();
        for pixel in 0..size[0] * size[1] {
            let (u, v) = (pixel % size[0], pixel / size[0]);
            let ray = |du: f64, dv: f64| {
                let x = (u as f64 + 0.5 + du - 0.5 * size[0] as f64) / camera.focal_px();
                let y = (v as f64 + 0.5 + dv - 0.5 * size[1] as f64) / camera.focal_px();
                let [a, b] = undistorted(distortion, [x, y]).map(|slope| -slope);
                let length = (1.0 + a * a + b * b).sqrt();
                let ray: [f64; 3] = std::array::from_fn(|i| (ahead[i] + a * left[i] + b * up[i]) / length);
                (ray, length)
            };
            let (direction, length) = ray(0.0, 0.0);
            let (object, range_m) = world.cast(origin, direction, row, params.range_m * length);
            let (ours, depth_m) = (taken.instance[pixel], f64::from(taken.depth_m[pixel]));
            agreement.rays += 1;
            agreement.bodies += usize::from(ours < GROUND && ours != SKY_INSTANCE);
            let is_same = ours == object && (ours == SKY_INSTANCE || (depth_m * length - range_m).abs() < 1e-3);
            if is_same {
                agreement.same += 1;
                continue;
            }
            // An edge is grazed if the oracle sees our object beside the ray, 3 mm off at the depth of the hit.
            let off = 3e-3 * camera.focal_px() / depth_m.max(1.0);
            let beside = [
                [0.0, 1.0],
                [0.0, -1.0],
                [1.0, 0.0],
                [-1.0, 0.0],
                [0.7, 0.7],
                [-0.7, 0.7],
                [0.7, -0.7],
                [-0.7, -0.7],
            ];
            let is_grazing = beside.into_iter().any(|[du, dv]| {
                let (direction, length) = ray(off * du, off * dv);
                let (object, range_m) = world.cast(origin, direction, row, params.range_m * length);
                // The ground is before and behind every edge of its own.
                object == ours && (ours != GROUND || (depth_m * length - range_m).abs() < 0.02 * range_m + 0.1)
            });
            agreement.grazing += usize::from(is_grazing);
            if !is_grazing {
                println!(
                    "row {row} pixel ({u}, {v}): {ours:x} at {} m, parry {object:x} at {range_m} m",
                    depth_m * length
                );
            }
        }
    }
    agreement
}

fn check(agreement: &Agreement) {
    println!("{agreement:?}");
    let off = agreement.rays - agreement.same;
    assert!(off * 10_000 <= agreement.rays, "{off} of {} differ", agreement.rays);
    assert_eq!(off, agreement.grazing, "every difference is a grazed edge");
    assert!(agreement.bodies * 5 > agreement.rays, "a dense city");
}

#[test]
fn upright_cameras_see_what_parry_sees() {
    check(&compare(&scene(500, 1), Moves::Straight, 0..6, [160, 120], 2));
}

#[test]
fn leaning_cameras_see_what_parry_sees() {
    check(&compare(&scene(500, 1), Moves::Wildly, 6..12, [160, 120], 3));
}

#[test]
fn cameras_on_hills_see_what_parry_sees() {
    check(&compare(&lidar_city::hilly(), Moves::Wildly, 12..16, [160, 120], 6));
}

/// Cameras on a viaduct and below it.
#[test]
fn cameras_on_and_under_a_bridge_see_what_parry_sees() {
    let scene = lidar_city::bridged();
    for (moves, seed) in [(Moves::Straight, 21), (Moves::Wildly, 22)] {
        let carriers = lidar_city::carriers_at_the_bridge(&scene, moves, seed);
        let agreement = compare(&scene, moves, carriers, [160, 120], seed);
        println!("{agreement:?}");
        let off = agreement.rays - agreement.same;
        assert!(off * 10_000 <= agreement.rays, "{off} of {} differ", agreement.rays);
        assert_eq!(off, agreement.grazing, "every difference is a grazed edge");
    }
}

#[test]
fn cameras_with_a_lens_see_what_parry_sees_along_its_rays() {
    let [barrel, pincushion] = [[-0.12, 0.01, 0.004, -0.006, 0.0], [0.08, 0.02, 0.0, 0.01, 0.001]];
    check(&compare_through(
        barrel,
        &scene(500, 1),
        Moves::Wildly,
        6..9,
        [160, 120],
        7,
    ));
    check(&compare_through(
        pincushion,
        &scene(500, 1),
        Moves::Straight,
        0..3,
        [150, 117],
        8,
    ));
    check(&compare_through(
        barrel,
        &lidar_city::hilly(),
        Moves::Wildly,
        12..14,
        [160, 120],
        9,
    ));
}

/// Ten million rays: `cargo test --release --test camera -- --ignored ten_million`.
#[test]
#[ignore = "minutes of processor time"]
fn ten_million_rays() {
    check(&compare(&scene(500, 1), Moves::Straight, 0..80, [320, 160], 4));
    check(&compare(&scene(500, 1), Moves::Wildly, 80..160, [320, 160], 5));
    check(&compare(&lidar_city::hilly(), Moves::Wildly, 160..200, [320, 160], 6));
}
