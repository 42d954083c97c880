//! The project's own maps: netconvert builds them in the run directory from plain XML that the program contains.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use crate::{failure::Exit, install::Install};

/// A map whose plain sources the program contains.
#[derive(Debug)]
pub struct OwnMap {
    name: &'static str,
    /// Names and texts of its files.
    sources: &'static [(&'static str, &'static str)],
}

macro_rules! own_map {
    ($map:literal: $($ending:literal),+ $(,)?) => {
        OwnMap {
            name: $map,
            sources: &[$((
                concat!($map, ".", $ending),
                include_str!(concat!("../../maps/", $map, "/", $map, ".", $ending)),
            )),+],
        }
    };
}

/// The town: one lane in each direction.
pub const TOWN: OwnMap =
    own_map!("town": "nod.xml", "edg.xml", "con.xml", "typ.xml", "netccfg", "poly.xml", "vtypes.add.xml");

/// The avenue: a ring of two and three lanes in each direction, and four streets across.
pub const AVENUE: OwnMap = own_map!("avenue": "nod.xml", "edg.xml", "typ.xml", "netccfg", "poly.xml", "vtypes.add.xml");

/// The file of the town that defines the vehicle types.
const VEHICLE_TYPES: &str = "town.vtypes.add.xml";

impl OwnMap {
    /// Writes the sources to `directory` and builds the net there. Returns the net and its additional files: vehicle types and polygons.
    ///
    /// # Errors
    /// The directory is not writable, or netconvert fails.
    pub fn build(&self, install: &Install, directory: &Path) -> Result<(PathBuf, Vec<PathBuf>), Exit> {
        for (name, text) in self.sources {
            write(directory, name, text)?;
        }
        let of_map = |ending: &str| directory.join(format!("{}.{ending}", self.name));
        let net_file = of_map("net.xml");
        netconvert(install, &of_map("netccfg"), &net_file)?;
        Ok((net_file, vec![of_map("vtypes.add.xml"), of_map("poly.xml")]))
    }
}

/// Writes the vehicle types of the town to `directory`, for other maps.
///
/// # Errors
/// The directory is not writable.
pub fn vehicle_types(directory: &Path) -> Result<PathBuf, Exit> {
    let source = TOWN.sources.iter().find(|(name, _)| *name == VEHICLE_TYPES);
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
