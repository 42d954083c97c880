//! Sensing as a whole: from a tick of the world to an observation block.

#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping, their helpers too")]

mod common;

use common::{Run, config, map, quiet, road_user};
use ipc_schema::sensor::{SensorKind, fitted_sensors};
use ipc_schema::{
    block,
    config::Field,
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::{EMPTY_SLOT, ObservationLayout, TERMINATED, TRUNCATED, VALID},
    traffic::{Kind, id_hash},
    world::{COLLIDED, VehicleState},
};
use sensor_daemon::sensing::{Sensing, WorldTick};

/// One tick; the payload as 8-byte words, which are aligned enough for every section.
fn tick(sensing: &mut Sensing, number: u64, flags: u32, states: &[VehicleState]) -> (usize, Vec<u64>) {
    let header = MessageHeader {
        tick: number,
        sim_time_ns: (number + 1) * 100_000_000,
        flags,
        episode_seed: 5,
        ..MessageHeader::default()
    };
    let n = sensing.assign(&header, states).unwrap();
    let mut payload = vec![0_u64; ObservationLayout::new(n, sensing.width(), sensing.imu_samples()).len / 8];
    sensing
        .observe(
            &header,
            &WorldTick {
                states,
                ..WorldTick::default()
            },
            bytemuck::cast_slice_mut(&mut payload),
        )
        .unwrap();
    (n, payload)
}

fn section<T: bytemuck::Pod>(n: usize, payload: &[u64], name: &str) -> Vec<T> {
    let layout = ObservationLayout::new(n, 9, 1);
    let (_, place) = layout.named().into_iter().find(|(known, _)| *known == name).unwrap();
    block::view::<T>(bytemuck::cast_slice(payload), place).unwrap().to_vec()
}

#[test]
fn without_noise_the_observation_is_the_truth_of_the_same_row() {
    let mut config = config();
    config.gnss.noise_std_deg = [0.0; 2];
    let mut sensing = Sensing::new(&config, &map()).unwrap();
    let states: Vec<_> = (0..5).map(|number| road_user(number, Kind::Cav)).collect();
    let (n, payload) = tick(&mut sensing, 0, FIRST_OF_EPISODE, &states);
    assert_eq!(n, 5);
    let observation: Vec<f32> = section(n, &payload, "observation");
    let truth: Vec<[f32; 4]> = section(n, &payload, "truth");
    for (row, truth) in observation.chunks_exact(9).zip(&truth) {
        // −1 … 1 over 0 … 260 m.
        assert!(((row[0] + 1.0) * 130.0 - truth[0]).abs() < 1e-3 && ((row[1] + 1.0) * 130.0 - truth[1]).abs() < 1e-3);
        assert_eq!(truth[3], 7.0);
    }
    assert_eq!(section::<u32>(n, &payload, "vehicle"), [0, 1, 2, 3, 4]);
    assert!(section::<u32>(n, &payload, "flags").iter().all(|flags| *flags == VALID));
    assert_eq!(section::<u64>(n, &payload, "id_hash")[3], id_hash("cav.3"));
}

#[test]
fn only_connected_vehicles_get_a_slot_and_a_left_one_is_terminated() {
    let mut sensing = Sensing::new(&config(), &map()).unwrap();
    let states = [
        road_user(0, Kind::Other),
        road_user(1, Kind::Cav),
        road_user(2, Kind::Person),
        road_user(3, Kind::Cav),
    ];
    let (n, payload) = tick(&mut sensing, 0, FIRST_OF_EPISODE, &states);
    assert_eq!(section::<u32>(n, &payload, "vehicle"), [1, 3]);
    let (n, payload) = tick(&mut sensing, 1, 0, &states[..3]);
    assert_eq!(section::<u32>(n, &payload, "vehicle"), [1, EMPTY_SLOT]);
    assert_eq!(section::<u32>(n, &payload, "flags"), [VALID, TERMINATED]);
    assert_eq!(section::<u32>(n, &payload, "episode_step"), [1, 0]);
    let (n, payload) = tick(&mut sensing, 2, FIRST_OF_EPISODE, &states[..2]);
    assert_eq!(section::<u32>(n, &payload, "flags"), [VALID | TRUNCATED, 0]);
}

#[test]
fn a_collision_ends_the_trajectory_if_configured() {
    let mut config = config();
    config.collision.ends_trajectory = true;
    let mut sensing = Sensing::new(&config, &map()).unwrap();
    let mut states = [
        road_user(0, Kind::Cav),
        road_user(1, Kind::Cav),
        road_user(2, Kind::Other),
    ];
    tick(&mut sensing, 0, FIRST_OF_EPISODE, &states);
    tick(&mut sensing, 1, 0, &states);
    // The tick of the contact is no part of the trajectory; its last observation was the one before.
    (states[0].flags, states[2].flags) = (COLLIDED, COLLIDED);
    let (n, payload) = tick(&mut sensing, 2, 0, &states);
    assert_eq!(section::<u32>(n, &payload, "vehicle"), [EMPTY_SLOT, 1]);
    assert_eq!(section::<u32>(n, &payload, "flags"), [TERMINATED, VALID]);
    // The contact lasts: a trajectory of its own, with fresh samples, that nothing has ended yet.
    (states[0].flags, states[2].flags) = (0, 0);
    let (n, payload) = tick(&mut sensing, 3, 0, &states);
    assert_eq!(section::<u32>(n, &payload, "vehicle"), [0, 1]);
    assert_eq!(section::<u32>(n, &payload, "flags"), [VALID, VALID]);
    assert_eq!(section::<u32>(n, &payload, "episode_step"), [0, 3]);
    // A vehicle that collides as it appears has had no trajectory to end.
    states[1].vehicle = 3;
    states[1].flags = COLLIDED;
    let (n, payload) = tick(&mut sensing, 4, 0, &states);
    assert_eq!(section::<u32>(n, &payload, "vehicle"), [0, EMPTY_SLOT]);
    assert_eq!(
        section::<u32>(n, &payload, "flags"),
        [VALID, TERMINATED],
        "of vehicle 1, which has left"
    );
}

#[test]
fn a_collision_ends_no_trajectory_by_default() {
    let mut sensing = Sensing::new(&config(), &map()).unwrap();
    let mut states = [road_user(0, Kind::Cav)];
    tick(&mut sensing, 0, FIRST_OF_EPISODE, &states);
    states[0].flags = COLLIDED;
    let (n, payload) = tick(&mut sensing, 1, 0, &states);
    assert_eq!(section::<u32>(n, &payload, "flags"), [VALID]);
    assert_eq!(section::<u32>(n, &payload, "episode_step"), [1]);
}

/// A vehicle's random numbers depend on its id, not on other vehicles or its slot.
#[test]
fn a_vehicles_noise_does_not_depend_on_the_others() {
    let alone = road_user(7, Kind::Cav);
    let mut one = Sensing::new(&config(), &map()).unwrap();
    let (n, payload) = tick(&mut one, 0, FIRST_OF_EPISODE, &[alone]);
    let reference = section::<[f32; 3]>(n, &payload, "gnss_m")[0];
    let mut many = Sensing::new(&config(), &map()).unwrap();
    let crowd: Vec<_> = (0..8).map(|number| road_user(number, Kind::Cav)).collect();
    let (n, payload) = tick(&mut many, 0, FIRST_OF_EPISODE, &crowd);
    assert_eq!(section::<[f32; 3]>(n, &payload, "gnss_m")[7], reference);
}

#[test]
fn a_slow_sensor_holds_its_sample_and_its_age_grows() {
    let mut config = config();
    config.gnss.period_s = 0.3;
    let mut sensing = Sensing::new(&config, &map()).unwrap();
    let states = [road_user(0, Kind::Cav)];
    let mut fixes = Vec::new();
    let mut ages = Vec::new();
    for number in 0..7 {
        let (n, payload) = tick(
            &mut sensing,
            number,
            if number == 0 { FIRST_OF_EPISODE } else { 0 },
            &states,
        );
        fixes.push(section::<[f32; 3]>(n, &payload, "gnss_m")[0]);
        ages.push(section::<[f32; 4]>(n, &payload, "age_s")[0]);
    }
    assert!(fixes[0] == fixes[1] && fixes[1] == fixes[2] && fixes[2] != fixes[3] && fixes[3] == fixes[5]);
    let gnss_ages: Vec<i32> = ages.iter().map(|age| (age[0] * 10.0).round() as i32).collect();
    assert_eq!(gnss_ages, [0, 1, 2, 0, 1, 2, 0]);
    assert!(ages.iter().all(|age| age[1] == 0.0));
}

#[test]
fn pedestrians_carry_a_smartphone_without_speed_and_steering() {
    let mut config = config();
    config.gnss.pedestrians = true;
    config.gnss.pedestrian_noise_factor = 3.0;
    config.observation.fields = vec![
        Field::Speed,
        Field::Steering,
        Field::SpeedSteeringValid,
        Field::SpeedSteeringAge,
        Field::AccelX,
    ];
    let mut run = Run::new(&config);
    let mut person = road_user(1, Kind::Person);
    person.accel_body_mps2 = [10.0, 0.0, 0.0];
    let tick = run.tick(&[road_user(0, Kind::Cav), person]);
    assert_eq!(tick.section::<u32>("vehicle"), [0, 1]);
    let of_vehicle = fitted_sensors(&config);
    let of_person = of_vehicle & !SensorKind::SpeedSteering.bit();
    assert_eq!(tick.section::<u32>("sensors"), [of_vehicle, of_person]);
    assert_eq!(tick.section::<u32>("flags"), [VALID; 2]);
    assert_eq!(tick.section::<[f32; 2]>("speed_steering")[1], [0.0; 2]);
    let row = &tick.section::<f32>("observation")[5..];
    assert_eq!(
        row[..4],
        [-1.0, 0.0, -1.0, -1.0],
        "no speed, straight ahead, never valid, no age"
    );
    assert!((row[4] - 0.5).abs() < 1e-3, "its own acceleration");
    let quality: Vec<[f32; 2]> = tick.section("gnss_quality");
    assert!((quality[1][0] / quality[0][0] - 3.0).abs() < 1e-6);
    config.gnss.pedestrians = false;
    assert_eq!(Run::new(&config).tick(&[person]).n, 0);
}

#[test]
fn a_smartphones_errors_are_a_multiple() {
    const PERSONS: u32 = 4000;
    let mut config = config();
    config.gnss.pedestrians = true;
    config.gnss.pedestrian_noise_factor = 2.0;
    let states: Vec<_> = (0..PERSONS).map(|number| road_user(number, Kind::Person)).collect();
    let fixes: Vec<[f32; 3]> = Run::new(&config).tick(&states).section("gnss_m");
    let squares = fixes
        .iter()
        .zip(&states)
        .map(|(fix, state)| (f64::from(fix[0]) - state.x_m).powi(2));
    let std = (squares.sum::<f64>() / f64::from(PERSONS)).sqrt();
    // 5e-5° are 5.57 m on the ellipsoid to 0.5 %.
    assert!(
        (std / 11.13 - 1.0).abs() < 5.0 / (2.0 * f64::from(PERSONS)).sqrt() + 0.005,
        "{std}"
    );
}

#[test]
fn a_history_holds_ticks_oldest_first_and_begins_with_its_first() {
    let mut config = quiet();
    config.observation.fields = vec![Field::AccelX, Field::Speed];
    config.observation.history = 3;
    let mut run = Run::new(&config);
    assert_eq!(run.sensing.width(), 6);
    let mut state = road_user(1, Kind::Cav);
    let mut at = |run: &mut Run, accel: f32, speed: f32, vehicle: u32| {
        state.accel_body_mps2[0] = accel;
        state.velocity_body_mps[0] = speed;
        state.vehicle = vehicle;
        run.tick(&[state]).section::<f32>("observation")
    };
    assert_eq!(at(&mut run, 0.0, 15.0, 1), [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(at(&mut run, 10.0, 30.0, 1), [0.0, 0.0, 0.0, 0.0, 0.5, 1.0]);
    assert_eq!(at(&mut run, -10.0, 0.0, 1), [0.0, 0.0, 0.5, 1.0, -0.5, -1.0]);
    // Another vehicle takes a slot of its own; the slot of the first is empty, and then reused.
    assert_eq!(at(&mut run, 20.0, 15.0, 2)[6..], [1.0, 0.0, 1.0, 0.0, 1.0, 0.0]);
    assert_eq!(at(&mut run, 10.0, 15.0, 3)[..6], [0.5, 0.0, 0.5, 0.0, 0.5, 0.0]);
}

#[test]
fn raw_sections_hold_what_the_sensors_deliver() {
    let mut config = quiet();
    config.gnss.bias_m = [0.0, 0.0, 4.0];
    let mut state = road_user(1, Kind::Cav);
    (state.z_m, state.road_wheel_angle_rad) = (2.0, 0.1);
    let tick = Run::new(&config).tick(&[state]);
    assert_eq!(tick.section::<[f32; 3]>("gnss_m")[0], [51.0, 80.0, 6.0]);
    let [latitude, longitude, altitude] = tick.section::<[f64; 3]>("gnss_geodetic")[0];
    // 78 m west and 46 m south of 52.26° N, 10.52° E.
    assert!((latitude - (52.26 - 46.0 / 111_270.0)).abs() < 1e-6, "{latitude}");
    assert!((longitude - (10.52 - 78.0 / 68_270.0)).abs() < 1e-6, "{longitude}");
    assert_eq!(altitude, 6.0);
    assert_eq!(tick.section::<[f32; 2]>("gnss_quality")[0], [0.0, 12.0]);
    let [speed, steering] = tick.section::<[f32; 2]>("speed_steering")[0];
    assert_eq!(speed, 7.0);
    assert!((steering - 1.5).abs() < 1e-6);
}
