//! The dynamic single-track model against closed forms, physical invariants and an independent implementation.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

mod common;

use common::limits;
use ipc_schema::config;
use proptest::prelude::*;
use sim_core::models::{
    dimensions::VehicleDimensions,
    dynamic::{DynamicParams, GRAVITY_MPS2},
    parameters::{ParameterCatalogue, ParameterSet},
    state::{ControlInput, ModelState},
};

const DT_S: f64 = 0.01;

fn wide() -> config::VehicleConfig {
    config::VehicleConfig {
        max_accel_mps2: 10.0,
        max_decel_mps2: 12.0,
        ..limits()
    }
}

fn set(class: &str, length_m: f64) -> (ParameterSet, VehicleDimensions) {
    let catalogue = ParameterCatalogue::new().unwrap();
    let set = catalogue.sets()[catalogue.choose(class.as_bytes(), length_m).set].clone();
    let body = set.dimensions(length_m, set.width_m, set.height_m);
    (set, body)
}

fn sedan(surface: f64, dt_s: f64) -> DynamicParams {
    let (set, body) = set("passenger", 4.7);
    DynamicParams::new(&set, &body, &wide(), surface, dt_s)
}

/// All kinds of vehicle, on a dry road.
fn every_kind() -> Vec<(String, DynamicParams)> {
    let catalogue = ParameterCatalogue::new().unwrap();
    let all = catalogue.sets().iter().map(|set| {
        let body = set.dimensions(set.whole_length_m(), set.width_m, set.height_m);
        {
            // These tests need 15 m/s, which a cyclist cannot hold.
            let params = DynamicParams {
                max_power_by_mass: 1e9,
                ..DynamicParams::new(set, &body, &wide(), 1.0, DT_S)
            };
            (set.name.clone(), params)
        }
    });
    all.collect()
}

fn rolling(speed_mps: f64) -> ModelState {
    ModelState::new(0.0, 0.0, 0.0, speed_mps)
}

fn run(params: &DynamicParams, mut state: ModelState, input: ControlInput, seconds: f64, dt_s: f64) -> Vec<ModelState> {
    let steps = (seconds / dt_s).round() as usize;
    (0..steps)
        .map(|_| {
            state = params.step(&state, &input, 0.0, dt_s).0;
            state
        })
        .collect()
}

fn steering(road_wheel_angle_rad: f64) -> ControlInput {
    ControlInput {
        accel_mps2: 0.0,
        road_wheel_angle_rad,
    }
}

fn braking(decel_mps2: f64) -> ControlInput {
    ControlInput {
        accel_mps2: -decel_mps2,
        road_wheel_angle_rad: 0.0,
    }
}

/// Distance of a stop with deceleration `a` that is reached at once: v² / 2a; the lag of the actuator, 1/12 s, adds v · lag.
#[test]
fn straight_braking_distance() {
    let dry = sedan(1.0, DT_S);
    let states = run(&dry, rolling(20.0), braking(6.0), 10.0, DT_S);
    let end = states.last().unwrap();
    let expected = 20.0 * 20.0 / (2.0 * 6.0) + 20.0 / 12.0;
    assert_eq!(end.speed_mps, 0.0);
    assert!((end.x_m / expected - 1.0).abs() < 0.02, "{} {expected}", end.x_m);
    // On snow the friction decides: 0.95 of it for the brakes.
    let snow = sedan(0.3, DT_S);
    let end = *run(&snow, rolling(20.0), braking(9.0), 15.0, DT_S).last().unwrap();
    let expected = 20.0 * 20.0 / (2.0 * 0.95 * snow.friction * GRAVITY_MPS2);
    assert!((end.x_m / expected - 1.0).abs() < 0.05, "{} {expected}", end.x_m);
}

/// In a steady bend `δ = L / R + K ay`, K = (1/Cf − 1/Cr) / g with stiffness by load (T. Gillespie, *Fundamentals of Vehicle
/// Dynamics*, chapter 6).
#[test]
fn steady_state_circle_against_the_understeer_gradient() {
    for (name, params) in every_kind() {
        let [front, rear] = params.stiffness_per_rad;
        let gradient = (1.0 / front - 1.0 / rear) / GRAVITY_MPS2;
        for speed in [8.0, 15.0] {
            let angle = 1.0 / (speed * speed) * params.wheelbase_m + gradient;
            let held = run(&params, rolling(speed), steering(angle), 12.0, DT_S);
            let end = held.last().unwrap();
            let accel = end.speed_mps * end.yaw_rate_radps;
            let expected = params.wheelbase_m * end.yaw_rate_radps / end.speed_mps + gradient * accel;
            assert!(
                (expected / angle - 1.0).abs() < 0.03,
                "{name} at {speed} m/s: {expected} {angle} ({accel} m/s²)"
            );
            assert!((end.speed_mps - speed).abs() < 0.5, "{name}: {}", end.speed_mps);
        }
    }
}

#[test]
fn a_step_of_the_steering_settles_with_its_roll() {
    for (name, params) in every_kind() {
        let states = run(&params, rolling(15.0), steering(0.02), 12.0, DT_S);
        let end = *states.last().unwrap();
        let settled = &states[800..];
        let within = |value: fn(&ModelState) -> f64, tolerance: f64| {
            settled
                .iter()
                .all(|state| (value(state) - value(&end)).abs() <= tolerance)
        };
        assert!(end.yaw_rate_radps > 0.01, "{name}: {end:?}");
        assert!(
            within(|s| s.yaw_rate_radps, 0.01 * end.yaw_rate_radps),
            "{name} still turns in"
        );
        assert!(
            within(|s| s.roll[0], 0.02 * end.roll[0].abs() + 1e-6),
            "{name} still rolls"
        );
        let most = states.iter().map(|s| s.yaw_rate_radps).fold(0.0, f64::max);
        assert!(most < 1.4 * end.yaw_rate_radps, "{name} overshoots to {most}");
        let catalogue = ParameterCatalogue::new().unwrap();
        let set = catalogue.sets().iter().find(|set| set.name == name).unwrap();
        let leaning = set.roll_per_mps2_rad * end.speed_mps * end.yaw_rate_radps;
        assert!(
            (end.roll[0] / leaning - 1.0).abs() < 0.03,
            "{name}: {} {leaning}",
            end.roll[0]
        );
    }
}

/// In a steady bend a two-wheeler leans into it by the balance of a thin wheel, `atan(a / g)`, linearised: too far by `(a / g)³ / 3`. An
/// accelerometer across its body then feels next to nothing, where that of a car feels the bend and its own roll.
#[test]
fn two_wheelers_lean_into_the_bend_until_nothing_pulls_sideways() {
    for (name, params) in every_kind() {
        for lateral in [1.0, 2.5] {
            let speed = 9.0;
            let gradient = (1.0 / params.stiffness_per_rad[0] - 1.0 / params.stiffness_per_rad[1]) / GRAVITY_MPS2;
            let angle = (params.wheelbase_m / (speed * speed) + gradient) * lateral;
            let end = *run(&params, rolling(speed), steering(angle), 12.0, DT_S)
                .last()
                .unwrap();
            let accel = end.speed_mps * end.yaw_rate_radps;
            let across = accel * end.roll[0].cos() + GRAVITY_MPS2 * end.roll[0].sin();
            if ["motorcycle", "bicycle"].contains(&name.as_str()) {
                let share = accel / GRAVITY_MPS2;
                let off = -end.roll[0] - share.atan();
                assert!(
                    off.abs() < share.powi(3) / 3.0 + 0.002,
                    "{name} leans {off} rad too far"
                );
                assert!(
                    across.abs() < 0.02 * accel + GRAVITY_MPS2 * share.powi(3) / 3.0,
                    "{name}: {across} m/s²"
                );
            } else {
                assert!(
                    end.roll[0] > 0.0 && across > accel,
                    "{name} leans out of the bend: {:?}",
                    end.roll
                );
            }
        }
    }
}

/// With actuators that follow at once, the error falls with the square of the sub-step.
#[test]
fn halving_the_sub_step_quarters_the_error() {
    let slalom = |steps: u32| {
        let dt_s = 4.0 / f64::from(steps);
        let params = DynamicParams {
            actuator_rate_per_s: [1e9; 2],
            max_road_wheel_rate_radps: 1e9,
            ..sedan(1.0, dt_s)
        };
        let mut state = rolling(20.0);
        for i in 1..=steps {
            let input = steering(0.03 * (3.0 * f64::from(i) * dt_s).sin());
            state = params.step(&state, &input, 0.0, dt_s).0;
        }
        state
    };
    let exact = slalom(51_200);
    let error = |steps| {
        let state = slalom(steps);
        (state.x_m - exact.x_m).hypot(state.y_m - exact.y_m)
    };
    let (coarse, medium, fine) = (error(200), error(400), error(800));
    assert!(coarse / medium > 3.4 && medium / fine > 3.4, "{coarse} {medium} {fine}");
    assert!(medium < 0.002, "{medium} m at 10 ms");
}

/// Slip of the rear wheels: at small forces the force by the stiffness, driven forwards, braked backwards, none without a force; at the
/// limit that of the saturating tyre.
#[test]
fn rear_wheels_slip_as_the_tyre_gives_its_force() {
    for (name, params) in every_kind() {
        let at = |accel_mps2: f64, speed_mps: f64, slope_sin: f64| {
            let state = ModelState {
                accel_mps2,
                ..rolling(speed_mps)
            };
            params.rear_wheel_slip(&state, slope_sin)
        };
        assert_eq!(at(-3.0, 0.0, 0.0), 0.0, "{name}: it stands");
        let resistance = params.drag_by_mass_per_m * 225.0 + params.rolling_mps2;
        assert!(at(-resistance, 15.0, 0.0).abs() < 1e-15, "{name}: it rolls");
        assert!(
            at(-resistance, 15.0, 0.05) >= 0.0 && at(-resistance, 15.0, -0.05) <= 0.0,
            "{name}"
        );
        let force = -0.5 - (-resistance);
        let share = 1.0 - params.share_front[usize::from(force <= 0.0)];
        let linear = share * force / (params.stiffness_per_rad[1] * params.loads_mps2(-0.5)[1]);
        assert!(
            (at(-0.5, 15.0, 0.0) / linear - 1.0).abs() < 0.02,
            "{name}: {} {linear}",
            at(-0.5, 15.0, 0.0)
        );
        // Braked at the limit: 0.95 of the friction, so 0.95 / √(1 − 0.95²) of μ / C.
        let locked = at(-30.0, 15.0, 0.0);
        let expected = -0.95 / (1.0_f64 - 0.95 * 0.95).sqrt() * params.friction / params.stiffness_per_rad[1];
        assert!((locked / expected - 1.0).abs() < 1e-9, "{name}: {locked} {expected}");
    }
}

#[test]
fn at_rest_it_stays_at_rest_on_a_grade() {
    for (name, params) in every_kind() {
        for slope_sin in [-0.12, 0.0, 0.12] {
            let mut state = rolling(0.0);
            for _ in 0..500 {
                state = params.step(&state, &steering(0.3), slope_sin, DT_S).0;
            }
            assert_eq!(
                [state.x_m, state.y_m, state.yaw_rad, state.speed_mps],
                [0.0; 4],
                "{name}"
            );
        }
    }
}

#[test]
fn a_grade_and_the_engine_limit_the_speed() {
    let params = sedan(1.0, DT_S);
    let full = ControlInput {
        accel_mps2: 10.0,
        road_wheel_angle_rad: 0.0,
    };
    let mut state = rolling(10.0);
    for _ in 0..60_000 {
        state = params.step(&state, &full, 0.1, DT_S).0;
    }
    let resisting =
        params.drag_by_mass_per_m * state.speed_mps * state.speed_mps + params.rolling_mps2 + 0.1 * GRAVITY_MPS2;
    let balance = resisting * state.speed_mps / params.max_power_by_mass;
    assert!((balance - 1.0).abs() < 0.01, "{balance} at {} m/s", state.speed_mps);
}

proptest! {
    /// At any state of the wheels brakes never add energy (of the plane motion, by mass), and no axle gives more than its friction.
    #[test]
    fn energy_never_grows_under_braking(
        speed in 0.0_f64..40.0, angle in -0.5_f64..0.5, decel in 3.0_f64..9.0, surface in prop::sample::select(vec![0.3, 0.7, 1.0]),
    ) {
        let params = sedan(surface, DT_S);
        let energy = |state: &ModelState| {
            let lateral = state.lateral_mps + params.cg_to_rear_m * state.yaw_rate_radps;
            0.5 * (state.speed_mps.powi(2) + lateral.powi(2) + state.yaw_rate_radps.powi(2) / params.mass_by_inertia_per_m2)
        };
        let mut state = rolling(speed);
        let input = ControlInput { road_wheel_angle_rad: angle, ..braking(decel) };
        for _ in 0..2_000 {
            let next = params.step(&state, &input, 0.0, DT_S).0;
            prop_assert!(energy(&next) <= energy(&state) * (1.0 + 1e-9) + 1e-9, "{:?} {:?}", state, next);
            state = next;
        }
        prop_assert_eq!(state.speed_mps, 0.0);
    }

    /// With any steering on any surface, a vehicle neither spins around nor gains speed.
    #[test]
    fn steering_alone_neither_spins_nor_speeds_up(
        speed in 1.0_f64..25.0, angle in -0.15_f64..0.15, surface in prop::sample::select(vec![0.3, 0.7, 1.0]),
    ) {
        let params = sedan(surface, DT_S);
        for state in run(&params, rolling(speed), steering(angle), 8.0, DT_S) {
            prop_assert!(state.speed_mps <= 1.02 * speed + 0.05, "{} m/s", state.speed_mps);
            prop_assert!(state.lateral_mps.abs() < 2.0 * state.speed_mps.max(2.0), "{:?}", state);
        }
    }
}

#[derive(Debug, serde::Deserialize)]
struct Reference {
    mass_kg: f64,
    yaw_inertia_kgm2: f64,
    cg_to_front_m: f64,
    cg_to_rear_m: f64,
    height_m: f64,
    friction: f64,
    stiffness_front_per_rad: f64,
    stiffness_rear_per_rad: f64,
    frequency_hz: f64,
}

/// The dynamic model with the reference's parameters: its tyres are linear (friction out of reach), its stiffness is multiplied by the
/// friction, speed is held, steering follows at once.
fn like(reference: &Reference, dt_s: f64) -> DynamicParams {
    let wheelbase_m = reference.cg_to_front_m + reference.cg_to_rear_m;
    DynamicParams {
        wheelbase_m,
        cg_to_rear_m: reference.cg_to_rear_m,
        mass_by_inertia_per_m2: reference.mass_kg / reference.yaw_inertia_kgm2,
        height_by_wheelbase: reference.height_m / wheelbase_m,
        stiffness_per_rad: [reference.stiffness_front_per_rad, reference.stiffness_rear_per_rad]
            .map(|stiffness| stiffness * reference.friction),
        friction: 1e3,
        max_road_wheel_angle_rad: 1.0,
        max_road_wheel_rate_radps: 1e9,
        max_power_by_mass: 1e9,
        drag_by_mass_per_m: 0.0,
        rolling_mps2: 0.0,
        actuator_rate_per_s: [1e9; 2],
        ..sedan(1.0, dt_s)
    }
}

/// commonroad-vehicle-models' single-track model, integrated at a tolerance of 1e-9 (`data/commonroad_st.py`): 10 s of sine steer
/// at 5, 15 and 30 m/s, at about 2 m/s² of lateral acceleration. The difference: the reference is linear in the angles. With the
/// friction of the reference's parameters, and so saturation, they agree too.
#[test]
fn trajectories_agree_with_an_independent_single_track_model() {
    let reference: Reference = serde_json::from_str(include_str!("data/commonroad_st.json")).unwrap();
    let rows: Vec<Vec<f64>> = include_str!("data/commonroad_st.csv")
        .lines()
        .skip(1)
        .map(|line| line.split(',').map(|number| number.parse().unwrap()).collect())
        .collect();
    let linear = like(&reference, DT_S);
    let saturating = DynamicParams {
        friction: reference.friction,
        ..linear
    };
    for speed in [5.0, 15.0, 30.0] {
        let rows: Vec<&Vec<f64>> = rows.iter().filter(|row| row[0] == speed).collect();
        for (params, position_m, yaw_rad, rate_radps) in
            [(linear, 0.06, 5e-4, 0.0015), (saturating, 0.06, 5e-4, 0.0015)]
        {
            let mut state = ModelState::new(-reference.cg_to_rear_m, 0.0, 0.0, speed);
            let (mut worst, mut tick) = ([0.0_f64; 3], 0);
            for row in &rows[1..] {
                let until = (row[2] / DT_S).round() as u32;
                while tick < until {
                    tick += 1;
                    let time_s = f64::from(tick) * DT_S;
                    let angle = row[1] * (std::f64::consts::TAU * reference.frequency_hz * time_s).sin();
                    state = params.step(&state, &steering(angle), 0.0, DT_S).0;
                }
                let cg = state.point_ahead(reference.cg_to_rear_m);
                worst[0] = worst[0].max((cg[0] - row[3]).hypot(cg[1] - row[4]));
                worst[1] = worst[1].max((state.yaw_rad - row[7]).abs());
                worst[2] = worst[2].max((state.yaw_rate_radps - row[8]).abs());
            }
            println!("{speed} m/s, friction {}: {worst:?}", params.friction);
            assert!(
                worst[0] < position_m && worst[1] < yaw_rad && worst[2] < rate_radps,
                "{speed} m/s, friction {}: {worst:?}",
                params.friction
            );
        }
    }
}
