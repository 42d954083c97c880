//! The mirror as a collection: episodes, announcements, order, headers, persons.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

mod common;

use common::{LENGTH_M, Road, drive, frame, limits, meta, previewing, settings};
use ipc_schema::{
    config,
    header::{EVALUATION, FIRST_OF_EPISODE, LAST_OF_EPISODE, LAST_OF_RUN, MessageHeader},
    traffic::{Kind, MetaEvent, TrafficState, VehicleMeta, class_name},
    world::{APPEARED, GUIDED, RESYNCHRONISED, VehicleState, trailing_index, vehicle_of},
};
use proptest::prelude::*;
use sim_core::{
    mirror::{Mirror, MirrorError, MirrorSettings, resynchronisation::ResynchronisationCause},
    trig::wrap_angle,
};

fn header(episode: u64, tick: u64) -> MessageHeader {
    MessageHeader {
        episode,
        tick,
        ..MessageHeader::default()
    }
}

fn road() -> Road {
    Road(vec![[0.0, 0.0], [1000.0, 0.0]])
}

#[test]
fn every_tick_gets_its_own_header() {
    let frame = MessageHeader {
        tick: 43,
        sim_time_ns: 5_000_000_000,
        flags: EVALUATION | FIRST_OF_EPISODE | LAST_OF_EPISODE | LAST_OF_RUN,
        stage: 2,
        map: 1,
        meta_messages: 9,
        ..MessageHeader::default()
    };
    let headers: Vec<MessageHeader> = (0..4).map(|t| settings(0.25, 5, 4).tick_header(&frame, t)).collect();
    assert_eq!(headers.iter().map(|h| h.tick).collect::<Vec<_>>(), [40, 41, 42, 43]);
    let times: Vec<u64> = headers.iter().map(|h| h.sim_time_ns / 1_000_000).collect();
    assert_eq!(times, [4250, 4500, 4750, 5000]);
    let flags: Vec<u32> = headers.iter().map(|h| h.flags).collect();
    let last = EVALUATION | LAST_OF_EPISODE | LAST_OF_RUN;
    assert_eq!(flags, [EVALUATION | FIRST_OF_EPISODE, EVALUATION, EVALUATION, last]);
    assert!(headers.iter().all(|h| (h.stage, h.map, h.meta_messages) == (2, 1, 0)));
}

#[test]
fn a_new_episode_forgets_everything_even_if_announcements_come_first() {
    let mut mirror = Mirror::new(settings(0.1, 10, 1)).unwrap();
    mirror.apply_meta(&header(0, 0), &[meta(0, Kind::Cav)]).unwrap();
    frame(&mut mirror, &header(0, 0), &[road().state(0, 50.0, 5.0)]);
    mirror.apply_meta(&header(1, 1), &[meta(0, Kind::Cav)]).unwrap();
    let ticks = frame(&mut mirror, &header(1, 1), &[road().state(0, 500.0, 5.0)]);
    assert_eq!(ticks[0].states[0].flags, APPEARED | RESYNCHRONISED);
    let unknown = mirror.accept(&header(2, 2), &[road().state(0, 500.0, 5.0)]);
    assert_eq!(unknown, Err(MirrorError::Unannounced { vehicle: 0, tick: 2 }));
    assert_eq!(mirror.resynchronisations(), 0);
}

#[test]
fn arrivals_free_their_place_and_unannounced_vehicles_are_refused() {
    let mut mirror = Mirror::new(settings(0.1, 10, 1)).unwrap();
    mirror
        .apply_meta(&header(0, 0), &[meta(0, Kind::Cav), meta(7, Kind::Other)])
        .unwrap();
    frame(
        &mut mirror,
        &header(0, 0),
        &[road().state(0, 50.0, 5.0), road().state(7, 80.0, 5.0)],
    );
    let mut arrived = meta(0, Kind::Cav);
    arrived.event = MetaEvent::Arrived as u32;
    mirror.apply_meta(&header(0, 1), &[arrived]).unwrap();
    let ticks = frame(&mut mirror, &header(0, 1), &[road().state(7, 80.5, 5.0)]);
    assert_eq!(ticks[0].states.len(), 1);
    assert_eq!(ticks[0].states[0].flags, 0);
    assert!(mirror.accept(&header(0, 2), &[road().state(0, 51.0, 5.0)]).is_err());
}

#[test]
fn faulty_frames_are_refused_by_name() {
    let mut mirror = Mirror::new(settings(0.1, 10, 1)).unwrap();
    mirror.apply_meta(&header(0, 0), &[meta(0, Kind::Cav)]).unwrap();
    let mut broken = road().state(0, 50.0, 5.0);
    broken.front_y_m = f64::NAN;
    assert_eq!(
        mirror.accept(&header(0, 3), &[broken]),
        Err(MirrorError::NotFinite { vehicle: 0, tick: 3 })
    );
    let twice = [road().state(0, 50.0, 5.0); 2];
    assert_eq!(
        mirror.accept(&header(0, 4), &twice),
        Err(MirrorError::Twice { vehicle: 0, tick: 4 })
    );
    assert!(mirror.apply_meta(&header(0, 4), &[meta(u32::MAX, Kind::Cav)]).is_err());
    mirror.accept(&header(0, 5), &[road().state(0, 50.0, 5.0)]).unwrap();
    assert!(mirror.write_tick(0, &mut [0; 64]).is_err());
}

#[test]
fn a_vehicle_that_was_absent_is_resynchronised_and_counted() {
    let mut mirror = Mirror::new(settings(0.1, 10, 10)).unwrap();
    mirror.apply_meta(&header(0, 0), &[meta(0, Kind::Cav)]).unwrap();
    frame(&mut mirror, &header(0, 0), &[road().state(0, 50.0, 5.0)]);
    frame(&mut mirror, &header(0, 10), &[]);
    let ticks = frame(&mut mirror, &header(0, 20), &[road().state(0, 300.0, 5.0)]);
    let counts: Vec<usize> = ticks.iter().map(|t| t.states.len()).collect();
    assert_eq!(counts, [0, 0, 0, 0, 0, 0, 0, 0, 0, 1]);
    assert_eq!(ticks[9].states[0].flags, RESYNCHRONISED);
    assert_eq!(mirror.resynchronisations(), 1);
}

#[test]
fn persons_pass_through_with_velocities_from_differences() {
    let mut mirror = Mirror::new(settings(0.1, 10, 2)).unwrap();
    mirror.apply_meta(&header(0, 0), &[meta(0, Kind::Person)]).unwrap();
    let at = |y: f64, speed: f32| TrafficState {
        front_y_m: y,
        yaw_rad: std::f32::consts::FRAC_PI_2,
        speed_mps: speed,
        kind: Kind::Person as u32,
        ..TrafficState::default()
    };
    // Half a step (0.1 s) behind SUMO: from 0.9 at 1 m/s to the middle between 1.0 and 1.3 at 1.5 m/s.
    let set = frame(&mut mirror, &header(0, 0), &[at(1.0, 1.0)])[1].states[0];
    assert!((set.y_m - 0.9).abs() < 1e-9);
    let ticks = frame(&mut mirror, &header(0, 2), &[at(1.3, 1.5)]);
    let (half, end) = (ticks[0].states[0], ticks[1].states[0]);
    assert!(
        (half.y_m - 1.0125).abs() < 1e-9 && (end.y_m - 1.15).abs() < 1e-9,
        "{} {}",
        half.y_m,
        end.y_m
    );
    assert!((end.velocity_body_mps[0] - 1.5).abs() < 1e-6 && end.velocity_body_mps[1].abs() < 1e-6);
    assert!((end.accel_body_mps2[0] - 2.5).abs() < 1e-5);
    assert!((ticks[1].rows[4].dy_m - (1.0125 + 0.05 * 1.25 + 0.003_125 - 1.15)).abs() < 1e-6);
    assert_eq!(mirror.resynchronisations(), 0);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(30))]

    /// The motion of a vehicle does not depend on other road users or on SUMO's order. Rows are ascending.
    #[test]
    fn order_and_other_vehicles_do_not_matter(
        count in 1_u32..12,
        shuffle in any::<u64>(),
        speeds in prop::collection::vec(0.0_f64..15.0, 12),
    ) {
        let drives: Vec<Vec<TrafficState>> = (0..count)
            .map(|v| {
                let mut states = drive(&road(), 10.0 + 20.0 * f64::from(v), 0.1, &vec![speeds[v as usize]; 30]);
                states.iter_mut().for_each(|s| s.vehicle = v);
                states
            })
            .collect();
        let mut together = Mirror::new(settings(0.1, 10, 1)).unwrap();
        let metas: Vec<_> = (0..count).map(|v| meta(v, Kind::Cav)).collect();
        together.apply_meta(&header(0, 0), &metas).unwrap();
        let mut alone: Vec<Mirror> = metas
            .iter()
            .map(|m| {
                let mut mirror = Mirror::new(settings(0.1, 10, 1)).unwrap();
                mirror.apply_meta(&header(0, 0), &[*m]).unwrap();
                mirror
            })
            .collect();
        for tick in 0..30 {
            let mut states: Vec<TrafficState> = drives.iter().map(|d| d[tick]).collect();
            states.rotate_left((shuffle as usize + tick) % count as usize);
            if tick % 2 == 0 {
                states.reverse();
            }
            let all = &frame(&mut together, &header(0, tick as u64), &states)[0];
            for (v, mirror) in alone.iter_mut().enumerate() {
                let one = &frame(mirror, &header(0, tick as u64), &[drives[v][tick]])[0];
                prop_assert_eq!(all.states[v], one.states[0]);
                prop_assert_eq!(&all.rows[10 * v..10 * v + 10], &one.rows[..]);
            }
        }
    }
}

/// A vehicle that speeds up and brakes, of this class and kind; all ticks in which it was moved.
fn moved(class: &str, kind: Kind) -> Vec<VehicleState> {
    let settings = settings(0.1, 10, 1);
    let vehicle = config::VehicleConfig {
        cav_model: config::SingleTrackModel::Dynamic,
        ..settings.vehicle
    };
    let settings = MirrorSettings {
        vehicle,
        wheel_slip: true,
        ..settings
    };
    let mut mirror = Mirror::new(settings).unwrap();
    let mut announced = meta(0, kind);
    announced.vehicle_class = Default::default();
    announced.vehicle_class[..class.len()].copy_from_slice(class.as_bytes());
    mirror.apply_meta(&header(0, 0), &[announced]).unwrap();
    let speeds: Vec<f64> = (0..160)
        .map(|i| 5.0 + 0.08 * f64::from(80 - (i - 80_i32).abs()))
        .collect();
    let states = drive(&road(), 50.0, 0.1, &speeds);
    let ticks = states
        .iter()
        .enumerate()
        .flat_map(|(tick, state)| frame(&mut mirror, &header(0, tick as u64), &[*state]));
    ticks.skip(5).map(|tick| tick.states[0]).collect()
}

#[test]
fn the_world_has_the_steering_ratio_of_each_set_and_the_slip_of_the_wheels_of_carriers() {
    for (class, ratio) in [("passenger", 15.0), ("bus", 22.0), ("truck", 20.0), ("bicycle", 1.0)] {
        for kind in [Kind::Cav, Kind::Other] {
            let states = moved(class, kind);
            assert!(states.iter().all(|state| state.steering_ratio == ratio), "{class}");
            let slips = || states.iter().map(|state| state.rear_wheel_slip);
            let (least, most) = (slips().fold(0.0, f32::min), slips().fold(0.0, f32::max));
            if kind == Kind::Cav {
                assert!(
                    -0.05 < least && least < -5e-4 && 1e-3 < most && most < 0.05,
                    "{class}: {least} {most}"
                );
            } else {
                assert_eq!((least, most), (0.0, 0.0), "{class}: no sensor reads it");
            }
        }
    }
}

#[test]
fn the_limits_are_the_configured_ones() {
    assert_eq!(settings(0.1, 10, 1).vehicle, limits());
}

#[test]
fn with_a_preview_a_road_user_appears_where_it_departed_when_the_others_have_come_as_far() {
    let (delay, speed_mps) = (5_u32, 10.0);
    let mut mirror = previewing();
    mirror.apply_meta(&header(0, 0), &[meta(0, Kind::Cav)]).unwrap();
    for tick in 0_u32..30 {
        let station_m = 50.0 + f64::from(tick) * 0.1 * speed_mps;
        let ticks = frame(
            &mut mirror,
            &header(0, u64::from(tick)),
            &[road().state(0, station_m, speed_mps)],
        );
        let states = &ticks[0].states;
        if tick < delay {
            assert!(states.is_empty(), "tick {tick}");
            continue;
        }
        assert_eq!(
            states[0].flags,
            if tick == delay { APPEARED | RESYNCHRONISED } else { 0 }
        );
        let front_m = states[0].x_m + LENGTH_M - f64::from(states[0].rear_overhang_m);
        assert!(
            (front_m - (station_m - 0.5 * speed_mps)).abs() < 0.05,
            "tick {tick}: {front_m} m"
        );
        // SUMO's own boxes about where the mirror is.
        let boxes = mirror.sumo_boxes(0);
        assert_eq!(boxes.len(), if tick == delay { 2 } else { 3 });
        for (age, solid) in (delay - 1..).zip(&boxes) {
            let expected_m = station_m - f64::from(age) * 0.1 * speed_mps - 0.5 * LENGTH_M;
            assert!(
                (solid.centre_m[0] - expected_m).abs() < 1e-6,
                "{age} frames ago: {solid:?}"
            );
        }
    }
    assert_eq!(mirror.resynchronisations(), 0);
    assert!(mirror.sumo_boxes(7).is_empty());
}

/// Distance of the front bumper from a point, metres.
fn front_from(state: &VehicleState, [x_m, y_m]: [f64; 2]) -> f64 {
    let front_m = LENGTH_M - f64::from(state.rear_overhang_m);
    let (sin, cos) = libm::sincos(state.yaw_rad);
    libm::hypot(state.x_m + front_m * cos - x_m, state.y_m + front_m * sin - y_m)
}

/// The largest steps of position (metres) and heading (radians) beyond what the velocity at their beginning explains.
fn largest_jumps(states: &[VehicleState]) -> [f64; 2] {
    states.windows(2).fold([0.0; 2], |largest, pair| {
        let (sin, cos) = libm::sincos(pair[0].yaw_rad);
        let [along, left, _] = pair[0].velocity_body_mps.map(f64::from);
        let moved = [pair[1].x_m - pair[0].x_m, pair[1].y_m - pair[0].y_m];
        let jump_m = libm::hypot(
            moved[0] - 0.1 * (along * cos - left * sin),
            moved[1] - 0.1 * (along * sin + left * cos),
        );
        let turn_rad =
            wrap_angle(pair[1].yaw_rad - pair[0].yaw_rad) - 0.1 * f64::from(pair[0].angular_rate_body_radps[2]);
        [f64::max(largest[0], jump_m), f64::max(largest[1], turn_rad.abs())]
    })
}

#[test]
fn through_a_turn_on_the_spot_a_vehicle_is_led_without_a_jump() {
    // A half circle of 1.6 m, as netgenerate's turnarounds, and a wide one.
    for (radius_m, cause) in [(1.6, Some(ResynchronisationCause::NarrowTurn)), (15.0, None)] {
        let road = Road::corner(60.0, radius_m, std::f64::consts::PI, 12);
        let mut mirror = previewing();
        mirror.apply_meta(&header(0, 0), &[meta(0, Kind::Cav)]).unwrap();
        let (mut causes, mut states) = (Vec::new(), Vec::new());
        for tick in 0_u32..275 {
            let station_m = f64::from(tick) * 0.1 * 4.0;
            let ticks = frame(
                &mut mirror,
                &header(0, u64::from(tick)),
                &[road.state(0, station_m, 4.0)],
            );
            states.extend(ticks[0].states.iter().copied());
            causes.extend(
                mirror
                    .guidances()
                    .iter()
                    .map(|guidance| (guidance.cause, guidance.vehicle)),
            );
        }
        assert_eq!(mirror.resynchronisations(), 0);
        let guided = states.iter().filter(|state| state.flags & GUIDED != 0).count();
        assert_eq!(causes, Vec::from_iter(cause.map(|cause| (cause, 0))), "{radius_m} m");
        assert_eq!(guided > 0, cause.is_some(), "{radius_m} m: {guided} ticks");
        assert!(guided < 80, "{radius_m} m: {guided} ticks");
        assert_eq!(
            states.last().unwrap().flags & GUIDED,
            0,
            "{radius_m} m: guidance does not end"
        );
        // At 4 m/s on 1.6 m the velocity itself turns by 0.25 rad in a tick, and moves by 0.1 m.
        let [jump_m, jump_rad] = largest_jumps(&states[1..]);
        assert!(jump_m < 0.15, "{radius_m} m: {jump_m} m");
        assert!(jump_rad < 0.2, "{radius_m} m: {jump_rad} rad");
    }
}

#[test]
fn a_vehicle_that_changes_lanes_while_it_stands_is_led_there() {
    let mut mirror = previewing();
    mirror.apply_meta(&header(0, 0), &[meta(0, Kind::Cav)]).unwrap();
    let mut states = Vec::new();
    for tick in 0_u32..150 {
        // It brakes to a stop at 60 m, and stands there in the other lane from the sixth second on.
        let left_s = (4.0 - 0.1 * f64::from(tick)).max(0.0);
        let now = TrafficState {
            front_y_m: if tick < 60 { 0.0 } else { 3.2 },
            ..road().state(0, 60.0 - 1.5 * left_s * left_s, 3.0 * left_s)
        };
        let ticks = frame(&mut mirror, &header(0, u64::from(tick)), &[now]);
        states.extend(ticks[0].states.iter().copied());
    }
    assert_eq!(mirror.resynchronisations(), 0);
    let [jump_m, jump_rad] = largest_jumps(&states[1..]);
    assert!(jump_m < 0.06 && jump_rad < 0.02, "{jump_m} m, {jump_rad} rad");
    assert!(states.iter().any(|state| state.flags & GUIDED != 0));
    let end = states.last().unwrap();
    assert!(front_from(end, [60.0, 3.2]) < 0.3, "{end:?}");
    assert_eq!(end.flags & GUIDED, 0);
}

/// An announcement of a semi-trailer truck.
fn truck(vehicle: u32) -> VehicleMeta {
    let mut announced = meta(vehicle, Kind::Cav);
    announced.vehicle_class = Default::default();
    announced.vehicle_class[..7].copy_from_slice(b"trailer");
    (announced.length_m, announced.width_m, announced.height_m) = (16.5, 2.55, 4.0);
    announced
}

#[test]
fn trailing_bodies_follow_all_road_users_and_those_without_room_are_left_out() {
    let settings = MirrorSettings {
        most_trailing: 2,
        ..settings(0.1, 10, 1)
    };
    let mut mirror = Mirror::new(settings).unwrap();
    let metas = [truck(0), meta(1, Kind::Cav), truck(2), truck(3)];
    mirror.apply_meta(&header(0, 0), &metas).unwrap();
    let at = |vehicle: u32, tick: u64| {
        let place_m = 100.0 + 40.0 * f64::from(vehicle) + 0.8 * tick as f64;
        road().state(vehicle, place_m, 8.0)
    };
    let bodies = |mirror: &mut Mirror, tick: u64, vehicles: &[u32]| -> (Vec<u32>, Vec<VehicleState>) {
        let states: Vec<TrafficState> = vehicles.iter().map(|vehicle| at(*vehicle, tick)).collect();
        let states = frame(mirror, &header(0, tick), &states).remove(0).states;
        assert!(
            states[..vehicles.len()]
                .iter()
                .map(|state| state.vehicle)
                .eq(vehicles.iter().copied())
        );
        let trailing = states[vehicles.len()..].to_vec();
        (trailing.iter().map(|state| state.vehicle).collect(), states)
    };
    for tick in 0..10 {
        let (trailing, states) = bodies(&mut mirror, tick, &[0, 1, 2, 3]);
        assert_eq!(trailing, [trailing_index(0, 1), trailing_index(2, 1)]);
        let behind: Vec<u16> = states.iter().map(|state| state.trailing).collect();
        assert_eq!(behind, [1, 0, 1, 0, 0, 0]);
        let classes: Vec<&str> = states.iter().map(|state| class_name(state.class)).collect();
        assert_eq!(
            classes,
            ["trailer", "passenger", "trailer", "trailer", "trailer", "trailer"]
        );
        assert_eq!(vehicle_of(trailing[1]), 2);
    }
    // When the first truck has left, the last one has its trailer, right behind it.
    for tick in 10..14 {
        let (trailing, states) = bodies(&mut mirror, tick, &[1, 2, 3]);
        assert_eq!(trailing, [trailing_index(2, 1), trailing_index(3, 1)]);
        let (cab, trailer) = (&states[2], &states[4]);
        let kingpin_m = trailer.x_m + f64::from(trailer.wheelbase_m);
        assert!((kingpin_m - cab.x_m - 0.6).abs() < 1e-4, "{kingpin_m} {}", cab.x_m);
        assert_eq!(trailer.kind, Kind::Trailing as u32);
    }
}
