//! Boxes of road users.

use sensor_daemon::sensors::camera::SemanticLabel;

use crate::{
    CameraModel, CameraParams, CameraScratch, Taken, VehicleState, car, config, lidar_city,
    lidar_city::{Moves, traffic},
    params, scene_of, take,
};

#[test]
fn visible_boxes_are_those_counted_from_the_instances() {
    let scene = lidar_city::scene(500, 1);
    let (states, _) = traffic(200, 60, Moves::Wildly, 0, 2);
    let mut scratch = CameraScratch::default();
    let mut boxes = 0;
    let params = params(160, 100, [1.5, 0.0, 1.6, 0.0, 0.02, 0.1]);
    let camera = CameraModel::new(&params, &config(), &scene);
    for row in 0..30 {
        let (taken, _) = take(&camera, &states, row, &mut scratch);
        boxes += check(&taken, &states, 160, 0.01);
    }
    assert!(boxes > 30, "{boxes}");
}

/// Checks the list of an image against its instances. Full boxes hold the visible ones but for `slack_px`. Returns the length of the list.
pub fn check(taken: &Taken, states: &[VehicleState], width: usize, slack_px: f32) -> usize {
    for state in states {
        let mut counted = (0_u32, [u16::MAX, u16::MAX, 0, 0]);
        for (pixel, _) in taken
            .instance
            .iter()
            .enumerate()
            .filter(|(_, seen)| **seen == state.vehicle)
        {
            let (u, v) = ((pixel % width) as u16, (pixel / width) as u16);
            let [left, top, right, bottom] = counted.1;
            counted = (counted.0 + 1, [left.min(u), top.min(v), right.max(u), bottom.max(v)]);
        }
        let found = taken.objects.iter().find(|seen| seen.object == state.vehicle);
        let found = found.map_or((0, [u16::MAX, u16::MAX, 0, 0]), |seen| {
            (seen.visible_px, seen.visible_box_px)
        });
        assert_eq!(found, counted, "{}", state.vehicle);
    }
    for seen in &taken.objects {
        let [left, top, right, bottom] = seen.full_box_px;
        let [l, t, r, b] = seen.visible_box_px.map(f32::from);
        let (inner, outer) = (0.5 + slack_px, 0.5 - slack_px);
        let holds = left <= l + inner && top <= t + inner && right >= r + outer && bottom >= b + outer;
        assert!(holds, "the full box holds the visible one: {seen:?}");
    }
    taken.objects.len()
}

#[test]
fn a_lens_bends_the_corners_of_a_box() {
    let distortion = [0.1, 0.0, 0.0, 0.02, 0.0];
    let states: Vec<VehicleState> = vec![car(0, 0.0, 0.0, 0.0), car(1, 9.0, 4.0, 0.0)];
    let params = CameraParams {
        distortion,
        ..params(200, 200, [0.0, 0.0, 1.2, 0.0, 0.0, 0.0])
    };
    let camera = CameraModel::new(&params, &config(), &scene_of(Vec::new()));
    let (taken, _) = take(&camera, &states, 0, &mut CameraScratch::default());
    let seen = taken.objects[0];
    // 100 px to a slope of 1; its rear is 8 m ahead and its front 12 m, 3 to 5 m to the left, the ground 1.2 m below.
    let bent = |ahead: f64, left: f64, below: f64| {
        let (x, y) = (-left / ahead, below / ahead);
        let r2 = x * x + y * y;
        let radial = 1.0 + 0.1 * r2;
        [
            100.0 + 100.0 * (x * radial + 0.02 * (r2 + 2.0 * x * x)),
            100.0 + 100.0 * (y * radial + 0.04 * x * y),
        ]
    };
    let [left, bottom] = bent(8.0, 5.0, 1.2);
    assert!((f64::from(seen.full_box_px[0]) - left).abs() < 1e-3, "{seen:?} {left}");
    assert!(
        (f64::from(seen.full_box_px[3]) - bent(8.0, 3.0, 1.2)[1].max(bottom)).abs() < 1e-3,
        "{seen:?}"
    );
    // The visible box is counted from bent pixels, so it ends where the bent corners do.
    assert!((f64::from(seen.visible_box_px[0]) - left).abs() < 1.5, "{seen:?}");
}

#[test]
fn a_car_beyond_the_edge_is_truncated_by_half() {
    // Square to the camera, its middle plane through the left edge of the image: a = 1 at 90°.
    let states: Vec<VehicleState> = vec![car(0, 0.0, 0.0, 0.0), car(1, 20.0, 20.0, std::f64::consts::FRAC_PI_2)];
    let camera = CameraModel::new(
        &params(200, 100, [0.0, 0.0, 1.2, 0.0, 0.0, 0.0]),
        &config(),
        &scene_of(Vec::new()),
    );
    let (taken, _) = take(&camera, &states, 0, &mut CameraScratch::default());
    let [seen] = taken.objects.as_slice() else {
        panic!("{:?}", taken.objects)
    };
    assert!(seen.label == SemanticLabel::Car as u32 && seen.object == 1);
    // Its corners are 19 and 21 m ahead, 19 to 23 m to the left: from a = 23 / 19 to 19 / 21; the image ends at a = 1.
    let expected = (23.0 / 19.0 - 1.0) / (23.0 / 19.0 - 19.0 / 21.0);
    assert!((f64::from(seen.truncated) - expected).abs() < 1e-5, "{seen:?}");
    assert_eq!(seen.depth_m, [19.0, 21.0]);
}
