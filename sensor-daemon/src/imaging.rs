//! Cameras in a run: publishes the images of every carrier, and counts and hashes them.

use std::{collections::BTreeMap, mem::offset_of, sync::Arc};

use ipc_schema::{
    block,
    config::{BlackoutPolicy, Config, OWN_SENSOR},
    failure::{Failure, FailureKind},
    header::MessageHeader,
    image::{ImageHead, ImageLayout, ImagePlane, MOST_SEEN, SeenObject},
    observation::EMPTY_SLOT,
    ports::Publisher,
    sensor::SensorKind,
    world::{SubStep, VehicleState},
};
use serde::{Deserialize, Serialize};

use crate::{
    mounts::DueUnit,
    roadside::RoadsideCarriers,
    sensing::Sensing,
    sensors::{
        camera::{CameraModel, CameraParams, CameraScratch, CameraTargets, ImagePlanes, SightScene},
        lidar::Targets,
    },
};

/// Counts of messages for the run's report, and the hash over all of them.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageTotals {
    /// Messages: one for each carrier and sample.
    pub messages: u64,
    /// Road users in images, or detections.
    pub entries: u64,
    /// BLAKE3 over tick and content of every message, each with the hash before it; empty before the first.
    pub hash: String,
}

impl MessageTotals {
    /// Adds a message with these sections.
    pub fn add(&mut self, tick: u64, entries: usize, sections: &[&[u8]]) {
        let mut hasher = blake3::Hasher::new();
        hasher.update(self.hash.as_bytes()).update(&tick.to_le_bytes());
        for section in sections {
            hasher.update(section);
        }
        self.hash = hasher.finalize().to_hex().to_string();
        self.messages += 1;
        self.entries += entries as u64;
    }
}

/// The cameras of a run.
pub struct CameraImaging {
    /// By number.
    cameras: BTreeMap<u32, NumberedCamera>,
    targets: Targets,
    seen: CameraTargets,
    scratch: CameraScratch,
    objects: Vec<SeenObject>,
    due: Vec<DueUnit>,
    publisher: Publisher,
    /// Images that stand in observations; `None` where none do.
    observed: Option<ObservedImages>,
    totals: MessageTotals,
}

/// The cameras of one number.
struct NumberedCamera {
    /// One for each map of the run.
    maps: Vec<CameraModel>,
    planes: u32,
    range_m: f32,
    plane_bytes: usize,
}

/// The newest image of each slot that carries a camera, as the observation has them.
struct ObservedImages {
    plane: ImagePlane,
    /// Slots that may carry a camera: the first.
    carriers: usize,
    image_bytes: usize,
    /// Images are 0 while their camera is dark (`blackout.policy`).
    dark_is_blank: bool,
    newest: Vec<u8>,
}

impl ObservedImages {
    fn new(config: &Config) -> Option<Self> {
        let plane = config.camera.observed.plane()?;
        Some(Self {
            plane,
            carriers: config.camera.vehicles as usize,
            image_bytes: config.camera.observed_bytes(),
            dark_is_blank: config.blackout.policy == BlackoutPolicy::Nan,
            newest: Vec::new(),
        })
    }

    /// Makes room for the slots of a tick, and clears those in which no trajectory continues.
    fn begin_tick(&mut self, sensing: &Sensing) {
        let slots = sensing.slots();
        self.newest.resize(slots.len().min(self.carriers) * self.image_bytes, 0);
        for (image, slot) in self.newest.chunks_exact_mut(self.image_bytes).zip(slots) {
            if slot.vehicle == EMPTY_SLOT || slot.step == 0 {
                image.fill(0);
            }
        }
    }

    /// Keeps the image of a slot.
    fn keep(&mut self, slot: usize, planes: &ImagePlanes) {
        let plane: &[u8] = match self.plane {
            ImagePlane::Semantic => planes.semantic,
            ImagePlane::Rgb => bytemuck::cast_slice(planes.rgb),
            ImagePlane::Binary => planes.binary,
            // No configuration observes these.
            ImagePlane::Depth | ImagePlane::Instance => return,
        };
        let first = slot * self.image_bytes;
        if let Some(place) = self.newest.get_mut(first..first + self.image_bytes) {
            place.copy_from_slice(plane);
        }
    }

    /// Writes the images of all slots of the tick to a section of zeros.
    fn write(&self, sensing: &Sensing, section: &mut [u8]) {
        let places = section.chunks_exact_mut(self.image_bytes);
        for (slot, (place, image)) in places.zip(self.newest.chunks_exact(self.image_bytes)).enumerate() {
            if !self.dark_is_blank || sensing.delivers(slot, SensorKind::Camera) {
                place.copy_from_slice(image);
            }
        }
    }
}

impl CameraImaging {
    /// Cameras as configured, in what cameras see of the run's maps.
    #[must_use]
    pub fn new(config: &Config, sights: &[Arc<SightScene>], publisher: Publisher) -> Self {
        let units = config.sensor_units(SensorKind::Camera);
        let cameras = units.iter().map(|unit| {
            let camera = config.with_unit(unit).camera;
            let params = CameraParams::from(&camera);
            let maps = sights
                .iter()
                .map(|sight| CameraModel::in_sight(&params, Arc::clone(sight)));
            let camera = NumberedCamera {
                maps: maps.collect(),
                planes: ImagePlane::wanted(&camera),
                range_m: camera.range_m as f32,
                plane_bytes: ImagePlane::bytes(&camera),
            };
            (unit.sensor, camera)
        });
        Self {
            cameras: cameras.collect(),
            targets: Targets::default(),
            seen: CameraTargets::default(),
            scratch: CameraScratch::default(),
            objects: Vec::new(),
            due: Vec::new(),
            publisher,
            observed: ObservedImages::new(config),
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

    /// One tick: takes and publishes an image with every camera that is due.
    ///
    /// # Errors
    /// Shared memory fails.
    pub fn take(
        &mut self,
        header: &MessageHeader,
        states: &[VehicleState],
        beside: &RoadsideCarriers,
        sensing: &Sensing,
    ) -> Result<(), Failure> {
        if let Some(observed) = &mut self.observed {
            observed.begin_tick(sensing);
        }
        let mut due = std::mem::take(&mut self.due);
        sensing.units_due(SensorKind::Camera, &mut due);
        beside.add_due(SensorKind::Camera, sensing.now(header).tick, states.len(), &mut due);
        if !due.is_empty() {
            let steps: &[SubStep] = &[];
            self.targets.update(states, steps, 0);
            self.seen.update(&self.targets);
            self.targets.add_fixed(beside.states());
        }
        for unit in &due {
            let carrier = states
                .get(unit.row)
                .or_else(|| beside.states().get(unit.row - states.len()));
            if let Some(carrier) = carrier {
                self.take_one(header, carrier, unit)?;
            }
        }
        self.due = due;
        Ok(())
    }

    /// Writes the newest images of all slots to the section of the observation of this tick, which is 0.
    pub fn write_observed(&self, sensing: &Sensing, section: &mut [u8]) {
        if let Some(observed) = &self.observed {
            observed.write(sensing, section);
        }
    }

    fn take_one(&mut self, header: &MessageHeader, carrier: &VehicleState, unit: &DueUnit) -> Result<(), Failure> {
        let Some(numbered) = self.cameras.get(&unit.sensor) else {
            return Ok(());
        };
        let camera = &numbered.maps[usize::from(header.map).min(numbered.maps.len() - 1)];
        let Some(pose) = camera.pose_on(&self.targets, unit.row) else {
            return Ok(());
        };
        let layout = ImageLayout::new(MOST_SEEN, numbered.plane_bytes);
        let mut draft = self.publisher.loan_unwritten(*header, layout.len)?;
        let sections = [layout.head, layout.planes, layout.objects];
        let [head, planes, listed] = block::split_mut(draft.payload_mut(), &sections).map_err(unreadable)?;
        let [width, height] = camera.size();
        let mut planes_of = split_planes(planes, numbered.planes, width * height);
        let (seen, scratch) = (&self.seen, &mut self.scratch);
        camera.take(seen, Some(unit.row), &pose, scratch, &mut planes_of, &mut self.objects);
        if let (Some(observed), Some(slot), OWN_SENSOR) = (&mut self.observed, unit.slot, unit.sensor) {
            observed.keep(slot, &planes_of);
        }
        self.objects.truncate(MOST_SEEN);
        let objects: &[u8] = bytemuck::cast_slice(&self.objects);
        listed[..objects.len()].copy_from_slice(objects);
        head.copy_from_slice(bytemuck::bytes_of(&ImageHead {
            position_m: pose.position_m(),
            attitude_rad: pose.attitude_rad(),
            id_hash: carrier.id_hash,
            vehicle: carrier.vehicle,
            width: width as u32,
            height: height as u32,
            planes: numbered.planes,
            focal_px: camera.focal_px() as f32,
            range_m: numbered.range_m,
            sensor: unit.sensor,
            reserved: 0,
        }));
        let hashed = hashed_head(head, offset_of!(ImageHead, sensor), unit.sensor);
        self.totals
            .add(header.tick, self.objects.len(), &[hashed, planes, objects]);
        *draft.header_mut() = MessageHeader {
            shape: ImageLayout::new(self.objects.len(), numbered.plane_bytes).shape,
            ..*header
        };
        draft.send()?;
        Ok(())
    }
}

/// The part of a head that is hashed. That of a section's sensor ends before its number, which is 0: runs without suites keep the hashes
/// that they had before there were numbers.
pub(crate) fn hashed_head(head: &[u8], number_at: usize, sensor: u32) -> &[u8] {
    if sensor == OWN_SENSOR { &head[..number_at] } else { head }
}

/// The planes of an image within the bytes of a message.
fn split_planes(mut bytes: &mut [u8], wanted: u32, pixels: usize) -> ImagePlanes<'_> {
    let mut of_plane = ImagePlane::ALL.map(|plane| {
        let length = if plane.bit() & wanted == 0 {
            0
        } else {
            pixels * plane.pixel_bytes()
        };
        let (first, rest) = std::mem::take(&mut bytes).split_at_mut(length);
        bytes = rest;
        first
    });
    let [depth, instance, semantic, rgb, binary] = of_plane.each_mut().map(std::mem::take);
    ImagePlanes {
        depth_m: bytemuck::cast_slice_mut(depth),
        instance: bytemuck::cast_slice_mut(instance),
        semantic,
        rgb: bytemuck::cast_slice_mut(rgb),
        binary,
    }
}

fn unreadable(error: block::BlockError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_follow_one_another_and_those_not_wanted_are_empty() {
        let mut words = [0_u64; 16];
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
        let wanted = ImagePlane::Depth.bit() | ImagePlane::Semantic.bit() | ImagePlane::Rgb.bit();
        let planes = split_planes(bytes, wanted, 6);
        let lengths = [
            planes.depth_m.len(),
            planes.instance.len(),
            planes.semantic.len(),
            planes.rgb.len(),
            planes.binary.len(),
        ];
        assert_eq!(lengths, [6, 0, 6, 6, 0]);
    }

    #[test]
    fn the_hash_tells_order_tick_and_content_apart() {
        let hash = |messages: &[(u64, &[u8])]| {
            let mut totals = MessageTotals::default();
            messages
                .iter()
                .for_each(|(tick, payload)| totals.add(*tick, 1, &[payload]));
            (totals.messages, totals.hash)
        };
        let one = hash(&[(1, b"a"), (2, b"b")]);
        assert_eq!(one, hash(&[(1, b"a"), (2, b"b")]));
        for other in [[(1, b"b"), (2, b"a")], [(1, b"a"), (3, b"b")]] {
            assert_ne!(one, hash(&other.map(|(tick, payload)| (tick, &payload[..]))));
        }
    }
}
