//! `caraware handover`: checks the request, sends it to the supervisor of the run, and prints the answer.

use std::path::{Path, PathBuf};

use ipc_schema::{
    config::Config,
    run::{Mode, RunFile},
};

use crate::{
    cli::HandoverArgs,
    config::{self, LayeredSettings},
    failure::Exit,
    registry,
    socket::{HandoverAnswer, HandoverRequest, SentRequest, SupervisorRequest},
};

/// The only settings that may change in a live run.
const CHANGEABLE: &str = "trainer.";

/// The configuration of `run` with other settings of the trainer.
///
/// # Errors
/// A key or value is wrong, or does not belong to the trainer.
pub fn changed_config(run: &RunFile, set: &[String]) -> Result<Config, Exit> {
    for assignment in set {
        let key = assignment.split('=').next().unwrap_or_default().trim();
        if config::keys::KEYS.iter().any(|known| known.path == key) && !key.starts_with(CHANGEABLE) {
            return Err(Exit::config(
                format!("`{key}` cannot change in a live run"),
                "a handover replaces the trainer: only keys of `trainer` may differ",
            ));
        }
    }
    Ok(LayeredSettings::of(&run.config)?.with_assignments(set)?.validate()?)
}

/// The checkpoint directory that the user named.
fn checkpoint(path: &Path) -> Result<PathBuf, Exit> {
    let path = std::path::absolute(path).map_err(|error| Exit::io("resolve", path, &error))?;
    if path.join("manifest.json").is_file() {
        return Ok(path);
    }
    Err(Exit::config(
        format!("{} is not a checkpoint: it has no manifest.json", path.display()),
        "give a directory like runs/NAME/checkpoints/update-000100",
    ))
}

/// A timeout that can be met.
fn timeout_s(seconds: f64) -> Result<f64, Exit> {
    if std::time::Duration::try_from_secs_f64(seconds).is_ok_and(|timeout| !timeout.is_zero()) {
        return Ok(seconds);
    }
    Err(Exit::config(
        format!("a timeout of {seconds} s cannot be met"),
        "`--timeout-s` takes seconds, more than 0",
    ))
}

/// Asks the supervisor of a run to replace its trainer, and waits for the answer. Trainers that learn together are replaced together.
///
/// # Errors
/// The request is wrong or refused, or no such run is alive.
pub fn handover(args: &HandoverArgs) -> Result<(), Exit> {
    let run = registry::find(args.run.as_deref())?;
    if run.mode != Mode::Train {
        return Err(Exit::config(
            format!("{} has no trainer", run.name),
            "`caraware simulate` only simulates; `caraware train` learns",
        ));
    }
    changed_config(&run, &args.set)?;
    let request = HandoverRequest {
        set: args.set.clone(),
        checkpoint: args.checkpoint.as_deref().map(checkpoint).transpose()?,
        now: args.now,
        timeout_s: args.timeout_s.map(timeout_s).transpose()?,
        together: run.config.trainer.ranks > 1,
    };
    let runs = ranks(&run)?;
    let requests = runs
        .iter()
        .map(|run| SentRequest::new(run, &SupervisorRequest::Handover(request.clone())));
    let mut requests: Vec<SentRequest> = requests.collect::<Result<_, _>>()?;
    if request.together {
        // No old trainer leaves before all successors are ready: they leave after the same update, or now.
        let refused = requests.iter_mut().find_map(|sent| match sent.answer() {
            Ok(HandoverAnswer::Refused(failure)) => Some(failure.into()),
            Ok(_) => None,
            Err(error) => Some(error),
        });
        if let Some(refused) = refused {
            requests.into_iter().for_each(SentRequest::withdraw);
            return Err(refused);
        }
        requests.iter_mut().try_for_each(SentRequest::permit)?;
    }
    for (run, sent) in runs.iter().zip(&mut requests) {
        print_answer(run, sent.answer()?)?;
    }
    Ok(())
}

fn print_answer(run: &RunFile, answer: HandoverAnswer) -> Result<(), Exit> {
    match answer {
        HandoverAnswer::Done(report) => {
            crate::say!(
                "{}: trainer {} continues from tick {}; the handover took {:.2} s",
                run.name,
                report.incarnation,
                report.first_tick,
                report.pause_s
            );
            Ok(())
        }
        HandoverAnswer::Refused(failure) => Err(failure.into()),
        HandoverAnswer::Ready => Err(Exit::run(
            format!("{} said twice that its successor is ready", run.name),
            "its supervisor is of another version; stop the run and resume it",
        )),
    }
}

/// The runs whose trainers are replaced together: `run` alone, or those of all ranks.
fn ranks(run: &RunFile) -> Result<Vec<RunFile>, Exit> {
    let ranks = run.config.trainer.ranks;
    if ranks == 1 {
        return Ok(vec![run.clone()]);
    }
    let runs = registry::ranks_of(run);
    if runs.len() != ranks as usize {
        return Err(Exit::config(
            format!(
                "{} of the {ranks} ranks that learn with {} are on this machine",
                runs.len(),
                run.name
            ),
            "a handover replaces the trainers of all ranks, on one machine; Ctrl-C and `--resume` do so on several",
        ));
    }
    Ok(runs)
}

/// Refuses the former name of the command.
///
/// # Errors
/// Always.
pub fn refuse_former_name() -> Result<(), Exit> {
    Err(Exit::config(
        "`caraware swap` was renamed to `caraware handover`",
        "the arguments are the same: `caraware handover --help`",
    ))
}
