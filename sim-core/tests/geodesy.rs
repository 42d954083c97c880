//! The projection compared with PROJ, and its inverse over 50 km × 50 km.

#![allow(clippy::unwrap_used, clippy::panic, reason = "test code may assert by unwrapping")]

use ipc_schema::run::MapInfo;
use sim_core::geodesy::{GeodesyError, Geodetic, NetPosition, Projection};

#[path = "common/spherical.rs"]
mod spherical;

const A10KW: &str = "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs";
const ORIGIN: Geodetic = Geodetic {
    latitude_deg: 52.2773,
    longitude_deg: 10.5391,
};
const SOUTH: &str = "+proj=utm +zone=23 +south +datum=WGS84 +units=m +no_defs";
const MERCATOR: &str = "+proj=merc +lon_0=0 +datum=WGS84 +units=m +no_defs";
const LAMBERT: &str =
    "+proj=lcc +lat_1=49 +lat_2=44 +lat_0=46.5 +lon_0=3 +x_0=700000 +y_0=6600000 +ellps=GRS80 +units=m +no_defs";

/// The projection of a net without one.
fn origin_projection(origin: Geodetic) -> String {
    format!(
        "+proj=tmerc +lat_0={} +lon_0={} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs",
        origin.latitude_deg, origin.longitude_deg
    )
}

fn projection(definition: &str, net_offset_m: [f64; 2]) -> Projection {
    Projection::new(&map(definition, net_offset_m)).unwrap()
}

fn map(definition: &str, net_offset_m: [f64; 2]) -> MapInfo {
    MapInfo {
        projection: definition.into(),
        net_offset_m,
        bounds_m: [0.0, 0.0, 1.0, 1.0],
        traffic_lights: 0,
        world_origin_m: [0.0; 2],
    }
}

fn cases() -> Vec<(Projection, Vec<[f64; 4]>)> {
    vec![
        (
            projection(A10KW, [-402_990.32, -5_794_389.48]),
            vec![
                [0.0, 0.0, 52.291286750005, 13.577618942568],
                [2_817.12, 3_173.89, 52.320303433354, 13.618022986958],
                [-25_000.0, -25_000.0, 52.061646463808, 13.220227439979],
                [25_000.0, 25_000.0, 52.519852182539, 13.938716236271],
                [-25_000.0, 25_000.0, 52.510953179367, 13.202126274242],
            ],
        ),
        (
            projection(&origin_projection(ORIGIN), [0.0, 0.0]),
            vec![
                [0.0, 0.0, 52.277300000000, 10.539100000000],
                [220.0, 220.0, 52.279277081837, 10.542323451943],
                [-25_000.0, -25_000.0, 52.052058780661, 10.174659001019],
                [25_000.0, 25_000.0, 52.501396494477, 10.907245348203],
            ],
        ),
        (
            projection(SOUTH, [-323_000.0, -7_394_000.0]),
            vec![
                [0.0, 0.0, -23.554720800442, -46.734126953105],
                [25_000.0, 25_000.0, -23.331512186855, -46.486734607652],
            ],
        ),
        (
            projection(MERCATOR, [-1_000_000.0, -6_000_000.0]),
            vec![
                [0.0, 0.0, 47.545309636381, 8.983152841195],
                [25_000.0, 25_000.0, 47.697145547199, 9.207731662225],
            ],
        ),
        (
            projection(LAMBERT, [-650_000.0, -6_860_000.0]),
            vec![
                [0.0, 0.0, 48.838110122583, 2.318790597038],
                [25_000.0, 25_000.0, 49.064373196229, 2.657913351563],
            ],
        ),
    ]
}

/// Latitudes and longitudes from pyproj 3.7.2 (PROJ 9.5.1): `Proj(definition)(x - offset_x, y - offset_y, inverse=True)`.
/// 1e-9 degrees are 0.1 mm.
#[test]
fn agrees_with_proj() {
    for (projection, points) in cases() {
        for [x_m, y_m, latitude_deg, longitude_deg] in points {
            let geodetic = projection.geodetic_from_net(NetPosition { x_m, y_m }).unwrap();
            assert!(
                (geodetic.latitude_deg - latitude_deg).abs() < 1e-9,
                "{geodetic:?} for ({x_m}, {y_m})"
            );
            assert!(
                (geodetic.longitude_deg - longitude_deg).abs() < 1e-9,
                "{geodetic:?} for ({x_m}, {y_m})"
            );
            let net = projection
                .net_from_geodetic(Geodetic {
                    latitude_deg,
                    longitude_deg,
                })
                .unwrap();
            assert!(
                (net.x_m - x_m).hypot(net.y_m - y_m) < 1e-4,
                "{net:?} for ({x_m}, {y_m})"
            );
        }
    }
}

/// A row of `data/geodesy.csv`: by pyproj and pymap3d, see `data/geodesy.py`.
struct Reference {
    projection: Projection,
    net: NetPosition,
    geodetic: Geodetic,
    /// In the plane that touches the ellipsoid at net (0, 0), metres.
    east_north_up_m: [f64; 3],
    /// On the paper's sphere, metres.
    sphere_m: [f64; 3],
    sphere_east_north_m: [f64; 2],
}

impl Reference {
    fn read(line: &str) -> Self {
        let (definition, numbers) = line.split_once(',').unwrap();
        let numbers: Vec<f64> = numbers.split(',').map(|number| number.parse().unwrap()).collect();
        let &[
            offset_x,
            offset_y,
            x_m,
            y_m,
            latitude_deg,
            longitude_deg,
            e,
            n,
            u,
            x,
            y,
            z,
            se,
            sn,
        ] = &numbers[..]
        else {
            panic!("{line}")
        };
        Self {
            projection: projection(definition, [offset_x, offset_y]),
            net: NetPosition { x_m, y_m },
            geodetic: Geodetic {
                latitude_deg,
                longitude_deg,
            },
            east_north_up_m: [e, n, u],
            sphere_m: [x, y, z],
            sphere_east_north_m: [se, sn],
        }
    }

    fn origin(&self) -> Geodetic {
        self.projection.geodetic_from_net(NetPosition::default()).unwrap()
    }
}

fn references() -> Vec<Reference> {
    include_str!("data/geodesy.csv")
        .lines()
        .skip(1)
        .map(Reference::read)
        .collect()
}

fn assert_close(actual: &[f64], expected: &[f64], tolerance_m: f64) {
    for (a, e) in actual.iter().zip(expected) {
        assert!((a - e).abs() < tolerance_m, "{actual:?} is not {expected:?}");
    }
}

/// Five projections over 50 km × 50 km, both ways, to a tenth of a millimetre.
#[test]
fn agrees_with_pyproj_over_50_km_square() {
    for Reference {
        projection,
        net,
        geodetic,
        ..
    } in references()
    {
        let found = projection.geodetic_from_net(net).unwrap();
        let angles = |place: Geodetic| [place.latitude_deg, place.longitude_deg];
        assert_close(&angles(found), &angles(geodetic), 1e-9);
        let back = projection.net_from_geodetic(geodetic).unwrap();
        assert_close(&[back.x_m, back.y_m], &[net.x_m, net.y_m], 1e-4);
    }
}

/// Against pymap3d, which has no projection but the exact plane that touches the ellipsoid. A transverse Mercator about the same origin bends that
/// plane along the ground: on a sphere east = R tanh(x/R), north = R sin(y/R) / cosh(x/R), up = R (cos(y/R) / cosh(x/R) − 1). The ellipsoid with
/// R = √(M N), the mean radius of curvature at the origin, differs by less than a millimetre sideways, and by the difference of M and N (0.3 % of
/// the 98 m that the ground falls away) in height.
#[test]
fn agrees_with_pymap3d_over_50_km_square() {
    for reference in references() {
        let origin = reference.origin();
        let local = projection(&origin_projection(origin), [0.0; 2]);
        let place = reference.projection.geodetic_from_net(reference.net).unwrap();
        let NetPosition { x_m, y_m } = local.net_from_geodetic(place).unwrap();
        let radius_m = mean_radius_of_curvature_m(origin.latitude_deg);
        let (x, y) = (x_m / radius_m, y_m / radius_m);
        let east_north_m = [radius_m * x.tanh(), radius_m * y.sin() / x.cosh()];
        assert_close(&east_north_m, &reference.east_north_up_m, 1e-3);
        let up_m = radius_m * (y.cos() / x.cosh() - 1.0);
        assert!((up_m - reference.east_north_up_m[2]).abs() < 0.004 * up_m.abs() + 1e-6);
    }
}

/// √(M N), metres, M along the meridian and N across (WGS 84).
fn mean_radius_of_curvature_m(latitude_deg: f64) -> f64 {
    const EQUATOR_M: f64 = 6_378_137.0;
    const ECCENTRICITY2: f64 = 6.694_379_990_14e-3;
    let flat = 1.0 - ECCENTRICITY2 * latitude_deg.to_radians().sin().powi(2);
    EQUATOR_M * (1.0 - ECCENTRICITY2).sqrt() / flat
}

/// The paper's equations 1 and 2 against pymap3d on the same sphere.
#[test]
fn the_papers_equations_agree_with_pymap3d_on_a_sphere() {
    for reference in references() {
        let ecef_m = spherical::ecef_from_geodetic(reference.geodetic);
        assert_close(&ecef_m, &reference.sphere_m, 1e-6);
        let east_north_m = spherical::east_north_from_geodetic(reference.origin(), reference.geodetic);
        assert_close(&east_north_m, &reference.sphere_east_north_m, 1e-4);
    }
}

#[test]
fn the_inverse_returns_the_point_over_50_km_square() {
    for (projection, _) in cases() {
        for i in -25..=25 {
            for j in -25..=25 {
                let start = NetPosition {
                    x_m: f64::from(i) * 1000.0,
                    y_m: f64::from(j) * 1000.0,
                };
                let end = projection
                    .net_from_geodetic(projection.geodetic_from_net(start).unwrap())
                    .unwrap();
                assert!(
                    (end.x_m - start.x_m).hypot(end.y_m - start.y_m) < 1e-4,
                    "{start:?} came back as {end:?}"
                );
            }
        }
    }
}

#[test]
fn unusable_projections_are_named() {
    assert_eq!(
        Projection::new(&map("!", [0.0; 2])).unwrap_err(),
        GeodesyError::NoProjection("!".into())
    );
    for definition in [
        "+proj=longlat +datum=WGS84",
        "+proj=nonsense",
        "utm",
        "+proj=utm +zone=99",
    ] {
        let error = Projection::new(&map(definition, [0.0; 2])).unwrap_err();
        assert!(error.to_string().contains(definition), "{error}");
    }
    let outside = projection(A10KW, [0.0; 2]).net_from_geodetic(Geodetic {
        latitude_deg: f64::NAN,
        longitude_deg: 0.0,
    });
    assert!(matches!(outside, Err(GeodesyError::OutsideDomain { .. })));
}

#[test]
fn can_be_shared_between_threads() {
    fn assert<T: Send + Sync>() {}
    assert::<Projection>();
}
