//! Images have the same bytes on every instruction set, in any order of road users, and after any other image.

use std::sync::{Arc, LazyLock};

use sensor_daemon::sensors::{camera::SightScene, lidar::ScanPath};

use crate::{
    CameraModel, CameraParams, CameraScratch, Taken, VehicleState, config, lidar_city,
    lidar_city::{Moves, traffic},
    params, take_since,
};

fn busy(path: ScanPath, size: [usize; 2], states: &[VehicleState], scratch: &mut CameraScratch) -> Taken {
    busy_through([0.0; 5], path, size, states, scratch)
}

/// An image through a lens with this distortion.
fn busy_through(
    distortion: [f64; 5],
    path: ScanPath,
    size: [usize; 2],
    states: &[VehicleState],
    scratch: &mut CameraScratch,
) -> Taken {
    // Half a second of work that does not depend on the path.
    static SIGHT: LazyLock<Arc<SightScene>> = LazyLock::new(|| {
        let mut config = config();
        config.weather.visibility_m = 300.0;
        config.weather.sunlight = 0.7;
        config.weather.sun_elevation_deg = 30.0;
        Arc::new(SightScene::new(&config, &lidar_city::scene(500, 1)))
    });
    let params = CameraParams {
        distortion,
        ..params(size[0], size[1], [1.5, 0.0, 1.4, 0.02, -0.03, 0.3])
    };
    let camera = CameraModel::in_sight(&params, Arc::clone(&SIGHT)).with_path(path);
    assert!(camera.path() == path);
    let before: Vec<_> = states
        .iter()
        .map(|state| VehicleState {
            x_m: state.x_m - state.yaw_rad.cos(),
            yaw_rad: state.yaw_rad - 0.02,
            ..*state
        })
        .collect();
    take_since(&camera, Some(&before), states, 0, scratch).0
}

#[test]
fn every_path_gives_the_same_bytes() {
    let (states, _) = traffic(200, 60, Moves::Wildly, 0, 2);
    for size in [[84, 84], [320, 160], [1, 1], [17, 9]] {
        let expected = busy(ScanPath::Plain, size, &states, &mut CameraScratch::default());
        for path in ScanPath::ALL.into_iter().filter(|path| path.is_here()) {
            let taken = busy(path, size, &states, &mut CameraScratch::default());
            assert!(taken == expected, "{path:?} {size:?}");
        }
        let lens = [-0.12, 0.01, 0.004, -0.006, 0.0];
        let bent = busy_through(lens, ScanPath::Plain, size, &states, &mut CameraScratch::default());
        assert!(size == [1, 1] || bent != expected, "{size:?}");
        for path in ScanPath::ALL.into_iter().filter(|path| path.is_here()) {
            // The scratch memory has the size, but not the lens, of another camera.
            let mut scratch = CameraScratch::default();
            assert!(busy(path, size, &states, &mut scratch) == expected);
            assert!(
                busy_through(lens, path, size, &states, &mut scratch) == bent,
                "{path:?} {size:?}"
            );
            assert!(busy(path, size, &states, &mut scratch) == expected);
        }
    }
}

#[test]
fn neither_the_order_of_road_users_nor_used_scratch_matters() {
    let (states, _) = traffic(200, 60, Moves::Wildly, 0, 2);
    let turned: Vec<_> = std::iter::once(&states[0])
        .chain(states[1..].iter().rev())
        .copied()
        .collect();
    let mut scratch = CameraScratch::default();
    let mut expected = busy(ScanPath::best(), [84, 84], &states, &mut scratch);
    let _ = busy(ScanPath::best(), [320, 160], &states, &mut scratch);
    assert!(busy(ScanPath::best(), [84, 84], &states, &mut scratch) == expected);
    let mut taken = busy(ScanPath::best(), [84, 84], &turned, &mut scratch);
    for image in [&mut taken, &mut expected] {
        image.objects.sort_by_key(|seen| seen.object);
    }
    assert!(taken == expected);
}
