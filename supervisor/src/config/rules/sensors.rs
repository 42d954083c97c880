//! Rules of the sensors: rates divide each other, fields of view are not empty, and every observation field has its sensor.

use ipc_schema::{
    config::{Config, LidarConfig, LidarPattern, Network, SensorUnit},
    image::ImagePlane,
    sensor::{SENSORS, SensorKind, fitted_sensors},
};

use super::{ConfigError, LayeredSettings, conflict, is_multiple};

/// Checks the sensors.
pub(super) fn check(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let refused = imu(config)
        .or_else(|| lidar(config))
        .or_else(|| observed_plane(config))
        .or_else(|| brightness_events(config))
        .or_else(|| rolling_shutter(config))
        .or_else(|| lens(config))
        .or_else(|| observation(config));
    match refused {
        None => Ok(()),
        Some((path, message, help)) => Err(conflict(settings, path, message, help)),
    }
}

/// Key and value of each period that is a whole number of ticks: those of all sensors of the run but the IMU, which has its own rule.
pub(super) fn tick_periods(config: &Config) -> impl Iterator<Item = (String, f64)> {
    let fitted = fitted_sensors(config);
    let rows = SENSORS
        .iter()
        .filter(move |spec| spec.kind.is_in(fitted) && spec.kind != SensorKind::Imu);
    rows.map(|spec| (format!("{}.period_s", spec.name), (spec.period_s)(config)))
}

/// Key, message and help of a broken rule.
pub(super) type BrokenSensorRule = (&'static str, String, String);

/// A fast IMU divides the tick and is divided by the sub-step; a slow one is a whole number of ticks.
fn imu(config: &Config) -> Option<BrokenSensorRule> {
    let (period_s, tick_s) = (config.imu.period_s, config.run.tick_s);
    let sub_step_s = tick_s / f64::from(config.run.sub_steps);
    let fits = if period_s < tick_s {
        is_multiple(period_s, sub_step_s) && is_multiple(tick_s, period_s)
    } else {
        is_multiple(period_s, tick_s)
    };
    (!fits).then(|| {
        (
            "imu.period_s",
            format!(
                "`imu.period_s` = {period_s} s is neither a whole number of ticks of `run.tick_s` = {tick_s} s nor a whole part of one \
                 that is a whole number of sub-steps of {sub_step_s} s"
            ),
            format!("choose {tick_s} s, a multiple of it, or a part such as {sub_step_s} s; or another `run.sub_steps`"),
        )
    })
}

/// Observations hold a plane that images have, of cameras that some vehicle carries; a network that sees needs both.
fn observed_plane(config: &Config) -> Option<BrokenSensorRule> {
    let (camera, sees) = (&config.camera, config.trainer.network == Network::Cnn);
    let Some(plane) = camera.observed.plane() else {
        return sees.then(|| {
            (
                "trainer.network",
                "`trainer.network` = \"cnn\", but observations hold no images".into(),
                "set camera.observed = \"semantic\", and camera.vehicles to the number of vehicles that learn".into(),
            )
        });
    };
    if camera.vehicles == 0 {
        return Some((
            "camera.observed",
            "`camera.observed` without a camera: `camera.vehicles` = 0".into(),
            "set camera.vehicles to the number of vehicles that learn, or camera.observed = \"none\"".into(),
        ));
    }
    let name = match plane {
        ImagePlane::Depth => "depth",
        ImagePlane::Instance => "instance",
        ImagePlane::Semantic => "semantic",
        ImagePlane::Rgb => "rgb",
        ImagePlane::Binary => "binary",
        ImagePlane::Infrared => "infrared",
        ImagePlane::Flow => "flow",
    };
    (ImagePlane::wanted(camera) & plane.bit() == 0).then(|| {
        (
            "camera.observed",
            format!("`camera.observed` = \"{name}\", but images have no such plane: `camera.{name}` = false"),
            format!("set camera.{name} = true, or camera.observed = \"none\""),
        )
    })
}

/// How messages name a camera.
fn named(unit: &SensorUnit) -> String {
    match unit.suite.as_str() {
        "" => "`camera`".to_owned(),
        suite => format!("camera `{}` of the suite `{suite}`", unit.name),
    }
}

/// The lens of every camera shows something in every pixel.
fn lens(config: &Config) -> Option<BrokenSensorRule> {
    let units = config.sensor_units(SensorKind::Camera);
    let (unit, [u, v]) = units
        .iter()
        .find_map(|unit| Some((unit, config.with_unit(unit).camera.folded_pixel()?)))?;
    Some((
        "camera.distortion",
        format!(
            "the distortion of {} folds within the image: no ray of a pinhole arrives at the pixel ({u}, {v})",
            named(unit)
        ),
        "check the order k1, k2, p1, p2, k3; or make its horizontal_fov_deg smaller, for which the lens was calibrated"
            .into(),
    ))
}

/// A dynamic vision sensor samples at every tick.
fn brightness_events(config: &Config) -> Option<BrokenSensorRule> {
    let units = config.sensor_units(SensorKind::Camera);
    let slow = units
        .iter()
        .find(|unit| unit.period_ticks != 1 && config.with_unit(unit).camera.events)?;
    Some((
        "camera.events",
        format!(
            "{} has events, but takes an image every {} ticks only",
            named(slow),
            slow.period_ticks
        ),
        format!(
            "set its period_s to {}, that of a tick, or events = false",
            config.run.tick_s
        ),
    ))
}

/// A rolling shutter reads all rows within one tick; a dynamic vision sensor has none.
fn rolling_shutter(config: &Config) -> Option<BrokenSensorRule> {
    let units = config.sensor_units(SensorKind::Camera);
    let tick_s = config.run.tick_s;
    units.iter().find_map(|unit| {
        let camera = config.with_unit(unit).camera;
        let readout_s = camera.readout_s;
        if readout_s > tick_s {
            return Some((
                "camera.readout_s",
                format!(
                    "{} reads its rows within {readout_s} s, but a tick, `run.tick_s`, has {tick_s} s",
                    named(unit)
                ),
                format!("set its readout_s to {tick_s} at most; or choose longer ticks"),
            ));
        }
        (readout_s > 0.0 && camera.events).then(|| {
            (
                "camera.readout_s",
                format!(
                    "{} has a rolling shutter and events, but a dynamic vision sensor has no shutter: each pixel fires at its own time",
                    named(unit)
                ),
                "set its readout_s to 0, or events = false; two sensors of a suite can have one each".into(),
            )
        })
    })
}

pub(super) fn lidar(config: &Config) -> Option<BrokenSensorRule> {
    let lidar = &config.lidar;
    if lidar.vehicles == 0 {
        return None;
    }
    pattern(lidar)
        .or_else(|| field_of_view(lidar))
        .or_else(|| rates(config))
}

fn pattern(lidar: &LidarConfig) -> Option<BrokenSensorRule> {
    (lidar.pattern == LidarPattern::Table && lidar.ray_table.is_none()).then(|| {
        (
            "lidar.pattern",
            "`lidar.pattern` = \"table\" needs `lidar.ray_table`".into(),
            "name a CSV file in lidar.ray_table, or another pattern".into(),
        )
    })
}

fn field_of_view(lidar: &LidarConfig) -> Option<BrokenSensorRule> {
    let (lower, upper) = (lidar.lower_fov_deg, lidar.upper_fov_deg);
    if lidar.pattern == LidarPattern::Uniform && (lower > upper || (lidar.channels > 1 && upper - lower <= 0.0)) {
        return Some((
            "lidar.upper_fov_deg",
            format!(
                "`lidar.upper_fov_deg` = {upper} is not above `lidar.lower_fov_deg` = {lower}: the field of view is empty"
            ),
            "give the highest channel's elevation in upper_fov_deg, the lowest one's in lower_fov_deg".into(),
        ));
    }
    (lidar.min_range_m >= lidar.range_m).then(|| {
        (
            "lidar.min_range_m",
            format!(
                "`lidar.min_range_m` = {} leaves nothing below `lidar.range_m` = {}",
                lidar.min_range_m, lidar.range_m
            ),
            "lower the one or raise the other".into(),
        )
    })
}

/// Rotations and ticks divide each other, and every tick fires the same whole number of columns.
fn rates(config: &Config) -> Option<BrokenSensorRule> {
    let (lidar, tick_s) = (&config.lidar, config.run.tick_s);
    let rotation_s = 1.0 / lidar.rotation_hz;
    if !is_multiple(rotation_s, tick_s) && !is_multiple(tick_s, rotation_s) {
        return Some((
            "lidar.rotation_hz",
            format!(
                "`lidar.rotation_hz` = {}: a rotation must be a whole number of ticks of `run.tick_s` = {tick_s} s, or a tick a whole \
                 number of rotations",
                lidar.rotation_hz
            ),
            format!("choose a multiple or a whole part of {} Hz", 1.0 / tick_s),
        ));
    }
    if lidar.pattern == LidarPattern::Table {
        return None;
    }
    let columns = lidar.points_per_second as f64 * tick_s / lidar.lasers() as f64;
    let whole = columns.round();
    (whole < 1.0 || (columns - whole).abs() > 1e-6 * columns).then(|| {
        (
            "lidar.points_per_second",
            format!(
                "`lidar.points_per_second` = {} makes {columns:.3} firings of {} channels in a tick of {tick_s} s: not a whole number",
                lidar.points_per_second,
                lidar.lasers()
            ),
            format!(
                "choose a multiple of {} such as {}",
                (lidar.lasers() as f64 / tick_s).round(),
                (whole.max(1.0) * lidar.lasers() as f64 / tick_s).round()
            ),
        )
    })
}

/// Checks that the run has the sensor of every observation field.
fn observation(config: &Config) -> Option<BrokenSensorRule> {
    let fitted = fitted_sensors(config);
    for field in &config.observation.fields {
        if let Some(sensor) = field.spec().source.sensor()
            && !sensor.is_in(fitted)
        {
            let (field, name) = (field.name(), sensor.name());
            return Some((
                "observation.fields",
                format!("`observation.fields` has \"{field}\", which the sensor `{name}` measures"),
                format!(
                    "set {name}.vehicles to the number of vehicles that carry one, give them a suite with one, or leave the field out"
                ),
            ));
        }
    }
    if config.gnss.pedestrians && config.drives() {
        return Some((
            "gnss.pedestrians",
            "`gnss.pedestrians` is for the localisation task: pedestrians take no actions".into(),
            "set gnss.pedestrians = false".into(),
        ));
    }
    None
}
