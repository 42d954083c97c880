//! The rigid-body model against closed forms.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

#[path = "common/preset.rs"]
mod preset;

use ipc_schema::config;
use sim_core::models::{
    dimensions::VehicleDimensions,
    dynamic::GRAVITY_MPS2,
    parameters::{ParameterCatalogue, ParameterSet},
    rigid_body::{RigidBody, RigidBodyError, RigidState},
    state::{ControlInput, ModelState},
};

const DT_S: f64 = 0.005;

fn limits() -> config::VehicleConfig {
    config::VehicleConfig {
        max_accel_mps2: 6.0,
        max_decel_mps2: 10.0,
        ..preset::town().vehicle
    }
}

/// The parameter set for a vehicle of this class and length, with the size of the set's own vehicle.
fn set(class: &str, length_m: f64) -> (ParameterSet, VehicleDimensions) {
    let catalogue = ParameterCatalogue::new().unwrap();
    let set = catalogue.sets()[catalogue.choose(class.as_bytes(), length_m).set].clone();
    let body = set.dimensions(set.whole_length_m(), set.width_m, set.height_m);
    (set, body)
}

fn sedan() -> (ParameterSet, VehicleDimensions) {
    set("passenger", 4.8)
}

fn vehicle((set, body): &(ParameterSet, VehicleDimensions), surface: f64) -> RigidBody {
    RigidBody::new(set, body, &limits(), surface, DT_S).unwrap()
}

fn rolling(speed_mps: f64) -> RigidState {
    ModelState::new(0.0, 0.0, 0.0, speed_mps).into()
}

/// Runs for `duration_s`; `input` is a function of time.
fn run(
    vehicle: &mut RigidBody,
    start: RigidState,
    slope_sin: f64,
    duration_s: f64,
    input: impl Fn(f64) -> (f64, f64),
) -> Vec<RigidState> {
    let mut states = vec![start];
    for step in 0..(duration_s / DT_S).round() as u32 {
        let (accel_mps2, road_wheel_angle_rad) = input(f64::from(step) * DT_S);
        let input = ControlInput {
            accel_mps2,
            road_wheel_angle_rad,
        };
        let last = states[states.len() - 1];
        states.push(vehicle.step(&last, &input, slope_sin).0);
    }
    states
}

#[test]
fn at_rest_it_stays_at_rest_also_on_a_grade() {
    for (slope_sin, accel_mps2) in [(0.0, 0.0), (0.0, -2.0), (0.05, -2.0), (-0.05, -2.0), (0.05, 0.0)] {
        let states = run(&mut vehicle(&sedan(), 1.0), rolling(0.0), slope_sin, 20.0, |_| {
            (accel_mps2, 0.1)
        });
        for state in &states {
            let level = state.level;
            assert!(
                level.x_m.hypot(level.y_m) < 1e-6 && level.yaw_rad.abs() < 1e-6,
                "{slope_sin} {level:?}"
            );
            assert!(state.heave[0].abs() < 0.01, "{slope_sin} {:?}", state.heave);
        }
        let end = states[states.len() - 1];
        assert!(end.heave[1].abs() < 1e-6 && end.level.pitch[1].abs() < 1e-6, "{end:?}");
    }
}

#[test]
fn braking_distance() {
    let (speed, decel) = (20.0, 6.0);
    let end = |surface: f64| {
        let states = run(&mut vehicle(&sedan(), surface), rolling(speed), 0.0, 10.0, |_| {
            (-decel, 0.0)
        });
        let end = states[states.len() - 1].level;
        assert!(end.speed_mps.abs() < 1e-12, "{end:?}");
        end.x_m
    };
    // The brake builds up with 30 m/s³ until 2.5 m/s² are missing, then with a lag of 1/12 s: as if applied late by `delay`.
    let linear_s = (decel - 2.5) / 30.0;
    let delay = linear_s * (1.0 - 0.5 * (decel - 2.5) / decel) + 2.5 / decel / 12.0;
    let (found, closed) = (end(1.0), speed * delay + 0.5 * speed * speed / decel);
    assert!((found / closed - 1.0).abs() < 0.01, "dry: {found} for {closed}");
    // On half the friction the tyres end it: 0.95 of it for braking, and rolling resistance and mean drag help.
    let most = 0.5 * 0.95 * GRAVITY_MPS2 + 0.012 * GRAVITY_MPS2 + 0.05;
    let (found, closed) = (end(0.5), speed * 0.5 * most / 30.0 + 0.5 * speed * speed / most);
    assert!((found / closed - 1.0).abs() < 0.02, "slippery: {found} for {closed}");
}

#[test]
fn energy_never_grows_under_braking() {
    let mut vehicle = vehicle(&sedan(), 0.7);
    let states = run(&mut vehicle, rolling(25.0), 0.0, 8.0, |t| (-5.0, 0.1 * (3.0 * t).sin()));
    let energy = |state: &RigidState| state.level.speed_mps.powi(2) + state.level.lateral_mps.powi(2);
    for pair in states.windows(40).skip(40) {
        assert!(energy(&pair[39]) <= energy(&pair[0]), "{:?}", pair[0]);
    }
}

#[test]
fn steady_circle_has_the_understeer_gradient_and_the_roll_of_the_set() {
    for vehicle_set in [sedan(), set("delivery", 5.9), set("bus", 12.0), set("passenger", 4.0)] {
        let (set, body) = &vehicle_set;
        let gradient = 1.0 / set.cornering_stiffness_front_per_rad - 1.0 / set.cornering_stiffness_rear_per_rad;
        for (speed, lateral) in [(3.0, 0.5), (10.0, 1.0), (20.0, 1.5)] {
            let curvature = lateral / (speed * speed);
            let angle = body.wheelbase_m * curvature + gradient * lateral / GRAVITY_MPS2;
            let states = run(&mut vehicle(&vehicle_set, 1.0), rolling(speed), 0.0, 30.0, |_| {
                (0.0, angle)
            });
            let end = states[states.len() - 1].level;
            let found = end.yaw_rate_radps / end.speed_mps;
            let note = format!("{} at {speed} m/s: {found} for {curvature}", set.name);
            assert!((found / curvature - 1.0).abs() < 0.04, "{note}");
            assert!(
                (end.speed_mps / speed - 1.0).abs() < 0.02,
                "{note}, {} m/s",
                end.speed_mps
            );
            let roll = set.roll_per_mps2_rad * end.yaw_rate_radps * end.speed_mps;
            assert!(
                (end.roll[0] / roll - 1.0).abs() < 0.1,
                "{note}, roll {} for {roll}",
                end.roll[0]
            );
        }
    }
}

#[test]
fn snow_holds_less() {
    let found = [1.0, 0.3].map(|surface| {
        let states = run(&mut vehicle(&sedan(), surface), rolling(20.0), 0.0, 4.0, |_| {
            (0.0, 0.12)
        });
        let end = states[states.len() - 1].level;
        (end.yaw_rate_radps * end.speed_mps) / GRAVITY_MPS2
    });
    assert!(found[0] > 0.6 && found[0] < 1.0, "{found:?}");
    assert!(found[1] > 0.15 && found[1] < 0.31, "{found:?}");
}

#[test]
fn step_steer_settles() {
    let states = run(&mut vehicle(&sedan(), 1.0), rolling(20.0), 0.0, 6.0, |t| {
        (0.0, if t < 1.0 { 0.0 } else { 0.03 })
    });
    let end = states[states.len() - 1].level;
    for state in &states[(4.0 / DT_S) as usize..] {
        assert!((state.level.yaw_rate_radps / end.yaw_rate_radps - 1.0).abs() < 0.02);
        assert!((state.level.roll[0] / end.roll[0] - 1.0).abs() < 0.02);
    }
}

#[test]
fn motion_is_the_derivative_of_the_pose() {
    let mut vehicle = vehicle(&sedan(), 1.0);
    let mut state = rolling(10.0);
    let start = ModelState::new(4000.0, -7000.0, 2.0, 10.0);
    state.level = start;
    let (mut at, mut velocity, mut yaw) = ([start.x_m, start.y_m], [0.0; 2], start.yaw_rad);
    velocity[0] = 10.0 * yaw.cos();
    velocity[1] = 10.0 * yaw.sin();
    for step in 0..2000 {
        let t = f64::from(step) * DT_S;
        let input = ControlInput {
            accel_mps2: 2.0 * (1.3 * t).sin(),
            road_wheel_angle_rad: 0.1 * (2.0 * t).sin(),
        };
        let (next, motion) = vehicle.step(&state, &input, 0.0);
        let turn = motion.yaw_rate_radps * DT_S;
        let (sin, cos) = (yaw + 0.5 * turn).sin_cos();
        let [along, left] = motion.accel_level_mps2;
        let change = [(along * cos - left * sin) * DT_S, (along * sin + left * cos) * DT_S];
        for axis in [0, 1] {
            at[axis] += (velocity[axis] + 0.5 * change[axis]) * DT_S;
            velocity[axis] += change[axis];
        }
        yaw += turn;
        state = next;
    }
    let level = state.level;
    assert!((level.x_m - at[0]).hypot(level.y_m - at[1]) < 1e-3, "{level:?} {at:?}");
    assert!((level.yaw_rad - yaw).abs() < 1e-6);
    assert!((level.x_m - start.x_m).hypot(level.y_m - start.y_m) > 50.0);
}

#[test]
fn the_motion_depends_on_the_state_alone() {
    let drive = |t: f64| (2.0 * t.sin(), 0.2 * (3.0 * t).sin());
    let alone = run(&mut vehicle(&sedan(), 1.0), rolling(15.0), 0.02, 5.0, drive);
    // The same again, with another vehicle in the same world in between.
    let mut shared = vehicle(&sedan(), 1.0);
    let (mut one, mut other) = (rolling(15.0), rolling(2.0));
    for (step, expected) in alone[1..].iter().enumerate() {
        let (accel_mps2, road_wheel_angle_rad) = drive(step as f64 * DT_S);
        let input = ControlInput {
            accel_mps2,
            road_wheel_angle_rad,
        };
        one = shared.step(&one, &input, 0.02).0;
        other = shared.step(&other, &ControlInput::default(), 0.0).0;
        assert_eq!(one, *expected);
    }
}

#[test]
fn two_wheelers_are_refused() {
    let (set, body) = set("bicycle", 1.6);
    let refused = RigidBody::new(&set, &body, &limits(), 1.0, DT_S).err().unwrap();
    assert_eq!(
        refused,
        RigidBodyError::LeansIn {
            set: "bicycle".to_owned()
        }
    );
}

#[test]
fn any_input_leaves_the_state_finite_and_steering_gains_no_speed() {
    let four_wheels = ParameterCatalogue::new().unwrap();
    for set in four_wheels.sets().iter().filter(|set| set.roll_per_mps2_rad > 0.0) {
        let body = set.dimensions(set.whole_length_m(), set.width_m, set.height_m);
        for (surface, speed) in [(1.0, 25.0), (0.3, 25.0), (1.0, 8.0)] {
            let mut vehicle = vehicle(&(set.clone(), body), surface);
            let states = run(&mut vehicle, rolling(speed), 0.0, 30.0, |t| {
                (0.0, 0.6 * (1.7 * t).sin().signum())
            });
            for state in &states {
                let ModelState {
                    speed_mps,
                    lateral_mps,
                    yaw_rate_radps,
                    roll,
                    pitch,
                    ..
                } = state.level;
                let note = format!("{} on {surface} from {speed} m/s: {state:?}", set.name);
                assert!(speed_mps.hypot(lateral_mps) < 1.1 * speed, "{note}");
                assert!(yaw_rate_radps.abs() < 10.0 && roll[0].is_finite(), "{note}");
                // A vehicle whose centre of gravity is higher than half its track over friction tips over; cars do not.
                let car = set.cg_height_m < 0.6;
                assert!(!car || (roll[0].abs() < 0.3 && pitch[0].abs() < 0.1), "{note}");
            }
        }
    }
}
