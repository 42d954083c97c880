//! Noise of pixels against the linear model of EMVA Standard 1288.

use sensor_daemon::sensors::{
    camera::{CameraModel, ImageNoise, PixelNoise},
    lidar::ScanPath,
};

use crate::{Taken, VehicleState, car, config, params, rectangle, scene_of, take_noisy};

const SIZE: [usize; 2] = [160, 120];
/// Images of each measurement: 19 200 pixels each.
const IMAGES: u64 = 20;

/// A camera in front of a wall that fills its image.
fn wall() -> (CameraModel, [VehicleState; 1]) {
    let scene = scene_of(vec![rectangle([10.0, 12.0], [-60.0, 60.0], 80.0)]);
    let params = params(SIZE[0], SIZE[1], [0.0, 0.0, 40.0, 0.0, 0.0, 0.0]);
    (CameraModel::new(&params, &config(), &scene), [car(0, 0.0, 0.0, 0.0)])
}

fn images(pixels: PixelNoise) -> (Taken, Vec<Taken>) {
    let (camera, states) = wall();
    let clean = take_noisy(&camera, &states, 0, None);
    let noisy = (0..IMAGES).map(|tick| take_noisy(&camera, &states, 0, ImageNoise::new(pixels, 5, 9, tick)));
    (clean, noisy.collect())
}

/// Mean and variance.
fn moments(values: impl Iterator<Item = f64> + Clone) -> [f64; 2] {
    let count = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / count;
    [
        mean,
        values.map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0),
    ]
}

/// Correlation of pairs.
fn correlation(pairs: impl Iterator<Item = [f64; 2]> + Clone) -> f64 {
    let [a, b] = [0, 1].map(|side: usize| moments(pairs.clone().map(move |pair| pair[side])));
    let count = pairs.clone().count() as f64;
    let covariance = pairs.map(|[x, y]| (x - a[0]) * (y - b[0])).sum::<f64>() / (count - 1.0);
    covariance / (a[1] * b[1]).sqrt()
}

#[test]
fn colours_have_the_variance_of_their_electrons() {
    for (full_well_e, read_noise_e) in [(2_000.0, 0.0), (500.0, 12.0), (20_000.0, 150.0)] {
        let (clean, noisy) = images(PixelNoise {
            full_well_e,
            read_noise_e,
            infrared_k: 0.0,
        });
        assert!(clean.rgb.iter().all(|pixel| *pixel == clean.rgb[0]), "one colour");
        for channel in 0..3 {
            let values = noisy
                .iter()
                .flat_map(|image| image.rgb.iter().map(move |pixel| f64::from(pixel[channel])));
            let [mean, variance] = moments(values);
            let share = mean / 255.0;
            // Rounding to bytes adds a twelfth.
            let expected = (share * f64::from(full_well_e) + f64::from(read_noise_e).powi(2))
                / f64::from(full_well_e).powi(2)
                * 255.0_f64.powi(2)
                + 1.0 / 12.0;
            let count = (noisy.len() * clean.rgb.len()) as f64;
            assert!((mean - f64::from(clean.rgb[0][channel])).abs() < 0.5 + 5.0 * (variance / count).sqrt());
            // The variance of a variance is 2 σ⁴ / n.
            let error = expected * (2.0 / count).sqrt();
            assert!(
                (variance - expected).abs() < 5.0 * error + 0.01 * expected,
                "{full_well_e} e: {variance}, expected {expected}"
            );
        }
        // Neither channels, nor neighbours, nor images have anything in common.
        let pixels = |image: &Taken| image.rgb.iter().map(|pixel| pixel.map(f64::from)).collect::<Vec<_>>();
        let (first, second) = (pixels(&noisy[0]), pixels(&noisy[1]));
        let most = 5.0 / (first.len() as f64).sqrt();
        let next = first.iter().skip(1);
        for found in [
            correlation(first.iter().map(|pixel| [pixel[0], pixel[1]])),
            correlation(first.iter().map(|pixel| [pixel[1], pixel[2]])),
            correlation(first.iter().zip(next).map(|(a, b)| [a[0], b[0]])),
            correlation(first.iter().zip(first.iter().skip(SIZE[0])).map(|(a, b)| [a[0], b[0]])),
            correlation(first.iter().zip(&second).map(|(a, b)| [a[2], b[2]])),
        ] {
            assert!(found.abs() < most, "{found}");
        }
    }
}

#[test]
fn temperatures_have_their_noise_and_other_planes_have_none() {
    let (clean, noisy) = images(PixelNoise {
        infrared_k: 0.3,
        ..PixelNoise::default()
    });
    let values = noisy
        .iter()
        .flat_map(|image| image.infrared.iter().map(|pixel| f64::from(*pixel)));
    let [mean, variance] = moments(values);
    assert!((mean - f64::from(clean.infrared[0])).abs() < 0.5, "{mean}");
    assert!((variance.sqrt() - 30.0).abs() < 0.3, "{variance}");
    for image in &noisy {
        let without = Taken {
            infrared: clean.infrared.clone(),
            ..image.clone()
        };
        assert!(without == clean);
    }
}

#[test]
fn noise_is_a_function_of_seed_carrier_and_tick_on_every_path() {
    let pixels = PixelNoise {
        full_well_e: 300.0,
        read_noise_e: 5.0,
        infrared_k: 0.1,
    };
    let image = |path: ScanPath, [seed, carrier, tick]: [u64; 3]| {
        let (camera, states) = wall();
        take_noisy(
            &camera.with_path(path),
            &states,
            0,
            ImageNoise::new(pixels, seed, carrier, tick),
        )
    };
    let expected = image(ScanPath::Plain, [1, 2, 3]);
    for path in ScanPath::ALL.into_iter().filter(|path| path.is_here()) {
        assert!(image(path, [1, 2, 3]) == expected, "{path:?}");
    }
    for other in [[2, 2, 3], [1, 3, 3], [1, 2, 4]] {
        assert!(image(ScanPath::best(), other).rgb != expected.rgb);
    }
    assert!(ImageNoise::new(PixelNoise::default(), 1, 2, 3).is_none());
}
