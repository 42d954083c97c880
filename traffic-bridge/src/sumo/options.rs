//! SUMO's options for a run.

use std::path::{Path, PathBuf};

use ipc_schema::{
    failure::{Failure, FailureKind},
    run::ScenarioOptions,
};

use super::{connected::ConnectedRule, convention::sumo_seed, engine::Engine, error::SumoError, inputs::InputFiles};

/// SUMO teleports a vehicle of the population out of a jam after this long without movement, seconds.
const POPULATION_TELEPORT_S: u32 = 120;

/// Steps up to the root directory: more than any path has folders (a path is at most 4096 bytes, a folder two).
const TO_THE_ROOT: usize = 128;

/// A simulation as it is to be started.
#[derive(Debug, Clone, PartialEq)]
pub struct SumoOptions {
    pub(crate) arguments: Vec<String>,
    pub(crate) files: InputFiles,
    pub(crate) rule: ConnectedRule,
    pub(crate) sumo_home: PathBuf,
    /// The world frame's (0, 0) in the net's coordinates, metres.
    pub(crate) world_origin_m: [f64; 2],
    /// x_min, y_min, x_max, y_max of the net with a margin, world, metres.
    pub(crate) net_bounds_m: [f64; 4],
    /// Length of a step, seconds.
    pub(crate) step_s: f64,
    /// Where SUMO runs.
    pub(crate) engine: Engine,
}

impl SumoOptions {
    /// A net for population control: empty roads, `step_s` seconds a step, SUMO's random numbers from `episode_seed`.
    ///
    /// # Errors
    /// A file is missing.
    pub fn population(
        sumo_home: &Path,
        net_file: &Path,
        additional_files: &[PathBuf],
        step_s: f64,
        episode_seed: u64,
    ) -> Result<Self, SumoError> {
        let files = InputFiles {
            main: net_file.into(),
            others: additional_files.to_vec(),
        };
        files.check()?;
        let mut arguments = arguments(&[
            ("--net-file", &net_file.to_string_lossy()),
            ("--step-length", &step_s.to_string()),
            ("--seed", &sumo_seed(episode_seed).to_string()),
            ("--collision.action", "warn"),
            ("--time-to-teleport", &POPULATION_TELEPORT_S.to_string()),
            ("--no-step-log", "true"),
            ("--duration-log.disable", "true"),
        ]);
        if !additional_files.is_empty() {
            let names: Vec<_> = additional_files.iter().map(|file| file.to_string_lossy()).collect();
            arguments.extend(["--additional-files".to_owned(), names.join(",")]);
        }
        Ok(Self {
            arguments,
            files,
            rule: ConnectedRule::Population,
            sumo_home: sumo_home.into(),
            world_origin_m: [0.0; 2],
            net_bounds_m: [0.0; 4],
            step_s,
            engine: Engine::InProcess,
        })
    }

    /// All traffic lights are on, or off.
    #[must_use]
    pub fn with_traffic_lights(mut self, are_on: bool) -> Self {
        if !are_on {
            self.arguments.extend(["--tls.all-off".to_owned(), "true".to_owned()]);
        }
        self
    }

    /// A user's scenario exactly as SUMO runs it, except for its outputs, which go to `output_dir`. `step_s` and `seed` are
    /// those of the run; they replace the scenario's `own` only if they differ. `rule` says which vehicles are connected or
    /// heroes.
    ///
    /// Demand and span are the scenario's own unless [`SumoOptions::with_scale`] and [`SumoOptions::with_span`] say otherwise.
    ///
    /// # Errors
    /// A file is missing, or `output_dir` cannot be made.
    pub fn scenario(
        sumo_home: &Path,
        sumocfg: &Path,
        own: &ScenarioOptions,
        output_dir: &Path,
        step_s: f64,
        seed: u64,
        rule: ConnectedRule,
    ) -> Result<Self, SumoError> {
        let files = InputFiles {
            main: sumocfg.into(),
            others: own.inputs.clone(),
        };
        files.check()?;
        let mut arguments = arguments(&[
            ("--configuration-file", &sumocfg.to_string_lossy()),
            ("--output-prefix", &output_prefix(output_dir)?),
            ("--no-step-log", "true"),
        ]);
        #[expect(clippy::float_cmp, reason = "the run took the number from the same text")]
        if own.step_s != step_s {
            arguments.extend(["--step-length".to_owned(), step_s.to_string()]);
        }
        if own.seed != seed {
            arguments.extend(["--seed".to_owned(), sumo_seed(seed).to_string()]);
        }
        if own.is_random {
            // A seed from the clock would be another in every run.
            arguments.extend(["--random".to_owned(), "false".to_owned()]);
        }
        for (option, name) in &own.renamed_outputs {
            arguments.extend([format!("--{option}"), name.clone()]);
        }
        if matches!(&rule, ConnectedRule::Scenario { heroes, .. } if !heroes.is_empty()) {
            // `sim-core` reports a hero's collisions and ends its episode; SUMO would move the hero out of the way.
            arguments.extend(["--collision.action".to_owned(), "warn".to_owned()]);
        }
        Ok(Self {
            arguments,
            files,
            rule,
            sumo_home: sumo_home.into(),
            world_origin_m: [0.0; 2],
            net_bounds_m: [0.0; 4],
            step_s,
            engine: Engine::InProcess,
        })
    }
}

impl SumoOptions {
    /// The failure of a process that SUMO crashes while it reads the files: SUMO itself names none.
    #[must_use]
    pub fn crashed(&self) -> Failure {
        let InputFiles { main, others } = &self.files;
        let others: Vec<_> = others.iter().map(|file| file.display().to_string()).collect();
        let others = match others.is_empty() {
            true => String::new(),
            false => format!(" or a file that it names ({})", others.join(", ")),
        };
        let message = format!("ended while SUMO was reading {}{others}", main.display());
        Failure::new(FailureKind::Config, message)
            .with_help("build the net again with netconvert; `sumo` on the same files ends in the same way, which shows the file to correct")
    }

    /// The same from and to these times of SUMO, seconds, where they are given: SUMO's `--begin` and `--end`.
    #[must_use]
    pub fn with_span(mut self, begin_s: Option<f64>, end_s: Option<f64>) -> Self {
        for (option, time_s) in [("--begin", begin_s), ("--end", end_s)] {
            if let Some(time_s) = time_s {
                self.arguments.extend([option.to_owned(), time_s.to_string()]);
            }
        }
        self
    }

    /// The same where `engine` says.
    #[must_use]
    pub fn with_engine(mut self, engine: Engine) -> Self {
        self.engine = engine;
        self
    }

    /// The same with the world frame's (0, 0) at this place of the net, metres.
    #[must_use]
    pub fn with_world_origin(mut self, world_origin_m: [f64; 2]) -> Self {
        self.world_origin_m = world_origin_m;
        self
    }

    /// The same on a net with these bounds (x_min, y_min, x_max, y_max, with a margin; world, metres).
    #[must_use]
    pub fn with_net_bounds(mut self, net_bounds_m: [f64; 4]) -> Self {
        self.net_bounds_m = net_bounds_m;
        self
    }

    /// The same with `scale` times the demand, if it is given: SUMO's `--scale`.
    #[must_use]
    pub fn with_scale(mut self, scale: Option<f64>) -> Self {
        if let Some(scale) = scale {
            self.arguments.extend(["--scale".to_owned(), scale.to_string()]);
        }
        self
    }
}

fn arguments(pairs: &[(&str, &str)]) -> Vec<String> {
    pairs
        .iter()
        .flat_map(|(name, value)| [(*name).to_owned(), (*value).to_owned()])
        .collect()
}

/// SUMO puts the prefix between the folder of an output and its name, whether the output is named in the
/// configuration or in an additional file; an absolute prefix would come out as `<folder>//absolute/…`. So the prefix
/// climbs to the root first, and nothing is written beside the user's files.
fn output_prefix(output_dir: &Path) -> Result<String, SumoError> {
    let failed = |source| SumoError::Output {
        path: output_dir.into(),
        source,
    };
    std::fs::create_dir_all(output_dir).map_err(failed)?;
    let absolute = output_dir.canonicalize().map_err(failed)?;
    let from_root = absolute.to_string_lossy().trim_start_matches('/').to_owned();
    Ok(format!("{}{from_root}/", "../".repeat(TO_THE_ROOT)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_prefix_leads_from_any_folder_to_the_output_directory() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("sumo");
        let from = folder.path().join("a/b");
        std::fs::create_dir_all(&from).unwrap();
        let prefix = output_prefix(&output).unwrap();
        std::fs::write(from.join(format!("{prefix}x.xml")), "").unwrap();
        assert!(output.join("x.xml").is_file());
    }

    #[test]
    fn a_missing_net_is_named() {
        let error = SumoOptions::population(Path::new("/"), Path::new("no.net.xml"), &[], 0.1, 1).unwrap_err();
        assert!(error.to_string().contains("no.net.xml"), "{error}");
    }
}
