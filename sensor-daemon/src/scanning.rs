//! LIDARs in a run: publishes the scans of every vehicle that carries one, and passes the nearest objects to the observation.

use std::sync::Arc;

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
    /// One for each map of the run.
    lidars: Vec<LidarModel>,
    targets: Targets,
    scratch: ScanScratch,
    publisher: Publisher,
    sub_steps: usize,
    /// The observation has fields of nearest objects.
    shows_objects: bool,
    totals: ScanTotals,
}

impl LidarScanning {
    /// LIDARs as configured, in the scenes of the run's maps.
    ///
    /// # Errors
    /// A ray table or mesh cannot be used.
    pub fn new(config: &Config, scenes: &[Arc<Scene>], publisher: Publisher) -> Result<Self, Failure> {
        let lidars = scenes.iter().map(|scene| LidarModel::new(config, scene));
        Ok(Self {
            lidars: lidars.collect::<Result<_, _>>()?,
            targets: Targets::default(),
            scratch: ScanScratch::default(),
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

    /// One tick: scans from every vehicle that carries a LIDAR, publishes the points and passes the nearest objects to `sensing`.
    ///
    /// # Errors
    /// Shared memory fails.
    pub fn scan(
        &mut self,
        header: &MessageHeader,
        states: &[VehicleState],
        sub_steps: &[SubStep],
        sensing: &mut Sensing,
    ) -> Result<(), Failure> {
        self.targets.update(states, sub_steps, self.sub_steps);
        let carriers: Vec<(usize, usize)> = sensing.carriers_due(SensorKind::Lidar).collect();
        for (slot, row) in carriers {
            if let Some(objects) = self.scan_one(header, row)? {
                sensing.set_objects(slot, objects);
            }
        }
        Ok(())
    }

    fn scan_one(&mut self, header: &MessageHeader, row: usize) -> Result<Option<[[f32; 2]; 4]>, Failure> {
        let lidar = &self.lidars[usize::from(header.map).min(self.lidars.len() - 1)];
        let layout = PointcloudLayout::new(lidar.max_points());
        let mut draft = self.publisher.loan_unwritten(*header, layout.len)?;
        let [head, body] = block::split_mut(draft.payload_mut(), &[layout.scan, layout.points]).map_err(unreadable)?;
        let points: &mut [LidarPoint] = bytemuck::cast_slice_mut(body);
        let mut scan = Scan::default();
        let count = lidar.scan(
            &self.targets,
            row,
            header.tick,
            header.episode_seed,
            &mut self.scratch,
            &mut scan,
            points,
        );
        let objects = self.shows_objects.then(|| nearest_objects(&points[..count], lidar));
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
