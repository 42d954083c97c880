//! Reads the options of a `.sumocfg` and the location of a net, before any process starts.

use std::{
    fs::File,
    io::{BufRead, BufReader},
    path::{Path, PathBuf},
};

use flate2::read::MultiGzDecoder;
use ipc_schema::run::MapInfo;
use quick_xml::{
    Reader,
    events::{BytesStart, Event},
};

use crate::{config::ConfigError, failure::Exit};

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

/// Reads a `.sumocfg` and checks that every file it names exists.
///
/// # Errors
/// The file is unreadable or malformed, it names no net, or a file that it names is missing (with the line).
pub fn read(path: &Path) -> Result<SumoScenario, Exit> {
    let text = std::fs::read_to_string(path).map_err(|error| {
        problem(
            path,
            format!("cannot be read: {error}"),
            "give the path of an existing .sumocfg",
        )
    })?;
    let directory = path.parent().unwrap_or(Path::new("."));
    let mut scenario = SumoScenario::default();
    let mut reader = Reader::from_str(&text);
    loop {
        let line = line_of(&text, reader.buffer_position());
        match reader.read_event() {
            Ok(Event::Start(element) | Event::Empty(element)) => {
                read_option(&mut scenario, &element, path, directory, line)?
            }
            Ok(Event::Eof) => break,
            Ok(_) => {}
            Err(error) => {
                return Err(problem(
                    path,
                    format!("line {line}: not valid XML: {error}"),
                    "correct the file; SUMO's own check: `sumo -c FILE`",
                ));
            }
        }
    }
    if scenario.net_file.as_os_str().is_empty() {
        return Err(problem(
            path,
            "names no net-file",
            "add <input><net-file value=\"…\"/></input>",
        ));
    }
    Ok(scenario)
}

/// Line of the first character at or after `position` that is not white space, from 1.
fn line_of(text: &str, position: u64) -> usize {
    let end = usize::try_from(position).unwrap_or(usize::MAX).min(text.len());
    let start = text.as_bytes()[end..]
        .iter()
        .take_while(|byte| byte.is_ascii_whitespace())
        .count();
    text.as_bytes()[..end + start]
        .iter()
        .filter(|byte| **byte == b'\n')
        .count()
        + 1
}

/// Takes one option of the `.sumocfg` over into `scenario`, or refuses it.
fn read_option(
    scenario: &mut SumoScenario,
    element: &BytesStart<'_>,
    path: &Path,
    directory: &Path,
    line: usize,
) -> Result<(), Exit> {
    let name = element.local_name();
    let name = name.as_ref().to_owned();
    let Some(value) = attribute(element, "value").or_else(|| attribute(element, "v")) else {
        return Ok(());
    };
    match name.as_str() {
        "net-file" | "net" | "n" | "route-files" | "routes" | "r" | "additional-files" | "additional" | "a" => {
            let files = files(&value, directory);
            if let Some(missing) = files.iter().find(|file| !file.is_file()) {
                let message = format!("line {line}: {name} names {}, which does not exist", missing.display());
                return Err(problem(
                    path,
                    message,
                    "paths in a .sumocfg are relative to the .sumocfg itself",
                ));
            }
            for file in files
                .iter()
                .filter(|file| file.extension().is_some_and(|kind| kind == "gz"))
            {
                check_gzip(file).map_err(|error| {
                    let message = format!(
                        "line {line}: {name} names {}, which cannot be unpacked: {error}",
                        file.display()
                    );
                    problem(path, message, "copy or pack the file again; `gzip -t FILE` checks it")
                })?;
            }
            if name.starts_with('n') {
                scenario.net_file = files.into_iter().next().unwrap_or_default();
            } else if name.starts_with('a') {
                scenario.additional_files = files;
            }
        }
        // SUMO would open the port on all interfaces and wait for a client before its first step.
        "remote-port" if value.trim() != "0" => {
            return Err(problem(
                path,
                format!(
                    "line {line}: remote-port = \"{value}\" makes SUMO wait for a TraCI client, but no client can connect to a run"
                ),
                "remove remote-port from the .sumocfg (traffic-bridge steps SUMO in its own process), or keep a copy without it",
            ));
        }
        "step-length" => scenario.step_s = Some(number(&value, &name, path, line)?),
        "seed" => scenario.seed = Some(number(&value, &name, path, line)?),
        _ => {}
    }
    Ok(())
}

fn files(value: &str, directory: &Path) -> Vec<PathBuf> {
    value
        .split(',')
        .map(str::trim)
        .filter(|name| !name.is_empty())
        .map(|name| directory.join(name))
        .collect()
}

/// Reads a gzip file to its end. SUMO would stop at the damage without naming the file.
fn check_gzip(file: &Path) -> std::io::Result<u64> {
    std::io::copy(&mut MultiGzDecoder::new(File::open(file)?), &mut std::io::sink())
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
    map.traffic_lights = traffic_lights(&mut reader.into_inner()).map_err(|error| unreadable(&error))?;
    Ok(map)
}

/// Counts the programs of traffic lights in the rest of a net. Large nets have a million elements, so only their names are compared.
fn traffic_lights(net: &mut impl BufRead) -> std::io::Result<u32> {
    let (mut element, mut count) = (Vec::new(), 0);
    while net.read_until(b'>', &mut element)? > 0 {
        count += u32::from(element.trim_ascii_start().starts_with(b"<tlLogic "));
        element.clear();
    }
    Ok(count)
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
        let scenario = read(&cfg).unwrap();
        assert_eq!(
            scenario,
            SumoScenario {
                net_file: directory.path().join("a.net.xml"),
                additional_files: Vec::new(),
                step_s: Some(0.5),
                seed: None
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
        let (text, help) = message(read(&cfg).unwrap_err());
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
