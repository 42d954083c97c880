use ipc_schema::{
    traffic::{NO_SIGNAL, RoutePoint, SIGNAL_LINKS},
    world::{CONFLICT_COLUMNS, SEEN_CONFLICTS, SENSED_USERS, SENSING_M, USER_COLUMNS, trailing_index},
};
use proptest::prelude::*;

use super::*;

/// A road along x, 4 m wide.
#[derive(Debug)]
struct Strip;

impl DrivableGround for Strip {
    fn is_on_road(&self, _: f64, y_m: f64) -> bool {
        y_m.abs() < 2.0
    }

    fn is_against_traffic(&self, _: f64, _: f64, yaw_rad: f64) -> bool {
        libm::cos(yaw_rad) < -0.5
    }
}

fn config() -> config::Config {
    let text = include_str!("../../../ipc-schema/tests/town.json");
    let mut config = config::Config::from_json(text).unwrap();
    config.task.kind = config::TaskKind::Driving;
    config.task.time_limit_s = 2.0;
    config
}

/// One hero (index 3) on a straight route of 200 m with a stop line at 100 m.
fn driving() -> DrivingTask<Strip> {
    let mut driving = DrivingTask::new(&config(), Strip);
    driving.enter_episode(0);
    let points: Vec<RoutePoint> = [0.0, 100.0, 200.0]
        .into_iter()
        .zip(0_u32..)
        .map(|(x_m, index)| RoutePoint {
            x_m,
            speed_limit_mps: 10.0,
            vehicle: 3,
            index,
            signal: if index == 1 { 5 } else { NO_SIGNAL },
            link: 2,
            ..RoutePoint::default()
        })
        .collect();
    driving.add_route(&points);
    driving
}

fn car(vehicle: u32, kind: Kind, x_m: f64, y_m: f64) -> VehicleState {
    VehicleState {
        x_m,
        y_m,
        vehicle,
        kind: kind as u32,
        length_m: 5.0,
        width_m: 1.8,
        rear_overhang_m: 1.0,
        velocity_body_mps: [7.0, 0.0, 0.0],
        ..VehicleState::default()
    }
}

fn tick(driving: &mut DrivingTask<Strip>, states: &mut [VehicleState]) -> (HeroView, EgoPose) {
    let mut views = [HeroView::default()];
    let poses = driving.end_tick(states);
    driving.write_views(states, &mut views);
    (views[0], poses[0])
}

#[test]
fn a_hero_sees_its_route_what_is_on_it_and_the_signal() {
    let mut driving = driving();
    let mut letters = [0; SIGNAL_LINKS];
    letters[2] = b'r';
    let signal = |state| SignalMeta {
        signal: 5,
        links: 3,
        state,
        ..bytemuck::Zeroable::zeroed()
    };
    driving.add_signals(&[signal(letters)]);
    // Another on its route 30 m ahead, one beside it, one behind it.
    let mut states = [
        car(1, Kind::Other, 41.0, 0.5),
        car(2, Kind::Cav, 25.0, 3.2),
        car(3, Kind::Hero, 10.0, -1.0),
        car(4, Kind::Other, 0.0, 0.0),
    ];
    let (view, pose) = tick(&mut driving, &mut states);
    assert_eq!(view.vehicle, 3);
    assert_eq!(view.route_m, [[5.0, 1.0], [10.0, 1.0], [20.0, 1.0], [40.0, 1.0]]);
    assert_eq!(
        (view.speed_limit_mps, view.route_offset_m, view.route_left_m),
        (10.0, 1.0, 186.0)
    );
    // Rear bumper of the leader at 40 m, front bumper of the hero at 14 m.
    assert_eq!((view.leader_gap_m, view.leader_speed_mps), (26.0, 7.0));
    assert_eq!(view.signal_gap_m, 86.0);
    assert_eq!(
        (pose.front_x_m, pose.front_y_m, pose.vehicle, pose.flags),
        (14.0, -1.0, 3, 0)
    );
    letters[2] = b'G';
    driving.add_signals(&[signal(letters)]);
    let (view, _) = tick(&mut driving, &mut states[2..3]);
    assert_eq!(
        (view.signal_gap_m, view.leader_gap_m, view.leader_speed_mps),
        (100.0, 100.0, 0.0)
    );
}

#[test]
fn a_hero_sees_the_advice_on_its_last_step_and_not_that_on_others() {
    let mut driving = driving();
    let advice = |vehicle, accel_mps2| HeroAdvice { vehicle, accel_mps2 };
    let mut states = [car(3, Kind::Hero, 10.0, 0.0)];
    assert_eq!(tick(&mut driving, &mut states).0.advised_accel_mps2, 0.0);
    driving.add_advice(&[advice(2, 1.0), advice(3, -4.5), advice(4, 2.0)]);
    assert_eq!(tick(&mut driving, &mut states).0.advised_accel_mps2, -4.5);
}

/// A person walks into the way of the hero, or stands beside it. The hero is 1.8 m wide, and its front is at 14 m.
#[test]
fn a_person_ahead_is_in_the_way_with_room_and_one_beside_the_hero_is_not() {
    let gap_m = |x_m: f64, y_m: f64| {
        let person = VehicleState {
            length_m: 0.2,
            width_m: 0.5,
            rear_overhang_m: 0.1,
            ..car(7, Kind::Person, x_m, y_m)
        };
        tick(&mut driving(), &mut [car(3, Kind::Hero, 10.0, 0.0), person])
            .0
            .leader_gap_m
    };
    for side in [-1.0, 1.0] {
        // 0.8 m of room ahead: up to 1.95 m beside the middle of the way.
        assert!(gap_m(20.0, side * 1.9) < 7.0 && gap_m(20.0, side * 2.0) == 100.0);
        // 0.2 m beside its front half: up to 1.35 m.
        assert!(gap_m(13.0, side * 1.3) == 0.0 && gap_m(13.0, side * 1.4) == 100.0);
        assert_eq!(gap_m(11.0, side * 1.0), 100.0, "beside its rear half");
    }
}

/// A leader's trailer is nearer than the leader, and a hero's own bodies are not in its way.
#[test]
fn a_hero_sees_the_trailer_ahead_and_not_its_own() {
    let mut driving = driving();
    let trailing = |of: u32, x_m: f64| VehicleState {
        vehicle: trailing_index(of, 1),
        kind: Kind::Trailing as u32,
        ..car(of, Kind::Other, x_m, 0.0)
    };
    let mut states = [
        car(3, Kind::Hero, 10.0, 0.0),
        car(4, Kind::Other, 65.0, 0.0),
        trailing(3, 5.0),
        trailing(4, 41.0),
    ];
    let (view, _) = tick(&mut driving, &mut states);
    // Rear end of the trailer at 40 m, front bumper of the hero at 14 m.
    assert_eq!(view.leader_gap_m, 26.0);
    // Middles: the trailer's at 42.5 m, the leader's at 66.5 m, out of sight.
    let users = view.around.as_chunks::<USER_COLUMNS>().0;
    assert_eq!(
        [users[0][0], users[1][0], users[2][0]],
        [32.5, SENSING_M as f32, SENSING_M as f32]
    );
}

#[test]
fn a_hero_that_stands_for_too_long_is_blocked_and_one_that_creeps_on_in_between_is_not() {
    let flags_of = |blocked_s: Option<f64>, speeds_mps: &[f32]| -> Vec<u32> {
        let mut config = config();
        config.task.blocked_s = blocked_s;
        let mut driving = DrivingTask::new(&config, Strip);
        driving.enter_episode(0);
        let mut stand = |speed_mps| {
            let mut hero = car(3, Kind::Hero, 10.0, 0.0);
            hero.velocity_body_mps[0] = speed_mps;
            tick(&mut driving, &mut [hero]).1.flags
        };
        speeds_mps.iter().map(|&speed_mps| stand(speed_mps)).collect()
    };
    assert_eq!(flags_of(Some(0.4), &[0.0, 0.05, 0.0, 0.0]), [0, 0, 0, BLOCKED]);
    assert_eq!(flags_of(Some(0.4), &[0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]), [0; 7]);
    assert_eq!(flags_of(None, &[0.0; 12]), [0; 12]);
}

#[test]
fn off_the_road_for_half_a_second_arrival_and_time_end_the_episode_each_with_its_flag() {
    let mut off = driving();
    let flags: Vec<u32> = (0..5)
        .map(|_| tick(&mut off, &mut [car(3, Kind::Hero, 10.0, 2.5)]).1.flags)
        .collect();
    assert_eq!(flags, [0, 0, 0, 0, OFF_ROAD]);
    // Back on the road in between: the time starts again.
    let mut back = driving();
    for y_m in [2.5, 2.5, 2.5, 0.0, 2.5, 2.5] {
        assert_eq!(tick(&mut back, &mut [car(3, Kind::Hero, 10.0, y_m)]).1.flags, 0);
    }
    let mut arriving = driving();
    for x_m in [
        50.0_f64, 65.0, 80.0, 95.0, 110.0, 125.0, 140.0, 155.0, 170.0, 185.0, 190.0,
    ] {
        assert_eq!(
            tick(&mut arriving, &mut [car(3, Kind::Hero, x_m, 0.0)]).1.flags,
            0,
            "{x_m}"
        );
    }
    assert_eq!(
        tick(&mut arriving, &mut [car(3, Kind::Hero, 191.5, 0.0)]).1.flags,
        ARRIVED
    );
    let mut waiting = driving();
    let flags: Vec<u32> = (0..20)
        .map(|_| tick(&mut waiting, &mut [car(3, Kind::Hero, 10.0, 0.0)]).1.flags)
        .collect();
    assert_eq!((flags[18], flags[19]), (0, TIME_LIMIT));
    let counts = |driving: &DrivingTask<Strip>| {
        let HeroCounts {
            off_road,
            arrived,
            time_limit,
            collided,
            ..
        } = driving.counts();
        [off_road, arrived, time_limit, collided]
    };
    assert_eq!(
        (counts(&off), counts(&arriving), counts(&waiting)),
        ([1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0])
    );
}

#[test]
fn a_collision_ends_the_episode_and_what_has_ended_is_not_cut() {
    let mut driving = driving();
    for _ in 0..19 {
        tick(&mut driving, &mut [car(3, Kind::Hero, 10.0, 0.0)]);
    }
    let mut states = [VehicleState {
        flags: COLLIDED,
        ..car(3, Kind::Hero, 10.0, 0.0)
    }];
    assert_eq!(tick(&mut driving, &mut states).1.flags, COLLIDED);
    assert_eq!(driving.counts().collided, 1);
}

#[test]
fn a_refused_action_is_flagged_counted_reported_once_and_the_last_valid_one_is_held() {
    let mut driving = driving();
    let (good, refusal) = driving.apply_action(3, [0.5, -0.5]);
    assert_eq!(refusal, None);
    assert_eq!((good.road_wheel_angle_rad, good.accel_mps2), (0.5 * 0.6, -0.5 * 9.0));
    assert_eq!(tick(&mut driving, &mut [car(3, Kind::Hero, 10.0, 0.0)]).0.vehicle, 3);
    for (action, is_reported) in [
        ([0.0, f32::NAN], true),
        ([2.0, 0.0], false),
        ([f32::INFINITY, 0.0], false),
    ] {
        let (held, refusal) = driving.apply_action(3, action);
        assert_eq!(held, good);
        assert_eq!(refusal.is_some(), is_reported, "{refusal:?}");
        let mut states = [car(3, Kind::Hero, 10.0, 0.0)];
        tick(&mut driving, &mut states);
        assert_eq!(states[0].flags, ACTION_REFUSED);
    }
    let mut states = [car(3, Kind::Hero, 10.0, 0.0)];
    driving.apply_action(3, [0.0, 1.0]);
    tick(&mut driving, &mut states);
    assert_eq!((states[0].flags, driving.counts().refused_actions), (0, 3));
}

/// The leader by a search of the whole way for each point of every road user.
fn leader_by_search(route: &HeroRoute, station_m: f64, states: &[VehicleState]) -> (f64, f64) {
    let hero = &states[0];
    let front_station_m = station_m + front_m(hero);
    let mut found = (SIGHT_M, 0.0);
    for body in states[1..].iter().map(bodies::TickBody::of) {
        let corridor_m = 0.5 * f64::from(hero.width_m + body.width_m) + SIDE_ROOM_M;
        let places = body
            .spine_m
            .map(|point| route.project(point, station_m, front_station_m + SIGHT_M));
        for place in places.into_iter().flatten() {
            let gap_m = (place.station_m - front_station_m).max(0.0);
            let is_in_the_way = place.left_m.abs() < corridor_m && place.station_m > station_m + 0.5 * front_m(hero);
            if is_in_the_way && gap_m < found.0 {
                found = (gap_m, body.speed_along(place.direction));
            }
        }
    }
    found
}

proptest! {
    #[test]
    fn a_leader_is_the_one_that_a_search_of_everything_finds(
        others in prop::collection::vec((-5.0..95.0_f64, -8.0..65.0_f64, -3.2..3.2_f64), 0..40),
        station_m in 0.0..60.0_f64,
    ) {
        let mut route = HeroRoute::default();
        for (x_m, y_m) in [(0.0, 0.0), (30.0, 0.0), (38.0, 3.0), (41.0, 11.0), (41.0, 40.0), (90.0, 60.0)] {
            route.push(&RoutePoint { x_m, y_m, ..RoutePoint::default() });
        }
        let [x_m, y_m] = route.at(station_m).unwrap();
        let mut states = vec![car(0, Kind::Hero, x_m, y_m)];
        states.extend(others.into_iter().zip(1..).map(|((x_m, y_m, yaw_rad), vehicle)| VehicleState {
            yaw_rad,
            ..car(vehicle, Kind::Other, x_m, y_m)
        }));
        let bodies = TickBodies::of(&states);
        let expected = leader_by_search(&route, station_m, &states);
        prop_assert_eq!(leader(&route, station_m, 0, (&states, &bodies)), expected);
    }
}

#[test]
fn a_hero_sees_since_when_a_light_is_yellow() {
    let mut driving = driving();
    let signal = |letter| {
        let mut state = [0; SIGNAL_LINKS];
        state[2] = letter;
        SignalMeta {
            signal: 5,
            links: 3,
            state,
            ..bytemuck::Zeroable::zeroed()
        }
    };
    let mut states = [car(3, Kind::Hero, 10.0, 0.0)];
    let mut green = |driving: &mut DrivingTask<Strip>| {
        let (view, _) = tick(driving, &mut states);
        let lights = SENSED_USERS * USER_COLUMNS + SEEN_CONFLICTS * CONFLICT_COLUMNS;
        (view.around[lights + 1] * 1e3).round() / 1e3
    };
    driving.add_signals(&[signal(b'G')]);
    assert_eq!([green(&mut driving), green(&mut driving)], [1.0, 1.0]);
    // The state comes with other changes, too: only a new letter begins anew.
    driving.add_signals(&[signal(b'y')]);
    assert_eq!([green(&mut driving), green(&mut driving)], [0.485, 0.47]);
    driving.add_signals(&[signal(b'y')]);
    assert_eq!(green(&mut driving), 0.455);
    driving.add_signals(&[signal(b'r')]);
    assert_eq!(green(&mut driving), 0.0);
    driving.add_signals(&[signal(b'y')]);
    assert_eq!(green(&mut driving), 0.485);
}
