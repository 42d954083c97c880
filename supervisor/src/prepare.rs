//! Turns the command line into a run file. Every mistake of the user is found here, before a process starts.

use std::path::{Path, PathBuf};

use ipc_schema::{
    SCHEMA_VERSION,
    config::{Config, HeroTurns, LocalisationAction},
    control,
    process::Process,
    reserve,
    run::{Beginning, MapInfo, Mode, RunFile, RunMap, SceneFiles, Source, Start},
    storage,
};
use serde_json::Value;

use crate::{
    checkpoint::{self, FoundCheckpoint},
    cli::{PlayArgs, RunArgs},
    config::{self, ConfigError, LayeredSettings},
    correction::{suggest_correction, suggest_one_action},
    failure::Exit,
    install::Install,
    interruption::InterruptionWatch,
    maps,
    memory_limit::{MemoryGroups, MemoryLimit},
    preparation_mark,
    registry::{self, RunClaim},
    remote, resume,
    scenario::{self, ScenarioReading, SumoScenario, input_check::require_regular},
    scenario_settings, system_limits,
    view::ViewerRequest,
};

/// How far ahead mirrors see SUMO's path on nets that were not drawn for them, seconds.
const PREVIEW_S: f64 = 1.5;

/// The key that `--trust-scenario` sets.
const TRUST_KEY: &str = "traffic.trust_scenario";

/// A run that is ready to be supervised.
#[derive(Debug)]
pub struct PreparedRun {
    /// The run file, which every process reads.
    pub run: RunFile,
    /// The installed programs.
    pub install: Install,
    /// The run's part of shared memory.
    pub claim: RunClaim,
    /// True if neither progress nor a summary is shown.
    pub quiet: bool,
    /// The viewer to start beside the run, if any.
    pub viewer: Option<ViewerRequest>,
    /// Notes signals until the supervisor does.
    pub interruption: InterruptionWatch,
}

/// The source of traffic that the argument CONFIG selects.
enum TrafficInput {
    /// A map with population control, which the configuration describes.
    Map,
    /// A `.sumocfg` with its own demand.
    Scenario(PathBuf, SumoScenario),
}

impl TrafficInput {
    fn is_scenario(&self) -> bool {
        matches!(self, Self::Scenario(..))
    }
}

/// Checks everything and claims a run directory and shared memory.
///
/// # Errors
/// The configuration, the user's files or this machine do not allow the run.
pub fn prepare(args: &RunArgs, mode: Mode) -> Result<PreparedRun, Exit> {
    let (mut settings, named, label) = resolve_config(&args.with_shorthands()?)?;
    scenario_settings::check_length(&settings, mode, named.is_scenario())?;
    suggest_one_action(&mut settings);
    if let (Mode::Train, TrafficInput::Scenario(path, _)) = (mode, &named) {
        suggest_correction(&mut settings, &path.display().to_string());
    }
    prepare_new(
        args,
        mode,
        settings.validate()?,
        named,
        &label,
        Install::find()?,
        |_| Ok(()),
    )
}

/// Checks a run in which the policy of a checkpoint predicts, and claims its directory and shared memory.
///
/// # Errors
/// As [`prepare`], or the checkpoint does not exist or does not fit the configuration.
pub fn prepare_play(args: &PlayArgs) -> Result<PreparedRun, Exit> {
    let install = Install::find()?;
    let found = FoundCheckpoint::best(&install, &args.checkpoint, &args.run.runs)?;
    let (settings, named) = match &args.run.config {
        Some(name) => {
            let (mut settings, named, _) = resolve_config(&args.run.with_shorthands()?)?;
            suggest_one_action(&mut settings);
            if found.run()?.config.task.action == LocalisationAction::Correction {
                suggest_correction(&mut settings, name);
            }
            (settings, named)
        }
        None => settings_of_run(&found.run()?, &args.run.with_shorthands()?.set)?,
    };
    let mut config = settings.validate()?;
    found.check_fit(&config)?;
    // A player shows one environment, however many the policy has learnt in.
    config.run.envs = 1;
    let label = format!("{}-play", found.label());
    prepare_new(&args.run, Mode::Play, config, named, &label, install, |run| {
        run.beginning = Some(Beginning {
            checkpoint: found.checkpoint,
            start: Start::default(),
            others: Vec::new(),
            episodes: args.episodes,
        });
        Ok(())
    })
}

/// Checks a run that continues from a checkpoint. It continues in its own directory if `resumed` names a run, and in a new directory
/// if `resumed` names a checkpoint.
///
/// # Errors
/// As [`prepare`], or the checkpoint or run does not exist, or a changed setting is one that observations depend on.
pub fn prepare_resume(args: &RunArgs, resumed: &str) -> Result<PreparedRun, Exit> {
    let install = Install::find()?;
    if let Some(run_dir) = checkpoint::without_checkpoint(resumed, &args.runs)? {
        let old = RunFile::read(&run_dir.join("run.json"))?;
        if args.name.is_some() {
            return Err(Exit::config(
                format!(
                    "the run {} has no checkpoint that another run could begin with",
                    old.name
                ),
                "leave --name out: the run resumes from its own beginning",
            ));
        }
        let config = resume::changed_config(&old, &args.with_shorthands()?.set)?;
        return prepare_in_place(args, None, old, config, install);
    }
    let found = FoundCheckpoint::newest(&install, resumed, &args.runs)?;
    let old = found.run()?;
    let config = resume::changed_config(&old, &args.with_shorthands()?.set)?;
    found.check_fit(&config)?;
    system_limits::check_open_files(config.run.envs)?;
    // A run is continued in its own directory.
    if found.is_run && args.name.is_none() {
        return prepare_in_place(args, Some(found.beginning()), old, config, install);
    }
    // A checkpoint is continued by a new run.
    let (_, named) = settings_of_run(&old, &[])?;
    prepare_new(args, Mode::Train, config, named, &found.label(), install, |run| {
        let beginning = found.copy_into(&run.run_dir)?;
        run.beginning = Some(resume::carry_over_logs(&old, &run.run_dir, beginning)?);
        Ok(())
    })
}

/// Prepares a stopped run to continue in its own directory, from `beginning` or, without it, from tick 0.
fn prepare_in_place(
    args: &RunArgs,
    beginning: Option<Beginning>,
    old: RunFile,
    mut config: Config,
    install: Install,
) -> Result<PreparedRun, Exit> {
    remote::check(&mut config.fanout)?;
    let viewer = ViewerRequest::of(args, &config.fanout)?;
    registry::sweep();
    system_limits::check_open_files(config.run.envs)?;
    let interruption = InterruptionWatch::start()?;
    let resumed = resume::resume_in_place(beginning, old, config, &install)
        .and_then(|(run, claim)| reserve_shared_memory(&run).map(|()| (run, claim)));
    let (run, claim) = interruption.outcome(resumed)?;
    Ok(PreparedRun {
        run,
        install,
        claim,
        quiet: args.quiet,
        viewer,
        interruption,
    })
}

/// The settings of an earlier run with the assignments `set`, and its source of traffic.
fn settings_of_run(run: &RunFile, set: &[String]) -> Result<(LayeredSettings, TrafficInput), Exit> {
    let settings = LayeredSettings::of(&run.config)?.with_assignments(set)?;
    let named = match &run.source {
        Source::Scenario { sumocfg, .. } => {
            let trusted = settings.has_flag(TRUST_KEY);
            let reading = ScenarioReading::of(trusted, &run.config.traffic.traci_host);
            TrafficInput::Scenario(sumocfg.clone(), scenario::read(sumocfg, reading)?)
        }
        Source::Population { .. } => TrafficInput::Map,
    };
    Ok((settings, named))
}

/// Checks a run and creates its directory, in which `begin` then puts what the run begins with; without success it removes the directory.
fn prepare_new(
    args: &RunArgs,
    mode: Mode,
    mut config: Config,
    named: TrafficInput,
    label: &str,
    install: Install,
    begin: impl FnOnce(&mut RunFile) -> Result<(), Exit>,
) -> Result<PreparedRun, Exit> {
    // Checks that leave no traces come first.
    system_limits::check_open_files(config.run.envs)?;
    check_task(&config, mode, &named)?;
    let origin = config.map.origin_latitude_deg.zip(config.map.origin_longitude_deg);
    let scenario_map = match &named {
        TrafficInput::Scenario(_, scenario) => Some(scenario::map_info(&scenario.net_file, origin)?),
        TrafficInput::Map => None,
    };
    remote::check(&mut config.fanout)?;
    let viewer = ViewerRequest::of(args, &config.fanout)?;
    maps::locate(&mut config.curriculum)?;
    let command_logs = read_command_logs(args.commands.as_deref(), config.run.envs)?;
    prepare_in_new_directory(args, label, install, viewer, |run_dir, install| {
        let (mut run, claim) = assemble(run_dir, mode, config, install, named, scenario_map)?;
        write_command_logs(&run_dir.path, &command_logs)?;
        begin(&mut run)?;
        Ok((run, claim))
    })
}

/// Creates the directory of a run, which `assemble` fills. Without success, or if this program is asked to end meanwhile, it removes the
/// directory.
///
/// # Errors
/// Those of `assemble`, the directory cannot be created, or this program is asked to end.
pub(crate) fn prepare_in_new_directory(
    args: &RunArgs,
    label: &str,
    install: Install,
    viewer: Option<ViewerRequest>,
    assemble: impl FnOnce(&RunDirectory, &Install) -> Result<(RunFile, RunClaim), Exit>,
) -> Result<PreparedRun, Exit> {
    registry::sweep();
    let interruption = InterruptionWatch::start()?;
    let run_dir = create_run_dir(args, label)?;
    let assembled = interruption.outcome(assemble(&run_dir, &install));
    let (run, claim) = assembled.inspect_err(|_| {
        // No process has started, so the directory holds nothing of use.
        if let Err(error) = std::fs::remove_dir_all(&run_dir.path) {
            tracing::warn!(%error, "cannot remove the run directory");
        }
    })?;
    Ok(PreparedRun {
        run,
        install,
        claim,
        quiet: args.quiet,
        viewer,
        interruption,
    })
}

/// Reads CONFIG, a preset, `.toml` or `.sumocfg`. Returns the settings, the source of traffic, and the label of the run's name.
fn resolve_config(args: &RunArgs) -> Result<(LayeredSettings, TrafficInput, String), Exit> {
    let name = args.config.as_deref().unwrap_or("town");
    let path = Path::new(name);
    let preset = args.preset.as_deref();
    let defaults = LayeredSettings::defaults()?;
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned());
    let label = stem
        .unwrap_or_else(|| name.to_owned())
        .trim_end_matches(".sumo")
        .to_owned();
    match path.extension().and_then(std::ffi::OsStr::to_str) {
        _ if scenario::is_scenario(path) => {
            let settings = match preset {
                Some(preset) => defaults.with_named_preset(preset)?,
                None => defaults,
            };
            let mut settings = settings.with_assignments(&args.set)?;
            let host = settings.text("traffic.traci_host").unwrap_or_default();
            let reading = ScenarioReading::of(settings.has_flag(TRUST_KEY), host);
            let scenario = scenario::read(path, reading)?;
            scenario_settings::apply(&mut settings, &scenario, name)?;
            suggest_preview(&mut settings, name);
            let path = std::path::absolute(path).map_err(|error| Exit::io("resolve", path, &error))?;
            Ok((settings, TrafficInput::Scenario(path, scenario), label))
        }
        Some("toml") => {
            let mut settings = defaults.with_file(path, preset)?.with_assignments(&args.set)?;
            if settings.is_set_by_user("curriculum.maps") {
                suggest_preview(&mut settings, name);
            }
            Ok((settings, TrafficInput::Map, label))
        }
        _ if preset.is_some() => Err(Exit::config(
            format!("`--preset` is for a .toml or a .sumocfg, and CONFIG is {name}"),
            "leave one of both out",
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

/// Lets mirrors see the path ahead on nets that were not drawn for them, unless the task is to drive among them.
fn suggest_preview(settings: &mut LayeredSettings, source: &str) {
    if !settings.has_text("task.kind", "driving") {
        settings.suggest("vehicle.preview_s", Value::from(PREVIEW_S), source);
    }
}

/// Checks that the mode and the source of traffic can do the task: driving needs a trainer and heroes.
fn check_task(config: &Config, mode: Mode, named: &TrafficInput) -> Result<(), Exit> {
    let traffic = &config.traffic;
    let for_scenarios = traffic.scale.or(traffic.begin_s).or(traffic.end_s);
    if !named.is_scenario() && (config.episode.whole_scenario || for_scenarios.is_some()) {
        return Err(Exit::config(
            "`episode.whole_scenario`, `traffic.scale`, `--begin` and `--end` need a .sumocfg, and CONFIG is not one",
            "name a .sumocfg in place of the preset, or leave them out (episode.ticks and episode.training_episodes limit a run on a map)",
        ));
    }
    let runs_once = named.is_scenario() && (mode == Mode::Simulate || config.episode.whole_scenario);
    let attaches = !traffic.traci_host.is_empty();
    if attaches && !runs_once {
        return Err(Exit::config(
            "a SUMO that runs already (`traffic.traci_host`) has one scenario and runs it once",
            "give its .sumocfg to `caraware simulate`, or train with episode.whole_scenario = true",
        ));
    }
    if named.is_scenario() && !config.curriculum.stages.is_empty() {
        return Err(Exit::config(
            "the stages of a curriculum set the number of vehicles, but a .sumocfg has its own vehicles",
            "name the .sumocfg in curriculum.maps and give a preset or .toml as CONFIG: its net then runs with population control",
        ));
    }
    if named.is_scenario() && !config.curriculum.maps.is_empty() {
        return Err(Exit::config(
            "`curriculum.maps` names nets with population control, and a .sumocfg has its own net and vehicles",
            "leave it out, or name the .sumocfg in it and give a preset or .toml as CONFIG",
        ));
    }
    let changes_map =
        !traffic.traffic_lights || traffic.speed_limit_factor != 1.0 || traffic.hero_turns != HeroTurns::Any;
    if named.is_scenario() && changes_map {
        return Err(Exit::config(
            "`traffic.traffic_lights`, `traffic.speed_limit_factor` and `traffic.hero_turns` are for maps with population control, and a .sumocfg has its own traffic",
            "leave them out, and change the scenario's own files",
        ));
    }
    if config.actor() == Some(Process::V2x) && mode == Mode::Simulate {
        return Err(Exit::config(
            "`v2x.inclusion` = \"policy\" needs a trainer, and `caraware simulate` has none",
            "use `caraware train`, or set v2x.inclusion = \"standard\"",
        ));
    }
    if !config.drives() {
        return Ok(());
    }
    match (mode, named) {
        (Mode::Simulate, _) => Err(Exit::config(
            "the driving task needs a trainer, and `caraware simulate` has none",
            "use `caraware train` and name the driver in trainer.module",
        )),
        (Mode::Train, TrafficInput::Map) if traffic.heroes == 0 || !traffic.hero_ids.is_empty() => Err(Exit::config(
            "on a map with population control `traffic.heroes` sets the number of heroes, and `traffic.hero_ids` must be empty",
            "set traffic.heroes = 1 and traffic.hero_ids = []",
        )),
        (Mode::Train, TrafficInput::Scenario(..)) if traffic.heroes > 0 || !traffic.hero_route.is_empty() => {
            Err(Exit::config(
                "heroes of a .sumocfg are its own vehicles: `traffic.heroes` and `traffic.hero_route` are for maps with population control",
                "set traffic.hero_ids to the ids of the vehicles to drive, and traffic.heroes = 0",
            ))
        }
        (Mode::Train | Mode::Play, TrafficInput::Scenario(..)) if config.vehicle.preview_s > 0.0 => Err(Exit::config(
            "with `vehicle.preview_s` a hero of a .sumocfg would vanish before the end of its route, where SUMO ends it earlier",
            "set vehicle.preview_s = 0 with heroes of a .sumocfg",
        )),
        (Mode::Train | Mode::Play, _) => Ok(()),
    }
}

/// Reads the logs of commands: each environment that has one, with its text. The log of environment 0 is `path`; the others lie beside
/// it as in a run directory.
fn read_command_logs(path: Option<&Path>, envs: u32) -> Result<Vec<(u32, String)>, Exit> {
    let Some(path) = path else { return Ok(Vec::new()) };
    let mut logs = vec![(0, read_command_log(path)?)];
    for index in 1..envs {
        let path = path.with_file_name(format!("env-{index}")).join(control::COMMAND_LOG);
        if path.exists() {
            logs.push((index, read_command_log(&path)?));
        }
    }
    Ok(logs)
}

/// Reads a log of commands and checks every line.
fn read_command_log(path: &Path) -> Result<String, Exit> {
    let wrong = |reason: String| {
        Exit::config(
            format!("--commands {}: {reason}", path.display()),
            "give the commands.jsonl of a run of the same configuration",
        )
    };
    require_regular(path).map_err(wrong)?;
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    match control::actions(&text) {
        Ok(_) => Ok(text),
        Err((line, reason)) => Err(wrong(format!("line {line}: {reason}"))),
    }
}

/// Writes each log of commands to the directory in which `traffic-bridge` of that environment reads it.
fn write_command_logs(run_dir: &Path, logs: &[(u32, String)]) -> Result<(), Exit> {
    for (index, text) in logs {
        let directory = match index {
            0 => run_dir.to_owned(),
            index => run_dir.join(format!("env-{index}")),
        };
        let path = directory.join(control::COMMAND_REPLAY);
        std::fs::create_dir_all(&directory)
            .and_then(|()| storage::write_whole(&path, text))
            .map_err(|error| Exit::io("write", &path, &error))?;
    }
    Ok(())
}

/// A new run directory.
pub(crate) struct RunDirectory {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
}

/// Creates `runs/<name>`, which must not exist: the given name, or the label with the first free number.
fn create_run_dir(args: &RunArgs, label: &str) -> Result<RunDirectory, Exit> {
    let runs = std::path::absolute(&args.runs).map_err(|error| Exit::io("resolve", &args.runs, &error))?;
    std::fs::create_dir_all(&runs).map_err(|error| Exit::io("create", &runs, &error))?;
    if let Some(name) = &args.name {
        check_name(name)?;
        let path = runs.join(name);
        return match preparation_mark::create_marked(&path) {
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
        match preparation_mark::create_marked(&path) {
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

/// The maps of a run and their files, as the run file holds them.
struct MapInputs {
    source: Source,
    map: MapInfo,
    scene_files: SceneFiles,
    maps: Vec<RunMap>,
}

impl MapInputs {
    fn of_scenario(sumocfg: PathBuf, scenario: SumoScenario, map: MapInfo) -> Self {
        Self {
            source: Source::Scenario {
                sumocfg,
                own: scenario.own,
            },
            map,
            scene_files: SceneFiles {
                net_file: scenario.net_file,
                additional_files: scenario.additional_files,
            },
            maps: Vec::new(),
        }
    }

    fn of_maps(maps: Vec<RunMap>) -> Result<Self, Exit> {
        let map = maps::combine(&maps);
        let (Some(map), Some(first)) = (map, maps.first().cloned()) else {
            return Err(Exit::run("the run has no map", "name a map in curriculum.maps"));
        };
        Ok(Self {
            source: first.source,
            map,
            scene_files: first.scene_files,
            maps: if maps.len() > 1 { maps } else { Vec::new() },
        })
    }
}

/// Builds the maps, claims shared memory and assembles the run file.
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
    if let TrafficInput::Scenario(_, scenario) = &named {
        scenario.note_moved_outputs(&run_dir.path)?;
    }
    let inputs = match (named, scenario_map) {
        (TrafficInput::Scenario(sumocfg, scenario), Some(map)) => {
            MapInputs::of_scenario(sumocfg, scenario.beginning_at(config.traffic.begin_s), map)
        }
        _ => MapInputs::of_maps(maps::build(install, &config, &run_dir.path.join("map"))?)?,
    };
    let claim = RunClaim::new(&run_dir.path)?;
    let config_hash = config::hash(&config)?;
    let path = run_dir.path.join("config.toml");
    let text = format!("# BLAKE3 {config_hash}\n{}", config::to_toml(&config)?);
    storage::write_whole(&path, text).map_err(|error| Exit::io("write", &path, &error))?;
    let run = RunFile {
        schema_version: SCHEMA_VERSION,
        env_index: 0,
        run_id: claim.run_id,
        name: run_dir.name.clone(),
        run_dir: run_dir.path.clone(),
        mode,
        supervisor_pid: i32::try_from(std::process::id()).unwrap_or(0),
        shared_memory: claim.memory.clone(),
        source: inputs.source,
        map: inputs.map,
        scene_files: inputs.scene_files,
        maps: inputs.maps,
        sumo_home: install.sumo_home.clone(),
        config,
        config_hash,
        beginning: None,
        restart: None,
        replay: None,
    };
    reserve_shared_memory(&run)?;
    Ok((run, claim))
}

/// Refuses a run whose shared memory alone is more than a limit on memory leaves: the kernel would end one of its processes.
fn check_memory_limit(needed_bytes: u64, limit: Option<MemoryLimit>) -> Result<(), Exit> {
    match limit {
        Some(limit) if limit.free_bytes < needed_bytes => Err(Exit::missing(
            format!(
                "the limit on memory of this container or job ({} MiB) leaves {} MiB, but this run needs {} MiB of shared memory alone",
                limit.limit_bytes >> 20,
                limit.free_bytes >> 20,
                needed_bytes.div_ceil(1 << 20)
            ),
            "raise the limit (Docker: --memory, Slurm: --mem), or lower `traffic.max_road_users`, `run.window_ticks` or `run.envs`",
        )),
        _ => Ok(()),
    }
}

/// Reserves the shared memory of a run.
pub(crate) fn reserve_shared_memory(run: &RunFile) -> Result<(), Exit> {
    check_memory_limit(reserve::needed_bytes(run), MemoryGroups::own().tightest())?;
    let Err(error) = reserve::create(run) else {
        return Ok(());
    };
    let mut lidars = match run.config.lidar.vehicles {
        0 => String::new(),
        vehicles => format!(" or `lidar.vehicles` (now {vehicles})"),
    };
    if !run.config.suites.is_empty() {
        lidars.push_str(", or give `first` to each `[[suite]]`,");
    }
    let environments = match run.config.run.envs {
        1 => String::new(),
        envs => format!(" or `run.envs` (now {envs})"),
    };
    Err(error
        .failure()
        .with_help(format!(
            "lower `traffic.max_road_users` (now {}) or `run.window_ticks` (now {}){environments}{lidars}, or enlarge {} (Docker: --shm-size)",
            run.config.traffic.max_road_users,
            run.config.run.window_ticks,
            reserve::SHARED_MEMORY
        ))
        .into())
}

/// Free bytes of the file system that holds `path`.
///
/// # Errors
/// The file system cannot be queried.
pub fn free_bytes(path: &Path) -> Result<u64, Exit> {
    let stat = rustix::fs::statvfs(path).map_err(|error| Exit::io("query", path, &error.into()))?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}
