//! Roads, buildings and trees of an imported map.

use std::{fs::File, io::BufReader, path::Path};

use quick_xml::{Reader, events::Event};

use super::{MapFormat, SumoTools};
use crate::{failure::Exit, scenario::attribute};

/// Options of netconvert for every format.
const ALWAYS: [&str; 8] = [
    "--geometry.remove",
    "--junctions.join",
    "--tls.discard-simple",
    "--tls.join",
    "--no-turnarounds.except-deadend",
    "--remove-edges.isolated",
    "--output.street-names",
    "--xml-validation=never",
];
/// Further options for OpenStreetMap: its roads have neither signal programs nor, for the most part, pavements and crossings.
const OSM: [&str; 9] = [
    "--roundabouts.guess",
    "--ramps.guess",
    "--tls.guess-signals",
    "--tls.default-type=actuated",
    "--sidewalks.guess",
    "--crossings.guess",
    "--osm.sidewalks",
    "--osm.turn-lanes",
    "--junctions.corner-detail=5",
];
/// Types of roads, lowest precedence first.
const OSM_TYPES: [&str; 3] = [
    "osmNetconvert.typ.xml",
    "osmNetconvertUrbanDe.typ.xml",
    "osmNetconvertPedestrians.typ.xml",
];
/// Type of a polygon or a point that is a tree.
pub(crate) const TREE: &str = "natural.tree";

/// Builds the net of `file`, and writes what netconvert says to `import.log`. Returns the number of its warnings.
///
/// # Errors
/// netconvert refuses the file.
pub(super) fn build(
    tools: &SumoTools<'_>,
    format: MapFormat,
    file: &Path,
    net: &str,
    more: &[String],
) -> Result<usize, Exit> {
    let file = file.to_string_lossy();
    let types = |names: &[&str]| {
        names
            .iter()
            .map(|name| tools.type_map(name))
            .collect::<Vec<_>>()
            .join(",")
    };
    let (input, types) = match format {
        MapFormat::Osm | MapFormat::OsmPbf => ("--osm-files", types(&OSM_TYPES)),
        MapFormat::OpenDrive => ("--opendrive-files", types(&["opendriveNetconvert.typ.xml"])),
    };
    let mut arguments = vec![input, &*file, "--type-files", &*types, "--output-file", net];
    arguments.extend(ALWAYS);
    if format.is_openstreetmap() {
        arguments.extend(OSM);
    }
    arguments.extend(more.iter().map(String::as_str));
    let said = tools.run("netconvert", &arguments)?;
    tools.write("import.log", &said)?;
    Ok(said.lines().filter(|line| line.starts_with("Warning")).count())
}

/// Builds buildings and trees. Returns whether the map has any.
///
/// # Errors
/// polyconvert refuses the file.
pub(super) fn build_polygons(tools: &SumoTools<'_>, file: &Path, net: &str, polygons: &str) -> Result<bool, Exit> {
    let file = file.to_string_lossy();
    let types = tools.type_map("osmPolyconvert.typ.xml");
    let arguments = [
        "--net-file",
        net,
        "--osm-files",
        &*file,
        "--type-file",
        &*types,
        "--osm.keep-full-type",
        "--output-file",
        polygons,
        "--xml-validation=never",
    ];
    tools.run("polyconvert", &arguments)?;
    Ok(tools.directory.join(polygons).is_file())
}

/// What the files hold.
#[derive(Debug, Default)]
pub(super) struct MapCounts {
    /// Length of all roads, each direction by itself, km.
    pub(super) road_km: f64,
    pub(super) junctions: u64,
    pub(super) signals: u64,
    pub(super) buildings: u64,
    pub(super) trees: u64,
}

impl MapCounts {
    /// MapCounts in the net and in the polygons.
    ///
    /// # Errors
    /// A file cannot be read.
    pub(super) fn of(tools: &SumoTools<'_>, net: &str, polygons: Option<&str>) -> Result<Self, Exit> {
        let mut counts = Self::default();
        counts.add(&tools.directory.join(net))?;
        if let Some(polygons) = polygons {
            counts.add(&tools.directory.join(polygons))?;
        }
        Ok(counts)
    }

    fn add(&mut self, path: &Path) -> Result<(), Exit> {
        let file = File::open(path).map_err(|error| Exit::io("read", path, &error))?;
        let mut reader = Reader::from_reader(BufReader::new(file));
        let (mut buffer, mut is_road, mut is_measured) = (Vec::new(), false, false);
        loop {
            buffer.clear();
            let event = reader.read_event_into(&mut buffer).map_err(|error| {
                Exit::run(
                    format!("{}: {error}", path.display()),
                    "this is a defect of SUMO's tools",
                )
            })?;
            let element = match &event {
                Event::Start(element) | Event::Empty(element) => element,
                Event::Eof => return Ok(()),
                _ => continue,
            };
            let text = |name: &str| attribute(element, name).unwrap_or_default();
            match element.local_name().as_ref() {
                "edge" => (is_road, is_measured) = (text("function").is_empty(), false),
                "lane" if is_road && !is_measured => {
                    is_measured = true;
                    self.road_km += text("length").parse().unwrap_or(0.0) / 1000.0;
                }
                "junction" if !matches!(text("type").as_str(), "internal" | "dead_end") => self.junctions += 1,
                "tlLogic" => self.signals += 1,
                "poly" if text("type").starts_with("building") => self.buildings += 1,
                "poi" if text("type") == TREE => self.trees += 1,
                _ => {}
            }
        }
    }
}
