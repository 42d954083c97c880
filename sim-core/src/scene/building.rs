//! Objects beside the road, from polygon files: which polygons are solid, and how high, and which points are trees.

use std::path::{Path, PathBuf};

use ipc_schema::run::MapInfo;
use quick_xml::events::BytesStart;

use super::{
    SceneError,
    shape::{Bounds, Point, contains, from_to, hull, is_simple, signed_area},
    xml::{ElementPosition, XmlTag, attribute, for_each_tag, points},
};
use crate::geodesy::{Geodetic, Projection};

/// Height of a storey, metres (OSM's own advice for `building:levels`).
const STOREY_M: f64 = 3.0;
/// A smaller polygon is a mistake, m².
const SMALLEST_M2: f64 = 0.01;

/// What a solid polygon is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum SolidClass {
    /// A building, or a part of one.
    Building = 0,
    /// A wall or fence.
    Wall = 1,
    /// Towers, silos, tanks.
    Structure = 2,
}

/// Types of building that traffic passes under, or that do not exist: never solid by their type.
const OPEN_TYPES: [&str; 4] = [
    "building.roof",
    "building.carport",
    "building.construction",
    "building.no",
];

/// Types of polygon that are solid, with the height of those that state none (`None`: `scene.building_height_m`). A type matches a
/// row if it is its name or begins with it and a dot; the first row that matches counts. Every other type (parks, water, land
/// use, parking, …) is solid only if its polygon states a height. Heights: one to five storeys of 3 m with a roof for houses,
/// offices and shops; a common size for works.
const SOLID_TYPES: [(&str, SolidClass, Option<f64>); 20] = [
    ("building.house", SolidClass::Building, Some(7.0)),
    ("building.detached", SolidClass::Building, Some(7.0)),
    ("building.terrace", SolidClass::Building, Some(8.0)),
    ("building.apartments", SolidClass::Building, Some(15.0)),
    ("building.office", SolidClass::Building, Some(15.0)),
    ("building.hotel", SolidClass::Building, Some(15.0)),
    ("building.hospital", SolidClass::Building, Some(15.0)),
    ("building.school", SolidClass::Building, Some(10.0)),
    ("building.church", SolidClass::Building, Some(15.0)),
    ("building.retail", SolidClass::Building, Some(6.0)),
    ("building.industrial", SolidClass::Building, Some(8.0)),
    ("building.garage", SolidClass::Building, Some(3.0)),
    ("building.garages", SolidClass::Building, Some(3.0)),
    ("building.shed", SolidClass::Building, Some(3.0)),
    ("building.kiosk", SolidClass::Building, Some(3.0)),
    ("building", SolidClass::Building, None),
    ("barrier.wall", SolidClass::Wall, Some(2.0)),
    ("man_made.tower", SolidClass::Structure, Some(20.0)),
    ("man_made.silo", SolidClass::Structure, Some(15.0)),
    ("man_made.storage_tank", SolidClass::Structure, Some(10.0)),
];

/// Type of a point that is a tree, as polyconvert names OpenStreetMap's.
const TREE: &str = "natural.tree";

/// What additional files hold.
#[derive(Debug, Default)]
pub(super) struct FoundObjects {
    /// Solid polygons.
    pub(super) solids: Vec<Prism>,
    /// Stems of trees, world, metres.
    pub(super) trees_m: Vec<Point>,
}

/// A vertical wall around a simple polygon, with a flat roof.
#[derive(Debug, Clone, PartialEq)]
pub struct Prism {
    /// SUMO's id of the polygon.
    pub id: String,
    /// What it is.
    pub class: SolidClass,
    /// Corners, counter-clockwise, the first not repeated, metres.
    pub outline_m: Vec<Point>,
    /// The rectangle about it.
    pub bounds: Bounds,
    /// Height of the ground it stands on, metres.
    pub base_z_m: f64,
    /// Of the roof above the base, metres.
    pub height_m: f64,
}

impl Prism {
    /// A prism over `outline_m` in any order of corners; one that crosses itself is replaced by its convex hull. `None` if it covers
    /// nothing.
    #[must_use]
    pub fn new(id: String, class: SolidClass, mut outline_m: Vec<Point>, base_z_m: f64, height_m: f64) -> Option<Self> {
        outline_m.dedup();
        while outline_m.len() > 1 && outline_m.first() == outline_m.last() {
            outline_m.pop();
        }
        if outline_m.len() < 3 {
            return None;
        }
        if !is_simple(&outline_m) {
            outline_m = hull(&outline_m);
        }
        let area_m2 = signed_area(&outline_m);
        if area_m2.abs() < SMALLEST_M2 {
            return None;
        }
        if area_m2 < 0.0 {
            outline_m.reverse();
        }
        Some(Self {
            id,
            class,
            bounds: Bounds::of(outline_m.iter().copied()),
            outline_m,
            base_z_m,
            height_m,
        })
    }

    /// Heights of base and roof, metres.
    #[must_use]
    pub fn z_m(&self) -> [f64; 2] {
        [self.base_z_m, self.base_z_m + self.height_m]
    }

    /// True if `point` is inside the walls.
    #[must_use]
    pub fn contains(&self, point: Point) -> bool {
        self.bounds.holds(point) && contains(&self.outline_m, point)
    }
}

/// Class and default height of a type of polygon; `None` if it is not solid by itself.
fn by_type(name: &str) -> Option<(SolidClass, Option<f64>)> {
    let matches = |row: &str| {
        name.strip_prefix(row)
            .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    if OPEN_TYPES.iter().any(|row| matches(row)) {
        return None;
    }
    let found = SOLID_TYPES.iter().find(|(row, ..)| matches(row));
    found.map(|(_, class, height_m)| (*class, *height_m))
}

/// A polygon as it is read, until its element ends.
#[derive(Debug, Default)]
struct SolidPolygon {
    id: String,
    kind: String,
    shape: Vec<[f64; 3]>,
    is_geodetic: bool,
    height_m: Option<f64>,
    levels: Option<f64>,
}

impl SolidPolygon {
    fn open(element: &BytesStart<'_>, place: &ElementPosition<'_>) -> Result<Self, SceneError> {
        let text = |name: &str| attribute(element, name).unwrap_or_default();
        Ok(Self {
            id: text("id"),
            kind: text("type"),
            shape: points(&text("shape"), place)?,
            is_geodetic: matches!(text("geo").as_str(), "1" | "true" | "yes" | "on" | "x" | "t" | "True"),
            height_m: attribute(element, "height").as_deref().and_then(metres),
            levels: None,
        })
    }

    fn parameter(&mut self, element: &BytesStart<'_>) {
        let (Some(key), Some(value)) = (attribute(element, "key"), attribute(element, "value")) else {
            return;
        };
        match key.as_str() {
            "height" | "building:height" => self.height_m = metres(&value).or(self.height_m),
            "building:levels" => self.levels = metres(&value),
            _ => {}
        }
    }

    /// Height: what it states, else its storeys, else by type, else `fallback_m`; `None` if it is not solid.
    fn class_and_height(&self, fallback_m: f64) -> Option<(SolidClass, f64)> {
        let stated = self.height_m.or(self.levels.map(|levels| levels * STOREY_M));
        match (by_type(&self.kind), stated) {
            (Some((class, by_type_m)), stated) => Some((class, stated.or(by_type_m).unwrap_or(fallback_m))),
            (None, Some(height_m)) => Some((SolidClass::Structure, height_m)),
            (None, None) => None,
        }
    }
}

/// "12.5", "12.5 m": a positive length.
fn metres(text: &str) -> Option<f64> {
    let number = text.trim().trim_end_matches('m').trim();
    number
        .parse()
        .ok()
        .filter(|height: &f64| height.is_finite() && *height > 0.0)
}

/// Reads the solid polygons of an additional file, and of those it includes.
pub(super) fn read(
    path: &Path,
    map: &MapInfo,
    fallback_m: f64,
    ground_m: &dyn Fn(Point) -> f64,
    into: &mut FoundObjects,
) -> Result<(), SceneError> {
    read_included(&mut vec![path.into()], map, fallback_m, ground_m, into)
}

/// Reads the last file of `open_files`, each of which includes the next one.
fn read_included(
    open_files: &mut Vec<PathBuf>,
    map: &MapInfo,
    fallback_m: f64,
    ground_m: &dyn Fn(Point) -> f64,
    into: &mut FoundObjects,
) -> Result<(), SceneError> {
    let path = &*open_files.last().cloned().unwrap_or_default();
    let mut open: Option<SolidPolygon> = None;
    let mut included: Vec<PathBuf> = Vec::new();
    let mut projection: Option<Projection> = None;
    for_each_tag(path, |tag, place| {
        match tag {
            XmlTag::Open(element) => match element.local_name().as_ref() {
                "poly" | "polygon" => open = Some(SolidPolygon::open(element, place)?),
                "param" => open.iter_mut().for_each(|polygon| polygon.parameter(element)),
                "poi" => into.trees_m.extend(tree(element, path, map, &mut projection)?),
                "include" => included.extend(attribute(element, "href").map(|href| path.with_file_name(href))),
                _ => {}
            },
            XmlTag::Close("poly" | "polygon") => {
                if let Some(polygon) = open.take() {
                    into.solids
                        .extend(prism(polygon, path, map, fallback_m, ground_m, &mut projection)?);
                }
            }
            XmlTag::Close(_) => {}
        }
        Ok(())
    })?;
    for file in included {
        let is_same = |open: &PathBuf| open.canonicalize().ok() == file.canonicalize().ok();
        // SUMO refuses a file that includes itself, by whatever way.
        if !open_files.iter().any(is_same) {
            open_files.push(file);
            read_included(open_files, map, fallback_m, ground_m, into)?;
            open_files.pop();
        }
    }
    Ok(())
}

/// Where the tree stands that a point is; `None` for another point.
fn tree(
    element: &BytesStart<'_>,
    path: &Path,
    map: &MapInfo,
    projection: &mut Option<Projection>,
) -> Result<Option<Point>, SceneError> {
    if attribute(element, "type").as_deref() != Some(TREE) {
        return Ok(None);
    }
    let number = |name: &str| {
        attribute(element, name)?
            .parse::<f64>()
            .ok()
            .filter(|number| number.is_finite())
    };
    if let (Some(x), Some(y)) = (number("x"), number("y")) {
        return Ok(Some(from_to(map.world_origin_m, [x, y])));
    }
    let (Some(longitude_deg), Some(latitude_deg)) = (number("lon"), number("lat")) else {
        return Ok(None);
    };
    let geodetic = |source| SceneError::Geodetic {
        path: path.into(),
        id: attribute(element, "id").unwrap_or_default(),
        source,
    };
    let projection = match projection {
        Some(projection) => projection,
        None => projection.insert(Projection::new(map).map_err(geodetic)?),
    };
    let place = projection.net_from_geodetic(Geodetic {
        latitude_deg,
        longitude_deg,
    });
    place.map(|place| Some([place.x_m, place.y_m])).map_err(geodetic)
}

fn prism(
    polygon: SolidPolygon,
    path: &Path,
    map: &MapInfo,
    fallback_m: f64,
    ground_m: &dyn Fn(Point) -> f64,
    projection: &mut Option<Projection>,
) -> Result<Option<Prism>, SceneError> {
    let Some((class, height_m)) = polygon.class_and_height(fallback_m) else {
        return Ok(None);
    };
    let mut outline_m: Vec<Point> = polygon.shape.iter().map(|[x, y, _]| [*x, *y]).collect();
    if !polygon.is_geodetic {
        for point in &mut outline_m {
            *point = from_to(map.world_origin_m, *point);
        }
    }
    if polygon.is_geodetic {
        let geodetic = |source| SceneError::Geodetic {
            path: path.into(),
            id: polygon.id.clone(),
            source,
        };
        let projection = match projection {
            Some(projection) => projection,
            None => projection.insert(Projection::new(map).map_err(geodetic)?),
        };
        for point in &mut outline_m {
            let place = projection.net_from_geodetic(Geodetic {
                latitude_deg: point[1],
                longitude_deg: point[0],
            });
            let place = place.map_err(geodetic)?;
            *point = [place.x_m, place.y_m];
        }
    }
    // Base: the lowest corner, or the lowest ground under a corner.
    let heights = polygon
        .shape
        .iter()
        .zip(&outline_m)
        .map(|([.., z], point)| if z.is_nan() { ground_m(*point) } else { *z });
    let base_z_m = heights.fold(f64::INFINITY, f64::min);
    Ok(Prism::new(polygon.id, class, outline_m, base_z_m, height_m))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_are_solid_or_not_by_one_table() {
        assert_eq!(by_type("building"), Some((SolidClass::Building, None)));
        assert_eq!(by_type("building.yes"), Some((SolidClass::Building, None)));
        assert_eq!(by_type("building.garage"), Some((SolidClass::Building, Some(3.0))));
        for flat in [
            "building.roof",
            "park",
            "landuse.forest",
            "amenity.parking",
            "natural.water",
            "",
            "buildings",
        ] {
            assert_eq!(by_type(flat), None, "{flat}");
        }
    }

    #[test]
    fn a_stated_height_wins_over_storeys_over_type_over_fallback() {
        let mut polygon = SolidPolygon {
            kind: "building.house".into(),
            ..SolidPolygon::default()
        };
        assert_eq!(polygon.class_and_height(9.0), Some((SolidClass::Building, 7.0)));
        polygon.levels = Some(4.0);
        assert_eq!(polygon.class_and_height(9.0), Some((SolidClass::Building, 12.0)));
        polygon.height_m = metres("10.5 m");
        assert_eq!(polygon.class_and_height(9.0), Some((SolidClass::Building, 10.5)));
        polygon.kind = "park".into();
        assert_eq!(polygon.class_and_height(9.0), Some((SolidClass::Structure, 10.5)));
        let plain = SolidPolygon {
            kind: "building".into(),
            ..SolidPolygon::default()
        };
        assert_eq!(plain.class_and_height(9.0), Some((SolidClass::Building, 9.0)));
        assert_eq!(metres("-3"), None);
    }

    #[test]
    fn outlines_come_out_simple_and_counter_clockwise() {
        let prism = |outline: &[Point]| Prism::new("a".into(), SolidClass::Building, outline.to_vec(), 0.0, 3.0);
        let clockwise = prism(&[[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]).unwrap();
        assert_eq!(clockwise.outline_m.len(), 4);
        assert!(signed_area(&clockwise.outline_m) > 0.0);
        let bow = prism(&[[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 2.0]]).unwrap();
        assert!((signed_area(&bow.outline_m) - 4.0).abs() < 1e-12);
        assert!(prism(&[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]).is_none());
    }
}
