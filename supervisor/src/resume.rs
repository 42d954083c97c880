//! `caraware train --resume`: continues a stopped run from a checkpoint.

use std::{
    ffi::OsStr,
    io::ErrorKind,
    os::unix::ffi::OsStrExt as _,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use ipc_schema::{
    SCHEMA_VERSION,
    config::Config,
    control::{self, Action, Command},
    episode_state,
    run::{Beginning, CURRICULUM_LOG, FORMER_CURRICULUM_LOG, Mode, RunFile, Start},
    storage,
};

use crate::{
    config::{self, LayeredSettings},
    environment::SIMULATORS,
    failure::Exit,
    install::Install,
    registry::{self, RunClaim},
};

/// Longest time in which the processes of a killed supervisor end: as long as a supervisor waits for them.
const FORMER_PROCESSES_END_WITHIN: Duration = Duration::from_secs(30);

/// Keys, or prefixes of keys, that a resumed run may change: no observation made so far depends on them.
const CHANGEABLE: [&str; 10] = [
    "trainer.",
    "fanout.",
    "run.journal_mib",
    "run.window_ticks",
    "run.real_time_factor",
    "run.stall_s",
    "run.on_stall",
    "run.ready_s",
    "episode.training_episodes",
    "episode.final_evaluations",
];

/// The configuration of a resumed run: that of the stopped run with the assignments `set`.
///
/// # Errors
/// A key or value is wrong, observations depend on a changed key, or the run cannot be resumed.
pub fn changed_config(run: &RunFile, set: &[String]) -> Result<Config, Exit> {
    if run.mode != Mode::Train {
        return Err(Exit::config(
            format!("{} cannot be resumed", run.name),
            "only a run of `caraware train` can be resumed",
        ));
    }
    let ranks = run.config.trainer.ranks;
    let started = std::env::var("WORLD_SIZE").ok().and_then(|size| size.parse().ok());
    if ranks > 1 && started != Some(ranks) {
        return Err(Exit::config(
            format!(
                "the trainer of {} learned together with others as one of {ranks} ranks",
                run.name
            ),
            format!("resume all ranks together: torchrun --nproc-per-node {ranks} -m caraware.parallel --resume RUN"),
        ));
    }
    check_changeable(set)?;
    Ok(LayeredSettings::of(&run.config)?.with_assignments(set)?.validate()?)
}

/// Checks that no observation depends on the settings that `set` changes.
///
/// # Errors
/// One does.
pub fn check_changeable(set: &[String]) -> Result<(), Exit> {
    for assignment in set {
        let key = assignment.split('=').next().unwrap_or_default().trim();
        let is_known = config::keys::KEYS.iter().any(|known| known.path == key);
        if is_known && !CHANGEABLE.iter().any(|part| key.starts_with(part)) {
            return Err(Exit::config(
                format!("`{key}` cannot change in a resumed run"),
                format!(
                    "observations depend on it. Keys that may change: {}",
                    CHANGEABLE.join(", ")
                ),
            ));
        }
    }
    Ok(())
}

/// Prepares a stopped run to continue in its own directory, from `beginning` or, without it, from tick 0.
///
/// # Errors
/// The run is alive, a file that it was made from does not exist any more, or its directory is not writable.
pub fn resume_in_place(
    beginning: Option<Beginning>,
    old: RunFile,
    config: Config,
    install: &Install,
) -> Result<(RunFile, RunClaim), Exit> {
    if registry::is_alive(&old.run_dir) {
        return Err(Exit::config(
            format!("the run {} is alive", old.name),
            format!(
                "`caraware stop {}` ends it; `caraware handover` replaces its trainer",
                old.name
            ),
        ));
    }
    wait_for_former_processes(&old)?;
    if let Some(missing) = sources(&old).into_iter().find(|file| !file.exists()) {
        return Err(Exit::config(
            format!(
                "the run was made from {}, which does not exist any more",
                missing.display()
            ),
            "restore the file, or start another run",
        ));
    }
    // The logs come first: the curriculum and the commands that were not carried out yet.
    let beginning = match beginning {
        Some(beginning) => Some(carry_over_logs(&old, &old.run_dir, beginning)?),
        None => {
            forget_all_decisions(&old)?;
            None
        }
    };
    let starts = beginning.iter().flat_map(|beginning| {
        let first = std::iter::once(&beginning.start);
        first.chain(&beginning.others).copied()
    });
    for (index, start) in (0..old.config.run.envs).zip(starts.chain(std::iter::repeat(Start::default()))) {
        let run_dir = old.environment(index).run_dir;
        remove_end_reports(&run_dir)?;
        for process in SIMULATORS {
            episode_state::forget_after(&run_dir, process, start.episode_tick)?;
        }
    }
    // The run gets a new part of shared memory, and its directory the new configuration.
    let claim = RunClaim::new(&old.run_dir)?;
    let config_hash = config::hash(&config)?;
    let path = old.run_dir.join("config.toml");
    let text = format!("# BLAKE3 {config_hash}\n{}", config::to_toml(&config)?);
    storage::write_whole(&path, text).map_err(|error| Exit::io("write", &path, &error))?;
    let run = RunFile {
        schema_version: SCHEMA_VERSION,
        run_id: claim.run_id,
        supervisor_pid: i32::try_from(std::process::id()).unwrap_or(0),
        shared_memory: claim.memory.clone(),
        sumo_home: install.sumo_home.clone(),
        config,
        config_hash,
        beginning,
        restart: None,
        ..old
    };
    Ok((run, claim))
}

/// Makes a run that begins again at tick 0 decide its curriculum again, and carry out all its commands again.
fn forget_all_decisions(old: &RunFile) -> Result<(), Exit> {
    let stages = old.run_dir.join(CURRICULUM_LOG);
    if stages.exists() {
        std::fs::remove_file(&stages).map_err(|error| Exit::io("remove", &stages, &error))?;
    }
    for index in 0..old.config.run.envs {
        let run_dir = old.environment(index).run_dir;
        repeat_commands(&run_dir, &run_dir, 0, Duration::ZERO)?;
    }
    Ok(())
}

/// Waits until the processes of a run whose supervisor was killed have ended: the trainer may still write a checkpoint.
fn wait_for_former_processes(old: &RunFile) -> Result<(), Exit> {
    let deadline = Instant::now() + FORMER_PROCESSES_END_WITHIN;
    loop {
        let pids = former_processes(old);
        if pids.is_empty() {
            return Ok(());
        }
        if Instant::now() > deadline {
            let within = FORMER_PROCESSES_END_WITHIN.as_secs();
            return Err(Exit::run(
                format!(
                    "processes of the run {} still live after {within} s: {}",
                    old.name,
                    pids.join(", ")
                ),
                "end these processes, and resume the run again",
            ));
        }
        std::thread::park_timeout(Duration::from_millis(50));
    }
}

/// Ids of the processes whose command lines name a run file of the run.
fn former_processes(old: &RunFile) -> Vec<String> {
    let directories: Vec<PathBuf> = (0..old.config.run.envs)
        .map(|index| old.environment(index).run_dir)
        .collect();
    let is_run_file = |argument: &[u8]| {
        let path = Path::new(OsStr::from_bytes(argument));
        let is_named = path
            .file_name()
            .is_some_and(|name| name == "run.json" || name == "run.next.json");
        is_named && directories.iter().any(|directory| path.parent() == Some(directory))
    };
    let entries = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = entries.filter_map(|entry| {
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let names_it = line.split(|byte| *byte == 0).any(is_run_file);
        names_it.then(|| entry.file_name().to_string_lossy().into_owned())
    });
    pids.collect()
}

/// Carries the logs of the run `old` over to the run in `run_dir`, which continues it from `beginning`.
///
/// `run_dir` gets the log of the curriculum. Commands from the first tick of the resumed episode on are carried out again; earlier
/// ones stay in the log of commands. The returned beginning counts the resets among the earlier ones.
///
/// # Errors
/// A log cannot be read or written.
pub fn carry_over_logs(old: &RunFile, run_dir: &Path, mut beginning: Beginning) -> Result<Beginning, Exit> {
    let former = old.run_dir.join(FORMER_CURRICULUM_LOG);
    if former.exists() {
        return Err(Exit::config(
            format!(
                "{} was written by another version of caraware, which used this name for {CURRICULUM_LOG}",
                former.display()
            ),
            "resume the run with the version that wrote it, or start another run",
        ));
    }
    // A trainer decides the curriculum of one environment. Several count their lessons, and need no log.
    let stages = old.run_dir.join(CURRICULUM_LOG);
    if stages.exists() && old.run_dir != run_dir {
        std::fs::read(&stages)
            .and_then(|log| storage::write_whole(&run_dir.join(CURRICULUM_LOG), log))
            .map_err(|error| Exit::io("copy", &stages, &error))?;
    }
    // Each environment has commands of its own.
    for index in 0..old.config.run.envs {
        let from = old.environment(index).run_dir;
        let to = match index {
            0 => run_dir.to_owned(),
            index => run_dir.join(format!("env-{index}")),
        };
        let start = match index {
            0 => Some(&mut beginning.start),
            index => beginning.others.get_mut(index as usize - 1),
        };
        let first_tick = start.as_ref().map_or(0, |start| start.episode_tick);
        let resets = repeat_commands(&from, &to, first_tick, Duration::ZERO)?;
        if let Some(start) = start {
            start.resets = resets;
        }
    }
    Ok(beginning)
}

/// Makes the commands of the run in `from` that came at or after `first_tick` those that the run in `to` replays. Returns the number of
/// episodes that earlier commands reset. Waits for at most `space_within` while the disk is full.
///
/// # Errors
/// A log cannot be read or written.
pub fn repeat_commands(from: &Path, to: &Path, first_tick: u64, space_within: Duration) -> Result<u64, Exit> {
    let (done, due): (Vec<Action>, Vec<Action>) =
        commands(from)?.into_iter().partition(|action| action.tick < first_tick);
    // The replay is written first: if the program is killed between the two writes, no command is lost.
    write_commands(&to.join(control::COMMAND_REPLAY), &due, space_within)?;
    write_commands(&to.join(control::COMMAND_LOG), &done, space_within)?;
    let resets = done.iter().filter(|action| matches!(action.control, Command::Reset {}));
    Ok(resets.count() as u64)
}

/// The commands that the run in `run_dir` has carried out, followed by those of its replay that were still due.
fn commands(run_dir: &Path) -> Result<Vec<Action>, Exit> {
    let read = |name: &str| {
        let path = run_dir.join(name);
        let wrong = |reason: String| {
            Exit::run(
                format!("cannot read the commands in {}: {reason}", path.display()),
                "correct the file; the resumed run ignores commands whose lines are removed",
            )
        };
        match std::fs::read_to_string(&path) {
            Ok(text) => control::actions(&text).map_err(|(line, reason)| wrong(format!("line {line}: {reason}"))),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(Vec::new()),
            Err(error) if error.kind() == ErrorKind::InvalidData => Err(wrong(error.to_string())),
            Err(error) => Err(Exit::io("read", &path, &error)),
        }
    };
    let mut actions = read(control::COMMAND_LOG)?;
    let last_tick = actions.last().map(|action| action.tick);
    let due = read(control::COMMAND_REPLAY)?;
    actions.extend(
        due.into_iter()
            .filter(|action| last_tick.is_none_or(|last| action.tick > last)),
    );
    Ok(actions)
}

/// Writes a log with these commands. Without commands it removes the file.
fn write_commands(path: &Path, actions: &[Action], space_within: Duration) -> Result<(), Exit> {
    if actions.is_empty() {
        return match std::fs::remove_file(path) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(Exit::io("remove", path, &error)),
            _ => Ok(()),
        };
    }
    let failed = |error: std::io::Error| Exit::io("write", path, &error);
    let mut lines = String::new();
    for action in actions {
        lines += &serde_json::to_string(action).map_err(|error| failed(error.into()))?;
        lines += "\n";
    }
    let directory = path.parent().unwrap_or(path);
    storage::wait_for_space(path, space_within, || {
        std::fs::create_dir_all(directory)?;
        storage::write_whole(path, &lines)
    })
    .map_err(failed)
}

/// The files that the run's traffic comes from.
fn sources(run: &RunFile) -> Vec<&Path> {
    use ipc_schema::run::Source;
    match &run.source {
        Source::Scenario { sumocfg, .. } => vec![sumocfg],
        Source::Population {
            net_file,
            additional_files,
        } => std::iter::once(net_file)
            .chain(additional_files)
            .map(PathBuf::as_path)
            .collect(),
    }
}

/// Removes the files that a run writes at its end: its failures, the parts of its report, and the report, of whose counters
/// [`EARLIER_STARTS`] keeps those that begin at zero with each start.
fn remove_end_reports(run_dir: &Path) -> Result<(), Exit> {
    keep_counters(run_dir)?;
    let files = |folder: &str, end: &'static str| {
        let entries = std::fs::read_dir(run_dir.join(folder)).into_iter().flatten().flatten();
        entries
            .map(|entry| entry.path())
            .filter(move |path| path.to_string_lossy().ends_with(end))
    };
    let ends = files("logs", ".error.json").chain(files("parts", ".json"));
    for file in ends.chain([run_dir.join("report.json")]).filter(|file| file.exists()) {
        std::fs::remove_file(&file).map_err(|error| Exit::io("remove", &file, &error))?;
    }
    Ok(())
}

/// The log of a run's earlier starts, each of which a later one has resumed: what their reports have counted.
pub const EARLIER_STARTS: &str = "earlier_starts.jsonl";
/// Keys of `report.json` that count from the start of the program, where others count from the beginning of the run.
const OF_ONE_START: [&str; 11] = [
    "result",
    "failure",
    "wall_s",
    "ticks",
    "restarts",
    "handovers",
    "drops",
    "redelivered_ticks",
    "journal_mib",
    "disk_full",
    "shortened_logs",
];

/// Adds the counters of `report.json`, if there is one, to [`EARLIER_STARTS`].
fn keep_counters(run_dir: &Path) -> Result<(), Exit> {
    let report = run_dir.join("report.json");
    let Ok(text) = std::fs::read(&report) else {
        return Ok(());
    };
    let path = run_dir.join(EARLIER_STARTS);
    let failed = |error: std::io::Error| Exit::io("write", &path, &error);
    // A damaged report has no counters.
    let Ok(mut counters) = serde_json::from_slice::<serde_json::Map<String, serde_json::Value>>(&text) else {
        return Ok(());
    };
    counters.retain(|key, _| OF_ONE_START.contains(&key.as_str()));
    let line = serde_json::to_string(&counters).map_err(|error| failed(error.into()))? + "\n";
    let mut starts = match std::fs::read_to_string(&path) {
        Err(error) if error.kind() != ErrorKind::NotFound => return Err(failed(error)),
        starts => starts.unwrap_or_default(),
    };
    // A resumption that was killed before it had removed the report has added its counters already.
    if !starts.ends_with(&line) {
        starts += &line;
        storage::write_whole(&path, starts).map_err(failed)?;
    }
    Ok(())
}

/// The counters of earlier starts, the oldest first. A start whose supervisor was killed has none.
#[must_use]
pub fn earlier_starts(run_dir: &Path) -> Vec<serde_json::Value> {
    let text = std::fs::read_to_string(run_dir.join(EARLIER_STARTS)).unwrap_or_default();
    text.lines()
        .filter_map(|line| serde_json::from_str(line).ok())
        .collect()
}
