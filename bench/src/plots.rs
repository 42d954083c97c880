//! Draws a report's curves as pictures with the project's Python, like the trainer's plots.

use std::{
    path::Path,
    process::{Command, Stdio},
};

use caraware::failure::Exit;

use super::BenchReport;

/// Draws every curve of `reports` into `directory`.
///
/// # Errors
/// The directory is not writable, or Python fails.
pub fn draw(python: &Path, reports: &[BenchReport], directory: &Path) -> Result<(), Exit> {
    std::fs::create_dir_all(directory).map_err(|error| Exit::io("create", directory, &error))?;
    let failed = |error: &std::io::Error| Exit::io("start", python, error);
    let mut process = Command::new(python)
        .args(["-m", "caraware_bench.plots"])
        .arg(directory)
        .stdin(Stdio::piped())
        .spawn()
        .map_err(|error| failed(&error))?;
    if let Some(mut input) = process.stdin.take() {
        serde_json::to_writer(&mut input, reports).map_err(|error| failed(&error.into()))?;
    }
    let status = process.wait().map_err(|error| failed(&error))?;
    if status.success() {
        return Ok(());
    }
    Err(Exit::run(
        format!("drawing the plots ended with {status}"),
        "its message is above",
    ))
}
