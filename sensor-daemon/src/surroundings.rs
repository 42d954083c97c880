//! Sensors of the surroundings: they read the scene and other road users, and sample before the observation of a tick is made.

use std::sync::Arc;

use ipc_schema::{
    failure::{Failure, FailureKind},
    header::MessageHeader,
    membership::RunMembership,
    run::MapInfo,
    sensor::{SENSORS, SceneUse},
    services::Channel,
};
use serde::{Deserialize, Serialize};
use sim_core::{
    geodesy::{GeodesyError, NetPosition, Projection},
    scene::Scene,
};

use crate::{
    echoing::RadarScanning,
    imaging::{CameraImaging, MessageTotals},
    roadside::RoadsideCarriers,
    scanning::{LidarScanning, ScanTotals},
    sensing::{Sensing, WorldTick},
    sensors::{camera::SightScene, sky::SkyMap, ultrasonic::UltrasonicSampling},
};

/// The sensors of the surroundings of a run, those that its configuration has.
pub struct Surroundings {
    lidars: Option<LidarScanning>,
    ultrasonic: Option<UltrasonicSampling>,
    cameras: Option<CameraImaging>,
    radars: Option<RadarScanning>,
    beside: RoadsideCarriers,
}

impl Surroundings {
    /// Reads the scenes if a sensor uses them, sets the sky of the GNSS receivers, and opens the LIDARs.
    ///
    /// # Errors
    /// A scene, a ray table or a mesh cannot be read, a map's projection is not understood, or a port fails.
    pub fn open(membership: &mut RunMembership, sensing: &mut Sensing) -> Result<Self, Failure> {
        let uses = SENSORS.map(|spec| (spec.scene)(&membership.run.config));
        if uses.iter().all(|scene| *scene == SceneUse::Unused) {
            return Ok(Self {
                lidars: None,
                ultrasonic: None,
                cameras: None,
                radars: None,
                beside: RoadsideCarriers::new(&membership.run, &[])?,
            });
        }
        let scenes = Scene::of_every_map(&membership.run)?;
        if uses.contains(&SceneUse::Sky) {
            for (index, (map, scene)) in membership.run.every_map().iter().zip(&scenes).enumerate() {
                let sky = sky_over(&map.info, scene, membership.run.seed())?;
                sensing.set_sky_of(index, Box::new(sky));
            }
        }
        let mut lidars = None;
        if uses.contains(&SceneUse::Rays) {
            let publisher = membership.publisher(Channel::Pointcloud)?;
            lidars = Some(LidarScanning::new(&membership.run.config, &scenes, publisher)?);
        }
        let ultrasonic = uses.contains(&SceneUse::Solids);
        let ultrasonic = ultrasonic.then(|| UltrasonicSampling::new(&membership.run.config, &scenes));
        // Cameras and radars share what they see of a map.
        let looks = [SceneUse::Images, SceneUse::Echoes]
            .iter()
            .any(|scene| uses.contains(scene));
        let sights: Vec<Arc<SightScene>> = match looks {
            true => {
                let seen = scenes.iter();
                seen.map(|scene| Arc::new(SightScene::new(&membership.run.config, scene)))
                    .collect()
            }
            false => Vec::new(),
        };
        let mut cameras = None;
        if uses.contains(&SceneUse::Images) {
            let publisher = membership.publisher(Channel::Image)?;
            cameras = Some(CameraImaging::new(&membership.run.config, &sights, publisher));
        }
        let mut radars = None;
        if uses.contains(&SceneUse::Echoes) {
            let publisher = membership.publisher(Channel::Radar)?;
            radars = Some(RadarScanning::new(&membership.run.config, &sights, publisher));
        }
        Ok(Self {
            lidars,
            ultrasonic,
            cameras,
            radars,
            beside: RoadsideCarriers::new(&membership.run, &scenes)?,
        })
    }

    /// Samples every sensor that is due at the tick of the last [`Sensing::assign`], and passes the samples to `sensing`.
    ///
    /// # Errors
    /// Shared memory fails.
    pub fn sample(
        &mut self,
        header: &MessageHeader,
        road_users: &WorldTick,
        sensing: &mut Sensing,
    ) -> Result<(), Failure> {
        if let Some(lidars) = &mut self.lidars {
            lidars.scan(header, road_users.bodies, road_users.sub_steps, &self.beside, sensing)?;
        }
        if let Some(ultrasonic) = &mut self.ultrasonic {
            ultrasonic.sample(header, road_users.bodies, sensing);
        }
        if let Some(cameras) = &mut self.cameras {
            cameras.take(header, road_users.bodies, road_users.sub_steps, &self.beside, sensing)?;
        }
        if let Some(radars) = &mut self.radars {
            radars.scan(header, road_users.bodies, &self.beside, sensing)?;
        }
        Ok(())
    }

    /// Writes the newest images to the section of an observation that holds them, which is 0.
    pub fn write_images(&self, sensing: &Sensing, section: &mut [u8]) {
        if let Some(cameras) = &self.cameras {
            cameras.write_observed(sensing, section);
        }
    }

    /// Continues counting LIDAR scans from `totals`.
    pub fn set_lidar_totals(&mut self, totals: Option<ScanTotals>) {
        if let (Some(lidars), Some(totals)) = (&mut self.lidars, totals) {
            lidars.set_totals(totals);
        }
    }

    /// Counts of LIDAR scans; `None` without LIDARs.
    #[must_use]
    pub fn lidar_totals(&self) -> Option<ScanTotals> {
        self.lidars.as_ref().map(LidarScanning::totals)
    }
}

/// Counts of the images and of the radar scans of a run; `None` without such a sensor.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SightTotals {
    /// Images.
    pub camera: Option<MessageTotals>,
    /// Radar scans.
    pub radar: Option<MessageTotals>,
}

impl Surroundings {
    /// Continues counting images and radar scans from `totals`.
    pub fn set_sight_totals(&mut self, totals: SightTotals) {
        if let (Some(cameras), Some(totals)) = (&mut self.cameras, totals.camera) {
            cameras.set_totals(totals);
        }
        if let (Some(radars), Some(totals)) = (&mut self.radars, totals.radar) {
            radars.set_totals(totals);
        }
    }

    /// Counts of images and radar scans.
    #[must_use]
    pub fn sight_totals(&self) -> SightTotals {
        SightTotals {
            camera: self.cameras.as_ref().map(|cameras| cameras.totals().clone()),
            radar: self.radars.as_ref().map(|radars| radars.totals().clone()),
        }
    }
}

fn sky_over(map: &MapInfo, scene: &Arc<Scene>, seed: u64) -> Result<SkyMap, Failure> {
    let [x_min, y_min, x_max, y_max] = map.bounds_m;
    let middle = NetPosition {
        x_m: 0.5 * (x_min + x_max),
        y_m: 0.5 * (y_min + y_max),
    };
    let middle = Projection::new(map)
        .and_then(|projection| projection.geodetic_from_net(middle))
        .map_err(projection_failure)?;
    Ok(SkyMap::new(Arc::clone(scene), middle, map.bounds_m, seed))
}

/// A failure that names the remedy for a projection that is not understood.
pub fn projection_failure(error: GeodesyError) -> Failure {
    Failure::from_error(FailureKind::Config, &error).with_help(
        "give a net whose <location> has a projection that proj4rs knows, such as UTM or transverse Mercator",
    )
}
