//! `caraware train --resume`: a run that was stopped goes on from a checkpoint.

use std::path::Path;

use ipc_schema::{
    SCHEMA_VERSION,
    config::Config,
    control,
    run::{Mode, RunFile},
};

use crate::{
    checkpoint::Found,
    config::{self, Settings},
    failure::Exit,
    install::Install,
    registry::{self, Claim},
};

/// What may differ, because no observation that has been made depends on it.
const CHANGEABLE: [&str; 7] = [
    "trainer.",
    "fanout.",
    "run.journal_mib",
    "run.window_ticks",
    "run.real_time_factor",
    "episode.training_episodes",
    "episode.final_evaluations",
];

/// The configuration of a run to be resumed, with other settings.
///
/// # Errors
/// A key or value is wrong, or observations depend on it, or the run cannot be resumed.
pub fn changed(run: &RunFile, set: &[String]) -> Result<Config, Exit> {
    if run.mode != Mode::Train || run.config.drives() {
        return Err(Exit::config(
            format!("{} cannot be resumed", run.name),
            "only a run of `caraware train` that learns to localise goes on from a checkpoint",
        ));
    }
    if run.config.run.envs > 1 || run.config.trainer.ranks > 1 {
        return Err(Exit::config(
            format!(
                "{} has several environments or trainers, and cannot be resumed",
                run.name
            ),
            "only a run of one environment and one trainer goes on from a checkpoint",
        ));
    }
    if !run.config.curriculum.steps.is_empty() {
        return Err(Exit::config(
            format!("{} follows a curriculum, and cannot be resumed", run.name),
            "where its lessons begin is known while it runs; start another run",
        ));
    }
    if run.run_dir.join(control::COMMAND_LOG).exists() {
        return Err(Exit::config(
            format!(
                "{} was given commands ({}), and cannot be resumed",
                run.name,
                control::COMMAND_LOG
            ),
            "its episodes are not those of its configuration any more; make it again with --commands, or start another run",
        ));
    }
    for assignment in set {
        let key = assignment.split('=').next().unwrap_or_default().trim();
        let is_known = config::keys::KEYS.iter().any(|known| known.path == key);
        if is_known && !CHANGEABLE.iter().any(|part| key.starts_with(part)) {
            return Err(Exit::config(
                format!("`{key}` cannot change in a run that goes on"),
                format!("observations depend on it. What may differ: {}", CHANGEABLE.join(", ")),
            ));
        }
    }
    Ok(Settings::of(&run.config)?.with_assignments(set)?.validate()?)
}

/// The run goes on in its own directory.
///
/// # Errors
/// It is alive, what it was made from has gone, or its directory is not writable.
pub fn go_on(found: &Found, old: RunFile, config: Config, install: &Install) -> Result<(RunFile, Claim), Exit> {
    if registry::is_alive(&old.run_dir) {
        return Err(Exit::config(
            format!("the run {} is alive", old.name),
            format!(
                "`caraware stop {}` ends it; `caraware swap` replaces its trainer",
                old.name
            ),
        ));
    }
    if let Some(gone) = sources(&old).into_iter().find(|file| !file.exists()) {
        return Err(Exit::config(
            format!("the run was made from {}, which is not there any more", gone.display()),
            "put it back, or start another run",
        ));
    }
    forget_the_end(&old.run_dir)?;
    let claim = Claim::new(&old.run_dir)?;
    let config_hash = config::hash(&config);
    let path = old.run_dir.join("config.toml");
    std::fs::write(&path, format!("# BLAKE3 {config_hash}\n{}", config::to_toml(&config)))
        .map_err(|error| Exit::io("write", &path, &error))?;
    let run = RunFile {
        schema_version: SCHEMA_VERSION,
        run_id: claim.run_id,
        supervisor_pid: i32::try_from(std::process::id()).unwrap_or(0),
        shared_memory: claim.memory.clone(),
        sumo_home: install.sumo_home.clone(),
        config,
        config_hash,
        beginning: Some(found.beginning()),
        ..old
    };
    Ok((run, claim))
}

fn sources(run: &RunFile) -> Vec<&Path> {
    use ipc_schema::run::Source;
    match &run.source {
        Source::Scenario { sumocfg } => vec![sumocfg],
        Source::Population {
            net_file,
            additional_files,
        } => std::iter::once(net_file)
            .chain(additional_files)
            .map(std::path::PathBuf::as_path)
            .collect(),
    }
}

/// Removes what told how the run had ended: it has not.
fn forget_the_end(run_dir: &Path) -> Result<(), Exit> {
    let files = |folder: &str, end: &'static str| {
        let entries = std::fs::read_dir(run_dir.join(folder)).into_iter().flatten().flatten();
        entries
            .map(|entry| entry.path())
            .filter(move |path| path.to_string_lossy().ends_with(end))
    };
    let told = files("logs", ".error.json").chain(files("parts", ".json"));
    for file in told.chain([run_dir.join("report.json")]).filter(|file| file.exists()) {
        std::fs::remove_file(&file).map_err(|error| Exit::io("remove", &file, &error))?;
    }
    Ok(())
}
