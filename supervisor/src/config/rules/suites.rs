//! Rules of suites: every suite has a name, sensors with names, and parameters that fit each other; every carrier beside the road has a
//! place and a suite that exists.

use std::collections::BTreeSet;

use ipc_schema::{
    config::{Config, MOST_SUITES, SuiteConfig},
    sensor::SensorKind,
};

use super::{ConfigError, LayeredSettings, conflict, conflict_in_entry, sensors};

pub(super) fn check(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    if config.suites.len() > MOST_SUITES {
        return Err(conflict(
            settings,
            "suite",
            format!("`suite` has {} suites", config.suites.len()),
            format!("give at most {MOST_SUITES}"),
        ));
    }
    let mut names = BTreeSet::new();
    for (index, suite) in config.suites.iter().enumerate() {
        let refuse = |key: &str, message: String, help: &str| {
            Err(conflict_in_entry(settings, ("suite", index, key), message, help.into()))
        };
        if suite.name.is_empty() {
            return refuse(
                "suite.name",
                format!("suite {} has no name", index + 1),
                "give `name`, or `preset` with a ready-made suite",
            );
        }
        if !names.insert(&suite.name) {
            return refuse(
                "suite.name",
                format!("two suites have the name \"{}\"", suite.name),
                "give each a name of its own",
            );
        }
        if suite.sensors.is_empty() {
            return refuse(
                "suite.sensor",
                format!("the suite \"{}\" has no sensor", suite.name),
                "add a [[suite.sensor]] with `kind` and `name`, or `preset` with a ready-made suite",
            );
        }
        if let Some((message, help)) = wrong_sensor(suite) {
            return refuse("suite.sensor", message, help);
        }
    }
    units(settings, config)?;
    roadsides(settings, config)
}

/// Message and help for a sensor with a name that another has, or a second receiver or inertial unit.
fn wrong_sensor(suite: &SuiteConfig) -> Option<(String, &'static str)> {
    let mut names = BTreeSet::new();
    for sensor in &suite.sensors {
        if sensor.name.is_empty() || !names.insert(&sensor.name) {
            return Some((
                format!(
                    "the suite \"{}\" has two sensors with the name \"{}\", or one without",
                    suite.name, sensor.name
                ),
                "give each sensor a name of its own",
            ));
        }
    }
    for kind in [SensorKind::Gnss, SensorKind::Imu] {
        let of_kind = suite.sensors.iter().filter(|sensor| sensor.model.kind() == kind);
        if of_kind.count() > 1 {
            return Some((
                format!(
                    "the suite \"{}\" has two sensors of kind \"{}\"",
                    suite.name,
                    kind.name()
                ),
                "keep one: a vehicle has one receiver and one inertial unit",
            ));
        }
    }
    None
}

/// The parameters of each LIDAR fit each other and the tick.
fn units(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    for unit in config.sensor_units(SensorKind::Lidar) {
        let Some(index) = unit.suite_index else { continue };
        let mut alone = config.with_unit(&unit);
        alone.lidar.vehicles = 1;
        if let Some((_, message, help)) = sensors::lidar(&alone) {
            let message = format!("suite \"{}\", sensor \"{}\": {message}", unit.suite, unit.name);
            return Err(conflict_in_entry(
                settings,
                ("suite", index, "suite.sensor"),
                message,
                help,
            ));
        }
    }
    Ok(())
}

fn roadsides(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let mut names = BTreeSet::new();
    for (index, roadside) in config.roadsides.iter().enumerate() {
        let refuse = |key: &str, message: String, help: String| {
            Err(conflict_in_entry(settings, ("roadside", index, key), message, help))
        };
        if roadside.name.is_empty() || !names.insert(&roadside.name) {
            return refuse(
                "roadside.name",
                format!(
                    "two carriers beside the road have the name \"{}\", or one has none",
                    roadside.name
                ),
                "give each a name of its own".into(),
            );
        }
        if !config.suites.iter().any(|suite| suite.name == roadside.suite) {
            let known: Vec<&str> = config.suites.iter().map(|suite| suite.name.as_str()).collect();
            return refuse(
                "roadside.suite",
                format!(
                    "\"{}\" carries the suite \"{}\", which the configuration does not have",
                    roadside.name, roadside.suite
                ),
                format!("add a [[suite]] of that name; there are: {}", known.join(", ")),
            );
        }
        if roadside.place().is_none() {
            return refuse(
                "roadside.name",
                format!("\"{}\" beside the road needs exactly one place", roadside.name),
                "give `x_m` and `y_m`, or `longitude_deg` and `latitude_deg`".into(),
            );
        }
    }
    Ok(())
}
