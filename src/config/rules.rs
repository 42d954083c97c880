//! Rules between keys: rates that must divide each other, sizes that must fit.

use ipc_schema::{config::Config, props::Obstacle};

use super::{ConfigError, Settings};

/// Checks every rule.
pub(super) fn check(settings: &Settings, config: &Config) -> Result<(), ConfigError> {
    let tick_s = config.run.tick_s;
    for (path, value_s) in [
        ("traffic.step_s", config.traffic.step_s),
        ("gnss.period_s", config.gnss.period_s),
        ("imu.period_s", config.imu.period_s),
        ("speed_steering.period_s", config.speed_steering.period_s),
    ] {
        if !is_multiple(value_s, tick_s) {
            return Err(conflict(
                settings,
                path,
                format!("`{path}` = {value_s} s is not a whole number of ticks of `run.tick_s` = {tick_s} s"),
                format!("choose a multiple of {tick_s} s, or another `run.tick_s`"),
            ));
        }
    }
    let trainer = &config.trainer;
    if trainer.batch_size > trainer.horizon {
        return Err(conflict(
            settings,
            "trainer.batch_size",
            format!(
                "`trainer.batch_size` = {} is more than `trainer.horizon` = {}",
                trainer.batch_size, trainer.horizon
            ),
            "a batch is a part of the horizon: lower the one or raise the other".into(),
        ));
    }
    let road_users = config.traffic.cavs + config.traffic.others + config.traffic.pedestrians;
    if road_users > config.traffic.max_road_users {
        return Err(conflict(
            settings,
            "traffic.max_road_users",
            format!(
                "`traffic.max_road_users` = {} is less than the {road_users} road users asked for",
                config.traffic.max_road_users
            ),
            format!("set traffic.max_road_users to {road_users} or more"),
        ));
    }
    if config.map.origin_latitude_deg.is_some() != config.map.origin_longitude_deg.is_some() {
        let path = if config.map.origin_latitude_deg.is_some() {
            "map.origin_latitude_deg"
        } else {
            "map.origin_longitude_deg"
        };
        return Err(conflict(
            settings,
            path,
            "`map.origin_latitude_deg` and `map.origin_longitude_deg` go together".into(),
            "set both or neither".into(),
        ));
    }
    obstacles(settings, config)
}

/// Every entry of `scene.obstacles` must be a known prop and a place.
fn obstacles(settings: &Settings, config: &Config) -> Result<(), ConfigError> {
    for text in &config.scene.obstacles {
        if let Err(error) = Obstacle::parse(text) {
            return Err(conflict(settings, "scene.obstacles", error.to_string(), error.help()));
        }
    }
    Ok(())
}

fn is_multiple(value_s: f64, tick_s: f64) -> bool {
    let ratio = value_s / tick_s;
    ratio.round() >= 1.0 && (ratio - ratio.round()).abs() < 1e-6 * ratio
}

fn conflict(settings: &Settings, path: &str, message: String, help: String) -> ConfigError {
    match settings.setting(path) {
        Some(setting) => ConfigError::Conflict {
            message,
            help,
            place: setting.place.clone(),
        },
        None => ConfigError::File {
            path: "configuration".into(),
            message,
            help,
        },
    }
}
