//! LIDARs in a run: publishes the scans of every carrier, and passes the nearest objects to the observation.

use std::{collections::BTreeMap, sync::Arc};

use ipc_schema::{
    block,
    config::Config,
    failure::{Failure, FailureKind},
    header::MessageHeader,
    pointcloud::{LidarPoint, PointcloudLayout, Scan},
    ports::Publisher,
    sensor::SensorKind,
    world::{SubStep, VehicleState},
};
use serde::{Deserialize, Serialize};
use sim_core::scene::Scene;

use crate::{
    mounts::DueUnit,
    roadside::RoadsideCarriers,
    sensing::Sensing,
    sensors::lidar::{LidarModel, ScanScratch, Targets, nearest_objects},
};

/// Counts of LIDAR scans for the run's report.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ScanTotals {
    /// Scans: one for each LIDAR and tick.
    pub scans: u64,
    /// Rays cast.
    pub rays: u64,
    /// Points written.
    pub points: u64,
}

/// The LIDARs of a run.
pub struct LidarScanning {
    /// By number.
    lidars: BTreeMap<u32, NumberedLidar>,
    targets: Targets,
    scratch: ScanScratch,
    due: Vec<DueUnit>,
    publisher: Publisher,
    sub_steps: usize,
    /// The observation has fields of nearest objects.
    shows_objects: bool,
    totals: ScanTotals,
}

/// The LIDARs of one number.
struct NumberedLidar {
    /// One for each map of the run.
    maps: Vec<LidarModel>,
    noise_key: u64,
}

impl LidarScanning {
    /// LIDARs as configured, in the scenes of the run's maps.
    ///
    /// # Errors
    /// A ray table or mesh cannot be used.
    pub fn new(config: &Config, scenes: &[Arc<Scene>], publisher: Publisher) -> Result<Self, Failure> {
        let mut lidars = BTreeMap::new();
        for unit in config.sensor_units(SensorKind::Lidar) {
            let config = config.with_unit(&unit);
            let maps = scenes.iter().map(|scene| LidarModel::new(&config, scene));
            let lidar = NumberedLidar {
                maps: maps.collect::<Result<_, _>>()?,
                noise_key: unit.noise_key(),
            };
            lidars.insert(unit.sensor, lidar);
        }
        Ok(Self {
            lidars,
            targets: Targets::in_ticks_of(config.run.tick_s),
            scratch: ScanScratch::default(),
            due: Vec::new(),
            publisher,
            sub_steps: config.run.sub_steps as usize,
            shows_objects: config
                .observation
                .fields
                .iter()
                .any(|field| SensorKind::Lidar.is_in(field.measurement_bit())),
            totals: ScanTotals::default(),
        })
    }

    /// Continues counting from `totals`.
    pub fn set_totals(&mut self, totals: ScanTotals) {
        self.totals = totals;
    }

    /// Counts so far.
    #[must_use]
    pub fn totals(&self) -> ScanTotals {
        self.totals
    }

    /// One tick: scans with every LIDAR that is due, publishes the points and passes the nearest objects to `sensing`.
    ///
    /// # Errors
    /// Shared memory fails.
    pub fn scan(
        &mut self,
        header: &MessageHeader,
        states: &[VehicleState],
        sub_steps: &[SubStep],
        beside: &RoadsideCarriers,
        sensing: &mut Sensing,
    ) -> Result<(), Failure> {
        let mut due = std::mem::take(&mut self.due);
        sensing.units_due(SensorKind::Lidar, &mut due);
        beside.add_due(SensorKind::Lidar, sensing.now(header).tick, states.len(), &mut due);
        if !due.is_empty() {
            self.targets.update(states, sub_steps, self.sub_steps);
            self.targets.add_fixed(beside.states());
        }
        for unit in &due {
            if let Some(objects) = self.scan_one(header, unit)?
                && let Some(slot) = unit.slot
            {
                sensing.set_objects(slot, objects);
            }
        }
        self.due = due;
        Ok(())
    }

    fn scan_one(&mut self, header: &MessageHeader, unit: &DueUnit) -> Result<Option<[[f32; 2]; 4]>, Failure> {
        let Some(NumberedLidar { maps, noise_key }) = self.lidars.get(&unit.sensor) else {
            return Ok(None);
        };
        let lidar = &maps[usize::from(header.map).min(maps.len() - 1)];
        let layout = PointcloudLayout::new(lidar.max_points());
        let mut draft = self.publisher.loan_unwritten(*header, layout.len)?;
        let [head, body] = block::split_mut(draft.payload_mut(), &[layout.scan, layout.points]).map_err(unreadable)?;
        let points: &mut [LidarPoint] = bytemuck::cast_slice_mut(body);
        let mut scan = Scan::default();
        let count = lidar.scan(
            &self.targets,
            unit.row,
            header.tick,
            header.episode_seed ^ noise_key,
            &mut self.scratch,
            &mut scan,
            points,
        );
        scan.sensor = unit.sensor;
        let shows_objects = self.shows_objects && unit.is_first;
        let objects = shows_objects.then(|| nearest_objects(&points[..count], lidar));
        self.totals.scans += 1;
        self.totals.rays += u64::from(scan.rays);
        self.totals.points += count as u64;
        head.copy_from_slice(bytemuck::bytes_of(&scan));
        *draft.header_mut() = MessageHeader {
            shape: PointcloudLayout::new(count).shape,
            ..*header
        };
        draft.send()?;
        Ok(objects)
    }
}

fn unreadable(error: block::BlockError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}
