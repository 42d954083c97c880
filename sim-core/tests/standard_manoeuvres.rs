//! Standard manoeuvres of the dynamic model, set by set: steady-state circle (ISO 4138), step and sine of the steering (ISO 7401), sine
//! with dwell (FMVSS 126), standing start, full braking and coast-down, against closed forms, data sheets and regulations.
//! `docs/vehicle-model.md` has the tables.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

#[path = "common/page.rs"]
mod page;
#[path = "common/preset.rs"]
mod preset;

use std::{f64::consts::TAU, fmt::Write as _};

use ipc_schema::config;
use sim_core::models::{
    catalogue::MotionModel,
    dynamic::{AIR_KGPM3, DynamicParams, GRAVITY_MPS2},
    kinematic::KinematicParams,
    parameters::{ParameterCatalogue, ParameterSet},
    state::{ControlInput, ModelState},
};

const DT_S: f64 = 0.002;
const KMH: f64 = 1.0 / 3.6;

fn sets() -> Vec<ParameterSet> {
    ParameterCatalogue::new().unwrap().sets().to_vec()
}

fn named(name: &str) -> ParameterSet {
    sets().into_iter().find(|set| set.name == name).unwrap()
}

/// Limits beyond those of every set.
fn wide() -> config::VehicleConfig {
    config::VehicleConfig {
        max_accel_mps2: 20.0,
        max_decel_mps2: 20.0,
        max_road_wheel_angle_rad: 1.5,
        max_road_wheel_rate_radps: 10.0,
        ..preset::town().vehicle
    }
}

fn dynamic(set: &ParameterSet) -> DynamicParams {
    let body = set.dimensions(set.whole_length_m(), set.width_m, set.height_m);
    DynamicParams::new(set, &body, &wide(), 1.0, DT_S)
}

/// The model that moves vehicles of this set unless the configuration says otherwise.
fn usual_model(set: &ParameterSet) -> MotionModel {
    if set.kinematic {
        MotionModel::Kinematic(KinematicParams::new(set, &wide(), set.wheelbase_m))
    } else {
        MotionModel::Dynamic(dynamic(set))
    }
}

/// Sets whose vehicles roll on tyres.
fn on_tyres() -> Vec<ParameterSet> {
    sets().into_iter().filter(|set| !set.kinematic).collect()
}

/// Speed of the handling tests, m/s: 80 km/h as ISO 7401 has it, less for what does not drive as fast.
fn test_speed_mps(set: &ParameterSet) -> f64 {
    match set.name.as_str() {
        "bicycle" => 20.0 * KMH,
        "bus" | "articulated_bus" | "truck" | "trailer_truck" => 60.0 * KMH,
        _ => 80.0 * KMH,
    }
}

/// Steady lateral acceleration of the step, m/s²: 4 as ISO 7401 has it, less for what is tall.
fn test_lateral_mps2(set: &ParameterSet) -> f64 {
    match set.name.as_str() {
        "bus" | "articulated_bus" | "truck" | "trailer_truck" | "bicycle" => 2.0,
        _ => 4.0,
    }
}

/// Understeer gradient, road-wheel angle by lateral acceleration, rad per m/s² (Gillespie, *Fundamentals of Vehicle Dynamics*, chapter 6).
fn understeer(set: &ParameterSet) -> f64 {
    (1.0 / set.cornering_stiffness_front_per_rad - 1.0 / set.cornering_stiffness_rear_per_rad) / GRAVITY_MPS2
}

/// The linear single-track model at a speed: `[w', r'] = A [w, r] + b δ` (Rajamani, section 2.3; M. Mitschke and H. Wallentowitz,
/// *Dynamik der Kraftfahrzeuge*, chapter 19).
struct Linear {
    a: [[f64; 2]; 2],
    b: [f64; 2],
}

impl Linear {
    fn new(set: &ParameterSet, speed_mps: f64) -> Self {
        let lr = set.front_load_share * set.wheelbase_m;
        let lf = set.wheelbase_m - lr;
        let turning = set.mass_kg / set.yaw_inertia_kgm2;
        let front = set.cornering_stiffness_front_per_rad * GRAVITY_MPS2 * lr / set.wheelbase_m;
        let rear = set.cornering_stiffness_rear_per_rad * GRAVITY_MPS2 * lf / set.wheelbase_m;
        Self {
            a: [
                [
                    -(front + rear) / speed_mps,
                    (lr * rear - lf * front) / speed_mps - speed_mps,
                ],
                [
                    turning * (lr * rear - lf * front) / speed_mps,
                    -turning * (lf * lf * front + lr * lr * rear) / speed_mps,
                ],
            ],
            b: [front, turning * lf * front],
        }
    }

    /// Undamped natural frequency, Hz, and damping ratio.
    fn mode(&self) -> [f64; 2] {
        let [[a, b], [c, d]] = self.a;
        let natural = (a * d - b * c).sqrt();
        [natural / TAU, -0.5 * (a + d) / natural]
    }

    /// Yaw rate by road-wheel angle at a frequency: gain, 1/s, and phase, radians.
    fn yaw_response(&self, frequency_hz: f64) -> [f64; 2] {
        let w = TAU * frequency_hz;
        let [[a, b], [c, d]] = self.a;
        // (b₂ (jω − a) + c b₁) / ((jω − a) (jω − d) − b c)
        let above = [self.b[0] * c - self.b[1] * a, self.b[1] * w];
        let below = [a * d - b * c - w * w, -w * (a + d)];
        let gain = above[0].hypot(above[1]) / below[0].hypot(below[1]);
        [gain, above[1].atan2(above[0]) - below[1].atan2(below[0])]
    }
}

/// A driver who holds the speed, and this road-wheel angle.
fn holding(state: &ModelState, speed_mps: f64, road_wheel_angle_rad: f64) -> ControlInput {
    ControlInput {
        accel_mps2: 3.0 * (speed_mps - state.speed_mps),
        road_wheel_angle_rad,
    }
}

/// Lateral acceleration of the centre of gravity over the last sub-step, m/s².
fn lateral_mps2(params: &DynamicParams, [before, after]: [&ModelState; 2]) -> f64 {
    let across = |state: &ModelState| state.lateral_mps + params.cg_to_rear_m * state.yaw_rate_radps;
    let (speed, rate) = (
        0.5 * (before.speed_mps + after.speed_mps),
        0.5 * (before.yaw_rate_radps + after.yaw_rate_radps),
    );
    (across(after) - across(before)) / DT_S + speed * rate
}

/// Drives with a road-wheel angle by time at a held speed; each sub-step's state and lateral acceleration.
fn steered(params: &DynamicParams, speed_mps: f64, seconds: f64, angle: impl Fn(f64) -> f64) -> Vec<(ModelState, f64)> {
    let mut state = ModelState::new(0.0, 0.0, 0.0, speed_mps);
    (0..(seconds / DT_S).round() as u32)
        .map(|step| {
            let input = holding(&state, speed_mps, angle(f64::from(step) * DT_S));
            let before = state;
            state = params.step(&state, &input, 0.0, DT_S).0;
            (state, lateral_mps2(params, [&before, &state]))
        })
        .collect()
}

/// Road-wheel angle for a steady lateral acceleration at a speed, by the linear model, radians.
fn angle_for(set: &ParameterSet, speed_mps: f64, lateral_mps2: f64) -> f64 {
    (set.wheelbase_m / (speed_mps * speed_mps) + understeer(set)) * lateral_mps2
}

/// The understeer gradient as ISO 4138 measures it at constant speed: the slope of the road-wheel angle over the lateral acceleration
/// between these two, m/s², less that of a vehicle without slip; rad per m/s².
fn measured_understeer(set: &ParameterSet, between_mps2: [f64; 2]) -> f64 {
    let speed_mps = test_speed_mps(set);
    let params = DynamicParams {
        max_power_by_mass: 1e9,
        ..dynamic(set)
    };
    let at = |wanted: f64| {
        let angle = angle_for(set, speed_mps, wanted);
        let (end, _) = *steered(&params, speed_mps, 12.0, |_| angle).last().unwrap();
        let lateral = end.speed_mps * end.yaw_rate_radps;
        [angle - set.wheelbase_m * end.yaw_rate_radps / end.speed_mps, lateral]
    };
    let [[low, slow], [high, fast]] = between_mps2.map(at);
    (high - low) / (fast - slow)
}

/// What ISO 7401 takes from a step of the steering.
struct StepResponse {
    /// From half of the steering to 90 % of the steady value, seconds: yaw rate, lateral acceleration.
    response_s: [f64; 2],
    /// From half of the steering to the peak of the yaw rate, seconds.
    yaw_peak_s: f64,
    /// Peak of the yaw rate by its steady value, less 1.
    yaw_overshoot: f64,
}

impl StepResponse {
    fn new(set: &ParameterSet) -> Self {
        let (speed_mps, params) = (test_speed_mps(set), dynamic(set));
        let params = DynamicParams {
            max_power_by_mass: 1e9,
            ..params
        };
        let angle = angle_for(set, speed_mps, test_lateral_mps2(set));
        let rows = steered(&params, speed_mps, 8.0, |_| angle);
        let time_s = |index: usize| (index + 1) as f64 * DT_S;
        let half_s = time_s(
            rows.iter()
                .position(|(state, _)| state.road_wheel_angle_rad >= 0.5 * angle)
                .unwrap(),
        );
        let (end, lateral) = *rows.last().unwrap();
        let steady = [end.yaw_rate_radps, lateral];
        let value = |row: &(ModelState, f64), of: usize| [row.0.yaw_rate_radps, row.1][of];
        let reaches = |of: usize| {
            let found = rows.iter().position(|row| value(row, of) >= 0.9 * steady[of]);
            time_s(found.unwrap()) - half_s
        };
        let (peak_at, peak) = rows.iter().enumerate().fold((0, 0.0), |best, (index, row)| {
            let rate = value(row, 0);
            if rate > best.1 { (index, rate) } else { best }
        });
        Self {
            response_s: [reaches(0), reaches(1)],
            yaw_peak_s: time_s(peak_at) - half_s,
            yaw_overshoot: peak / steady[0] - 1.0,
        }
    }
}

/// Gain (1/s) and phase (radians) of the yaw rate behind the road-wheel angle, from a continuous sine (ISO 7401, section 14).
fn measured_yaw_response(set: &ParameterSet, frequency_hz: f64) -> [f64; 2] {
    let (speed_mps, params) = (test_speed_mps(set), dynamic(set));
    let params = DynamicParams {
        actuator_rate_per_s: [1e9; 2],
        max_power_by_mass: 1e9,
        ..params
    };
    let amplitude = angle_for(set, speed_mps, 0.5);
    let periods = (6.0 * frequency_hz).ceil() + 2.0;
    let rows = steered(&params, speed_mps, periods / frequency_hz, |t| {
        amplitude * (TAU * frequency_hz * t).sin()
    });
    // Correlation over the last two periods; the road-wheel angle of a row is that of the sub-step's start.
    let last = (2.0 / frequency_hz / DT_S).round() as usize;
    let mut sums = [[0.0; 2]; 2];
    for (index, (state, _)) in rows.iter().enumerate().skip(rows.len() - last) {
        let (sin, cos) = (TAU * frequency_hz * (index + 1) as f64 * DT_S).sin_cos();
        for (sum, value) in sums.iter_mut().zip([state.road_wheel_angle_rad, state.yaw_rate_radps]) {
            *sum = [sum[0] + value * sin, sum[1] + value * cos];
        }
    }
    let [angle, rate] = sums.map(|[sin, cos]| (sin.hypot(cos), cos.atan2(sin)));
    [rate.0 / angle.0, rate.1 - angle.1]
}

#[test]
fn the_steady_circle_has_the_understeer_gradient_of_the_stiffness() {
    for set in on_tyres() {
        let (measured, expected) = (measured_understeer(&set, [0.2, 0.8]), understeer(&set));
        let off = (measured - expected) * GRAVITY_MPS2;
        assert!(
            off.to_degrees().abs() < 0.05,
            "{}: {:.3} instead of {:.3} degrees per g",
            set.name,
            (measured * GRAVITY_MPS2).to_degrees(),
            (expected * GRAVITY_MPS2).to_degrees()
        );
    }
}

#[test]
fn the_frequency_response_of_the_yaw_rate_is_that_of_the_linear_single_track_model() {
    for set in on_tyres() {
        let linear = Linear::new(&set, test_speed_mps(&set));
        for frequency_hz in [0.25, 0.5, 1.0, 2.0] {
            let (measured, expected) = (
                measured_yaw_response(&set, frequency_hz),
                linear.yaw_response(frequency_hz),
            );
            assert!(
                (measured[0] / expected[0] - 1.0).abs() < 0.03 && (measured[1] - expected[1]).abs() < 0.03,
                "{} at {frequency_hz} Hz: {measured:?} instead of {expected:?}",
                set.name
            );
        }
    }
}

/// Brakes, and what regulations ask of them: initial speed, km/h, and the longest stopping distance, metres. UN Regulation 13-H, annex
/// 3, 2.1.1 (cars): 0.1 v + 0.0060 v². UN Regulation 13, annex 4, 2.1.1 (others with more than three wheels): 0.15 v + v²/130 at
/// 60 km/h. UN Regulation 78 (motorcycles, the front brake alone): 0.1 v + 0.0087 v² at 60 km/h. ISO 4210-2, 4.6.8 (trekking bicycles):
/// 7 m from 25 km/h.
fn braking_rule(set: &ParameterSet) -> Option<(f64, f64, &'static str)> {
    let row = |speed: f64, a: f64, b: f64, name| Some((speed, a * speed + b * speed * speed, name));
    match set.name.as_str() {
        "small_car" | "sedan" => row(100.0, 0.1, 0.0060, "UN R13-H"),
        "van" => row(80.0, 0.15, 1.0 / 130.0, "UN R13"),
        "bus" | "articulated_bus" | "truck" | "trailer_truck" => row(60.0, 0.15, 1.0 / 130.0, "UN R13"),
        "motorcycle" => row(60.0, 0.1, 0.0087, "UN R78"),
        "bicycle" => Some((25.0, 7.0, "ISO 4210-2")),
        _ => None,
    }
}

/// Distance of a full braking, metres.
fn stopping_m(set: &ParameterSet, speed_kmh: f64) -> f64 {
    let model = usual_model(set);
    let mut state = ModelState::new(0.0, 0.0, 0.0, speed_kmh * KMH);
    let input = ControlInput {
        accel_mps2: -20.0,
        road_wheel_angle_rad: 0.0,
    };
    for _ in 0..50_000 {
        state = model.step(&state, &input, DT_S).0;
    }
    assert_eq!(state.speed_mps, 0.0, "{}", set.name);
    state.x_m
}

/// Time of a standing start to a speed, seconds; none if it is not reached in 2 minutes.
fn start_s(set: &ParameterSet, speed_kmh: f64) -> Option<f64> {
    let model = usual_model(set);
    let mut state = ModelState::new(0.0, 0.0, 0.0, 0.0);
    let input = ControlInput {
        accel_mps2: 20.0,
        road_wheel_angle_rad: 0.0,
    };
    for step in 1..=60_000_u32 {
        state = model.step(&state, &input, DT_S).0;
        if state.speed_mps >= speed_kmh * KMH {
            return Some(f64::from(step) * DT_S);
        }
    }
    None
}

/// Fastest speed on the level, m/s: where the power balances the resistance.
fn top_speed_mps(set: &ParameterSet) -> f64 {
    let MotionModel::Dynamic(params) = usual_model(set) else {
        return f64::INFINITY;
    };
    let mut state = ModelState::new(0.0, 0.0, 0.0, 20.0);
    let input = ControlInput {
        accel_mps2: 20.0,
        road_wheel_angle_rad: 0.0,
    };
    for _ in 0..40_000 {
        state = params.step(&state, &input, 0.0, 0.01).0;
    }
    state.speed_mps
}

/// Resistance on the level, N: rolling, and drag by the square of the speed (N s²/m²).
fn road_load(set: &ParameterSet) -> [f64; 2] {
    [
        set.rolling_resistance * GRAVITY_MPS2 * set.mass_kg,
        0.5 * AIR_KGPM3 * set.drag_area_m2,
    ]
}

/// Time in which a vehicle without drive rolls from one speed to the other, m/s, by the closed form: `m v' = −(a + b v²)`.
fn coasting_s(set: &ParameterSet, [from, to]: [f64; 2]) -> f64 {
    let [a, b] = road_load(set);
    let angle = |speed: f64| (speed * (b / a).sqrt()).atan();
    set.mass_kg / (a * b).sqrt() * (angle(from) - angle(to))
}

fn coasted_s(set: &ParameterSet, [from, to]: [f64; 2]) -> f64 {
    let params = dynamic(set);
    let mut state = ModelState::new(0.0, 0.0, 0.0, from);
    let mut time_s = 0.0;
    while state.speed_mps > to {
        let resistance = params.drag_by_mass_per_m * state.speed_mps * state.speed_mps + params.rolling_mps2;
        // The driver asks for no force: by the demanded acceleration alone the driver would make up for the resistance.
        let input = ControlInput {
            accel_mps2: -resistance,
            road_wheel_angle_rad: 0.0,
        };
        state = params.step(&state, &input, 0.0, DT_S).0;
        time_s += DT_S;
    }
    time_s
}

#[test]
fn a_coast_down_takes_the_time_of_the_closed_form() {
    for set in on_tyres() {
        let speeds = if set.name == "bicycle" {
            [10.0, 3.0]
        } else {
            [25.0, 5.0]
        };
        let (found, expected) = (coasted_s(&set, speeds), coasting_s(&set, speeds));
        assert!(
            (found / expected - 1.0).abs() < 0.02,
            "{}: {found} {expected}",
            set.name
        );
    }
}

#[test]
fn brakes_stop_within_what_the_regulations_ask() {
    for set in on_tyres() {
        let (speed_kmh, longest_m, rule) = braking_rule(&set).unwrap();
        let stopping_m = stopping_m(&set, speed_kmh);
        assert!(
            stopping_m <= longest_m,
            "{}: {stopping_m} m, {rule} {longest_m} m",
            set.name
        );
        // Not better than the friction: no brake stops before v² / (2 μ g).
        let least_m = (speed_kmh * KMH).powi(2) / (2.0 * set.friction * GRAVITY_MPS2);
        assert!(
            stopping_m > least_m,
            "{}: {stopping_m} m, friction {least_m} m",
            set.name
        );
    }
}

/// What the makers of the two cars state: seconds from 0 to 100 km/h, and top speed, km/h (that of the Passat is limited to 250 km/h
/// electronically, so it says nothing). Volkswagen, press releases on the Polo GTI (2014) and the Passat 2.0 TSI 4MOTION (2014).
const STATED: [(&str, f64, Option<f64>); 2] = [("small_car", 6.7, Some(236.0)), ("sedan", 5.5, None)];

#[test]
fn cars_accelerate_and_end_as_their_makers_state() {
    for (name, stated_s, top_kmh) in STATED {
        let set = named(name);
        let found_s = start_s(&set, 100.0).unwrap();
        assert!(
            (found_s / stated_s - 1.0).abs() < 0.2,
            "{name}: {found_s} s, {stated_s} s"
        );
        if let Some(top_kmh) = top_kmh {
            let found_kmh = top_speed_mps(&set) / KMH;
            assert!(
                (found_kmh / top_kmh - 1.0).abs() < 0.1,
                "{name}: {found_kmh} km/h, {top_kmh} km/h"
            );
        }
    }
}

/// Road load at 80 km/h by two regulations, N. The least: UN Regulation 83, annex 4a, appendix 7, table 3 (setting of a dynamometer
/// without a coast-down; 1.3 times as much for light trucks). The most: the default road load of UN GTR 15, annex 4, paragraph 5:
/// `0.140 m + (2.8e-6 m + 0.0170 width height) v²` with v in km/h, made so that no vehicle gains by it.
fn road_load_band_n(set: &ParameterSet) -> Option<[f64; 2]> {
    let least = match set.name.as_str() {
        // 1 190 to 1 305 kg, 1 530 to 1 640 kg, 2 380 to 2 610 kg.
        "small_car" => 302.0,
        "sedan" => 338.0,
        "van" => 1.3 * 423.0,
        _ => return None,
    };
    let speed = 80.0;
    let most = 0.140 * set.mass_kg + (2.8e-6 * set.mass_kg + 0.0170 * set.width_m * set.height_m) * speed * speed;
    Some([least, most])
}

fn road_load_n(set: &ParameterSet, speed_mps: f64) -> f64 {
    let [a, b] = road_load(set);
    a + b * speed_mps * speed_mps
}

#[test]
fn the_road_load_lies_between_those_of_two_regulations() {
    for set in ["small_car", "sedan", "van"].map(named) {
        let [least, most] = road_load_band_n(&set).unwrap();
        let found = road_load_n(&set, 80.0 * KMH);
        assert!(
            least < found && found < most,
            "{}: {found} N, {least} to {most} N",
            set.name
        );
    }
}

/// Sine with dwell of FMVSS 126 (49 CFR 571.126, S7.9) from 80 km/h, coasting, at one amplitude of the road-wheel angle.
struct SineWithDwell {
    /// Yaw rate by its second peak, 1 s and 1.75 s after the end of the steering.
    left: [f64; 2],
    /// Displacement of the centre of gravity to the side 1.07 s after the beginning, metres.
    aside_m: f64,
}

impl SineWithDwell {
    fn new(set: &ParameterSet, amplitude_rad: f64) -> Self {
        const HZ: f64 = 0.7;
        const DWELL_S: f64 = 0.5;
        let end_s = 1.0 / HZ + DWELL_S;
        let params = dynamic(set);
        let steering = |t: f64| {
            let phase = if t < 0.75 / HZ {
                t
            } else if t < 0.75 / HZ + DWELL_S {
                0.75 / HZ
            } else {
                t - DWELL_S
            };
            if t < end_s {
                amplitude_rad * (TAU * HZ * phase).sin()
            } else {
                0.0
            }
        };
        let mut state = ModelState::new(0.0, 0.0, 0.0, 80.0 * KMH);
        let (mut peak, mut left, mut aside_m) = (0.0_f64, [0.0; 2], 0.0);
        for step in 0..((end_s + 2.0) / DT_S).round() as u32 {
            let time_s = f64::from(step) * DT_S;
            let resistance = params.drag_by_mass_per_m * state.speed_mps * state.speed_mps + params.rolling_mps2;
            let input = ControlInput {
                accel_mps2: -resistance,
                road_wheel_angle_rad: steering(time_s),
            };
            state = params.step(&state, &input, 0.0, DT_S).0;
            let passes = |at_s: f64| time_s < at_s && at_s <= time_s + DT_S;
            // The second peak: that after the steering has changed its sign.
            if time_s > 0.5 / HZ && time_s < end_s {
                peak = peak.max(-state.yaw_rate_radps);
            }
            for (left, after_s) in left.iter_mut().zip([1.0, 1.75]) {
                if passes(end_s + after_s) {
                    *left = -state.yaw_rate_radps / peak;
                }
            }
            if passes(1.07) {
                aside_m = state.point_ahead(params.cg_to_rear_m)[1];
            }
        }
        Self { left, aside_m }
    }

    /// The amplitudes of the test, radians at the road wheels: multiples of that for 0.3 g from 1.5 to 6.5, or to 270° at the steering
    /// wheel if that is more, never more than 300°.
    fn amplitudes_rad(set: &ParameterSet) -> Vec<(f64, f64)> {
        let unit = angle_for(set, 80.0 * KMH, 0.3 * GRAVITY_MPS2);
        let at_wheels = |degrees: f64| degrees.to_radians() / set.steering_ratio;
        let last = (6.5 * unit).max(at_wheels(270.0)).min(at_wheels(300.0));
        let mut all: Vec<(f64, f64)> = (3..)
            .map(|half| 0.5 * f64::from(half))
            .map(|multiple| (multiple, multiple * unit))
            .take_while(|(_, angle)| *angle < last)
            .collect();
        all.push((last / unit, last));
        all
    }
}

/// The worst of all amplitudes: yaw rates left after 1 s and 1.75 s, and the least displacement from five times 0.3 g on.
fn worst_dwell(set: &ParameterSet) -> ([f64; 2], f64) {
    let mut worst = ([f64::NEG_INFINITY; 2], f64::INFINITY);
    for (multiple, amplitude) in SineWithDwell::amplitudes_rad(set) {
        let run = SineWithDwell::new(set, amplitude);
        for (worst, left) in worst.0.iter_mut().zip(run.left) {
            *worst = worst.max(left);
        }
        if multiple >= 5.0 {
            worst.1 = worst.1.min(run.aside_m);
        }
    }
    worst
}

/// Speed at which the yaw rate by road-wheel angle is greatest, km/h: `√(L / K)` with the understeer gradient.
fn characteristic_kmh(set: &ParameterSet) -> f64 {
    (set.wheelbase_m / understeer(set)).sqrt() / KMH
}

/// Characteristic speed of passenger cars, km/h (H. Wallentowitz, lecture on vertical and lateral dynamics, RWTH Aachen).
const CHARACTERISTIC_KMH: [f64; 2] = [65.0, 100.0];

/// What a test demands of a car that has an electronic stability control (FMVSS 126, S5.2): yaw rates left after 1 s and 1.75 s, and the
/// displacement, metres.
const DWELL_LEFT: [f64; 2] = [0.35, 0.20];
const DWELL_ASIDE_M: f64 = 1.83;

/// The sets to which FMVSS 126 applies: at most 4 536 kg on four wheels.
const LIGHT: [&str; 3] = ["small_car", "sedan", "van"];

/// The known deviations from published bands, each with its cause on the page: the sets understeer less than cars do, and none has an
/// electronic stability control. A set that leaves the list, or comes to it, is news.
#[test]
fn the_deviations_from_published_bands_are_the_stated_ones() {
    for set in LIGHT.map(named) {
        let characteristic = characteristic_kmh(&set);
        assert!(
            characteristic > CHARACTERISTIC_KMH[1],
            "{}: {characteristic} km/h",
            set.name
        );
        let (left, aside_m) = worst_dwell(&set);
        assert!(aside_m >= DWELL_ASIDE_M, "{}: {aside_m} m", set.name);
        assert!(
            left[0] > DWELL_LEFT[0] && left[1] > DWELL_LEFT[1],
            "{}: {left:?}: say on the page that it is stable",
            set.name
        );
        // Stable nevertheless up to here.
        for (multiple, amplitude) in SineWithDwell::amplitudes_rad(&set) {
            if multiple <= 5.0 {
                let run = SineWithDwell::new(&set, amplitude);
                assert!(
                    run.left[0] < DWELL_LEFT[0] && run.left[1] < DWELL_LEFT[1],
                    "{} at {multiple} times: {:?}",
                    set.name,
                    run.left
                );
            }
        }
    }
}

/// The largest multiple of the steering for 0.3 g up to which the yaw rate dies out as FMVSS 126 asks.
fn stable_up_to(set: &ParameterSet) -> f64 {
    let stable = |(_, amplitude): &(f64, f64)| {
        let left = SineWithDwell::new(set, *amplitude).left;
        left[0] <= DWELL_LEFT[0] && left[1] <= DWELL_LEFT[1]
    };
    let amplitudes = SineWithDwell::amplitudes_rad(set);
    amplitudes
        .iter()
        .take_while(|amplitude| stable(amplitude))
        .last()
        .map_or(0.0, |(multiple, _)| *multiple)
}

/// A row of a table of the page: its name, its unit, and the text for a set.
type TableRow<'a> = (&'a str, &'a str, &'a dyn Fn(&ParameterSet) -> String);

fn columns(sets: &[ParameterSet], rows: &[TableRow<'_>]) -> String {
    let mut table = String::from("| | unit |");
    sets.iter().for_each(|set| write!(table, " `{}` |", set.name).unwrap());
    writeln!(table, "\n|---|---|{}", "---|".repeat(sets.len())).unwrap();
    for (name, unit, value) in rows {
        write!(table, "| {name} | {unit} |").unwrap();
        sets.iter().for_each(|set| write!(table, " {} |", value(set)).unwrap());
        table.push('\n');
    }
    table
}

#[test]
fn the_page_shows_the_handling() {
    let of_step = |value: &dyn Fn(&StepResponse) -> String, set: &ParameterSet| value(&StepResponse::new(set));
    let mode = |set: &ParameterSet| Linear::new(set, test_speed_mps(set)).mode();
    let rows: [TableRow<'_>; 9] = [
        ("speed, steady lateral acceleration of the step", "km/h, m/s²", &|set| {
            format!("{:.0}, {}", test_speed_mps(set) / KMH, test_lateral_mps2(set))
        }),
        ("understeer gradient, 0.5 to 2 m/s²", "° per g", &|set| {
            format!(
                "{:.2}",
                (measured_understeer(set, [0.5, 2.0]) * GRAVITY_MPS2).to_degrees()
            )
        }),
        ("characteristic speed", "km/h", &|set| {
            format!("{:.0}", characteristic_kmh(set))
        }),
        ("yaw rate by steering-wheel angle", "1/s", &|set| {
            format!(
                "{:.2}",
                Linear::new(set, test_speed_mps(set)).yaw_response(0.0)[0] / set.steering_ratio
            )
        }),
        ("yaw: natural frequency, damping ratio", "Hz", &|set| {
            format!("{:.2}, {:.2}", mode(set)[0], mode(set)[1])
        }),
        ("response time, yaw rate", "s", &|set| {
            of_step(&|step| format!("{:.2}", step.response_s[0]), set)
        }),
        ("response time, lateral acceleration", "s", &|set| {
            of_step(&|step| format!("{:.2}", step.response_s[1]), set)
        }),
        ("peak of the yaw rate after", "s", &|set| {
            of_step(&|step| format!("{:.2}", step.yaw_peak_s), set)
        }),
        ("overshoot of the yaw rate", "%", &|set| {
            of_step(&|step| format!("{:.0}", 100.0 * step.yaw_overshoot), set)
        }),
    ];
    page::shows("handling", &columns(&on_tyres(), &rows));
}

#[test]
fn the_page_shows_the_sine_with_dwell() {
    let worst = |set: &ParameterSet| worst_dwell(set);
    let rows: [TableRow<'_>; 3] = [
        ("yaw rate left after 1 s, 1.75 s; at most 35, 20", "%", &|set| {
            let [first, second] = worst(set).0.map(|left| 100.0 * left);
            format!("{first:.0}, {second:.0}")
        }),
        ("displacement after 1.07 s; at least 1.83", "m", &|set| {
            format!("{:.2}", worst(set).1)
        }),
        ("stable up to this multiple of the steering for 0.3 g", "", &|set| {
            stable_up_to(set).to_string()
        }),
    ];
    page::shows("sine with dwell", &columns(&LIGHT.map(named), &rows));
}

#[test]
fn the_page_shows_starts_stops_and_coasting() {
    let start = |set: &ParameterSet, kmh: f64| start_s(set, kmh).map_or("–".to_owned(), |s| format!("{s:.1}"));
    let stated = |set: &ParameterSet| STATED.into_iter().find(|(name, ..)| *name == set.name);
    let rows: [TableRow<'_>; 9] = [
        ("0 to 50, 0 to 100 km/h", "s", &|set| {
            format!("{}, {}", start(set, 50.0), start(set, 100.0))
        }),
        ("0 to 100 km/h, its maker", "s", &|set| {
            stated(set).map_or("–".to_owned(), |(_, s, _)| s.to_string())
        }),
        ("top speed on the level", "km/h", &|set| {
            if set.kinematic {
                "–".to_owned()
            } else {
                format!("{:.0}", top_speed_mps(set) / KMH)
            }
        }),
        ("top speed, its maker", "km/h", &|set| {
            stated(set)
                .and_then(|(.., top)| top)
                .map_or("–".to_owned(), |top| top.to_string())
        }),
        ("100 to 0 km/h", "m", &|set| format!("{:.1}", stopping_m(set, 100.0))),
        ("stop from the speed of the regulation", "m", &|set| {
            braking_rule(set).map_or("–".to_owned(), |(kmh, ..)| format!("{:.1}", stopping_m(set, kmh)))
        }),
        ("at most", "m", &|set| {
            braking_rule(set).map_or("–".to_owned(), |(kmh, most, rule)| {
                format!("{most:.1} from {kmh} km/h, {rule}")
            })
        }),
        ("coast-down 90 to 18 km/h (bicycle: 36 to 11)", "s", &|set| {
            let speeds = if set.name == "bicycle" {
                [10.0, 3.0]
            } else {
                [25.0, 5.0]
            };
            if set.kinematic {
                "–".to_owned()
            } else {
                format!("{:.0}", coasted_s(set, speeds))
            }
        }),
        ("road load at 80 km/h; least and most", "N", &|set| {
            road_load_band_n(set).map_or("–".to_owned(), |[least, most]| {
                format!("{:.0}; {least:.0}, {most:.0}", road_load_n(set, 80.0 * KMH))
            })
        }),
    ];
    page::shows("starts and stops", &columns(&sets(), &rows));
}
