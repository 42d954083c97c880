//! Radars in a run: publishes the detections of every carrier, and counts and hashes them.

use std::{collections::BTreeMap, mem::offset_of, sync::Arc};

use ipc_schema::{
    block,
    config::Config,
    failure::{Failure, FailureKind},
    header::MessageHeader,
    ports::Publisher,
    radar::{MOST_DETECTIONS, RadarDetection, RadarLayout, RadarScan},
    sensor::SensorKind,
    world::{SubStep, VehicleState},
};

use crate::{
    imaging::{MessageTotals, hashed_head},
    mounts::DueUnit,
    roadside::RoadsideCarriers,
    sensing::Sensing,
    sensors::{
        camera::{CameraTargets, SightScene},
        lidar::Targets,
        radar::{RadarModel, RadarScratch},
    },
};

/// The radars of a run.
pub struct RadarScanning {
    /// By number.
    radars: BTreeMap<u32, NumberedRadar>,
    targets: Targets,
    seen: CameraTargets,
    scratch: RadarScratch,
    detections: Vec<RadarDetection>,
    due: Vec<DueUnit>,
    /// Road users and, behind them, carriers beside the road.
    carriers: Vec<VehicleState>,
    publisher: Publisher,
    totals: MessageTotals,
}

/// The radars of one number.
struct NumberedRadar {
    /// One for each map of the run.
    maps: Vec<RadarModel>,
    noise_key: u64,
}

impl RadarScanning {
    /// Radars as configured, in what cameras see of the run's maps.
    #[must_use]
    pub fn new(config: &Config, sights: &[Arc<SightScene>], publisher: Publisher) -> Self {
        let units = config.sensor_units(SensorKind::Radar);
        let radars = units.iter().map(|unit| {
            let config = config.with_unit(unit);
            let maps = sights
                .iter()
                .map(|sight| RadarModel::in_sight(&config, Arc::clone(sight)));
            let radar = NumberedRadar {
                maps: maps.collect(),
                noise_key: unit.noise_key(),
            };
            (unit.sensor, radar)
        });
        Self {
            radars: radars.collect(),
            targets: Targets::default(),
            seen: CameraTargets::default(),
            scratch: RadarScratch::default(),
            detections: Vec::new(),
            due: Vec::new(),
            carriers: Vec::new(),
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

    /// One tick: scans and publishes with every radar that is due.
    ///
    /// # Errors
    /// Shared memory fails.
    pub fn scan(
        &mut self,
        header: &MessageHeader,
        states: &[VehicleState],
        beside: &RoadsideCarriers,
        sensing: &Sensing,
    ) -> Result<(), Failure> {
        let mut due = std::mem::take(&mut self.due);
        sensing.units_due(SensorKind::Radar, &mut due);
        beside.add_due(SensorKind::Radar, sensing.now(header).tick, states.len(), &mut due);
        if !due.is_empty() {
            let steps: &[SubStep] = &[];
            self.targets.update(states, steps, 0);
            self.seen.update(&self.targets);
            self.targets.add_fixed(beside.states());
            self.carriers.clear();
            if !beside.states().is_empty() {
                self.carriers.extend(states.iter().chain(beside.states()));
            }
        }
        for unit in &due {
            self.scan_one(header, states, unit)?;
        }
        self.due = due;
        Ok(())
    }

    fn scan_one(&mut self, header: &MessageHeader, states: &[VehicleState], unit: &DueUnit) -> Result<(), Failure> {
        let Some(NumberedRadar { maps, noise_key }) = self.radars.get(&unit.sensor) else {
            return Ok(());
        };
        let radar = &maps[usize::from(header.map).min(maps.len() - 1)];
        let carriers = if self.carriers.is_empty() {
            states
        } else {
            &self.carriers
        };
        let scan = radar.scan(
            (&self.targets, &self.seen),
            carriers,
            unit.row,
            header.tick,
            header.episode_seed ^ noise_key,
            &mut self.scratch,
            &mut self.detections,
        );
        let Some(mut scan) = scan else {
            return Ok(());
        };
        scan.sensor = unit.sensor;
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
        let hashed = hashed_head(head, offset_of!(RadarScan, sensor), unit.sensor);
        self.totals.add(header.tick, self.detections.len(), &[hashed, body]);
        draft.send()?;
        Ok(())
    }
}
