//! The validated configuration: what every process may rely on. Keys, units, ranges and defaults are checked by the
//! `caraware` command before it writes these into the run file; `configs/README.md` lists them all.

use serde::{Deserialize, Serialize};

use crate::{neighbours, process::Process};

mod camera;
mod curriculum;
mod fanout;
mod lens;
mod lidar_pattern;
mod observation;
mod radar;
mod record;
mod region;
mod scene;
mod sensors;
mod suite;
pub(crate) mod text;
mod trainer;
mod ultrasonic;
mod v2x;
mod vehicle;
pub use camera::*;
pub use curriculum::*;
pub use fanout::*;
pub use lens::*;
pub use lidar_pattern::*;
pub use observation::*;
pub use radar::*;
pub use record::*;
pub use region::*;
pub use scene::*;
pub use sensors::*;
pub use suite::*;
pub use trainer::*;
pub use ultrasonic::*;
pub use v2x::*;
pub use vehicle::*;

/// One whole configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Time, seed and flow control.
    pub run: RunConfig,
    /// Where traffic comes from.
    pub traffic: TrafficConfig,
    /// Geodetic reference of a net that has none.
    pub map: MapConfig,
    /// Length of episodes and when to evaluate.
    pub episode: EpisodeConfig,
    /// Steps of training, each with a gate to the next.
    pub curriculum: CurriculumConfig,
    /// What the trainer's output means.
    pub task: TaskConfig,
    /// Vehicle models and their limits.
    pub vehicle: VehicleConfig,
    /// The road.
    pub road: RoadConfig,
    /// What stands beside it.
    pub scene: SceneConfig,
    /// Contacts.
    pub collision: CollisionConfig,
    /// Rain, fog and sun.
    pub weather: WeatherConfig,
    /// Where vehicles are sensed.
    pub region: RegionConfig,
    /// GNSS receiver.
    pub gnss: GnssConfig,
    /// Inertial measurement unit and compass.
    pub imu: ImuConfig,
    /// Wheel speed and steering angle.
    pub speed_steering: SpeedSteeringConfig,
    /// Spinning LIDAR.
    pub lidar: LidarConfig,
    /// Ultrasonic sensors in the bumpers.
    pub ultrasonic: UltrasonicConfig,
    /// Camera.
    pub camera: CameraConfig,
    /// Radar.
    pub radar: RadarConfig,
    /// Named sets of mounted sensors, and the vehicles that carry them.
    #[serde(default, rename = "suite", skip_serializing_if = "Vec::is_empty")]
    pub suites: Vec<SuiteConfig>,
    /// Carriers that stand beside the road.
    #[serde(default, rename = "roadside", skip_serializing_if = "Vec::is_empty")]
    pub roadsides: Vec<RoadsideConfig>,
    /// Messages between road users.
    pub v2x: V2xConfig,
    /// What happens while a sensor is dark.
    pub blackout: BlackoutConfig,
    /// Fields and normalisation of the observation.
    pub observation: ObservationConfig,
    /// The learner.
    pub trainer: TrainerConfig,
    /// The learned estimator of the preset `fusion`.
    pub fusion: FusionConfig,
    /// Shared memory → zenoh.
    pub fanout: FanoutConfig,
    /// Shared memory → a file.
    pub record: RecordConfig,
}

impl Config {
    /// The configuration that this text describes, as a run file has it.
    ///
    /// Reading it is many thousand lines of code, which this crate compiles once: each crate that calls `serde_json` itself compiles them again.
    ///
    /// # Errors
    /// The text is not JSON, lacks a key, or has a value that is no value of its key.
    pub fn from_json(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }

    /// Whether SUMO's own driver is asked what it would have done with a hero.
    #[must_use]
    pub fn advises_heroes(&self) -> bool {
        self.task.kind == TaskKind::Driving && self.observation.fields.contains(&Field::AdvisedAccel)
    }

    /// Heroes alive at a time, at most; 0 if the task is not driving.
    #[must_use]
    pub fn heroes(&self) -> usize {
        match self.task.kind {
            TaskKind::Localisation | TaskKind::Lane | TaskKind::Messages => 0,
            TaskKind::Driving => {
                let most = self
                    .traffic_of_stages()
                    .map(|traffic| traffic.heroes)
                    .max()
                    .unwrap_or(0);
                most as usize + self.traffic.hero_ids.len()
            }
        }
    }

    /// What the road is covered with in this weather: rain makes a dry road wet.
    #[must_use]
    pub fn surface(&self) -> Surface {
        match self.road.surface {
            Surface::Dry if self.weather.rain_mmph > 0.0 => Surface::Wet,
            surface => surface,
        }
    }

    /// Numbers in a row that a policy sees: of the observation, or in the messages task of `speech`.
    #[must_use]
    pub fn policy_width(&self) -> usize {
        match self.speaks() {
            true => neighbours::speech_width(self.v2x.candidates as usize),
            false => self.observation_width(),
        }
    }

    /// Numbers in a row of the observation: fields times ticks.
    #[must_use]
    pub fn observation_width(&self) -> usize {
        self.observation.fields.len() * self.observation.history as usize
    }

    /// IMU samples in a tick: those of a slow IMU count as one.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "validated: at most `run.sub_steps`"
    )]
    pub fn imu_samples(&self) -> usize {
        (self.run.tick_s / self.imu.period_s).round().max(1.0) as usize
    }

    /// True if actions move vehicles, so that every process waits for the one before it.
    #[must_use]
    pub fn drives(&self) -> bool {
        self.task.kind == TaskKind::Driving
    }

    /// True if the task is what messages list, so that `v2x` sends what a policy sees and what messages achieve.
    #[must_use]
    pub fn speaks(&self) -> bool {
        self.task.kind == TaskKind::Messages
    }

    /// The process that waits for the trainer's actions at every tick; `None` where the world does not depend on them.
    #[must_use]
    pub fn actor(&self) -> Option<Process> {
        match self.task.kind {
            TaskKind::Driving => Some(Process::SimCore),
            TaskKind::Messages if self.v2x.inclusion == V2xInclusion::Policy => Some(Process::V2x),
            TaskKind::Messages | TaskKind::Localisation | TaskKind::Lane => None,
        }
    }

    /// True if a tick waits for the trainer's actions.
    #[must_use]
    pub fn awaits_actions(&self) -> bool {
        self.actor().is_some()
    }
}

/// Time, seed and flow control.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Seed of everything random.
    pub seed: u64,
    /// Environments (SUMO, dynamics, sensors) side by side, feeding one trainer.
    pub envs: u32,
    /// Index of the first of them among those of all runs that learn together: their seeds follow from it.
    pub first_env: u32,
    /// Length of a tick (one observation), seconds.
    pub tick_s: f64,
    /// Nanoscopic sub-steps in a tick.
    pub sub_steps: u32,
    /// Ticks a producer may be ahead of its required consumer.
    pub window_ticks: u32,
    /// Most memory and disk for observations that no checkpoint contains yet, MiB.
    pub journal_mib: u32,
    /// Simulated seconds per wall second; 0 = as fast as possible.
    pub real_time_factor: f64,
    /// A process that neither works nor waits in order for this long hangs, seconds.
    pub stall_s: f64,
    /// What happens to a process that hangs.
    pub on_stall: StallAction,
    /// Longest time from the start of a process to its readiness, seconds.
    pub ready_s: f64,
}

/// What happens to a process that hangs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StallAction {
    /// It is named in the log, in the progress line and by `caraware ps`.
    Report,
    /// It is killed as well, and started again as after any death.
    Replace,
}

/// Where traffic comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrafficConfig {
    /// SUMO step, seconds: an integer multiple of `run.tick_s`.
    pub step_s: f64,
    /// Connected vehicles kept alive (population control).
    pub cavs: u32,
    /// Vehicles without sensors kept alive (population control).
    pub others: u32,
    /// Pedestrians kept alive (population control).
    pub pedestrians: u32,
    /// Heroes kept alive (driving task).
    pub heroes: u32,
    /// Edges of every hero's route; empty = at random.
    pub hero_route: Vec<String>,
    /// Which routes heroes are given at random.
    #[serde(default)]
    pub hero_turns: HeroTurns,
    /// Traffic lights are on; off, vehicles give way by the junctions' rules (population control).
    #[serde(default = "on")]
    pub traffic_lights: bool,
    /// Factor on all speed limits (population control).
    #[serde(default = "unchanged")]
    pub speed_limit_factor: f64,
    /// SUMO ids of the heroes of a scenario (`.sumocfg`).
    pub hero_ids: Vec<String>,
    /// Share of a scenario's own vehicles that carry sensors (`.sumocfg`).
    pub cav_share: f64,
    /// Most of them at a time (`.sumocfg`); 0 = no limit.
    pub max_cavs: u32,
    /// Share of all trips, from road to road, that only evaluation episodes make, which make no others; 0 = none.
    pub held_out_trips: f64,
    /// Factor on a scenario's demand, SUMO's `--scale` (`.sumocfg`); `None` = as the scenario says.
    pub scale: Option<f64>,
    /// Where SUMO runs.
    #[serde(default)]
    pub engine: TrafficEngine,
    /// Host of a SUMO that runs already; empty = `traffic-bridge` starts SUMO.
    #[serde(default)]
    pub traci_host: String,
    /// Place of `traffic-bridge` among the clients of that SUMO.
    #[serde(default)]
    pub traci_order: u32,
    /// Port of SUMO's own process for TraCI clients; that of environment n is n higher.
    #[serde(default)]
    pub traci_port: u16,
    /// TraCI clients that SUMO's own process waits for, `traffic-bridge` among them.
    #[serde(default)]
    pub traci_clients: u32,
    /// The channel `lane-position` is sent.
    #[serde(default)]
    pub lane_positions: bool,
    /// SUMO's time at the begin, seconds (`.sumocfg`); `None` = as the scenario says.
    pub begin_s: Option<f64>,
    /// SUMO's time at the end, seconds (`.sumocfg`); `None` = as the scenario says.
    pub end_s: Option<f64>,
    /// A scenario's files may do all that SUMO can (`.sumocfg`); false = what reaches beyond the run's directory is refused.
    #[serde(default)]
    pub trust_scenario: bool,
    /// Most road users alive at once; shared memory is laid out for them.
    pub max_road_users: u32,
}

/// Routes of heroes that are drawn at random.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HeroTurns {
    /// Any.
    #[default]
    Any,
    /// With at least one left turn at a junction that has other ways, too.
    Left,
}

fn on() -> bool {
    true
}

fn unchanged() -> f64 {
    1.0
}

/// Where SUMO runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrafficEngine {
    /// In `traffic-bridge`.
    #[default]
    Libsumo,
    /// In a process of its own, over TraCI, with room for other clients.
    Traci,
    /// The same with SUMO's window.
    TraciGui,
}

/// Geodetic reference of a net that has none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapConfig {
    /// Latitude of the net's (0, 0), degrees; only for a net without projection.
    pub origin_latitude_deg: Option<f64>,
    /// Longitude of the net's (0, 0), degrees; only for a net without projection.
    pub origin_longitude_deg: Option<f64>,
}

/// Length of episodes and when to evaluate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeConfig {
    /// Ticks in a training episode; its end respawns everybody at random places.
    pub ticks: u64,
    /// Training episodes.
    pub training_episodes: u64,
    /// Training episodes between two evaluations; 0 = only at the end.
    pub evaluation_interval: u64,
    /// Ticks in an evaluation episode.
    pub evaluation_ticks: u64,
    /// Evaluation episodes at the end.
    pub final_evaluations: u64,
    /// The scenario as it is (`.sumocfg`): one episode with its own seed, to its own end.
    pub whole_scenario: bool,
}

/// What the trainer's output means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskKind {
    /// A position for every connected vehicle; the world does not listen.
    Localisation,
    /// Steering and acceleration of every hero, each in −1 … 1.
    Driving,
    /// Lane and lateral position in it of every connected vehicle; the world does not listen.
    Lane,
    /// Which of the objects that it perceives each connected vehicle tells others of.
    Messages,
}

impl TaskKind {
    /// Its name in configurations.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Localisation => "localisation",
            Self::Driving => "driving",
            Self::Lane => "lane",
            Self::Messages => "messages",
        }
    }
}

/// What an action of the localisation task names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LocalisationAction {
    /// A place in the box of the map, as in the paper.
    Place,
    /// A correction of the newest fix, in standard deviations of a fix.
    Correction,
}

/// What the trainer's output means.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskConfig {
    /// Which task.
    pub kind: TaskKind,
    /// What an action of the localisation task names.
    pub action: LocalisationAction,
    /// Longest episode of a hero, seconds.
    pub time_limit_s: f64,
    /// A hero that stands for so long is blocked, and its episode ends, seconds; `None` for never.
    pub blocked_s: Option<f64>,
    /// What moves the heroes.
    pub driver: HeroDriver,
    /// A hero's episode ends at a red light and when it drives against the traffic.
    pub ends_at_infractions: bool,
    /// Messages task: what a kilobyte of collective perception messages costs, in seconds for which others newly know an object.
    pub message_cost: f64,
    /// Reward: "" for the task's own, or "package.module:function".
    pub reward: String,
    /// Checkpoint or file of parameters from which a new policy begins; "" for none.
    pub begin_from: String,
}

/// What moves the heroes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HeroDriver {
    /// The trainer's actions.
    Actions,
    /// SUMO's own driver: the trainer only watches, for data sets and comparisons.
    Sumo,
}

/// Contacts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CollisionConfig {
    /// Look for contacts of connected vehicles and heroes.
    pub detect: bool,
    /// A contact ends the trajectory of a connected vehicle, as it always ends a hero's.
    pub ends_trajectory: bool,
}

/// The learned estimator of the preset `fusion` (`caraware.fusion.train`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FusionConfig {
    /// Whether the estimator has the lanes of the net.
    pub map: bool,
    /// Ticks in a piece of an episode that is learnt from.
    pub segment_ticks: u64,
    /// Ticks that a gradient reaches back.
    pub truncation_ticks: u64,
}
