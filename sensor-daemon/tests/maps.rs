//! Sensors of a curriculum on several maps: each map has its own sky and projection, and all share one bounding box.

#![allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]

mod common;

use common::{Run, Tick, cavs, map, quiet};
use ipc_schema::{
    config::{Config, Field},
    header::{FIRST_OF_EPISODE, MessageHeader},
    run::MapInfo,
};
use sensor_daemon::{
    sensing::{Sensing, UnknownSuiteError},
    sensors::gnss::{SatelliteSky, SkyView},
};
use sim_core::geodesy::{NetPosition, Projection};

/// A sky with this number of satellites, and an offset of as many metres to the east.
struct Marked(u32);

impl SatelliteSky for Marked {
    fn at(&self, _x_m: f64, _y_m: f64, _z_m: f64, _time_s: f64) -> SkyView {
        SkyView {
            satellites: self.0,
            offset_m: [f64::from(self.0), 0.0, 0.0],
            ..SkyView::default()
        }
    }
}

/// The map of the other tests, and one in the tropics that is larger.
fn maps() -> [MapInfo; 2] {
    let far = MapInfo {
        projection: "+proj=tmerc +lat_0=-10 +lon_0=100 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs".into(),
        net_offset_m: [0.0; 2],
        bounds_m: [-100.0, -100.0, 900.0, 700.0],
        traffic_lights: 0,
        world_origin_m: [0.0; 2],
    };
    [map(), far]
}

const BOX_M: [f64; 4] = [-100.0, -100.0, 900.0, 700.0];

/// Two stages: the first on both maps, the second, which is noisier, on the second map alone.
fn config() -> Config {
    let mut config = quiet();
    config.observation.fields = vec![Field::GnssX, Field::GnssY];
    config.gnss.bias_m = [0.0, 2.0, 0.0];
    config.curriculum.maps = ["town", "far.net.xml"].map(|map| map.parse().unwrap()).into();
    config.curriculum.stages = serde_json::from_value(serde_json::json!([
        {"cavs": 1, "maps": ["town", "far"]},
        {"cavs": 1, "maps": ["far"], "noise": 3.0},
    ]))
    .unwrap();
    config
}

/// Satellites, error east and north (metres).
fn seen(tick: &Tick) -> (f32, f32, f32) {
    let fix = tick.section::<[f32; 3]>("gnss_m")[0];
    let satellites = tick.section::<[f32; 2]>("gnss_quality")[0][1];
    (satellites, (fix[0] - 50.0).round(), (fix[1] - 80.0).round())
}

#[test]
fn an_episode_has_sky_and_projection_of_its_map_and_the_noise_of_its_stage() {
    let (config, maps) = (config(), maps());
    let mut run = Run::with(&config, Sensing::on_maps(&config, BOX_M, &maps).unwrap());
    run.sensing.set_sky_of(0, Box::new(Marked(5)));
    run.sensing.set_sky_of(1, Box::new(Marked(9)));
    let first = run.tick(&cavs(1));
    assert_eq!(seen(&first), (5.0, 5.0, 2.0));
    let cases = [
        (1, 1, (9.0, 9.0, 2.0)),
        (2, 1, (9.0, 9.0, 6.0)),
        (1, 0, (5.0, 5.0, 2.0)),
        (0, 0, (5.0, 5.0, 2.0)),
    ];
    for (stage, map, expected) in cases {
        run.restart_in(7, stage, map);
        run.tick(&cavs(1));
        let tick = run.tick(&cavs(1));
        assert_eq!(seen(&tick), expected, "stage {stage}, map {map}");
        let [latitude_deg, longitude_deg, _] = tick.section::<[f64; 3]>("gnss_geodetic")[0];
        let (east, north) = (f64::from(expected.1), f64::from(expected.2));
        let place = NetPosition {
            x_m: 50.0 + east,
            y_m: 80.0 + north,
        };
        let place = Projection::new(&maps[usize::from(map)])
            .unwrap()
            .geodetic_from_net(place)
            .unwrap();
        // 1e-6 degrees are 0.1 m; the convergence of the meridians turns the offset by less.
        assert!(
            (latitude_deg - place.latitude_deg).abs() < 1e-6,
            "{latitude_deg} {place:?}"
        );
        assert!(
            (longitude_deg - place.longitude_deg).abs() < 1e-6,
            "{longitude_deg} {place:?}"
        );
        // One box for all maps: −1 … 1 over 1000 m × 800 m.
        let row = tick.section::<f32>("observation");
        let normalised = [
            (50.0 + east + 100.0) / 500.0 - 1.0,
            (80.0 + north + 100.0) / 400.0 - 1.0,
        ];
        for (value, expected) in row.iter().zip(normalised) {
            assert!((f64::from(*value) - expected).abs() < 1e-3, "{row:?} {normalised:?}");
        }
    }
}

#[test]
fn earlier_episodes_on_another_map_change_nothing() {
    let mut config = config();
    config.gnss.noise_std_deg = [5e-5; 2];
    config.gnss.correlated_std_m = [1.0; 3];
    let maps = maps();
    let sensing = || Run::with(&config, Sensing::on_maps(&config, BOX_M, &maps).unwrap());
    let ticks = |run: &mut Run| -> Vec<u64> { (0..20).flat_map(|_| run.tick(&cavs(3)).bytes().to_vec()).collect() };
    // Stage and map before an episode in stage 1 on map 1.
    let after = |stage: u16, map: u16| {
        let mut run = sensing();
        run.restart_in(3, stage, map);
        ticks(&mut run);
        run.restart_in(11, 1, 1);
        ticks(&mut run)
    };
    assert_eq!(after(1, 0), after(1, 1));
    assert_eq!(after(2, 1), after(1, 1));
}

#[test]
fn an_episode_on_a_map_that_its_stage_does_not_have_is_refused() {
    let (config, maps) = (config(), maps());
    let mut sensing = Sensing::on_maps(&config, BOX_M, &maps).unwrap();
    let header = MessageHeader {
        flags: FIRST_OF_EPISODE,
        stage: 2,
        map: 0,
        ..MessageHeader::default()
    };
    let refused = UnknownSuiteError { stage: 2, map: 0 };
    assert_eq!(sensing.assign(&header, &cavs(1)), Err(refused));
}
