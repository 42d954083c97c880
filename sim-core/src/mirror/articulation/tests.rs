use super::*;

const DT_S: f64 = 0.1;
const STEPS: usize = 10;

fn trailer() -> TrailingBodies {
    TrailingBodies::Trailer(TrailerBody {
        hitch_ahead_m: 0.6,
        length_m: 13.7,
        hitch_to_axle_m: 7.9,
        rear_overhang_m: 4.2,
    })
}

fn carriages(count: u32) -> TrailingBodies {
    TrailingBodies::Carriages(Carriages {
        count,
        length_m: 26.4,
        gap_m: 0.6,
        bogies_m: 19.0,
    })
}

/// A tractor's cab, or a carriage, whose origin is here.
fn leading(shape: &TrailingBodies, [x_m, y_m, z_m]: [f64; 3], yaw_rad: f64, flags: u32) -> VehicleState {
    let (length_m, rear_overhang_m, whole_length_m) = match shape {
        TrailingBodies::Trailer(_) => (2.6, -2.4, 16.5),
        _ => (26.4, 13.2, 26.4 + 27.0 * shape.count() as f32),
    };
    VehicleState {
        x_m,
        y_m,
        z_m,
        yaw_rad,
        velocity_body_mps: [10.0, 0.0, 0.0],
        length_m,
        width_m: 2.5,
        height_m: 4.0,
        rear_overhang_m,
        whole_length_m,
        vehicle: 7,
        id_hash: 70,
        flags,
        ..VehicleState::default()
    }
}

/// Drives along a path, given by the pose of the leading body's origin at a time; returns leading body and trailing bodies of each tick.
fn drive(
    shape: TrailingBodies,
    ticks: usize,
    path: impl Fn(f64) -> ([f64; 3], f64),
) -> Vec<(VehicleState, Vec<VehicleState>)> {
    let mut chain = TrailingChain::new(shape).unwrap();
    let mut out = vec![VehicleState::default(); chain.count()];
    let mut all = Vec::new();
    for tick in 0..ticks {
        let end_s = (tick + 1) as f64 * DT_S;
        let (place, yaw) = path(end_s);
        let mut steps: Vec<SubStep> = (1..=STEPS)
            .map(|step| {
                let ([x, y, z], at) = path(end_s - DT_S * (STEPS - step) as f64 / STEPS as f64);
                SubStep {
                    dx_m: (x - place[0]) as f32,
                    dy_m: (y - place[1]) as f32,
                    dz_m: (z - place[2]) as f32,
                    dyaw_rad: (at - yaw) as f32,
                    ..SubStep::default()
                }
            })
            .collect();
        let flags = if tick == 0 { APPEARED | RESYNCHRONISED } else { 0 };
        let mut state = leading(&shape, place, yaw, flags);
        chain.write_tick(&mut state, &mut steps, DT_S, &mut out);
        all.push((state, out.clone()));
    }
    all
}

fn straight(time_s: f64) -> ([f64; 3], f64) {
    ([10.0 * time_s, 0.0, 0.0], 0.0)
}

#[test]
fn on_a_straight_road_the_bodies_make_one_line_of_sumos_length() {
    for shape in [trailer(), carriages(3)] {
        for (state, bodies) in drive(shape, 30, straight) {
            let front_m = state.x_m + f64::from(state.length_m - state.rear_overhang_m);
            let last = bodies.last().unwrap();
            let rear_m = last.x_m - f64::from(last.rear_overhang_m);
            assert!(
                (front_m - rear_m - f64::from(state.whole_length_m)).abs() < 1e-3,
                "{}",
                front_m - rear_m
            );
            for (place, body) in (1..).zip(&bodies) {
                assert_eq!((body.vehicle, body.id_hash), (trailing_index(7, place), 70));
                assert!(body.y_m.abs() < 1e-9 && body.yaw_rad.abs() < 1e-9 && body.pitch_rad == 0.0);
                assert!((body.velocity_body_mps[0] - 10.0).abs() < 1e-3);
            }
        }
    }
}

/// In a steady circle the axle of a trailer is at √(r² + a² − l²) if its pivot is a metres ahead of an axle at r.
#[test]
fn in_a_circle_a_trailer_runs_on_the_radius_of_the_closed_form() {
    let radius_m = 15.0;
    let circle = |time_s: f64| {
        let angle = 5.0 * time_s / radius_m;
        let (sin, cos) = libm::sincos(angle);
        ([radius_m * sin, radius_m * (1.0 - cos), 0.0], angle)
    };
    let all = drive(trailer(), 400, circle);
    let expected_m = (radius_m * radius_m + 0.6 * 0.6 - 7.9 * 7.9_f64).sqrt();
    for (_, bodies) in &all[300..] {
        let got_m = libm::hypot(bodies[0].x_m, bodies[0].y_m - radius_m);
        assert!((got_m - expected_m).abs() < 2e-3, "{got_m} m instead of {expected_m} m");
        // Its wheels do not slip: its axle moves along the body.
        let [ahead, left, _] = bodies[0].velocity_body_mps;
        assert!((ahead - 5.0 * (expected_m / radius_m) as f32).abs() < 0.02, "{ahead}");
        // The mean over a tick, in the axes of its end: half a tick's turn.
        assert!(left.abs() < 0.1, "{left}");
    }
}

/// The kinematic single-track model with an on-axle trailer of commonroad-vehicle-models (KST; M. Althoff, G. Würsching, *CommonRoad:
/// Vehicle Models*, 2020, section 5): the hitch angle obeys `α' = −v (sin α / l_trailer + tan δ / l)`. Sine steer at 8 m/s, Runge-Kutta.
#[test]
fn a_trailer_follows_commonroads_kinematic_model_through_a_slalom() {
    const FINE_S: f64 = 1e-3;
    let (speed, wheelbase_m, trailer_m) = (8.0, 3.6, 7.9);
    let steer = |time_s: f64| 0.25 * libm::sin(0.7 * time_s);
    let rates = |time_s: f64, [_, _, yaw, hitch]: [f64; 4]| {
        let turn = libm::tan(steer(time_s)) / wheelbase_m;
        [
            speed * libm::cos(yaw),
            speed * libm::sin(yaw),
            speed * turn,
            -speed * (libm::sin(hitch) / trailer_m + turn),
        ]
    };
    let mut states = vec![[0.0; 4]];
    for step in 0..20_000 {
        let (time_s, state) = (f64::from(step) * FINE_S, states[step as usize]);
        let ahead = |rate: [f64; 4], dt_s: f64| std::array::from_fn(|i| state[i] + dt_s * rate[i]);
        let a = rates(time_s, state);
        let b = rates(time_s + 0.5 * FINE_S, ahead(a, 0.5 * FINE_S));
        let c = rates(time_s + 0.5 * FINE_S, ahead(b, 0.5 * FINE_S));
        let d = rates(time_s + FINE_S, ahead(c, FINE_S));
        let mean = std::array::from_fn(|i| (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]) / 6.0);
        states.push(ahead(mean, FINE_S));
    }
    let at = |time_s: f64| states[libm::round(time_s / FINE_S).max(0.0) as usize];
    let shape = TrailingBodies::Trailer(TrailerBody {
        hitch_ahead_m: 0.0,
        length_m: 13.7,
        hitch_to_axle_m: trailer_m,
        rear_overhang_m: 4.2,
    });
    let all = drive(shape, 199, |time_s| {
        let [x, y, yaw, _] = at(time_s);
        ([x, y, 0.0], yaw)
    });
    let (mut most, mut least) = (0.0_f64, 0.0_f64);
    for (tick, (state, bodies)) in all.iter().enumerate() {
        let hitch = at((tick + 1) as f64 * DT_S)[3];
        let got = wrap_angle(bodies[0].yaw_rad - state.yaw_rad);
        assert!((got - hitch).abs() < 2e-3, "tick {tick}: {got} rad instead of {hitch}");
        (most, least) = (most.max(got), least.min(got));
    }
    assert!(most > 0.2 && least < -0.2, "{least} to {most} rad");
}

/// The bogies of all carriages stay on the path of the front, in an S of two arcs and a straight in between.
#[test]
fn carriages_keep_their_bogies_on_the_path_of_the_front() {
    let radius_m = 150.0;
    // The front's path, by its length: 60 m straight on, an arc to the left, an arc to the right.
    let place = |way_m: f64| -> Point {
        let quarter_m = radius_m * std::f64::consts::FRAC_PI_4;
        let arc = |way_m: f64| {
            let (sin, cos) = libm::sincos(way_m / radius_m);
            [radius_m * sin, radius_m * (1.0 - cos)]
        };
        if way_m < 60.0 {
            return [way_m, 0.0];
        }
        let left = arc((way_m - 60.0).min(quarter_m));
        if way_m < 60.0 + quarter_m {
            return [60.0 + left[0], left[1]];
        }
        let [ahead, aside] = arc(way_m - 60.0 - quarter_m);
        let (sin, cos) = libm::sincos(std::f64::consts::FRAC_PI_4);
        [
            60.0 + left[0] + cos * ahead + sin * aside,
            left[1] + sin * ahead - cos * aside,
        ]
    };
    // A leading carriage whose front and rear bogie are on the path: its middle and heading.
    let path = |time_s: f64| {
        let way_m = 15.0 * time_s;
        let [a, b] = [way_m - 3.7, way_m - 22.7].map(place);
        let yaw = libm::atan2(a[1] - b[1], a[0] - b[0]);
        ([0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.0], yaw)
    };
    let all = drive(carriages(4), 180, path);
    let away_m = |point: Point| {
        let near = (0..5000).map(|step| {
            let on = place(f64::from(step) * 0.1 - 160.0);
            libm::hypot(on[0] - point[0], on[1] - point[1])
        });
        near.fold(f64::INFINITY, f64::min)
    };
    // The first carriage is on the rails too, and is driven smoothly: 1.5 m/s² is 15 m/s in 150 m.
    for (state, _) in all.iter().skip(12) {
        let [ahead, left, _] = state.accel_body_mps2;
        assert!(ahead.hypot(left) < 2.0, "{ahead} {left} m/s²");
        let (sin, cos) = libm::sincos(state.yaw_rad);
        for ahead_m in [9.5, -9.5] {
            let bogie = [state.x_m + ahead_m * cos, state.y_m + ahead_m * sin];
            assert!(away_m(bogie) < 0.35, "{} m beside the rails", away_m(bogie));
        }
    }
    let mut turned = 0.0_f64;
    for (_, bodies) in all.iter().skip(10).step_by(7) {
        for body in bodies {
            let (sin, cos) = libm::sincos(body.yaw_rad);
            for ahead_m in [9.5, -9.5] {
                let bogie = [body.x_m + ahead_m * cos, body.y_m + ahead_m * sin];
                // The front itself hangs over by l (l + b) / 2R, which the trail has.
                assert!(away_m(bogie) < 0.35, "{} m beside the rails", away_m(bogie));
            }
            turned = turned.max(body.yaw_rad.abs());
        }
    }
    assert!(turned > 0.5, "the train has turned by {turned} only");
}

#[test]
fn on_a_slope_bodies_have_its_height_and_pitch() {
    let slope = 0.06;
    let ramp = |time_s: f64| {
        let x = 10.0 * time_s;
        ([x, 0.0, slope * x.max(0.0)], 0.0)
    };
    for shape in [trailer(), carriages(2)] {
        let (_, bodies) = drive(shape, 150, ramp).pop().unwrap();
        for body in bodies {
            assert!(
                (body.z_m - slope * body.x_m).abs() < 0.02,
                "{} m at {} m",
                body.z_m,
                body.x_m
            );
            assert!((f64::from(body.pitch_rad) - libm::atan(slope)).abs() < 1e-3);
        }
    }
    // A vehicle that appears on a slope stands on it.
    let mut chain = TrailingChain::new(trailer()).unwrap();
    let mut out = [VehicleState::default()];
    let mut state = leading(&trailer(), [100.0, 0.0, 6.0], 0.0, APPEARED | RESYNCHRONISED);
    state.pitch_rad = libm::atan(slope) as f32;
    chain.write_tick(&mut state, &mut [], DT_S, &mut out);
    assert!((out[0].z_m - slope * out[0].x_m).abs() < 1e-3, "{out:?}");
}

#[test]
fn a_vehicle_that_is_set_elsewhere_takes_its_bodies_along() {
    for shape in [trailer(), carriages(2)] {
        let mut chain = TrailingChain::new(shape).unwrap();
        let mut out = vec![VehicleState::default(); chain.count()];
        let mut state = VehicleState::default();
        // Turned by some 20° against the leading body.
        for tick in 0..40 {
            let angle = 0.02 * f64::from(tick);
            let (sin, cos) = libm::sincos(angle);
            let flags = if tick == 0 { APPEARED | RESYNCHRONISED } else { 0 };
            state = leading(&shape, [40.0 * sin, 40.0 * (1.0 - cos), 0.0], angle, flags);
            chain.write_tick(&mut state, &mut [], DT_S, &mut out);
        }
        let relative = |state: &VehicleState, body: &VehicleState| {
            let (sin, cos) = libm::sincos(state.yaw_rad);
            let (dx, dy) = (body.x_m - state.x_m, body.y_m - state.y_m);
            [
                cos * dx + sin * dy,
                cos * dy - sin * dx,
                body.yaw_rad - state.yaw_rad,
                body.z_m - state.z_m,
            ]
        };
        let before: Vec<_> = out.iter().map(|body| relative(&state, body)).collect();
        let mut set = leading(&shape, [-300.0, 500.0, 12.0], -1.3, RESYNCHRONISED);
        chain.write_tick(&mut set, &mut [], DT_S, &mut out);
        for (body, before) in out.iter().zip(before) {
            let after = relative(&set, body);
            assert!(
                before.iter().zip(after).all(|(a, b)| (a - b).abs() < 1e-9),
                "{before:?} {after:?}"
            );
            assert_eq!((body.flags, body.velocity_body_mps), (RESYNCHRONISED, [10.0, 0.0, 0.0]));
        }
    }
}
