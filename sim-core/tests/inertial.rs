//! The inertial truth is the derivative of the motion, and the integrator converges.

mod common;

use std::f64::consts::FRAC_PI_2;

use common::{Road, drive, kinematic, limits, mirror_one, settings};
use ipc_schema::world::{SubStep, VehicleState};
use sim_core::models::{
    catalogue::MotionModel,
    state::{ControlInput, ModelState},
};

/// Dead reckoning of a user: heading from the angular rate, velocity from the body's acceleration turned by
/// the heading half-way, position from the mean velocity.
fn integrate(start: &VehicleState, rows: &[SubStep], dt_s: f64) -> [f64; 3] {
    let (mut x, mut y, mut yaw) = (start.x_m, start.y_m, start.yaw_rad);
    let speed = f64::from(start.velocity_body_mps[0]);
    let mut velocity = [speed * yaw.cos(), speed * yaw.sin()];
    for row in rows {
        let turn = f64::from(row.angular_rate_body_radps[2]) * dt_s;
        let (sin, cos) = (yaw + 0.5 * turn).sin_cos();
        let [ax, ay, _] = row.accel_body_mps2.map(f64::from);
        let change = [(ax * cos - ay * sin) * dt_s, (ax * sin + ay * cos) * dt_s];
        x += (velocity[0] + 0.5 * change[0]) * dt_s;
        y += (velocity[1] + 0.5 * change[1]) * dt_s;
        velocity = [velocity[0] + change[0], velocity[1] + change[1]];
        yaw += turn;
    }
    [x, y, yaw]
}

fn speeds() -> Vec<f64> {
    (0..220)
        .map(|i| 6.0 + 3.0 * (f64::from(i) * 0.07).sin() - if i % 7 == 0 { 0.3 } else { 0.0 })
        .collect()
}

#[test]
fn ten_seconds_of_acceleration_and_angular_rate_reproduce_the_pose_to_1_cm_and_a_hundredth_of_a_degree() {
    let road = Road::corner(40.0, 7.0, FRAC_PI_2, 5);
    let mut frames = drive(&road, 10.0, 0.1, &speeds());
    frames[150..].iter_mut().for_each(|f| f.front_x_m -= 3.2);
    for sub_steps in [10, 5, 1] {
        let (states, rows) = mirror_one(settings(0.1, sub_steps, 1), &frames);
        let per_tick = sub_steps as usize;
        for start in [0, 30, 60, 100] {
            let end = start + 100;
            let moved = &rows[(start + 1) * per_tick..(end + 1) * per_tick];
            let [x, y, yaw] = integrate(&states[start], moved, 0.1 / f64::from(sub_steps));
            let off = (x - states[end].x_m).hypot(y - states[end].y_m);
            let turned = (yaw - states[end].yaw_rad + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU);
            assert!(
                off < if sub_steps == 1 { 0.05 } else { 0.01 },
                "{sub_steps} sub-steps from {start}: {off} m"
            );
            assert!(
                (turned - std::f64::consts::PI).abs() < 0.01_f64.to_radians(),
                "{sub_steps} sub-steps: {turned}"
            );
        }
    }
}

#[test]
fn sub_steps_lie_on_the_path_between_two_ticks() {
    let road = Road::corner(40.0, 7.0, FRAC_PI_2, 5);
    let (states, rows) = mirror_one(settings(0.1, 10, 1), &drive(&road, 10.0, 0.1, &speeds()));
    for (i, state) in states.iter().enumerate().skip(1) {
        let tick = &rows[10 * i..10 * i + 10];
        assert_eq!([tick[9].dx_m, tick[9].dy_m, tick[9].dyaw_rad], [0.0; 3]);
        assert_eq!(tick[9].speed_mps, state.velocity_body_mps[0]);
        assert_eq!(tick[9].accel_body_mps2, state.accel_body_mps2);
        let before = &states[i - 1];
        let first = [
            state.x_m + f64::from(tick[0].dx_m) - before.x_m,
            state.y_m + f64::from(tick[0].dy_m) - before.y_m,
        ];
        let expected = 0.005 * f64::from(tick[0].speed_mps + before.velocity_body_mps[0]);
        assert!(
            (first[0].hypot(first[1]) - expected).abs() < 1e-5,
            "tick {i}: {first:?} {expected}"
        );
    }
}

fn slalom(steps: u32) -> ModelState {
    let mut limits = limits();
    (limits.max_road_wheel_rate_radps, limits.max_accel_mps2) = (10.0, 50.0);
    let model = MotionModel::Kinematic(kinematic(&limits, 2.6));
    let dt_s = 4.0 / f64::from(steps);
    let mut state = ModelState::new(0.0, 0.0, 0.3, 10.0);
    for i in 0..steps {
        let t = (f64::from(i) + 0.5) * dt_s;
        let input = ControlInput {
            accel_mps2: (2.0 * t).sin(),
            road_wheel_angle_rad: 0.1 * (1.5 * t).sin(),
        };
        state = model.step(&state, &input, dt_s).0;
    }
    state
}

/// The actuators' lag is a first-order hold of the demand (first order); the motion that follows converges with it.
#[test]
fn halving_the_sub_step_at_least_halves_the_error() {
    let exact = slalom(25_600);
    let error = |steps: u32| {
        let state = slalom(steps);
        (state.x_m - exact.x_m).hypot(state.y_m - exact.y_m)
    };
    let (coarse, medium, fine) = (error(400), error(800), error(1600));
    assert!(coarse > 1.9 * medium && medium > 1.9 * fine, "{coarse} {medium} {fine}");
    assert!(medium < 0.15, "{medium}");
}

/// With held actuators the motion is an exact circle for every sub-step.
#[test]
fn a_circle_closes_whatever_the_sub_step() {
    let model = MotionModel::Kinematic(kinematic(&limits(), 2.6));
    let angle = 0.2;
    let radius = 2.6 / f64::tan(angle);
    for steps in [50_u32, 100, 1000] {
        let time_s = std::f64::consts::TAU * radius / 8.0;
        let mut state = ModelState {
            road_wheel_angle_rad: angle,
            ..ModelState::new(3.0, 4.0, 0.0, 8.0)
        };
        for _ in 0..steps {
            let input = ControlInput {
                accel_mps2: 0.0,
                road_wheel_angle_rad: angle,
            };
            let (next, motion) = model.step(&state, &input, time_s / f64::from(steps));
            assert!((motion.yaw_rate_radps - 8.0 / radius).abs() < 1e-9);
            let coarse = (8.0 / radius * time_s / f64::from(steps)).powi(2) / 24.0;
            assert!((motion.accel_level_mps2[1] / (64.0 / radius) - 1.0).abs() < coarse + 1e-9);
            state = next;
        }
        assert!((state.x_m - 3.0).hypot(state.y_m - 4.0) < 1e-6, "{state:?}");
        assert!((state.yaw_rad - std::f64::consts::TAU).abs() < 1e-9);
    }
}

/// Constant deceleration from 20 m/s: the actuator's lag aside, v² / 2a.
#[test]
fn straight_braking_distance() {
    let model = MotionModel::Kinematic(kinematic(&limits(), 2.6));
    let mut state = ModelState {
        accel_mps2: -5.0,
        ..ModelState::new(0.0, 0.0, 0.0, 20.0)
    };
    for _ in 0..500 {
        state = model
            .step(
                &state,
                &ControlInput {
                    accel_mps2: -5.0,
                    road_wheel_angle_rad: 0.0,
                },
                0.01,
            )
            .0;
    }
    assert_eq!((state.speed_mps, state.accel_mps2), (0.0, 0.0));
    assert!((state.x_m - 40.0).abs() < 1e-3, "{}", state.x_m);
}
