//! `caraware bench`, `caraware reproduce`, `caraware study` and `caraware report`: start the program `caraware-bench`, which lies beside
//! this one, and modules of Python.

use std::{ffi::OsString, os::unix::process::CommandExt as _, process::Command};

use crate::{failure::Exit, install};

/// Replaces this process by `caraware-bench` with the same arguments; returns only if that fails.
///
/// # Errors
/// The program has not been built, or the system cannot start it.
pub fn bench(arguments: &[OsString]) -> Result<(), Exit> {
    let program = install::program(&install::programs()?, "caraware-bench")?;
    let error = Command::new(&program).args(arguments).exec();
    Err(Exit::io("start", &program, &error))
}

/// Replaces this process by the study that measures a table of the docs again; returns only if that fails.
///
/// # Errors
/// The Python environment is missing, or the system cannot start it.
pub fn reproduce(arguments: &[OsString]) -> Result<(), Exit> {
    install::become_module("caraware.study.reproduce", arguments)
}

/// Replaces this process by the search for the best values of keys; returns only if that fails.
///
/// # Errors
/// The Python environment is missing, or the system cannot start it.
pub fn study(arguments: &[OsString]) -> Result<(), Exit> {
    install::become_module("caraware.trials", arguments)
}

/// Replaces this process by the program that writes what runs have reached; returns only if that fails.
///
/// # Errors
/// The Python environment is missing, or the system cannot start it.
pub fn report(arguments: &[OsString]) -> Result<(), Exit> {
    install::become_module("caraware.report.document", arguments)
}
