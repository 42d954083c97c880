//! Images of single bodies in closed form.

use ipc_schema::traffic::class_number;
use sensor_daemon::sensors::camera::{SKY_INSTANCE, SemanticLabel};
use sim_core::scene::{NO_JUNCTION, RoadPiece, SurfaceKind};

use crate::{
    CameraModel, CameraScratch, GROUND, Kind, Road, Scene, Taken, VehicleState, car, config, params, rectangle,
    scene_of, take,
};

fn at(taken: &Taken, u: usize, v: usize) -> (u32, f32, u8, u8) {
    let pixel = v * 100 + u;
    (
        taken.instance[pixel],
        taken.depth_m[pixel],
        taken.semantic[pixel],
        taken.binary[pixel],
    )
}

#[test]
fn a_wall_square_to_the_camera_has_one_depth() {
    let scene = scene_of(vec![rectangle([12.0, 20.0], [-30.0, 30.0], 4.5)]);
    let camera = CameraModel::new(&params(100, 100, [2.0, 0.0, 1.5, 0.0, 0.0, 0.0]), &config(), &scene);
    let (taken, _) = take(&camera, &[car(0, 0.0, 0.0, 0.0)], 0, &mut CameraScratch::default());
    // f = 50 px: the roof is 3 m above at 10 m, 15 px over the middle; the foot 1.5 m below, 7.5 px under it.
    for u in 0..100 {
        for v in 0..100 {
            let (instance, depth_m, label, binary) = at(&taken, u, v);
            let below = (v as f64 + 0.5 - 50.0) / 50.0;
            if below < -0.3 {
                assert!(
                    (instance, label) == (SKY_INSTANCE, SemanticLabel::Sky as u8) && (depth_m - 120.0).abs() < 1e-4
                );
            } else if below < 0.15 {
                assert!(instance == 1 << 31 && label == SemanticLabel::Building as u8 && (depth_m - 10.0).abs() < 1e-5);
            } else {
                let expected = 1.5 / below;
                assert!(
                    instance == GROUND && label == SemanticLabel::Terrain as u8,
                    "({u}, {v})"
                );
                assert!((f64::from(depth_m) - expected).abs() < 1e-5 * expected);
            }
            assert_eq!(binary, 0);
        }
    }
}

#[test]
fn each_kind_of_road_user_has_its_class_and_is_white() {
    use SemanticLabel::{Bicycle, Bus, Car, Dynamic, Motorcycle, Person, Train, Truck};
    let of = |class: &str, [length_m, width_m, height_m]: [f32; 3], kind: Kind| VehicleState {
        class: class_number(class),
        length_m,
        width_m,
        height_m,
        kind: kind as u32,
        ..car(1, 20.0, 0.0, 0.0)
    };
    for (state, expected) in [
        (of("passenger", [5.0, 1.8, 1.5], Kind::Other), Car),
        (of("delivery", [6.5, 2.16, 2.86], Kind::Other), Truck),
        (of("truck", [5.8, 2.2, 2.0], Kind::Other), Truck),
        (of("taxi", [6.2, 2.0, 2.2], Kind::Other), Car),
        (of("trailer", [16.5, 2.55, 4.0], Kind::Other), Truck),
        (of("trailer", [9.0, 2.55, 3.5], Kind::Trailing), Truck),
        (of("bus", [8.0, 2.5, 3.4], Kind::Other), Bus),
        (of("coach", [14.0, 2.6, 4.0], Kind::Other), Bus),
        (of("tram", [22.0, 2.4, 3.2], Kind::Other), Train),
        (of("rail_fast", [25.0, 2.95, 3.6], Kind::Trailing), Train),
        (of("moped", [1.8, 0.8, 1.7], Kind::Other), Motorcycle),
        (of("bicycle", [2.0, 0.65, 1.7], Kind::Other), Bicycle),
        (of("ship", [17.0, 4.0, 4.0], Kind::Other), Dynamic),
        (of("wheelchair", [0.8, 0.7, 1.4], Kind::Other), Person),
        (of("pedestrian", [0.5, 0.5, 1.7], Kind::Person), Person),
        // Types of vehicles whose class names no kind: their size decides.
        (of("ignoring", [7.1, 2.4, 2.4], Kind::Other), Truck),
        (of("passenger", [16.5, 2.55, 4.0], Kind::Other), Truck),
        (of("passenger", [12.0, 2.5, 3.4], Kind::Other), Bus),
        (of("custom1", [2.2, 0.9, 1.5], Kind::Other), Motorcycle),
        (of("passenger", [1.6, 0.65, 1.7], Kind::Other), Bicycle),
    ] {
        let camera = CameraModel::new(
            &params(100, 100, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
            &config(),
            &scene_of(Vec::new()),
        );
        let (taken, _) = take(
            &camera,
            &[car(0, 0.0, 0.0, 0.0), state],
            0,
            &mut CameraScratch::default(),
        );
        let (instance, _, label, binary) = at(&taken, 49, 50);
        assert_eq!((instance, label, binary), (1, expected as u8, 255));
        assert_eq!(taken.objects[0].label, expected as u32);
    }
}

/// A road at the height 1 m from west to east, and one at 8 m from south to north on a deck of 0.8 m.
fn crossing_levels() -> Scene {
    let lane = |id: &str, shape_m: Vec<[f64; 3]>| RoadPiece {
        id: id.into(),
        surface: SurfaceKind::Lane,
        shape_m,
        half_width_m: Some(3.0),
        junctions: [NO_JUNCTION; 2],
    };
    let pieces = vec![
        lane("below_0", vec![[-90.0, 0.0, 1.0], [90.0, 0.0, 1.0]]),
        lane("above_0", vec![[0.0, -90.0, 8.0], [0.0, 90.0, 8.0]]),
    ];
    Scene::new(Road::new(pieces), Vec::new(), Vec::new())
}

#[test]
fn a_bridge_is_a_road_on_top_and_seen_from_below() {
    let scene = crossing_levels();
    let seen = |x_m: f64, z_m: f64, mount: [f64; 6]| {
        let camera = CameraModel::new(&params(100, 100, mount), &config(), &scene);
        let state = VehicleState {
            z_m,
            ..car(0, x_m, 0.0, 0.0)
        };
        let (taken, _) = take(&camera, &[state], 0, &mut CameraScratch::default());
        // The ray beside the optical axis: one half pixel off it.
        at(&taken, 50, 50)
    };
    let straight = |pitch: f64| [0.0, 0.0, 1.5, 0.0, pitch, 0.0];
    let half_turn = std::f64::consts::FRAC_PI_2;
    let is = |(instance, depth_m, label, _): (u32, f32, u8, u8), wanted: SemanticLabel, wanted_m: f32| {
        assert_eq!((instance, label), (GROUND, wanted as u8));
        assert!((depth_m - wanted_m).abs() < 0.01, "{depth_m} instead of {wanted_m}");
    };
    // From below, straight up to the underside; on the deck, straight down; from the west, at its side and under it.
    is(
        seen(0.0, 1.0, straight(half_turn)),
        SemanticLabel::Bridge,
        8.0 - 0.8 - 2.5,
    );
    is(seen(0.0, 8.0, straight(-half_turn)), SemanticLabel::Road, 1.5);
    let side = [0.0, 0.0, 6.6, 0.0, 0.0, 0.0];
    is(seen(-30.0, 1.0, side), SemanticLabel::Bridge, 27.0);
    is(seen(-4.0, 1.0, straight(-half_turn)), SemanticLabel::Road, 1.5);
}

#[test]
fn fog_whitens_what_is_far_and_night_darkens_all() {
    let scene = scene_of(vec![rectangle([52.0, 60.0], [-99.0, 99.0], 40.0)]);
    let wall = |visibility_m: f64, sun_deg: f64| {
        let mut config = config();
        (config.weather.visibility_m, config.weather.sun_elevation_deg) = (visibility_m, sun_deg);
        config.weather.sunlight = 0.0;
        let camera = CameraModel::new(&params(100, 100, [2.0, 0.0, 1.5, 0.0, 0.0, 0.0]), &config, &scene);
        let (taken, _) = take(&camera, &[car(0, 0.0, 0.0, 0.0)], 0, &mut CameraScratch::default());
        [taken.rgb[40 * 100 + 50], taken.rgb[0]]
    };
    let [[clear, sky], [fog, _], [night, _]] = [wall(1e9, 45.0), wall(50.0, 45.0), wall(1e9, -20.0)];
    for i in 0..3 {
        // Koschmieder: at the visibility, exp(−3.912) = 2 % of the contrast is left.
        let expected = f64::from(sky[i]) + 0.02 * (f64::from(clear[i]) - f64::from(sky[i]));
        assert!((f64::from(fog[i]) - expected).abs() <= 1.5, "{fog:?} {clear:?} {sky:?}");
        assert!(night[i] * 5 < clear[i], "{night:?} {clear:?}");
    }
}

#[test]
fn thermal_images_show_warm_bodies_a_cold_sky_and_the_air_in_fog() {
    let person = VehicleState {
        length_m: 0.5,
        width_m: 0.5,
        height_m: 1.7,
        kind: Kind::Person as u32,
        ..car(2, 12.0, 0.0, 0.0)
    };
    let states = [car(0, 0.0, 0.0, 0.0), car(1, 12.0, 6.0, 0.0), person];
    let kelvin = |visibility_m: f64, sunlight: f64| {
        let mut config = config();
        config.weather.air_temperature_c = 10.0;
        config.weather.visibility_m = visibility_m;
        (config.weather.sunlight, config.weather.sun_elevation_deg) = (sunlight, 40.0);
        let camera = CameraModel::new(
            &params(100, 100, [2.0, 0.0, 1.5, 0.0, 0.0, 0.0]),
            &config,
            &scene_of(Vec::new()),
        );
        let (taken, _) = take(&camera, &states, 0, &mut CameraScratch::default());
        let of = |instance: u32| {
            let pixel = taken.instance.iter().position(|found| *found == instance).unwrap();
            f64::from(taken.infrared[pixel]) / 100.0
        };
        [of(SKY_INSTANCE), of(1), of(2), of(GROUND)]
    };
    let air_k = 283.15;
    let [sky, car, person, grass] = kelvin(1e6, 1.0);
    // Swinbank: 0.0552 · 283.15^1.5 = 263.0 K; 120 m of clear air take a thousandth of the difference.
    assert!((sky - 263.0).abs() < 0.2, "{sky}");
    // Half-way between the skin's 306.15 K and the air, of emissivity 0.97.
    assert!((person - 0.5 * (306.15 + air_k)).abs() < 1.0, "{person}");
    // 7 K and the sun's 12 K · sin 40° above the air, of emissivity 0.92.
    assert!((car - (air_k + 7.0 + 12.0 * 0.6428)).abs() < 2.5, "{car}");
    assert!((grass - (air_k - 1.0 + 6.0 * 0.6428)).abs() < 1.0, "{grass}");
    let [sky, car, person, grass] = kelvin(1e6, 0.0);
    assert!(
        (sky - air_k).abs() < 0.02,
        "an overcast sky is as warm as the air: {sky}"
    );
    assert!(person > car && car > grass && grass < air_k);
    // Koschmieder in dense fog: at the visibility 2 % of the difference are left.
    let [_, _, fogged, _] = kelvin(10.0, 0.0);
    assert!((fogged - air_k - 0.02 * (person - air_k)).abs() < 0.1, "{fogged}");
}

#[test]
fn odd_positions_do_no_harm() {
    let scene = scene_of(vec![rectangle([-5.0, 5.0], [-5.0, 5.0], 9.0)]);
    let camera = CameraModel::new(&params(40, 30, [0.0, 0.0, 1.5, 0.1, 0.0, 0.0]), &config(), &scene);
    let mut scratch = CameraScratch::default();
    for [x, y, z] in [
        [0.0; 3],
        [5.0, 5.0, 0.0],
        [5.0, 0.0, 0.0],
        [5.0 + 1e-9, 1e-9, 7.5],
        [9.0, 0.0, -30.0],
        [0.0, 0.0, 90.0],
    ] {
        let mut states = [car(0, x, y, 3.0), car(1, x, y, 1.0), car(2, x + 3.0, y, 0.0)];
        states[0].z_m = z;
        let (taken, _) = take(&camera, &states, 0, &mut scratch);
        assert!(
            taken.depth_m.iter().all(|depth_m| (0.0..=120.001).contains(depth_m)),
            "{x} {y} {z}"
        );
        assert!(z >= 0.0 || !taken.instance.contains(&GROUND));
    }
    let none = CameraModel::new(
        &params(40, 30, [0.0; 6]),
        &config(),
        &Scene::new(Road::default(), Vec::new(), Vec::new()),
    );
    assert_eq!(take(&none, &[car(0, 0.0, 0.0, 0.0)], 0, &mut scratch).0.objects, []);
}
