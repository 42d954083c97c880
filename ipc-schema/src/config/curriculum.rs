//! Stages of training, each with its own population, noise, blackouts and maps, and a gate to the next.

use std::{fmt, path::PathBuf, str::FromStr};

use serde::{Deserialize, Serialize};

use super::{
    Config, HeroTurns, OWN_TRAINER, TrafficConfig,
    text::{optional_path, serde_as_text},
};
use crate::{metric::PolicyMetric, sensor::SENSORS};

/// Stages of training.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurriculumConfig {
    /// In order; none = every training episode is as the rest of the configuration says.
    pub stages: Vec<StageConfig>,
    /// `curriculum.jsonl` of a run whose stages a simulation without learner repeats.
    #[serde(with = "optional_path")]
    pub log: Option<PathBuf>,
    /// Maps that stages choose from; the first is the run's own, that of evaluations. None = the town alone.
    pub maps: Vec<CurriculumMap>,
}

/// The names of the project's own maps.
const TOWN: &str = "town";
const AVENUE: &str = "avenue";
/// The maps of a run that names none.
const TOWN_ALONE: &[CurriculumMap] = &[CurriculumMap::Town];
/// Endings of files that are maps.
const MAP_ENDINGS: [&str; 4] = [".sumocfg", ".sumo.cfg", ".net.xml", ".net.xml.gz"];

/// A map that stages choose from. Configurations and run files write it as "town", "avenue" or as a path; stages refer to it by its name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CurriculumMap {
    /// The project's own map: one lane in each direction.
    Town,
    /// The project's own map with roads of up to three lanes.
    Avenue,
    /// A `.net.xml` or a `.sumocfg`.
    File {
        /// The file.
        path: PathBuf,
        /// Its name without the ending.
        name: String,
    },
}

/// The text is not a map.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is no map")]
pub struct CurriculumMapError(pub String);

impl CurriculumMap {
    /// The name by which stages refer to it.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Town => TOWN,
            Self::Avenue => AVENUE,
            Self::File { name, .. } => name,
        }
    }
}

serde_as_text!(CurriculumMap);

impl FromStr for CurriculumMap {
    type Err = CurriculumMapError;

    fn from_str(text: &str) -> Result<Self, CurriculumMapError> {
        match text {
            TOWN => return Ok(Self::Town),
            AVENUE => return Ok(Self::Avenue),
            _ => (),
        }
        let file = text.rsplit_once('/').map_or(text, |(_, file)| file);
        let name = MAP_ENDINGS.iter().find_map(|ending| file.strip_suffix(ending));
        match name {
            Some(name) if !name.is_empty() => Ok(Self::File {
                path: text.into(),
                name: name.to_owned(),
            }),
            _ => Err(CurriculumMapError(text.to_owned())),
        }
    }
}

impl fmt::Display for CurriculumMap {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Town => formatter.write_str(TOWN),
            Self::Avenue => formatter.write_str(AVENUE),
            Self::File { path, .. } => path.display().fmt(formatter),
        }
    }
}

impl CurriculumConfig {
    /// The run's maps, in order; at least one.
    #[must_use]
    pub fn run_maps(&self) -> &[CurriculumMap] {
        match self.maps.as_slice() {
            [] => TOWN_ALONE,
            maps => maps,
        }
    }

    /// Names of the run's maps, in order; at least one.
    #[must_use]
    pub fn map_names(&self) -> Vec<&str> {
        self.run_maps().iter().map(CurriculumMap::name).collect()
    }

    /// The first stage, counted from 1, that is on a map which the run does not have, and that map's name. `None` in a validated
    /// configuration and in a run file that was read.
    #[must_use]
    pub fn unknown_map(&self) -> Option<(usize, &str)> {
        let names = self.map_names();
        (1..).zip(&self.stages).find_map(|(number, stage)| {
            let unknown = stage.maps.iter().find(|name| !names.contains(&name.as_str()));
            unknown.map(|name| (number, name.as_str()))
        })
    }

    /// The maps that lessons of `stage` choose from, as indices into [`CurriculumConfig::map_names`]; at least one. The run has all
    /// of them ([`CurriculumConfig::unknown_map`]).
    #[must_use]
    pub fn maps_of(&self, stage: &StageConfig) -> Vec<usize> {
        if stage.maps.is_empty() {
            return vec![0];
        }
        let names = self.map_names();
        let place = |name: &String| names.iter().position(|known| known == name);
        stage.maps.iter().filter_map(place).collect()
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
    /// Connected vehicles kept alive; none = `traffic.cavs`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cavs: Option<u32>,
    /// Vehicles without sensors kept alive; none = `traffic.others`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub others: Option<u32>,
    /// Pedestrians kept alive; none = `traffic.pedestrians`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pedestrians: Option<u32>,
    /// Heroes kept alive; none = `traffic.heroes`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heroes: Option<u32>,
    /// Routes of heroes; none = `traffic.hero_turns`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hero_turns: Option<HeroTurns>,
    /// Whether traffic lights are on; none = `traffic.traffic_lights`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub traffic_lights: Option<bool>,
    /// Factor on speed limits; none = `traffic.speed_limit_factor`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed_limit_factor: Option<f64>,
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

impl StageConfig {
    /// The traffic of this stage, in a run with `traffic`.
    #[must_use]
    pub fn traffic(&self, traffic: &TrafficConfig) -> TrafficConfig {
        TrafficConfig {
            cavs: self.cavs.unwrap_or(traffic.cavs),
            others: self.others.unwrap_or(traffic.others),
            pedestrians: self.pedestrians.unwrap_or(traffic.pedestrians),
            heroes: self.heroes.unwrap_or(traffic.heroes),
            hero_turns: self.hero_turns.unwrap_or(traffic.hero_turns),
            traffic_lights: self.traffic_lights.unwrap_or(traffic.traffic_lights),
            speed_limit_factor: self.speed_limit_factor.unwrap_or(traffic.speed_limit_factor),
            ..traffic.clone()
        }
    }
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
    /// True if the trainer decides which stage of the curriculum a lesson belongs to. With several trainers or environments, or a trainer
    /// other than [`OWN_TRAINER`], each environment counts its own lessons.
    #[must_use]
    pub fn trainer_decides_lessons(&self) -> bool {
        let is_alone = self.run.envs == 1 && self.trainer.ranks <= 1;
        !self.curriculum.stages.is_empty() && is_alone && self.trainer.module == OWN_TRAINER
    }

    /// The traffic of the base configuration and of each stage.
    pub fn traffic_of_stages(&self) -> impl Iterator<Item = TrafficConfig> {
        let stages = self.curriculum.stages.iter();
        std::iter::once(self.traffic.clone()).chain(stages.map(|stage| stage.traffic(&self.traffic)))
    }

    /// This configuration in `stage` of the curriculum (counted from 1); 0 is the configuration itself.
    #[must_use]
    pub fn in_stage(&self, stage: usize) -> Self {
        let mut config = self.clone();
        let Some(stage) = stage.checked_sub(1).and_then(|index| self.curriculum.stages.get(index)) else {
            return config;
        };
        config.traffic = stage.traffic(&config.traffic);
        for sensor in &SENSORS {
            (sensor.scale_noise)(&mut config, stage.noise);
            (sensor.scale_blackouts)(&mut config, stage.blackout);
        }
        config
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_is_the_town_or_a_file_that_is_called_by_its_name() {
        assert_eq!("town".parse(), Ok(CurriculumMap::Town));
        assert_eq!("avenue".parse(), Ok(CurriculumMap::Avenue));
        for text in [
            "city.net.xml",
            "nets/city.net.xml.gz",
            "/nets/city.sumocfg",
            "city.sumo.cfg",
        ] {
            let map: CurriculumMap = text.parse().unwrap();
            assert_eq!((map.name(), map.to_string().as_str()), ("city", text));
        }
        for text in ["", "village", "city.xml", "nets/.net.xml", "nets/"] {
            assert_eq!(text.parse::<CurriculumMap>(), Err(CurriculumMapError(text.to_owned())));
        }
    }

    /// The noise of a pixel as a share of full brightness, at a share of it.
    fn pixel_noise(config: &Config, share: f64) -> f64 {
        let camera = &config.camera;
        (share * camera.full_well_e + camera.read_noise_e.powi(2)).sqrt() / camera.full_well_e
    }

    #[test]
    fn a_stage_scales_the_noise_of_a_pixel_at_any_brightness() {
        let mut config = Config::from_json(include_str!("../../tests/town.json")).unwrap();
        let camera = &mut config.camera;
        (camera.full_well_e, camera.read_noise_e, camera.infrared_noise_k) = (9000.0, 12.0, 0.05);
        config.curriculum.stages = [0.5, 3.0, 0.0]
            .map(|noise| serde_json::from_value(serde_json::json!({ "cavs": 1, "noise": noise })).unwrap())
            .to_vec();
        for (stage, factor) in [(1, 0.5), (2, 3.0)] {
            let scaled = config.in_stage(stage);
            for share in [0.0, 0.01, 0.4, 1.0] {
                let ratio = pixel_noise(&scaled, share) / pixel_noise(&config, share);
                assert!((ratio / factor - 1.0).abs() < 1e-12, "{factor} at {share}: {ratio}");
            }
            assert!((scaled.camera.infrared_noise_k - 0.05 * factor).abs() < 1e-12);
        }
        let silent = config.in_stage(3).camera;
        assert_eq!((silent.full_well_e, silent.infrared_noise_k), (0.0, 0.0));
    }

    #[test]
    fn a_stage_on_a_map_that_the_run_does_not_have_is_found() {
        let stage = |maps: &[&str]| serde_json::from_value(serde_json::json!({ "cavs": 1, "maps": maps })).unwrap();
        let mut curriculum = CurriculumConfig {
            maps: vec![CurriculumMap::Town, "city.net.xml".parse().unwrap()],
            stages: vec![stage(&[]), stage(&["city", "town"])],
            ..CurriculumConfig::default()
        };
        assert_eq!(curriculum.unknown_map(), None);
        let places: Vec<_> = curriculum
            .stages
            .iter()
            .map(|stage| curriculum.maps_of(stage))
            .collect();
        assert_eq!(places, [vec![0], vec![1, 0]]);
        curriculum.stages.push(stage(&["village"]));
        assert_eq!(curriculum.unknown_map(), Some((3, "village")));
    }
}
