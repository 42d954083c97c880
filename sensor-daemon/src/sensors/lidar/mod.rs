//! Spinning LIDARs of connected vehicles: the points that each measures during a tick.
//!
//! A scan is rasterised from prisms and boxes, not traced through a tree: see [`raster`](self). `docs/lidar.md` says which path a scene
//! takes and what it costs. The result depends on the configuration, the seed, the vehicle and the tick alone, not on threads, the
//! order of objects or the processor.

use ipc_schema::{
    config::{Config, LidarAxes},
    pointcloud::{LidarPoint, Scan},
};
use sim_core::scene::Scene;

mod aim;
mod candidates;
mod error;
mod firing;
mod mesh;
mod nearest;
mod pattern;
mod random;
mod raster;
mod returns;
mod scan;
pub(super) mod sensor;
pub(super) mod simd;
pub(super) mod solids;
pub(super) mod targets;
mod terrain;
mod weather;

pub use error::LidarError;
pub(in crate::sensors) use mesh::{GroundGrid, flat_ground_m};
pub use nearest::nearest_objects;
pub(in crate::sensors) use random::{ScanKey, draw, exp_minus};
pub use scan::ScanScratch;
pub use targets::Targets;

/// Instruction set of a scan; all give the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScanPath {
    /// AVX-512 F, DQ, BW and VL.
    Avx512,
    /// AVX2.
    Avx2,
    /// The baseline instructions of the target.
    Plain,
}

impl ScanPath {
    /// All instruction sets, the fastest first.
    pub const ALL: [Self; 3] = [Self::Avx512, Self::Avx2, Self::Plain];

    /// True if this processor has the instructions.
    #[must_use]
    pub fn is_here(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        {
            use std::arch::is_x86_feature_detected as has;
            match self {
                Self::Avx512 => has!("avx512f") && has!("avx512dq") && has!("avx512bw") && has!("avx512vl"),
                Self::Avx2 => has!("avx2"),
                Self::Plain => true,
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            self == Self::Plain
        }
    }

    /// The fastest instructions of this processor.
    #[must_use]
    pub fn best() -> Self {
        Self::ALL.into_iter().find(|path| path.is_here()).unwrap_or(Self::Plain)
    }
}

/// A LIDAR and the scene around it; one model serves all vehicles that carry it.
#[derive(Debug)]
pub struct LidarModel {
    pattern: pattern::RayPattern,
    firing: firing::FiringSequence,
    mount: sensor::SensorMount,
    solids: solids::StillSolids,
    meshes: mesh::SceneMeshes,
    /// The ground of a net with elevation, unless the pattern is a table.
    terrain: Option<terrain::Terrain>,
    receiver: returns::ReturnModel,
    path: ScanPath,
    /// Height of flat ground; `None` if the ground is a mesh.
    ground_m: Option<f64>,
    /// Largest tangent of an elevation; infinite for a table.
    steepest: f64,
    /// All lasers of a column lie in one plane, there is no mesh, and the mounting is upright: the sensor is upright when its carrier is.
    is_flat_fan: bool,
    is_rolling: bool,
    is_paper: bool,
    range_m: f64,
    tick_s: f64,
}

impl LidarModel {
    /// The LIDAR of a configuration in a scene.
    ///
    /// # Errors
    /// Unusable ray table or mesh, or rotations that do not fit the tick.
    pub fn new(config: &Config, scene: &Scene) -> Result<Self, LidarError> {
        let lidar = &config.lidar;
        let pattern = pattern::RayPattern::new(lidar)?;
        let firing = firing::FiringSequence::new(config, &pattern)?;
        let mount = sensor::SensorMount::new(lidar.mount);
        let ground = GroundGrid::new(scene);
        let meshes = mesh::SceneMeshes::new(&config.scene.meshes, scene, ground.as_ref())?;
        let tangents = pattern.groups.iter().flat_map(|group| group.tan.0);
        let steepest = tangents.fold(0.0_f64, |most, tan| most.max(f64::from(tan.abs())));
        Ok(Self {
            is_flat_fan: !pattern.is_table && mount.is_upright && meshes.is_empty(true),
            terrain: ground.filter(|_| !pattern.is_table).and_then(terrain::Terrain::new),
            steepest: if pattern.is_table { f64::INFINITY } else { steepest },
            solids: solids::StillSolids::new(lidar, scene),
            receiver: returns::ReturnModel::new(config),
            path: ScanPath::best(),
            ground_m: flat_ground_m(scene),
            is_rolling: lidar.rolling_shutter,
            is_paper: lidar.axes == LidarAxes::Paper,
            range_m: lidar.range_m,
            tick_s: config.run.tick_s,
            pattern,
            firing,
            mount,
            meshes,
        })
    }

    /// The same LIDAR with other instructions; unchanged if this processor lacks them.
    #[must_use]
    pub fn with_path(mut self, path: ScanPath) -> Self {
        if path.is_here() {
            self.path = path;
        }
        self
    }

    /// The instructions it uses.
    #[must_use]
    pub fn path(&self) -> ScanPath {
        self.path
    }

    /// Most points of a scan: rays of a tick.
    #[must_use]
    pub fn max_points(&self) -> usize {
        self.columns() * self.pattern.lasers
    }

    /// Most columns (azimuths; of a table: groups of rays) of a tick.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.firing.most_columns()
    }

    /// Scans from the vehicle in `row` of the targets during `tick`: fills `scan` and the first points of `points`, in the order in
    /// which they were fired. Returns the number of points. `points` needs room for [`LidarModel::max_points`]: points beyond its end
    /// are lost. The scan of a row that does not exist is empty.
    #[expect(clippy::too_many_arguments, reason = "inputs and outputs of a scan")]
    pub fn scan(
        &self,
        targets: &Targets,
        row: usize,
        tick: u64,
        episode_seed: u64,
        scratch: &mut ScanScratch,
        scan: &mut Scan,
        points: &mut [LidarPoint],
    ) -> usize {
        if row >= targets.movers.len() {
            *scan = Scan::default();
            return 0;
        }
        let order = scan::ScanOrder {
            lidar: self,
            targets,
            row,
            tick,
            episode_seed,
        };
        order.run_on(self.path, scratch, scan, points)
    }
}

impl scan::ScanOrder<'_> {
    fn run_on(&self, path: ScanPath, scratch: &mut ScanScratch, scan: &mut Scan, points: &mut [LidarPoint]) -> usize {
        #[cfg(target_arch = "x86_64")]
        #[expect(
            unsafe_code,
            reason = "calls of functions compiled for more than the baseline processor"
        )]
        match path {
            // SAFETY: `LidarModel::path` holds only instructions that `ScanPath::is_here` has detected on this processor.
            ScanPath::Avx512 => return unsafe { self.run_avx512(scratch, scan, points) },
            // SAFETY: as above.
            ScanPath::Avx2 => return unsafe { self.run_avx2(scratch, scan, points) },
            ScanPath::Plain => {}
        }
        let _ = path;
        self.run::<simd::plain::Plain>(scratch, scan, points)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl")]
    fn run_avx512(&self, scratch: &mut ScanScratch, scan: &mut Scan, points: &mut [LidarPoint]) -> usize {
        self.run::<simd::avx512::Avx512>(scratch, scan, points)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn run_avx2(&self, scratch: &mut ScanScratch, scan: &mut Scan, points: &mut [LidarPoint]) -> usize {
        self.run::<simd::avx2::Avx2>(scratch, scan, points)
    }
}
