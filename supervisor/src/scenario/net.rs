//! Reads where a net lies, and how large it is, from its file.

use std::{
    io::{BufRead, BufReader},
    path::Path,
};

use ipc_schema::run::MapInfo;
use quick_xml::{
    Reader,
    events::{BytesStart, Event},
};

use super::{attribute, input_check, problem};
use crate::failure::Exit;

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
    let mut reader = Reader::from_reader(BufReader::new(
        input_check::open(net).map_err(|error| unreadable(&error))?,
    ));
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

/// A net that lies further than this from its own (0, 0) gets a world frame of its own: from here on single precision has steps of
/// more than 8 mm.
const FAR_M: f64 = 131_072.0;
/// The world frame's (0, 0) is a multiple of this in net coordinates, metres.
const ORIGIN_STEP_M: f64 = 1000.0;

/// The world frame's (0, 0) in the coordinates of a net with these corners.
fn world_origin_m([x_min, y_min, x_max, y_max]: [f64; 4]) -> [f64; 2] {
    let furthest = [x_min, y_min, x_max, y_max]
        .map(f64::abs)
        .into_iter()
        .fold(0.0, f64::max);
    match furthest > FAR_M {
        true => [x_min, y_min].map(|least: f64| (least / ORIGIN_STEP_M).floor() * ORIGIN_STEP_M),
        false => [0.0; 2],
    }
}

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
    let world_origin_m = world_origin_m(bounds_m);
    let [x_0, y_0] = world_origin_m;
    let [x_min, y_min, x_max, y_max] = bounds_m;
    let bounds_m = [
        x_min - MARGIN_M - x_0,
        y_min - MARGIN_M - y_0,
        x_max + MARGIN_M - x_0,
        y_max + MARGIN_M - y_0,
    ];
    let offset_m: [f64; 2] = numbers("netOffset")
        .and_then(|list| list.try_into().ok())
        .ok_or_else(|| bad("netOffset"))?;
    let projection = attribute(element, "projParameter").unwrap_or_default();
    if projection.len() > 1 {
        return Ok(MapInfo {
            projection,
            net_offset_m: [offset_m[0] - x_0, offset_m[1] - y_0],
            bounds_m,
            traffic_lights: 0,
            world_origin_m,
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
        net_offset_m: [-x_0, -y_0],
        bounds_m,
        traffic_lights: 0,
        world_origin_m,
    })
}

#[cfg(test)]
mod tests {
    use std::{fs::File, path::PathBuf};

    use super::*;

    fn write(directory: &Path, name: &str, text: &str) -> PathBuf {
        let path = directory.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    const NET: &str = r#"<net><location netOffset="1.0,-2.5" convBoundary="0,0,100,50" origBoundary="0,0,1,1" projParameter="P"/></net>"#;

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
            world_origin_m: [0.0; 2],
        };
        assert_eq!(map_info(&plain, None).unwrap(), expected);
        assert_eq!(map_info(&packed, None).unwrap(), expected);
    }

    #[test]
    fn a_net_without_projection_needs_an_origin() {
        let directory = tempfile::tempdir().unwrap();
        let net = write(directory.path(), "a.net.xml", &NET.replace("\"P\"", "\"!\""));
        let (text, help) = map_info(&net, None).unwrap_err().summary();
        let help = help.unwrap();
        assert!(text.contains("has no projection"), "{text}");
        assert!(help.contains("map.origin_latitude_deg"), "{help}");
        assert!(
            map_info(&net, Some((52.0, 10.0)))
                .unwrap()
                .projection
                .starts_with("+proj=tmerc +lat_0=52 +lon_0=10")
        );
    }

    #[test]
    fn a_net_in_raw_utm_coordinates_gets_a_world_frame_beside_it() {
        let directory = tempfile::tempdir().unwrap();
        let utm = NET
            .replace("1.0,-2.5", "0.00,0.00")
            .replace("0,0,100,50", "691234.5,5334021.25,693000,5336000")
            .replace("\"P\"", "\"+proj=utm +zone=32\"");
        let map = map_info(&write(directory.path(), "a.net.xml", &utm), None).unwrap();
        assert_eq!(map.world_origin_m, [691_000.0, 5_334_000.0]);
        assert_eq!(map.net_offset_m, [-691_000.0, -5_334_000.0]);
        assert_eq!(map.bounds_m, [214.5, 1.25, 2020.0, 2020.0]);
        assert_eq!(world_origin_m([-100_000.0, 0.0, 131_072.0, 5.0]), [0.0; 2]);
    }
}
