//! From the command line to a run file: everything that can be wrong is found here, before anything is started.

use std::path::{Path, PathBuf};

use ipc_schema::{
    SCHEMA_VERSION,
    config::Config,
    control,
    run::{Beginning, MapInfo, Mode, RunFile, RunMap, SceneFiles, Source, Start},
    services::Channel,
};
use serde_json::Value;

use crate::{
    checkpoint::FoundCheckpoint,
    cli::{PlayArgs, RunArgs},
    config::{self, ConfigError, LayeredSettings},
    failure::Exit,
    install::Install,
    maps,
    registry::{self, RunClaim},
    remote, resume,
    scenario::{self, SumoScenario},
    view::ViewerRequest,
};

/// SUMO's own default step, seconds.
const SUMO_STEP_S: f64 = 1.0;
/// SUMO's own default seed.
const SUMO_SEED: u64 = 23423;
/// Road users that shared memory is laid out for when a scenario does not say.
const SCENARIO_ROAD_USERS: u64 = 8192;

/// A run that is ready to be supervised.
#[derive(Debug)]
pub struct PreparedRun {
    /// What every process will read.
    pub run: RunFile,
    /// The parts of caraware.
    pub install: Install,
    /// Its corner of shared memory.
    pub claim: RunClaim,
    /// Show no progress and no summary.
    pub quiet: bool,
    /// Where to show it meanwhile, if at all.
    pub viewer: Option<ViewerRequest>,
}

/// What CONFIG names.
enum TrafficInput {
    Map,
    Scenario(PathBuf, SumoScenario),
}

/// Checks everything and claims a run directory and shared memory.
///
/// # Errors
/// Anything wrong with the configuration, the user's files or this machine.
pub fn prepare(args: &RunArgs, mode: Mode) -> Result<PreparedRun, Exit> {
    let (settings, named, label) = resolve(&args.with_shorthands())?;
    make(args, mode, settings.validate()?, named, &label, Install::find()?)
}

/// Checks a run in which the policy of a checkpoint predicts, and claims its directory and shared memory.
///
/// # Errors
/// As [`prepare`], or there is no such checkpoint, or it does not fit the configuration.
pub fn prepare_play(args: &PlayArgs) -> Result<PreparedRun, Exit> {
    let install = Install::find()?;
    let found = FoundCheckpoint::best(&install, &args.checkpoint, &args.run.runs)?;
    let (settings, named) = match &args.run.config {
        Some(_) => resolve(&args.run.with_shorthands()).map(|(settings, named, _)| (settings, named))?,
        None => of_run(&found.run()?, &args.run.with_shorthands().set)?,
    };
    let config = settings.validate()?;
    if config.drives() {
        return Err(Exit::config(
            "play is for policies that tell where a vehicle is, not for the driving task",
            "`caraware train` with a driver as trainer.module drives",
        ));
    }
    found.check_fit(&config)?;
    let label = format!("{}-play", found.label());
    let mut prepared = make(&args.run, Mode::Play, config, named, &label, install)?;
    prepared.run.beginning = Some(Beginning {
        checkpoint: found.checkpoint,
        start: Start::default(),
        others: Vec::new(),
        episodes: args.episodes,
    });
    Ok(prepared)
}

/// Checks a run that goes on from a checkpoint: in its own directory if a run is named, in a new one if a checkpoint is.
///
/// # Errors
/// As [`prepare`], or there is no such checkpoint or run, or a setting differs that observations depend on.
pub fn prepare_resume(args: &RunArgs, resumed: &str) -> Result<PreparedRun, Exit> {
    let install = Install::find()?;
    let found = FoundCheckpoint::newest(&install, resumed, &args.runs)?;
    let old = found.run()?;
    let mut config = resume::changed(&old, &args.with_shorthands().set)?;
    found.check_fit(&config)?;
    if found.is_run && args.name.is_none() {
        remote::check(&mut config.fanout)?;
        let viewer = ViewerRequest::of(args, &config.fanout)?;
        registry::sweep();
        let (run, claim) = resume::go_on(&found, old, config, &install)?;
        check_shared_memory(&run)?;
        return Ok(PreparedRun {
            run,
            install,
            claim,
            quiet: args.quiet,
            viewer,
        });
    }
    let (_, named) = of_run(&old, &[])?;
    let mut prepared = make(args, Mode::Train, config, named, &found.label(), install)?;
    let beginning = found.copy_into(&prepared.run.run_dir)?;
    prepared.run.beginning = Some(resume::follow(&old, &prepared.run.run_dir, beginning)?);
    Ok(prepared)
}

/// The settings and the source of traffic of another run, and what changes.
fn of_run(run: &RunFile, set: &[String]) -> Result<(LayeredSettings, TrafficInput), Exit> {
    let settings = LayeredSettings::of(&run.config)?.with_assignments(set)?;
    let named = match &run.source {
        Source::Scenario { sumocfg } => TrafficInput::Scenario(sumocfg.clone(), scenario::read(sumocfg)?),
        Source::Population { .. } => TrafficInput::Map,
    };
    Ok((settings, named))
}

fn make(
    args: &RunArgs,
    mode: Mode,
    mut config: Config,
    named: TrafficInput,
    label: &str,
    install: Install,
) -> Result<PreparedRun, Exit> {
    check_task(&config, mode, &named)?;
    let origin = config.map.origin_latitude_deg.zip(config.map.origin_longitude_deg);
    let scenario_map = match &named {
        TrafficInput::Scenario(_, scenario) => Some(scenario::map_info(&scenario.net_file, origin)?),
        TrafficInput::Map => None,
    };
    remote::check(&mut config.fanout)?;
    let viewer = ViewerRequest::of(args, &config.fanout)?;
    maps::locate(&mut config.curriculum)?;
    let actions = actions(args.commands.as_deref(), config.run.envs)?;
    registry::sweep();
    let run_dir = create_run_dir(args, label)?;
    let result = assemble(&run_dir, mode, config, &install, named, scenario_map)
        .and_then(|assembled| write_actions(&run_dir.path, &actions).map(|()| assembled));
    if result.is_err() {
        // Nothing has been started: leave nothing behind.
        if let Err(error) = std::fs::remove_dir_all(&run_dir.path) {
            tracing::warn!(%error, "cannot remove the run directory");
        }
    }
    let (run, claim) = result?;
    Ok(PreparedRun {
        run,
        install,
        claim,
        quiet: args.quiet,
        viewer,
    })
}

fn resolve(args: &RunArgs) -> Result<(LayeredSettings, TrafficInput, String), Exit> {
    let name = args.config.as_deref().unwrap_or("town");
    let path = Path::new(name);
    let defaults = LayeredSettings::defaults()?;
    let label = path
        .file_stem()
        .map_or_else(|| name.to_owned(), |stem| stem.to_string_lossy().into_owned());
    match path.extension().and_then(std::ffi::OsStr::to_str) {
        Some("sumocfg") => {
            let scenario = scenario::read(path)?;
            let mut settings = defaults.with_assignments(&args.set)?;
            suggest_scenario(&mut settings, &scenario, name)?;
            let path = std::path::absolute(path).map_err(|error| Exit::io("resolve", path, &error))?;
            Ok((settings, TrafficInput::Scenario(path, scenario), label))
        }
        Some("toml") => Ok((
            defaults.with_file(path)?.with_assignments(&args.set)?,
            TrafficInput::Map,
            label,
        )),
        _ => {
            let settings = defaults.with_preset(name).ok_or_else(|| ConfigError::File {
                path: name.to_owned(),
                message: "is neither a preset, a .toml nor a .sumocfg".into(),
                help: format!("presets: {}. A path needs its extension.", config::preset_names()),
            })??;
            Ok((settings.with_assignments(&args.set)?, TrafficInput::Map, label))
        }
    }
}

/// A scenario's own step and seed count, unless the user says otherwise, and its own road users.
fn suggest_scenario(settings: &mut LayeredSettings, scenario: &SumoScenario, source: &str) -> Result<(), Exit> {
    for (path, none) in [("traffic.cavs", 1), ("traffic.others", 0), ("traffic.pedestrians", 0)] {
        if settings.is_set_by_user(path) {
            return Err(Exit::config(
                format!("`{path}` is for maps with population control, and {source} has its own road users"),
                "traffic.cav_share and traffic.max_cavs say how many of its vehicles carry sensors; traffic.scale changes its demand",
            ));
        }
        settings.suggest(path, Value::from(none), source);
    }
    settings.suggest(
        "traffic.step_s",
        Value::from(scenario.step_s.unwrap_or(SUMO_STEP_S)),
        source,
    );
    settings.suggest("run.seed", Value::from(scenario.seed.unwrap_or(SUMO_SEED)), source);
    settings.suggest("traffic.max_road_users", Value::from(SCENARIO_ROAD_USERS), source);
    Ok(())
}

/// Actions need somebody who gives them, and heroes that the source of traffic has.
fn check_task(config: &Config, mode: Mode, named: &TrafficInput) -> Result<(), Exit> {
    if matches!(named, TrafficInput::Map) && (config.episode.whole_scenario || config.traffic.scale.is_some()) {
        return Err(Exit::config(
            "`episode.whole_scenario` and `traffic.scale` are for a .sumocfg, and there is none",
            "name one in place of the preset, or leave them out",
        ));
    }
    if matches!(named, TrafficInput::Scenario(..)) && !config.curriculum.stages.is_empty() {
        return Err(Exit::config(
            "the stages of a curriculum say how many vehicles there are, and a .sumocfg has its own",
            "name the .sumocfg in curriculum.maps, and a preset or .toml in its place: its net is then run with population control",
        ));
    }
    if !config.drives() {
        return Ok(());
    }
    let traffic = &config.traffic;
    match (mode, named) {
        (Mode::Simulate, _) => Err(Exit::config(
            "the driving task needs a trainer that drives, and `caraware simulate` has none",
            "use `caraware train`; trainer.module names the driver",
        )),
        (Mode::Train, TrafficInput::Map) if traffic.heroes == 0 || !traffic.hero_ids.is_empty() => Err(Exit::config(
            "on a map with population control heroes come by `traffic.heroes`, not by `traffic.hero_ids`",
            "set traffic.heroes = 1 and traffic.hero_ids = []",
        )),
        (Mode::Train, TrafficInput::Scenario(..)) if traffic.heroes > 0 || !traffic.hero_route.is_empty() => {
            Err(Exit::config(
                "heroes of a .sumocfg are vehicles of its own: `traffic.heroes` and `traffic.hero_route` are for maps with population control",
                "set traffic.hero_ids to the ids of the vehicles that are to be driven, and traffic.heroes = 0",
            ))
        }
        (Mode::Train | Mode::Play, _) => Ok(()),
    }
}

/// The texts of the action logs of all environments that have one: that of environment 0 is `path`, the others lie beside it as in a run
/// directory.
fn actions(path: Option<&Path>, envs: u32) -> Result<Vec<(u32, String)>, Exit> {
    let Some(path) = path else { return Ok(Vec::new()) };
    let mut logs = vec![(0, log(path)?)];
    for index in 1..envs {
        let path = path.with_file_name(format!("env-{index}")).join(control::COMMAND_LOG);
        if path.exists() {
            logs.push((index, log(&path)?));
        }
    }
    Ok(logs)
}

fn log(path: &Path) -> Result<String, Exit> {
    let wrong = |reason: String| {
        Exit::config(
            format!("--commands {}: {reason}", path.display()),
            "give the commands.jsonl of a run of the same configuration",
        )
    };
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    match control::actions(&text) {
        Ok(_) => Ok(text),
        Err((line, reason)) => Err(wrong(format!("line {line}: {reason}"))),
    }
}

/// Puts the logs that the run is to follow where each `traffic-bridge` looks for its own.
fn write_actions(run_dir: &Path, logs: &[(u32, String)]) -> Result<(), Exit> {
    for (index, text) in logs {
        let directory = match index {
            0 => run_dir.to_owned(),
            index => run_dir.join(format!("env-{index}")),
        };
        let path = directory.join(control::COMMAND_REPLAY);
        std::fs::create_dir_all(&directory)
            .and_then(|()| std::fs::write(&path, text))
            .map_err(|error| Exit::io("write", &path, &error))?;
    }
    Ok(())
}

struct RunDirectory {
    name: String,
    path: PathBuf,
}

/// `runs/<name>`, created by us alone: the name given, or the label with the first free number.
fn create_run_dir(args: &RunArgs, label: &str) -> Result<RunDirectory, Exit> {
    let runs = std::path::absolute(&args.runs).map_err(|error| Exit::io("resolve", &args.runs, &error))?;
    std::fs::create_dir_all(&runs).map_err(|error| Exit::io("create", &runs, &error))?;
    if let Some(name) = &args.name {
        check_name(name)?;
        let path = runs.join(name);
        return match std::fs::create_dir(&path) {
            Ok(()) => Ok(RunDirectory {
                name: name.clone(),
                path,
            }),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => Err(Exit::config(
                format!("the run name `{name}` is in use: {} exists", path.display()),
                "choose another with --name, or remove that directory",
            )),
            Err(error) => Err(Exit::io("create", &path, &error)),
        };
    }
    for number in 1_u32.. {
        let name = format!("{label}-{number}");
        let path = runs.join(&name);
        match std::fs::create_dir(&path) {
            Ok(()) => return Ok(RunDirectory { name, path }),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(Exit::io("create", &path, &error)),
        }
    }
    Err(Exit::run("no free run number", "name the run with --name"))
}

fn check_name(name: &str) -> Result<(), Exit> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
    if !name.is_empty() && name.len() <= 64 && name.chars().all(plain) && !name.starts_with('.') {
        return Ok(());
    }
    Err(Exit::config(
        format!("the run name `{name}` cannot be used"),
        "use up to 64 of the letters a–z, digits, '.', '_' and '-', not starting with '.'",
    ))
}

/// What a run is on, as its run file says it.
struct MapInputs {
    source: Source,
    map: MapInfo,
    scene_files: SceneFiles,
    maps: Vec<RunMap>,
}

impl MapInputs {
    fn of_scenario(sumocfg: PathBuf, scenario: SumoScenario, map: MapInfo) -> Self {
        Self {
            source: Source::Scenario { sumocfg },
            map,
            scene_files: SceneFiles {
                net_file: scenario.net_file,
                additional_files: scenario.additional_files,
            },
            maps: Vec::new(),
        }
    }

    fn of_maps(maps: Vec<RunMap>) -> Result<Self, Exit> {
        let map = maps::together(&maps);
        let (Some(map), Some(first)) = (map, maps.first().cloned()) else {
            return Err(Exit::run("the run has no map", "name one in curriculum.maps"));
        };
        Ok(Self {
            source: first.source,
            map,
            scene_files: first.scene_files,
            maps: if maps.len() > 1 { maps } else { Vec::new() },
        })
    }
}

fn assemble(
    run_dir: &RunDirectory,
    mode: Mode,
    config: Config,
    install: &Install,
    named: TrafficInput,
    scenario_map: Option<MapInfo>,
) -> Result<(RunFile, RunClaim), Exit> {
    for part in ["logs", "parts"] {
        let path = run_dir.path.join(part);
        std::fs::create_dir(&path).map_err(|error| Exit::io("create", &path, &error))?;
    }
    let ground = match (named, scenario_map) {
        (TrafficInput::Scenario(sumocfg, scenario), Some(map)) => MapInputs::of_scenario(sumocfg, scenario, map),
        _ => MapInputs::of_maps(maps::build(install, &config, &run_dir.path.join("map"))?)?,
    };
    let claim = RunClaim::new(&run_dir.path)?;
    let config_hash = config::hash(&config);
    let path = run_dir.path.join("config.toml");
    std::fs::write(&path, format!("# BLAKE3 {config_hash}\n{}", config::to_toml(&config)))
        .map_err(|error| Exit::io("write", &path, &error))?;
    let run = RunFile {
        schema_version: SCHEMA_VERSION,
        env_index: 0,
        run_id: claim.run_id,
        name: run_dir.name.clone(),
        run_dir: run_dir.path.clone(),
        mode,
        supervisor_pid: i32::try_from(std::process::id()).unwrap_or(0),
        shared_memory: claim.memory.clone(),
        source: ground.source,
        map: ground.map,
        scene_files: ground.scene_files,
        maps: ground.maps,
        sumo_home: install.sumo_home.clone(),
        config,
        config_hash,
        beginning: None,
        restart: None,
    };
    check_shared_memory(&run)?;
    Ok((run, claim))
}

/// Refuses a run whose worst case does not fit: a full `/dev/shm` would kill processes with SIGBUS in mid-run.
fn check_shared_memory(run: &RunFile) -> Result<(), Exit> {
    let needed: u64 = Channel::ALL
        .into_iter()
        .map(|channel| channel.worst_case_bytes(run) as u64)
        .sum::<u64>()
        * u64::from(run.config.run.envs);
    let free = free_bytes(Path::new(registry::SHARED_MEMORY))?;
    if needed <= free {
        return Ok(());
    }
    let lidars = match run.config.lidar.vehicles {
        0 => String::new(),
        vehicles => format!(" or `lidar.vehicles` (now {vehicles})"),
    };
    let environments = match run.config.run.envs {
        1 => String::new(),
        envs => format!(" or `run.envs` (now {envs})"),
    };
    let mebi = |bytes: u64| bytes.div_ceil(1 << 20);
    Err(Exit::missing(
        format!(
            "{} has {} MiB free, this run may need {} MiB",
            registry::SHARED_MEMORY,
            mebi(free),
            mebi(needed)
        ),
        format!(
            "lower `traffic.max_road_users` (now {}) or `run.window_ticks` (now {}){environments}{lidars}, or enlarge {} (Docker: --shm-size)",
            run.config.traffic.max_road_users,
            run.config.run.window_ticks,
            registry::SHARED_MEMORY
        ),
    ))
}

/// Free bytes of the file system that holds `path`.
///
/// # Errors
/// It cannot be asked.
pub fn free_bytes(path: &Path) -> Result<u64, Exit> {
    let stat = rustix::fs::statvfs(path).map_err(|error| Exit::io("look at", path, &error.into()))?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}
