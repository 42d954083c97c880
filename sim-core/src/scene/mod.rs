//! The static scene: buildings, props and the road surface, read once from SUMO's own files, the same for collisions and for rays.
//!
//! A pure function of net file, additional files, configuration and seed: processes that need it read it themselves.

use std::{path::PathBuf, sync::Arc};

use ipc_schema::{
    failure::{Failure, FailureKind},
    props::{Obstacle, PropKind},
    run::{MapInfo, RunFile, RunMap, SceneFiles},
};

use crate::geodesy::GeodesyError;

mod building;
pub mod chart;
mod deck;
mod grid;
mod level;
mod prop;
mod road;
pub mod shape;
mod xml;

use building::FoundObjects;
pub use building::{Prism, SolidClass};
pub use deck::DeckSlice;
pub use grid::Grid;
pub use prop::Prop;
pub use road::{NO_JUNCTION, Road, RoadPiece, SurfaceKind};
use shape::{Bounds, Point};

/// Size of a cell of the index over buildings and props, metres.
const CELL_M: f64 = 20.0;
/// Distance from a building within which a road sets the height of the ground, metres; doubled until there is a road.
const GROUND_REACH_M: f64 = 25.0;
/// Beyond this distance from any road the ground has no height of its own, metres.
const GROUND_LIMIT_M: f64 = 2_000.0;

/// The scene cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file cannot be read.
    #[error("cannot read {path}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// A file is not XML.
    #[error("{path}, line {line}: not well-formed XML: {reason}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line in it.
        line: usize,
        /// Why.
        reason: String,
    },
    /// A value is not usable.
    #[error("{path}, line {line}: \"{value}\" is not a usable {what}")]
    Value {
        /// The file.
        path: PathBuf,
        /// Line in it.
        line: usize,
        /// Attribute.
        what: &'static str,
        /// The value.
        value: String,
    },
    /// A polygon in latitude and longitude cannot be brought onto the map.
    #[error("{path}: polygon \"{id}\" is in longitude and latitude and cannot be brought onto the map")]
    Geodetic {
        /// The file.
        path: PathBuf,
        /// The polygon.
        id: String,
        /// Why.
        #[source]
        source: GeodesyError,
    },
}

impl From<SceneError> for Failure {
    fn from(error: SceneError) -> Self {
        let help = match &error {
            SceneError::Unreadable { .. } => "check the path and its permissions".to_owned(),
            SceneError::Malformed { .. } | SceneError::Value { .. } => {
                "correct the file; `netedit` shows its shapes".into()
            }
            SceneError::Geodetic { .. } => {
                "give polygons in net coordinates, or a net whose projection covers them".into()
            }
        };
        Self::from_error(FailureKind::Config, &error).with_help(help)
    }
}

/// All static objects.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    road: Road,
    buildings: Vec<Prism>,
    props: Vec<Prop>,
    /// Over buildings, then props.
    index: Grid,
}

impl Scene {
    /// Reads the scene of a run. A run without a net file has an empty one.
    ///
    /// # Errors
    /// A file is unreadable or malformed.
    pub fn of_run(run: &RunFile) -> Result<Self, SceneError> {
        Self::of_map(run, &run.scene_files, &run.map)
    }

    /// Reads the scene of every map of a run, in the order of [`RunFile::every_map`].
    ///
    /// # Errors
    /// As [`Scene::of_run`].
    pub fn of_every_map(run: &RunFile) -> Result<Vec<Arc<Self>>, SceneError> {
        let scene = |map: RunMap| Self::of_map(run, &map.scene_files, &map.info).map(Arc::new);
        run.every_map().into_iter().map(scene).collect()
    }

    fn of_map(run: &RunFile, files: &SceneFiles, map: &MapInfo) -> Result<Self, SceneError> {
        let config = &run.config.scene;
        let mut scene = Self::read(files, map, config.building_height_m)?;
        let placed: Vec<Prop> = config.obstacles.iter().map(|obstacle| scene.prop(obstacle)).collect();
        let placed = std::mem::take(&mut scene.props).into_iter().chain(placed).collect();
        scene.set_props(placed);
        let random = prop::beside_the_road(&scene, config.random_props, run.config.run.seed);
        let mut all = std::mem::take(&mut scene.props);
        all.extend(random);
        scene.set_props(all);
        Ok(scene)
    }

    /// Reads roads and buildings from the files, those without a height `building_height_m` high.
    ///
    /// # Errors
    /// A file is unreadable or malformed.
    pub fn read(files: &SceneFiles, map: &MapInfo, building_height_m: f64) -> Result<Self, SceneError> {
        let road = if files.net_file.as_os_str().is_empty() {
            Road::default()
        } else {
            Road::read(&files.net_file, map.world_origin_m)?
        };
        let mut found = FoundObjects::default();
        for file in &files.additional_files {
            let ground_m = |point| ground_height_m(&road, point);
            building::read(file, map, building_height_m, &ground_m, &mut found)?;
        }
        let mut scene = Self::new(road, found.solids, Vec::new());
        let kind = PropKind::by_name("tree");
        let trees = kind
            .into_iter()
            .flat_map(|kind| found.trees_m.iter().map(move |&stem_m| (kind, stem_m)));
        let trees = trees.map(|(kind, stem_m)| scene.prop_at(kind, stem_m, 0.0)).collect();
        scene.set_props(trees);
        Ok(scene)
    }

    /// A scene from its parts.
    #[must_use]
    pub fn new(road: Road, buildings: Vec<Prism>, props: Vec<Prop>) -> Self {
        let mut scene = Self {
            road,
            buildings,
            ..Self::default()
        };
        scene.set_props(props);
        scene
    }

    fn set_props(&mut self, props: Vec<Prop>) {
        self.props = props;
        let bounds: Vec<Bounds> = self.bounds().collect();
        self.index = Grid::new(&bounds, CELL_M);
    }

    /// Bounds of every building, then of every prop.
    pub fn bounds(&self) -> impl Iterator<Item = Bounds> + '_ {
        let buildings = self.buildings.iter().map(|building| building.bounds);
        buildings.chain(self.props.iter().map(|prop| prop.body.bounds()))
    }

    /// An obstacle of the configuration, on the ground.
    #[must_use]
    pub fn prop(&self, obstacle: &Obstacle) -> Prop {
        self.prop_at(obstacle.kind, obstacle.centre_m, obstacle.heading_deg.to_radians())
    }

    /// A prop with its centre at `centre_m`, on the ground.
    fn prop_at(&self, kind: &'static PropKind, centre_m: Point, yaw_rad: f64) -> Prop {
        Prop::new(kind, centre_m, yaw_rad, ground_height_m(&self.road, centre_m))
    }

    /// The road surface.
    #[must_use]
    pub fn road(&self) -> &Road {
        &self.road
    }

    /// Buildings and other solid polygons, in the order of the files.
    #[must_use]
    pub fn buildings(&self) -> &[Prism] {
        &self.buildings
    }

    /// Trees of the additional files, obstacles of the configuration, then props placed at random.
    #[must_use]
    pub fn props(&self) -> &[Prop] {
        &self.props
    }

    /// True if vehicles drive there: on a lane, in a junction or on a crossing; sidewalks and rails are no road.
    #[must_use]
    pub fn is_on_road(&self, x_m: f64, y_m: f64) -> bool {
        self.road.under([x_m, y_m]).any(|(piece, _)| piece.surface.is_road())
    }

    /// True if there are lanes at a point outside junctions, and all of them lead against the heading `yaw_rad`.
    #[must_use]
    pub fn is_against_traffic(&self, x_m: f64, y_m: f64, yaw_rad: f64) -> bool {
        let (sin, cos) = libm::sincos(yaw_rad);
        let mut against = self
            .road
            .lane_directions([x_m, y_m])
            .map(|[dx, dy]| cos * dx + sin * dy < -0.5);
        against.next().is_some_and(|first| first && against.all(|other| other))
    }

    /// Decks on which roads of a net with elevation pass over others, in slices.
    #[must_use]
    pub fn decks(&self) -> &[DeckSlice] {
        self.road.decks()
    }

    /// Height of the ground: of the lowest road, or of the nearest one. Roads on decks do not count. Metres.
    #[must_use]
    pub fn ground_height_m(&self, x_m: f64, y_m: f64) -> f64 {
        ground_height_m(&self.road, [x_m, y_m])
    }

    /// A building or prop by its number in [`Scene::bounds`] and [`Scene::solids_near`].
    #[must_use]
    pub fn solid(&self, number: u32) -> Solid<'_> {
        let number = number as usize;
        match self.buildings.get(number) {
            Some(building) => Solid::Building(building),
            None => Solid::Prop(&self.props[number - self.buildings.len()]),
        }
    }

    /// Numbers of buildings and props whose bounds may meet `bounds`, ascending, into `found`.
    pub fn solids_near(&self, bounds: &Bounds, found: &mut Vec<u32>) {
        self.index.near(bounds, found);
    }
}

/// A static object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Solid<'a> {
    /// A building.
    Building(&'a Prism),
    /// A prop.
    Prop(&'a Prop),
}

fn ground_height_m(road: &Road, point: Point) -> f64 {
    if let Some(height_m) = road.flat_height_m() {
        return height_m;
    }
    if let Some(height_m) = road.ground_under_m(point) {
        return height_m;
    }
    let mut reach_m = GROUND_REACH_M;
    while reach_m < GROUND_LIMIT_M {
        if let Some(height_m) = road.nearest_ground_m(point, reach_m) {
            return height_m;
        }
        reach_m *= 2.0;
    }
    0.0
}
