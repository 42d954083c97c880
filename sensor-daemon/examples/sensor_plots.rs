//! Writes what the sensors deliver, as CSV: the figures of `docs/sensor-models.md` are drawn from it.
//!
//! `cargo run --release -p sensor-daemon --example sensor_plots -- DIR`. `imu.csv`: two hours at rest, x axes of accelerometer and
//! gyroscope, with the parameters in `imu_model.csv`. `gnss.csv`: a drive past houses (`houses.csv`) with three kinds of error.
//! `street.csv`: the sky over a day in an east–west street 20 m wide between houses of several heights, 3 m off its middle.
//! `horizons.csv`, `satellites.csv`: the sky at two places of the drive. `scan.csv`, with the columns x_m,y_m,z_m,tag,intensity, is the LIDAR's.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "an example asserts by unwrapping"
)]

use std::{
    env, fs,
    io::{self, BufWriter, Write},
    path::Path,
    sync::Arc,
};

use ipc_schema::{config::Config, run::MapInfo, world::VehicleState};
use sensor_daemon::{
    gnss, imu,
    noise::{Sensor, Stream},
    sky::{
        ANTENNA_M, MOST_EXTRA_PATH_M, SkyMap, SkyView,
        constellation::Observer,
        horizon::{Placed, SECTORS, Sky, Skyline},
    },
};
use sim_core::{
    displacement::DisplacementMap,
    geodesy::{Geodetic, NetPosition, Projection},
    scene::{Prism, Road, Scene, SolidClass},
};

const SEED: u64 = 1;
const ID: u64 = 7;
/// A hundred samples a second.
const IMU_S: f64 = 0.01;
const IMU_SAMPLES: u32 = 720_000;
/// White noise as a density and random walk of the bias: accelerometer (m/s²/√Hz, m/s³/√Hz) and gyroscope (rad/s/√Hz, rad/s²/√Hz) of an
/// industrial MEMS unit (table in `docs/sensor-models.md`).
const ACCEL: [f64; 2] = [9.8e-4, 1.4e-5];
const GYRO: [f64; 2] = [1.4e-4, 9.3e-6];
/// Ten fixes a second.
const GNSS_S: f64 = 0.1;
const SPEED_MPS: f64 = 8.0;
/// Standard deviation of the white and of the correlated error, metres; correlation time of the latter.
const WHITE_M: f64 = 2.0;
const CORRELATED_M: f64 = 2.0;
const CORRELATION_TIME_S: f64 = 20.0;
/// Corners of the drive: along a street between houses, then into a cross street and out of the town.
const DRIVE: [[f64; 2]; 3] = [[-60.0, 0.0], [150.0, 0.0], [150.0, 160.0]];

fn town() -> Config {
    serde_json::from_str(include_str!("../../ipc-schema/tests/town.json")).expect("the preset as resolved")
}

fn map() -> MapInfo {
    MapInfo {
        projection: "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs".into(),
        net_offset_m: [0.0, 0.0],
        bounds_m: [-100.0, -60.0, 220.0, 200.0],
    }
}

/// Houses beside the drive: low corner, high corner, height, metres.
const HOUSES: [[f64; 5]; 8] = [
    [0.0, 9.0, 40.0, 30.0, 18.0],
    [42.0, 9.0, 90.0, 34.0, 24.0],
    [92.0, 9.0, 140.0, 30.0, 30.0],
    [0.0, -30.0, 60.0, -9.0, 21.0],
    [62.0, -34.0, 162.0, -10.0, 27.0],
    [160.0, -8.0, 182.0, 50.0, 24.0],
    [160.0, 52.0, 184.0, 90.0, 15.0],
    [118.0, 32.0, 140.0, 80.0, 24.0],
];

fn main() -> io::Result<()> {
    let directory = env::args().nth(1).unwrap_or_else(|| ".".into());
    let directory = Path::new(&directory);
    fs::create_dir_all(directory)?;
    let create = |name: &str| fs::File::create(directory.join(name)).map(BufWriter::new);
    write_imu(&mut create("imu.csv")?)?;
    write_imu_model(&mut create("imu_model.csv")?)?;
    write_houses(&mut create("houses.csv")?)?;
    write_gnss(&mut create("gnss.csv")?)?;
    write_street(&mut create("street.csv")?)?;
    write_sky(&mut create("horizons.csv")?, &mut create("satellites.csv")?)
}

/// The IMU at rest: the one place that says how its errors come about.
fn write_imu(out: &mut impl Write) -> io::Result<()> {
    let params = ipc_schema::config::Imu {
        accel_noise_std_mps2: [ACCEL[0] / IMU_S.sqrt(); 3],
        gyro_noise_std_radps: [GYRO[0] / IMU_S.sqrt(); 3],
        gyro_bias_radps: [0.0; 3],
        ..town().imu
    };
    let state = VehicleState {
        id_hash: ID,
        ..VehicleState::default()
    };
    let walk = Stream {
        episode_seed: SEED,
        id_hash: ID + 1,
        sensor: Sensor::Accelerometer,
    };
    let (mut accel_bias, mut gyro_bias) = (0.0, 0.0);
    writeln!(out, "accel_mps2,gyro_radps")?;
    for index in 0..IMU_SAMPLES {
        let sample = imu::sample(&params, &state, SEED, index);
        let [a, g] = [0, 1].map(|i: usize| f64::from(walk.normals(index)[i] as f32));
        accel_bias += ACCEL[1] * IMU_S.sqrt() * a;
        gyro_bias += GYRO[1] * IMU_S.sqrt() * g;
        let (accel, gyro) = (sample.accel_mps2[0] + accel_bias, sample.gyro_radps[0] + gyro_bias);
        writeln!(out, "{accel:.6e},{gyro:.6e}")?;
    }
    Ok(())
}

fn write_imu_model(out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "sensor,period_s,density,walk")?;
    writeln!(out, "accel_mps2,{IMU_S},{:e},{:e}", ACCEL[0], ACCEL[1])?;
    writeln!(out, "gyro_radps,{IMU_S},{:e},{:e}", GYRO[0], GYRO[1])
}

fn write_houses(out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "x_min_m,y_min_m,x_max_m,y_max_m,height_m")?;
    for [x, y, to_x, to_y, height] in HOUSES {
        writeln!(out, "{x},{y},{to_x},{to_y},{height}")?;
    }
    Ok(())
}

fn scene() -> Arc<Scene> {
    let house = |[x, y, to_x, to_y, height]: [f64; 5]| {
        let outline = vec![[x, y], [to_x, y], [to_x, to_y], [x, to_y]];
        Prism::new(String::new(), SolidClass::Building, outline, 0.0, height).expect("a house has an area")
    };
    Arc::new(Scene::new(Road::default(), HOUSES.map(house).to_vec(), Vec::new()))
}

/// Where the drive is after a way, metres.
fn place(mut way_m: f64) -> Option<[f64; 2]> {
    for pair in DRIVE.windows(2) {
        let along = [pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]];
        let length_m = libm::hypot(along[0], along[1]);
        if way_m <= length_m {
            let share = way_m / length_m;
            return Some([pair[0][0] + share * along[0], pair[0][1] + share * along[1]]);
        }
        way_m -= length_m;
    }
    None
}

/// The drive with each kind of error: the one place that says how they come about.
fn write_gnss(out: &mut impl Write) -> io::Result<()> {
    let info = map();
    let projection = Projection::new(&info).unwrap();
    let displacements = DisplacementMap::new(&projection, info.bounds_m).unwrap();
    let middle = projection
        .geodetic_from_net(NetPosition { x_m: 60.0, y_m: 70.0 })
        .unwrap();
    let sky = SkyMap::new(scene(), middle, info.bounds_m, SEED);
    let white_deg = (WHITE_M / 6_371_000.0_f64).to_degrees();
    let params = ipc_schema::config::Gnss {
        noise_std_deg: [white_deg; 2],
        bias_deg: [0.0; 2],
        ..town().gnss
    };
    let stream = |id_hash| Stream {
        episode_seed: SEED,
        id_hash,
        sensor: Sensor::Gnss,
    };
    let decay = libm::exp(-GNSS_S / CORRELATION_TIME_S);
    let mut slow = stream(ID + 1).normal_pair(u32::MAX);
    writeln!(out, "error,t_s,x_m,y_m,fix_x_m,fix_y_m,satellites")?;
    for index in 0_u32.. {
        let t_s = f64::from(index) * GNSS_S;
        let Some([x, y]) = place(SPEED_MPS * t_s) else { break };
        let step = stream(ID + 1).normal_pair(index);
        slow = [0, 1].map(|i: usize| decay * slow[i] + libm::sqrt(1.0 - decay * decay) * step[i]);
        let fix = gnss::sample(&params, &displacements, x, y, stream(ID), index);
        let white = [fix.x_m - x, fix.y_m - y];
        let view = sky.at(x, y, 0.0, t_s);
        // Each error alone; the sky's with a little white noise to scale.
        let seen = [0, 1].map(|i: usize| view.offset_m[i] + 0.25 * view.noise_factor * white[i]);
        let correlated = slow.map(|error| CORRELATED_M * error);
        let open = sky.at(1e6, 1e6, 0.0, t_s).satellites;
        for (name, error, satellites, has_fix) in [
            ("white", white, open, true),
            ("correlated", correlated, open, true),
            ("sky view", seen, view.satellites, view.has_fix),
        ] {
            if has_fix {
                writeln!(
                    out,
                    "{name},{t_s:.1},{x:.3},{y:.3},{:.3},{:.3},{satellites}",
                    x + error[0],
                    y + error[1]
                )?;
            }
        }
    }
    Ok(())
}

fn write_street(out: &mut impl Write) -> io::Result<()> {
    writeln!(
        out,
        "houses_m,satellites,no_fix_share,noise_factor,along_rms_m,across_rms_m"
    )?;
    for height_m in [0.1, 10.0, 20.0, 30.0, 45.0] {
        let house = |from_y: f64, to_y: f64| {
            let outline = vec![[-150.0, from_y], [150.0, from_y], [150.0, to_y], [-150.0, to_y]];
            Prism::new(String::new(), SolidClass::Building, outline, 0.0, height_m).expect("a house has an area")
        };
        let houses = vec![house(10.0, 25.0), house(-25.0, -10.0)];
        let scene = Arc::new(Scene::new(Road::default(), houses, Vec::new()));
        let middle = Geodetic {
            latitude_deg: 52.0,
            longitude_deg: 10.5,
        };
        let sky = SkyMap::new(scene, middle, [-200.0, -200.0, 200.0, 200.0], SEED);
        let views: Vec<SkyView> = (0..1436)
            .map(|minute| sky.at(0.0, -3.0, 0.0, 60.0 * f64::from(minute)))
            .collect();
        let fixes: Vec<&SkyView> = views.iter().filter(|view| view.has_fix).collect();
        let mean = |of: &dyn Fn(&SkyView) -> f64| fixes.iter().map(|view| of(view)).sum::<f64>() / fixes.len() as f64;
        let rms = |axis: usize| mean(&|view| view.offset_m[axis] * view.offset_m[axis]).sqrt();
        writeln!(
            out,
            "{height_m},{:.1},{:.3},{:.2},{:.1},{:.1}",
            views.iter().map(|view| f64::from(view.satellites)).sum::<f64>() / views.len() as f64,
            1.0 - fixes.len() as f64 / views.len() as f64,
            mean(&|view| view.noise_factor),
            rms(0),
            rms(1),
        )?;
    }
    Ok(())
}

/// Horizons and satellites at two places of the drive.
fn write_sky(horizons: &mut impl Write, satellites: &mut impl Write) -> io::Result<()> {
    writeln!(horizons, "place,azimuth_deg,elevation_deg")?;
    writeln!(satellites, "place,azimuth_deg,elevation_deg,signal")?;
    let scene = scene();
    let skyline = Skyline::new(scene.buildings());
    let observer = Observer::at(Geodetic {
        latitude_deg: 52.0,
        longitude_deg: 10.5,
    });
    for (place, [x, y]) in [("along the street", [75.0, -2.0]), ("at the corner", [148.0, 0.0])] {
        let antenna_m = [x, y, ANTENNA_M];
        let Sky::Walled(horizon) = skyline.sky(&scene, antenna_m) else {
            continue;
        };
        for (sector, tangent) in horizon.tangents().enumerate() {
            let azimuth_deg = 90.0 - 360.0 * (sector as f64 + 0.5) / SECTORS as f64;
            writeln!(
                horizons,
                "{place},{azimuth_deg:.3},{:.3}",
                libm::atan(tangent).to_degrees()
            )?;
        }
        let mirrors = horizon.mirrors(antenna_m);
        for satellite in observer.satellites(3000.0) {
            let placed = Placed::from(satellite);
            let signal = if horizon.is_in_sight(&placed, antenna_m) {
                "direct"
            } else if mirrors
                .extra_path_m(&placed)
                .is_some_and(|extra_m| extra_m <= MOST_EXTRA_PATH_M)
            {
                "reflected"
            } else {
                "hidden"
            };
            let [east, north] = satellite.heading;
            let azimuth_deg = libm::atan2(east, north).to_degrees();
            let elevation_deg = libm::atan(satellite.tan_elevation).to_degrees();
            writeln!(satellites, "{place},{azimuth_deg:.3},{elevation_deg:.3},{signal}")?;
        }
    }
    Ok(())
}
