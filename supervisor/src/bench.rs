//! `caraware bench`: starts the program `caraware-bench`, which lies beside this one.

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
