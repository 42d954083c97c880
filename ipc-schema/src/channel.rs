//! The data services of a run: one row of [`CHANNELS`] for each. Creation and opening, credits, the fan-out and the table at the head
//! of this crate derive from it (decision 21).

use crate::{
    config::{Config, TaskKind},
    control::{MAX_SWITCHES, SensorSwitchLayout},
    ego::EgoPoseLayout,
    event::CollisionLayout,
    image::{ImageLayout, ImagePlane, MOST_SEEN, most_events},
    lane_position::LanePositionLayout,
    neighbours::NeighboursLayout,
    observation::ObservationLayout,
    pointcloud::PointcloudLayout,
    prediction::{ACTION_COLUMNS, ESTIMATE_COLUMNS, PredictionLayout},
    process::Process::{self, Recorder, SensorDaemon, SimCore, TrafficBridge, Trainer, V2x},
    radar::{MOST_DETECTIONS, RadarLayout},
    run::RunFile,
    section::SectionSpec,
    sensor::SensorKind,
    traffic::{
        EVENTS_PER_MESSAGE, MOST_SIGNALS, ROUTE_POINTS_PER_MESSAGE, SIGNALS_PER_MESSAGE, TrafficLayout,
        TrafficMetaLayout,
    },
    world::{WorldLayout, most_trailing},
};

/// Messages a process may hold besides those in its queue.
const SPARE_MESSAGES: usize = 2;
/// Messages that the route of one hero may take: 4096 points.
const ROUTE_MESSAGES_PER_HERO: usize = 2;

/// A data service; its number is its place in [`CHANNELS`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Channel {
    /// SUMO's road users.
    Traffic = 0,
    /// Arrivals, departures and what a road user is.
    TrafficMeta = 1,
    /// Every road user and every traffic light, once per simulated second.
    Census = 2,
    /// Road users as the nanoscopic core moves them.
    World = 3,
    /// What connected vehicles sense.
    Observation = 4,
    /// What the policy makes of it: positions, or actions in the driving task.
    Prediction = 5,
    /// Where the heroes are, back to SUMO.
    EgoPose = 6,
    /// Collisions.
    Event = 7,
    /// What LIDARs see: one message for each LIDAR and tick.
    Pointcloud = 8,
    /// Sensors that commands switch on and off.
    Switch = 9,
    /// What cameras see: one message for each camera and image.
    Image = 10,
    /// What radars detect: one message for each radar and scan.
    Radar = 11,
    /// What connected vehicles sense, for `v2x`: every tick that is made, once.
    Measurement = 12,
    /// What connected vehicles know from messages.
    Neighbours = 13,
    /// Where road users are on SUMO's lanes and routes, and SUMO's time.
    LanePosition = 14,
}

/// What happens to a message that finds a subscriber's queue full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FullQueue {
    /// The new message is dropped for that subscriber, and counted. Credit keeps the queue of a required consumer from filling.
    DropNewest,
    /// The new message pushes the oldest one out.
    DropOldest,
}

/// One row of [`CHANNELS`].
#[derive(Debug, Clone, Copy)]
pub struct ChannelSpec {
    /// The channel.
    pub channel: Channel,
    /// Name in service names.
    pub name: &'static str,
    /// What a payload holds, in words.
    pub payload: &'static str,
    /// Sections of a payload.
    pub sections: &'static [SectionSpec],
    /// Names of the dimensions of the sections, in the order of the header's shape.
    pub dimensions: &'static [&'static str],
    /// The one process that sends.
    pub producer: Process,
    /// Processes that must not miss a message: the producer needs the credit of each that the run requires ([`Channel::requires`]).
    pub required: &'static [Process],
    /// The channel whose credit bounds this one's messages too: its own, or that of the ticks that its messages go with.
    pub paced_by: Channel,
    /// Ticks that the producer may be ahead of each required consumer.
    pub window: fn(&RunFile) -> u64,
    /// Topics on which `fanout` publishes what this channel carries.
    pub topics: &'static [&'static str],
    /// What happens at a full queue.
    pub when_full: FullQueue,
    /// Longest payload of a run, bytes.
    pub max_payload: fn(&RunFile) -> usize,
    /// Messages that a subscriber's queue holds.
    pub queue_length: fn(&RunFile) -> usize,
    /// Messages that one subscriber may hold while it works on them.
    pub in_hand: fn(&RunFile) -> usize,
    /// False for a run in which no message is ever sent: its memory is not counted.
    pub is_used: fn(&RunFile) -> bool,
}

/// Ticks that a process may be ahead of the next.
fn window(run: &RunFile) -> usize {
    usize::try_from(run.window_ticks()).unwrap_or(usize::MAX)
}

/// Messages of `traffic` that traffic-bridge may be ahead of sim-core.
fn traffic_frames(run: &RunFile) -> usize {
    let per_frame = usize::try_from(run.ticks_per_frame()).unwrap_or(usize::MAX);
    let window = usize::try_from(run.traffic_window_ticks()).unwrap_or(usize::MAX);
    window.div_ceil(per_frame)
}

/// Most road users alive at once.
fn road_users(run: &RunFile) -> usize {
    run.config.traffic.max_road_users as usize
}

/// Most heroes that SUMO gives advice for in a step: those that have just left count, too.
fn advised_heroes(run: &RunFile) -> usize {
    if run.config.advises_heroes() {
        road_users(run)
    } else {
        0
    }
}

/// Most `traffic-meta` messages without routes that one SUMO step takes: all road users may leave and as many come in it, and every
/// traffic light may change.
fn meta_messages(run: &RunFile) -> usize {
    let events = (2 * road_users(run)).div_ceil(EVENTS_PER_MESSAGE);
    let lights = run.map.traffic_lights as usize;
    events.max(lights.div_ceil(SIGNALS_PER_MESSAGE)).max(1)
}

/// A window of messages.
fn windowful(run: &RunFile) -> usize {
    window(run) + SPARE_MESSAGES
}

/// Further messages of `channel` that may be on their way to a `recorder` that must not miss one; 0 where none must.
fn recorded_ahead(run: &RunFile, channel: Channel, messages: usize) -> usize {
    if run.config.record.is_lossless(channel) {
        messages
    } else {
        0
    }
}

/// Messages of `census`, one a simulated second, that may be on their way to a `recorder` that must not miss one.
fn censuses(run: &RunFile) -> usize {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a window is a small positive time"
    )]
    let seconds = (run.traffic_window_ticks() as f64 * run.config.run.tick_s).ceil() as usize;
    recorded_ahead(run, Channel::Census, seconds)
}

/// The largest size of the sensors of this kind.
fn of_units(run: &RunFile, kind: SensorKind, size: impl Fn(&Config) -> usize) -> usize {
    let units = run.config.sensor_units(kind);
    let sizes = units.iter().map(|unit| size(&run.config.with_unit(unit)));
    sizes.max().unwrap_or_else(|| size(&run.config))
}

/// A batch at work while the next one is taken.
const fn two_batches(queue_length: usize) -> usize {
    2 * queue_length
}

/// Every data service, by [`Channel`].
pub const CHANNELS: [ChannelSpec; 15] = [
    ChannelSpec {
        channel: Channel::Traffic,
        name: "traffic",
        payload: "`[TrafficState]`, `[HeroAdvice]`",
        sections: TrafficLayout::SECTIONS,
        dimensions: TrafficLayout::DIMENSIONS,
        producer: TrafficBridge,
        required: &[SimCore, Recorder],
        paced_by: Channel::Traffic,
        window: RunFile::traffic_window_ticks,
        topics: &[],
        when_full: FullQueue::DropNewest,
        max_payload: |run| TrafficLayout::sized(road_users(run), advised_heroes(run)).len,
        queue_length: |run| traffic_frames(run) + SPARE_MESSAGES,
        in_hand: |run| two_batches(Channel::Traffic.queue_length(run)),
        is_used: |_| true,
    },
    ChannelSpec {
        channel: Channel::TrafficMeta,
        name: "traffic-meta",
        payload: "`[VehicleMeta]`, `[SignalMeta]`; or `[RoutePoint]`",
        sections: TrafficMetaLayout::SECTIONS,
        dimensions: TrafficMetaLayout::DIMENSIONS,
        producer: TrafficBridge,
        required: &[SimCore],
        paced_by: Channel::Traffic,
        window: RunFile::traffic_window_ticks,
        topics: &["vehicles", "signals", "routes"],
        when_full: FullQueue::DropNewest,
        max_payload: |_| {
            let metas = TrafficMetaLayout::new(EVENTS_PER_MESSAGE, SIGNALS_PER_MESSAGE).len;
            metas.max(TrafficMetaLayout::sized(0, 0, ROUTE_POINTS_PER_MESSAGE).len)
        },
        // All heroes may come within one step, each with its route.
        queue_length: |run| {
            let routes = run.config.heroes() * ROUTE_MESSAGES_PER_HERO;
            traffic_frames(run) * meta_messages(run) + routes + SPARE_MESSAGES
        },
        in_hand: |run| two_batches(Channel::TrafficMeta.queue_length(run)),
        is_used: |_| true,
    },
    ChannelSpec {
        channel: Channel::Census,
        name: "census",
        payload: "as `traffic-meta`: every road user and every light",
        sections: TrafficMetaLayout::SECTIONS,
        dimensions: TrafficMetaLayout::DIMENSIONS,
        producer: TrafficBridge,
        required: &[],
        paced_by: Channel::Traffic,
        window: RunFile::window_ticks,
        topics: &["vehicles", "signals"],
        when_full: FullQueue::DropOldest,
        max_payload: |run| TrafficMetaLayout::new(road_users(run), MOST_SIGNALS).len,
        queue_length: |run| censuses(run) + SPARE_MESSAGES,
        in_hand: |_| SPARE_MESSAGES,
        is_used: |run| run.config.fanout.enabled,
    },
    ChannelSpec {
        channel: Channel::World,
        name: "world",
        payload: "`[VehicleState]`, `[SubStep]`, `[HeroView]`",
        sections: WorldLayout::SECTIONS,
        dimensions: WorldLayout::DIMENSIONS,
        producer: SimCore,
        required: &[SensorDaemon, V2x, Recorder],
        paced_by: Channel::World,
        window: RunFile::window_ticks,
        topics: &["world"],
        when_full: FullQueue::DropNewest,
        max_payload: |run| {
            let sub_steps = run.config.run.sub_steps as usize;
            let road_users = road_users(run);
            WorldLayout::with_heroes(road_users, sub_steps, run.config.heroes(), most_trailing(road_users)).len
        },
        // A trainer that watches is behind sensor-daemon by another window.
        queue_length: |run| match run.config.trainer.road_users {
            true => 3 * windowful(run),
            false => windowful(run),
        },
        in_hand: |run| two_batches(windowful(run)),
        is_used: |_| true,
    },
    ChannelSpec {
        channel: Channel::Observation,
        name: "observation",
        payload: "observations, truth, newest samples, slots",
        sections: ObservationLayout::SECTIONS,
        dimensions: ObservationLayout::DIMENSIONS,
        producer: SensorDaemon,
        required: &[Trainer, Recorder],
        paced_by: Channel::Observation,
        window: RunFile::window_ticks,
        topics: &["observation"],
        when_full: FullQueue::DropNewest,
        max_payload: |run| ObservationLayout::of_run(road_users(run), &run.config).len,
        queue_length: windowful,
        in_hand: |run| two_batches(windowful(run)),
        is_used: |_| true,
    },
    ChannelSpec {
        channel: Channel::Prediction,
        name: "prediction",
        payload: "positions or actions, estimates of the filter, vehicles",
        sections: PredictionLayout::SECTIONS,
        dimensions: PredictionLayout::DIMENSIONS,
        producer: Trainer,
        // Where the world waits for actions, sim-core or v2x waits for each message: the trainer is at most one ahead, and no queue
        // overflows.
        required: &[],
        paced_by: Channel::Observation,
        window: RunFile::window_ticks,
        topics: &["prediction"],
        when_full: FullQueue::DropNewest,
        max_payload: |run| {
            let slots = road_users(run);
            let layout = match run.config.task.kind {
                TaskKind::Driving => PredictionLayout::of_actions(slots, ACTION_COLUMNS),
                TaskKind::Messages => PredictionLayout::new(slots, run.config.v2x.candidates as usize, false),
                TaskKind::Localisation | TaskKind::Lane => PredictionLayout::new(slots, ESTIMATE_COLUMNS, true),
            };
            layout.len
        },
        queue_length: |run| windowful(run) + recorded_ahead(run, Channel::Prediction, 2 * window(run)),
        in_hand: |run| two_batches(Channel::Prediction.queue_length(run)),
        is_used: |_| true,
    },
    ChannelSpec {
        channel: Channel::EgoPose,
        name: "ego-pose",
        payload: "`[EgoPose]`",
        sections: EgoPoseLayout::SECTIONS,
        dimensions: EgoPoseLayout::DIMENSIONS,
        producer: SimCore,
        required: &[TrafficBridge],
        paced_by: Channel::World,
        window: RunFile::window_ticks,
        topics: &[],
        when_full: FullQueue::DropNewest,
        max_payload: |run| EgoPoseLayout::sized(road_users(run)).len,
        queue_length: windowful,
        in_hand: |run| two_batches(windowful(run)),
        is_used: |_| true,
    },
    ChannelSpec {
        channel: Channel::Event,
        name: "event",
        payload: "`[Collision]`",
        sections: CollisionLayout::SECTIONS,
        dimensions: CollisionLayout::DIMENSIONS,
        producer: SimCore,
        required: &[],
        paced_by: Channel::World,
        window: RunFile::window_ticks,
        topics: &["event"],
        when_full: FullQueue::DropNewest,
        max_payload: |run| CollisionLayout::sized(road_users(run)).len,
        queue_length: windowful,
        in_hand: |run| two_batches(windowful(run)),
        is_used: |_| true,
    },
    ChannelSpec {
        channel: Channel::Pointcloud,
        name: "pointcloud",
        payload: "`Scan`, `[LidarPoint]`: one message for each LIDAR and tick",
        sections: PointcloudLayout::SECTIONS,
        dimensions: PointcloudLayout::DIMENSIONS,
        producer: SensorDaemon,
        required: &[],
        paced_by: Channel::Observation,
        window: RunFile::window_ticks,
        topics: &["pointcloud"],
        when_full: FullQueue::DropOldest,
        max_payload: |run| {
            let rays = of_units(run, SensorKind::Lidar, |config| {
                config.lidar.rays_per_tick(config.run.tick_s)
            });
            PointcloudLayout::new(rays).len
        },
        // The scans of one tick.
        queue_length: |run| {
            let scans = run.messages_per_tick(SensorKind::Lidar);
            scans + recorded_ahead(run, Channel::Pointcloud, scans * window(run)) + SPARE_MESSAGES
        },
        in_hand: |_| SPARE_MESSAGES,
        is_used: |run| run.config.carries(SensorKind::Lidar),
    },
    ChannelSpec {
        channel: Channel::Switch,
        name: "switch",
        payload: "`[SensorSwitch]`, from the tick in the header on",
        sections: SensorSwitchLayout::SECTIONS,
        dimensions: SensorSwitchLayout::DIMENSIONS,
        producer: TrafficBridge,
        // A switch goes with a tick, whose own credit bounds both.
        required: &[],
        paced_by: Channel::Traffic,
        window: RunFile::traffic_window_ticks,
        topics: &[],
        when_full: FullQueue::DropNewest,
        max_payload: |_| SensorSwitchLayout::sized(MAX_SWITCHES).len,
        // One for each step that is on its way through sim-core.
        queue_length: |run| traffic_frames(run) + windowful(run),
        in_hand: |run| two_batches(Channel::Switch.queue_length(run)),
        is_used: |_| true,
    },
    ChannelSpec {
        channel: Channel::Image,
        name: "image",
        payload: "`ImageHead`, planes, `[SeenObject]`, `[BrightnessEvent]`: one message for each camera and image",
        sections: ImageLayout::SECTIONS,
        dimensions: ImageLayout::DIMENSIONS,
        producer: SensorDaemon,
        required: &[],
        paced_by: Channel::Observation,
        window: RunFile::window_ticks,
        topics: &["image"],
        when_full: FullQueue::DropOldest,
        max_payload: |run| {
            of_units(run, SensorKind::Camera, |config| {
                let camera = &config.camera;
                ImageLayout::new(MOST_SEEN, ImagePlane::bytes(camera), most_events(camera)).len
            })
        },
        // The messages of one tick.
        queue_length: |run| run.messages_per_tick(SensorKind::Camera) + SPARE_MESSAGES,
        in_hand: |_| SPARE_MESSAGES,
        is_used: |run| run.config.carries(SensorKind::Camera),
    },
    ChannelSpec {
        channel: Channel::Radar,
        name: "radar",
        payload: "`RadarScan`, `[RadarDetection]`: one message for each radar and scan",
        sections: RadarLayout::SECTIONS,
        dimensions: RadarLayout::DIMENSIONS,
        producer: SensorDaemon,
        required: &[],
        paced_by: Channel::Observation,
        window: RunFile::window_ticks,
        topics: &["radar"],
        when_full: FullQueue::DropOldest,
        max_payload: |_| RadarLayout::new(MOST_DETECTIONS).len,
        // The messages of one tick.
        queue_length: |run| run.messages_per_tick(SensorKind::Radar) + SPARE_MESSAGES,
        in_hand: |_| SPARE_MESSAGES,
        is_used: |run| run.config.carries(SensorKind::Radar),
    },
    ChannelSpec {
        channel: Channel::Measurement,
        name: "measurement",
        payload: "as `observation`, for every tick made",
        sections: ObservationLayout::SECTIONS,
        dimensions: ObservationLayout::DIMENSIONS,
        producer: SensorDaemon,
        required: &[V2x, Recorder],
        paced_by: Channel::Measurement,
        window: RunFile::window_ticks,
        topics: &[],
        when_full: FullQueue::DropNewest,
        max_payload: |run| match run.config.v2x.is_on() {
            true => Channel::Observation.max_payload(run),
            false => 0,
        },
        queue_length: windowful,
        in_hand: |run| two_batches(windowful(run)),
        is_used: |run| run.config.v2x.is_on(),
    },
    ChannelSpec {
        channel: Channel::Neighbours,
        name: "neighbours",
        payload: "objects known from messages, radios",
        sections: NeighboursLayout::SECTIONS,
        dimensions: NeighboursLayout::DIMENSIONS,
        producer: V2x,
        required: &[Trainer, Recorder],
        paced_by: Channel::Neighbours,
        window: RunFile::window_ticks,
        topics: &["neighbours"],
        when_full: FullQueue::DropNewest,
        max_payload: |run| match run.config.v2x.is_on() {
            true => NeighboursLayout::of_config(&run.config, road_users(run)).len,
            false => 0,
        },
        queue_length: windowful,
        in_hand: |run| two_batches(windowful(run)),
        is_used: |run| run.config.v2x.is_on(),
    },
    ChannelSpec {
        channel: Channel::LanePosition,
        name: "lane-position",
        payload: "SUMO's time, `[LanePosition]`",
        sections: LanePositionLayout::SECTIONS,
        dimensions: LanePositionLayout::DIMENSIONS,
        producer: TrafficBridge,
        required: &[],
        paced_by: Channel::Traffic,
        window: RunFile::traffic_window_ticks,
        topics: &[],
        when_full: FullQueue::DropOldest,
        max_payload: |run| match run.config.traffic.lane_positions {
            true => LanePositionLayout::new(road_users(run)).len,
            false => 0,
        },
        // A trainer that reads them with each observation misses none: the ticks between SUMO and it are bounded by credit.
        queue_length: |run| match run.config.traffic.lane_positions {
            true => traffic_frames(run) + 2 * windowful(run),
            false => SPARE_MESSAGES,
        },
        in_hand: |_| SPARE_MESSAGES,
        is_used: |run| run.config.traffic.lane_positions,
    },
];

/// Each row stands at the place of its channel.
const _: () = {
    let mut row = 0;
    while row < CHANNELS.len() {
        assert!(CHANNELS[row].channel as usize == row);
        row += 1;
    }
};

impl Channel {
    /// Number of data services.
    pub const COUNT: usize = CHANNELS.len();

    /// Every data service, in the order of [`CHANNELS`].
    pub const ALL: [Self; Self::COUNT] = {
        let mut channels = [CHANNELS[0].channel; Self::COUNT];
        let mut row = 0;
        while row < Self::COUNT {
            channels[row] = CHANNELS[row].channel;
            row += 1;
        }
        channels
    };

    /// Its row.
    #[must_use]
    pub const fn spec(self) -> &'static ChannelSpec {
        const ROWS: &[ChannelSpec] = &CHANNELS;
        &ROWS[self as usize]
    }

    /// Name in service names.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.spec().name
    }

    /// The one process that sends.
    #[must_use]
    pub const fn producer(self) -> Process {
        self.spec().producer
    }

    /// The required consumers that `run` has.
    pub fn required(self, run: &RunFile) -> impl Iterator<Item = Process> {
        let required = self.spec().required.iter().copied();
        required.filter(move |process| {
            let spec = process.spec();
            (spec.is_wanted)(run) && (spec.must_receive)(run, self)
        })
    }

    /// True if `process` must not miss a message in `run`.
    #[must_use]
    pub fn requires(self, process: Process, run: &RunFile) -> bool {
        self.required(run).any(|required| required == process)
    }

    /// Subscribers at a time: each required consumer and its successor, the fan-out, a `recorder` that watches, and one beside the run
    /// (`caraware record`).
    #[must_use]
    pub fn max_subscribers(self) -> usize {
        let required = self.spec().required.len();
        // A trainer that reads `world` (`trainer.road_users`), and its successor.
        let trainers = if matches!(self, Self::World) { 2 } else { 0 };
        (2 * required + 2).max(5) + trainers
    }

    /// Longest payload of a run, bytes.
    #[must_use]
    pub fn max_payload(self, run: &RunFile) -> usize {
        (self.spec().max_payload)(run)
    }

    /// Messages that a subscriber's queue holds.
    #[must_use]
    pub fn queue_length(self, run: &RunFile) -> usize {
        (self.spec().queue_length)(run)
    }

    /// Most messages that can be in use at a time, with every queue of a required consumer and the fan-out full; none in a run that does not use
    /// the channel.
    #[must_use]
    pub fn worst_case_messages(self, run: &RunFile) -> usize {
        let spec = self.spec();
        if !(spec.is_used)(run) {
            return 0;
        }
        // The required consumers that the run has, at least one, the fan-out, and a trainer that watches road users.
        let required = self.required(run).filter(|&process| process != Recorder).count().max(1);
        let fanned_out = usize::from(run.config.fanout.enabled && !spec.topics.is_empty());
        let watching = usize::from(self == Self::World && run.config.trainer.road_users);
        let subscribers = required + fanned_out + watching;
        // Where the newest messages win, all queues hold the same ones: those sent last.
        let queues = match spec.when_full {
            FullQueue::DropNewest => subscribers,
            FullQueue::DropOldest => 1,
        };
        // A recorder copies each message as it comes, so it has one in hand.
        let recorded = match run.config.record.records(self) {
            true => (spec.queue_length)(run) + 1,
            false => 0,
        };
        queues * (spec.queue_length)(run) + subscribers * (spec.in_hand)(run) + recorded + SPARE_MESSAGES
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The rows of the table at the head of this crate, without padding.
    fn documented() -> Vec<String> {
        let head = include_str!("lib.rs")
            .lines()
            .filter_map(|line| line.strip_prefix("//! |"));
        let squeeze = |line: &str| line.split('|').map(str::trim).collect::<Vec<_>>().join(" | ");
        head.map(squeeze).collect()
    }

    #[test]
    fn the_table_at_the_head_of_the_crate_has_every_channel() {
        let documented = documented();
        for spec in CHANNELS {
            let required: Vec<&str> = spec.required.iter().map(|process| process.name()).collect();
            let required = if required.is_empty() {
                "none".into()
            } else {
                required.join(", ")
            };
            let row = format!(
                "`{}` | {} | {} | {required} | ",
                spec.name,
                spec.payload,
                spec.producer.name()
            );
            assert!(documented.contains(&row), "{row}\n{documented:#?}");
        }
    }

    #[test]
    fn credit_bounds_every_channel_that_has_a_required_consumer() {
        for spec in CHANNELS {
            assert!(
                spec.required.is_empty() || spec.when_full == FullQueue::DropNewest,
                "{}",
                spec.name
            );
            assert!(!spec.required.contains(&spec.producer), "{}", spec.name);
        }
    }

    #[test]
    fn the_channel_that_paces_another_has_required_consumers_and_paces_itself() {
        for spec in CHANNELS {
            let pace = spec.paced_by.spec();
            assert!(!pace.required.is_empty(), "{}", spec.name);
            assert_eq!(pace.paced_by, pace.channel, "{}", spec.name);
            assert!(pace.required.contains(&Recorder), "{}", spec.name);
        }
    }
}
