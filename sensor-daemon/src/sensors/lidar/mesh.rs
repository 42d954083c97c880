//! Ground that is not flat, and triangle meshes: single rays are cast through a hierarchy of boxes.

use ipc_schema::{
    config::MeshPlacement,
    pointcloud::{GROUND, STATIC_OBJECT, Tag},
};
use parry3d_f64::{
    math::Vector,
    query::{Ray, RayCast},
    shape::TriMesh,
};
use sim_core::scene::{Scene, shape::Bounds};

use super::error::LidarError;

/// Least size of a cell of the ground, metres.
const GROUND_CELL_M: f64 = 5.0;
/// Most cells of the ground: larger nets get larger cells.
const GROUND_CELLS: f64 = 250_000.0;
/// Width of the ground beyond the outermost road, metres.
const MARGIN_M: f64 = 100.0;

/// One mesh in the world.
struct Mesh {
    triangles: TriMesh,
    object: u32,
}

impl Mesh {
    fn word(&self) -> u32 {
        match self.object {
            GROUND => Tag::Ground as u32,
            _ => Tag::Mesh as u32,
        }
    }
}

impl std::fmt::Debug for Mesh {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("Mesh")
            .field("object", &self.object)
            .finish_non_exhaustive()
    }
}

/// All meshes of a scene.
#[derive(Debug, Default)]
pub(super) struct SceneMeshes {
    ground: Option<Mesh>,
    placed: Vec<Mesh>,
}

/// Hit of a ray on a mesh.
#[derive(Debug, Clone, Copy)]
pub(super) struct MeshHit {
    pub(super) range_m: f64,
    pub(super) incidence_cos: f64,
    pub(super) object: u32,
    /// Tag.
    pub(super) word: u32,
}

impl SceneMeshes {
    pub(super) fn new(
        placements: &[MeshPlacement],
        scene: &Scene,
        ground: Option<&GroundGrid>,
    ) -> Result<Self, LidarError> {
        let mut placed = Vec::new();
        let first = (scene.buildings().len() + scene.props().len()) as u32;
        for (number, placement) in (first..).zip(placements) {
            placed.push(Mesh {
                triangles: read(placement, scene)?,
                object: STATIC_OBJECT | number,
            });
        }
        Ok(Self {
            ground: ground.and_then(GroundGrid::mesh),
            placed,
        })
    }

    /// Neither meshes nor, with `with_ground`, the ground.
    pub(super) fn is_empty(&self, with_ground: bool) -> bool {
        self.placed.is_empty() && (self.ground.is_none() || !with_ground)
    }

    /// The nearest hit of a ray within `range_m`, on the ground too if `with_ground`; `direction` has length 1.
    pub(super) fn cast(
        &self,
        origin_m: [f64; 3],
        direction: [f64; 3],
        range_m: f64,
        with_ground: bool,
    ) -> Option<MeshHit> {
        let vector = |[x, y, z]: [f64; 3]| Vector::new(x, y, z);
        let ray = Ray::new(vector(origin_m), vector(direction));
        let mut nearest: Option<MeshHit> = None;
        for mesh in self.ground.iter().filter(|_| with_ground).chain(&self.placed) {
            let most_m = nearest.map_or(range_m, |hit| hit.range_m);
            if let Some(hit) = mesh.triangles.cast_local_ray_and_get_normal(&ray, most_m, false) {
                nearest = Some(MeshHit {
                    range_m: hit.time_of_impact,
                    incidence_cos: hit.normal.dot(ray.dir).abs(),
                    object: mesh.object,
                    word: mesh.word(),
                });
            }
        }
        nearest
    }
}

/// Height of the ground if it is flat: in a net without elevation, and without a net.
pub(in crate::sensors) fn flat_ground_m(scene: &Scene) -> Option<f64> {
    let road = scene.road();
    road.flat_height_m().or(road.pieces().is_empty().then_some(0.0))
}

/// The ground between and about the roads of a net with elevation: heights at the corners of a grid.
#[derive(Debug, Clone)]
pub(in crate::sensors) struct GroundGrid {
    pub(in crate::sensors) min_m: [f64; 2],
    pub(in crate::sensors) cell_m: f64,
    /// Corners in a row and in a column, two at least.
    pub(in crate::sensors) corners: [usize; 2],
    /// Row by row.
    heights_m: Vec<f64>,
}

impl GroundGrid {
    /// As tall as the nearest road at each corner; `None` if the ground is flat.
    pub(in crate::sensors) fn new(scene: &Scene) -> Option<Self> {
        if flat_ground_m(scene).is_some() {
            return None;
        }
        let corners = scene.road().pieces().iter().flat_map(|piece| &piece.shape_m);
        let bounds = Bounds::of(corners.map(|[x, y, _]| [*x, *y])).grown(MARGIN_M);
        let size = [0, 1].map(|axis: usize| bounds.max_m[axis] - bounds.min_m[axis]);
        let cell_m = GROUND_CELL_M.max((size[0] * size[1] / GROUND_CELLS).sqrt());
        let mut grid = Self {
            min_m: bounds.min_m,
            cell_m,
            corners: size.map(|length_m| (length_m / cell_m).ceil() as usize + 1),
            heights_m: Vec::new(),
        };
        let [columns, rows] = grid.corners;
        let places = (0..columns * rows).map(|corner| grid.place(corner % columns, corner / columns));
        grid.heights_m = places.map(|[x, y]| scene.ground_height_m(x, y)).collect();
        Some(grid)
    }

    /// Heights of all corners, row by row, metres.
    pub(in crate::sensors) fn heights_m(&self) -> &[f64] {
        &self.heights_m
    }

    fn place(&self, column: usize, row: usize) -> [f64; 2] {
        [
            self.min_m[0] + column as f64 * self.cell_m,
            self.min_m[1] + row as f64 * self.cell_m,
        ]
    }

    /// A corner in the world.
    #[inline(always)]
    pub(in crate::sensors) fn corner(&self, column: usize, row: usize) -> [f64; 3] {
        let [x, y] = self.place(column, row);
        [x, y, self.heights_m[row * self.corners[0] + column]]
    }

    fn mesh(&self) -> Option<Mesh> {
        let [columns, rows] = self.corners;
        let corners = (0..columns * rows).map(|corner| {
            let [x, y, z] = self.corner(corner % columns, corner / columns);
            Vector::new(x, y, z)
        });
        let (width, mut triangles) = (columns as u32, Vec::new());
        for row in 0..rows as u32 - 1 {
            for column in 0..width - 1 {
                let at = row * width + column;
                triangles.extend([[at, at + 1, at + width], [at + 1, at + width + 1, at + width]]);
            }
        }
        let triangles = TriMesh::new(corners.collect(), triangles).ok()?;
        Some(Mesh {
            triangles,
            object: GROUND,
        })
    }
}

/// The triangles of a mesh, in the world.
fn read(placement: &MeshPlacement, scene: &Scene) -> Result<TriMesh, LidarError> {
    let path = &placement.file;
    let wrong = |reason: String| LidarError::Mesh {
        path: path.clone(),
        reason,
    };
    std::fs::File::open(path).map_err(|source| LidarError::Unreadable {
        path: path.clone(),
        source,
    })?;
    let options = tobj::LoadOptions {
        triangulate: true,
        ..tobj::LoadOptions::default()
    };
    // Materials are not used: a missing material library is no error.
    let (models, _) = tobj::load_obj(path, &options).map_err(|error| wrong(error.to_string()))?;
    let [x, y] = placement.origin_m;
    let ground_m = scene.ground_height_m(x, y);
    let (sin, cos) = libm::sincos(placement.heading_deg.to_radians());
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    for model in &models {
        let first = vertices.len() as u32;
        vertices.extend(model.mesh.positions.chunks_exact(3).map(|p| {
            let [a, b, c] = [p[0], p[1], p[2]].map(f64::from);
            Vector::new(x + a * cos - b * sin, y + a * sin + b * cos, ground_m + c)
        }));
        let of_model = model.mesh.indices.chunks_exact(3);
        triangles.extend(of_model.map(|corners| [first + corners[0], first + corners[1], first + corners[2]]));
    }
    if triangles.is_empty() {
        return Err(wrong("it has no faces".into()));
    }
    TriMesh::new(vertices, triangles).map_err(|error| wrong(format!("{error:?}")))
}
