//! The town, the project's own map: netconvert builds it in the run directory from plain XML that the program contains.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use crate::{failure::Exit, install::Install};

macro_rules! sources {
    ($($name:literal),+ $(,)?) => { [$(($name, include_str!(concat!("../../maps/town/", $name)))),+] };
}

/// The plain sources of the town.
const SOURCES: [(&str, &str); 7] = sources![
    "town.nod.xml",
    "town.edg.xml",
    "town.con.xml",
    "town.typ.xml",
    "town.netccfg",
    "town.poly.xml",
    "town.vtypes.add.xml",
];

/// The one of these files that defines the vehicle types.
const VEHICLE_TYPES: &str = "town.vtypes.add.xml";

/// Writes the sources of the town to `directory` and builds its net there. Returns the net and its additional files: vehicle types and
/// polygons.
///
/// # Errors
/// The directory is not writable, or netconvert fails.
pub fn build(install: &Install, directory: &Path) -> Result<(PathBuf, Vec<PathBuf>), Exit> {
    for (name, text) in SOURCES {
        write(directory, name, text)?;
    }
    let net_file = directory.join("town.net.xml");
    netconvert(install, &directory.join("town.netccfg"), &net_file)?;
    let additional_files = [VEHICLE_TYPES, "town.poly.xml"].map(|name| directory.join(name));
    Ok((net_file, additional_files.to_vec()))
}

/// Writes the vehicle types of the town to `directory`, for other maps.
///
/// # Errors
/// The directory is not writable.
pub fn vehicle_types(directory: &Path) -> Result<PathBuf, Exit> {
    let source = SOURCES.into_iter().find(|(name, _)| *name == VEHICLE_TYPES);
    write(directory, VEHICLE_TYPES, source.map_or("", |(_, text)| text))
}

fn write(directory: &Path, name: &str, text: &str) -> Result<PathBuf, Exit> {
    std::fs::create_dir_all(directory).map_err(|error| Exit::io("create", directory, &error))?;
    let path = directory.join(name);
    std::fs::write(&path, text).map_err(|error| Exit::io("write", &path, &error))?;
    Ok(path)
}

fn netconvert(install: &Install, config: &Path, net_file: &PathBuf) -> Result<(), Exit> {
    let program = install.sumo_program("netconvert");
    let output = Command::new(&program)
        .arg("-c")
        .arg(config)
        .arg("-o")
        .arg(net_file)
        .env("SUMO_HOME", &install.sumo_home)
        .env("PROJ_DATA", install.sumo_home.join("data/proj"))
        .output()
        .map_err(|error| {
            Exit::missing(
                format!("cannot start {}: {error}", program.display()),
                "run `make build`, then `caraware doctor`",
            )
        })?;
    if output.status.success() {
        return Ok(());
    }
    let text = String::from_utf8_lossy(&output.stderr);
    Err(Exit::run(
        format!("netconvert could not build {}: {}", net_file.display(), text.trim()),
        "`caraware doctor` checks the SUMO installation",
    ))
}
