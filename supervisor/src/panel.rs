//! `caraware panel`: starts the Python server of the panel, which runs this program for each of its actions.

use std::ffi::OsString;

use crate::{cli::PanelArgs, failure::Exit, install, view};

/// Serves the panel until Ctrl-C: this process becomes the server.
///
/// # Errors
/// The viewer is not installed, or the system cannot start it.
pub fn panel(args: &PanelArgs) -> Result<(), Exit> {
    view::check_installed(&install::python(&install::programs()?)?)?;
    let mut arguments: Vec<OsString> = vec!["--runs".into(), args.runs.clone().into()];
    arguments.extend(args.port.map(|port| format!("--port={port}").into()));
    install::become_module("caraware_viewer.panel", arguments)
}
