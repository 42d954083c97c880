//! `caraware replay`: prepares a run in which a recording takes the place of the simulators.

use ipc_schema::{
    SCHEMA_VERSION,
    channel::Channel,
    config::Config,
    run::{Mode, Replay, RunFile},
    storage,
};
use recorder::{
    file::{RecordingError, reader::RecordingReader},
    run_logs::{CHART, RUN_FILE},
};

use crate::{
    cli::{ReplayArgs, RunArgs},
    config::{self, LayeredSettings},
    failure::Exit,
    install::Install,
    prepare::{PreparedRun, RunDirectory, prepare_in_new_directory, reserve_shared_memory},
    record::recording_path,
    registry::RunClaim,
    remote, resume, system_limits,
    view::ViewerRequest,
};

/// Checks a recording and prepares its replay, to viewers or to a trainer.
///
/// # Errors
/// The recording cannot be read, another version wrote it, or a setting cannot change.
pub fn prepare_replay(args: &ReplayArgs) -> Result<PreparedRun, Exit> {
    let install = Install::find()?;
    let file = std::path::absolute(recording_path(&args.recording, &args.runs))
        .map_err(|error| Exit::io("resolve", &args.recording, &error))?;
    let recording = RecordingReader::open(&file)?;
    let old = recorded_run(&recording)?;
    let mode = if args.learn { Mode::Train } else { Mode::Simulate };
    resume::check_changeable(&args.set)?;
    let speed = args.speed.unwrap_or(if args.learn { 0.0 } else { 1.0 });
    let mut set = vec!["record.manner=off".to_owned(), format!("run.real_time_factor={speed}")];
    if !args.learn {
        set.push("fanout.enabled=true".to_owned());
    }
    set.extend(args.set.iter().cloned());
    let mut config = LayeredSettings::of(&old.config)?.with_assignments(&set)?.validate()?;
    if args.learn && config.v2x.is_on() && !holds(&recording, Channel::Neighbours) {
        return Err(Exit::config(
            format!(
                "{} has no channel `neighbours`, which a trainer of a run with messages (`v2x.share`) needs",
                recording.path().display()
            ),
            "replay it without --learn, or record a run whose `record.channels` lists it",
        ));
    }
    system_limits::check_open_files(config.run.envs)?;
    remote::check(&mut config.fanout)?;
    let run_args = RunArgs {
        name: args.name.clone(),
        runs: args.runs.clone(),
        viewer: args.viewer,
        credentials: args.credentials.clone(),
        quiet: args.quiet,
        ..RunArgs::default()
    };
    let viewer = ViewerRequest::of(&run_args, &config.fanout)?;
    let label = format!("{}-replay", old.name);
    prepare_in_new_directory(&run_args, &label, install, viewer, |run_dir, install| {
        assemble(args, mode, run_dir, config, old, &recording, install)
    })
}

/// Fills the directory of a run that replays `recording`, the one of the run `old`, and claims its shared memory.
fn assemble(
    args: &ReplayArgs,
    mode: Mode,
    run_dir: &RunDirectory,
    config: Config,
    old: RunFile,
    recording: &RecordingReader,
    install: &Install,
) -> Result<(RunFile, RunClaim), Exit> {
    for part in ["logs", "parts", "map"] {
        let path = run_dir.path.join(part);
        std::fs::create_dir(&path).map_err(|error| Exit::io("create", &path, &error))?;
    }
    let claim = RunClaim::new(&run_dir.path)?;
    let config_hash = config::hash(&config)?;
    let path = run_dir.path.join("config.toml");
    let text = format!("# BLAKE3 {config_hash}\n{}", config::to_toml(&config)?);
    storage::write_whole(&path, text).map_err(|error| Exit::io("write", &path, &error))?;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the command line takes no negative time"
    )]
    let from_tick = (args.from_s / config.run.tick_s).round() as u64;
    let run = RunFile {
        schema_version: SCHEMA_VERSION,
        env_index: 0,
        run_id: claim.run_id,
        name: run_dir.name.clone(),
        run_dir: run_dir.path.clone(),
        mode,
        supervisor_pid: i32::try_from(std::process::id()).unwrap_or(0),
        shared_memory: claim.memory.clone(),
        sumo_home: install.sumo_home.clone(),
        config,
        config_hash,
        beginning: None,
        restart: None,
        replay: Some(Replay {
            file: recording.path().to_owned(),
            from_tick,
        }),
        ..old
    };
    if let Some(chart) = recording.attachment(CHART) {
        let path = run.chart_path();
        storage::write_whole(&path, chart).map_err(|error| Exit::io("write", &path, &error))?;
    }
    reserve_shared_memory(&run)?;
    Ok((run, claim))
}

/// True if the recording has a message of a channel; what is damaged is reported when it is played.
fn holds(recording: &RecordingReader, channel: Channel) -> bool {
    let mut readable = recording.channel_messages().map_while(Result::ok);
    readable.any(|message| message.channel == channel)
}

/// The run file of the recorded run.
fn recorded_run(recording: &RecordingReader) -> Result<RunFile, Exit> {
    let damaged = |reason: String| {
        Exit::from(RecordingError::Foreign {
            path: recording.path().into(),
            offset: 0,
            reason,
        })
    };
    let text = recording.attachment(RUN_FILE);
    let text = text.ok_or_else(|| damaged(format!("it has no {RUN_FILE}")))?;
    serde_json::from_slice(text).map_err(|error| damaged(format!("{RUN_FILE}: {error}")))
}
