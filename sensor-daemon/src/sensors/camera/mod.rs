//! Cameras: depth, instances, classes, colours, temperatures, optical flow, events, boxes. An image is a visibility buffer over the polygons
//! of the scene, see [`raster`](self).
//!
//! The result depends on the configuration and the world of the tick alone, not on threads, the order of objects or the processor. How it
//! works and what it costs: docs/camera.md.

use std::sync::Arc;

use ipc_schema::config::Config;
use sim_core::scene::Scene;

mod bodies;
mod boxes;
mod events;
mod flow;
mod ground;
mod labels;
mod light;
mod noise;
mod optics;
mod raster;
mod relief;
mod resolve;
mod shutter;
mod surfaces;
mod thermal;
mod view;

pub use bodies::CameraTargets;
pub use events::{EventMemory, SampledSpan, sort_events};
pub use flow::PastPoses;
pub use ipc_schema::image::{SKY_INSTANCE, SeenObject};
pub use labels::SemanticLabel;
pub use noise::{ImageNoise, PixelNoise};
pub use optics::{CameraParams, RollingShutter};
pub use resolve::ImagePlanes;

use crate::sensors::lidar::{
    ScanPath, Targets, flat_ground_m,
    sensor::{SensorPose, turned},
    simd::{self, Simd},
    targets::TickMoment,
};

/// A camera and the scene around it; one model serves all vehicles that carry it.
#[derive(Debug)]
pub struct CameraModel {
    optics: optics::CameraOptics,
    sight: Arc<SightScene>,
    path: ScanPath,
}

/// What stands still around cameras, and its light: one serves all cameras of a map.
#[derive(Debug)]
pub struct SightScene {
    bodies: bodies::StillBodies,
    ground: ground::GroundMap,
    light: light::Daylight,
    thermal: thermal::ThermalLight,
    /// Colours of the ground, by class.
    ground_colours: Box<[[f32; 3]; 256]>,
    /// Height of flat ground; `None` if it is not flat.
    ground_m: Option<f64>,
    relief: Option<relief::Relief>,
}

impl SightScene {
    /// A scene. Props of interest and the weather are those of the configuration.
    #[must_use]
    pub fn new(config: &Config, scene: &Scene) -> Self {
        let light = light::Daylight::new(&config.weather);
        let mut ground_colours = Box::new([[0.0; 3]; 256]);
        for label in SemanticLabel::ALL {
            ground_colours[label as usize] = light.on_ground(label);
        }
        Self {
            bodies: bodies::StillBodies::new(&config.lidar, scene),
            ground: ground::GroundMap::new(scene),
            light,
            thermal: thermal::ThermalLight::new(&config.weather),
            ground_colours,
            ground_m: flat_ground_m(scene),
            relief: relief::Relief::new(scene),
        }
    }
}

/// Working memory of one thread: empty at first, then kept.
#[derive(Debug, Default)]
pub struct CameraScratch {
    /// Bodies of the map that may be in the image.
    near: Vec<u32>,
    band: BandScratch,
    rolled: shutter::RolledImage,
    corners: boxes::RolledCorners,
}

/// Working memory of the rows that are taken at one time.
#[derive(Debug, Default)]
struct BandScratch {
    canvas: raster::Canvas,
    list: view::DrawList,
    surfaces: surfaces::SurfaceTable,
    /// Pixels of each road user of the surface table.
    counts: Vec<resolve::PixelCount>,
    motions: resolve::ImageMotions,
}

/// What the rows of one time are taken of.
struct BandShot<'a> {
    view: view::CameraView<'a>,
    targets: &'a CameraTargets,
    carrier: Option<usize>,
    /// The camera at the earlier time of the optical flow, and that time: the end of its tick, or a moment of it.
    past: Option<(SensorPose, &'a PastPoses, Option<TickMoment>)>,
    noise: Option<ImageNoise>,
}

/// What an image is taken of.
#[derive(Debug, Clone, Copy)]
pub struct CameraShot<'a> {
    /// The road users at the end of the tick.
    pub targets: &'a CameraTargets,
    /// Their tick, in which a camera with a rolling shutter reads its rows. Without it every camera has a global one.
    pub tick: Option<&'a Targets>,
    /// Row of the road user that carries the camera and is invisible to it.
    pub carrier: Option<usize>,
    /// The camera at the end of the tick.
    pub pose: CameraPose,
    /// Camera and road users at the time since which the optical flow counts; without it there is no flow.
    pub past: Option<(CameraPose, &'a PastPoses)>,
    /// Noise of the colours and of the apparent temperatures.
    pub noise: Option<ImageNoise>,
}

/// Position and attitude of a camera in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraPose(SensorPose);

impl CameraPose {
    /// Position, metres.
    #[must_use]
    pub fn position_m(&self) -> [f64; 3] {
        self.0.position_m
    }

    /// A direction of the camera's frame in the world.
    #[must_use]
    pub fn world_from_camera(&self, direction: [f64; 3]) -> [f64; 3] {
        turned(&self.0.world_from_sensor, direction)
    }

    /// Roll (right side down), pitch (nose up) and heading (counter-clockwise from east), radians.
    #[must_use]
    pub fn attitude_rad(&self) -> [f64; 3] {
        self.0.attitude_rad()
    }
}

impl CameraModel {
    /// A camera in a scene. Props of interest and the weather are those of the configuration.
    #[must_use]
    pub fn new(params: &CameraParams, config: &Config, scene: &Scene) -> Self {
        Self::in_sight(params, Arc::new(SightScene::new(config, scene)))
    }

    /// A camera in a scene that it shares with others.
    #[must_use]
    pub fn in_sight(params: &CameraParams, sight: Arc<SightScene>) -> Self {
        Self {
            optics: optics::CameraOptics::new(params),
            sight,
            path: ScanPath::best(),
        }
    }

    /// The same camera with other instructions; unchanged if this processor lacks them.
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

    /// Columns and rows of an image.
    #[must_use]
    pub fn size(&self) -> [usize; 2] {
        [self.optics.width, self.optics.height]
    }

    /// Distance of the pinhole from the image, pixels.
    #[must_use]
    pub fn focal_px(&self) -> f64 {
        self.optics.focal_px
    }

    /// The camera on the road user in `row` at the end of the tick; `None` if there is no such row.
    #[must_use]
    pub fn pose_on(&self, targets: &Targets, row: usize) -> Option<CameraPose> {
        let mover = targets.movers.get(row)?;
        Some(CameraPose(self.optics.mount.sensor(&mover.end)))
    }

    /// The camera on the road user in `row` at the end of a sub-step; `None` if there is no such row.
    #[must_use]
    pub fn pose_within(&self, targets: &Targets, row: usize, sub_step: usize) -> Option<CameraPose> {
        targets.movers.get(row)?;
        Some(CameraPose(
            self.optics.mount.sensor(&targets.pose(row, sub_step, 1.0, 0.0)),
        ))
    }

    /// The camera on a road user at an earlier time; `None` if it was not there.
    #[must_use]
    pub fn past_pose_on(&self, vehicle: u32, poses: &PastPoses) -> Option<CameraPose> {
        let pose = poses.of(vehicle, None)?;
        Some(CameraPose(self.optics.mount.sensor(&pose)))
    }

    /// Takes an image: fills the planes that are wanted, and `objects` with the road users in the image, in the order of their rows. A
    /// plane whose length is not that of the image stays as it is.
    pub fn take(
        &self,
        shot: &CameraShot<'_>,
        scratch: &mut CameraScratch,
        planes: &mut ImagePlanes<'_>,
        objects: &mut Vec<SeenObject>,
    ) {
        #[cfg(target_arch = "x86_64")]
        #[expect(
            unsafe_code,
            reason = "calls of functions compiled for more than the baseline processor"
        )]
        match self.path {
            // SAFETY: `CameraModel::path` holds only instructions that `ScanPath::is_here` has detected on this processor.
            ScanPath::Avx512 => return unsafe { self.take_avx512(shot, scratch, planes, objects) },
            // SAFETY: as above.
            ScanPath::Avx2 => return unsafe { self.take_avx2(shot, scratch, planes, objects) },
            ScanPath::Plain => {}
        }
        self.take_with::<simd::plain::Plain>(shot, scratch, planes, objects);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl")]
    fn take_avx512(
        &self,
        shot: &CameraShot<'_>,
        scratch: &mut CameraScratch,
        planes: &mut ImagePlanes<'_>,
        objects: &mut Vec<SeenObject>,
    ) {
        self.take_with::<simd::avx512::Avx512>(shot, scratch, planes, objects);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn take_avx2(
        &self,
        shot: &CameraShot<'_>,
        scratch: &mut CameraScratch,
        planes: &mut ImagePlanes<'_>,
        objects: &mut Vec<SeenObject>,
    ) {
        self.take_with::<simd::avx2::Avx2>(shot, scratch, planes, objects);
    }

    #[inline(always)]
    fn take_with<S: Simd>(
        &self,
        shot: &CameraShot<'_>,
        scratch: &mut CameraScratch,
        planes: &mut ImagePlanes<'_>,
        objects: &mut Vec<SeenObject>,
    ) {
        let CameraScratch {
            near,
            band: band_scratch,
            rolled,
            corners,
        } = scratch;
        let (sight, optics) = (&*self.sight, &self.optics);
        band_scratch.canvas.room_for(optics);
        // Find what may be in the image.
        let rolling = self.rolling(shot);
        let bands = match &rolling {
            Some(rolling) => {
                rolled.begin(optics, rolling, &sight.bodies, near);
                &optics.bands[..]
            }
            None => {
                let [x, y, _] = shot.pose.0.position_m;
                sight.bodies.near([x, y], optics.reach_m, near);
                std::slice::from_ref(&optics.whole)
            }
        };
        // Take one band after the other; a global shutter has one.
        objects.clear();
        for (number, band) in bands.iter().enumerate() {
            let band_shot = match &rolling {
                Some(rolling) => rolled.band_shot((optics, number), rolling, shot),
                None => BandShot {
                    view: view::CameraView {
                        optics,
                        band,
                        pose: shot.pose.0,
                    },
                    targets: shot.targets,
                    carrier: shot.carrier,
                    past: shot.past.map(|(pose, poses)| (pose.0, poses, None)),
                    noise: shot.noise,
                },
            };
            self.take_band::<S>(&band_shot, near, band_scratch, planes);
            let (rows, counts) = (&band_scratch.surfaces.users, &band_scratch.counts);
            if rolling.is_some() {
                rolled.end_band(rows, counts);
                continue;
            }
            for (row, count) in rows.iter().zip(counts).filter(|(_, count)| count.pixels > 0) {
                let user = shot.targets.user(*row as usize);
                objects.push(boxes::seen_object(&band_shot.view, user, count));
            }
        }
        if let Some(rolling) = &rolling {
            let seen = rolled.users.iter().filter(|user| user.count.pixels > 0);
            objects.extend(seen.map(|user| boxes::rolled_object(optics, rolled, user, rolling.targets, corners)));
        }
    }

    /// Fills the rows of a view, and counts the pixels of each road user in them.
    #[inline(always)]
    fn take_band<S: Simd>(
        &self,
        shot: &BandShot<'_>,
        near: &[u32],
        scratch: &mut BandScratch,
        planes: &mut ImagePlanes<'_>,
    ) {
        let BandScratch {
            canvas,
            list,
            surfaces,
            counts,
            motions,
        } = scratch;
        let (sight, BandShot { view, targets, .. }) = (&*self.sight, shot);
        // Gather what may be in the rows, and sort it.
        list.clear();
        surfaces.begin(planes.have_colours().then_some(sight.light));
        sight.bodies.gather(view, near, list, surfaces);
        targets.gather(view, shot.carrier, list, surfaces);
        list.sort();
        // Find the first surface of each pixel.
        canvas.fill::<S>(
            &view.band.tiles,
            sight.ground_m.and_then(|ground_m| view.ground(ground_m)),
            (1.0 / view.optics.range_m) as f32,
        );
        canvas.draw::<S>(&list.items, &list.order, &list.edges, &list.cylinders, &view.axes());
        if let Some(relief) = &sight.relief {
            relief.draw::<S>(view, canvas, list);
        }
        // Write what that surface shows.
        motions.still = None;
        motions.users.clear();
        if let (false, Some((past, poses, moment))) = (planes.flow_px.is_empty(), &shot.past) {
            motions.still = Some(flow::PixelMotion::of_still(&view.pose, past));
            let rows = surfaces.users.iter().map(|row| *row as usize);
            motions
                .users
                .extend(rows.map(|row| targets.motion(row, &view.pose, past, (poses, moment.as_ref()))));
        }
        counts.clear();
        counts.resize(surfaces.users.len(), resolve::PixelCount::NONE);
        let resolver = resolve::Resolver {
            canvas,
            view: *view,
            surfaces,
            ground: &sight.ground,
            light: &sight.light,
            ground_colours: &sight.ground_colours,
            thermal: &sight.thermal,
            motions,
            noise: shot.noise,
        };
        resolver.write::<S>(planes, counts);
    }

    /// The tick during which the rows of an image are read; `None` of a global shutter.
    fn rolling<'a>(&'a self, shot: &CameraShot<'a>) -> Option<shutter::RollingTick<'a>> {
        let (targets, row) = (shot.tick?, shot.carrier?);
        let shutter = self.optics.shutter.as_ref()?;
        (row < targets.movers.len()).then_some(shutter::RollingTick { shutter, targets, row })
    }
}
