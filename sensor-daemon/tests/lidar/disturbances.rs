//! Noise, weak returns and weather.

use crate::{Scanned, car, empty, range, scan, small};

#[test]
fn noise_has_the_configured_level() {
    let mut config = small(32, 1800);
    config.lidar.range_noise_std_m = 0.05;
    let exact = scan(&small(32, 1800), &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    let noisy = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    let errors: Vec<f64> = exact
        .points
        .iter()
        .zip(&noisy.points)
        .map(|(a, b)| range(b) - range(a))
        .collect();
    let n = errors.len() as f64;
    let mean = errors.iter().sum::<f64>() / n;
    let std = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    assert!(mean.abs() < 5.0 * 0.05 / n.sqrt(), "{mean}");
    assert!((std / 0.05 - 1.0).abs() < 5.0 / (2.0 * n).sqrt(), "{std}");
    // Neighbours, and the two rays of one draw, are independent.
    for apart in [1, 16, 27] {
        let pairs = errors.iter().zip(&errors[apart..]);
        let correlation = pairs.map(|(a, b)| a * b).sum::<f64>() / n / 0.05_f64.powi(2);
        assert!(correlation.abs() < 5.0 / n.sqrt(), "{apart}: {correlation}");
    }
}

#[test]
fn intensity_falls_with_range_and_weak_returns_get_lost() {
    let mut config = small(32, 1800);
    config.lidar.attenuation_per_m = 0.02;
    let all = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    for point in &all.points {
        assert!((f64::from(point.intensity) / (-0.02 * range(point)).exp() - 1.0).abs() < 1e-5);
    }
    config.lidar.dropoff = 0.25;
    config.lidar.dropoff_intensity = 0.8;
    config.lidar.dropoff_zero_intensity = 0.4;
    let some = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    for channel in [0_u16, 12, 20] {
        let of = |scanned: &Scanned| scanned.points.iter().filter(|point| point.channel == channel).count() as f64;
        let point = all.points.iter().find(|point| point.channel == channel).unwrap();
        let weak = 0.4 * (1.0 - f64::from(point.intensity) / 0.8).max(0.0);
        let kept = 0.75 * (1.0 - weak);
        let share = of(&some) / of(&all);
        assert!(
            (share - kept).abs() < 5.0 * (kept * (1.0 - kept) / of(&all)).sqrt(),
            "{channel}: {share} of {kept}"
        );
    }
}

#[test]
fn rain_fog_and_sun_disturb() {
    let mut config = small(32, 1800);
    config.lidar.attenuation_per_m = 0.0;
    let clear = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    config.weather.rain_mmph = 10.0;
    let rain = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    // e^(−2 α d) (range / d)² falls to 1 at d = 44.3 m for α = 0.039 81 1/m, range 100 m.
    let farthest = rain.points.iter().map(range).fold(0.0, f64::max);
    assert!(rain.points.len() < clear.points.len() && farthest < 32.0, "{farthest}");
    config.weather.rain_mmph = 0.0;
    config.weather.visibility_m = 100.0;
    let fog = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    let point = fog.points[0];
    assert!(point.intensity < 0.9 && fog.points.len() < clear.points.len());
    config.weather.visibility_m = 50_000.0;
    config.weather.sunlight = 1.0;
    config.weather.sun_elevation_deg = 5.0;
    let sunny = scan(&config, &empty(), &[car(0, 0.0, 0.0, 0.0)]);
    let noise = |towards_sun: bool| {
        let errors = clear
            .points
            .iter()
            .zip(&sunny.points)
            .filter(|(a, _)| (a.position_m[1] < 0.0) == towards_sun);
        let errors: Vec<f64> = errors.map(|(a, b)| (range(b) - range(a)).abs()).collect();
        errors.iter().sum::<f64>() / errors.len() as f64
    };
    assert!(
        noise(true) > 0.01 && noise(false) < 1e-5,
        "{} {}",
        noise(true),
        noise(false)
    );
}
