//! Prints responses of the vehicle models as CSV, from which the figures of `docs/vehicle-model.md` are drawn.
//!
//! `cargo run --release -p sim-core --example response > response.csv`. Vehicle: the set `sedan` at its own size, sub-steps of 5 ms.
//! `circle`: end states after 12 s at a held road-wheel angle and 20 m/s. `step`: 0.03 rad from t = 0.5 s on, at 20 m/s. `brake`: full
//! braking from 30 m/s.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "an example asserts by unwrapping and prints"
)]

#[path = "../tests/common/preset.rs"]
mod preset;

use ipc_schema::config::{self, Surface};
use sim_core::models::{
    catalogue::{MotionModel, friction_share},
    dimensions::VehicleDimensions,
    dynamic::DynamicParams,
    kinematic::KinematicParams,
    parameters::{ParameterCatalogue, ParameterSet},
    rigid_body::{RigidBody, RigidState},
    state::{ControlInput, ModelState, SubStepMotion},
};

const DT_S: f64 = 0.005;
const SPEED_MPS: f64 = 20.0;
fn limits() -> config::VehicleConfig {
    config::VehicleConfig {
        max_accel_mps2: 6.0,
        max_decel_mps2: 10.0,
        ..preset::town().vehicle
    }
}

/// A moving vehicle.
#[expect(clippy::large_enum_variant, reason = "two values in all")]
enum Vehicle {
    Plain(MotionModel, ModelState),
    Rigid(Box<RigidBody>, RigidState),
}

impl Vehicle {
    fn new(model: &str, set: &ParameterSet, body: &VehicleDimensions, surface: Surface, speed_mps: f64) -> Self {
        let (share, start) = (friction_share(surface), ModelState::new(0.0, 0.0, 0.0, speed_mps));
        match model {
            "kinematic" => Self::Plain(
                MotionModel::Kinematic(KinematicParams::new(set, &limits(), body.wheelbase_m)),
                start,
            ),
            "dynamic" => Self::Plain(
                MotionModel::Dynamic(DynamicParams::new(set, body, &limits(), share, DT_S)),
                start,
            ),
            _ => Self::Rigid(
                Box::new(RigidBody::new(set, body, &limits(), share, DT_S).unwrap()),
                start.into(),
            ),
        }
    }

    fn state(&self) -> ModelState {
        match self {
            Self::Plain(_, state) => *state,
            Self::Rigid(_, state) => state.level,
        }
    }

    fn step(&mut self, accel_mps2: f64, road_wheel_angle_rad: f64) -> SubStepMotion {
        let input = ControlInput {
            accel_mps2,
            road_wheel_angle_rad,
        };
        match self {
            Self::Plain(model, state) => {
                let (next, motion) = model.step(state, &input, DT_S);
                *state = next;
                motion
            }
            Self::Rigid(body, state) => {
                let (next, motion) = body.step(state, &input, 0.0);
                *state = next;
                motion
            }
        }
    }
}

/// The models, with their names.
struct Case<'a> {
    figure: &'a str,
    model: &'a str,
    surface: Surface,
}

fn print(case: &Case<'_>, time_s: f64, vehicle: &Vehicle, motion: &SubStepMotion, cg_to_rear_m: f64) {
    let state = vehicle.state();
    let slip = libm::atan2(
        state.lateral_mps + cg_to_rear_m * state.yaw_rate_radps,
        state.speed_mps.max(0.01),
    );
    println!(
        "{},{},{},{time_s:.3},{:.5},{:.4},{:.4},{:.4},{:.5},{slip:.5},{:.5},{:.5}",
        case.figure,
        case.model,
        format!("{:?}", case.surface).to_lowercase(),
        state.road_wheel_angle_rad,
        state.speed_mps,
        state.x_m,
        motion.accel_level_mps2[1],
        state.yaw_rate_radps,
        state.roll[0],
        state.pitch[0],
    );
}

fn main() {
    let catalogue = ParameterCatalogue::new().unwrap();
    let set = catalogue.sets().iter().find(|set| set.name == "sedan").unwrap();
    let body = set.dimensions(set.whole_length_m(), set.width_m, set.height_m);
    let cg = set.front_load_share * body.wheelbase_m;
    println!(
        "figure,model,surface,t_s,road_wheel_angle_rad,speed_mps,x_m,lateral_mps2,yaw_rate_radps,slip_rad,roll_rad,pitch_rad"
    );
    let models = ["kinematic", "dynamic", "rigid_body"];
    let run =
        |case: &Case<'_>, speed: f64, duration_s: f64, each: u32, input: &dyn Fn(f64, &ModelState) -> (f64, f64)| {
            let mut vehicle = Vehicle::new(case.model, set, &body, case.surface, speed);
            let steps = (duration_s / DT_S).round() as u32;
            for step in 1..=steps {
                let (accel, angle) = input(f64::from(step - 1) * DT_S, &vehicle.state());
                let motion = vehicle.step(accel, angle);
                if step.is_multiple_of(each) || (each == 0 && step == steps) {
                    print(case, f64::from(step) * DT_S, &vehicle, &motion, cg);
                }
            }
        };
    let hold = |state: &ModelState| 2.0 * (SPEED_MPS - state.speed_mps);
    for model in models {
        for surface in [Surface::Dry, Surface::Snow] {
            let case = Case {
                figure: "circle",
                model,
                surface,
            };
            for angle in (1..=40).map(|i| 0.0025 * f64::from(i)) {
                run(&case, SPEED_MPS, 12.0, 0, &|_, state| (hold(state), angle));
            }
        }
        let case = Case {
            figure: "step",
            model,
            surface: Surface::Dry,
        };
        run(&case, SPEED_MPS, 3.0, 2, &|t, state| {
            (hold(state), if t < 0.5 { 0.0 } else { 0.03 })
        });
        for surface in [Surface::Dry, Surface::Wet, Surface::Snow] {
            let case = Case {
                figure: "brake",
                model,
                surface,
            };
            run(&case, 30.0, 14.0, 4, &|_, _| (-9.5, 0.0));
        }
    }
}
