//! Rolling shutter, moving targets and the frames of the points.

use crate::{azimuth, car, empty, rectangle, scan, scan_with, small};
use ipc_schema::config::LidarAxes;
use ipc_schema::pointcloud::STATIC_OBJECT;
use ipc_schema::world::SubStep;
use sensor_daemon::sensors::lidar::LidarModel;
use sim_core::scene::{Road, Scene};

/// Figure 3: y backward, x left, z down. A car 10 m ahead is at y = −10; equation 4 with the heading brings (−y, x) into the world.
#[test]
fn equation_4_and_the_papers_axes() {
    let mut config = small(32, 360);
    let states = [
        car(0, 100.0, 50.0, 0.7),
        car(1, 100.0 + 10.0 * 0.7_f64.cos(), 50.0 + 10.0 * 0.7_f64.sin(), 0.7),
    ];
    let forward = scan(&config, &empty(), &states);
    config.lidar.axes = LidarAxes::Paper;
    let paper = scan(&config, &empty(), &states);
    assert_eq!((forward.scan.axes, paper.scan.axes), (0, 1));
    assert_eq!(forward.points.len(), paper.points.len());
    for (f, p) in forward.points.iter().zip(&paper.points) {
        assert_eq!([-p.position_m[1], p.position_m[0], -p.position_m[2]], f.position_m);
    }
    let point = paper.points.iter().find(|point| point.object == 1).unwrap();
    let [x, y, z] = point.position_m.map(f64::from);
    assert!(y < -8.9 && z > 0.0);
    // Equation 4: a rotation by the heading, of (−y, x).
    let (sin, cos) = states[0].yaw_rad.sin_cos();
    let [east, north] = [-cos * y - sin * x, cos * x - sin * y];
    // The world's plane in the frame of the other car: its rear is 1 m behind its origin, its half width 1 m.
    let (dx, dy) = (
        states[0].x_m + east - states[1].x_m,
        states[0].y_m + north - states[1].y_m,
    );
    let (sin, cos) = states[1].yaw_rad.sin_cos();
    let (ahead, left) = (dx * cos + dy * sin, dy * cos - dx * sin);
    assert!((ahead + 1.0).abs() < 1e-3 && left.abs() < 1.001, "{ahead} {left}");
}

/// Steps of a road user that moves straight at a constant velocity.
fn straight(velocity: [f64; 2], yaw_rate: f64, yaw: f64) -> Vec<SubStep> {
    (1..=10)
        .map(|i| {
            let t = 0.01 * f64::from(i) - 0.1;
            let (sin, cos) = (yaw + yaw_rate * t).sin_cos();
            SubStep {
                dx_m: (velocity[0] * t) as f32,
                dy_m: (velocity[1] * t) as f32,
                dyaw_rad: (yaw_rate * t) as f32,
                speed_mps: (velocity[0] * cos + velocity[1] * sin) as f32,
                lateral_speed_mps: (velocity[1] * cos - velocity[0] * sin) as f32,
                angular_rate_body_radps: [0.0, 0.0, yaw_rate as f32],
                ..SubStep::default()
            }
        })
        .collect()
}

#[test]
fn a_moving_target_is_where_it_was_when_its_azimuth_fired() {
    let mut config = small(32, 1800);
    config.lidar.rolling_shutter = true;
    // Abeam to the right (three quarters of the tick) a car drives past at 20 m/s.
    let states = [car(0, 0.0, 0.0, 0.0), car(1, 0.0, -8.0, 0.0)];
    let steps = [straight([0.0; 2], 0.0, 0.0), straight([20.0, 0.0], 0.0, 0.0)].concat();
    let lidar = LidarModel::new(&config, &empty()).unwrap();
    let scanned = scan_with(&lidar, &states, &steps, 10, 0, 1);
    let seen: Vec<_> = scanned.points.iter().filter(|point| point.object == 1).collect();
    assert!(seen.len() > 100);
    for point in &seen {
        let age = f64::from(point.age_us) * 1e-6;
        let fired = (azimuth(point).rem_euclid(std::f64::consts::TAU) / std::f64::consts::TAU) * 0.1 + 0.1 / 1800.0;
        assert!((0.1 - age - fired).abs() < 2e-6, "fired by azimuth");
        let x = f64::from(point.position_m[0]) + 20.0 * age;
        assert!((-1.001..=3.001).contains(&x), "{x}");
    }
    // Its whole length is seen: from rear to front bumper, by columns 2.8 cm apart.
    let along: Vec<f64> = seen
        .iter()
        .map(|point| f64::from(point.position_m[0]) + 20.0 * f64::from(point.age_us) * 1e-6)
        .collect();
    let (least, most) = along
        .iter()
        .fold((9.0_f64, -9.0_f64), |(a, b), x| (a.min(*x), b.max(*x)));
    assert!(least < -0.95 && most > 2.95, "{least} {most}");
}

#[test]
fn a_wall_seen_from_a_turning_car_is_straight() {
    let mut config = small(16, 1800);
    config.lidar.rolling_shutter = true;
    let (rate, velocity) = (0.8, [10.0, 3.0]);
    let scene = Scene::new(
        Road::default(),
        vec![rectangle([12.0, 13.0], [-90.0, 90.0], 30.0)],
        Vec::new(),
    );
    let steps = straight(velocity, rate, 0.5);
    let lidar = LidarModel::new(&config, &scene).unwrap();
    let scanned = scan_with(&lidar, &[car(0, 0.0, 0.0, 0.5)], &steps, 10, 0, 1);
    let mut seen = 0;
    for point in scanned.points.iter().filter(|point| point.object == STATIC_OBJECT) {
        let t = -f64::from(point.age_us) * 1e-6;
        let (sin, cos) = (0.5 + rate * t).sin_cos();
        let [x, y] = [0, 1].map(|axis: usize| f64::from(point.position_m[axis]));
        let world = velocity[0] * t + x * cos - y * sin;
        // Half a microsecond of rounding in the age, the precision of the wire, and 8·10⁻⁶ rad of heading.
        assert!((world - 12.0).abs() < 2e-3, "{world}");
        seen += 1;
    }
    assert!(seen > 3000);
}
