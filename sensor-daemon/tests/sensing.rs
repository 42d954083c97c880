//! Sensing as a whole: from world to observation block.

#![expect(clippy::unwrap_used, reason = "tests assert by unwrapping, their helpers too")]

use ipc_schema::{
    block,
    config::Config,
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::{EMPTY_SLOT, ObservationLayout, TERMINATED, TRUNCATED, VALID},
    run::MapInfo,
    traffic::{Kind, id_hash},
    world::{COLLIDED, VehicleState},
};
use sensor_daemon::sensing::{Sensing, World};

fn config() -> Config {
    serde_json::from_str(include_str!("../../ipc-schema/tests/town.json")).unwrap()
}

fn map() -> MapInfo {
    MapInfo {
        projection: "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs".into(),
        net_offset_m: [129.0, 126.0],
        bounds_m: [0.0, 0.0, 260.0, 260.0],
    }
}

fn vehicle(number: u32, kind: Kind) -> VehicleState {
    VehicleState {
        x_m: 50.0 + f64::from(number),
        y_m: 80.0,
        yaw_rad: 1.0,
        velocity_body_mps: [7.0, 0.0, 0.0],
        id_hash: id_hash(&format!("cav.{number}")),
        vehicle: number,
        kind: kind as u32,
        ..VehicleState::default()
    }
}

/// One tick; the payload as 8-byte words, which are aligned enough for every section.
fn tick(sensing: &mut Sensing, number: u64, flags: u32, states: &[VehicleState]) -> (usize, Vec<u64>) {
    let header = MessageHeader {
        tick: number,
        sim_time_ns: (number + 1) * 100_000_000,
        flags,
        episode_seed: 5,
        ..MessageHeader::default()
    };
    let n = sensing.assign(&header, states);
    let mut payload = vec![0_u64; ObservationLayout::new(n, sensing.width(), sensing.imu_samples()).len / 8];
    sensing
        .observe(
            &header,
            &World {
                states,
                ..World::default()
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
    let states: Vec<_> = (0..5).map(|number| vehicle(number, Kind::Cav)).collect();
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
        vehicle(0, Kind::Other),
        vehicle(1, Kind::Cav),
        vehicle(2, Kind::Person),
        vehicle(3, Kind::Cav),
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
fn a_collision_ends_the_trajectory_if_it_is_to() {
    let mut config = config();
    config.collision.ends_trajectory = true;
    let mut sensing = Sensing::new(&config, &map()).unwrap();
    let mut states = [vehicle(0, Kind::Cav), vehicle(1, Kind::Cav), vehicle(2, Kind::Other)];
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
fn a_collision_ends_nothing_unless_asked() {
    let mut sensing = Sensing::new(&config(), &map()).unwrap();
    let mut states = [vehicle(0, Kind::Cav)];
    tick(&mut sensing, 0, FIRST_OF_EPISODE, &states);
    states[0].flags = COLLIDED;
    let (n, payload) = tick(&mut sensing, 1, 0, &states);
    assert_eq!(section::<u32>(n, &payload, "flags"), [VALID]);
    assert_eq!(section::<u32>(n, &payload, "episode_step"), [1]);
}

/// A vehicle's stream depends on its id, not on who else is there or in which slot it sits.
#[test]
fn a_vehicles_noise_does_not_depend_on_the_others() {
    let alone = vehicle(7, Kind::Cav);
    let mut one = Sensing::new(&config(), &map()).unwrap();
    let (n, payload) = tick(&mut one, 0, FIRST_OF_EPISODE, &[alone]);
    let reference = section::<[f32; 3]>(n, &payload, "gnss_m")[0];
    let mut many = Sensing::new(&config(), &map()).unwrap();
    let crowd: Vec<_> = (0..8).map(|number| vehicle(number, Kind::Cav)).collect();
    let (n, payload) = tick(&mut many, 0, FIRST_OF_EPISODE, &crowd);
    assert_eq!(section::<[f32; 3]>(n, &payload, "gnss_m")[7], reference);
}

#[test]
fn a_slow_sensor_holds_its_sample_and_tells_its_age() {
    let mut config = config();
    config.gnss.period_s = 0.3;
    let mut sensing = Sensing::new(&config, &map()).unwrap();
    let states = [vehicle(0, Kind::Cav)];
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
