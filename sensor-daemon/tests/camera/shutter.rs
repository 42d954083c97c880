//! Rolling shutters: in closed form, against images of a global shutter, and on every instruction set.

use std::sync::Arc;

use sensor_daemon::sensors::{
    camera::{RollingShutter, SightScene},
    lidar::ScanPath,
};

use crate::{
    CameraModel, CameraParams, CameraScratch, CameraShot, CameraTargets, ImagePlanes, Scene, SubStep, Taken, Targets,
    VehicleState, boxes, car, config, flow,
    lidar_city::{self, Moves, SUB_STEPS, TICK_S, traffic},
    params, rectangle, scene_of, take, take_rolling,
};

/// A wide lens that bends upwards and to the side.
const LENS: [f64; 5] = [-0.12, 0.01, 0.004, -0.006, 0.0];
/// Rows of a band.
const BAND: usize = 8;

fn rolling(readout_s: f64, params: CameraParams) -> CameraParams {
    CameraParams {
        shutter: Some(RollingShutter {
            readout_s,
            tick_s: TICK_S,
        }),
        ..params
    }
}

/// When a row is read, seconds after the end of the tick.
fn read_s(row: f64, height: usize, readout_s: f64) -> f64 {
    readout_s * (row / (height - 1) as f64 - 1.0)
}

/// When the middle of a band is read, seconds after the end of the tick.
fn band_s(band: usize, height: usize, readout_s: f64) -> f64 {
    let last = ((band + 1) * BAND).min(height) - 1;
    read_s(0.5 * (band * BAND + last) as f64, height, readout_s)
}

/// The sub-steps of a road user that keeps its velocity and yaw rate, upright.
fn steady(velocity_mps: [f64; 2], yaw_rate_radps: f64) -> Vec<SubStep> {
    let step = |number: usize| {
        let t = TICK_S * (number as f64 / SUB_STEPS as f64 - 1.0);
        SubStep {
            dx_m: (velocity_mps[0] * t) as f32,
            dy_m: (velocity_mps[1] * t) as f32,
            dyaw_rad: (yaw_rate_radps * t) as f32,
            angular_rate_body_radps: [0.0, 0.0, yaw_rate_radps as f32],
            ..SubStep::default()
        }
    };
    (1..=SUB_STEPS).map(step).collect()
}

/// 200 × 200 pixels, 400 px to a slope of 1.
fn narrow(readout_s: f64, mount: [f64; 6]) -> CameraParams {
    let horizontal_fov_deg = 2.0 * 0.25_f64.atan().to_degrees();
    CameraParams {
        horizontal_fov_deg,
        ..rolling(readout_s, params(200, 200, mount))
    }
}

#[test]
fn a_pole_leans_by_the_turn_of_the_camera_during_the_readout() {
    let scene = scene_of(vec![rectangle([20.0, 20.2], [-0.1, 0.1], 14.0)]);
    for (yaw_rate, readout_s) in [(1.0, 0.05), (-0.7, 0.1), (1.0, 0.0)] {
        let camera = CameraModel::new(&narrow(readout_s, [0.0, 0.0, 6.0, 0.0, 0.0, 0.0]), &config(), &scene);
        let tick = ([car(0, 0.0, 0.0, 0.0)], steady([0.0; 2], yaw_rate));
        let taken = take_rolling(&camera, None, (&tick.0, &tick.1), 0, &mut CameraScratch::default());
        let place_px = |row: usize| {
            let columns = (0..200).filter(|u| taken.instance[row * 200 + u] == 1 << 31);
            let (count, sum) = columns.fold((0.0, 0.0), |(count, sum), u| (count + 1.0, sum + u as f64 + 0.5));
            assert!(count >= 3.0, "the pole is 4 px wide in row {row}");
            sum / count
        };
        for row in 0..200 {
            // Earlier the camera looked farther to the right if it turns to the left, so the pole was farther to the left.
            let expected_px = 100.0 + 400.0 * (yaw_rate * read_s(row as f64, 200, readout_s)).tan();
            let of_band_px = 400.0 * 1.1 * yaw_rate.abs() * readout_s * 3.5 / 199.0;
            let off_px = (place_px(row) - expected_px).abs();
            assert!(
                off_px <= 0.51 + of_band_px,
                "row {row}: {off_px} px beside the closed form"
            );
        }
        let lean_px = place_px(199) - place_px(0);
        let expected_px = 400.0 * (yaw_rate * readout_s).tan();
        assert!((lean_px - expected_px).abs() < 1.6, "{lean_px} {expected_px}");
    }
}

#[test]
fn a_bus_that_crosses_is_skewed_by_its_way_during_the_readout() {
    let (speed_mps, readout_s) = (20.0, 0.05);
    let camera = CameraModel::new(
        &narrow(readout_s, [0.0, 0.0, 2.0, 0.0, 0.0, 0.0]),
        &config(),
        &scene_of(Vec::new()),
    );
    // It drives to the left, its front 1.5 m to the left at the end of the tick, its near side 15 m ahead.
    let bus = VehicleState {
        length_m: 12.0,
        height_m: 3.2,
        ..car(1, 16.0, -9.5, std::f64::consts::FRAC_PI_2)
    };
    let states = [car(0, 0.0, 0.0, 0.0), bus];
    let steps = [steady([0.0; 2], 0.0), steady([0.0, speed_mps], 0.0)].concat();
    let taken = take_rolling(&camera, None, (&states, &steps), 0, &mut CameraScratch::default());
    let left_px = |time_s: f64| 100.0 - 400.0 / 15.0 * (1.5 + speed_mps * time_s);
    let mut rows = 0;
    for row in 0..200 {
        let Some(first) = (0..200).find(|u| taken.instance[row * 200 + u] == 1) else {
            continue;
        };
        rows += 1;
        let off_px = (first as f64 - left_px(read_s(row as f64, 200, readout_s))).abs();
        let of_band_px = 400.0 / 15.0 * speed_mps * readout_s * 3.5 / 199.0;
        assert!(
            off_px <= 0.51 + of_band_px,
            "row {row}: {off_px} px beside the closed form"
        );
    }
    // 3.2 m at 15 m.
    assert!((84..=86).contains(&rows), "{rows}");
    let [seen] = taken.objects.as_slice() else {
        panic!("{:?}", taken.objects)
    };
    // The foot is 2 m below the camera, 53.3 px under the middle: in the band of the rows 152 to 159.
    let expected_px = left_px(band_s(19, 200, readout_s));
    assert!(
        (f64::from(seen.full_box_px[0]) - expected_px).abs() < 1e-3,
        "{seen:?} {expected_px}"
    );
    assert!(seen.depth_m == [15.0, 17.0], "{seen:?}");
    // At the end of the tick it would end 10 px farther to the left.
    let global = CameraModel::new(
        &CameraParams {
            shutter: None,
            ..narrow(readout_s, [0.0, 0.0, 2.0, 0.0, 0.0, 0.0])
        },
        &config(),
        &scene_of(Vec::new()),
    );
    let (at_end, _) = take(&global, &states, 0, &mut CameraScratch::default());
    let skew_px = seen.full_box_px[0] - at_end.objects[0].full_box_px[0];
    assert!(
        (f64::from(skew_px) - (expected_px - left_px(0.0))).abs() < 1e-3,
        "{skew_px}"
    );
}

/// Sub-steps of road users that stand.
fn standing(states: &[VehicleState]) -> Vec<SubStep> {
    let steps = states.iter().flat_map(|state| {
        [SubStep {
            roll_rad: state.roll_rad,
            pitch_rad: state.pitch_rad,
            ..SubStep::default()
        }; SUB_STEPS]
    });
    steps.collect()
}

#[test]
fn where_nothing_moves_the_bytes_are_those_of_a_global_shutter() {
    let (states, _) = traffic(200, 60, Moves::Wildly, 0, 2);
    let steps = standing(&states);
    for (scene, lens) in [
        (lidar_city::scene(500, 1), [0.0; 5]),
        (lidar_city::scene(500, 1), LENS),
        (lidar_city::hilly(), [0.0; 5]),
        (lidar_city::hilly(), LENS),
    ] {
        let sight = Arc::new(SightScene::new(&config(), &scene));
        let mut states = states.clone();
        lidar_city::stand_on(&scene, &mut states);
        for (size, row) in [([160, 100], 3), ([84, 84], 7), ([17, 9], 8), ([1, 1], 9), ([40, 8], 9)] {
            let global = CameraParams {
                distortion: lens,
                ..params(size[0], size[1], [1.5, 0.0, 1.6, 0.0, 0.02, 0.1])
            };
            let [global, rolling] =
                [global, rolling(0.1, global)].map(|params| CameraModel::in_sight(&params, Arc::clone(&sight)));
            let mut scratch = CameraScratch::default();
            let tick = (&states[..], &steps[..]);
            let expected = take_rolling(&global, Some(tick), tick, row, &mut scratch);
            for _ in 0..2 {
                let taken = take_rolling(&rolling, Some(tick), tick, row, &mut scratch);
                assert!(taken == expected, "{size:?}");
            }
        }
    }
}

/// The road users at a time of their tick after its first sub-step, seconds after its end: between two sub-steps each part is linear.
fn at(states: &[VehicleState], steps: &[SubStep], time_s: f64) -> Vec<VehicleState> {
    let place = (time_s + TICK_S) / TICK_S * SUB_STEPS as f64;
    let number = place as usize;
    let share = place - number as f64;
    let moved = states.iter().zip(steps.chunks(SUB_STEPS)).map(|(state, steps)| {
        let between = |part: fn(&SubStep) -> f32| {
            let [before, after] = [&steps[number - 1], &steps[number]].map(|step| f64::from(part(step)));
            before + (after - before) * share
        };
        VehicleState {
            x_m: state.x_m + between(|step| step.dx_m),
            y_m: state.y_m + between(|step| step.dy_m),
            yaw_rad: state.yaw_rad + between(|step| step.dyaw_rad),
            roll_rad: between(|step| step.roll_rad) as f32,
            pitch_rad: between(|step| step.pitch_rad) as f32,
            ..*state
        }
    });
    moved.collect()
}

#[test]
fn each_band_is_that_of_a_global_shutter_at_its_time() {
    let (states, steps) = traffic(200, 60, Moves::Wildly, 0, 2);
    let (width, height, readout_s) = (160, 100, 0.085);
    let (mut same, mut compared, mut differ_from_end) = (0, 0, 0);
    for (scene, lens) in [(lidar_city::scene(500, 1), [0.0; 5]), (lidar_city::scene(500, 1), LENS)] {
        let global = CameraParams {
            distortion: lens,
            ..params(width, height, [1.5, 0.0, 1.6, 0.0, 0.02, 0.1])
        };
        let [global, rolling] =
            [global, rolling(readout_s, global)].map(|params| CameraModel::new(&params, &config(), &scene));
        let mut scratch = CameraScratch::default();
        for row in 0..12 {
            let taken = take_rolling(&rolling, None, (&states, &steps), row, &mut scratch);
            let (at_end, _) = take(&global, &states, row, &mut scratch);
            for band in 0..height.div_ceil(BAND) {
                let then = at(&states, &steps, band_s(band, height, readout_s));
                let (expected, _) = take(&global, &then, row, &mut scratch);
                for pixel in band * BAND * width..((band + 1) * BAND).min(height) * width {
                    let depths = [taken.depth_m[pixel], expected.depth_m[pixel]];
                    compared += 1;
                    let is_same = taken.instance[pixel] == expected.instance[pixel];
                    same += u32::from(is_same && (depths[0] - depths[1]).abs() < 1e-3 * depths[1]);
                    differ_from_end += u32::from(taken.instance[pixel] != at_end.instance[pixel]);
                }
            }
        }
    }
    println!("{same} of {compared} the same, {differ_from_end} differ from the end of the tick");
    assert!(
        f64::from(compared - same) < 1e-4 * f64::from(compared),
        "{same} of {compared}"
    );
    assert!(differ_from_end > 1000, "{differ_from_end}");
}

#[test]
fn boxes_are_those_counted_from_the_instances() {
    let scene = lidar_city::scene(500, 1);
    let (states, steps) = traffic(200, 60, Moves::Wildly, 0, 2);
    let params = rolling(0.1, params(160, 100, [1.5, 0.0, 1.6, 0.0, 0.02, 0.1]));
    let camera = CameraModel::new(&params, &config(), &scene);
    let (mut scratch, mut count) = (CameraScratch::default(), 0);
    for row in 0..30 {
        let taken = take_rolling(&camera, None, (&states, &steps), row, &mut scratch);
        // Edges in the middle of a body are those of their bands: 14 m/s and 0.6 rad/s for four rows of 100.
        count += boxes::check(&taken, &states, 160, 1.0);
    }
    assert!(count > 30, "{count}");
}

/// A camera with a rolling shutter, in fog.
fn foggy(distortion: [f64; 5], sight: &Arc<SightScene>) -> CameraModel {
    let params = CameraParams {
        distortion,
        ..rolling(0.07, params(130, 84, [1.5, 0.0, 1.4, 0.02, -0.03, 0.3]))
    };
    CameraModel::in_sight(&params, Arc::clone(sight))
}

fn fog(scene: &Scene) -> Arc<SightScene> {
    let mut config = config();
    (config.weather.visibility_m, config.weather.sunlight) = (300.0, 0.7);
    Arc::new(SightScene::new(&config, scene))
}

/// An image from the road user in `row`, with the flow of a tick.
fn busy(camera: &CameraModel, tick: (&[VehicleState], &[SubStep]), row: usize) -> Taken {
    let (before, steps) = traffic(200, 60, Moves::Wildly, 0, 2);
    take_rolling(
        camera,
        Some((&before, &steps)),
        tick,
        row,
        &mut CameraScratch::default(),
    )
}

#[test]
fn every_path_gives_the_same_bytes() {
    let (states, steps) = traffic(200, 60, Moves::Wildly, 1, 2);
    for scene in [lidar_city::scene(500, 1), lidar_city::hilly()] {
        let sight = fog(&scene);
        for lens in [[0.0; 5], LENS] {
            let image = |path: ScanPath, row: usize| {
                let camera = foggy(lens, &sight).with_path(path);
                assert!(camera.path() == path);
                busy(&camera, (&states, &steps), row)
            };
            for row in 0..6 {
                let expected = image(ScanPath::Plain, row);
                for path in ScanPath::ALL.into_iter().filter(|path| path.is_here()) {
                    assert!(image(path, row) == expected, "{path:?}");
                }
            }
        }
    }
}

#[test]
fn the_order_of_road_users_does_not_matter() {
    let (states, steps) = traffic(200, 60, Moves::Wildly, 1, 2);
    let camera = foggy([0.0; 5], &fog(&lidar_city::scene(500, 1)));
    let turned: Vec<VehicleState> = states.iter().rev().copied().collect();
    let turned_steps: Vec<SubStep> = steps.chunks(SUB_STEPS).rev().flatten().copied().collect();
    let mut seen = 0;
    for row in 0..40 {
        let mut expected = busy(&camera, (&states, &steps), row);
        let mut taken = busy(&camera, (&turned, &turned_steps), states.len() - 1 - row);
        for image in [&mut taken, &mut expected] {
            image.objects.sort_by_key(|seen| seen.object);
        }
        assert!(taken == expected, "row {row}");
        seen += taken.objects.len();
    }
    assert!(seen > 30, "{seen}");
}

#[test]
fn a_carrier_beside_the_road_reads_its_rows_too() {
    let camera = CameraModel::new(
        &narrow(0.1, [0.0, 0.0, 2.0, 0.0, 0.0, 0.0]),
        &config(),
        &scene_of(Vec::new()),
    );
    let (post, bus) = (car(0, 0.0, 0.0, 0.0), car(1, 16.0, -2.0, std::f64::consts::FRAC_PI_2));
    let steps = [steady([0.0; 2], 0.0), steady([0.0, 10.0], 0.0)].concat();
    let on_car = take_rolling(&camera, None, (&[post, bus], &steps), 0, &mut CameraScratch::default());
    let (mut targets, mut seen, mut instance) = (Targets::default(), CameraTargets::default(), vec![0; 200 * 200]);
    targets.update(&[bus], &steps[SUB_STEPS..], SUB_STEPS);
    seen.update(&targets);
    targets.add_fixed(&[post]);
    let shot = CameraShot {
        targets: &seen,
        tick: Some(&targets),
        carrier: Some(1),
        pose: camera.pose_on(&targets, 1).unwrap(),
        past: None,
        noise: None,
    };
    let mut planes = ImagePlanes {
        instance: &mut instance,
        ..ImagePlanes::default()
    };
    let mut objects = Vec::new();
    camera.take(&shot, &mut CameraScratch::default(), &mut planes, &mut objects);
    assert!(instance == on_car.instance && objects == on_car.objects && objects.len() == 1);
}

#[test]
fn the_earlier_image_shows_the_same_at_the_earlier_place() {
    let params = rolling(0.05, params(200, 120, [2.0, 0.0, 1.5, 0.0, 0.0, 0.0]));
    let camera = CameraModel::new(&params, &config(), &lidar_city::scene(500, 1));
    let mut scratch = CameraScratch::default();
    flow::agrees(200, |row, tick| {
        let [before, now] = [tick, tick + 1].map(|tick| traffic(200, 60, Moves::Wildly, tick, 2));
        let (before, now) = ((&before.0[..], &before.1[..]), (&now.0[..], &now.1[..]));
        let earlier = take_rolling(&camera, None, before, row, &mut scratch);
        [earlier, take_rolling(&camera, Some(before), now, row, &mut scratch)]
    });
}

#[test]
fn the_flow_of_a_row_is_that_of_its_own_time() {
    // A steady turn: each row has turned by the same angle within a period, whenever it is read.
    let (yaw_rate, readout_s) = (0.5, 0.1);
    let camera = CameraModel::new(
        &narrow(readout_s, [0.0, 0.0, 6.0, 0.0, 0.0, 0.0]),
        &config(),
        &scene_of(Vec::new()),
    );
    let steps = steady([0.0; 2], yaw_rate);
    let turn = yaw_rate * TICK_S;
    let [before, now] = [-turn, 0.0].map(|yaw| [car(0, 0.0, 0.0, yaw)]);
    let taken = take_rolling(
        &camera,
        Some((&before, &steps)),
        (&now, &steps),
        0,
        &mut CameraScratch::default(),
    );
    for (pixel, flow_px) in taken.flow_px.iter().enumerate() {
        let slope = (100.0 - (pixel % 200) as f64 - 0.5) / 400.0;
        let above = (100.0 - (pixel / 200) as f64 - 0.5) / 400.0;
        let left = (slope.atan() + turn).tan();
        let along = turn.cos() - slope * turn.sin();
        let expected = [400.0 * (left - slope), 400.0 * (above / along - above)];
        assert!(
            (0..2).all(|axis| (f64::from(flow_px[axis]) - expected[axis]).abs() < 1e-2),
            "{pixel}: {flow_px:?} {expected:?}"
        );
    }
}
