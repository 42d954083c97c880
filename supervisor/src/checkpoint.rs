//! Checkpoints on disk. The Python module `caraware.run.manifest`, which writes them, also verifies them for the supervisor.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use ipc_schema::{
    config::{Activation, Config, Network},
    run::{Beginning, RunFile, Start},
    storage,
};
use serde::Deserialize;

use crate::{failure::Exit, install::Install};

/// The fields of a checkpoint's manifest that the supervisor needs.
#[derive(Debug, Clone, Deserialize)]
struct CheckpointManifest {
    observation_size: u64,
    hidden: Vec<u64>,
    network: Network,
    activation: Activation,
    counters: CheckpointCounters,
}

#[derive(Debug, Clone, Deserialize)]
struct CheckpointCounters {
    /// The last committed tick; -1 before the first commit.
    committed_tick: i64,
    next_episode: u64,
    next_episode_tick: u64,
}

impl CheckpointCounters {
    /// Where a resumed simulation begins.
    fn start(&self) -> Start {
        Start {
            committed_ticks: u64::try_from(self.committed_tick + 1).unwrap_or(0),
            episode: self.next_episode,
            episode_tick: self.next_episode_tick,
            resets: 0,
        }
    }
}

/// The answer of `caraware.run.manifest`.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum VerifierAnswer {
    /// A verified checkpoint.
    Sound {
        checkpoint: PathBuf,
        manifest: CheckpointManifest,
        /// Counters of the environments after the first.
        others: Vec<CheckpointCounters>,
    },
    /// No checkpoint is usable.
    Refused {
        /// The reason.
        refused: String,
    },
}

/// A verified checkpoint: every byte is as the trainer wrote it.
#[derive(Debug)]
pub struct FoundCheckpoint {
    /// Its directory.
    pub checkpoint: PathBuf,
    /// True if the user named a run; false if the user named this checkpoint.
    pub is_run: bool,
    run_dir: PathBuf,
    manifest: CheckpointManifest,
    others: Vec<CheckpointCounters>,
}

impl FoundCheckpoint {
    /// Finds the checkpoint in the directory `named`, or the best checkpoint of the run with this directory or with this name in `runs`.
    ///
    /// # Errors
    /// There is no checkpoint, or it is damaged.
    pub fn best(install: &Install, named: &str, runs: &Path) -> Result<Self, Exit> {
        Self::find(install, named, runs, "best")
    }

    /// As [`Self::best`], but finds the newest checkpoint of a run.
    ///
    /// # Errors
    /// There is no checkpoint, or it is damaged.
    pub fn newest(install: &Install, named: &str, runs: &Path) -> Result<Self, Exit> {
        Self::find(install, named, runs, "newest")
    }

    fn find(install: &Install, named: &str, runs: &Path, which: &str) -> Result<Self, Exit> {
        let (directory, is_run) = locate(named, runs)?;
        let output = Command::new(&install.python)
            .args(["-m", "caraware.run.manifest"])
            .arg(&directory)
            .arg(which)
            .output()
            .map_err(|error| Exit::io("start", &install.python, &error))?;
        let warnings = String::from_utf8_lossy(&output.stderr);
        let answer: VerifierAnswer = serde_json::from_slice(&output.stdout).map_err(|_| {
            Exit::missing(
                format!("cannot verify {}: {}", directory.display(), warnings.trim()),
                "`make build` installs what the trainer needs; `caraware doctor` checks it",
            )
        })?;
        // The verifier warns of each damaged checkpoint that it skips.
        eprint!("{warnings}");
        let (checkpoint, manifest, others) = match answer {
            VerifierAnswer::Sound {
                checkpoint,
                manifest,
                others,
            } => (checkpoint, manifest, others),
            VerifierAnswer::Refused { refused } => {
                return Err(Exit::run(
                    format!("checkpoint refused: {refused}"),
                    "name another checkpoint of the run, e.g. runs/NAME/checkpoints/update-000100",
                ));
            }
        };
        let run_dir = checkpoint.ancestors().nth(2).unwrap_or(&checkpoint).to_owned();
        Ok(Self {
            checkpoint,
            is_run,
            run_dir,
            manifest,
            others,
        })
    }

    /// Reads the run file of the run that the checkpoint belongs to.
    ///
    /// # Errors
    /// The run file is missing, or another version wrote it.
    pub fn run(&self) -> Result<RunFile, Exit> {
        RunFile::read(&self.run_dir.join("run.json")).map_err(|error| {
            let mut failure =
                ipc_schema::failure::Failure::from_error(ipc_schema::failure::FailureKind::Config, &error);
            failure.help = Some(format!(
                "the configuration of {} comes from the run file beside it; `caraware play` accepts a CONFIG instead",
                self.checkpoint.display()
            ));
            failure.into()
        })
    }

    /// Name of the run that the checkpoint belongs to.
    #[must_use]
    pub fn label(&self) -> String {
        self.run_dir
            .file_name()
            .map_or_else(|| "run".into(), |name| name.to_string_lossy().into_owned())
    }

    /// Checks that the configuration has the checkpoint's size of observation, network, activation and hidden layers.
    ///
    /// # Errors
    /// One of them differs; the message holds both values.
    pub fn check_fit(&self, config: &Config) -> Result<(), Exit> {
        let refuse = |what: &str, has: String, wants: String, help: &str| {
            let message = format!(
                "{} does not fit the configuration: its {what} {has}, the configuration's {wants}",
                self.checkpoint.display()
            );
            Err(Exit::config(message, help))
        };
        let (size, width) = (self.manifest.observation_size, config.policy_width() as u64);
        if size != width {
            let help = "set observation.fields and observation.history (v2x.candidates in the messages task) as in the run that learnt it";
            return refuse("observation has", format!("{size} numbers"), width.to_string(), help);
        }
        if self.manifest.network != config.trainer.network {
            let (has, wants) = (&self.manifest.network, &config.trainer.network);
            let help = "set trainer.network as in the run that learnt it";
            return refuse("network is", format!("\"{has}\""), format!("\"{wants}\""), help);
        }
        if self.manifest.activation != config.trainer.activation {
            let [has, wants] = [self.manifest.activation, config.trainer.activation].map(Activation::name);
            let help = "set trainer.activation as in the run that learnt it";
            return refuse(
                "network has the activation",
                format!("\"{has}\""),
                format!("\"{wants}\""),
                help,
            );
        }
        if self.manifest.hidden != config.trainer.hidden {
            let (has, wants) = (&self.manifest.hidden, &config.trainer.hidden);
            let help = "set trainer.hidden as in the run that learnt it";
            return refuse(
                "network has hidden layers",
                format!("{has:?}"),
                format!("{wants:?}"),
                help,
            );
        }
        Ok(())
    }

    /// Where a run that continues from this checkpoint begins.
    #[must_use]
    pub fn beginning(&self) -> Beginning {
        Beginning {
            checkpoint: self.checkpoint.clone(),
            start: self.manifest.counters.start(),
            others: self.others.iter().map(CheckpointCounters::start).collect(),
            episodes: None,
        }
    }

    /// Copies the checkpoint to the run in `run_dir`, and returns the beginning of that run, which continues from the copy. The copy has its
    /// name once it is whole and flushed to disk.
    ///
    /// # Errors
    /// The checkpoint is not readable, or `run_dir` is not writable.
    pub fn copy_into(&self, run_dir: &Path) -> Result<Beginning, Exit> {
        let name = self.checkpoint.file_name().unwrap_or_default();
        let folder = run_dir.join("checkpoints");
        let copy = folder.join(name);
        let failed = |error: std::io::Error| Exit::io("write", &copy, &error);
        let partial = folder.join(format!(".{}.partial", name.to_string_lossy()));
        let copy_files = || {
            std::fs::create_dir_all(&partial)?;
            for entry in std::fs::read_dir(&self.checkpoint)? {
                let entry = entry?;
                storage::write_whole(&partial.join(entry.file_name()), std::fs::read(entry.path())?)?;
            }
            std::fs::rename(&partial, &copy)
        };
        copy_files().map_err(failed)?;
        // This flushes the folder, too.
        storage::write_whole(&folder.join("latest"), name.as_encoded_bytes()).map_err(failed)?;
        Ok(Beginning {
            checkpoint: copy.clone(),
            ..self.beginning()
        })
    }
}

/// Environment variable: the newest checkpoint that all ranks of a launch have, `caraware.run.manifest.NEWEST`.
const NEWEST: &str = "CARAWARE_NEWEST_CHECKPOINT";
/// Its value where they have none in common, `caraware.run.manifest.BEGINNING`.
const BEGINNING: &str = "beginning";

/// The directory of the run `named`, a name in `runs` or a directory, if it has no checkpoint that counts: it was cut off before its
/// first one, or before another rank had written that.
///
/// # Errors
/// The run was cut off before it was prepared.
pub fn without_checkpoint(named: &str, runs: &Path) -> Result<Option<PathBuf>, Exit> {
    let candidates = [runs.join(named), PathBuf::from(named)];
    let Some(run_dir) = candidates
        .iter()
        .find(|run| run.join("logs").is_dir() || run.join("run.json").is_file())
    else {
        return Ok(None);
    };
    let is_checkpoint = |entry: std::fs::DirEntry| {
        let name = entry.file_name();
        !name.to_string_lossy().starts_with('.') && entry.path().join("manifest.json").exists()
    };
    let mut entries = std::fs::read_dir(run_dir.join("checkpoints"))
        .into_iter()
        .flatten()
        .flatten();
    let begins_again = std::env::var_os(NEWEST).is_some_and(|newest| newest == BEGINNING);
    if !begins_again && entries.any(is_checkpoint) {
        return Ok(None);
    }
    if !run_dir.join("run.json").is_file() {
        return Err(Exit::run(
            format!("the run in {} ended before it was prepared", run_dir.display()),
            "remove the directory, and start the run again",
        ));
    }
    std::path::absolute(run_dir)
        .map(Some)
        .map_err(|error| Exit::io("resolve", run_dir, &error))
}

/// The directory of the checkpoint or run that `named` stands for; true if it is a run.
fn locate(named: &str, runs: &Path) -> Result<(PathBuf, bool), Exit> {
    let absolute = |path: &Path| std::path::absolute(path).map_err(|error| Exit::io("resolve", path, &error));
    let path = Path::new(named);
    if path.join("manifest.json").exists() || path.parent().is_some_and(|folder| folder.ends_with("checkpoints")) {
        return Ok((absolute(path)?, false));
    }
    let candidates = [runs.join(named), path.to_owned()];
    if let Some(run) = candidates.iter().find(|run| run.join("checkpoints").is_dir()) {
        return Ok((absolute(run)?, true));
    }
    if let Some(run) = candidates.iter().find(|run| run.join("run.json").is_file()) {
        return Err(Exit::run(
            format!("the run {} has no checkpoint", run.display()),
            "`caraware train --resume` continues it from its beginning",
        ));
    }
    Err(Exit::config(
        format!("`{named}` is neither a run in {} nor a checkpoint", runs.display()),
        "give the name or directory of a run, or a directory like runs/NAME/checkpoints/update-000100",
    ))
}
