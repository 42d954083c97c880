//! Reads the options of a `.sumocfg` and the location of a net, before any process starts. A scenario may come from a stranger:
//! docs/decisions/0028-scenario-files-are-not-trusted.md.

mod configuration;
pub mod input_check;
pub mod options;

use std::{
    fs::File,
    io::{BufRead, BufReader, Read as _},
    path::{Path, PathBuf},
};

use flate2::read::MultiGzDecoder;
use ipc_schema::run::MapInfo;
use quick_xml::{
    Reader,
    events::{BytesStart, Event},
};

use crate::{config::ConfigError, failure::Exit};
use configuration::SumoSetting;
use input_check::{InputCheck, OutputPlace, TRUST};
use options::OptionEffect;

/// The options of a `.sumocfg` that the bridge needs.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SumoScenario {
    /// The net.
    pub net_file: PathBuf,
    /// `additional-files`, in order.
    pub additional_files: Vec<PathBuf>,
    /// `step-length`, if set.
    pub step_s: Option<f64>,
    /// `seed`, if set.
    pub seed: Option<u64>,
    /// Outputs that the files place elsewhere, which SUMO writes into the run's directory: each with its place.
    pub moved_outputs: Vec<String>,
}

impl SumoScenario {
    /// Notes in the log of `traffic-bridge` which outputs are not written where the scenario's files say.
    ///
    /// # Errors
    /// The log cannot be written.
    pub fn note_moved_outputs(&self, run_dir: &Path) -> Result<(), Exit> {
        let log = run_dir.join("logs/traffic-bridge.log");
        if self.moved_outputs.is_empty() {
            return Ok(());
        }
        let place = run_dir.join("sumo");
        let notes = self
            .moved_outputs
            .iter()
            .map(|output| format!("{output}: written into {} instead\n", place.display()));
        std::fs::write(&log, notes.collect::<String>()).map_err(|error| Exit::io("write", &log, &error))
    }
}

fn problem(path: &Path, message: impl Into<String>, help: impl Into<String>) -> Exit {
    ConfigError::File {
        path: path.display().to_string(),
        message: message.into(),
        help: help.into(),
    }
    .into()
}

/// The value of attribute `name`, unescaped.
pub(crate) fn attribute(element: &BytesStart<'_>, name: &str) -> Option<String> {
    let attribute = element.try_get_attribute(name).ok().flatten()?;
    attribute
        .normalized_value(quick_xml::XmlVersion::Implicit1_0)
        .ok()
        .map(|value| value.into_owned())
}

/// Reads a `.sumocfg` and checks every file that it names. Unless it is `trusted`, whatever reaches beyond the run's directory is refused.
///
/// # Errors
/// The file is unreadable or malformed, it names no net, a file that it names is missing or no regular file, or an option or an element
/// makes SUMO connect, listen, load another configuration, or write outside the run's directory. Each error has its file and line.
pub fn read(path: &Path, trusted: bool) -> Result<SumoScenario, Exit> {
    let unreadable = |reason: String| problem(path, reason, "give the path of an existing .sumocfg");
    if path.exists() {
        input_check::require_regular(path).map_err(unreadable)?;
    }
    let text = std::fs::read_to_string(path).map_err(|error| unreadable(format!("cannot be read: {error}")))?;
    let configuration = configuration::parse(&text).map_err(|(line, reason)| {
        let help = "correct the file; SUMO's own check: `sumo -c FILE`";
        problem(path, format!("line {line}: not valid XML: {reason}"), help)
    })?;
    let mut reader = ScenarioReader {
        path,
        directory: path.parent().unwrap_or(Path::new(".")),
        scenario: SumoScenario::default(),
        check: (!trusted).then(|| InputCheck::new(OutputPlace::RunDirectory)),
    };
    if let (Some(line), false) = (configuration.doctype_line, trusted) {
        let help = format!("remove <!DOCTYPE …>, {TRUST}");
        return Err(reader.problem(line, "a document type declaration makes SUMO read other files", help));
    }
    for setting in &configuration.settings {
        reader.read_setting(setting)?;
    }
    let mut scenario = reader.scenario;
    scenario.moved_outputs = reader.check.map(|check| check.moved).unwrap_or_default();
    if scenario.net_file.as_os_str().is_empty() {
        return Err(problem(
            path,
            "names no net-file",
            "add <input><net-file value=\"…\"/></input>",
        ));
    }
    Ok(scenario)
}

/// Checks the net of a map with population control, for which SUMO has no directory of outputs.
///
/// # Errors
/// As [`read`]; a net may not write at all.
pub fn check_net(net: &Path, trusted: bool) -> Result<(), Exit> {
    match trusted {
        true => {
            input_check::require_regular(net).map_err(|reason| problem(net, reason, "give a net built by netconvert"))
        }
        false => InputCheck::new(OutputPlace::Anywhere).check_xml(net),
    }
}

/// Takes over the options of one `.sumocfg`.
struct ScenarioReader<'a> {
    path: &'a Path,
    directory: &'a Path,
    scenario: SumoScenario,
    /// `None` if the scenario is trusted.
    check: Option<InputCheck>,
}

impl ScenarioReader<'_> {
    fn problem(&self, line: usize, message: impl std::fmt::Display, help: impl Into<String>) -> Exit {
        problem(self.path, format!("line {line}: {message}"), help)
    }

    /// Takes one option over into the scenario, or refuses it.
    fn read_setting(&mut self, setting: &SumoSetting) -> Result<(), Exit> {
        let SumoSetting { name, value, line } = setting;
        let effect = OptionEffect::of(name);
        match effect {
            OptionEffect::ReadsXml | OptionEffect::Reads => self.read_files(setting, effect)?,
            // No client can connect to a run, trusted or not.
            OptionEffect::Listens if value.trim() != "0" => {
                return Err(self.problem(
                    *line,
                    format!("remote-port = \"{value}\" makes SUMO wait for a TraCI client, but no client can connect to a run"),
                    "remove remote-port from the .sumocfg (traffic-bridge steps SUMO in its own process), or keep a copy without it",
                ));
            }
            _ => self.check_setting(setting, effect)?,
        }
        match name.as_str() {
            "step-length" => self.scenario.step_s = Some(number(value, name, self.path, *line)?),
            "seed" => self.scenario.seed = Some(number(value, name, self.path, *line)?),
            _ => {}
        }
        Ok(())
    }

    /// Refuses an option that reaches beyond the run's directory, unless the scenario is trusted.
    fn check_setting(&mut self, setting: &SumoSetting, effect: OptionEffect) -> Result<(), Exit> {
        let SumoSetting { name, value, line } = setting;
        let Some(check) = &mut self.check else { return Ok(()) };
        let (message, help) = match effect {
            OptionEffect::Writes => {
                let outputs = value
                    .split(',')
                    .try_for_each(|output| check.check_output(self.path, name, output));
                match outputs {
                    Ok(()) => return Ok(()),
                    Err(refused) => refused,
                }
            }
            OptionEffect::NamesOutputs if value.contains(['/', '\\', '$']) => (
                format!("{name} = \"{value}\" may place outputs outside the run's directory"),
                format!("use a suffix without \"/\" and \"$\", {TRUST}"),
            ),
            OptionEffect::Validates if !["never", "local", ""].contains(&value.trim()) => (
                format!(
                    "{name} = \"{value}\" makes SUMO load schemas and entities from addresses that its input files name"
                ),
                format!("set it to \"local\" or \"never\", {TRUST}"),
            ),
            OptionEffect::Escapes if !value.trim().is_empty() => (
                format!("{name} = \"{value}\" makes SUMO write or load files outside the run's directory"),
                format!("remove it, {TRUST}"),
            ),
            _ => return Ok(()),
        };
        Err(self.problem(*line, message, help))
    }

    /// Checks the files of an option, and takes the net and the additional files over into the scenario.
    fn read_files(&mut self, setting: &SumoSetting, effect: OptionEffect) -> Result<(), Exit> {
        let SumoSetting { name, value, line } = setting;
        let files = files(value, self.directory);
        for file in &files {
            let shown = file.display();
            if !file.exists() {
                let message = format!("{name} names {shown}, which does not exist");
                let help = "paths in a .sumocfg are relative to the .sumocfg itself";
                return Err(self.problem(*line, message, help));
            }
            input_check::require_regular(file).map_err(|reason| {
                let message = format!("{name} names {shown}, which {reason}");
                self.problem(*line, message, "name a file that SUMO's own tools have written")
            })?;
            if file.extension().is_some_and(|kind| kind == "gz") {
                check_gzip(file, self.check.is_none()).map_err(|error| {
                    let message = format!("{name} names {shown}, which cannot be unpacked: {error}");
                    self.problem(*line, message, "copy or pack the file again; `gzip -t FILE` checks it")
                })?;
            }
            if let (Some(check), OptionEffect::ReadsXml) = (&mut self.check, effect) {
                check.check_xml(file)?;
            }
        }
        match name.as_str() {
            "net-file" | "net" | "n" => self.scenario.net_file = files.into_iter().next().unwrap_or_default(),
            "additional-files" | "additional" | "a" => self.scenario.additional_files = files,
            _ => {}
        }
        Ok(())
    }
}

fn files(value: &str, directory: &Path) -> Vec<PathBuf> {
    value
        .split(',')
        .map(str::trim)
        .filter(|name| !name.is_empty())
        .map(|name| directory.join(name))
        .collect()
}

/// Reads a gzip file to its end, or to the limit of what it may unpack to. SUMO would stop at damage without naming the file.
fn check_gzip(file: &Path, trusted: bool) -> std::io::Result<u64> {
    let limit = match trusted {
        true => u64::MAX,
        false => input_check::unpacked_limit(file.metadata()?.len()),
    };
    let mut unpacked = MultiGzDecoder::new(File::open(file)?).take(limit);
    let bytes = std::io::copy(&mut unpacked, &mut std::io::sink())?;
    match bytes == limit {
        true => Err(std::io::Error::other(input_check::UNPACKS_TO_TOO_MUCH)),
        false => Ok(bytes),
    }
}

fn number<T: std::str::FromStr>(value: &str, name: &str, path: &Path, line: usize) -> Result<T, Exit> {
    value.trim().parse().map_err(|_| {
        problem(
            path,
            format!("line {line}: {name} = \"{value}\" is not a number"),
            "write a plain number",
        )
    })
}

/// Reads the `<location>` of a net file (plain or gzip) and counts its traffic lights. If the net has no projection, `origin_deg` (latitude
/// and longitude of its origin) replaces it.
///
/// # Errors
/// The file is unreadable, it has no `<location>`, or there is neither a projection nor an origin.
pub fn map_info(net: &Path, origin_deg: Option<(f64, f64)>) -> Result<MapInfo, Exit> {
    let unreadable = |error: &dyn std::fmt::Display| {
        problem(
            net,
            format!("cannot be read: {error}"),
            "give a net built by netconvert",
        )
    };
    let file = File::open(net).map_err(|error| unreadable(&error))?;
    let mut raw = BufReader::new(file);
    let gzip = raw
        .fill_buf()
        .map_err(|error| unreadable(&error))?
        .starts_with(&[0x1f, 0x8b]);
    let input: Box<dyn BufRead> = if gzip {
        Box::new(BufReader::new(MultiGzDecoder::new(raw)))
    } else {
        Box::new(raw)
    };
    let mut reader = Reader::from_reader(input);
    let mut buffer = Vec::new();
    let mut map = loop {
        match reader.read_event_into(&mut buffer) {
            Ok(Event::Start(element) | Event::Empty(element)) if element.local_name().as_ref() == "location" => {
                break location(&element, net, origin_deg)?;
            }
            Ok(Event::Eof) => return Err(problem(net, "has no <location>", "give a net built by netconvert")),
            Ok(_) => buffer.clear(),
            Err(error) => return Err(unreadable(&error)),
        }
    };
    let counts = NetCounts::of(&mut reader.into_inner()).map_err(|error| unreadable(&error))?;
    if counts.internal_edges > 0 && (counts.inner_connections == 0 || counts.outer_connections == 0) {
        let message =
            "has junctions, but no <connection> into them or out of them: SUMO crashes while it reads such a net";
        return Err(problem(net, message, "build the net again with netconvert"));
    }
    map.traffic_lights = counts.traffic_lights;
    Ok(map)
}

/// Numbers of elements of a net.
#[derive(Debug, Default)]
struct NetCounts {
    /// Programs of traffic lights.
    traffic_lights: u32,
    /// Edges within junctions.
    internal_edges: u64,
    /// Connections that begin within a junction.
    inner_connections: u64,
    /// Connections that begin on a road.
    outer_connections: u64,
}

impl NetCounts {
    /// Counts in the rest of a net. Large nets have a million elements, so only the beginnings of elements are compared.
    fn of(net: &mut impl BufRead) -> std::io::Result<Self> {
        let (mut element, mut counts) = (Vec::new(), Self::default());
        while net.read_until(b'>', &mut element)? > 0 {
            let text = element.trim_ascii_start();
            if text.starts_with(b"<tlLogic ") {
                counts.traffic_lights += 1;
            } else if text.starts_with(b"<edge id=\":") {
                counts.internal_edges += 1;
            } else if text.starts_with(b"<connection from=\":") {
                counts.inner_connections += 1;
            } else if text.starts_with(b"<connection ") {
                counts.outer_connections += 1;
            }
            element.clear();
        }
        Ok(counts)
    }
}

/// Margin around the net for positions outside it, such as GNSS errors and vehicles wider than their lane, metres.
const MARGIN_M: f64 = 20.0;

fn location(element: &BytesStart<'_>, net: &Path, origin_deg: Option<(f64, f64)>) -> Result<MapInfo, Exit> {
    let numbers = |name: &str| -> Option<Vec<f64>> {
        attribute(element, name)?
            .split(',')
            .map(|part| part.trim().parse().ok())
            .collect()
    };
    let bad = |name: &str| {
        problem(
            net,
            format!("<location> has no usable {name}"),
            "give a net built by netconvert",
        )
    };
    let bounds_m: [f64; 4] = numbers("convBoundary")
        .and_then(|list| list.try_into().ok())
        .ok_or_else(|| bad("convBoundary"))?;
    let [x_min, y_min, x_max, y_max] = bounds_m;
    let bounds_m = [x_min - MARGIN_M, y_min - MARGIN_M, x_max + MARGIN_M, y_max + MARGIN_M];
    let offset_m: [f64; 2] = numbers("netOffset")
        .and_then(|list| list.try_into().ok())
        .ok_or_else(|| bad("netOffset"))?;
    let projection = attribute(element, "projParameter").unwrap_or_default();
    if projection.len() > 1 {
        return Ok(MapInfo {
            projection,
            net_offset_m: offset_m,
            bounds_m,
            traffic_lights: 0,
        });
    }
    let (latitude, longitude) = origin_deg.ok_or_else(|| {
        problem(
            net,
            "has no projection (projParameter is \"!\"), so GNSS has no latitude and longitude",
            "give the position of the net's (0, 0): --set map.origin_latitude_deg=52.0 --set map.origin_longitude_deg=10.0",
        )
    })?;
    let projection =
        format!("+proj=tmerc +lat_0={latitude} +lon_0={longitude} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs");
    Ok(MapInfo {
        projection,
        net_offset_m: [0.0, 0.0],
        bounds_m,
        traffic_lights: 0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(directory: &Path, name: &str, text: &str) -> PathBuf {
        let path = directory.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    fn message(exit: Exit) -> (String, String) {
        match exit {
            Exit::Config(error) => (
                error.to_string(),
                miette::Diagnostic::help(&*error).unwrap().to_string(),
            ),
            other => panic!("{other:?}"),
        }
    }

    const NET: &str = r#"<net><location netOffset="1.0,-2.5" convBoundary="0,0,100,50" origBoundary="0,0,1,1" projParameter="P"/></net>"#;

    #[test]
    fn options_are_read_relative_to_the_file() {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), "a.net.xml", NET);
        let cfg = write(
            directory.path(),
            "a.sumocfg",
            "<configuration>\n<input>\n<net-file value=\"a.net.xml\"/></input><time><step-length value=\"0.5\"/></time></configuration>",
        );
        let scenario = read(&cfg, false).unwrap();
        assert_eq!(
            scenario,
            SumoScenario {
                net_file: directory.path().join("a.net.xml"),
                additional_files: Vec::new(),
                step_s: Some(0.5),
                seed: None,
                moved_outputs: Vec::new(),
            }
        );
    }

    #[test]
    fn a_missing_route_file_is_named_with_its_line() {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), "a.net.xml", NET);
        let cfg = write(
            directory.path(),
            "a.sumocfg",
            "<configuration>\n  <input>\n    <net-file value=\"a.net.xml\"/>\n    <route-files value=\"b.rou.xml\"/>\n  </input>\n</configuration>",
        );
        let (text, help) = message(read(&cfg, false).unwrap_err());
        assert!(
            text.contains("line 4: route-files names") && text.contains("b.rou.xml"),
            "{text}"
        );
        assert!(help.contains("relative to the .sumocfg"), "{help}");
    }

    #[test]
    fn location_and_traffic_lights_are_read_from_plain_and_gzip_nets() {
        use std::io::Write as _;
        let directory = tempfile::tempdir().unwrap();
        let lights = "\n  <tlLogic id=\"a\">\n  <phase/></tlLogic>\n<tlLogic id=\"b\"/></net>";
        let net = NET.replace("\"P\"", "\"+proj=utm +zone=32\"").replace("</net>", lights);
        let plain = write(directory.path(), "a.net.xml", &net);
        let packed = directory.path().join("a.net.xml.gz");
        let mut encoder = flate2::write::GzEncoder::new(File::create(&packed).unwrap(), flate2::Compression::fast());
        encoder.write_all(net.as_bytes()).unwrap();
        encoder.finish().unwrap();
        let expected = MapInfo {
            projection: "+proj=utm +zone=32".into(),
            net_offset_m: [1.0, -2.5],
            bounds_m: [-20.0, -20.0, 120.0, 70.0],
            traffic_lights: 2,
        };
        assert_eq!(map_info(&plain, None).unwrap(), expected);
        assert_eq!(map_info(&packed, None).unwrap(), expected);
    }

    #[test]
    fn a_net_without_projection_needs_an_origin() {
        let directory = tempfile::tempdir().unwrap();
        let net = write(directory.path(), "a.net.xml", &NET.replace("\"P\"", "\"!\""));
        let (text, help) = message(map_info(&net, None).unwrap_err());
        assert!(text.contains("has no projection"), "{text}");
        assert!(help.contains("map.origin_latitude_deg"), "{help}");
        assert!(
            map_info(&net, Some((52.0, 10.0)))
                .unwrap()
                .projection
                .starts_with("+proj=tmerc +lat_0=52 +lon_0=10")
        );
    }
}
