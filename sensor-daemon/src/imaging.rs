//! Cameras in a run: publishes the images of every carrier, and counts and hashes them.

use std::{
    collections::{BTreeMap, VecDeque},
    mem::offset_of,
    sync::Arc,
};

use ipc_schema::{
    block,
    config::{BlackoutPolicy, Config, OWN_SENSOR},
    failure::{Failure, FailureKind},
    header::MessageHeader,
    image::{BrightnessEvent, ImageHead, ImageLayout, ImagePlane, MOST_SEEN, SeenObject, most_events},
    observation::EMPTY_SLOT,
    pointcloud::ROADSIDE_CARRIER,
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
        camera::{
            CameraModel, CameraParams, CameraPose, CameraScratch, CameraShot, CameraTargets, EventMemory, ImageNoise,
            ImagePlanes, PastPoses, PixelNoise, SampledSpan, SightScene, sort_events,
        },
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
    /// Sub-steps of a tick that a camera needs; 0 if all show its end alone.
    sub_steps: usize,
    seen: CameraTargets,
    scratch: CameraScratch,
    objects: Vec<SeenObject>,
    past: PastTicks,
    vision: EventVision,
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
    distortion: [f32; 5],
    plane_bytes: usize,
    noise: PixelNoise,
    noise_key: u64,
    /// Ticks since which the optical flow counts; 0 without it.
    flow_ticks: u64,
    /// From the readout of the first row to that of the last one, seconds; 0 = global shutter.
    readout_s: f32,
    /// Change of brightness that is an event, and most events of an image; `None` without events.
    events: Option<(f32, usize)>,
}

/// Poses of the last ticks of an episode, for the optical flow.
#[derive(Default)]
struct PastTicks {
    /// Most that are kept.
    most: usize,
    /// Episode, tick and poses, the oldest first.
    ticks: VecDeque<(u64, u64, PastPoses)>,
}

impl PastTicks {
    /// The poses so many ticks before a tick; `None` if its episode had not begun.
    fn before(&self, header: &MessageHeader, ticks: u64) -> Option<&PastPoses> {
        let wanted = (header.episode, header.tick.checked_sub(ticks)?);
        let mut known = self.ticks.iter();
        known
            .find(|(episode, tick, _)| (*episode, *tick) == wanted)
            .map(|(.., poses)| poses)
    }

    /// The camera and the road users at the time since which its optical flow counts.
    fn since(
        &self,
        header: &MessageHeader,
        numbered: &NumberedCamera,
        camera: &CameraModel,
        carrier: &VehicleState,
        now: &CameraPose,
    ) -> Option<(CameraPose, &PastPoses)> {
        if numbered.flow_ticks == 0 {
            return None;
        }
        let poses = self.before(header, numbered.flow_ticks)?;
        let pose = match carrier.vehicle & ROADSIDE_CARRIER {
            0 => camera.past_pose_on(carrier.vehicle, poses)?,
            // It stands still.
            _ => *now,
        };
        Some((pose, poses))
    }

    /// Adds the poses of a tick.
    fn record(&mut self, header: &MessageHeader, targets: &Targets) {
        let mut poses = PastPoses::default();
        if self.ticks.len() >= self.most
            && let Some((.., oldest)) = self.ticks.pop_front()
        {
            poses = oldest;
        }
        poses.record(targets);
        self.ticks.push_back((header.episode, header.tick, poses));
    }
}

/// The dynamic vision sensors of a run: they sample within the tick.
#[derive(Default)]
struct EventVision {
    /// Length of a sub-step, microseconds.
    sub_step_us: f64,
    sub_steps: usize,
    /// The road users at the end of each sub-step of the tick that `targets` are of.
    within: Vec<CameraTargets>,
    /// By carrier and number of the camera, with the tick of the last sample.
    memories: BTreeMap<(u64, u32, u32), (u64, EventMemory)>,
    brightness: Vec<f32>,
    events: Vec<BrightnessEvent>,
}

impl EventVision {
    /// The road users within a tick.
    fn begin_tick(&mut self, header: &MessageHeader, targets: &Targets) {
        self.within.resize_with(self.sub_steps, CameraTargets::default);
        for (sub_step, within) in self.within.iter_mut().enumerate() {
            within.update_within(targets, sub_step);
        }
        // A camera that has missed a tick begins again.
        self.memories.retain(|_, (tick, _)| *tick + 1 == header.tick);
    }

    /// Events of a tick of one camera.
    fn sample(
        &mut self,
        header: &MessageHeader,
        camera: &CameraModel,
        targets: &Targets,
        (vehicle, unit): (u32, &DueUnit),
        threshold: f32,
        scratch: &mut CameraScratch,
    ) {
        self.events.clear();
        let [width, height] = camera.size();
        self.brightness.resize(width * height, 0.0);
        let key = (header.episode, vehicle, unit.sensor);
        let (tick, memory) = self.memories.entry(key).or_default();
        *tick = header.tick;
        let mut objects = Vec::new();
        for (sub_step, within) in self.within.iter().enumerate() {
            let Some(pose) = camera.pose_within(targets, unit.row, sub_step) else {
                return;
            };
            let shot = CameraShot {
                noise: None,
                targets: within,
                tick: None,
                carrier: Some(unit.row),
                pose,
                past: None,
            };
            let mut planes = ImagePlanes {
                brightness: &mut self.brightness,
                ..ImagePlanes::default()
            };
            camera.take(&shot, scratch, &mut planes, &mut objects);
            let span = SampledSpan {
                begin_us: self.sub_step_us * sub_step as f64,
                length_us: self.sub_step_us,
            };
            memory.sample(&self.brightness, width, threshold, span, &mut self.events);
        }
        sort_events(&mut self.events);
    }
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
            ImagePlane::Depth | ImagePlane::Instance | ImagePlane::Infrared | ImagePlane::Flow => return,
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
            let params = CameraParams::new(&camera, config.run.tick_s);
            let maps = sights
                .iter()
                .map(|sight| CameraModel::in_sight(&params, Arc::clone(sight)));
            let camera = NumberedCamera {
                maps: maps.collect(),
                planes: ImagePlane::wanted(&camera),
                range_m: camera.range_m as f32,
                distortion: camera.distortion.map(|part| part as f32),
                plane_bytes: ImagePlane::bytes(&camera),
                noise: PixelNoise {
                    full_well_e: camera.full_well_e as f32,
                    read_noise_e: camera.read_noise_e as f32,
                    infrared_k: camera.infrared_noise_k as f32,
                },
                noise_key: unit.noise_key(),
                flow_ticks: if camera.flow { u64::from(unit.period_ticks) } else { 0 },
                readout_s: camera.readout_s as f32,
                events: camera
                    .events
                    .then(|| (camera.event_threshold as f32, most_events(&camera))),
            };
            (unit.sensor, camera)
        });
        let cameras: BTreeMap<u32, NumberedCamera> = cameras.collect();
        let most = cameras.values().map(|camera| camera.flow_ticks).max().unwrap_or(0) as usize;
        let sub_steps_if = |is_needed: fn(&NumberedCamera) -> bool| match cameras.values().any(is_needed) {
            true => config.run.sub_steps as usize,
            false => 0,
        };
        let vision_steps = sub_steps_if(|camera| camera.events.is_some());
        let sub_steps = vision_steps.max(sub_steps_if(|camera| camera.readout_s > 0.0));
        Self {
            cameras,
            targets: Targets::in_ticks_of(config.run.tick_s),
            sub_steps,
            seen: CameraTargets::default(),
            scratch: CameraScratch::default(),
            objects: Vec::new(),
            past: PastTicks {
                most,
                ticks: VecDeque::new(),
            },
            vision: EventVision {
                sub_step_us: 1e6 * config.run.tick_s / f64::from(config.run.sub_steps),
                sub_steps: vision_steps,
                ..EventVision::default()
            },
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
        sub_steps: &[SubStep],
        beside: &RoadsideCarriers,
        sensing: &Sensing,
    ) -> Result<(), Failure> {
        if let Some(observed) = &mut self.observed {
            observed.begin_tick(sensing);
        }
        let mut due = std::mem::take(&mut self.due);
        sensing.units_due(SensorKind::Camera, &mut due);
        beside.add_due(SensorKind::Camera, sensing.now(header).tick, states.len(), &mut due);
        // The optical flow of a later image needs the poses of this tick, whether a camera is due or not.
        let keeps_poses = self.past.most > 0;
        if !due.is_empty() || keeps_poses {
            self.targets.update(states, sub_steps, self.sub_steps);
        }
        if !due.is_empty() {
            self.seen.update(&self.targets);
            self.vision.begin_tick(header, &self.targets);
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
        if keeps_poses {
            self.past.record(header, &self.targets);
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
        let most_events = numbered.events.map_or(0, |(_, most)| most);
        let longest = ImageLayout::new(MOST_SEEN, numbered.plane_bytes, most_events);
        let mut draft = self.publisher.loan_unwritten(*header, longest.len)?;
        // Head and planes lie at the same place whatever follows them.
        let [planes] = block::split_mut(draft.payload_mut(), &[longest.planes]).map_err(unreadable)?;
        let [width, height] = camera.size();
        let mut planes_of = split_planes(planes, numbered.planes, width * height);
        let (seen, scratch) = (&self.seen, &mut self.scratch);
        let shot = CameraShot {
            noise: ImageNoise::new(
                numbered.noise,
                header.episode_seed ^ numbered.noise_key,
                carrier.id_hash,
                header.tick,
            ),
            targets: seen,
            tick: Some(&self.targets),
            carrier: Some(unit.row),
            pose,
            past: self.past.since(header, numbered, camera, carrier, &pose),
        };
        camera.take(&shot, scratch, &mut planes_of, &mut self.objects);
        if let (Some(observed), Some(slot), OWN_SENSOR) = (&mut self.observed, unit.slot, unit.sensor) {
            observed.keep(slot, &planes_of);
        }
        self.objects.truncate(MOST_SEEN);
        let vision = &mut self.vision;
        vision.events.clear();
        if let Some((threshold, _)) = numbered.events {
            let carried = (carrier.vehicle, unit);
            vision.sample(header, camera, &self.targets, carried, threshold, scratch);
        }
        let lost_events = vision.events.len().saturating_sub(most_events);
        vision.events.truncate(most_events);
        let layout = ImageLayout::new(self.objects.len(), numbered.plane_bytes, vision.events.len());
        let sections = [layout.head, layout.planes, layout.objects, layout.events];
        let [head, planes, objects, events] = block::split_mut(draft.payload_mut(), &sections).map_err(unreadable)?;
        objects.copy_from_slice(bytemuck::cast_slice(&self.objects));
        events.copy_from_slice(bytemuck::cast_slice(&vision.events));
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
            lost_events: lost_events as u32,
            distortion: numbered.distortion,
            readout_s: numbered.readout_s,
        }));
        let hashed = hashed_head(head, offset_of!(ImageHead, sensor), unit.sensor);
        self.totals
            .add(header.tick, self.objects.len(), &[hashed, planes, objects, events]);
        *draft.header_mut() = MessageHeader {
            shape: layout.shape,
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
    let [depth, instance, flow, infrared, semantic, rgb, binary] = of_plane.each_mut().map(std::mem::take);
    ImagePlanes {
        depth_m: bytemuck::cast_slice_mut(depth),
        instance: bytemuck::cast_slice_mut(instance),
        semantic,
        rgb: bytemuck::cast_slice_mut(rgb),
        binary,
        infrared: bytemuck::cast_slice_mut(infrared),
        flow_px: bytemuck::cast_slice_mut(flow),
        brightness: &mut [],
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
            planes.infrared.len(),
            planes.flow_px.len(),
        ];
        assert_eq!(lengths, [6, 0, 6, 6, 0, 0, 0]);
    }

    #[test]
    fn all_planes_of_an_odd_number_of_pixels_are_aligned() {
        let mut words = [0_u64; 32];
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
        let wanted = ImagePlane::ALL.into_iter().fold(0, |bits, plane| bits | plane.bit());
        let planes = split_planes(bytes, wanted, 3);
        assert_eq!(
            (planes.infrared.len(), planes.flow_px.len(), planes.binary.len()),
            (3, 3, 3)
        );
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
