//! Spinning LIDARs of connected vehicles: what each sees during a tick, point by point.
//!
//! A LIDAR is drawn like a picture of a city of prisms and boxes, not traced through a tree: see [`raster`](self). Which path a scene
//! takes and what it costs: `docs/lidar.md`. The result depends on the configuration, the seed, the vehicle and the tick alone, not
//! on threads, the order of objects or the processor.

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
mod sensor;
mod simd;
mod solids;
mod targets;
mod weather;

pub use error::LidarError;
pub use nearest::nearest_objects;
pub use scan::Scratch;
pub use targets::Targets;

/// Instructions that a scan is made with; all give the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Path {
    /// AVX-512 F, DQ, BW and VL.
    Avx512,
    /// AVX2.
    Avx2,
    /// What every processor has.
    Plain,
}

impl Path {
    /// All of them, the fastest first.
    pub const ALL: [Self; 3] = [Self::Avx512, Self::Avx2, Self::Plain];

    /// True if this processor can.
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

    /// The fastest that this processor can.
    #[must_use]
    pub fn best() -> Self {
        Self::ALL.into_iter().find(|path| path.is_here()).unwrap_or(Self::Plain)
    }
}

/// A LIDAR and the scene it stands in; one serves all vehicles that carry it.
#[derive(Debug)]
pub struct Lidar {
    pattern: pattern::Pattern,
    firing: firing::Firing,
    mount: sensor::Mount,
    solids: solids::Solids,
    meshes: mesh::Meshes,
    receiver: returns::Receiver,
    path: Path,
    /// Height of flat ground; none if it is a mesh.
    ground_m: Option<f64>,
    /// Largest tangent of an elevation; infinite for a table.
    steepest: f64,
    /// All lasers of a column in one plane, no mesh, and an upright mounting: upright whenever the carrier is.
    is_flat_fan: bool,
    is_rolling: bool,
    is_paper: bool,
    range_m: f64,
    tick_s: f64,
}

impl Lidar {
    /// The LIDAR of a configuration in a scene.
    ///
    /// # Errors
    /// Unknown pattern or prop, unusable ray table or mesh, or rotations that do not fit the tick.
    pub fn new(config: &Config, scene: &Scene) -> Result<Self, LidarError> {
        let lidar = &config.lidar;
        let pattern = pattern::Pattern::new(lidar)?;
        let firing = firing::Firing::new(config, &pattern)?;
        let mount = sensor::Mount::new(lidar.mount);
        let meshes = mesh::Meshes::new(&config.scene.meshes, scene)?;
        let tangents = pattern.groups.iter().flat_map(|group| group.tan.0);
        let steepest = tangents.fold(0.0_f64, |most, tan| most.max(f64::from(tan.abs())));
        Ok(Self {
            is_flat_fan: !pattern.is_table && mount.is_upright && meshes.is_empty(),
            steepest: if pattern.is_table { f64::INFINITY } else { steepest },
            solids: solids::Solids::new(lidar, scene)?,
            receiver: returns::Receiver::new(config),
            path: Path::best(),
            ground_m: mesh::flat_ground_m(scene),
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

    /// The same with other instructions; unchanged if this processor does not have them.
    #[must_use]
    pub fn with_path(mut self, path: Path) -> Self {
        if path.is_here() {
            self.path = path;
        }
        self
    }

    /// The instructions it uses.
    #[must_use]
    pub fn path(&self) -> Path {
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
    /// which they were fired; how many. `points` needs room for [`Lidar::max_points`]: what goes beyond its end is lost. A row
    /// that does not exist sees nothing.
    #[expect(clippy::too_many_arguments, reason = "what a scan is of, and where it goes")]
    pub fn scan(
        &self,
        targets: &Targets,
        row: usize,
        tick: u64,
        episode_seed: u64,
        scratch: &mut Scratch,
        scan: &mut Scan,
        points: &mut [LidarPoint],
    ) -> usize {
        if row >= targets.movers.len() {
            *scan = Scan::default();
            return 0;
        }
        let order = scan::Order {
            lidar: self,
            targets,
            row,
            tick,
            episode_seed,
        };
        order.run_on(self.path, scratch, scan, points)
    }
}

impl scan::Order<'_> {
    fn run_on(&self, path: Path, scratch: &mut Scratch, scan: &mut Scan, points: &mut [LidarPoint]) -> usize {
        #[cfg(target_arch = "x86_64")]
        #[expect(
            unsafe_code,
            reason = "calls of functions compiled for more than the baseline processor"
        )]
        match path {
            // SAFETY: `Lidar::path` is a path that `Path::is_here` has found on this processor.
            Path::Avx512 => return unsafe { self.run_avx512(scratch, scan, points) },
            // SAFETY: as above.
            Path::Avx2 => return unsafe { self.run_avx2(scratch, scan, points) },
            Path::Plain => {}
        }
        let _ = path;
        self.run::<simd::plain::Plain>(scratch, scan, points)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl")]
    fn run_avx512(&self, scratch: &mut Scratch, scan: &mut Scan, points: &mut [LidarPoint]) -> usize {
        self.run::<simd::avx512::Avx512>(scratch, scan, points)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn run_avx2(&self, scratch: &mut Scratch, scan: &mut Scan, points: &mut [LidarPoint]) -> usize {
        self.run::<simd::avx2::Avx2>(scratch, scan, points)
    }
}
