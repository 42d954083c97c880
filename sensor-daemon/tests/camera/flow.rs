//! Optical flow in closed form, and against the earlier image itself.

use crate::{
    CameraModel, CameraParams, CameraScratch, GROUND, Taken, VehicleState, car, config, lidar_city,
    lidar_city::{Moves, traffic},
    params, rectangle, scene_of, take, take_since,
};
use sensor_daemon::sensors::camera::SKY_INSTANCE;

/// What stands for "not a number" in a taken image.
pub const UNKNOWN: [f32; 2] = [f32::MAX; 2];

const MOUNT: [f64; 6] = [2.0, 0.0, 1.5, 0.0, 0.0, 0.0];

#[test]
fn a_drive_towards_a_wall_makes_it_grow_from_the_middle_and_leaves_the_sky() {
    let scene = scene_of(vec![rectangle([12.0, 20.0], [-30.0, 30.0], 4.5)]);
    let camera = CameraModel::new(&params(100, 100, MOUNT), &config(), &scene);
    let [before, now] = [-2.0, 0.0].map(|x| [car(0, x, 0.0, 0.0)]);
    let (taken, _) = take_since(&camera, Some(&before), &now, 0, &mut CameraScratch::default());
    // The wall is 10 m ahead and was 12 m ahead, so a pixel was at 10/12 of its distance from the middle.
    for (pixel, flow_px) in taken.flow_px.iter().enumerate() {
        let from_middle = [pixel % 100, pixel / 100].map(|place| place as f64 + 0.5 - 50.0);
        let expected = match taken.instance[pixel] {
            SKY_INSTANCE => [0.0; 2],
            GROUND => {
                // At depth d it was 2 m farther.
                let depth_m = f64::from(taken.depth_m[pixel]);
                from_middle.map(|part| part * 2.0 / (depth_m + 2.0))
            }
            _ => from_middle.map(|part| part / 6.0),
        };
        for axis in 0..2 {
            let off = (f64::from(flow_px[axis]) - expected[axis]).abs();
            assert!(off < 1e-3, "{pixel}: {flow_px:?} {expected:?}");
        }
    }
}

#[test]
fn a_turn_to_the_left_moves_the_sky_to_the_right() {
    let camera = CameraModel::new(&params(100, 100, MOUNT), &config(), &scene_of(Vec::new()));
    let turn = 0.05;
    let [before, now] = [0.0, turn].map(|yaw| [car(0, 0.0, 0.0, yaw)]);
    let (taken, _) = take_since(&camera, Some(&before), &now, 0, &mut CameraScratch::default());
    for u in 0..100_usize {
        let slope = (50.0 - (u as f64 + 0.5)) / 50.0;
        // The direction of the pixel was farther to the left of the axis by the turn.
        let (left, above) = ((slope.atan() + turn).tan(), 49.5 / 50.0);
        let along = turn.cos() - slope * turn.sin();
        let expected = [50.0 * (left - slope), 50.0 * (above / along - above)];
        let found = taken.flow_px[u].map(f64::from);
        assert!(
            (0..2).all(|axis| (found[axis] - expected[axis]).abs() < 1e-3),
            "{u}: {found:?} {expected:?}"
        );
        assert!(found[0] > 0.0);
    }
}

#[test]
fn a_car_that_keeps_its_distance_stands_still_in_the_image() {
    let camera = CameraModel::new(&params(100, 100, MOUNT), &config(), &scene_of(Vec::new()));
    // Both turn about the origin of the world, 40 m to their left, one 10 m ahead of the other.
    let on_circle = |number: u32, angle: f64| car(number, 40.0 * angle.sin(), -40.0 * angle.cos(), angle);
    let at = |angle: f64| [on_circle(0, angle), on_circle(1, angle + 0.25)];
    let (taken, _) = take_since(&camera, Some(&at(0.1)), &at(0.13), 0, &mut CameraScratch::default());
    let mut counts = [0; 2];
    for (instance, flow_px) in taken.instance.iter().zip(&taken.flow_px) {
        match *instance {
            1 => {
                assert!(flow_px.iter().all(|part| part.abs() < 2e-3), "{flow_px:?}");
                counts[0] += 1;
            }
            SKY_INSTANCE => {
                assert!(flow_px[0] > 1.0);
                counts[1] += 1;
            }
            _ => {}
        }
    }
    assert!(counts.iter().all(|count| *count > 100), "{counts:?}");
}

#[test]
fn what_was_not_there_has_no_flow() {
    let camera = CameraModel::new(&params(100, 100, MOUNT), &config(), &scene_of(Vec::new()));
    let now = [car(0, 0.0, 0.0, 0.0), car(1, 10.0, 0.0, 0.0)];
    let (first, _) = take(&camera, &now, 0, &mut CameraScratch::default());
    assert!(first.flow_px.iter().all(|flow_px| *flow_px == UNKNOWN));
    let (second, _) = take_since(&camera, Some(&now[..1]), &now, 0, &mut CameraScratch::default());
    for (instance, flow_px) in second.instance.iter().zip(&second.flow_px) {
        assert_eq!(*flow_px == UNKNOWN, *instance == 1, "{instance}");
    }
    // After half a turn everything was behind the camera.
    let before = [car(0, 0.0, 0.0, std::f64::consts::PI), now[1]];
    let (turned, _) = take_since(&camera, Some(&before), &now, 0, &mut CameraScratch::default());
    assert!(turned.flow_px.iter().all(|flow_px| *flow_px == UNKNOWN));
}

/// The earlier image shows the same thing at the place from which a pixel has moved, unless something hid it there.
#[test]
fn the_earlier_image_shows_the_same_at_the_earlier_place() {
    agrees_with_the_earlier_image([0.0; 5]);
}

#[test]
fn so_it_does_through_a_lens() {
    agrees_with_the_earlier_image([-0.12, 0.01, 0.004, -0.006, 0.0]);
}

fn agrees_with_the_earlier_image(distortion: [f64; 5]) {
    let params = CameraParams {
        distortion,
        ..params(200, 120, MOUNT)
    };
    let camera = CameraModel::new(&params, &config(), &lidar_city::scene(500, 1));
    let mut scratch = CameraScratch::default();
    agrees(200, |row, tick| {
        let [before, now]: [Vec<VehicleState>; 2] =
            [tick, tick + 1].map(|tick| traffic(200, 60, Moves::Wildly, tick, 2).0);
        let (earlier, _) = take(&camera, &before, row, &mut scratch);
        [earlier, take_since(&camera, Some(&before), &now, row, &mut scratch).0]
    });
}

/// Checks the flow of the second of two images, which are taken from a row and begin at a tick.
pub fn agrees(width: usize, mut images: impl FnMut(usize, u64) -> [Taken; 2]) {
    let (mut compared, mut same, mut of_users) = (0, 0, 0);
    for (tick, row) in (0..8).flat_map(|tick| (0..4).map(move |row| (tick, row))) {
        let [earlier, taken] = images(row, tick);
        let size = [width, taken.flow_px.len() / width].map(|part| part as f32);
        for (pixel, flow_px) in taken.flow_px.iter().enumerate() {
            let place = [pixel % width, pixel / width].map(|part| part as f32);
            let [u, v] = [0, 1].map(|axis: usize| (place[axis] - flow_px[axis]).round());
            if !(0.0..size[0]).contains(&u) || !(0.0..size[1]).contains(&v) {
                continue;
            }
            compared += 1;
            let instance = taken.instance[pixel];
            of_users += u32::from(instance < 1 << 30);
            same += u32::from(earlier.instance[v as usize * width + u as usize] == instance);
        }
    }
    let share = f64::from(same) / f64::from(compared);
    assert!(compared > 300_000 && of_users > 3_000, "{compared} {of_users}");
    assert!(share > 0.97, "{share}");
}
