//! The sky at places computed by hand, and horizons against rays.

use super::*;
use proptest::prelude::*;
use sim_core::scene::{
    Prism, Road, SolidClass,
    shape::{Point, crossing, distance},
};
use std::f64::consts::TAU;

const MIDDLE: Geodetic = Geodetic {
    latitude_deg: 52.0,
    longitude_deg: 10.5,
};
const BOUNDS_M: [f64; 4] = [-200.0, -200.0, 200.0, 200.0];
/// Times over a sidereal day, seconds.
const TIMES: u32 = 480;

fn block([x, y]: Point, [to_x, to_y]: Point, height_m: f64) -> Prism {
    let outline = vec![[x, y], [to_x, y], [to_x, to_y], [x, to_y]];
    Prism::new("block".into(), SolidClass::Building, outline, 0.0, height_m).unwrap()
}

fn over(buildings: Vec<Prism>) -> SkyMap {
    let scene = Scene::new(Road::default(), buildings, Vec::new());
    SkyMap::new(Arc::new(scene), MIDDLE, BOUNDS_M, 1)
}

/// An east–west street 20 m wide between rows of houses 20 m high.
fn street() -> SkyMap {
    over(vec![
        block([-150.0, 10.0], [150.0, 25.0], 20.0),
        block([-150.0, -25.0], [150.0, -10.0], 20.0),
    ])
}

fn times() -> impl Iterator<Item = f64> {
    (0..TIMES).map(|i| SIDEREAL_DAY_S * f64::from(i) / f64::from(TIMES))
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

#[test]
fn an_open_sky_is_as_good_as_it_gets() {
    let (empty, far) = (over(Vec::new()), over(vec![block([150.0, 150.0], [160.0, 160.0], 5.0)]));
    for time_s in times() {
        let view = empty.at(0.0, 0.0, 0.0, time_s);
        assert!(view.has_fix && view.satellites >= 6, "{view:?}");
        assert_eq!((view.noise_factor, view.offset_m), (1.0, [0.0; 3]));
        assert_eq!(
            view,
            far.at(0.0, 0.0, 0.0, time_s),
            "a low house far away hides nothing"
        );
        assert_eq!(view, empty.at(1e4, -1e4, 0.0, time_s), "beside the map");
    }
    let satellites = mean(times().map(|time_s| f64::from(empty.at(0.0, 0.0, 0.0, time_s).satellites)));
    assert!((8.0..12.0).contains(&satellites), "{satellites}");
    let hdop = mean(times().map(|time_s| empty.epoch(time_s).hdop));
    assert!((0.8..1.4).contains(&hdop), "{hdop}");
}

#[test]
fn a_street_between_houses_is_worse_across_than_along() {
    let (open, street) = (over(Vec::new()), street());
    let at = |time_s| street.at(1.0, 3.0, 0.0, time_s);
    let seen = |map: &SkyMap| mean(times().map(|time_s| f64::from(map.at(1.0, 3.0, 0.0, time_s).satellites)));
    assert!(
        seen(&street) < seen(&open) - 2.0,
        "{} of {}",
        seen(&street),
        seen(&open)
    );
    let fixes: Vec<SkyView> = times().map(at).filter(|view| view.has_fix).collect();
    assert!(fixes.len() * 10 > TIMES as usize * 8, "{} fixes", fixes.len());
    assert!(mean(fixes.iter().map(|view| view.noise_factor)) > 1.3);
    let [east, north] = [0, 1].map(|axis: usize| mean(fixes.iter().map(|view| view.offset_m[axis].abs())));
    assert!(north > 2.0 * east && north > 0.5, "along {east}, across {north}");
    // The variance by geometry alone.
    let cell = street.kept_sky([50.0, 50.0]).unwrap();
    let horizon::CellSky::Walled(horizon) = cell else {
        panic!("{cell:?}")
    };
    let variances: Vec<[f64; 2]> = times()
        .filter_map(|time_s| received(horizon, street.epoch(time_s), [1.0, 3.0, ANTENNA_M]).1)
        .filter(|solution| solution.hdop() < MOST_HDOP)
        .map(|solution| solution.variance)
        .collect();
    let [east, north] = [0, 1].map(|axis: usize| mean(variances.iter().map(|variance| variance[axis])));
    assert!(north > 2.0 * east, "along {east}, across {north}");
}

/// An endless wall hides half of the sky; no satellite of the hidden half is received, as no wall mirrors it.
#[test]
fn a_tall_wall_takes_half_of_the_sky() {
    let walled = over(vec![block([-200.0, -60.0], [200.0, -0.5], 150.0)]);
    let open = over(Vec::new());
    for time_s in times() {
        let north = open
            .epoch(time_s)
            .satellites
            .iter()
            .filter(|placed| placed.satellite.heading[1] > 0.1)
            .count();
        let view = walled.at(0.0, 0.4, 0.0, time_s);
        let all = open.at(0.0, 0.4, 0.0, time_s).satellites as usize;
        assert!(
            (north..all).contains(&(view.satellites as usize)) && view.offset_m == [0.0; 3],
            "{view:?}"
        );
    }
}

#[test]
fn there_is_no_fix_in_a_deep_courtyard_nor_inside_a_house() {
    let courtyard = over(vec![
        block([-30.0, -30.0], [30.0, -6.0], 100.0),
        block([-30.0, 6.0], [30.0, 30.0], 100.0),
        block([-30.0, -6.0], [-6.0, 6.0], 100.0),
        block([6.0, -6.0], [30.0, 6.0], 100.0),
    ]);
    for time_s in times() {
        let view = courtyard.at(0.0, 0.0, 0.0, time_s);
        assert!(!view.has_fix && view.satellites < 4, "{view:?}");
        assert_eq!(courtyard.at(20.0, 0.0, 0.0, time_s), without_fix(0));
        assert!(courtyard.at(0.0, 0.0, 100.0, time_s).has_fix, "on the roof");
    }
}

/// Seen from (0, 0), a satellite at 30° is mirrored by a wall 12 m to the north: from the south its path is 2 · 12 m · cos 30° = 20.785 m
/// longer, from 60° to the side of that half as much. The house that hides it stands 10 m to the south.
#[test]
fn a_reflection_by_hand() {
    let reflected = |heading: Point, hider_m: f64, wall_m: f64| {
        let houses = vec![
            block([-100.0, -20.0], [100.0, -10.0], ANTENNA_M + hider_m),
            block([-5.0, 12.0], [60.0, 20.0], ANTENNA_M + wall_m),
        ];
        let scene = Scene::new(Road::default(), houses, Vec::new());
        let antenna_m = [0.0, 0.0, ANTENNA_M];
        let sky = Skyline::new(scene.buildings()).sky(&scene, antenna_m);
        let horizon::CellSky::Walled(horizon) = sky else {
            panic!("{sky:?}")
        };
        let cos_e = 30.0_f64.to_radians().cos();
        let line_of_sight = [cos_e * heading[0], cos_e * heading[1], 0.5];
        let placed = PlacedSatellite::from(constellation::Satellite::towards(line_of_sight));
        assert!(!horizon.is_in_sight(&placed, antenna_m));
        horizon.mirrors(antenna_m).extra_path_m(&placed)
    };
    let side = 0.75_f64.sqrt();
    let south = reflected([0.0, -1.0], 12.0, 30.0).unwrap();
    assert!((south - 20.785).abs() < 1e-3, "{south}");
    let east = reflected([side, -0.5], 12.0, 30.0).unwrap();
    assert!((east - 10.392).abs() < 1e-3, "{east}");
    let west = reflected([-side, -0.5], 12.0, 30.0);
    assert_eq!(
        west, None,
        "the mirrored ray leaves to the west, where there is no wall"
    );
    let low = reflected([0.0, -1.0], 12.0, 6.5);
    assert_eq!(low, None, "12 m away the ray is 6.93 m above the antenna");
    let dark = reflected([0.0, -1.0], 20.0, 30.0);
    assert_eq!(
        dark, None,
        "the house shades the wall up to 20 m − 22 m · tan 30° = 7.3 m"
    );
}

#[test]
fn the_sky_of_a_place_does_not_depend_on_the_order_of_requests() {
    let (one, other) = (street(), street());
    let places: Vec<[f64; 4]> = (0..400)
        .map(|i| {
            [
                f64::from(i % 20) * 15.0 - 150.0,
                f64::from(i / 20) - 10.0,
                f64::from(i % 3),
                f64::from(i) * 7.0,
            ]
        })
        .collect();
    let ask = |map: &SkyMap, [x, y, z, t]: [f64; 4]| map.at(x, y, z, t);
    let forward: Vec<SkyView> = places.iter().map(|place| ask(&one, *place)).collect();
    let mut backward: Vec<SkyView> = places.iter().rev().map(|place| ask(&other, *place)).collect();
    backward.reverse();
    assert_eq!(forward, backward);
    one.kept.store(MOST_HORIZONS, Ordering::Relaxed);
    let unkept = street();
    unkept.kept.store(MOST_HORIZONS, Ordering::Relaxed);
    assert_eq!(
        forward,
        places.iter().map(|place| ask(&unkept, *place)).collect::<Vec<_>>()
    );
}

#[test]
fn seeds_begin_at_different_times_and_a_day_later_all_is_the_same() {
    let mut map = street();
    let views = |map: &SkyMap, from_s: f64| {
        (0..50)
            .map(|i| map.at(0.0, 0.0, 0.0, from_s + f64::from(i) * 60.0))
            .collect::<Vec<_>>()
    };
    let first = views(&map, 0.0);
    // In the middle of a step, so that rounding does not matter.
    let shift_s = (0.5 - (map.start_s / SIDEREAL_DAY_S * STEPS as f64).fract()) * SIDEREAL_DAY_S / STEPS as f64;
    assert_eq!(views(&map, shift_s), views(&map, shift_s + SIDEREAL_DAY_S));
    map.begin_episode(2);
    assert_ne!(first, views(&map, 0.0));
    map.begin_episode(1);
    assert_eq!(first, views(&map, 0.0));
}

/// A regular pattern may have moments in which all satellites are aligned: none is bad enough to lose a fix, anywhere on earth.
#[test]
fn an_open_sky_gives_a_fix_everywhere() {
    let scene = Arc::new(Scene::default());
    for latitude_deg in [-90.0, -60.0, -33.0, 0.0, 10.0, 25.0, 45.0, 52.0, 60.0, 70.0, 80.0, 90.0] {
        for longitude_deg in [0.0, 17.0, 31.0] {
            let middle = Geodetic {
                latitude_deg,
                longitude_deg,
            };
            let map = SkyMap::new(Arc::clone(&scene), middle, BOUNDS_M, 1);
            let worst = times().map(|time_s| map.epoch(time_s).hdop).fold(0.0, f64::max);
            assert!(worst < 3.0, "{worst} at {middle:?}");
        }
    }
}

/// The bounds on cells and horizons limit memory to 24 MB and 77 MB.
#[test]
fn memory_is_bounded() {
    assert!(size_of::<OnceLock<horizon::CellSky>>() <= 24 && size_of::<horizon::Horizon>() <= 512);
    let scene = Arc::new(Scene::default());
    let large = SkyMap::new(Arc::clone(&scene), MIDDLE, [0.0, 0.0, 200_000.0, 100_000.0], 1);
    assert!(large.skies.len() < 1_010_000 && large.at(1e5, 5e4, 0.0, 0.0).has_fix);
    let long = SkyMap::new(scene, MIDDLE, [0.0, 0.0, 1e6, 0.0], 1);
    assert!(long.skies.len() <= 1_000_001);
}

/// Height above the antenna and distance of the roof with the highest elevation along a heading, by intersection with every edge;
/// [0, 1] stands for no roof.
fn highest_roof(buildings: &[Prism], place: Point, antenna_z_m: f64, angle_rad: f64) -> [f64; 2] {
    let far = [place[0] + 5e3 * angle_rad.cos(), place[1] + 5e3 * angle_rad.sin()];
    let mut highest = [0.0, 1.0];
    for building in buildings {
        let outline = &building.outline_m;
        for (i, &a) in outline.iter().enumerate() {
            if let Some(hit) = crossing(place, far, a, outline[(i + 1) % outline.len()]) {
                let seen = [building.z_m()[1] - antenna_z_m, distance(place, hit)];
                if seen[0] / seen[1] > highest[0] / highest[1] {
                    highest = seen;
                }
            }
        }
    }
    highest
}

/// Random houses: middle, distances of their corners from it, height, metres.
type Houses = Vec<(Point, Vec<f64>, f64)>;

fn houses() -> impl Strategy<Value = Houses> {
    let corners = prop::collection::vec(2.0_f64..25.0, 3..8);
    prop::collection::vec((prop::array::uniform2(-80.0_f64..80.0), corners, 2.0_f64..60.0), 1..12)
}

fn prisms(houses: &Houses) -> Vec<Prism> {
    let prism = |(turn, ([cx, cy], radii, height)): (usize, &(Point, Vec<f64>, f64))| {
        let corner = |(i, r): (usize, &f64)| {
            let angle = TAU * (i as f64 + 0.37 * turn as f64) / radii.len() as f64;
            [cx + r * angle.cos(), cy + r * angle.sin()]
        };
        let outline = radii.iter().enumerate().map(corner).collect();
        Prism::new(String::new(), SolidClass::Building, outline, 0.0, *height)
    };
    houses.iter().enumerate().filter_map(prism).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn a_view_keeps_its_invariants(houses in houses(), x in -90.0_f64..90.0, y in -90.0_f64..90.0, z in 0.0_f64..10.0, time_s in 0.0_f64..1e5) {
        let map = over(prisms(&houses));
        let (view, open) = (map.at(x, y, z, time_s), over(Vec::new()).at(x, y, z, time_s));
        prop_assert!(view.satellites <= open.satellites && view.noise_factor >= 1.0, "{view:?}");
        let [e, n, u] = view.offset_m;
        prop_assert!(libm::hypot(libm::hypot(e, n), u) < MOST_OFFSET_M * (1.0 + 1e-12), "{view:?}");
        prop_assert!(view.noise_factor * map.epoch(time_s).hdop < MOST_HDOP * (1.0 + 1e-12));
        prop_assert!(view.has_fix || view == without_fix(view.satellites));
        prop_assert!(!view.has_fix || view.satellites >= LEAST_SATELLITES);
    }

    #[test]
    fn horizons_agree_with_rays(houses in houses(), x in -60.0_f64..60.0, y in -60.0_f64..60.0, z in 0.0_f64..20.0) {
        let buildings = prisms(&houses);
        let scene = Scene::new(Road::default(), buildings.clone(), Vec::new());
        let inside = buildings.iter().any(|building| building.contains([x, y]) && building.height_m > z);
        let tan_mask = constellation::MASK_DEG.to_radians().tan();
        let expected: Vec<[f64; 2]> = (0..horizon::SECTORS)
            .map(|sector| highest_roof(&buildings, [x, y], z, TAU * (sector as f64 + 0.5) / horizon::SECTORS as f64))
            .collect();
        let is_low = |[top, distance]: [f64; 2]| top / distance <= tan_mask * (1.0 + 1e-6);
        match Skyline::new(&buildings).sky(&scene, [x, y, z]) {
            horizon::CellSky::Inside => prop_assert!(inside),
            horizon::CellSky::Open => prop_assert!(!inside && expected.iter().all(|roof| is_low(*roof))),
            horizon::CellSky::Walled(horizon) => {
                prop_assert!(!inside);
                for (sector, (found, roof)) in horizon.tangents().zip(&expected).enumerate() {
                    // Rounded to 1/64 m up and 1/32 m away, never 0. Lower than the mask it does not matter.
                    let error_rad = (found.atan() - (roof[0] / roof[1]).atan()).abs();
                    let rounding_rad = (0.5 / 64.0 + 1.0 / 32.0) / roof[0].hypot(roof[1]);
                    let are_low = found <= tan_mask && is_low(*roof);
                    prop_assert!(are_low || error_rad < 1.1 * rounding_rad, "{sector}: {found} is not {roof:?}");
                }
            }
        }
    }
}
