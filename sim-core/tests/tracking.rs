//! The mirror on synthetic SUMO paths, with bounds on the tracking error.

mod common;

use std::f64::consts::FRAC_PI_2;

use common::{Road, drive, mirror_one, settings, worst};
use ipc_schema::{
    traffic::{DISCONTINUOUS, TrafficState},
    world::{APPEARED, RESYNCHRONISED, VehicleState},
};
use proptest::prelude::*;

fn front(state: &VehicleState) -> [f64; 2] {
    let ahead = f64::from(state.length_m - state.rear_overhang_m);
    [
        state.x_m + ahead * state.yaw_rad.cos(),
        state.y_m + ahead * state.yaw_rad.sin(),
    ]
}

fn assert_never_resynchronised(states: &[VehicleState]) {
    assert_eq!(states[0].flags, APPEARED | RESYNCHRONISED);
    assert!(states[1..].iter().all(|s| s.flags == 0), "the mirror was set onto SUMO");
}

#[test]
fn first_frame_puts_the_rear_axle_behind_the_front_bumper() {
    let road = Road(vec![[0.0, 0.0], [30.0, 40.0]]);
    let (states, rows) = mirror_one(settings(0.1, 10, 1), &[road.state(0, 10.0, 3.0)]);
    // Half a step behind SUMO's (6, 8): 0.05 s at 3 m/s.
    let [x, y] = front(&states[0]);
    assert!((x - 5.91).abs() < 1e-6 && (y - 7.88).abs() < 1e-6, "{x} {y}");
    assert!((states[0].velocity_body_mps[0] - 3.0).abs() < 1e-6);
    assert_eq!(rows.len(), 10);
    assert!(rows.iter().all(|r| r.dx_m == 0.0 && r.speed_mps == 3.0));
}

#[test]
fn steady_straight_driving_is_exact() {
    let road = Road(vec![[0.0, 0.0], [1000.0, 0.0]]);
    let (states, rows) = mirror_one(settings(0.1, 10, 1), &drive(&road, 10.0, 0.1, &[14.0; 200]));
    assert_never_resynchronised(&states);
    let (lateral, longitudinal) = worst(&states);
    assert!(lateral < 1e-5 && longitudinal < 1e-5, "{lateral} {longitudinal}");
    assert!(
        rows.iter()
            .all(|r| r.accel_body_mps2[0].abs() < 1e-4 && r.angular_rate_body_radps[2].abs() < 1e-5)
    );
}

/// A circle of radius 50 m at 10 m/s: yaw rate v / r, lateral acceleration v² / r, at the rear axle's own radius.
#[test]
fn a_circle_has_the_closed_form_yaw_rate_and_lateral_acceleration() {
    let road = Road::corner(100.0, 50.0, 6.0, 600);
    let (states, rows) = mirror_one(settings(0.1, 10, 1), &drive(&road, 60.0, 0.1, &[10.0; 300]));
    assert_never_resynchronised(&states);
    let (state, row) = (states[250], rows[2500]);
    let ahead = f64::from(state.length_m - state.rear_overhang_m);
    let rear_radius = (50.0_f64 * 50.0 - ahead * ahead).sqrt();
    let (yaw_rate, speed) = (10.0 / 50.0, 10.0 * rear_radius / 50.0);
    assert!(
        (f64::from(row.speed_mps) - speed).abs() < 2e-3,
        "{} {speed}",
        row.speed_mps
    );
    assert!(
        (f64::from(row.angular_rate_body_radps[2]) - yaw_rate).abs() < 1e-3,
        "{row:?}"
    );
    assert!(
        (f64::from(row.accel_body_mps2[1]) - speed * yaw_rate).abs() < 1e-2,
        "{row:?}"
    );
    let wheel = (f64::from(state.wheelbase_m) / rear_radius).atan();
    assert!(
        (f64::from(state.road_wheel_angle_rad) - wheel).abs() < 1e-3,
        "{} {wheel}",
        state.road_wheel_angle_rad
    );
    let (lateral, longitudinal) = worst(&states);
    assert!(lateral < 0.15 && longitudinal < 0.1, "{lateral} {longitudinal}");
}

#[test]
fn a_town_corner_of_five_straight_pieces() {
    for (radius, speed, bound) in [(6.0, 5.0, 0.25), (9.0, 7.0, 0.25), (20.0, 10.0, 0.3)] {
        for side in [1.0, -1.0] {
            let road = Road::corner(60.0, radius, side * FRAC_PI_2, 5);
            let road = if side < 0.0 { Road(mirrored(60.0, radius)) } else { road };
            let (states, _) = mirror_one(
                settings(0.1, 10, 1),
                &drive(&road, 30.0, 0.1, &vec![speed; (80.0 / speed / 0.1) as usize]),
            );
            assert_never_resynchronised(&states);
            let (lateral, longitudinal) = worst(&states);
            assert!(
                lateral < bound && longitudinal < 0.3,
                "radius {radius}: {lateral} {longitudinal}"
            );
        }
    }
}

fn mirrored(straight: f64, radius: f64) -> Vec<[f64; 2]> {
    Road::corner(straight, radius, FRAC_PI_2, 5)
        .0
        .into_iter()
        .map(|[x, y]| [x, -y])
        .collect()
}

#[test]
fn one_second_steps_are_tracked_through_ten_ticks() {
    let road = Road::corner(60.0, 9.0, FRAC_PI_2, 5);
    let (states, _) = mirror_one(settings(0.1, 10, 10), &drive(&road, 20.0, 1.0, &[6.0; 16]));
    assert_eq!(
        states.len(),
        1 + 10 * 15,
        "a vehicle is there from the tick at which SUMO first has it"
    );
    assert_never_resynchronised(&states);
    let (lateral, longitudinal) = worst(&states);
    assert!(lateral < 0.15 && longitudinal < 0.1, "{lateral} {longitudinal}");
    // Half a step behind SUMO, at the end of each step as in between.
    for (k, tick) in states.iter().enumerate() {
        let [x, y] = road.at(20.0 + 0.6 * k as f64 - 3.0);
        let [fx, fy] = front(tick);
        assert!((x - fx).hypot(y - fy) < 1.0, "tick {k}: {x} {y} {fx} {fy}");
    }
}

#[test]
fn a_lane_change_is_spread_and_not_set() {
    let road = Road(vec![[0.0, 0.0], [1000.0, 0.0]]);
    for (speed, step_s, m) in [(13.0, 0.1, 1), (30.0, 0.5, 5), (25.0, 1.0, 10), (2.0, 0.1, 1)] {
        let count = (20.0 / step_s) as usize;
        let mut frames = drive(&road, 10.0, step_s, &vec![speed; count]);
        frames[count / 4..].iter_mut().for_each(|f| f.front_y_m += 3.2);
        let (states, rows) = mirror_one(settings(0.1, 10, m), &frames);
        assert_never_resynchronised(&states);
        let (lateral, longitudinal) = worst(&states);
        assert!(
            lateral < 0.25 && longitudinal < 0.25,
            "at {speed}: {lateral} {longitudinal}"
        );
        let end = front(&states[states.len() - 1]);
        assert!((end[1] - 3.2).abs() < 0.02, "at {speed}: {end:?}");
        let most = rows.iter().map(|r| r.accel_body_mps2[1].abs()).fold(0.0, f32::max);
        assert!(most < 3.5, "lateral acceleration {most}");
    }
}

fn stop_and_go() -> Vec<f64> {
    let mut speeds = vec![12.0];
    let mut push = |change: f64, steps: u32| {
        for _ in 0..steps {
            let next = speeds[speeds.len() - 1] + change;
            speeds.push(next.clamp(0.0, 13.9));
        }
    };
    for _ in 0..3 {
        push(0.26, 60);
        push(-0.45, 60);
        push(0.0, 50);
    }
    speeds
}

#[test]
fn stop_and_go_keeps_up_and_never_reverses() {
    let road = Road(vec![[0.0, 0.0], [1000.0, 0.0]]);
    let (states, rows) = mirror_one(settings(0.1, 10, 1), &drive(&road, 10.0, 0.1, &stop_and_go()));
    assert_never_resynchronised(&states);
    let (lateral, longitudinal) = worst(&states);
    assert!(lateral < 1e-3 && longitudinal < 0.35, "{lateral} {longitudinal}");
    assert!(rows.iter().all(|r| r.speed_mps >= 0.0));
    assert!(states.windows(2).all(|w| w[1].x_m >= w[0].x_m), "it reversed");
    assert!(
        states.iter().filter(|s| s.velocity_body_mps[0] == 0.0).count() > 60,
        "it never came to rest"
    );
}

#[test]
fn hard_stops_with_one_second_steps_stay_within_half_a_metre() {
    let road = Road(vec![[0.0, 0.0], [1000.0, 0.0]]);
    let speeds = [14.0, 14.0, 14.0, 9.5, 5.0, 0.5, 0.0, 0.0, 0.0, 2.6, 5.2, 7.8, 7.8, 7.8];
    let (states, rows) = mirror_one(settings(0.1, 10, 10), &drive(&road, 10.0, 1.0, &speeds));
    assert_never_resynchronised(&states);
    let (_, longitudinal) = worst(&states);
    assert!(longitudinal < 0.5, "{longitudinal}");
    assert!(rows.iter().all(|r| (-9.01..=5.01).contains(&r.accel_body_mps2[0])));
}

#[test]
fn a_standing_vehicle_stands_whatever_its_heading_says() {
    let road = Road(vec![[0.0, 0.0], [1000.0, 0.0]]);
    let mut frames = vec![road.state(0, 50.0, 0.0); 100];
    for (i, frame) in frames.iter_mut().enumerate() {
        frame.yaw_rad = if i % 2 == 0 { 0.0 } else { 0.05 };
        frame.front_x_m += 1e-3 * (i % 3) as f64;
    }
    let (states, rows) = mirror_one(settings(0.1, 10, 1), &frames);
    assert_never_resynchronised(&states);
    assert!(
        states
            .windows(2)
            .all(|w| w[0].x_m == w[1].x_m && w[0].yaw_rad == w[1].yaw_rad)
    );
    assert!(
        rows.iter()
            .all(|r| r.speed_mps == 0.0 && r.accel_body_mps2 == [0.0; 3] && r.road_wheel_angle_rad == 0.0)
    );
}

#[test]
fn discontinuities_are_set_flagged_and_counted() {
    let road = Road(vec![[0.0, 0.0], [1000.0, 0.0]]);
    for m in [1, 10] {
        let mut frames = drive(&road, 10.0, 0.1 * f64::from(m), &[10.0; 20]);
        frames[8..].iter_mut().for_each(|f| f.front_y_m += 300.0);
        frames[8].flags = DISCONTINUOUS;
        let (states, _) = mirror_one(settings(0.1, 10, m), &frames);
        let set: Vec<usize> = states
            .iter()
            .enumerate()
            .filter(|(_, s)| s.flags != 0)
            .map(|(i, _)| i)
            .collect();
        assert_eq!(set, [0, 8 * m as usize]);
        let [x, y] = front(&states[set[1]]);
        let half_a_step_m = 0.5 * 10.0 * 0.1 * f64::from(m);
        assert!((x + half_a_step_m - frames[8].front_x_m).abs() < 1e-6 && (y - 300.0).abs() < 1e-6);
    }
}

#[test]
fn a_jump_without_a_flag_resynchronises_the_mirror() {
    let road = Road(vec![[0.0, 0.0], [1000.0, 0.0]]);
    for [dx, dy] in [[12.0, 0.0], [0.0, 12.0], [-12.0, 0.0]] {
        let mut frames = drive(&road, 10.0, 0.1, &[10.0; 40]);
        for frame in &mut frames[20..] {
            frame.front_x_m += dx;
            frame.front_y_m += dy;
        }
        let (states, _) = mirror_one(settings(0.1, 10, 1), &frames);
        let set: Vec<usize> = states
            .iter()
            .enumerate()
            .filter(|(_, s)| s.flags != 0)
            .map(|(i, _)| i)
            .collect();
        assert_eq!(set, [0, 20], "jump by {dx}, {dy}");
        let (lateral, longitudinal) = worst(&states);
        assert!(lateral < 1e-3 && longitudinal < 1e-3);
    }
}

/// A 90° corner without any radius at speed: no vehicle can follow it, so the mirror is resynchronised repeatedly.
#[test]
fn an_error_beyond_the_limit_resynchronises_the_mirror() {
    let road = Road(vec![[0.0, 0.0], [40.0, 0.0], [40.0, 40.0]]);
    let (states, _) = mirror_one(settings(0.1, 10, 1), &drive(&road, 10.0, 0.1, &[20.0; 35]));
    assert!(states.iter().filter(|s| s.flags & RESYNCHRONISED != 0).count() > 1);
    let (lateral, longitudinal) = worst(&states);
    assert!(lateral <= 5.0 && longitudinal <= 5.0);
    let end = front(&states[states.len() - 1]);
    assert!((end[0] - 40.0).abs() < 2.0, "{end:?}");
}

fn random_drive() -> impl Strategy<Value = Vec<TrafficState>> {
    let speeds = prop::collection::vec(-0.45_f64..0.26, 50..150);
    let corner = (5.0_f64..60.0, -1.6_f64..1.6, 4_u32..12);
    (speeds, corner).prop_map(|(changes, (radius, angle, pieces))| {
        let mut speeds = vec![6.0_f64];
        for change in changes {
            let next = (speeds[speeds.len() - 1] + change).clamp(0.0, (radius * 4.0).sqrt());
            speeds.push(next);
        }
        let mut road = Road::corner(30.0, radius, angle.abs().max(0.01), pieces);
        road.0.iter_mut().for_each(|p| p[1] *= angle.signum());
        drive(&road, 8.0, 0.1, &speeds)
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// Within SUMO's own default acceleration (2.6 m/s²) and deceleration (4.5 m/s²), drawn in every step, the limits of
    /// the model hold and the front bumper stays near SUMO's.
    #[test]
    fn any_drive_is_tracked_within_the_limits(frames in random_drive()) {
        let (states, rows) = mirror_one(settings(0.1, 10, 1), &frames);
        let (lateral, longitudinal) = worst(&states);
        prop_assert!(lateral < 0.5 && longitudinal < 0.5, "{} {}", lateral, longitudinal);
        for pair in rows.windows(2) {
            prop_assert!(pair[1].speed_mps >= 0.0 && pair[1].road_wheel_angle_rad.abs() <= 0.6001);
            prop_assert!((pair[1].road_wheel_angle_rad - pair[0].road_wheel_angle_rad).abs() <= 0.01 + 1e-6);
            prop_assert!((-9.01..=5.01).contains(&pair[1].accel_body_mps2[0]));
            // The jerk limit of 30 m/s³; around the instant of rest the brakes release the small rest.
            let most = if pair[0].speed_mps.min(pair[1].speed_mps) == 0.0 { 0.5 } else { 0.301 };
            prop_assert!((pair[1].accel_body_mps2[0] - pair[0].accel_body_mps2[0]).abs() <= most, "{:?}", pair);
            let lateral = f64::from(pair[1].speed_mps) * f64::from(pair[1].angular_rate_body_radps[2]);
            prop_assert!((lateral - f64::from(pair[1].accel_body_mps2[1])).abs() < 0.1);
        }
    }
}
