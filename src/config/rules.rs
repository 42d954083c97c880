//! Rules between keys: rates that must divide each other, sizes that must fit.

use ipc_schema::{config::Config, props::Obstacle, traffic::VEHICLE_CLASSES};

use super::{
    ConfigError, Settings,
    keys::{FIELD_NAMES, FIRST_HERO_FIELD},
};

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
    check_class_models(settings, config)?;
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
    task(settings, config)?;
    let traffic = &config.traffic;
    let road_users = traffic.cavs + traffic.others + traffic.pedestrians + traffic.heroes;
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

/// The learner that comes with caraware: it predicts positions.
const LOCALISING_TRAINER: &str = "caraware.train";

/// Heroes and the driving task go together, and actions must reach SUMO at every tick.
fn task(settings: &Settings, config: &Config) -> Result<(), ConfigError> {
    let refuse = |path: &str, message: String, help: &str| Err(conflict(settings, path, message, help.into()));
    let traffic = &config.traffic;
    if !config.drives() {
        if traffic.heroes > 0 {
            let message = format!("`traffic.heroes` = {} without anybody who drives them", traffic.heroes);
            return refuse(
                "traffic.heroes",
                message,
                "set task.kind = \"driving\", or traffic.heroes = 0",
            );
        }
        if !traffic.hero_ids.is_empty() {
            let message = "`traffic.hero_ids` names heroes without anybody who drives them".into();
            return refuse(
                "traffic.hero_ids",
                message,
                "set task.kind = \"driving\", or traffic.hero_ids = []",
            );
        }
        if let Some(name) = hero_field(config) {
            let message = format!("`observation.fields` has \"{name}\", which only a hero has");
            return refuse(
                "observation.fields",
                message,
                "set task.kind = \"driving\", or leave the field out",
            );
        }
        if traffic.cavs == 0 {
            let message = "`traffic.cavs` = 0: nobody is to be localised".into();
            return refuse("traffic.cavs", message, "ask for one connected vehicle or more");
        }
        return Ok(());
    }
    if config.heroes() == 0 {
        let message = "`task.kind` = \"driving\" without a hero".into();
        return refuse(
            "task.kind",
            message,
            "set traffic.heroes = 1 (with a .sumocfg: traffic.hero_ids = [\"…\"])",
        );
    }
    #[expect(clippy::float_cmp, reason = "both are what the user wrote")]
    if traffic.step_s != config.run.tick_s {
        let message = format!(
            "`traffic.step_s` = {} s is not `run.tick_s` = {} s, as the driving task needs",
            traffic.step_s, config.run.tick_s
        );
        return refuse(
            "traffic.step_s",
            message,
            "set both to the same time, such as 0.1: an action reaches SUMO within a tick",
        );
    }
    if config.trainer.module == LOCALISING_TRAINER {
        let message = format!("`trainer.module` = \"{LOCALISING_TRAINER}\" learns to localise and cannot drive");
        let help = "name a module that publishes actions, such as \"caraware.examples.pure_pursuit\"";
        return refuse("trainer.module", message, help);
    }
    Ok(())
}

/// The first field of the observation that only a hero has.
fn hero_field(config: &Config) -> Option<String> {
    let heroes = &FIELD_NAMES[FIRST_HERO_FIELD..];
    let names = config.observation.fields.iter().filter_map(|field| {
        let name = serde_json::to_value(field).ok()?;
        name.as_str().map(str::to_owned)
    });
    names.into_iter().find(|name| heroes.contains(&name.as_str()))
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

/// Entries of `vehicle.class_models` are "class=model" with a vehicle class of SUMO.
fn check_class_models(settings: &Settings, config: &Config) -> Result<(), ConfigError> {
    let understood = |entry: &str| {
        entry.split_once('=').is_some_and(|(class, model)| {
            VEHICLE_CLASSES.contains(&class.trim()) && ["kinematic", "dynamic"].contains(&model.trim())
        })
    };
    match config.vehicle.class_models.iter().find(|entry| !understood(entry)) {
        None => Ok(()),
        Some(entry) => Err(conflict(
            settings,
            "vehicle.class_models",
            format!("`vehicle.class_models` has \"{entry}\", which is no vehicle class of SUMO with a model"),
            format!(
                "give \"class=kinematic\" or \"class=dynamic\"; the classes are {}",
                VEHICLE_CLASSES.join(", ")
            ),
        )),
    }
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
