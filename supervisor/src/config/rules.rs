//! Rules between keys: rates that must divide each other, sizes that must fit, keys that exclude each other.

use ipc_schema::{
    channel::Channel,
    config::{
        Config, HeroDriver, HeroTurns, Network, OWN_TRAINER, TaskKind, TrafficEngine, V2xInclusion, VehicleModel,
    },
};

mod curriculum;
mod roadside;
mod sensors;
mod suites;

use super::{ConfigError, LayeredSettings, layer::LocatedValue};

/// Checks every rule.
pub(super) fn check(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let tick_s = config.run.tick_s;
    let step = ("traffic.step_s".to_owned(), config.traffic.step_s);
    for (path, value_s) in std::iter::once(step).chain(sensors::tick_periods(config)) {
        if !is_multiple(value_s, tick_s) {
            return Err(conflict(
                settings,
                &path,
                format!("`{path}` = {value_s} s is not a whole number of ticks of `run.tick_s` = {tick_s} s"),
                format!("choose a multiple of {tick_s} s, or another `run.tick_s`"),
            ));
        }
    }
    sensors::check(settings, config)?;
    suites::check(settings, config)?;
    recorded_channels(settings, config)?;
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
    curriculum::check(settings, config)?;
    roadside::check(settings, config)?;
    if let Some((path, message, help)) = unattachable(config) {
        return Err(conflict(settings, path, message, help.into()));
    }
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
    region(settings, config)
}

/// Every recorded channel exists, and a recorded run has at least one.
fn recorded_channels(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let record = &config.record;
    let names = || Channel::ALL.map(Channel::name).join(", ");
    let refused = |message: String| {
        let help = format!("name some of: {}", names());
        Err(conflict(settings, "record.channels", message, help))
    };
    let is_channel = |name: &&String| Channel::ALL.iter().any(|channel| channel.name() == name.as_str());
    match record.channels.iter().find(|name| !is_channel(name)) {
        Some(name) => refused(format!("`record.channels` names \"{name}\", which is no channel")),
        None if record.is_on() && record.channels.is_empty() => refused("`record.channels` is empty".to_owned()),
        None => Ok(()),
    }
}

/// Heroes need the driving task, and the driving task needs heroes.
fn task(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let refused = if config.drives() {
        undrivable(config).or_else(|| actions_without_tick(config))
    } else {
        heroes_without_a_driver(config)
            .or_else(|| unspeakable(config))
            .or_else(|| actions_without_tick(config))
    };
    match refused {
        None => Ok(()),
        Some((path, message, help)) => Err(conflict(settings, path, message, help.into())),
    }
}

/// Key, message and help of a broken rule.
type BrokenRule = (&'static str, String, &'static str);

/// A SUMO that runs already has its own options, and begins once.
fn unattachable(config: &Config) -> Option<BrokenRule> {
    let traffic = &config.traffic;
    if traffic.traci_host.is_empty() {
        return None;
    }
    if traffic.engine != TrafficEngine::Traci {
        return Some((
            "traffic.traci_host",
            "`traffic.traci_host` needs `traffic.engine` = \"traci\": over TraCI a run attaches to a SUMO that runs already, with or \
             without a window"
                .into(),
            "set traffic.engine = \"traci\", or leave traffic.traci_host out",
        ));
    }
    let own = [
        ("traffic.scale", traffic.scale),
        ("traffic.begin_s", traffic.begin_s),
        ("traffic.end_s", traffic.end_s),
    ];
    if let Some((path, _)) = own.into_iter().find(|(_, value)| value.is_some()) {
        return Some((
            path,
            format!("`{path}` is an option of SUMO, and the SUMO at `traffic.traci_host` has been started already"),
            "give that SUMO the option, and leave it out here",
        ));
    }
    (config.run.envs > 1).then(|| {
        (
            "run.envs",
            format!(
                "`run.envs` = {}: a SUMO that runs already is one environment",
                config.run.envs
            ),
            "set run.envs = 1, or leave traffic.traci_host out",
        )
    })
}

fn heroes_without_a_driver(config: &Config) -> Option<BrokenRule> {
    let traffic = &config.traffic;
    if traffic.heroes > 0 {
        return Some((
            "traffic.heroes",
            format!("`traffic.heroes` = {} needs the driving task", traffic.heroes),
            "set task.kind = \"driving\", or traffic.heroes = 0",
        ));
    }
    if !traffic.hero_ids.is_empty() {
        return Some((
            "traffic.hero_ids",
            "`traffic.hero_ids` names heroes, which need the driving task".into(),
            "set task.kind = \"driving\", or traffic.hero_ids = []",
        ));
    }
    if let Some(name) = hero_field(config) {
        return Some((
            "observation.fields",
            format!("`observation.fields` has \"{name}\", which only a hero has"),
            "set task.kind = \"driving\", or leave the field out",
        ));
    }
    (traffic.cavs == 0).then(|| {
        (
            "traffic.cavs",
            "`traffic.cavs` = 0: the localisation task needs a connected vehicle".into(),
            "set traffic.cavs to 1 or more",
        )
    })
}

/// The driving task needs heroes and a driver, and an action must reach SUMO at every tick.
fn undrivable(config: &Config) -> Option<BrokenRule> {
    if config.heroes() == 0 {
        return Some((
            "task.kind",
            "`task.kind` = \"driving\" without a hero".into(),
            "set traffic.heroes = 1 (with a .sumocfg: traffic.hero_ids = [\"…\"])",
        ));
    }
    let (step_s, tick_s) = (config.traffic.step_s, config.run.tick_s);
    #[expect(clippy::float_cmp, reason = "both are what the user wrote")]
    if step_s != tick_s {
        return Some((
            "traffic.step_s",
            format!("`traffic.step_s` = {step_s} s is not `run.tick_s` = {tick_s} s, as the driving task needs"),
            "set both to the same time, such as 0.1: an action reaches SUMO within a tick",
        ));
    }
    if config.traffic.hero_turns != HeroTurns::Any && !config.traffic.hero_route.is_empty() {
        return Some((
            "traffic.hero_turns",
            "`traffic.hero_turns` is for routes that are drawn, and `traffic.hero_route` gives one".into(),
            "set traffic.hero_route = [], or traffic.hero_turns = \"any\"",
        ));
    }
    if config.vehicle.preview_s > 0.0 && config.task.driver == HeroDriver::Actions {
        return Some((
            "vehicle.preview_s",
            "`vehicle.preview_s` puts the traffic around a hero into the past".into(),
            "set vehicle.preview_s = 0 with task.kind = \"driving\", or task.driver = \"sumo\"",
        ));
    }
    if config.task.driver == HeroDriver::Sumo && config.vehicle.hero_model == VehicleModel::RigidBody {
        return Some((
            "vehicle.hero_model",
            "`vehicle.hero_model` = \"rigid_body\" cannot follow SUMO's driver".into(),
            "set vehicle.hero_model = \"dynamic\" with task.driver = \"sumo\"",
        ));
    }
    if config.task.driver == HeroDriver::Sumo && config.advises_heroes() {
        return Some((
            "observation.fields",
            "`advised_accel` is what SUMO's driver would do where actions drive, but `task.driver` = \"sumo\"".into(),
            "set observation.fields = \"driver\", or task.driver = \"actions\"",
        ));
    }
    if config.task.driver == HeroDriver::Sumo && config.trainer.module == OWN_TRAINER {
        return Some((
            "task.driver",
            "`task.driver` = \"sumo\" leaves nothing to learn by driving".into(),
            "set trainer.module = \"caraware.driving.imitate\", or task.driver = \"actions\"",
        ));
    }
    None
}

/// The messages task needs messages whose content can be chosen, and nothing else lets the trainer choose it.
fn unspeakable(config: &Config) -> Option<BrokenRule> {
    let v2x = &config.v2x;
    if !config.speaks() {
        return (v2x.inclusion == V2xInclusion::Policy).then(|| {
            (
                "v2x.inclusion",
                "`v2x.inclusion` = \"policy\" needs a trainer that chooses".into(),
                "set task.kind = \"messages\", or another v2x.inclusion",
            )
        });
    }
    if !v2x.is_on() {
        return Some((
            "v2x.share",
            "`task.kind` = \"messages\", but no road user has a radio".into(),
            "set v2x.share above 0",
        ));
    }
    (v2x.perception_range_m == 0.0).then(|| {
        (
            "v2x.perception_range_m",
            "`task.kind` = \"messages\", but vehicles perceive nothing that they could tell of".into(),
            "set v2x.perception_range_m, such as to 60",
        )
    })
}

/// Actions that the world waits for are drawn tick by tick, from fields alone.
fn actions_without_tick(config: &Config) -> Option<BrokenRule> {
    let draws = matches!(config.task.kind, TaskKind::Driving | TaskKind::Messages)
        && config.trainer.module == OWN_TRAINER
        && config.task.driver == HeroDriver::Actions;
    if !draws {
        return None;
    }
    if config.trainer.network == Network::Cnn {
        return Some((
            "trainer.network",
            "`trainer.network` = \"cnn\" does not draw actions tick by tick: it would draw them without its images"
                .into(),
            "set trainer.network = \"mlp\" or a class",
        ));
    }
    if config.trainer.network == Network::Gru {
        return Some((
            "trainer.network",
            "`trainer.network` = \"gru\" does not draw actions tick by tick: it would draw them without its memory"
                .into(),
            "set trainer.network = \"mlp\" or a class",
        ));
    }
    (config.trainer.actions_per_observation > 1).then(|| {
        (
            "trainer.actions_per_observation",
            format!(
                "`trainer.actions_per_observation` = {}: the world takes one action at a time",
                config.trainer.actions_per_observation
            ),
            "set trainer.actions_per_observation = 1",
        )
    })
}

/// The first field of the observation that only a hero has.
fn hero_field(config: &Config) -> Option<&'static str> {
    let mut fields = config.observation.fields.iter().map(|field| field.spec());
    fields
        .find(|spec| spec.source.task() == Some(TaskKind::Driving))
        .map(|spec| spec.name)
}

/// A polygon has three corners or more, and excludes a circle.
fn region(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let refused = |message: String, help: &str| Err(conflict(settings, "region.polygon_m", message, help.into()));
    let corners = config.region.polygon_m.len();
    if (1..3).contains(&corners) {
        return refused(
            format!("`region.polygon_m` has {corners} corners"),
            "give three corners or more, or [] for none",
        );
    }
    if corners > 0 && config.region.radius_m > 0.0 {
        return refused(
            format!(
                "`region.polygon_m` and `region.radius_m` = {} are two regions",
                config.region.radius_m
            ),
            "set region.polygon_m = [] or region.radius_m = 0",
        );
    }
    Ok(())
}

fn is_multiple(value_s: f64, tick_s: f64) -> bool {
    let ratio = value_s / tick_s;
    ratio.round() >= 1.0 && (ratio - ratio.round()).abs() < 1e-6 * ratio
}

fn conflict(settings: &LayeredSettings, path: &str, message: String, help: String) -> ConfigError {
    conflict_at(settings.setting(path), message, help)
}

/// A conflict at a key of one entry of a list of tables: `(list, index, key)`.
fn conflict_in_entry(
    settings: &LayeredSettings,
    (list, index, key): (&str, usize, &str),
    message: String,
    help: String,
) -> ConfigError {
    let list = settings.setting(list);
    let setting = list.and_then(|list| list.entries.get(index)?.get(key));
    conflict_at(setting.or(list), message, help)
}

/// A conflict at a setting, if it was set.
pub(super) fn conflict_at(setting: Option<&LocatedValue>, message: String, help: String) -> ConfigError {
    match setting {
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
