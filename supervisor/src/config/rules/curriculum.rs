//! Rules of a curriculum: every stage has room for its vehicles and maps that exist, and a learner decides its gates.

use std::collections::BTreeSet;

use ipc_schema::{
    config::{Config, CurriculumMap, HeroTurns, MapChoice, OWN_TRAINER, StageConfig},
    metric::PolicyMetric,
};

use super::{ConfigError, LayeredSettings, conflict, conflict_in_entry};

/// Most stages of a curriculum: each prefetches its maps and keeps statistics of its own.
const MOST_STAGES: usize = 255;
/// Most maps of a curriculum.
const MOST_MAPS: usize = 256;

pub(super) fn check(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let stages = &config.curriculum.stages;
    let refuse = |message: String, help: String| Err(conflict(settings, "curriculum.stages", message, help));
    if stages.len() > MOST_STAGES {
        return refuse(
            format!("`curriculum.stages` has {} stages", stages.len()),
            format!("give at most {MOST_STAGES}"),
        );
    }
    maps(settings, config)?;
    if let Some((number, unknown)) = config.curriculum.unknown_map() {
        return refuse(
            format!("stage {number} of `curriculum.stages` uses the map \"{unknown}\", which the run does not have"),
            format!(
                "its maps are \"{}\": add the file to `curriculum.maps`, or name one of them",
                config.curriculum.map_names().join("\", \"")
            ),
        );
    }
    (1..).zip(stages).try_for_each(|(number, stage)| {
        road_users(settings, config, number, stage)?;
        counted_lessons(settings, config, number, stage)?;
        gate_of_stage(settings, config, number, stage)?;
        choice_of_map(settings, number, stage)
    })
}

/// A stage has road users that the task needs, and no more than there is room for.
fn road_users(
    settings: &LayeredSettings,
    config: &Config,
    number: usize,
    stage: &StageConfig,
) -> Result<(), ConfigError> {
    let traffic = stage.traffic(&config.traffic);
    let refuse = |key: &str, message: String, help: String| {
        let entry = ("curriculum.stages", number - 1, key);
        let message = format!("stage {number} of `curriculum.stages` {message}");
        Err(conflict_in_entry(settings, entry, message, help))
    };
    let road_users = traffic.cavs + traffic.others + traffic.pedestrians + traffic.heroes;
    if road_users > traffic.max_road_users {
        return refuse(
            "curriculum.stages.cavs",
            format!(
                "asks for {road_users} road users, `traffic.max_road_users` is {}",
                traffic.max_road_users
            ),
            format!("set traffic.max_road_users to {road_users} or more"),
        );
    }
    if config.drives() {
        return match traffic.heroes {
            0 => refuse(
                "curriculum.stages.heroes",
                "has no hero to teach".into(),
                "give the stage `heroes`, or set traffic.heroes".into(),
            ),
            _ if traffic.hero_turns != HeroTurns::Any && !traffic.hero_route.is_empty() => refuse(
                "curriculum.stages.hero_turns",
                "sets `hero_turns`, which is for routes that are drawn, and `traffic.hero_route` gives one".into(),
                "set traffic.hero_route = [], or leave `hero_turns` out".into(),
            ),
            _ => Ok(()),
        };
    }
    if stage.heroes.is_some() || stage.hero_turns.is_some() {
        return refuse(
            "curriculum.stages.heroes",
            "sets heroes, which need the driving task".into(),
            "set task.kind = \"driving\", or leave `heroes` and `hero_turns` out".into(),
        );
    }
    if traffic.cavs == 0 {
        return refuse(
            "curriculum.stages.cavs",
            format!("has no connected vehicle for the {} task", config.task.kind.name()),
            "set `cavs` to 1 or more".into(),
        );
    }
    Ok(())
}

/// Where no single trainer of a single environment decides, stages end by the number of their lessons.
fn counted_lessons(
    settings: &LayeredSettings,
    config: &Config,
    number: usize,
    stage: &StageConfig,
) -> Result<(), ConfigError> {
    if config.trainer_decides_lessons() {
        return Ok(());
    }
    let why = match (config.run.envs, config.trainer.ranks) {
        (2.., _) => format!("the {} environments of `run.envs`", config.run.envs),
        (_, 2..) => format!("the environments of {} ranks", config.trainer.ranks),
        _ => format!("a run with `trainer.module` = \"{}\"", config.trainer.module),
    };
    let key = match (stage.until_std, stage.until_metric, stage.restart) {
        (Some(_), _, _) => "until_std",
        (None, Some(_), _) => "until_metric",
        (None, None, false) => "restart",
        (None, None, true) => return Ok(()),
    };
    Err(conflict_in_entry(
        settings,
        ("curriculum.stages", number - 1, &format!("curriculum.stages.{key}")),
        format!(
            "stage {number} of `curriculum.stages`: `{key}` needs one trainer that decides, and {why} count lessons"
        ),
        format!(
            "{}, or train in one environment with one trainer, \"{OWN_TRAINER}\"",
            match key {
                "restart" => "leave `restart` out",
                _ => "use `until_lessons`",
            }
        ),
    ))
}

/// A gate has a metric of the run's task and the value that it must reach, or neither.
fn gate_of_stage(
    settings: &LayeredSettings,
    config: &Config,
    number: usize,
    stage: &StageConfig,
) -> Result<(), ConfigError> {
    let task = config.task.kind;
    let of_task = PolicyMetric::all().filter(|metric| metric.spec().task == task);
    let names: Vec<String> = of_task.map(|metric| format!("\"{}\"", metric.spec().name)).collect();
    let refuse = |key: &str, message: &str, help: String| {
        let message = format!("stage {number} of `curriculum.stages`: {message}");
        Err(conflict_in_entry(
            settings,
            ("curriculum.stages", number - 1, key),
            message,
            help,
        ))
    };
    match (stage.until_metric, stage.until_value) {
        (Some(metric), _) if metric.spec().task != task => refuse(
            "curriculum.stages.until_metric",
            &format!(
                "`until_metric` = \"{}\" is no metric of the {} task",
                metric.spec().name,
                task.name()
            ),
            format!("its metrics are {}", names.join(", ")),
        ),
        (Some(metric), None) => refuse(
            "curriculum.stages.until_metric",
            "`until_metric` is set without `until_value`",
            format!("give the value that ends the stage, in {}", metric.spec().unit),
        ),
        (None, Some(_)) => refuse(
            "curriculum.stages.until_value",
            "`until_value` is set without `until_metric`",
            format!("name the metric: {}", names.join(", ")),
        ),
        (Some(_), Some(_)) | (None, None) => Ok(()),
    }
}

/// Every map has a unique name, and the configuration has stages that can use it.
fn maps(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let maps = &config.curriculum.maps;
    let refuse = |message: String, help: &str| Err(conflict(settings, "curriculum.maps", message, help.into()));
    if maps.len() > MOST_MAPS {
        let message = format!("`curriculum.maps` has {} maps", maps.len());
        return refuse(message, &format!("give at most {MOST_MAPS}"));
    }
    // One map alone is that of the whole run.
    if maps.len() > 1 && config.curriculum.stages.is_empty() {
        return refuse(
            "`curriculum.maps` has several maps, but there are no stages to choose from them".into(),
            "add a [[curriculum.stages]], or name one map; to run a scenario unchanged, name its .sumocfg in place of the preset",
        );
    }
    let mut names = BTreeSet::new();
    for name in maps.iter().map(CurriculumMap::name) {
        if !names.insert(name) {
            return refuse(
                format!("`curriculum.maps` has two maps of the name \"{name}\""),
                "a map's name is its file's name without the ending: rename one of the files",
            );
        }
    }
    if maps.len() < 2 {
        return Ok(());
    }
    match positioned_key(config) {
        None => Ok(()),
        Some(key) => Err(conflict(
            settings,
            key,
            format!(
                "`{key}` holds positions on one map, but `curriculum.maps` has {}",
                maps.len()
            ),
            "leave it out; every map has its own buildings, and `scene.random_props` are placed on all maps".into(),
        )),
    }
}

/// The first key in use that holds positions on a map.
fn positioned_key(config: &Config) -> Option<&'static str> {
    let (scene, region) = (&config.scene, &config.region);
    let keys = [
        ("scene.obstacles", !scene.obstacles.is_empty()),
        ("scene.meshes", !scene.meshes.is_empty()),
        ("region.polygon_m", !region.polygon_m.is_empty()),
        ("region.radius_m", region.radius_m > 0.0),
        ("roadside", !config.roadsides.is_empty()),
    ];
    keys.into_iter().find_map(|(key, is_used)| is_used.then_some(key))
}

/// A stage that draws its maps names two or more.
fn choice_of_map(settings: &LayeredSettings, number: usize, stage: &StageConfig) -> Result<(), ConfigError> {
    let refuse = |message: String, help: String| Err(conflict(settings, "curriculum.stages", message, help));
    if stage.map_choice != MapChoice::InOrder && stage.maps.len() < 2 {
        return refuse(
            format!(
                "stage {number} of `curriculum.stages` draws its maps, but names {}",
                stage.maps.len()
            ),
            "give `maps` with two or more, or leave `map_choice` out".into(),
        );
    }
    Ok(())
}
