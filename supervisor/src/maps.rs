//! The maps of a run with population control: finds or builds the nets and scenes of `curriculum.maps`, and the box around all of them.

use std::path::{Path, PathBuf};

use ipc_schema::{
    config::{Config, CurriculumConfig, CurriculumMap},
    run::{MapInfo, RunMap, SceneFiles, Source},
};

use crate::{
    failure::Exit,
    install::Install,
    scenario::{self, ScenarioReading},
    town,
};

/// Checks that every file of `curriculum.maps` exists, and makes its path absolute.
///
/// # Errors
/// A file does not exist.
pub fn locate(curriculum: &mut CurriculumConfig) -> Result<(), Exit> {
    for map in &mut curriculum.maps {
        let CurriculumMap::File { path, .. } = map else {
            continue;
        };
        let absolute = std::path::absolute(&*path).map_err(|error| Exit::io("resolve", path, &error))?;
        if !absolute.is_file() {
            return Err(Exit::config(
                format!(
                    "`curriculum.maps` has \"{}\", but {} is not a file",
                    path.display(),
                    absolute.display()
                ),
                "correct the path: it is relative to the directory that caraware is started in",
            ));
        }
        *path = absolute;
    }
    Ok(())
}

/// Prepares every map of `config` for SUMO and the scene. Files that have to be built go to `directory`.
///
/// # Errors
/// A file cannot be read, a net lacks what it needs, or the town cannot be built.
pub fn build(install: &Install, config: &Config, directory: &Path) -> Result<Vec<RunMap>, Exit> {
    let origin = config.map.origin_latitude_deg.zip(config.map.origin_longitude_deg);
    let map = |map: &CurriculumMap| {
        let (source, scene_files) = match map {
            CurriculumMap::Town => built(install, &town::TOWN, directory)?,
            CurriculumMap::Avenue => built(install, &town::AVENUE, directory)?,
            CurriculumMap::File { path, .. } => user_map(path, directory, config.traffic.trust_scenario)?,
        };
        Ok(RunMap {
            name: map.name().to_owned(),
            info: scenario::map_info(&scene_files.net_file, origin)?,
            source,
            scene_files,
        })
    };
    config.curriculum.run_maps().iter().map(map).collect()
}

/// Builds a map of our own. SUMO and the scene use the same files.
fn built(install: &Install, map: &town::OwnMap, directory: &Path) -> Result<(Source, SceneFiles), Exit> {
    let (net_file, additional_files) = map.build(install, directory)?;
    let source = Source::Population {
        net_file: net_file.clone(),
        additional_files: additional_files.clone(),
    };
    let scene_files = SceneFiles {
        net_file,
        additional_files,
    };
    Ok((source, scene_files))
}

/// Reads a user's net or scenario. The scene uses its additional files; SUMO does not, because they may also define demand and outputs,
/// and gets only the town's vehicle types.
fn user_map(file: &Path, directory: &Path, trusted: bool) -> Result<(Source, SceneFiles), Exit> {
    let scene_files = match scenario::is_scenario(file) {
        true => {
            let scenario = scenario::read(file, ScenarioReading::of(trusted, ""))?;
            SceneFiles {
                net_file: scenario.net_file,
                additional_files: scenario.additional_files,
            }
        }
        false => SceneFiles {
            net_file: PathBuf::from(file),
            additional_files: Vec::new(),
        },
    };
    scenario::check_net(&scene_files.net_file, trusted)?;
    let source = Source::Population {
        net_file: scene_files.net_file.clone(),
        additional_files: vec![town::vehicle_types(directory)?],
    };
    Ok((source, scene_files))
}

/// Combines the maps for the run file: the first map's projection, the box around all, and the largest number of traffic lights.
#[must_use]
pub fn combine(maps: &[RunMap]) -> Option<MapInfo> {
    let (first, others) = maps.split_first()?;
    let mut whole = first.info.clone();
    for RunMap { info, .. } in others {
        for side in 0..4 {
            let (a, b) = (whole.bounds_m[side], info.bounds_m[side]);
            whole.bounds_m[side] = if side < 2 { a.min(b) } else { a.max(b) };
        }
        whole.traffic_lights = whole.traffic_lights.max(info.traffic_lights);
    }
    Some(whole)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use ipc_schema::run::ScenarioOptions;

    use super::*;

    fn map(bounds_m: [f64; 4], traffic_lights: u32, projection: &str) -> RunMap {
        RunMap {
            name: projection.into(),
            source: Source::Scenario {
                sumocfg: "none".into(),
                own: ScenarioOptions::default(),
            },
            info: MapInfo {
                projection: projection.into(),
                net_offset_m: [1.0, 2.0],
                bounds_m,
                traffic_lights,
                world_origin_m: [0.0; 2],
            },
            scene_files: SceneFiles::default(),
        }
    }

    #[test]
    fn one_box_holds_all_maps() {
        let maps = [
            map([-20.0, -20.0, 500.0, 100.0], 3, "a"),
            map([-50.0, 0.0, 400.0, 300.0], 7, "b"),
        ];
        let whole = combine(&maps).unwrap();
        assert_eq!(whole.bounds_m, [-50.0, -20.0, 500.0, 300.0]);
        assert_eq!((whole.projection.as_str(), whole.traffic_lights), ("a", 7));
        assert_eq!(combine(&maps[1..]).unwrap(), maps[1].info);
    }

    #[test]
    fn a_missing_map_is_named_with_its_key() {
        let folder = tempfile::tempdir().unwrap();
        let net = folder.path().join("here.net.xml");
        std::fs::write(&net, "").unwrap();
        let here: CurriculumMap = net.to_string_lossy().parse().unwrap();
        let maps = vec![CurriculumMap::Town, here];
        let mut curriculum = CurriculumConfig {
            maps: maps.clone(),
            ..CurriculumConfig::default()
        };
        locate(&mut curriculum).unwrap();
        assert_eq!(curriculum.maps, maps);
        curriculum.maps.push("nowhere/city.sumocfg".parse().unwrap());
        let message = format!("{:?}", locate(&mut curriculum).unwrap_err());
        assert!(
            message.contains("`curriculum.maps`") && message.contains("nowhere/city.sumocfg"),
            "{message}"
        );
    }
}
