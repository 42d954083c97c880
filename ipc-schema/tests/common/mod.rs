//! A run file for tests that create real services: a training run in a directory of its own.

use std::path::Path;

use ipc_schema::{
    SCHEMA_VERSION,
    config::Config,
    run::{MapInfo, Mode, RunFile, ScenarioOptions, SceneFiles, SharedMemory, Source},
};

/// The default preset.
pub fn town() -> Config {
    Config::from_json(include_str!("../town.json")).unwrap()
}

/// A run named `name` in `directory`. Its supervisor is the parent of this process.
pub fn run_in(directory: &Path, name: &str, config: Config) -> RunFile {
    RunFile {
        schema_version: SCHEMA_VERSION,
        env_index: 0,
        run_id: 1,
        name: name.into(),
        run_dir: directory.into(),
        mode: Mode::Train,
        supervisor_pid: rustix::process::getppid().unwrap().as_raw_nonzero().get(),
        shared_memory: SharedMemory {
            root: directory.into(),
            prefix: format!("caraware_{name}{}_", std::process::id()),
        },
        source: Source::Scenario {
            sumocfg: "none".into(),
            own: ScenarioOptions::default(),
        },
        map: MapInfo {
            projection: String::new(),
            net_offset_m: [0.0; 2],
            bounds_m: [0.0; 4],
            traffic_lights: 0,
            world_origin_m: [0.0; 2],
        },
        scene_files: SceneFiles::default(),
        maps: Vec::new(),
        sumo_home: "none".into(),
        config,
        config_hash: String::new(),
        beginning: None,
        restart: None,
        replay: None,
    }
}
