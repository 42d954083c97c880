//! Stages of training, each with its own population, noise, blackouts and maps, and a gate to the next.

use serde::{Deserialize, Serialize};

use super::{Config, TrafficConfig};
use crate::{metric::PolicyMetric, sensor::SENSORS};

/// Stages of training.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurriculumConfig {
    /// In order; none = every training episode is as the rest of the configuration says.
    pub stages: Vec<StageConfig>,
    /// `curriculum.jsonl` of a run whose stages a simulation without learner repeats; "" = none.
    pub log: String,
    /// Maps that stages choose from, each "town", a `.net.xml` or a `.sumocfg`; the first is the run's own, that of evaluations. None =
    /// the town alone.
    #[serde(default)]
    pub maps: Vec<String>,
}

/// The project's own map.
pub const TOWN: &str = "town";
/// Endings of files that are maps.
const MAP_ENDINGS: [&str; 3] = [".sumocfg", ".net.xml", ".net.xml.gz"];

/// Name of a map in `curriculum.maps`: "town", or that of the file without its ending; `None` if it is neither.
#[must_use]
pub fn map_name(entry: &str) -> Option<&str> {
    if entry == TOWN {
        return Some(TOWN);
    }
    let file = entry.rsplit('/').next().unwrap_or(entry);
    let name = MAP_ENDINGS.iter().find_map(|ending| file.strip_suffix(ending))?;
    (!name.is_empty()).then_some(name)
}

impl CurriculumConfig {
    /// Names of the run's maps, in order; at least one.
    #[must_use]
    pub fn map_names(&self) -> Vec<&str> {
        match self.maps.as_slice() {
            [] => vec![TOWN],
            maps => maps.iter().map(|entry| map_name(entry).unwrap_or(entry)).collect(),
        }
    }

    /// The maps that lessons of `stage` choose from, as indices into [`CurriculumConfig::map_names`]; at least one.
    #[must_use]
    pub fn maps_of(&self, stage: &StageConfig) -> Vec<usize> {
        let names = self.map_names();
        let known = stage.maps.iter();
        let known: Vec<usize> = known
            .filter_map(|name| names.iter().position(|known| known == name))
            .collect();
        if known.is_empty() { vec![0] } else { known }
    }
}

/// Which of a stage's maps a lesson is on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MapChoice {
    /// One after the other, then the first again.
    #[default]
    InOrder,
    /// Drawn for each lesson.
    Random,
    /// The first map, and a share of lessons on a drawn map that grows from none to all.
    GraduallyRandom,
}

/// One stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StageConfig {
    /// Connected vehicles kept alive.
    pub cavs: u32,
    /// Ticks in a lesson; none = `episode.ticks`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ticks: Option<u64>,
    /// Every lesson begins with all vehicles at new positions; else it continues where the one before ended.
    #[serde(default = "yes")]
    pub restart: bool,
    /// Names of the maps that its lessons are on; none = the run's first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub maps: Vec<String>,
    /// Which of them, lesson by lesson.
    #[serde(default, skip_serializing_if = "is_default")]
    pub map_choice: MapChoice,
    /// Factor on the random errors and biases of all sensors.
    #[serde(default = "one")]
    pub noise: f64,
    /// Factor on the lengths of blackouts; 0 = none.
    #[serde(default = "one")]
    pub blackout: f64,
    /// Passed once the policy's standard deviation is at most this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_std: Option<f64>,
    /// Passed once the mean of this metric in an update's samples is as good as `until_value`, or better.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_metric: Option<PolicyMetric>,
    /// In the unit of `until_metric`, with which it is set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_value: Option<f64>,
    /// Passed after so many lessons.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_lessons: Option<u64>,
}

fn is_default(choice: &MapChoice) -> bool {
    *choice == MapChoice::default()
}

fn yes() -> bool {
    true
}

fn one() -> f64 {
    1.0
}

impl Config {
    /// This configuration in `stage` of the curriculum (counted from 1); 0 is the configuration itself.
    #[must_use]
    pub fn in_stage(&self, stage: usize) -> Self {
        let mut config = self.clone();
        let Some(stage) = stage.checked_sub(1).and_then(|index| self.curriculum.stages.get(index)) else {
            return config;
        };
        config.traffic = TrafficConfig {
            cavs: stage.cavs,
            ..config.traffic
        };
        for sensor in &SENSORS {
            (sensor.scale_noise)(&mut config, stage.noise);
            (sensor.scale_blackouts)(&mut config, stage.blackout);
        }
        config
    }
}
