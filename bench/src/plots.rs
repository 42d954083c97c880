//! Draws a report's curves as pictures with the project's Python, like the trainer's plots.

use std::{
    io::Write as _,
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
        let text = serde_json::to_string(reports).unwrap_or_default();
        input.write_all(text.as_bytes()).map_err(|error| failed(&error))?;
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
