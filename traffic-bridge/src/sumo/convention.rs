//! SUMO's conventions, here and nowhere else.
//!
//! SUMO's net frame is also the project's (x east, y north, z up, metres), except that a net far from its own (0, 0) is moved there
//! ([`world_from_net`]). The differences: headings are degrees clockwise from
//! north, slopes are degrees, and a road user that is not on the road has the position −2³⁰. A vehicle's position is
//! the centre of its front bumper; a person's position is taken as their centre, as SUMO draws them.

use ipc_schema::traffic::{DISCONTINUOUS, Kind, TrafficState};

use super::libsumo::ffi::RawState;

/// What SUMO returns for a value that does not exist (`libsumo::INVALID_DOUBLE_VALUE`).
const INVALID: f64 = -1_073_741_824.0;

/// Bits of the random seed that SUMO's option parser takes (a positive `int`).
const SEED_BITS: u32 = 31;

/// Yaw in radians counter-clockwise from east, in (−π, π], of a heading in degrees clockwise from north.
#[must_use]
pub fn yaw_rad_from_heading_deg(heading_deg: f64) -> f32 {
    // Wrapped as f32, so that rounding cannot leave the interval.
    let from_east_deg = (90.0 - heading_deg).rem_euclid(360.0);
    let wrapped_deg = if from_east_deg > 180.0 {
        from_east_deg - 360.0
    } else {
        from_east_deg
    };
    let yaw_rad = single(wrapped_deg.to_radians());
    if yaw_rad <= -std::f32::consts::PI {
        std::f32::consts::PI
    } else {
        yaw_rad
    }
}

/// Heading in degrees clockwise from north, in [0, 360), of a yaw in radians counter-clockwise from east.
#[must_use]
pub fn heading_deg_from_yaw_rad(yaw_rad: f64) -> f64 {
    (90.0 - yaw_rad.to_degrees()).rem_euclid(360.0)
}

/// A place of the net in the world frame, whose (0, 0) lies at `world_origin_m` of the net; metres.
#[must_use]
pub fn world_from_net([x_m, y_m]: [f64; 2], world_origin_m: [f64; 2]) -> [f64; 2] {
    [x_m - world_origin_m[0], y_m - world_origin_m[1]]
}

/// The inverse of [`world_from_net`].
#[must_use]
pub fn net_from_world([x_m, y_m]: [f64; 2], world_origin_m: [f64; 2]) -> [f64; 2] {
    [x_m + world_origin_m[0], y_m + world_origin_m[1]]
}

/// SUMO's `--seed` for an episode seed: its low 31 bits.
#[must_use]
pub fn sumo_seed(episode_seed: u64) -> u64 {
    episode_seed & ((1 << SEED_BITS) - 1)
}

/// The state of a road user in the project's units, or `None` while it is off the road (teleporting, riding, parked away).
/// `step_s` is the time since the state before, seconds; `world_origin_m` as in [`world_from_net`].
#[must_use]
pub fn traffic_state(raw: &RawState, kind: Kind, step_s: f64, world_origin_m: [f64; 2]) -> Option<TrafficState> {
    if !is_on_road(raw) {
        return None;
    }
    let continuous = raw.previous_speed != INVALID && raw.speed != INVALID;
    let speed_mps = if raw.speed == INVALID { 0.0 } else { raw.speed };
    let accel_mps2 = if continuous {
        (speed_mps - raw.previous_speed) / step_s
    } else {
        0.0
    };
    let [front_x_m, front_y_m] = world_from_net([raw.x, raw.y], world_origin_m);
    Some(TrafficState {
        front_x_m,
        front_y_m,
        front_z_m: if raw.z == INVALID { 0.0 } else { raw.z },
        yaw_rad: yaw_rad_from_heading_deg(raw.angle),
        pitch_rad: single(raw.slope.to_radians()),
        speed_mps: single(speed_mps),
        accel_mps2: single(accel_mps2),
        vehicle: raw.index,
        kind: kind as u32,
        signals: u32::try_from(raw.signals).unwrap_or(0),
        flags: if continuous { 0 } else { DISCONTINUOUS },
    })
}

/// False while a road user is off the road (teleporting, riding, parked away).
#[must_use]
pub fn is_on_road(raw: &RawState) -> bool {
    raw.x != INVALID && raw.y != INVALID
}

/// A number of SUMO's, `None` for its "invalid" value.
#[must_use]
pub fn valid(value: f64) -> Option<f64> {
    (value != INVALID).then_some(value)
}

/// The nearest single-precision number: angles, speeds and sizes are carried in it.
#[must_use]
pub fn single(value: f64) -> f32 {
    #[expect(clippy::cast_possible_truncation, reason = "rounding to single precision is meant")]
    let rounded = value as f32;
    rounded
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f32::consts::{FRAC_PI_2, PI};

    fn raw() -> RawState {
        RawState {
            x: 1.0,
            y: 2.0,
            z: INVALID,
            angle: 0.0,
            slope: 0.0,
            speed: 3.0,
            previous_speed: 2.0,
            signals: 8,
            lane: -1,
            lane_position: 0.0,
            edge: -1,
            route_index: -1,
            odometer: INVALID,
            carrier: -1,
            index: 7,
        }
    }

    #[test]
    fn the_four_winds() {
        for (heading_deg, yaw_rad) in [(0.0, FRAC_PI_2), (90.0, 0.0), (180.0, -FRAC_PI_2), (270.0, PI)] {
            assert!(
                (yaw_rad_from_heading_deg(heading_deg) - yaw_rad).abs() < 1e-6,
                "{heading_deg}"
            );
        }
    }

    #[test]
    fn a_net_far_away_is_moved_to_the_world_frame_and_back() {
        let far = RawState {
            x: 691_234.5,
            y: 5_334_021.25,
            ..raw()
        };
        let state = traffic_state(&far, Kind::Cav, 0.5, [691_000.0, 5_334_000.0]).unwrap();
        assert_eq!((state.front_x_m, state.front_y_m), (234.5, 21.25));
        let back = net_from_world([state.front_x_m, state.front_y_m], [691_000.0, 5_334_000.0]);
        assert_eq!(back, [far.x, far.y]);
    }

    #[test]
    fn acceleration_is_the_change_of_speed_over_the_step() {
        let state = traffic_state(&raw(), Kind::Cav, 0.5, [0.0; 2]).unwrap();
        assert_eq!((state.accel_mps2, state.flags, state.front_z_m), (2.0, 0, 0.0));
    }

    #[test]
    fn a_road_user_that_was_off_the_road_comes_back_discontinuous_and_unaccelerated() {
        let state = traffic_state(
            &RawState {
                previous_speed: INVALID,
                ..raw()
            },
            Kind::Cav,
            0.5,
            [0.0; 2],
        )
        .unwrap();
        assert_eq!((state.accel_mps2, state.flags), (0.0, DISCONTINUOUS));
    }

    #[test]
    fn a_road_user_off_the_road_has_no_state() {
        assert_eq!(
            traffic_state(
                &RawState {
                    x: INVALID,
                    y: INVALID,
                    ..raw()
                },
                Kind::Other,
                0.1,
                [0.0; 2]
            ),
            None
        );
    }

    proptest! {
        #[test]
        fn yaw_is_in_its_interval_and_points_the_same_way(heading_deg in -1e4_f64..1e4) {
            let yaw_rad = yaw_rad_from_heading_deg(heading_deg);
            prop_assert!(yaw_rad > -PI && yaw_rad <= PI);
            let (east, north) = heading_deg.to_radians().sin_cos();
            prop_assert!((f64::from(yaw_rad).cos() - east).abs() < 1e-6);
            prop_assert!((f64::from(yaw_rad).sin() - north).abs() < 1e-6);
        }

        #[test]
        fn headings_go_there_and_back(yaw_rad in -3.1_f64..3.1) {
            let heading_deg = heading_deg_from_yaw_rad(yaw_rad);
            prop_assert!((0.0..360.0).contains(&heading_deg));
            prop_assert!((f64::from(yaw_rad_from_heading_deg(heading_deg)) - yaw_rad).abs() < 1e-6);
        }

        #[test]
        fn turning_left_increases_yaw(heading_deg in 0.0_f64..360.0, left_deg in 0.0_f64..90.0) {
            let turned = yaw_rad_from_heading_deg(heading_deg - left_deg) - yaw_rad_from_heading_deg(heading_deg);
            let turned = if turned < -1e-5 { turned + 2.0 * PI } else { turned };
            prop_assert!((turned - single(left_deg.to_radians())).abs() < 1e-5);
        }

        #[test]
        fn every_state_is_finite(
            x in -1e6_f64..1e6, y in -1e6_f64..1e6, angle in 0.0_f64..360.0, speed in 0.0_f64..100.0,
            previous in prop::option::of(0.0_f64..100.0), signals: i32, step_s in 0.01_f64..10.0,
        ) {
            let previous_speed = previous.unwrap_or(INVALID);
            let state = traffic_state(&RawState { x, y, angle, speed, previous_speed, signals, ..raw() }, Kind::Cav, step_s, [0.0; 2]).unwrap();
            prop_assert!(state.yaw_rad.is_finite() && state.accel_mps2.is_finite());
            prop_assert!(state.accel_mps2.abs() <= single(100.0 / step_s));
            prop_assert_eq!(state.flags & DISCONTINUOUS != 0, previous.is_none());
        }

        #[test]
        fn seeds_fit_sumo(seed: u64) {
            prop_assert!(i32::try_from(sumo_seed(seed)).is_ok());
        }
    }
}
