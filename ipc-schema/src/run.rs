//! The run file: the supervisor writes it, and every process reads it at its start.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use serde::{Deserialize, Serialize};

use crate::{
    SCHEMA_VERSION,
    config::{Config, PreviewFrames, SensorUnit},
    field::{RunField, run_fields},
    process::Process,
    schedule,
    sensor::SensorKind,
    storage,
};

/// Purpose of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// A trainer learns.
    Train,
    /// The run has no trainer.
    Simulate,
    /// The policy of a checkpoint predicts without learning.
    Play,
}

impl Mode {
    /// True if the run has the process `trainer`, which receives every observation.
    #[must_use]
    pub fn has_trainer(self) -> bool {
        self != Self::Simulate
    }
}

/// Version of the layout of a run's directory, in `report.json` (docs/run-directory.md).
pub const LAYOUT_VERSION: u32 = 1;
/// Log of a curriculum in the run directory: the first lesson and tick of each stage.
pub const CURRICULUM_LOG: &str = "curriculum.jsonl";
/// File in the run directory with the ids of a scenario's road users in order of appearance, each a line of JSON.
pub const VEHICLE_IDS: &str = "ids.jsonl";
/// Former name of that log. A directory with a file of this name is refused.
pub const FORMER_CURRICULUM_LOG: &str = "actions.jsonl";

/// The checkpoint that a run begins with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Beginning {
    /// Its directory.
    pub checkpoint: PathBuf,
    /// Where this environment continues. The run file of the whole run is that of environment 0.
    #[serde(flatten)]
    pub start: Start,
    /// Where the environments after environment 0 continue.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub others: Vec<Start>,
    /// Number of episodes in `caraware play`; `None` means without end.
    pub episodes: Option<u64>,
}

/// Where an environment continues after a checkpoint.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Start {
    /// Ticks below this are in the checkpoint: they may be simulated again but are not delivered.
    pub committed_ticks: u64,
    /// Number of the episode of the first tick that is delivered. The simulation begins with this episode.
    pub episode: u64,
    /// The first tick of that episode.
    pub episode_tick: u64,
    /// Number of resets before that episode. Each reset adds an episode, so the episode's number exceeds its position in the schedule by
    /// this number.
    pub resets: u64,
}

/// Where the simulator processes of an environment start again after one of them has died.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RestartPoint {
    /// Where they begin.
    #[serde(flatten)]
    pub start: Start,
    /// Ticks that had been sensed before. They are made again as fast as possible.
    pub sensed_ticks: u64,
}

/// Source of the traffic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// A map with population control: road users on random routes, without end.
    Population {
        /// The built net.
        net_file: PathBuf,
        /// Vehicle types and polygons.
        additional_files: Vec<PathBuf>,
    },
    /// A user's scenario, which SUMO runs unchanged.
    Scenario {
        /// The `.sumocfg`.
        sumocfg: PathBuf,
        /// What it says.
        #[serde(default)]
        own: ScenarioOptions,
    },
}

/// What a `.sumocfg` itself says: the values that the run replaces only where they differ, and the files that it names.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScenarioOptions {
    /// SUMO's step, seconds.
    pub step_s: f64,
    /// SUMO's seed. A negative one is carried as the 32 bits that it has in SUMO.
    pub seed: u64,
    /// SUMO's time at the begin of every episode, seconds: its `begin` or that of the run, or the time of the saved state.
    pub begin_s: f64,
    /// SUMO draws its seed from the clock, unless the run gives one.
    pub is_random: bool,
    /// Options of outputs that get another name, because two outputs have the same name in two folders: option and name.
    pub renamed_outputs: Vec<(String, String)>,
    /// Files that it names, with variables of the environment replaced.
    pub inputs: Vec<PathBuf>,
}

impl Default for ScenarioOptions {
    /// SUMO's own defaults.
    fn default() -> Self {
        Self {
            step_s: 1.0,
            seed: 23423,
            begin_s: 0.0,
            is_random: false,
            renamed_outputs: Vec::new(),
            inputs: Vec::new(),
        }
    }
}

/// Location and size of a map, from its net file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapInfo {
    /// PROJ string of the net, or of the origin given in the configuration.
    pub projection: String,
    /// Offset from projected coordinates to the world frame, metres.
    pub net_offset_m: [f64; 2],
    /// x_min, y_min, x_max, y_max of the net with a margin of 20 m, metres: the range of positions and predictions. In a run with several
    /// maps the box holds all of them.
    pub bounds_m: [f64; 4],
    /// Number of programs of traffic lights in the net, at least the number of traffic lights.
    pub traffic_lights: u32,
    /// The world frame's (0, 0) in the net's own coordinates, metres. It is (0, 0) unless the net lies so far from its own (0, 0) that
    /// single precision would lose centimetres, as in raw UTM coordinates. Every other position of the run is in the world frame.
    #[serde(default)]
    pub world_origin_m: [f64; 2],
}

/// The files that the static scene is built from.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SceneFiles {
    /// The net: road surface, crossings, traffic lights.
    pub net_file: PathBuf,
    /// Polygons (buildings) and SUMO's other additional files.
    pub additional_files: Vec<PathBuf>,
}

/// A map of a run whose curriculum has several.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunMap {
    /// Name of the map in the stages of a curriculum.
    pub name: String,
    /// Source of the traffic.
    pub source: Source,
    /// The map, with its own bounds.
    pub info: MapInfo,
    /// The files that the static scene is built from.
    pub scene_files: SceneFiles,
}

/// Where the run's shared memory is. The run changes nothing outside it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SharedMemory {
    /// Directory of iceoryx2's files.
    pub root: PathBuf,
    /// Prefix of the files in `/dev/shm`.
    pub prefix: String,
}

/// Least number of SUMO steps under way: one that `sim-core` moves, one that waits for it, and one that SUMO makes meanwhile.
const STEPS_AHEAD: u64 = 3;
/// Longest time between two states of a road user that the mirror's window is made of, seconds, where a tick is not longer.
const FRAME_S: f64 = 0.1;
/// Longest wait for space on a full disk before a start is given up.
const SPACE_WITHIN: Duration = Duration::from_secs(10);

/// The run file, `run.json` in the run directory.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunFile {
    /// [`SCHEMA_VERSION`] of the writer.
    pub schema_version: u32,
    /// Random identity.
    pub run_id: u64,
    /// Name of the run.
    pub name: String,
    /// Index of this file's environment, from 0. Processes of the whole run read the file of environment 0.
    pub env_index: u32,
    /// Directory of this environment's results. That of environment 0 holds the directories of the others.
    pub run_dir: PathBuf,
    /// Purpose of the run.
    pub mode: Mode,
    /// Process id of the supervisor. All processes end when it ends.
    pub supervisor_pid: i32,
    /// Shared memory of the run.
    pub shared_memory: SharedMemory,
    /// Source of the traffic.
    pub source: Source,
    /// The map.
    pub map: MapInfo,
    /// The files that the static scene is built from.
    pub scene_files: SceneFiles,
    /// The maps of a curriculum with several maps; the first is that of `source`. Then `map` has the bounds of all maps, and the largest
    /// number of traffic lights.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub maps: Vec<RunMap>,
    /// Installation of SUMO (the `sumo` directory of the `eclipse-sumo` wheel).
    pub sumo_home: PathBuf,
    /// The validated configuration.
    pub config: Config,
    /// BLAKE3 of the configuration's canonical JSON.
    pub config_hash: String,
    /// The checkpoint that the run begins with, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beginning: Option<Beginning>,
    /// Where the simulator processes of this environment were started again, after one of them had died.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restart: Option<RestartPoint>,
    /// The recording that takes the place of the simulators, if one does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replay: Option<Replay>,
}

/// A recording in the place of the simulators of an environment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Replay {
    /// The recording of this environment.
    pub file: PathBuf,
    /// The first tick that is played.
    pub from_tick: u64,
}

/// The run file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunFileError {
    /// The file cannot be read or written.
    #[error("cannot access the run file {path}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The cause.
        #[source]
        source: std::io::Error,
    },
    /// The file is not a run file.
    #[error("{path} is not a run file")]
    Format {
        /// The file.
        path: PathBuf,
        /// The cause.
        #[source]
        source: serde_json::Error,
    },
    /// A stage of the curriculum uses a map that the run does not have.
    #[error("{path}: stage {stage} of `curriculum.stages` uses the map \"{map}\", which the run does not have")]
    UnknownMap {
        /// The file.
        path: PathBuf,
        /// The stage, counted from 1.
        stage: usize,
        /// The map.
        map: String,
    },
    /// Another version wrote the file.
    #[error("{path} has schema version {found}, this program reads {SCHEMA_VERSION}: rebuild with `make build`")]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
}

/// The version in a run file, which the reader checks before the rest of the file.
#[derive(Deserialize)]
struct RunFileVersion {
    schema_version: u32,
}

/// The written run file: it also has values that readers in other languages would otherwise have to compute.
#[derive(Serialize)]
struct WrittenRun<'a> {
    #[serde(flatten)]
    run: &'a RunFile,
    /// Every field of an observation with its range.
    observation_fields: Vec<RunField>,
    /// Every sensor that sends messages of its own, with its suite, its name and its mounting.
    sensor_units: Vec<SensorUnit>,
}

impl RunFile {
    /// Reads and checks a run file.
    ///
    /// # Errors
    /// The file is unreadable or malformed, or has another schema version.
    pub fn read(path: &Path) -> Result<Self, RunFileError> {
        let text = std::fs::read_to_string(path).map_err(|source| RunFileError::Io {
            path: path.into(),
            source,
        })?;
        let malformed = |source| RunFileError::Format {
            path: path.into(),
            source,
        };
        // The version comes first: a file of another version may have other fields.
        let RunFileVersion { schema_version } = serde_json::from_str(&text).map_err(malformed)?;
        if schema_version != SCHEMA_VERSION {
            return Err(RunFileError::Version {
                path: path.into(),
                found: schema_version,
            });
        }
        let run: Self = serde_json::from_str(&text).map_err(malformed)?;
        if let Some((stage, map)) = run.config.curriculum.unknown_map() {
            return Err(RunFileError::UnknownMap {
                path: path.into(),
                stage,
                map: map.to_owned(),
            });
        }
        Ok(run)
    }

    /// The run file's text.
    ///
    /// # Errors
    /// A path in it is not UTF-8.
    pub fn to_json(&self) -> Result<String, serde_json::Error> {
        serde_json::to_string_pretty(&WrittenRun {
            run: self,
            observation_fields: run_fields(&self.config, &self.map),
            sensor_units: self.config.all_sensor_units(),
        })
    }

    /// Writes the run file of a run that starts to `run_dir/run.json`, and returns its path.
    ///
    /// # Errors
    /// The run directory is not writable, or its disk stays full.
    pub fn write(&self) -> Result<PathBuf, RunFileError> {
        self.write_within(SPACE_WITHIN)
    }

    /// Writes the run file of a live run again, and waits while the disk is full.
    ///
    /// # Errors
    /// The run directory is not writable, or the process is asked to stop while the disk is full.
    pub fn rewrite(&self) -> Result<PathBuf, RunFileError> {
        self.write_within(Duration::MAX)
    }

    fn write_within(&self, limit: Duration) -> Result<PathBuf, RunFileError> {
        let path = self.run_dir.join("run.json");
        let text = self.to_json().map_err(|source| RunFileError::Format {
            path: path.clone(),
            source,
        })?;
        let written = storage::wait_for_space(&path, limit, || storage::write_whole(&path, &text));
        written.map_err(|source| RunFileError::Io {
            path: path.clone(),
            source,
        })?;
        Ok(path)
    }

    /// True if ticks of this run are due at times of the clock and `process` is needed for them.
    #[must_use]
    pub fn keeps_time(&self, process: Process) -> bool {
        (process.spec().holds_up_ticks)(self) && self.config.run.real_time_factor > 0.0
    }

    /// The run file of environment `env_index`. `self` is that of environment 0.
    #[must_use]
    pub fn environment(&self, env_index: u32) -> Self {
        let run_dir = match env_index {
            0 => self.run_dir.clone(),
            index => self.run_dir.join(format!("env-{index}")),
        };
        let beginning = self.beginning.clone().map(|beginning| match env_index {
            0 => beginning,
            index => Beginning {
                start: beginning.others.get(index as usize - 1).copied().unwrap_or_default(),
                ..beginning
            },
        });
        let replay = self.replay.clone().map(|replay| match env_index {
            0 => replay,
            // The recordings of a run lie as their run directories do.
            index => {
                let name = replay.file.file_name().unwrap_or_default();
                let directory = replay.file.with_file_name(format!("env-{index}"));
                let file = directory.join(name);
                Replay { file, ..replay }
            }
        });
        Self {
            env_index,
            run_dir,
            beginning,
            replay,
            restart: None,
            ..self.clone()
        }
    }

    /// Every map of the run, at least one, in the order of [`crate::header::MessageHeader::map`].
    #[must_use]
    pub fn every_map(&self) -> Vec<RunMap> {
        if !self.maps.is_empty() {
            return self.maps.clone();
        }
        vec![RunMap {
            name: self.config.curriculum.map_names()[0].to_owned(),
            source: self.source.clone(),
            info: self.map.clone(),
            scene_files: self.scene_files.clone(),
        }]
    }

    /// Seed of all random numbers in this environment. The first environment has the seed of the run.
    #[must_use]
    pub fn seed(&self) -> u64 {
        let run = &self.config.run;
        schedule::environment_seed(run.seed, run.first_env + self.env_index)
    }

    /// Most connected vehicles on the road at a time.
    #[must_use]
    pub fn most_connected(&self) -> usize {
        let traffic = &self.config.traffic;
        let limit = match &self.source {
            Source::Population { .. } => {
                let of_stages = self.config.traffic_of_stages().map(|traffic| traffic.cavs);
                of_stages.max().unwrap_or(traffic.cavs)
            }
            Source::Scenario { .. } if traffic.max_cavs > 0 => traffic.max_cavs,
            Source::Scenario { .. } => traffic.max_road_users,
        };
        (limit as usize + self.config.heroes()).min(traffic.max_road_users as usize)
    }

    /// Most messages that the sensors of this kind send at one tick.
    #[must_use]
    pub fn messages_per_tick(&self, kind: SensorKind) -> usize {
        let (config, connected) = (&self.config, self.most_connected());
        let of_unit = |unit: &SensorUnit| match unit.suite_index.and_then(|index| config.suites.get(index)) {
            None => (kind.spec().vehicles)(config) as usize,
            Some(suite) => {
                let beside = config.roadsides.iter().filter(|roadside| roadside.suite == suite.name);
                let vehicles = match suite.first {
                    _ if config.is_roadside_only(suite) => 0,
                    Some(first) => connected.min(first as usize),
                    None => connected,
                };
                vehicles + beside.count()
            }
        };
        config.sensor_units(kind).iter().map(of_unit).sum()
    }

    /// Path of the scene for viewers, as JSON (docs/fanout.md, `map`). `sim-core` writes it before it attaches.
    #[must_use]
    pub fn chart_path(&self) -> PathBuf {
        self.run_dir.join("map").join("chart.json")
    }

    /// Path of the socket for requests to the supervisor, in a directory that only its user can enter.
    #[must_use]
    pub fn control_socket(&self) -> PathBuf {
        self.shared_memory.root.join("control")
    }

    /// Number of ticks in one SUMO step.
    #[must_use]
    pub fn ticks_per_traffic_step(&self) -> u64 {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "validated to be a small positive integer"
        )]
        let ratio = (self.config.traffic.step_s / self.config.run.tick_s).round() as u64;
        ratio.max(1)
    }

    /// Number of ticks in one message of `traffic`. A mirror that sees the path ahead needs a state every [`FRAME_S`]: where SUMO steps
    /// more slowly, `traffic-bridge` sends frames between its steps.
    #[must_use]
    pub fn ticks_per_frame(&self) -> u64 {
        let per_step = self.ticks_per_traffic_step();
        if self.config.vehicle.preview_s <= 0.0 {
            return per_step;
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "validated: a tick is positive, and not much shorter than a frame"
        )]
        let shortest = (FRAME_S / self.config.run.tick_s - 1e-6).ceil().max(1.0) as u64;
        let divisors = (shortest..per_step).filter(|ticks| per_step.is_multiple_of(*ticks));
        divisors.min().unwrap_or(per_step)
    }

    /// Messages of `traffic` by which the mirrored road users are behind SUMO, half a frame rounded down.
    #[must_use]
    pub fn mirror_delay_frames(&self) -> usize {
        let frame_s = self.config.run.tick_s * self.ticks_per_frame() as f64;
        self.config.vehicle.preview(frame_s).map_or(0, PreviewFrames::delay)
    }

    /// Ticks that `sim-core` and `sensor-daemon` may each be ahead of the next process.
    #[must_use]
    pub fn window_ticks(&self) -> u64 {
        u64::from(self.config.run.window_ticks)
    }

    /// Ticks that `traffic-bridge` may be ahead of `sim-core`: the window, and at least [`STEPS_AHEAD`] SUMO steps if a step has several
    /// ticks. With fewer, SUMO and `sim-core` wait for each other instead of working side by side.
    #[must_use]
    pub fn traffic_window_ticks(&self) -> u64 {
        let window = self.window_ticks();
        match self.ticks_per_traffic_step() {
            1 => window,
            per_step => window.max(STEPS_AHEAD * per_step),
        }
    }

    /// Where this environment begins: where its processes were started again, as the checkpoint says which the run begins with, or at
    /// its first tick.
    #[must_use]
    pub fn start(&self) -> Start {
        let beginning = self.beginning.as_ref().map(|beginning| beginning.start);
        let restart = self.restart.map(|restart| restart.start);
        restart.or(beginning).unwrap_or_default()
    }

    /// Number of the first tick that is simulated.
    #[must_use]
    pub fn first_tick(&self) -> u64 {
        self.start().episode_tick
    }

    /// Ticks below this are in the checkpoint that the run begins with.
    #[must_use]
    pub fn committed_ticks(&self) -> u64 {
        self.start().committed_ticks
    }

    /// The episodes of this run, in order; in play without end.
    pub fn schedule(&self) -> Box<dyn Iterator<Item = schedule::Episode>> {
        let episodes = self.beginning.as_ref().and_then(|beginning| beginning.episodes);
        let Start { episode, resets, .. } = self.start();
        if self.mode == Mode::Play {
            let ticks = match self.source {
                Source::Population { .. } => Some(self.config.episode.ticks),
                Source::Scenario { .. } => None,
            };
            let seed = self.seed();
            let indices = episode.saturating_sub(resets)..episodes.unwrap_or(u64::MAX);
            return Box::new(indices.map(move |index| schedule::play(seed, index, ticks)));
        }
        let run = self.clone();
        let episodes = (0..).map_while(move |index| run.episode(index));
        Box::new(episodes.filter(move |due| due.index + resets >= episode))
    }

    /// The plan of this run's curriculum, if it has one.
    #[must_use]
    pub fn curriculum_plan(&self) -> Option<schedule::CurriculumPlan> {
        let Config {
            curriculum, episode, ..
        } = &self.config;
        match (&self.source, curriculum.stages.is_empty()) {
            (Source::Population { .. }, false) if self.mode != Mode::Play => {
                Some(schedule::CurriculumPlan::new(episode, curriculum, self.seed()))
            }
            _ => None,
        }
    }

    /// The `index`-th episode of this run, as the configuration plans it; `None` past the last one, and in play. With a curriculum the run
    /// may end earlier.
    #[must_use]
    pub fn episode(&self, index: u64) -> Option<schedule::Episode> {
        let (lengths, seed) = (&self.config.episode, self.seed());
        match self.planned_manner() {
            PlannedManner::Play => None,
            PlannedManner::Scenario => schedule::scenario(seed, index),
            PlannedManner::Training => schedule::training(lengths, seed, index),
            PlannedManner::Simulation => schedule::simulation(lengths, seed, index),
        }
    }

    /// How many episodes of which length the configuration plans; none in play.
    #[must_use]
    pub fn episode_counts(&self) -> Vec<schedule::EpisodeCount> {
        let lengths = &self.config.episode;
        let counted = |ticks, episodes| vec![schedule::EpisodeCount { ticks, episodes }];
        match self.planned_manner() {
            PlannedManner::Play => Vec::new(),
            PlannedManner::Scenario => counted(None, 1),
            PlannedManner::Training => schedule::training_counts(lengths).to_vec(),
            PlannedManner::Simulation => counted(Some(lengths.ticks), lengths.training_episodes),
        }
    }

    fn planned_manner(&self) -> PlannedManner {
        match (&self.source, self.mode) {
            (_, Mode::Play) => PlannedManner::Play,
            (Source::Scenario { .. }, Mode::Simulate) => PlannedManner::Scenario,
            (Source::Scenario { .. }, Mode::Train) if self.config.episode.whole_scenario => PlannedManner::Scenario,
            (_, Mode::Train) => PlannedManner::Training,
            (Source::Population { .. }, Mode::Simulate) => PlannedManner::Simulation,
        }
    }
}

/// How the episodes of a run follow each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PlannedManner {
    Play,
    Scenario,
    Training,
    Simulation,
}
