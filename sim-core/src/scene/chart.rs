//! The scene as viewers receive it (docs/fanout.md, `map`): written once into the run's directory, in centimetres.

use std::{collections::BTreeMap, path::Path};

use ipc_schema::{run::RunFile, traffic::id_hash};
use quick_xml::events::BytesStart;
use serde::Serialize;

use super::{
    Prism, Prop, RoadPiece, Scene, SceneError, SolidClass, SurfaceKind,
    xml::{XmlTag, attribute, for_each_tag},
};

/// Classes that make a lane one for buses: it admits none but these.
const BUS_CLASSES: [&str; 5] = ["bus", "coach", "taxi", "emergency", "authority"];

/// All static objects.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Chart {
    /// Lanes, crossings, sidewalks.
    pub lanes: Vec<ChartLane>,
    /// Junctions and walking areas.
    pub areas: Vec<ChartArea>,
    /// Buildings and walls.
    pub buildings: Vec<ChartBuilding>,
    /// Props.
    pub obstacles: Vec<ChartObstacle>,
    /// Traffic lights.
    pub signals: Vec<ChartSignal>,
}

/// A lane, crossing or sidewalk.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChartLane {
    /// SUMO's id.
    pub id: String,
    /// Its edge.
    pub edge: String,
    /// Number within the edge, from the right.
    pub index: u32,
    /// `car`, `bus`, `bicycle`, `sidewalk`, `crossing`, `rail` or `verge`.
    pub kind: &'static str,
    /// A way across a junction.
    pub inside: bool,
    /// Metres.
    pub width_m: f64,
    /// Marking of the right edge: `solid`, `dashed`, `none`.
    pub right: &'static str,
    /// Marking of the left edge.
    pub left: &'static str,
    /// Centre line, metres.
    pub points_m: Vec<[f64; 3]>,
}

/// A polygon on the ground.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChartArea {
    /// SUMO's id.
    pub id: String,
    /// `junction` or `walking_area`.
    pub kind: &'static str,
    /// Outline, not closed, metres.
    pub points_m: Vec<[f64; 3]>,
}

/// An upright prism.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChartBuilding {
    /// SUMO's id of the polygon.
    pub id: String,
    /// `building`, `wall` or `structure`.
    pub kind: &'static str,
    /// Outline, counter-clockwise, not closed, metres.
    pub points_m: Vec<[f64; 2]>,
    /// Height of the ground, metres.
    pub base_m: f64,
    /// Above the base, metres.
    pub height_m: f64,
}

/// A prop.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChartObstacle {
    /// Its name in the catalogue.
    pub kind: &'static str,
    /// On the ground, metres.
    pub center_m: [f64; 3],
    /// Counter-clockwise from east, radians.
    pub yaw_rad: f64,
    /// Length, width, height, metres.
    pub size_m: [f64; 3],
}

/// A traffic light.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChartSignal {
    /// SUMO's id.
    pub id: String,
    /// Its hash, as traffic lights carry it.
    pub id_hash: String,
    /// The links that it controls, by number.
    pub links: Vec<ChartLink>,
}

/// Position of a link of a traffic light.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChartLink {
    /// Its number.
    pub link: u32,
    /// The lane that it controls.
    pub lane: String,
    /// End of that lane; of a crossing its begin. Metres.
    pub position_m: [f64; 3],
    /// Heading of the traffic there, radians.
    pub yaw_rad: f64,
}

/// Attributes that only the net file has.
#[derive(Default)]
struct NetAttributes {
    /// Classes that a lane admits, where it names them.
    allowed: BTreeMap<String, String>,
    /// Traffic light and link → from lane, to lane.
    links: BTreeMap<(String, u32), (String, String)>,
}

impl NetAttributes {
    fn read(path: &Path) -> Result<Self, SceneError> {
        let mut net = Self::default();
        if path.as_os_str().is_empty() {
            return Ok(net);
        }
        for_each_tag(path, |tag, _| {
            let XmlTag::Open(element) = tag else { return Ok(()) };
            match element.local_name().as_ref() {
                "lane" => net.add_lane(element),
                "connection" => net.add_link(element),
                _ => {}
            }
            Ok(())
        })?;
        Ok(net)
    }

    fn add_lane(&mut self, element: &BytesStart<'_>) {
        if let (Some(id), Some(allowed)) = (attribute(element, "id"), attribute(element, "allow")) {
            self.allowed.insert(id, allowed);
        }
    }

    fn add_link(&mut self, element: &BytesStart<'_>) {
        let number = |name| attribute(element, name).and_then(|text| text.parse::<u32>().ok());
        let (Some(signal), Some(link)) = (attribute(element, "tl"), number("linkIndex")) else {
            return;
        };
        let lane = |edge, index| Some(format!("{}_{}", attribute(element, edge)?, number(index)?));
        if let (Some(from), Some(to)) = (lane("from", "fromLane"), lane("to", "toLane")) {
            self.links.entry((signal, link)).or_insert((from, to));
        }
    }
}

impl Chart {
    /// The chart of a run's scene.
    ///
    /// # Errors
    /// The net file is unreadable or malformed.
    pub fn of_run(run: &RunFile, scene: &Scene) -> Result<Self, SceneError> {
        let net = NetAttributes::read(&run.scene_files.net_file)?;
        let pieces = scene.road().pieces();
        let kinds: BTreeMap<&str, &'static str> = pieces
            .iter()
            .filter_map(|piece| Some((piece.id.as_str(), lane_kind(piece, &net)?)))
            .collect();
        Ok(Self {
            lanes: pieces.iter().filter_map(|piece| lane(piece, &kinds)).collect(),
            areas: pieces.iter().filter_map(area).collect(),
            buildings: scene.buildings().iter().map(building).collect(),
            obstacles: scene.props().iter().map(obstacle).collect(),
            signals: signals(&net, pieces),
        })
    }

    /// Writes it, whole or not at all. Waits while the disk is full.
    ///
    /// # Errors
    /// Not writable.
    pub fn write(&self, path: &Path) -> std::io::Result<()> {
        let text = serde_json::to_vec(self)?;
        let partial = path.with_extension("partial");
        ipc_schema::storage::when_there_is_space(path, || {
            if let Some(directory) = path.parent() {
                std::fs::create_dir_all(directory)?;
            }
            std::fs::write(&partial, &text)?;
            std::fs::rename(&partial, path)
        })
    }
}

/// The kind of a strip; `None` for polygons.
fn lane_kind(piece: &RoadPiece, net: &NetAttributes) -> Option<&'static str> {
    piece.half_width_m?;
    Some(match piece.surface {
        SurfaceKind::Crossing => "crossing",
        SurfaceKind::Sidewalk => "sidewalk",
        SurfaceKind::Track => "rail",
        SurfaceKind::Verge => "verge",
        _ => {
            let allowed = net.allowed.get(&piece.id).map_or("", String::as_str);
            let only = |classes: &[&str]| {
                !allowed.trim().is_empty() && allowed.split_whitespace().all(|class| classes.contains(&class))
            };
            if only(&["bicycle", "scooter", "pedestrian"]) {
                "bicycle"
            } else if only(&BUS_CLASSES) {
                "bus"
            } else {
                "car"
            }
        }
    })
}

fn lane(piece: &RoadPiece, kinds: &BTreeMap<&str, &'static str>) -> Option<ChartLane> {
    let kind = *kinds.get(piece.id.as_str())?;
    let (edge, index) = piece.id.rsplit_once('_')?;
    let index: u32 = index.parse().ok()?;
    let inside = piece.id.starts_with(':');
    let beside = |index: Option<u32>| {
        let neighbour = kinds.get(format!("{edge}_{}", index?).as_str()).copied();
        neighbour.filter(|neighbour| *neighbour == kind)
    };
    let marking = |index| match (inside, beside(index)) {
        (true, _) => "none",
        (false, Some(_)) => "dashed",
        (false, None) => "solid",
    };
    Some(ChartLane {
        id: piece.id.clone(),
        edge: edge.to_owned(),
        index,
        kind,
        inside,
        width_m: centimetres(2.0 * piece.half_width_m?),
        right: marking(index.checked_sub(1)),
        left: marking(index.checked_add(1)),
        points_m: piece.shape_m.iter().map(|point| point.map(centimetres)).collect(),
    })
}

fn area(piece: &RoadPiece) -> Option<ChartArea> {
    let kind = match (piece.half_width_m, piece.surface) {
        (None, SurfaceKind::Junction) => "junction",
        (None, SurfaceKind::WalkingArea) => "walking_area",
        _ => return None,
    };
    Some(ChartArea {
        id: piece.id.clone(),
        kind,
        points_m: piece.shape_m.iter().map(|point| point.map(centimetres)).collect(),
    })
}

fn building(prism: &Prism) -> ChartBuilding {
    ChartBuilding {
        id: prism.id.clone(),
        kind: match prism.class {
            SolidClass::Building => "building",
            SolidClass::Wall => "wall",
            SolidClass::Structure => "structure",
        },
        points_m: prism.outline_m.iter().map(|point| point.map(centimetres)).collect(),
        base_m: centimetres(prism.base_z_m),
        height_m: centimetres(prism.height_m),
    }
}

fn obstacle(prop: &Prop) -> ChartObstacle {
    let body = &prop.body;
    ChartObstacle {
        kind: prop.kind.name,
        center_m: [body.centre_m[0], body.centre_m[1], body.z_m[0]].map(centimetres),
        yaw_rad: libm::atan2(body.along[1], body.along[0]),
        size_m: [prop.kind.length_m, prop.kind.width_m, prop.kind.height_m],
    }
}

fn signals(net: &NetAttributes, pieces: &[RoadPiece]) -> Vec<ChartSignal> {
    let strips: BTreeMap<&str, &RoadPiece> = pieces
        .iter()
        .filter(|piece| piece.half_width_m.is_some())
        .map(|piece| (piece.id.as_str(), piece))
        .collect();
    let mut signals: BTreeMap<&str, Vec<ChartLink>> = BTreeMap::new();
    for ((signal, link), (from, to)) in &net.links {
        let links = signals.entry(signal).or_default();
        links.extend(place(&strips, from, to).map(|(lane, position_m, yaw_rad)| ChartLink {
            link: *link,
            lane: lane.to_owned(),
            position_m: position_m.map(centimetres),
            yaw_rad,
        }));
    }
    let signal = |(id, links): (&str, Vec<ChartLink>)| ChartSignal {
        id: id.to_owned(),
        id_hash: format!("{:#018x}", id_hash(id)),
        links,
    };
    signals.into_iter().map(signal).collect()
}

/// The stop position of a controlled road user: at the end of its lane, or in front of the crossing that it takes.
fn place<'a>(strips: &BTreeMap<&str, &RoadPiece>, from: &'a str, to: &'a str) -> Option<(&'a str, [f64; 3], f64)> {
    let heading = |a: [f64; 3], b: [f64; 3]| libm::atan2(b[1] - a[1], b[0] - a[0]);
    if let Some(crossing) = strips.get(to).filter(|piece| piece.surface == SurfaceKind::Crossing) {
        let [first, second] = *crossing.shape_m.first_chunk()?;
        return Some((to, first, heading(first, second)));
    }
    let [before, last] = *strips.get(from)?.shape_m.last_chunk()?;
    Some((from, last, heading(before, last)))
}

/// SUMO writes no more digits.
fn centimetres(value_m: f64) -> f64 {
    libm::round(value_m * 100.0) / 100.0
}
