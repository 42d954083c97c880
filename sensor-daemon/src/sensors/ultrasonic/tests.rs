use std::f64::consts::TAU;

use sim_core::scene::shape::{OrientedBox, contains, cross, dot, edges, from_to};

use super::*;
use crate::preset::town;

/// Distance of neighbouring points of a sampled surface, metres.
const SPACING_M: f64 = 0.03;
const RANGE_M: f64 = 5.0;

/// Numbers in 0 … 1 (SplitMix64).
struct Random(u64);

impl Random {
    fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        low + ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64 * (high - low)
    }

    fn point(&mut self, reach_m: f64) -> Point {
        [(); 2].map(|()| self.between(-reach_m, reach_m))
    }
}

enum TestSolid {
    Prism(Vec<Point>, [f64; 2]),
    Cylinder(Point, f64, [f64; 2]),
}

/// A point of a surface, with its normal, and the radius of the surface (infinite if it is flat).
struct SurfacePoint {
    at: [f64; 3],
    normal: [f64; 3],
    radius_m: f64,
}

fn shares(length_m: f64) -> impl Iterator<Item = f64> {
    let count = (length_m / SPACING_M).ceil().max(1.0) as u32;
    (0..=count).map(move |step| f64::from(step) / f64::from(count))
}

impl TestSolid {
    /// A box, an L or a cylinder, near the origin, sometimes wholly above or below the height 0.
    fn random(random: &mut Random) -> Self {
        let low_m = random.between(-1.5, 0.6);
        let z_m = [low_m, low_m + random.between(0.1, 1.6)];
        let reach_m = random.between(1.0, 5.0);
        let centre_m = random.point(reach_m);
        let kind = random.between(0.0, 3.0) as u32;
        if kind == 0 {
            return Self::Cylinder(centre_m, random.between(0.05, 1.3), z_m);
        }
        let angle = random.between(0.0, TAU);
        let body = OrientedBox {
            centre_m,
            along: [angle.cos(), angle.sin()],
            half_m: [random.between(0.05, 2.5), random.between(0.05, 1.5)],
            z_m,
        };
        if kind == 1 {
            return Self::Prism(body.corners().to_vec(), z_m);
        }
        let [l, w] = body.half_m;
        let outline = [
            [-l, -w],
            [l, -w],
            [l, -0.3 * w],
            [-0.2 * l, -0.3 * w],
            [-0.2 * l, w],
            [-l, w],
        ];
        Self::Prism(outline.map(|local| body.world_from_local(local)).to_vec(), z_m)
    }

    fn reflect(&self, search: &mut EchoSearch) {
        match self {
            Self::Prism(outline_m, z_m) => search.prism(outline_m, *z_m),
            Self::Cylinder(centre_m, radius_m, z_m) => search.cylinder(*centre_m, *radius_m, *z_m),
        }
    }

    fn holds(&self, place_m: Point, height_m: f64) -> bool {
        let (is_inside, z_m) = match self {
            Self::Prism(outline_m, z_m) => (contains(outline_m, place_m), z_m),
            Self::Cylinder(centre_m, radius_m, z_m) => {
                let off = from_to(*centre_m, place_m);
                (dot(off, off) <= radius_m * radius_m, z_m)
            }
        };
        is_inside && (z_m[0]..=z_m[1]).contains(&height_m)
    }

    /// Points of all its surfaces: every point of its sides has one of them within [`SPACING_M`].
    fn surface(&self) -> Vec<SurfacePoint> {
        let mut points = Vec::new();
        let [low_m, high_m] = match self {
            Self::Prism(_, z_m) | Self::Cylinder(.., z_m) => *z_m,
        };
        let heights: Vec<f64> = shares(high_m - low_m)
            .map(|share| low_m + share * (high_m - low_m))
            .collect();
        let mut side = |[x, y]: Point, [nx, ny]: Point, radius_m: f64| {
            let at_heights = heights.iter().map(|z| SurfacePoint {
                at: [x, y, *z],
                normal: [nx, ny, 0.0],
                radius_m,
            });
            points.extend(at_heights);
        };
        let (outline, bounds): (Box<dyn Fn(Point) -> bool + '_>, Bounds) = match self {
            Self::Prism(outline_m, _) => {
                for (a, b) in edges(outline_m) {
                    let along = from_to(a, b);
                    let length_m = dot(along, along).sqrt();
                    for share in shares(length_m) {
                        let at = [a[0] + share * along[0], a[1] + share * along[1]];
                        side(at, [along[1] / length_m, -along[0] / length_m], f64::INFINITY);
                    }
                }
                (
                    Box::new(|point| contains(outline_m, point)),
                    Bounds::of(outline_m.iter().copied()),
                )
            }
            Self::Cylinder(centre_m, radius_m, _) => {
                for share in shares(TAU * radius_m) {
                    let (sin, cos) = (TAU * share).sin_cos();
                    side(
                        [centre_m[0] + radius_m * cos, centre_m[1] + radius_m * sin],
                        [cos, sin],
                        *radius_m,
                    );
                }
                let holds = move |point| {
                    let off = from_to(*centre_m, point);
                    dot(off, off) <= radius_m * radius_m
                };
                (Box::new(holds), Bounds::about(*centre_m, *radius_m))
            }
        };
        let [width_m, depth_m] = from_to(bounds.min_m, bounds.max_m);
        for (u, v) in shares(width_m).flat_map(|u| shares(depth_m).map(move |v| (u, v))) {
            let [x, y] = [bounds.min_m[0] + u * width_m, bounds.min_m[1] + v * depth_m];
            if outline([x, y]) {
                let top = SurfacePoint {
                    at: [x, y, high_m],
                    normal: [0.0, 0.0, 1.0],
                    radius_m: f64::INFINITY,
                };
                points.push(SurfacePoint {
                    at: [x, y, low_m],
                    normal: [0.0, 0.0, -1.0],
                    ..top
                });
                points.push(top);
            }
        }
        points
    }
}

/// The cone in three dimensions, as the model defines it.
struct SpaceCone {
    axis: SensorAxis,
    /// Tangents of the half angles.
    tangents: [f64; 2],
}

impl SpaceCone {
    /// Range of the nearest of `points` that returns an echo, each condition relaxed by what it may change within `slack_m`.
    fn nearest_m(&self, points: &[SurfacePoint], slack_m: f64) -> f64 {
        let ranges = points.iter().filter_map(|point| {
            let to_point = [
                point.at[0] - self.axis.place_m[0],
                point.at[1] - self.axis.place_m[1],
                point.at[2] - self.axis.z_m,
            ];
            let range_m = to_point.iter().map(|part| part * part).sum::<f64>().sqrt();
            let off = [to_point[0], to_point[1]];
            let (x, y) = (dot(self.axis.ahead, off), cross(self.axis.ahead, off));
            let [aside, up] = self.tangents;
            let depth_m = x - (y / aside).hypot(to_point[2] / up);
            let facing_m: f64 = -to_point
                .iter()
                .zip(point.normal)
                .map(|(part, normal)| part * normal)
                .sum::<f64>();
            let is_flat = point.radius_m.is_infinite();
            let is_in_cone = depth_m >= -slack_m * (1.0 + 1.0 / aside.min(up));
            let turned_m = if is_flat {
                0.0
            } else {
                slack_m * (1.0 + range_m / point.radius_m)
            };
            let is_facing = facing_m > -turned_m;
            let is_seen = !is_flat || facing_m >= 0.5 * range_m - 2.0 * slack_m;
            (is_in_cone && is_facing && is_seen && range_m <= RANGE_M + slack_m).then_some(range_m)
        });
        ranges.fold(f64::INFINITY, f64::min)
    }
}

/// Oracle: no point of a densely sampled surface that is in the cone, faces the sensor and is seen at 60° or less is nearer than the
/// echo. And the echo is no nearer than such a point, if each condition is relaxed by what it may change within the spacing.
#[test]
fn the_echo_is_the_closest_point_of_sampled_surfaces_in_the_cone() {
    let mut random = Random(11);
    let (mut heard, mut silent, mut clipped, mut inside) = (0, 0, 0, 0);
    for scene in 0..1500 {
        let half_angles_deg = [random.between(5.0, 80.0), random.between(5.0, 29.9)];
        let angle = random.between(0.0, TAU);
        let axis = SensorAxis {
            place_m: random.point(1.0),
            z_m: random.between(-0.2, 0.2),
            ahead: [angle.cos(), angle.sin()],
        };
        let solids: Vec<TestSolid> = (0..=scene % 3).map(|_| TestSolid::random(&mut random)).collect();
        let mut search = EchoSearch::new(ConeOpening::new(half_angles_deg[0], half_angles_deg[1]), axis, RANGE_M);
        solids.iter().for_each(|solid| solid.reflect(&mut search));
        let found_m = search.range_m();
        if solids.iter().any(|solid| solid.holds(axis.place_m, axis.z_m)) {
            assert_eq!(found_m, Some(0.0), "scene {scene}");
            inside += 1;
            continue;
        }
        let tangents = half_angles_deg.map(|angle_deg| angle_deg.to_radians().tan());
        let cone = SpaceCone { axis, tangents };
        let points: Vec<SurfacePoint> = solids.iter().flat_map(TestSolid::surface).collect();
        let echo_m = found_m.unwrap_or(f64::INFINITY);
        let sampled_m = cone.nearest_m(&points, 0.0);
        assert!(
            sampled_m >= echo_m - 1e-9,
            "scene {scene}: {sampled_m} is nearer than {echo_m}"
        );
        if let Some(echo_m) = found_m {
            let relaxed_m = cone.nearest_m(&points, SPACING_M);
            assert!(
                echo_m >= relaxed_m - SPACING_M,
                "scene {scene}: {echo_m} before {relaxed_m}"
            );
            let all_around = SpaceCone {
                axis,
                tangents: [1e9; 2],
            };
            clipped += u32::from(all_around.nearest_m(&points, 0.0) < echo_m - SPACING_M);
            heard += 1;
        } else {
            silent += 1;
        }
    }
    println!("{heard} heard, {clipped} of them clipped by the cone, {silent} silent, {inside} inside a solid");
    assert!(heard > 150 && clipped > 50 && silent > 100 && inside > 5);
}

fn car() -> VehicleState {
    VehicleState {
        x_m: 10.0,
        y_m: 20.0,
        z_m: 3.0,
        yaw_rad: std::f64::consts::FRAC_PI_2,
        length_m: 4.5,
        width_m: 1.8,
        height_m: 1.5,
        rear_overhang_m: 0.9,
        ..VehicleState::default()
    }
}

#[test]
fn the_mounts_are_in_the_bumpers_and_look_outwards() {
    let model = UltrasonicModel::new(&town());
    let axes: Vec<SensorAxis> = model.axes(&car()).collect();
    assert_eq!(axes.len(), ULTRASONIC_MOUNTS);
    // The car heads north: its centre is 1.35 m north of the rear axle.
    let body = OrientedBox {
        centre_m: [10.0, 21.35],
        along: [0.0, 1.0],
        half_m: [2.25, 0.9],
        z_m: [3.0, 4.5],
    };
    for (index, axis) in axes.iter().enumerate() {
        let [ahead_m, left_m] = body.local_from_world(axis.place_m);
        let on_side = (left_m.abs() - 0.9).abs() < 1e-6 && ahead_m.abs() < 2.25;
        let on_bumper = (ahead_m.abs() - 2.25).abs() < 1e-6 && left_m.abs() < 0.9;
        assert!(on_side || on_bumper, "mount {index}");
        assert_eq!(ahead_m > 0.0, index < 6, "six in front");
        assert!(
            dot(axis.ahead, from_to(body.centre_m, axis.place_m)) > 0.0,
            "mount {index} looks outwards"
        );
        assert!((axis.z_m - 3.5).abs() < 1e-9);
    }
    let nose_up = VehicleState {
        pitch_rad: 0.05,
        ..car()
    };
    let raised: Vec<f64> = model.axes(&nose_up).map(|axis| axis.z_m - 3.5).collect();
    assert!(
        (raised[2] - 3.6 * 0.05_f64.sin()).abs() < 1e-6,
        "the front bumper is 3.6 m ahead of the rear axle"
    );
    assert!((raised[8] + 0.9 * 0.05_f64.sin()).abs() < 1e-6);
}

#[test]
fn fewer_mounts_are_the_first() {
    let mut config = town();
    config.ultrasonic.mounts = 4;
    let all: Vec<SensorAxis> = UltrasonicModel::new(&town()).axes(&car()).collect();
    let four: Vec<SensorAxis> = UltrasonicModel::new(&config).axes(&car()).collect();
    assert_eq!(four, all[..4]);
}

#[test]
fn a_reading_is_within_the_ranges_that_are_measured() {
    let model = UltrasonicModel::new(&town());
    assert_eq!(model.reading(None, 0.3), 5.0, "no echo has no error");
    assert_eq!(model.reading(Some(2.0), 0.25), 2.25);
    assert_eq!(model.reading(Some(0.05), 0.01), 0.15);
    assert_eq!(model.reading(Some(4.99), 0.02), 5.0);
}

/// Five standard errors of mean, deviation and correlation.
#[test]
fn the_errors_of_the_mounts_are_independent_and_standard_normal() {
    const N: u32 = 20_000;
    let now = |tick| TickTime {
        episode_seed: 5,
        tick,
        time_ns: 0,
    };
    let samples: Vec<[f64; ULTRASONIC_MOUNTS]> = (0..N).map(|tick| normals(&now(tick), 77)).collect();
    let mean_of =
        |value: &dyn Fn(&[f64; ULTRASONIC_MOUNTS]) -> f64| samples.iter().map(value).sum::<f64>() / f64::from(N);
    let root = f64::from(N).sqrt();
    for mount in 0..ULTRASONIC_MOUNTS {
        assert!(mean_of(&|sample| sample[mount]).abs() < 5.0 / root);
        let std = mean_of(&|sample| sample[mount] * sample[mount]).sqrt();
        assert!((std - 1.0).abs() < 5.0 / (2.0 * f64::from(N)).sqrt(), "{std}");
        let other = (mount + 1) % ULTRASONIC_MOUNTS;
        assert!(mean_of(&|sample| sample[mount] * sample[other]).abs() < 5.0 / root);
    }
    let lagged = samples.windows(2).map(|pair| pair[0][11] * pair[1][0]).sum::<f64>() / f64::from(N);
    assert!(lagged.abs() < 5.0 / root, "from tick to tick");
    assert_ne!(normals(&now(3), 77), normals(&now(3), 78));
    assert_eq!(normals(&now(3), 77), normals(&now(3), 77));
}

/// The grid over road users finds what a search through all of them finds.
#[test]
fn no_road_user_nearby_is_missed() {
    let mut random = Random(3);
    let states: Vec<VehicleState> = (0..300)
        .map(|number| VehicleState {
            x_m: random.between(0.0, 120.0),
            y_m: random.between(0.0, 120.0),
            yaw_rad: random.between(-3.0, 3.0),
            length_m: if number % 10 == 0 { 18.0 } else { 4.5 },
            ..car()
        })
        .collect();
    let mut bodies = MovingBodies::default();
    bodies.update(&states);
    for _ in 0..100 {
        let place_m = [random.between(0.0, 120.0), random.between(0.0, 120.0)];
        let mut found: Vec<usize> = bodies.near(place_m, RANGE_M).map(|body| body.row).collect();
        found.sort_unstable();
        let is_near = |state: &VehicleState| {
            let ahead_m = 0.5 * f64::from(state.length_m) - 0.9;
            let centre_m = [
                state.x_m + ahead_m * state.yaw_rad.cos(),
                state.y_m + ahead_m * state.yaw_rad.sin(),
            ];
            let off = from_to(centre_m, place_m);
            dot(off, off).sqrt() <= RANGE_M + 0.5 * f64::from(state.length_m).hypot(f64::from(state.width_m))
        };
        let expected: Vec<usize> = (0..states.len()).filter(|row| is_near(&states[*row])).collect();
        assert_eq!(found, expected);
    }
}
