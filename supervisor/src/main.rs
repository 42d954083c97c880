//! The `caraware` command.

use std::process::ExitCode;

use caraware::{
    bench,
    cli::{Cli, Command},
    control,
    display::Display,
    doctor,
    failure::Exit,
    generate,
    prepare::{Prepared, prepare, prepare_play, prepare_resume},
    report, status,
    supervisor::Supervisor,
    swap,
    view::{self, Beside},
};
use clap::Parser as _;
use ipc_schema::run::Mode;

fn main() -> ExitCode {
    let cli = Cli::parse();
    let result = match cli.command {
        Command::Train(args) => match &args.resume {
            Some(resumed) => prepare_resume(&args.run, resumed).and_then(run),
            None => prepare(&args.run, Mode::Train).and_then(run),
        },
        Command::Play(args) => prepare_play(&args).and_then(run),
        Command::Simulate(args) => prepare(&args, Mode::Simulate).and_then(run),
        Command::Ps { run } => status::ps(run.as_deref()),
        Command::Swap(args) => swap::swap(&args),
        Command::Control(args) => control::control(&args),
        Command::Stop { run } => status::stop(run.as_deref()),
        Command::View(args) => view::view(&args),
        Command::Generate(args) => generate::generate(&args),
        Command::Bench { arguments } => bench::bench(&arguments),
        Command::Doctor { clean } => doctor::doctor(clean),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(exit) => exit.report(),
    }
}

fn run(prepared: Prepared) -> Result<(), Exit> {
    let (run, quiet) = (prepared.run.clone(), prepared.quiet);
    if !quiet {
        eprintln!("run {}: results go to {}", run.name, run.run_dir.display());
    }
    // Dropped, and so ended, after the run.
    let _viewer = prepared.viewer.map(|wanted| Beside::start(&run, &wanted)).transpose()?;
    let supervisor = Supervisor::new(prepared.run, prepared.install, prepared.claim)?;
    let outcome = supervisor.supervise(&mut if quiet { Display::silent() } else { Display::new() })?;
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
