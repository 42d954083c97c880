//! Finds the installed parts of caraware: the programs, the Python environment, and SUMO.

use std::{
    ffi::OsStr,
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::Command,
};

use crate::failure::Exit;

/// The virtual environment of `make peers`, which holds most peers of the benchmarks.
pub const PEERS: &str = ".venv-peers";

/// Paths of the installed parts.
#[derive(Debug, Clone)]
pub struct Install {
    /// Directory of the process binaries.
    pub bin: PathBuf,
    /// Python of the project's virtual environment.
    pub python: PathBuf,
    /// The `sumo` directory of the `eclipse-sumo` wheel.
    pub sumo_home: PathBuf,
}

impl Install {
    /// Finds the parts beside the running program. `CARAWARE_PYTHON` and `CARAWARE_SUMO_HOME` have precedence.
    ///
    /// # Errors
    /// A part is missing; the failure names it and the command that installs it.
    pub fn find() -> Result<Self, Exit> {
        let bin = programs()?;
        let python = python(&bin)?;
        let sumo_home = sumo_home(&bin, &python)?;
        Ok(Self { bin, python, sumo_home })
    }

    /// Path of a process's program.
    ///
    /// # Errors
    /// It has not been built.
    pub fn binary(&self, name: &str) -> Result<PathBuf, Exit> {
        program(&self.bin, name)
    }

    /// A program of the SUMO wheel ("sumo", "netconvert").
    #[must_use]
    pub fn sumo_program(&self, name: &str) -> PathBuf {
        self.sumo_home.join("bin").join(name)
    }
}

/// Directory of the programs, which is that of the running program.
///
/// # Errors
/// The path of the running program cannot be read.
pub fn programs() -> Result<PathBuf, Exit> {
    let executable = std::env::current_exe().map_err(|error| {
        Exit::missing(
            format!("cannot find the running program: {error}"),
            "start caraware by its path",
        )
    })?;
    let bin = executable.parent().map(Path::to_path_buf).unwrap_or_default();
    // Test binaries lie one level below the programs.
    Ok(if bin.ends_with("deps") {
        bin.parent().map(Path::to_path_buf).unwrap_or_default()
    } else {
        bin
    })
}

/// Path of one of caraware's programs in `bin`.
///
/// # Errors
/// It has not been built.
pub fn program(bin: &Path, name: &str) -> Result<PathBuf, Exit> {
    let path = bin.join(name);
    if path.is_file() {
        return Ok(path);
    }
    Err(Exit::missing(
        format!("the program {} does not exist", path.display()),
        "run `make build`",
    ))
}

/// Python of another virtual environment beside the project's own: [`PEERS`], or that of one peer. `None` if it does not exist.
#[must_use]
pub fn environment_python(bin: &Path, environment: &str) -> Option<PathBuf> {
    bin.ancestors()
        .map(|directory| directory.join(environment).join("bin/python"))
        .find(|path| path.exists())
}

/// Replaces this process by a module of the Python environment, which finds this program in `CARAWARE`; returns only if that fails.
///
/// # Errors
/// The Python environment is missing, or the system cannot start it.
pub fn become_module(name: &str, arguments: impl IntoIterator<Item = impl AsRef<OsStr>>) -> Result<(), Exit> {
    let python = python(&programs()?)?;
    let program = std::env::current_exe().map_err(|error| Exit::io("find", Path::new("caraware"), &error))?;
    let error = Command::new(&python)
        .args(["-m", name])
        .args(arguments)
        .env("CARAWARE", program)
        .exec();
    Err(Exit::io("start", &python, &error))
}

/// Python of the project's virtual environment or of the one that the programs are in, or the one that `CARAWARE_PYTHON` names.
///
/// # Errors
/// There is none.
pub fn python(bin: &Path) -> Result<PathBuf, Exit> {
    if let Some(path) = std::env::var_os("CARAWARE_PYTHON").filter(|path| !path.is_empty()) {
        return Ok(path.into());
    }
    // A wheel puts the programs into its environment. The command that it installs also sets `CARAWARE_PYTHON`.
    let is_environment = |directory: &&Path| directory.join("pyvenv.cfg").is_file();
    let own = bin
        .ancestors()
        .find(is_environment)
        .map(|directory| directory.join("bin/python"));
    own.into_iter()
        .chain(bin.ancestors().map(|directory| directory.join(".venv/bin/python")))
        .find(|path| path.exists())
        .ok_or_else(|| {
            Exit::missing(
                "the Python environment .venv does not exist",
                "run `make build`, or set CARAWARE_PYTHON to a Python that has caraware installed",
            )
        })
}

fn sumo_home(bin: &Path, python: &Path) -> Result<PathBuf, Exit> {
    if let Some(path) = std::env::var_os("CARAWARE_SUMO_HOME").filter(|path| !path.is_empty()) {
        return Ok(path.into());
    }
    // The programs of an installed wheel are in `caraware/programs`, beside the packages that it asks for.
    let beside = bin
        .parent()
        .and_then(Path::parent)
        .map(|packages| packages.join("sumo"));
    if let Some(home) = beside.filter(|home| home.join("bin/sumo").is_file()) {
        return Ok(home);
    }
    let library = python
        .parent()
        .and_then(Path::parent)
        .map(|venv| venv.join("lib"))
        .unwrap_or_default();
    std::fs::read_dir(&library)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path().join("site-packages/sumo"))
        .find(|home| home.join("bin/sumo").is_file())
        .ok_or_else(|| {
            Exit::missing(
                format!(
                    "SUMO (the wheel eclipse-sumo) is not installed below {}",
                    library.display()
                ),
                "run `make build`, or set CARAWARE_SUMO_HOME to the wheel's `sumo` directory",
            )
        })
}
