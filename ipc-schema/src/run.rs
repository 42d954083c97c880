//! The run file: what the supervisor tells every process at its start.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::{
    SCHEMA_VERSION,
    config::Config,
    field::{RunField, run_fields},
    process::Process,
    schedule,
};

/// What a run is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// A trainer learns.
    Train,
    /// No learner.
    Simulate,
    /// A policy of a checkpoint predicts, and nothing learns.
    Play,
}

impl Mode {
    /// True if there is a process in the trainer's place, which must not miss an observation.
    #[must_use]
    pub fn has_trainer(self) -> bool {
        self != Self::Simulate
    }
}

/// Log of a curriculum in the run directory: the first lesson and tick of each stage.
pub const CURRICULUM_LOG: &str = "curriculum.jsonl";
/// Name of that log before it was renamed: a directory with it is refused.
pub const FORMER_CURRICULUM_LOG: &str = "actions.jsonl";

/// The checkpoint that a run begins with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Beginning {
    /// Its directory.
    pub checkpoint: PathBuf,
    /// Where this environment stands in it; in the file of a run that is environment 0.
    #[serde(flatten)]
    pub start: Start,
    /// Where those after environment 0 stand.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub others: Vec<Start>,
    /// Play: most episodes; `None`: without end.
    pub episodes: Option<u64>,
}

/// Where an environment stands in a checkpoint.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Start {
    /// Ticks of the environment that the checkpoint has learnt from: none of them is delivered again.
    pub committed_ticks: u64,
    /// Number of the episode that the first of the others belongs to: the simulation begins with it.
    pub episode: u64,
    /// The first tick of that episode.
    pub episode_tick: u64,
    /// How many episodes before it were begun anew by a command: so far its number is ahead of its place in the schedule.
    #[serde(default)]
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

/// What traffic runs on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// A map with population control: random routes for ever.
    Population {
        /// The built net.
        net_file: PathBuf,
        /// Vehicle types and polygons.
        additional_files: Vec<PathBuf>,
    },
    /// A user's scenario, as SUMO runs it.
    Scenario {
        /// The `.sumocfg`.
        sumocfg: PathBuf,
    },
}

/// What the net file says about itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapInfo {
    /// PROJ string of the net, or of the origin given in the configuration.
    pub projection: String,
    /// Added to projected coordinates to give net coordinates, metres.
    pub net_offset_m: [f64; 2],
    /// x_min, y_min, x_max, y_max of the net with a margin of 20 m, metres: the range of positions and predictions. Of a run with several
    /// maps: of all of them.
    pub bounds_m: [f64; 4],
    /// Programs of traffic lights in the net: at least as many as there are lights.
    pub traffic_lights: u32,
}

/// The files that the static scene is built from.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SceneFiles {
    /// The net: road surface, crossings, traffic lights.
    pub net_file: PathBuf,
    /// Polygons (buildings) and whatever else SUMO is given beside the routes.
    pub additional_files: Vec<PathBuf>,
}

/// A map of a run whose curriculum has several.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunMap {
    /// The name by which stages refer to it.
    pub name: String,
    /// What traffic runs on.
    pub source: Source,
    /// The map, with its own bounds.
    pub info: MapInfo,
    /// The files that the static scene is built from.
    pub scene_files: SceneFiles,
}

/// Where the run's shared memory lives: nothing outside it is touched.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SharedMemory {
    /// Directory of iceoryx2's files.
    pub root: PathBuf,
    /// Prefix of the files in `/dev/shm`.
    pub prefix: String,
}

/// SUMO steps under way at least: the one that moves now, the one that waits for it, and the one that SUMO makes meanwhile.
const STEPS_AHEAD: u64 = 3;

/// The run file, `run.json` in the run directory.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunFile {
    /// [`SCHEMA_VERSION`] of the writer.
    pub schema_version: u32,
    /// Random identity.
    pub run_id: u64,
    /// Name of the run.
    pub name: String,
    /// Index of the environment that this file speaks to, 0-based; what belongs to the whole run belongs to environment 0.
    #[serde(default)]
    pub env_index: u32,
    /// Directory with everything that this environment leaves behind; that of environment 0 holds the others'.
    pub run_dir: PathBuf,
    /// What the run is for.
    pub mode: Mode,
    /// Process id of the supervisor: processes end when it does.
    pub supervisor_pid: i32,
    /// Shared memory of the run.
    pub shared_memory: SharedMemory,
    /// What traffic runs on.
    pub source: Source,
    /// The map.
    pub map: MapInfo,
    /// The files that the static scene is built from.
    pub scene_files: SceneFiles,
    /// The maps of a curriculum that has several, the one above first. `map` above then has the bounds of all of them, and as many
    /// traffic lights as the one with the most.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub maps: Vec<RunMap>,
    /// Installation of SUMO (the `sumo` directory of the `eclipse-sumo` wheel).
    pub sumo_home: PathBuf,
    /// The validated configuration.
    pub config: Config,
    /// BLAKE3 of the configuration's canonical JSON.
    pub config_hash: String,
    /// The checkpoint to begin with, where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beginning: Option<Beginning>,
    /// Where the simulator processes of this environment were started again, after one of them had died.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restart: Option<RestartPoint>,
}

/// The run file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunFileError {
    /// Not readable or not writable.
    #[error("cannot access the run file {path}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// Not a run file.
    #[error("{path} is not a run file")]
    Format {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: serde_json::Error,
    },
    /// Written by another version.
    #[error("{path} has schema version {found}, this program reads {SCHEMA_VERSION}: rebuild with `make build`")]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
}

/// The run file as it is written: with what readers in other languages would have to work out.
#[derive(Serialize)]
struct WrittenRun<'a> {
    #[serde(flatten)]
    run: &'a RunFile,
    /// Every field of an observation with its range.
    observation_fields: Vec<RunField>,
}

impl RunFile {
    /// Reads and checks a run file.
    ///
    /// # Errors
    /// Unreadable, malformed, or of another schema version.
    pub fn read(path: &Path) -> Result<Self, RunFileError> {
        let text = std::fs::read_to_string(path).map_err(|source| RunFileError::Io {
            path: path.into(),
            source,
        })?;
        let run: Self = serde_json::from_str(&text).map_err(|source| RunFileError::Format {
            path: path.into(),
            source,
        })?;
        if run.schema_version != SCHEMA_VERSION {
            return Err(RunFileError::Version {
                path: path.into(),
                found: run.schema_version,
            });
        }
        Ok(run)
    }

    /// Writes the run file to `run_dir/run.json` and returns its path.
    ///
    /// # Errors
    /// Not writable.
    pub fn write(&self) -> Result<PathBuf, RunFileError> {
        let path = self.run_dir.join("run.json");
        let written = WrittenRun {
            run: self,
            observation_fields: run_fields(&self.config, &self.map),
        };
        let text = serde_json::to_string_pretty(&written).map_err(|source| RunFileError::Format {
            path: path.clone(),
            source,
        })?;
        std::fs::write(&path, text).map_err(|source| RunFileError::Io {
            path: path.clone(),
            source,
        })?;
        Ok(path)
    }

    /// True if a tick of this run is due at a time of the clock, and waits for `process`.
    #[must_use]
    pub fn keeps_time(&self, process: Process) -> bool {
        (process.spec().holds_up_ticks)(self) && self.config.run.real_time_factor > 0.0
    }

    /// The same run as environment `env_index` sees it. `self` is environment 0's.
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
        Self {
            env_index,
            run_dir,
            beginning,
            restart: None,
            ..self.clone()
        }
    }

    /// Every map of the run, at least one, by its place in [`crate::header::MessageHeader::map`].
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

    /// Seed of everything random in this environment; that of the run in the first one of all.
    #[must_use]
    pub fn seed(&self) -> u64 {
        let run = &self.config.run;
        schedule::environment_seed(run.seed, run.first_env + self.env_index)
    }

    /// Where `sim-core` writes what viewers are told of the scene, as JSON (docs/fanout.md, `map`), before it attaches.
    #[must_use]
    pub fn chart_path(&self) -> PathBuf {
        self.run_dir.join("map").join("chart.json")
    }

    /// Socket through which the supervisor takes requests, in a directory that only its user can enter.
    #[must_use]
    pub fn control_socket(&self) -> PathBuf {
        self.shared_memory.root.join("control")
    }

    /// SUMO steps per tick are 1 / this: ticks in one SUMO step.
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

    /// Ticks that dynamics and sensors may be ahead of the next process.
    #[must_use]
    pub fn window_ticks(&self) -> u64 {
        u64::from(self.config.run.window_ticks)
    }

    /// Ticks that traffic may be ahead of the dynamics: the window, and at least [`STEPS_AHEAD`] SUMO steps where a step has several
    /// ticks. With less SUMO and the dynamics wait for each other instead of working side by side.
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

    /// Number of the first tick that is made.
    #[must_use]
    pub fn first_tick(&self) -> u64 {
        self.start().episode_tick
    }

    /// Ticks that the checkpoint which the run begins with has learnt from.
    #[must_use]
    pub fn committed_ticks(&self) -> u64 {
        self.start().committed_ticks
    }

    /// The episodes that are made, in order; in play they may have no end.
    pub fn schedule(&self) -> Box<dyn Iterator<Item = schedule::Episode>> {
        let episodes = self.beginning.as_ref().and_then(|beginning| beginning.episodes);
        let Start { episode, resets, .. } = self.start();
        if self.mode == Mode::Play {
            let ticks = match self.source {
                Source::Population { .. } => Some(self.config.episode.ticks),
                Source::Scenario { .. } => None,
            };
            let seed = self.seed();
            return Box::new((0..episodes.unwrap_or(u64::MAX)).map(move |index| schedule::play(seed, index, ticks)));
        }
        Box::new(
            self.episodes()
                .into_iter()
                .filter(move |due| due.index + resets >= episode),
        )
    }

    /// The plan of this run if it has a curriculum.
    #[must_use]
    pub fn curriculum_plan(&self) -> Option<schedule::CurriculumPlan> {
        let Config {
            curriculum, episode, ..
        } = &self.config;
        match (&self.source, curriculum.stages.is_empty()) {
            (Source::Population { .. }, false) if self.mode != Mode::Play => {
                Some(schedule::CurriculumPlan::new(episode, curriculum, self.config.run.seed))
            }
            _ => None,
        }
    }

    /// The episodes of this run, where they have an end that the configuration knows; none in play. Of one with a curriculum the
    /// longest that it may get.
    #[must_use]
    pub fn episodes(&self) -> Vec<schedule::Episode> {
        let (lengths, seed) = (&self.config.episode, self.seed());
        match (&self.source, self.mode) {
            (_, Mode::Play) => Vec::new(),
            (Source::Scenario { .. }, Mode::Simulate) => schedule::scenario(seed),
            (Source::Scenario { .. }, Mode::Train) if lengths.whole_scenario => schedule::scenario(seed),
            (_, Mode::Train) => schedule::training(lengths, seed),
            (Source::Population { .. }, Mode::Simulate) => schedule::simulation(lengths, seed),
        }
    }
}
