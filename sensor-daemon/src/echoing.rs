//! Radars in a run: publishes the detections of every vehicle that carries one, and counts and hashes them.

use std::sync::Arc;

use ipc_schema::{
    block,
    config::Config,
    failure::{Failure, FailureKind},
    header::MessageHeader,
    ports::Publisher,
    radar::{MOST_DETECTIONS, RadarDetection, RadarLayout},
    sensor::SensorKind,
    world::{SubStep, VehicleState},
};
use sim_core::scene::Scene;

use crate::{
    imaging::MessageTotals,
    sensing::Sensing,
    sensors::{
        camera::CameraTargets,
        lidar::Targets,
        radar::{RadarModel, RadarScratch},
    },
};

/// The radars of a run.
pub struct RadarScanning {
    /// One for each map of the run.
    radars: Vec<RadarModel>,
    targets: Targets,
    seen: CameraTargets,
    scratch: RadarScratch,
    detections: Vec<RadarDetection>,
    publisher: Publisher,
    totals: MessageTotals,
}

impl RadarScanning {
    /// Radars as configured, in the scenes of the run's maps.
    #[must_use]
    pub fn new(config: &Config, scenes: &[Arc<Scene>], publisher: Publisher) -> Self {
        Self {
            radars: scenes.iter().map(|scene| RadarModel::new(config, scene)).collect(),
            targets: Targets::default(),
            seen: CameraTargets::default(),
            scratch: RadarScratch::default(),
            detections: Vec::new(),
            publisher,
            totals: MessageTotals::default(),
        }
    }

    /// Continues counting from `totals`.
    pub fn set_totals(&mut self, totals: MessageTotals) {
        self.totals = totals;
    }

    /// Counts so far.
    #[must_use]
    pub fn totals(&self) -> &MessageTotals {
        &self.totals
    }

    /// One tick: scans and publishes from every vehicle whose radar is due.
    ///
    /// # Errors
    /// Shared memory fails.
    pub fn scan(&mut self, header: &MessageHeader, states: &[VehicleState], sensing: &Sensing) -> Result<(), Failure> {
        let carriers: Vec<usize> = sensing.carriers_due(SensorKind::Radar).map(|(_, row)| row).collect();
        if carriers.is_empty() {
            return Ok(());
        }
        let steps: &[SubStep] = &[];
        self.targets.update(states, steps, 0);
        self.seen.update(&self.targets);
        let radar = &self.radars[usize::from(header.map).min(self.radars.len() - 1)];
        for row in carriers {
            let scan = radar.scan(
                (&self.targets, &self.seen),
                states,
                row,
                header.tick,
                header.episode_seed,
                &mut self.scratch,
                &mut self.detections,
            );
            let Some(scan) = scan else { continue };
            self.detections.truncate(MOST_DETECTIONS);
            let layout = RadarLayout::new(self.detections.len());
            let header = MessageHeader {
                shape: layout.shape,
                ..*header
            };
            let mut draft = self.publisher.loan(header, layout.len)?;
            let sections = [layout.scan, layout.detections];
            let [head, body] = block::split_mut(draft.payload_mut(), &sections)
                .map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
            head.copy_from_slice(bytemuck::bytes_of(&scan));
            body.copy_from_slice(bytemuck::cast_slice(&self.detections));
            self.totals.add(header.tick, self.detections.len(), &[head, body]);
            draft.send()?;
        }
        Ok(())
    }
}
