//! Rules of a curriculum: every stage has room for its vehicles and maps that exist, and a learner decides its gates.

use std::collections::BTreeSet;

use ipc_schema::{
    config::{Config, CurriculumMap, MapChoice, StageConfig},
    metric::PolicyMetric,
};

use super::{ConfigError, LayeredSettings, OWN_TRAINER, conflict, conflict_in_entry};

/// Most stages of a curriculum: each prefetches its maps and keeps statistics of its own.
const MOST_STAGES: usize = 255;
/// Most maps of a curriculum.
const MOST_MAPS: usize = 256;

pub(super) fn check(settings: &LayeredSettings, config: &Config) -> Result<(), ConfigError> {
    let (stages, traffic) = (&config.curriculum.stages, &config.traffic);
    let refuse = |message: String, help: String| Err(conflict(settings, "curriculum.stages", message, help));
    if stages.len() > MOST_STAGES {
        return refuse(
            format!("`curriculum.stages` has {} stages", stages.len()),
            format!("give at most {MOST_STAGES}"),
        );
    }
    if !stages.is_empty() && config.drives() {
        return refuse(
            "a curriculum is for the localisation task: its stages set the number of connected vehicles".into(),
            "set task.kind = \"localisation\" or curriculum.stages = []".into(),
        );
    }
    if !stages.is_empty() && (config.run.envs > 1 || config.trainer.ranks > 1) {
        return refuse(
            "a curriculum needs exactly one trainer and one environment".into(),
            "set run.envs = 1 and start one trainer, or set curriculum.stages = []".into(),
        );
    }
    if !stages.is_empty() && config.trainer.module != OWN_TRAINER {
        return refuse(
            format!(
                "`trainer.module` = \"{}\" does not decide lessons, and a curriculum waits for these decisions",
                config.trainer.module
            ),
            format!("set trainer.module = \"{OWN_TRAINER}\" or curriculum.stages = []"),
        );
    }
    for (number, stage) in (1..).zip(stages) {
        let road_users = stage.cavs + traffic.others + traffic.pedestrians;
        if road_users > traffic.max_road_users {
            return refuse(
                format!(
                    "stage {number} of `curriculum.stages` asks for {road_users} road users, `traffic.max_road_users` is {}",
                    traffic.max_road_users
                ),
                format!("set traffic.max_road_users to {road_users} or more"),
            );
        }
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
        gate_of_stage(settings, config, number, stage)?;
        choice_of_map(settings, number, stage)
    })
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
