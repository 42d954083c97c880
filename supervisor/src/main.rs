//! The `caraware` command.

use std::process::ExitCode;

use caraware::{
    bench, catalogue,
    cli::{Cli, Subcommands},
    compare, control,
    display::{self, ProgressDisplay},
    doctor,
    failure::Exit,
    generate, handover,
    housekeeping::Housekeeping,
    import, metrics, panel,
    prepare::{PreparedRun, prepare, prepare_play, prepare_resume},
    record, relaunch, replay, report, status,
    supervisor::{RunEnding, RunOutcome, Supervisor},
    system_limits,
    view::{self, ViewerProcess},
};
use clap::Parser as _;
use ipc_schema::run::Mode;

fn main() -> ExitCode {
    let cli = Cli::parse();
    ipc_schema::process_main::show_warnings();
    system_limits::raise_open_files();
    system_limits::protect_files();
    let result = match cli.command {
        Subcommands::Train(args) if args.restart => match relaunch::train(&args) {
            Ok(code) => return code,
            Err(exit) => Err(exit),
        },
        Subcommands::Train(args) => match &args.resume {
            Some(resumed) => prepare_resume(&args.run, resumed).and_then(run),
            None => prepare(&args.run, Mode::Train).and_then(run),
        },
        Subcommands::Play(args) => prepare_play(&args).and_then(run),
        Subcommands::Simulate(args) => prepare(&args, Mode::Simulate).and_then(run),
        Subcommands::Ps { run, json } => status::ps(run.as_deref(), json),
        Subcommands::Metrics(args) => metrics::metrics(&args),
        Subcommands::Report { arguments } => bench::report(&arguments),
        Subcommands::Handover(args) => handover::request::handover(&args),
        Subcommands::Swap { .. } => handover::request::refuse_former_name(),
        Subcommands::Control(args) => control::control(&args),
        Subcommands::Stop { run } => status::stop(run.as_deref()),
        Subcommands::View(args) => view::view(&args),
        Subcommands::Panel(args) => panel::panel(&args),
        Subcommands::Keys { prefix, json } => catalogue::keys(prefix.as_deref(), json),
        Subcommands::Compare(args) => compare::compare(&args),
        Subcommands::Record(args) => record::record(&args),
        Subcommands::Diff(args) => record::diff(&args),
        Subcommands::Export(args) => record::export(&args),
        Subcommands::Replay(args) => replay::prepare_replay(&args).and_then(run),
        Subcommands::Generate(args) => generate::generate(&args),
        Subcommands::Import(args) => import::import(&args),
        Subcommands::Bench { arguments } => bench::bench(&arguments),
        Subcommands::Reproduce { arguments } => bench::reproduce(&arguments),
        Subcommands::Study { arguments } => bench::study(&arguments),
        Subcommands::Doctor { clean } => doctor::doctor(clean),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(exit) => exit.report(),
    }
}

fn run(prepared: PreparedRun) -> Result<(), Exit> {
    let (run, quiet) = (prepared.run.clone(), prepared.quiet);
    if !quiet {
        display::notice(&format!("run {}: results go to {}", run.name, run.run_dir.display()));
    }
    // The viewer is dropped, and so ended, after the run.
    let _viewer = prepared
        .viewer
        .map(|request| ViewerProcess::start(&run, &request))
        .transpose()?;
    let mut display = match quiet {
        true => ProgressDisplay::silent(),
        false => ProgressDisplay::new(),
    };
    let housekeeping = Housekeeping::start(&run);
    let outcome = match Supervisor::new(&prepared.run, prepared.install, prepared.claim, prepared.interruption) {
        Ok(supervisor) => supervisor.supervise(&mut display),
        Err(exit) => RunOutcome::not_started(exit),
    };
    handover::phases::remove_successor_run_file(&run);
    // Whatever ended the run, its report says so.
    let written = report::write(&run, &outcome, &housekeeping.finish());
    if let Ok(report) = &written
        && !quiet
    {
        display::print(&report.summary());
    }
    match outcome.ending {
        RunEnding::Completed => written?.check_complete(),
        RunEnding::Interrupted => Err(Exit::Interrupted),
        RunEnding::Failed(exit) => Err(exit),
    }
}
