//! The `caraware` command.

use std::process::ExitCode;

use caraware::{
    bench,
    cli::{Cli, Command, RunArgs},
    display::Display,
    doctor,
    failure::Exit,
    prepare::prepare,
    report, status,
    supervisor::Supervisor,
    swap,
};
use clap::Parser as _;
use ipc_schema::run::Mode;

fn main() -> ExitCode {
    let cli = Cli::parse();
    let result = match cli.command {
        Command::Train(args) => run(&args, Mode::Train),
        Command::Simulate(args) => run(&args, Mode::Simulate),
        Command::Ps { run } => status::ps(run.as_deref()),
        Command::Swap(args) => swap::swap(&args),
        Command::Stop { run } => status::stop(run.as_deref()),
        Command::Bench(args) => bench::bench(&args),
        Command::Doctor { clean } => doctor::doctor(clean),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(exit) => exit.report(),
    }
}

fn run(args: &RunArgs, mode: Mode) -> Result<(), Exit> {
    let prepared = prepare(args, mode)?;
    let run = prepared.run.clone();
    if !args.quiet {
        eprintln!("run {}: results go to {}", run.name, run.run_dir.display());
    }
    let supervisor = Supervisor::new(prepared.run, prepared.install, prepared.claim)?;
    let outcome = supervisor.supervise(&mut if args.quiet { Display::silent() } else { Display::new() })?;
    let (report, path) = report::write(&run, &outcome)?;
    if !args.quiet {
        println!("{}", report::summary(&report, &path));
    }
    if outcome.interrupted {
        Err(Exit::Interrupted)
    } else {
        Ok(())
    }
}
