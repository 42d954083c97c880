//! A recording in the place of the simulators: its messages go to shared memory in their order, to viewers at a chosen speed, and to a trainer
//! as far as it returns credit. The process takes the place of `sensor-daemon`, so a trainer notices no difference.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use ipc_schema::{
    block,
    board::State,
    channel::Channel,
    digest::ObservationDigest,
    failure::{Failure, FailureKind},
    header::{LAST_OF_RUN, MessageHeader},
    membership::{RunMembership, Wait},
    observation::{EMPTY_SLOT, ObservationLayout},
    ports::Publisher,
    process::Process,
    run::Replay,
    sensor::SensorKind,
};
use recorder::file::{
    RecordingError,
    reader::{ChannelMessage, RecordingReader},
};
use serde_json::json;

mod census;
mod outputs;
use census::PlayedCensus;
use outputs::{TickMessage, TickOutputs};

/// Longest wait between two looks at the clock and the request to stop.
const LOOK: Duration = Duration::from_millis(50);

/// Plays the recording that the run file names, until its end or until the process is asked to stop.
///
/// # Errors
/// The recording cannot be read or ends before the run that it is of, or a port failed.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let membership = RunMembership::join(run_file, Process::SensorDaemon)?;
    let replay = membership.run.replay.clone();
    let replay = replay.ok_or_else(|| Failure::new(FailureKind::Run, "the run file names no recording"))?;
    let recording = RecordingReader::open(&replay.file).map_err(unreadable)?;
    let mut player = Player::open(membership, &replay)?;
    for message in recording.channel_messages() {
        let message = message.map_err(unreadable)?;
        if player.play(&message)? == Wait::Stopped {
            return player.write_part();
        }
    }
    player.leave(&replay)
}

fn unreadable(error: RecordingError) -> Failure {
    Failure::from_error(FailureKind::Run, &error).with_help(error.advice())
}

struct Player {
    membership: RunMembership,
    /// By [`Channel`]; `None` for those that the replay does not send.
    publishers: Vec<Option<Publisher>>,
    outputs: TickOutputs,
    census: PlayedCensus,
    from_tick: u64,
    /// Tick that the clock began with, and when.
    begun: Option<(u64, Instant)>,
    digest: ObservationDigest,
    first_tick: Option<u64>,
    ticks: u64,
    vehicle_steps: u64,
    cavs_max: u32,
    has_last: bool,
}

impl Player {
    fn open(mut membership: RunMembership, replay: &Replay) -> Result<Self, Failure> {
        let has_trainer = membership.run.mode.has_trainer();
        let is_sent = |channel: Channel| match channel {
            // Their only receivers are simulators.
            Channel::Traffic | Channel::EgoPose | Channel::Switch | Channel::Measurement => false,
            // They have publishers of their own.
            Channel::Observation | Channel::Neighbours => false,
            Channel::Prediction => !has_trainer,
            Channel::Pointcloud => membership.run.config.carries(SensorKind::Lidar),
            Channel::Image => membership.run.config.carries(SensorKind::Camera),
            Channel::LanePosition => membership.run.config.traffic.lane_positions,
            Channel::Radar => membership.run.config.carries(SensorKind::Radar),
            Channel::Census => membership.run.config.fanout.enabled,
            Channel::TrafficMeta | Channel::World | Channel::Event => true,
        };
        let publisher = |channel: Channel| is_sent(channel).then(|| membership.publisher(channel)).transpose();
        let publishers = Channel::ALL.into_iter().map(publisher).collect::<Result<_, _>>()?;
        let outputs = TickOutputs::open(&membership)?;
        membership.attach();
        Ok(Self {
            publishers,
            outputs,
            census: PlayedCensus::default(),
            from_tick: replay.from_tick,
            begun: None,
            digest: ObservationDigest::default(),
            first_tick: None,
            ticks: 0,
            vehicle_steps: 0,
            cavs_max: 0,
            has_last: false,
            membership,
        })
    }

    fn publisher(&self, channel: Channel) -> Option<&Publisher> {
        self.publishers[channel as usize].as_ref()
    }

    /// The header of a recorded message as a message of this run.
    fn header(&self, recorded: &MessageHeader) -> MessageHeader {
        let ours = self.membership.header();
        MessageHeader {
            schema_version: ours.schema_version,
            run_id: ours.run_id,
            incarnation: ours.incarnation,
            addressee: 0,
            ..*recorded
        }
    }

    /// Sends a message when it is due.
    fn play(&mut self, message: &ChannelMessage) -> Result<Wait, Failure> {
        let header = self.header(&message.header);
        if message.channel == Channel::TrafficMeta {
            self.census
                .add(&header, message.payload())
                .map_err(|error| Failure::from_error(FailureKind::Run, &error))?;
        }
        if header.tick < self.from_tick {
            return Ok(Wait::Ready);
        }
        if self.wait_until_due(header.tick)? == Wait::Stopped {
            return Ok(Wait::Stopped);
        }
        if matches!(message.channel, Channel::Observation | Channel::Neighbours) {
            return self.play_tick(message.channel, header, message.payload());
        }
        if message.channel == Channel::World
            && let Some(census) = &self.publishers[Channel::Census as usize]
        {
            self.census.publish_if_due(census, header)?;
        }
        if let Some(publisher) = self.publisher(message.channel) {
            let mut draft = publisher.loan_unwritten(header, message.payload().len())?;
            draft.payload_mut().copy_from_slice(message.payload());
            draft.send()?;
        }
        Ok(Wait::Ready)
    }

    /// Waits until `tick` is due by the clock, in a replay that has a speed.
    fn wait_until_due(&mut self, tick: u64) -> Result<Wait, Failure> {
        let run = &self.membership.run.config.run;
        let (first, begin) = *self.begun.get_or_insert_with(|| (tick, Instant::now()));
        if run.real_time_factor > 0.0 {
            #[expect(clippy::cast_precision_loss, reason = "a time on the clock")]
            let after_s = tick.saturating_sub(first) as f64 * run.tick_s / run.real_time_factor;
            let after = Duration::from_secs_f64(after_s);
            while let Some(left) = after.checked_sub(begin.elapsed()).filter(|left| !left.is_zero()) {
                if self.membership.stopped() {
                    break;
                }
                self.membership.wait(left.min(LOOK))?;
            }
        }
        Ok(if self.membership.stopped() {
            Wait::Stopped
        } else {
            Wait::Ready
        })
    }

    /// Sends an observation, or what is known from messages, to viewers, and to the trainer as the simulators do.
    fn play_tick(&mut self, channel: Channel, header: MessageHeader, payload: &[u8]) -> Result<Wait, Failure> {
        if !self.outputs.are_paired() {
            return self.send_tick(channel, &header, payload);
        }
        let payload = payload.to_vec();
        self.outputs.keep(channel, TickMessage { header, payload });
        while let Some(pair) = self.outputs.next_pair() {
            for (channel, message) in [Channel::Observation, Channel::Neighbours].into_iter().zip(pair) {
                if self.send_tick(channel, &message.header, &message.payload)? == Wait::Stopped {
                    return Ok(Wait::Stopped);
                }
            }
        }
        Ok(Wait::Ready)
    }

    fn send_tick(&mut self, channel: Channel, header: &MessageHeader, payload: &[u8]) -> Result<Wait, Failure> {
        let sent = self.outputs.send(&mut self.membership, channel, header, payload)?;
        if sent == Wait::Ready && channel == Channel::Observation {
            self.digest.add(header, payload);
            self.report(header, payload);
        }
        Ok(sent)
    }

    fn report(&mut self, header: &MessageHeader, payload: &[u8]) {
        self.first_tick.get_or_insert(header.tick);
        self.has_last |= header.has(LAST_OF_RUN);
        self.ticks = header.tick + 1;
        let vehicles: &[u32] = block::view(payload, ObservationLayout::of(header).vehicle).unwrap_or_default();
        let cavs = vehicles.iter().filter(|vehicle| **vehicle != EMPTY_SLOT).count() as u32;
        self.cavs_max = self.cavs_max.max(cavs);
        self.vehicle_steps += u64::from(cavs);
        let (ticks, vehicle_steps) = (self.ticks, self.vehicle_steps);
        self.membership.report(|health| {
            health.state = State::Running as u32;
            health.ticks = ticks;
            health.episode = header.episode;
            health.sim_time_ns = header.sim_time_ns;
            health.cavs = cavs;
            health.vehicle_steps = vehicle_steps;
        });
    }

    /// Leaves once the trainer is done.
    fn leave(mut self, replay: &Replay) -> Result<(), Failure> {
        if self.outputs.observations.has_trainer() && !self.has_last {
            let file = replay.file.display();
            return Err(Failure::new(
                FailureKind::Run,
                format!(
                    "{file} ends with tick {}, before the run that it is of: a trainer would wait for more",
                    self.ticks
                ),
            )
            .with_help("learn from the recording of a run that was completed"));
        }
        let waited = self.outputs.wait_for_consumers_end(&mut self.membership, self.ticks)?;
        self.write_part()?;
        if waited == Wait::Ready {
            self.membership.report(|health| health.state = State::Done as u32);
        }
        Ok(())
    }

    fn write_part(&self) -> Result<(), Failure> {
        let first_tick = self.first_tick.unwrap_or(0);
        let delivery = self.outputs.observations.figures();
        self.membership.write_part(&json!({
            "observation_hash": self.digest.hex(),
            "first_tick": first_tick,
            "observations": self.vehicle_steps,
            "ticks": self.ticks.saturating_sub(first_tick),
            "cavs_max": self.cavs_max,
            "raw_gnss_mean_error_m": null,
            "drops": delivery.drops,
            "lidar": null,
            "camera": null,
            "radar": null,
            "redelivered_ticks": delivery.redelivered_ticks,
            "journal_mib": delivery.journal_mib,
            "handovers": delivery.handovers,
        }))
    }
}
