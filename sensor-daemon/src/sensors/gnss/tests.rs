//! Fixes against exact geodesy, and their noise against its parameters.

use super::*;
use crate::{noise::RandomStream, preset::town};
use ipc_schema::{run::MapInfo, sensor::NoiseStream};

const UTM: &str = "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs";
const SMALL_M: [f64; 4] = [0.0, 0.0, 260.0, 260.0];

fn projection(definition: &str, net_offset_m: [f64; 2]) -> Projection {
    Projection::new(&MapInfo {
        projection: definition.into(),
        net_offset_m,
        bounds_m: SMALL_M,
        traffic_lights: 0,
        world_origin_m: [0.0; 2],
    })
    .unwrap()
}

fn small() -> Projection {
    projection(
        "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs",
        [129.0, 126.0],
    )
}

fn quiet() -> Params {
    Params {
        noise_std_deg: [0.0; 2],
        ..town().gnss
    }
}

fn receiver(params: &Params) -> GnssReceiver {
    GnssReceiver::new(params, &small(), SMALL_M).unwrap()
}

fn open_sky(receiver: &GnssReceiver, place_m: [f64; 3], white: &NormalBlock) -> GnssFix {
    receiver.fix(
        place_m,
        &GnssErrors {
            white,
            unit_bias_m: &[0.0; 3],
            correlated: &[0.0; 3],
            view: &SkyView::default(),
            factor: 1.0,
        },
    )
}

/// Geodetic to earth-centred coordinates on WGS 84, metres (NIMA TR8350.2, equation 4-14).
fn ecef(latitude_deg: f64, longitude_deg: f64) -> [f64; 3] {
    let square = 0.006_694_379_990_14;
    let (phi, lambda) = (latitude_deg.to_radians(), longitude_deg.to_radians());
    let n = 6_378_137.0 / (1.0 - square * phi.sin().powi(2)).sqrt();
    [
        n * phi.cos() * lambda.cos(),
        n * phi.cos() * lambda.sin(),
        n * (1.0 - square) * phi.sin(),
    ]
}

/// How far `to` is east and north of `from`, both latitude and longitude, metres.
fn east_north(from: [f64; 2], to: [f64; 2]) -> [f64; 2] {
    let (a, b) = (ecef(from[0], from[1]), ecef(to[0], to[1]));
    let d = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
    let (sp, cp) = from[0].to_radians().sin_cos();
    let (sl, cl) = from[1].to_radians().sin_cos();
    [-sl * d[0] + cl * d[1], -sp * cl * d[0] - sp * sl * d[1] + cp * d[2]]
}

#[test]
fn without_noise_the_fix_is_the_truth_to_a_tenth_of_a_millimetre() {
    let receiver = receiver(&quiet());
    assert!(!receiver.has_white_noise() && !receiver.has_correlated_noise());
    for (x, y) in [(20.0, 17.9), (129.0, 126.0), (239.0, 236.0)] {
        let fix = open_sky(&receiver, [x, y, 3.5], &[1.0; 4]);
        assert!((fix.x_m - x).hypot(fix.y_m - y) < 1e-4, "{fix:?}");
        assert_eq!(
            (fix.z_m, fix.altitude_m, fix.satellites, fix.accuracy_m),
            (3.5, 3.5, 12, 0.0)
        );
    }
}

/// Metres and degrees together agree with exact geodesy: latitude and longitude to 1 mm of the requested error, and the position in
/// the net with the projection of that latitude and longitude.
#[test]
fn errors_in_metres_and_degrees_agree_with_exact_geodesy() {
    let bounds_m = [-25_000.0, -25_000.0, 25_000.0, 25_000.0];
    let maps = [
        (projection(UTM, [-402_990.0, -5_794_389.0]), bounds_m),
        (small(), SMALL_M),
    ];
    for (projection, bounds_m) in &maps {
        for bias_m in [[20.0, 0.0, 4.0], [0.0, -20.0, 4.0], [12.0, 12.0, -4.0]] {
            for degrees in [0.0, 5e-5] {
                let params = Params {
                    bias_m,
                    bias_deg: [degrees, -degrees],
                    ..quiet()
                };
                let receiver = GnssReceiver::new(&params, projection, *bounds_m).unwrap();
                for (share_x, share_y) in [(0.0, 0.0), (0.5, 0.5), (1.0, 0.3), (0.2, 1.0)] {
                    let x_m = bounds_m[0] + share_x * (bounds_m[2] - bounds_m[0]);
                    let y_m = bounds_m[1] + share_y * (bounds_m[3] - bounds_m[1]);
                    let fix = open_sky(&receiver, [x_m, y_m, 1.0], &[0.0; 4]);
                    let start = projection.geodetic_from_net(NetPosition { x_m, y_m }).unwrap();
                    let cosine = start.latitude_deg.to_radians().cos();
                    // What the angles alone do, then the metres from there.
                    let from = [start.latitude_deg + degrees, start.longitude_deg - degrees / cosine];
                    let [east, north] = east_north(from, [fix.latitude_deg, fix.longitude_deg]);
                    let off = (east - bias_m[0]).hypot(north - bias_m[1]);
                    assert!(off < 1e-3, "{off} m off at {x_m}, {y_m} by {bias_m:?} and {degrees}°");
                    let net = projection
                        .net_from_geodetic(sim_core::geodesy::Geodetic {
                            latitude_deg: fix.latitude_deg,
                            longitude_deg: fix.longitude_deg,
                        })
                        .unwrap();
                    assert!((net.x_m - fix.x_m).hypot(net.y_m - fix.y_m) < 1e-3);
                    assert_eq!(fix.z_m, 1.0 + bias_m[2]);
                }
            }
        }
    }
}

/// σ = 5e-5° is 5.57 m on each axis, so the mean distance is σ √(π/2) = 6.98 m; the receiver estimates σ √2.
#[test]
fn the_papers_noise_is_seven_metres_on_average_and_equal_on_both_axes() {
    const N: u32 = 40_000;
    let receiver = receiver(&town().gnss);
    let stream = RandomStream {
        episode_seed: 1,
        id_hash: 9,
        sensor: NoiseStream::Gnss,
    };
    let fixes: Vec<GnssFix> = (0..N)
        .map(|index| open_sky(&receiver, [100.0, 50.0, 0.0], &stream.normals(index)))
        .collect();
    let mean = |of: &dyn Fn(&GnssFix) -> f64| fixes.iter().map(of).sum::<f64>() / f64::from(N);
    let std_x = mean(&|fix| (fix.x_m - 100.0).powi(2)).sqrt();
    let std_y = mean(&|fix| (fix.y_m - 50.0).powi(2)).sqrt();
    let sigma_m = 5e-5_f64.to_radians() * 6_371_000.0;
    // Five standard errors of a standard deviation, σ/√(2N), and the ellipsoid's 0.5 % against the sphere.
    let tolerance = 5.0 * sigma_m / (2.0 * f64::from(N)).sqrt() + 0.005 * sigma_m;
    assert!(
        (std_x - sigma_m).abs() < tolerance && (std_y - sigma_m).abs() < tolerance,
        "{std_x} {std_y}"
    );
    let distance = mean(&|fix| (fix.x_m - 100.0).hypot(fix.y_m - 50.0));
    assert!((distance - 6.98).abs() < 0.1, "{distance}");
    assert!((fixes[0].accuracy_m - sigma_m * std::f64::consts::SQRT_2).abs() < 0.005 * sigma_m * 2.0);
    assert!(fixes.iter().all(|fix| fix.z_m == 0.0));
}

/// All errors at once: variance by axis, and the receiver's own estimate against the root mean square of the distance.
#[test]
fn the_receivers_estimate_is_the_root_mean_square_of_its_errors() {
    const N: u32 = 100_000;
    let params = Params {
        noise_std_deg: [1e-5, 2e-5],
        bias_deg: [0.0, 1e-5],
        noise_std_m: [1.0, 2.0, 3.0],
        bias_m: [0.5, 0.0, -2.0],
        correlated_std_m: [1.5, 1.0, 2.0],
        ..town().gnss
    };
    let receiver = receiver(&params);
    assert!(receiver.has_white_noise() && receiver.has_correlated_noise());
    let stream = |sensor| RandomStream {
        episode_seed: 1,
        id_hash: 9,
        sensor,
    };
    let view = SkyView {
        noise_factor: 2.0,
        satellites: 6,
        ..SkyView::default()
    };
    let (mut squares, mut up, mut estimate) = (0.0, 0.0, 0.0);
    for index in 0..N {
        let [e, n, u, _] = stream(NoiseStream::GnssCorrelated).normals(index);
        let fix = receiver.fix(
            [100.0, 50.0, 0.0],
            &GnssErrors {
                white: &stream(NoiseStream::Gnss).normals(index),
                unit_bias_m: &[0.0; 3],
                correlated: &[e, n, u],
                view: &view,
                factor: 1.5,
            },
        );
        squares += (fix.x_m - 100.0).powi(2) + (fix.y_m - 50.0).powi(2);
        up += (fix.z_m + 3.0).powi(2);
        estimate = fix.accuracy_m;
        assert_eq!(fix.satellites, 6);
    }
    let rms = (squares / f64::from(N)).sqrt();
    // The distance of two unlike axes varies by less than its mean: five standard errors are below 1 %.
    assert!((rms / estimate - 1.0).abs() < 0.01, "{rms} {estimate}");
    let std = (up / f64::from(N)).sqrt();
    let expected = 3.0 * (9.0_f64 + 4.0).sqrt();
    assert!(
        (std / expected - 1.0).abs() < 5.0 / (2.0 * f64::from(N)).sqrt(),
        "{std}"
    );
}

/// Autocorrelation of the correlated error: exp(−t/τ), variance 1 from the first sample on.
#[test]
fn the_correlated_error_is_a_stationary_gauss_markov_process() {
    const VEHICLES: u64 = 4000;
    let params = Params {
        correlated_std_m: [1.0; 3],
        correlation_time_s: 2.0,
        period_s: 0.1,
        ..quiet()
    };
    let receiver = receiver(&params);
    let n = VEHICLES as f64;
    let mut products = [0.0; 3];
    let mut variances = [0.0; 41];
    for id_hash in 0..VEHICLES {
        let stream = RandomStream {
            episode_seed: 1,
            id_hash,
            sensor: NoiseStream::GnssCorrelated,
        };
        let [a, b, c, _] = stream.normals(0);
        let mut path = vec![[a, b, c]];
        for index in 1..=40 {
            path.push(receiver.correlated(path[path.len() - 1], &stream.normals(index)));
        }
        for (variance, state) in variances.iter_mut().zip(&path) {
            *variance += f64::from(state[0]).powi(2) / n;
        }
        for (product, lag) in products.iter_mut().zip([10, 20, 40]) {
            *product += f64::from(path[0][1] * path[lag][1]) / n;
        }
    }
    for variance in variances {
        assert!((variance - 1.0).abs() < 5.0 * (2.0 / n).sqrt(), "{variance}");
    }
    for (product, time_s) in products.iter().zip([1.0_f64, 2.0, 4.0]) {
        let expected = (-time_s / 2.0).exp();
        // Variance of a product of two correlated normal numbers: 1 + ρ².
        let tolerance = 5.0 * ((1.0 + expected * expected) / n).sqrt();
        assert!((product - expected).abs() < tolerance, "{product} after {time_s} s");
    }
}

#[test]
fn reflections_move_a_fix_and_a_smartphone_errs_more() {
    let params = Params {
        bias_m: [1.0, 2.0, 3.0],
        ..quiet()
    };
    let receiver = receiver(&params);
    let view = SkyView {
        offset_m: [10.0, 0.0, 5.0],
        ..SkyView::default()
    };
    let fix = receiver.fix(
        [129.0, 126.0, 0.0],
        &GnssErrors {
            white: &[0.0; 4],
            unit_bias_m: &[0.0; 3],
            correlated: &[0.0; 3],
            view: &view,
            factor: 2.0,
        },
    );
    assert!((fix.x_m - 141.0).abs() < 1e-3 && (fix.y_m - 130.0).abs() < 1e-3 && fix.z_m == 11.0);
}
