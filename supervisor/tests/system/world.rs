//! The motion of every vehicle in a whole run on the town, read from its recording.

use std::collections::BTreeMap;

use crate::common::{Workplace, of_channel};
use ipc_schema::{
    block,
    channel::Channel,
    traffic::Kind,
    world::{APPEARED, RESYNCHRONISED, SubStep, VehicleState, WorldLayout},
};

type Vector = [f64; 3];
/// Columns are the body's axes in the world.
type Rotation = [Vector; 3];

/// Ticks over which motion is integrated: 10 s.
const TICKS: usize = 100;
const SUB_STEP_S: f64 = 0.01;

/// A vehicle at the end of a tick with the sub-steps that led there.
type Moved = (VehicleState, Vec<SubStep>);

/// All ticks of a run on the town from its lossless recording: all road users in the order of their index.
fn record(workplace: &Workplace, settings: &[&str]) -> Vec<Vec<Moved>> {
    let mut arguments = vec!["simulate", "--set", "fanout.enabled=false"];
    settings.iter().for_each(|setting| arguments.extend(["--set", setting]));
    let recording = workplace.record("world", &arguments, &[Channel::World]);
    let mut ticks: Vec<Vec<Moved>> = Vec::new();
    for message in of_channel(&recording, Channel::World) {
        assert_eq!(message.header.tick, ticks.len() as u64);
        let layout = WorldLayout::of(&message.header);
        let states: &[VehicleState] = block::view(message.payload(), layout.states).unwrap();
        let rows: &[SubStep] = block::view(message.payload(), layout.sub_steps).unwrap();
        let rows = rows.chunks(message.header.shape[1] as usize).map(<[SubStep]>::to_vec);
        ticks.push(states.iter().copied().zip(rows).collect());
    }
    ticks
}

/// Consecutive states of each vehicle, split where a pose was set.
fn ways(ticks: &[Vec<Moved>]) -> Vec<Vec<&Moved>> {
    let mut open: BTreeMap<u32, Vec<&Moved>> = BTreeMap::new();
    let mut done = Vec::new();
    for tick in ticks {
        let mut still: BTreeMap<u32, Vec<&Moved>> = BTreeMap::new();
        for moved in tick.iter().filter(|(state, _)| state.kind != Kind::Person as u32) {
            let set = moved.0.flags & (RESYNCHRONISED | APPEARED) != 0;
            let mut way = open.remove(&moved.0.vehicle).unwrap_or_default();
            if set {
                done.push(std::mem::take(&mut way));
            }
            way.push(moved);
            still.insert(moved.0.vehicle, way);
        }
        done.extend(std::mem::replace(&mut open, still).into_values());
    }
    done.extend(open.into_values());
    done
}

fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn apply(rotation: &Rotation, body: Vector) -> Vector {
    std::array::from_fn(|i| rotation[0][i] * body[0] + rotation[1][i] * body[1] + rotation[2][i] * body[2])
}

fn times(a: &Rotation, b: &Rotation) -> Rotation {
    b.map(|column| apply(a, column))
}

/// Rotation by `angle` (rad, about an axis in the body; O. Rodrigues).
fn exponential(angle: Vector) -> Rotation {
    let size = dot(angle, angle).sqrt();
    let axis = angle.map(|part| if size > 0.0 { part / size } else { 0.0 });
    let (sin, cos) = size.sin_cos();
    std::array::from_fn(|column| {
        let unit: Vector = std::array::from_fn(|i| f64::from(u8::from(i == column)));
        let cross = [
            axis[1] * unit[2] - axis[2] * unit[1],
            axis[2] * unit[0] - axis[0] * unit[2],
            axis[0] * unit[1] - axis[1] * unit[0],
        ];
        std::array::from_fn(|i| cos * unit[i] + sin * cross[i] + (1.0 - cos) * axis[column] * axis[i])
    })
}

/// `Rz(yaw) Ry(−pitch) Rx(roll)`.
fn attitude(state: &VehicleState) -> Rotation {
    let about = |axis: usize, angle: f64| exponential(std::array::from_fn(|i| if i == axis { angle } else { 0.0 }));
    let yaw_pitch = times(&about(2, state.yaw_rad), &about(1, -f64::from(state.pitch_rad)));
    times(&yaw_pitch, &about(0, f64::from(state.roll_rad)))
}

/// Dead reckoning: attitude from the angular rate, velocity from the acceleration turned by the attitude half-way, position from
/// the mean velocity.
fn integrate(start: &VehicleState, way: &[&Moved]) -> (Vector, Rotation) {
    let mut turned = attitude(start);
    let mut position = [start.x_m, start.y_m, start.z_m];
    let mut velocity = apply(&turned, start.velocity_body_mps.map(f64::from));
    for row in way.iter().flat_map(|(_, rows)| rows) {
        let angle = row.angular_rate_body_radps.map(|rate| f64::from(rate) * SUB_STEP_S);
        let half_way = times(&turned, &exponential(angle.map(|part| 0.5 * part)));
        let change = apply(
            &half_way,
            row.accel_body_mps2.map(|accel| f64::from(accel) * SUB_STEP_S),
        );
        for i in 0..3 {
            position[i] += (velocity[i] + 0.5 * change[i]) * SUB_STEP_S;
            velocity[i] += change[i];
        }
        turned = times(&turned, &exponential(angle));
    }
    (position, turned)
}

/// Angle between two attitudes, rad.
fn between(a: &Rotation, b: &Rotation) -> f64 {
    let trace: f64 = (0..3).map(|i| dot(a[i], b[i])).sum();
    // Near 1 the arc cosine loses all digits, so the angle comes from the sine.
    let skew = (0..3).map(|i| {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        dot(a[j], b[k]) - dot(a[k], b[j])
    });
    let sine = 0.5 * skew.map(|part| part * part).sum::<f64>().sqrt();
    sine.atan2(0.5 * (trace - 1.0))
}

#[test]
fn acceleration_and_angular_rate_of_every_vehicle_of_the_town_reproduce_its_pose() {
    let workplace = Workplace::new();
    let settings = [
        "episode.training_episodes=1",
        "episode.ticks=900",
        "traffic.pedestrians=4",
    ];
    let ticks = record(&workplace, &settings);
    assert_eq!(ticks.len(), 900);
    let ways = ways(&ticks);
    let (mut checked, mut furthest_m, mut most_rad, mut leaning) = (0, 0.0_f64, 0.0_f64, 0.0_f32);
    for way in &ways {
        for window in way.windows(TICKS + 1).step_by(TICKS) {
            let (start, end) = (window[0], window[TICKS]);
            let (position, turned) = integrate(&start.0, &window[1..]);
            let off = [
                position[0] - end.0.x_m,
                position[1] - end.0.y_m,
                position[2] - end.0.z_m,
            ];
            furthest_m = furthest_m.max(dot(off, off).sqrt());
            most_rad = most_rad.max(between(&turned, &attitude(&end.0)));
            leaning = leaning.max(end.0.roll_rad.abs()).max(end.0.pitch_rad.abs());
            checked += 1;
        }
    }
    println!("{checked} times 10 s: at most {furthest_m} m and {most_rad} rad; roll or pitch up to {leaning} rad");
    assert!(checked > 200, "only {checked}");
    assert!(leaning > 0.01, "no vehicle rolled or pitched: {leaning}");
    assert!(furthest_m < 0.01, "{furthest_m} m");
    assert!(most_rad < 0.01_f64.to_radians(), "{most_rad} rad");
    assert_within_limits(&ways);
}

/// Asserts that jerk stays within the actuators' limits, slip of the rear axle within that of tyres, and yaw rate within friction.
fn assert_within_limits(ways: &[Vec<&Moved>]) {
    let (mut jerk, mut slip, mut lateral) = (0.0_f32, 0.0_f32, 0.0_f32);
    for way in ways {
        let rows: Vec<&SubStep> = way.iter().skip(1).flat_map(|(_, rows)| rows).collect();
        for three in rows.windows(3) {
            let change = three[2].speed_mps - 2.0 * three[1].speed_mps + three[0].speed_mps;
            jerk = jerk.max(change.abs() / (SUB_STEP_S * SUB_STEP_S) as f32);
        }
        for row in rows {
            slip = slip.max(row.lateral_speed_mps.abs() / row.speed_mps.max(2.0));
            lateral = lateral.max((row.speed_mps * row.angular_rate_body_radps[2]).abs());
        }
    }
    println!("jerk {jerk} m/s³, rear slip {slip}, lateral {lateral} m/s²");
    assert!(jerk < 35.0, "{jerk} m/s³");
    assert!(slip < 0.12, "{slip}");
    assert!(lateral < 9.81, "{lateral} m/s²");
}

/// The default preset's mirror follows its reference: p99.9 at most 0.5 m across and 1.0 m along, never more than 2 m.
#[test]
fn the_report_measures_how_well_the_town_is_tracked() {
    let workplace = Workplace::new();
    let settings = ["--set", "episode.training_episodes=2", "--set", "fanout.enabled=false"];
    workplace.succeed(&[&["simulate", "--name", "tracked"], &settings[..]].concat());
    let tracking = &workplace.report("tracked")["dynamics"]["tracking"];
    let number = |part: &str, name: &str| tracking[part][name].as_f64().unwrap_or_else(|| panic!("{tracking}"));
    assert!(tracking["samples"].as_u64().unwrap() > 50_000, "{tracking}");
    assert!(
        number("lateral", "p999_m") <= 0.5 && number("lateral", "max_m") <= 2.0,
        "{tracking}"
    );
    assert!(
        number("longitudinal", "p999_m") <= 1.0 && number("longitudinal", "max_m") <= 2.0,
        "{tracking}"
    );
    assert!(number("reference_from_sumo", "max_m") <= 5.0, "{tracking}");
}
