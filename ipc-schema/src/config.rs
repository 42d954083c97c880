//! The validated configuration: what every process may rely on. Keys, units, ranges and defaults are checked by the
//! `caraware` command before it writes these into the run file; `configs/README.md` lists them all.

use serde::{Deserialize, Serialize};

use crate::traffic::VEHICLE_CLASSES;

mod curriculum;
mod observation;
mod region;
mod sensors;
mod ultrasonic;
pub use curriculum::*;
pub use observation::*;
pub use region::*;
pub use sensors::*;
pub use ultrasonic::*;

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
}

impl Config {
    /// Heroes alive at a time, at most; 0 if the task is not driving.
    #[must_use]
    pub fn heroes(&self) -> usize {
        match self.task.kind {
            TaskKind::Localisation => 0,
            TaskKind::Driving => self.traffic.heroes as usize + self.traffic.hero_ids.len(),
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
    /// SUMO ids of the heroes of a scenario (`.sumocfg`).
    pub hero_ids: Vec<String>,
    /// Share of a scenario's own vehicles that carry sensors (`.sumocfg`).
    pub cav_share: f64,
    /// Most of them at a time (`.sumocfg`); 0 = no limit.
    #[serde(default)]
    pub max_cavs: u32,
    /// Share of all trips, from road to road, that only evaluation episodes make, which make no others; 0 = none.
    pub held_out_trips: f64,
    /// Factor on a scenario's demand, SUMO's `--scale` (`.sumocfg`); `None` = as the scenario says.
    pub scale: Option<f64>,
    /// Most road users alive at once; shared memory is laid out for them.
    pub max_road_users: u32,
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
}

impl TaskKind {
    /// Its name in configurations.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Localisation => "localisation",
            Self::Driving => "driving",
        }
    }
}

/// What the trainer's output means.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskConfig {
    /// Which task.
    pub kind: TaskKind,
    /// Longest episode of a hero, seconds.
    pub time_limit_s: f64,
}

/// A vehicle model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VehicleModel {
    /// Single track without slip.
    Kinematic,
    /// Single track with saturating tyres, load transfer, roll and pitch.
    Dynamic,
    /// Rigid body on four ray-cast wheels; heroes only.
    RigidBody,
}

/// Reads an entry of `vehicle.class_models`, "class=kinematic" or "class=dynamic" with a vehicle class of SUMO.
#[must_use]
pub fn class_model(entry: &str) -> Option<(&str, VehicleModel)> {
    let (class, model) = entry.split_once('=')?;
    let model = match model.trim() {
        "kinematic" => VehicleModel::Kinematic,
        "dynamic" => VehicleModel::Dynamic,
        _ => return None,
    };
    let class = class.trim();
    VEHICLE_CLASSES.contains(&class).then_some((class, model))
}

/// What the road is covered with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Surface {
    /// Dry asphalt.
    Dry,
    /// Wet asphalt.
    Wet,
    /// Snow.
    Snow,
}

/// The road.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoadConfig {
    /// What it is covered with: decides the friction.
    pub surface: Surface,
}

/// What stands beside the road, or on it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneConfig {
    /// Obstacles, each "name x y heading": a prop by name, its centre in metres (world), its heading in degrees counter-clockwise
    /// from east (0 if left out).
    pub obstacles: Vec<String>,
    /// Props placed at random beside the road, the same for the same `run.seed`.
    pub random_props: u32,
    /// Height of a building whose polygon and type name none, metres.
    pub building_height_m: f64,
    /// Triangle meshes, each "file x y heading": a Wavefront OBJ, its origin on the ground in metres (world), its heading in degrees
    /// counter-clockwise from east (0 if left out). LIDARs see them; traffic and collisions do not.
    pub meshes: Vec<String>,
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

/// Vehicle models and their limits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleConfig {
    /// Model of connected vehicles.
    pub cav_model: VehicleModel,
    /// Model of vehicles without sensors.
    pub other_model: VehicleModel,
    /// Model of heroes.
    pub hero_model: VehicleModel,
    /// Models by SUMO class, each "class=model"; they win over the three above.
    pub class_models: Vec<String>,
    /// Time over which an instantaneous lane change is spread, seconds.
    pub lane_change_s: f64,
    /// Largest road-wheel angle, radians.
    pub max_road_wheel_angle_rad: f64,
    /// Largest rate of the road-wheel angle, rad/s.
    pub max_road_wheel_rate_radps: f64,
    /// Largest acceleration of the mirror, m/s².
    pub max_accel_mps2: f64,
    /// Largest deceleration of the mirror, m/s².
    pub max_decel_mps2: f64,
    /// Steering-wheel angle per road-wheel angle.
    pub steering_ratio: f64,
    /// Tracking error beyond which the mirror is set onto SUMO, metres.
    pub resynchronise_m: f64,
    /// Distance between the reference and SUMO's path, because that cannot be driven, beyond which the mirror is set onto SUMO, metres.
    pub leave_path_m: f64,
}

/// Reward of a prediction, a function of its Euclidean distance d from the truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reward {
    /// 1 / d.
    Inverse,
    /// 1 / (1 + d / scale).
    BoundedInverse,
    /// exp(−d / scale).
    Exponential,
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

/// The learner: PPO with the paper's hyper-parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainerConfig {
    /// Python module that is run as the trainer.
    pub module: String,
    /// Learning rate of Adam at the start.
    pub learning_rate: f64,
    /// Factor on the learning rate after each update.
    pub learning_rate_decay: f64,
    /// Learning rate at the end of training; `None`: `learning_rate_decay` alone.
    pub learning_rate_final: Option<f64>,
    /// Discount γ.
    pub discount: f64,
    /// GAE λ.
    pub gae_lambda: f64,
    /// Clip ε of the probability ratio.
    pub clip_epsilon: f64,
    /// ε at the end of training; `None`: constant.
    pub clip_epsilon_final: Option<f64>,
    /// Standard deviation of the policy at the start, in the action's −1 … 1.
    pub initial_std: f64,
    /// Weight of the entropy bonus.
    pub entropy_scale: f64,
    /// Weight of the entropy bonus at the end of training; `None`: constant.
    pub entropy_scale_final: Option<f64>,
    /// Weight of the value loss.
    pub value_scale: f64,
    /// How far a value may move in one update; `None`: any way.
    pub value_clip: Option<f64>,
    /// KL divergence at which an update of the policy ends; `None`: after all epochs.
    pub target_kl: Option<f64>,
    /// Largest norm of the gradient.
    pub max_grad_norm: f64,
    /// Actions tried on every observation.
    pub actions_per_observation: u64,
    /// Samples per update.
    pub horizon: u64,
    /// Samples per gradient step.
    pub batch_size: u64,
    /// Passes over a horizon.
    pub epochs: u64,
    /// Networks of policy and value.
    #[serde(default)]
    pub network: Network,
    /// Width of the hidden layers of policy and value network.
    pub hidden: Vec<u64>,
    /// What follows a hidden layer.
    #[serde(default)]
    pub activation: Activation,
    /// Ticks that a gradient reaches back in a network with memory.
    #[serde(default = "default_truncation_ticks")]
    pub truncation_ticks: u64,
    /// Train a network of the policy's size by regression beside it.
    pub supervised: bool,
    /// Reward by name.
    pub reward: Reward,
    /// Scale of `bounded_inverse` and `exponential`, metres.
    pub reward_scale_m: f64,
    /// Trainers that learn together by `torch.distributed`, each with a run of its own.
    pub ranks: u32,
    /// Threads of torch; 0 = one for each core.
    pub threads: u64,
    /// "cpu" or "auto" (a GPU if there is one).
    pub device: String,
    /// Precision of matrix products: "float32", "bfloat16", or "auto" (bfloat16 where the processor has AMX).
    pub matmul_precision: String,
    /// Updates between two checkpoints.
    pub checkpoint_interval: u64,
    /// Newest checkpoints that are kept.
    pub checkpoints_kept: u64,
    /// Updates between two checkpoints that are kept for good; 0 = none.
    pub checkpoint_keep_every: u64,
    /// When the Kalman filter's estimates travel beside the predictions.
    pub estimates: Estimates,
}

/// Shared memory → zenoh.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FanoutConfig {
    /// Start the fan-out process.
    pub enabled: bool,
    /// zenoh endpoint to listen on.
    pub listen: String,
    /// File of those who may connect, a line `user:password` each; "" = nobody is asked.
    pub users: String,
    /// Certificate of this machine, PEM, for an endpoint `tls/…`.
    pub tls_certificate: String,
    /// Its private key, PEM.
    pub tls_private_key: String,
    /// Certificate of the authority, PEM, that must have signed the certificates of those who connect; "" = they need none.
    pub tls_client_ca: String,
    /// Users, or common names of certificates, that may send commands; "*" = all who may connect.
    pub commanders: Vec<String>,
    /// Most frames of `world` per wall second.
    pub world_hz: f64,
    /// The same of `observation`.
    pub observation_hz: f64,
    /// The same of `prediction`.
    pub prediction_hz: f64,
    /// The same of each LIDAR's `pointcloud`.
    pub pointcloud_hz: f64,
    /// The same of `event`.
    pub event_hz: f64,
    /// The same of `signals`.
    pub signals_hz: f64,
    /// The same of `vehicles`.
    pub vehicles_hz: f64,
    /// The same of `status`.
    pub status_hz: f64,
}

/// Of a run file that was written before there were networks with memory.
fn default_truncation_ticks() -> u64 {
    32
}

/// Networks of policy and value.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub enum Network {
    /// Hidden layers: sees one moment.
    #[default]
    Mlp,
    /// The last hidden layer is a gated recurrent unit, with a state for each slot.
    Gru,
    /// A Python class, as `package.module:Class`.
    Class(String),
}

impl From<String> for Network {
    fn from(word: String) -> Self {
        match word.as_str() {
            "mlp" => Self::Mlp,
            "gru" => Self::Gru,
            _ => Self::Class(word),
        }
    }
}

impl From<Network> for String {
    fn from(network: Network) -> Self {
        match network {
            Network::Mlp => "mlp".to_owned(),
            Network::Gru => "gru".to_owned(),
            Network::Class(name) => name,
        }
    }
}

/// What follows a hidden layer of policy and value network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// max(0, x).
    #[default]
    Relu,
    /// tanh x.
    Tanh,
}

/// When the trainer runs the Kalman filter beside the policy, for whoever watches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Estimates {
    /// In a run paced by the wall clock: at full speed the filter costs more than the policy.
    Paced,
    /// Always.
    Always,
    /// Never.
    Never,
}
