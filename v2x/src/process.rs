//! The process: receives `world` and `measurement` of each tick, and publishes `neighbours`.

use std::path::Path;

use ipc_schema::{
    block::{self, BlockError},
    board::State,
    config::{Config, ImuConvention, RoadsideUnitConfig},
    digest::ObservationDigest,
    failure::{Failure, FailureKind},
    header::{FIRST_OF_EPISODE, LAST_OF_EPISODE, LAST_OF_RUN, MessageHeader},
    membership::{RunMembership, Wait},
    neighbours::{NeighboursLayout, NeighboursSections},
    observation::{EMPTY_SLOT, ObservationLayout},
    ports::{Message, PortError},
    process::Process,
    run::RunFile,
    sensor::SensorKind,
    services::Channel,
    world::{VehicleState, WorldLayout},
};
use sensor_daemon::delivery::tick_publisher::{DeliveryFigures, TickPublisher};
use serde::{Deserialize, Serialize};
use sim_core::{geodesy::Projection, scene::Scene};

use crate::{
    capture::CaptureFile,
    choices::ChoicePort,
    exchange::{ExchangeCounts, MessageExchange, SlotMeasurement, speech::SpeechCounts},
    station::OwnMeasurement,
};

/// What this process has counted when an episode begins.
#[derive(Debug, Default, Serialize, Deserialize)]
struct V2xState {
    digest: ObservationDigest,
    counts: ExchangeCounts,
    load_sum: f64,
    radio_ticks: u64,
    #[serde(default)]
    speech: SpeechCounts,
}

/// What this process adds to the run's report.
#[derive(Debug, Serialize)]
struct V2xReport {
    /// BLAKE3 over every block of neighbours.
    neighbours_hash: String,
    ticks: u64,
    #[serde(flatten)]
    counts: ExchangeCounts,
    /// Mean share of time in which a radio finds the channel busy.
    mean_channel_load: Option<f64>,
    /// In the messages task: what messages have achieved.
    #[serde(skip_serializing_if = "Option::is_none")]
    speech: Option<SpeechReport>,
    #[serde(flatten)]
    delivery: DeliveryFigures,
}

/// What messages have achieved in the messages task.
#[derive(Debug, Serialize)]
struct SpeechReport {
    #[serde(flatten)]
    counts: SpeechCounts,
    /// Share of the road users in range that a station knows, over all stations and ticks.
    awareness: Option<f64>,
    /// Collective perception messages of a station, kbit/s.
    message_kbitps: Option<f64>,
}

impl SpeechReport {
    #[expect(clippy::cast_precision_loss, reason = "means in a report")]
    fn new(counts: SpeechCounts, tick_s: f64) -> Self {
        let station_s = counts.station_ticks as f64 * tick_s;
        Self {
            awareness: (counts.in_range > 0).then(|| counts.known as f64 / counts.in_range as f64),
            message_kbitps: (station_s > 0.0).then(|| counts.cpm_bytes as f64 * 8.0 / 1000.0 / station_s),
            counts,
        }
    }
}

/// Exchanges messages until the last tick of the run, or until the process is asked to stop.
///
/// # Errors
/// The map's projection is not understood, the scene cannot be read, or a port fails.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let mut membership = RunMembership::join(run_file, Process::V2x)?;
    let world = membership.subscriber(Channel::World)?;
    let measurements = membership.subscriber(Channel::Measurement)?;
    let mut process = V2xProcess::open(membership)?;
    loop {
        let Some(world_message) = process.neighbours.next(&mut process.membership, &world)? else {
            break;
        };
        let Some(measurement) = process.neighbours.next(&mut process.membership, &measurements)? else {
            break;
        };
        if process.tick(&world_message, &measurement)? == Wait::Stopped {
            break;
        }
        let header = *measurement.header();
        drop((world_message, measurement));
        process.membership.consumed(header.tick + 1);
        if header.has(LAST_OF_RUN) {
            return process.wait_for_consumers_end();
        }
    }
    process.write_part()
}

/// Every roadside unit stands within the map.
fn units_are_on_the_map(run: &RunFile) -> Result<(), Failure> {
    let [x_min, y_min, x_max, y_max] = run.map.bounds_m;
    let is_outside =
        |unit: &&RoadsideUnitConfig| !(x_min..=x_max).contains(&unit.x_m) || !(y_min..=y_max).contains(&unit.y_m);
    match run.config.v2x.roadside.iter().find(is_outside) {
        None => Ok(()),
        Some(unit) => Err(Failure::new(
            FailureKind::Config,
            format!(
                "the roadside unit \"{}\" at {} m, {} m stands beside the map",
                unit.id, unit.x_m, unit.y_m
            ),
        )
        .with_help(format!(
            "choose `v2x.roadside.x_m` from {x_min} to {x_max}, and `v2x.roadside.y_m` from {y_min} to {y_max}"
        ))),
    }
}

struct V2xProcess {
    membership: RunMembership,
    exchange: MessageExchange,
    neighbours: TickPublisher,
    /// What the trainer chooses, where messages are its choice.
    choices: Option<ChoicePort>,
    /// The file of the episode, where messages are captured.
    capture: Option<CaptureFile>,
    digest: ObservationDigest,
    load_sum: f64,
    radio_ticks: u64,
    /// The next tick.
    tick: u64,
}

impl V2xProcess {
    fn open(mut membership: RunMembership) -> Result<Self, Failure> {
        let scenes = Scene::of_every_map(&membership.run)?;
        let maps = membership.run.every_map();
        units_are_on_the_map(&membership.run)?;
        let projections: Result<Vec<Projection>, _> = maps.iter().map(|map| Projection::new(&map.info)).collect();
        let projections = projections.map_err(|error| Failure::from_error(FailureKind::Config, &error))?;
        let maps = scenes.into_iter().zip(projections).collect();
        let mut exchange = MessageExchange::new(&membership.run.config, maps);
        let state: V2xState = membership.stored_episode_state()?.unwrap_or_default();
        exchange.set_counts(state.counts);
        exchange.set_speech_counts(state.speech);
        let neighbours = TickPublisher::open(&membership, Channel::Neighbours)?;
        let choices = match membership.run.config.actor() {
            Some(Process::V2x) => Some(ChoicePort::open(&mut membership)?),
            _ => None,
        };
        membership.attach();
        let tick = membership.run.first_tick();
        Ok(Self {
            membership,
            exchange,
            neighbours,
            choices,
            capture: None,
            digest: state.digest,
            load_sum: state.load_sum,
            radio_ticks: state.radio_ticks,
            tick,
        })
    }

    fn tick(&mut self, world: &Message, measurement: &Message) -> Result<Wait, Failure> {
        let header = *measurement.header();
        for (channel, received) in [("world", world.header().tick), ("measurement", header.tick)] {
            if received != self.tick {
                return Err(PortError::Gap {
                    channel,
                    expected: self.tick,
                    received,
                }
                .into());
            }
        }
        let states: &[VehicleState] =
            block::view(world.payload(), WorldLayout::of(world.header()).states).map_err(unreadable)?;
        let slots = slots_of(measurement, &self.membership.run.config).map_err(unreadable)?;
        let layout = NeighboursLayout::of_config(&self.membership.run.config, slots.len());
        let waited = self
            .neighbours
            .wait_for_credit(&mut self.membership, header.tick, layout.len)?;
        if waited == Wait::Stopped {
            return Ok(Wait::Stopped);
        }
        self.publish(&header, &slots, states, &layout)?;
        // What is sent after the last tick of an episode arrives nowhere.
        if !header.has(LAST_OF_EPISODE) {
            if self.choose(&header, &slots)? == Wait::Stopped {
                return Ok(Wait::Stopped);
            }
            self.exchange.send(&header, &slots, states);
        }
        if self.membership.run.config.v2x.pcap {
            self.capture(&header)?;
        }
        self.report(&header);
        Ok(Wait::Ready)
    }

    /// Waits for the trainer's choices where messages are its choice.
    fn choose(&mut self, header: &MessageHeader, slots: &[SlotMeasurement]) -> Result<Wait, Failure> {
        let Some(port) = &mut self.choices else {
            return Ok(Wait::Ready);
        };
        let Some(choices) = port.next(&mut self.membership, &mut self.neighbours, header, slots)? else {
            return Ok(Wait::Stopped);
        };
        let mut choices = choices.iter().peekable();
        for (slot, measured) in slots.iter().enumerate() {
            if let Some(choice) = choices.next_if(|choice| choice.vehicle == measured.vehicle) {
                self.exchange.choose(slot, choice.places);
            }
        }
        Ok(Wait::Ready)
    }

    /// Writes what the stations know, adds it to the hash, and sends it or keeps it in the journal.
    fn publish(
        &mut self,
        header: &MessageHeader,
        slots: &[SlotMeasurement],
        states: &[VehicleState],
        layout: &NeighboursLayout,
    ) -> Result<(), Failure> {
        let ours = self.membership.header();
        let header = MessageHeader {
            run_id: ours.run_id,
            incarnation: ours.incarnation,
            addressee: 0,
            shape: layout.shape,
            ..*header
        };
        let header = self.neighbours.addressed(header);
        let mut draft = self.neighbours.port().loan(header, layout.len)?;
        let mut sections = NeighboursSections::split(draft.payload_mut(), layout).map_err(unreadable)?;
        self.exchange.receive(&header, slots, states, &mut sections);
        let loads = sections.radio.iter().zip(sections.channel_load.iter());
        for (_, load) in loads.filter(|([equipped, ..], _)| *equipped == 1) {
            self.load_sum += f64::from(*load);
            self.radio_ticks += 1;
        }
        self.digest.add(&header, draft.payload());
        // Stored before the tick is sent: a process that has received the last tick of an episode can rely on the state of the next one.
        if header.has(LAST_OF_EPISODE) {
            self.store_state(header.tick + 1)?;
        }
        self.neighbours.publish(&header, draft)
    }

    /// Writes the messages of the tick into the file of the episode.
    fn capture(&mut self, header: &MessageHeader) -> Result<(), Failure> {
        let unwritable = |error: std::io::Error| {
            Failure::from_error(FailureKind::Run, &error)
                .with_help("check free space and permissions of the run directory")
        };
        if header.has(FIRST_OF_EPISODE) {
            let file = CaptureFile::create(&self.membership.run.run_dir, header.episode).map_err(unwritable)?;
            self.capture = Some(file);
        }
        let Some(file) = &mut self.capture else { return Ok(()) };
        if header.has(LAST_OF_EPISODE) {
            return file.flush().map_err(unwritable);
        }
        file.push(header.sim_time_ns, self.exchange.on_air())
            .map_err(unwritable)
    }

    fn store_state(&self, tick: u64) -> Result<(), Failure> {
        let state = V2xState {
            digest: self.digest.clone(),
            counts: self.exchange.counts(),
            load_sum: self.load_sum,
            radio_ticks: self.radio_ticks,
            speech: self.exchange.speech_counts(),
        };
        self.membership.store_episode_state(tick, &state)
    }

    fn report(&mut self, header: &MessageHeader) {
        self.tick = header.tick + 1;
        let (ticks, drops) = (self.tick, self.neighbours.port().drops());
        self.membership.report(|health| {
            health.state = State::Running as u32;
            health.ticks = ticks;
            health.episode = header.episode;
            health.sim_time_ns = header.sim_time_ns;
            health.drops = drops;
        });
    }

    /// Waits until every required consumer is done.
    fn wait_for_consumers_end(mut self) -> Result<(), Failure> {
        let waited = self
            .neighbours
            .wait_for_consumers_end(&mut self.membership, self.tick, || true)?;
        self.write_part()?;
        if waited == Wait::Ready {
            self.membership.report(|health| health.state = State::Done as u32);
        }
        Ok(())
    }

    fn write_part(&mut self) -> Result<(), Failure> {
        // A run that is stopped leaves what it has captured of its last episode.
        if let Some(file) = &mut self.capture {
            let flushed = file.flush();
            flushed.map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
        }
        #[expect(clippy::cast_precision_loss, reason = "a mean in a report")]
        let mean = (self.radio_ticks > 0).then(|| self.load_sum / self.radio_ticks as f64);
        self.membership.write_part(&V2xReport {
            neighbours_hash: self.digest.hex(),
            ticks: self.tick,
            counts: self.exchange.counts(),
            mean_channel_load: mean,
            speech: self
                .membership
                .run
                .config
                .speaks()
                .then(|| SpeechReport::new(self.exchange.speech_counts(), self.membership.run.config.run.tick_s)),
            delivery: self.neighbours.figures(),
        })
    }
}

/// The slots of a `measurement` message: what services may know of their own vehicle.
fn slots_of(message: &Message, config: &Config) -> Result<Vec<SlotMeasurement>, BlockError> {
    let (payload, layout) = (message.payload(), ObservationLayout::of(message.header()));
    let vehicle: &[u32] = block::view(payload, layout.vehicle)?;
    let id_hash: &[u64] = block::view(payload, layout.id_hash)?;
    let episode_step: &[u32] = block::view(payload, layout.episode_step)?;
    let sensors: &[u32] = block::view(payload, layout.sensors)?;
    let gnss_m: &[[f32; 3]] = block::view(payload, layout.gnss_m)?;
    let quality: &[[f32; 2]] = block::view(payload, layout.gnss_quality)?;
    let age_s: &[[f32; 4]] = block::view(payload, layout.age_s)?;
    let speed_steering: &[[f32; 2]] = block::view(payload, layout.speed_steering)?;
    let imu: &[[f32; 7]] = block::view(payload, layout.imu)?;
    let samples = imu.len().checked_div(vehicle.len()).unwrap_or(0);
    let left_handed = config.imu.convention == ImuConvention::Carla;
    let slot = |slot: usize| {
        let fix = gnss_m[slot].map(f64::from);
        // Before the first fix all of it is zero.
        let has_fix = fix != [0.0; 3] && samples > 0 && vehicle[slot] != EMPTY_SLOT;
        let own = has_fix.then(|| {
            let sample = imu[(slot + 1) * samples - 1].map(f64::from);
            let delivers = SensorKind::Gnss.is_in(sensors[slot]) && quality[slot][0] > 0.0;
            OwnMeasurement {
                fix_m: [fix[0], fix[1]],
                altitude_m: fix[2],
                fix_age_s: age_s[slot][SensorKind::Gnss.index()].into(),
                accuracy_m: delivers.then(|| quality[slot][0].into()),
                speed_mps: speed_steering[slot][0].into(),
                heading_rad: std::f64::consts::FRAC_PI_2 - sample[6],
                accel_mps2: sample[0],
                yaw_rate_radps: if left_handed { -sample[5] } else { sample[5] },
            }
        });
        SlotMeasurement {
            vehicle: vehicle[slot],
            id_hash: id_hash[slot],
            episode_step: episode_step[slot],
            own,
        }
    };
    Ok((0..vehicle.len()).map(slot).collect())
}

fn unreadable(error: BlockError) -> Failure {
    Failure::from_error(FailureKind::Run, &error)
}
