//! The `caraware` command.

use std::process::ExitCode;

use caraware::{
    bench,
    cli::{Cli, Subcommands},
    control,
    display::ProgressDisplay,
    doctor,
    failure::Exit,
    generate, handover,
    prepare::{PreparedRun, prepare, prepare_play, prepare_resume},
    report, status,
    supervisor::Supervisor,
    view::{self, ViewerProcess},
};
use clap::Parser as _;
use ipc_schema::run::Mode;

fn main() -> ExitCode {
    let cli = Cli::parse();
    let result = match cli.command {
        Subcommands::Train(args) => match &args.resume {
            Some(resumed) => prepare_resume(&args.run, resumed).and_then(run),
            None => prepare(&args.run, Mode::Train).and_then(run),
        },
        Subcommands::Play(args) => prepare_play(&args).and_then(run),
        Subcommands::Simulate(args) => prepare(&args, Mode::Simulate).and_then(run),
        Subcommands::Ps { run } => status::ps(run.as_deref()),
        Subcommands::Handover(args) => handover::request::handover(&args),
        Subcommands::Swap { .. } => handover::request::refuse_former_name(),
        Subcommands::Control(args) => control::control(&args),
        Subcommands::Stop { run } => status::stop(run.as_deref()),
        Subcommands::View(args) => view::view(&args),
        Subcommands::Generate(args) => generate::generate(&args),
        Subcommands::Bench { arguments } => bench::bench(&arguments),
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
        eprintln!("run {}: results go to {}", run.name, run.run_dir.display());
    }
    // Dropped, and so ended, after the run.
    let _viewer = prepared
        .viewer
        .map(|wanted| ViewerProcess::start(&run, &wanted))
        .transpose()?;
    let supervisor = Supervisor::new(&prepared.run, prepared.install, prepared.claim)?;
    let outcome = supervisor.supervise(&mut if quiet {
        ProgressDisplay::silent()
    } else {
        ProgressDisplay::new()
    })?;
    let (report, path) = report::write(&run, &outcome)?;
    if !quiet {
        println!("{}", report::summary(&report, &path));
    }
    if outcome.interrupted {
        Err(Exit::Interrupted)
    } else {
        Ok(())
    }
}
