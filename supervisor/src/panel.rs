//! `caraware panel`: starts the Python server of the panel, which runs this program for each of its actions.

use std::{os::unix::process::CommandExt as _, path::Path, process::Command};

use crate::{cli::PanelArgs, failure::Exit, install, view};

/// The server's Python module.
const MODULE: &str = "caraware_viewer.panel";

/// Serves the panel until Ctrl-C: this process becomes the server.
///
/// # Errors
/// The viewer is not installed, or the system cannot start it.
pub fn panel(args: &PanelArgs) -> Result<(), Exit> {
    let python = install::python(&install::programs()?)?;
    view::check_installed(&python)?;
    let program = std::env::current_exe().map_err(|error| Exit::io("find", Path::new("caraware"), &error))?;
    let error = Command::new(&python)
        .args(["-m", MODULE])
        .args(args.port.map(|port| format!("--port={port}")))
        .arg("--runs")
        .arg(&args.runs)
        .env("CARAWARE", program)
        .exec();
    Err(Exit::io("start", &python, &error))
}
