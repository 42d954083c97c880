//! A vehicle in a batch moves as it does alone.

use super::*;
use crate::models::{dimensions::VehicleDimensions, parameters::ParameterCatalogue};
use crate::preset;
use ipc_schema::config;
use proptest::prelude::*;

fn limits() -> config::VehicleConfig {
    preset::town().vehicle
}

#[derive(Debug, Clone)]
struct Case {
    state: ModelState,
    curve: ReferenceCurve,
    rise: RoadRise,
    body: VehicleDimensions,
}

fn case() -> impl Strategy<Value = Case> {
    let state = (
        -3.1_f64..3.1,
        prop_oneof![Just(0.0), 0.0_f64..40.0],
        -9.0_f64..5.0,
        -0.6_f64..0.6,
        prop::array::uniform2(-0.5_f64..0.5),
    );
    let slope = prop::array::uniform3(-0.05_f64..0.05);
    (state, prop::array::uniform4(-15.0_f64..15.0), slope, 2.0_f64..18.0).prop_map(
        |((yaw, speed, accel, angle, [lateral, rate]), c, slope_rad, length_m)| {
            let body = ParameterCatalogue::new().unwrap().sets()[0].dimensions(length_m, 2.0, 1.5);
            let state = ModelState {
                accel_mps2: accel,
                road_wheel_angle_rad: angle,
                lateral_mps: lateral,
                yaw_rate_radps: rate,
                roll: [0.1 * lateral, rate],
                pitch: [0.1 * rate, lateral],
                ..ModelState::new(5.0, -7.0, yaw, speed)
            };
            let start = state.point_ahead(body.front_m());
            let curve = ReferenceCurve::hermite(
                [start[0] + 0.1 * c[0], start[1]],
                [c[1], c[2]],
                [[c[2], c[3]], [c[0], c[1]]],
                0.7,
            );
            let rise = RoadRise {
                height_m: [0.0, slope_rad[1], slope_rad[2]],
                slope_rad,
            };
            Case {
                state,
                curve,
                rise,
                body,
            }
        },
    )
}

/// The same vehicle alone: tracker and model one after the other.
fn alone<P: BatchModel<N>, const N: usize>(
    case: &Case,
    params: &P,
    sub_steps: usize,
) -> Vec<(ModelState, SubStepMotion)> {
    let front_m = case.body.front_m();
    let mut state = case.state;
    let mut slope = road_at(&case.rise, front_m, 0.0)[2];
    let mut input = ControlInput::default();
    (0..sub_steps)
        .map(|index| {
            let time_s = index as f64 * 0.01;
            if index % 2 == 0 {
                input = params.demand(front_m, &state, &case.curve.at(time_s));
            }
            let (next, motion) = params.step(&state, &input, slope, 0.01);
            slope = road_at(&case.rise, front_m, time_s + 0.01)[2];
            state = next;
            (next, motion)
        })
        .collect()
}

fn compare<P: BatchModel<N>, const N: usize>(cases: &[Case], params: &[P]) -> Result<(), TestCaseError> {
    let mut batch: VehicleBatch<P, N> = VehicleBatch::new(10);
    for (member, (case, params)) in cases.iter().zip(params).enumerate() {
        batch.set_model(member, member as u32, params, false);
        batch.load(member, &case.state, (&case.curve, &case.rise), case.body.front_m());
    }
    let mut baseline = batch.clone();
    batch.advance(0.01, &|_| ());
    baseline.advance_here(0.01, &|_| ());
    prop_assert_eq!(&batch.rows, &baseline.rows, "whatever the processor's vectors");
    // With room between the members.
    let mut all = vec![SubStep::default(); 20 * cases.len()];
    batch.write_all((0..cases.len()).map(|member| 20 * member), &mut all);
    for (member, (case, params)) in cases.iter().zip(params).enumerate() {
        let steps = alone(case, params, 10);
        let mut rows = [SubStep::default(); 10];
        batch.write(member, &mut rows);
        prop_assert_eq!(&rows[..], &all[20 * member..][..10]);
        for ((state, _), row) in steps.iter().zip(&rows) {
            prop_assert!((f64::from(row.dx_m) - (state.x_m - steps[9].0.x_m)).abs() < 1e-5);
            prop_assert!((f64::from(row.dyaw_rad) - (state.yaw_rad - steps[9].0.yaw_rad)).abs() < 1e-6);
            prop_assert_eq!(row.lateral_speed_mps, state.lateral_mps as f32);
            prop_assert_eq!(row.roll_rad, state.roll[0] as f32);
            prop_assert_eq!(row.road_wheel_angle_rad, state.road_wheel_angle_rad as f32);
        }
        prop_assert_eq!(steps[9].0, batch.state(member));
    }
    Ok(())
}

proptest! {
        #[test]
        fn side_by_side_gives_the_same_bits_as_alone(cases in prop::collection::vec(case(), 1..=BATCH)) {
            let catalogue = ParameterCatalogue::new().unwrap();
            let set = &catalogue.sets()[0];
            let kinematic: Vec<_> =
                cases.iter().map(|case| KinematicParams::new(set, &limits(), case.body.wheelbase_m)).collect();
            compare(&cases, &kinematic)?;
            let dynamic: Vec<_> =
                cases.iter().map(|case| DynamicParams::new(set, &case.body, &limits(), 0.7, 0.01)).collect();
            compare(&cases, &dynamic)?;
        }

        #[test]
        fn whatever_the_demand_the_numbers_stay_finite(case in case()) {
            let catalogue = ParameterCatalogue::new().unwrap();
            let params = DynamicParams::new(&catalogue.sets()[0], &case.body, &limits(), 0.3, 0.01);
            for (state, motion) in alone(&case, &params, 200) {
                prop_assert!(bytemuck::cast::<ModelState, [f64; STATE]>(state).iter().all(|number| number.is_finite()));
prop_assert!(motion.accel_level_mps2.iter().all(|accel| accel.is_finite()));
            }
        }
    }
