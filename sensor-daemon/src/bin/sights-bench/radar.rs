//! Radar scans per second of one core.

use ipc_schema::config::Config;
use sensor_daemon::sensors::{
    camera::CameraTargets,
    lidar::Targets,
    radar::{RadarModel, RadarScratch},
};

use crate::{BenchSize, city::Ground, lidar_city, now_s};

/// The first vehicles carry a radar.
const RADARS: usize = 16;

/// A radar: its name, and what is set beside the defaults, which are those of a long-range radar.
type NamedRadar = (&'static str, fn(&mut Config));

const UNITS: [NamedRadar; 3] = [
    ("default", |_| ()),
    ("wide, 150° and 80 m", |config| {
        (config.radar.horizontal_fov_deg, config.radar.range_m) = (150.0, 80.0);
    }),
    ("default, with 100 false alarms in a million cells", |config| {
        config.radar.false_alarm_probability = 1e-4;
    }),
];

/// Scans per second of every unit and ground, and how many detections a scan has.
pub fn measure(bench: &BenchSize) -> serde_json::Value {
    let mut rows = Vec::new();
    for ground in Ground::ALL {
        let scene = ground.scene();
        for (unit, set) in UNITS {
            let mut config = lidar_city::config();
            config.radar.mount = [3.5, 0.0, 0.5, 0.0, 0.0, 0.0];
            set(&mut config);
            let radar = RadarModel::new(&config, &scene);
            let (mut targets, mut seen) = (Targets::default(), CameraTargets::default());
            let (mut scratch, mut found) = (RadarScratch::default(), 0);
            let mut rates: Vec<f64> = (0..bench.rounds as u64)
                .map(|round| {
                    let ticks: Vec<_> = (0..bench.ticks)
                        .map(|tick| ground.traffic(&scene, RADARS, round * bench.ticks + tick).0)
                        .collect();
                    let since_s = now_s();
                    for (tick, states) in (0..).zip(&ticks) {
                        targets.update(states, &[], 0);
                        seen.update(&targets);
                        for row in 0..RADARS {
                            let mut detections = Vec::new();
                            let _ = radar.scan((&targets, &seen), states, row, tick, 7, &mut scratch, &mut detections);
                            found += detections.len();
                        }
                    }
                    (RADARS as u64 * bench.ticks) as f64 / (now_s() - since_s)
                })
                .collect();
            rates.sort_by(f64::total_cmp);
            let rate = rates[bench.rounds / 2];
            let detections = found as f64 / (bench.rounds * RADARS * bench.ticks as usize) as f64;
            println!(
                "{} {unit}: {rate:.0} scans/s, {detections:.1} detections in each",
                ground.name()
            );
            rows.push(serde_json::json!({
                "ground": ground.name(), "unit": unit, "scans_per_s": rate, "detections": detections,
            }));
        }
    }
    serde_json::json!({ "rows": rows })
}
