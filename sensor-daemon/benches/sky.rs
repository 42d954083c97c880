//! Cost of one evaluation of the sky view, in open country and in streets between houses.
//! `cargo bench -p sensor-daemon --bench sky`

#![expect(clippy::panic, reason = "a benchmark that cannot run panics with the reason")]

use std::{hint::black_box, sync::Arc, time::Instant};

use sensor_daemon::sensors::gnss::SatelliteSky as _;
use sensor_daemon::sensors::sky::SkyMap;
use sim_core::{
    geodesy::Geodetic,
    scene::{Prism, Road, Scene, SolidClass},
};

const LOOKS: u32 = 200_000;
const ROUNDS: usize = 5;
/// Distance from street to street, metres.
const RASTER_M: f64 = 80.0;
/// Side of the map, metres.
const SIDE_M: f64 = 2_000.0;

/// Blocks of houses with streets of 20 m between them.
fn town() -> Vec<Prism> {
    let count = (SIDE_M / RASTER_M) as u32;
    (0..count * count)
        .map(|i| {
            let [x, y] = [i % count, i / count].map(|place| f64::from(place) * RASTER_M + 20.0);
            let (to_x, to_y) = (x + RASTER_M - 20.0, y + RASTER_M - 20.0);
            let outline = vec![[x, y], [to_x, y], [to_x, to_y], [x, to_y]];
            let height_m = 8.0 + f64::from(i % 7) * 3.0;
            Prism::new(String::new(), SolidClass::Building, outline, 0.0, height_m)
                .unwrap_or_else(|| panic!("a block of houses has an area"))
        })
        .collect()
}

/// Nanoseconds for one evaluation, with vehicles spread over the first `streets` streets of `length_m`.
fn look_ns(map: &SkyMap, streets: u32, length_m: u32, time_s: f64) -> f64 {
    let start = Instant::now();
    for i in 0..LOOKS {
        let along_m = f64::from(i.wrapping_mul(2_654_435_761) % (100 * length_m)) / 100.0;
        let street_m = f64::from(i % streets) * RASTER_M + 10.0 + f64::from(i % 5) - 2.0;
        black_box(map.at(along_m, street_m, 0.0, time_s));
    }
    start.elapsed().as_secs_f64() * 1e9 / f64::from(LOOKS)
}

fn main() {
    let middle = Geodetic {
        latitude_deg: 52.0,
        longitude_deg: 10.5,
    };
    for (name, buildings, streets, length_m) in [
        ("open", Vec::new(), 25, 2000),
        ("two short streets", town(), 2, 50),
        ("twenty-five streets", town(), 25, 2000),
    ] {
        let scene = Arc::new(Scene::new(Road::default(), buildings, Vec::new()));
        let map = SkyMap::new(scene, middle, [0.0, 0.0, SIDE_M, SIDE_M], 1);
        let first = look_ns(&map, streets, length_m, 0.0);
        let mut rounds: Vec<f64> = (1..=ROUNDS)
            .map(|round| look_ns(&map, streets, length_m, 600.0 * round as f64))
            .collect();
        rounds.sort_by(f64::total_cmp);
        println!(
            "sky, {name}: {:.0} ns a look (median of {ROUNDS}; {first:.0} ns with horizons still to compute)",
            rounds[ROUNDS / 2]
        );
        println!("{map:?}");
    }
}
