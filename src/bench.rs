//! `caraware bench`: measures a part of caraware on this machine, side by side with what others use for the same work.

use std::process::Command;

use crate::{
    cli::{BenchArgs, Part},
    failure::Exit,
    install,
};

/// The program that measures a part.
fn program(part: Part) -> &'static str {
    match part {
        Part::Lidar => "lidar-bench",
    }
}

/// Runs the measurement; it prints its own table.
///
/// # Errors
/// The program is not built, or fails.
pub fn bench(args: &BenchArgs) -> Result<(), Exit> {
    let bin = install::programs()?;
    let path = bin.join(program(args.part));
    if !path.is_file() {
        return Err(Exit::missing(
            format!("the program {} is not there", path.display()),
            "run `make build`",
        ));
    }
    let mut command = Command::new(&path);
    // The peers are Python packages that nothing else needs: without a Python, ours is measured alone.
    if let Some(python) = args.python.clone().or_else(|| install::python(&bin).ok()) {
        command.arg("--python").arg(python);
    }
    if let Some(json) = &args.json {
        command.arg("--json").arg(json);
    }
    let status = command.status().map_err(|error| Exit::io("start", &path, &error))?;
    if status.success() {
        return Ok(());
    }
    Err(Exit::run(
        format!("{} ended with {status}", path.display()),
        "its message above says why",
    ))
}
