//! Writes sensor values as CSV files, from which the figures of `docs/sensor-models.md` are drawn.
//!
//! `cargo run --release -p sensor-daemon --example sensor_plots -- DIR`. `imu.csv`: two hours at rest, x axes of accelerometer and
//! gyroscope, with the parameters in `imu_model.csv`. `gnss.csv`: a drive past houses (`houses.csv`) with three kinds of error.
//! `street.csv`: the sky over a day in an east–west street 20 m wide between houses of several heights, 3 m off its middle.
//! `horizons.csv`, `satellites.csv`: the sky at two places of the drive. `scan.csv`: a LIDAR's points.

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

use ipc_schema::{
    block::{self, Section},
    config::Config,
    header::{FIRST_OF_EPISODE, MessageHeader},
    observation::{IMU_COLUMNS, ObservationLayout},
    pointcloud::{LidarPoint, Scan},
    run::MapInfo,
    sensor::SensorKind,
    traffic::Kind,
    world::{SubStep, VehicleState},
};
use sensor_daemon::{
    sensing::{Sensing, WorldTick},
    sensors::gnss::{SatelliteSky as _, SkyView},
    sensors::lidar::{LidarModel, ScanScratch, Targets},
    sensors::sky::{
        ANTENNA_M, MOST_EXTRA_PATH_M, SkyMap,
        constellation::SkyObserver,
        horizon::{CellSky, PlacedSatellite, SECTORS, Skyline},
    },
};
use sim_core::{
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
    Config::from_json(include_str!("../../ipc-schema/tests/town.json")).expect("the preset as resolved")
}

fn map() -> MapInfo {
    MapInfo {
        projection: "+proj=tmerc +lat_0=52.26 +lon_0=10.52 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs".into(),
        net_offset_m: [0.0, 0.0],
        bounds_m: [-100.0, -60.0, 220.0, 200.0],
        traffic_lights: 0,
        world_origin_m: [0.0; 2],
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
    write_scan(&mut create("scan.csv")?)?;
    write_sky(&mut create("horizons.csv")?, &mut create("satellites.csv")?)
}

/// Runs one vehicle in ticks of 0.1 s and passes the bytes of each observation to `each`.
fn sense(
    sensing: &mut Sensing,
    ticks: u32,
    state: &dyn Fn(u32) -> Option<VehicleState>,
    each: &mut dyn FnMut(u32, &NormalBlock),
) {
    let mut header = MessageHeader {
        flags: FIRST_OF_EPISODE,
        episode_seed: SEED,
        ..MessageHeader::default()
    };
    for tick in 0..ticks {
        let Some(state) = state(tick) else { return };
        (header.tick, header.sim_time_ns) = (u64::from(tick), (u64::from(tick) + 1) * 100_000_000);
        let states = [state];
        let n = sensing.assign(&header, &states).unwrap();
        let layout = ObservationLayout::new(n, sensing.width(), sensing.imu_samples());
        let mut payload = vec![0_u64; layout.len.div_ceil(8)];
        let world = WorldTick {
            states: &states,
            ..WorldTick::default()
        };
        sensing
            .observe(&header, &world, bytemuck::cast_slice_mut(&mut payload))
            .unwrap();
        each(tick, &NormalBlock { layout, payload });
        header.flags = 0;
    }
}

/// An observation.
struct NormalBlock {
    layout: ObservationLayout,
    payload: Vec<u64>,
}

impl NormalBlock {
    fn section<T: bytemuck::Pod>(&self, section: Section) -> &[T] {
        block::view(bytemuck::cast_slice(&self.payload), section).unwrap()
    }
}

/// The IMU at rest.
fn write_imu(out: &mut impl Write) -> io::Result<()> {
    let mut config = town();
    config.imu = ipc_schema::config::ImuConfig {
        period_s: IMU_S,
        accel_noise_std_mps2: [0.0; 3],
        accel_noise_density: [ACCEL[0]; 3],
        accel_bias_walk: [ACCEL[1]; 3],
        gyro_noise_std_radps: [0.0; 3],
        gyro_noise_density: [GYRO[0]; 3],
        gyro_bias_walk: [GYRO[1]; 3],
        ..config.imu
    };
    let state = VehicleState {
        id_hash: ID,
        ..VehicleState::default()
    };
    let mut samples = Vec::new();
    let mut sensing = Sensing::new(&config, &map()).unwrap();
    let ticks = IMU_SAMPLES / 10;
    sense(&mut sensing, ticks, &|_| Some(state), &mut |_, block| {
        samples.extend_from_slice(block.section::<[f32; IMU_COLUMNS]>(block.layout.imu));
    });
    writeln!(out, "accel_mps2,gyro_radps")?;
    for sample in samples {
        writeln!(out, "{:.6e},{:.6e}", sample[0], sample[3])?;
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

/// Position on the drive after a distance, metres.
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

/// State of the vehicle on the drive at a tick.
fn driven(tick: u32) -> Option<VehicleState> {
    let [x_m, y_m] = place(SPEED_MPS * GNSS_S * f64::from(tick))?;
    Some(VehicleState {
        x_m,
        y_m,
        id_hash: ID,
        ..VehicleState::default()
    })
}

/// The drive with each kind of error alone; the sky's error scales a little white noise.
fn write_gnss(out: &mut impl Write) -> io::Result<()> {
    let info = map();
    let middle = Projection::new(&info)
        .unwrap()
        .geodetic_from_net(NetPosition { x_m: 60.0, y_m: 70.0 })
        .unwrap();
    writeln!(out, "error,t_s,x_m,y_m,fix_x_m,fix_y_m,satellites")?;
    let [white, correlated, sky] = [[WHITE_M, 0.0], [0.0, CORRELATED_M], [0.25 * WHITE_M, 0.0]];
    for (name, [white_m, correlated_m], is_hidden) in [
        ("white", white, false),
        ("correlated", correlated, false),
        ("sky view", sky, true),
    ] {
        let mut config = town();
        config.gnss.noise_std_deg = [0.0; 2];
        config.gnss.noise_std_m = [white_m; 3];
        config.gnss.correlated_std_m = [correlated_m; 3];
        config.gnss.correlation_time_s = CORRELATION_TIME_S;
        let mut sensing = Sensing::new(&config, &info).unwrap();
        let scene = if is_hidden { scene() } else { Arc::new(Scene::default()) };
        sensing.set_sky(Box::new(SkyMap::new(scene, middle, info.bounds_m, SEED)));
        let mut lines = Vec::new();
        sense(&mut sensing, u32::MAX, &driven, &mut |tick, block| {
            let state = driven(tick).unwrap();
            let has_fix = SensorKind::Gnss.is_in(block.section::<u32>(block.layout.sensors)[0]);
            let [x, y, _] = block.section::<[f32; 3]>(block.layout.gnss_m)[0];
            let [_, satellites] = block.section::<[f32; 2]>(block.layout.gnss_quality)[0];
            if has_fix {
                let t_s = GNSS_S * f64::from(tick);
                lines.push(format!(
                    "{name},{t_s:.1},{:.3},{:.3},{x:.3},{y:.3},{satellites}",
                    state.x_m, state.y_m
                ));
            }
        });
        for line in lines {
            writeln!(out, "{line}")?;
        }
    }
    Ok(())
}

/// Length, width and height of the vehicles on the street, metres.
const CAR_M: [f32; 3] = [4.5, 1.8, 1.5];

/// A scan between the houses, with other vehicles and persons around.
fn write_scan(out: &mut impl Write) -> io::Result<()> {
    let mut config = town();
    config.lidar.vehicles = 1;
    config.lidar.range_m = 80.0;
    let lidar = LidarModel::new(&config, &scene()).unwrap();
    let road_user = |vehicle: u32, [x_m, y_m]: [f64; 2], yaw_rad: f64, kind: Kind| {
        let person = kind == Kind::Person;
        VehicleState {
            x_m,
            y_m,
            yaw_rad,
            vehicle,
            kind: kind as u32,
            id_hash: u64::from(vehicle),
            length_m: if person { 0.5 } else { CAR_M[0] },
            width_m: if person { 0.5 } else { CAR_M[1] },
            height_m: if person { 1.7 } else { CAR_M[2] },
            rear_overhang_m: if person { 0.0 } else { 0.9 },
            ..VehicleState::default()
        }
    };
    let around = [
        ([75.0, -2.0], 0.0, Kind::Cav),
        ([90.0, -2.2], 0.0, Kind::Other),
        ([58.0, -1.8], 0.0, Kind::Other),
        ([84.0, 2.0], std::f64::consts::PI, Kind::Other),
        ([62.0, 2.2], std::f64::consts::PI, Kind::Other),
        ([110.0, 2.1], std::f64::consts::PI, Kind::Other),
        ([82.0, 6.5], 0.0, Kind::Person),
        ([70.0, -6.5], 0.0, Kind::Person),
        ([66.0, 6.2], 0.0, Kind::Person),
    ];
    let states: Vec<VehicleState> = (0..)
        .zip(around)
        .map(|(vehicle, (place, yaw_rad, kind))| road_user(vehicle, place, yaw_rad, kind))
        .collect();
    let mut targets = Targets::default();
    targets.update(&states, &vec![SubStep::default(); states.len()], 1);
    let (mut scan, mut points) = (Scan::default(), vec![LidarPoint::default(); lidar.max_points()]);
    let count = lidar.scan(
        &targets,
        0,
        0,
        SEED,
        &mut ScanScratch::default(),
        &mut scan,
        &mut points,
    );
    writeln!(out, "x_m,y_m,z_m,tag,intensity")?;
    for point in &points[..count] {
        let [x, y, z] = point.position_m;
        writeln!(out, "{x:.3},{y:.3},{z:.3},{},{:.3}", point.tag, point.intensity)?;
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
    let observer = SkyObserver::at(Geodetic {
        latitude_deg: 52.0,
        longitude_deg: 10.5,
    });
    for (place, [x, y]) in [("along the street", [75.0, -2.0]), ("at the corner", [148.0, 0.0])] {
        let antenna_m = [x, y, ANTENNA_M];
        let CellSky::Walled(horizon) = skyline.sky(&scene, antenna_m) else {
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
            let placed = PlacedSatellite::from(satellite);
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
