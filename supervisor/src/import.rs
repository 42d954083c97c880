//! `caraware import`: makes a scenario of a town from OpenStreetMap or of a road from OpenDRIVE, by SUMO's own tools. Plain SUMO runs it
//! too (docs/import.md).

mod demand;
mod net;
mod pbf;

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use ipc_schema::run::MapInfo;

use crate::{
    cli::ImportArgs,
    display,
    failure::Exit,
    install::Install,
    interruption::remove_when_interrupted,
    scenario::{self, ScenarioReading, input_check::require_regular},
};
use demand::ImportedDemand;
pub use pbf::BoundingBox;

/// The scenario in the directory.
const SUMOCFG: &str = "city.sumocfg";
const NET: &str = "city.net.xml";
const POLYGONS: &str = "city.poly.xml";
/// The map as XML, as long as SUMO's tools read it; only of PBF.
const UNPACKED: &str = "city.osm.xml";
/// SUMO's step, seconds.
const STEP_S: f64 = 0.1;
/// Simulated time of the check by bare SUMO, seconds.
const CHECKED_S: f64 = 120.0;

/// Formats that a map may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapFormat {
    /// OpenStreetMap's XML, plain or gzip.
    Osm,
    /// OpenStreetMap's PBF, which SUMO's tools do not read: it is unpacked first.
    OsmPbf,
    /// OpenDRIVE.
    OpenDrive,
}

impl MapFormat {
    /// The format of a file, by its name.
    ///
    /// # Errors
    /// The name has no known ending.
    pub fn of(file: &Path) -> Result<Self, Exit> {
        let name = file.to_string_lossy().to_ascii_lowercase();
        let ends_with = |endings: &[&str]| endings.iter().any(|ending| name.ends_with(ending));
        if ends_with(&[".osm", ".osm.xml", ".osm.gz", ".osm.xml.gz"]) {
            Ok(Self::Osm)
        } else if ends_with(&[".xodr", ".xodr.gz"]) {
            Ok(Self::OpenDrive)
        } else if ends_with(&[".pbf"]) {
            Ok(Self::OsmPbf)
        } else {
            Err(Exit::config(
                format!("{} is neither .osm, .osm.pbf nor .xodr", file.display()),
                "give a map of OpenStreetMap (.osm, .osm.gz, .osm.pbf) or OpenDRIVE (.xodr)",
            ))
        }
    }

    /// Whether SUMO's tools read it as a map of OpenStreetMap.
    fn is_openstreetmap(self) -> bool {
        match self {
            Self::Osm | Self::OsmPbf => true,
            Self::OpenDrive => false,
        }
    }
}

/// A program of SUMO's wheel, run in the directory of the scenario.
pub(crate) struct SumoTools<'a> {
    install: &'a Install,
    directory: &'a Path,
}

impl SumoTools<'_> {
    /// Runs a program of the wheel. Returns what it said.
    fn run(&self, name: &str, arguments: &[&str]) -> Result<String, Exit> {
        let program = self.install.sumo_program(name);
        self.output(Command::new(&program).args(arguments), name)
    }

    /// Runs one of SUMO's Python tools, which may need libraries of the wheel. Returns what it said.
    fn run_python(&self, tool: &str, arguments: &[&str]) -> Result<String, Exit> {
        let path = self.install.sumo_home.join("tools").join(tool);
        self.output(Command::new(&self.install.python).arg(path).args(arguments), tool)
    }

    fn output(&self, command: &mut Command, name: &str) -> Result<String, Exit> {
        let output = command
            .current_dir(self.directory)
            .env("SUMO_HOME", &self.install.sumo_home)
            .env("PROJ_DATA", self.install.sumo_home.join("data/proj"))
            .output()
            .map_err(|error| {
                Exit::missing(
                    format!("cannot start {name}: {error}"),
                    "run `make build`, then `caraware doctor`",
                )
            })?;
        let said = format!(
            "{}{}",
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
        if output.status.success() {
            return Ok(said);
        }
        let errors: Vec<&str> = said.lines().filter(|line| line.contains("Error")).collect();
        let reason = if errors.is_empty() {
            said.trim()
        } else {
            &errors.join(" ")
        };
        Err(Exit::run(
            format!("{name} failed: {reason}"),
            "correct the map in its editor, or give netconvert other options with --netconvert",
        ))
    }

    /// A file of types in SUMO's installation.
    fn type_map(&self, name: &str) -> String {
        let path = self.install.sumo_home.join("data/typemap").join(name);
        path.to_string_lossy().into_owned()
    }

    fn write(&self, name: &str, text: &str) -> Result<(), Exit> {
        let path = self.directory.join(name);
        std::fs::write(&path, text).map_err(|error| Exit::io("write", &path, &error))
    }
}

/// Imports a map and prints what it holds, what to tune, and the command that runs it.
///
/// # Errors
/// The file is unreadable or not a map, the directory holds something else, or a tool of SUMO fails.
pub fn import(args: &ImportArgs) -> Result<(), Exit> {
    let format = MapFormat::of(&args.file)?;
    if args.bbox.is_some() && format != MapFormat::OsmPbf {
        return Err(Exit::config(
            format!(
                "--bbox cuts a part out of an .osm.pbf, and {} is none",
                args.file.display()
            ),
            "leave it out, or cut before: osmium extract -b west,south,east,north FILE.osm -o PART.osm",
        ));
    }
    require_regular(&args.file).map_err(|reason| {
        Exit::config(
            format!("{}: {reason}", args.file.display()),
            "give the path of an existing map",
        )
    })?;
    let file = std::path::absolute(&args.file).map_err(|error| Exit::io("resolve", &args.file, &error))?;
    let was_there = args.directory.exists();
    let directory = empty_directory(&args.directory)?;
    let _removal = remove_when_interrupted(&directory, was_there)?;
    let install = Install::find()?;
    let tools = SumoTools {
        install: &install,
        directory: &directory,
    };
    let unpacked = match format {
        MapFormat::OsmPbf => Some(pbf::unpack(&args.file, args.bbox.as_ref(), &directory.join(UNPACKED))?),
        MapFormat::Osm | MapFormat::OpenDrive => None,
    };
    let map_file = match &unpacked {
        Some(map) => {
            display::notice(&format!(
                "{} unpacked: {} nodes, {} ways, {} relations",
                args.file.display(),
                map.nodes,
                map.ways,
                map.relations
            ));
            &*map.path
        }
        None => &*file,
    };
    let stage = |number: u32, what: &str| display::notice(&format!("{number}/5 {what}"));

    stage(1, "roads, junctions and signals (netconvert)");
    let warnings = net::build(&tools, format, map_file, NET, &args.netconvert)?;
    stage(2, "buildings and trees (polyconvert)");
    let has_polygons = format.is_openstreetmap() && net::build_polygons(&tools, map_file, NET, POLYGONS)?;
    drop(unpacked);
    stage(3, "demand (randomTrips)");
    let demand = ImportedDemand::write(&tools, NET, args)?;
    tools.write(SUMOCFG, &configuration(args, has_polygons, &demand))?;
    stage(4, "the files as a run reads them");
    let sumocfg = directory.join(SUMOCFG);
    let scenario = scenario::read(&sumocfg, ScenarioReading::Checked)?;
    let counts = net::MapCounts::of(&tools, NET, has_polygons.then_some(POLYGONS))?;
    let projected = scenario::map_info(&scenario.net_file, None);
    stage(5, "the first two minutes in bare SUMO");
    let check = Check::run(&tools, args.duration_s.min(CHECKED_S))?;
    display::print(&summary(
        &args.directory,
        &counts,
        &demand,
        &check,
        warnings,
        projected.as_ref().ok(),
    ));
    Ok(())
}

/// Creates the directory; one that holds something is refused, because nothing of the user's is overwritten.
fn empty_directory(directory: &Path) -> Result<PathBuf, Exit> {
    std::fs::create_dir_all(directory).map_err(|error| Exit::io("create", directory, &error))?;
    let mut entries = std::fs::read_dir(directory).map_err(|error| Exit::io("read", directory, &error))?;
    if entries.next().is_some() {
        return Err(Exit::config(
            format!("{} is not empty, and an import overwrites nothing", directory.display()),
            "name a new directory",
        ));
    }
    std::path::absolute(directory).map_err(|error| Exit::io("resolve", directory, &error))
}

fn configuration(args: &ImportArgs, has_polygons: bool, demand: &ImportedDemand) -> String {
    let additional = match has_polygons {
        true => format!("        <additional-files value=\"{POLYGONS}\"/>\n"),
        false => String::new(),
    };
    format!(
        "<configuration>\n\
         \x20   <input>\n\
         \x20       <net-file value=\"{NET}\"/>\n\
         \x20       <route-files value=\"{}\"/>\n\
         {additional}\
         \x20   </input>\n\
         \x20   <output>\n\
         \x20       <summary-output value=\"summary.xml\"/>\n\
         \x20       <tripinfo-output value=\"tripinfo.xml\"/>\n\
         \x20   </output>\n\
         \x20   <time>\n\
         \x20       <begin value=\"0\"/>\n\
         \x20       <end value=\"{}\"/>\n\
         \x20       <step-length value=\"{STEP_S}\"/>\n\
         \x20   </time>\n\
         \x20   <random_number>\n\
         \x20       <seed value=\"{}\"/>\n\
         \x20   </random_number>\n\
         \x20   <report>\n\
         \x20       <no-step-log value=\"true\"/>\n\
         \x20   </report>\n\
         </configuration>\n",
        demand.files().join(","),
        args.duration_s,
        args.seed,
    )
}

/// What bare SUMO made of the first minutes.
#[derive(Debug, Default, PartialEq, Eq)]
struct Check {
    inserted: u64,
    teleports: u64,
    collisions: u64,
}

impl Check {
    /// Runs bare SUMO, with its statistics beside the scenario until they are read.
    fn run(tools: &SumoTools<'_>, seconds: f64) -> Result<Self, Exit> {
        const STATISTICS: &str = "check.xml";
        let end = seconds.to_string();
        let prefix = ["--output-prefix", "check-", "--statistic-output", STATISTICS];
        tools.run(
            "sumo",
            &[&["-c", SUMOCFG, "--end", &end, "--no-warnings"], &prefix[..]].concat(),
        )?;
        let path = tools.directory.join(format!("check-{STATISTICS}"));
        let text = std::fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
        for name in [STATISTICS, "summary.xml", "tripinfo.xml"] {
            let path = tools.directory.join(format!("check-{name}"));
            if let Err(error) = std::fs::remove_file(&path) {
                tracing::warn!(%error, path = %path.display(), "cannot remove");
            }
        }
        Ok(Self::of(&text))
    }

    fn of(text: &str) -> Self {
        let value = |element: &str, name: &str| {
            let (_, rest) = text.split_once(&format!("<{element} "))?;
            let (attributes, _) = rest.split_once('>')?;
            let (_, rest) = attributes.split_once(&format!("{name}=\""))?;
            rest.split_once('"')?.0.parse().ok()
        };
        Self {
            inserted: value("vehicles", "inserted").unwrap_or(0),
            teleports: value("teleports", "total").unwrap_or(0),
            collisions: value("safety", "collisions").unwrap_or(0),
        }
    }
}

fn summary(
    directory: &Path,
    counts: &net::MapCounts,
    demand: &ImportedDemand,
    check: &Check,
    warnings: usize,
    map: Option<&MapInfo>,
) -> String {
    let sumocfg = directory.join(SUMOCFG);
    let mut lines = vec![
        format!(
            "{}: {:.1} km of road, {} junctions, {} with signals, {} buildings, {} trees",
            sumocfg.display(),
            counts.road_km,
            counts.junctions,
            counts.signals,
            counts.buildings,
            counts.trees
        ),
        format!("demand: {}", demand.description()),
        format!(
            "bare SUMO, first two minutes: {} vehicles, {} teleports, {} collisions; {warnings} warnings of netconvert in import.log",
            check.inserted, check.teleports, check.collisions
        ),
    ];
    if check.inserted == 0 {
        lines.push("tune: no vehicle departed; raise --demand, or check that the map has roads for cars".to_owned());
    }
    if check.teleports + check.collisions > 0 {
        lines.push(
            "tune: jams or collisions; lower --demand, or correct junctions and signals with `netedit`".to_owned(),
        );
    }
    lines.push(
        "tune: --demand scales all traffic, --netconvert passes options (such as --netconvert=--tls.default-type=static); \
         city.sumocfg and the route files are plain SUMO"
            .to_owned(),
    );
    let origin = match map {
        Some(_) => "",
        None => {
            lines.push("the map says nothing of its latitude and longitude: give those of its (0, 0)".to_owned());
            " --set map.origin_latitude_deg=52.0 --set map.origin_longitude_deg=10.0"
        }
    };
    lines.push(format!("caraware simulate {} --end 60{origin}", sumocfg.display()));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_format_is_that_of_the_name() {
        for name in ["a.osm", "A.OSM", "a.osm.xml", "a.osm.gz"] {
            assert_eq!(MapFormat::of(Path::new(name)).unwrap(), MapFormat::Osm);
        }
        assert_eq!(MapFormat::of(Path::new("a.xodr")).unwrap(), MapFormat::OpenDrive);
        assert_eq!(MapFormat::of(Path::new("a.osm.pbf")).unwrap(), MapFormat::OsmPbf);
        assert!(MapFormat::of(Path::new("a.net.xml")).is_err());
    }

    #[test]
    fn statistics_are_read_by_name() {
        let text = "<statistics><vehicles loaded=\"9\" inserted=\"7\" running=\"1\"/>\n<teleports total=\"2\" jam=\"1\"/>\n\
                    <safety collisions=\"3\" emergencyStops=\"0\"/></statistics>";
        let check = Check {
            inserted: 7,
            teleports: 2,
            collisions: 3,
        };
        assert_eq!((Check::of(text), Check::of("")), (check, Check::default()));
    }

    #[test]
    fn a_directory_with_files_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        assert!(empty_directory(&directory.path().join("new")).is_ok());
        assert!(
            empty_directory(directory.path())
                .unwrap_err()
                .summary()
                .0
                .contains("not empty")
        );
    }
}
